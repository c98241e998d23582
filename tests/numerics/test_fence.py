"""Fences change no value and no derivative, and a compiler that looks at whole operations does not see through them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.fence import entries, fence, hidden_one


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_hidden_one_is_1_of_any_number(dtype):
    values = np.array(
        [0.0, -0.0, 1.0, -3.7, np.inf, -np.inf, np.nan, np.finfo(dtype).tiny, np.nextafter(dtype(1), dtype(2))], dtype
    )
    one = jax.jit(hidden_one)(values)
    assert one.dtype == dtype
    np.testing.assert_array_equal(one, np.ones(len(values), dtype))


def test_fences_keep_values_that_are_not_finite():
    values = jnp.asarray([2.5, jnp.inf, -jnp.inf, jnp.nan, 0.0])
    np.testing.assert_array_equal(fence(values, hidden_one(values)), values)
    np.testing.assert_array_equal(jnp.stack(entries(values, hidden_one(values[0]))), values)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("way", [lambda x: fence(x, hidden_one(x[-1])), lambda x: jnp.stack(entries(x, hidden_one(x[-1])))])
def test_fences_have_the_derivatives_of_what_they_keep(way, count):
    def function(x):
        return way((jnp.arange(count) + 1.0) * jnp.sin(x))

    x = jnp.linspace(0.3, 0.9, count)
    exact = np.diag((np.arange(count) + 1.0) * np.cos(np.asarray(x)))
    for derivative in (jax.jacfwd(function), jax.jacrev(function), jax.jit(jax.jacfwd(function))):
        np.testing.assert_allclose(derivative(x), exact, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(jax.vmap(function)(jnp.stack([x, 2.0 * x]))[1], function(2.0 * x), rtol=1e-15)


def test_xla_does_not_see_that_it_divides_by_1():
    compiled = jax.jit(lambda x: fence(x * x + 1.0, hidden_one(x))).lower(1.0).compile()
    assert " divide(" in compiled.as_text()
