"""Search for scenes whose time integration or measurement takes much longer than their number of operations suggests.

    python benchmarks/scan.py [--quick] [--only WORD ...]

The scenes are chosen so that every pair of parts (machine, loads, effects, drive) occurs in one of them. For each scene the
table contains the number of operations of one evaluation of the equations, and the CPU time, microseconds, of a step of a run
and of a sample of the measured window, in total and per thousand operations (second call, compiled). Scenes with more than 3
times the median are listed at the end; the compiler handles an operation in such a scene badly. --only selects the scenes whose
name contains one of the words.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jaxvib as jv

jv.prepare_cpu()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from jax.extend import core  # noqa: E402
from machines import published_rotor  # noqa: E402
from parts.common import busy, machine_line  # noqa: E402

from jaxvib.errors import InputError  # noqa: E402
from jaxvib.motion.analysis.measure import measure  # noqa: E402
from jaxvib.motion.analysis.scaled_error import natural_units  # noqa: E402
from jaxvib.motion.integrate import WINDOW_SAMPLES  # noqa: E402

SPEED = 150.0
OUTLIER = 3.0

MACHINES = {
    "one mass": jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    "two masses": jv.two_mass(
        mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0
    ),
    "three masses": jv.three_mass(
        mass=(30.0, 40.0, 20.0),
        stiffness=(1e4, 4e4, 3e3),
        damping=(10.0, 20.0, 5.0),
        link_stiffness=(1e4, 5e3, 2e4),
        link_damping=(5.0, 1.0, 7.0),
        exciter=3,
    ),
    "planar rotor": jv.planar_rotor(mass=37.0, stiffness=1.1e6, damping=800.0),
    "rotor": jv.rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(0.604e6, 0.555e6),
        damping=(430.0, 410.0),
        position=(0.165, -0.155),
        stations=(0.28, -0.25, -0.28),
    ),
}
LOADS = {
    "balls": jv.balls(count=3, mass=0.05, radius=0.08, drag=0.4, ball_radius=0.015),
    "pendulums": jv.pendulums(count=3, mass=0.05, radius=0.08, drag=0.4, inertia=2e-5),
}
EFFECTS: dict[str, tuple[jv.Effect, ...]] = {
    "no effect": (),
    "gravity": (jv.Gravity(),),
    "imbalance": (jv.Gravity(), jv.StaticImbalance(0.008)),
    "friction": (jv.Gravity(), jv.DryFriction(0.15, diameter=0.02, width=20.0)),
    "run-up friction": (jv.DryFriction(0.15, diameter=0.02, reaction="run_up"),),
    "contact": (jv.LoadContact(stiffness=1e5, damping=20.0),),
    "cubic support": (jv.CubicSupport(3e9),),
    "friction support": (jv.FrictionSupport(40.0),),
    "stop": (jv.Stop(4e5, gap=5e-4, damping=90.0),),
}
DRIVES = {
    "constant speed": jv.ConstantSpeed(SPEED),
    "spin-up": jv.SpinUp(SPEED, duration=0.5),
    "run-up": jv.RunUp(SPEED, acceleration=230.0),
    "DC motor": jv.DCMotor(SPEED, stall_torque=3.0, inertia=0.02),
    "induction motor": jv.InductionMotor(SPEED, breakdown_torque=3.0, breakdown_slip=0.3, inertia=0.02),
}


class Cost(NamedTuple):
    """Cost of a scene: operations of its equations, and CPU time of a step and of a sample, s."""

    operations: int
    step: float
    sample: float


def pairwise() -> list[tuple[str, ...]]:
    """Return few combinations of parts that contain every pair of parts, by a greedy choice."""
    every = [choice for choice in itertools.product(MACHINES, LOADS, EFFECTS, DRIVES) if allowed(*choice)]
    pairs = {choice: set(itertools.combinations(choice, 2)) for choice in every}
    missing, chosen = set[tuple[str, str]]().union(*pairs.values()), []
    while missing:
        choice = max(every, key=lambda c: len(pairs[c] & missing))
        chosen.append(choice)
        missing -= pairs[choice]
    return chosen


def scene(machine: str, load: str, effect: str, drive: str) -> jv.Scene:
    return jv.Scene(MACHINES[machine], LOADS[load], DRIVES[drive], EFFECTS[effect])


def allowed(*choice: str) -> bool:
    """Return True if a scene of these parts is allowed."""
    try:
        scene(*choice)
    except InputError:
        return False
    return True


def operations(jaxpr: core.Jaxpr) -> int:
    """Return the number of values that a program computes, including inner programs."""
    total = 0
    for equation in jaxpr.eqns:
        inner = equation.params.get("jaxpr")
        if inner is None:
            total += sum(v.aval.size for v in equation.outvars)
        else:
            total += operations(getattr(inner, "jaxpr", inner))
    return total


def cost(s: jv.Scene, steps: int) -> Cost:
    state, field = jv.initial_state(s), jv.vector_field(s)
    counted = operations(jax.make_jaxpr(lambda t, y: field(t, y))(0.0, state).jaxpr)
    end = steps * 2e-4

    def run(steps: int) -> Callable[[], jv.Run]:
        equal = jv.EqualSteps(steps)
        return lambda: jv.simulate(s, end, start=state, stepsize_controller=equal, estimate=False, save="window", throw=False)

    window = run(steps)().window
    measured = jax.jit(lambda s, times, states: measure(s, jv.vector_field(s), times, states, natural_units(s)))
    measuring = lambda: measured(s, window.time, window.state)  # noqa: E731
    step = (busy(run(3 * steps)) - busy(run(steps))) / (2 * steps)
    return Cost(counted, step, busy(measuring) / WINDOW_SAMPLES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two scenes, as a test of the program")
    parser.add_argument("--only", nargs="*", default=[], help="words of which the name of a scene contains one")
    options = parser.parse_args()
    print(machine_line())
    print(f"{'':56} {'operations':>10} {'us/step':>8} {'/1000':>8} {'us/sample':>9} {'/1000':>8}")
    scenes: dict[str, Callable[[], jv.Scene]] = {
        "published rotor": lambda: published_rotor(9.2e-4, "uncoupled"),
        **{", ".join(choice): lambda choice=choice: scene(*choice) for choice in pairwise()},
    }
    chosen = [name for name in scenes if not options.only or any(word in name for word in options.only)]
    found: dict[str, Cost] = {}
    for name in chosen[1:3] if options.quick else chosen:
        try:
            found[name] = cost(scenes[name](), 200 if options.quick else 2000)
        except InputError as refused:
            print(f"{name:56} {refused}")
            continue
        each = found[name]
        step, sample = (1e6 * x for x in (each.step, each.sample))
        share = 1e3 / each.operations
        print(
            f"{name:56} {each.operations:10d} {step:8.2f} {step * share:8.2f} {sample:9.3f} {sample * share:8.3f}", flush=True
        )
    for what in ("step", "sample"):
        rates = {name: 1e9 * getattr(each, what) / each.operations for name, each in found.items()}
        median = float(np.median(list(rates.values())))
        worst = {name: rate for name, rate in rates.items() if rate > OUTLIER * median}
        print(f"\nmicroseconds a {what} for a thousand operations: median {median:.3g}, outliers: {'' if worst else 'none'}")
        for name, rate in sorted(worst.items(), key=lambda item: -item[1]):
            print(f"  {name}: {rate:.3g}, {rate / median:.1f} times the median")


if __name__ == "__main__":
    main()
