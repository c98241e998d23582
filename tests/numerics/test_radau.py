"""Radau's transition matrices against closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from jaxvib.numerics.radau import _WEIGHTS, NODES, steps_for, transition


def slopes(t):
    """[P, R] of two coupled equations that change with time, with coefficients of SciPy's kind."""
    return np.array([[-2.0 - np.cos(t), 0.5 * t, -0.1 * t, 0.3], [0.2 * t**2, -1.5, np.sin(t), -0.4]])


def exact(h, start=0.4):
    def field(t, x):
        x = x.reshape(4, 4)
        return np.concatenate([x[2:], slopes(t) @ x]).ravel()

    return solve_ivp(field, (start, start + h), np.eye(4).ravel(), "DOP853", rtol=1e-13, atol=1e-15).y[:, -1].reshape(4, 4)


def step(h, start=0.4):
    return np.asarray(transition(jnp.asarray([slopes(start + c * h) for c in NODES]), h))


def test_weights_integrate_polynomials_up_to_their_degree():
    for power in range(6):
        np.testing.assert_allclose(_WEIGHTS @ NODES**power, NODES ** (power + 1) / (power + 1), rtol=0.0, atol=1e-15)
    for power in range(11):  # of the last row, a quadrature, up to degree 10
        np.testing.assert_allclose(_WEIGHTS[-1] @ NODES**power, 1.0 / (power + 1), rtol=1e-13)


def test_a_step_is_of_order_eleven():
    """Its error is of h^12: from steps of 2.4 to 1.2 it falls 4096 times."""
    errors = [np.max(np.abs(step(h) - exact(h))) for h in (2.4, 1.2)]
    assert errors[1] < 1e-6 and 1500.0 < errors[0] / errors[1] < 20000.0, errors


def test_a_step_of_one_radian_leaves_nothing_but_rounding():
    assert float(steps_for(jnp.asarray(7.5))) == 8
    found = transition(jnp.broadcast_to(jnp.asarray([[-1.0, 0.0]]), (6, 1, 2)), 1.0)
    np.testing.assert_allclose(found, [[np.cos(1.0), np.sin(1.0)], [-np.sin(1.0), np.cos(1.0)]], atol=5e-12)


def test_fast_decay_is_gone_after_some_steps():
    """x'' = - r (x' + x): the slow part decays by about exp(-t), the fast one by exp(-r t)."""
    for rate in (1e3, 1e6, 1e12):
        found = np.asarray(transition(jnp.broadcast_to(jnp.asarray([[-rate, -rate]]), (6, 1, 2)), 0.5))
        slow, fast = (-rate + np.array([1.0, -1.0]) * np.sqrt(rate**2 - 4.0 * rate)) / 2.0
        slow = slow if rate < 1e9 else -1.0
        ends = np.exp(4.0 * slow) * np.array([[fast, -1.0], [fast * slow, -slow]]) / (fast - slow)
        np.testing.assert_allclose(np.linalg.matrix_power(found, 8), ends, rtol=0.0, atol=1e-11)


def test_derivatives_are_those_of_differences():
    base, along = jnp.asarray([slopes(0.4 + c) for c in NODES]), jnp.asarray(np.random.default_rng(0).normal(size=(6, 2, 4)))
    found = jax.jvp(lambda a: transition(a, 1.0), (base,), (along,))[1]
    h = 1e-5
    right = (transition(base + h * along, 1.0) - transition(base - h * along, 1.0)) / (2.0 * h)
    np.testing.assert_allclose(found, right, rtol=1e-7, atol=1e-9)
