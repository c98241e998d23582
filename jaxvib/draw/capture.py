"""Charts of captures of balls: fractions of captured starts, thresholds, and paths on the unrolled torus."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from jaxvib.display import Drawn, Onto
from jaxvib.draw.style import COLORS, GUIDE, STROKES, color_of, legend_above, panels


def threshold_chart(
    speed: np.ndarray, fraction: np.ndarray, error: np.ndarray | None, threshold: float, *, ax: Axes | None = None
) -> Drawn:
    """Draw the fraction of captured starts over the initial speed, and the threshold.

    **Arguments** (n speeds): `speed` (n,): initial speed relative to the rotor, divided by the rotor speed; `fraction` (n,) of
    captured starts; `error` (n,): its standard error, or None; `threshold`: in the unit of `speed`, NaN for none.
    """
    figure, (axis,) = panels(1, size=(7.0, 3.4), ax=ax)
    label = "fraction"
    if error is not None:
        low, high = np.clip([fraction - error, fraction + error], 0.0, 1.0)
        axis.fill_between(speed, low, high, color=COLORS[0], alpha=0.2, lw=0.0)
        label = "fraction, with its standard error"
    axis.plot(speed, fraction, marker="o", ms=3.0, color=COLORS[0], label=label)
    if np.isfinite(threshold):
        axis.axvline(threshold, color=COLORS[1], ls="--", label=f"threshold {threshold:.3f}")
    axis.set(xlabel="initial speed relative to the rotor / rotor speed", ylabel="fraction captured", ylim=(-0.05, 1.05))
    legend_above(axis)
    return figure if ax is None else ax


def curve_chart(
    value: np.ndarray, threshold: np.ndarray, uncertainty: np.ndarray, least: np.ndarray, *, ax: Axes | None = None
) -> Drawn:
    """Draw thresholds of capture over a varied parameter, with their uncertainty, and the lowest captured speeds.

    **Arguments** (n values): `value` (n,) of the parameter; `threshold` (n,), NaN if not all starts at the highest speed were
    captured; `uncertainty` (n,); `least` (n,): the lowest initial speed from which a start was captured. Speeds are relative to
    the rotor, divided by the rotor speed.
    """
    figure, (axis,) = panels(1, size=(7.0, 3.4), ax=ax)
    axis.fill_between(value, threshold, 0.0, color=COLORS[0], alpha=0.12, lw=0.0, label="all starts captured")
    axis.errorbar(value, threshold, uncertainty, marker="o", ms=4.0, capsize=3.0, color=COLORS[0], label="threshold")
    below_threshold = np.where(least < threshold - uncertainty, least, np.nan)
    if np.any(np.isfinite(below_threshold)):
        axis.plot(value, below_threshold, "v", color=COLORS[1], label="lowest captured speed")
    missing = np.isnan(threshold)
    if np.any(missing):
        axis.plot(value[missing], np.zeros(np.sum(missing)), "x", color="black", clip_on=False, label="not all starts captured")
    axis.set(xlabel="value", ylabel="initial speed relative to the\nrotor / rotor speed", ylim=(-1.03, 0.0))
    legend_above(axis, 3)
    return figure if ax is None else ax


def torus_paths(around: np.ndarray, across: np.ndarray, rate: np.ndarray, time: np.ndarray, *, ax: Onto = None) -> Drawn:
    """Draw paths of balls on the unrolled torus, and their speeds.

    **Arguments** (T times, N balls)

    - `around` (T, N): angle about the axis, relative to the rotor, rad
    - `across` (T, N): angle in the cross-section of the tube, rad; 0 is the bottom, pi/2 the outer equator
    - `rate` (T, N): speed relative to the rotor, divided by the rotor speed
    - `time` (T,): time, s
    """
    figure, (paths, speeds) = panels(2, size=(7.0, 3.4), ax=ax)
    late = max(1, round(0.9 * time.size))
    for j in range(around.shape[1]):
        colour = color_of(j)
        x, y = _wrapped(around[:, j], -np.pi), _wrapped(across[:, j], -0.5 * np.pi)
        # The line is interrupted if a ball leaves the chart on one side and returns on the other.
        leaps = (np.abs(np.diff(x, prepend=x[:1])) > np.pi) | (np.abs(np.diff(y, prepend=y[:1])) > np.pi)
        broken = np.degrees(np.where(leaps, np.nan, x))
        paths.plot(broken, np.degrees(y), color=colour, lw=0.6, alpha=0.3)
        paths.plot(broken[late:], np.degrees(y[late:]), color=colour, lw=1.2, label=f"ball {j + 1}, the last tenth")
        paths.plot(np.degrees(x[:1]), np.degrees(y[:1]), "o", mfc="white", color=colour, label=None if j else "start")
        paths.plot(np.degrees(x[-1:]), np.degrees(y[-1:]), "o", color=colour, mec="white", zorder=4, label=None if j else "end")
        speeds.plot(time, rate[:, j], color=colour, ls=STROKES[j % len(STROKES)], lw=1.0, label=f"ball {j + 1}")
    paths.axhline(90.0, color=GUIDE, ls="--", lw=0.8, label="outer equator")
    paths.set_xlim(-180.0, 180.0)
    paths.set_xticks(np.arange(-180, 181, 90))
    paths.yaxis.set_major_locator(MultipleLocator(45.0))
    paths.set(xlabel="around the axis, relative to the rotor, degrees", ylabel="in the tube, degrees")
    legend_above(paths, 3)
    speeds.axhline(0.0, color=GUIDE, ls="--", lw=0.8)
    speeds.set(xlabel="time, s", ylabel="speed relative to the\nrotor / rotor speed")
    legend_above(speeds)
    return figure if ax is None else ax


def _wrapped(angle: np.ndarray, least: float) -> np.ndarray:
    """Return the angle, rad, reduced to the turn that begins at `least`, rad."""
    return np.mod(angle - least, 2.0 * np.pi) + least
