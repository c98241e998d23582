"""Sines and cosines against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.ode.sincos import sine_and_cosine


@pytest.mark.parametrize(("dtype", "far", "error"), [(jnp.float64, 1e5, 2.3e-16), (jnp.float32, 1e3, 1.2e-7)])
def test_sines_are_numpys(dtype, far, error):
    rng = np.random.default_rng(0)
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
