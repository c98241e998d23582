"""Refusal of numbers that have no value until a compiled program runs, by the status of its result."""

from __future__ import annotations

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.checked import allowed_unknowns
from jaxvib.machine.scene import Scene
from jaxvib.results.result import Result

__all__ = ["REFUSED", "refuse_unknowns", "without_numbers"]

REFUSED = "a number that was not known while the program was built is not allowed in a scene: build the scene outside to see it"
"""Sentence of the status `refused`."""

Found = TypeVar("Found", bound=Result)


def refuse_unknowns(scene: Scene, found: Found, refused: eqx.Enumeration) -> Found:
    """The result with the status `refused` and without numbers if, under a JAX transformation, a number of the scene turns out
    to be one that its constructor would not take, such as a negative stiffness; the result itself if all numbers are known."""
    allowed = allowed_unknowns(scene)
    if allowed is None:
        return found
    status = jax.tree.map(lambda own, other: jnp.where(allowed, own, other), found.status, refused)
    return eqx.tree_at(lambda result: result.status, without_numbers(allowed, found), status)


def without_numbers(allowed: Array, found: Any) -> Any:
    """The tree with NaN and False in place of its numbers unless `allowed`; a scene in it stays as it is."""

    def kept(value: Any) -> Any:
        if not isinstance(value, Array):
            return value
        if jnp.issubdtype(value.dtype, jnp.inexact):
            # `jnp.where` would broadcast the condition for each of the arrays.
            return jax.lax.select(allowed, value, jnp.full_like(value, jnp.nan))
        return value & allowed if value.dtype == bool else value

    return jax.tree.map(kept, found, is_leaf=lambda value: isinstance(value, Scene))
