"""Sliding of loads that their track holds from both sides."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv

G, R = 9.81, 0.1


def started(coefficient, angle):
    """Acceleration, rad/s^2, of a ball at rest on a track in a body too heavy to move."""
    machine = jv.planar_rotor(mass=1e12, stiffness=1e12, damping=0.0)
    loads = jv.balls(count=1, mass=0.2, radius=R, drag=0.0, ball_radius=0.01)
    scene = jv.Scene(machine, loads, jv.ConstantSpeed(1.0), (jv.Gravity(G), jv.Sliding(coefficient)))
    start = jv.with_spin(scene, jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.full(1, angle),), (jnp.zeros(1),)))
    return float(rates_at(scene, 0.0, start).rate[0][0])


@pytest.mark.parametrize("degrees", [60.0, 120.0, 50.0])
def test_hanging_balls_roll_or_slide_by_their_force(degrees):
    """|N| = m g sin phi holds a ball on the upper half from its other side: up to mu |N| it rolls, then it slides."""
    angle = np.radians(degrees)
    pull, normal = -G * np.cos(angle), G * np.sin(angle)
    limit = (1.0 - 5.0 / 7.0) * abs(pull) / normal
    np.testing.assert_allclose(started(1.5 * limit, angle), pull * 5.0 / 7.0 / R, rtol=1e-9)
    rubbed = pull - np.sign(pull) * 0.5 * limit * normal
    np.testing.assert_allclose(started(0.5 * limit, angle), rubbed / R, rtol=1e-9)
    np.testing.assert_allclose(started(0.5 * limit, -angle), rubbed / R, rtol=1e-9)
