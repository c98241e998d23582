"""Identification files: a machine, recorded runs, their channels, and the unknown numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxvib.errors import InputError, quoted, within
from jaxvib.exchange.recordings.read import read_run
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.files import Tables, build_part, load_scene, suggest_name
from jaxvib.machine.scene import Scene
from jaxvib.units import Number

FIT_TABLES = ["machine", "run", "channel", "identify"]

_RUN_FIELDS = {"file": "file", "from": "start", "until": "until", "rate": "rate", "change": "change"}
"""Names of fields of a run in a file, and in Python, in which `from` is a keyword."""


class FitInput(NamedTuple):
    """Arguments of `identify`: `scene`, `runs`, names of `unknown` numbers, `known` numbers with their errors; and the path of
    the `scene_file`."""

    scene_file: Path
    scene: Scene
    runs: tuple[MeasuredRun, ...]
    unknown: tuple[str, ...]
    known: dict[str, Number]


def fit_from_tables(tables: Tables, folder: Path) -> FitInput:
    """Return the arguments of `identify` from the tables of an identification file in `folder`, see `TEMPLATE`.

    **Raises** `InputError` for a table or field that is missing or unknown, and for values that are not allowed.

    >>> fit_from_tables({"machine": {"file": "machine.toml"}, "runs": []}, Path())
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: runs is not part of an identification file; did you mean 'run'? allowed: ...
    """
    for name in tables:
        if name not in FIT_TABLES:
            raise InputError(name, f"is not part of an identification file; {suggest_name(name, FIT_TABLES)}")
    machine = tables.get("machine")
    if not isinstance(machine, Mapping) or set(machine) != {"file"} or not isinstance(machine["file"], str):
        raise InputError("machine", 'is not the name of a scene file; write [machine] and below it file = "machine.toml"')
    options = build_part(_options, _table(tables.get("identify", {}), "identify"), "identify")
    channels = [build_part(Channel, each, f"channel[{k}]") for k, each in enumerate(_entries(tables, "channel"))]
    runs = [_run(each, k, channels, folder) for k, each in enumerate(_entries(tables, "run"))]
    scene_file = folder / machine["file"]
    return FitInput(scene_file, load_scene(scene_file), tuple(runs), *options)


def _table(value: object, name: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise InputError(name, f"is {quoted(value)}; it must be a table, write [{name}]")
    return value


def _entries(tables: Tables, name: str) -> list[Mapping[str, object]]:
    entries = tables.get(name)
    if not isinstance(entries, list) or not entries or not all(isinstance(each, Mapping) for each in entries):
        raise InputError(name, f"is {'missing' if entries is None else quoted(entries)}; write [[{name}]] for each {name}")
    return entries  # pyright: ignore[reportReturnType]


def _run(table: Mapping[str, object], k: int, channels: list[Channel], folder: Path) -> MeasuredRun:
    for name in table:
        if name not in _RUN_FIELDS:
            raise InputError(f"run[{k}].{name}", f"is not a field here; {suggest_name(name, list(_RUN_FIELDS))}")
    file = table.get("file")
    if not isinstance(file, str):
        raise InputError(f"run[{k}].file", f"is {'missing' if file is None else quoted(file)}; write the path of a recording")
    change = table.get("change", {})
    if not isinstance(change, Mapping):
        raise InputError(f"run[{k}].change", f'is {quoted(change)}; write {{ "machine.mass[0]" = "+10 kg" }}')
    rest = {_RUN_FIELDS[name]: value for name, value in table.items() if name != "file"}
    with within(f"run[{k}]: "):
        return read_run(folder / file, channels, **rest)  # pyright: ignore[reportArgumentType]


def _options(unknown: object = (), known: object = None) -> tuple[tuple[str, ...], dict[str, Number]]:
    if not isinstance(unknown, (list, tuple)) or not unknown or not all(isinstance(each, str) for each in unknown):
        raise InputError("identify.unknown", f'is {quoted(unknown)}; write a list of names, such as ["machine.stiffness"]')
    if known is not None and not isinstance(known, Mapping):
        raise InputError("identify.known", f'is {quoted(known)}; write {{ "machine.mass[1]" = "95 kg +- 1 %" }}')
    return tuple(unknown), dict(known or {})


TEMPLATE = """# Recorded runs of a machine, from which numbers of its scene are identified.
[machine]
file = "machine.toml"       # scene with first values of the unknown numbers; paths are relative to this file

[[run]]
file = "run_up.csv"         # CSV, TDMS, UFF, MAT, WAV or MF4
# from = "2 s"              # part of the record
# until = "40 s"
# rate = "2 kHz"            # if the file has no times

# [[run]]                   # a second run, with a mass that was added to the first platform
# file = "heavier.csv"
# change = { "machine.mass[0]" = "+10 kg" }

[[channel]]
name = "frame"              # as in the file
kind = "acceleration"       # velocity, displacement, force, pulses, speed, angle, torque, current
at = 2                      # number of the platform, or [x, y] on a body
# unit = "g"                # if the file does not state it
# direction = "down"        # in which a positive reading points; default: up
# gain_error = "1 %"        # standard uncertainty of the gain; 1 % by default for accelerations
# delay = "0.1 ms"
# high_pass = "0.5 Hz"      # of an IEPE accelerometer
# range = "50 g"            # readings at the end of the range are clipped

[[channel]]
name = "tacho"
kind = "pulses"
per_turn = 1

[identify]
unknown = ["machine.stiffness", "machine.damping"]
# known = { "machine.mass[1]" = "95 kg +- 1 %" }
"""
"""Commented example of an identification file."""
