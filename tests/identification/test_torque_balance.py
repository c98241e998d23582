"""Numbers of a motor from the speed of its rotor, against run-ups and coast-downs by SciPy."""

import functools
import types

import jax
import numpy as np
import pytest
from run_ups_by_scipy import TRUTH, line_torque, motor_run_up, record, scene_of

import jaxvib as jv
from jaxvib.identification import torque
from jaxvib.identification.fit import information_at
from jaxvib.identification.problem import build_problem
from jaxvib.identification.torque import _predicted_drive, _runs, _Trial, _with_torque_balance

T, NOISE = 0.016 * np.arange(1000), 0.05
FEW = 400
"""Number of samples with the first resonance only."""


def scene(drive, numbers=TRUTH):
    machine, unbalance = scene_of(numbers).machine, numbers["exciters[0].unbalance"]
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=unbalance, at=2)])


def line(no_load=120.0, stall_torque=1.6, inertia=0.1):
    return jv.DCMotor(no_load, stall_torque=stall_torque, inertia=inertia)


run_up = functools.cache(motor_run_up)


def times(count):
    return tuple(map(float, T[:count]))


def run_of(torque=line_torque, count=FEW, **options):
    clean, turning = run_up(times(count), tuple(TRUTH.items()), torque)
    rng = np.random.default_rng(3)
    return record(T[:count], clean, NOISE, rng, turning=turning, resolution=1e-4, **options)


def distances(fit, truth):
    return np.array([(fit.estimate(name).value - value) / fit.estimate(name).error for name, value in truth.items()])


def test_predicted_angle_is_that_of_scipy():
    """The angle is sampled too seldom to show its ripple of twice per turn, which the prediction contains."""
    _, turning = run_up(times(FEW), tuple(TRUTH.items()))
    angle, speed, acceleration = turning(T[:FEW])
    channels = [jv.Channel("frame", "acceleration", at=1), jv.Channel("rotor", "angle")]
    run = jv.MeasuredRun.from_arrays(channels, T[:FEW], {"frame": np.sin(T[:FEW]), "rotor": angle})
    problem = build_problem(scene(line()), [run], ["drive.inertia"], {})
    unbalance = TRUTH["exciters[0].unbalance"] * np.array([np.cos(0.4), np.sin(0.4)])
    fitted = types.SimpleNamespace(
        problem=problem, x=np.zeros(problem.unknowns.count), linear=np.append(unbalance, np.zeros(5))
    )
    runs, _ = _runs(fitted)
    every = np.concatenate([fitted.x, fitted.linear, [angle[0], speed[0], 0.0]])
    drive = _predicted_drive(problem, runs[0], problem.rotors[0][0], every)
    np.testing.assert_allclose(jax.vmap(drive.angle_at)(T[:FEW]), angle, atol=2e-4)
    ripple = np.std(acceleration[-100:])
    np.testing.assert_allclose(jax.vmap(drive.acceleration_at)(T[:FEW]), acceleration, atol=0.01 * ripple)


def test_known_unbalance_is_that_of_the_result(monkeypatch):
    """The information from a known unbalance is along its direction, which the torque balance changes."""
    channels = [jv.Channel("frame", "acceleration", at=1), jv.Channel("rotor", "angle")]
    run = jv.MeasuredRun.from_arrays(channels, T[:FEW], {"frame": np.sin(T[:FEW]), "rotor": 3.0 * T[:FEW] ** 2})
    known = {"exciters[0].unbalance": "0.05 kg m +- 2 %"}
    problem = build_problem(scene(line()), [run], ["drive.inertia"], known)
    fitted = information_at(problem, np.array([0.05, 0.0, *np.zeros(5)]))
    turned = np.concatenate([fitted.x, [0.03, 0.04], np.zeros(8)])
    trial = _Trial(turned, 1.0, (np.eye(turned.size), np.zeros((turned.size,) * 2), np.zeros(turned.size)))
    monkeypatch.setattr(torque, "_minimum", lambda *_: (trial, True))
    found, _ = _with_torque_balance(fitted, [0])
    p = fitted.x.size
    np.testing.assert_allclose(found.prior[p : p + 2, p : p + 2], np.outer([0.6, 0.8], [0.6, 0.8]) / 0.001**2)


@pytest.mark.slow
def test_run_up_gives_inertia_and_torque():
    """The errors of the spline of the angle are 64 more unknowns, which are small and do not make the fit `patterned`."""
    first = TRUTH | {"machine.stiffness[0]": 5.2e4}
    names = ["machine.stiffness[0]", "drive.inertia", "drive.stall_torque"]
    fit = jv.identify(scene(line(stall_torque=1.9, inertia=0.08), first), run_of(), unknown=names)
    assert fit.status_name == "found"
    truth = {"machine.stiffness[0]": 5e4, "drive.inertia": 0.1, "drive.stall_torque": 1.6}
    assert np.max(np.abs(distances(fit, truth))) < 3.5
    assert fit.estimate("drive.inertia").error < 2e-3 * 0.1


@pytest.mark.slow
def test_known_torque_of_a_motor_gives_the_masses():
    """The torque of the vibration, which makes the speed dip, is known in N m if that of the motor is known."""
    names = ["machine.mass", "machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping"]
    names += ["exciters[0].unbalance", "drive.inertia"]
    fit = jv.identify(scene(line(inertia=0.09)), run_of(count=1000), unknown=names)
    assert fit.status_name == "found" and fit.undetermined == ()
    assert np.max(np.abs(distances(fit, TRUTH | {"drive.inertia": 0.1}))) < 3.5
    assert fit.estimate("machine.mass[0]").error < 0.002 * 120.0


def switched_off(t, speed):
    return line_torque(t, speed) if t < 8.003 else -0.004 * speed


@pytest.mark.slow
def test_coast_down_gives_the_friction_of_bearings():
    drive = jv.SwitchedOff(line(inertia=0.08), at=8.003, bearing=0.01)
    fit = jv.identify(scene(drive), run_of(switched_off, 1000), unknown=["drive.bearing", "drive.motor.inertia"])
    assert fit.status_name == "found"
    assert np.max(np.abs(distances(fit, {"drive.bearing": 0.004, "drive.motor.inertia": 0.1}))) < 3.5


def curved_torque(t, speed):
    return 1.6 * (1.0 - (speed / 120.0) ** 2)


@pytest.mark.slow
def test_wrong_form_of_the_torque_is_named():
    fit = jv.identify(scene(line()), run_of(curved_torque), unknown=["drive.inertia", "drive.stall_torque"])
    assert fit.status_name == "patterned"
    assert any("deviates from the torque balance of its motor by" in note for note in fit.notes)


@pytest.mark.parametrize(("drive", "kept"), [(jv.RunUp(60.0, acceleration=5.0), ("a1", "tacho")), (line(), ("a1",))])
def test_numbers_of_a_drive_need_a_motor_and_its_speed(drive, kept):
    run = run_of()
    channels = [each for each in run.channels if each.name in kept]
    run = jv.MeasuredRun(tuple(channels), run.times, run.values, run.clipped, run.change, run.notes, run.source)
    with pytest.raises(jv.InputError, match="is a parameter of the drive"):
        jv.identify(scene(drive), run, unknown=["drive.speed"])
