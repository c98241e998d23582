"""Synchronous regimes of the averaged theory: closed forms of Blekhman and of roots of polynomials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import jaxvib as jv

MOTOR = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
MASS, INERTIA, S = 300.0, 75.0, 0.4


def body(stiffness, damping, lever=0.6):
    """Body on two equal springs in x and y, without coupling of its three coordinates."""
    springs = [jv.support(at=(x, 0.0), stiffness=(stiffness,) * 2, damping=(damping,) * 2) for x in (-lever, lever)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def scene_of(places, ways, machine, motors=None, unbalance=S):
    motors = motors or [MOTOR] * len(places)
    parts = zip(motors, places, ways, strict=True)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=m, unbalance=unbalance, at=at, direction=way) for m, at, way in parts])


def receptances(machine, omega):
    carrier = machine.carrier()
    matrix = np.asarray(carrier.stiffness - omega**2 * carrier.mass + 1j * omega * carrier.damping)
    return np.diag(np.linalg.inv(matrix))


def apart(regime, k=1):
    """Phase of mass k against the first, from -pi to pi."""
    return float(np.angle(np.exp(1j * (regime.phases[k] - regime.phases[0]))))


@pytest.mark.parametrize("side", [-1e-4, 1e-4])
def test_equal_exciters_exchange_stability_at_the_boundary(side):
    machine = body(3e3, 150.0)
    distance = 0.7
    for _ in range(4):  # the speed depends on the distance a little
        scene = scene_of([(-distance, 0.0), (distance, 0.0)], (1, 1), machine)
        together = jv.synchronous_regimes(scene, near=(100.0, jnp.zeros(2)))
        a = receptances(machine, float(together.speed)).real
        distance = np.sqrt((a[0] + a[1]) / a[2])
    np.testing.assert_allclose(distance, np.sqrt(2.0 * INERTIA / MASS), rtol=0.02)  # soft supports: M l^2 = 2 J
    distance *= 1.0 + side
    found = jv.synchronous_regimes(scene_of([(-distance, 0.0), (distance, 0.0)], (1, 1), machine))
    phases = sorted(abs(apart(r)) for r in map(found.select, range(2)))
    np.testing.assert_allclose(phases, [0.0, np.pi], atol=1e-12)
    stable = found.select(0)
    assert bool(stable.stable) and abs(abs(apart(stable)) - (0.0 if side > 0 else np.pi)) < 1e-9
    assert not bool(found.select(1).stable)


def test_antiphase_of_equal_exciters_only_turns_the_body():
    regime = jv.synchronous_regimes(scene_of([(-0.3, 0.0), (0.3, 0.0)], (1, 1), body(3e3, 150.0))).select(0)
    np.testing.assert_allclose(np.abs(regime.displacement[:2]), 0.0, atol=1e-15)
    response = receptances(body(3e3, 150.0), float(regime.speed))[2]
    np.testing.assert_allclose(regime.amplitude[2], float(regime.speed) ** 2 * 2 * S * 0.3 * abs(response), rtol=1e-12)


def test_opposite_exciters_synchronize_at_the_sum_of_angles():
    angles, length = np.array([2.3, 0.4]), 0.5
    places = [tuple(length * np.array([np.cos(d), np.sin(d)])) for d in angles]
    regime = jv.synchronous_regimes(scene_of(places, (1, -1), body(3e3, 150.0))).select(0)
    assert bool(regime.stable)
    np.testing.assert_allclose(np.exp(1j * apart(regime)), np.exp(-1j * np.sum(angles)), atol=1e-10)
    # The centre moves on a straight line at half the sum of the angles.
    x, y = np.asarray(regime.displacement[:2])
    np.testing.assert_allclose(y * np.cos(np.sum(angles) / 2), x * np.sin(np.sum(angles) / 2), atol=1e-10 * abs(x))


def test_torque_between_opposite_exciters_on_soft_supports():
    motors = [jv.InductionMotor(n, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05) for n in (100.05, 99.95)]
    regime = jv.synchronous_regimes(scene_of([(-0.6, 0.0), (0.5, 0.0)], (1, -1), body(1e-3, 0.0), motors)).select(0)
    w = float(regime.speed) ** 2 * S**2 * 0.6 * 0.5 / (2 * INERTIA)
    torque = w * np.sin(apart(regime) + np.pi)
    np.testing.assert_allclose(regime.vibrational_torque, [torque, -torque], rtol=1e-9)
    assert abs(torque) > 0.1 * w
    # The regime ends where the sine is 1: half the difference of the torques is then w.
    half = abs(float(regime.torque[0] - regime.torque[1])) / 2
    np.testing.assert_allclose(regime.margin * half, w, rtol=1e-3)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_circular_translation_is_exact(count):
    turn = 2 * np.pi * np.arange(count) / count
    places = [(0.0, 0.0)] if count == 1 else [(float(np.cos(a)), float(np.sin(a))) for a in turn + 0.3]
    machine = body(4e5, 900.0)
    found = jv.synchronous_regimes(scene_of(places, [1] * count, machine), near=(99.0, jnp.zeros(count)))
    omega = float(found.speed)
    stiffness, damping, mass = 2 * 4e5, 2 * 900.0, MASS
    square = (stiffness - mass * omega**2) ** 2 + (damping * omega) ** 2
    np.testing.assert_allclose(found.torque, count * damping * S**2 * omega**5 / square, rtol=1e-11)
    np.testing.assert_allclose(np.exp(1j * found.phases), 1.0, atol=1e-12)
    np.testing.assert_allclose(found.displacement[2], 0.0, atol=1e-15)
    np.testing.assert_allclose(np.sum(found.power), 0.5 * damping * omega**2 * np.sum(found.amplitude[:2] ** 2), rtol=1e-11)


def test_three_exciters_on_a_triangle_leave_the_body_at_rest():
    angles = 0.3 + 2 * np.pi * np.arange(3) / 3
    places = [(float(np.cos(a)), float(np.sin(a))) for a in angles]
    found = jv.synchronous_regimes(scene_of(places, (1, 1, 1), body(3e3, 150.0)))
    regime = found.select(0)
    np.testing.assert_allclose(regime.speed, 100.0, rtol=1e-12)
    np.testing.assert_allclose(np.exp(1j * regime.phases), np.exp(-1j * (angles - angles[0])), atol=1e-9)
    assert bool(regime.stable) and float(regime.foundation_force) < 1e-9
    assert found.speed.size == 4  # mirror images and exchanges are listed once


@pytest.mark.parametrize("share", (0.95, 1.05))
def test_three_in_phase_are_least_beyond_the_closed_form(share):
    """Blekhman's function of three exciters on a triangle on soft supports is least in phase if M l^2 > 4 J."""
    distance = np.sqrt(4.0 * share * INERTIA / MASS)
    angles = 2 * np.pi * np.arange(3) / 3
    places = [(float(distance * np.cos(a)), float(distance * np.sin(a))) for a in angles]
    regime = jv.synchronous_regimes(scene_of(places, (1, 1, 1), body(3e3, 15.0)), near=(99.9, jnp.zeros(3)))
    np.testing.assert_allclose(np.exp(1j * regime.phases), 1.0, atol=1e-9)
    assert (float(regime.quasi_static) < 0.0) == (share > 1.0)


@pytest.mark.parametrize(("stiffness", "middle"), [(3e3, np.pi), (4e6, 0.0)])
def test_middle_of_three_on_a_line_opposes_above_resonances(stiffness, middle):
    """The outer ones are far from each other, M l^2 > J; below all resonances all turn in phase."""
    found = jv.synchronous_regimes(scene_of([(-2.0, 0.0), (0.0, 0.0), (2.0, 0.0)], (1, 1, 1), body(stiffness, 150.0, 2.0)))
    stable = [r for r in map(found.select, range(found.speed.size)) if bool(r.stable)]
    assert len(stable) == 1
    assert abs(apart(stable[0], 2)) < 0.05 and abs(abs(apart(stable[0], 1)) - middle) < 0.05


def roots_of_balance(torque, machine_numbers, slope, working):
    """Speeds at which torque (1 - w/working) + slope terms equal the braking of a circular translation, from a polynomial."""
    mass, stiffness, damping = machine_numbers
    p = np.polynomial.Polynomial
    w = p([0.0, 1.0])
    square = (stiffness - mass * w**2) ** 2 + (damping * w) ** 2
    balance = torque * (1 - w / working) * square - slope * w**5
    roots = balance.roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    return np.sort(real[(real > 0) & (real < working * 1.001)])[::-1]


@pytest.mark.parametrize(("stall", "regimes"), [(8.0, 3), (60.0, 1)])
def test_regimes_of_one_motor_are_roots_of_a_polynomial(stall, regimes):
    machine, motor = body(1.5e5, 300.0), jv.DCMotor(100.0, stall_torque=stall, inertia=0.05)
    found = jv.synchronous_regimes(scene_of([(0.0, 0.0)], [1], machine, [motor]))
    expected = roots_of_balance(stall, (MASS, 3e5, 600.0), 600.0 * S**2, 100.0)
    assert expected.size == regimes
    np.testing.assert_allclose(np.sort(found.speed)[::-1], expected, rtol=1e-10)
    slopes = [stall / 100.0 + derivative(w) > 0 for w in np.asarray(found.speed)]
    assert (found.quasi_static < 0).tolist() == slopes


@pytest.mark.parametrize(("side", "count"), [(-1e-6, 3), (1e-6, 1)])
def test_two_regimes_end_at_the_fold_of_the_motor(side, count):
    """Torque at which the motor's line touches the resonance curve, 1e-6 less and 1e-6 more."""
    curve = lambda w: 600.0 * S**2 * w**5 / abs(6e4 - MASS * w**2 + 600.0j * w) ** 2 / (1.0 - w / 100.0)  # noqa: E731
    top = minimize_scalar(lambda w: -curve(w), bounds=(13.0, 15.5), method="bounded", options={"xatol": 1e-12}).x
    motor = jv.DCMotor(100.0, stall_torque=(1.0 + side) * curve(top), inertia=0.5)
    assert jv.synchronous_regimes(scene_of([(0.0, 0.0)], [1], body(3e4, 300.0), [motor])).speed.size == count


def derivative(w, mass=MASS, stiffness=3e5, damping=600.0):
    """Slope of the braking torque over the speed."""
    return float(jax.grad(lambda w: damping * S**2 * w**5 / ((stiffness - mass * w**2) ** 2 + (damping * w) ** 2))(w))


def test_jams_of_loads_come_from_the_same_equation():
    machine = body(1.5e5, 300.0)
    loads = jv.balls(count=1, mass=2.0, radius=0.2, drag=3.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(loads, jv.ConstantSpeed(60.0), at=(0.0, 0.0))])
    found = jv.synchronous_regimes(scene)
    expected = roots_of_balance(3.0 * 0.2**2 * 60.0, (MASS + 2.0, 3e5, 600.0), 600.0 * 0.4**2, 60.0)
    np.testing.assert_allclose(np.sort(found.speed)[::-1], expected, rtol=1e-10)
    assert expected.size == 3


def test_two_balancers_push_a_resonance_together():
    machine = jv.plane_body(
        mass=MASS,
        inertia=INERTIA,
        supports=[jv.support(at=(x, 0.0), stiffness=(1e5, 1e5), damping=(40.0, 40.0)) for x in (-1.2, 1.2)],
    )
    loads, drive = jv.balls(count=1, mass=1.0, radius=0.15, drag=1.0), jv.ConstantSpeed(200.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(loads, drive, at=(x, 0.0)) for x in (-0.5, 0.5)])
    translation, turn = np.sqrt(2e5 / 302.0), np.sqrt(2e5 * 1.44 / (INERTIA + 2 * 0.25))
    found = jv.synchronous_regimes(scene)
    for frequency, phase in ((translation, 0.0), (turn, np.pi)):
        below = [
            r for r in map(found.select, range(found.speed.size)) if 0.9 < float(r.speed) / frequency < 1.0 and bool(r.stable)
        ]
        assert [round(abs(apart(r)), 6) for r in below] == [round(phase, 6)]
