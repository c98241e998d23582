"""Newton's method with damped steps, on single numbers and on arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.steady.jams.newton import damped_newton


def circle_and_line(x, radius):
    """Residual of the point where a circle meets a line through its centre, with its angle."""
    return jnp.stack([jnp.sum(x**2) - radius**2, x[1] - 2.0 * x[0]]), jnp.arctan2(x[1], x[0])


@pytest.mark.parametrize("on_scalars", [True, False])
def test_a_zero_is_found_with_what_is_wanted_beside(on_scalars):
    x, angle = damped_newton(circle_and_line, jnp.array([0.3, 0.1]), jnp.asarray(0.7), on_scalars=on_scalars)
    np.testing.assert_allclose(x, 0.7 * np.array([1.0, 2.0]) / np.sqrt(5.0), rtol=1e-14)
    np.testing.assert_allclose(angle, np.arctan(2.0), rtol=1e-14)


@pytest.mark.parametrize("on_scalars", [True, False])
def test_many_starts_come_to_what_each_comes_to_alone(on_scalars):
    starts = jax.random.uniform(jax.random.key(0), (40, 2), minval=-1.0)

    def one(start):
        return damped_newton(circle_and_line, start, jnp.asarray(0.7), 12, on_scalars=on_scalars)[0]

    together = jax.vmap(one)(starts)
    np.testing.assert_allclose(together, [one(start) for start in starts], rtol=0.0, atol=1e-12)
    assert {tuple(np.sign(x)) for x in np.asarray(together)} == {(1.0, 1.0), (-1.0, -1.0)}


def test_without_a_zero_the_best_point_is_kept():
    x, _ = damped_newton(lambda x, _: (x**2 + 0.25, None), jnp.array([0.5]), None)
    np.testing.assert_allclose(x, [0.0], atol=1e-4)


def test_no_step_is_the_start_and_what_is_there():
    x, angle = damped_newton(circle_and_line, jnp.array([0.3, 0.3]), jnp.asarray(0.7), 0)
    np.testing.assert_allclose(x, [0.3, 0.3])
    np.testing.assert_allclose(angle, np.pi / 4.0)


def test_large_problems_stay_on_arrays():
    a = jnp.diag(jnp.arange(1.0, 9.0)) / 8.0 + 0.01
    x, _ = damped_newton(lambda x, a: (a @ x - jnp.sin(x) - 0.05, None), jnp.zeros(8), a + jnp.eye(8))
    np.testing.assert_allclose((a + jnp.eye(8)) @ x - jnp.sin(x), jnp.full(8, 0.05), rtol=1e-13)
    loop = next(
        e
        for e in jax.make_jaxpr(lambda s: damped_newton(lambda x, _: (x, None), s, None)[0])(a[0]).jaxpr.eqns
        if e.primitive.name == "while"
    )
    assert any(v.aval.shape for v in loop.outvars)


def test_small_residual_does_not_stop_a_long_step():
    """1e-9 arctan(20 x) from 0.3: full steps leap over the zero ever further, what is left is 1e-9 all the time."""
    x, _ = damped_newton(lambda x, _: (1e-9 * jnp.arctan(20.0 * x), x), jnp.array([0.3]), jnp.zeros(1))
    np.testing.assert_allclose(x, 0.0, atol=1e-9)
