"""Profile likelihood: intervals of the parameters for which the cost of a fit is not a quadratic function.

A parameter is fixed at a distance from its fitted value while all other unknowns are fitted again. The rise of the cost is
compared with the quadratic form, (distance/error)^2. If they differ by more than 10 % at two standard errors, the ends of the
interval are the values at which the cost rises by 1.96^2.
"""

from __future__ import annotations

import cmath
import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from jaxvib.identification.directions import Information, eliminate, elimination, free_unbalances, in_polar_unbalances
from jaxvib.identification.fit import (
    Fitted,
    minimize,
    nonlinear_columns,
    nonlinear_cost,
    nonlinear_differences,
    prior_equations,
    project,
    solve_scaled,
)
from jaxvib.identification.problem import Known, Problem

QUANTILE = 1.959964
"""97.5 % quantile of the normal distribution."""

_COMPARED_DISTANCE = 2.0
"""Distance at which the cost is compared with the quadratic form, in standard errors."""

_MAX_DIFFERENCE = 0.1
"""Relative difference from the quadratic form above which an interval follows from the profile."""

_VALLEY_STEPS, _SMALL_REDUCTION = 6, 0.05
"""Number of steps into a curved valley of the cost, and reduction of the cost below which they end."""

_TIGHT_ERROR = 1e-3
"""Standard error of the known value by which a parameter is fixed, relative to the standard error of the parameter in the
fit."""

_MAX_DISTANCE = 20.0
"""Distance in standard errors beyond which an interval counts as unbounded."""


@dataclasses.dataclass(frozen=True)
class _Profile:
    """Profile of one parameter of a fit.

    The coordinate of the parameter is its entry of x, or the logarithm of the unbalance.

    **Attributes**

    - `fitted`: the fit; `index` of the parameter in x, or of its exciter if `is_unbalance`
    - `center` and `spread`: value and standard error of the coordinate
    - `slopes` (p + L,): change of all unknowns per change of the coordinate; an unbalance is (logarithm of its size, angle)
    - `floor`: the least cost
    - `is_vanished`: True if the parameter is not distinguishable from 0; distances are then multiples of the standard error of
      the parameter itself, not of its logarithm
    - of a nonlinear motion: `columns` (n, p + L), the derivatives of `nonlinear_columns`, and `data` (p + L, p + L), the
      information of the data
    """

    fitted: Fitted
    index: int
    is_unbalance: bool
    center: float
    spread: float
    slopes: np.ndarray
    floor: float
    is_vanished: bool = False
    columns: np.ndarray | None = None
    data: np.ndarray | None = None

    def shift(self, distance: float) -> float:
        """Return the change of the coordinate at a `distance` in standard errors."""
        return math.log1p(distance * self.spread) if self.is_vanished else distance * self.spread

    def rise(self, distance: float, is_exact: bool) -> float:
        """Return the rise of the cost at a `distance` in standard errors. If `is_exact`, all other unknowns are fitted.
        Otherwise only the linear ones are fitted, and the others follow from the quadratic form. A nonlinear motion has no
        linear unknown; see `_descend_into_valley`."""
        target, p = self.center + self.shift(distance), self.fitted.x.size
        problem, known_cost = self._fix_parameter(target)
        change = distance * self.spread * self.slopes
        x = self.fitted.x + change[:p]
        if self.is_vanished:
            x[self.index] = target
        if problem.linear is not None:
            linear, pair = problem.linear + change[p:], complex(*problem.linear[:2]) * cmath.exp(complex(*change[p : p + 2]))
            linear[:2] = pair.real, pair.imag
            x, linear = self._descend_into_valley(problem, x, linear)
            problem = problem._replace(linear=linear)
        trial = minimize(problem, x)[0] if is_exact else project(problem, x)
        return trial.cost + known_cost - self.floor

    def _descend_into_valley(self, problem: Problem, x: np.ndarray, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the unknowns of a nonlinear motion after a few steps of the Gauss-Newton method with the derivatives at the
        fit. The valley of the cost is curved: far from the fit, the unknowns of the quadratic form are outside the valley."""
        assert self.columns is not None and self.data is not None
        p, best, last = x.size, (x, linear), math.inf
        for _ in range(_VALLEY_STEPS):
            differences = nonlinear_differences(problem, x, linear)
            cost = nonlinear_cost(problem, x, linear, differences)
            if not cost < last - _SMALL_REDUCTION:
                break
            best, last = (x, linear), cost
            prior, gradient = prior_equations(problem, x, linear)
            step = solve_scaled(self.data + prior, self.columns.T @ differences + gradient)
            x, linear = x + step[:p], linear + step[p:]
        return best

    def _fix_parameter(self, target: float) -> tuple[Problem, float]:
        """Return the problem with the parameter fixed at `target`, and the cost of the difference between
        `target` and the known value of the parameter."""
        problem, relative_error = self.fitted.problem, _TIGHT_ERROR * min(self.spread, 1.0)
        if self.is_unbalance:
            known, value = problem.unbalances[self.index], math.exp(target)
            unbalances = list(problem.unbalances)
            unbalances[self.index] = Known(value, relative_error * value)
            known_cost = 0.0 if known is None else ((known.value - value) / known.error) ** 2
            return problem._replace(unbalances=tuple(unbalances)), known_cost
        means, precisions = problem.means.copy(), problem.precisions.copy()
        known_cost = float(precisions[self.index] * (target - means[self.index]) ** 2)
        means[self.index], precisions[self.index] = target, 1.0 / relative_error**2
        return problem._replace(means=means, precisions=precisions), known_cost

    def is_quadratic(self, is_exact: bool) -> bool:
        """Return True if the rises at two standard errors agree with the quadratic form; see `rise`."""
        rises = [self.rise(side * _COMPARED_DISTANCE, is_exact) for side in (-1.0, 1.0)]
        return max(abs(rise / _COMPARED_DISTANCE**2 - 1.0) for rise in rises) <= _MAX_DIFFERENCE

    def end(self, side: float) -> float:
        """Return the distance of an end of the interval from the fitted value, in standard errors; infinite if there is no end.

        **Arguments**: `side`: -1 for the lower end, 1 for the upper end.

        The square root of the rise is nearly proportional to the distance. The secant method therefore finds the end in a few
        steps.
        """
        last_distance, last_root, distance = 0.0, 0.0, _COMPARED_DISTANCE
        for _ in range(8):
            new_root = math.sqrt(max(self.rise(side * distance, is_exact=True), 0.0))
            if abs(new_root - QUANTILE) < 0.01 * QUANTILE:
                return distance
            slope = (new_root - last_root) / (distance - last_distance)
            last_distance, last_root = distance, new_root
            distance += (QUANTILE - new_root) / slope if slope > 0.0 else math.inf
            if not 0.0 < distance < _MAX_DISTANCE:
                return math.inf
        return math.inf


def profile_intervals(fitted: Fitted, information: Information) -> Mapping[str, tuple[float, float]]:
    """Return, for each parameter for which the cost is not a quadratic function, the distances of both ends of its interval
    from the fitted value, by name. A distance is a change of the parameter's entry of x, or of the logarithm of an unbalance.

    The lower distance of a parameter that is not distinguishable from 0 is minus infinity. Undetermined parameters are left
    out.

    **Arguments**: `fitted`, and the `information` about its parameters.
    """
    problem, p, number_count = fitted.problem, fitted.x.size, len(fitted.problem.unknowns.numbers)
    data, prior, sizes = in_polar_unbalances(fitted)
    free_exciters = free_unbalances(problem)
    indices = np.array([*range(p), *(p + 2 * k for k in free_exciters)], int)
    covariance = np.linalg.pinv(eliminate(data + prior, indices), rcond=1e-13, hermitian=True)
    floor, intervals, derivatives = project(problem, fitted.x).cost, {}, ()
    if problem.linear is not None:
        columns = np.concatenate(nonlinear_columns(problem, fitted.x, problem.linear))[:, :-1]
        derivatives = columns, columns.T @ columns
    for i, name in enumerate(information.names):
        if not information.determined[i]:
            continue
        is_unbalance, is_vanished = i >= number_count, bool(information.vanished[i])
        entry = p + i - number_count if is_unbalance else i
        index = free_exciters[i - number_count] if is_unbalance else i
        center = math.log(sizes[index]) if is_unbalance else float(fitted.x[i])
        slopes, variance = elimination(data + prior, indices[[entry]])[:, 0], covariance[entry, entry]
        if is_vanished:  # the information about this parameter may be below the accuracy of the pseudoinverse
            slopes, variance = np.zeros(len(data)), information.covariance[i, i]
        spread = math.sqrt(variance)
        profile = _Profile(fitted, index, is_unbalance, center, spread, slopes, floor, is_vanished, *derivatives)
        if is_vanished:
            intervals[name] = -math.inf, profile.shift(profile.end(1.0))
            continue
        # The cost of a nonlinear motion that is not fitted completely may rise by more than in the profile.
        if profile.is_quadratic(is_exact=False) or (problem.linear is not None and profile.is_quadratic(is_exact=True)):
            continue
        intervals[name] = -profile.spread * profile.end(-1.0), profile.spread * profile.end(1.0)
    return intervals
