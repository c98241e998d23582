"""The operations of a program."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.runtime import compat, operations

X = jnp.asarray(0.5)


def three(x):
    shared = jnp.exp(x)
    return [jnp.sin(shared), jnp.tan(x) * shared, jnp.log(x)]


def turned_round(x):
    """The same as a part of a larger program, whose results stand elsewhere."""
    first, second, third = three(x)
    return [third, jnp.sqrt(x), second, first]


def test_operations_that_no_wanted_result_needs_are_left_out(monkeypatch):
    """All operations where nobody may read programs."""
    few = operations.results_of(three, [True, False, True], X)
    assert operations.operations(few, X) == 3 and few(X) == [three(X)[0], three(X)[2]]
    slope = X * (jnp.cos(jnp.exp(X)) * jnp.exp(X) + 1.0 / X)
    np.testing.assert_allclose(jax.vjp(few, X)[1]([X, X])[0], slope, rtol=1e-15)
    monkeypatch.setattr(operations, "HAS_JAXPRS", False)
    assert operations.results_of(three, [True, False, True], X)(X) == [three(X)[0], three(X)[2]]


def test_a_program_that_was_traced_before_is_not_traced_again(monkeypatch):
    known = jax.make_jaxpr(turned_round)(X), [3, 2, 0]
    few = operations.results_of(None, [True, False, True], X, traced=known)
    assert operations.operations(few, X) == 3 and few(X) == [three(X)[0], three(X)[2]]
    monkeypatch.setattr(operations, "rewritten", lambda program, *_: program)  # JAX that lets nobody write programs
    assert operations.results_of(three, [True, False, True], X, traced=known)(X) == [three(X)[0], three(X)[2]]
    monkeypatch.undo()
    assert compat.HAS_JAXPRS
