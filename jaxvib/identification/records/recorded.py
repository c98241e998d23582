"""Channels as recorders store them, and the selection of those that the description of a run names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.units.columns import split_head, unit_factor


class Recorded(NamedTuple):
    """Channel of a file: `name`, `unit` ("" if the file does not state it), `time` (n,) s or None, `values` (n,)."""

    name: str
    unit: str
    time: np.ndarray | None
    values: np.ndarray


def recorded_from_sep005(timeseries: Sequence[Mapping[str, Any]], source: str) -> list[Recorded]:
    """Return channels from dictionaries in the format SEP-005: `data`, `name`, `unit_str`, and `fs` (Hz) or `time` (s).

    **Raises** `InputError` for a dictionary without one of these entries.

    >>> recorded_from_sep005([{"name": "a", "unit_str": "g", "fs": 10.0, "data": [0.1, 0.2]}], "run")[0].time.tolist()
    [0.0, 0.1]
    """
    found = []
    for k, each in enumerate(timeseries):
        where = f"{source}: timeseries[{k}]"
        missing = [name for name in ("data", "name", "unit_str") if name not in each]
        if missing or (each.get("time") is None and each.get("fs") is None):
            needed = missing[0] if missing else "fs"
            raise InputError(where, f"has no entry {quoted(needed)}; SEP-005 needs data, name, unit_str, and fs or time")
        try:
            values = np.asarray([np.nan if x is None else x for x in each["data"]], float)
            if each.get("time") is not None:
                time = np.asarray(each["time"], float)
            elif (rate := float(each["fs"])) > 0.0:
                time = np.arange(values.size) / rate
            else:
                raise ValueError(rate)
        except (TypeError, ValueError) as error:
            raise InputError(where, "has data, fs or time that are not numbers; fs must be greater than 0") from error
        found.append(Recorded(str(each["name"]), str(each["unit_str"]), time, values))
    return found


def described_channels(
    recorded: Sequence[Recorded], channels: Sequence[Channel], source: str, low: float = -math.inf, high: float = math.inf
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the times (s, from `low` to `high`) and the values of channels.

    The values are in SI, or as in the file if the channel has its own `unit`.

    **Raises** `InputError` for a channel that was not recorded or not once only, a wrong unit, and times and values of
    different length.
    """
    times, values = {}, {}
    for channel in channels:
        where = f"{source}: channel {quoted(channel.name)}"
        found = _find(recorded, channel, where)
        factor = _factor(found, channel, where)
        if found.time is None:
            if channel.kind != "pulses":
                raise InputError(where, "has no times in the file; give the sampling rate of the run, `rate`")
            times[channel.name] = _between(found.values, low, high, found.values)
            continue
        if found.time.size != found.values.size:
            sizes = f"has {found.time.size} times but {found.values.size} values"
            raise InputError(where, f"{sizes}; save both with the same length")
        times[channel.name] = _between(found.time, low, high, found.time)
        own = _between(found.time, low, high, found.values)
        values[channel.name] = own if factor == 1.0 else own * factor
    return times, values


def _between(time: np.ndarray, low: float, high: float, values: np.ndarray) -> np.ndarray:
    return values if low == -math.inf and high == math.inf else values[(time >= low) & (time <= high)]


def _find(recorded: Sequence[Recorded], channel: Channel, where: str) -> Recorded:
    """Return the channel of the file with a name, which may include its unit; upper and lower case are not distinguished."""
    wanted = channel.name.strip().lower()
    for name_of in (
        lambda each: wanted if each.name == channel.name else None,
        lambda each: each.name.strip().lower(),
        lambda each: f"{each.name} ({each.unit})".lower(),
        lambda each: split_head(each.name, UNITS[channel.kind])[0].lower(),
    ):
        found = [each for each in recorded if name_of(each) == wanted]
        if len(found) > 1:
            raise InputError(where, f"is the name of {len(found)} channels of the file; give them different names")
        if found:
            return found[0]
    names = ", ".join(quoted(each.name) for each in recorded[:20])
    raise InputError(where, f"is not in the file; its channels are {names}")


def _factor(recorded: Recorded, channel: Channel, where: str) -> float:
    """Return the factor from the unit in the file to SI for a channel without a unit of its own."""
    if channel.kind == "pulses" or channel.unit is not None:
        return 1.0
    si = UNITS[channel.kind]
    factor = unit_factor(recorded.unit or split_head(recorded.name, si)[1], si)
    if not recorded.unit:
        return 1.0 if factor is None else factor
    if factor is None:
        problem = f"is in {quoted(recorded.unit)} in the file, which is not a unit of {channel.kind}"
        remedy = f"give the unit of the readings, such as unit='10 {si}' if a reading of 1 is 10 {si}"
        raise InputError(where, f"{problem}; correct its kind, or {remedy}")
    return factor
