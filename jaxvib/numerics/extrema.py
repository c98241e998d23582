"""Extrema of evenly sampled motions between their samples."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

__all__ = ["extremum_value", "locate_extrema"]


def locate_extrema(x: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Where the quintics through evenly spaced samples are least and greatest, over their first half, their second and all.

    x, v, a (n,) are samples and their first two derivatives, in units of the sampling step. **Returns** values there, the
    sample before each place, and at which share of the step after it the place is; (2, 3) each.
    """
    begin, end = ([part[cut] for part in (x, v, a)] for cut in (slice(-1), slice(1, None)))
    quintic = _quintic(begin, end)
    slope = _derived(quintic)
    bend = _derived(slope)
    turns = begin[1] * end[1] < 0.0
    share = jnp.clip(-begin[1] / jnp.where(turns, end[1] - begin[1], 1.0), 0.0, 1.0)
    for _ in range(4):
        curved = _at(bend, share)
        share = jnp.clip(share - _at(slope, share) / jnp.where(turns & (curved != 0.0), curved, 1.0), 0.0, 1.0)
    inner = jnp.where(turns, _at(quintic, share), x[:-1])
    n, half = len(x), len(x) // 2

    def greatest(sign: float, first: int, stop: int) -> tuple[Array, Array, Array]:
        inside = sign * inner > sign * x[:-1]
        reached = jnp.where(inside, sign * inner, sign * x[:-1])[first : stop - 1]
        top, last = jnp.max(reached), sign * x[stop - 1]
        value = jnp.maximum(top, last)
        k = first + jnp.min(jnp.where(reached == top, jnp.arange(stop - 1 - first), stop - 2 - first))
        place = jnp.where(last > top, 1.0, jnp.where(inside, share, 0.0)[k])
        place = jnp.where(jnp.isnan(value), jnp.nan, place)  # what is made of it later is not a number either
        return value, jnp.where(last > top, stop - 2, k), place

    found = []
    for sign in (-1.0, 1.0):
        parts = [greatest(sign, *stretch) for stretch in ((0, half), (half, n), (half - 1, half + 1))]
        value, k, place = (jnp.stack(column) for column in zip(*parts, strict=True))
        best = jnp.argmax(value)
        found.append([jnp.concatenate([row[:2], row[best][None]]) for row in (sign * value, k, place)])
    values, k, places = (jnp.stack(pair) for pair in zip(*found, strict=True))
    return values, k, places


def extremum_value(begin: Sequence[Array], end: Sequence[Array], share: Array) -> Array:
    """The quintic's value at an extremum, which stays one: where it is inside the step it moves with what it is made of."""
    quintic = _quintic(begin, end)
    slope = _derived(quintic)
    curved = _at(_derived(slope), share)
    inside = (share > 0.0) & (share < 1.0) & (curved != 0.0)
    move = jnp.where(inside, _at(slope, share), 0.0) / jax.lax.stop_gradient(jnp.where(inside, curved, 1.0))
    return _at(quintic, share - move + jax.lax.stop_gradient(move))


def _quintic(begin: Sequence[Array], end: Sequence[Array]) -> list[Array]:
    """Coefficients, of the lowest power first, of the Hermite interpolant through values and two derivatives at 0 and 1."""
    (x0, v0, a0), (x1, v1, a1) = begin, end
    d, e, f = x1 - x0 - v0 - a0 / 2.0, v1 - v0 - a0, a1 - a0
    return [
        x0,
        v0,
        a0 / 2.0,
        10.0 * d - 4.0 * e + f / 2.0,
        -15.0 * d + 7.0 * e - f,
        6.0 * d - 3.0 * e + f / 2.0,
    ]


def _derived(polynomial: list[Array]) -> list[Array]:
    return [float(k) * c for k, c in enumerate(polynomial)][1:]


def _at(polynomial: list[Array], s: Array) -> Array:
    return functools.reduce(lambda value, c: value * s + c, reversed(polynomial))
