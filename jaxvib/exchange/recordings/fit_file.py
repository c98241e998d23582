"""Identification files: a machine, recorded runs, their channels, the unknown parameters, and runs to plan."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxvib.errors import InputError, quoted, within
from jaxvib.exchange.recordings.read import read_run
from jaxvib.identification.further_runs.planned import PlannedRun
from jaxvib.identification.problem import MOTIONS
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.files import DRIVES, Tables, build_kind, build_part, load_scene, require_fields, require_tables
from jaxvib.machine.scene import Scene
from jaxvib.units import Number

FIT_TABLES = ["machine", "run", "channel", "identify", "candidate", "limits"]

_RUN_FIELDS = {"file": "file", "from": "start", "until": "until", "rate": "rate", "change": "change"}
"""Fields of a run in a file, and the names of the same arguments in Python, where `from` is a keyword."""


_CANDIDATE_FIELDS = ["name", "drive", "duration", "rate", "at", "noise", "change", "channel"]


class FitInput(NamedTuple):
    """Contents of an identification file.

    **Attributes**: path of the `scene_file`; arguments of `identify`: `scene`, `runs`, names of `unknown` parameters, and
    `known` parameters with their errors; arguments of `plan_runs`: `candidates` and `limits` (None without limits).
    """

    scene_file: Path
    scene: Scene
    runs: tuple[MeasuredRun, ...]
    unknown: tuple[str, ...]
    known: dict[str, Number]
    candidates: tuple[PlannedRun, ...]
    limits: dict[str, Number] | None


def fit_from_tables(tables: Tables, folder: Path) -> FitInput:
    """Return the arguments of `identify` and `plan_runs` from the tables of an identification file in `folder`, see `TEMPLATE`.

    **Raises** `InputError` for a table or field that is missing or unknown, and for values that are not allowed.

    >>> fit_from_tables({"machine": {"file": "machine.toml"}, "runs": []}, Path())
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: runs is not part of an identification file; did you mean 'run'? allowed: ...
    """
    require_tables(tables, "identification", FIT_TABLES)
    machine = tables.get("machine")
    if not isinstance(machine, Mapping) or set(machine) != {"file"} or not isinstance(machine["file"], str):
        raise InputError(
            "machine", 'must be a table with the name of the scene file; write [machine] and below it file = "machine.toml"'
        )
    options = build_part(_unknown_and_known, _table(tables.get("identify", {}), "identify"), "identify")
    entries = _entries(tables, "channel")
    channels = [build_part(Channel, table, f"channel[{k}]") for k, table in enumerate(entries)]
    runs = [_run(table, k, channels, folder) for k, table in enumerate(_entries(tables, "run"))]
    planned = _entries(tables, "candidate") if "candidate" in tables else []
    candidates = [_candidate(table, k, entries, runs[0]) for k, table in enumerate(planned)]
    limits = dict(_table(tables["limits"], "limits")) if "limits" in tables else None
    scene_file = folder / machine["file"]
    scene = load_scene(scene_file)
    return FitInput(scene_file, scene, tuple(runs), *options, tuple(candidates), limits)  # pyright: ignore[reportArgumentType]


def _table(value: object, name: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise InputError(name, f"is {quoted(value)}; it must be a table; write [{name}]")
    return value


def _entries(tables: Mapping[str, object], name: str, within_table: str | None = None) -> list[Mapping[str, object]]:
    entries, path = tables.get(name), name if within_table is None else f"{within_table}.{name}"
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise InputError(path, f"is {'missing' if entries is None else quoted(entries)}; write [[{path}]] for each {name}")
    return entries  # pyright: ignore[reportReturnType]


def _run(table: Mapping[str, object], k: int, channels: list[Channel], folder: Path) -> MeasuredRun:
    require_fields(table, _RUN_FIELDS, f"run[{k}]")
    file = table.get("file")
    if not isinstance(file, str):
        raise InputError(f"run[{k}].file", f"is {'missing' if file is None else quoted(file)}; write the path of a recording")
    change = table.get("change", {})
    if not isinstance(change, Mapping):
        raise InputError(f"run[{k}].change", f'is {quoted(change)}; write {{ "machine.mass[0]" = "+10 kg" }}')
    rest = {_RUN_FIELDS[name]: value for name, value in table.items() if name != "file"}
    with within(f"run[{k}]: "):
        return read_run(folder / file, channels, **rest)  # pyright: ignore[reportArgumentType]


def _candidate(table: Mapping[str, object], k: int, channels: list[Mapping[str, object]], first: MeasuredRun) -> PlannedRun:
    """Return a planned run. Its channels are those of the file, some of them moved to other places, and new ones."""
    field = f"candidate[{k}]"
    require_fields(table, _CANDIDATE_FIELDS, field)
    for name in ("name", "drive", "duration"):
        if name not in table:
            raise InputError(f"{field}.{name}", "is missing; a candidate needs a name, a drive and a duration")
    places, names = table.get("at", {}), [str(each["name"]) for each in channels]
    if not isinstance(places, Mapping):
        raise InputError(f"{field}.at", f"is {quoted(places)}; write the places of channels, such as at = {{ {names[0]} = 2 }}")
    for name in places:
        if name not in names:
            raise InputError(f"{field}.at.{name}", f"is not a channel; the channels are: {', '.join(names)}")
    moved_channels = [
        {**each, "at": places[name]} if name in places else each for name, each in zip(names, channels, strict=True)
    ]
    new = _entries(table, "channel", within_table="candidate") if "channel" in table else []
    measured = [channel.name for channel in first.of_kind(*MOTIONS)]
    if "rate" not in table and not measured:
        raise InputError(f"{field}.rate", "is missing; write for example rate = '500 Hz'")
    values: dict[str, object] = {
        "name": table["name"],
        "drive": build_kind(table["drive"], f"{field}.drive", DRIVES),
        "duration": table["duration"],
        "channels": [build_part(Channel, each, f"{field}.channel") for each in (*moved_channels, *new)],
        "rate": table["rate"] if "rate" in table else first.rate(measured[0]),
        "noise": table.get("noise"),
        "change": table.get("change"),
    }
    with within(f"{field}."):
        return build_part(PlannedRun, values, "")


def _unknown_and_known(unknown: object = (), known: object = None) -> tuple[tuple[str, ...], dict[str, Number]]:
    if not isinstance(unknown, (list, tuple)) or not unknown or not all(isinstance(each, str) for each in unknown):
        raise InputError(
            "identify.unknown",
            f'is {quoted(unknown) if unknown else "missing or empty"}; write a list of names, such as ["machine.stiffness"]',
        )
    if known is not None and not isinstance(known, Mapping):
        raise InputError("identify.known", f'is {quoted(known)}; write {{ "machine.mass[1]" = "95 kg +- 1 %" }}')
    return tuple(unknown), dict(known or {})


TEMPLATE = Path(__file__).with_name("identification.toml").read_text(encoding="utf-8")
"""Commented example of an identification file."""
