"""Adam (optax) from many starts at once: along held quantities, with demands by an augmented Lagrangian."""

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
from optimize.search.problem import Point, Problem, derive

STRETCH = 25
"""Number of steps of the descent in one call of its program."""

_DESCENT_VIOLATION = 0.1
"""Allowed violation of held quantities during the descent, in which every step corrects the violation of the previous step."""

_STEPS_PER_UPDATE = 20
"""Number of steps between updates of the multipliers of demands."""


class _Lane(NamedTuple):
    """State of one search: the point, the state of Adam, the step length, multipliers and weight of the demands, the initial
    size of the objective, and the number of steps."""

    z: Array
    values: Array
    slopes: Array
    known: tuple[Array, ...]
    known_slopes: tuple[Array, ...]
    adam: optax.OptState
    length: Array
    multipliers: Array
    weight: Array
    worst: Array
    size: Array
    taken: Array


class Descended(NamedTuple):
    """Result of the descent: a `Point`, the multipliers of the demands and the history of the objective (steps, starts)."""

    point: Point
    multipliers: np.ndarray
    history: np.ndarray


_ADAM = optax.scale_by_adam()


def _least(rows: Array, right: Array) -> Array:
    """Return the solution x (d,) of least norm of rows (m, d) x = right (m,)."""
    gram = rows @ rows.T
    ridge = jnp.finfo(gram.dtype).eps * (1.0 + jnp.trace(gram))
    return rows.T @ small_solve(gram + ridge * jnp.eye(gram.shape[0]), right)


def _along(vector: Array, held: Array, free: Array) -> Array:
    """Project `vector` (d,) onto changes of free parameters that keep the held quantities."""
    vector = vector * free
    if held.shape[0] == 0:
        return vector
    rows = held * free[None, :]
    return vector - _least(rows, rows @ vector)


@cached
def _initial_lanes(point: Any, multipliers: Array) -> _Lane:
    lane = jax.vmap(_ADAM.init)(point.z)
    n = point.z.shape[0]
    one = jnp.ones(n)
    size = jnp.maximum(jnp.abs(point.values[:, 0]), 1e-300)
    worst = jnp.full(n, jnp.inf)
    z, values, slopes, known, known_slopes, *_ = point
    return _Lane(z, values, slopes, known, known_slopes, lane, one, multipliers, 10.0 * one, worst, size, jnp.zeros(n, int))


def _step(problem: Problem, lane: _Lane, rate: Array) -> tuple[_Lane, Array]:
    m = problem.equalities
    off, excess = lane.values[1 : 1 + m], lane.values[1 + m :]
    held = lane.slopes[1 : 1 + m]
    pull = jnp.maximum(0.0, lane.multipliers + lane.weight * excess)
    slope = lane.slopes[0] / lane.size + pull @ lane.slopes[1 + m :]
    free = jnp.ones_like(lane.z)
    for _ in range(2):
        down = _along(slope, held, free)
        free = jnp.where(((lane.z <= 0.0) & (down > 0.0)) | ((lane.z >= 1.0) & (down < 0.0)), 0.0, free)
    move, adam = _ADAM.update(_along(slope, held, free), lane.adam)
    step = -rate * _along(jnp.asarray(move), held, free)
    if m:
        correction = -_least(held, off)
        stopped = ((lane.z <= 0.0) & (correction < 0.0)) | ((lane.z >= 1.0) & (correction > 0.0))
        step = step - _least(held * jnp.where(stopped, 0.0, 1.0)[None, :], off)
    z = jnp.clip(lane.z + lane.length * step, 0.0, 1.0)
    near = tuple(_ahead(w, r, z - lane.z) for w, r in zip(lane.known, lane.known_slopes, strict=True))
    values, slopes, known, known_slopes = derive(problem, z, near)
    finite = jnp.all(jnp.isfinite(values)) & jnp.all(jnp.isfinite(slopes))
    good = finite & jnp.all(jnp.abs(values[1 : 1 + m]) < _DESCENT_VIOLATION) & (rate > 0.0)

    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(good, new, old)

    new = (z, values, slopes, known, known_slopes)
    z, values, slopes, known, known_slopes = jax.tree.map(
        chosen, new, (lane.z, lane.values, lane.slopes, lane.known, lane.known_slopes)
    )
    length = jnp.where(good, jnp.minimum(1.0, 1.2 * lane.length), 0.5 * lane.length)

    update = (lane.taken % _STEPS_PER_UPDATE == _STEPS_PER_UPDATE - 1) & (rate > 0.0)
    excess = values[1 + m :]
    multipliers = jnp.where(update, jnp.maximum(0.0, lane.multipliers + lane.weight * excess), lane.multipliers)
    worst = jnp.max(jnp.maximum(excess, 0.0), initial=0.0)
    slow = update & (worst > 0.5 * lane.worst) & (worst > 1e-6)
    weight = jnp.where(slow, jnp.minimum(3.0 * lane.weight, 1e4), lane.weight)
    lane = _Lane(
        z, values, slopes, known, known_slopes, adam, length, multipliers, weight,
        jnp.where(update, worst, lane.worst), lane.size, lane.taken + 1,
    )  # fmt: skip
    return lane, values[0]


def _ahead(known: Array, known_slopes: Array, step: Array) -> Array:
    moved = known + known_slopes @ step
    return jnp.where(jnp.isfinite(moved) & (jnp.abs(moved / known - 1.0) < 0.2), moved, known)


@cached
def _stretch(problem: Problem, lanes: _Lane, rates: Array) -> tuple[_Lane, Array]:
    def step(lanes: _Lane, rate: Array) -> tuple[_Lane, Array]:
        return jax.vmap(lambda lane: _step(problem, lane, rate))(lanes)

    lanes, history = jax.lax.scan(step, lanes, rates)
    return lanes, history.T


def descend(problem: Problem, point: Point, steps: int, rate: float, tell: Callable[[float, Point], None]) -> Descended:
    """Descend by Adam from all starts at once; each step keeps the held quantities and corrects their deviations.

    Demands are included by the augmented Lagrangian sum_i (max(0, l_i + w g_i)^2 - l_i^2)/(2 w) with multipliers l_i and the
    weight w, which are updated every 20 steps. A step to a design without the objective is rejected, and the step length of
    that start is halved. `tell` is called with the progress (0 to 1) and the point; an interrupt ends the descent.

    **Returns** `Descended`.
    """
    schedule = optax.cosine_decay_schedule(rate, steps, alpha=0.01)
    rates = np.asarray(jax.jit(schedule)(np.arange(steps)))
    rates = np.pad(rates, (0, -steps % STRETCH)).reshape(-1, STRETCH)
    lanes = in_chunks(problem.lanes, _initial_lanes, point, np.zeros((len(point.z), len(problem.demands))))
    history: list[np.ndarray] = []
    for k, part in enumerate(rates):
        each = on_device(part)
        lanes, values = in_chunks(problem.lanes, lambda lane, each=each: _stretch(problem, lane, each), lanes)
        history.append(values)
        tell((k + 1) / len(rates), _point(lanes))
    values = np.concatenate(history, axis=1)[:, :steps]
    return Descended(_point(lanes), lanes.multipliers, values.T)


def _point(lanes: _Lane) -> Point:
    """Return the point of the searches, without pieces of the objective."""
    z, values, slopes = (np.asarray(each) for each in lanes[:3])
    nothing = np.zeros((len(z), 0))
    return Point(z, values, slopes, lanes.known, lanes.known_slopes, nothing, np.zeros((*nothing.shape, z.shape[1])))
