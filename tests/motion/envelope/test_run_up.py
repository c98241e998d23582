"""Run-up of motors: exciters that resonances catch, the weakest motors that pass, bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxvib as jv

MASS, INERTIA, S, WORKING = 300.0, 75.0, 0.4, 100.0


def body(across=6e4, up=6e4, damping=600.0):
    springs = [jv.support(at=(x, 0.0), stiffness=(across / 2, up / 2), damping=(damping / 2,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def motor(torque):
    return jv.DCMotor(WORKING, stall_torque=torque, inertia=0.5)


def central(torque, make=motor):
    return jv.Scene(body(), exciters=[jv.Exciter(drive=make(torque), unbalance=S)])


def test_weak_motor_is_caught_below_the_resonance():
    """Circular translation: L(w) = c S^2 w^5 / |K - M w^2 + i w c|^2."""
    found = jv.run_up(central(0.6), 90.0)

    def balance(w):
        return 0.6 * (1.0 - w / WORKING) - 600.0 * S**2 * w**5 / ((6e4 - MASS * w**2) ** 2 + (600.0 * w) ** 2)

    assert found.status_name == "caught" and found.caught_at.tolist() == [1]
    np.testing.assert_allclose(found.resonances[0], np.sqrt(6e4 / MASS), rtol=1e-9)
    np.testing.assert_allclose(found.speed, brentq(balance, 5.0, 14.1), rtol=1e-4)
    assert "caught by resonance 1" in found.summary()


def test_least_torque_separates_capture_from_passage():
    found = jv.run_up(central(5.0), 60.0, least=True)
    assert found.status_name == "passed" and found.caught_at.tolist() == [0]
    ends = [jv.simulate(central(5.0 * float(found.least_torque) * x), 60.0, save="window") for x in (0.9, 1.1)]
    assert float(ends[0].omega) < 1.05 * np.sqrt(6e4 / MASS) < 20.0 < float(ends[1].omega)
    assert float(found.peak_amplitude[0]) > 2.0 * S / MASS


def test_exciters_are_caught_at_different_resonances():
    machine = body(2e4, 2e5)
    exciters = [
        jv.Exciter(drive=motor(0.12), unbalance=0.1, at=(0.0, 0.0)),
        jv.Exciter(drive=motor(0.05), unbalance=0.4, at=(0.0, 0.0), direction=-1),
    ]
    scene = jv.Scene(machine, exciters=exciters)
    found = jv.run_up(scene, 120.0)
    full = jv.simulate(scene, 120.0, save="window")
    assert found.caught_at[0] > found.caught_at[1] > 0
    np.testing.assert_allclose(np.abs(full.load_speed), found.speed, rtol=2e-2)


def test_motor_too_weak_for_gravity_has_a_status():
    scene = jv.Scene(body(), exciters=[jv.Exciter(drive=motor(2.8), unbalance=S)], effects=jv.Gravity())
    found = jv.run_up(scene, 5.0)  # 0.7246 S g = 2.84 N m
    assert found.status_name == "not_turning" and "cannot lift" in found.summary()
    assert (
        "needs 2.84 N m, its starting torque is 2.8 N m\nwithout gravity (exciters that are turning already):"
        in found.summary()
    )
    least = dataclasses.replace(found, least_torque=jnp.asarray(0.7246 * S * 9.80665 / 2.8 * 1.005))
    assert "with 1.02 times its torque a motor just lifts its unbalance" in least.summary()
    assert "just lifts" not in dataclasses.replace(least, least_torque=jnp.asarray(2.0)).summary()


def test_peaks_include_runs_from_hanging_unbalances():
    """The full equations with gravity, from unbalances that hang; the averaged run from the angles 0 has half the peak."""
    supports = [jv.support(at=(x, -0.4), stiffness=("130 N/mm", "240 N/mm"), damping=(1500.0, 2000.0)) for x in (-1.6, 1.6)]
    plate = jv.NamePlateMotor("7.5 kW", "960 rpm", breakdown_ratio=2.6, inertia=1.0, frequency="50 Hz")
    ends = (((-0.636, 1.136), 1), ((0.636, -0.136), -1))
    exciters = [jv.Exciter(drive=plate, unbalance=4.4, at=at, direction=way) for at, way in ends]
    scene = jv.Scene(jv.plane_body(mass=1850.0, inertia=2100.0, supports=supports), exciters=exciters, effects=jv.Gravity())
    found = jv.run_up(scene, 2.5)
    full = jv.simulate(scene, 2.5, estimate=False)
    peak = np.max(np.abs(full.trajectory.state.displacement[:, 1]))
    np.testing.assert_allclose(found.peak_amplitude[1], peak, rtol=0.03)
    np.testing.assert_allclose(found.peak_force, full.largest_force, rtol=0.03)
    level = eqx.tree_at(lambda s: [each.rotor for each in s.exciters], jv.initial_state(scene), [(jnp.zeros(()),) * 2] * 2)
    single = jv.envelope(scene, 2.5, start=level, samples=4096)
    assert float(jnp.max(single.trajectory.amplitude[:, 1])) < 0.5 * float(found.peak_amplitude[1])
    assert "largest of several initial angles" in found.summary()


def test_weight_changes_peaks_more_than_speeds_for_weak_motors():
    """The full equations with gravity from several angles; without gravity the peaks are within 4 % of the averaged ones."""
    light = jv.Exciter(drive=jv.DCMotor(WORKING, stall_torque=6.0, inertia=0.1), unbalance=S)
    found = jv.run_up(jv.Scene(body(), exciters=[light], effects=jv.Gravity(g=9.81)), 2.0)
    np.testing.assert_allclose(found.speed_variation, S * 9.81 / (0.1 * 6e4 / MASS), rtol=1e-9)
    assert "changes speeds by about 20 % within a turn" in found.summary()
    rest, changes = jv.initial_state(found.scene), []
    for angle in np.arange(4) * np.pi / 2:
        start = eqx.tree_at(lambda s: s.exciters[0].rotor[0], rest, jnp.asarray(angle))
        full = jv.simulate(found.scene, 2.0, start=start, estimate=False)
        changes += list(full.largest_displacement[:2] / found.peak_amplitude[:2] - 1.0)
    assert 0.3 * found.speed_variation < np.max(np.abs(changes)) < found.speed_variation
    weak = eqx.tree_at(lambda s: s.drive.stall_torque, found.scene, jnp.asarray(3.5))
    change = jv.simulate(weak, 4.0, estimate=False).largest_displacement[0] / jv.run_up(weak, 4.0).peak_amplitude[0] - 1.0
    assert np.abs(change) > 1.1 * found.speed_variation
    calm = jv.run_up(central(6.0), 2.0)
    assert calm.speed_variation == 0.0 and "weight of the unbalances" not in calm.summary()


def constant_torque(torque):
    return jv.TorqueTable([0.0, 90.0, 100.0], [torque, torque, 0.0], 0.5)


def kloss(torque):
    return jv.InductionMotor(WORKING, breakdown_torque=torque, breakdown_slip=0.2, inertia=0.5)


@pytest.mark.parametrize("make", [constant_torque, motor, kloss])
def test_least_motor_is_that_at_the_fold_of_its_torque(make):
    """The fold: the braking torque below the resonance, divided by the torque of a motor of 1 N m, is largest.

    A motor that runs up from rest already passes a little below its fold, because the vibration needs time to build up.
    """
    speeds = np.linspace(10.0, 15.5, 5501)
    braking = 600.0 * S**2 * speeds**5 / ((6e4 - MASS * speeds**2) ** 2 + (600.0 * speeds) ** 2)
    factor = braking / np.asarray(jax.vmap(make(1.0).torque)(jnp.asarray(speeds)))
    fold, caught = np.max(factor), 0.97 * np.max(factor)
    passed = jv.run_up(central(1.03 * fold, make), 200.0, least=True)
    assert passed.status_name == "passed" and 0.97 < 1.03 * float(passed.least_torque) < 1.0
    found = jv.run_up(central(caught, make), 200.0)
    assert found.status_name == "caught" and found.caught_at.tolist() == [1]
    below = np.flatnonzero(factor > caught)[0]
    np.testing.assert_allclose(found.speed, np.interp(caught, factor[: below + 1], speeds[: below + 1]), rtol=1e-4)


def induction_motor(voltage):
    circuit = {"stator_resistance": 2.0, "rotor_resistance": 2.0, "stator_leakage": 0.01, "rotor_leakage": 0.01}
    return jv.InductionMotorElectrical(voltage, "50 Hz", 3, **circuit, magnetizing_inductance=0.2, inertia=0.5)


def direct_current_motor(voltage):
    return jv.DCMotorElectrical(voltage, 2.0, torque_constant=0.5, inertia=0.5, inductance=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("make", [induction_motor, direct_current_motor])
def test_currents_keep_the_fold_of_the_steady_torque(make):
    """The fold over the voltage, where the largest braking torque below the resonance equals T(w)."""
    speeds = np.linspace(13.0, 15.5, 2001)
    braking = 600.0 * S**2 * speeds**5 / ((6e4 - MASS * speeds**2) ** 2 + (600.0 * speeds) ** 2)

    def excess(voltage):
        return float(np.min(np.asarray(make(voltage).torque(jnp.asarray(speeds))) - braking))

    fold = brentq(excess, 5.0, 100.0)
    for share, status in ((0.97, "caught"), (1.03, "passed")):
        scene = jv.Scene(body(), exciters=[jv.Exciter(drive=make(share * fold), unbalance=S)])
        found, full = jv.run_up(scene, 200.0), jv.simulate(scene, 200.0, save="window", estimate=False)
        assert found.status_name == status
        np.testing.assert_allclose(found.speed, full.omega, rtol=1e-4)
    at_fold = speeds[np.argmin(np.asarray(make(fold).torque(jnp.asarray(speeds))) - braking)]
    least = float(make(fold).torque(at_fold) / make(1.03 * fold).torque(at_fold))
    np.testing.assert_allclose(jv.run_up(scene, 200.0, least=True).least_torque, least, rtol=0.02)


@pytest.mark.slow
def test_slow_currents_carry_a_motor_over_the_resonance():
    """Inductance over resistance against the time 2 M/c = 1 s in which the vibration of the body decays."""
    steady = direct_current_motor(0.97 * 10.1985)  # caught by its steady torque, see the fold above

    def scene(lag):
        drive = eqx.tree_at(lambda m: m.inductance, steady, 2.0 * lag)
        return jv.Scene(body(), exciters=[jv.Exciter(drive=drive, unbalance=S)])

    found = jv.ensemble(scene, jnp.asarray([0.01, 0.1, 3.0]), 200.0, estimate=False)
    resonance = np.sqrt(6e4 / MASS)
    assert (found.load_speed[:, 0] > 1.05 * resonance).tolist() == [False, False, True]
    assert jv.run_up(scene(3.0), 200.0).status_name == "caught"


def test_run_up_without_a_motor_is_refused():
    scene = jv.Scene(body(), exciters=[jv.Exciter(drive=jv.ConstantSpeed(jnp.asarray(60.0)), unbalance=S)])
    with pytest.raises(jv.InputError, match="has no motor"):
        jv.run_up(scene, 5.0)


def test_a_motor_that_is_switched_off_is_refused():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    motor = jv.DCMotor(100.0, stall_torque=5.0, inertia=0.05)

    def scene(at):
        return jv.Scene(machine, exciters=[jv.Exciter(drive=jv.SwitchedOff(motor, at=at), unbalance=0.02)])

    with pytest.raises(jv.InputError, match=r"drive switches the motor off at 5 s, before the end of the run-up at 20 s"):
        jv.run_up(scene("5 s"), "20 s")
    assert jv.run_up(scene("30 s"), "20 s").status_name == "passed"
