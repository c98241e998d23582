"""Charts of histories over time: whole runs as bands between their peaks, and the last periods as curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import (
    axis_unit,
    color_of,
    legend_above,
    load_names,
    panels,
    resonance_lines,
    series_look,
)

_BINS = 600
"""Maximum number of intervals of a run. The run is drawn as a band of its oscillation about the trend, see `band`."""

_MAX_PLAIN_PERIODS = 40
"""Maximum number of periods of a run that is drawn without bands."""

_MAX_BEATS, _SAMPLES_PER_INTERVAL, _MIN_SAMPLES = 20, 10, 1000
"""Maximum number of beats of an averaged history that is drawn as a curve. A history with more beats and at least
`_MIN_SAMPLES` samples is drawn as a band between the minima and maxima of intervals of `_SAMPLES_PER_INTERVAL` samples."""

_SHORT_INTERVALS = "band: lowest to highest value within short intervals"
"""Entry of a legend for the band of an averaged history, which has a width where the amplitude beats or changes fast."""

_ZERO_SHARE = 1e-9
"""Ratio of the last periods and the largest value of a run below which the last periods are rounding errors."""

_BAND_ALPHA = 0.22
"""Opacity of a band."""

_SHOWN_PERIODS = 3
"""Number of periods at the end that are drawn as curves."""


def band(time: np.ndarray, values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middle times and the lower and upper limits (bins,) of a signal (nt,) in `bins` intervals of equal length.

    The limits are those of the deviations from the trend of the signal, added to the trend at the middle of each interval: the
    band of a ramp has no width. If the signal has fewer than 2 samples per interval, return all times and the signal itself as
    both limits.

    >>> import numpy as np
    >>> t = np.arange(100.0)
    >>> middle, low, high = band(t, 2.0 * t + (-1.0) ** t, 10)
    >>> (low - 2.0 * middle).round(9).tolist() == [-1.0] * 10, (high - 2.0 * middle).round(9).tolist() == [1.0] * 10
    (True, True)
    """
    if time.size < 2 * bins:
        return time, values, values
    edges = np.linspace(0, time.size, bins + 1).astype(int)
    middle, trend = (time[edges[:-1]] + time[edges[1:] - 1]) / 2.0, _trend(time, values, edges)
    at_middle = np.interp(middle, time, trend)

    def limit(sign: float) -> np.ndarray:
        # Both are limits of the signal. The second one is the tighter one on a slope, and the first one beside a kink.
        plain, about_trend = (
            _smoothed_peaks(np.maximum.reduceat(sign * each, edges[:-1])) for each in (values, values - trend)
        )
        return sign * np.minimum(plain, about_trend + sign * at_middle)

    return middle, limit(-1.0), limit(1.0)


_TREND_WEIGHTS = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
"""Weights of the means of successive intervals in the trend. They reduce the oscillation in these means: an interval does not
contain a whole number of periods."""


def _trend(time: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the trend (nt,) of a signal: straight lines between the weighted means of the intervals between `edges`."""
    if edges.size <= _TREND_WEIGHTS.size + 1:
        return np.full(time.size, np.mean(values))
    size = np.diff(edges)
    # The times have the same weights, so that a straight line is its own trend.
    t, mean = (np.convolve(np.add.reduceat(x, edges[:-1]) / size, _TREND_WEIGHTS, "valid") for x in (time, values))
    slope = np.diff(mean) / np.diff(t)
    trend = np.interp(time, t, mean)
    return trend + slope[0] * np.minimum(time - t[0], 0.0) + slope[-1] * np.maximum(time - t[-1], 0.0)


def _smoothed_peaks(values: np.ndarray) -> np.ndarray:
    """Return a smooth curve that is not below the maxima of intervals.

    An interval does not contain a whole number of periods; the maxima of successive intervals therefore form a saw-tooth. The
    result is the mean of three running maxima, each over three neighbouring intervals that include the interval itself.
    """
    padded = np.pad(values, 2, mode="edge")
    largest = np.maximum(np.maximum(padded[:-2], padded[2:]), padded[1:-1])
    return (largest[:-2] + largest[1:-1] + largest[2:]) / 3.0


def period_of(time: np.ndarray, values: np.ndarray) -> float:
    """Return the mean period of the signal with the largest range among `values` (nt, k), s.

    It is the mean time between upward crossings of the middle of the range, or the whole time if there are fewer than two.

    >>> import numpy as np
    >>> t = np.linspace(0.0, 1.0, 1000)
    >>> round(period_of(t, np.sin(40.0 * np.pi * t)[:, None]), 3)
    0.05
    """
    signal = values[:, int(np.argmax(np.ptp(values, axis=0)))]
    signal = signal - (np.max(signal) + np.min(signal)) / 2.0
    up = np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0))
    return float((time[up[-1]] - time[up[0]]) / (up.size - 1)) if up.size > 1 else float(time[-1] - time[0])


def last_periods(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a mask (nt,) that is True for the samples in the last periods of signals (nt, k)."""
    return time >= time[-1] - _SHOWN_PERIODS * period_of(time, values)


def time_histories(
    whole: Sequence[np.ndarray],
    end: Sequence[np.ndarray],
    *,
    names: Sequence[str],
    units: Sequence[str] | None = None,
    directions: Sequence[str] = ("force",),
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw the histories of a run in two columns: the `whole` run as bands between its peaks, and its last periods as curves.

    The rows are displacements in mm or µm, tilts in deg if there are any, speeds of loads and rotor in `unit`, and the
    foundation force in N. If the last periods have another unit, it is beside their axis. Loads that move equally are one line.

    **Arguments** (nt times, nd coordinates, nb directions of the force)

    - `whole`, `end`: tuples of time (nt,), s; displacement (nt, nd), m or rad; load speeds (nt, count) and rotor speeds
      (nt, exciters), rad/s; force (nt, nb), N. The right column shows the last periods of `end`
    - `names`, `units` (nd,): names of the coordinates and their units, "m" or "rad"; `units` None: all m
    - `directions` (nb,): names of the directions of the force

    >>> import numpy as np
    >>> t, q, one = np.linspace(0.0, 1.0, 5), np.ones((5, 2)), np.ones((5, 1))
    >>> figure = time_histories(*[(t, q, one, one, one)] * 2, names=("y", "theta"), units=("m", "rad"))
    >>> [axes.get_ylabel() for axes in figure.axes][::2]
    ['displacement, mm', 'tilt, deg', 'speed, rpm', 'foundation force, N']
    """
    units = ["m"] * len(names) if units is None else units
    unit, scale = speed_unit(unit)
    kinds = _kinds(whole[1], units, "displacement", "tilt")
    figure, axes = panels(len(kinds) + 2, 2, size=(5.4, 2.3), widths=(1.7, 1.0), share_x="col", ax=ax)
    period = period_of(end[0], end[1])
    # Each interval is longer than a period; otherwise the band would follow the vibration.
    periods = (whole[0][-1] - whole[0][0]) / period
    bins = min(_BINS, int(periods / 1.25)) if periods > _MAX_PLAIN_PERIODS else whole[0].size
    part = [values[last_periods(end[0], end[1])] for values in end]
    for kind, left, right in zip(kinds, axes[0:-4:2], axes[1:-4:2], strict=True):
        _draw_coordinates(left, right, kind, whole[:2], part[:2], names, units, bins)
    left, right = axes[-4:-2]
    for k, name in _equal_loads(whole[2], part[2]):
        _draw_band(left, whole[0], scale * whole[2][:, k], k, name, bins)
        right.plot(part[0], scale * part[2][:, k], **series_look(k), lw=1.2)
    _draw_rotor_speeds(left, whole[0], scale * whole[3], bins)
    slowest, fastest = np.min(part[2], initial=np.inf), np.max(part[2], initial=-np.inf)
    # The ripple of loads that are much slower than the rotor would be invisible on an axis that includes the rotor.
    shown = max(fastest - slowest, _MIN_SPEED_RANGE * fastest)
    if whole[2].shape[1] == 0 or np.all(np.abs(part[3] - 0.5 * (slowest + fastest)) < shown):
        _draw_rotor_speeds(right, part[0], scale * part[3])
    else:
        beyond = ", ".join(f"{x:.5g}" for x in scale * part[3][-1])
        at = {"transform": right.transAxes, "ha": "right", "va": "bottom"}
        right.text(1.0, 1.02, f"rotor speed (outside this panel): {beyond} {unit}", fontsize="small", color="#555555", **at)
    low, high = right.get_ylim()
    if high - low < (least := _MIN_SPEED_RANGE * max(abs(low), abs(high))):  # rounding errors of a constant speed
        right.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
    left.set_ylabel(f"speed, {unit}")
    _draw_legend(left)
    left, right = axes[-2:]
    for k, name in enumerate(directions):
        _draw_band(left, whole[0], whole[4][:, k], k, name, bins)
        right.plot(part[0], part[4][:, k], **series_look(k), lw=1.2)
    _mark_zero(right, whole[4], part[4])
    left.set_ylabel("foundation force, N")
    _draw_legend(left, 2)
    first, last = float(whole[0][0]), float(whole[0][-1])
    title = "the whole run" if first < 0.01 * last else f"the last part of the run, from {first:.4g} s"
    for axis, text in zip(axes[:2], (title, f"its last {last - float(part[0][0]):.2g} s"), strict=True):
        axis.text(1.0, 1.02, text, transform=axis.transAxes, ha="right", va="bottom", fontsize="small", color="#555555")
    for axis in axes[-2:]:
        axis.set_xlabel("time, s")
    axes[-1].locator_params(axis="x", nbins=4)
    return figure if ax is None else ax


def _draw_coordinates(
    left: Axes,
    right: Axes,
    kind: tuple[str, str, float],
    whole: Sequence[np.ndarray],
    end: Sequence[np.ndarray],
    names: Sequence[str],
    units: Sequence[str],
    bins: int,
) -> None:
    """Draw the coordinates of a `kind`, see `_kinds`, over the whole run and over its last periods.

    The label of the right axis names its unit if it differs from that of the left axis.
    """
    unit, label, factor = kind
    label_at_end, factor_at_end = next(x[1:] for x in _kinds(end[1], units, "displacement", "tilt") if x[0] == unit)
    depth = np.argsort(np.argsort(-np.ptp(whole[1], axis=0)))  # signals of larger range are drawn first, below smaller ones
    of_kind = [k for k in range(len(names)) if units[k] == unit]
    for k in of_kind:
        _draw_band(left, whole[0], factor * whole[1][:, k], k, names[k], bins, depth[k])
        look = series_look(k)
        right.plot(end[0], factor_at_end * end[1][:, k], lw=1.3, **look)
    left.set_ylabel(label)
    _draw_legend(left)
    if _mark_zero(right, whole[1][:, of_kind], end[1][:, of_kind]):
        return
    if label_at_end != label:
        right.set_ylabel(label_at_end)


def _mark_zero(axis: Axes, whole: np.ndarray, end: np.ndarray) -> bool:
    """Return True for an `end` (nt, k) that is zero within rounding errors, and state it in place of its curves."""
    is_zero = bool(np.max(np.abs(end), initial=0.0) < _ZERO_SHARE * np.max(np.abs(whole), initial=0.0))
    if is_zero:
        for line in axis.lines:
            line.set_visible(False)
        axis.set_yticks([])
        words = "zero within rounding:\nless than 1e-9 of the\nlargest value of the run"
        axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", va="center", fontsize="small", color="#555555")
    return is_zero


def _kinds(values: np.ndarray, units: Sequence[str], length: str, tilt: str) -> list[tuple[str, str, float]]:
    """Return the unit, the label and the factor of each kind of coordinates among signals (nt, nd): lengths and tilts."""
    unit, factor = axis_unit("m", values[:, np.asarray(units) == "m"])
    angle, angle_factor = axis_unit("rad", values[:, np.asarray(units) == "rad"])
    kinds = (("m", f"{length}, {unit}", factor), ("rad", f"{tilt}, {angle}", angle_factor))
    return [kind for kind in kinds if kind[0] in units]


_MIN_SPEED_RANGE = 1e-4
"""Smallest range of the axis of the last periods' speeds, relative to the speeds."""

_MAX_EQUAL_DIFFERENCE = 0.01
"""Difference of the speeds of two loads, relative to the range of an axis, below which they are drawn as one line."""


def _equal_loads(whole: np.ndarray, end: np.ndarray) -> list[tuple[int, str | None]]:
    """Return the first of each group of loads that move equally, with the name of the group.

    **Arguments**: speeds `whole` (nt, count) of a run and of its `end` (nt', count).

    >>> import numpy as np
    >>> t = np.linspace(0.0, 1.0, 9)[:, None]
    >>> _equal_loads(np.hstack([t, t, -t]), np.hstack([t, t, -t]))
    [(0, 'loads 1 and 2'), (2, 'load 3')]
    >>> _equal_loads(np.zeros((9, 0)), np.zeros((9, 0)))      # rotors with unbalances only
    []
    """
    count, signals = whole.shape[1], (whole, end)
    if count == 0:
        return []
    largest = [float(np.max(np.abs(values), initial=0.0)) for values in signals]
    limits = [_MAX_EQUAL_DIFFERENCE * float(np.ptp(values)) + 1e-9 * top for values, top in zip(signals, largest, strict=True)]
    groups: list[list[int]] = []
    for k in range(count):

        def is_equal(other: list[int], k: int = k) -> bool:
            return all(np.max(np.abs(x[:, k] - x[:, other[0]])) <= limit for x, limit in zip(signals, limits, strict=True))

        same = next((group for group in groups if is_equal(group)), None)
        if same is None:
            groups.append([k])
        else:
            same.append(k)
    names = load_names(count)
    return [(group[0], names[group[0]] if len(group) == 1 else _group_name(group)) for group in groups]


def _group_name(group: Sequence[int]) -> str:
    """Return the name of several loads: "loads 1 to 3", or "loads 1 and 3"."""
    if len(group) > 2 and group[-1] - group[0] == len(group) - 1:
        return f"loads {group[0] + 1} to {group[-1] + 1}"
    return f"loads {', '.join(str(k + 1) for k in group[:-1])} and {group[-1] + 1}"


def _draw_band(
    axis: Axes, time: np.ndarray, values: np.ndarray, k: int, name: str | None, bins: int, depth: float | np.ndarray = 0.0
) -> None:
    """Draw the signal number `k` as a band, or as a curve if it has fewer than 2 samples for each of `bins` intervals.

    Areas lie above each other in the order of `depth`, and lines above them in the order of the signals, because the solid line
    of the first signal would hide the dashes of an equal one.
    """
    middle, low, high = band(time, values, bins)
    look = {**series_look(k), "lw": 1.1, "zorder": 2.0 + 0.001 * k}
    axis.plot(middle, high, label=name, **look)
    if low is not high:
        axis.plot(middle, low, **look)
        axis.fill_between(middle, low, high, color=look["color"], alpha=_BAND_ALPHA, lw=0.0, zorder=1.5 + 0.001 * float(depth))


def _draw_legend(axis: Axes, least: int = 1, band: str = "band: lowest to highest value") -> None:
    """Draw the legend of a panel, with an entry for its bands, unless it has fewer than `least` entries."""
    handles, _ = axis.get_legend_handles_labels()
    if axis.collections:
        handles.append(Patch(color="#555555", alpha=_BAND_ALPHA, lw=0.0, label=band))
    if len(handles) >= least:
        legend_above(axis, 4, handles=handles)  # a legend wider than its panel would move the columns apart


def _draw_rotor_speeds(axis: Axes, time: np.ndarray, speeds: np.ndarray, bins: int | None = None) -> None:
    """Draw the speeds of the rotors (nt, exciters), negative for a clockwise rotor, as dashed lines.

    With `bins` they are the middles of bands, because the dashes of a fluctuating speed could not be distinguished.
    """
    rotors = speeds.shape[1]
    for k in range(rotors):
        look = {"color": "black" if rotors == 1 else color_of(k), "ls": "--", "lw": 1.1, "zorder": 2.5}
        sense = " (clockwise: negative)" if np.sum(speeds[:, k]) < 0.0 else ""
        middle, low, high = band(time, speeds[:, k], time.size if bins is None else bins)
        if low is not high:
            axis.fill_between(middle, low, high, color=look["color"], alpha=_BAND_ALPHA, lw=0.0)
        axis.plot(middle, (low + high) / 2.0, label=f"rotor{'' if rotors == 1 else f' {k + 1}'}{sense}", **look)


def amplitude_histories(
    time: np.ndarray,
    amplitude: np.ndarray,
    load_speed: np.ndarray,
    force: np.ndarray,
    rotor_speed: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str],
    directions: Sequence[str] = ("force",),
    resonances: Sequence[float] = (),
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw the histories of an averaged run, a panel for each quantity; amplitudes are zero to peak.

    **Arguments** (nt times, nd coordinates)

    - `time` (nt,), s; `amplitude` (nt, nd), m or rad according to `units` (nd,), drawn in mm or µm, and in deg
    - `load_speed` (nt, count), `rotor_speed` (nt, exciters), rad/s, drawn in `unit`
    - `force` (nt, directions): foundation force, N
    - `resonances`: natural frequencies, rad/s; those below the largest rotor speed are dotted lines in the panel of the speeds
    """
    unit, scale = speed_unit(unit)
    kinds = _kinds(amplitude, units, "amplitude", "amplitude")
    figure, axes = panels(len(kinds) + 2, size=(7.0, 2.2), share_x="col", ax=ax)

    def lines(axis: Axes, values: np.ndarray, places: Sequence[int], labels: Sequence[str | None]) -> None:
        depth = np.argsort(np.argsort(-np.ptp(values, axis=0)))  # as in `time_histories`
        for k, name in zip(places, labels, strict=True):
            beats = np.count_nonzero(np.diff(np.sign(np.diff(values[:, k])))) / 2.0
            bins = time.size // _SAMPLES_PER_INTERVAL if beats > _MAX_BEATS and time.size >= _MIN_SAMPLES else time.size
            _draw_band(axis, time, values[:, k], k, name, bins, depth[k])

    for axis, (kind, label, factor) in zip(axes, kinds, strict=False):
        of_kind = [k for k in range(len(names)) if units[k] == kind]
        lines(axis, factor * amplitude, of_kind, [names[k] for k in of_kind])
        axis.set_ylabel(f"{label}\nzero to peak")
        _draw_legend(axis, band=_SHORT_INTERVALS)
    for k, name in _equal_loads(load_speed, load_speed[-(load_speed.shape[0] // 4) :]):
        lines(axes[-2], scale * load_speed, [k], [name])
    _draw_rotor_speeds(axes[-2], time, scale * rotor_speed)
    signs = [sign for sign in (1.0, -1.0) if np.any(sign * rotor_speed > 0.0)]
    passed = [w for w in resonances if w < np.max(np.abs(rotor_speed), initial=0.0)]
    resonance_lines(axes[-2].axhline, scale * np.outer(signs, passed).ravel(), "resonances")
    axes[-2].set_ylabel(f"speed, {unit}")
    _draw_legend(axes[-2])
    lines(axes[-1], force, range(len(directions)), directions)
    axes[-1].set_ylabel("foundation force, N\nzero to peak")
    _draw_legend(axes[-1], 2, _SHORT_INTERVALS)
    axes[-1].set_xlabel("time, s")
    return figure if ax is None else ax
