"""Fences that keep a compiler from computing a value anew for each use.

XLA's fusion on a CPU computes a value anew for each use of it, and what it is made of with it: where shared parts are made of
shared parts, that grows without bounds. It does not do so to the result of a division, which it takes to be dear. So a value
is divided by a 1 that XLA does not know to be one. The compiler behind it, LLVM, does, and leaves the division out.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

__all__ = ["fence", "hidden_one", "through_memory"]


def fence(value: Array, one: Array) -> Array:
    """A floating-point value that XLA computes once, however often it is used; `one` is a `hidden_one`.

    >>> fence(jnp.asarray([2.0, jnp.inf]), hidden_one(jnp.asarray(3.0))).tolist()
    [2.0, inf]
    """
    return value / one.astype(value.dtype)


def hidden_one(value: Array) -> Array:
    """1, made of any floating-point value, of which a compiler has to know that a bit has no half to find it out.

    >>> float(hidden_one(jnp.asarray(jnp.nan)))
    1.0
    """
    dtype = np.dtype(value.dtype)
    bits = np.dtype(f"uint{8 * dtype.itemsize}").type
    nothing = (jax.lax.bitcast_convert_type(jax.lax.stop_gradient(value), bits) & bits(1)) >> bits(1)
    return jax.lax.bitcast_convert_type(nothing | np.ones((), dtype).view(bits), dtype)


def through_memory(values: Sequence[Array], one: Array) -> list[Array]:
    """Several single numbers that XLA computes once, all in one piece of code, which stores them and reads them again: what
    needs several at a time comes so in less time than by a fence for each.

    >>> [float(x) for x in through_memory([jnp.asarray(2.0), jnp.asarray(3.0)], hidden_one(jnp.asarray(3.0)))]
    [2.0, 3.0]
    """
    return [fence(values[0], one)] if len(values) == 1 else _from_bits(jnp.stack(values), one)


@jax.custom_jvp
def _from_bits(stack: Array, one: Array) -> list[Array]:
    """The numbers of a stack, each read as bits: the compiler puts what a number was made of in place of one that it reads as
    what it is. Tangents have no bits to be read."""
    bits = jax.lax.bitcast_convert_type(stack, jnp.dtype(f"uint{8 * stack.dtype.itemsize}"))
    return [jax.lax.bitcast_convert_type(bits[i], stack.dtype) for i in range(len(stack))]


@_from_bits.defjvp
def _from_bits_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[list[Array], list[Array]]:
    stack, one = primals
    return _from_bits(stack, one), [fence(tangents[0][i], one) for i in range(len(stack))]
