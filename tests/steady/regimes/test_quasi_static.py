"""Regime that grows although the quasi-static criterion calls it stable, confirmed by multipliers and by simulation."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv


def lightly_damped():
    """Resonances at 62, 74 and 80 rad/s with a damping ratio of 1.6 %, below the working speed of 100 rad/s."""
    stiffness = 300.0 * 1e4 * np.array([0.64, 0.38]) / 2.0
    damping = tuple(2.0 * 0.016 * np.sqrt(stiffness * 150.0))
    springs = [jv.support(at=(x, 0.0), stiffness=tuple(stiffness), damping=damping) for x in (-0.6, 0.6)]
    motor = jv.DCMotor(100.0, stall_torque=55.0, inertia=0.031)
    exciters = [
        jv.Exciter(drive=motor, unbalance=0.52, at=(-0.5, 0.31)),
        jv.Exciter(drive=motor, unbalance=0.52, at=(0.39, -0.024), direction=-1),
    ]
    return jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=exciters)


@pytest.fixture(scope="module")
def regime():
    return jv.synchronous_regimes(lightly_damped(), near=(98.9, jnp.array([0.0, -2.735])))


def test_quasi_static_criterion_misses_a_growing_regime(regime):
    assert regime.status_name == "found" and float(regime.speed) > 98.0
    assert float(regime.quasi_static) < -6.0 and float(regime.growth) > 6.0 and not bool(regime.stable)


def test_multipliers_confirm_the_growth_of_the_regime(regime):
    orbit = jv.synchronous_orbit(regime.scene, regime)
    assert not bool(orbit.stable)
    np.testing.assert_allclose(orbit.speed, regime.speed, rtol=2e-3)
    rate = np.log(float(orbit.multiplier)) * float(orbit.speed) / (2.0 * np.pi)
    np.testing.assert_allclose(rate, regime.growth, rtol=1e-2)


def test_simulated_phases_leave_the_regime(regime):
    orbit = jv.synchronous_orbit(regime.scene, regime)
    start = orbit.at(jnp.zeros(()))
    first, second = start.exciters
    assert second.rotor is not None
    disturbed = jv.ExciterState(rotor=(second.rotor[0] + 1e-4, second.rotor[1]))
    start = jv.State(start.displacement, start.velocity, exciters=[first, disturbed])
    kept = jv.simulate(regime.scene, 2.0, start=start, samples=257, estimate=False).trajectory
    angles, rates = zip(*(own.rotor for own in kept.state.exciters), strict=True)
    phase = np.asarray(angles[0] + angles[1])
    assert np.ptp(phase[:65]) < 0.05 and np.ptp(phase) > 2.0
    assert np.mean(np.abs(rates)[:, -32:]) < 85.0
