"""Many searches at once: a descent on optax that keeps held quantities, then polishing by Newton's method."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import Array

from optimize.quantities import Quantity
from optimize.space import DesignSpace

__all__ = ["Search", "Starts", "descend", "draw_starts", "polish"]

_FEASIBLE = 1e-8
"""How well held quantities must be kept, relative to their value."""


class Search(eqx.Module):
    """A design space and what is to be small in it."""

    space: DesignSpace
    objective: Quantity = eqx.field(static=True)

    def values(self, z: Array) -> Array:
        """The objective and the residuals of what is held, (1 + m,)."""
        scene = self.space.at(z)
        return jnp.concatenate([jnp.reshape(self.objective(scene), (1,)), self.space.residuals(scene)])

    def values_and_jacobian(self, z: Array) -> tuple[Array, Array]:
        """`values` and their derivatives (1 + m, d); forward mode unless there are many free numbers."""
        d, rows = z.shape[0], 1 + len(self.space.held)

        def twice(x: Array) -> tuple[Array, Array]:
            out = self.values(x)
            return out, out

        derive = jax.jacfwd if d <= 4 * rows else jax.jacrev
        jacobian, values = derive(twice, has_aux=True)(z)
        return values, jacobian

    def good(self, values: Array) -> Array:
        """Whether the objective exists there and what is held is kept."""
        return jnp.all(jnp.isfinite(values)) & jnp.all(jnp.abs(values[1:]) < _FEASIBLE)

    def restored(self, z: Array, steps: int) -> Array:
        """The design nearest to `z`, to first order, that keeps what is held: Gauss-Newton steps inside the bounds."""
        if not self.space.held:
            return z
        for _ in range(steps):
            values, jacobian = self.values_and_jacobian(z)
            wanted = -jacobian[1:].T @ _gram_solve(jacobian[1:], values[1:])
            # A number that its bound stops takes no part: the others have to do its share.
            free = (((z > 0.0) | (wanted > 0.0)) & ((z < 1.0) | (wanted < 0.0))).astype(z.dtype)
            slopes = jacobian[1:] * free[None, :]
            step = -slopes.T @ _gram_solve(slopes, values[1:])
            z = jnp.clip(z + jnp.where(jnp.isfinite(step), step, 0.0), 0.0, 1.0)
        return z

    def downhill(self, z: Array, jacobian: Array) -> tuple[Array, Array]:
        """The objective's gradient along what may move (d,): not against a bound, not against what is held; and what may."""
        free = jnp.ones_like(z)
        for _ in range(2):
            slope = _tangent(jacobian, free)
            stopped = ((z <= 0.0) & (slope > 0.0)) | ((z >= 1.0) & (slope < 0.0))
            free = jnp.where(stopped, 0.0, free)
        return _tangent(jacobian, free), free


def _gram_solve(slopes: Array, right: Array) -> Array:
    gram = slopes @ slopes.T
    ridge = jnp.finfo(gram.dtype).eps * (1.0 + jnp.trace(gram))
    return jnp.linalg.solve(gram + ridge * jnp.eye(gram.shape[0]), right)


def _project(vector: Array, slopes: Array, free: Array) -> Array:
    """The part of `vector` that moves free numbers only and changes nothing that is held."""
    slopes, vector = slopes * free[None, :], vector * free
    if slopes.shape[0] == 0:
        return vector
    return vector - slopes.T @ _gram_solve(slopes, slopes @ vector)


def _tangent(jacobian: Array, free: Array) -> Array:
    return _project(jacobian[0], jacobian[1:], free)


class Starts(NamedTuple):
    """Designs to start from: `z` (starts, d), and how many had to be `drawn` to find as many that are possible."""

    z: Array
    drawn: int


@eqx.filter_jit
def _draw(search: Search, key: Array, count: int) -> tuple[Array, Array]:
    z = jax.random.uniform(key, (count, search.space.size), dtype=float)
    z = jax.vmap(lambda x: search.restored(x, 8))(z)
    return z, jax.vmap(search.good)(jax.vmap(search.values)(z))


def draw_starts(search: Search, starts: int, seed: int, rounds: int = 20) -> Starts:
    """Random designs in the bounds, moved onto what is held; those where the objective does not exist are drawn anew."""
    key = jax.random.key(seed)
    found = jnp.zeros((0, search.space.size))
    drawn = 0
    for _ in range(rounds):
        key, now = jax.random.split(key)
        z, good = _draw(search, now, starts)
        found = jnp.concatenate([found, z[good]])
        drawn += starts
        if found.shape[0] >= starts:
            break
    return Starts(found[:starts], drawn)


@eqx.filter_jit
def descend(search: Search, z: Array, steps: int, rate: float) -> tuple[Array, Array]:
    """Adam (optax) from every start at once, each step taken along what is held and then put back onto it.

    A step to a design where the objective does not exist is not taken, and the start's steps become half as long.

    **Returns** the designs (starts, d) and the objective on the way (steps, starts).
    """
    method = optax.adam(optax.cosine_decay_schedule(rate, steps, alpha=0.01))

    def one(z: Array) -> tuple[Array, Array]:
        def step(carry: tuple, _: None) -> tuple[tuple, Array]:
            z, values, jacobian, state, scale = carry
            gradient, free = search.downhill(z, jacobian)
            update, state = method.update(gradient, state)
            new = search.restored(jnp.clip(z + scale * _project(update, jacobian[1:], free), 0.0, 1.0), 2)
            new_values, new_jacobian = search.values_and_jacobian(new)
            good = search.good(new_values) & jnp.all(jnp.isfinite(new_jacobian))
            z, values, jacobian = jax.tree.map(
                lambda a, b: jnp.where(good, a, b), (new, new_values, new_jacobian), (z, values, jacobian)
            )
            scale = jnp.where(good, jnp.minimum(1.0, 1.2 * scale), 0.5 * scale)
            return (z, values, jacobian, state, scale), values[0]

        values, jacobian = search.values_and_jacobian(z)
        (z, *_), history = jax.lax.scan(step, (z, values, jacobian, method.init(z), jnp.ones(())), None, length=steps)
        return z, history

    z, history = jax.vmap(one)(z)
    return z, history.T


_LENGTHS = 0.5 ** jnp.arange(0, 24, 2)


@eqx.filter_jit
def polish(search: Search, z: Array, steps: int) -> tuple[Array, Array, Array, Array]:
    """Newton's method on the Lagrangian, within what is held and between the bounds, with a line search, from all at once.

    **Returns** the designs (starts, d), the objective on the way (steps, starts), what is left of the gradient along what may
    move relative to the objective (starts,), and whether the design is possible (starts,).
    """

    def curvature(z: Array, multipliers: Array) -> Array:
        def lagrangian(x: Array) -> Array:
            values = search.values(x)
            return values[0] - multipliers @ values[1:]

        return jax.jacfwd(jax.jacfwd(lagrangian))(z)

    def one(z: Array) -> tuple[Array, Array, Array, Array]:
        def step(z: Array, _: None) -> tuple[Array, Array]:
            values, jacobian = search.values_and_jacobian(z)
            gradient, free = search.downhill(z, jacobian)
            slopes = jacobian[1:] * free[None, :]
            multipliers = _gram_solve(slopes, slopes @ (jacobian[0] * free)) if search.space.held else jnp.zeros((0,))
            along = jax.vmap(lambda v: _project(v, jacobian[1:], free))
            bend = along(along(curvature(z, multipliers)).T)
            bend = jnp.where(jnp.all(jnp.isfinite(bend)), (bend + bend.T) / 2.0, jnp.eye(z.shape[0]))
            size, shape = jnp.linalg.eigh(bend)
            size = jnp.maximum(jnp.abs(size), 1e-10 * jnp.max(jnp.abs(size)) + jnp.finfo(z.dtype).tiny)
            newton = -_project(shape @ ((shape.T @ gradient) / size), jacobian[1:], free)
            newton = newton * jnp.minimum(1.0, 0.3 / jnp.maximum(jnp.linalg.norm(newton), 1e-300))
            tries = jax.vmap(lambda a: search.restored(jnp.clip(z + a * newton, 0.0, 1.0), 2))(_LENGTHS)
            tried = jax.vmap(search.values)(tries)
            score = jnp.where(jax.vmap(search.good)(tried), tried[:, 0], jnp.inf)
            best = jnp.argmin(score)
            better = score[best] < values[0]
            return jnp.where(better, tries[best], z), jnp.where(better, score[best], values[0])

        z, history = jax.lax.scan(step, z, None, length=steps)
        values, jacobian = search.values_and_jacobian(z)
        gradient, _ = search.downhill(z, jacobian)
        left = jnp.linalg.norm(gradient) / jnp.maximum(jnp.abs(values[0]), jnp.finfo(z.dtype).tiny)
        return z, history, left, search.good(values)

    z, history, left, good = jax.vmap(one)(z)
    return z, history.T, left, good
