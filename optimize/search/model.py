"""The quadratic model of a search about a design: second derivatives of its Lagrangian, the step to the model's least value."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optimize.search.problem import Point, Problem, evaluate
from optimize.search.quadratic import Solved, elastic

__all__ = ["Step", "at_kink", "curvatures", "fall", "least_norm", "modelled", "seconds", "transposed", "unlike"]

_WIDTH = 1e-5
"""Step of the central differences of derivatives, in parts of a free number's range."""

_COUNTS = 1e-4
"""The least share of a piece of the objective that counts as being at the kink."""

_NOTHING = 1e-4
"""An objective below this share of what it changes by over the bounds, as its slope has it, is measured by that share."""


class Step(NamedTuple):
    """The steps `p` (s, d) to the least value of the model, and the multipliers there: of what is `held` (s, me), of `demands`
    (s, mi); the `shares` (s, parts) of the objective's pieces, together 1."""

    p: np.ndarray
    held: np.ndarray
    demands: np.ndarray
    shares: np.ndarray


def transposed(a: np.ndarray) -> np.ndarray:
    """Each matrix of (s, ...) the other way round."""
    return np.swapaxes(a, 1, 2)


def least_norm(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The shortest x (s, d) with rows (s, m, d) x = right (s, m)."""
    gram = rows @ transposed(rows)
    ridge = np.finfo(float).eps * (1.0 + np.trace(gram, axis1=1, axis2=2))
    solved = np.linalg.solve(gram + ridge[:, None, None] * np.eye(gram.shape[1]), right[..., None])
    return (transposed(rows) @ solved)[..., 0]


def _pieces(problem: Problem, point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Values (s, p) and derivatives (s, p, d) of what the objective is the largest of: itself where it is one piece."""
    if problem.parts == 1:
        return point.values[:, :1], point.slopes[:, :1]
    return point.pieces, point.tilts


def unlike(point: Point, shares: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences, in parts of `size` (s,), of the objective's pieces that have `shares` (s, parts) from the one with the
    largest share, (s, k), and their derivatives (s, k, d); 0 for pieces without a share."""
    most = np.argsort(-shares, axis=1)[:, : point.z.shape[1] + 1]
    values, met = (np.take_along_axis(a, most, axis=1) for a in (point.pieces, shares > _COUNTS))
    tilts = np.take_along_axis(point.tilts, most[:, :, None], axis=1)
    met, size = met[:, 1:] & np.all(np.isfinite(tilts), axis=(1, 2))[:, None], size[:, None]
    apart, tilts = values[:, 1:] - values[:, :1], tilts[:, 1:] - tilts[:, :1]
    return np.where(met, apart / size, 0.0), np.where(met[:, :, None], tilts / size[:, :, None], 0.0)


def at_kink(point: Point, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The derivatives (s, d) of the largest piece of the objective; by how much those (s, k, d) of the next ones differ, and
    which of these, (s, k), are about as large: within `near` of the objective, or of what it changes by over the bounds."""
    order = np.argsort(-point.pieces, axis=1)[:, : point.z.shape[1] + 1]
    values = np.take_along_axis(point.pieces, order, axis=1)
    tilts = np.nan_to_num(np.take_along_axis(point.tilts, order[:, :, None], axis=1))
    size = np.maximum(np.abs(values[:, :1]), _NOTHING * np.max(np.abs(tilts), axis=(1, 2))[:, None])
    return tilts[:, 0], tilts[:, 1:] - tilts[:, :1], values[:, :1] - values[:, 1:] < near * size


def seconds(problem: Problem, point: Point) -> np.ndarray:
    """Second derivatives (s, d, me + mi + parts + 1, d) of what is held, of demands, of the objective's pieces, and of half
    the objective's square, by central differences of the first ones."""
    s, d = point.z.shape
    moves = _WIDTH * np.concatenate([np.eye(d), -np.eye(d)])
    # All in one, so that chunks are full and every core has some.
    around = point.take(np.tile(np.arange(s), 2 * d))
    z = around.z + np.repeat(moves, s, axis=0)
    there = evaluate(problem, z, around.ahead(z))
    rows = np.concatenate(
        [there.slopes[:, 1:], _pieces(problem, there)[1], (there.values[:, :1] * there.slopes[:, 0])[:, None]], axis=1
    )
    high, low = rows.reshape(2, d, s, -1, d)
    return np.moveaxis((high - low) / (2.0 * _WIDTH), 0, 1)


def curvatures(
    problem: Problem, point: Point, second: np.ndarray, weights: np.ndarray, shares: np.ndarray, size: np.ndarray
) -> list[np.ndarray]:
    """Second derivatives (s, d, d) of the Lagrangian over the objective's size, not indefinite; only along what constraints
    and pieces that count leave free: across them the linear model decides. Second ones, where the objective f is positive,
    take (f^2/2)''/f in place of f'': where f is the modulus of what is linear nearby, a force that is to vanish, their step
    leads there at once, and that of f'' only from near.

    **Arguments**: `second` see `seconds`; multipliers `weights` (s, me + mi) in units of the objective's `size` (s,); `shares`
    (s, parts) of its pieces.
    """
    s, d = point.z.shape
    m = problem.equalities
    constraints = np.einsum("sm,simd->sid", weights, second[:, :, : weights.shape[1]])
    bend = constraints + np.einsum("sp,sipd->sid", shares / size[:, None], second[:, :, weights.shape[1] : -1])
    usable = np.all(np.isfinite(bend), axis=(1, 2), keepdims=True)
    bend = np.where(usable, bend, np.eye(d))
    counts = np.ones(weights.shape, bool)
    counts[:, m:] = weights[:, m:] > 1e-12
    free = 1.0 - (((point.z <= 0.0) | (point.z >= 1.0)) * 1.0)
    rows = np.where(np.isfinite(point.slopes), point.slopes, 0.0)[:, 1:] * counts[:, :, None]
    if problem.parts > 1:  # along a kink the pieces that meet there stay alike
        rows = np.concatenate([rows, unlike(point, shares, size)[1]], axis=1)
    rows = rows * free[:, None, :]
    projector = np.eye(d) * np.ones((s, 1, 1))
    if rows.shape[1]:
        projector = projector - np.stack([least_norm(rows, rows[:, :, i]) for i in range(d)], axis=2)
    value = point.values[:, 0]
    if problem.parts > 1 or not np.any(value > 0.0):
        return [_positive(projector, bend)]
    with np.errstate(all="ignore"):  # an objective that is nothing has no such ones
        other = constraints + second[:, :, -1] / (size * value)[:, None, None]
    apt = usable & (value > 0.0)[:, None, None] & np.all(np.isfinite(other), axis=(1, 2), keepdims=True)
    return [_positive(projector, bend), _positive(projector, np.where(apt, other, bend))]


def _positive(projector: np.ndarray, bend: np.ndarray) -> np.ndarray:
    inner = projector @ (bend + transposed(bend)) / 2.0 @ transposed(projector)
    values, vectors = np.linalg.eigh((inner + transposed(inner)) / 2.0)
    top = np.maximum(np.max(np.abs(values), axis=1, keepdims=True), 1e-12)
    values = np.maximum(np.abs(values), 1e-10 * top)
    return np.einsum("sij,sj,skj->sik", vectors, values, vectors)


def modelled(problem: Problem, point: Point, bend: np.ndarray, size: np.ndarray, price: np.ndarray, reach: np.ndarray) -> Step:
    """The step to the least value of the model within the bounds and within `reach` (s,). Where the objective is the largest
    of several pieces, this is the epigraph's: the least t that none of them exceeds."""
    m, mi, d = problem.equalities, len(problem.demands), point.z.shape[1]
    box = np.maximum(-point.z, -reach[:, None]), np.minimum(1.0 - point.z, reach[:, None])
    held = point.slopes[:, 1 : 1 + m], point.values[:, 1 : 1 + m]
    demands = point.slopes[:, 1 + m :], point.values[:, 1 + m :]
    if problem.parts == 1:
        found = elastic(bend, point.slopes[:, 0] / size[:, None], held, demands, box, price)
        return Step(found.p, found.held, found.demands * _active(found, demands), np.ones((len(bend), 1)))
    values = (point.pieces - point.values[:, :1]) / size[:, None]
    slopes = point.tilts / size[:, None, None]
    # Those that could be the largest within reach, and not more than may be at one kink and some to spare.
    could = values + np.einsum("spd,sd->sp", np.abs(slopes), np.maximum(-box[0], box[1]))
    few = np.argsort(-could, axis=1)[:, : 3 * d + 8]
    values = np.take_along_axis(values, few, axis=1)
    slopes = np.take_along_axis(slopes, few[:, :, None], axis=1)

    def beside(rows: np.ndarray, of_t: float) -> np.ndarray:
        return np.concatenate([rows, np.full((*rows.shape[:2], 1), of_t)], axis=2)

    wide = 1.0 + 2.0 * np.max(np.abs(could), axis=1, keepdims=True)
    found = elastic(
        np.pad(bend, ((0, 0), (0, 1), (0, 1))),
        np.concatenate([np.zeros((len(bend), d)), np.ones((len(bend), 1))], axis=1),
        (beside(held[0], 0.0), held[1]),
        (np.concatenate([beside(demands[0], 0.0), beside(slopes, -1.0)], axis=1), np.concatenate([demands[1], values], axis=1)),
        (np.concatenate([box[0], -wide], axis=1), np.concatenate([box[1], wide], axis=1)),
        price,
    )
    shares = np.zeros_like(point.pieces)
    np.put_along_axis(shares, few, found.demands[:, mi:], axis=1)
    shares = shares / np.maximum(np.sum(shares, axis=1, keepdims=True), 1e-300)
    return Step(found.p[:, :d], found.held, found.demands[:, :mi] * _active(found, demands), shares)


def _active(found: Solved, demands: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """True (s, mi) for demands (slopes, excess) that the step has no room left for. An interior point leaves every other one a
    small multiplier: its curvature would be left out, and beside an objective of almost nothing it would be large."""
    slopes, excess = demands
    room = -excess - np.einsum("smd,sd->sm", slopes, found.p[:, : slopes.shape[2]])
    return found.demands[:, : excess.shape[1]] > room


def fall(problem: Problem, point: Point, bend: np.ndarray, model: Step, size: np.ndarray) -> np.ndarray:
    """Decrease of the objective that the model predicts, relative to its value; for an objective of about 0, relative to its
    change over the bounds."""
    values, slopes = _pieces(problem, point)
    along = np.max(values - point.values[:, :1] + np.einsum("spd,sd->sp", slopes, model.p), axis=1)
    dual = np.concatenate([model.held, model.demands], axis=1) * size[:, None]
    paid = np.einsum("sm,smd,sd->s", dual, point.slopes[:, 1:], model.p)
    curved = np.einsum("si,sij,sj->s", model.p, bend, model.p) * size
    # At the tip of a modulus that vanishes slopes say nothing, and how they change does.
    change = np.max(np.abs(slopes), axis=(1, 2)) + _WIDTH * np.trace(bend, axis1=1, axis2=2) * size
    least = np.maximum(np.abs(point.values[:, 0]), _NOTHING * change)
    return np.abs(along + paid + 0.5 * curved) / np.maximum(least, 1e-300)
