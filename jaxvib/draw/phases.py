"""Jams of loads at unequal phases, over their drag."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxvib.draw.charts import solid_and_dashed
from jaxvib.draw.style import (
    COLORS,
    GUIDE,
    MARKERS,
    OPERATING,
    UNSTABLE,
    Drawn,
    SpeedUnit,
    legend_above,
    log_ticks,
    panels,
    speed_scale,
)

__all__ = ["drag_diagram"]

_WIDTHS = (2.2, 1.0)
"""Widths of stable and unstable lines, so that overlapping dashes are not taken for a stable line."""


def drag_diagram(
    branches: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    rotor_speed: float,
    *,
    label: str,
    at: float,
    jams: tuple[np.ndarray, np.ndarray] | None = None,
    within: float | None = None,
    unit: SpeedUnit = "rad/s",
    ax: Axes | None = None,
) -> Drawn:
    """Load speeds over the drag, log scale, of patterns (name, drag, speed, stable), (n,) each; the rotor's a level line.

    Patterns of one name have one colour; stable parts are solid, unstable ones dashed. `label` names the drag on its axis; `at`
    is drawn as an upright line with the `jams` (speed, stable) on it, unstable ones hollow; with `within` the axis goes from
    `at` / `within` to `at` x `within`. Speeds are given in rad/s and drawn in `unit`.

    >>> import numpy as np
    >>> drag, speed = np.array([1.0, 2.0, 1.5]), np.array([5.0, 6.0, 7.0])
    >>> figure = drag_diagram([("together", drag, speed, drag < 1.8)], 8.0, label="drag, N s/m", at=1.2)
    >>> figure.axes[0].get_ylabel()
    'speed of loads, rad/s'
    """
    scale = speed_scale(unit)
    figure, (axis,) = panels(1, size=(7.5, 4.6), ax=ax)
    colors = dict(zip(dict.fromkeys(name for name, *_ in branches), itertools.cycle(COLORS), strict=False))
    marks = dict(zip(colors, MARKERS, strict=False))
    for name, drag, speed, stable in branches:
        solid_and_dashed(axis, drag, scale * speed, stable, colors[name], widths=_WIDTHS, marker=marks.get(name, ""))
    for name, color in colors.items():
        axis.plot([], [], color=color, lw=_WIDTHS[0], marker=marks.get(name, ""), ms=4.0, mfc="white", label=name)
    axis.plot([], [], color="black", lw=_WIDTHS[0], label="stable")
    axis.plot([], [], color="black", ls=UNSTABLE, lw=_WIDTHS[1], label="unstable")
    axis.axhline(scale * rotor_speed, color=GUIDE, lw=1.2, label="speed of the rotor")
    axis.axvline(at, label="the scene's drag; points: its jams", **OPERATING)
    if jams is not None:
        speed, stable = jams
        for kind, face in ((~stable, "white"), (stable, "black")):
            axis.plot(np.full(np.sum(kind), at), scale * speed[kind], "o", ms=4.0, mfc=face, mec="black", mew=0.8, zorder=3)
    axis.set_xscale("log")
    if within is not None:
        axis.set_xlim(at / within, at * within)
    log_ticks(axis, "x")
    axis.set_ylim(0.0, 1.05 * scale * rotor_speed)
    axis.set_xlabel(label)
    axis.set_ylabel("speed of loads, " + unit)
    legend_above(axis, 3)
    return figure if ax is None else ax
