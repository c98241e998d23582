"""Fences that prevent a compiler from recomputing a value for each use.

XLA's fusion on a CPU recomputes a value, with all its operands, for each use; for nested shared operands the work grows without
bound. It does not recompute the result of a division, which it considers expensive. Therefore a value is divided by a 1 that
XLA does not recognize as 1. LLVM, which compiles the code afterwards, recognizes the 1 and removes the division.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


def fence(value: Array, one: Array) -> Array:
    """Fence a floating-point value, which XLA then computes once for any number of uses; `one` is a `hidden_one`.

    >>> fence(jnp.asarray([2.0, jnp.inf]), hidden_one(jnp.asarray(3.0))).tolist()
    [2.0, inf]
    """
    return value / one.astype(value.dtype)


def hidden_one(value: Array) -> Array:
    """A 1 computed from a floating-point value by bit operations that XLA does not simplify.

    >>> float(hidden_one(jnp.asarray(jnp.nan)))
    1.0
    """
    dtype = np.dtype(value.dtype)
    bits = np.dtype(f"uint{8 * dtype.itemsize}").type
    nothing = (jax.lax.bitcast_convert_type(jax.lax.stop_gradient(value), bits) & bits(1)) >> bits(1)
    return jax.lax.bitcast_convert_type(nothing | np.ones((), dtype).view(bits), dtype)


def through_memory(values: Sequence[Array], one: Array) -> list[Array]:
    """Fence several scalars at once: one piece of code computes, stores and reads them. This takes less time than one fence
    for each if they are used together.

    >>> [float(x) for x in through_memory([jnp.asarray(2.0), jnp.asarray(3.0)], hidden_one(jnp.asarray(3.0)))]
    [2.0, 3.0]
    """
    return [fence(values[0], one)] if len(values) == 1 else _from_bits(jnp.stack(values), one)


@jax.custom_jvp
def _from_bits(stack: Array, one: Array) -> list[Array]:
    """Unstack numbers by reading their bits. If they were read as numbers, the compiler would replace them by their operands.
    Tangents are unstacked as numbers."""
    bits = jax.lax.bitcast_convert_type(stack, jnp.dtype(f"uint{8 * stack.dtype.itemsize}"))
    return [jax.lax.bitcast_convert_type(bits[i], stack.dtype) for i in range(len(stack))]


@_from_bits.defjvp
def _from_bits_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[list[Array], list[Array]]:
    stack, one = primals
    return _from_bits(stack, one), [fence(tangents[0][i], one) for i in range(len(stack))]
