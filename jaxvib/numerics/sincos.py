"""Sine and cosine without branches or tables, which a compiler can vectorize.

XLA's CPU backend calls the C library once for each number. Here the nearest multiple of pi (for the cosine: the nearest odd
multiple of pi/2) is subtracted from the angle. The multiple is a sum of three parts, which keeps the remainder accurate (Cody
and Waite). The sine of the remainder, which is at most pi/2, is an odd polynomial. The sine and the cosine share no
intermediate result, because the compiler would compute it twice in any case. For angles up to 1e5 (single precision: 1e3) the
error is below 1.1 times the distance from 1 to the next floating-point number. For larger angles it is proportional to the
rounding error of the angle, like the error of any sine of a rounded angle.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.fence import fence, hidden_one

_Both: TypeAlias = Callable[[Array], tuple[Array, Array]]

_PI = Fraction(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211706798214808651"
)

_TERMS = {np.dtype(np.float64): 8, np.dtype(np.float32): 5}
"""Number of terms of the polynomial in addition to the angle."""


def _parts(dtype: np.dtype) -> tuple[float, float, float]:
    """Return pi as a sum of three numbers, the first two with 22 unused bits (single precision: 11), so that their products
    with numbers up to 2^22 (2^11) are exact."""
    digits, spare = (53, 22) if dtype == np.float64 else (24, 11)
    parts, rest = [], _PI
    for _ in range(2):
        scale = 2 ** (digits - spare - math.frexp(float(rest))[1])
        part = Fraction(math.floor(rest * scale), scale)
        parts.append(float(part))
        rest -= part
    return parts[0], parts[1], float(rest)


@functools.cache
def _polynomial(terms: int) -> tuple[float, ...]:
    """Return the coefficients of P(z), lowest power first, with sin r = r + r z P(z), z = r^2 up to (pi/2)^2: Taylor's series
    economized by Chebyshev polynomials, whose error exceeds that of the best polynomial by a few percent."""
    scale = 2 / (_PI / 2) ** 2
    chebyshev = [[Fraction(1)], [Fraction(-1), scale]]
    series = [Fraction((-1) ** k, math.factorial(2 * k + 1)) for k in range(1, terms + 8)]
    while len(chebyshev) < len(series):
        before, last = chebyshev[-2:]
        following = [2 * scale * x for x in [Fraction(0), *last]]
        for k, x in enumerate(last):
            following[k] -= 2 * x
        for k, x in enumerate(before):
            following[k] -= x
        chebyshev.append(following)
    while len(series) > terms:
        least = chebyshev[len(series) - 1]
        share = series[-1] / least[-1]
        series = [x - share * y for x, y in zip(series[:-1], least[:-1], strict=True)]
    return tuple(float(x) for x in series)


def _summed(z: Array, coefficients: Sequence[float]) -> Array:
    """Return sum_k coefficients_k z^k, added in pairs (Estrin). The longest chain of dependent
    products is 3 for 7 coefficients and 2 for 4; in Horner's form it is 6 and 3."""
    parts: list[Array | float] = list(coefficients)
    while len(parts) > 1:
        parts = [parts[k] + parts[k + 1] * z if k + 1 < len(parts) else parts[k] for k in range(0, len(parts), 2)]
        z = z * z
    return jnp.asarray(parts[0])


def _sine(x: Array, ahead: float) -> Array:
    """Return sin(x + pi ahead); `ahead` is 0 or 1/2."""
    dtype = np.dtype(x.dtype)
    first, second, third = _parts(dtype)
    whole = jnp.round(x * float(1 / _PI) + ahead) if ahead else jnp.round(x * float(1 / _PI))
    halves = whole - ahead if ahead else whole
    r = ((x - halves * first) - halves * second) - halves * third
    z = r * r
    constant, *others = _polynomial(_TERMS[dtype])
    # The largest term is added last, which keeps the roundings of the others as small as in Horner's form.
    total = constant + z * _summed(z, others)
    # The sine changes its sign if the number `whole` of half turns is odd. The sum of `whole` and a large constant has no
    # fractional part, and its last bit is 1 if `whole` is odd. This bit is shifted to the position of the sign of 1, because
    # operations on bits take almost no time. The sine itself is not an operand of such an operation: JAX drops the rule of
    # `custom_jvp` in reverse derivatives of loops, so that second derivatives are those of the operations below.
    bits = np.dtype(f"uint{8 * dtype.itemsize}")
    beside = whole + 1.5 * 2.0 ** np.finfo(dtype).nmant
    sign = jax.lax.bitcast_convert_type(beside, bits) << bits.type(8 * dtype.itemsize - 1)
    one = jax.lax.bitcast_convert_type(sign | np.ones((), dtype).view(bits), dtype)
    return (r + (r * z) * total) * one


@jax.custom_jvp
def sine_and_cosine(x: Array) -> tuple[Array, Array]:
    """Return sin x and cos x; x in rad, any shape.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> s, c = sine_and_cosine(jnp.linspace(-50.0, 50.0, 1001))
    >>> bool(jnp.max(jnp.abs(s**2 + c**2 - 1.0)) < 1e-15)
    True
    """
    one = hidden_one(x)
    return fence(_sine(x, 0.0), one), fence(_sine(x, 0.5), one)


@jax.custom_jvp
def unfenced_sine_and_cosine(x: Array) -> tuple[Array, Array]:
    """Return `sine_and_cosine` without fences (see `jaxvib.numerics.fence`), for a program that adds its own."""
    return _sine(x, 0.0), _sine(x, 0.5)


def _derivative(function: _Both) -> Callable[[tuple[Array], tuple[Array]], tuple[tuple[Array, Array], tuple[Array, Array]]]:
    def jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        s, c = function(*primals)
        return (s, c), (c * tangents[0], -s * tangents[0])

    return jvp


sine_and_cosine.defjvp(_derivative(sine_and_cosine))
unfenced_sine_and_cosine.defjvp(_derivative(unfenced_sine_and_cosine))
