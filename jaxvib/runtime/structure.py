"""Conversion of trees of dataclasses, tuples, lists and dictionaries to descriptions in JSON, and back.

A description contains no code: it can name classes and functions of known packages, but none of them is called.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np

Description: TypeAlias = "bool | int | float | str | list[Description] | dict[str, Description] | None"
"""JSON values."""

KNOWN_PACKAGES = {"jaxvib", "optimize", "jax", "equinox", "diffrax", "optimistix", "optax", "lineax"}
"""Packages whose classes and functions a description may name, because the keys of stored programs include their sources or
versions."""


@dataclasses.dataclass(frozen=True)
class Slot:
    """Placeholder in a tree for the array with this index."""

    index: int


@dataclasses.dataclass(frozen=True, eq=False)
class Skeleton:
    """Tree with a `Slot` in place of each array; two skeletons are equal if their structures and all other leaves are equal."""

    tree: Any

    @classmethod
    def of(cls, leaves: Sequence[object], treedef: Hashable) -> Skeleton:
        """Return the skeleton of a tree with these leaves."""
        indices = itertools.count()
        return cls(jax.tree.unflatten(treedef, [Slot(next(indices)) if eqx.is_array(x) else x for x in leaves]))

    @functools.cached_property
    def flat(self) -> tuple[tuple[object, ...], Hashable]:
        """Leaves and tree structure."""
        leaves, treedef = jax.tree.flatten(self.tree)
        return tuple(leaves), treedef

    @functools.cached_property
    def key(self) -> Hashable:
        return tuple(map(leaf_key, self.flat[0])), self.flat[1]

    @property
    def size(self) -> int:
        """Number of arrays."""
        return sum(isinstance(leaf, Slot) for leaf in self.flat[0])

    def filled(self, arrays: Iterable[object]) -> Any:
        """Return the tree with these arrays in its slots."""
        leaves, treedef = self.flat
        arrays = tuple(arrays)
        return jax.tree.unflatten(treedef, [arrays[x.index] if isinstance(x, Slot) else x for x in leaves])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Skeleton) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def leaf_key(leaf: Any) -> Hashable:
    """Return the part of a leaf on which a program depends: the shape, dtype and weak type of an array, otherwise the leaf
    itself with its Python type."""
    if isinstance(leaf, (jax.Array, np.ndarray, np.generic)):
        return jax.typeof(leaf)
    return type(leaf), repr(leaf) if isinstance(leaf, float) else leaf  # 0.0 equals -0.0, but their programs differ


class Undescribable(Exception):
    """Error for a value without a description: a function without a name, or an object of a class of an unknown package."""


def describe(value: object, array: Callable[[Any], Description]) -> Description:
    """Return the description of a tree; the function `array` describes its arrays.

    **Raises** `Undescribable` for a value without a description.

    >>> describe({"a": (1, None)}, lambda x: str(x.dtype))
    {'dict': [['a', {'tuple': [1, None]}]]}
    """
    inner = functools.partial(describe, array=array)
    match value:
        case jax.Array() | np.ndarray():
            return {"array": array(value)}
        case None | bool() | int() | float() | str() if type(value) in (type(None), bool, int, float, str):
            return value
        case list() if type(value) is list:
            return {"list": [inner(x) for x in value]}
        case tuple() if type(value) is tuple:
            return {"tuple": [inner(x) for x in value]}
        case dict() if type(value) is dict:
            return {"dict": [[inner(key), inner(x)] for key, x in value.items()]}
    if isinstance(value, type) or inspect.isroutine(value) or hasattr(value, "__wrapped__"):
        return {"name": _import_name(value)}
    try:
        return {"class": _import_name(type(value)), "fields": [inner(getattr(value, name)) for name in _fields(type(value))]}
    except AttributeError as error:
        raise Undescribable(str(error)) from error


def rebuild(description: Description, arrays: Iterator[object]) -> Any:
    """Build the tree of a description; `arrays` yields its arrays in the order in which `describe` visited them.

    **Raises** `Undescribable` for a description that `describe` cannot produce.

    >>> rebuild({"dict": [["a", {"tuple": [1, None]}]]}, iter(()))
    {'a': (1, None)}
    """
    match description:
        case None | bool() | int() | float() | str():
            return description
        case {"array": _}:
            return next(arrays)
        case {"list": [*items]}:
            return [rebuild(x, arrays) for x in items]
        case {"tuple": [*items]}:
            return tuple(rebuild(x, arrays) for x in items)
        case {"dict": [*items]}:
            return {rebuild(key, arrays): rebuild(x, arrays) for key, x in items}  # pyright: ignore
        case {"name": str() as name}:
            return _import_definition(name)
        case {"class": str() as name, "fields": [*items]}:
            return _instance(_import_definition(name), [rebuild(x, arrays) for x in items])
    raise Undescribable(f"{description!r} is not a valid description")


def _fields(kind: type) -> list[str]:
    if dataclasses.is_dataclass(kind):
        names = (field.name for field in dataclasses.fields(kind))
        return [name for name in names if not isinstance(getattr(kind, name, None), property)]
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return list(kind._fields)  # pyright: ignore[reportAttributeAccessIssue]
    raise Undescribable(f"{kind} is neither a dataclass nor a named tuple")


def _instance(kind: object, values: list[object]) -> object:
    """Return an object with these field values. Its constructor, which might convert or check them, is not called."""
    if not isinstance(kind, type):
        raise Undescribable(f"{kind} is not a class")
    names = _fields(kind)
    if issubclass(kind, tuple):
        return tuple.__new__(kind, values)
    instance = object.__new__(kind)
    for name, value in zip(names, values, strict=True):
        object.__setattr__(instance, name, value)
    return instance


def _import_name(value: object) -> str:
    """Return `module:name` of a class or function; raise `Undescribable` if an import by this name does not return the same
    object."""
    name = f"{getattr(value, '__module__', None)}:{getattr(value, '__qualname__', None)}"
    if _import_definition(name) is not value:
        raise Undescribable(f"{value!r} cannot be found by its name")
    return name


def _import_definition(name: str) -> object:
    module, _, path = name.partition(":")
    if module.partition(".")[0] not in KNOWN_PACKAGES:
        raise Undescribable(f"{name} does not belong to a known package")
    try:
        definition = functools.reduce(getattr, path.split("."), importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        raise Undescribable(f"{name} cannot be found") from error
    if (getattr(definition, "__module__", None), getattr(definition, "__qualname__", None)) != (module, path):
        raise Undescribable(f"{name} is not defined in {module}")  # the module only imports it
    return definition
