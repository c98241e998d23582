"""Even sampling of a channel: order of times, gaps, missing and clipped readings."""

from __future__ import annotations

import numpy as np

from jaxvib.errors import InputError

MIN_SAMPLES = 16
"""Smallest number of samples of a channel."""

_MAX_MISSING = 0.1
"""Largest share of readings that may be NaN, and largest share that may be in dropouts."""

_MAX_GAPS = 0.5
"""Largest share of the duration of a record that may be in gaps."""

_JITTER = 0.01
"""Deviation of times from an even grid, relative to the step, above which readings are interpolated."""

_GAP = 1.5
"""Interval between samples, relative to the step, above which readings are missing."""

_MIN_DROPOUT, _MIN_RATIO = 20, 10
"""A segment of equal readings is a dropout if it has at least the first number of readings, and at least the second number
times the length that 99 % of all segments do not exceed."""

_BINS, _PEAK_RATIO, _MIN_CLIPPED = (0.001, 0.003, 0.01), 3.0, 10
"""Limits for clipped readings in a histogram: widths of its last bin, relative to the range of the values; smallest ratio of
the number of readings in this bin to the number in the next four bins; smallest number of readings in this bin. For a smooth
signal the ratio is below 2."""

_SPIKE_DISTANCE = 3.0
"""Distance of a spike from all other readings, relative to their range."""


def require_ascending(time: np.ndarray, where: str) -> None:
    """**Raises** `InputError` for fewer than 16 times, and for times that are not finite or do not ascend."""
    if time.size < MIN_SAMPLES:
        raise InputError(where, f"has {time.size} samples; at least {MIN_SAMPLES} are needed; record more")
    invalid = np.flatnonzero(~np.isfinite(time))
    if invalid.size:
        raise InputError(where, f"has the time {time[invalid[0]]} at sample {invalid[0] + 1}; times must be finite numbers")
    invalid = np.flatnonzero(np.diff(time) <= 0.0)
    if invalid.size:
        k = int(invalid[0])
        if time[k + 1] == time[k]:
            problem = f"has the time {time[k]:g} s twice, at samples {k + 1} and {k + 2}"
            raise InputError(
                where, f"{problem}; leave one of them out, or give the sampling rate `rate` if the file rounds its times"
            )
        problem = f"has the time {time[k + 1]:g} s at sample {k + 2}, and {time[k]:g} s at the sample before it"
        raise InputError(where, f"{problem}; times must ascend: sort the samples, or make two runs of them")


def continued_angle(value: np.ndarray, where: str) -> tuple[np.ndarray, list[str]]:
    """Return an angle (n,), rad, with whole turns added if it begins anew in each turn, and a note; otherwise the same angle.

    Such an angle stays within one turn and has steps of more than half a turn.

    >>> angle, notes = continued_angle(np.array([0.0, 2.0, 4.0, 6.0, 1.7, 3.7]), "run: channel 'rotor'")
    >>> np.round(angle, 1).tolist(), len(notes)
    ([0.0, 2.0, 4.0, 6.0, 8.0, 10.0], 1)
    """
    is_known = np.isfinite(value)
    known = value[is_known]
    if known.size == 0 or np.ptp(known) > 1.001 * 2.0 * np.pi or np.max(np.abs(np.diff(known)), initial=0.0) <= np.pi:
        return value, []
    continued = value.copy()
    continued[is_known] = np.unwrap(known)
    return continued, [f"{where} begins anew in each turn; whole turns were added"]


def even_samples(time: np.ndarray, value: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return a channel on an even grid of times, with NaN for missing readings, and notes about repairs.

    - NaN and constant dropouts are missing readings
    - A channel that has a reading only at every n-th time has a lower rate
    - Gaps are filled with missing readings
    - Readings at uneven times are interpolated linearly

    **Raises** `InputError` for times that do not ascend, and if too many readings are missing.

    >>> t = np.delete(np.arange(0.0, 1.0, 0.01), [40, 41])
    >>> time, value, notes = even_samples(t, t, "run: channel 'frame'")
    >>> time.size, int(np.count_nonzero(np.isnan(value))), notes
    (100, 2, ["run: channel 'frame' has 1 gap; the longest is 0.03 s at 0.39 s"])
    """
    require_ascending(time, where)
    if not np.all(np.isfinite(value)):
        value = np.where(np.isfinite(value), value, np.nan)
    time, value, notes = _reduced_to_own_rate(time, value, where)
    is_missing = np.isnan(value)
    if np.any(is_missing):
        count = int(np.count_nonzero(is_missing))
        first = f"the first at {time[np.argmax(is_missing)]:g} s"
        if count > _MAX_MISSING * value.size:
            share = f"has {count} of {value.size} readings that are not numbers, {first}"
            allowed = f"at most {100.0 * _MAX_MISSING:.0f} % may be missing"
            raise InputError(where, f"{share}; {allowed}; use another part of the record")
        readings = "reading that is not a number" if count == 1 else "readings that are not numbers"
        notes.append(f"{where} has {count} {readings}, {first}; left out")
    is_dropout = dropouts(value)
    if np.any(is_dropout):
        count = int(np.count_nonzero(is_dropout))
        first = f"the first at {time[np.argmax(is_dropout)]:g} s"
        if count > _MAX_MISSING * value.size:
            share = f"is constant in segments for {count} of {value.size} readings, {first}"
            raise InputError(where, f"{share}: the sensor or its cable failed; use another part of the record")
        notes.append(f"{where} is constant in segments with {count} readings in total (dropouts), {first}; left out")
        value = np.where(is_dropout, np.nan, value)
    time, value, grid_notes = _on_grid(time, value, where)
    return time, value, notes + grid_notes


def _reduced_to_own_rate(time: np.ndarray, value: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the samples without the times that have no reading, if the channel has a reading only at every n-th time."""
    if not np.any(np.isnan(value)):
        return time, value, []
    with_reading = np.flatnonzero(~np.isnan(value))
    if with_reading.size < MIN_SAMPLES:
        raise InputError(where, f"has {with_reading.size} readings; at least {MIN_SAMPLES} are needed; record more")
    stride = int(np.median(np.diff(with_reading)))
    if stride == 1 or np.mean(np.diff(with_reading) % stride == 0) < 1.0:
        return time, value, []
    part = slice(with_reading[0] % stride, None, stride)
    rate = 1.0 / float(np.median(np.diff(time[part])))
    return time[part], value[part], [f"{where} has a reading at only one in {stride} times: its rate is {rate:.6g} Hz"]


def _on_grid(time: np.ndarray, value: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    even = np.linspace(time[0], time[-1], time.size)
    deviation = time - even
    if max(np.max(deviation), -np.min(deviation)) <= _JITTER * (even[1] - even[0]):
        return even, value, []
    steps = np.diff(time)
    step = float(np.median(steps))
    step = float(np.mean(steps[steps < _GAP * step]))  # the median may be rounded to the digits of the file
    is_gap, notes = steps > _GAP * step, []
    if np.any(is_gap):
        gap_time = float(np.sum(steps[is_gap]))
        longest = int(np.argmax(steps))
        count = int(np.count_nonzero(is_gap))
        gap_count = "1 gap" if count == 1 else f"{count} gaps"
        place = f"the longest is {steps[longest]:.3g} s at {time[longest]:g} s"
        if gap_time > _MAX_GAPS * (time[-1] - time[0]):
            raise InputError(
                where, f"has {gap_count} in {gap_time:.3g} of {time[-1] - time[0]:.3g} s; {place}: use a part without gaps"
            )
        notes.append(f"{where} has {gap_count}; {place}")
    index = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / step), 1.0))]).astype(int)
    centred = index - np.mean(index)
    slope = float(centred @ time / (centred @ centred))
    grid = np.mean(time) + slope * (np.arange(index[-1] + 1) - np.mean(index))
    error = np.max(np.abs(time - grid[index]))
    if error <= max(_JITTER * slope, _resolution(time)):
        even = np.full(grid.size, np.nan)
        even[index] = value
        return grid, even, notes
    count = max(round((time[-1] - time[0]) / step), 1)
    grid = time[0] + (time[-1] - time[0]) / count * np.arange(count + 1)
    is_known = ~np.isnan(value)
    even = np.interp(grid, time[is_known], value[is_known])
    after = np.clip(np.searchsorted(time[is_known], grid), 1, np.count_nonzero(is_known) - 1)
    even[np.diff(time[is_known])[after - 1] > _GAP * step] = np.nan
    spread = f"{np.min(steps):.3g} to {np.max(steps[~is_gap]):.3g} s"
    notes.append(f"{where} has steps of {spread}; its readings were interpolated to even steps of {grid[1] - grid[0]:.4g} s")
    return grid, even, notes


def _resolution(time: np.ndarray) -> float:
    """Return half a unit (with a margin of 2 %) of the last decimal digit to which all times are rounded; 0 if they are not
    rounded."""
    for digits in range(1, 9):
        if np.all(
            np.abs(time * 10.0**digits - np.rint(time * 10.0**digits)) < 1e-6 * np.maximum(np.abs(time) * 10.0**digits, 1.0)
        ):
            return 0.51 * 10.0**-digits
    return 0.0


def dropouts(value: np.ndarray) -> np.ndarray:
    """Return True for readings in dropouts: long segments of exactly equal readings that are neither the largest nor the
    smallest, in a signal that otherwise changes.

    >>> x = np.sin(np.arange(400.0))
    >>> x[100:140] = 0.0
    >>> int(np.count_nonzero(dropouts(x)))
    40
    """
    equal = value[1:] == value[:-1]
    if np.count_nonzero(equal) < _MIN_DROPOUT - 1:
        return np.zeros(value.size, bool)
    starts = np.concatenate([[0], np.flatnonzero(~equal) + 1])
    lengths = np.diff(np.concatenate([starts, [value.size]]))
    usual_length = max(float(np.quantile(lengths, 0.99)), 1.0)
    with np.errstate(invalid="ignore"):
        is_inside = (value[starts] > np.nanmin(value)) & (value[starts] < np.nanmax(value))
    is_long = (lengths >= max(_MIN_DROPOUT, _MIN_RATIO * usual_length)) & is_inside
    return np.repeat(is_long, lengths)


def without_spikes(time: np.ndarray, value: np.ndarray, where: str) -> tuple[np.ndarray, list[str]]:
    """Return the readings with NaN in place of spikes, and a note about them.

    At most 9 readings at each end of the range count as spikes. A spike is outside the range of the other readings by more than
    three times this range. Channels of fewer than 100 readings are returned unchanged. Spikes are left out here because a fit
    by least squares begins with all readings, in which one spike could hide the motion.

    >>> value = np.sin(0.1 * np.arange(400.0))
    >>> value[7] = 500.0
    >>> found, notes = without_spikes(0.01 * np.arange(400.0), value, "run: channel 'a'")
    >>> bool(np.isnan(found[7])), int(np.isnan(found).sum()), notes
    (True, 1, ["run: channel 'a' has 1 spike, at 0.07 s, far beyond all other readings; left out"])
    """
    known = value[np.isfinite(value)]
    if known.size < 10 * _MIN_CLIPPED:
        return value, []
    ends = np.partition(known, (_MIN_CLIPPED - 1, known.size - _MIN_CLIPPED))
    low, high = ends[_MIN_CLIPPED - 1], ends[known.size - _MIN_CLIPPED]
    is_spike = (value > high + _SPIKE_DISTANCE * (high - low)) | (value < low - _SPIKE_DISTANCE * (high - low))
    count = int(np.count_nonzero(is_spike))
    if count == 0 or high == low:
        return value, []
    what = f"1 spike, at {time[is_spike][0]:g} s" if count == 1 else f"{count} spikes, the first at {time[is_spike][0]:g} s"
    return np.where(is_spike, np.nan, value), [f"{where} has {what}, far beyond all other readings; left out"]


def clipped_at(value: np.ndarray) -> tuple[float, float]:
    """Return the levels (low, high) at which the histogram shows that readings are clipped; infinite if they are not.

    >>> low, high = clipped_at(np.clip(np.sin(0.01 * np.arange(4000.0)), -2.0, 0.9))
    >>> bool(np.isinf(low)), bool(0.85 < high <= 0.9)
    (True, True)
    """
    is_missing = np.isnan(value)
    known = value[~is_missing] if np.any(is_missing) else value
    return -_clipped_above(-known), _clipped_above(known)


def _clipped_above(value: np.ndarray) -> float:
    """Return the level above which readings are clipped; infinite if the histogram has no peak at its upper end."""
    count = max(1, min(_MIN_CLIPPED, value.size // 4))  # fewer readings beyond all others are spikes
    ends = np.partition(value, (count - 1, value.size - count))
    top, size = float(np.max(value)), float(ends[value.size - count] - ends[count - 1])
    below = value[value < top]
    if size == 0.0 or below.size == 0:
        return np.inf
    level = np.inf
    for share in _BINS:
        width = max(share * size, 1.5 * (top - float(np.max(below))))  # a bin has at least one step of the converter
        if 5.0 * width > size and np.count_nonzero(value == top) < _MIN_CLIPPED:  # a few spikes above all other readings
            continue
        is_top = value > top - width
        in_last_bin, in_next_bins = np.count_nonzero(is_top), np.count_nonzero((value > top - 5.0 * width) & ~is_top)
        in_triples = np.count_nonzero(is_top[2:] & is_top[1:-1] & is_top[:-2])
        if in_last_bin >= _MIN_CLIPPED and in_last_bin > _PEAK_RATIO * in_next_bins and in_triples >= _MIN_CLIPPED // 2:
            level = top - 2.0 * width  # noise on the clipped readings may exceed one bin
    return level
