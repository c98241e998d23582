"""Loops whose number of steps is a result of the computation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Carry = TypeVar("Carry")


@jax.custom_batching.custom_vmap
def _any_of_batch(value: Array) -> Array:
    """Return the value; in a batch, return True for the whole batch if any of its values is True."""
    return value


@_any_of_batch.def_vmap
def _any_of_batch_rule(_size: int, _batched: list[bool], values: Array) -> tuple[Array, bool]:
    return _any_of_batch(jnp.any(values)), False


def repeat(step: Callable[[Array, Carry], Carry], count: int | Array, start: Carry, limit: int | None = None) -> Carry:
    """Return the carry after `count` steps, `step(k, carry)` with k = 0, 1, ..., from `start`.

    **Arguments**: `limit`: largest count. With a limit, derivatives in reverse mode exist even for a traced count, and a batch
    takes as many steps as the largest count in it. Without a limit, a loop with a traced count has derivatives in forward mode
    only.

    >>> import jax
    >>> jax.grad(lambda x: repeat(lambda k, y: x * y, jnp.asarray(3), 1.0, limit=8))(2.0)
    Array(12., dtype=float64, weak_type=True)
    """
    if limit is None:
        return jax.lax.fori_loop(0, count, step, start)

    def step_if_needed(k: Array, carry: Carry) -> Carry:
        return jax.tree.map(lambda new, old: jnp.where(k < count, new, old), step(k, carry), carry)

    def scan_step(carry: Carry, k: Array) -> tuple[Carry, None]:
        # The condition is the same for all entries of a batch. With a condition for each entry, all steps would be computed.
        return jax.lax.cond(_any_of_batch(k < count), step_if_needed, lambda k, carry: carry, k, carry), None

    return jax.lax.scan(scan_step, start, jnp.arange(limit))[0]
