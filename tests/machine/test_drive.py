"""Angle, speed and acceleration of drives belong together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxvib as jv

DRIVES = [jv.RunUp(460.0, acceleration=230.0), jv.SpinUp(100.0, duration=4.0), jv.ConstantSpeed(60.0)]


@pytest.mark.parametrize("drive", DRIVES, ids=lambda drive: drive.kind)
@pytest.mark.parametrize("t", [0.5, 1.9, 2.1, 3.9, 4.5, 30.0])
def test_a_drives_angle_is_the_integral_of_its_speed(drive, t):
    """Before and after the working speed is reached."""
    end = [2.0, 4.0]
    turned, _ = quad(lambda x: float(drive.speed_at(jnp.asarray(x))), 0.0, t, points=[x for x in end if x < t] or None)
    np.testing.assert_allclose(drive.angle_at(jnp.asarray(t)), turned, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(drive.angle_at)(t), drive.speed_at(jnp.asarray(t)), rtol=1e-12)
    np.testing.assert_allclose(jax.grad(drive.speed_at)(t), drive.acceleration_at(jnp.asarray(t)), rtol=1e-9, atol=1e-9)
