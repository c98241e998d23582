"""Least-squares fit of a machine to recorded runs by the method of Levenberg and Marquardt with projected linear unknowns.

At every trial the linear unknowns (first states, unbalances, offsets) are those of least squares. Only the other unknowns are
damped. The noise of each channel follows from its residuals, and the fit is repeated with residuals filtered to white noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.identification.problem import Problem, with_noise
from jaxvib.identification.response import linear_equations, model_readings, normal_equations
from jaxvib.numerics.noise import autoregression

_MAX_ITERATIONS = 40
_LONGEST_STEP = 0.7
"""Largest change of the logarithm of an unknown in one step."""

_CONVERGED = 1e-2
"""Length of the next undamped step, in standard errors, below which the fit has converged."""

_MAX_PASSES = 6
_STEADY_NOISE = 0.01
"""Relative change of the noise of a channel below which its filter is final."""

_RIDGE = 1e-13
"""Relative addition to the diagonal of normal equations, which keeps undetermined combinations of unknowns in place."""


class Fitted(NamedTuple):
    """Result of a fit.

    **Attributes** (p unknowns x, L linear unknowns: components (a, b) of each unbalance, then state and offsets of each run)

    - `x` (p,), `linear` (L,), and the `problem` with its filters and weights
    - `information` (p + L, p + L) of the data alone, `prior` (p + L, p + L) of known values
    - `residuals` (n, C) of each run, readings minus model, NaN for samples that do not count
    - `noise` (C,) of each run: standard deviation of the residuals
    - `converged`
    """

    x: np.ndarray
    linear: np.ndarray
    problem: Problem
    information: np.ndarray
    prior: np.ndarray
    residuals: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]
    converged: bool


class _Trial(NamedTuple):
    """Unknowns `x` with the best linear unknowns, their cost, and the parts of the linear unknowns in each run."""

    x: np.ndarray
    linear: np.ndarray
    cost: float


def linear_places(problem: Problem) -> list[np.ndarray]:
    """Return, for each run, the places of its linear unknowns (state, unbalances, offsets) among all linear unknowns."""
    exciters = len(problem.unbalances)
    places, after = [], 2 * exciters
    for samples in problem.runs:
        offsets = len(samples.channels)
        states = 2 * len(problem.scene.machine.structure().coordinates) + sum(c.high_pass > 0.0 for c in samples.channels)
        own = np.arange(after, after + states + offsets)
        places.append(np.concatenate([own[:states], np.arange(2 * exciters), own[states:]]))
        after += states + offsets
    return places


def _linear_count(problem: Problem) -> int:
    return int(max(place.max() for place in linear_places(problem))) + 1


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of scaled normal equations."""
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
        left = (known.value - size) / known.error
        information += np.outer(row, row) / known.error**2
        gradient += row * left / known.error
        cost += left**2
    return information, gradient, cost


def _project(problem: Problem, x: np.ndarray) -> _Trial:
    """Return the best linear unknowns at `x`, and their cost."""
    total = _linear_equations(problem, x)
    matrix, right, square = total[:-1, :-1], total[:-1, -1], total[-1, -1]
    if not np.all(np.isfinite(total)):
        return _Trial(x, np.zeros(len(right)), np.inf)
    linear = _solve(matrix, right)
    for k, known in enumerate(problem.unbalances):
        pair = linear[2 * k : 2 * k + 2]
        if known is not None:
            linear[2 * k : 2 * k + 2] = pair * known.value / max(float(np.hypot(*pair)), 1e-300)
    prior_cost = 0.0
    if any(problem.unbalances):
        for _ in range(8):
            information, gradient, prior_cost = unbalance_prior(problem, linear)
            linear = linear + _solve(matrix + information, right - matrix @ linear + gradient)
        prior_cost = unbalance_prior(problem, linear)[2]
    data = square - 2.0 * linear @ right + linear @ matrix @ linear
    away = float(np.sum(problem.precisions * (x - problem.means) ** 2))
    return _Trial(x, linear, max(float(data), 0.0) + away + prior_cost)


def _linear_equations(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Return the normal equations (L + 1, L + 1) of the linear unknowns and the readings at `x`."""
    total = np.zeros((_linear_count(problem) + 1,) * 2)
    for samples, place in zip(problem.runs, linear_places(problem), strict=True):
        part = np.asarray(linear_equations(problem.unknowns, samples, problem.scene, jnp.asarray(x)))
        where = np.append(place, total.shape[0] - 1)
        total[np.ix_(where, where)] += part
    return total


def linear_at(problem: Problem, x: np.ndarray, unbalance: np.ndarray | None) -> np.ndarray:
    """Return the best linear unknowns at `x`, with the components (a, b) of each unbalance if they are not None."""
    if unbalance is None:
        return _project(problem, x).linear
    total, n = _linear_equations(problem, x), unbalance.size
    return np.concatenate([unbalance, _solve(total[n:-1, n:-1], total[n:-1, -1] - total[n:-1, :n] @ unbalance)])


def run_equations(problem: Problem, x: np.ndarray, linear: np.ndarray) -> list[np.ndarray]:
    """Return the normal equations (p + L + 1, p + L + 1) of each run: of all unknowns and the residuals."""
    p, size, found = x.size, x.size + linear.size, []
    for samples, place in zip(problem.runs, linear_places(problem), strict=True):
        own = jnp.asarray(linear[place])
        where, total = np.concatenate([np.arange(p), p + place, [size]]), np.zeros((size + 1, size + 1))
        total[np.ix_(where, where)] = np.asarray(
            normal_equations(problem.unknowns, samples, problem.scene, jnp.asarray(x), own)
        )
        found.append(total)
    return found


def prior_equations(problem: Problem, x: np.ndarray, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (p + L, p + L) and the gradient (p + L,) of the known values."""
    p, size = x.size, x.size + linear.size
    prior, gradient = np.zeros((size, size)), np.zeros(size)
    prior[np.arange(p), np.arange(p)] = problem.precisions
    gradient[:p] = -problem.precisions * (x - problem.means)
    prior[p:, p:], gradient[p:], _ = unbalance_prior(problem, linear)
    return prior, gradient


def _equations(problem: Problem, trial: _Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the information of the data, that of known values, both (p + L, p + L), and the gradient (p + L,)."""
    total = np.sum(run_equations(problem, trial.x, trial.linear), axis=0)
    prior, gradient = prior_equations(problem, trial.x, trial.linear)
    return total[:-1, :-1], prior, total[:-1, -1] + gradient


def _minimize(problem: Problem, x: np.ndarray) -> tuple[_Trial, np.ndarray, np.ndarray, bool]:
    """Return the minimum near `x`, the information of data and of known values there, and True if it was reached."""
    best, damping = _project(problem, x), 1e-2
    for _ in range(_MAX_ITERATIONS):
        information, prior, gradient = _equations(problem, best)
        matrix, p = information + prior, best.x.size
        if not np.all(np.isfinite(matrix)):
            return best, information, prior, False
        undamped = _solve(matrix + 1e-9 * np.diag(np.diagonal(matrix)), gradient)
        if gradient @ undamped < _CONVERGED**2:
            return best, information, prior, True
        while True:
            damped = matrix.copy()
            damped[np.arange(p), np.arange(p)] += damping * (np.diagonal(matrix)[:p] + 1e-12 * np.max(np.diagonal(matrix)[:p]))
            step = _solve(damped, gradient)[:p]
            step *= min(1.0, _LONGEST_STEP / max(float(np.max(np.abs(step), initial=0.0)), 1e-300))
            trial = _project(problem, best.x + step)
            if trial.cost < best.cost:
                best, damping = trial, max(0.1 * damping, 1e-9)
                break
            damping *= 8.0
            if damping > 1e6:
                return best, information, prior, bool(gradient @ undamped < 100.0 * _CONVERGED**2)
    return best, *_equations(problem, best)[:2], False


def residuals_of(problem: Problem, x: np.ndarray, linear: np.ndarray) -> list[np.ndarray]:
    """Return readings minus model (n, C) of each run, NaN for samples that do not count."""
    found = []
    for samples, place, raw, mask in zip(problem.runs, linear_places(problem), problem.raw, problem.masks, strict=True):
        model = model_readings(problem.unknowns, samples, problem.scene, jnp.asarray(x), jnp.asarray(linear[place]))
        shown = np.stack(
            [
                _delayed(np.asarray(model)[:, k], channel.delay / float(samples.step))
                for k, channel in enumerate(samples.channels)
            ],
            axis=1,
        )
        found.append(np.where(mask, raw - shown[: len(raw)], np.nan))
    return found


def _delayed(values: np.ndarray, delay: float) -> np.ndarray:
    """Return values that are later by a number of steps."""
    if delay == 0.0:
        return values
    from scipy.interpolate import make_interp_spline  # slow to import

    place = np.arange(values.size, dtype=float)
    return make_interp_spline(place, values, 5)(np.maximum(place - delay, 0.0))


def fit_from(problem: Problem, starts: Sequence[np.ndarray]) -> Fitted:
    """Return the fit of a problem: the best one of those from the unknowns `starts`.

    The first pass weighs each channel by its own size, the next by their residuals, the last with filters to white noise.
    """
    white = [[np.ones(1) for _ in samples.channels] for samples in problem.runs]
    sizes = [
        np.array([np.std(raw[mask[:, k], k]) if np.any(mask[:, k]) else 0.0 for k in range(raw.shape[1])])
        for raw, mask in zip(problem.raw, problem.masks, strict=True)
    ]
    deviations = [np.where(each > 0.0, each, 1.0) for each in sizes]
    found = _pass(problem, white, deviations, starts)
    if _largest_change([each / size for each, size in zip(found.noise, deviations, strict=True)]) < 0.3:
        return found._replace(converged=False)  # the model does not resemble the records, and their noise is unknown
    found = _pass(problem, white, found.noise, [found.x])
    for _ in range(_MAX_PASSES):  # goes on after a pass that has not converged, since its weights were not final
        models = [[autoregression(each[:, k]) for k in range(each.shape[1])] for each in found.residuals]
        new = [np.array([deviation for _, deviation in of_run]) for of_run in models]
        change = _largest_change([after / before for after, before in zip(new, deviations, strict=True)])
        if change < _STEADY_NOISE:
            break
        deviations = new
        found = _pass(problem, [[taps for taps, _ in of_run] for of_run in models], deviations, [found.x])
    return found


def _largest_change(ratios: Sequence[np.ndarray]) -> float:
    return max(float(np.max(np.abs(each - 1.0))) for each in ratios)


def _pass(
    problem: Problem, filters: Sequence[Sequence[np.ndarray]], deviations: Sequence[np.ndarray], starts: Sequence[np.ndarray]
) -> Fitted:
    """Return the fit with these filters to white noise and its standard deviations, the best one of those from `starts`."""
    problem = with_noise(problem, filters, deviations)
    minima = [_minimize(problem, x) for x in starts]
    trial, information, prior, converged = min(minima, key=lambda each: each[0].cost)
    left = residuals_of(problem, trial.x, trial.linear)
    noise = [np.nanstd(each, axis=0) for each in left]
    return Fitted(
        x=trial.x,
        linear=trial.linear,
        problem=problem,
        information=information,
        prior=prior,
        residuals=tuple(left),
        noise=tuple(np.maximum(each, 1e-12 * old) for each, old in zip(noise, deviations, strict=True)),
        converged=converged,
    )


def information_at(problem: Problem, unbalance: np.ndarray) -> Fitted:
    """Return a fit without iterations, whose information is that at the first values of the unknowns.

    **Arguments**: `unbalance`: components (a, b) of each unbalance; states and offsets are 0.
    """
    linear = np.zeros(_linear_count(problem))
    linear[: unbalance.size] = unbalance
    x = np.zeros(problem.unknowns.count)
    information, prior, _ = _equations(problem, _Trial(x, linear, 0.0))
    return Fitted(x, linear, problem, information, prior, (), (), True)
