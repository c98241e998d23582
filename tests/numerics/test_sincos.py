"""Sines and cosines against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.sincos import sine_and_cosine


@pytest.mark.parametrize(("dtype", "far"), [(jnp.float64, 1e5), (jnp.float32, 1e3)])
def test_sines_are_numpys(dtype, far):
    rng, error = np.random.default_rng(0), 1.1 * np.finfo(dtype).eps
    x = jnp.asarray(np.concatenate([np.linspace(-20.0, 20.0, 10_001), rng.uniform(-far, far, 10_000)]), dtype)
    s, c = sine_and_cosine(x)
    assert s.dtype == dtype
    exact = np.asarray(x, np.longdouble)
    for ours, theirs in ((s, np.sin(exact)), (c, np.cos(exact))):
        assert np.max(np.abs(np.asarray(ours, np.longdouble) - theirs)) <= error


def test_sines_have_exact_derivatives_of_any_order():
    x = jnp.asarray(1.3)
    assert float(jax.grad(lambda x: sine_and_cosine(x)[0])(x)) == float(sine_and_cosine(x)[1])
    np.testing.assert_allclose(jax.grad(jax.grad(lambda x: sine_and_cosine(x)[1]))(x), -np.cos(1.3), rtol=1e-15)


def test_sines_at_whole_quarters_and_beyond_numbers():
    s, c = sine_and_cosine(jnp.asarray([0.0, np.pi / 2, -np.pi, jnp.inf, jnp.nan]))
    np.testing.assert_array_equal([s[0], c[0], s[1], c[2]], [0.0, 1.0, 1.0, -1.0])
    assert np.all(np.isnan([*s[3:], *c[3:]]))


def test_second_derivatives_hold_within_loops():
    """Compare with forward mode; reverse derivatives of loops do not use the rule of a `custom_jvp`."""

    def repeated(x):
        return jax.lax.fori_loop(0, 3, lambda j, x: x + sine_and_cosine(x)[0] * sine_and_cosine(2.0 * x)[1], x)

    for x in (0.4, 2.5, -9.0):
        second = jax.jacfwd(jax.grad(repeated))(x)
        expected = jax.jacfwd(jax.jacfwd(repeated))(x)
        np.testing.assert_allclose(second, expected, rtol=1e-12)
