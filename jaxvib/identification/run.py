"""Recorded runs of a machine: channels, and their samples in SI units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.identification.records.agreement import ROTOR_KINDS, check_agreement, turn_speed
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.identification.records.pulses import fit_pulses, number_pulses, rising_edges
from jaxvib.identification.records.recorded import described_channels, recorded_from_sep005
from jaxvib.identification.records.sampling import clipped_at, continued_angle, even_samples, require_ascending, without_spikes
from jaxvib.results.readable import Readable
from jaxvib.results.table import is_number
from jaxvib.units import Number, number

_MAX_READING = 1e100
"""Largest absolute reading, SI units. Squares of larger readings overflow."""

_CLIPPED_SHARE = 0.999
"""Share of the range of a sensor above which a reading counts as clipped."""


_QUANTITIES = {"acceleration": "a", "velocity": "v", "displacement": "d", "force": "f"}
"""Names that the format SEP-005 gives to the kinds of channels."""


class Change(NamedTuple):
    """Change of a parameter of the scene for one run: `action` "add", "set" or "scale", and its `amount`.

    The amount of "add" and "set" is a string with a unit or a number in the unit of the changed parameter; that of "scale" is a
    factor.
    """

    action: Literal["add", "set", "scale"]
    amount: float | str


class MeasuredRun(Readable):
    """Recorded run of a machine.

    **Attributes**

    - `channels`: the `Channel` of each recorded quantity
    - `times` (n,), s, ascending, and `values` (n,), SI units, by the name of the channel. For kind "pulses": the times of the
      pulses, interpolated between samples, and their numbers 0, 1, 2, ...; a number is left out for each pulse that the
      tachometer missed
    - `clipped` (n,): True for samples at the end of the sensor's range, by the name of the channel
    - `change`: `Change` of parameters of the scene in this run, by their names, such as a mass that was added
    - `notes`: sentences about repairs and about doubtful samples
    - `source`: the file, or another name for messages

    Returned by `read_run` and `MeasuredRun.from_arrays`.
    """

    channels: tuple[Channel, ...]
    times: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    clipped: dict[str, np.ndarray]
    change: dict[str, Change] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    source: str = eqx.field(static=True)

    @classmethod
    @validated
    def from_arrays(
        cls,
        channels: Sequence[Channel],
        times: np.ndarray | Sequence[float] | Mapping[str, ArrayLike],
        values: Mapping[str, ArrayLike],
        change: Mapping[str, Number] | None = None,
        source: str = "run",
    ) -> MeasuredRun:
        """Return a run from arrays of samples.

        **Arguments**

        - `channels`: one `Channel` for each recorded quantity
        - `times`, s: one array (n,) for all channels, or a dictionary with an array for each channel by its name
        - `values`: arrays (n,) in the unit of each channel, by its name; for kind "pulses" the sampled signal, or no entry if
          `times` has the times of the pulses
        - `change`: parameters of the scene that were different in this run: "+10 kg" and "-10 kg" add to a value, "+5 %" scales
          it, "95 kg" replaces it
        - `source`: name of the run in messages

        **Returns** `MeasuredRun`. **Raises** `InputError` for samples that cannot be used.

        >>> import numpy as np, jaxvib as jv
        >>> t = np.arange(0.0, 2.0, 1e-3)
        >>> frame = jv.Channel("frame", "acceleration", at=1, unit="g")
        >>> reading = {"frame": 0.1 * np.sin(50.0 * t)}
        >>> run = jv.MeasuredRun.from_arrays([frame], t, reading, change={"machine.mass[0]": "+10 kg"})
        >>> run.change["machine.mass[0]"].action, round(float(np.max(run.values["frame"])), 3)
        ('add', 0.981)
        """
        return run_of(channels, times, values, {}, change, source)

    @classmethod
    @validated
    def from_sep005(
        cls,
        channels: Sequence[Channel],
        timeseries: Sequence[Mapping[str, Any]],
        change: Mapping[str, Number] | None = None,
        source: str = "run",
    ) -> MeasuredRun:
        """Return a run from dictionaries in the format SEP-005, in which the packages of SDyPy exchange measurements.

        **Arguments**

        - `channels`: one `Channel` for each recorded quantity
        - `timeseries`: dictionaries with `data`, `name`, `unit_str`, and `fs` (Hz) or `time` (s); for kind "pulses" the sampled
          signal, or the numbers of pulses at their times, as `to_sep005` returns them
        - `change` and `source` as for `from_arrays`

        **Returns** `MeasuredRun`. **Raises** `InputError` for a missing entry, and for samples that cannot be used.

        >>> import numpy as np, jaxvib as jv
        >>> frame = {"name": "frame", "unit_str": "g", "fs": 1000.0, "data": np.sin(0.05 * np.arange(2000))}
        >>> run = jv.MeasuredRun.from_sep005([jv.Channel("frame", "acceleration", at=1)], [frame])
        >>> run.to_sep005()[0]["unit_str"], round(float(np.max(run.values["frame"])), 3)
        ('m/s^2', 9.807)
        """
        times, values, units = described_channels(recorded_from_sep005(timeseries, source), channels, source)
        for channel in channels:  # numbers of pulses ascend, a sampled signal does not
            if channel.kind == "pulses" and np.all(np.diff(values[channel.name]) > 0.0):
                del values[channel.name]
        return run_of(channels, times, values, units, change, source)

    def to_sep005(self) -> list[dict[str, Any]]:
        """Return the channels as dictionaries in the format SEP-005 with these entries:

        - `name`, `data` and `unit_str`, in the unit of the channel, or in SI if it has none
        - `quantity` for accelerations, velocities, displacements and forces
        - `fs` (Hz), except for channels of pulses
        - `time` (s), a list, for channels of pulses and for channels that do not begin at 0 s
        """
        entries = []
        for channel in self.channels:
            time = self.times[channel.name]
            entry: dict[str, Any] = {"name": channel.name, "data": self.values[channel.name], "unit_str": UNITS[channel.kind]}
            if channel.factor != 1.0:
                entry |= {"data": entry["data"] / channel.factor, "unit_str": channel.unit}
            if channel.kind in _QUANTITIES:
                entry["quantity"] = _QUANTITIES[channel.kind]
            if channel.kind != "pulses":
                entry["fs"] = self.rate(channel.name)
            if channel.kind == "pulses" or time[0] != 0.0:
                entry["time"] = time.tolist()
            entries.append(entry)
        return entries

    @validated
    def of_kind(self, *kinds: str) -> tuple[Channel, ...]:
        """Return the channels of the given `kinds`."""
        return tuple(channel for channel in self.channels if channel.kind in kinds)

    @property
    def rotor_channel(self) -> Channel | None:
        """Channel of the rotor: its pulses if they are recorded, otherwise its angle, otherwise its speed; None without any of
        them."""
        return min(self.of_kind(*ROTOR_KINDS), key=lambda channel: ROTOR_KINDS.index(channel.kind), default=None)

    @validated
    def rate(self, name: str) -> float:
        """Return the sampling rate, Hz, of the channel `name`: the inverse of the median time step.

        **Raises** `InputError` for a channel that the run does not have.
        """
        require_one_of(name, self.times, "name")
        return 1.0 / float(np.median(np.diff(self.times[name])))

    def rotor_speed(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return times, s, and the rotor speed, rad/s, from the `rotor_channel`; None without such a channel.

        For pulses, the speed is the derivative of a smooth angle that is fitted to them. The times are the middles between
        two pulses.
        """
        channel = self.rotor_channel
        if channel is None:
            return None
        time, value = self.times[channel.name], self.values[channel.name]
        if channel.kind != "pulses":
            return turn_speed(channel, time, value)
        middles = 0.5 * (time[1:] + time[:-1])
        return middles, fit_pulses(time, value, channel.per_turn).spline(middles, 1)[:, 0]

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of all channels, s."""
        return min(float(t[0]) for t in self.times.values()), max(float(t[-1]) for t in self.times.values())


def run_of(
    channels: Sequence[Channel],
    times: np.ndarray | Sequence[float] | Mapping[str, ArrayLike],
    values: Mapping[str, ArrayLike],
    units: Mapping[str, str],
    change: Mapping[str, Number] | None,
    source: str,
) -> MeasuredRun:
    """Return the run of `MeasuredRun.from_arrays`; `units`: units that a file states, by the name of the channel."""
    names = [channel.name for channel in channels]
    if not names:
        raise InputError("channels", "is empty; give at least one Channel")
    for name in names:
        if names.count(name) > 1:
            raise InputError("channels", f"has the name {quoted(name)} twice; names must differ")
    samples = {channel.name: _read_channel(channel, times, values, source) for channel in channels}
    parsed = {name: parse_change(value, f"change[{quoted(name)}]") for name, value in (change or {}).items()}
    times_by_name, values_by_name = (
        {k: each.time for k, each in samples.items()},
        {k: each.value for k, each in samples.items()},
    )
    grids: dict[tuple[int, float, float], np.ndarray] = {}  # channels with the same times share one array
    for channel in channels:
        time = times_by_name[channel.name]
        if channel.kind != "pulses":
            times_by_name[channel.name] = grids.setdefault((time.size, time[0], time[-1]), time)
    notes = [
        f"{source}: channel {quoted(channel.name)} has no unit in the file; its readings are taken as {UNITS[channel.kind]}"
        for channel in channels
        if channel.kind != "pulses" and channel.unit is None and units.get(channel.name) == ""
    ]
    notes += [note for each in samples.values() for note in each.notes]
    notes += check_agreement(channels, times_by_name, values_by_name, source, units)
    clipped = {name: each.clipped for name, each in samples.items()}
    return MeasuredRun(tuple(channels), times_by_name, values_by_name, clipped, parsed, tuple(notes), source)


def parse_change(value: Number, field: str) -> Change:
    """Return a change of a parameter of the scene from a number or a string.

    >>> parse_change("+10 kg", "change"), parse_change("-5 %", "change"), parse_change("95 kg", "change")
    (Change(action='add', amount='10 kg'), Change(action='scale', amount=0.95), Change(action='set', amount='95 kg'))
    """
    if not isinstance(value, str):
        return Change("set", float(number(value, "", field)))
    text = value.strip()
    if text[:1] in ("+", "-"):
        amount = text[1:].strip() if text[0] == "+" else f"-{text[1:].strip()}"
        if amount.endswith("%") and is_number(amount[:-1], ","):
            return Change("scale", 1.0 + float(amount[:-1]) / 100.0)
        return Change("add", amount)
    if not text:
        raise InputError(field, "is empty; write for example '+10 kg' or '95 kg'")
    return Change("set", text)


class _Samples(NamedTuple):
    """Samples of a channel: `time` (n,) s, `value` (n,) in SI units, `clipped` (n,): True at an end of the range, `notes`."""

    time: np.ndarray
    value: np.ndarray
    clipped: np.ndarray
    notes: list[str]


def _read_channel(
    channel: Channel,
    times: np.ndarray | Sequence[float] | Mapping[str, ArrayLike],
    values: Mapping[str, ArrayLike],
    source: str,
) -> _Samples:
    """Return the samples of a channel after checks and repairs."""
    name, where = channel.name, f"{source}: channel {quoted(channel.name)}"
    if isinstance(times, Mapping) and name not in times:
        raise InputError("times", f"has no entry {quoted(name)}; it has: {', '.join(times) or 'none'}")
    time = _as_samples(times[name] if isinstance(times, Mapping) else times, where)
    if name not in values:
        if channel.kind != "pulses" or not isinstance(times, Mapping):
            raise InputError("values", f"has no entry {quoted(name)}; it has: {', '.join(values) or 'none'}")
        time, number, notes = number_pulses(time, where)
        return _Samples(time, number, np.zeros(time.size, bool), notes)
    value = _as_samples(values[name], where)
    if channel.factor != 1.0 or value is values[name]:  # one copy only, because a recording may be long
        value = value * channel.factor
    if np.max(np.abs(value), initial=0.0, where=np.isfinite(value)) > _MAX_READING:
        raise InputError(where, f"has a reading above {_MAX_READING:g} {UNITS[channel.kind]}; correct the file or the unit")
    if time.shape != value.shape:
        raise InputError(where, f"has {time.size} times but {value.size} values; each value needs its time")
    if channel.kind == "pulses":
        require_ascending(time, where)
        edges = rising_edges(time, value if channel.direction[1] >= 0.0 else -value, where)
        edges, number, notes = number_pulses(edges, where)
        return _Samples(edges, number, np.zeros(edges.size, bool), notes)
    value, turn_notes = continued_angle(value, where) if channel.kind == "angle" else (value, [])
    time, value, notes = even_samples(time, value, where)
    value, spike_notes = (value, []) if channel.kind in ROTOR_KINDS else without_spikes(time, value, where)
    notes = turn_notes + notes + spike_notes
    low, high = (-np.inf, np.inf) if channel.kind in ("speed", "angle") else clipped_at(value)
    if channel.range is not None:
        low, high = max(low, -_CLIPPED_SHARE * channel.range), min(high, _CLIPPED_SHARE * channel.range)
    clipped = (value <= low) | (value >= high)
    if np.any(clipped):
        count, first = int(np.count_nonzero(clipped)), time[np.argmax(clipped)]
        ends = " and ".join(f"{each:.4g} {UNITS[channel.kind]}" for each in (low, high) if np.isfinite(each))
        notes.append(f"{where} is clipped at about {ends}: {count} of {value.size} readings, the first at {first:g} s")
    return _Samples(time, value, clipped, notes)


def _as_samples(values: ArrayLike, where: str) -> np.ndarray:
    try:
        samples = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(where, "has entries that are not numbers; give one list of numbers") from error
    if samples.ndim != 1:
        raise InputError(where, f"has an array of shape {samples.shape}; one list of numbers is needed")
    return samples
