"""Command `identify` of jaxvib."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, table
from jaxvib.cli.output import DECIMAL_COMMA, fields_of, write_file
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.machine.files import Tables
    from jaxvib.results.estimate import Estimate

Command = TypeVar("Command", bound=Callable)

_NUMBER_OPTIONS = (
    ("mass", "pendulum", "Mass of the pendulum, such as '300 g'."),
    ("length", "pendulum", "Distance of the centre of mass from the axis of the bearing, such as '25 cm'."),
    ("inertia", "pendulum", "Moment of inertia about the centre of mass, kg m^2 [0, a point mass]."),
    ("bearing", "pendulum", "Diameter of the bearing, for --dry, such as '20 mm'."),
    ("g", "pendulum", "Gravity [9.81 m/s^2]."),
    ("angle-unit", "record", "Unit of the angle, such as deg [as in the header]."),
    ("from", "record", "Start of the part of the record to use."),
    ("until", "record", "End of the part of the record to use."),
    ("instrument", "identify", "Relative uncertainty of the moment of inertia, such as 0.03, for the intervals."),
)


def _with_number_options(command: Command) -> Command:
    for name, section, text in reversed(_NUMBER_OPTIONS):
        command = click.option(f"--{name}", f"{section}__{name.replace('-', '_')}", help=text)(command)
    return command


def _with_options(tables: Tables, given: Mapping[str, str | bool | None]) -> Tables:
    """Return the tables of a measurement file with the given options in place of their values."""
    result = dict(tables)
    for name, value in given.items():
        section, _, field = name.partition("__")
        old = result.get(section, {})
        if value is not None and isinstance(old, dict):
            result[section] = {**old, field: value.split(",") if field == "columns" and isinstance(value, str) else value}
    return result


@command("identify", "record")
@_with_number_options
@click.option("--columns", "record__columns", help="Names of the columns of time and angle, such as 't,phi'.")
@click.option(
    "--dry/--no-dry",
    "identify__dry",
    default=None,
    help="Identify the dry friction mu2 in addition to the viscous friction mu1.",
)
@click.option("--air/--no-air", "identify__air", default=None, help="Identify the quadratic drag of the air as well.")
@click.option("--torque/--no-torque", "identify__torque", default=None, help="Identify a constant torque as well.")
@DECIMAL_COMMA
def identify(record: Path, output: Output, **given: str | bool | None) -> None:
    """Identify parameters of a machine from recorded runs, or the friction of a bearing from a recorded swing.

    For a machine, RECORD is an identification file (TOML) with the names of a scene file, of recorded runs and of their
    channels. --out adds the fitted scene (found.toml), a figure of each run and the fit (fit.npz).

    For a bearing, RECORD is a CSV file with the time and the angle of a pendulum that swings on the bearing, or a measurement
    file (TOML) with the name of the CSV file. Options replace the values in the measurement file. --out adds the
    figure and the fit (fit.csv)."""
    import numpy as np  # slow imports, which --help does not need

    from jaxvib.display import shown_unit
    from jaxvib.machine.files import read_toml
    from jaxvib.results.table import read_table
    from jaxvib.study.bearing.identify import identify_bearing
    from jaxvib.study.bearing.measurement import measurement_from_tables

    is_file = record.suffix.lower() == ".toml"
    if not is_file:
        read_table(record, "time and angle of a pendulum")  # reports a wrong file before missing entries of the pendulum
    tables: Tables = read_toml(record) if is_file else {"record": {"file": record.name}}
    if not {"machine", "run", "channel"}.isdisjoint(tables):
        _identify_machine(tables, record.parent, output, [name for name, value in given.items() if value is not None])
        return
    pendulum, swing, options = measurement_from_tables(_with_options(tables, given), record.parent)
    found = identify_bearing(pendulum, swing, **options)
    output.figure("record.png", found.plot)
    unit, factor = shown_unit("rad", 1.0)
    angles = {f"{name} ({unit})": factor * np.asarray(x) for name, x in (("angle", swing.angle), ("fit", found.fitted))}
    output.table("fit.csv", {"time (s)": np.asarray(swing.time), **angles})
    decrement = found.decrement
    document = {
        "status": found.status_name,
        "message": found.message,
        **fields_of(found, "notes", "viscous", "dry", "air", "torque", "correlation"),
        "decrement": None
        if decrement is None
        else {**fields_of(decrement, "viscous", "scatter", "drift", "period", "periods"), "pairs": len(decrement.estimates)},
        **fields_of(found, "frequency", "offset"),
        "inertia": pendulum.total_inertia,
        "inertia_by_frequency": found.inertia,
        **fields_of(found, "noise", "pattern", "structure", "until", "stopped_at"),
        "samples": swing.samples,
        "instrument": options["instrument"],
    }

    def text() -> str:
        rows = [_row("mu1, N m s", found.viscous)]
        further_numbers = {"mu2": found.dry, "drag of the air, N m s^2": found.air, "torque, N m": found.torque}
        rows += [_row(name, each) for name, each in further_numbers.items() if each is not None]
        if decrement is not None:
            rows.append(_row(f"mu1 by the formula of {decrement.periods} periods, N m s", decrement.viscous))
        rows.append(_row("frequency of small swings, rad/s", found.frequency))
        rows.append(_row("recorded angle at the hanging position, rad", found.offset))
        is_valid = found.status_name in ("found", "undetermined")
        meaning = "intervals are for a confidence of 95 %" if is_valid else "intervals do not include the error of the law"
        lines = [
            f"{swing.name}: {swing.samples} samples, noise {found.noise:.3g} rad",
            f"{found.status_name}: {found.message}",
            table(f"friction of the bearing; {meaning}", ["", "value", "from", "to"], rows),
        ]
        if found.dry is not None:
            lines.append(f"correlation of the errors of mu1 and mu2: {found.correlation:.3f}")
        return "\n".join([*lines, *found.notes])

    output.done(document, text, "identify", found)


def _identify_machine(tables: Tables, folder: Path, output: Output, options: list[str]) -> None:
    """Identify the parameters of the machine of an identification file in `folder`."""
    from jaxvib.exchange.recordings.fit_file import fit_from_tables  # slow imports, which --help does not need
    from jaxvib.machine.rewrite import rewrite_scene

    if options:
        name = f"--{options[0].partition('__')[2].replace('_', '-')}"
        raise InputError(name, "is for the swing of a pendulum; leave it out for a machine, and change the identification file")
    fit = fit_from_tables(tables, folder)
    found = jv.identify(fit.scene, fit.runs, unknown=fit.unknown, known=fit.known)
    assert isinstance(found, jv.MachineFit)
    for run in range(1, len(found.time) + 1):
        output.figure("fit.png" if run == 1 else f"fit_run_{run}.png", partial(found.plot, run=run))
    output.save_result("fit.npz", found)
    path = output.file("found.toml")
    if path is not None:
        write_file(path, rewrite_scene(fit.scene_file.read_text(encoding="utf-8"), found.scene))
    document = {"status": found.status_name, "message": found.message}
    document |= fields_of(found, "notes", "names", "units", "estimates", "frequency", "damping_ratio", "gain_names", "gains")
    document |= {name: [each.sentence for each in getattr(found, name)] for name in ("undetermined", "by_gain")}
    output.done(document, found.summary, "identify", found)


def _row(name: str, estimate: Estimate) -> list[str]:
    return [name, f"{estimate.value:.6g}", f"{estimate.low:.6g}", f"{estimate.high:.6g}"]
