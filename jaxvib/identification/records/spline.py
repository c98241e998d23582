"""Smoothing splines of degree 5 for the angle of a rotor, or for its speed.

The knots are evenly spaced, and their number minimizes the Bayesian information criterion. The second derivative of the angle,
on which the force of an unbalance depends, is smooth, except at jumps, such as the end of a ramp. Near a jump a smooth spline
would either deviate by several times its stated error, or have so many knots that intervals at low speed contain no pulse.
Therefore a jump is added if it reduces the criterion. Its knot has the multiplicity 5, which allows a change of the slope of
the angle too: an error of the time of the jump causes such a change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

DEGREE = 5
"""Degree of the splines."""

_MAX_INTERVALS = 512
"""Largest number of intervals of a spline."""

_ROUNDING = 1e-13
"""Relative accuracy of the values: smaller residuals are rounding errors."""

_MIN_VALUES = 2
"""Smallest number of values in an interval: without values the spline is not determined there."""

_MAX_JUMPS = 8
"""Largest number of jumps of the acceleration."""

_SEARCH_VALUES, _SEARCH_INTERVALS = 4096, (1, 8, 64)
"""Largest number of values in the search of a jump, and numbers of intervals of the splines to which a jump is added: a jump
between wavy parts is visible with many intervals only, and a weak jump with few intervals only."""

_MIN_PLACES, _MAX_PLACES = 100, 400
"""Smallest and largest number of times at which a jump is tried; within these limits the number is twice that of the
intervals."""

_VALUES_BETWEEN_JUMPS = 12
"""Smallest number of values between two jumps, and between a jump and an end of the record."""

_FINER_SEARCHES, _FINER_PLACES = 6, 9
"""Number of searches that refine the time of a jump, and number of times at which each of them tries it."""


def fit_spline(
    time: np.ndarray,
    value: np.ndarray,
    marks: np.ndarray | None = None,
    rates: np.ndarray | None = None,
    jump_order: int | None = None,
) -> tuple[Any, float]:
    """Return a smoothing spline of degree 5 with 1 + m columns (the values and their m errors), and the scatter.

    The scatter is the standard deviation of the values about the spline; with `rates` it is the standard deviation of the
    times, s. The errors are the principal components of the covariance of the curve at evenly spaced times, the largest first.

    **Arguments**

    - `time` (n,) s, ascending, and `value` (n,)
    - `marks` (n,): for pulses of a tachometer, index of the mark on the rotor that causes the value; each mark has an unknown
      offset, 0 on average
    - `rates` (n,): time derivatives of the values, for values whose errors are errors of their times. A common delay of all
      times is then included in the covariance
    - `jump_order`: order of the derivative that may jump; None for a smooth curve

    >>> t = np.linspace(0.0, 2.0, 200)
    >>> spline, _ = fit_spline(t, 30.0 * t**2 + 1e-3 * np.random.default_rng(0).normal(size=t.size))
    >>> bool(abs(spline(1.0, 2)[0] - 60.0) < 0.1), bool(5e-5 < np.linalg.norm(spline(1.0)[1:]) < 5e-4)
    (True, True)
    """
    from scipy.interpolate import BSpline  # slow to import

    data = _data(time, value, np.zeros(time.size, int) if marks is None else marks, rates)
    best = _best_fit(data, (), _MAX_INTERVALS)
    if jump_order is not None:
        best = _with_jumps(data, best, jump_order)
    covariance, scatter = best.covariance(), math.sqrt(best.variance) / (1.0 if rates is None else float(np.mean(rates)))
    if rates is not None:
        delay_column = scatter * _derivative(best)
        covariance += np.outer(delay_column, delay_column)
    sizes, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    grid = BSpline.design_matrix(np.linspace(time[0], time[-1], 4 * len(best.coefficients)), best.knots, DEGREE)
    errors = root @ np.linalg.svd(grid @ root, full_matrices=False)[2].T
    return BSpline(best.knots, np.concatenate([best.coefficients[:, None], errors], axis=1), DEGREE), scatter


def fit_curve(time: np.ndarray, value: np.ndarray) -> Any:
    """Return a smoothing spline of degree 5 with one column, the values (n,) at ascending times (n,), s, without their errors.
    The errors of a spline of many knots take most of the time of `fit_spline`."""
    from scipy.interpolate import BSpline  # slow to import

    best = _best_fit(_data(time, value, np.zeros(time.size, int), None), (), _MAX_INTERVALS)
    return BSpline(best.knots, best.coefficients[:, None], DEGREE)


class _Data(NamedTuple):
    """Values of a fit: `time` (n,), `weights` (n,), weighted values `value` (n,), and `marks` (n,).

    `columns` (n, o): sparse matrix of the derivatives of the weighted values with respect to the offsets of all marks but the
    first, whose offset is minus their sum; `gram` (o, o): its normal equations.
    """

    time: np.ndarray
    value: np.ndarray
    weights: np.ndarray
    marks: np.ndarray
    columns: Any
    gram: np.ndarray

    def thinned(self, step: int) -> _Data:
        """Return the data with only those values whose index is a multiple of `step`."""
        part = slice(None, None, step)
        marks = np.unique(self.marks[part], return_inverse=True)[1]
        columns, gram = _mark_offsets(marks, self.weights[part])
        return _Data(self.time[part], self.value[part], self.weights[part], marks, columns, gram)


def _data(time: np.ndarray, value: np.ndarray, marks: np.ndarray, rates: np.ndarray | None) -> _Data:
    weights = np.ones(time.size) if rates is None else np.mean(rates) / rates
    return _Data(time, value * weights, weights, marks, *_mark_offsets(marks, weights))


def _mark_offsets(marks: np.ndarray, weights: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return `columns` and `gram` of `_Data`."""
    from scipy.sparse import csr_matrix  # slow to import

    count, first, others = int(np.max(marks)), np.flatnonzero(marks == 0), np.flatnonzero(marks)
    rows = np.concatenate([others, np.repeat(first, count)])
    columns = np.concatenate([marks[others] - 1, np.tile(np.arange(count), first.size)])
    entries = np.concatenate([weights[others], -np.repeat(weights[first], count)])
    squares = np.bincount(marks, weights**2)
    return csr_matrix((entries, (rows, columns)), shape=(marks.size, count)), np.diag(squares[1:]) + squares[0]


class _KnotsFit(NamedTuple):
    """Fit of a spline with given `knots`.

    **Attributes**

    - the `data`; number of even `intervals`, and the `jumps` within them
    - `basis` (n, k): sparse matrix of the derivatives of the weighted values with respect to the coefficients
    - `band`: diagonals of the normal equations N of the coefficients
    - `offset_changes` (k, o): N^-1 B, where B (k, o) couples the coefficients with the o offsets
    - `offset_covariance` (o, o): inverse of the Schur complement of N, which is the covariance of the offsets divided by the
      variance
    - `coefficients` (k,) of the spline; `residuals` (n,), weighted
    """

    data: _Data
    intervals: int
    jumps: tuple[float, ...]
    knots: np.ndarray
    basis: Any
    band: np.ndarray
    offset_changes: np.ndarray
    offset_covariance: np.ndarray
    coefficients: np.ndarray
    residuals: np.ndarray

    @property
    def parameter_count(self) -> int:
        """Number of coefficients and offsets."""
        return len(self.coefficients) + len(self.data.gram)

    @property
    def criterion(self) -> float:
        """Bayesian information criterion."""
        n, accuracy = self.residuals.size, _ROUNDING * float(np.max(np.abs(self.data.value)))
        return n * math.log(
            max(float(self.residuals @ self.residuals) / n, accuracy**2, 1e-300)
        ) + self.parameter_count * math.log(n)

    @property
    def variance(self) -> float:
        """Variance of the weighted values."""
        return float(self.residuals @ self.residuals) / max(self.residuals.size - self.parameter_count, 1)

    def covariance(self) -> np.ndarray:
        """Return the covariance (k, k) of the coefficients."""
        from scipy.linalg import solveh_banded  # slow to import

        inverse_band = solveh_banded(self.band, np.eye(self.band.shape[1]), lower=True)
        return self.variance * (inverse_band + self.offset_changes @ self.offset_covariance @ self.offset_changes.T)

    def fitted(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients (k, m) of the spline that fits weighted values (n, m), and the residuals (n, m)."""
        from scipy.linalg import solveh_banded  # slow to import

        columns, coefficients, residuals = self.data.columns, 0.0, values
        for _ in range(2):  # the second solution corrects rounding errors of the first
            without_offsets = solveh_banded(self.band, self.basis.T @ residuals, lower=True)
            offsets = self.offset_covariance @ (columns.T @ (residuals - self.basis @ without_offsets))
            step = without_offsets - self.offset_changes @ offsets
            coefficients, residuals = coefficients + step, residuals - self.basis @ step - columns @ offsets
        return np.asarray(coefficients), residuals


def _fit_knots(data: _Data, intervals: int, jumps: Sequence[float] = ()) -> _KnotsFit:
    """Return the fit by a spline with even intervals and jumps."""
    from scipy.interpolate import BSpline  # slow to import
    from scipy.linalg import solveh_banded
    from scipy.sparse import diags

    breaks = _breaks(data.time, intervals, jumps)
    inner = np.repeat(breaks, np.where(np.isin(breaks, jumps), DEGREE, 1))
    knots = np.concatenate([[breaks[0]] * DEGREE, inner, [breaks[-1]] * DEGREE])
    basis: Any = diags(data.weights) @ BSpline.design_matrix(data.time, knots, DEGREE)
    gram = basis.T @ basis
    band = np.stack([np.pad(gram.diagonal(k), (0, k)) for k in range(DEGREE + 1)])
    band[0] += 1e-12 * np.mean(band[0])  # otherwise rounding errors may make the matrix indefinite
    coupling = (basis.T @ data.columns).toarray()
    offset_changes = solveh_banded(band, coupling, lower=True) if coupling.size else coupling
    offset_covariance = np.linalg.inv(data.gram - coupling.T @ offset_changes)
    none = np.zeros(0)
    fit = _KnotsFit(data, intervals, tuple(jumps), knots, basis, band, offset_changes, offset_covariance, none, none)
    coefficients, residuals = fit.fitted(data.value[:, None])
    return fit._replace(coefficients=coefficients[:, 0], residuals=residuals[:, 0])


def _breaks(time: np.ndarray, intervals: int, jumps: Sequence[float]) -> np.ndarray:
    """Return the ends of the intervals: even ones and jumps, without even ones that are close to a jump or leave an interval
    with fewer than two values."""
    even, width = np.linspace(time[0], time[-1], intervals + 1), (time[-1] - time[0]) / intervals
    fixed = [time[0], *jumps, time[-1]]
    is_apart = np.all([np.abs(even - each) > 0.5 * width for each in jumps], axis=0) if jumps else np.ones(even.size, bool)
    breaks = [time[0]]
    for each in np.sort(np.concatenate([even[1:-1][is_apart[1:-1]], fixed[1:]])):
        while each in fixed and breaks[-1] not in fixed and _value_count(time, breaks[-1], each) < _MIN_VALUES:
            breaks.pop()
        if each in fixed or _value_count(time, breaks[-1], each) >= _MIN_VALUES:
            breaks.append(each)
    return np.array(breaks)


def _value_count(time: np.ndarray, begin: float, end: float) -> int:
    return int(np.searchsorted(time, end) - np.searchsorted(time, begin))


def _best_fit(data: _Data, jumps: Sequence[float], max_intervals: int) -> _KnotsFit:
    """Return the fit with the smallest criterion, among fits with up to `max_intervals` intervals."""
    fits, intervals = [], 1
    while intervals <= min(max_intervals, data.time.size // 4):
        fits.append(_fit_knots(data, intervals, jumps))
        intervals = max(intervals + 1, int(1.4 * intervals))
    return min(fits, key=lambda each: each.criterion)


def _with_jumps(data: _Data, smooth: _KnotsFit, order: int) -> _KnotsFit:
    """Return the fit with those jumps of the derivative of an `order` that reduce the criterion.

    The jumps are searched in a part of the values, one after the other, and their places are then refined in all values.
    """
    step = -(-data.time.size // _SEARCH_VALUES)
    part = data.thinned(step)
    best = smooth if step == 1 else _best_fit(part, (), smooth.intervals)
    while len(best.jumps) < _MAX_JUMPS:
        trials = []
        for intervals in {min(each, best.intervals) for each in (*_SEARCH_INTERVALS, best.intervals)}:
            places = min(max(_MIN_PLACES, 2 * intervals), _MAX_PLACES)
            place = _place_of_jump(_fit_knots(part, intervals, best.jumps), order, (part.time[0], part.time[-1]), places)
            if place is not None:
                trials.append(_best_fit(part, (*best.jumps, place), best.intervals))
        trial = min(trials, key=lambda each: each.criterion, default=best)
        if trial.criterion >= best.criterion:
            break
        best = trial
    if not best.jumps:
        return smooth
    jumps, spacing = list(best.jumps), (data.time[-1] - data.time[0]) / _MAX_PLACES
    for k in 2 * list(range(len(jumps))):  # a place depends on those of the other jumps
        fit = _fit_knots(data, best.intervals, [each for i, each in enumerate(jumps) if i != k])
        jumps[k] = _place_of_jump(fit, order, (jumps[k] - spacing, jumps[k] + spacing), _FINER_PLACES) or jumps[k]
    return min(smooth, _best_fit(data, jumps, smooth.intervals), key=lambda each: each.criterion)


def _place_of_jump(fit: _KnotsFit, order: int, ends: tuple[float, float], count: int) -> float | None:
    """Return the time between `ends` at which a further jump of the derivative of an `order` reduces the squares of the
    residuals most; None if all times are too close to other jumps or to an end of the record.

    **Arguments**: `count` of the times at which the jump is tried first.
    """
    data, (low, high) = fit.data, ends
    time, fixed, place = data.time, np.sort([data.time[0], *fit.jumps, data.time[-1]]), None
    for _ in range(1 + _FINER_SEARCHES):
        trials = np.linspace(low, high, count)
        after = np.clip(np.searchsorted(fixed, trials), 1, len(fixed) - 1)
        at = np.searchsorted(time, trials)
        is_free = (at - np.searchsorted(time, fixed[after - 1]) >= _VALUES_BETWEEN_JUMPS) & (
            np.searchsorted(time, fixed[after]) - at >= _VALUES_BETWEEN_JUMPS
        )
        if not np.any(is_free):
            return place
        trials = trials[is_free]
        columns = np.maximum((time[:, None] - trials) / (time[-1] - time[0]), 0.0) ** order * data.weights[:, None]
        columns = fit.fitted(columns)[1]
        gains = (fit.residuals @ columns) ** 2 / np.sum(columns**2, axis=0)
        place, spacing = float(trials[np.argmax(gains)]), (high - low) / (count - 1)
        low, high, count = place - spacing, place + spacing, _FINER_PLACES
    return place


def _derivative(fit: _KnotsFit) -> np.ndarray:
    """Return the coefficients (k,) of the spline with the same knots that interpolates the derivative."""
    from scipy.interpolate import BSpline  # slow to import

    places = np.lib.stride_tricks.sliding_window_view(fit.knots[1:-1], DEGREE).mean(axis=1)
    places = np.clip(places, fit.knots[0], fit.knots[-1])  # rounding errors
    basis = BSpline.design_matrix(places, fit.knots, DEGREE).toarray()
    return np.linalg.solve(basis, BSpline(fit.knots, fit.coefficients, DEGREE)(places, 1))
