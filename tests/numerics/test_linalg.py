"""Small linear solves against NumPy's."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.linalg import (
    eigenvalues,
    eigenvalues_in_turn,
    hermitian_error,
    hermitian_modes,
    relative_to,
    root_or_zero,
    small_inverse,
    small_solve,
    solve_definite,
    times,
)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 17])
def test_small_solve_is_numpys(n):
    rng = np.random.default_rng(n)
    for _ in range(5):
        a = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        b = rng.normal(size=n) + 1j * rng.normal(size=n)
        for matrix, right in ((a, b), (a.real, b), (a, b.real), (a.real, b.real)):
            found = small_solve(jnp.asarray(matrix), jnp.asarray(right))
            np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11)


@pytest.mark.parametrize("shape", [(1, 17), (3, 3), (17, 17)])
def test_times_is_numpys_product_of_any_size(shape):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=shape), rng.normal(size=(5, shape[1]))
    np.testing.assert_allclose(times(jnp.asarray(a), jnp.asarray(b[0])), a @ b[0], rtol=1e-13)
    np.testing.assert_allclose(jax.vmap(times, (None, 0))(jnp.asarray(a), jnp.asarray(b)), b @ a.T, rtol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_many_small_systems_written_out_are_numpys(n):
    """The first entry is 0 in one of three systems: its rows must be swapped."""
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(3, n, n)), rng.normal(size=(3, n))
    a[0, 0, 0] = 0.0 if n > 1 else a[0, 0, 0]
    x = small_inverse([[jnp.asarray(a[:, i, j]) for j in range(n)] for i in range(n)])(tuple(jnp.asarray(b.T)))
    np.testing.assert_allclose(np.stack(x, axis=1), np.linalg.solve(a, b[..., None])[..., 0], rtol=1e-10)


def test_errors_of_eigenvalues_are_those_of_rayleighs_quotient():
    """4 (1 + 1e-3), and 1 of a shape that is off by 1e-3 towards that of 4: (1 + 4e-6)/(1 + 1e-6) - 1."""
    pencil = jnp.diag(jnp.asarray([2.0, 8.0, 0.0])), 2.0 * jnp.eye(3)
    shapes = jnp.asarray([[1.0, 0.0, 0.0], [1e-3, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = hermitian_error(pencil, jnp.asarray([1.0, 4.004, 0.0]), shapes)
    np.testing.assert_allclose(found, [3e-6, 0.004 / 4.004, np.inf], rtol=1e-5)


def _called(function):
    """The dimensions of what the CPU's library calls are given in a program."""
    first = re.findall(r"@lapack_\w+\(.*: \(tensor<([^>]+)>", jax.jit(function).lower(1.1).as_text())
    return {len(shape.split("x")) - 1 for shape in first}


@pytest.mark.parametrize("n", [4, 8, 9, 20])
def test_batched_solves_make_no_batched_library_call(n):
    """Such calls, as many at once as XLA has threads, wait for each other for ever (jaxlib before 0.11.2)."""
    rng = np.random.default_rng(n)
    a, b = jnp.asarray(rng.normal(size=(3, n, n)) + n * np.eye(n)), jnp.asarray(rng.normal(size=(3, n)))

    def of(solve):
        return lambda s: jnp.sum(jax.vmap(lambda x, y: solve(s * x, y + s))(a, b) ** 2)

    ours, right = of(small_solve), of(jnp.linalg.solve)
    assert _called(right) == {3}
    for derived in (lambda f: f, jax.jacfwd, jax.grad, lambda f: jax.jacfwd(jax.grad(f))):
        np.testing.assert_allclose(derived(ours)(1.1), derived(right)(1.1), rtol=1e-12)
        assert _called(derived(ours)) == (set() if n <= 8 else {2})


@pytest.mark.parametrize("n", [3, 8, 9])
def test_types_may_be_mixed(n):
    a = jnp.asarray(np.random.default_rng(n).normal(size=(n, n)) + 1j * np.eye(n))
    x = small_solve(a, jnp.arange(1.0 * n))
    np.testing.assert_allclose(a @ x, np.arange(n), atol=1e-12)


def test_nested_batches_of_eigenvalues_solve_one_matrix_a_call():
    matrices = jax.random.normal(jax.random.key(0), (3, 4, 5, 5))
    many = jax.jit(jax.vmap(jax.vmap(eigenvalues_in_turn)))
    for found, matrix in zip(many(matrices).reshape(-1, 5), matrices.reshape(-1, 5, 5), strict=True):
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(np.linalg.eigvals(matrix)), rtol=1e-9)
    assert re.search(r"geev[^\n]*tensor<5x5x", text := many.lower(matrices).as_text()), text
    assert not re.search(r"geev[^\n]*tensor<(\d+x)+5x5x", text)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_definite_equations_are_solved(n):
    rng = np.random.default_rng(n)
    root, b = rng.normal(size=(n, n)), rng.normal(size=n)
    a = root.T @ root + 0.1 * np.eye(n)
    np.testing.assert_allclose(solve_definite(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_modes_of_a_symmetric_matrix_are_numpys(n):
    rng = np.random.default_rng(n)
    matrices = [np.zeros((n, n)), np.eye(n), np.diag([1e6, 1.0, 1e-3, 2.0][:n]), np.ones((n, n))]
    for a in [*matrices, *(root + root.T for root in rng.normal(size=(20, n, n)))]:
        values, vectors = map(np.asarray, hermitian_modes(jnp.asarray(a)))
        size = np.max(np.abs(a)) + 1e-300
        np.testing.assert_allclose(values, np.linalg.eigvalsh(a), atol=1e-14 * size)
        np.testing.assert_allclose(a @ vectors, vectors * values, atol=2e-14 * size)  # each column with its value
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_metric_is_divided_out_in_its_own_precision(n, precision):
    rng = np.random.default_rng(n)
    root, other = rng.normal(size=(2, n, n))
    metric, matrix = (jnp.asarray(a, precision) for a in (root @ root.T + np.eye(n), other + other.T))
    square, inverse = relative_to(metric, matrix)
    assert square.dtype == inverse.dtype == precision
    digits = 30.0 * np.finfo(precision).eps
    np.testing.assert_allclose(inverse @ metric @ inverse.T, np.eye(n), atol=digits)
    np.testing.assert_allclose(np.triu(inverse, 1), 0.0, atol=0.0)
    np.testing.assert_allclose(square, inverse @ matrix @ inverse.T, atol=digits * float(jnp.max(jnp.abs(square))))


def test_eigenvalues_have_second_derivatives():
    def largest(x):
        return jnp.max(eigenvalues(jnp.array([[1.0, x], [2.0, 3.0]])).real)

    # The eigenvalues are 2 +- sqrt(1 + 2 x).
    np.testing.assert_allclose(largest(1.5), 4.0, rtol=1e-14)
    np.testing.assert_allclose(jax.grad(largest)(1.5), 0.5, rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(largest)(1.5), -0.125, rtol=1e-13)


@pytest.mark.parametrize("n", [2, 5])
def test_root_of_rounding_is_zero_with_derivative_zero(n):
    eps = np.finfo(float).eps

    def roots(small):
        return root_or_zero(jnp.concatenate([jnp.array([small]), jnp.full(n - 1, 4.0)]))

    assert roots(3.0 * n * 4.0 * eps)[0] == 0.0 and jax.jacfwd(roots)(3.0 * n * 4.0 * eps)[0] == 0.0
    assert np.allclose(roots(5.0 * n * 4.0 * eps)[0], (20.0 * n * eps) ** 0.5, rtol=1e-15)
