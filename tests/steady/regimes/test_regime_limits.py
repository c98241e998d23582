"""Synchronous regimes: a family, no damping, derivatives, a dense scan, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

MOTOR = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)


def body(stiffness=3e3, damping=150.0):
    springs = [jv.support(at=(x, 0.0), stiffness=(stiffness,) * 2, damping=(damping,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=300.0, inertia=75.0, supports=springs)


def scene_of(places, ways, drives=None, machine=None, unbalance=0.4, effects=()):
    drives = drives or [MOTOR] * len(places)
    parts = zip(drives, places, ways, strict=True)
    exciters = [jv.Exciter(drive=d, unbalance=unbalance, at=at, direction=way) for d, at, way in parts]
    return jv.Scene(machine or body(), exciters=exciters, effects=effects)


PAIR = [(-0.6, 0.0), (0.5, 0.1)]


def test_opposite_exciters_at_the_centre_are_one_family():
    found = jv.synchronous_regimes(scene_of([(0.0, 0.0)] * 2, (1, -1)))
    assert found.speed.size == 1 and found.select(0).status_name == "degenerate"
    assert "family" in found.summary()


@pytest.mark.parametrize("second", [0.4, 0.3])
def test_exciters_on_one_axis_have_two_isolated_regimes(second):
    """The torques of two equal motors are equal if (S_1^2 - S_2^2) Im H + 2 S_1 S_2 Re H sin(alpha_2 - alpha_1) = 0."""
    at, motor = (0.1, 0.2), jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
    exciters = [jv.Exciter(drive=motor, unbalance=S, at=at) for S in (0.4, second)]
    found = jv.synchronous_regimes(jv.Scene(body(), exciters=exciters))
    names = [found.select(k).status_name for k in range(found.speed.size)]
    assert names == ["no_vibration" if second == 0.4 else "found", "found"] and found.stable.tolist() == [True, False]
    carrier, push = body().carrier(), np.array([[1, 0, -at[1]], [0, 1, at[0]]]).T @ np.array([1, -1j])
    for w, phase, sign in zip(found.speed, found.phases[:, 1], (-1.0, 1.0), strict=True):
        h = push.conj() @ np.linalg.solve(carrier.stiffness - w**2 * carrier.mass + 1j * w * carrier.damping, push)
        sine = -(0.4**2 - second**2) / (0.8 * second) * h.imag / h.real
        np.testing.assert_allclose(np.exp(1j * phase), sign * np.sqrt(1.0 - sine**2) + 1j * sine, atol=1e-9)


def test_cancelling_forces_leave_the_machine_at_rest():
    scene = scene_of([(0.1, 0.2)] * 3, (1, 1, 1))
    regime = jv.working_regime(scene)
    assert regime.status_name == "no_vibration" and "no vibration" in regime.summary()
    np.testing.assert_allclose(regime.speed, 100.0, rtol=1e-12)
    np.testing.assert_allclose(regime.amplitude, 0.0, atol=1e-12)
    measures = jv.vibration_measures(scene, regime.vibration())
    assert float(measures.exciter_force) == 0.0 and np.isinf(float(measures.transmissibility))
    text = measures.summary()
    assert "the forces of the exciters cancel: there is no transmissibility" in text and "reach the foundation" not in text


def test_no_damping_is_not_called_stable():
    found = jv.synchronous_regimes(scene_of(PAIR, (1, -1), machine=body(damping=0.0)))
    assert found.speed.size == 2 and np.all(np.isfinite(found.growth)) and not np.any(found.stable)
    np.testing.assert_allclose(found.speed, 100.0, rtol=1e-12)


def test_ideal_drives_report_the_torque_they_give():
    found = jv.synchronous_regimes(scene_of(PAIR, (1, 1), [jv.ConstantSpeed(80.0)] * 2))
    regime = found.select(0)
    assert found.speed.size == 1 and float(regime.speed) == 80.0 and regime.phases.tolist() == [0.0, 0.0]
    carrier, velocity = body().carrier(), 80.0 * np.asarray(regime.displacement)
    lost = 0.5 * np.real(velocity.conj() @ np.asarray(carrier.damping) @ velocity)
    np.testing.assert_allclose(np.sum(regime.power), lost, rtol=1e-12)


def test_undamped_resonance_is_named():
    drive = jv.ConstantSpeed(float(np.sqrt(6e3 / 300.0)))
    found = jv.synchronous_regimes(scene_of([(0.0, 0.0)], [1], [drive], body(damping=0.0)))
    assert found.select(0).status_name == "unbounded" and "resonance" in found.summary()


def test_single_precision_finds_the_same_regimes():
    scene = scene_of(PAIR, (1, -1))
    small = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, scene)
    with jax.enable_x64(False):
        found = jv.synchronous_regimes(small)
    expected = jv.synchronous_regimes(scene)
    assert found.speed.dtype == jnp.float32 and found.stable.tolist() == expected.stable.tolist()
    np.testing.assert_allclose(np.exp(1j * np.asarray(found.phases)), np.exp(1j * expected.phases), atol=1e-2)


def test_motor_too_weak_for_its_unbalance_cannot_start():
    weak = jv.DCMotor(100.0, stall_torque=2.8, inertia=0.05)
    found = jv.synchronous_regimes(scene_of(PAIR, (1, -1), [weak, MOTOR], effects=(jv.Gravity(),)))
    assert found.can_start[0].tolist() == [False, True]  # 0.7246 S g = 2.84 N m


def test_derivatives_are_those_of_finite_differences():
    def ask(x):
        first = jv.InductionMotor(100.05, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
        scene = scene_of(PAIR, (1, -1), [first, MOTOR])
        scene = eqx.tree_at(lambda s: (s.machine.mass, s.exciters[1].unbalance), scene, (300.0 * x, 0.4 * x**2))
        regime = jv.synchronous_regimes(scene, near=(99.9, jnp.array([0.0, 3.0])))
        return jnp.stack([regime.speed, regime.phases[1], regime.margin, regime.power[0], regime.foundation_force])

    forward, backward = jax.jit(jax.jacfwd(ask))(1.0), jax.jit(jax.jacrev(ask))(1.0)
    step = 1e-4
    values = jax.vmap(ask)(1.0 + step * jnp.array([-2.0, -1.0, 1.0, 2.0]))
    differences = jnp.array([1.0, -8.0, 8.0, -1.0]) @ values / (12.0 * step)
    np.testing.assert_allclose(forward, differences, rtol=2e-6)
    np.testing.assert_allclose(backward, forward, rtol=1e-9)
    assert np.all(np.isfinite(values)) and np.all(np.abs(forward) > 1e-9)


def brute_force(scene, omegas, angles):
    """Regimes of two motors: the phase difference of torques along every root of their sum, on a dense grid."""
    carrier, exciters = scene.machine.carrier(), scene.exciters
    m, c, k = (np.asarray(x) for x in (carrier.mass, carrier.damping, carrier.stiffness))
    rows = [np.array([[1, 0, -e.at[1]], [0, 1, e.at[0]]]).T @ np.array([1, -1j * e.direction]) for e in exciters]
    d = np.array(rows)
    receptance = np.linalg.inv(k - omegas[:, None, None] ** 2 * m + 1j * omegas[:, None, None] * c)
    h = np.einsum("ia,gab,kb->gik", d.conj(), receptance, d) * 0.4**2 * omegas[:, None, None] ** 4 / 2
    turn = np.exp(1j * angles)[:, None]
    first = np.imag(h[:, 0, 0] + turn * h[:, 0, 1]) + np.asarray(jax.vmap(exciters[0].drive.torque)(jnp.asarray(omegas)))
    second = np.imag(h[:, 1, 1] + h[:, 1, 0] / turn) + np.asarray(jax.vmap(exciters[1].drive.torque)(jnp.asarray(omegas)))
    total, crossings = first + second, []
    # Follow each root of the total over the angle; count sign changes of the first torque along it.
    place, at = np.nonzero(total[:, :-1] * total[:, 1:] < 0)
    share = total[place, at] / (total[place, at] - total[place, at + 1])
    speed = omegas[at] + share * (omegas[at + 1] - omegas[at])
    value = first[place, at] + share * (first[place, at + 1] - first[place, at])
    for row in range(len(angles) - 1):
        here, there = place == row, place == row + 1
        for w, v in zip(speed[here], value[here], strict=True):
            near = np.argmin(np.abs(speed[there] - w))
            if abs(speed[there][near] - w) < 0.05 and v * value[there][near] < 0:
                crossings.append((w, angles[row]))
    return np.array(crossings)


@pytest.mark.parametrize(("stall", "ways"), [(60.0, (1, 1)), (9.0, (1, 1))])
def test_search_of_two_exciters_equals_a_dense_scan(stall, ways):
    drives = [jv.DCMotor(n, stall_torque=stall, inertia=0.05) for n in (100.0, 97.0)]
    scene = scene_of(PAIR, ways, drives, body(1.2e5, 350.0))
    expected = brute_force(scene, np.linspace(1.0, 101.0, 8001), np.linspace(-np.pi, np.pi, 1441))
    found = jv.synchronous_regimes(scene)
    phase = np.asarray(found.phases[:, 1])
    for w, a in expected:
        apart = np.abs(np.exp(1j * phase) - np.exp(1j * a)) + np.abs(np.asarray(found.speed) - w)
        assert np.min(apart) < 0.03
    assert found.speed.size == len(expected) > 0


def test_start_with_a_wrong_number_of_phases_is_refused():
    with pytest.raises(jv.InputError, match="one phase for each of the 2 rotating masses"):
        jv.synchronous_regimes(scene_of(PAIR, (1, 1)), near=(99.0, jnp.zeros(3)))


OVERFLOWS = [lambda s: s.exciters[0].drive.speed, lambda s: s.machine.mass, lambda s: s.exciters[0].unbalance]


@pytest.mark.parametrize("where", OVERFLOWS)
def test_torques_that_overflow_end_in_a_status(where):
    with pytest.raises(jv.ComputationError, match=r"^overflow: torques of the vibration are not finite; check"):
        jv.synchronous_regimes(eqx.tree_at(where, scene_of(PAIR, (1, 1)), jnp.asarray(1e160)))


@pytest.mark.parametrize("stall_torque", [1e150, 1e300])
def test_stability_with_very_strong_motors_is_undecided(stall_torque):
    """The speed is held, but the growth of small disturbances is smaller than rounding errors of the motors' rates."""
    found = jv.synchronous_regimes(scene_of(PAIR, (1, -1), [jv.DCMotor(100.0, stall_torque=stall_torque, inertia=0.05)] * 2))
    assert found.speed.size > 0
    np.testing.assert_allclose(found.speed, 100.0, rtol=1e-9)
    regime = found.select(0)
    assert regime.status_name == "undecided" and np.isnan(regime.growth) and not regime.stable
    assert "stability lost in rounding errors" in regime.summary()


def test_margin_is_infinite_for_equal_drives():
    """Also where the phases are neutral: exciters that turn in opposite directions at the middle of equal springs."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(600.0, 600.0)) for x in (-0.6, 0.6)]
    motor = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
    exciters = [jv.Exciter(drive=motor, unbalance=0.4, at=(0.0, 0.0), direction=way) for way in (1, -1)]
    scene = jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=exciters)
    regime = jv.synchronous_regimes(scene, near=(99.0, jnp.array([0.0, 2.5])))
    assert regime.status_name == "degenerate" and float(regime.margin) == np.inf


def test_weight_can_make_a_caught_regime_unstable():
    """Phases that swing with about half the speed grow by S g / (4 I w), w: frequency of the swing, less their decay."""
    caught = jv.DCMotor(100.0, stall_torque=20.0, inertia=0.5)
    springs = [jv.support(at=(x, -0.2), stiffness=(3e4, 3e4), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    machine = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    pair = scene_of([(-0.3, 0.4), (0.3, 0.4)], (1, -1), [caught] * 2, machine, unbalance=2.0, effects=jv.Gravity(0.0))
    heavy = eqx.tree_at(lambda s: s.effects[0].g, pair, jnp.asarray(9.81))
    regime, growth, swing = jv.synchronous_regimes(pair, near=(13.7, jnp.array([0.0, np.pi]))), [], []
    for scene in (pair, heavy):
        orbit = jv.synchronous_orbit(scene, regime, points=33)
        rates = np.log(np.asarray(orbit.multipliers)) * orbit.speed / (2.0 * np.pi)
        fastest = rates[np.argmax(np.where(np.abs(rates.imag) > 0.4 * orbit.speed, rates.real, -np.inf))]
        growth, swing = [*growth, fastest.real], [*swing, abs(fastest.imag)]
        assert bool(orbit.stable) == (scene is pair)
    np.testing.assert_allclose(growth[0], regime.growth, rtol=0.05)
    np.testing.assert_allclose(growth[1] - growth[0], 2.0 * 9.81 / (4.0 * 0.5 * swing[1]), rtol=0.05)
