"""Three equal motors on a line: two stable regimes, the choice between them by the initial phases, motors that are off."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

PLACES, S = (-0.45, 0.1, 0.3), 0.4
MOTOR = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.2)


def scene_of(drives=(MOTOR,) * 3):
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    pairs = zip(drives, PLACES, strict=True)
    return jv.Scene(body, exciters=[jv.Exciter(drive=drive, unbalance=S, at=(x, 0.0)) for drive, x in pairs])


def wrapped(phases):
    """Phases relative to the first exciter, from -pi to pi."""
    phases = np.asarray(phases)
    return np.angle(np.exp(1j * (phases - phases[0])))


def phases_after(scene, phases, speed, away, until):
    """Phases at the end of a run without vibration at its start, whose rotors start `away` from the phases."""
    angles = np.asarray(phases) + np.asarray(away)
    exciters = [jv.ExciterState(rotor=(jnp.asarray(angle), jnp.asarray(speed))) for angle in angles]
    start = jv.State(jnp.zeros(3), jnp.zeros(3), exciters=exciters)
    run = jv.simulate(scene, until, start=start, save="window", estimate=False)
    return wrapped([own.rotor[0][-1] for own in run.window.state.exciters])


@pytest.fixture(scope="module")
def regimes():
    found = jv.synchronous_regimes(scene_of())
    return [found.select(k) for k in np.flatnonzero(np.asarray(found.stable))]


def test_three_motors_have_two_stable_regimes(regimes):
    """Without damping R_12 sin(a_2 - a_1) = R_23 sin(a_3 - a_2) = R_31 sin(a_1 - a_3), with the receptances R_ik of the axes.

    The differences of the phases are therefore pi minus the angles of a triangle with the sides 1/|R_ik|, in either order.
    """
    force, turn = 2.0 / (6e4 - 300.0 * 1e4), 1.0 / (6e4 * 0.36 - 75.0 * 1e4)
    side = [1.0 / abs(force + turn * PLACES[i] * PLACES[k]) for i, k in ((0, 1), (1, 2), (2, 0))]
    square = np.square(side)
    angles = [np.arccos((np.sum(square) - 2.0 * square[k]) / (2.0 * side[k - 1] * side[k - 2])) for k in range(3)]
    expected = wrapped([0.0, np.pi - angles[0], angles[2] - np.pi])
    assert len(regimes) == 2
    for regime, sign in zip(sorted(regimes, key=lambda r: -wrapped(r.phases)[1]), (1.0, -1.0), strict=True):
        np.testing.assert_allclose(wrapped(regime.phases), sign * expected, atol=0.05)


@pytest.mark.parametrize("number", (0, 1))
def test_initial_phases_choose_the_stable_regime(regimes, number):
    regime, other = regimes[number], regimes[1 - number]
    orbit = jv.synchronous_orbit(regime.scene, regime)
    assert bool(orbit.stable) and np.max(np.abs(wrapped(orbit.phases - other.phases))) > 1.0
    np.testing.assert_allclose(orbit.speed, regime.speed, rtol=1e-5)
    np.testing.assert_allclose(wrapped(orbit.phases), wrapped(regime.phases), atol=5e-3)
    for side in (1.0, -1.0):
        end = phases_after(regime.scene, regime.phases, regime.speed, (0.0, 0.3 * side, -0.3 * side), 15.0)
        np.testing.assert_allclose(end, wrapped(orbit.phases), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("off", [(2,), (1, 2)])
@pytest.mark.parametrize("number", (0, 1))
def test_one_or_two_motors_that_are_off_stay_synchronous(regimes, number, off):
    """The others are switched off during the run; their bearings brake them with 0.1 N m."""

    def scene(at):
        return scene_of([jv.SwitchedOff(MOTOR, at=at, bearing=1e-3) if k in off else MOTOR for k in range(3)])

    regime = jv.synchronous_regimes(scene(0.0), near=(regimes[number].speed, regimes[number].phases))
    orbit = jv.synchronous_orbit(regime.scene, regime)
    assert bool(regime.stable) and bool(orbit.stable)
    np.testing.assert_allclose(np.asarray(orbit.torque)[list(off)], -1e-3 * float(orbit.speed), rtol=1e-3)
    np.testing.assert_allclose(wrapped(orbit.phases), wrapped(regime.phases), atol=0.01)
    end = phases_after(scene(5.0), regimes[number].phases, regimes[number].speed, (0.0, 0.2, -0.2), 25.0)
    np.testing.assert_allclose(end, wrapped(orbit.phases), atol=1e-3)
