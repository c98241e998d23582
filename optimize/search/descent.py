"""Descent by Adam (optax) from many starts at once, with held quantities and with demands (by an augmented Lagrangian).

Sizes of arrays: d free parameters, m held quantities.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxvib.numerics.linalg import small_solve
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from optimize.quantities.evaluation import mapped
from optimize.search.problem import Point, Problem, derive

STEPS_PER_CALL = 25
"""Number of steps of the descent in one call of its program."""

_DESCENT_VIOLATION = 0.1
"""Largest relative deviation of held quantities after an accepted step of the descent; the next step corrects it."""

_STEPS_PER_UPDATE = 20
"""Number of steps between updates of the multipliers of demands."""


class _SearchState(NamedTuple):
    """State of one search.

    It contains the design with its values and derivatives (as in `Point`), the state of Adam, the step `length`, and the
    multipliers and the weight of the demands. `worst` is the largest violation of a demand at the last update of the
    multipliers. The objective is divided by `scale`, the modulus of the initial objective. `steps` is the number of steps.
    """

    z: Array
    values: Array
    slopes: Array
    speeds: tuple[Array, ...]
    speed_slopes: tuple[Array, ...]
    adam: optax.OptState
    length: Array
    multipliers: Array
    weight: Array
    worst: Array
    scale: Array
    steps: Array


class Descended(NamedTuple):
    """Result of the descent: a `Point`, the multipliers of the demands and the history (steps, starts, 2) of the objective and
    the largest violation."""

    point: Point
    multipliers: np.ndarray
    history: np.ndarray


_ADAM = optax.scale_by_adam()


def _least_norm_solution(rows: Array, right: Array) -> Array:
    """Return the solution x (d,) of least norm of rows (m, d) x = right (m,)."""
    gram = rows @ rows.T
    ridge = jnp.finfo(gram.dtype).eps * (1.0 + jnp.trace(gram))
    return rows.T @ small_solve(gram + ridge * jnp.eye(gram.shape[0]), right)


def _project(vector: Array, held: Array, free: Array) -> Array:
    """Project `vector` (d,) onto changes of free parameters that keep the held quantities."""
    vector = vector * free
    if held.shape[0] == 0:
        return vector
    rows = held * free[None, :]
    return vector - _least_norm_solution(rows, rows @ vector)


@cached
def _initial_states(point: Any, multipliers: Array) -> _SearchState:
    state = jax.vmap(_ADAM.init)(point.z)
    n = point.z.shape[0]
    ones = jnp.ones(n)
    scale = jnp.maximum(jnp.abs(point.values[:, 0]), 1e-300)
    worst = jnp.full(n, jnp.inf)
    z, values, slopes, speeds, speed_slopes, *_ = point
    return _SearchState(
        z, values, slopes, speeds, speed_slopes, state, ones, multipliers, 10.0 * ones, worst, scale, jnp.zeros(n, int)
    )


def _step(problem: Problem, state: _SearchState, rate: Array) -> tuple[_SearchState, Array]:
    m = problem.equalities
    deviations, excess = state.values[1 : 1 + m], state.values[1 + m :]
    held = state.slopes[1 : 1 + m]
    demand_weights = jnp.maximum(0.0, state.multipliers + state.weight * excess)
    slope = state.slopes[0] / state.scale + demand_weights @ state.slopes[1 + m :]
    free = jnp.ones_like(state.z)
    for _ in range(2):
        down = _project(slope, held, free)
        free = jnp.where(((state.z <= 0.0) & (down > 0.0)) | ((state.z >= 1.0) & (down < 0.0)), 0.0, free)
    move, adam = _ADAM.update(_project(slope, held, free), state.adam)
    step = -rate * _project(jnp.asarray(move), held, free)
    if m:
        correction = -_least_norm_solution(held, deviations)
        stopped = ((state.z <= 0.0) & (correction < 0.0)) | ((state.z >= 1.0) & (correction > 0.0))
        step = step - _least_norm_solution(held * jnp.where(stopped, 0.0, 1.0)[None, :], deviations)
    z = jnp.clip(state.z + state.length * step, 0.0, 1.0)
    near = tuple(_extrapolate(w, r, z - state.z) for w, r in zip(state.speeds, state.speed_slopes, strict=True))
    values, slopes, speeds, speed_slopes = derive(problem, z, near)
    is_finite = jnp.all(jnp.isfinite(values)) & jnp.all(jnp.isfinite(slopes))
    is_accepted = is_finite & jnp.all(jnp.abs(values[1 : 1 + m]) < _DESCENT_VIOLATION) & (rate > 0.0)

    def select(new: Array, old: Array) -> Array:
        return jnp.where(is_accepted, new, old)

    new = (z, values, slopes, speeds, speed_slopes)
    z, values, slopes, speeds, speed_slopes = jax.tree.map(
        select, new, (state.z, state.values, state.slopes, state.speeds, state.speed_slopes)
    )
    length = jnp.where(is_accepted, jnp.minimum(1.0, 1.2 * state.length), 0.5 * state.length)

    update = (state.steps % _STEPS_PER_UPDATE == _STEPS_PER_UPDATE - 1) & (rate > 0.0)
    excess = values[1 + m :]
    multipliers = jnp.where(update, jnp.maximum(0.0, state.multipliers + state.weight * excess), state.multipliers)
    worst = jnp.max(jnp.maximum(excess, 0.0), initial=0.0)
    slow = update & (worst > 0.5 * state.worst) & (worst > 1e-6)
    weight = jnp.where(slow, jnp.minimum(3.0 * state.weight, 1e4), state.weight)
    state = _SearchState(
        z, values, slopes, speeds, speed_slopes, adam, length, multipliers, weight,
        jnp.where(update, worst, state.worst), state.scale, state.steps + 1,
    )  # fmt: skip
    violation = jnp.maximum(worst, jnp.max(jnp.abs(values[1 : 1 + m]), initial=0.0))
    return state, jnp.stack([values[0], violation])


def _extrapolate(speeds: Array, speed_slopes: Array, step: Array) -> Array:
    extrapolated = speeds + speed_slopes @ step
    return jnp.where(jnp.isfinite(extrapolated) & (jnp.abs(extrapolated / speeds - 1.0) < 0.2), extrapolated, speeds)


@cached
def _run_steps(problem: Problem, states: _SearchState, rates: Array) -> tuple[_SearchState, Array]:
    def step(states: _SearchState, rate: Array) -> tuple[_SearchState, Array]:
        return mapped(lambda state: _step(problem, state, rate), one_by_one=problem.forward_only)(states)

    states, history = jax.lax.scan(step, states, rates)
    return states, history.swapaxes(0, 1)


def descend(problem: Problem, point: Point, steps: int, rate: float, report: Callable[[float, Point], None]) -> Descended:
    """Descend by Adam from all starts at once; each step keeps the held quantities and corrects their deviations.

    Demands are included by the augmented Lagrangian sum_i (max(0, l_i + w g_i)^2 - l_i^2)/(2 w) with the excesses g_i. The
    multipliers l_i and the weight w are updated every 20 steps. A step is rejected if a quantity does not exist for the new
    design, or if a held quantity deviates by more than 10 %. The step length of this search is then halved. `report` is called
    with the progress (0 to 1) and the point.

    **Returns** `Descended`.
    """
    schedule = optax.cosine_decay_schedule(rate, steps, alpha=0.01)
    rates = np.asarray(jax.jit(schedule)(np.arange(steps)))
    rates = np.pad(rates, (0, -steps % STEPS_PER_CALL)).reshape(-1, STEPS_PER_CALL)
    states = in_chunks(problem.designs_per_call, _initial_states, point, np.zeros((len(point.z), len(problem.demands))))
    history: list[np.ndarray] = []
    for k, part in enumerate(rates):
        part_rates = on_device(part)
        states, values = in_chunks(
            problem.designs_per_call, lambda state, part_rates=part_rates: _run_steps(problem, state, part_rates), states
        )
        history.append(values)
        report((k + 1) / len(rates), _point(states))
    values = np.concatenate(history, axis=1)[:, :steps]
    return Descended(_point(states), states.multipliers, values.swapaxes(0, 1))


def _point(states: _SearchState) -> Point:
    """Return the designs of all searches, without pieces of the objective."""
    z, values, slopes = (np.asarray(array) for array in states[:3])
    empty = np.zeros((len(z), 0))
    return Point(z, values, slopes, states.speeds, states.speed_slopes, empty, np.zeros((*empty.shape, z.shape[1])))
