"""Fields of results: units and axes as metadata, and the plain and labelled data that follow from them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypedDict, TypeGuard, TypeVar

import equinox as eqx
import jax
import numpy as np

from jaxvib.errors import optional_module
from jaxvib.results.status import is_status, sentence, status_names

if TYPE_CHECKING:
    import xarray
    from _typeshed import DataclassInstance

EACH = "*"
"""Placeholder for the `outer_axes` of the class to which a field belongs."""

T = TypeVar("T")

Plain: TypeAlias = "bool | int | float | str | list[Plain] | dict[str, Plain] | None"
"""Values that JSON can represent."""

Labels: TypeAlias = Mapping[str, Sequence[str]]
"""Mapping from the name of each axis to the labels of its points; the entry "unit" contains the units of the coordinates."""

Column: TypeAlias = tuple[str, tuple[str, ...], np.ndarray, str]
"""Name of an array, names of its axes, values and unit."""


class InUnit(TypedDict):
    """Metadata of `in_unit`."""

    unit: str
    axes: tuple[str, ...]
    name: str
    first: int


class Part(TypedDict):
    """Metadata of `part`."""

    part: tuple[str, ...]
    prefix: str


class AsText(TypedDict):
    """Metadata of `as_text`."""

    write: Callable[[Any], str]
    read: Callable[[str], object]
    labels: Callable[[Any], Labels]


class Names(TypedDict):
    """Metadata of `names_along`."""

    labels: Callable[[Any], Labels]


def in_unit(unit: str, *axes: str, name: str = "", first: int = 0) -> InUnit:
    """Return the metadata of a field of numbers: their unit ("" for none) and the names of their axes in order.

    **Arguments**

    - `unit`: one unit, or two if it depends on the coordinate, such as "m or rad" for lengths and angles
    - `axes`: names of the axes; "*" is a placeholder for the `outer_axes` of the class
    - `name`: name in labelled data; default: the name of the field
    - `first`: number of entries at the start of a tuple that labelled data omit

    >>> in_unit("rad/s", "load")
    {'unit': 'rad/s', 'axes': ('load',), 'name': '', 'first': 0}
    """
    return {"unit": unit, "axes": axes, "name": name, "first": first}


def part(*axes: str, prefix: str = "") -> Part:
    """Return the metadata of a field that contains another object whose fields have metadata, or a tuple of such objects.

    **Arguments**: `axes`: names of axes that precede the axes of the object; `prefix` of the names of its arrays in labelled
    data. The objects of a tuple with several objects are numbered, and each of them has its own axis "load".
    """
    return {"part": axes, "prefix": prefix}


def as_text(write: Callable[[T], str], read: Callable[[str], T], labels: Callable[[T], Labels]) -> AsText:
    """Return the metadata of a field that is stored as text in files and plain data, by `write` to the text and `read` from it;
    `labels`: function from the field's value to labels of axes."""
    return {"write": write, "read": read, "labels": labels}


def names_along(axis: str) -> Names:
    """Return the metadata of a field that contains the labels of the points on an `axis`; with the axis "unit", the labels are
    the units of the coordinates."""
    return {"labels": lambda names: {axis: names}}


def is_named_tuple(value: object) -> TypeGuard[NamedTuple]:
    """Return True for a named tuple."""
    return isinstance(value, tuple) and hasattr(value, "_fields")


def as_dict(result: eqx.Module, *, infinity: bool = False) -> dict[str, Plain]:
    """Return a result as plain Python values for JSON, in SI units, with the `status` and the `message` before the fields.

    Statuses are represented by their names, complex numbers by pairs [real, imaginary], and NaN and infinity by None. With
    `infinity`, infinite numbers are kept, for documents that people read.
    """
    status = getattr(result, "status", None)
    head = {} if status is None else {"status": plain(status), "message": sentence(status)}
    return {**head, **_plain_fields(result, infinity)}


def plain(value: object, *, infinity: bool = False) -> Plain:
    """Return a value in a form that JSON can represent, see `as_dict`. **Raises** `TypeError` for a value of another class."""
    inner = functools.partial(plain, infinity=infinity)
    if is_status(value):
        return status_names(value).tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain_fields(value, infinity)
    if is_named_tuple(value):
        return {name: inner(getattr(value, name)) for name in value._fields}
    if isinstance(value, Mapping):
        return {str(name): inner(entry) for name, entry in value.items()}
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        return inner(np.asarray(value).tolist())
    if isinstance(value, (tuple, list)):
        return [inner(entry) for entry in value]
    if isinstance(value, complex):
        return [inner(value.real), inner(value.imag)]
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) or (infinity and math.isinf(value)) else None
    raise TypeError(f"{value!r} is neither a plain value nor an array")


def _plain_fields(value: DataclassInstance, infinity: bool) -> dict[str, Plain]:
    entries = {field.name: (field.metadata, getattr(value, field.name)) for field in dataclasses.fields(value)}
    return {
        name: meta["write"](entry) if "write" in meta else plain(entry, infinity=infinity)
        for name, (meta, entry) in entries.items()
    }


def to_xarray(result: eqx.Module) -> xarray.Dataset:
    """Return the numbers of a result as a labelled dataset with units in the attribute "units"; needs the extra `xarray`.

    The axis of an outer `vmap` is called "batch". Several such axes are called "batch_1", "batch_2", ..., the outermost first.

    **Raises** `InputError` if xarray is not installed.
    """
    xr = optional_module("xarray", "xarray")
    labels = labels_of(result)
    variables = {}
    for name, axes, value, unit in columns(result):
        extra = value.ndim - len(axes)
        batch = ("batch",) if extra == 1 else tuple(f"batch_{k + 1}" for k in range(extra))
        attributes = {"units": one_unit(unit, labels.get("unit", ()))} if unit else {}
        variables[name] = ((*batch, *axes), value, attributes)
    data = xr.Dataset(variables)
    known = {axis: list(names) for axis, names in labels.items() if data.sizes.get(axis) == len(names) and axis not in data}
    data = data.assign_coords(known)
    if "unit" in labels and data.sizes.get("coordinate") == len(labels["unit"]):
        data = data.assign_coords(unit=("coordinate", list(labels["unit"])))
    status = getattr(result, "status", None)
    return data if status is None else data.assign_attrs(result=type(result).__name__, message=sentence(status))


def columns(result: eqx.Module) -> Iterator[Column]:
    """Yield name, names of axes, values and unit of every array of a result."""
    return _columns(result, "", (), {})


def is_single(result: eqx.Module) -> bool:
    """Return True if the numbers of a result are not traced and have no axis of an outer `vmap`."""
    try:
        return all(value.ndim == len(axes) for _, axes, value, _ in columns(result))
    except jax.errors.TracerArrayConversionError:
        return False


def labels_of(result: eqx.Module) -> Labels:
    """Return a mapping from the name of each axis to the labels of its points; the entry "unit" contains the units of the
    coordinates."""
    labels: dict[str, Sequence[str]] = {}
    for field in dataclasses.fields(result):
        value = getattr(result, field.name)
        if "labels" in field.metadata and value is not None:
            labels |= field.metadata["labels"](value)
        elif "part" in field.metadata and isinstance(value, eqx.Module):
            labels |= labels_of(value)
    return labels


def one_unit(unit: str, units: Sequence[str]) -> str:
    """Return the common unit of all coordinates from a unit such as "m or rad"; return it unchanged if their units differ."""
    choices = unit.split(" or ")
    alike = len(choices) == 2 and len(set(units)) == 1
    return choices[("m", "rad").index(units[0])] if alike else unit


def _columns(tree: eqx.Module, prefix: str, outer: tuple[str, ...], renamed: Mapping[str, str]) -> Iterator[Column]:
    """Yield name, names of axes, values and unit of every array of a tree."""
    outer_axes = getattr(tree, "outer_axes", ())
    for field in dataclasses.fields(tree):
        value, metadata = getattr(tree, field.name), field.metadata

        def axes(own: tuple[str, ...]) -> tuple[str, ...]:
            every = [axis for name in own for axis in (outer_axes if name == EACH else (name,))]
            return (*outer, *(renamed.get(axis, axis) for axis in every))

        if value is None:
            continue
        if "part" in metadata:
            trees = value if isinstance(value, tuple) else (value,)
            for k, each in enumerate(trees):
                number = f"{field.name}_{k + 1}_" if len(trees) > 1 else ""
                before = prefix + metadata["prefix"] + number
                inner = dict(renamed) | ({"load": f"{before}load"} if number else {})
                if metadata["prefix"]:
                    own = [known.name for known in dataclasses.fields(each) if known.metadata.get("axes") == (known.name,)]
                    inner |= {axis: before + axis for axis in own}
                yield from _columns(each, before, axes(metadata["part"]), inner)
        elif "unit" in metadata:
            name = prefix + (metadata["name"] or field.name)
            shown = value[first:] if (first := metadata["first"]) else value
            yield from _column(name, axes(metadata["axes"]), shown, metadata["unit"])
        elif is_status(value):
            yield from _column(prefix + field.name, axes((EACH,)), value, "")


def _column(name: str, axes: tuple[str, ...], value: object, unit: str) -> Iterator[Column]:
    if is_status(value):
        yield name, axes, status_names(value), ""
    elif is_named_tuple(value):
        for entry in value._fields:
            yield f"{name}_{entry}", axes, np.asarray(getattr(value, entry)), unit
    elif isinstance(value, (tuple, list)) and value and is_named_tuple(value[0]):
        for entry in value[0]._fields:
            yield f"{name}_{entry}", axes, np.asarray([getattr(row, entry) for row in value]), unit
    elif isinstance(value, tuple) and value and isinstance(value[0], (jax.Array, np.ndarray)):
        for k, entry in enumerate(value):
            yield name if len(value) == 1 else f"{name}_{k + 1}", axes, np.asarray(entry), unit
    elif not (isinstance(value, (tuple, list)) and not value):
        yield name, axes, np.asarray(value), unit
