"""Text representation of objects that contain arrays: values with units."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxvib.boundary import Module
from jaxvib.display import shown_unit
from jaxvib.results.fields import is_single
from jaxvib.results.status import is_status, sentence

_MAX_ENTRIES = 12
"""Largest number of entries of an array whose entries are all shown. For a larger array the shape, the smallest and the largest
value are shown."""


class Readable(Module):
    """Base of results, of their parts and of other objects with arrays: `repr` shows values with units, and `==` is True if all
    fields are equal, with NaN equal to NaN.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> jv.State(jnp.array([0.0012, -0.0004]), jnp.zeros(2), angle=(jnp.arange(100.0),), rate=(jnp.full(100, 60.0),))
    State:
      displacement: 0.0012, -0.0004 m or rad
      velocity: 0, 0 m/s or rad/s
      exciters:
        angle: (100,) from 0 to 5672.3 deg
        rate: (100,) from 572.96 to 572.96 rpm
    """

    def __repr__(self) -> str:
        """Return a text: for a single result its summary, for other objects the values and units of all fields, for a traced
        object the shapes."""
        if not _has_values(self):
            return super().__repr__()
        summary = getattr(self, "summary", None)
        if summary is not None and is_single(self):
            return summary()
        return "\n".join([f"{type(self).__name__}:", *_lines(self)])

    def __eq__(self, other: object) -> Any:
        """Return True if the other object has the same class and equal fields; a traced value in traced objects."""
        if type(other) is not type(self):
            return NotImplemented
        (leaves, structure), (leaves_of_other, structure_of_other) = jax.tree.flatten(self), jax.tree.flatten(other)
        if structure != structure_of_other:
            return False
        if not (_has_values(self) and _has_values(other)):
            return eqx.tree_equal(self, other)
        return all(map(_is_equal, leaves, leaves_of_other))

    __hash__ = eqx.Module.__hash__


@np.errstate(over="ignore")
def values_text(values: object, unit: str = "") -> str:
    """Return numbers of any shape, given in the SI `unit`, as text in their display unit.

    Up to 12 numbers are all written; of more numbers, the text states the shape and the range.

    >>> values_text([[0.01, 0.02], [0.03, float("nan")]], "m"), values_text(np.linspace(0.0, 0.1, 50), "m")
    ('[10, 20], [30, nan] mm', '(50,) from 0 to 100 mm')
    """
    array = np.asarray(values)
    if array.dtype.kind not in "fc":
        return _entries(array, str) if array.size <= _MAX_ENTRIES else f"{array.shape} of {array.dtype}"
    finite = array[np.isfinite(array)]
    shown, factor = shown_unit(unit, float(np.max(np.abs(finite), initial=0.0)))
    if array.size <= _MAX_ENTRIES:
        return f"{_entries(factor * array, lambda x: f'{x:.5g}')} {shown}".rstrip()
    if finite.size == 0:
        return f"{array.shape} of nan"
    name, span = ("magnitude ", np.abs(finite)) if array.dtype.kind == "c" else ("", finite)
    return f"{array.shape} {name}from {factor * np.min(span):.5g} to {factor * np.max(span):.5g} {shown}".rstrip()


def _is_equal(one: object, other: object) -> bool:
    """Return True if two leaves have the same type, shape and values; NaN equals NaN."""
    first, second = np.asarray(one), np.asarray(other)
    return first.dtype == second.dtype and np.array_equal(first, second, equal_nan=first.dtype.kind in "fc")


def _has_values(tree: Any) -> bool:
    """Return True if no number in the tree is traced."""
    try:
        for leaf in jax.tree.leaves(tree):
            np.asarray(leaf)
    except jax.errors.TracerArrayConversionError:
        return False
    return True


def _entries(array: np.ndarray, text: Callable[[Any], str]) -> str:
    if array.ndim == 0:
        return text(array.item())
    return ", ".join(_entries(each, text) if each.ndim == 0 else f"[{_entries(each, text)}]" for each in array)


def _lines(tree: eqx.Module) -> list[str]:
    """Return a line for each field of a tree, and indented lines for trees in it."""
    lines = []
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name, None)
        trees: Sequence[Any] = list(value) if isinstance(value, (tuple, list)) else [value]
        if value is None or not trees:
            continue
        if all(isinstance(each, Readable) for each in trees):
            for k, each in enumerate(trees):
                name = field.name if len(trees) == 1 else f"{field.name}[{k}]"
                lines += [f"  {name}:", *(f"  {line}" for line in _lines(each))]
            continue
        if is_status(value):
            text = sentence(value)
        elif all(isinstance(each, (jax.Array, np.ndarray, float)) for each in trees):
            text = "; ".join(values_text(each, field.metadata.get("unit", "")) for each in trees)
        elif isinstance(value, eqx.Module):
            text = f"a {getattr(value, 'kind', type(value).__name__)}"
        else:
            text = repr(value)
        lines.append(f"  {field.name}: {text}")
    return lines
