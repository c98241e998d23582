"""Tables of numbers in text files: CSV, or columns separated by semicolons, tabs or blanks."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxvib.errors import InputError, open_regular, quoted

_MAX_BYTES, _MAX_LINE = 2**29, 10_000
"""Largest number of bytes of a file (about ten million rows of five columns), and of characters of a line."""

_MAX_PREAMBLE = 400
"""Largest number of lines above the header of a table."""

_MISSING = ("", "-", "nan", "na", "n/a", "#n/a", "null", "none")
"""Texts, in lower case, in place of a reading that is missing."""


_ONE_COLUMN_DELIMITER = "\n"
"""Separator of a table with one column: a character that occurs in no line."""


class TextTable(NamedTuple):
    """Table of numbers in a text file.

    **Attributes**

    - `path` of the file
    - `heads` and `units`: texts of the line of names and of the line below it, an empty list without such a line
    - `width`: number of columns
    - `remarks`: lines above the header, and those that begin with #
    - `first`: number of lines above the first row of numbers; empty lines and lines that begin with # do not count
    - `delimiter`: character between columns, None for blanks, a line break for one column
    """

    path: Path
    heads: list[str]
    units: list[str]
    width: int
    remarks: list[str]
    first: int
    delimiter: str | None

    def values(self, places: Sequence[int], names: Sequence[str], *, missing: bool = False) -> np.ndarray:
        """Return columns as numbers, (rows, columns).

        **Arguments**: `places` of the columns, from 0; their `names` for messages; `missing`: True to return NaN for readings
        that are empty or NaN.

        **Raises** `InputError`, which names the line, for a row with another number of columns and for a text that is not a
        finite number.
        """
        try:
            delimiter = None if self.delimiter == _ONE_COLUMN_DELIMITER else self.delimiter
            found = np.loadtxt(self._texts(), delimiter=delimiter, usecols=places, comments=None, quotechar='"', ndmin=2)
        except InputError:
            raise
        except ValueError:
            found = None
        if found is not None and np.all(np.isfinite(found)):
            return found
        return np.array([self._row(k, text, places, names, missing) for k, text in self._rows()])

    def line(self, row: int) -> int:
        """Return the line number in the file, counted from 1, of the row of numbers with the index `row`, counted from 0."""
        return next(itertools.islice(self._rows(), row, None))[0]

    def _rows(self) -> Iterator[tuple[int, str]]:
        for line, text in itertools.islice(_content(self.path), self.first, None):
            if '"' in text and text.count('"') % 2:  # it would extend a cell over all lines that follow
                problem = "has a quotation mark without its partner; delete it"
                raise InputError(f"{self.path} line {line}", problem)
            yield line, text

    def _texts(self) -> Iterator[str]:
        """Yield the rows for NumPy. **Raises** `ValueError` for a row with another number of columns."""
        for _, text in self._rows():
            if (len(text.split()) if self.delimiter is None else text.count(self.delimiter) + 1) != self.width:
                raise ValueError
            yield text if self.delimiter == "," else text.replace(",", ".")

    def _row(self, line: int, text: str, places: Sequence[int], names: Sequence[str], missing: bool) -> list[float]:
        cells = _cells(text, self.delimiter)
        if len(cells) != self.width:
            raise InputError(f"{self.path} line {line}", f"has {len(cells)} columns; the lines above have {self.width}")
        found = []
        for place, name in zip(places, names, strict=True):
            cell = cells[place]
            if missing and cell.lower() in _MISSING:
                found.append(np.nan)
                continue
            if not is_number(cell, self.delimiter):
                problem = f"has {quoted(cell)} where the {name} should be; a finite number is needed"
                raise InputError(f"{self.path} line {line}", problem)
            found.append(float(cell.replace(",", ".")))
        return found


def read_table(path: str | Path, needs: str) -> TextTable:
    """Read the header of a table of text.

    - Lines that begin with # and empty lines are skipped
    - Lines above the line of names are skipped if only a line of units, or no line, is between the names and the numbers
    - Numbers may have a decimal comma if columns are separated by semicolons, tabs or blanks

    **Arguments**: `path` of the file; `needs`: the expected columns, for messages.

    **Returns** `TextTable`. **Raises** `InputError` for a file that cannot be read or has no numbers.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> _ = path.write_text("recorder 7\\ntime (s);frame (g)\\n0,0;0,5\\n0,1;0,7\\n")
    >>> table = read_table(path, "time and readings")
    >>> table.heads, table.values([0, 1], table.heads).tolist()
    (['time (s)', 'frame (g)'], [[0.0, 0.5], [0.1, 0.7]])
    """
    path = Path(path)
    remarks = [text.lstrip("# \t") for _, text in _lines(path, _MAX_PREAMBLE) if text.startswith("#")]
    texts = [text for _, text in itertools.islice(_content(path), _MAX_PREAMBLE + 2)]
    if not texts:
        raise InputError(str(path), f"contains no lines of numbers; it needs {needs}")
    delimiter, count = _delimiter(texts), 0
    while count < min(2, len(texts)) and not _has_number(texts[count], delimiter):
        count += 1
    start = 0
    # A second row without a number is a line of names below lines such as "serial 5".
    if not _is_table(texts[: count + 2], delimiter) or not all(
        _has_number(text, delimiter) for text in texts[count + 1 : count + 2]
    ):
        for k in range(1, len(texts) - 1):
            other = _delimiter(texts[k:])
            if _has_number(texts[k], other) or not _has_number(texts[k + 1], other) or not _is_table(texts[k : k + 3], other):
                continue
            alike = [above for above in texts[:k] if _is_table([above, texts[k]], other)]
            if any(_has_number(above, other) for above in alike):  # numbers above the names: the table is damaged
                break
            has_units = bool(alike) and alike[-1] == texts[k - 1] and len(_cells(texts[k], other)) > 1
            start, delimiter, count = (k - 1, other, 2) if has_units else (k, other, 1)
            break
    if start + count == len(texts):
        raise InputError(str(path), "contains no lines of numbers below its header")
    heads = [_cells(text, delimiter) for text in texts[start : start + count]]
    width = len(heads[0]) if heads else len(_cells(texts[0], delimiter))
    units = heads[1] if len(heads) == 2 else []
    if units and len(units) != width:
        raise InputError(str(path), f"has {width} names but {len(units)} units below them")
    below = [unit.strip("()[]{} ") for unit in units]
    return TextTable(path, heads[0] if heads else [], below, width, remarks + texts[:start], start + count, delimiter)


def is_number(cell: str, delimiter: str | None) -> bool:
    """Return True for the text of a finite number. It may have a decimal comma, unless the comma is the `delimiter`."""
    try:
        # Python would read "1_000".
        return "_" not in cell and bool(np.isfinite(float(cell if delimiter == "," else cell.replace(",", "."))))
    except ValueError:
        return False


def _has_number(text: str, delimiter: str | None) -> bool:
    return any(is_number(cell, delimiter) for cell in _cells(text, delimiter))


def _is_table(texts: list[str], delimiter: str | None) -> bool:
    """Return True if all lines have the same number of columns."""
    return len({len(_cells(text, delimiter)) for text in texts}) == 1


def _delimiter(texts: list[str]) -> str | None:
    """Return the character between columns from the first lines of a table; None for blanks, a line break for one column."""
    delimiter = next((delimiter for delimiter in (";", "\t", ",") if delimiter in texts[0]), None)
    row = next((text for text in texts if _has_number(text, delimiter)), texts[0])
    return _ONE_COLUMN_DELIMITER if delimiter is None and len(row.split()) == 1 else delimiter


def _cells(text: str, delimiter: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in text.split(delimiter)]


def _content(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is neither empty nor begins with #."""
    return ((k, text) for k, text in _lines(path) if text.strip() and not text.startswith("#"))


def _lines(path: Path, max_lines: int | None = None) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of each line without surrounding blanks, for at most `max_lines` lines."""
    try:
        with open_regular(path) as file:
            if file.seek(0, io.SEEK_END) > _MAX_BYTES:
                raise InputError(str(path), f"is larger than {_MAX_BYTES >> 20} MB; give the path of a CSV file")
            file.seek(0)
            if file.read(2) == b"PK":
                problem = "is an archive, such as a saved result, not a recording"
                advice = 'for a run: run.to_pandas("time").to_csv("run.csv", index=False)'
                raise InputError(str(path), f"{problem}; give the path of a CSV file ({advice})")
            file.seek(0)
            text = io.TextIOWrapper(file, encoding="utf-8-sig")
            for k in itertools.count(1) if max_lines is None else range(1, max_lines + 1):
                line = text.readline(_MAX_LINE + 1)
                if not line:
                    return
                if len(line) > _MAX_LINE:
                    raise InputError(f"{path} line {k}", f"has more than {_MAX_LINE} characters; give one row in each line")
                yield k, line.strip("\r\n ")
    except OSError as error:
        raise InputError(str(path), f"cannot be read ({error.strerror}); give the path of a CSV file") from error
    except UnicodeDecodeError as error:
        raise InputError(str(path), "is not UTF-8 text; save it as UTF-8") from error
