"""Sensitivities at the end of a search: active limits, influences of free parameters, quantities whose derivatives cannot be
trusted, distinct machines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxvib.display import shown_unit
from optimize.quantities.quantity import Demand, Quantity, walk
from optimize.result import Influence, Limit, Machine, Unresolved
from optimize.search.find import SearchResult
from optimize.search.polish import ACTIVE_DISTANCE, MAX_VIOLATION
from optimize.search.problem import Problem

_STEP = 0.01
"""Relative change for which effects on the objective are stated: of a free parameter (`Influence`), or of a limit (`Limit`)."""

_TINY_STEPS = np.array([-1e-6, -3e-7, 3e-7, 1e-6])
"""Relative changes of all free parameters by which a quantity of a run is tested. There are several, because the effect of a
single change on a chaotic motion may be small by chance."""

_MIN_TINY_SHARE, _MIN_TINY_CHANGE = 1e-2, 1e-4
"""Smallest change of a quantity by `_TINY_STEPS` that shows a meaningless derivative, as a share of the largest change by
`_STEP` (1e-4 for a linear quantity), and relative to the quantity. Errors of integration cause smaller changes."""

_EDGE = 2.0 * ACTIVE_DISTANCE
"""Distance from a bound, relative to the range, within which a free parameter counts as at its bound if the multiplier of the
bound is not 0."""


def limits_of(problem: Problem, demands: Sequence[Demand], result: SearchResult, sides: np.ndarray) -> tuple[Limit, ...]:
    """Return the limits of the best design: held quantities, demands and active bounds.

    **Arguments**: `sides` (number of demands, 2): the value of each demanded quantity, and its limit.
    """
    best, held_count = result.best, problem.equalities
    values, duals = result.point.values[best], result.optimality
    objective = abs(values[0]) if np.isfinite(values[0]) else np.nan
    space = problem.space.within(*result.bounds)
    rows: list[Limit] = []

    def gain(multiplier: float) -> float:
        return float(100.0 * _STEP * multiplier / max(objective, 1e-300))

    for held, deviation, dual in zip(space.held, values[1 : 1 + held_count], duals.held[best], strict=True):
        assert held.value is not None
        at = float(held.value)
        unit, factor = shown_unit(held.quantity.unit, abs(at))
        what = f"{held.quantity.words} held at {at * factor:.5g} {unit}".rstrip()
        size = abs(deviation)
        violation = 0.0 if size <= MAX_VIOLATION else size if np.isfinite(size) else np.inf
        value = float(at * (1.0 + deviation))
        multiplier = float(-dual * np.sign(at))
        rows.append(Limit(what, held.quantity.unit, value, at, float(violation), True, multiplier, gain(multiplier), held=True))
    for k, demand in enumerate(demands):
        excess, dual, scale = values[1 + held_count + k], duals.demands[best, k], float(problem.scales[k])
        violation = 0.0 if excess <= MAX_VIOLATION else excess if np.isfinite(excess) else np.inf
        active = bool(excess > -1e-6)
        multiplier = -dual * abs(sides[k, 1]) / scale if active else 0.0
        value, limit = float(sides[k, 0]), float(sides[k, 1])
        effect = (float(multiplier), gain(multiplier), demand.written_unit)
        rows.append(Limit(demand.words, demand.quantity.unit, value, limit, float(violation), active, *effect))
    numbers = space.numbers(result.point.z[best])
    low, high = (np.asarray(b) for b in (problem.space.low, problem.space.high))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(space.logs, numbers * np.log(high / low), high - low)
        position = np.where(space.logs, np.log(numbers / low) / np.log(high / low), (numbers - low) / (high - low))
    for k, (word, unit) in enumerate(problem.space.words_of_changes()):
        dual = duals.bounds[best, k]
        upper = position[k] > 0.5
        is_active = min(position[k], 1.0 - position[k]) <= _EDGE and dual != 0.0
        if low[k] == high[k] or slopes[k] == 0.0 or not is_active:
            continue
        shown, factor = shown_unit(unit, abs(numbers[k]))
        what = f"{word} {'at most' if upper else 'at least'} {numbers[k] * factor:.5g} {shown}"
        multiplier = -abs(dual * numbers[k]) / slopes[k]
        at = float(numbers[k])
        rows.append(Limit(what, unit, at, at, 0.0, True, float(multiplier), gain(multiplier)))
    return tuple(rows)


def neighbours(problem: Problem, result: SearchResult) -> np.ndarray:
    """Return the free parameters (5 + 2 d, d), SI, of the best design and of its neighbours.

    In each neighbour one free parameter is 1 % smaller or larger; in the last four all of them change by at most a
    millionth.
    """
    numbers = problem.space.within(*result.bounds).numbers(result.point.z[result.best])
    changes = np.diag(_STEP * numbers)
    return numbers + np.concatenate([np.zeros((1, len(numbers))), -changes, changes, _TINY_STEPS[:, None] * numbers])


def influences_of(problem: Problem, demands: Sequence[Demand], reports: np.ndarray) -> tuple[Influence, ...]:
    """Return the influence of each free parameter.

    **Arguments**: `reports` (5 + 2 d, 1 + 2 number of demands): the objective at the `neighbours`, and for each demand the
    value of its quantity and its limit.
    """
    d, values = problem.space.size, reports[:, 0]
    if not values[0]:
        return ()
    change = 100.0 * (values[1:] - values[0]) / abs(values[0])
    senses = np.array([1.0 if demand.sense == "at most" else -1.0 for demand in demands])
    violations = senses * (reports[:, 1::2] - reports[:, 2::2]) / np.asarray(problem.scales)

    def unmet(k: int) -> tuple[str, ...]:
        """Return the demands that the design meets and its neighbour `k` does not, in words."""
        is_lost = (violations[0] <= MAX_VIOLATION) & (violations[k] > MAX_VIOLATION)
        return tuple(demand.words for demand, lost in zip(demands, is_lost, strict=True) if lost)

    return tuple(
        Influence(word, float(change[k]), float(change[d + k]), unmet(1 + k), unmet(1 + d + k))
        for k, (word, _) in enumerate(problem.space.words_of_changes())
    )


def unresolved_of(quantities: Sequence[Quantity], values: np.ndarray) -> tuple[Unresolved, ...]:
    """Return the quantities of runs whose derivatives cannot be trusted, from the `values` (5 + 2 d, q) of the `neighbours`.

    Such a quantity changes by about as much if the free parameters change by a millionth as if they change by 1 %.
    """
    with np.errstate(invalid="ignore"):  # a quantity may be infinite
        changes = np.abs(values[1:] - values[0])
    parts = np.split(changes, [-_TINY_STEPS.size])
    large, tiny = (np.max(part, axis=0, initial=0.0, where=np.isfinite(part)) for part in parts)
    size = np.abs(values[0])
    is_unresolved = tiny > np.maximum(_MIN_TINY_SHARE * large, _MIN_TINY_CHANGE * size)
    return tuple(
        Unresolved(quantity.words, float(100.0 * tiny[k] / size[k]), float(100.0 * large[k] / size[k]))
        for k, quantity in enumerate(quantities)
        if is_unresolved[k] and size[k] > 0.0 and _may_contain_run(quantity)
    )


def _may_contain_run(quantity: Quantity) -> bool:
    """Return True if a run, or a function of the user, which may contain a run, is part of the quantity."""
    return any(type(part) is Quantity or part.forward_only for part in walk(quantity))


def machines_of(problem: Problem, result: SearchResult, same: float) -> tuple[Machine, ...]:
    """Return the distinct machines among the results of the searches, best first.

    **Arguments**: `same`: distance of two designs, relative to the ranges, below which they are the same machine.
    """
    values = result.feasible_values
    remaining = [int(k) for k in np.argsort(values) if np.isfinite(values[k])]
    z, numbers = result.designs(problem.space), problem.space.within(*result.bounds).numbers(result.point.z)
    machines: list[Machine] = []
    while remaining:
        first = remaining[0]
        near = [k for k in remaining if np.max(np.abs(z[k] - z[first])) < same]
        machines.append(Machine(len(near), float(values[first]), tuple(map(float, numbers[first]))))
        remaining = [k for k in remaining if k not in set(near)]
    return tuple(machines)
