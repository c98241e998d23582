"""The operations of a program."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.runtime import operations

X = jnp.asarray(0.5)


def two(x):
    shared = jnp.exp(x)
    found = [jnp.sin(shared), jnp.tan(x) * shared, jnp.log(x)]
    return [found[0], found[2]]


def test_operations_that_no_result_needs_are_left_out(monkeypatch):
    """All operations stay where nobody may read programs."""
    few = operations.pruned(two, X)
    assert operations.operations(two, X) == 5 and operations.operations(few, X) == 3 and few(X) == two(X)
    slope = X * (jnp.cos(jnp.exp(X)) * jnp.exp(X) + 1.0 / X)
    np.testing.assert_allclose(jax.vjp(few, X)[1]([X, X])[0], slope, rtol=1e-15)
    monkeypatch.setattr(operations, "HAS_JAXPRS", False)
    assert operations.pruned(two, X)(X) == two(X)
