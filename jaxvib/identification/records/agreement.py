"""Agreement of the channels of a run with one another: units, signs, swapped channels, shafts, clocks, aliasing.

Two kinds of comparison need no model of the machine:

- Rotor speeds that are measured by pulses, by an angle and by a speed must be equal
- For two motions x and y of one point in one direction, Y = (i w)^d X at each frequency w at which they are coherent; d is
  the difference of their numbers of derivatives, -2 to 2
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.units.columns import unit_factor

_DERIVATIVES = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Number of derivatives of the displacement in a kind of motion."""

ROTOR_KINDS = ("pulses", "angle", "speed")
"""Kinds of channels that measure the rotor's rotation, the most accurate one first."""

OTHER_UNITS = {
    "displacement": ("m", "mm", "um", "mil"),
    "velocity": ("m/s", "mm/s", "in/s"),
    "acceleration": ("m/s^2", "g", "mm/s^2"),
    "speed": ("rad/s", "rpm", "Hz", "deg/s"),
}
"""Units that a file may have in place of the stated one."""

_SPEED_ERROR, _MOTION_ERROR, _UNIT_ERROR = 0.03, 0.3, 0.15
"""Largest allowed relative difference between two speeds, and between two motions. A wrong unit is named as the cause if the
relative difference between the ratio of motions and the ratio of units is at most the third number."""

_COHERENT, _STRONG = 0.9, 1e-3
"""Smallest coherence at a frequency that is compared, and smallest power at this frequency relative to the largest power."""

_SEGMENTS = 8
"""Number of segments of a record whose spectra are averaged."""

_ALIASING_LENGTH, _ALIASING_PIECES = 8192, 64
"""Number of samples of a piece of a record, and largest number of pieces, whose spectrum is examined for aliasing."""

_DRIFT, _DRIFT_ANGLE = 3.0, 0.1
"""Drift of a clock, relative to its standard error, and error of the rotor's angle at the end of the record, rad, above which
a note reports the drift."""

_LEAST_DRIFT_ERROR, _MAX_CONDITION = 1e-7, 1e3
"""Smallest standard error of a drift, and largest condition number of the fit of a drift."""


class _Signal(NamedTuple):
    channel: Channel
    unit: str
    time: np.ndarray
    value: np.ndarray


def check_agreement(
    channels: Sequence[Channel],
    times: Mapping[str, np.ndarray],
    values: Mapping[str, np.ndarray],
    source: str,
    file_units: Mapping[str, str],
) -> list[str]:
    """Compare the channels of a run with one another, and return notes about clocks and aliasing.

    **Arguments**: `channels`; `times`, s, and `values`, SI, by the name of the channel; `source` for messages; `file_units`:
    units that the file states, for messages about wrong units.

    **Raises** `InputError` for a wrong unit, a reversed sign, swapped channels, different shafts, and a sampling rate that is
    too low for the rotor speed.
    """
    signals = [
        _Signal(each, each.unit or file_units.get(each.name) or UNITS[each.kind], times[each.name], values[each.name])
        for each in channels
    ]
    speeds = [
        _Signal(each.channel, each.unit, *turn_speed(each.channel, each.time, each.value))
        for each in signals
        if each.channel.kind in ROTOR_KINDS
    ]
    motions = [each._replace(value=_filled(each.value)) for each in signals if each.channel.kind in _DERIVATIVES]
    notes = []
    for one, other in itertools.combinations(sorted(speeds, key=lambda each: each.channel.kind == "speed"), 2):
        notes += _compare_speeds(one, other, source)
    _check_motions(motions, source)
    for motion in motions:
        notes += _aliasing(motion, speeds, source)
    return notes


def turn_speed(channel: Channel, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and the rotor speed, rad/s, from a channel of pulses (`value`: their numbers), angle or speed.

    For pulses the speed is the average over each turn, because marks may be unevenly spaced. If a recorder rounds the times of
    pulses to its samples, the duration of a turn has an error of up to one sampling step.
    """
    if channel.kind == "speed":
        is_finite = np.isfinite(value)
        return time[is_finite], value[is_finite]
    if channel.kind == "pulses":  # only the pulses of one mark, selected by their numbers
        angles = 2.0 * np.pi * value / channel.per_turn
        is_used = np.isfinite(value) & ((value - value[np.isfinite(value)][0]) % channel.per_turn == 0.0)
    else:
        angles, is_used = value, np.isfinite(value) & (np.arange(time.size) % max(1, time.size // 500) == 0)
    angles, time = angles[is_used], time[is_used]
    return 0.5 * (time[1:] + time[:-1]), np.diff(angles) / np.diff(time)


def _compare_speeds(reference_signal: _Signal, other: _Signal, source: str) -> list[str]:
    """Compare two speeds of the rotor; `other` is the one whose unit is in doubt."""
    inside = (reference_signal.time > other.time[0]) & (reference_signal.time < other.time[-1])
    if np.count_nonzero(inside) < 4:
        return []
    time, reference = reference_signal.time[inside], reference_signal.value[inside]
    speed = np.interp(time, other.time, other.value)
    is_turning = np.abs(reference) > 0.05 * np.max(np.abs(reference))
    ratio = float(np.median(speed[is_turning] / reference[is_turning]))
    where, name = f"{source}: channel {quoted(other.channel.name)}", quoted(reference_signal.channel.name)
    if abs(abs(ratio) - 1.0) <= _SPEED_ERROR:
        if ratio < 0.0 and other.channel.kind != "speed":
            raise InputError(where, f"turns in the opposite direction to {name}; reverse the sign of one of them")
        pair = f"{name} and {quoted(other.channel.name)}"
        return _drift(time, reference, np.sign(ratio) * speed, f"{source}: the clocks of {pair}")
    if other.channel.kind == "speed":
        fitting_unit = _fitting_unit(other, 1.0 / abs(ratio), _SPEED_ERROR)
        if fitting_unit:
            problem = f"is {abs(ratio):.4g} times the speed of {name}"
            raise InputError(where, f"{problem}; the unit {quoted(fitting_unit)} would fit")
    scatter = float(np.median(np.abs(speed[is_turning] / reference[is_turning] / ratio - 1.0)))
    if scatter > _SPEED_ERROR:
        raise InputError(
            where, f"and {name} are not the speed of one rotor: their ratio changes by {100.0 * scatter:.0f} %; leave one out"
        )
    problem = f"turns {abs(ratio):.4g} times as fast as {name} at all times"
    raise InputError(where, f"{problem}: correct per_turn, or leave out the channel of the shaft without the exciter")


def _fitting_unit(signal: _Signal, factor: float, error: float) -> str | None:
    """Return the unit with which the readings would be `factor` times as large; None if no unit does this."""
    kind = signal.channel.kind
    for unit in OTHER_UNITS[kind]:
        ratio = (unit_factor(unit, UNITS[kind]) or 1.0) / (unit_factor(signal.unit, UNITS[kind]) or 1.0)
        if ratio != 1.0 and abs(ratio / factor - 1.0) <= error:
            return unit
    return None


def _drift(time: np.ndarray, reference: np.ndarray, speed: np.ndarray, subject: str) -> list[str]:
    """Return a note on the `subject` if the clock of one speed drifts against the clock of the other speed.

    While the speed changes at the rate a, a delay of d + e t changes the reading by -a (d + e t).
    """
    if time.size < 32:
        return []
    rate = np.gradient(reference, time)
    elapsed = time - time[0]
    columns = np.stack([reference, -rate, -rate * elapsed], axis=1)
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / scale
    if np.min(scale) < 1e-9 * np.max(np.abs(reference)) or np.linalg.cond(columns) > _MAX_CONDITION:
        return []
    coefficients, *_ = np.linalg.lstsq(columns, speed, rcond=None)
    residuals = speed - columns @ coefficients
    errors = np.sqrt(np.sum(residuals**2) / (time.size - 3) * np.diag(np.linalg.inv(columns.T @ columns)))
    drift, error = coefficients[2] / scale[2], max(float(errors[2] / scale[2]), _LEAST_DRIFT_ERROR)
    final_delay = abs(drift) * elapsed[-1]
    if abs(drift) < _DRIFT * error or final_delay * float(np.max(np.abs(reference))) < _DRIFT_ANGLE:
        return []
    return [
        f"{subject} drift by {1e3 * final_delay:.3g} ms over the record ({1e6 * abs(drift):.3g} ppm); "
        "record both by one device, or leave one out"
    ]


def _check_motions(motions: Sequence[_Signal], source: str) -> None:
    """Compare motions of the same point in the same direction."""
    pairs = [pair for pair in itertools.combinations(motions, 2) if _same_place(pair[0].channel, pair[1].channel)]
    factors = {(one.channel.name, other.channel.name): _factor(one, other) for one, other in pairs}
    disagreeing = [pair for pair in pairs if not _agrees(factors[pair[0].channel.name, pair[1].channel.name])]
    for (a, b), (c, d) in itertools.combinations(disagreeing, 2):
        for first, second, third, fourth in ((a, b, c, d), (a, b, d, c)):
            if second.channel.kind == fourth.channel.kind and _fits(first, second, fourth) and _fits(third, fourth, second):
                names = f"{quoted(second.channel.name)} and {quoted(fourth.channel.name)}"
                raise InputError(
                    f"{source}: channels {names}",
                    "are swapped: the readings of each channel fit the place of the other; exchange the places",
                )
    for one, other in disagreeing:
        factor = factors[one.channel.name, other.channel.name]
        assert factor is not None
        where, name = f"{source}: channel {quoted(other.channel.name)}", quoted(one.channel.name)
        if factor.real < 0.0 and abs(factor.imag) < 0.5 * abs(factor.real) and abs(abs(factor) - 1.0) <= _MOTION_ERROR:
            raise InputError(where, f"has the reversed sign of {name} at the same place; reverse the direction of one of them")
        units = [
            f"{quoted(unit)} for {quoted(each.channel.name)}"
            for each, need in ((other, 1.0 / abs(factor)), (one, abs(factor)))
            if (unit := _fitting_unit(each, need, _UNIT_ERROR))
        ]
        problem = f"is {abs(factor):.3g} times the motion that follows from {name} at the same place"
        fix = f"the unit {' or '.join(units)} would fit" if units else "correct the unit, the place or the gain of one of them"
        raise InputError(where, f"{problem}; {fix}")


def _same_place(one: Channel, other: Channel) -> bool:
    across = one.direction[0] * other.direction[1] - one.direction[1] * other.direction[0]
    return one.at == other.at and abs(across) < 1e-6


def _agrees(factor: complex | None) -> bool:
    """Return True if a factor is close to 1, or None."""
    return factor is None or abs(factor - 1.0) <= _MOTION_ERROR


def _fits(one: _Signal, place: _Signal, other: _Signal) -> bool:
    """Return True if the motion of `one` agrees with the readings of `other` at the place and in the direction of `place`."""
    factor = _factor(one, other._replace(channel=place.channel))
    return factor is not None and _agrees(factor)


def _factor(one: _Signal, other: _Signal) -> complex | None:
    """Return the median of Y / ((i w)^d X) of two motions X, Y over the coherent frequencies, or None without such frequencies.

    The median is 1 if the channels agree; opposite directions of the channels are taken into account.
    """
    step = max(float(np.median(np.diff(each.time))) for each in (one, other))
    start, end = max(one.time[0], other.time[0]), min(one.time[-1], other.time[-1])
    count = int((end - start) / step)
    length = 2 * (count // (_SEGMENTS + 1))
    if length < 32:
        return None
    grid = start + step * np.arange(count)
    sign = np.sign(
        one.channel.direction[0] * other.channel.direction[0] + one.channel.direction[1] * other.channel.direction[1]
    )
    spectra = []
    for signal in (one, other):
        pieces = np.lib.stride_tricks.sliding_window_view(np.interp(grid, signal.time, signal.value), length)[:: length // 2]
        pieces = pieces - np.mean(pieces, axis=1, keepdims=True)
        spectra.append(np.fft.rfft(pieces * np.hanning(length), axis=1))
    x, y = spectra
    xx, yy, xy = np.mean(np.abs(x) ** 2, axis=0), np.mean(np.abs(y) ** 2, axis=0), np.mean(np.conj(x) * y, axis=0)
    w = 2.0 * np.pi * np.fft.rfftfreq(length, step)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.abs(xy) ** 2 / (xx * yy)
        is_strong = (coherence > _COHERENT) & (xx > _STRONG * np.max(xx[2:])) & (yy > _STRONG * np.max(yy[2:]))
        is_strong &= (np.arange(w.size) >= 2) & (w < 0.8 * np.pi / step)
        factors = xy / xx / (1j * w) ** (_DERIVATIVES[other.channel.kind] - _DERIVATIVES[one.channel.kind])
    if np.count_nonzero(is_strong) < 2:
        return None
    return complex(np.median(factors[is_strong].real), np.median(factors[is_strong].imag)) * float(sign)


def _aliasing(motion: _Signal, speeds: Sequence[_Signal], source: str) -> list[str]:
    """Return a note if most of the power is close to half the sampling rate.

    **Raises** `InputError` for a rotor that turns faster than half the sampling rate.
    """
    rate = 1.0 / float(np.median(np.diff(motion.time)))
    where = f"{source}: channel {quoted(motion.channel.name)}"
    fastest_hertz = max((float(np.quantile(np.abs(each.value), 0.99)) for each in speeds), default=0.0) / (2.0 * np.pi)
    if fastest_hertz > 0.5 * rate:
        problem = f"is sampled at {rate:.4g} Hz, less than twice the highest rotor speed, {fastest_hertz:.4g} Hz"
        raise InputError(where, f"{problem}: its vibration is aliased; record at more than {2.56 * fastest_hertz:.3g} Hz")
    length = min(motion.value.size, _ALIASING_LENGTH)
    starts = np.unique(np.linspace(0, motion.value.size - length, _ALIASING_PIECES).astype(int))
    pieces = np.stack([motion.value[k : k + length] for k in starts])
    window = np.hanning(length)
    power = np.mean(np.abs(np.fft.rfft((pieces - np.mean(pieces, axis=1, keepdims=True)) * window, axis=1)) ** 2, axis=0)
    share = float(np.sum(power[int(0.8 * power.size) :]) / max(float(np.sum(power)), 1e-300))
    if share > 0.5:
        problem = f"has {100.0 * share:.0f} % of its power between 0.4 and 0.5 times its sampling rate of {rate:.4g} Hz"
        return [f"{where} {problem}: it is probably aliased; record faster, or with an anti-aliasing filter"]
    return []


def _filled(value: np.ndarray) -> np.ndarray:
    """Return readings with missing ones interpolated."""
    is_finite = np.isfinite(value)
    return value if np.all(is_finite) else np.interp(np.arange(value.size), np.flatnonzero(is_finite), value[is_finite])
