"""Fences that prevent a compiler from recomputing a value for each use.

XLA's fusion on a CPU recomputes a value, with all its operands, for each use; for nested shared operands the work grows without
bound. It does not recompute the result of a division, which it considers expensive. Therefore a value is divided by a 1 that
XLA does not recognize as 1. LLVM, which compiles the code afterwards, recognizes the 1 and removes the division.
"""

from __future__ import annotations

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
    """Return a 1 that is computed from a floating-point value by bit operations, which XLA does not simplify.

    >>> float(hidden_one(jnp.asarray(jnp.nan)))
    1.0
    """
    dtype = np.dtype(value.dtype)
    bits = np.dtype(f"uint{8 * dtype.itemsize}").type
    zero = (jax.lax.bitcast_convert_type(jax.lax.stop_gradient(value), bits) & bits(1)) >> bits(1)
    return jax.lax.bitcast_convert_type(zero | np.ones((), dtype).view(bits), dtype)


@jax.custom_jvp
def entries(vector: Array, one: Array) -> list[Array]:
    """Return the entries of a floating-point vector (n,), read as bits.

    If the entries were read as numbers, the compiler would replace each of them by its computation. Tangents are read as
    numbers and fenced; `one` is a `hidden_one`.

    >>> [float(x) for x in entries(jnp.asarray([2.0, 3.0]), hidden_one(jnp.asarray(3.0)))]
    [2.0, 3.0]
    """
    bits = jax.lax.bitcast_convert_type(vector, jnp.dtype(f"uint{8 * vector.dtype.itemsize}"))
    return [jax.lax.bitcast_convert_type(bits[i], vector.dtype) for i in range(len(vector))]


@entries.defjvp
def _entries_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[list[Array], list[Array]]:
    vector, one = primals
    return entries(vector, one), [fence(tangents[0][i], one) for i in range(len(vector))]
