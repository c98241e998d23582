"""The Magnus method behind exact stability, against integration by SciPy."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from scenes import scene
from scipy.integrate import solve_ivp

from jaxvib.steady.balance.monodromy import _exponential, balanced_motion, magnus


def matrix(t):
    return np.array([[0.1 * np.sin(t), 1.0, 0.3], [-2.0 - np.cos(t), -0.1 * t, 0.5 * t], [0.2 * t**2, -0.4, np.cos(2.0 * t)]])


def flow(h, start=0.4):
    points = start + h * (0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0]))
    return np.asarray(magnus(*(jnp.asarray(matrix(t)) for t in points), h))


def exact(h, start=0.4):
    field = lambda t, x: (matrix(t) @ x.reshape(3, 3)).ravel()  # noqa: E731
    return solve_ivp(field, (start, start + h), np.eye(3).ravel(), "DOP853", rtol=1e-13, atol=1e-13).y[:, -1].reshape(3, 3)


def test_a_step_is_of_order_six():
    """Its error is of h^7: from steps of 0.4 to 0.2 it falls 128 times."""
    errors = [np.max(np.abs(flow(h) - exact(h))) for h in (0.4, 0.2)]
    assert errors[0] < 2e-5 and 90.0 < errors[0] / errors[1] < 180.0


def test_the_exponential_is_scipys():
    a = 4.0 * np.random.default_rng(0).normal(size=(6, 6))
    np.testing.assert_allclose(_exponential(jnp.asarray(a)), scipy.linalg.expm(a), rtol=1e-9, atol=1e-9 * np.exp(8.0))
    small = 0.5 * a / np.linalg.norm(a, 2)
    np.testing.assert_allclose(_exponential(jnp.asarray(small)), scipy.linalg.expm(small), rtol=1e-13, atol=1e-13)


def test_balanced_loads_turn_with_the_rotor():
    s = scene(speed=7.0)
    state = balanced_motion(s, jnp.array([0.1, 2.0, 4.0]), jnp.asarray(0.5))
    np.testing.assert_allclose(state.angle[0], [0.6, 2.5, 4.5])
    np.testing.assert_array_equal(state.rate[0], [7.0, 7.0, 7.0])
    assert not np.any(state.displacement) and not np.any(state.velocity)
