"""Records of a swing: time and angle from a camera or a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.results.fields import in_unit
from jaxvib.results.readable import Readable
from jaxvib.results.table import TextTable, read_table
from jaxvib.units.columns import split_head, unit_factor

_MIN_SAMPLES = 16
"""Smallest number of samples of a record; fewer do not contain a swing."""

_NAMES = {"time": ("time", "t", "zeit", "время"), "angle": ("angle", "phi", "theta", "f", "winkel", "угол")}

_SI = {"time": "s", "angle": "rad"}

_ALLOWED_UNITS = {"time": "s, ms, us or min", "angle": "rad, mrad, deg, gon or turn"}


class Record(Readable):
    """Recorded swing of a pendulum.

    **Arguments**

    - `time` (n,), s, ascending, at least 16 samples; steps need not be equal; typical: 25 to 200 samples per second over 10 to
      60 s
    - `angle` (n,), rad, relative to any position; typical: 0.05 to 1
    - `name` for messages

    **Raises** `InputError` for lengths that differ, fewer than 16 samples, times that do not ascend, and values that are not
    finite. It is also raised for angles with a range above one full turn, which are probably degrees.

    >>> import numpy as np, jaxvib as jv
    >>> t = np.arange(0.0, 10.0, 0.04)
    >>> jv.Record(t, 0.1 * np.cos(6.0 * t)).samples
    250
    """

    time: np.ndarray = eqx.field(metadata=in_unit("s", "time"))
    angle: np.ndarray = eqx.field(metadata=in_unit("rad", "time", name="recorded"))
    name: str = eqx.field(static=True)

    @validated
    def __init__(self, time: ArrayLike, angle: ArrayLike, name: str = "record"):
        try:
            self.time, self.angle = (np.asarray(x, dtype=float) for x in (time, angle))
        except (TypeError, ValueError) as error:
            raise InputError(name, "has entries that are not numbers; give the time in s and the angle in rad") from error
        self.name = name
        if self.time.ndim != 1 or self.time.shape != self.angle.shape:
            shapes = f"time {self.time.shape}, angle {self.angle.shape}"
            raise InputError(name, f"has shapes {shapes}; two lists of one length are needed")
        if self.time.size < _MIN_SAMPLES:
            raise InputError(name, f"has {self.time.size} samples; a swing needs at least {_MIN_SAMPLES}")
        for what, values in (("time", self.time), ("angle", self.angle)):
            wrong = np.flatnonzero(~np.isfinite(values))
            if wrong.size:
                raise InputError(name, f"has {what} {values[wrong[0]]} at sample {wrong[0] + 1}; finite numbers are needed")
        wrong = np.flatnonzero(np.diff(self.time) <= 0.0)
        if wrong.size:
            k = wrong[0]
            pair = f"{self.time[k + 1]:g} s at sample {k + 2}, and {self.time[k]:g} s at the sample before it"
            raise InputError(name, f"has the time {pair}; times must ascend")
        if np.ptp(self.angle) > 2.0 * np.pi:
            size = f"{np.ptp(self.angle):.3g} rad from end to end"
            raise InputError(
                name,
                f"swings {size}, more than a full turn; if these are degrees, give the unit in the header or as angle_unit",
            )

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.time.size

    @validated
    def between(self, start: float, stop: float) -> Record:
        """Return the part of the record from `start` to `stop`, s. **Raises** `InputError` if it has too few samples."""
        is_inside = (self.time >= start) & (self.time <= stop)
        if np.count_nonzero(is_inside) < _MIN_SAMPLES:
            span = f"{self.time[0]:g} s to {self.time[-1]:g} s"
            raise InputError(
                self.name, f"has {np.count_nonzero(is_inside)} samples from {start:g} s to {stop:g} s; it goes from {span}"
            )
        return Record(self.time[is_inside], self.angle[is_inside], self.name)


@validated
def read_record(path: str | Path, *, columns: Sequence[str] | None = None, angle_unit: str | None = None) -> Record:
    """Read a record from a table of text: CSV, or columns between semicolons, tabs or blanks.

    - Lines that begin with # and empty lines are skipped
    - The first line may contain the names of the columns, for example `time (s), angle (deg)`, `t [ms]` or `ANGLE_DEG`; units
      can also be in the next line. Upper and lower case are not distinguished
    - Columns with the names time and angle (t, phi, theta, ...) without a unit are in s and rad; other columns need a unit
    - If columns are separated by semicolons, tabs or blanks, numbers may have a decimal comma

    **Arguments**

    - `path` of the file; typical: 250 to 10,000 lines
    - `columns`: names of the columns of time and angle, with or without their units, if these names are not time and angle
    - `angle_unit`: "rad", "mrad", "deg", "gon" or "turn", in place of the unit in the header

    **Returns** `Record`. **Raises** `InputError` with the wrong line, or the column without a known unit.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "swing.csv"
    >>> _ = path.write_text("# camera 2\\ntime (s), angle (deg)\\n" + "".join(f"{k / 10}, {10 - k % 3}\\n" for k in range(20)))
    >>> round(float(read_record(path).angle[0]), 6)
    0.174533
    """
    if columns is not None and (len(columns) != 2 or not all(isinstance(name, str) for name in columns)):
        raise InputError("columns", f"is {quoted(columns)}; give the names of two columns, time first, such as ['t', 'phi']")
    table = read_table(path, "two columns, time and angle")
    places, factors = _columns(table, columns, angle_unit)
    values = table.values(places, list(_NAMES)) * factors
    wrong = np.flatnonzero(np.diff(values[:, 0]) <= 0.0)
    if wrong.size:
        n = int(wrong[0]) + 1
        pair = f"{values[n, 0]:g} s, and {values[n - 1, 0]:g} s in the line before it"
        raise InputError(f"{table.path} line {table.line(n)}", f"has the time {pair}; times must ascend")
    return Record(values[:, 0], values[:, 1], str(table.path))


def _columns(table: TextTable, requested: Sequence[str] | None, angle_unit: str | None) -> tuple[list[int], list[float]]:
    """Return the indices of the columns of time and angle, and the factors from their units to SI units."""
    path, width, heads = table.path, table.width, table.heads
    if width < 2:
        raise InputError(str(path), "has one column; two are needed, time and angle, separated by commas, semicolons or tabs")
    given_factor = None if angle_unit is None else _factor(angle_unit, "angle", f"{path}: unit of angle")
    if not heads:
        if requested is not None or width > 2:
            raise InputError(str(path), f"has {width} columns but no line of names; add one, for example time (s), angle (deg)")
        return [0, 1], [1.0, 1.0 if given_factor is None else given_factor]
    unit_row = table.units or [""] * width
    places, factors = [], []
    for k, (what, known) in enumerate(_NAMES.items()):
        parts = [split_head(head, _SI[what]) for head in heads]
        choice = tuple(name.strip().lower() for name in ((requested[k],) if requested is not None else known))
        matching = [i for i, (name, _) in enumerate(parts) if {name.lower(), heads[i].lower()} & set(choice)]
        if not matching and requested is None and width == 2:
            matching = [k]
        if len(matching) != 1:
            problem = (
                f"has {len(matching) or 'no'} column{'s' if matching else ''} {(requested[k] if requested else choice[0])!r}"
            )
            names = ", ".join(heads)
            raise InputError(str(path), f"{problem} for the {what}; its columns are {names}: name those of time and angle")
        place = matching[0]
        name, unit = parts[place]
        unit = unit_row[place] or unit
        places.append(place)
        if what == "angle" and given_factor is not None:
            factors.append(given_factor)
        elif unit:
            factors.append(_factor(unit, what, f"{path}: unit of {what}"))
        elif name.lower() in known:
            factors.append(1.0)
        else:
            advice = f"write {what} ({'s' if what == 'time' else 'deg'})" + (" or give angle_unit" if what == "angle" else "")
            raise InputError(
                str(path), f"has the column {quoted(heads[place])} for the {what}, whose unit is unknown; {advice}"
            )
    return places, factors


def _factor(unit: str, what: str, field: str) -> float:
    factor = unit_factor(unit, _SI[what])
    if factor is None:
        raise InputError(field, f"is {quoted(unit)}, which is not a unit of {what} here; write {_ALLOWED_UNITS[what]}")
    return factor
