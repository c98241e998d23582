"""Synchronous regimes with the loads of each exciter at one angle."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.steady.regimes.collected import POINTS, collected_regimes, follow_regimes

MACHINE = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
BALLS = jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5)


def test_regimes_of_one_exciter_are_its_jams():
    scene = jv.Scene(MACHINE, BALLS, jv.ConstantSpeed(120.0))
    found, modes = collected_regimes(scene), jv.jam_modes(scene)
    jams = np.asarray(modes.omega)[np.asarray(modes.exists)]
    np.testing.assert_allclose(np.sort(found.speed), np.sort(jams), rtol=1e-9)
    for omega, amplitude in zip(found.speed, found.amplitude, strict=True):
        mode = int(np.nanargmin(np.abs(np.asarray(modes.omega) - omega)))
        np.testing.assert_allclose(amplitude, np.asarray(modes.amplitude)[mode], rtol=1e-9)


def test_followed_regimes_are_those_at_the_changed_speed():
    exciters = [jv.Exciter(BALLS, jv.ConstantSpeed(120.0), at=1), jv.Exciter(BALLS, jv.ConstantSpeed(110.0), at=2)]
    scene = jv.Scene(MACHINE, exciters=exciters)
    found = collected_regimes(scene)
    start = np.asarray(found.speed[:1]), np.asarray(found.phases[:1])
    followed = follow_regimes(scene, *start, jnp.asarray(0.5), jnp.asarray(1.5))
    factor = np.asarray(followed.factor)
    assert factor.shape == (2 * POINTS - 1,) and factor[POINTS - 1] == 1.0 and np.all(np.diff(factor) > 0.0)
    np.testing.assert_allclose(followed.speed[0, POINTS - 1], found.speed[0], rtol=1e-9)
    changed = eqx.tree_at(
        lambda s: [exciter.drive.speed for exciter in s.exciters], scene, [jnp.asarray(180.0), jnp.asarray(165.0)]
    )
    near = jv.synchronous_regimes(changed, near=(float(followed.speed[0, -1]), followed.phases[0, -1]))
    np.testing.assert_allclose(followed.speed[0, -1], near.speed, rtol=1e-9)
    np.testing.assert_allclose(followed.amplitude[0, -1], near.amplitude, rtol=1e-6)
    assert near.status_name == "found"


SPRINGS = [jv.support(at=(x, -0.2), stiffness=(2e5, 3e5), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
BODY = jv.plane_body(mass=300.0, inertia=75.0, supports=SPRINGS)


def on_body(*exciters):
    """Scene with balls in exciters on a body: number of balls, drag, rotor speed in rpm, place, direction of each."""
    return jv.Scene(
        BODY,
        exciters=[
            jv.Exciter(
                jv.balls(count=n, mass=0.8, radius=0.12, drag=drag), jv.ConstantSpeed(f"{rpm} rpm"), at=(x, 0.3), direction=way
            )
            for n, drag, rpm, x, way in exciters
        ],
    )


def test_all_numbers_are_those_of_the_regimes_of_all_loads():
    """The list of all loads has one phase, one equation and two eigenvalues for each load."""
    scene = on_body((2, 1.5, 900, -0.3, 1), (3, 1.2, 880, 0.3, -1))
    found = collected_regimes(scene)
    assert found.speed.size > 10 and found.phases.shape[1] == 5
    for k in range(0, found.speed.size, 3):
        regime = found.select(k)
        near = jv.synchronous_regimes(scene, near=(float(regime.speed), regime.phases))
        for name in (
            "speed",
            "phases",
            "growth",
            "quasi_static",
            "margin",
            "torque",
            "vibrational_torque",
            "power",
            "amplitude",
        ):
            np.testing.assert_allclose(getattr(regime, name), getattr(near, name), rtol=1e-6, atol=1e-8, err_msg=name)
        assert bool(regime.stable) == bool(near.stable) and regime.status_name == near.status_name


def test_three_exciters_with_loads_settle_in_the_stable_regime():
    scene = on_body((2, 1.5, 900, -0.3, 1), (2, 1.5, 900, 0.0, 1), (2, 1.5, 900, 0.3, -1))
    regime = collected_regimes(scene).select(0)
    omega, phases = float(regime.speed), np.asarray(regime.phases)
    assert bool(regime.stable)
    moved = phases + np.repeat([0.0, 0.25, -0.2], 2) + np.tile([0.1, -0.1], 3)
    turning = np.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    rest = jv.initial_state(scene, "rest")
    start = eqx.tree_at(
        lambda s: [s.displacement, s.velocity, *(each.angle[0] for each in s.exciters), *(each.rate[0] for each in s.exciters)],
        rest,
        [
            jnp.real(regime.displacement),
            jnp.real(1j * omega * regime.displacement),
            *jnp.split(jnp.asarray(turning * moved), 3),
            *jnp.split(jnp.asarray(turning * omega), 3),
        ],
    )
    run = jv.simulate(scene, 15.0, start=start, estimate=False)
    late = np.asarray(run.trajectory.time) > 14.0
    angles = np.concatenate([np.asarray(own.angle[0])[late] for own in run.trajectory.state.exciters], axis=1) * turning
    lags = np.angle(np.mean(np.exp(1j * (angles - angles[:, :1])), axis=0))
    np.testing.assert_allclose(lags, phases, atol=0.01)
