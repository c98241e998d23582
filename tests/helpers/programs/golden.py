"""Golden programs: a digest of the program that each question traces to, for scenes with every part.

    python tests/helpers/programs/golden.py            # print what differs from the recorded programs
    python tests/helpers/programs/golden.py --write    # record the programs of today, and print what changed
    python tests/helpers/programs/golden.py --show "two masses" energy    # print one program, for a diff between two revisions

A digest covers the order of the operations, their parameters and literals, the operands of each, and the shapes and types of
the results. It is the same in every process and on every CPU for one version of JAX; therefore constants are rounded. Names,
source lines and Python functions are left out.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.equations.averaged import amplitudes_of, averaged_field
from jaxvib.runtime.operations import program_text

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from scenes import BALLS, ROTOR, TWO_MASS, loads, machines, published

jax.config.update("jax_enable_x64", True)  # before the parts below are made

RECORDED = pathlib.Path(__file__).parents[2] / "data" / "golden.json"

_DECIMALS = 9
"""Number of decimals of constants, relative to the largest entry of an array."""

SPEED = jv.ConstantSpeed(120.0)


def scenes() -> dict[str, jv.Scene]:
    """One scene or more with every machine, load, drive and effect."""
    one, two, network = (machines()[name] for name in ("one_mass", "two_mass", "network"))
    rotor, planar = jv.rotor(**ROTOR), jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    stations = jv.rotor(**ROTOR, stations=(0.28, 0.25, -0.25, -0.28))
    equal, sized = jv.balls(**BALLS), jv.balls(**BALLS, ball_radius=0.02)
    pendulums = jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1)
    torus = jv.torus_balls(count=2, mass=0.11, radius=0.2, tube=0.015, ball_radius=0.0145)
    flat = jv.Gravity(along="axis")
    rolling = jv.RollingFriction(3e-5)
    found = {
        "one mass": (one, equal, SPEED),
        "two masses": (two, equal, SPEED),
        "two masses, exciter on the first": (jv.two_mass(**TWO_MASS, exciter=1), equal, SPEED),
        "three masses": (machines()["three_mass"], equal, SPEED),
        "network": (network, equal, SPEED),
        "balls side by side": (two, sized, SPEED),
        "roller": (one, loads()["rollers"], SPEED),
        "unequal pendulums": (two, loads()["pendulums"], SPEED),
        "spin-up": (two, equal, jv.SpinUp(120.0, 5.0)),
        "run-up": (two, equal, jv.RunUp(120.0, 30.0)),
        "DC motor": (two, equal, jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2)),
        "induction motor": (two, equal, jv.InductionMotor(120.0, breakdown_torque=8.0, breakdown_slip=0.2, inertia=0.2)),
        "gravity": (two, equal, SPEED, (jv.Gravity(),)),
        "dry friction": (one, pendulums, SPEED, (jv.DryFriction(0.0015, 0.02),)),
        "printed dry friction": (one, pendulums, SPEED, (jv.DryFriction(0.0015, 0.02, reaction="steady"),)),
        "rolling friction": (one, sized, SPEED, (rolling,)),
        "imbalance": (two, equal, SPEED, (jv.StaticImbalance(0.005),)),
        "imbalance and a motor": (two, equal, jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2), (jv.StaticImbalance(0.005),)),
        "cubic support": (two, equal, SPEED, (jv.CubicSupport(1e9, platform=1),)),
        "stop": (two, equal, SPEED, (jv.Stop(1e6, gap=0.01, damping=50.0, platform=2),)),
        "friction support": (two, equal, SPEED, (jv.FrictionSupport(30.0, platform=2, to=1),)),
        "contact": (one, sized, SPEED, (jv.LoadContact(1e5, damping=3.0),)),
        "planar rotor": (planar, pendulums, SPEED),
        "rotor": (rotor, pendulums, SPEED),
        "rotor with stations": (
            stations,
            pendulums,
            SPEED,
            (jv.Gravity(), jv.StaticImbalance(0.009), jv.MomentImbalance(1e-4)),
        ),
        "torus": (planar, torus, SPEED, (flat, rolling)),
        "torus, balls spin and slide": (planar, torus, SPEED, (flat, jv.FreeSpin(), jv.Sliding(0.2))),
    }
    return {name: jv.Scene(*parts) for name, parts in found.items()} | {"published": published().scene()}


def scenes_of_exciters() -> dict[str, jv.Scene]:
    """Scenes with several exciters, unbalances and both directions."""
    two, loads_of_two = machines()["two_mass"], jv.balls(**BALLS)
    motors = [jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2), jv.InductionMotor(110.0, 8.0, 0.2, inertia=0.2)]
    support = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.2, 1.2)]
    body = jv.plane_body(mass=2000.0, inertia=600.0, supports=support)
    imbalance = jv.StaticImbalance(0.005)
    pendulums = jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1)
    turning = [(motors[0], -0.2, 1), (motors[1], 0.3, -1)]
    circuit = {"stator_resistance": 1.0, "rotor_resistance": 1.0, "stator_leakage": 0.005, "rotor_leakage": 0.005}
    electrical = jv.InductionMotorElectrical(400.0, 314.0, 2, **circuit, magnetizing_inductance=0.15, inertia=0.2)
    table, profile = jv.TorqueTable([0.0, 100.0], [10.0, -2.0], 0.2), jv.SpeedProfile([0.0, 1.0, 2.0], [0.0, 90.0, 80.0])
    control = jv.SpeedControl(profile, gain=0.5, integral_gain=2.0, torque_limit=8.0, inertia=0.2)
    several = [electrical, jv.Converter(table, profile), control, jv.DCMotorElectrical(24.0, 0.6, 0.1, 0.2, 0.002)]
    several.append(jv.NamePlateMotor(1e3, 150.0, 2.5, 0.2))
    found = {
        "body in a plane, electrical and controlled drives": (
            body,
            [jv.Exciter(drive=drive, unbalance=1.5, at=(0.1 * k, 0.4)) for k, drive in enumerate(several)],
        ),
        "two exciters on platforms": (
            two,
            [jv.Exciter(loads_of_two, SPEED, at=1), jv.Exciter(pendulums, motors[0], at=2, effects=(imbalance,))],
        ),
        "exciter with unbalance and loads": (two, [jv.Exciter(loads_of_two, motors[1], unbalance=0.3, at=2)]),
        "body in a plane, motors of opposite directions": (
            body,
            [jv.Exciter(drive=m, unbalance=1.5, at=(x, 0.4), direction=direction) for m, x, direction in turning],
        ),
    }
    return {name: jv.Scene(machine, exciters=exciters) for name, (machine, exciters) in found.items()}


def state_of(scene: jv.Scene) -> jv.State:
    """A state of the scene away from equilibrium."""
    leaves, structure = jax.tree.flatten(jv.initial_state(scene, "rest"))
    rng = np.random.default_rng(0)
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=np.shape(leaf))) for leaf in leaves])


def field(scene: jv.Scene) -> Any:
    return jv.vector_field(scene)(jnp.asarray(0.3), state_of(scene))


def energy(scene: jv.Scene) -> Any:
    return jv.energy(scene, state_of(scene), 0.3)


def power(scene: jv.Scene) -> Any:
    return jv.power(scene, 0.3, state_of(scene))


def force(scene: jv.Scene) -> Any:
    return jv.foundation_force(scene, state_of(scene))


def averaged(scene: jv.Scene) -> Any:
    return averaged_field(scene)(jnp.asarray(0.3), amplitudes_of(scene, state_of(scene)))


def frequencies(scene: jv.Scene) -> Any:
    return jv.natural_frequencies(scene)


def jam_modes(scene: jv.Scene) -> Any:
    return jv.jam_modes(scene)


def jam_orbit(scene: jv.Scene) -> Any:
    return jv.jam_orbit(scene, omega=60.0)


def simulate(scene: jv.Scene) -> Any:
    return jv.simulate(scene, 5.0, start=state_of(scene), save="window", max_steps=4096, estimate=False)


def ensemble(scene: jv.Scene) -> Any:
    def make(speed):
        return eqx.tree_at(lambda s: s.exciters[0].drive.speed, scene, speed), state_of(scene)

    return jv.ensemble(make, jnp.linspace(50.0, 60.0, 4), 2.0, stepsize_controller=jv.EqualSteps(400), estimate=False)


QUESTIONS: dict[str, Callable[[jv.Scene], Any]] = {
    f.__name__: f for f in (field, energy, power, force, averaged, frequencies, jam_modes, jam_orbit, simulate, ensemble)
}

LONG = {
    "jam_modes": (
        "one mass",
        "two masses",
        "network",
        "unequal pendulums",
        "dry friction",
        "planar rotor",
        "rotor",
        "torus",
        "stop",
    ),
    "jam_orbit": ("two masses", "balls side by side", "unequal pendulums", "gravity", "dry friction", "planar rotor", "stop"),
    "simulate": (
        "two masses",
        "run-up",
        "DC motor",
        "rotor with stations",
        "torus, balls spin and slide",
        "contact",
        "two exciters on platforms",
        "body in a plane, motors of opposite directions",
    ),
    "ensemble": ("two masses", "torus", "imbalance and a motor", "exciter with unbalance and loads"),
}
"""Questions that take long to trace, and the scenes that they are traced for."""


def program(scene: jv.Scene, question: Callable[[jv.Scene], Any]) -> list[str]:
    """The operations of a question, one per line; the scene's numbers are its arguments. Of a refusal the argument's name."""
    numbers, rest = eqx.partition(scene, eqx.is_array)

    def asked(values: jv.Scene) -> list[Any]:
        return [leaf for leaf in jax.tree.leaves(question(eqx.combine(values, rest))) if eqx.is_array(leaf)]

    try:
        return program_text(jax.make_jaxpr(asked)(numbers), _DECIMALS)
    except jv.InputError as error:
        return [f"refused: {error.field}"]


def digest(lines: list[str]) -> str:
    """The number of operations and a hash of the lines."""
    return f"{len(lines)} {hashlib.sha256(chr(10).join(lines).encode()).hexdigest()[:16]}"


def programs(only: str = "") -> Iterator[tuple[str, list[str]]]:
    """All recorded programs by the names of scene and question."""
    for scene_name, scene in (scenes() | scenes_of_exciters()).items():
        for question_name, question in QUESTIONS.items():
            name = f"{scene_name}: {question_name}"
            if scene_name in LONG.get(question_name, (scene_name,)) and only in name:
                yield name, program(scene, question)


def recorded() -> dict[str, Any]:
    return json.loads(RECORDED.read_text()) if RECORDED.exists() else {"jax": jax.__version__, "programs": {}}


def changes(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """One line per program that differs: its number of operations and digest before and after."""
    names = dict.fromkeys([*before, *after])
    return [
        f"{name}: {before.get(name, 'absent')} -> {after.get(name, 'absent')}"
        for name in names
        if before.get(name) != after.get(name)
    ]


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--write", action="store_true", help="record the programs of today")
    options.add_argument("--show", nargs=2, metavar=("SCENE", "QUESTION"), help="print one program")
    given = options.parse_args()
    if given.show:
        print("\n".join(program((scenes() | scenes_of_exciters())[given.show[0]], QUESTIONS[given.show[1]])))
        return 0
    gc.set_threshold(100_000, 50, 100)  # as in conftest.py
    after = {name: digest(lines) for name, lines in programs()}
    found = changes(recorded()["programs"], after)
    print("\n".join(found) or "no program changed")
    if given.write:
        RECORDED.write_text(json.dumps({"jax": jax.__version__, "programs": after}, indent=1) + "\n")
        return 0
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
