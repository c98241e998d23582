"""Stops press and never pull."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv


@pytest.mark.parametrize(("side", "sign"), [("above", 1.0), ("below", -1.0), ("both", 1.0), ("both", -1.0)])
def test_a_stop_never_pulls(side, sign):
    """Moving away faster than k x / c it lets go: its force is 0, neither a pull nor the spring's."""
    (support,) = jv.Stop(1e4, gap=1e-3, damping=100.0, side=side).terms()

    def force(beyond, rate):
        """Away from the foundation's side, N: what presses is positive."""
        return sign * float(support.force(jnp.full(1, sign * (1e-3 + beyond)), jnp.full(1, sign * rate))[0])

    np.testing.assert_allclose(force(2e-3, 0.3), 1e4 * 2e-3 + 100.0 * 0.3)
    np.testing.assert_allclose(force(2e-3, -0.1), 1e4 * 2e-3 - 100.0 * 0.1)
    assert abs(force(2e-3, -0.2)) < 1e-12 and abs(force(2e-3, -0.3)) < 1e-12 and abs(force(2e-3, -50.0)) < 1e-12
    assert force(-2e-3, 5.0) == 0.0


def test_a_ring_never_pulls():
    (support,) = jv.Stop(1e4, gap=1e-3, damping=100.0).terms()
    place, away = jnp.asarray([1.8e-3, 2.4e-3]), jnp.asarray([-3.0, -4.0])
    np.testing.assert_allclose(support.force(place, 0.0 * away), 1e4 * 2e-3 * np.array([0.6, 0.8]))
    np.testing.assert_allclose(support.force(place, away), 0.0, atol=1e-12)


def test_typical_cubic_support_is_one_percent_stiffer():
    """The first harmonic of its force over a swing at the platform that moves most of those on supports."""
    machine = jv.two_mass(mass=(12.0, 9.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0)
    usual = jv.CubicSupport.typical(machine, loads, jnp.asarray(60.0), jnp.array([1e-3, -2e-3])).effect
    assert usual.platform == 2
    cosine = np.cos(2.0 * np.pi * np.arange(64) / 64)
    force = float(usual.stiffness) * (2e-3 * cosine) ** 3
    np.testing.assert_allclose(2.0 * np.mean(force * cosine) / 2e-3, 0.01 * 3e4, rtol=1e-12)
    assert jv.CubicSupport.typical(machine, loads, jnp.asarray(60.0), jnp.zeros(2)) is None
