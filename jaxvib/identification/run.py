"""Recorded runs of a machine: channels, and their samples in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.results.table import is_number
from jaxvib.units import Number, number
from jaxvib.units.columns import unit_factor

Kind = Literal["acceleration", "velocity", "displacement", "force", "pulses", "speed", "angle", "torque", "current"]

UNITS: dict[str, str] = {
    "acceleration": "m/s^2",
    "velocity": "m/s",
    "displacement": "m",
    "force": "N",
    "pulses": "",
    "speed": "rad/s",
    "angle": "rad",
    "torque": "N m",
    "current": "A",
}
"""SI unit of each kind of channel."""

_GAIN_ERROR = {"acceleration": 0.01}
"""Relative standard uncertainty of the gain by kind, if it is not stated; 0 for all other kinds."""

_DIRECTIONS = {"up": (0.0, 1.0), "down": (0.0, -1.0), "across": (1.0, 0.0), "-across": (-1.0, 0.0)}


class Channel(eqx.Module):
    """Channel of a recorded run: a sensor with its place, or a quantity that the recorder computed.

    **Arguments**

    - `name` of the column or channel in the file
    - `kind`: "acceleration", "velocity", "displacement", "force" (on the foundation), "pulses" (of a tachometer), "speed",
      "angle" or "torque" of the rotor, "current" of the motor
    - `at`: number of the platform, from 1, or (x, y), m, of a point of a body, for kinds that measure a motion; default: the
      place of the exciter
    - `direction` in which a positive reading points: "up", "down", "across", "-across", or a pair (across, up) of any length;
      default: up
    - `unit` of the samples, such as "g", "mm/s" or "rpm"; default: the unit stated in the file, otherwise the SI unit
    - `gain_error`: relative standard uncertainty of the gain; default: 0.01 for acceleration, 0 for other kinds; typical: 0.01
      to 0.05
    - `delay`, s, of the readings behind the motion; typical: 0 to 1e-3
    - `high_pass`, Hz, corner frequency of the sensor's first-order high-pass filter, 0 for none; typical: 0.1 to 1 for IEPE
      accelerometers
    - `range`: largest absolute reading, in `unit` or with its own unit; readings at it are clipped; default: detected in the
      histogram
    - `per_turn`: number of pulses per turn

    **Raises** `InputError` for an unknown kind or direction, a unit of another dimension, and numbers that are not allowed.

    >>> import jaxvib as jv
    >>> jv.Channel("frame", "acceleration", at=1, unit="g", range="50 g").range
    490.3325
    """

    name: str = eqx.field(static=True)
    kind: Kind = eqx.field(static=True)
    at: int | tuple[float, float] | None
    direction: tuple[float, float]
    unit: str | None = eqx.field(static=True)
    gain_error: float
    delay: float
    high_pass: float
    range: float | None
    per_turn: int = eqx.field(static=True)

    @validated
    def __init__(
        self,
        name: str,
        kind: str,
        at: int | Sequence[Number] | None = None,
        direction: str | Sequence[float] | None = None,
        unit: str | None = None,
        gain_error: Number | None = None,
        delay: Number = 0.0,
        high_pass: Number = 0.0,
        range: Number | None = None,
        per_turn: int = 1,
    ):
        where = f"channel {quoted(name)}"
        require_one_of(kind, get_args(Kind), f"{where}: kind")
        if unit is not None and kind != "pulses" and unit_factor(unit, UNITS[kind]) is None:
            raise InputError(
                f"{where}: unit", f"is {quoted(unit)}, which is not a unit of {kind}; write for example {UNITS[kind]}"
            )
        if per_turn < 1:
            raise InputError(f"{where}: per_turn", f"is {per_turn}; it must be at least 1")
        self.name, self.kind, self.unit, self.per_turn = name, kind, unit, int(per_turn)  # pyright: ignore[reportAttributeAccessIssue]
        self.at, self.direction = _place(at, where), _direction(direction, where)
        self.gain_error = _GAIN_ERROR.get(kind, 0.0) if gain_error is None else _known(gain_error, "", f"{where}: gain_error")
        self.delay = float(number(delay, "s", f"{where}: delay"))
        self.high_pass = _known(high_pass, "Hz", f"{where}: high_pass")
        self.range = None if range is None else self._full_scale(range, f"{where}: range")

    def _full_scale(self, value: Number, field: str) -> float:
        """Return the largest reading in SI units."""
        if isinstance(value, str):
            text, _, unit = value.strip().partition(" ")
            factor = unit_factor(unit, UNITS[self.kind]) if unit else self.factor
            if factor is not None and is_number(text, ","):
                return float(number(float(text) * factor, UNITS[self.kind], field, low=0.0, open_low=True))
        return float(number(value, UNITS[self.kind], field, low=0.0, open_low=True)) * (
            1.0 if isinstance(value, str) else self.factor
        )

    @property
    def factor(self) -> float:
        """Factor from the channel's unit to SI; 1 for a channel without a unit."""
        return 1.0 if self.unit is None or self.kind == "pulses" else unit_factor(self.unit, UNITS[self.kind]) or 1.0


class Change(NamedTuple):
    """Change of a number of the scene for one run: `action` "add", "set" or "scale", and its `amount`.

    The amount of "add" and "set" is a string with a unit or a number in the unit of the changed number; that of "scale" is a
    factor.
    """

    action: Literal["add", "set", "scale"]
    amount: float | str


class MeasuredRun(eqx.Module):
    """Recorded run of a machine.

    **Attributes**

    - `channels`: the `Channel` of each recorded quantity
    - `times` (n,), s, ascending, and `values` (n,), SI units, by the name of the channel. For kind "pulses": the times of the
      pulses, interpolated between samples, and their numbers 0, 1, 2, ...; a number is left out for each pulse that the
      tachometer missed
    - `clipped` (n,): True for samples at the end of the sensor's range, by the name of the channel
    - `change`: `Change` of numbers of the scene in this run, by their names, such as a mass that was added
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
        times: ArrayLike | Mapping[str, ArrayLike],
        values: Mapping[str, ArrayLike],
        change: Mapping[str, Number] | None = None,
        source: str = "run",
    ) -> MeasuredRun:
        """Return a run from arrays of samples.

        **Arguments**

        - `channels`: one `Channel` for each recorded quantity
        - `times`, s: one array for all channels, or one for each by its name
        - `values`, in the unit of each channel, by its name; for kind "pulses" the sampled signal, or nothing if `times` has
          the times of the pulses
        - `change`: numbers of the scene that were different in this run: "+10 kg" and "-10 kg" add to a number, "+5 %" scales
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
        found_times, found_values, clipped, notes = {}, {}, {}, []
        names = [channel.name for channel in channels]
        if not names:
            raise InputError("channels", "is empty; give at least one Channel")
        for name in names:
            if names.count(name) > 1:
                raise InputError("channels", f"has the name {quoted(name)} twice; names must differ")
        for channel in channels:
            name, where = channel.name, f"{source}: channel {quoted(channel.name)}"
            if isinstance(times, Mapping) and name not in times:
                raise InputError("times", f"has no entry {quoted(name)}; it has: {', '.join(times) or 'none'}")
            time = _samples(times[name] if isinstance(times, Mapping) else times, where)
            if name not in values:
                if channel.kind != "pulses" or not isinstance(times, Mapping):
                    raise InputError("values", f"has no entry {quoted(name)}; it has: {', '.join(values) or 'none'}")
                value = np.arange(time.size, dtype=float)
            else:
                value = _samples(values[name], where) * channel.factor
            if time.shape != value.shape:
                raise InputError(where, f"has {time.size} times but {value.size} values; each value needs its time")
            found_times[name], found_values[name] = time, value
            clipped[name] = np.zeros(time.size, bool) if channel.range is None else np.abs(value) >= channel.range
        parsed = {name: parse_change(value, f"change[{quoted(name)}]") for name, value in (change or {}).items()}
        return cls(tuple(channels), found_times, found_values, clipped, parsed, tuple(notes), source)

    def of_kind(self, *kinds: str) -> tuple[Channel, ...]:
        """Return the channels of the given `kinds`."""
        return tuple(channel for channel in self.channels if channel.kind in kinds)

    def rate(self, name: str) -> float:
        """Return the sampling rate, Hz, of the channel `name`: that of the median time step."""
        return 1.0 / float(np.median(np.diff(self.times[name])))

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of all channels, s."""
        return min(float(t[0]) for t in self.times.values()), max(float(t[-1]) for t in self.times.values())


def parse_change(value: Number, field: str) -> Change:
    """Return a change of a number of the scene from a number or a string.

    >>> parse_change("+10 kg", "change"), parse_change("-5 %", "change"), parse_change("95 kg", "change")
    (Change(action='add', amount='10 kg'), Change(action='scale', amount=0.95), Change(action='set', amount='95 kg'))
    """
    if not isinstance(value, str):
        return Change("set", float(number(value, "", field)))
    text = value.strip()
    if text[:1] in ("+", "-"):
        if text.endswith("%") and is_number(text[1:-1], ","):
            return Change("scale", 1.0 + float(text[:-1]) / 100.0)
        rest = text[1:].strip()
        return Change("add", f"-{rest}" if text[0] == "-" else rest)
    if not text:
        raise InputError(field, "is empty; write for example '+10 kg' or '95 kg'")
    return Change("set", text)


def _samples(values: ArrayLike, where: str) -> np.ndarray:
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(where, "has entries that are not numbers; give one list of numbers") from error
    if found.ndim != 1:
        raise InputError(where, f"has an array of shape {found.shape}; one list of numbers is needed")
    return found


def _known(value: Number, unit: str, field: str) -> float:
    return float(number(value, unit, field, low=0.0))


def _place(at: int | Sequence[Number] | None, where: str) -> int | tuple[float, float] | None:
    if at is None or isinstance(at, (int, np.integer)):
        if at is not None and at < 1:
            raise InputError(f"{where}: at", f"is {at}; it must be the number of a platform, from 1, or a pair (x, y)")
        return None if at is None else int(at)
    if len(at) != 2:
        raise InputError(f"{where}: at", f"is {quoted(at)}; it must be the number of a platform, or a pair (x, y)")
    x, y = (float(number(each, "m", f"{where}: at[{k}]")) for k, each in enumerate(at))
    return x, y


def _direction(direction: str | Sequence[float] | None, where: str) -> tuple[float, float]:
    """Return the unit vector (across, up) of a direction."""
    field = f"{where}: direction"
    if direction is None:
        return _DIRECTIONS["up"]
    if isinstance(direction, str):
        require_one_of(direction, _DIRECTIONS, field)
        return _DIRECTIONS[direction]
    if len(direction) != 2:
        raise InputError(field, f"is {quoted(direction)}; write up, down, across, -across or a pair (across, up)")
    across, up = (float(number(each, "", f"{field}[{k}]")) for k, each in enumerate(direction))
    length = math.hypot(across, up)
    if length == 0.0:
        raise InputError(field, "is (0, 0); it must be a vector that is not zero")
    return across / length, up / length
