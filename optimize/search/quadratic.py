"""Many small quadratic programs at once, by a primal-dual interior-point method.

Sizes of arrays: s problems with d unknowns, me equalities and mi inequalities. Each constraint gets one more unknown, its
violation. The interior-point method solves these programs of n = d + me + mi unknowns with m = 3 me + 2 mi + 2 d inequalities.
A slack is the distance of an inequality from its limit, and a dual the multiplier of an inequality.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_MAX_NEWTON_STEPS = 60

_STEPS_WITHOUT_PROGRESS, _NEAR_OPTIMUM = 8, 1e-6
"""The iteration ends if the residual is below `_NEAR_OPTIMUM` and has not halved in `_STEPS_WITHOUT_PROGRESS` steps, because
then only rounding errors are left."""


class Solved(NamedTuple):
    """Solutions `p` (s, d) of s problems with d unknowns, and their multipliers.

    The multipliers are those of the me equalities, `held` (s, me); of the mi inequalities, `demands` (s, mi), never negative;
    and of the `bounds` (s, d), positive at an upper bound and negative at a lower one.
    """

    p: np.ndarray
    held: np.ndarray
    demands: np.ndarray
    bounds: np.ndarray


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the products of matrices (s, m, n) and vectors (s, n)."""
    return (matrix @ vector[..., None])[..., 0]


def solve_penalized(
    hessian: np.ndarray,
    slope: np.ndarray,
    held: tuple[np.ndarray, np.ndarray],
    demands: tuple[np.ndarray, np.ndarray],
    box: tuple[np.ndarray, np.ndarray],
    penalty: np.ndarray,
) -> Solved:
    """Solve quadratic programs whose constraints are penalized. A solution therefore always exists:

        min p.B p/2 + g.p + penalty (sum |A p + a| + sum max(0, C p + c)),     low <= p <= high

    Method: Mehrotra's predictor and corrector (SIAM J. Optim. 2, 1992) on the slacks of all inequalities. The errors of the
    multipliers are proportional to the penalty, at most about 1e-7 times the penalty.

    **Arguments** (s problems): `hessian` B (s, d, d), positive semidefinite;
    `slope` g (s, d); `held` A (s, me, d) and a (s, me); `demands` C (s, mi, d) and c (s, mi); `box` low and high (s, d);
    `penalty` (s,).

    >>> import numpy as np
    >>> none = np.zeros((1, 0, 1)), np.zeros((1, 0))
    >>> one = solve_penalized(np.eye(1)[None], np.array([[-3.0]]), none, (np.ones((1, 1, 1)), np.array([[-1.0]])),
    ...               (np.array([[-9.0]]), np.array([[9.0]])), np.array([100.0]))
    >>> one.p.round(6).tolist(), one.demands.round(6).tolist()    # the minimum of x^2/2 - 3 x for x <= 1
    ([[1.0]], [[2.0]])
    """
    (a_rows, a), (c_rows, c), (low, high) = held, demands, box
    me, mi, d = a.shape[1], c.shape[1], slope.shape[1]
    program = _with_slacks(hessian, slope, held, demands, box, penalty)
    # Start in the middle of the box with equal products of slacks and duals. `constraint_values` are the values of the
    # constraints there. All violations have the initial value `first_violation`.
    p = (low + high) / 2.0
    constraint_values = np.concatenate([_times(a_rows, p) + a, _times(c_rows, p) + c], axis=1)
    first_violation = 1.0 + 2.0 * np.max(np.abs(constraint_values), axis=1, initial=0.0)
    x = np.concatenate([p, np.repeat(first_violation[:, None], me + mi, axis=1)], axis=1)
    slack = np.maximum(program.right - _times(program.rows, x), 1e-12)
    x, dual = _interior_point(program, x, slack, (penalty * first_violation / 3.0)[:, None] / slack)
    parts = np.split(dual, np.cumsum([me, me, mi, me + mi, d]), axis=1)
    return Solved(np.clip(x[:, :d], low, high), parts[0] - parts[1], parts[2], parts[4] - parts[5])


class _Program(NamedTuple):
    """Quadratic programs min x.Q x/2 + q.x with rows x <= right: `quadratic` (s, n, n), `linear` (s, n), `rows` (s, m, n),
    `right` (s, m)."""

    quadratic: np.ndarray
    linear: np.ndarray
    rows: np.ndarray
    right: np.ndarray


def _with_slacks(
    hessian: np.ndarray,
    slope: np.ndarray,
    held: tuple[np.ndarray, np.ndarray],
    demands: tuple[np.ndarray, np.ndarray],
    box: tuple[np.ndarray, np.ndarray],
    penalty: np.ndarray,
) -> _Program:
    """Return the programs of `solve_penalized` in x = (p, violations); each constraint has one violation, at least 0."""
    (a_rows, a), (c_rows, c), (low, high) = held, demands, box
    (s, d), me, mi = slope.shape, a.shape[1], c.shape[1]
    n = d + me + mi
    quadratic = np.zeros((s, n, n))
    quadratic[:, :d, :d] = hessian
    identity = np.broadcast_to(np.eye(d), (s, d, d))

    def row(of_p: np.ndarray, k: int, count: int) -> np.ndarray:
        """Return rows with the coefficients `of_p` of p; row j < `count` also has the coefficient -1 of violation `k` + j."""
        rows = np.zeros((s, of_p.shape[1], n))
        rows[:, :, :d] = of_p
        rows[:, np.arange(count), d + k + np.arange(count)] = -1.0
        return rows

    rows = [
        row(a_rows, 0, me),
        row(-a_rows, 0, me),
        row(c_rows, me, mi),
        row(np.zeros((s, me + mi, d)), 0, me + mi),
        row(identity, 0, 0),
        row(-identity, 0, 0),
    ]
    return _Program(
        quadratic,
        linear=np.concatenate([slope, np.repeat(penalty[:, None], me + mi, axis=1)], axis=1),
        rows=np.concatenate(rows, axis=1),
        right=np.concatenate([-a, a, -c, np.zeros((s, me + mi)), high, -low], axis=1),
    )


def _interior_point(program: _Program, x: np.ndarray, slack: np.ndarray, dual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the solutions x and their duals from a start with positive slacks and duals."""
    quadratic, linear, rows, right = program
    s, m = right.shape
    scale = 1.0 + np.abs(linear).max(axis=1)
    best, least_residual, halved_residual, halved_at = (x, dual), np.full(s, np.inf), np.full(s, np.inf), np.zeros(s, int)
    for k in range(_MAX_NEWTON_STEPS):
        stationary = _times(quadratic, x) + linear + _times(np.swapaxes(rows, 1, 2), dual)
        primal = _times(rows, x) + slack - right
        gap = np.einsum("sm,sm->s", slack, dual) / m
        # The best point is stored, because rounding errors may make later points worse.
        residual = np.maximum(np.maximum(gap, np.abs(stationary).max(axis=1)) / scale, np.abs(primal).max(axis=1))
        better = residual < least_residual
        is_halved = residual < 0.5 * halved_residual
        halved_at, halved_residual = np.where(is_halved, k, halved_at), np.where(is_halved, residual, halved_residual)
        least_residual = np.where(better, residual, least_residual)
        best = np.where(better[:, None], x, best[0]), np.where(better[:, None], dual, best[1])
        done = (least_residual < 1e-11) | ((least_residual < _NEAR_OPTIMUM) & (k - halved_at >= _STEPS_WITHOUT_PROGRESS))
        if np.all(done):
            break
        dx, ds, dl = _predicted_and_corrected(program, stationary, primal, gap, slack, dual)
        fraction = np.where(done, 0.0, 0.995)
        # One step length for x and the duals, because the stationarity condition contains both: Q x + q + rows^T dual = 0.
        length = fraction * np.minimum(_longest(slack, ds), _longest(dual, dl))
        x = x + length[:, None] * dx
        slack = np.maximum(slack + length[:, None] * ds, 1e-300)
        dual = np.maximum(dual + length[:, None] * dl, 1e-300)
    return best


def _predicted_and_corrected(
    program: _Program, stationary: np.ndarray, primal: np.ndarray, gap: np.ndarray, slack: np.ndarray, dual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Mehrotra's step of x, slacks and duals: a predictor step determines how far the products of slacks and duals can
    decrease, and the corrector step aims at these smaller products."""
    rows, transposed = program.rows, np.swapaxes(program.rows, 1, 2)
    (m, n), weight = rows.shape[1:], dual / slack
    matrix = program.quadratic + (transposed * weight[:, None, :]) @ rows
    # The ridge of each unknown is relative to its own diagonal entry. The weights of violations that are 0 tend to infinity; a
    # ridge relative to the mean of the diagonal would therefore exceed the quadratic part.
    diagonal = np.einsum("snn->sn", matrix)
    matrix = matrix + 1e-13 * (1.0 + diagonal)[:, :, None] * np.eye(n)

    def solved(target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the step that changes the products of slacks and duals by `target`, to first order."""
        rest = -stationary - _times(transposed, weight * primal + target / slack)
        dx = np.linalg.solve(matrix, rest[..., None])[..., 0]
        ds = -primal - _times(rows, dx)
        return dx, ds, target / slack - weight * ds

    _, ds, dl = solved(-slack * dual)
    length_s, length_l = _longest(slack, ds), _longest(dual, dl)
    after = np.einsum("sm,sm->s", slack + length_s[:, None] * ds, dual + length_l[:, None] * dl) / m
    centre = (after / np.maximum(gap, 1e-300)) ** 3 * gap
    return solved(centre[:, None] - slack * dual - ds * dl)


def _longest(value: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the largest fraction of a step, at most 1, that leaves all values positive."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.minimum(1.0, np.where(step < 0.0, -value / step, np.inf).min(axis=1))
