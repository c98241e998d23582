"""Recorded programs: a restructured package traces every question to the same operations."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from programs import golden
from programs.golden import QUESTIONS, digest, program, recorded, scenes, scenes_of_exciters

import jaxvib as jv


def test_programs_are_those_recorded():
    """The programs are traced in a process of their own, since the configuration of the tests changes some by an operation."""
    if recorded()["jax"] != jax.__version__:
        pytest.skip(f"recorded with jax {recorded()['jax']}; record them anew by {golden.__file__} --write")
    done = subprocess.run([sys.executable, golden.__file__], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}{done.stderr}\nif the change is meant, record it by {golden.__file__} --write"


def question(k):
    return lambda scene: k(scene.machine.mass, scene.machine.stiffness)


@pytest.mark.parametrize(
    "changed",
    [
        lambda m, k: 2.0 * m - k,
        lambda m, k: 2.0 * m + k + 0.0,
        lambda m, k: 2.5 * m + k,
        lambda m, k: 2.0 * k + m,
        lambda m, k: 2.0 * m[:1] + k,
        lambda m, k: 2.0 * m + jnp.asarray([0.0, 1.0]) * k,
    ],
    ids=["sign", "operation", "literal", "operand", "shape", "constant"],
)
def test_a_changed_program_has_another_digest(changed):
    scene = scenes()["two masses"]
    right = digest(program(scene, question(lambda m, k: 2.0 * m + k)))
    assert digest(program(scene, question(lambda m, k: 2.0 * m + k))) == right
    assert digest(program(scene, question(changed))) != right


def test_scenes_hold_every_load_drive_and_effect():
    found = [*scenes().values(), *scenes_of_exciters().values()]
    exciters = [exciter for scene in found for exciter in scene.exciters]
    kinds = {scene.machine.kind for scene in found} | {exciter.drive.kind for exciter in exciters}
    kinds |= {exciter.loads.kind for exciter in exciters if exciter.loads is not None}
    assert {exciter.carries for exciter in exciters} == {("loads",), ("unbalance",), ("loads", "unbalance")}
    assert kinds >= {"one_mass", "two_mass", "three_mass", "network", "planar_rotor", "rotor", "plane_body"}
    assert kinds >= {"ball", "roller", "pendulum", "torus_ball"}
    assert kinds >= {"constant_speed", "spin_up", "run_up", "dc_motor", "induction_motor", "name_plate_motor"}
    assert kinds >= {"dc_motor_electrical", "induction_motor_electrical", "converter", "speed_control"}
    effects = {type(effect) for scene in found for effect in scene.all_effects}
    assert effects == {getattr(jv, name) for name in jv.__all__ if is_effect(getattr(jv, name))}


def is_effect(value):
    return isinstance(value, type) and issubclass(value, jv.Effect) and value is not jv.Effect


def test_every_question_is_recorded():
    asked = {name.split(": ")[1] for name in recorded()["programs"]}
    assert asked == set(QUESTIONS)
