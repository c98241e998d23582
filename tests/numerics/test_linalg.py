"""Small linear solves against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.linalg import small_solve


@pytest.mark.parametrize("n", [1, 2, 3, 4, 17])
def test_small_solve_is_numpys(n):
    rng = np.random.default_rng(n)
    for _ in range(5):
        a = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        b = rng.normal(size=n) + 1j * rng.normal(size=n)
        np.testing.assert_allclose(small_solve(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-11)


def _called(jaxpr, found):
    """The library's solvers in a program, with the dimensions of what they are given."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("lu", "triangular_solve", "cholesky"):
            found.append((equation.primitive.name, equation.invars[0].aval.ndim))
        for parameter in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            inner = getattr(parameter, "jaxpr", parameter)
            if hasattr(inner, "eqns"):
                _called(inner, found)
    return found


@pytest.mark.parametrize("n", [4, 16])
def test_solves_of_a_batch_and_their_derivatives_call_no_library_for_the_batch(n):
    """Such calls, as many at once as XLA has threads, wait for each other for ever (jaxlib before 0.11)."""
    rng = np.random.default_rng(n)
    a, b = jnp.asarray(rng.normal(size=(3, n, n)) + n * np.eye(n)), jnp.asarray(rng.normal(size=(3, n)))

    def of(solve):
        return lambda s: jnp.sum(jax.vmap(lambda x, y: solve(s * x, y + s))(a, b) ** 2)

    ours, right = of(small_solve), of(jnp.linalg.solve)
    assert {ndim for _, ndim in _called(jax.make_jaxpr(right)(1.1).jaxpr, [])} == {3}
    for derived in (lambda f: f, jax.jacfwd, jax.grad, lambda f: jax.jacfwd(jax.grad(f))):
        np.testing.assert_allclose(derived(ours)(1.1), derived(right)(1.1), rtol=1e-12)
        assert not _called(jax.make_jaxpr(derived(ours))(1.1).jaxpr, [])
