"""Reduction of the sampling rate of long records: every n-th reading after a low-pass filter.

Above the frequencies of the machine, a record contains only noise and other vibrations. The filter removes this part from
records whose sampling rate is much higher than the frequencies of the machine. The filter is symmetric in time. Its gain is 1
up to 0.3 times the new rate and 0 from 0.7 times the new rate, both to 2e-5. Aliases lie above 0.3 times the new rate, and
white noise remains nearly white.

Outliers and missing readings are replaced by values of the filtered signal, and the readings are filtered again. The remaining
error is small, because outliers and gaps are much shorter than the impulse response of the filter.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxvib.identification.run import MeasuredRun

SAMPLES_PER_PERIOD = 10.0
"""Smallest number of samples per period of the highest frequency."""

MIN_SAMPLES = 2**14
"""Smallest number of samples of a record that is filtered."""

_MIN_FACTOR, _MIN_LEFT = 4, 1024
"""Smallest ratio of the old to the new rate, and smallest number of samples after the filter."""

_HALF_LENGTH, _KAISER = 8, 10.06
"""Half of the length of the filter, in steps of the new rate, and the parameter beta of its Kaiser window (100 dB
attenuation)."""

_PASSES, _OUTLIER_DISTANCE, _RIPPLE = 4, 6.0, 1e-3
"""Largest number of filter passes for a record with outliers or missing readings. The distance of an outlier from the filtered
signal is at least 6 standard deviations of the distances of all readings, and at least 1e-3 of the standard deviation of the
signal, which is above the error of the filter."""

_NEIGHBOURS = 2
"""Number of readings on each side of an outlier with which it is compared."""

_PIECE = 2**18
"""Number of readings that are filtered at once."""

_KINDS = ("acceleration", "velocity", "displacement", "force", "angle", "speed")


def decimated(run: MeasuredRun, highest: float) -> MeasuredRun:
    """Return a run with a lower sampling rate, and a note about both rates. A short or slowly sampled run is not changed.

    The rate is reduced if the run has at least 2^14 samples, and at least 40 of them in a period of the `highest` frequency
    (rad/s) of the machine and its rotors.

    A run with clipped readings (each is only a bound of the motion), or with channels at different times, is not changed.
    """
    channels = run.of_kind(*_KINDS)
    first = run.times[channels[0].name] if channels else np.zeros(0)
    rate = (first.size - 1) / max(first[-1] - first[0], 1e-300) if first.size > 1 else 0.0
    factor = min(math.floor(rate * 2.0 * np.pi / (SAMPLES_PER_PERIOD * highest)), first.size // _MIN_LEFT)
    if factor < _MIN_FACTOR or first.size < MIN_SAMPLES:
        return run
    for channel in channels:
        time = run.times[channel.name]
        has_same_times = time.size == first.size and abs(time[0] - first[0]) + abs(time[-1] - first[-1]) < 0.01 / rate
        if not has_same_times or np.any(run.clipped[channel.name]):
            return run
    half = _HALF_LENGTH * factor
    sample_slice = slice(half, first.size - half, factor)
    values, replaced = dict(run.values), 0
    for channel in channels:
        values[channel.name], count = filter_readings(run.values[channel.name], factor)
        replaced += count
    names = {channel.name for channel in channels}
    time = first[sample_slice].copy()
    note = (
        f"{run.source}: the readings were filtered to the band of the machine, and their rate was lowered from {rate:.6g} to "
        f"{rate / factor:.6g} Hz"
    )
    return dataclasses.replace(
        run,
        times=run.times | dict.fromkeys(names, time),
        values=values,
        clipped=run.clipped | dict.fromkeys(names, np.zeros(time.size, bool)),
        notes=(*run.notes, f"{note}; {replaced} readings far from the filtered ones were replaced" if replaced else note),
    )


def filter_readings(value: np.ndarray, factor: int) -> tuple[np.ndarray, int]:
    """Return every `factor`-th filtered reading, without 8 x `factor` readings at each end, and the number of outliers.

    Results near gaps of more than `factor` / 2 readings are NaN.

    >>> t = 1e-3 * np.arange(40000)
    >>> value = np.sin(20.0 * t) + 0.1 * np.sin(3000.0 * t)
    >>> value[[7000, 9000]] += 5.0, np.nan
    >>> found, outliers = filter_readings(value, 20)
    >>> bool(np.max(np.abs(found - np.sin(20.0 * t[160:-160:20]))) < 1e-2), outliers
    (True, 1)
    """
    half = _HALF_LENGTH * factor
    shift = np.arange(-half, half + 1)
    taps = np.sinc(shift / factor) * np.kaiser(shift.size, _KAISER)
    taps /= np.sum(taps)
    is_missing = ~np.isfinite(value)
    is_bad, inside = is_missing.copy(), slice(half, value.size - half)
    if np.any(is_bad):
        value = np.interp(np.arange(value.size), np.flatnonzero(~is_bad), value[~is_bad])
    smooth = value
    for _ in range(_PASSES):
        smooth = _smooth(value, taps)
        deviation = value - smooth
        present = np.abs(deviation[inside][~is_missing[inside]][:: max(value.size // 100_000, 1)])
        spread = 1.4826 * float(np.median(present)) if present.size else 0.0
        limit = max(_OUTLIER_DISTANCE * spread, _RIPPLE * float(np.std(value)))
        far_indices = np.flatnonzero(np.abs(deviation[inside]) > limit) + half
        local_median = np.median(deviation[far_indices[:, None] + np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)], axis=1)
        # An outlier also moves the filtered signal around it; the comparison with the local median excludes these readings.
        is_bad[far_indices[np.abs(deviation[far_indices] - local_median) > limit]] = True
        if not np.any(is_bad):
            break
        value = np.where(is_bad, smooth, value)
    result = smooth[inside][::factor].copy()
    starts = np.flatnonzero(np.diff(is_missing.astype(np.int8), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(is_missing.astype(np.int8), append=0) == -1) + 1
    for start, end in zip(starts, ends, strict=True):
        if end - start > factor // 2:
            result[max(-(-(start - 2 * half) // factor), 0) : max(end // factor + 1, 0)] = np.nan
    return result, int(np.count_nonzero(is_bad & ~is_missing))


def _smooth(value: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Return the values (n,) after a filter of odd length; they are computed in pieces, which bounds the memory."""
    from scipy.signal import oaconvolve  # slow to import

    half, result = taps.size // 2, np.empty(value.size)
    for start in range(0, value.size, _PIECE):
        begin, end = max(start - half, 0), min(start + _PIECE, value.size)
        part = oaconvolve(value[begin : end + half], taps, mode="same")
        result[start:end] = part[start - begin : end - begin]
    return result
