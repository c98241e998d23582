"""Test for slowdowns: times of common functions, as ratios within one run, compared with recorded ratios.

    python benchmarks/guard.py [--record] [--limit 3]

Run times are divided by the time of one native run (numba: 5000 steps of Dormand and Prince's method of order 8, two masses and
one load). Times of first calls are divided by the time to compile a small fixed program. Both units are measured in the same
run; the ratios therefore hardly depend on the computer.

The program fails if a ratio is more than `limit` times the ratio in benchmarks/guard.json, or if a small scene is integrated on
arrays and not by the scalar engine; --record replaces the file. It only detects slowdowns. The other benchmarks compare times
at equal errors.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["JAXVIB_AUTOMATIC"] = "off"  # no program comes from a cache

import jaxvib as jv

jv.prepare_cpu()

import diffrax  # noqa: E402
import equinox as eqx  # noqa: E402
import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_enable_compilation_cache", False)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from machines import published_rotor  # noqa: E402
from parts import native  # noqa: E402
from parts.common import best, first, flat, machine_line, published, thrown  # noqa: E402

RECORD = Path(__file__).with_suffix(".json")

Call = Callable[[], Any]


def platforms(*effects: jv.Effect) -> jv.Scene:
    """Return two platforms with three loads."""
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    loads = jv.pendulums if effects else jv.balls
    return jv.Scene(machine, loads(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed(120.0), effects)


def planar(count: int = 2) -> jv.Scene:
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    return jv.Scene(machine, jv.pendulums(count=count, mass=0.1 / count, radius=0.08, drag=0.14), jv.ConstantSpeed(460.0))


def chain(n: int) -> jv.Scene:
    """Return a chain of n platforms."""
    machine = jv.network(
        mass=[100.0] * n, stiffness=[2e4] * n, damping=[30.0] * n, links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[2e5] * (n - 1), link_damping=[30.0] * (n - 1), exciter=n,
    )  # fmt: skip
    return jv.Scene(machine, jv.balls(count=2, mass=0.3, radius=0.1, drag=0.5), jv.ConstantSpeed(120.0))


def run_of(scene: jv.Scene, until: float, start: Any = "rest") -> Call:
    """Return a call of `simulate` that measures the window, as a user writes it."""
    return lambda: jv.simulate(scene, until, start=start, save="window", estimate=False).foundation_force


SCALAR_RUNS = {
    "single run": lambda: jv.simulate(published(), 10.0, start=thrown(), save="window"),
    "three balls on two platforms": lambda: jv.simulate(platforms(), 0.2, save="window"),
    "dry friction": lambda: jv.simulate(platforms(jv.DryFriction(0.05, diameter="20 mm")), 0.2, save="window"),
    "planar rotor": lambda: jv.simulate(planar(), 0.2, save="window"),
}
"""Runs of small scenes, which the scalar engine must integrate: on arrays they take several times as long."""


def slopes(kind: Callable[..., Any], **options: Any) -> Call:
    """Return a call that differentiates the end of a run with respect to two parameters."""
    scene = published()

    def end(k: jax.Array) -> jax.Array:
        moved = eqx.tree_at(lambda s: s.machine.stiffness, scene, k)
        run = jv.simulate(moved, 100.0, start=thrown(), save="window", max_steps=2**12, **options)
        return run.window.state.displacement[-1, 0]

    call = jax.jit(kind(end))
    k: jax.Array = scene.machine.stiffness
    return lambda: call(k)


def orbits_with_multipliers() -> Call:
    scene = published()
    return lambda: jv.branches(scene, exact=True, points=200, least=0.5, most=0.9).multiplier


def designs() -> Call:
    scene = published()

    def one(k: jax.Array) -> jax.Array:
        return jv.jam_modes(eqx.tree_at(lambda s: s.machine.stiffness, scene, k)).foundation_force

    many = jnp.asarray(np.random.default_rng(0).uniform(0.05, 0.2, (1000, 2)))
    call = jax.jit(jax.vmap(one))
    return lambda: call(many)


def many_runs() -> Call:
    scene = published()
    make = lambda n: eqx.tree_at(lambda s: s.drive.speed, scene, n)  # noqa: E731
    speeds = jnp.linspace(4.0, 5.0, 256)
    return lambda: jv.ensemble(make, speeds, 100.0, estimate=False).load_speed


def small_program() -> Call:
    """Return the unit of compile times: a call that compiles 120 operations without jaxvib."""
    matrix = np.eye(7)

    def chain(x: jax.Array) -> jax.Array:
        for k in range(40):
            x = jnp.sin(matrix @ x) + float(k)
        return x

    return lambda: jax.jit(lambda x: chain(x)).lower(jnp.ones(7)).compile() and ()


RUNS: dict[str, Callable[[], Call]] = {
    "single run, window measured": lambda: run_of(published(), 1000.0, thrown()),
    "three balls on two platforms": lambda: run_of(platforms(), 5.0),
    "dry friction": lambda: run_of(platforms(jv.DryFriction(0.05, diameter="20 mm")), 5.0),
    "planar rotor": lambda: run_of(planar(), 2.0),
    "rotor with loads at stations": lambda: run_of(published_rotor(), 3.0),
    "ensemble of 256": many_runs,
    "gradient, forward": lambda: slopes(jax.jacfwd, adjoint=diffrax.ForwardMode()),
    "gradient, reverse": lambda: slopes(jax.grad),
    "200 orbits with multipliers": orbits_with_multipliers,
    "1000 designs": designs,
    "envelope": lambda: lambda: jv.envelope(published(eps=1e-3), 1000.0).foundation_force,
    "jam_modes": lambda: lambda: jv.jam_modes(platforms()).foundation_force,
    "jam_modes of 20 platforms": lambda: lambda: jv.jam_modes(chain(20)).foundation_force,
    "phase_jams of 8 equal loads": lambda: lambda: jv.phase_jams(planar(8)).omega,
}
"""Calls whose times are divided by that of a native run; the first call of each is not timed."""

FIRST_CALLS = {
    "jam_modes, first call": lambda: jax.jit(lambda s: jv.jam_modes(s).foundation_force).lower(platforms()).compile() and (),
    "jam_orbit, first call": lambda: (
        jax.jit(lambda s: jv.jam_orbit(s, mode=3).foundation_force).lower(platforms()).compile() and ()
    ),
    "simulate, first call": lambda: (
        jax.jit(lambda s: jv.simulate(s, 5.0, save="window", max_steps=4096).foundation_force).lower(platforms()).compile()
        and ()
    ),
}
"""Calls that trace and compile a function; their times are divided by that of the small program."""


def measured() -> dict[str, float]:
    """Return all ratios. The units are measured before and after all calls; the shorter time of each is used."""
    scene = published()
    loop, par, y0 = native.single(), native.numbers(scene), flat(thrown())
    unit_run: Call = lambda: loop(y0, float(scene.drive.speed), par, 1000.0, 5000)  # noqa: E731
    loop(y0, 1.0, par, 1.0, 5)
    compiles = small_program()
    units = [(best(unit_run, 20), best(compiles, 3))]
    seconds: dict[str, float] = {}
    for name, make in RUNS.items():
        call = make()
        once = max(first(call), first(call))
        seconds[name] = best(call, 3 if once > 1.0 else 10)
        print(f"  {name:36s} {1e3 * seconds[name]:10.2f} ms", flush=True)
    for name, call in FIRST_CALLS.items():
        jax.clear_caches()
        seconds[name] = first(call)
        print(f"  {name:36s} {1e3 * seconds[name]:10.0f} ms", flush=True)
    units.append((best(unit_run, 20), best(compiles, 3)))
    run_unit, compile_unit = (min(pair) for pair in zip(*units, strict=True))
    print(f"  a native run {1e3 * run_unit:.3f} ms, the small program {1e3 * compile_unit:.0f} ms")
    return {name: s / (compile_unit if name in FIRST_CALLS else run_unit) for name, s in seconds.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="write the ratios of this run to the file of recorded ratios")
    parser.add_argument("--limit", type=float, default=3.0, help="largest allowed multiple of the recorded ratio")
    options = parser.parse_args()
    print(machine_line())
    found = measured()
    if options.record:
        RECORD.write_text(json.dumps({name: float(f"{ratio:.3g}") for name, ratio in found.items()}, indent=2) + "\n")
    recorded = json.loads(RECORD.read_text())
    fallen = [name for name, run in SCALAR_RUNS.items() if run().engine != "scalar"]
    slow = [name for name, ratio in found.items() if not ratio <= options.limit * recorded[name]]
    print(f"\n{'':38s}{'ratio':>10s}{'recorded':>10s}")
    for name, ratio in found.items():
        print(f"{name:38s}{ratio:10.3g}{recorded[name]:10.3g}{'  TOO SLOW' if name in slow else ''}")
    for name in fallen:
        print(f"{name:38s}  ON ARRAYS, must run on the scalar engine")
    return 1 if slow or fallen else 0


if __name__ == "__main__":
    sys.exit(main())
