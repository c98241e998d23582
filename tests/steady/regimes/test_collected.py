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
