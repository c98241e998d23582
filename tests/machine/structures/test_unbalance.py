"""Unbalances from catalogues, their mass, and motors that are switched off."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv
from jaxvib.equations.linear import linear_model
from jaxvib.machine.files import SCREENS
from jaxvib.machine.numbers.named import numbers_of

SPRINGS = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.2, 1.2)]
SCREEN = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)
MOTOR = jv.InductionMotor("1000 rpm", breakdown_torque=150.0, breakdown_slip=0.3, inertia=0.4)
BALLS = jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5)
AT = (0.4, 0.6)


def test_catalogue_force_gives_the_unbalance():
    np.testing.assert_allclose(jv.unbalance(force="20 kN", at="1000 rpm"), 20e3 / (1000 * np.pi / 30) ** 2, rtol=1e-15)


def scene_of(machine, drive=MOTOR, **more):
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=2.0, at=AT, **more)])


def state_of(scene):
    leaves, structure = jax.tree.flatten(jv.initial_state(scene))
    values = np.random.default_rng(0).normal(size=len(leaves) + 10)
    return jax.tree.unflatten(structure, [jnp.asarray(values[k] + np.zeros(np.shape(leaf))) for k, leaf in enumerate(leaves)])


def test_mass_of_an_unbalance_is_a_point_mass_at_the_axis():
    """It equals a body whose mass matrix has m B^T B in addition; the field and the energy are the same."""
    m, (x, y) = 40.0, AT
    rows = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])

    class Heavier(type(SCREEN)):
        def carrier(self):
            found = super().carrier()
            return eqx.tree_at(lambda c: c.mass, found, found.mass + m * rows.T @ rows)

    heavier = Heavier(**{name: getattr(SCREEN, name) for name in ("mass", "inertia", "supports", "kind")})
    own, other = scene_of(SCREEN, unbalance_mass=m), scene_of(heavier)
    state = state_of(own)
    found, wanted = (rates_at(scene, 0.0, state) for scene in (own, other))
    np.testing.assert_allclose(found.velocity, wanted.velocity, rtol=1e-12)
    np.testing.assert_allclose(found.rotor[1], wanted.rotor[1], rtol=1e-12)
    np.testing.assert_allclose(jv.energy(own, state), jv.energy(other, state), rtol=1e-12)
    np.testing.assert_allclose(jv.natural_frequencies(own), jv.natural_frequencies(other), rtol=1e-12)


def test_mass_of_an_unbalance_on_a_rotor_is_at_its_station():
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=6e5, damping=400.0, position=(0.165, -0.155)
    )
    masses = [
        linear_model(jv.Scene(machine, exciters=[jv.Exciter(drive=MOTOR, unbalance=0.05, at=0.2, **more)])).mass
        for more in ({}, {"unbalance_mass": 5.0})
    ]
    row = np.kron([1.0, 0.2], np.eye(2))  # y, z, tilts
    np.testing.assert_allclose(masses[1] - masses[0], 5.0 * row.T @ row, atol=1e-12)


def test_motor_that_is_off_slows_down_by_its_bearings():
    """Without other torques the speed decays as exp(-b t/J) after the time at which the motor is switched off."""
    heavy = jv.plane_body(mass=1e9, inertia=1e9, supports=SPRINGS)
    scene = scene_of(heavy, jv.SwitchedOff(MOTOR, at="3 s", bearing=0.1))
    run = jv.simulate(scene, 9.0)
    speed, time = np.asarray(run.trajectory.rotor_speed), np.asarray(run.trajectory.time)
    before, after = np.argmin(np.abs(time - 2.99)), np.argmin(np.abs(time - 7.0))
    assert abs(speed[before] - 1000 * np.pi / 30) < 0.1
    at = np.argmin(np.abs(time - 3.01))
    np.testing.assert_allclose(speed[after] / speed[at], np.exp(-0.1 * (time[after] - time[at]) / 0.4), rtol=1e-4)


@pytest.mark.parametrize("direction", [1, -1])
def test_power_of_a_motor_that_is_off_is_that_of_its_friction(direction):
    scene = scene_of(SCREEN, jv.SwitchedOff(MOTOR, at=3.0, bearing=0.1), direction=direction)
    state = state_of(scene)
    driven = float(state.rotor[1] - state.velocity[2])
    for t, torque in ((2.0, direction * MOTOR.torque(direction * driven)), (4.0, -0.1 * driven)):
        np.testing.assert_allclose(jv.power(scene, t, state)[0], driven * torque, rtol=1e-12)


def test_files_keep_unbalances_and_motors_within_drives():
    off = jv.SwitchedOff(MOTOR, at=3.0, bearing=0.1)
    scene = scene_of(SCREEN, off, unbalance_mass=40.0)
    assert eqx.tree_equal(jv.scene_from_toml(jv.scene_to_toml(scene)), scene)
    assert "drive.motor.breakdown_torque" in numbers_of(scene) and "exciters[0].unbalance_mass" in numbers_of(scene)
    text = jv.scene_to_toml(scene).replace("unbalance = 2.0", 'unbalance = { force = "20 kN", at = "1000 rpm" }')
    np.testing.assert_allclose(jv.scene_from_toml(text).exciters[0].unbalance, 1.82378, rtol=1e-5)


def exciter(**more):
    return jv.Exciter(**{"drive": MOTOR, "unbalance": 2.0, **more})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: exciter(unbalance_mass=5.0),
            r"drive turns a rotor with the inertia 0.4 kg m\^2, .* S\^2/m = 0.8 kg m\^2; the inertia must inc",
        ),
        (
            lambda: exciter(loads=BALLS, unbalance=None, unbalance_mass=5.0),
            "unbalance_mass is 5.0 without an unbalance; give unbalance",
        ),
        (lambda: exciter(unbalance_mass=0.0), "unbalance_mass is 0 kg; it must be greater than 0"),
        (lambda: exciter(direction=0), r"direction is 0; it must be 1 \(anticlockwise\) or -1 \(clockwise\)"),
        (lambda: exciter(unbalance=None), "loads is None; it must be a Loads, for example .*, or give an unbalance"),
        (lambda: exciter(unbalance=-1.0), "unbalance is -1 kg m; it must be greater than 0"),
        (lambda: jv.Scene(SCREEN, exciters=[exciter(body=1)]), "body is 1; the machine has one body, number 0"),
        (lambda: jv.Scene(SCREEN, exciters=[exciter(), exciter(body=-1)]), "body is -1; it must be a whole number, at least 0"),
        (lambda: jv.unbalance(force=0.0, at="1000 rpm"), "force is 0 N; it must be greater than 0"),
        (
            lambda: jv.scene_from_toml(SCREENS["feeder"].replace('force = "10 kN"', 'force = "10 kg"', 1)),
            r"exciters\[0\]\.unbalance\.force is '10 kg'; a kilogram is a mass",
        ),
        (lambda: jv.unbalance(force="10 kN", at=1450), "at is 1450, and a plain number is in rad/s; write '1450 rpm' or"),
        (
            lambda: jv.SwitchedOff(jv.ConstantSpeed(9.0)),
            "drive.motor is .*; it must be a motor that is not switched off already",
        ),
        (lambda: jv.SwitchedOff(MOTOR, bearing=-1.0), "drive.bearing is -1 N m s; it must be at least 0"),
        (
            lambda: jv.simulate(
                eqx.tree_at(lambda s: s.exciters[0].drive.inertia, scene_of(SCREEN, unbalance_mass=40.0), 0.01), 1.0
            ),
            r"drive turns a rotor with the inertia 0.01 kg m\^2, less than",
        ),
    ],
)
def test_wrong_input_ends_in_one_sentence(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()
