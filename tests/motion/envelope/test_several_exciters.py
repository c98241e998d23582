"""Averaged motion of several exciters against the equations of each exciter's own amplitudes and against `simulate`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.averaged import Amplitudes, averaged_model
from jaxvib.equations.linear import linear_model

MASS, INERTIA = 300.0, 75.0


def body(stiffness=3e4, damping=600.0, height=-0.2):
    springs = [jv.support(at=(x, height), stiffness=(stiffness,) * 2, damping=(damping,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def motor(speed=100.0, torque=60.0, inertia=0.05):
    return jv.DCMotor(speed, stall_torque=torque, inertia=inertia)


def scene_of(places, ways, drives, unbalances=0.4, machine=None, effects=()):
    unbalances = np.broadcast_to(unbalances, len(places))
    parts = zip(drives, unbalances, places, ways, strict=True)
    exciters = [jv.Exciter(drive=d, unbalance=float(s), at=at, direction=way) for d, s, at, way in parts]
    return jv.Scene(machine or body(), exciters=exciters, effects=effects)


THREE = scene_of(
    [(-0.5, 0.3), (0.4, 0.1), (0.1, -0.4)], (1, -1, 1), [motor(), motor(99.0), motor(101.0, 40.0)], (0.4, 0.3, 0.5)
)


def rates_of_own_amplitudes(scene, y, v, angle, rate):
    """Derivatives of the amplitudes (N, nd) of each exciter, and of its speed."""
    carrier, exciters = scene.machine.carrier(), scene.exciters
    m, c, k = carrier.mass, carrier.damping, carrier.stiffness
    arms = [jnp.array([[1.0, 0.0, -e.at[1]], [0.0, 1.0, e.at[0]]]) for e in exciters]
    push = jnp.stack([b.T @ jnp.array([1.0, -1j * e.direction]) for b, e in zip(arms, exciters, strict=True)])
    s = jnp.stack([e.unbalance for e in exciters])
    inertia = jnp.stack([e.drive.inertia for e in exciters])
    torque = jnp.stack([e.drive.torque(w) for e, w in zip(exciters, rate, strict=True)])

    def accelerations(change):
        forced = push * (s * (rate**2 - 1j * change))[:, None]
        return jnp.linalg.solve(m, (forced - v @ c.T - y @ k.T).T).T

    def wrong(change):
        felt = push.conj() @ accelerations(change).T
        turned = jnp.exp(1j * (angle[None, :] - angle[:, None]))
        return inertia * change - torque + s / 2.0 * jnp.imag(jnp.sum(turned * felt, axis=1))

    zero = jnp.zeros_like(rate)
    change = jnp.linalg.solve(jax.jacfwd(wrong)(zero), -wrong(zero))
    turn = 1j * rate[:, None]
    return v - turn * y, accelerations(change) - turn * v, change


def test_common_amplitudes_are_sums_over_the_exciters():
    """At different speeds, without synchronization."""
    rng = np.random.default_rng(1)
    y, v = (scale * jnp.asarray(rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))) for scale in (1e-3, 0.1))
    angle, rate = jnp.asarray(rng.uniform(0.0, 6.0, 3)), jnp.asarray([95.0, 60.0, 20.0])
    own_y, own_v, change = rates_of_own_amplitudes(THREE, y, v, angle, rate)
    psi, relative = angle - jnp.mean(angle), (rate - jnp.mean(rate))[:, None]
    turn = jnp.exp(1j * psi)[:, None]
    state = Amplitudes(jnp.sum(turn * y, axis=0), jnp.sum(turn * v, axis=0), rate, psi)
    found = averaged_model(linear_model(THREE))(jnp.zeros(()), state)
    np.testing.assert_allclose(found.rate, change, rtol=1e-11)
    np.testing.assert_allclose(found.displacement, jnp.sum(turn * (own_y + 1j * relative * y), axis=0), rtol=1e-11)
    np.testing.assert_allclose(found.velocity, jnp.sum(turn * (own_v + 1j * relative * v), axis=0), rtol=1e-11)


def test_growth_of_regimes_is_that_of_each_exciters_amplitudes():
    halves = np.pi * np.array([(0, 0, 0), (0, 1, 0), (0, 0, 1), (0, 1, 1)])
    regimes = [jv.synchronous_regimes(THREE, near=(99.5, phases)) for phases in halves]

    @jax.jit
    def matrix(speed, phases):
        carrier, n = THREE.machine.carrier(), 3

        def flow(x):
            parts = x[: 12 * n].reshape(4, n, 3)
            angle, rate = x[12 * n : 13 * n], x[13 * n :]
            y, v, w = rates_of_own_amplitudes(THREE, parts[0] + 1j * parts[1], parts[2] + 1j * parts[3], angle, rate)
            return jnp.concatenate([jnp.stack([y.real, y.imag, v.real, v.imag]).ravel(), rate - speed, w])

        stiffness = carrier.stiffness - speed**2 * carrier.mass + 1j * speed * carrier.damping
        rows = [jnp.array([1.0, -1j * e.direction, e.at[0] * -1j * e.direction - e.at[1]]) for e in THREE.exciters]
        y = jnp.stack(
            [jnp.linalg.solve(stiffness, speed**2 * e.unbalance * r) for e, r in zip(THREE.exciters, rows, strict=True)]
        )
        v = 1j * speed * y
        at = jnp.concatenate([jnp.stack([y.real, y.imag, v.real, v.imag]).ravel(), phases, jnp.full(n, speed)])
        return flow(at), jax.jacfwd(flow)(at)

    assert {bool(regime.stable) for regime in regimes} == {True, False}
    for regime in regimes:
        still, slopes = matrix(regime.speed, regime.phases)
        np.testing.assert_allclose(still[36:], 0.0, atol=1e-8)
        values = np.linalg.eigvals(slopes)
        values = values[np.argsort(np.abs(values))][1:]
        assert np.min(np.abs(values.real - float(regime.growth))) < 1e-6 * np.max(np.abs(values))
        assert (np.max(values.real) > 1e-6) == (not bool(regime.stable))


def test_envelope_ends_in_a_synchronous_regime():
    run = jv.envelope(THREE, 30.0, save="window", stepsize_controller=jv.Tolerance(1e-7))
    assert bool(run.settled)
    phase = run.window.phase[-1]
    regime = jv.synchronous_regimes(THREE, near=(run.omega, phase))
    np.testing.assert_allclose(run.omega, regime.speed, rtol=1e-6)
    np.testing.assert_allclose(np.exp(1j * (phase - phase[0])), np.exp(1j * regime.phases), atol=1e-4)
    np.testing.assert_allclose(run.load_speed, float(run.omega) * np.array([1.0, -1.0, 1.0]), rtol=1e-6)
    np.testing.assert_allclose(run.amplitude, regime.amplitude, rtol=1e-4)
    np.testing.assert_array_equal(run.ripple, np.max(run.window.ripple, axis=0))
    assert np.ptp(run.ripple) > 0.1 * np.max(run.ripple)
    np.testing.assert_allclose(run.ellipse((0.3, 0.1)).semi_major, regime.ellipse((0.3, 0.1)).semi_major, rtol=1e-4)


def test_error_falls_with_the_square_of_the_unbalance():
    """Two exciters approach a regime: half the unbalance, twice the time, a quarter of the error of the phase."""
    errors = []
    for part in (1.0, 0.5):
        drives = [motor(100.0, 60.0 * part), motor(99.8, 60.0 * part)]
        scene = scene_of([(-0.5, 0.3), (0.4, 0.1)], (1, 1), drives, 0.8 * part, body(damping=6e3))
        zero = jnp.zeros(3)
        turning = [jv.ExciterState(rotor=(jnp.asarray(a), jnp.asarray(99.0))) for a in (0.0, 1.0)]
        start = jv.State(zero, zero, exciters=turning)
        found = []
        for tier in (jv.simulate, jv.envelope):
            run = tier(scene, 1.0 / part, start=start, samples=65, stepsize_controller=jv.Tolerance(1e-9))
            kept = run.trajectory
            phases = [own.rotor[0] for own in kept.state.exciters] if tier is jv.simulate else kept.phase.T
            found.append(np.asarray(phases[1] - phases[0]))
        errors.append(np.sqrt(np.mean((found[0] - found[1]) ** 2)))
        assert np.ptp(found[0]) > 0.5
    assert errors[0] < 0.05
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.4)


def test_amplitudes_beat_at_the_difference_of_two_speeds():
    """Nothing is dropped for ideal drives: the vibration is the sum of two harmonics."""
    speeds = (60.0, 50.0)
    scene = scene_of([(-0.5, 0.3), (0.4, 0.1)], (1, -1), list(map(jv.ConstantSpeed, speeds)))
    run = jv.envelope(scene, 20.0, save="window", stepsize_controller=jv.Tolerance(1e-7))
    t, carrier = np.asarray(run.window.time), scene.machine.carrier()
    expected = 0.0
    for w, e in zip(speeds, scene.exciters, strict=True):
        row = np.array([1.0, -1j * e.direction, -float(e.at[1]) - 1j * e.direction * float(e.at[0])])
        y = np.linalg.solve(carrier.stiffness - w**2 * carrier.mass + 1j * w * carrier.damping, w**2 * 0.4 * row)
        expected = expected + (y * np.exp(1j * w * t)[:, None]).real
    found = (np.asarray(run.window.displacement) * np.exp(55j * t)[:, None]).real
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.max(np.abs(expected)))
    assert float(run.ellipse((0.3, 0.1)).remainder) > 0.1


def test_switched_off_rotor_is_driven_by_the_vibration():
    off = jv.SwitchedOff(motor(), at="6 s", bearing=1e-4)
    scene = scene_of([(-0.5, 0.3), (0.4, 0.1)], (1, -1), [motor(), off], 0.8)
    slow, full = (tier(scene, 15.0, save="window") for tier in (jv.envelope, jv.simulate))
    assert abs(float(slow.load_speed[1])) > 95.0
    np.testing.assert_allclose(slow.load_speed, full.load_speed, rtol=1e-3)
    np.testing.assert_allclose(slow.amplitude, full.amplitude, rtol=1e-2)


def test_settled_motion_that_is_unstable_says_so():
    """Equal exciters that start alike stay in phase, although only antiphase is stable so close to the centre."""
    machine = body(3e3, height=0.0)
    run = jv.envelope(scene_of([(-0.3, 0.0), (0.3, 0.0)], (1, 1), [motor(), motor()], 0.05, machine), 10.0)
    assert run.status_name == "unstable" and not bool(run.settled)
    assert run.summary().startswith("not settled: the exciters turn at one speed")


def test_unbalance_too_heavy_for_its_motor_does_not_turn():
    weak = motor(torque=2.8)  # 0.7246 S g = 2.84 N m
    scene = scene_of([(-0.5, 0.3), (0.4, 0.1)], (1, -1), [motor(), weak], effects=jv.Gravity())
    with pytest.raises(jv.ComputationError, match="cannot lift it against gravity") as error:
        jv.envelope(scene, 5.0)
    assert error.value.status == "not_turning"
