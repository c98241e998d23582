"""Tables of the fields of a result along one axis, and CSV files of them."""

from __future__ import annotations

import collections
import csv
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import shown_unit
from jaxvib.errors import InputError, quoted, written
from jaxvib.results.fields import Labels, columns, labels_of, one_unit


@validated
def write_csv(result: eqx.Module, axis: str, path: str | Path, *, display: bool = False, decimal_comma: bool = False) -> Path:
    """Write all quantities of a result along an axis into a CSV file, a row for each point of the axis.

    The header of a column consists of the name, the labels of the other axes and the unit: "displacement y1 (m)". Numbers have
    9 digits. Complex numbers have one column for the real part and one for the imaginary part. A point of a curve that the
    result has twice, because two pieces meet there, has one row.

    **Arguments**

    - `result`: result of any class
    - `axis`: name of the axis in the metadata of the fields, such as "time" or "point"
    - `path`: path of the file, which is overwritten
    - `display`: True for the units of `display_units` and names in words, such as "rotor speed" for `rotor_speed`, without a
      prefix that the axis and all columns have, such as "trajectory_"; default: SI units and the names of the fields
    - `decimal_comma`: True for decimal commas, and semicolons between columns, as German and Russian spreadsheets expect;
      default: decimal points and commas

    **Returns** the path. **Raises** `InputError` for an axis that the result does not have, and for a path that cannot be
    written to.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> scene = jv.Scene(jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
    ...                  jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5), jv.ConstantSpeed(60.0))
    >>> path = write_csv(jv.whirl(scene, [10.0, 20.0]), "rotor_speed", pathlib.Path(tempfile.mkdtemp()) / "campbell.csv")
    >>> path.read_text().splitlines()[0].split(",")[:4]
    ['rotor_speed (rad/s)', 'speed 1 (rad/s)', 'speed 2 (rad/s)', 'decay 1 (1/s)']
    """
    table = table_along(result, axis, display=display)
    return write_table(table, path, decimal_comma=decimal_comma, unique=axis in ("point", "speed"))


def write_table(
    table: Mapping[str, np.ndarray], path: str | Path, *, decimal_comma: bool = False, unique: bool = False
) -> Path:
    """Write columns, given by their headers, to a CSV file. With `unique`, equal rows in succession, such as the common end of
    two pieces of a curve, are written once."""
    path = Path(path)
    with written(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n", delimiter=";" if decimal_comma else ",")
        writer.writerow(table)
        rows = ([_shown(x, decimal_comma) for x in row] for row in zip(*table.values(), strict=True))
        writer.writerows((row for row, _ in itertools.groupby(rows)) if unique else rows)
    return path


def main_axis(result: eqx.Module) -> str:
    """Return the name of the most frequent first axis of the arrays of a result; "" if no array has an axis. If this axis has
    only one point (the segment of a single spectrum), return the name of the longest axis whose points are a field of the
    same name (frequencies)."""
    arrays = [(name, axes, values) for name, axes, values, _ in columns(result) if axes and values.ndim == len(axes)]
    counts = collections.Counter(axes[0] for _, axes, _ in arrays)
    main = max(counts, key=lambda axis: counts[axis], default="")
    sizes = {axes[0]: values.shape[0] for name, axes, values in arrays if axes in ((name,), (main,))}
    return max(sizes, key=lambda axis: sizes[axis], default="") if sizes.get(main) == 1 else main


def table_along(result: eqx.Module, axis: str, *, display: bool = False) -> dict[str, np.ndarray]:
    """Return the columns of the table of `write_csv` by their headers. **Raises** `InputError` for an unknown axis.

    The first columns are the labels of the axis, if it has labels. A table along the coordinates also has a column of
    their units if these differ.
    """
    labels = labels_of(result)
    units = labels.get("unit", ())
    prefix = _common_prefix(result, axis) if display else ""
    in_words: Callable[[str], str] = (lambda name: name.removeprefix(prefix).replace("_", " ")) if display else str
    table: dict[str, np.ndarray] = {}
    for name, axes, values, unit in columns(result):
        if values.ndim != len(axes):
            continue
        # A first axis of one point, such as the only segment of a spectrum, is left out.
        while axes[:1] != (axis,) and values.shape[:1] == (1,):
            axes, values = axes[1:], values[0]
        if axes[:1] != (axis,):
            continue
        for place in np.ndindex(values.shape[1:]):
            places = [_label(labels, a, k, n) for a, k, n in zip(axes[1:], place, values.shape[1:], strict=True)]
            column_unit = _own_unit(unit, axes, place, units)
            head, column = " ".join([in_words(name), *filter(None, places)]), values[(slice(None), *place)]
            if display and column_unit and np.issubdtype(column.dtype, np.inexact):  # real and imaginary part have one unit
                largest = float(np.max(np.abs(column), initial=0.0, where=np.isfinite(column)))
                column_unit, factor = shown_unit(column_unit, largest)
                column = factor * column
            parts = [("real ", np.real(column)), ("imaginary ", np.imag(column))] if np.iscomplexobj(column) else [("", column)]
            for part, numbers in parts:
                table[f"{part}{head}" + (f" ({column_unit})" if column_unit else "")] = numbers
    if not table:
        if (batch := next((values.ndim - len(axes) for _, axes, values, _ in columns(result)), 0)) > 0:
            problem = f"is a batch with {batch} outer {'axis' if batch == 1 else 'axes'}; take one of its results, "
            raise InputError("result", f"{problem}jax.tree.map(lambda x: x[0], result), or use to_xarray()")
        known = sorted({axes[0] for _, axes, values, _ in columns(result) if axes and values.ndim == len(axes)})
        raise InputError("axis", f"is {quoted(axis)}; the axes of {type(result).__name__} are: {', '.join(known) or 'none'}")
    named = (axis, "unit") if axis == "coordinate" and len(set(units)) > 1 else (axis,)
    rows = len(next(iter(table.values())))
    return {in_words(name): np.array(labels[name]) for name in named if len(labels.get(name, ())) == rows} | table


def _common_prefix(result: eqx.Module, axis: str) -> str:
    """Return the prefix, such as "trajectory_", of the name of an axis and of all columns along it; "" without one."""
    prefix = axis[: axis.find("_") + 1]
    return prefix if all(name.startswith(prefix) for name, axes, *_ in columns(result) if axes[:1] == (axis,)) else ""


def _label(labels: Labels, axis: str, k: int, n: int) -> str:
    """Return the label of the k-th of n entries along an axis; without labels its number, or "" for a single entry."""
    known = labels.get(axis, ())
    return str(known[k]) if len(known) == n else "" if n == 1 else str(k + 1)


def _own_unit(unit: str, axes: tuple[str, ...], place: tuple[int, ...], units: Sequence[str]) -> str:
    """Return the unit of a column: a `unit` such as "m or rad" becomes that of the column's coordinate. In a table along the
    coordinates it becomes their common unit, and stays unchanged if they have different `units`. `place`: indices of the column
    along the `axes` after the first."""
    is_of_one = "coordinate" in axes[1:] and len(units) > 0
    return one_unit(unit, [units[place[axes.index("coordinate") - 1]]] if is_of_one else units)


def _shown(value: np.generic, decimal_comma: bool) -> str:
    if isinstance(value, np.floating):
        return f"{value:.9g}".replace(".", ",") if decimal_comma else f"{value:.9g}"
    return str(int(value) if isinstance(value, np.bool_) else value)
