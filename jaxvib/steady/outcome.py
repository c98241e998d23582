"""Outcome of a computation: its result, an error raised because of its status, or a result with the status `refused`.

The values of traced parameters of a scene are known only when a compiled program runs. They are not validated when the scene
is built; if one of them is not allowed, the result has the status `refused` and NaN in place of numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import allowed_unknowns
from jaxvib.results.result import Result
from jaxvib.results.status import failure, status_name
from jaxvib.runtime.compat import enumeration_of
from jaxvib.runtime.programs import cached
from jaxvib.units.known import is_known

REFUSED = "a traced parameter has a value that is not allowed: call the function outside of jit, grad and vmap to see which one"
"""Message of the status `refused`."""

SomeResult = TypeVar("SomeResult", bound=Result)
Tree = TypeVar("Tree")


def outcome(
    result: SomeResult,
    scene: Scene | None = None,
    end: Array | None = None,
    *,
    throw: bool = False,
    failures: Collection[str] = (),
    hint: Callable[[str], str] = lambda _: "",
) -> SomeResult:
    """Return the result of a computation, with the status `refused` and NaN in place of numbers if a traced parameter of its
    `scene` has a value that is not allowed, or if its `end` time, s, is not positive.

    **Raises** `ComputationError` if `throw` is True and the name of a known status is among the `failures`; `hint`: function
    from this name to the text that is appended to the message.
    """
    is_positive = unknown_is_positive(end)
    if throw and is_known(result.status) and (name := status_name(result.status)) in failures:
        raise failure(result.status, hint(name))
    allowed = None if scene is None else allowed_unknowns(scene)
    if allowed is None and is_positive is None:
        return result
    allowed = functools.reduce(jnp.logical_and, [each for each in (allowed, is_positive) if each is not None])
    refused = enumeration_of(result.status).refused  # pyright: ignore[reportAttributeAccessIssue]
    status = jax.tree.map(lambda own, other: jnp.where(allowed, own, other), result.status, refused)
    return eqx.tree_at(lambda result: result.status, without_numbers(allowed, result), status)


def require_index(index: int, size: int, entries: str) -> None:
    """**Raises** `InputError` unless `index` is the number, from 0, of one of `size` entries."""
    if not 0 <= index < size:
        raise InputError("index", f"is {quoted(index)}; there are {size} {entries}, counted from 0")


def entry(batch: Result, kind: type[SomeResult], index: int) -> SomeResult:
    """Return the entry `index` of a batch of results, as a result of a `kind` with some of the fields of the batch."""
    fields = {name: getattr(batch, name) for name in kind.__dataclass_fields__}
    return _entry(kind(**fields), np.asarray(index, np.uint32))


@cached
def _entry(batch: SomeResult, index: Array | np.ndarray) -> SomeResult:
    return jax.tree.map(lambda leaf: leaf[index], batch)


def unknown_is_positive(number: Array | None) -> Array | None:
    """Return a traced Boolean, True if a traced number is finite and positive; None for a number with a known value or no
    number."""
    return None if number is None or is_known(number) else jnp.isfinite(number) & (number > 0.0)


def without_numbers(allowed: Array, tree: Tree) -> Tree:
    """Return a tree with NaN in place of floating-point numbers, and False in place of Booleans, if `allowed` is False.

    Integers, and a scene in the tree, are unchanged.
    """

    def replace(value: object) -> object:
        if not isinstance(value, Array):
            return value
        if jnp.issubdtype(value.dtype, jnp.inexact):
            # `jnp.where` would broadcast the condition for each of the arrays.
            return jax.lax.select(allowed, value, jnp.full_like(value, jnp.nan))
        return value & allowed if value.dtype == bool else value

    return jax.tree.map(replace, tree, is_leaf=lambda value: isinstance(value, Scene))
