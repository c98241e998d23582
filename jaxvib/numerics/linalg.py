"""Small linear algebra, unrolled for small matrices, so that time loops contain no library calls."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree
from numpy.typing import NDArray

from jaxvib.errors import ComputationError

T = TypeVar("T")

_MAX_UNROLLED_EQUATIONS = 8
"""Largest number of equations for which `eliminate` is as fast as a library call for each system of a batch."""

MAX_EIGENVALUE_ERROR = 1e-2
"""Largest relative error of a valid eigenvalue. An eigenvalue with a larger error has lost its digits to rounding."""

_compiled = functools.partial(jax.jit, inline=True)
"""Decorator that compiles functions with loops. Without it, JAX would trace and compile them at each call outside a program."""

_Entry: TypeAlias = Array | float
"""Entry of a matrix: a number, or an array of the entries of many matrices."""


def times(matrix: Array, vector: Array) -> Array:
    """Return matrix (m, n) times vector (n,), for small matrices as a sum, because a product in a time loop prevents fusion."""
    if max(matrix.shape) <= _MAX_UNROLLED_EQUATIONS:
        return jnp.sum(matrix * vector[None, :], axis=-1)
    return jnp.matmul(matrix, vector, precision="highest")


def small_inverse(a: Sequence[Sequence[_Entry]]) -> Callable[[tuple[Array, ...]], tuple[Array, ...]]:
    """Return the function that maps b to the solution x of a x = b, unrolled for a few equations; the entries may be arrays of
    many such systems."""
    n = len(a)
    if n == 1:
        return lambda b: (b[0] / a[0][0],)
    if n == 2:
        det = a[0][0] * a[1][1] - a[0][1] * a[1][0]
        return lambda b: ((a[1][1] * b[0] - a[0][1] * b[1]) / det, (a[0][0] * b[1] - a[1][0] * b[0]) / det)
    return lambda b: _eliminate(a, b)


def _eliminate(a: Sequence[Sequence[_Entry]], b: tuple[Array, ...]) -> tuple[Array, ...]:
    """Solve a x = b by Gaussian elimination with the largest entry of each column as pivot."""
    rows = [[*line, right] for line, right in zip(a, b, strict=True)]
    n = len(rows)
    for k in range(n):
        for i in range(k + 1, n):
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = (
                [jnp.where(swap, y, x) for x, y in zip(rows[k], rows[i], strict=True)],
                [jnp.where(swap, x, y) for x, y in zip(rows[k], rows[i], strict=True)],
            )
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [y - factor * x if j > k else y for j, (x, y) in enumerate(zip(rows[k], rows[i], strict=True))]
    x: list[Array] = []
    for i in reversed(range(n)):
        x.insert(0, (rows[i][n] - sum(rows[i][j] * solved for j, solved in enumerate(x, i + 1))) / rows[i][i])
    return tuple(x)


def relative_to(metric: Array, matrix: Array) -> tuple[Array, Array]:
    """Return L^-1 A L^-T (n, n) and L^-1 for the `matrix` A and a positive definite `metric` L L^T.

    The eigenvalues of the first result are those of A x = value L L^T x; the eigenvectors x are L^-T times its eigenvectors.
    """
    n = metric.shape[0]
    if n > 3:
        eye = jnp.eye(n, dtype=metric.dtype)
        inverse = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(metric), eye, lower=True)
    else:
        inverse = _small_factor_inverse(metric)
    return inverse @ matrix @ inverse.T, inverse


def _small_factor_inverse(metric: Array) -> Array:
    """Return L^-1 of a metric L L^T up to 3 x 3 without a library call, see `_small_modes`."""
    n = metric.shape[0]
    zero = jnp.zeros_like(metric[0, 0])
    factor: list[list[Array]] = [[zero] * n for _ in range(n)]
    inverse: list[list[Array]] = [[zero] * n for _ in range(n)]
    for i in range(n):
        for j in range(i):
            factor[i][j] = (metric[i, j] - sum(factor[i][k] * factor[j][k] for k in range(j))) / factor[j][j]
        factor[i][i] = jnp.sqrt(metric[i, i] - sum(factor[i][k] ** 2 for k in range(i)))
        for j in range(i):
            inverse[i][j] = -sum(factor[i][k] * inverse[k][j] for k in range(j, i)) / factor[i][i]
        inverse[i][i] = 1.0 / factor[i][i]
    return jnp.stack([jnp.stack(row) for row in inverse])


def root_or_zero(values: Array) -> Array:
    """Return the square roots of nonnegative eigenvalues (n,); the root of a value within rounding of 0 is 0, with derivative
    0."""
    is_positive = values > 4.0 * values.shape[0] * jnp.finfo(values.dtype).eps * jnp.max(values, initial=0.0)
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, values, 1.0)), 0.0)


def hermitian_error(pencil: tuple[Array, Array], values: Array, shapes: Array) -> Array:
    """Return the relative errors (k,) of eigenvalues of A x = value B x with Hermitian A and B.

    The error is the difference from Rayleigh's quotient x^H A x / x^H B x, whose own error is of second order in the error of
    the shape x. The rounding of the terms of the quotient, which cancel for soft springs next to stiff ones, is included. The
    error of an eigenvalue 0 is infinite.

    **Arguments**: `pencil` A and B (n, n), B positive definite; `values` (k,); `shapes` (n, k).
    """
    sizes, eps = jnp.abs(shapes), jnp.finfo(values.dtype).eps
    top, bottom = (jnp.sum(shapes.conj() * (matrix @ shapes), axis=0).real for matrix in pencil)
    top_terms, bottom_terms = (jnp.sum(sizes * (jnp.abs(matrix) @ sizes), axis=0) for matrix in pencil)
    rounding = shapes.shape[0] * eps * (top_terms + jnp.abs(values) * bottom_terms) / bottom
    length = jnp.abs(values)
    return jnp.where(length > 0.0, (jnp.abs(top / bottom - values) + rounding) / jnp.where(length > 0.0, length, 1.0), jnp.inf)


def poles_of(
    mass: Array | np.ndarray, damping: Array | np.ndarray, stiffness: Array | np.ndarray
) -> NDArray[np.complexfloating]:
    """Return the roots s (2 n,) of det(s^2 M + s C + K) = 0, in NumPy's arithmetic.

    **Raises** `ComputationError` with the status "lost_digits" if M is singular within rounding, or M^-1 K or M^-1 C overflow.
    """
    try:
        flow = -np.linalg.solve(mass, np.concatenate([stiffness, damping], axis=1))
        n = len(flow)
        return np.linalg.eigvals(np.concatenate([np.eye(n, 2 * n, n), flow])).astype(complex)
    except np.linalg.LinAlgError as error:
        problem = "the free vibrations of the machine are lost in rounding errors; check its largest and its smallest numbers"
        raise ComputationError("lost_digits", problem) from error


@jax.custom_jvp
def hermitian_modes(square: Array) -> tuple[Array, Array]:
    """Return the ascending eigenvalues (..., n) and the eigenvectors (..., n, n), as columns, of Hermitian matrices.

    The eigenvectors of equal eigenvalues are not unique. The component of the derivative of an eigenvector along other
    eigenvectors with the same eigenvalue is therefore not defined; it is set to 0.
    """
    if square.shape[-1] > 3 or jnp.iscomplexobj(square):
        values, vectors = jnp.linalg.eigh(square)  # a plain tuple, because a derivative rule cannot return a named pair
        return values, vectors
    return _small_modes(square)


@_compiled
def _small_modes(square: Array) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of real symmetric matrices up to 3 x 3, by unrolled Jacobi rotations.

    Rotations are faster than library calls, which can deadlock for large batches, see `solve_in_turn`. Large batches occur for
    machines of up to three platforms.
    """
    n = square.shape[-1]
    entries = tuple(tuple(square[..., i, j] for j in range(n)) for i in range(n))
    axes = tuple(tuple(jnp.full_like(square[..., 0, 0], float(i == j)) for j in range(n)) for i in range(n))

    def sweep(_: int, state: tuple) -> tuple:
        a, v = ([list(row) for row in part] for part in state)
        for p in range(n - 1):
            for q in range(p + 1, n):
                off = a[p][q]
                ratio = (a[q][q] - a[p][p]) / (2.0 * jnp.where(off == 0.0, 1.0, off))
                tangent = jnp.where(ratio < 0.0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.sqrt(ratio**2 + 1.0))
                tangent = jnp.where(off == 0.0, 0.0, tangent)
                cosine = 1.0 / jnp.sqrt(tangent**2 + 1.0)
                sine = tangent * cosine
                a[p][p], a[q][q] = a[p][p] - tangent * off, a[q][q] + tangent * off
                a[p][q] = a[q][p] = jnp.zeros_like(off)
                for r in range(n):
                    if r not in (p, q):
                        a[r][p], a[r][q] = cosine * a[r][p] - sine * a[r][q], sine * a[r][p] + cosine * a[r][q]
                        a[p][r], a[q][r] = a[r][p], a[r][q]
                    v[r][p], v[r][q] = cosine * v[r][p] - sine * v[r][q], sine * v[r][p] + cosine * v[r][q]
        return tuple(tuple(row) for row in a), tuple(tuple(row) for row in v)

    a, v = jax.lax.fori_loop(0, (0, 0, 1, 6)[n], sweep, (entries, axes))
    numbers = [jnp.stack([a[i][i] for i in range(n)], axis=-1), *(jnp.stack(row, axis=-1) for row in v)]
    values, *rows = jax.lax.sort(numbers, num_keys=1)  # each column belongs to its value
    return values, jnp.stack(rows, axis=-2)


@hermitian_modes.defjvp
def _hermitian_modes_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    values, vectors = hermitian_modes(*primals)
    change = (tangents[0] + tangents[0].conj().mT) / 2.0
    modal_change = vectors.conj().mT @ change @ vectors
    gap = values[..., None, :] - values[..., :, None]
    top = jnp.max(jnp.abs(values), axis=-1)[..., None, None]
    is_distinct = jnp.abs(gap) > values.shape[-1] * jnp.finfo(values.dtype).eps * top
    mixing = jnp.where(is_distinct, modal_change / jnp.where(is_distinct, gap, 1.0), 0.0)
    return (values, vectors), (jnp.diagonal(modal_change, axis1=-2, axis2=-1).real, vectors @ mixing)


def magnitude(value: Array) -> Array:
    """Return the modulus of complex numbers, with derivative 0 instead of NaN if the value is exactly 0."""
    square = value.real**2 + value.imag**2
    zero = square == 0.0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def small_solve(a: Array, b: Array) -> Array:
    """Return x of a x = b; b (n,) or (n, m).

    - 1 to 3 equations are solved in unrolled form, many times faster than a library call under `vmap`
    - up to 8 equations are solved by `eliminate`
    - larger systems are solved by the library, those of a batch one after the other, see `solve_in_turn`
    """
    n = b.shape[0]
    if n == 1:
        return b / a[0, 0]
    if n <= 3:
        return _unrolled_solve(a, b)
    if n <= _MAX_UNROLLED_EQUATIONS:
        return eliminate(a, b)
    dtype = jnp.result_type(a, b)
    a, b = a.astype(dtype), b.astype(dtype)
    return jax.lax.custom_linear_solve(
        lambda x: a @ x, b, lambda _, right: solve_in_turn(a, right), lambda _, right: solve_in_turn(a.T, right)
    )


@jax.custom_jvp
def _unrolled_solve(a: Array, b: Array) -> Array:
    adjugate, determinant = _adjugate(a)
    return _times(adjugate, b) / determinant


@_unrolled_solve.defjvp
def _unrolled_solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return x and its tangent x', the solution of a x' = b' - a' x, from one adjugate: half the operations of an automatic
    derivative."""
    (a, b), (da, db) = primals, tangents
    adjugate, determinant = _adjugate(a)
    x = _times(adjugate, b) / determinant
    return x, _times(adjugate, db - _times(da, x)) / determinant


def _adjugate(a: Array) -> tuple[Array, Array]:
    """Return the adjugate adj(a) and the determinant det(a) of a matrix 2 x 2 or 3 x 3: a adj(a) = det(a) I."""
    if a.shape[0] == 2:
        cofactors = a[::-1, ::-1] * np.array([[1.0, -1.0], [-1.0, 1.0]], a.dtype)
    else:
        below, above = jnp.roll(a, -1, 0), jnp.roll(a, 1, 0)
        cofactors = jnp.roll(below, -1, 1) * jnp.roll(above, 1, 1) - jnp.roll(below, 1, 1) * jnp.roll(above, -1, 1)
    return cofactors.T, jnp.sum(a[0] * cofactors[0])


def _times(a: Array, b: Array) -> Array:
    """Product a @ b as a sum, which the compiler can fuse."""
    return jnp.sum(a.reshape(*a.shape, *[1] * (b.ndim - 1)) * b[None], axis=1)


@custom_vmap
def solve_in_turn(a: Array, b: Array) -> Array:
    """Return x of a x = b by the library, without derivatives.

    On a CPU the library is called for one system of a batch after the other. A batched call can deadlock on a CPU
    (jaxlib before 0.11.2): a thread that runs such a call waits until threads of the same pool have solved its systems. If all
    threads wait, none is left to solve a system. For about 20 equations and more, calls one after the other are also faster.
    """
    return jnp.linalg.solve(a, b)


@solve_in_turn.def_vmap
def _solve_one_by_one(size: int, is_mapped: list[bool], a: Array, b: Array) -> tuple[Array, bool]:
    if not is_mapped[0]:  # one system, many right-hand sides
        columns = jnp.moveaxis(b, 0, -1)
        x = solve_in_turn(a, columns.reshape(a.shape[0], -1))
        return jnp.moveaxis(x.reshape(columns.shape), -1, 0), True

    def solve_each(a: Array, b: Array) -> Array:
        return jax.lax.map(lambda system: solve_in_turn(*system), (a, b))

    right = b if is_mapped[1] else jnp.broadcast_to(b, (size, *b.shape))
    return jax.lax.platform_dependent(a, right, cpu=solve_each, default=jax.vmap(jnp.linalg.solve)), True


def eigenvalues(matrix: Array) -> Array:
    """Return the complex eigenvalues (..., n) of matrices (..., n, n), which have derivatives of any order.

    For `jnp.linalg.eigvals` JAX refuses second derivatives, because those of eigenvectors depend on their normalization. The
    derivatives of the eigenvalues do not.
    """
    pair = jax.lax.linalg.eig(
        matrix, compute_left_eigenvectors=False, compute_right_eigenvectors=False, enable_eigvec_derivs=True
    )
    return pair[0]


def _in_turn(function: Callable[[Array], T]) -> Callable[[Array], T]:
    """Return a function that calls the library for one matrix of a batch after the other, see `solve_in_turn`."""
    each = custom_vmap(function)

    @each.def_vmap
    def _(size: int, is_mapped: list[bool], matrices: Array) -> tuple[T, PyTree[bool]]:
        results = jax.lax.map(each, matrices)
        return results, jax.tree.map(lambda _: True, results)

    return each


@_in_turn
def eigenvalues_in_turn(matrix: Array) -> Array:
    """Return the complex eigenvalues (n,) of a matrix (n, n), without eigenvectors."""
    return eigenvalues(matrix)


@_in_turn
def eigenvectors_in_turn(matrix: Array) -> tuple[Array, Array]:
    """Return the complex eigenvalues (n,) and eigenvectors (n, n) of a matrix (n, n)."""
    values, vectors = jnp.linalg.eig(matrix)
    return values, vectors


@_in_turn
def svd_in_turn(matrix: Array) -> tuple[Array, Array, Array]:
    """Return the singular value decomposition U, s, V^T of a matrix (n, n)."""
    left, values, right = jnp.linalg.svd(matrix)
    return left, values, right


def complex_product(matrix: Array, other: Array) -> Array:
    """Return matrix @ other for a real or complex matrix and a complex vector or matrix `other`. It is computed from products
    of real matrices, which take less than half of the time.

    >>> complex_product(jnp.asarray([[1.0, 1.0j]]), jnp.asarray([2.0, 1.0j]))
    Array([1.+0.j], dtype=complex128)
    """
    if not jnp.iscomplexobj(matrix):
        return jax.lax.complex(matrix @ other.real, matrix @ other.imag)
    a, b, c, d = matrix.real, matrix.imag, other.real, other.imag
    return jax.lax.complex(a @ c - b @ d, a @ d + b @ c)


def refine_solution(product: Callable[[Array], Array], inverse: Callable[[Array], Array], b: Array, norm: Array) -> Array:
    """Return x of A x = b, where `product(x)` is A x, `inverse(b)` an approximate solution, and `norm` the row-sum norm of A.
    The solution is corrected by its residual until only rounding errors are left, at most 4 times; usually no correction is
    needed."""
    eps = jnp.finfo(norm.dtype).eps

    def residual(x: Array) -> tuple[Array, Array]:
        rest = b - product(x)
        return rest, jnp.max(jnp.abs(rest)) / (norm * jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(b)))

    def improves(carry: tuple[Array, ...]) -> Array:
        steps, _, _, error, before = carry
        return (steps < 4) & (error > 8.0 * eps) & (error < 0.5 * before)

    def correct(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        steps, x, rest, error, _ = carry
        x = x + inverse(rest)
        return steps + 1, x, *residual(x), error

    x = inverse(b)
    rest, error = residual(x)
    start = (jnp.asarray(0), x, rest, error, jnp.full_like(error, jnp.inf))
    return jax.lax.while_loop(improves, correct, start)[1]


def solve_definite(a: Array, b: Array) -> Array:
    """Return x (n,) or (n, m) of a x = b for a symmetric, positive definite matrix a, without pivots and therefore without
    branches."""
    rows = jnp.concatenate([a, b if b.ndim > 1 else b[:, None]], axis=1)
    for k in range(b.shape[0]):
        line = rows[k, 1:] / rows[k, 0]
        above, below = (part[:, 1:] - part[:, :1] * line[None] for part in (rows[:k], rows[k + 1 :]))
        rows = jnp.concatenate([above, line[None], below])
    return rows if b.ndim > 1 else rows[:, 0]


@_compiled
def eliminate(a: Array, b: Array) -> Array:
    """Return x (n,) or (n, m) of a x = b, by elimination with pivots, because library calls for large batches can deadlock, see
    `solve_in_turn`."""
    n = a.shape[0]
    row = jnp.arange(n)

    def eliminate_column(k: int, rows: Array) -> Array:
        pivot = jnp.argmax(jnp.where(row >= k, jnp.abs(rows[:, k]), -1.0))
        rows = rows[jnp.where(row == k, pivot, jnp.where(row == pivot, k, row))]
        line = rows[k] / rows[k, k]
        return jnp.where((row == k)[:, None], line[None, :], rows - rows[:, k][:, None] * line[None, :])

    dtype = jnp.result_type(a, b)
    rows = jnp.concatenate([a.astype(dtype), b.reshape(n, -1).astype(dtype)], axis=1)
    return jax.lax.fori_loop(0, n, eliminate_column, rows)[:, n:].reshape(b.shape)


@jax.custom_jvp
def unrolled_inverse(matrix: Array) -> Array:
    """Return the inverse of a matrix (n, n) by unrolled Gauss-Jordan elimination.

    A library call would prevent fusion in the time loop, and large batches of such calls can deadlock, see `solve_in_turn`.
    There are no pivots; the matrix must be diagonally dominant, such as 1/(gamma h) - J for small h. For larger h the
    inverse can be inaccurate; the step is then rejected by its error estimate and repeated with a smaller h.
    """
    for i in range(matrix.shape[0]):
        here = np.arange(matrix.shape[0]) == i
        pivot = 1.0 / matrix[i, i]
        row = jnp.where(here, pivot, matrix[i] * pivot)
        others = jnp.where(here[None, :], 0.0, matrix) - matrix[:, i][:, None] * row[None, :]
        matrix = jnp.where(here[:, None], row[None, :], others)
    return matrix


@unrolled_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = unrolled_inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse
