"""Gain by each technique of the integration engine: time without it, as a multiple of the time with it.

    python benchmarks/ablation.py [--quick] [--only GROUP ...]

Each technique is switched off alone, in the same process. The times are CPU times of a second call; the time of the first call,
which includes compilation, is printed separately. The techniques and their reasons are explained in jaxvib/ode/README.md. The
scenes are the two-mass machine of the antiphase paper with one load (6 numbers in a state) and, for steps that are a loop over
their stages, a two-mass machine with three balls (10 numbers).
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.extend import core
from parts.common import busy, machine_line, published, thrown
from parts.loads import apart
from parts.loads import scene as balls

import jaxvib as jv
from jaxvib.motion.integration import system
from jaxvib.motion.integration.system import PackedSystem
from jaxvib.ode import dopri8, dopri8_loop, replay, scalarize
from jaxvib.ode.dopri8_loop import LoopDopri8

jv.prepare_cpu()
jax.config.update("jax_enable_x64", True)

BATCH_SIZE, STEP = 64, 0.2

NONE = contextlib.nullcontext
OFF: dict[str, Callable[[], Any]] = {
    "unrolled step: always looped": lambda: mock.patch.object(system, "_MAX_UNROLLED_SIZE", 0),
    "scalarize: on arrays": lambda: mock.patch.object(system, "MAX_SCALARS", 0),
    "polynomial sine and cosine: jnp.sin, jnp.cos": lambda: mock.patch.object(
        scalarize, "sine_and_cosine", lambda x: (jnp.sin(x), jnp.cos(x))
    ),
    "fences in the equations: none": lambda: mock.patch.object(
        system, "fenced", lambda program, x: core.jaxpr_as_fun(program)(*x)
    ),
    "fences between stages: none": lambda: mock.patch.object(dopri8, "_fenced", lambda values, *rest, **known: values),
    "entries by their bits: as numbers": lambda: mock.patch.object(system, "entries", lambda y, one: jnp.unstack(y)),
    "reciprocals: divisions": lambda: mock.patch.object(system, "with_reciprocals", lambda program, changing: program),
}


def ended(s: jv.Scene, start: jv.State, steps: int, step: float, batch: bool, solver: Any = None) -> jv.State:
    """Return the state after a number of equal steps."""
    packed = PackedSystem(jv.vector_field(s), start, batch=batch)
    ended = diffrax.diffeqsolve(
        packed.term,
        packed.method() if solver is None else solver,
        0.0,
        steps * step,
        step,
        packed.pack(start),
        packed.args,
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
        max_steps=2**20,
        throw=False,
    )
    return packed.unpack(ended.ys)


def runs(s: jv.Scene, start: jv.State, steps: int, step: float, batch: int) -> Callable[[], Any]:
    """Return a function that computes one run, or a batch of runs at different rotor speeds."""
    if batch == 1:
        call = jax.jit(lambda s: ended(s, start, steps, step, False))
        return lambda: call(s)
    speeds = s.drive.speed * jnp.linspace(0.9, 1.1, batch)
    many = jax.jit(jax.vmap(lambda speed: ended(eqx.tree_at(lambda s: s.drive.speed, s, speed), start, steps, step, True)))
    return lambda: many(speeds)


def row(name: str, call: Callable[[], Any], base: float | None = None) -> float:
    begun = time.process_time()
    jax.block_until_ready(call())
    compiling = time.process_time() - begun
    seconds = busy(call)
    times = "" if base is None else f"{seconds / base:6.2f} times"
    print(f"  {name:52s} {1e3 * seconds:9.3f} ms {times:13s} first call {compiling:.1f} s", flush=True)
    return seconds


def steps(quick: bool) -> None:
    for batch in (1, BATCH_SIZE):
        print(f"\n{batch} run{'s together' * (batch > 1)}, 6 numbers, {50 if quick else 1000} steps")
        make = lambda batch=batch: runs(published(), thrown(), 50 if quick else 1000, STEP, batch)  # noqa: E731
        base = row("as it is", make())
        for name, off in OFF.items():
            with off():
                row(name, make(), base)


def batches(quick: bool) -> None:
    s = balls(3)
    print(f"\n{BATCH_SIZE} runs together, 10 numbers, the step looped over its stages")
    make = lambda: runs(s, apart(s), 20 if quick else 200, 1e-3, BATCH_SIZE)  # noqa: E731
    base = row("as it is", make())
    with mock.patch.object(dopri8_loop, "_advance_batch_last", dopri8_loop._advance):
        row("batch_last: as vmap lays it out", make(), base)


def tangents(quick: bool) -> None:
    s = balls(3)
    print("\nforward derivatives of one run in 8 directions, 10 numbers")

    def end(x: Array, tangents: bool) -> Array:
        moved = eqx.tree_at(lambda s: (s.machine.mass, s.machine.stiffness), s, (x[:2], x[2:4]))
        moved = eqx.tree_at(lambda s: (s.machine.damping, s.loads.drag, s.drive.speed), moved, (x[4:6], x[6], x[7]))
        found = ended(moved, apart(s), 20 if quick else 200, 1e-3, False, LoopDopri8(tangents=tangents))
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(found)])

    m: Any = s
    x = jnp.concatenate([m.machine.mass, m.machine.stiffness, m.machine.damping, jnp.stack([m.loads.drag, m.drive.speed])])
    calls = [jax.jit(jax.jacfwd(lambda x, on=on: end(x, on))) for on in (True, False)]
    base = row("as it is", lambda: calls[0](x))
    row("multi_tangent_jvp: as jacfwd lays it out", lambda: calls[1](x), base)

    print("\nforward derivatives of an adaptive run by 6 numbers, its window measured")
    m = published()
    names = ("stiffness", "damping", "link_stiffness", "link_damping")
    numbers = [getattr(m.machine, name) for name in names]

    def last(x: list[Array], tangents: bool) -> Array:
        moved = eqx.tree_at(lambda s: [getattr(s.machine, name) for name in names], m, x)
        given = dict(solver=LoopDopri8(tangents=tangents, reuse=True), adjoint=diffrax.ForwardMode(), max_steps=2**13)
        found = jv.simulate(moved, 20.0 if quick else 200.0, start=thrown(), save="window", **given)
        return found.window.state.displacement[-1, 1]

    calls = [jax.jit(jax.jacfwd(lambda x, on=on: last(x, on))) for on in (True, False)]
    base = row("as it is", lambda: calls[0](numbers))
    row("multi_tangent_jvp: as jacfwd lays it out", lambda: calls[1](numbers), base)


def samples(quick: bool) -> None:
    s = balls(3)
    count = 512 if quick else 4096
    print(f"\nrates of {count} states, 10 numbers")
    times = jnp.linspace(0.0, 0.1, count)
    states = jax.tree.map(lambda leaf: jax.vmap(lambda t: leaf + t)(times), apart(s))
    field = jv.vector_field(s)

    def call() -> Callable[[], Any]:
        compiled = jax.jit(scalarize.scalarized_vmap(lambda moment, field: field(*moment)))
        return lambda: compiled((times, states), field)

    base = row("as it is", call())
    with mock.patch.object(scalarize, "MAX_SCALARS", 0):
        row("scalarize: on arrays", call(), base)
    with mock.patch.object(scalarize, "fenced", lambda program, x: core.jaxpr_as_fun(program)(*x)):
        row("fence in the program on scalars: none", call(), base)


@contextlib.contextmanager
def checkpointed() -> Iterator[None]:
    """Compute derivatives of adaptive steps by diffrax's own adjoint, which chooses the steps again in the reverse pass."""

    def plain(inputs: Any, controller: Any, solver: LoopDopri8, *rest: Any) -> diffrax.Solution:
        solver = dataclasses.replace(solver, reuse=False)
        return replay._solve(inputs, controller, diffrax.RecursiveCheckpointAdjoint(), solver, *rest)

    with mock.patch.object(replay, "_with_replay", plain):
        yield


def term_by_term() -> Any:
    """Differentiate the sums over the stages of a step as they are written, term by term."""
    written = lambda weights, stages: sum(weights[j] * stages[j] for j in range(len(weights)))  # noqa: E731
    return mock.patch.object(dopri8_loop, "_written_sum", written)


def gradients(quick: bool) -> None:
    end = 20.0 if quick else 600.0
    print(f"\nreverse derivatives of an adaptive run, T = {end:g}; error: to forward derivatives")
    s, start = published(), thrown()

    def final(speed: Array, adjoint: Any = None) -> Array:
        moved = eqx.tree_at(lambda s: s.drive.speed, s, speed)
        found = jv.simulate(
            moved, end, start=start, save="window", stepsize_controller=jv.Tolerance(1e-6), adjoint=adjoint, max_steps=2**14
        )
        return found.window.state.displacement[-1, 0]

    speed: Array = s.drive.speed
    exact = float(jax.jit(jax.jacfwd(lambda x: final(x, diffrax.ForwardMode())))(speed))
    base = None
    ways = {"as it is": NONE, "derivative of sums: term by term": term_by_term, "step replay: steps chosen anew": checkpointed}
    for name, off in ways.items():
        jax.clear_caches()  # programs within, traced with or without it
        with off():
            call = jax.jit(jax.grad(lambda x: final(x)))
            error = abs(float(call(speed)) / exact - 1.0)
            seconds = row(f"{name} (error {error:.0e})", lambda call=call: call(speed), base)
        base = seconds if base is None else base


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    groups = dict(steps=steps, batches=batches, tangents=tangents, samples=samples, gradients=gradients)
    parser.add_argument("--only", nargs="*", choices=list(groups), default=list(groups))
    parser.add_argument("--quick", action="store_true", help="small problems, as a test of the program")
    options = parser.parse_args()
    print(machine_line())
    for name in options.only:
        groups[name](options.quick)


if __name__ == "__main__":
    main()
