"""Channels of a recorded run: sensors with their places."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.results.readable import Readable
from jaxvib.results.table import is_number
from jaxvib.units import Number, count, number
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
"""Default relative standard uncertainty of the gain by kind; 0 for all other kinds."""

_DIRECTIONS = {"up": (0.0, 1.0), "down": (0.0, -1.0), "across": (1.0, 0.0), "-across": (-1.0, 0.0)}


class Channel(Readable):
    """Channel of a recorded run: a sensor with its place, or a quantity that the recorder computed.

    **Arguments**

    - `name` of the column or channel in the file. It also names the sensor: channels of several runs with the same name have
      the same gain in `identify`, wherever they are
    - `kind`: "acceleration", "velocity", "displacement", "force" (on the foundation), "pulses" (of a tachometer), "speed",
      "angle" or "torque" of the rotor, "current" of the motor
    - `at`: number of the platform, from 1, or (x, y), m, of a point of a body, for kinds that measure a motion; default: the
      place of the exciter
    - `direction` in which a positive reading points: "up", "down", "across" (horizontal), "-across", or a
      pair (horizontal, up) of any length; default: up
    - `unit` of the samples, such as "g", "mm/s" or "rpm", or a multiple of a unit, such as "10 g" for a file in V of a sensor
      with 100 mV/g; default: the unit stated in the file, otherwise the SI unit
    - `gain_error`: relative standard uncertainty of the gain; default: 0.01 for acceleration, 0 for other kinds; typical: 0.01
      to 0.05
    - `delay`, s, of the readings relative to the motion; typical: 0 to 1e-3
    - `high_pass`, Hz, corner frequency of the sensor's first-order high-pass filter, 0 for none; typical: 0.1 to 1 for IEPE
      accelerometers
    - `range`: largest absolute reading of the sensor, as a number in `unit` (in SI without a `unit`) or a string with a unit,
      such as "50 g"; readings of at least 99.9 % of the range count as clipped. Clipping is also detected from the histogram of
      the readings, except for speeds and angles. Without a range (the default), only the histogram is used
    - `per_turn`: number of marks per turn, a missing tooth included (36 for a 36-1 wheel); typical: 1 to 60 (default 1)

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
            other = next((each for each, si in UNITS.items() if unit_factor(unit, si) is not None), None)
            known = f"a unit of {other}, not of {kind}" if other else f"not a unit of {kind}"
            raise InputError(f"{where}: unit", f"is {quoted(unit)}, which is {known}; write for example {UNITS[kind]}")
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


def gain_errors(channels: Iterable[Channel]) -> dict[str, float]:
    """Return the standard uncertainty of the gain of each sensor whose gain is uncertain, by the name of its channels.

    **Raises** `InputError` for channels with the same name that are not of one sensor.
    """
    sensors: dict[str, Channel] = {}
    for channel in channels:
        first = sensors.setdefault(channel.name, channel)
        for field in ("kind", "gain_error"):
            one, other = getattr(first, field), getattr(channel, field)
            if one != other:
                problem = (
                    f"is {quoted(one)} in one run and {quoted(other)} in another, but channels with the same name have one"
                )
                raise InputError(
                    f"channel {quoted(channel.name)}: {field}", f"{problem} gain; give different sensors different names"
                )
    return {name: channel.gain_error for name, channel in sensors.items() if channel.gain_error > 0.0}


def _known(value: Number, unit: str, field: str) -> float:
    return float(number(value, unit, field, low=0.0))


def _place(at: int | Sequence[Number] | None, where: str) -> int | tuple[float, float] | None:
    if at is None or isinstance(at, (int, np.integer)):
        if at is not None and at < 1:
            raise InputError(f"{where}: at", f"is {at}; it must be the number of a platform, from 1, or a pair (x, y)")
        return None if at is None else count(at, f"{where}: at")
    if not (isinstance(at, (list, tuple)) or getattr(at, "ndim", 0) == 1) or len(at) != 2:
        raise InputError(f"{where}: at", f"is {quoted(at)}; it must be the number of a platform, or a pair (x, y)")
    x, y = (float(number(each, "m", f"{where}: at[{k}]")) for k, each in enumerate(at))
    return x, y


def _direction(direction: str | Sequence[float] | None, where: str) -> tuple[float, float]:
    """Return the unit vector (horizontal, up) of a direction."""
    field = f"{where}: direction"
    if direction is None:
        return _DIRECTIONS["up"]
    if isinstance(direction, str):
        require_one_of(direction, _DIRECTIONS, field)
        return _DIRECTIONS[direction]
    if len(direction) != 2:
        raise InputError(field, f"is {quoted(direction)}; write up, down, across, -across or a pair (horizontal, up)")
    across, up = (float(number(each, "", f"{field}[{k}]")) for k, each in enumerate(direction))
    length = math.hypot(across, up)
    if length == 0.0:
        raise InputError(field, "is (0, 0); it must be a vector that is not zero")
    return across / length, up / length
