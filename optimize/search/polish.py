"""Sequential quadratic programming from many designs at once, and what is known of where it ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from optimize.search.model import Step, at_kink, curvatures, fall, least_norm, modelled, seconds, transposed, unlike
from optimize.search.problem import Point, Problem, evaluate

__all__ = ["FEASIBLE", "Polished", "Starts", "draw_starts", "optimality", "polish", "restored", "violation"]

FEASIBLE = 1e-8
"""Largest violation of held quantities and demands in the end, relative to their values."""

_AT_REST = 1e-10
"""A fall below this that no step brings is not to be had: derivatives of an exact motion have that rounding."""

_HIDDEN, _ROUNDING = 1e-13, 1e-15
"""A fall of less than this, relative, is hidden in the rounding of the objective."""

_EVEN = 4
"""Steps back onto a kink, each to first order."""

_ACTIVE = 1e-6
"""Largest distance from its limit, relative to it, at which a demand or a free number counts as being at it."""

_DEAREST = 1e9
"""The most that breaking a constraint may cost before it counts as contradictory, in parts of the objective."""


class Optimality(NamedTuple):
    """Optimality of designs: `multipliers` of what is held (s, me) and of demands (s, mi), in units of the objective per unit
    of the relative excess; of bounds (s, d), positive at the upper one; the `kkt` residual (s,), relative."""

    held: np.ndarray
    demands: np.ndarray
    bounds: np.ndarray
    kkt: np.ndarray


class Polished(NamedTuple):
    """Ends of searches: the `point`; the objective on the way, `history` (steps, starts); `left`, by how much it could still
    fall in relation to its value, as slopes and curvatures tell; the greatest `violation`; and its `Optimality`."""

    point: Point
    history: np.ndarray
    left: np.ndarray
    violation: np.ndarray
    optimality: Optimality


def violation(problem: Problem, point: Point) -> np.ndarray:
    """The greatest relative amount (s,) by which anything held is off or a demand exceeded; infinite where there is no
    value."""
    m = problem.equalities
    parts = np.concatenate([np.abs(point.values[:, 1 : 1 + m]), np.maximum(point.values[:, 1 + m :], 0.0)], axis=1)
    return np.where(point.exists(), np.max(parts, axis=1, initial=0.0), np.inf)


def restored(
    problem: Problem, point: Point, steps: int, demanded: np.ndarray | None = None, shares: np.ndarray | None = None
) -> Point:
    """The designs nearest to `point`, to first order, that keep what is held, and demands of which `demanded` (s, mi) is true
    or that are exceeded, inside the bounds; and at which the objective's pieces that have `shares` (s, parts) are alike."""
    m, mi = problem.equalities, len(problem.demands)
    if m + mi == 0 and shares is None:
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
        if shares is not None:
            apart, tilts = unlike(point, shares, np.maximum(np.abs(point.values[:, 0]), 1e-300))
            slopes, values = np.concatenate([slopes, tilts], axis=1), np.concatenate([values, apart], axis=1)
        z = _moved(point.z, slopes, values, most=0.3)
        point = evaluate(problem, z, point.ahead(z))
    return point


def _moved(z: np.ndarray, slopes: np.ndarray, values: np.ndarray, most: float = np.inf) -> np.ndarray:
    """The designs z (s, d) moved the shortest way to where `values` (s, m) with these `slopes` (s, m, d) would be 0, inside the
    bounds, no number by more than `most`."""
    wanted = -least_norm(slopes, values)
    stopped = ((z <= 0.0) & (wanted < 0.0)) | ((z >= 1.0) & (wanted > 0.0))
    step = -least_norm(slopes * np.where(stopped, 0.0, 1.0)[:, None, :], values)
    return np.clip(z + np.clip(step, -most, most), 0.0, 1.0)


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
        z = _moved(point.z, slopes, values)
        point = evaluate(problem, z, point.ahead(z))
    return point


def _joined(points: list[Point]) -> Point | None:
    points = [p for p in points if len(p.z)]
    if not points:
        return None
    return jax.tree.map(lambda *each: np.concatenate(each), *points)


def polish(problem: Problem, point: Point, steps: int, tell: Callable[[float, Point], None]) -> Polished:
    """Sequential quadratic programming with a box about each design that it trusts (S l1 QP: Fletcher, Practical Methods of
    Optimization, 14.4), from every start at once.

    Second derivatives of the Lagrangian are central differences of exact first ones. Breaking what is held or a demand costs so
    much of the objective; where it does not vanish at any price, the demands contradict each other.
    """
    if problem.parts > 1:  # the descent does not ask for them
        point = evaluate(problem, point.z, point.known)
    size = np.maximum(np.abs(point.values[:, 0]), 1e-9 * np.max(np.abs(point.slopes[:, 0]), axis=1))
    size = np.where(size > 0.0, size, 1.0)
    price, reach = np.full(len(point.z), 10.0), np.full(len(point.z), 0.2)
    point = restored(problem, point, 2)
    seen = _first_guess(problem, point) / size[:, None]
    shares = np.zeros((len(point.z), problem.parts))
    shares[np.arange(len(shares)), np.argmax(point.pieces, axis=1) if problem.parts > 1 else 0] = 1.0
    second = np.zeros((len(point.z), point.z.shape[1], seen.shape[1] + problem.parts + 1, point.z.shape[1]))
    still = point.exists()
    moved = still.copy()
    left = np.full(len(point.z), np.inf)
    history = [point.values[:, 0]]
    for k in range(steps + 1):
        index = np.flatnonzero(still)
        if len(index):
            here = point.take(index)
            if np.any(moved):
                second[moved] = seconds(problem, point.take(np.flatnonzero(moved)))
            bends = curvatures(problem, here, second[index], seen[index], shares[index], size[index])
            models = [modelled(problem, here, bend, size[index], price[index], reach[index]) for bend in bends]
            model = models[0]
            falls = [fall(problem, here, b, m, size[index]) for b, m in zip(bends, models, strict=True)]
            left[index] = np.minimum(falls[0], falls[-1])
            dual = np.concatenate([model.held, model.demands], axis=1)
            # A price below the multipliers lets a constraint be broken that could be kept.
            short = np.max(np.abs(dual), axis=1, initial=0.0) > 0.9 * price[index]
            price[index] = np.where(short, np.minimum(10.0 * price[index], _DEAREST), price[index])
            if k == steps:
                break
            tried = [_tried(problem, here, each, size[index], price[index]) for each in models]
            merits = [_merit(problem, each, size[index], price[index]) for each in tried]
            first = merits[0] <= merits[-1]
            new, new_merit = tried[0].where(first, tried[-1]), np.minimum(merits[0], merits[-1])
            kept = violation(problem, new) < np.maximum(FEASIBLE, violation(problem, here))
            merit = _merit(problem, here, size[index], price[index])
            better = new_merit < merit
            # The last step, quadratically convergent: rounding of the objective hides its fall, and slopes still show the way.
            better |= kept & (left[index] < _HIDDEN) & (new_merit <= merit + _ROUNDING * np.abs(merit))
            better |= kept & (violation(problem, here) > FEASIBLE) & new.exists()
            point = point.put(index, new.where(better, here))
            step = np.max(np.abs(np.where(first[:, None], models[0].p, models[-1].p)), axis=1)
            reach[index] = np.where(better, np.where(step > 0.9 * reach[index], 2.0 * reach[index], reach[index]), 0.25 * step)
            reach = np.clip(reach, 1e-9, 0.5)
            seen[index] = np.clip(dual, -1e6, 1e6)
            shares[index] = model.shares
            least = violation(problem, here) < 1e-10
            at_rest = least & ~short & ((left[index] < _HIDDEN) | (~better & (left[index] < _AT_REST)))
            still[index] = ~(at_rest | (~better & (reach[index] <= 1e-9)))
            moved = np.zeros_like(still)
            moved[index] = better & still[index]
        history.append(point.values[:, 0])
        tell(min(k + 1, steps) / max(steps, 1), point)
    return Polished(point, np.asarray(history), left, violation(problem, point), optimality(problem, point))


def _first_guess(problem: Problem, point: Point) -> np.ndarray:
    found = optimality(problem, point)
    return np.nan_to_num(np.concatenate([found.held, found.demands], axis=1))


def _tried(problem: Problem, point: Point, model: Step, size: np.ndarray, price: np.ndarray) -> Point:
    """Point to which the step leads, moved back onto the held quantities, demands and kinks that the model has it at; the best
    of these."""
    z = np.clip(point.z + model.p, 0.0, 1.0)
    new = evaluate(problem, z, point.ahead(z))
    active = model.demands > 1e-6
    mended = restored(problem, new, 2, active)
    whole = mended.exists() & (violation(problem, mended) <= violation(problem, new))
    best = mended.where(whole, new)
    if problem.parts > 1:
        even = restored(problem, best, _EVEN, active, model.shares)
        best = even.where(_merit(problem, even, size, price) < _merit(problem, best, size, price), best)
    return best


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
    if problem.parts > 1:
        slope, tilts, met = at_kink(point, _ACTIVE)
        rows, counts = np.concatenate([rows, tilts], axis=1), np.concatenate([counts, met], axis=1)
    at_low, at_high = point.z <= _ACTIVE, point.z >= 1.0 - _ACTIVE
    fixed = np.asarray(problem.space.low == problem.space.high)[None, :] & np.ones((s, 1), bool)
    free = ~(at_low | at_high | fixed)
    dual = np.zeros(counts.shape)
    rest = slope
    for _ in range(3 + counts.shape[1] - m):
        part = rows * counts[:, :, None] * free[:, None, :]
        gram = part @ transposed(part)
        ridge = np.finfo(float).eps * (1e-300 + np.trace(gram, axis1=1, axis2=2)) + 1e-300
        right = -np.einsum("smd,sd->sm", part, slope * free)
        dual = np.linalg.solve(gram + ridge[:, None, None] * np.eye(counts.shape[1]), right[..., None])[..., 0] * counts
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
    return Optimality(dual[:, :m], dual[:, m : m + mi], bounds, kkt)
