"""Many searches at once: a descent on optax that keeps held quantities, then polishing by Newton's method.

Only the quantities and their derivatives are compiled, once for all starts; the searches themselves are a few small matrices
a step and run in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxvib.steady.jams.jam import jam_modes
from optimize.quantities import Quantity
from optimize.space import DesignSpace

__all__ = ["Polished", "Search", "Starts", "descend", "draw_starts", "polish"]

_FEASIBLE = 1e-8
"""How well held quantities must be kept in the end, relative to their value."""

_ON_THE_WAY = 0.1
"""How well they must be kept during the descent, where every step corrects what the one before left."""

Tell = Callable[[float], None]


class Point(NamedTuple):
    """Designs z (s, d), their values (s, 1 + m), the objective first, then by how much what is held is off, and derivatives."""

    z: np.ndarray
    values: np.ndarray
    slopes: np.ndarray

    def good(self, kept: float) -> np.ndarray:
        """Whether the objective exists there, with its derivatives, and what is held is kept that well (s,)."""
        finite = np.all(np.isfinite(self.values), axis=1) & np.all(np.isfinite(self.slopes), axis=(1, 2))
        with np.errstate(invalid="ignore"):
            return finite & np.all(np.abs(self.values[:, 1:]) < kept, axis=1)

    def where(self, chosen: np.ndarray, other: Point) -> Point:
        """This point where `chosen`, the other elsewhere."""
        return Point(*(np.where(chosen.reshape((-1,) + (1,) * (a.ndim - 1)), a, b) for a, b in zip(self, other, strict=True)))


class Search(eqx.Module):
    """A design space and what is to be small in it."""

    space: DesignSpace
    objective: Quantity = eqx.field(static=True)

    def values(self, z: Array) -> Array:
        """The objective and the residuals of what is held, (1 + m,), of one design."""
        scene = self.space.at(z)
        modes = jam_modes(scene)
        return jnp.concatenate([jnp.reshape(self.objective(scene, modes), (1,)), self.space.residuals(scene, modes)])

    def at(self, z: np.ndarray) -> Point:
        """Values and derivatives of many designs."""
        values, slopes = _evaluated(self, jnp.asarray(z))
        return Point(z, np.asarray(values), np.asarray(slopes))


@eqx.filter_jit
def _evaluated(search: Search, z: Array) -> tuple[Array, Array]:
    def twice(x: Array) -> tuple[Array, Array]:
        out = search.values(x)
        return out, out

    derive = jax.jacfwd if z.shape[1] <= 4 * (1 + len(search.space.held)) else jax.jacrev
    slopes, values = jax.vmap(derive(twice, has_aux=True))(z)
    return values, slopes


def _transposed(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, 1, 2)


def _least(slopes: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The shortest x (s, d) with slopes (s, m, d) times x = right (s, m)."""
    gram = slopes @ _transposed(slopes)
    ridge = np.finfo(float).eps * (1.0 + np.trace(gram, axis1=1, axis2=2))
    solved = np.linalg.solve(gram + ridge[:, None, None] * np.eye(gram.shape[1]), right[..., None])
    return (_transposed(slopes) @ solved)[..., 0]


def _along(vector: np.ndarray, slopes: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The part of `vector` (s, d) that moves free numbers only and changes nothing that is held."""
    vector = vector * free
    if slopes.shape[1] == 1:
        return vector
    held = slopes[:, 1:] * free[:, None, :]
    return vector - _least(held, np.einsum("smd,sd->sm", held, vector))


def _downhill(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """The objective's gradient along what may move, (s, d): not against a bound nor what is held; and what may move."""
    free = np.ones_like(point.z)
    for _ in range(2):
        slope = _along(point.slopes[:, 0], point.slopes, free)
        free = np.where(((point.z <= 0.0) & (slope > 0.0)) | ((point.z >= 1.0) & (slope < 0.0)), 0.0, free)
    return _along(point.slopes[:, 0], point.slopes, free), free


def _back(point: Point) -> np.ndarray:
    """The step (s, d) back onto what is held: Gauss-Newton, by the numbers that no bound stops."""
    if point.slopes.shape[1] == 1:
        return np.zeros_like(point.z)
    finite = np.all(np.isfinite(point.slopes), axis=(1, 2)) & np.all(np.isfinite(point.values), axis=1)
    slopes = np.where(finite[:, None, None], point.slopes, 0.0)[:, 1:]
    values = np.where(finite[:, None], point.values, 0.0)[:, 1:]
    wanted = -_least(slopes, values)
    stopped = ((point.z <= 0.0) & (wanted < 0.0)) | ((point.z >= 1.0) & (wanted > 0.0))
    return -_least(slopes * np.where(stopped, 0.0, 1.0)[:, None, :], values)


def _restored(search: Search, z: np.ndarray, steps: int) -> Point:
    """The designs nearest to `z`, to first order, that keep what is held, inside the bounds."""
    point = search.at(z)
    if search.space.held:
        for _ in range(steps):
            point = search.at(np.clip(point.z + _back(point), 0.0, 1.0))
    return point


class Starts(NamedTuple):
    """Designs to start from: `z` (starts, d), and how many had to be `drawn` to find as many that are possible; how many of
    those have the objective, `existing`, and by how much the `nearest` of them is off what is held."""

    z: np.ndarray
    drawn: int
    existing: int
    nearest: float


def draw_starts(search: Search, starts: int, seed: int, rounds: int = 20) -> Starts:
    """Random designs in the bounds, moved onto what is held; those where the objective does not exist are drawn anew."""
    random = np.random.default_rng(seed)
    found = np.zeros((0, search.space.size))
    drawn, existing, nearest = 0, 0, np.inf
    while len(found) < starts and drawn < rounds * starts:
        point = _restored(search, random.uniform(size=(starts, search.space.size)), 6)
        found = np.concatenate([found, point.z[point.good(_FEASIBLE)]])
        drawn += starts
        there = np.all(np.isfinite(point.values), axis=1)
        existing += int(np.sum(there))
        nearest = min([nearest, *np.max(np.abs(point.values[there, 1:]), axis=1, initial=0.0)])
    return Starts(found[:starts], drawn, existing, nearest)


def descend(search: Search, z: np.ndarray, steps: int, rate: float, tell: Tell) -> tuple[np.ndarray, np.ndarray]:
    """Adam (optax) from every start at once; each step goes along what is held and corrects what the last one left of it.

    A step to a design where the objective does not exist is not taken, and that start's steps become half as long.

    **Returns** the designs (starts, d) and the objective on the way (steps, starts).
    """
    method = optax.adam(optax.cosine_decay_schedule(rate, steps, alpha=0.01))
    state = method.init(jnp.asarray(z))
    update = jax.jit(method.update)
    point = search.at(z)
    scale = np.ones((len(z), 1))
    history = []
    for k in range(steps):
        gradient, free = _downhill(point)
        move, state = update(jnp.asarray(gradient), state)
        step = scale * (_along(np.asarray(move), point.slopes, free) + _back(point))
        new = search.at(np.clip(point.z + step, 0.0, 1.0))
        good = new.good(_ON_THE_WAY)
        point = new.where(good, point)
        scale = np.where(good[:, None], np.minimum(1.0, 1.2 * scale), 0.5 * scale)
        history.append(point.values[:, 0])
        tell((k + 1) / steps)
    return point.z, np.asarray(history)


class Polished(NamedTuple):
    """Where searches ended: designs `z` (starts, d); the objective on the way, `history` (steps, starts); `left`, by how much
    it could still fall in relation to its value, as its slopes and curvatures tell, and whether the design is possible, `good`
    (starts,)."""

    z: np.ndarray
    history: np.ndarray
    left: np.ndarray
    good: np.ndarray


def polish(search: Search, z: np.ndarray, steps: int, tell: Tell) -> Polished:
    """Newton's method on the Lagrangian, within what is held and between the bounds, from every start at once.

    The second derivatives are central differences of the exact first ones. A step that does not lead down is taken back,
    and the next one is a quarter as long.
    """
    point = _restored(search, z, 4)
    scale = np.ones((len(z), 1))
    history = [point.values[:, 0]]
    for k in range(steps):
        gradient, free = _downhill(point)
        newton = _newton(search, point, gradient, free)
        new = _restored(search, np.clip(point.z + scale * newton, 0.0, 1.0), 2)
        better = new.good(_FEASIBLE) & (new.values[:, 0] < point.values[:, 0])
        better |= new.good(_FEASIBLE) & ~point.good(_FEASIBLE)
        point = new.where(better, point)
        scale = np.where(better[:, None], np.minimum(1.0, 4.0 * scale), 0.25 * scale)
        history.append(point.values[:, 0])
        tell((k + 1) / steps)
    gradient, free = _downhill(point)
    newton = _newton(search, point, gradient, free)
    gain = -np.einsum("sd,sd->s", gradient, newton) / 2.0
    left = gain / np.maximum(np.abs(point.values[:, 0]), np.finfo(float).tiny)
    return Polished(point.z, np.asarray(history), left, point.good(_FEASIBLE))


def _newton(search: Search, point: Point, gradient: np.ndarray, free: np.ndarray) -> np.ndarray:
    d = point.z.shape[1]
    held = point.slopes[:, 1:] * free[:, None, :]
    gram = held @ _transposed(held)
    right = np.einsum("smd,sd->sm", held, point.slopes[:, 0] * free)
    ridge = np.finfo(float).eps * (1.0 + np.trace(gram, axis1=1, axis2=2))[:, None, None]
    multipliers = np.linalg.solve(gram + ridge * np.eye(gram.shape[1]), right[..., None])[..., 0]
    weights = np.concatenate([np.ones((len(right), 1)), -multipliers], axis=1)

    width = 1e-5
    bend = np.empty((len(point.z), d, d))
    for i in range(d):
        shift = width * np.eye(d)[i]
        high, low = search.at(point.z + shift), search.at(point.z - shift)
        bend[:, i] = np.einsum("sm,smd->sd", weights, high.slopes - low.slopes) / (2.0 * width)
    usable = np.all(np.isfinite(bend), axis=(1, 2), keepdims=True)
    bend = np.where(usable, bend, np.eye(d))
    columns = [_along(bend[:, i], point.slopes, free) for i in range(d)]
    rows = np.stack(columns, axis=1)
    bend = np.stack([_along(rows[:, :, i], point.slopes, free) for i in range(d)], axis=2)
    size, shape = np.linalg.eigh((bend + _transposed(bend)) / 2.0)
    size = np.maximum(np.abs(size), 1e-10 * np.max(np.abs(size), axis=1, keepdims=True) + np.finfo(float).tiny)
    newton = -np.einsum("sij,sj->si", shape, np.einsum("sji,sj->si", shape, gradient) / size)
    newton = _along(newton, point.slopes, free)
    return newton * np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(newton, axis=1, keepdims=True), 1e-300))
