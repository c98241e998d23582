"""Quadratic model of the Lagrangian at a design: second derivatives and the step to the minimum.

Sizes of arrays: s designs, d free parameters, me held quantities (equalities), mi demands (inequalities), p or `parts` pieces
of the objective, k pieces in addition to the largest one, m equations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optimize.search.problem import Point, Problem, evaluate
from optimize.search.quadratic import Solved, solve_penalized

_DIFFERENCE_STEP = 1e-5
"""Step of central differences, as a fraction of the range of a free parameter."""

_MIN_SHARE_AT_KINK = 1e-4
"""Share of a piece of the objective (its multiplier) above which the piece counts as one of those that meet at a kink."""

_SMALL_OBJECTIVE_SHARE = 1e-4
"""Smallest scale of the objective, relative to its predicted change: its largest slope times the whole range of the parameter,
from the lower to the upper bound."""


class Step(NamedTuple):
    """Steps to the minimum of the model.

    **Attributes**: `p` (s, d): changes of the free parameters, as fractions of their ranges; multipliers of `held`
    quantities (s, me) and of `demands` (s, mi); `shares` (s, parts) of the pieces of the objective, with the sum 1.
    """

    p: np.ndarray
    held: np.ndarray
    demands: np.ndarray
    shares: np.ndarray


def transposed(a: np.ndarray) -> np.ndarray:
    """Transpose each matrix of an array (s, ...)."""
    return np.swapaxes(a, 1, 2)


def least_norm(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution x (s, d) of least norm of rows (s, m, d) x = right (s, m)."""
    gram = rows @ transposed(rows)
    ridge = np.finfo(float).eps * (1.0 + np.trace(gram, axis1=1, axis2=2))
    solved = np.linalg.solve(gram + ridge[:, None, None] * np.eye(gram.shape[1]), right[..., None])
    return (transposed(rows) @ solved)[..., 0]


def _pieces(problem: Problem, point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Return values (s, p) and derivatives (s, p, d) of the pieces whose maximum is the objective."""
    if problem.parts == 1:
        return point.values[:, :1], point.slopes[:, :1]
    return point.pieces, point.piece_gradients


def kink_residuals(point: Point, shares: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals of the condition that pieces of the objective are equal at a kink.

    **Arguments**: `shares` (s, parts): shares of the pieces; `size` (s,): unit of the objective.

    **Returns** the differences (s, k) between the other pieces and the piece with the largest share, in units of `size`, and
    their derivatives (s, k, d); both are 0 for pieces without a share.
    """
    largest = np.argsort(-shares, axis=1)[:, : point.z.shape[1] + 1]
    values, meets = (np.take_along_axis(a, largest, axis=1) for a in (point.pieces, shares > _MIN_SHARE_AT_KINK))
    piece_gradients = np.take_along_axis(point.piece_gradients, largest[:, :, None], axis=1)
    meets, size = meets[:, 1:] & np.all(np.isfinite(piece_gradients), axis=(1, 2))[:, None], size[:, None]
    gap, piece_gradients = values[:, 1:] - values[:, :1], piece_gradients[:, 1:] - piece_gradients[:, :1]
    return np.where(meets, gap / size, 0.0), np.where(meets[:, :, None], piece_gradients / size[:, :, None], 0.0)


def at_kink(point: Point, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return derivatives at a kink of the objective.

    **Returns** the derivatives (s, d) of the largest piece; for the next largest pieces, the derivatives (s, k, d) minus those
    of the largest piece; and True (s, k) for pieces that equal the largest one within `near`. The unit of `near` is
    the objective or, if this is small, its smallest scale (`_SMALL_OBJECTIVE_SHARE`).
    """
    order = np.argsort(-point.pieces, axis=1)[:, : point.z.shape[1] + 1]
    values = np.take_along_axis(point.pieces, order, axis=1)
    piece_gradients = np.nan_to_num(np.take_along_axis(point.piece_gradients, order[:, :, None], axis=1))
    size = np.maximum(np.abs(values[:, :1]), _SMALL_OBJECTIVE_SHARE * np.max(np.abs(piece_gradients), axis=(1, 2))[:, None])
    return piece_gradients[:, 0], piece_gradients[:, 1:] - piece_gradients[:, :1], values[:, :1] - values[:, 1:] < near * size


def second_derivatives(problem: Problem, point: Point) -> np.ndarray:
    """Return second derivatives (s, d, me + mi + parts + 1, d) by central differences of first derivatives.

    The order of the functions is: held quantities, demands, pieces of the objective, half the square of the objective.
    """
    s, d = point.z.shape
    moves = _DIFFERENCE_STEP * np.concatenate([np.eye(d), -np.eye(d)])
    # All designs are evaluated in one call; batches are then full, and every core has work.
    around = point.take(np.tile(np.arange(s), 2 * d))
    z = around.z + np.repeat(moves, s, axis=0)
    around_point = evaluate(problem, z, around.extrapolate_speeds(z))
    rows = np.concatenate(
        [
            around_point.slopes[:, 1:],
            _pieces(problem, around_point)[1],
            (around_point.values[:, :1] * around_point.slopes[:, 0])[:, None],
        ],
        axis=1,
    )
    high, low = rows.reshape(2, d, s, -1, d)
    return np.moveaxis((high - low) / (2.0 * _DIFFERENCE_STEP), 0, 1)


def curvatures(
    problem: Problem, point: Point, second: np.ndarray, weights: np.ndarray, shares: np.ndarray, size: np.ndarray
) -> list[np.ndarray]:
    """Return second derivatives (s, d, d) of the Lagrangian, in units of the objective, made positive semidefinite.

    The second derivatives are projected onto the directions in which active constraints and pieces do not determine the step;
    in the other directions the linear model determines it. If the objective f has one piece and is positive for a design, a
    second set is returned, with (f^2/2)''/f in place of f''. The second set is better if f is the modulus of an almost linear
    quantity, for example a force that should vanish. The step with this set then reaches the zero at once, whereas the step
    with f'' reaches it only from nearby.

    **Arguments**: `second`: see `second_derivatives`; `weights` (s, me + mi): multipliers, in units of the objective's `size`
    (s,); `shares` (s, parts) of the pieces of the objective.
    """
    s, d = point.z.shape
    m = problem.equalities
    constraints = np.einsum("sm,simd->sid", weights, second[:, :, : weights.shape[1]])
    hessian = constraints + np.einsum("sp,sipd->sid", shares / size[:, None], second[:, :, weights.shape[1] : -1])
    usable = np.all(np.isfinite(hessian), axis=(1, 2), keepdims=True)
    hessian = np.where(usable, hessian, np.eye(d))
    is_active = np.ones(weights.shape, bool)
    is_active[:, m:] = weights[:, m:] > 1e-12
    free = 1.0 - (((point.z <= 0.0) | (point.z >= 1.0)) * 1.0)
    rows = np.where(np.isfinite(point.slopes), point.slopes, 0.0)[:, 1:] * is_active[:, :, None]
    if problem.parts > 1:  # pieces that are equal at a kink stay equal along it
        rows = np.concatenate([rows, kink_residuals(point, shares, size)[1]], axis=1)
    rows = rows * free[:, None, :]
    projector = np.eye(d) * np.ones((s, 1, 1))
    if rows.shape[1]:
        projector = projector - np.stack([least_norm(rows, rows[:, :, i]) for i in range(d)], axis=2)
    value = point.values[:, 0]
    if problem.parts > 1 or not np.any(value > 0.0):
        return [_positive(projector, hessian)]
    with np.errstate(all="ignore"):  # not defined for an objective of 0
        constraints_and_square = constraints + second[:, :, -1] / (size * value)[:, None, None]
    is_usable_square = (
        usable & (value > 0.0)[:, None, None] & np.all(np.isfinite(constraints_and_square), axis=(1, 2), keepdims=True)
    )
    return [_positive(projector, hessian), _positive(projector, np.where(is_usable_square, constraints_and_square, hessian))]


def _positive(projector: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    inner = projector @ (hessian + transposed(hessian)) / 2.0 @ transposed(projector)
    values, vectors = np.linalg.eigh((inner + transposed(inner)) / 2.0)
    top = np.maximum(np.max(np.abs(values), axis=1, keepdims=True), 1e-12)
    values = np.maximum(np.abs(values), 1e-10 * top)
    return np.einsum("sij,sj,skj->sik", vectors, values, vectors)


def solve_model(
    problem: Problem, point: Point, hessian: np.ndarray, size: np.ndarray, penalty: np.ndarray, trust_radius: np.ndarray
) -> Step:
    """Return the step to the minimum of the model within the bounds and the trust region of radius `trust_radius` (s,).

    If the objective is the maximum of several pieces, an additional unknown t is minimized such that no piece exceeds t
    (epigraph form).
    """
    m, mi, d = problem.equalities, len(problem.demands), point.z.shape[1]
    box = np.maximum(-point.z, -trust_radius[:, None]), np.minimum(1.0 - point.z, trust_radius[:, None])
    held = point.slopes[:, 1 : 1 + m], point.values[:, 1 : 1 + m]
    demands = point.slopes[:, 1 + m :], point.values[:, 1 + m :]
    if problem.parts == 1:
        solution = solve_penalized(hessian, point.slopes[:, 0] / size[:, None], held, demands, box, penalty)
        return Step(solution.p, solution.held, solution.demands * _active(solution, demands), np.ones((len(hessian), 1)))
    values = (point.pieces - point.values[:, :1]) / size[:, None]
    slopes = point.piece_gradients / size[:, None, None]
    # Only the 3 d + 8 pieces that can reach the largest values in the trust region are used; at most d + 1 meet at a kink.
    reachable = values + np.einsum("spd,sd->sp", np.abs(slopes), np.maximum(-box[0], box[1]))
    candidates = np.argsort(-reachable, axis=1)[:, : 3 * d + 8]
    values = np.take_along_axis(values, candidates, axis=1)
    slopes = np.take_along_axis(slopes, candidates[:, :, None], axis=1)

    def with_t(rows: np.ndarray, of_t: float) -> np.ndarray:
        return np.concatenate([rows, np.full((*rows.shape[:2], 1), of_t)], axis=2)

    limit_of_t = 1.0 + 2.0 * np.max(np.abs(reachable), axis=1, keepdims=True)
    solution = solve_penalized(
        np.pad(hessian, ((0, 0), (0, 1), (0, 1))),
        np.concatenate([np.zeros((len(hessian), d)), np.ones((len(hessian), 1))], axis=1),
        (with_t(held[0], 0.0), held[1]),
        (np.concatenate([with_t(demands[0], 0.0), with_t(slopes, -1.0)], axis=1), np.concatenate([demands[1], values], axis=1)),
        (np.concatenate([box[0], -limit_of_t], axis=1), np.concatenate([box[1], limit_of_t], axis=1)),
        penalty,
    )
    shares = np.zeros_like(point.pieces)
    np.put_along_axis(shares, candidates, solution.demands[:, mi:], axis=1)
    shares = shares / np.maximum(np.sum(shares, axis=1, keepdims=True), 1e-300)
    return Step(solution.p[:, :d], solution.held, solution.demands[:, :mi] * _active(solution, demands), shares)


def _active(solution: Solved, demands: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return True (s, mi) for demands (slopes, excess) that are active after the step.

    An interior-point method leaves small multipliers of inactive demands. Compared with an objective near 0 they are not small.
    """
    slopes, excess = demands
    slack = -excess - np.einsum("smd,sd->sm", slopes, solution.p[:, : slopes.shape[2]])
    return solution.demands[:, : excess.shape[1]] > slack


def predicted_decrease(problem: Problem, point: Point, hessian: np.ndarray, model: Step, size: np.ndarray) -> np.ndarray:
    """Return the change of the Lagrangian that the model predicts, as a positive number relative to the objective.

    If the objective is about 0, the number is relative to its smallest scale (`_SMALL_OBJECTIVE_SHARE`).
    """
    values, slopes = _pieces(problem, point)
    linear_change = np.max(values - point.values[:, :1] + np.einsum("spd,sd->sp", slopes, model.p), axis=1)
    dual = np.concatenate([model.held, model.demands], axis=1) * size[:, None]
    constraint_change = np.einsum("sm,smd,sd->s", dual, point.slopes[:, 1:], model.p)
    curved = np.einsum("si,sij,sj->s", model.p, hessian, model.p) * size
    # At the zero of a modulus the slopes vanish; their change then defines the scale.
    change = np.max(np.abs(slopes), axis=(1, 2)) + _DIFFERENCE_STEP * np.trace(hessian, axis1=1, axis2=2) * size
    scale = np.maximum(np.abs(point.values[:, 0]), _SMALL_OBJECTIVE_SHARE * change)
    return np.abs(linear_change + constraint_change + 0.5 * curved) / np.maximum(scale, 1e-300)
