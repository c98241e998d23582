"""Gradients of a run by all available methods, their memory for long runs, and gradients of leading-order designs.

Called by engine.py. The machine and its start are those of single.py.
"""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from parts.common import best, best_in_turn, first, published, say, thrown

import jaxvib as jv
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.folds import rotor_speed_at

NAMES = ("stiffness", "damping", "link_stiffness", "link_damping")


def gradient(quick: bool = False) -> None:
    """Gradient as a user writes it: `simulate` under `jit`, `jacfwd` and `grad`; a displacement at the end by 6 numbers."""
    end = 40.0 if quick else 200.0
    scene, start = published(), thrown()
    values = jnp.concatenate([getattr(scene.machine, name) for name in NAMES])

    def value(x: jax.Array, adjoint: Any = None, steps: Any = None) -> jax.Array:
        moved = eqx.tree_at(lambda s: [getattr(s.machine, name) for name in NAMES], scene, [x[:2], x[2:4], x[4:5], x[5:6]])
        given = dict(start=start, save="window", max_steps=2**13)
        run = jv.simulate(moved, end, stepsize_controller=steps, adjoint=adjoint, **given)
        return run.window.state.displacement[-1, 1]

    for how, steps in (("tolerance 1e-8", jv.Tolerance(1e-8)), ("equal steps", jv.EqualSteps(int(5 * end)))):
        group = f"gradient, {how}"
        print(f"{group}: the end state of simulate with respect to 6 parameters, T = {end:g}")
        run = jax.jit(lambda x, steps=steps: value(x, steps=steps))

        def differences(x: jax.Array, run: Any = run) -> jax.Array:
            moves = 1e-5 * jnp.diag(x)
            return jnp.stack([(run(x + m) - run(x - m)) / (2e-5 * x[k]) for k, m in enumerate(moves)])

        ways: list[tuple[str, Any]] = [
            ("the run itself, under jit", run),
            ("forward mode", jax.jit(jax.jacfwd(lambda x, s=steps: value(x, diffrax.ForwardMode(), s)))),
            ("reverse mode", jax.jit(jax.grad(lambda x, s=steps: value(x, steps=s)))),
            ("finite differences, 12 runs", differences),
        ]
        compiling = [first(lambda call=call: call(values)) for _, call in ways]
        found = [np.asarray(call(values)) for _, call in ways]
        seconds = best_in_turn([lambda call=call: call(values) for _, call in ways], 3 if quick else 20)
        for k, (name, _) in enumerate(ways):
            off = float(np.max(np.abs(found[k] - found[1])) / np.max(np.abs(found[1]))) if k > 1 else None
            say(group, name, seconds[k], seconds[0], off, compiling[k], "" if off is None else "error: to forward mode")


def memory(quick: bool = False) -> None:
    group = "memory of a reverse gradient"
    print(f"{group}: temporary arrays of the compiled program, by turns of the rotor; tolerance 1e-6")
    scene, start = published(), thrown()
    for turns in (30, 100) if quick else (100, 300, 1000, 3000, 10_000):
        end = 2.0 * np.pi * turns / float(scene.drive.speed)

        def value(n: jax.Array, end: float = end, turns: int = turns) -> jax.Array:
            moved = eqx.tree_at(lambda s: s.drive.speed, scene, n)
            asked = dict(start=start, save="window", stepsize_controller=jv.Tolerance(1e-6), max_steps=16 * turns)
            run = jv.simulate(moved, end, **asked)
            return run.window.state.displacement[-1, 1]

        compiled = jax.jit(jax.grad(value)).lower(scene.drive.speed).compile()
        finite = bool(jnp.isfinite(compiled(scene.drive.speed)))
        analysis = compiled.memory_analysis()
        size = None if analysis is None else analysis.temp_size_in_bytes
        seconds = best(lambda compiled=compiled: compiled(scene.drive.speed), 2)
        note = ("" if size is None else f"{size / 2**20:.3f} MiB") + ("" if finite else ", did not finish")
        say(group, f"{turns} turns", seconds, None, None, None, note, turns=turns, bytes=size)


def designs(quick: bool = False) -> None:
    count, group = (10_000, "leading-order designs") if quick else (200_000, "leading-order designs")
    scene, rng = published(), np.random.default_rng(0)
    stiffness = jnp.asarray(rng.uniform(0.05, 0.2, (count, 2)))

    def one(k: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.value_and_grad(
            lambda k: rotor_speed_at(jammed_model(eqx.tree_at(lambda s: s.machine.stiffness, scene, k)), jnp.asarray(0.9))
        )(k)

    call = jax.jit(lambda k: jax.lax.map(jax.vmap(one), k.reshape(-1, 1000, 2)))
    compiling = first(lambda: call(stiffness))
    each = best(lambda: call(stiffness)) / count
    print(group)
    note = f"{1.0 / each:.2e} a second on one device"
    say(group, "value and gradient of the jam's rotor speed", each, None, None, compiling, note, per_second=1.0 / each)
