"""A phase pattern followed over the load speed."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.steady.jams import phase_search
from jaxvib.steady.jams.phase_search import phase_branch
from jaxvib.steady.jams.phases import phase_jam

MACHINE = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
SCENE = jv.Scene(MACHINE, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))


def test_a_branch_is_made_of_the_jams_that_each_drag_has():
    """Of loads whose drags differ, at unequal phases: speeds and growth are those of the scene with so many times the drag,
    whose jam is solved for by itself."""
    scene = eqx.tree_at(lambda s: s.loads.drag, SCENE, jnp.array([0.04, 0.05]))
    jam = phase_jam(scene, 182.0, jnp.zeros(2))
    speeds = np.sort([178.0, 180.0, float(jam.omega), 190.0])
    at = int(np.searchsorted(speeds, float(jam.omega)))
    branch = phase_branch(scene, jam, jnp.asarray(speeds))
    np.testing.assert_allclose(branch.drag_factor[at], 1.0, rtol=1e-9)
    np.testing.assert_allclose(branch.growth[at], jam.growth, rtol=1e-6)
    assert abs(float(jam.phase[1])) > 0.1 and float(jam.growth) > 1.0
    for k, omega in enumerate(speeds):
        braked = eqx.tree_at(lambda s: s.loads.drag, scene, scene.loads.drag * branch.drag_factor[k])
        alone = phase_jam(braked, omega, branch.phase[k])
        np.testing.assert_allclose(alone.omega, omega, rtol=1e-8)
        np.testing.assert_allclose(branch.growth[k], alone.growth, rtol=1e-5)
        assert bool(branch.stable[k]) == bool(alone.stable)


def test_a_branch_is_followed_from_its_jam_both_ways(monkeypatch):
    asked = []

    def followed(scene, phase, omega, anew):
        asked.append((np.asarray(phase), np.asarray(omega), np.asarray(anew)))
        return omega, omega, omega, omega

    monkeypatch.setattr(phase_search, "_followed", followed)
    jam = phase_jam(SCENE, 165.0, jnp.zeros(2))
    branch = phase_branch(SCENE, jam, jnp.array([150.0, 160.0, 168.0, 172.0]))
    ((phase, omega, anew),) = asked
    np.testing.assert_array_equal(phase, jam.phase)
    at = int(np.sum(np.array([150.0, 160.0, 168.0, 172.0]) < float(jam.omega)))
    assert 0 < at < 4
    np.testing.assert_array_equal(omega, [*[150.0, 160.0, 168.0, 172.0][at:], *[150.0, 160.0, 168.0, 172.0][:at][::-1]])
    np.testing.assert_array_equal(anew, np.arange(4) == 4 - at)  # below the jam from its own phases again
    np.testing.assert_array_equal(branch.growth, branch.omega)
