"""Channels as recorders store them, and the selection of the channels that the description of a run names."""

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
    channels = []
    for k, entry in enumerate(timeseries):
        where = f"{source}: timeseries[{k}]"
        missing = [name for name in ("data", "name", "unit_str") if name not in entry]
        if missing or (entry.get("time") is None and entry.get("fs") is None):
            needed = missing[0] if missing else "fs"
            raise InputError(where, f"has no entry {quoted(needed)}; SEP-005 needs data, name, unit_str, and fs or time")
        try:
            values = np.asarray([np.nan if x is None else x for x in entry["data"]], float)
            if entry.get("time") is not None:
                time = np.asarray(entry["time"], float)
            elif (rate := float(entry["fs"])) > 0.0:
                time = np.arange(values.size) / rate
            else:
                raise ValueError(rate)
        except (TypeError, ValueError) as error:
            raise InputError(
                where, "has values of data, fs or time that are not numbers, or an fs that is not greater than 0; correct them"
            ) from error
        channels.append(Recorded(str(entry["name"]), str(entry["unit_str"]), time, values))
    return channels


def described_channels(
    recorded: Sequence[Recorded], channels: Sequence[Channel], source: str, low: float = -math.inf, high: float = math.inf
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, str]]:
    """Return the times (s, from `low` to `high`) and the values of channels, and the units that the file states.

    The values are in SI units. If the channel has a `unit`, they are the values of the file, unchanged, in this unit. If a
    channel of pulses has no times in the file, its recorded values are returned as the times of the pulses, without values.

    **Raises** `InputError` for a channel that the file does not have or has more than once, a wrong unit, and times and values
    of different length.
    """
    times, values, units = {}, {}, {}
    for channel in channels:
        where = f"{source}: channel {quoted(channel.name)}"
        recorded_channel = _find(recorded, channel, where)
        factor = _factor(recorded_channel, channel, where)
        units[channel.name] = recorded_channel.unit or split_head(recorded_channel.name, UNITS[channel.kind])[1]
        if recorded_channel.time is None:
            if channel.kind != "pulses":
                raise InputError(where, "has no times in the file; give the sampling rate of the run, `rate`")
            times[channel.name] = _between(recorded_channel.values, low, high, recorded_channel.values)
            continue
        if recorded_channel.time.size != recorded_channel.values.size:
            sizes = f"has {recorded_channel.time.size} times but {recorded_channel.values.size} values"
            raise InputError(where, f"{sizes}; save both with the same length")
        times[channel.name] = _between(recorded_channel.time, low, high, recorded_channel.time)
        in_span = _between(recorded_channel.time, low, high, recorded_channel.values)
        values[channel.name] = in_span if factor == 1.0 else in_span * factor
    return times, values, units


def _between(time: np.ndarray, low: float, high: float, values: np.ndarray) -> np.ndarray:
    return values if low == -math.inf and high == math.inf else values[(time >= low) & (time <= high)]


def _find(recorded: Sequence[Recorded], channel: Channel, where: str) -> Recorded:
    """Return the recorded channel with the name of `channel`. An exact match comes first; then upper and lower case are not
    distinguished, and the name in the file may include its unit."""
    wanted_name = channel.name.strip().lower()
    for name_of in (
        lambda each: wanted_name if each.name == channel.name else None,
        lambda each: each.name.strip().lower(),
        lambda each: f"{each.name} ({each.unit})".lower(),
        lambda each: split_head(each.name, UNITS[channel.kind])[0].lower(),
    ):
        matches = [each for each in recorded if name_of(each) == wanted_name]
        if len(matches) > 1:
            raise InputError(where, f"is the name of {len(matches)} channels of the file; give them different names")
        if matches:
            return matches[0]
    names = ", ".join(quoted(each.name) for each in recorded[:20])
    raise InputError(where, f"is not in the file; its channels are {names}")


def _factor(recorded: Recorded, channel: Channel, where: str) -> float:
    """Return the factor from the unit in the file to SI; 1 for pulses and for a channel whose `unit` is given."""
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
