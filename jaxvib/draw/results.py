"""Small charts of plain arrays for results that need no other: modes, phases, speeds, signals, multipliers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

__all__ = [
    "growth_chart",
    "modes_chart",
    "multiplier_chart",
    "phase_circles",
    "points_chart",
    "signals_chart",
    "speeds_chart",
]


def modes_chart(
    mode: np.ndarray,
    omega: np.ndarray,
    stable: np.ndarray,
    amplitude: np.ndarray,
    resonances: np.ndarray | None = None,
    *,
    names: Sequence[str],
) -> Figure:
    """Load speeds (k,) rad/s and amplitudes (k, nd) m over the numbers of modes (k,); filled where stable, resonances level;
    `names` (nd,) of the coordinates, a colour each.

    >>> import numpy as np
    >>> figure = modes_chart(np.array([1, 2]), np.array([3.0, 4.0]), np.array([True, False]), np.ones((2, 1)), names=["y"])
    >>> figure.axes[1].get_ylabel()
    'amplitude, m'
    """
    figure, (top, bottom) = panels(2, size=(6.0, 2.6), share_x=True)
    for axis, values in ((top, omega[:, None]), (bottom, amplitude)):
        for k in range(values.shape[1]):
            for kind, face in ((stable, COLORS[k % len(COLORS)]), (~stable, "white")):
                axis.plot(mode[kind], values[kind, k], "o", mfc=face, mec=COLORS[k % len(COLORS)])
    for k, name in enumerate(names):
        bottom.plot([], [], "o", color=COLORS[k % len(COLORS)], label=name)
    bottom.legend(loc="best")
    for k, w in enumerate(() if resonances is None else resonances):
        top.axhline(w, color="#999999", lw=0.8, ls=":", label=None if k else "resonance")
    if resonances is not None:
        top.legend(loc="best")
    top.set_ylabel("speed of loads, rad/s")
    bottom.set_ylabel("amplitude, m")
    bottom.set_xlabel("jam mode (hollow: unstable by slope)")
    if np.any(amplitude > 0.0):
        bottom.set_yscale("log")
    bottom.set_xticks(mode)
    return figure


def phase_circles(sets: Sequence[tuple[str, np.ndarray]], *, ax: Axes | None = None) -> Figure:
    """Angles of loads (count,) rad as points on a circle, one circle for each (title, angles); `ax` only for a single one.

    >>> import numpy as np
    >>> len(phase_circles([("a", np.zeros(2)), ("b", np.ones(2))]).axes)
    2
    """
    figure, axes = panels(1, max(len(sets), 1), size=(3.0, 3.2), ax=ax)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for axis in axes:
        axis.plot(np.cos(turn), np.sin(turn), color="#999999", lw=0.8)
        axis.set_aspect("equal")
        axis.set_xticks([])
        axis.set_yticks([])
    for axis, (title, angles) in zip(axes, sets, strict=False):
        for k, angle in enumerate(angles):
            axis.plot(np.cos(angle), np.sin(angle), "o", color=COLORS[k % len(COLORS)], label=f"load {k + 1}")
        axis.set_title(title)
        axis.legend(loc="center")
    return figure


def speeds_chart(
    rows: Sequence[tuple[str, np.ndarray]], spans: Sequence[tuple[str, np.ndarray]] = (), *, ax: Axes | None = None
) -> Figure:
    """Speeds (n,) rad/s as points on a level line for each (label, speeds), then intervals (n, 2) as bars; what is no finite
    number is left out, an interval without an end goes to the edge.

    >>> import numpy as np
    >>> figure = speeds_chart([("resonances", np.array([1.0, np.nan]))], [("balancing", np.array([[1.0, np.inf]]))])
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['balancing', 'resonances']
    """
    figure, (axis,) = panels(1, size=(7.0, 0.5 * (len(rows) + len(spans)) + 1.0), ax=ax)
    values = np.concatenate([np.ravel(x) for _, x in (*rows, *spans)])
    top = 1.15 * np.max(values[np.isfinite(values)], initial=1e-300)
    heights = np.arange(len(rows) + len(spans))[::-1]
    for height, (k, (_, speeds)) in zip(heights, enumerate(rows), strict=False):
        axis.plot(speeds, np.full(np.shape(speeds), height), "o", color=COLORS[k % len(COLORS)])
    for height, (k, (_, intervals)) in zip(heights[len(rows) :], enumerate(spans), strict=True):
        for start, end in intervals[~np.isnan(intervals[:, 0])]:
            axis.barh(height, min(end, top) - start, left=start, height=0.5, color=COLORS[k % len(COLORS)], alpha=0.6)
    labels = [label for label, _ in (*rows, *spans)]
    axis.set_yticks(heights[::-1], labels[::-1])
    axis.set_xlim(0.0, top)
    axis.set_xlabel("speed, rad/s")
    return figure


def signals_chart(x: np.ndarray, signals: Sequence[tuple[str, np.ndarray]], *, across: str) -> Figure:
    """One panel for each (label with unit, values (n, k)), over x (n,), which `across` labels.

    >>> import numpy as np
    >>> len(signals_chart(np.arange(3.0), [("angle, rad", np.ones((3, 1)))], across="time, s").axes)
    1
    """
    figure, axes = panels(len(signals), size=(7.5, 2.2), share_x=True)
    for axis, (label, values) in zip(axes, signals, strict=True):
        for k in range(values.shape[1]):
            axis.plot(x, values[:, k], color=COLORS[k % len(COLORS)], label=str(k + 1))
        axis.set_ylabel(label)
        if values.shape[1] > 1:
            axis.legend(loc="upper right", ncols=min(values.shape[1], 6))
    axes[-1].set_xlabel(across)
    return figure


def points_chart(values: np.ndarray, *, across: str, up: str, ax: Axes | None = None) -> Figure:
    """Values (n, k) as points over 1 .. n.

    >>> import numpy as np
    >>> points_chart(np.ones((3, 2)), across="run", up="speed, rad/s").axes[0].get_xlabel()
    'run'
    """
    figure, (axis,) = panels(1, size=(7.0, 3.2), ax=ax)
    for k in range(values.shape[1]):
        axis.plot(np.arange(1, values.shape[0] + 1), values[:, k], ".", color=COLORS[k % len(COLORS)])
    axis.set_xlabel(across)
    axis.set_ylabel(up)
    return figure


def multiplier_chart(multipliers: np.ndarray, *, ax: Axes | None = None) -> Figure:
    """Floquet multipliers (n,) in the complex plane, and the unit circle.

    >>> import numpy as np
    >>> multiplier_chart(np.array([0.5 + 0.1j])).axes[0].get_xlabel()
    'real part'
    """
    figure, (axis,) = panels(1, size=(4.0, 4.0), ax=ax)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    axis.plot(np.cos(turn), np.sin(turn), color="#999999", lw=0.8)
    axis.plot(np.real(multipliers), np.imag(multipliers), "o", color=COLORS[0], ms=4.0)
    axis.set_aspect("equal")
    axis.set_xlabel("real part")
    axis.set_ylabel("imaginary part")
    return figure


def growth_chart(time: np.ndarray, rates: np.ndarray, exponent: float, uncertainty: float, *, ax: Axes | None = None) -> Figure:
    """Rates of growth (n,) 1/s of stretches that end at `time` (n,) s; the exponent with its standard error."""
    figure, (axes,) = panels(1, ax=ax)
    axes.plot(time, rates, "o-", ms=3.5, color=COLORS[0], label="each stretch")
    half = time[time.size // 2 :]
    axes.fill_between(half[[0, -1]], exponent - uncertainty, exponent + uncertainty, color=COLORS[1], alpha=0.3, lw=0.0)
    axes.plot(half[[0, -1]], [exponent, exponent], color=COLORS[1], label="exponent")
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set_xlabel("time, s")
    axes.set_ylabel("growth of disturbances, 1/s")
    axes.legend()
    return figure
