"""Extrema of evenly sampled motions between their samples."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.fence import fence, hidden_one

NODES = 4
"""Number of neighbouring samples whose values and slopes a polynomial interpolates."""

_MIDDLE = (NODES - 1) / 2.0
"""Origin of the polynomial, in steps from its first sample."""


def _hermite() -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices (4, 3) and (4, 4) that give the even and the odd coefficients of `_polynomial`. They multiply sums
    and differences of the values and slopes at the two inner points and at the two outer points. Values are relative to the
    mean of the inner values; the sum of the inner values is therefore 0 and is omitted."""
    nodes, even = np.asarray([[0.5], [1.5]]), np.asarray([0, 2, 4, 6])

    def inverse(powers: np.ndarray) -> np.ndarray:
        return 0.5 * np.linalg.inv(np.concatenate([nodes**powers, powers * nodes ** np.maximum(powers - 1, 0)]))

    return inverse(even)[:, 1:], inverse(even + 1)


_EVEN, _ODD = _hermite()


def _extrapolation() -> tuple[np.ndarray, np.ndarray]:
    """Return two matrices (2, 8) that multiply the values and slopes of four samples. They give value and slope of the
    polynomial through the samples, one step before the first sample and one step after the last sample."""
    powers = np.arange(2 * NODES)

    def rows(positions: np.ndarray) -> np.ndarray:
        s = positions[:, None]
        return np.concatenate([s**powers, powers * s ** np.maximum(powers - 1, 0)])

    weights = rows(np.asarray([-1.0, 1.0]) * (_MIDDLE + 1.0)) @ np.linalg.inv(rows(np.arange(NODES) - _MIDDLE))
    return weights[0::2], weights[1::2]


_BEFORE, _AFTER = _extrapolation()


_MAX_CURVATURE = 0.6
"""Largest second difference of three samples, relative to the middle one, for which a parabola is used; that of a cosine with 8
samples in a period is 0.59."""


def sampled_maximum(values: Array, axis: int) -> Array:
    """Return the largest value of an evenly sampled function that is not negative, along an axis.

    A parabola through a sample and its two neighbours estimates a maximum between the samples. For a cosine with n samples in a
    period, the estimate is too small by at most 9e-3 (n = 8), 6e-4 (16), 4e-5 (32); the largest sample by 8e-2, 2e-2, 5e-3. If
    the neighbours are much smaller than the sample, the samples do not resolve the function, and no parabola is used.

    The result is NaN unless all values are finite; XLA's maximum can ignore a NaN.
    """
    values = jnp.moveaxis(values, axis, -1)
    left, middle, right = values[..., :-2], values[..., 1:-1], values[..., 2:]
    curvature = 2.0 * middle - left - right
    is_peak = (middle >= left) & (middle >= right) & (curvature > 0.0) & (curvature <= _MAX_CURVATURE * middle)
    above = jnp.where(is_peak, (right - left) ** 2 / (8.0 * jnp.where(is_peak, curvature, 1.0)), 0.0)
    largest = jnp.maximum(jnp.max(middle + above, axis=-1, initial=0.0), jnp.max(values, axis=-1))
    return jnp.where(jnp.all(jnp.isfinite(values), axis=-1), largest, jnp.nan)


def locate_extrema(x: Array, v: Array) -> tuple[Array, Array, Array]:
    """Locate the extrema of an evenly sampled motion over its first half, its second half and all of it.

    Between two samples the motion is approximated by the polynomial p of degree 7 through the values and slopes of four
    samples. The two samples are the middle ones of the four; at the ends the outermost four samples are used. The error is

        |x - p| <= 0.32 / 8! max |d^8 x/ds^8|        (at the ends 1 / 8!)

    with s the time in steps: 4e-9 of the amplitude for 16 samples a period, and 256 times less for twice as many.

    **Arguments**: x, v (n,), n >= 4: samples, and their slopes times the sampling step.

    **Returns** three arrays (2, 3): the extrema, the index of the first of the four samples, and the position relative to this
    sample, in steps from 0 to 3. The rows are the minimum and the maximum; the columns are the first half, the second half and
    all samples.
    """
    n, half = len(x), len(x) // 2
    first = np.clip(np.arange(n - 1) - 1, 0, n - NODES)
    share, inner = _extrema_between(x, v)

    def maxima(sign: Array) -> tuple[Array, Array, Array]:
        """First maxima of `sign` times the motion over the first half of the samples, the second half and the step between."""
        samples, between = sign * x, sign * inner
        largest = jnp.maximum(between, samples[:-1])
        spans = (0, half), (half, n), (half - 1, half + 1)
        top = jnp.stack([jnp.max(largest[start : stop - 1]) for start, stop in spans])
        steps = np.arange(n - 1)
        where = [
            jnp.min(jnp.where(largest[start : stop - 1] == high, steps[start : stop - 1], stop - 2))
            for (start, stop), high in zip(spans, top, strict=True)
        ]
        ends = np.asarray([stop - 1 for _, stop in spans])
        last = samples[ends]
        k = jnp.where(last > top, ends - 1, jnp.stack(where))
        begin = jnp.asarray(first)[k]
        position = (k - begin) + jnp.where(last > top, 1.0, jnp.where(between[k] > samples[k], share[k], 0.0))
        value = jnp.maximum(top, last)
        position = jnp.where(jnp.isnan(value), jnp.nan, position)  # results that depend on the position are then NaN as well
        return value, begin, position

    signs = jnp.asarray([-1.0, 1.0], x.dtype)
    value, k, position = jax.vmap(maxima)(signs)
    best = jnp.argmax(value, axis=1)[:, None]
    value, k, position = (
        jnp.concatenate([row[:, :2], jnp.take_along_axis(row, best, 1)], axis=1)
        for row in (value * signs[:, None], k, position)
    )
    return value, k, position


def extremum_value(x: Array, v: Array, position: Array) -> Array:
    """Return the value at an extremum from four samples x (4,) and their slopes v (4,), see `locate_extrema`. `position`: in
    steps from the first sample. Derivatives of the value include the change of the position."""
    polynomial, s = _polynomial(x, v), position - _MIDDLE
    slope = _derivative(polynomial)
    curved = _at(_derivative(slope), s)
    inside = (position != jnp.round(position)) & (curved != 0.0)
    move = jnp.where(inside, _at(slope, s), 0.0) / jax.lax.stop_gradient(jnp.where(inside, curved, 1.0))
    return _at(polynomial, s - move + jax.lax.stop_gradient(move))


def between(begin: Sequence[Array], end: Sequence[Array], s: Array) -> tuple[Array, Array]:
    """Return value and slope of a motion within a step, at the position `s` from 0 to 1.

    They are those of the polynomial p of degree 5 through both ends: |x - p| <= max |d^6 x/ds^6| / 46080. A jump of the second
    derivative has no influence on other steps.

    **Arguments**: `begin` and `end`: value, slope and second derivative with respect to s at the ends of the step.
    """
    rise = end[0] - begin[0] - begin[1] - 0.5 * begin[2]
    slope, bend = end[1] - begin[1] - begin[2], end[2] - begin[2]
    cubic, quartic, quintic = (
        10.0 * rise - 4.0 * slope + 0.5 * bend,
        -15.0 * rise + 7.0 * slope - bend,
        6.0 * rise - 3.0 * slope + 0.5 * bend,
    )
    polynomial = [begin[0], begin[1], 0.5 * begin[2], cubic, quartic, quintic]
    return _at(polynomial, s), _at(_derivative(polynomial), s)


def greatest(values: Array) -> Array:
    """Return the maximum of numbers (n,), with the derivatives of the largest one. Those of `jnp.max` are 0/0 if the compiler
    recomputes the maximum with another rounding, because none of the numbers then equals it."""
    return values[jnp.argmax(values)]


def step_extrema(x: Array, v: Array) -> tuple[Array, Array]:
    """Return the minimum and the maximum of motions that are sampled at all steps of a run.

    Between two samples the motion is approximated by the cubic polynomial through their values and slopes. In contrast to the
    polynomials of `locate_extrema`, it needs no further samples, which may be beyond a kink. The relative error is
    (w h)^4 / 384 for a vibration of the rate w and a step h without a kink.

    **Arguments**: x, v (n, ...), n >= 2: samples, and their slopes times the sampling step. **Returns** two arrays (...).
    """
    rise, begin, end = x[1:] - x[:-1], v[:-1], v[1:]
    turns, share = _cubic_extremum(rise, begin, end)
    inner = x[:-1] + share * (begin + share * (3.0 * rise - 2.0 * begin - end + share * (begin + end - 2.0 * rise)))
    values = jnp.concatenate([x, jnp.where(turns, inner, x[:-1])])
    return jnp.min(values, axis=0), jnp.max(values, axis=0)


def _cubic_extremum(rise: Array, begin: Array, end: Array) -> tuple[Array, Array]:
    """Return True where a motion has an extremum between two samples, and its position from 0 to 1. The motion is a cubic
    polynomial with the `rise` of the values and with the slopes, times the sampling step, at its `begin` and `end`."""
    turns = begin * end < 0.0
    bend = 3.0 * rise - 2.0 * begin - end
    root = jnp.sqrt(jnp.where(turns, jnp.abs(bend**2 - 3.0 * (begin + end - 2.0 * rise) * begin), 1.0))
    divisor = bend + jnp.where(begin > 0.0, -root, root)
    return turns, jnp.clip(-begin / jnp.where(turns & (divisor != 0.0), divisor, 1.0), 0.0, 1.0)


def _extrema_between(x: Array, v: Array) -> tuple[Array, Array]:
    """Return, for each step between samples x with slopes v (n,), the position of the extremum, from 0 to 1, and the value
    there, both (n - 1,). In a step without an extremum the value is that of the first sample."""
    n, rise, begin, end, origin = len(x), x[1:] - x[:-1], v[:-1], v[1:], -0.5
    # A sample beyond each end, on the polynomial of the outermost four. The samples of each step are then slices, which are
    # read several times as fast as samples at given indices.
    first, last = x[:1], x[-1:]
    before = _BEFORE.astype(x.dtype) @ jnp.concatenate([x[:NODES] - first, v[:NODES]])
    after = _AFTER.astype(x.dtype) @ jnp.concatenate([x[-NODES:] - last, v[-NODES:]])
    padded = (jnp.concatenate([first + before[:1], x, last + after[:1]]), jnp.concatenate([before[1:], v, after[1:]]))
    polynomial = _polynomial(*([y[k : n - 1 + k] for k in range(NODES)] for y in padded))
    slope = _derivative(polynomial)
    curvature = _derivative(slope)
    # Newton's method starts at the extremum of the cubic polynomial through the two samples of the step and their slopes.
    turns, start = _cubic_extremum(rise, begin, end)

    def improved(share: Array) -> Array:
        curved = _at(curvature, origin + share)
        change = _at(slope, origin + share) / jnp.where(turns & (curved != 0.0), curved, 1.0)
        return jnp.clip(share - change, 0.0, 1.0)

    share = improved(start)
    value = jnp.where(turns, _at(polynomial, origin + share), x[:-1])
    # Without the barrier and the fence the compiler recomputes the polynomials for each use of their values.
    return jax.lax.optimization_barrier((improved(share), fence(value, hidden_one(x[0]))))


def _polynomial(x: Sequence[Array] | Array, v: Sequence[Array] | Array) -> list[Array]:
    """Return the 8 coefficients, lowest power first, of the polynomial through values and slopes at -3/2, -1/2, 1/2 and 3/2."""
    # Values are relative to the mean of the inner samples, so that a common offset causes no rounding error.
    inner = x[1] + x[2]
    even = x[0] + x[3] - inner, v[2] - v[1], v[3] - v[0]
    odd = x[2] - x[1], x[3] - x[0], v[1] + v[2], v[0] + v[3]
    parts = zip(_products(_EVEN, even), _products(_ODD, odd), strict=True)
    constant, *others = [coefficient for pair in parts for coefficient in pair]
    return [constant + 0.5 * inner, *others]


def _products(matrix: np.ndarray, vector: Sequence[Array]) -> list[Array]:
    """Return matrix times vector as unrolled sums, because the compiler cannot fuse a matrix product with other operations."""
    return [functools.reduce(operator.add, [float(m) * y for m, y in zip(row, vector, strict=True)]) for row in matrix]


def _derivative(polynomial: Sequence[Array]) -> list[Array]:
    return [k * c for k, c in enumerate(polynomial)][1:]


def _at(polynomial: Sequence[Array], s: Array) -> Array:
    return functools.reduce(lambda value, c: value * s + c, reversed(polynomial))
