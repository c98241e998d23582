"""First values of a motion on nonlinear supports: the records guide the motion.

At each sample, the state of the model is changed by a constant matrix times the difference between recorded and computed
readings, except during a contact with a stop. The motion then stays near the recorded one, contacts occur when they occurred in
the record, and the differences are nearly linear functions of errors of the unknowns. The matrix is that of the Kalman filter
of the machine without nonlinear supports, whose velocities change at random at each sample.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.identification.fit import Fitted, linear_at, linear_indices, minimize, project
from jaxvib.identification.problem import Problem, channel_sizes, with_noise
from jaxvib.identification.response import Samples, linear_steps, model_states
from jaxvib.machine.effects.supports import Stop
from jaxvib.numerics.noise import Noise

_STRENGTH = 0.3
"""Standard deviation of the random changes of the velocities at a sample, relative to the largest velocities. The errors of the
readings are assumed to be as large as the readings."""

_DECAY = 0.999
"""Factor by which the filter reduces the state at each sample. Without it the filter does not exist for a free mass between
stops, whose displacement no accelerometer observes."""

_FIRST_ANGLES = 8
"""Number of angles of the unbalance of which the best one begins the fit. Contacts change the phase of the vibration."""

_OPEN_GAP = 1.1
"""First value of a gap that is not touched, relative to the largest displacement."""

_SAME_COST = 1.1
"""The motion without contacts is chosen if its cost is below this multiple of the cost of the motion with contacts."""


def with_guided_motion(problem: Problem) -> tuple[Problem, np.ndarray]:
    """Return the problem of a motion on nonlinear supports with first values of the linear unknowns, and the first values x
    of the other unknowns.

    The linear response to the first record gives the size of the unbalance. The linear responses to the beginnings of all
    records (their first segments, see `Samples`) give the first states. If a fit of the linear machine explains the records as
    well as the fit that begins with the guided motion, no stop is touched.
    """
    noise = [[Noise(np.ones(1), size) for size in of_run] for of_run in channel_sizes(problem)]
    weighted, x = with_noise(problem, noise), np.zeros(problem.unknowns.count)
    linear = project(weighted._replace(runs=weighted.runs[:1]), x).linear
    angles, begins = 2.0 * np.pi / _FIRST_ANGLES * np.arange(_FIRST_ANGLES), tuple(map(_beginning, weighted.runs))
    unbalances = np.hypot(*linear[:2]) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    linear = linear_at(weighted._replace(runs=begins), x, unbalances[0])
    guides = [jnp.asarray(_guide(weighted, r, x, linear)) for r in range(len(problem.runs))]
    runs = tuple(dataclasses.replace(samples, guide=guide) for samples, guide in zip(weighted.runs, guides, strict=True))

    def guided_problem(chosen: slice, unbalance: np.ndarray) -> Problem:
        linear = linear_at(weighted._replace(runs=begins[chosen]), x, unbalance)
        guided = weighted._replace(runs=runs[chosen])
        return guided._replace(linear=with_first_states(guided, x, linear))

    alone = [slice(r, r + 1) for r in range(len(runs))]
    costs = np.array([[project(guided_problem(run, each), x).cost for each in unbalances] for run in alone])
    turns = [samples.turn for samples in runs]
    best_index = int(np.argmin(np.sum(costs[[turn is None for turn in turns]], axis=0)))
    for turn, cost in zip(turns, costs, strict=True):
        if turn is not None:
            index = problem.unknowns.first.shape[0] + len(problem.unknowns.gains) + turn
            x[index] = angles[np.argmin(cost)] - angles[best_index]
    first = guided_problem(slice(None), unbalances[best_index])
    touching, free = minimize(first, x)[0], minimize(weighted, x)[0]
    touching = minimize(weighted._replace(linear=touching.linear), touching.x)[0]
    problem_of_free = weighted._replace(linear=with_first_states(weighted, free.x, free.linear))
    free = project(problem_of_free, _with_open_stops(weighted, free.x, free.linear))
    best = free if free.cost < _SAME_COST * touching.cost else touching
    return problem._replace(linear=best.linear), best.x


def with_first_states(problem: Problem, x: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Return the linear unknowns with the displacements of the first states in m. In the linear response these unknowns are
    displacements times a frequency."""
    first = linear.copy()
    for samples, indices in zip(problem.runs, linear_indices(problem), strict=True):
        states = model_states(problem.unknowns, samples, problem.scene, jnp.asarray(x), jnp.asarray(linear[indices]))
        first[indices[: states.shape[1]]] = states[0]
    return first


def _beginning(samples: Samples) -> Samples:
    """Return the samples with the weight 0 for all samples after the first segment."""
    index = jnp.arange(samples.weights.shape[0] * samples.weights.shape[1]).reshape(samples.weights.shape[:2])
    weights = jnp.where(index[:, :, None] < samples.segments[1], samples.weights, 0.0)
    return dataclasses.replace(samples, weights=weights)


def _guide(problem: Problem, r: int, x: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Return the gain (ns, C) of the Kalman filter of a run."""
    from scipy.linalg import solve_discrete_are  # slow to import

    parts = problem.unknowns, problem.runs[r], problem.scene, jnp.asarray(x)
    power, outputs = (np.asarray(each) for each in linear_steps(*parts))
    states = np.asarray(model_states(*parts, jnp.asarray(linear[linear_indices(problem)[r]])))
    nd, random = states.shape[1] // 2, np.zeros(len(power))
    random[nd : 2 * nd] = (_STRENGTH * np.max(np.abs(states[: len(problem.raw[r]), nd:]), axis=0)) ** 2
    noise = np.diag(np.array(channel_sizes(problem)[r]) ** 2)
    covariance = solve_discrete_are(_DECAY * power.T, outputs.T, np.diag(random), noise)
    return covariance @ outputs.T @ np.linalg.inv(outputs @ covariance @ outputs.T + noise)


def _with_open_stops(problem: Problem, x: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Return x with unknown gaps that are so large that the linear response does not touch the stops.

    A stop that no run touches has the same effect as a very soft stop. A fit from a gap that is too small would therefore end
    at a very soft stop.
    """
    x, names = x.copy(), [number.name for number in problem.unknowns.numbers]
    paths, nd = [], len(problem.scene.machine.structure().coordinates)
    for samples, indices, raw in zip(problem.runs, linear_indices(problem), problem.raw, strict=True):
        states = model_states(problem.unknowns, samples, problem.scene, jnp.asarray(x), jnp.asarray(linear[indices]))
        paths.append(states[: len(raw), :nd])
    stops = [effect for effect in problem.unknowns.scene(problem.scene, x).effects if isinstance(effect, Stop)]
    for k, stop in enumerate(stops):
        if (name := f"effects.stop[{k}].gap") in names and float(stop.gap) > 0.0:
            path = jnp.concatenate(paths) @ stop.rows(problem.scene.machine).T
            largest = float(stop.gap + jnp.max(jax.vmap(lambda at, stop=stop: stop.penetration(at)[0])(path)))
            x[names.index(name)] += max(math.log(_OPEN_GAP * largest / float(stop.gap)), 0.0) if largest > 0.0 else 0.0
    return x


def untouched_stops(fitted: Fitted) -> Iterator[str]:
    """Yield sentences about stops whose parameters are unknown and have no influence, because no run touches them."""
    names = [number.name for number in fitted.problem.unknowns.numbers]
    influence = np.diagonal(fitted.information)[: len(names)]
    for k in range(len(fitted.problem.scene.effects)):
        own = [i for i, name in enumerate(names) if name.startswith(f"effects.stop[{k}].")]
        if own and not np.any(influence[own] > 0.0):
            yield (
                f"effects.stop[{k}] is not touched in the runs, which therefore do not determine its parameters: record a run "
                "with larger vibrations, or leave these parameters out of `unknown`"
            )
