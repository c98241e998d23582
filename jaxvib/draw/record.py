"""Charts of recorded runs of a machine, of the recorded swing of a pendulum, and of the models fitted to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxvib.display import Drawn, Onto, speed_unit
from jaxvib.draw.style import COLORS, GUIDE, color_of, legend_above, panels


def swing_chart(time: np.ndarray, angle: np.ndarray, fitted: np.ndarray, noise: float, *, ax: Onto = None) -> Drawn:
    """Draw the recorded and the fitted angle over time, and their difference in a second panel, in degrees.

    `time` (n,) is in s, `angle` and `fitted` (n,) are in rad. The difference, record minus fit, is compared with twice the
    `noise`, rad.
    """
    degrees = 180.0 / np.pi
    figure, (top, bottom) = panels(2, size=(9.0, 2.6), share_x=True, ax=ax)
    top.plot(time, degrees * fitted, color=COLORS[0], lw=0.8, label="fit")
    top.plot(time, degrees * angle, ".", color=COLORS[1], ms=2.5, label="record")
    top.set_ylabel("angle, deg")
    legend_above(top)
    bottom.plot(time, degrees * (angle - fitted), ".", color=COLORS[0], ms=2.5)
    for sign in (-2.0, 2.0):
        bottom.axhline(sign * degrees * noise, color=GUIDE, lw=0.9, ls=":", label="twice the noise" if sign > 0.0 else None)
    legend_above(bottom)
    bottom.set(ylabel="record - fit, deg", xlabel="time, s")
    return figure if ax is None else ax


_MAX_SHOWN_POINTS = 4000
"""Number of points of a curve above which it is drawn by the smallest and the largest value of each part."""


def recording_chart(
    signals: Sequence[tuple[str, np.ndarray, np.ndarray]], speed: tuple[np.ndarray, np.ndarray] | None = None
) -> Figure:
    """Draw one panel for each signal (label, times s, values), and a last one for the `speed` (times s, rad/s) of the rotor."""
    figure, axes = panels(len(signals) + (speed is not None), size=(9.0, 1.9), share_x=True)
    for axis, (label, time, values) in zip(axes, signals, strict=False):
        axis.plot(*_extremes(time, values), color=COLORS[0], lw=0.6)
        axis.set_ylabel(label)
    if speed is not None:
        unit, factor = speed_unit()
        axes[-1].plot(speed[0], factor * speed[1], color=COLORS[1])
        axes[-1].set_ylabel(f"rotor speed, {unit}")
    axes[-1].set_xlabel("time, s")
    return figure


def _extremes(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve of at most `_MAX_SHOWN_POINTS` points with the smallest and the largest value of each part of it."""
    size = -(-2 * values.size // _MAX_SHOWN_POINTS)
    if size <= 2:
        return time, values
    starts = np.arange(0, values.size, size)
    low = np.minimum.reduceat(np.where(np.isfinite(values), values, np.inf), starts)
    high = np.maximum.reduceat(np.where(np.isfinite(values), values, -np.inf), starts)
    pairs = np.stack([low, high], axis=1).ravel()
    return np.repeat(time[starts], 2), np.where(np.isfinite(pairs), pairs, np.nan)


def fit_chart(
    time: np.ndarray,
    readings: np.ndarray,
    fitted: np.ndarray,
    noise: np.ndarray,
    names: Sequence[str],
    *,
    y_label: str = "reading, SI units",
    ax: Onto = None,
) -> Drawn:
    """Draw the readings of channels and their fit over time, and the residuals relative to their noise in a second panel.

    `time` (n,) is in s, `readings` and `fitted` (n, channels) are in SI units, `noise` (channels,) is that of the channels
    `names`.
    """
    figure, (top, bottom) = panels(2, size=(9.0, 2.8), share_x=True, ax=ax)
    for k, name in enumerate(names):
        color = color_of(k)
        top.plot(time, readings[:, k], ".", color=color, ms=1.5, alpha=0.5)
        top.plot(time, fitted[:, k], color=color, lw=0.8, label=name)
        bottom.plot(time, (readings[:, k] - fitted[:, k]) / max(float(noise[k]), 1e-300), ".", color=color, ms=1.5)
    legend_above(top)
    top.set_ylabel(y_label)
    for sign in (-2.0, 2.0):
        bottom.axhline(sign, color=GUIDE, lw=0.9, ls=":", label="twice the noise" if sign > 0.0 else None)
    legend_above(bottom)
    bottom.set(ylabel="(reading - fit) / noise", xlabel="time, s")
    return figure if ax is None else ax
