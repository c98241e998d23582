"""Columns of CSV files, such as catalogues of springs and curves of motors."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, read_text
from jaxvib.units.columns import split_head, unit_factor


@validated
def csv_column(path: str | Path, unit: str, column: str | None = None) -> np.ndarray:
    """Return a column of a CSV file in SI units.

    The first row has the names of the columns with their units: `rate (N/mm)`, `rate [N/mm]` or `rate / N/mm`. Columns are
    separated by commas, semicolons or tabs. If they are separated by semicolons or tabs, numbers may have a decimal comma.

    **Arguments**

    - `path` of the file, at most 16 MB
    - `unit`: SI unit of the returned numbers, such as "N/m", "rad/s", "N m"
    - `column`: name of the column; default: the only column with a unit of this dimension; typical: "rate"

    **Returns** the numbers of the column as an array; rows with an empty cell are left out. The array can be used as `choices`
    of a design or as an argument of `TorqueTable`.

    **Raises** `InputError` for a file that cannot be read, a column that is missing or not unique, a unit of another dimension,
    and a cell that is not a number.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "springs.csv"
    >>> _ = path.write_text("part;rate (N/mm);length (mm)\\nA1;12,5;80\\nA2;20,0;80\\n")
    >>> jv.csv_column(path, "N/m").tolist()
    [12500.0, 20000.0]
    """
    factor, cells = _column(path, unit, column)
    return np.asarray([factor * _number(cell, f"{path}, row {line}") for line, cell, _ in cells])


def row_names(path: str | Path, unit: str, column: str | None = None) -> list[str]:
    """Return texts that identify the rows of `csv_column`: the first cell, if it is not a number, with the row and the file."""
    _, cells = _column(path, unit, column)
    return [f"{_row_prefix(first)}row {line} of {Path(path).name}" for line, _, first in cells]


def _row_prefix(cell: str) -> str:
    """Return the first cell of a row as the beginning of a text, "" for a number."""
    try:
        float(cell or "0")
    except ValueError:
        return f"{cell}, "
    return ""


def _column(path: str | Path, unit: str, column: str | None) -> tuple[float, list[tuple[int, str, str]]]:
    """Return the factor from the unit of a column to the SI unit, and (number of the row, cell in the column, first cell of the
    row) for each row. Rows with an empty cell in the column are left out."""
    (_, head), *rows = _rows(path)
    names = [split_head(each, unit) for each in head]
    matching = [k for k, (name, head_unit) in enumerate(names) if _matches(head[k], name, head_unit, unit, column)]
    if not matching and column is None:
        example = "rpm" if unit == "rad/s" else unit
        raise InputError(str(path), f"has no column with a unit such as {example}; write it in the header: NAME ({example})")
    if len(matching) != 1:
        wanted = f"with a unit such as {unit}" if column is None else f"{quoted(column)}"
        problem = f"has {len(matching) or 'no'} columns {wanted}"
        raise InputError(str(path), f"{problem}; set column to one of: {', '.join(map(quoted, head))}")
    (k,) = matching
    head_unit = names[k][1]
    factor = 1.0 if not unit and head_unit in ("", "-") else unit_factor(head_unit, unit) if head_unit else None
    if factor is None:
        problem = f"has the column {quoted(head[k])}, whose unit is missing or not convertible to {unit}"
        raise InputError(str(path), f"{problem}; write {names[k][0]} ({unit})")
    cells = [(line, row[k], row[0]) for line, row in rows if len(row) > k and row[k]]
    if not cells:
        raise InputError(str(path), f"has no number in the column {quoted(head[k])}")
    return factor, cells


def _matches(head: str, name: str, head_unit: str, unit: str, column: str | None) -> bool:
    if column is not None:
        return column.strip().lower() in (head.lower(), name.lower())
    return bool(head_unit) and unit_factor(head_unit, unit) is not None


def _rows(path: str | Path) -> list[tuple[int, list[str]]]:
    """Return the rows of a CSV file that are not empty, with their numbers from 1. Decimal commas in the cells below the header
    are replaced by decimal points."""
    lines = read_text(path, "a CSV file").splitlines()
    first = next((line for line in lines if line.strip(";, \t")), "")
    separator = max(";\t,", key=lambda each: (first.count(each) > 0, each != ","))
    reader = csv.reader(lines, delimiter=separator)
    rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    if len(rows) < 2:
        raise InputError(str(path), "has no rows; the first row has the names of the columns, the others numbers")
    if separator != ",":
        rows[1:] = [(line, [cell.replace(",", ".") for cell in row]) for line, row in rows[1:]]
    return rows


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell.replace("_", "?"))  # Python would read "1_000"
    except ValueError as error:
        raise InputError(where, f"has {quoted(cell)}, which is not a number") from error
    if not np.isfinite(value):
        raise InputError(where, f"has {quoted(cell)}; a finite number is needed")
    return value
