"""Least-squares fit of a machine to recorded runs by the method of Levenberg and Marquardt with projected linear unknowns.

At every trial the linear unknowns (initial states, unbalances, offsets) are computed by linear least squares. Only the steps of
the other unknowns are damped. The noise of each channel follows from its residuals, and the fit is repeated with whitened
residuals. Outliers among the residuals have little influence; a clipped reading is a bound of the true value. If the error of a
rotor's angle is not small compared with the noise, the angle is fitted together with the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.identification.jammed.motion import closed_motion, motion_columns, motion_differences
from jaxvib.identification.problem import Problem, channel_sizes, with_angle_errors, with_noise
from jaxvib.identification.response import linear_equations, model_readings, normal_equations, state_count
from jaxvib.numerics.noise import Noise, noise_of

_MAX_ITERATIONS = 40
_LONGEST_STEP = 0.7
"""Largest change of the logarithm of an unknown in one step."""

_NEAR_REDUCTION = 0.1
"""Expected relative reduction of the cost below which undamped steps are tried first."""

_VALLEY_STEPS = 3
"""Largest number of undamped steps that follow the first one along a curved valley of the cost."""

_PROBE, _LONGEST_CORRECTION = 0.1, 0.75
"""Fraction of a step after which a difference gives the second derivative of the model along the step, and largest length of
the correction by this derivative, relative to the step."""

_CONVERGED = 1e-2
"""Length of the next undamped step, in standard errors, below which the fit has converged."""

_VANISHED = 10.0
"""Standard error of the logarithm of a parameter above which the parameter is not reduced further: the data do not distinguish
it from 0."""

_MAX_PASSES = 8
_STEADY_NOISE = 0.01
"""Relative change of the noise of a channel below which its filter is final."""

_STEADY_VALUES = 0.05
"""Change of the unknowns in a pass, in standard errors, below which the influence of outliers and bounds is final."""

_MAX_GROWTH = 1.2
"""Largest ratio of the standard deviation of residuals in a fit with coloured noise to that in the fit with white noise. Above
it, the coloured noise is a part of the motion: noise with the frequencies of the machine can describe its free decay."""

_ANGLE_MATTERS = 0.03
"""Share of the noise due to the error of the rotor's angle above which the angle is fitted with the machine."""

_RIDGE = 1e-13
"""Relative addition to the diagonal of normal equations, which keeps undetermined combinations of unknowns in place."""


Equations = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Information of the data and of known values, and the gradient."""


class Fitted(NamedTuple):
    """Result of a fit.

    **Attributes** (p unknowns x, L linear unknowns: components (a, b) of each unbalance, then state and offsets of each run)

    - `x` (p,), `linear` (L,), and the `problem` with its filters and weights
    - `information` (p + L, p + L) of the data alone, `prior` (p + L, p + L) of known values
    - `differences` (n, C) of each run, readings minus model
    - `noise` (C,) of each run: standard deviation of the residuals
    - `outliers` (C,) of each run: share of the residuals that are outliers
    - `converged`: True if the last descent reached a minimum
    - `is_absorbed`: True if coloured noise would take up a part of the motion; the noise of the fit is white then
    - `misfits` of each run: standard deviation of the rotor's readings from the torque balance, divided by that from a smooth
      curve; empty if no parameter of a motor is unknown
    """

    x: np.ndarray
    linear: np.ndarray
    problem: Problem
    information: np.ndarray
    prior: np.ndarray
    differences: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]
    outliers: tuple[np.ndarray, ...]
    converged: bool
    is_absorbed: bool = False
    misfits: tuple[float, ...] = ()

    @property
    def residuals(self) -> tuple[np.ndarray, ...]:
        """Differences (n, C) of each run, NaN for samples that do not count."""
        pairs = zip(self.problem.masks, self.differences, strict=True)
        return tuple(np.where(mask, each, np.nan) for mask, each in pairs)


class _Trial(NamedTuple):
    """Unknowns `x`, the best linear unknowns for them, and the `cost`: sum of the squares of weighted residuals."""

    x: np.ndarray
    linear: np.ndarray
    cost: float


def linear_indices(problem: Problem) -> list[np.ndarray]:
    """Return, for each run, the indices of its linear unknowns (state, unbalances, offsets) among all linear unknowns."""
    exciters = len(problem.unbalances)
    indices, after = [], 2 * exciters
    for samples in problem.runs:
        offsets = len(samples.channels)
        states = state_count(problem.scene, samples.channels)
        of_run = np.arange(after, after + states + offsets)
        indices.append(np.concatenate([of_run[:states], np.arange(2 * exciters), of_run[states:]]))
        after += states + offsets
    return indices


def _linear_count(problem: Problem) -> int:
    return int(max(indices.max() for indices in linear_indices(problem))) + 1


def unknown_count(problem: Problem) -> int:
    """Return the number of all unknowns, with the states, the unbalances and the offsets of the runs."""
    return problem.unknowns.count + _linear_count(problem)


def solve_scaled(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution (k,) of normal equations with a `matrix` (k, k) and a `right` side (k,), scaled by the diagonal."""
    size = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    scaled = matrix / np.outer(size, size) + _RIDGE * np.eye(len(size))
    return np.linalg.solve(scaled, right / size) / size


def unbalance_prior(problem: Problem, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the information (L, L), the gradient (L,) and the cost of known unbalances at the linear unknowns."""
    information, gradient, cost = np.zeros((linear.size, linear.size)), np.zeros(linear.size), 0.0
    for k, known in enumerate(problem.unbalances):
        if known is None:
            continue
        pair = linear[2 * k : 2 * k + 2]
        size = float(np.hypot(*pair))
        row = np.zeros(linear.size)
        row[2 * k : 2 * k + 2] = pair / max(size, 1e-300)
        deviation = (known.value - size) / known.error
        information += np.outer(row, row) / known.error**2
        gradient += row * deviation / known.error
        cost += deviation**2
    return information, gradient, cost


def project(problem: Problem, x: np.ndarray) -> _Trial:
    """Return the best linear unknowns at `x`, and the cost. For a nonlinear motion, `problem.linear` is returned unchanged."""
    if problem.linear is not None:
        return _nonlinear_trial(problem, x, problem.linear)
    total = _linear_equations(problem, x)
    matrix, right, square = total[:-1, :-1], total[:-1, -1], total[-1, -1]
    if not np.all(np.isfinite(total)):
        return _Trial(x, np.zeros(len(right)), np.inf)
    damping = np.zeros(len(right))  # limits the steps of known unbalances, whose angles may be undetermined
    for k, known in enumerate(problem.unbalances):
        damping[2 * k : 2 * k + 2] = 0.0 if known is None else 1.0 / known.value**2
    linear = solve_scaled(matrix + np.diag(damping), right)
    if any(problem.unbalances):
        for _ in range(8):  # the information of known unbalances depends on the directions in the previous iteration
            information, gradient, _ = unbalance_prior(problem, linear)
            linear = linear + solve_scaled(matrix + information + np.diag(damping), right - matrix @ linear + gradient)
    data = square - 2.0 * linear @ right + linear @ matrix @ linear
    return _Trial(x, linear, max(float(data), 0.0) + known_cost(problem, x, linear))


def _nonlinear_trial(problem: Problem, x: np.ndarray, linear: np.ndarray) -> _Trial:
    """Return the unknowns of a nonlinear motion, and their cost."""
    return _Trial(x, linear, nonlinear_cost(problem, x, linear, nonlinear_differences(problem, x, linear)))


def nonlinear_cost(problem: Problem, x: np.ndarray, linear: np.ndarray, differences: np.ndarray) -> float:
    """Return the cost of the `differences` and of the known values; infinite for a motion that diverges."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = known_cost(problem, x, linear) + float(np.sum(differences**2))
    return cost if np.isfinite(cost) else np.inf


def nonlinear_differences(problem: Problem, x: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Return the weighted differences, readings minus model, of a nonlinear motion; one array contains those of all runs."""
    pairs = zip(problem.runs, linear_indices(problem), strict=True)
    return np.concatenate(
        [motion_differences(problem.unknowns, each, problem.scene, x, linear[indices]) for each, indices in pairs]
    )


def known_cost(problem: Problem, x: np.ndarray, linear: np.ndarray) -> float:
    """Return the cost of the known values."""
    loads = 0.0 if problem.load_spread is None else float(linear @ problem.load_spread @ linear)
    return float(np.sum(problem.precisions * (x - problem.means) ** 2)) + unbalance_prior(problem, linear)[2] + loads


def _linear_equations(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Return the normal equations (L + 1, L + 1) of the linear unknowns and the readings at `x`."""
    total = np.zeros((_linear_count(problem) + 1,) * 2)
    for samples, indices in zip(problem.runs, linear_indices(problem), strict=True):
        part = np.asarray(linear_equations(problem.unknowns, samples, problem.scene, jnp.asarray(x)))
        where = np.append(indices, total.shape[0] - 1)
        total[np.ix_(where, where)] += part
    return total


def linear_at(problem: Problem, x: np.ndarray, unbalance: np.ndarray | None) -> np.ndarray:
    """Return the best linear unknowns at `x`.

    **Arguments**: `unbalance`: given components (a, b) of each unbalance; None to compute them too.
    """
    if unbalance is None:
        return project(problem, x).linear
    total, n = _linear_equations(problem, x), unbalance.size
    return np.concatenate([unbalance, solve_scaled(total[n:-1, n:-1], total[n:-1, -1] - total[n:-1, :n] @ unbalance)])


def run_equations(problem: Problem, x: np.ndarray, linear: np.ndarray) -> list[np.ndarray]:
    """Return the normal equations (p + L + 1, p + L + 1) of each run: of all unknowns and the residuals."""
    if problem.linear is not None:
        return [columns.T @ columns for columns in nonlinear_columns(problem, x, linear)]
    p, size, of_runs = x.size, x.size + linear.size, []
    for samples, indices in zip(problem.runs, linear_indices(problem), strict=True):
        parts = problem.unknowns, samples, problem.scene
        where, total = np.concatenate([np.arange(p), p + indices, [size]]), np.zeros((size + 1, size + 1))
        total[np.ix_(where, where)] = normal_equations(*parts, jnp.asarray(x), jnp.asarray(linear[indices]))
        of_runs.append(total)
    return of_runs


def nonlinear_columns(problem: Problem, x: np.ndarray, linear: np.ndarray) -> list[np.ndarray]:
    """Return the columns (n C, p + L + 1) of each run: derivatives with respect to all unknowns, and the residuals."""
    p, size, of_runs = x.size, x.size + linear.size, []
    for samples, indices in zip(problem.runs, linear_indices(problem), strict=True):
        columns = motion_columns(problem.unknowns, samples, problem.scene, x, linear[indices])
        total = np.zeros((len(columns), size + 1))
        total[:, np.concatenate([np.arange(p), p + indices, [size]])] = columns
        of_runs.append(total)
    return of_runs


def polar_unbalances(problem: Problem, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (p + L, p + L) of all unknowns with respect to the polar unknowns, and the sizes (E,) of the
    unbalances. The polar unknowns have (logarithm of the size, angle) instead of the components (a, b) of each unbalance."""
    p, exciters = problem.unknowns.count, len(problem.unbalances)
    jacobian, sizes = np.eye(p + linear.size), np.zeros(exciters)
    for k in range(exciters):
        a, b = linear[2 * k : 2 * k + 2]
        sizes[k] = float(np.hypot(a, b))
        jacobian[p + 2 * k : p + 2 * k + 2, p + 2 * k : p + 2 * k + 2] = [[a, -b], [b, a]]
    return jacobian, sizes


def prior_equations(problem: Problem, x: np.ndarray, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (p + L, p + L) and the gradient (p + L,) of the known values."""
    p, size = x.size, x.size + linear.size
    prior, gradient = np.zeros((size, size)), np.zeros(size)
    prior[np.arange(p), np.arange(p)] = problem.precisions
    gradient[:p] = -problem.precisions * (x - problem.means)
    prior[p:, p:], gradient[p:], _ = unbalance_prior(problem, linear)
    if problem.load_spread is not None:
        prior[p:, p:] += problem.load_spread
        gradient[p:] -= problem.load_spread @ linear
    return prior, gradient


def joint_equations(problem: Problem, x: np.ndarray, linear: np.ndarray) -> Equations:
    """Return the information of the data and that of known values, each (p + L, p + L), and the gradient (p + L,)."""
    return _joined(problem, x, linear, np.sum(run_equations(problem, x, linear), axis=0))


def _joined(problem: Problem, x: np.ndarray, linear: np.ndarray, total: np.ndarray) -> Equations:
    """Return the result of `joint_equations` from the normal equations `total` of all runs."""
    prior, gradient = prior_equations(problem, x, linear)
    return total[:-1, :-1], prior, total[:-1, -1] + gradient


def minimize(problem: Problem, x: np.ndarray) -> tuple[_Trial, np.ndarray, np.ndarray, bool]:
    """Return the minimum near `x`, the information of data and of known values there, and True if it was reached."""
    if problem.linear is not None:
        return _minimize_nonlinear(problem, x)

    def equations(trial: _Trial) -> Equations:
        return joint_equations(problem, trial.x, trial.linear)

    def stepped(trial: _Trial, step: np.ndarray) -> _Trial:
        return project(problem, trial.x + limited_step(problem, step)[: x.size])

    start = project(problem, x)
    best, (information, prior, _), converged = descend(start, equations, stepped, x.size, positive_indices(problem))
    return best, information, prior, converged


def _minimize_nonlinear(problem: Problem, x: np.ndarray) -> tuple[_Trial, np.ndarray, np.ndarray, bool]:
    """Return the result of `minimize` for a nonlinear motion, on which no unknown has a linear influence.

    Steps of the size and of the angle of the unbalance are damped separately, because the size may be known.
    """
    p, columns = x.size, np.zeros((0, 0))

    def in_polar(trial: _Trial, data: np.ndarray, prior: np.ndarray, gradient: np.ndarray) -> Equations:
        jacobian, _ = polar_unbalances(problem, trial.linear)
        return jacobian.T @ data @ jacobian, jacobian.T @ prior @ jacobian, jacobian.T @ gradient

    def equations(trial: _Trial) -> Equations:
        nonlocal columns
        columns = np.concatenate(nonlinear_columns(problem, trial.x, trial.linear))
        return in_polar(trial, *_joined(problem, trial.x, trial.linear, columns.T @ columns))

    def moved(trial: _Trial, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        linear, unbalance = trial.linear + step[p:], complex(*trial.linear[:2]) * np.exp(complex(*step[p : p + 2]))
        linear[:2] = unbalance.real, unbalance.imag
        return trial.x + step[:p], linear

    def stepped(trial: _Trial, step: np.ndarray) -> _Trial:
        return _nonlinear_trial(problem, *moved(trial, limited_step(problem, step)))

    def bend(trial: _Trial, step: np.ndarray) -> np.ndarray:
        jacobian, slopes = polar_unbalances(problem, trial.linear)[0], columns[:, :-1]
        change = nonlinear_differences(problem, *moved(trial, step)) - columns[:, -1] + slopes @ (jacobian @ step)
        return jacobian.T @ (slopes.T @ change)

    start = project(problem, x)
    count = p + start.linear.size
    with np.errstate(over="ignore", invalid="ignore"):  # a trial may diverge; its cost is then infinite
        best, found, converged = descend(start, equations, stepped, count, positive_indices(problem), bend)
    to_polar = np.linalg.inv(polar_unbalances(problem, best.linear)[0])
    return best, to_polar.T @ found[0] @ to_polar, to_polar.T @ found[1] @ to_polar, converged


def positive_indices(problem: Problem) -> np.ndarray:
    """Return the indices in x of positive parameters, whose logarithms are unknown."""
    return np.flatnonzero(np.asarray(problem.unknowns.positive))


def descend(
    best: Any,
    equations: Callable[[Any], Equations],
    stepped: Callable[[Any, np.ndarray], Any],
    damped_count: int,
    positive: np.ndarray,
    bend: Callable[[Any, np.ndarray], np.ndarray] | None = None,
    tolerance: float = _CONVERGED**2,
) -> tuple[Any, Equations, bool]:
    """Return the minimum near a trial, its equations, and True if it was reached.

    With `bend`, each damped step is corrected for the second derivative of the model along it. In a curved valley of the cost,
    such steps are much longer than those of the linearized model.

    A parameter that the data do not distinguish from 0 is not reduced further. Its logarithm is the unknown, and the expected
    reduction of the cost would remain the same at every smaller value: the descent would never end.

    **Arguments**: the first trial `best`, with its `cost`; `equations`: returns the equations of a trial; `stepped`: returns
    the trial after a step; `damped_count`: number of the first unknowns, whose steps are damped; `positive`: indices of the
    positive parameters; `bend`: returns for a trial and a step the product J^T (differences after the step - differences
    + J step), where J are the derivatives of the model at the trial whose `equations` were computed last; `tolerance`: expected
    reduction of the cost by an undamped step below which the descent ends.

    Source of the correction: Transtrum, Sethna 2012, arXiv 1201.5885 (geodesic acceleration).
    """
    damping, indices = 1e-2, np.arange(damped_count)
    for _ in range(_MAX_ITERATIONS):
        current = equations(best)
        matrix, gradient = _without_vanished(current, positive)
        if not np.all(np.isfinite(matrix)):
            return best, current, False
        undamped = _undamped_step(matrix, gradient)
        if gradient @ undamped < tolerance:
            return best, current, True
        if bend is None and gradient @ undamped < _NEAR_REDUCTION * best.cost:
            trial = _follow_valley(stepped(best, undamped), equations, stepped, positive)
            if trial.cost < best.cost:
                best = trial
                continue
        while True:
            damped, size = matrix.copy(), np.diagonal(matrix)[indices]
            damped[indices, indices] += damping * (size + 1e-12 * np.max(size))
            step = _damped_step(best, damped, gradient, bend, positive)
            trial = best if step is None else stepped(best, step)
            if trial.cost < best.cost:
                best, damping = trial, max(0.1 * damping, 1e-12)
                break
            damping *= 8.0
            if damping > 1e6:
                return best, current, bool(gradient @ undamped < 100.0 * tolerance)
    return best, equations(best), False


def _damped_step(
    best: Any,
    damped: np.ndarray,
    gradient: np.ndarray,
    bend: Callable[[Any, np.ndarray], np.ndarray] | None,
    positive: np.ndarray,
) -> np.ndarray | None:
    """Return a damped step with its second-order correction; None if the correction is longer than three quarters of the step.

    Lengths are those of vectors whose entries are divided by the scale of each unknown, the inverse root of the diagonal of
    `damped`.

    A change of the logarithm of a parameter near 0 hardly changes the model; the step of this logarithm is therefore long. It
    is shortened, and the other unknowns adapt to it. If all unknowns were shortened together, the descent would stop.
    """
    size, step, free = np.sqrt(np.diagonal(damped)), solve_scaled(damped, gradient), np.ones(len(gradient), bool)
    while np.max(np.abs(step[positive]), initial=0.0) > 1.001 * _LONGEST_STEP:
        k = positive[np.argmax(np.abs(step[positive]))]
        shorter, free[k] = math.copysign(_LONGEST_STEP, step[k]), False
        gradient = gradient - damped[k] * shorter
        damped[k], damped[:, k], damped[k, k], gradient[k] = 0.0, 0.0, 1.0, shorter
        step = solve_scaled(damped, gradient)
    if bend is None:
        return step
    correction = solve_scaled(damped, free * bend(best, _PROBE * step)) / _PROBE**2
    is_short = np.linalg.norm(size * correction) < _LONGEST_CORRECTION * np.linalg.norm(size * step)
    return step + correction if is_short else None


def _without_vanished(equations: Equations, positive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the gradient in which positive parameters that are not distinguishable from 0 are not reduced."""
    information, prior, gradient = equations
    matrix, gradient = information + prior, gradient.copy()
    frozen = positive[(gradient[positive] < 0.0) & (np.diagonal(matrix)[positive] < _VANISHED**-2)]
    matrix[frozen], matrix[:, frozen], matrix[frozen, frozen], gradient[frozen] = 0.0, 0.0, 1.0, 0.0
    return matrix, gradient


def _undamped_step(matrix: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    return solve_scaled(matrix + 1e-9 * np.diag(np.diagonal(matrix)), gradient)


def limited_step(problem: Problem, step: np.ndarray) -> np.ndarray:
    """Return the step, shortened such that no entry of x changes by more than 0.7; errors of rotor angles do not count."""
    longest = float(np.max(np.abs(step[: problem.unknowns.count - problem.unknowns.errors]), initial=0.0))
    return step * min(1.0, _LONGEST_STEP / max(longest, 1e-300))


def _follow_valley(
    trial: Any, equations: Callable[[Any], Equations], stepped: Callable[[Any, np.ndarray], Any], positive: np.ndarray
) -> Any:
    """Return the trial after up to 3 undamped steps. The cost may rise in between: the steps follow a curved valley of the
    cost, such as that of two dampings with very small noise. The damped method needs about ten times as many steps."""
    for _ in range(_VALLEY_STEPS):
        matrix, gradient = _without_vanished(equations(trial), positive)
        step = _undamped_step(matrix, gradient)
        if not np.all(np.isfinite(step)) or gradient @ step < _CONVERGED**2:
            break
        trial = stepped(trial, step)
    return trial


def differences_of(problem: Problem, x: np.ndarray, linear: np.ndarray) -> list[np.ndarray]:
    """Return readings minus model (n, C) of each run."""
    differences = []
    for samples, indices, raw in zip(problem.runs, linear_indices(problem), problem.raw, strict=True):
        parts = problem.unknowns, samples, problem.scene
        if problem.linear is not None:
            model = closed_motion(*parts, x, linear[indices])[0]
        else:
            model = np.asarray(model_readings(*parts, jnp.asarray(x), jnp.asarray(linear[indices])))
        shown = np.stack(
            [_delayed(model[:, k], channel.delay / float(samples.step)) for k, channel in enumerate(samples.channels)],
            axis=1,
        )
        differences.append(raw - shown[: len(raw)])
    return differences


def _delayed(values: np.ndarray, delay: float) -> np.ndarray:
    """Return the values (n,), interpolated, with a delay in steps of the grid."""
    if delay == 0.0:
        return values
    from scipy.interpolate import make_interp_spline  # slow to import

    place = np.arange(values.size, dtype=float)
    return make_interp_spline(place, values, 5)(np.maximum(place - delay, 0.0))


def fit_from(problem: Problem, starts: Sequence[np.ndarray]) -> Fitted:
    """Fit a problem from each of the `starts` (values of x), and return the fit with the lowest cost.

    The first pass weights each channel by the size of its readings, the second pass by its residuals. All later passes use
    filters that make the residuals white.
    """
    noise = [[Noise(np.ones(1), size) for size in of_run] for of_run in channel_sizes(problem)]
    fitted = _pass(problem, noise, None, starts)
    if _largest_change(noise, [[Noise(np.ones(1), each) for each in of_run] for of_run in fitted.noise]) < 0.3:
        return fitted._replace(converged=False)  # the model does not resemble the records, and their noise is unknown
    noise = [[Noise(np.ones(1), float(each)) for each in of_run] for of_run in fitted.noise]
    fitted = _pass(fitted.problem, noise, None, [fitted.x])
    with_white_noise, is_final = fitted, not any(np.any(each) for each in problem.bounds)
    matters = [bool(np.any(each > _ANGLE_MATTERS)) for each in angle_shares(fitted)]
    if any(matters):
        problem, is_final = with_angle_errors(fitted.problem, matters), False
        fitted = fitted._replace(x=np.concatenate([fitted.x, np.zeros(problem.unknowns.errors)]), problem=problem)
    for _ in range(_MAX_PASSES):  # a pass that has not converged is no reason to stop: its weights are not final
        new = [[noise_of(each[:, k]) for k in range(each.shape[1])] for each in fitted.residuals]
        if is_final and _largest_change(noise, new) < _STEADY_NOISE:
            break
        before, noise = fitted.x, new
        fitted = _pass(fitted.problem, noise, fitted.differences, [before])
        if _is_absorbed(noise, with_white_noise, fitted):
            return with_white_noise._replace(is_absorbed=True)
        matrix = fitted.information + fitted.prior
        change = np.concatenate([fitted.x - before, np.zeros(fitted.linear.size)])
        is_final = bool(change @ matrix @ change < _STEADY_VALUES**2) or not _has_changing_weights(problem, noise)
    return fitted


def _is_absorbed(noise: Sequence[Sequence[Noise]], before: Fitted, after: Fitted) -> bool:
    """Return True if a channel with coloured `noise` has larger residuals `after` than `before` (fit with white noise)."""
    triples = zip(noise, before.noise, after.noise, strict=True)
    return any(
        len(each.taps) > 1 and new > _MAX_GROWTH * old
        for of_run, olds, news in triples
        for each, old, new in zip(of_run, olds, news, strict=True)
    )


def _has_changing_weights(problem: Problem, noise: Sequence[Sequence[Noise]]) -> bool:
    """Return True if the weights of the readings depend on the last fit, as they do with outliers and clipped readings."""
    has_outliers = any(each.outliers for of_run in noise for each in of_run)
    return has_outliers or any(np.any(each) for each in problem.bounds)


def angle_shares(fitted: Fitted) -> list[np.ndarray]:
    """Return, for each run, the change (C,) of the readings due to the standard error of the rotor's angle, divided by the
    noise."""
    problem = fitted.problem
    return [
        np.array([error * np.std(raw[mask[:, k], k]) / max(noise[k], 1e-300) for k in range(raw.shape[1])])
        for error, raw, mask, noise in zip(problem.angle_errors, problem.raw, problem.masks, fitted.noise, strict=True)
    ]


def _largest_change(before: Sequence[Sequence[Noise]], after: Sequence[Sequence[Noise]]) -> float:
    """Return the largest relative change of the standard deviation of a channel."""
    pairs = [pair for runs in zip(before, after, strict=True) for pair in zip(*runs, strict=True)]
    return max(abs(new.deviation / old.deviation - 1.0) for old, new in pairs)


def _pass(
    problem: Problem,
    noise: Sequence[Sequence[Noise]],
    differences: Sequence[np.ndarray] | None,
    starts: Sequence[np.ndarray],
) -> Fitted:
    """Fit with the given noise from each of the `starts`, and return the fit with the lowest cost; for `differences` see
    `with_noise`."""
    problem = with_noise(problem, noise, differences)
    minima = [minimize(problem, x) for x in starts]
    trial, information, prior, converged = min(minima, key=lambda each: each[0].cost)
    problem = problem._replace(linear=trial.linear) if problem.linear is not None else problem
    residuals = differences_of(problem, trial.x, trial.linear)
    pairs = zip(residuals, problem.masks, noise, strict=True)
    deviations = [
        np.array([max(float(np.std(each[mask[:, k], k])), 1e-12 * old.deviation) for k, old in enumerate(of_run)])
        for each, mask, of_run in pairs
    ]
    return Fitted(
        x=trial.x,
        linear=trial.linear,
        problem=problem,
        information=information,
        prior=prior,
        differences=tuple(residuals),
        noise=tuple(deviations),
        outliers=tuple(np.array([each.outliers for each in of_run]) for of_run in noise),
        converged=converged,
    )


def information_at(problem: Problem, linear: np.ndarray) -> Fitted:
    """Return a fit without iterations: its information is computed at the first values of the unknowns x and at the `linear`
    unknowns (L,)."""
    x = np.zeros(problem.unknowns.count)
    information, prior, _ = joint_equations(problem, x, linear)
    return Fitted(x, linear, problem, information, prior, (), (), (), True)
