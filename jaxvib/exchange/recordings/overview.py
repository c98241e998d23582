"""Overview of a recording: rate, gaps, missing and clipped readings of each channel, and the rotor speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.identification.records.recorded import Recorded
from jaxvib.identification.records.sampling import clipped_at, even_samples
from jaxvib.identification.run import MeasuredRun
from jaxvib.units.columns import unit_factor

_TWO_LEVELS = 0.9
"""Share of readings at the two ends of the range above which a channel counts as a signal with two levels."""


_BAND = (10.0, 1000.0)
"""Range of frequencies, Hz, of the velocity of a vibration in ISO 20816, for machines above 600 rpm (for slower machines the
range begins at 2 Hz)."""


class ChannelOverview(NamedTuple):
    """Overview of a channel, in the unit of the file.

    **Attributes**

    - `name`, `unit`; `kinds`: the kinds of channels (see `Channel`) that can have this unit
    - `rate`: sampling rate, Hz, NaN without times; `samples`: number of readings; `start` and `end`: first and last time, s
    - `low` and `high`: smallest and largest reading; `rms`: root mean square of the readings without their mean
    - `main_frequency`, Hz: frequency of the largest line of the spectrum; `velocity`, m/s, of a channel of acceleration or
      velocity: root mean square of the velocity from 10 to 1000 Hz, the band of ISO 20816 for machines above 600 rpm. Both are
      valid for a run at a constant speed, and are NaN for channels without times, with gaps, or with two levels
    - `missing` and `clipped`: numbers of missing and of clipped readings
    - `notes`: sentences about gaps, repairs and problems
    """

    name: str
    unit: str
    kinds: tuple[str, ...]
    rate: float
    samples: int
    start: float
    end: float
    low: float
    high: float
    rms: float
    main_frequency: float
    velocity: float
    missing: int
    clipped: int
    notes: tuple[str, ...]


def overview_of(recorded: Recorded) -> ChannelOverview:
    """Return the overview of a channel. If a fit would refuse the channel, the only note is the reason.

    >>> t = np.arange(0.0, 2.0, 0.01)
    >>> found = overview_of(Recorded("frame", "g", t, np.clip(np.sin(9.0 * t), -1.0, 0.8)))
    >>> round(found.rate), found.kinds, found.clipped > 30
    (100, ('acceleration',), True)
    """
    field = f"channel {quoted(recorded.name)}"
    kinds = tuple(kind for kind, si in UNITS.items() if recorded.unit and unit_factor(recorded.unit, si) is not None)
    finite = recorded.values[np.isfinite(recorded.values)]
    low, high = (float(np.min(finite)), float(np.max(finite))) if finite.size else (np.nan, np.nan)
    count, nan = recorded.values.size, float("nan")
    missing, clipped = count - finite.size, 0
    notes: list[str] = []
    rate, start, end, main_frequency, velocity = nan, nan, nan, nan, nan
    if recorded.time is not None and recorded.time.size:
        start, end = float(recorded.time[0]), float(recorded.time[-1])
        try:
            if recorded.time.size != count:
                raise InputError(field, f"has {recorded.time.size} times but {count} values")
            time, value, notes = even_samples(recorded.time, recorded.values, field)
            rate, missing = 1.0 / float(time[1] - time[0]), int(np.count_nonzero(np.isnan(value)))
            bottom, top = clipped_at(value)
            clipped = int(np.count_nonzero((value <= bottom) | (value >= top)))
            if clipped > _TWO_LEVELS * count:
                notes.append(f"{field} has two levels, like the pulses of a tachometer")
                clipped = 0
            elif not missing:
                main_frequency, velocity = _lines_of(value, rate, recorded.unit)
            if clipped:
                notes.append(f"{field} is clipped at {' and '.join(f'{x:.4g}' for x in (bottom, top) if np.isfinite(x))}")
        except InputError as error:
            notes = [str(error)]
    rms = float(np.std(finite)) if finite.size else nan
    return ChannelOverview(
        name=recorded.name,
        unit=recorded.unit,
        kinds=kinds,
        rate=rate,
        samples=count,
        start=start,
        end=end,
        low=low,
        high=high,
        rms=rms,
        main_frequency=main_frequency,
        velocity=velocity,
        missing=missing,
        clipped=clipped,
        notes=tuple(notes),
    )


def _lines_of(value: np.ndarray, rate: float, unit: str) -> tuple[float, float]:
    """Return the frequency of the largest line of a signal, Hz, and the root mean square of its velocity, m/s, see
    `ChannelOverview`; NaN for a constant signal. The velocity is NaN for another unit, and for a rate below 20 Hz."""
    window = np.hanning(value.size)
    power = np.abs(np.fft.rfft((value - np.mean(value)) * window)) ** 2
    frequency = np.fft.rfftfreq(value.size, 1.0 / rate)
    if not np.any(power > 0.0):
        return np.nan, np.nan
    largest = int(np.argmax(power))
    near = slice(max(largest - 1, 0), largest + 2)  # a line between two frequencies of the transform is in both
    main_frequency = float(np.sum(frequency[near] * power[near]) / np.sum(power[near]))
    band = (frequency >= _BAND[0]) & (frequency <= _BAND[1])
    acceleration, velocity = (unit_factor(unit, si) if unit else None for si in ("m/s^2", "m/s"))
    if not np.any(band):
        return main_frequency, np.nan
    if acceleration is not None:
        factor = acceleration / (2.0 * np.pi * frequency[band])
    elif velocity is not None:
        factor = np.full(np.count_nonzero(band), velocity)
    else:
        return main_frequency, np.nan
    return main_frequency, float(np.sqrt(2.0 * np.sum(factor**2 * power[band]) / (value.size * np.sum(window**2))))


def speed_of(recorded: Sequence[Recorded], pulses: str | None, speed: str | None, per_turn: int) -> MeasuredRun | None:
    """Return a run that contains only the channel of the rotor: the pulses of a tachometer, or a speed.

    **Arguments**: `pulses` or `speed`: name of the channel, None for the first channel in rpm or rad/s; `per_turn`: pulses per
    revolution.

    **Returns** None if no channel is named and no channel has such a unit. **Raises** `InputError` for an unknown name,
    for a `speed` channel whose unit is not a speed, for a channel without times, and for pulses that cannot be used.
    """
    name = pulses or speed or next((each.name for each in recorded if each.unit.lower() in ("rpm", "1/min", "rad/s")), None)
    if name is None:
        return None
    rotor = next((each for each in recorded if each.name.lower() == name.lower()), None)
    if rotor is None:
        raise InputError("pulses" if pulses else "speed", f"is {quoted(name)}; the channels are {_names(recorded)}")
    if pulses is None and unit_factor(rotor.unit or "rad/s", "rad/s") is None:
        raise InputError("speed", f"is {quoted(name)}, which is in {quoted(rotor.unit)}; give a channel in rpm, rad/s or Hz")
    kind, unit = ("pulses", None) if pulses else ("speed", rotor.unit or None)
    channel = Channel(rotor.name, kind, unit=unit, per_turn=per_turn)
    if rotor.time is None:
        raise InputError(
            "pulses" if pulses else "speed",
            f"is {quoted(name)}, which has no times in the file; give the sampling rate, `rate`",
        )
    return MeasuredRun.from_arrays([channel], {rotor.name: rotor.time}, {rotor.name: rotor.values}, source="recording")


def _names(recorded: Sequence[Recorded]) -> str:
    return ", ".join(quoted(each.name) for each in recorded[:20])
