"""Small linear solves against NumPy's."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.linalg import small_solve


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_small_solve_is_numpys(n):
    rng = np.random.default_rng(n)
    for _ in range(5):
        a = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        b = rng.normal(size=n) + 1j * rng.normal(size=n)
        np.testing.assert_allclose(small_solve(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-11)
