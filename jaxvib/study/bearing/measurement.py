"""Measurement files: the record of a swing, the pendulum, and the arguments of `identify`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxvib.errors import InputError, quoted
from jaxvib.machine.files import Tables, build_part, require_fields, require_tables
from jaxvib.study.bearing.record import Record, read_record
from jaxvib.study.bearing.swing import BearingPendulum
from jaxvib.units import Number, number

_FIELDS = {"file": "file", "columns": "columns", "angle_unit": "angle_unit", "from": "from_", "until": "until"}
"""Names of the fields of a record in a file, and in Python, where `from` is a keyword."""


class Measurement(NamedTuple):
    """Arguments of `identify`: `pendulum`, `record`, and `options` (dry, air, torque, instrument)."""

    pendulum: BearingPendulum
    record: Record
    options: dict[str, Any]


def measurement_from_tables(tables: Tables, folder: Path) -> Measurement:
    """Return a measurement from the tables [record], [pendulum], [identify] of a file in `folder`, see `TEMPLATE`.

    **Arguments**: `tables` as parsed from TOML; `folder` that contains the record's file.

    **Returns** `Measurement`. **Raises** `InputError` for a table or field that is missing or unknown, and for values that are
    not allowed.

    >>> import pathlib
    >>> rod = {"mass": 0.3, "length": "25 cm"}
    >>> measurement_from_tables({"record": {"file": "swing.csv", "form": 1.0}, "pendulum": rod}, pathlib.Path())
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: record.form is not a field here; did you mean 'from'? allowed: ...
    """
    names = ["record", "pendulum", "identify"]
    require_tables(tables, "measurement", names)
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            raise InputError(name, f"is {quoted(table)}; it must be a table; write [{name}]")
    pendulum = build_part(BearingPendulum, tables.get("pendulum", {}), "pendulum")
    options = build_part(_options, tables.get("identify", {}), "identify")
    record_table = tables.get("record", {})
    require_fields(record_table, _FIELDS, "record")
    record = build_part(_record, {_FIELDS[name]: value for name, value in record_table.items()}, "record")(folder)
    return Measurement(pendulum, record, options)


def _record(
    file: object, columns: object = None, angle_unit: object = None, from_: Number | None = None, until: Number | None = None
) -> Callable[[Path], Record]:
    if not isinstance(file, str):
        raise InputError("record.file", f"is {quoted(file)}; write the path of a CSV file")
    if angle_unit is not None and not isinstance(angle_unit, str):
        raise InputError("record.angle_unit", f"is {quoted(angle_unit)}; write 'rad', 'mrad', 'deg', 'gon' or 'turn'")
    if columns is not None and (
        not isinstance(columns, (list, tuple)) or len(columns) != 2 or not all(isinstance(name, str) for name in columns)
    ):
        raise InputError(
            "record.columns", f"is {quoted(columns)}; write the names of two columns, time first, such as ['t', 'phi']"
        )

    def read(folder: Path) -> Record:
        record = read_record(folder / file, columns=columns, angle_unit=angle_unit)
        if from_ is None and until is None:
            return record
        start = -math.inf if from_ is None else float(number(from_, "s", "record.from"))
        return record.between(start, math.inf if until is None else float(number(until, "s", "record.until")))

    return read


def _options(dry: object = False, air: object = False, torque: object = False, instrument: Number = 0.0) -> dict[str, Any]:
    laws = {"dry": dry, "air": air, "torque": torque}
    for name, value in laws.items():
        if not isinstance(value, bool):
            raise InputError(f"identify.{name}", f"is {quoted(value)}; write true or false")
    return {**laws, "instrument": float(number(instrument, "", "identify.instrument", low=0.0))}


TEMPLATE = Path(__file__).with_name("measurement.toml").read_text(encoding="utf-8")
"""Commented example of a measurement file."""
