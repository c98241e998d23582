"""Sequential quadratic programming from many designs at once, and what is known of where it ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optimize.search.problem import Point, Problem, evaluate
from optimize.search.quadratic import Solved, elastic

__all__ = ["FEASIBLE", "Polished", "Starts", "draw_starts", "least_norm", "optimality", "polish", "restored", "violation"]

FEASIBLE = 1e-8
"""How well what is held, and demands, must be kept in the end, relative to their values."""

_WIDTH = 1e-5
"""Step of the central differences of derivatives, in parts of a free number's range."""

_ACTIVE = 1e-6
"""How near to its limit a demand, relative to it, or to its bound a free number counts as being at it."""

_DEAREST = 1e9
"""The most that breaking a constraint may cost before it counts as contradictory, in parts of the objective."""


class Optimality(NamedTuple):
    """What is known of designs: `multipliers` of what is held (s, me) and of demands (s, mi), in units of the objective per
    unit of the relative excess; of bounds (s, d), positive at the upper one; the `kkt` residual (s,), relative."""

    held: np.ndarray
    demands: np.ndarray
    bounds: np.ndarray
    kkt: np.ndarray


class Polished(NamedTuple):
    """Where searches ended: the `point`; the objective on the way, `history` (steps, starts); `left`, by how much it could
    still fall in relation to its value, as slopes and curvatures tell; the greatest `violation`; and its `Optimality`."""

    point: Point
    history: np.ndarray
    left: np.ndarray
    violation: np.ndarray
    optimality: Optimality


def _transposed(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, 1, 2)


def least_norm(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The shortest x (s, d) with rows (s, m, d) x = right (s, m)."""
    gram = rows @ _transposed(rows)
    ridge = np.finfo(float).eps * (1.0 + np.trace(gram, axis1=1, axis2=2))
    solved = np.linalg.solve(gram + ridge[:, None, None] * np.eye(gram.shape[1]), right[..., None])
    return (_transposed(rows) @ solved)[..., 0]


def violation(problem: Problem, point: Point) -> np.ndarray:
    """The greatest relative amount (s,) by which anything held is off or a demand exceeded; infinite where there is no
    value."""
    m = problem.equalities
    parts = np.concatenate([np.abs(point.values[:, 1 : 1 + m]), np.maximum(point.values[:, 1 + m :], 0.0)], axis=1)
    return np.where(point.exists(), np.max(parts, axis=1, initial=0.0), np.inf)


def restored(problem: Problem, point: Point, steps: int, demanded: np.ndarray | None = None) -> Point:
    """The designs nearest to `point`, to first order, that keep what is held, and demands of which `demanded` (s, mi) is true
    or that are exceeded, inside the bounds."""
    m, mi = problem.equalities, len(problem.demands)
    if m + mi == 0:
        return point
    for _ in range(steps):
        finite = point.exists()
        slopes = np.where(finite[:, None, None], point.slopes, 0.0)[:, 1:]
        values = np.where(finite[:, None], point.values, 0.0)[:, 1:]
        counts = np.ones(values.shape, bool)
        counts[:, m:] = values[:, m:] > 0.0
        if demanded is not None:
            counts[:, m:] |= demanded
        slopes, values = slopes * counts[:, :, None], values * counts
        wanted = -least_norm(slopes, values)
        stopped = ((point.z <= 0.0) & (wanted < 0.0)) | ((point.z >= 1.0) & (wanted > 0.0))
        step = -least_norm(slopes * np.where(stopped, 0.0, 1.0)[:, None, :], values)
        z = np.clip(point.z + np.clip(step, -0.3, 0.3), 0.0, 1.0)
        point = evaluate(problem, z, point.ahead(z))
    return point


class Starts(NamedTuple):
    """Designs to start from, a `Point`, how many had to be `drawn`, how many of those have the objective, `existing`, and the
    `nearest` to keeping what is held of those that do not keep it, a `Point` of as many as were asked for, or None."""

    point: Point | None
    drawn: int
    existing: int
    nearest: Point | None


def draw_starts(
    problem: Problem, starts: int, seed: int, look: Callable[[Problem, np.ndarray], tuple[np.ndarray, ...]], rounds: int = 20
) -> Starts:
    """Random designs in the bounds, moved onto what is held; those where the objective does not exist are drawn anew."""
    random = np.random.default_rng(seed)
    kept: list[Point] = []
    others: list[Point] = []
    drawn = existing = 0
    while sum(len(p.z) for p in kept) < starts and drawn < rounds * starts:
        z = random.uniform(size=(starts, problem.space.size))
        point = evaluate(problem, z, look(problem, z))
        drawn += starts
        point = point.take(np.flatnonzero(point.exists()))
        existing += len(point.z)
        if not len(point.z):
            continue
        before = point
        if problem.equalities:
            point = _onto_held(problem, point)
        off = np.max(np.abs(point.values[:, 1 : 1 + problem.equalities]), axis=1, initial=0.0)
        good = point.exists() & (off < FEASIBLE)
        kept.append(point.take(np.flatnonzero(good)))
        others.append(before.take(np.flatnonzero(~good)))
    found, rest = _joined(kept), _joined(others)
    return Starts(
        None if found is None else found.take(np.arange(len(found.z))[:starts]),
        drawn,
        existing,
        None if rest is None else rest.take(np.arange(len(rest.z))[:starts]),
    )


def _onto_held(problem: Problem, point: Point) -> Point:
    m = problem.equalities
    for _step in range(6):
        finite = point.exists()
        slopes = np.where(finite[:, None, None], point.slopes, 0.0)[:, 1 : 1 + m]
        values = np.where(finite[:, None], point.values, 0.0)[:, 1 : 1 + m]
        wanted = -least_norm(slopes, values)
        stopped = ((point.z <= 0.0) & (wanted < 0.0)) | ((point.z >= 1.0) & (wanted > 0.0))
        z = np.clip(point.z - least_norm(slopes * np.where(stopped, 0.0, 1.0)[:, None, :], values), 0.0, 1.0)
        point = evaluate(problem, z, point.ahead(z))
    return point


def _joined(points: list[Point]) -> Point | None:
    points = [p for p in points if len(p.z)]
    if not points:
        return None
    first, *more = points
    return first._replace(
        z=np.concatenate([first.z, *(p.z for p in more)]),
        values=np.concatenate([first.values, *(p.values for p in more)]),
        slopes=np.concatenate([first.slopes, *(p.slopes for p in more)]),
        known=tuple(np.concatenate(each) for each in zip(first.known, *(p.known for p in more), strict=True)),
        reach=tuple(np.concatenate(each) for each in zip(first.reach, *(p.reach for p in more), strict=True)),
    )


def polish(problem: Problem, point: Point, steps: int, tell: Callable[[float, Point], None]) -> Polished:
    """Sequential quadratic programming with a box about each design that it trusts (S l1 QP: Fletcher, Practical Methods of
    Optimization, 14.4), from every start at once.

    Second derivatives of the Lagrangian are central differences of exact first ones. Breaking what is held or a demand costs so
    much of the objective; where it does not vanish at any price, the demands contradict each other.
    """
    m = problem.equalities
    size = np.maximum(np.abs(point.values[:, 0]), 1e-300)
    price, reach = np.full(len(point.z), 10.0), np.full(len(point.z), 0.2)
    point = restored(problem, point, 2)
    seen = np.zeros((len(point.z), 1 + m + len(problem.demands)))
    seen[:, 0] = 1.0
    seen[:, 1:] = _first_guess(problem, point) / size[:, None]
    still = point.exists()
    left = np.full(len(point.z), np.inf)
    history = [point.values[:, 0]]
    for k in range(steps + 1):
        index = np.flatnonzero(still)
        if len(index):
            here = point.take(index)
            bend = _curvature(problem, here, seen[index], size[index])
            model = _model(problem, here, bend, size[index], price[index], reach[index])
            left[index] = _fall(problem, here, bend, model, size[index])
            dual = np.concatenate([model.held, model.demands], axis=1)
            # A price below the multipliers lets a constraint be broken that could be kept.
            short = np.max(np.abs(dual), axis=1, initial=0.0) > 0.9 * price[index]
            price[index] = np.where(short, np.minimum(10.0 * price[index], _DEAREST), price[index])
            if k == steps:
                break
            new = _tried(problem, here, model)
            old_merit, new_merit = (_merit(problem, p, size[index], price[index]) for p in (here, new))
            kept = violation(problem, new) < np.maximum(FEASIBLE, violation(problem, here))
            better = (new_merit < old_merit) | (kept & (violation(problem, here) > FEASIBLE) & new.exists())
            point = point.put(index, new.where(better, here))
            step = np.max(np.abs(model.p), axis=1)
            reach[index] = np.where(better, np.where(step > 0.9 * reach[index], 2.0 * reach[index], reach[index]), 0.25 * step)
            reach = np.clip(reach, 1e-9, 0.5)
            seen[index, 1:] = np.clip(dual, -1e6, 1e6)
            at_rest = (left[index] < 1e-13) & (violation(problem, here) < 1e-10) & ~short
            still[index] = ~(at_rest | (~better & (reach[index] <= 1e-9)))
        history.append(point.values[:, 0])
        tell((k + 1) / max(steps, 1), point)
    return Polished(point, np.asarray(history), left, violation(problem, point), optimality(problem, point))


def _first_guess(problem: Problem, point: Point) -> np.ndarray:
    found = optimality(problem, point)
    return np.nan_to_num(np.concatenate([found.held, found.demands], axis=1))


def _curvature(problem: Problem, point: Point, weights: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Second derivatives (s, d, d) of the Lagrangian over the objective's size, not indefinite; only along what constraints
    that count leave free: across them the linear constraints decide."""
    d, m = point.z.shape[1], problem.equalities
    weights = weights.copy()
    weights[:, 0] = 1.0 / size
    bend = np.empty((len(point.z), d, d))
    for i in range(d):
        sides = [point.z + sign * _WIDTH * np.eye(d)[i] for sign in (1.0, -1.0)]
        high, low = (evaluate(problem, z, point.ahead(z)) for z in sides)
        bend[:, i] = np.einsum("sm,smd->sd", weights, high.slopes - low.slopes) / (2.0 * _WIDTH)
    usable = np.all(np.isfinite(bend), axis=(1, 2), keepdims=True)
    bend = np.where(usable, bend, np.eye(d))
    counts = np.ones(weights.shape[1] - 1, bool)[None, :] & np.ones((len(weights), 1), bool)
    counts[:, m:] = weights[:, 1 + m :] > 1e-12
    free = 1.0 - (((point.z <= 0.0) | (point.z >= 1.0)) * 1.0)
    rows = np.where(np.isfinite(point.slopes), point.slopes, 0.0)[:, 1:] * counts[:, :, None] * free[:, None, :]
    projector = np.eye(d) * np.ones((len(rows), 1, 1))
    if rows.shape[1]:
        projector = projector - np.stack([least_norm(rows, rows[:, :, i]) for i in range(d)], axis=2)
    inner = projector @ (bend + _transposed(bend)) / 2.0 @ _transposed(projector)
    values, vectors = np.linalg.eigh((inner + _transposed(inner)) / 2.0)
    top = np.maximum(np.max(np.abs(values), axis=1, keepdims=True), 1e-12)
    values = np.maximum(np.abs(values), 1e-10 * top)
    return np.einsum("sij,sj,skj->sik", vectors, values, vectors)


def _model(problem: Problem, point: Point, bend: np.ndarray, size: np.ndarray, price: np.ndarray, reach: np.ndarray) -> Solved:
    m = problem.equalities
    box = np.maximum(-point.z, -reach[:, None]), np.minimum(1.0 - point.z, reach[:, None])
    held = point.slopes[:, 1 : 1 + m], point.values[:, 1 : 1 + m]
    demands = point.slopes[:, 1 + m :], point.values[:, 1 + m :]
    return elastic(bend, point.slopes[:, 0] / size[:, None], held, demands, box, price)


def _fall(problem: Problem, point: Point, bend: np.ndarray, model: Solved, size: np.ndarray) -> np.ndarray:
    """By how much the objective may fall yet, as the model has it, in parts of its value."""
    along = np.einsum("sd,sd->s", point.slopes[:, 0], model.p)
    dual = np.concatenate([model.held, model.demands], axis=1) * size[:, None]
    paid = np.einsum("sm,smd,sd->s", dual, point.slopes[:, 1:], model.p)
    curved = np.einsum("si,sij,sj->s", model.p, bend, model.p) * size
    return np.abs(along + paid + 0.5 * curved) / np.maximum(np.abs(point.values[:, 0]), 1e-300)


def _tried(problem: Problem, point: Point, model: Solved) -> Point:
    z = np.clip(point.z + model.p, 0.0, 1.0)
    new = evaluate(problem, z, point.ahead(z))
    active = model.demands > 1e-6
    mended = restored(problem, new, 2, active)
    whole = mended.exists() & (violation(problem, mended) <= violation(problem, new))
    return mended.where(whole, new)


def _merit(problem: Problem, point: Point, size: np.ndarray, price: np.ndarray) -> np.ndarray:
    m = problem.equalities
    broken = np.sum(np.abs(point.values[:, 1 : 1 + m]), axis=1) + np.sum(np.maximum(point.values[:, 1 + m :], 0.0), axis=1)
    broken = np.where(broken < 1e-12, 0.0, broken)
    return np.where(point.exists(), point.values[:, 0] / size + price * broken, np.inf)


def optimality(problem: Problem, point: Point) -> Optimality:
    """Multipliers by least squares from the constraints that are active, and how well they balance the objective's slope."""
    m, mi = problem.equalities, len(problem.demands)
    s = len(point.z)
    slopes = np.where(np.isfinite(point.slopes), point.slopes, 0.0)
    rows, slope = slopes[:, 1:], slopes[:, 0]
    counts = np.ones((s, m + mi), bool)
    counts[:, m:] = point.values[:, 1 + m :] > -_ACTIVE
    at_low, at_high = point.z <= _ACTIVE, point.z >= 1.0 - _ACTIVE
    fixed = np.asarray(problem.space.low == problem.space.high)[None, :] & np.ones((s, 1), bool)
    free = ~(at_low | at_high | fixed)
    dual = np.zeros((s, m + mi))
    rest = slope
    for _ in range(3 + mi):
        part = rows * counts[:, :, None] * free[:, None, :]
        gram = part @ _transposed(part)
        ridge = np.finfo(float).eps * (1e-300 + np.trace(gram, axis1=1, axis2=2)) + 1e-300
        right = -np.einsum("smd,sd->sm", part, slope * free)
        dual = np.linalg.solve(gram + ridge[:, None, None] * np.eye(m + mi), right[..., None])[..., 0] * counts
        rest = slope + np.einsum("sm,smd->sd", dual, rows)
        pushed = counts.copy()
        pushed[:, m:] &= dual[:, m:] >= 0.0
        inward = (at_low & (rest < 0.0)) | (at_high & (rest > 0.0))
        if np.array_equal(pushed, counts) and not np.any(inward & ~free & ~fixed):
            break
        counts, free = pushed, free | (inward & ~fixed)
    bounds = np.where(free | fixed, 0.0, -rest)
    size = np.maximum(np.abs(slope).max(axis=1), np.abs(point.values[:, 0]))
    residual = np.max(np.abs(np.where(fixed, 0.0, rest + bounds)), axis=1) / np.maximum(size, 1e-300)
    kkt = np.maximum(residual, violation(problem, point))
    return Optimality(dual[:, :m], dual[:, m:], bounds, kkt)
