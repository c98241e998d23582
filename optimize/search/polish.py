"""Sequential quadratic programming from many designs at once, and the optimality of the results.

The objective may be the maximum of several smooth pieces, for example of the peaks of a force. At a kink the largest pieces are
equal. The shares of the pieces are their multipliers, with the sum 1.

Sizes of arrays: s designs, d free parameters, me held quantities (equalities; `m` in the code), mi demands (inequalities); in
`_least_change`, m values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from optimize.search.model import (
    Step,
    at_kink,
    curvatures,
    kink_residuals,
    least_norm,
    predicted_decrease,
    second_derivatives,
    solve_model,
    transposed,
)
from optimize.search.problem import Point, Problem, evaluate

FEASIBILITY_TOLERANCE = 1e-8
"""Violation below which a search treats held quantities and demands as met, relative to held values and limits."""

MAX_VIOLATION = 10.0 * FEASIBILITY_TOLERANCE
"""Violation up to which a final design counts as feasible."""

_UNREACHABLE_DECREASE = 1e-10
"""Predicted relative decrease of the objective that counts as zero if no step achieves it. Rounding errors of the derivatives
of exact motions have this size."""

_HIDDEN_DECREASE, _ROUNDING = 1e-13, 1e-15
"""Predicted relative decrease of the objective below which rounding errors can hide the decrease, and the relative increase
that counts as rounding."""

_KINK_STEPS = 4
"""Number of first-order steps that move a design back onto a kink."""

ACTIVE_DISTANCE = 1e-6
"""Largest distance at which a limit counts as active: of a demand from its limit, relative to the limit, or of a free parameter
from a bound, relative to the range between its bounds."""

_MAX_PENALTY = 1e9
"""Largest penalty of a violated constraint, in units of the objective. A constraint that is still violated at this penalty
contradicts the others."""


class Optimality(NamedTuple):
    """Optimality of designs.

    **Attributes** (s designs, me held quantities, mi demands, d free parameters)

    - `held` (s, me) and `demands` (s, mi): Lagrange multipliers, in units of the objective per unit of relative violation
    - `bounds` (s, d): multipliers of the bounds, positive at the upper bound
    - `kkt` (s,): relative residual of the Karush-Kuhn-Tucker conditions
    """

    held: np.ndarray
    demands: np.ndarray
    bounds: np.ndarray
    kkt: np.ndarray


class Polished(NamedTuple):
    """Results of searches.

    **Attributes**: the final `point`; `history` (steps, starts, 2) of the objective and the largest violation;
    `remaining_decrease` of the objective that the model still predicts, relative; the largest `violation`; the `optimality`.
    """

    point: Point
    history: np.ndarray
    remaining_decrease: np.ndarray
    violation: np.ndarray
    optimality: Optimality


def violation(problem: Problem, point: Point) -> np.ndarray:
    """Return the largest relative violation (s,) of held quantities and demands; infinite for designs whose quantities do not
    exist."""
    return np.where(point.exists(), np.max(problem.violations(point.values), axis=1, initial=0.0), np.inf)


def progress_at(problem: Problem, point: Point) -> np.ndarray:
    """Return an entry of a history: the objective and the largest violation (s, 2) of designs."""
    return np.stack([point.values[:, 0], violation(problem, point)], axis=1)


def restore(
    problem: Problem, point: Point, steps: int, demanded: np.ndarray | None = None, shares: np.ndarray | None = None
) -> Point:
    """Change designs as little as possible, to first order, so that they meet their constraints within the bounds.

    The constraints are the held quantities, and the demands that are violated or marked in `demanded` (designs, demands). If
    `shares` (designs, pieces) are given, the pieces of the objective with a share must be equal, too.
    """
    m, mi = problem.equalities, len(problem.demands)
    if m + mi == 0 and shares is None:
        return point
    for _ in range(steps):
        finite = point.exists()
        slopes = np.where(finite[:, None, None], point.slopes, 0.0)[:, 1:]
        values = np.where(finite[:, None], point.values, 0.0)[:, 1:]
        is_used = np.ones(values.shape, bool)
        is_used[:, m:] = values[:, m:] > 0.0
        if demanded is not None:
            is_used[:, m:] |= demanded
        slopes, values = slopes * is_used[:, :, None], values * is_used
        if shares is not None:
            gap, piece_gradients = kink_residuals(point, shares, np.maximum(np.abs(point.values[:, 0]), 1e-300))
            slopes, values = np.concatenate([slopes, piece_gradients], axis=1), np.concatenate([values, gap], axis=1)
        z = _least_change(point.z, slopes, values, max_change=0.3)
        point = evaluate(problem, z, point.extrapolate_speeds(z))
    return point


def _least_change(z: np.ndarray, slopes: np.ndarray, values: np.ndarray, max_change: float = np.inf) -> np.ndarray:
    """Return the nearest designs to z (s, d) at which the linearized `values` (s, m) vanish.

    The bounds and `max_change` then limit the change. If they reduce it, the values do not vanish.

    **Arguments**: `slopes` (s, m, d): derivatives of the values; `max_change`: largest change of each entry of z.
    """
    unlimited = -least_norm(slopes, values)
    stopped = ((z <= 0.0) & (unlimited < 0.0)) | ((z >= 1.0) & (unlimited > 0.0))
    step = -least_norm(slopes * np.where(stopped, 0.0, 1.0)[:, None, :], values)
    return np.clip(z + np.clip(step, -max_change, max_change), 0.0, 1.0)


class Starts(NamedTuple):
    """Initial designs.

    **Attributes**

    - `point`: all initial designs, or None
    - `drawn`: number of random designs; `existing`: number of those for which the objective exists
    - `off_held`: random designs that cannot be changed so that the held quantities have their values, in their state before
      this change; at most the requested number of starts, or None
    """

    point: Point | None
    drawn: int
    existing: int
    off_held: Point | None


def draw_starts(
    problem: Problem,
    starts: int,
    seed: int,
    speeds_of: Callable[[Problem, np.ndarray], tuple[np.ndarray, ...]],
    rounds: int = 20,
) -> Starts:
    """Draw random designs within the bounds, and change them until the held quantities have their values.

    Further designs are drawn in place of those that are not usable: the objective does not exist, or the held values are not
    reached in six steps. The search for usable designs ends after `rounds` times `starts` designs. `speeds_of` returns
    the load speeds near which the jams and folds in the quantities are searched for, see `find_speeds`.
    """
    random = np.random.default_rng(seed)
    on_held: list[Point] = []
    off_held: list[Point] = []
    drawn = existing = 0
    while sum(len(p.z) for p in on_held) < starts and drawn < rounds * starts:
        z = random.uniform(size=(starts, problem.space.size))
        point = evaluate(problem, z, speeds_of(problem, z))
        drawn += starts
        point = point.take(np.flatnonzero(point.exists()))
        existing += len(point.z)
        if not len(point.z):
            continue
        before = point
        if problem.equalities:
            point = _onto_held(problem, point)
        off = np.max(np.abs(point.values[:, 1 : 1 + problem.equalities]), axis=1, initial=0.0)
        good = point.exists() & (off < FEASIBILITY_TOLERANCE)
        on_held.append(point.take(np.flatnonzero(good)))
        off_held.append(before.take(np.flatnonzero(~good)))
    return Starts(_first_of(on_held, starts), drawn, existing, _first_of(off_held, starts))


def _onto_held(problem: Problem, point: Point) -> Point:
    m = problem.equalities
    for _step in range(6):
        finite = point.exists()
        slopes = np.where(finite[:, None, None], point.slopes, 0.0)[:, 1 : 1 + m]
        values = np.where(finite[:, None], point.values, 0.0)[:, 1 : 1 + m]
        z = _least_change(point.z, slopes, values)
        point = evaluate(problem, z, point.extrapolate_speeds(z))
    return point


def _first_of(points: list[Point], count: int) -> Point | None:
    """Return the first `count` designs of all points; None if there is no design."""
    points = [p for p in points if len(p.z)]
    return jax.tree.map(lambda *each: np.concatenate(each)[:count], *points) if points else None


def polish(problem: Problem, point: Point, steps: int, report: Callable[[float, Point], None]) -> Polished:
    """Minimize by sequential quadratic programming with a trust region (S l1 QP: Fletcher, Practical Methods of Optimization,
    14.4), from all starts at once.

    Second derivatives of the Lagrangian are central differences of exact first ones. Violated constraints are penalized; if a
    violation does not vanish at the largest penalty, the constraints contradict each other.
    """
    searches = _begin(problem, point)
    history = [progress_at(problem, searches.point)]
    for k in range(steps + 1):
        index = np.flatnonzero(searches.active)
        if len(index):
            here = searches.point.take(index)
            models, penalty_is_small = _build_models(problem, searches, index, here)
            if k == steps:
                break
            _move(problem, searches, index, here, models, penalty_is_small)
        history.append(progress_at(problem, searches.point))
        report(min(k + 1, steps) / max(steps, 1), searches.point)
    point = searches.point
    return Polished(
        point, np.asarray(history), searches.remaining_decrease, violation(problem, point), optimality(problem, point)
    )


@dataclasses.dataclass
class _Searches:
    """State of the searches from all starts; arrays have a leading axis over the s starts.

    **Attributes**

    - `point`: the best designs so far; `size` of the objective, by which it is scaled
    - `penalty` of violated constraints, and `trust_radius`: the largest change of a free parameter, relative to its range
    - `multipliers` of the constraints and `shares` of the pieces of the objective, from the last models
    - `second`: second derivatives; they are computed anew for designs that have `changed`
    - `active`: True until a search ends
    - `remaining_decrease` of the objective that the model predicts, relative
    """

    point: Point
    size: np.ndarray
    penalty: np.ndarray
    trust_radius: np.ndarray
    multipliers: np.ndarray
    shares: np.ndarray
    second: np.ndarray
    active: np.ndarray
    changed: np.ndarray
    remaining_decrease: np.ndarray


def _begin(problem: Problem, point: Point) -> _Searches:
    """Return the searches at their starts, which are first changed to meet the constraints."""
    if problem.parts > 1:  # `descend`, which may precede this search, does not compute the pieces of the objective
        point = evaluate(problem, point.z, point.speeds)
    size = np.maximum(np.abs(point.values[:, 0]), 1e-9 * np.max(np.abs(point.slopes[:, 0]), axis=1))
    size = np.where(size > 0.0, size, 1.0)
    point = restore(problem, point, 2)
    starts, free = point.z.shape
    start_optimality = optimality(problem, point)
    multipliers = np.nan_to_num(np.concatenate([start_optimality.held, start_optimality.demands], axis=1)) / size[:, None]
    shares = np.zeros((starts, problem.parts))
    shares[np.arange(starts), np.argmax(point.pieces, axis=1) if problem.parts > 1 else 0] = 1.0
    active = point.exists()
    return _Searches(
        point,
        size,
        np.full(starts, 10.0),
        np.full(starts, 0.2),
        multipliers,
        shares,
        np.zeros((starts, free, multipliers.shape[1] + problem.parts + 1, free)),
        active,
        active.copy(),
        np.full(starts, np.inf),
    )


def _build_models(problem: Problem, searches: _Searches, index: np.ndarray, here: Point) -> tuple[list[Step], np.ndarray]:
    """Return the proposed steps of the searches `index` from `here`, and True for searches whose penalty was too small.

    The list of steps has one entry for each set of second derivatives that `curvatures` returns (one or two). Each entry
    contains the steps of all these searches.

    Updates the second derivatives, the penalties and the remaining decreases.
    """
    size = searches.size[index]
    if np.any(searches.changed):
        searches.second[searches.changed] = second_derivatives(problem, searches.point.take(np.flatnonzero(searches.changed)))
    hessians = curvatures(problem, here, searches.second[index], searches.multipliers[index], searches.shares[index], size)
    penalty, radius = searches.penalty[index], searches.trust_radius[index]
    models = [solve_model(problem, here, hessian, size, penalty, radius) for hessian in hessians]
    decreases = [predicted_decrease(problem, here, b, m, size) for b, m in zip(hessians, models, strict=True)]
    searches.remaining_decrease[index] = np.minimum(decreases[0], decreases[-1])
    # A constraint whose penalty is below its multiplier stays violated although it could be met.
    penalty_is_small = np.max(np.abs(_dual(models[0])), axis=1, initial=0.0) > 0.9 * penalty
    searches.penalty[index] = np.where(penalty_is_small, np.minimum(10.0 * penalty, _MAX_PENALTY), penalty)
    return models, penalty_is_small


def _dual(model: Step) -> np.ndarray:
    """Return the multipliers of all constraints of a model."""
    return np.concatenate([model.held, model.demands], axis=1)


def _move(
    problem: Problem, searches: _Searches, index: np.ndarray, here: Point, models: list[Step], penalty_is_small: np.ndarray
) -> None:
    """Move each design by the better of the steps if this step improves it, adapt the trust regions, and end the searches that
    make no further progress."""
    size, penalty, radius = searches.size[index], searches.penalty[index], searches.trust_radius[index]
    remaining_decrease = searches.remaining_decrease[index]
    trials = [_trial_point(problem, here, model, size, penalty) for model in models]
    merits = [_merit(problem, trial, size, penalty) for trial in trials]
    first = merits[0] <= merits[-1]
    new, new_merit = trials[0].where(first, trials[-1]), np.minimum(merits[0], merits[-1])
    merit = _merit(problem, here, size, penalty)
    better = _is_better(problem, here, new, merit, new_merit, remaining_decrease)
    searches.point = searches.point.put(index, new.where(better, here))
    step = np.max(np.abs(np.where(first[:, None], models[0].p, models[-1].p)), axis=1)
    radius = np.clip(np.where(better, np.where(step > 0.9 * radius, 2.0 * radius, radius), 0.25 * step), 1e-9, 0.5)
    searches.trust_radius[index] = radius
    searches.multipliers[index] = np.clip(_dual(models[0]), -1e6, 1e6)
    searches.shares[index] = models[0].shares
    is_met, is_stuck = violation(problem, here) < 1e-10, ~better & (remaining_decrease < _UNREACHABLE_DECREASE)
    is_finished = is_met & ~penalty_is_small & ((remaining_decrease < _HIDDEN_DECREASE) | is_stuck)
    searches.active[index] = ~(is_finished | (~better & (radius <= 1e-9)))
    searches.changed = np.zeros_like(searches.active)
    searches.changed[index] = better & searches.active[index]


def _is_better(
    problem: Problem, here: Point, new: Point, merit: np.ndarray, new_merit: np.ndarray, remaining_decrease: np.ndarray
) -> np.ndarray:
    """Return True for designs whose step is accepted; `remaining_decrease` is the decrease of the objective that their models
    predict."""
    is_feasible = violation(problem, new) < np.maximum(FEASIBILITY_TOLERANCE, violation(problem, here))
    is_better = new_merit < merit
    # The last step converges quadratically: the decrease of the objective is below its rounding error, but derivatives are
    # exact.
    is_better |= is_feasible & (remaining_decrease < _HIDDEN_DECREASE) & (new_merit <= merit + _ROUNDING * np.abs(merit))
    is_better |= is_feasible & (violation(problem, here) > FEASIBILITY_TOLERANCE) & new.exists()
    return is_better


def _trial_point(problem: Problem, point: Point, model: Step, size: np.ndarray, penalty: np.ndarray) -> Point:
    """Return the designs after a step, or the nearest designs to them on the active constraints and kinks if these are
    better."""
    z = np.clip(point.z + model.p, 0.0, 1.0)
    new = evaluate(problem, z, point.extrapolate_speeds(z))
    active = model.demands > 1e-6
    restored = restore(problem, new, 2, active)
    as_feasible = restored.exists() & (violation(problem, restored) <= violation(problem, new))
    best = restored.where(as_feasible, new)
    if problem.parts > 1:
        on_kink = restore(problem, best, _KINK_STEPS, active, model.shares)
        best = on_kink.where(_merit(problem, on_kink, size, penalty) < _merit(problem, best, size, penalty), best)
    return best


def _merit(problem: Problem, point: Point, size: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    total_violation = np.sum(problem.violations(point.values), axis=1)
    total_violation = np.where(total_violation < 1e-12, 0.0, total_violation)
    return np.where(point.exists(), point.values[:, 0] / size + penalty * total_violation, np.inf)


def optimality(problem: Problem, point: Point) -> Optimality:
    """Return the optimality of designs, with multipliers by least squares over the active constraints."""
    m, mi = problem.equalities, len(problem.demands)
    s = len(point.z)
    slopes = np.where(np.isfinite(point.slopes), point.slopes, 0.0)
    rows, slope = slopes[:, 1:], slopes[:, 0]
    is_active = np.ones((s, m + mi), bool)
    is_active[:, m:] = point.values[:, 1 + m :] > -ACTIVE_DISTANCE
    if problem.parts > 1:
        slope, piece_gradients, meets = at_kink(point, ACTIVE_DISTANCE)
        rows, is_active = np.concatenate([rows, piece_gradients], axis=1), np.concatenate([is_active, meets], axis=1)
    at_low, at_high = point.z <= ACTIVE_DISTANCE, point.z >= 1.0 - ACTIVE_DISTANCE
    fixed = np.asarray(problem.space.low == problem.space.high)[None, :] & np.ones((s, 1), bool)
    free = ~(at_low | at_high | fixed)
    dual = np.zeros(is_active.shape)
    rest = slope
    for _ in range(3 + is_active.shape[1] - m):
        part = rows * is_active[:, :, None] * free[:, None, :]
        gram = part @ transposed(part)
        ridge = np.finfo(float).eps * (1e-300 + np.trace(gram, axis1=1, axis2=2)) + 1e-300
        right = -np.einsum("smd,sd->sm", part, slope * free)
        dual = np.linalg.solve(gram + ridge[:, None, None] * np.eye(is_active.shape[1]), right[..., None])[..., 0] * is_active
        rest = slope + np.einsum("sm,smd->sd", dual, rows)
        still_active = is_active.copy()
        still_active[:, m:] &= dual[:, m:] >= 0.0
        inward = (at_low & (rest < 0.0)) | (at_high & (rest > 0.0))
        if np.array_equal(still_active, is_active) and not np.any(inward & ~free & ~fixed):
            break
        is_active, free = still_active, free | (inward & ~fixed)
    bounds = np.where(free | fixed, 0.0, -rest)
    size = np.maximum(np.abs(slope).max(axis=1), np.abs(point.values[:, 0]))
    residual = np.max(np.abs(np.where(fixed, 0.0, rest + bounds)), axis=1) / np.maximum(size, 1e-300)
    kkt = np.maximum(residual, violation(problem, point))
    return Optimality(dual[:, :m], dual[:, m : m + mi], bounds, kkt)
