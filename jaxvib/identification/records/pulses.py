"""Pulses of a tachometer: times of edges, missed and doubled pulses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxvib.errors import InputError
from jaxvib.identification.records.spline import fit_spline

MIN_PULSES = 12
"""Smallest number of pulses of a run."""

_LOW, _HIGH = 0.35, 0.65
"""Levels relative to the range of the signal: a pulse counts if the signal rises above the high level after it was below the
low level."""

_MISSED, _DOUBLED = 1.6, 0.62
"""Limits of an interval relative to its neighbours: above the first, pulses were missed; below the second, one of its two
pulses is false."""

_NEIGHBOURS = 5
"""Number of intervals on each side with which an interval is compared."""

_MIN_SPEED = 0.02
"""Lower limit of the rough speeds, relative to the largest. The error of a pulse's angle is assumed to be proportional to its
rough speed, but at low speeds not smaller than at this limit."""

_MAX_FAULTS = 0.1
"""Largest share of missed and false pulses."""


def rising_edges(time: np.ndarray, level: np.ndarray, where: str) -> np.ndarray:
    """Return the times at which a sampled signal rises through the middle of its range, interpolated between the samples.

    A pulse counts once, even if noise makes the signal cross the middle several times.

    >>> t = np.arange(0.0, 1.0, 1e-3)
    >>> rising_edges(t, np.sin(40.0 * np.pi * t - 1.0), "run: channel 'tacho'")[:2].round(5).tolist()
    [0.00796, 0.05796]
    """
    is_finite = np.isfinite(level)
    if not np.all(is_finite):
        time, level = time[is_finite], level[is_finite]
    low, high = (float(x) for x in np.quantile(level, [0.01, 0.99])) if level.size else (0.0, 0.0)
    if level.size and high - low < 0.5 * np.ptp(level):  # pulses shorter than a hundredth of their period
        low, high = float(np.min(level)), float(np.max(level))
    if high <= low:
        raise InputError(where, "is constant; give a channel with the pulses of the tachometer")
    middle = 0.5 * (low + high)
    bottoms = _starts(level < low + _LOW * (high - low))
    tops = _starts(level > low + _HIGH * (high - low))
    before = np.searchsorted(bottoms, tops) - 1  # the last time at which the signal became low
    _, first = np.unique(before, return_index=True)
    tops = tops[first[before[first] >= 0]]
    rises = _starts(level >= middle)
    after = rises[np.searchsorted(rises, tops, side="right") - 1]
    share = (middle - level[after - 1]) / (level[after] - level[after - 1])
    return time[after - 1] + share * (time[after] - time[after - 1])


def _starts(flags: np.ndarray) -> np.ndarray:
    """Return the indices at which segments of True begin."""
    return np.flatnonzero(flags & ~np.concatenate([[False], flags[:-1]]))


def number_pulses(time: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the times (n,), s, of the pulses without false pulses, their numbers (n,), and notes about repairs.

    The interval between two pulses is compared with the geometric mean of two medians: of five intervals before it and of five
    intervals after it. This mean is also right while a rotor starts from rest. The number of a missed pulse is skipped.

    **Raises** `InputError` for too few pulses, times that do not ascend, and too many missed and false pulses.

    >>> t = np.delete(np.arange(40) / 10.0, 17)
    >>> _, number, notes = number_pulses(t, "run: channel 'tacho'")
    >>> number[15:19].tolist(), notes
    ([15.0, 16.0, 18.0, 19.0], ["run: channel 'tacho' missed 1 pulse, at 1.6 s, which is counted"])
    """
    if time.size < MIN_PULSES:
        raise InputError(where, f"has {time.size} {_pulses(time.size)}; at least {MIN_PULSES} are needed; record more turns")
    not_ascending = np.flatnonzero(~(np.diff(time) > 0.0))
    if not_ascending.size:
        k = int(not_ascending[0])
        raise InputError(where, f"has a pulse at {time[k + 1]:g} s after one at {time[k]:g} s; times must ascend")
    count, notes = time.size, []
    false_times: list[float] = []
    while (doubtful := _false_pulses(time)).size and len(false_times) <= _MAX_FAULTS * count:
        false_times += time[doubtful].tolist()
        time = np.delete(time, doubtful)
    ratio = np.diff(time) / _usual_intervals(np.diff(time))
    steps = np.where(ratio > _MISSED, np.maximum(np.rint(ratio), 1.0), 1.0)
    steps[[0, -1]] = 1.0  # these intervals have neighbours on one side only
    missed = int(np.sum(steps - 1.0))
    if len(false_times) + missed > _MAX_FAULTS * count:
        problem = f"misses {missed} and doubles {len(false_times)} of {count} pulses"
        raise InputError(where, f"{problem}; check the trigger level, the marks and the direction of the edge")
    if false_times:
        notes.append(
            f"{where} had {len(false_times)} false {_pulses(len(false_times))}, the first at {min(false_times):.4g} s; left out"
        )
    if missed:
        first = float(time[np.argmax(steps > 1.0)])
        place = f"at {first:.4g} s" if missed == 1 else f"the first at {first:.4g} s"
        verb = "which is counted" if missed == 1 else "which are counted"
        notes.append(f"{where} missed {missed} {_pulses(missed)}, {place}, {verb}")
    return time, np.concatenate([[0.0], np.cumsum(steps)]), notes


class PulseFit(NamedTuple):
    """Smooth angle of a rotor, fitted to pulses.

    **Attributes**: `spline` of the angle and its errors, see `fit_spline`; `scatter` of the times, s; `angle` (n,), rad, of the
    pulses; `marks` (n,): index of the mark of each pulse; `speeds` (n,): rough speed at each pulse, rad/s, the ratio of an
    error of the angle to an error of the time.
    """

    spline: Any
    scatter: float
    angle: np.ndarray
    marks: np.ndarray
    speeds: np.ndarray


def fit_pulses(time: np.ndarray, number: np.ndarray, per_turn: int) -> PulseFit:
    """Return the angle of a rotor over time.

    **Arguments**: `time` (n,), s, and `number` (n,) of the pulses, at least 12; `per_turn`: pulses per turn.

    >>> t = np.round(np.sqrt(np.arange(1.0, 60.0)), 3)    # 2 pi t^2 rad; the times have errors up to 0.5 ms
    >>> spline = fit_pulses(t, np.arange(t.size), 1).spline
    >>> bool(abs(spline(5.0, 1)[0] / (20.0 * np.pi) - 1.0) < 1e-3)
    True
    """
    marks = np.unique(number % per_turn, return_inverse=True)[1]  # without those of missing teeth
    angle = 2.0 * np.pi * number / per_turn
    rough_speed = np.convolve(np.pad(np.gradient(angle, time), 2, mode="edge"), np.full(5, 0.2), mode="valid")
    speeds = np.maximum(rough_speed, _MIN_SPEED * np.max(rough_speed))
    spline, scatter = fit_spline(time, angle, marks, speeds, jump_order=2)
    return PulseFit(spline, scatter, angle, marks, speeds)


def _usual_intervals(steps: np.ndarray) -> np.ndarray:
    """Return, for each interval, the geometric mean of two medians: of 5 intervals before it and of 5 intervals after it."""
    padded = np.concatenate([np.full(_NEIGHBOURS, np.nan), steps, np.full(_NEIGHBOURS, np.nan)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    before, after = np.full(steps.size, np.nan), np.full(steps.size, np.nan)
    before[1:] = np.nanmedian(windows[1:, :_NEIGHBOURS], axis=1)
    after[:-1] = np.nanmedian(windows[:-1, _NEIGHBOURS + 1 :], axis=1)
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    return np.sqrt(before * after)


def _false_pulses(time: np.ndarray) -> np.ndarray:
    """Return the indices of false pulses: the pulses before and after such a pulse are one usual interval apart. No two
    adjacent pulses are returned."""
    if time.size < MIN_PULSES:
        return np.array([], int)
    steps, usual = np.diff(time), _usual_intervals(np.diff(time))
    ratio = steps / usual
    shorter, longer = np.minimum(ratio[:-1], ratio[1:]), np.maximum(ratio[:-1], ratio[1:])
    log_ratios = np.abs(np.log((time[2:] - time[:-2]) / np.sqrt(usual[1:] * usual[:-1])))
    doubtful = (shorter < _DOUBLED) & (longer < 1.25) & (log_ratios < np.log(1.4))
    doubtful[[0, -1]] = False
    error = np.concatenate([[np.inf], np.where(doubtful, log_ratios, np.inf), [np.inf]])
    is_false = doubtful & (error[1:-1] <= error[:-2]) & (error[1:-1] < error[2:])
    return np.flatnonzero(is_false) + 1


def _pulses(count: int) -> str:
    return "pulse" if count == 1 else "pulses"
