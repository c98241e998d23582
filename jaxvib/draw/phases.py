"""Chart of jams of loads at unequal phases over their drag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn, SpeedUnit, speed_unit
from jaxvib.draw.charts import solid_and_dashed
from jaxvib.draw.style import COLORS, GUIDE, MARKERS, OPERATING, UNSTABLE, legend_above, log_ticks, panels

_PATTERNS = ("all together", "in two opposite groups", "spread around the circle, cancelling each other", "at other phases")
"""Patterns of phases, each of which has the same colour and marker in all figures."""

_WIDTHS = (2.2, 1.0)
"""Widths of stable and unstable lines, which differ because overlapping dashes could otherwise look like a stable line."""


def drag_diagram(
    branches: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    rotor_speed: float,
    *,
    label: str,
    at: float,
    jams: tuple[np.ndarray, np.ndarray] | None = None,
    within: float | None = None,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw load speeds over the drag, on a log scale; stable parts are solid, unstable ones dashed.

    **Arguments**

    - `branches`: patterns (name, drag, speed, stable), arrays (n,); patterns of the same name have the same colour
    - `rotor_speed`: rotor speed, rad/s, drawn as a horizontal line
    - `label`: label of the drag axis
    - `at`: drag of the scene, drawn as a vertical line
    - `jams`: jams (speed, stable) at the drag of the scene; unstable ones are hollow
    - `within`: factor of the range of the axis, from `at` / `within` to `at` x `within`; None: automatic range
    - `unit`: unit in which speeds, rad/s, are drawn

    >>> import numpy as np
    >>> drag, speed = np.array([1.0, 2.0, 1.5]), np.array([5.0, 6.0, 7.0])
    >>> figure = drag_diagram([("together", drag, speed, drag < 1.8)], 8.0, label="drag, N s/m", at=1.2)
    >>> figure.axes[0].get_ylabel()
    'speed of loads, rpm'
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.5, 4.6), ax=ax)
    shown = dict.fromkeys(name for name, *_ in branches)
    places = {name: k for k, name in enumerate(dict.fromkeys((*_PATTERNS, *shown)))}
    colors = {name: COLORS[places[name] % len(COLORS)] for name in shown}
    marks = {name: MARKERS[places[name] % len(MARKERS)] for name in shown}
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
    axis.set(ylim=(0.0, 1.05 * scale * rotor_speed), xlabel=label, ylabel="speed of loads, " + unit)
    legend_above(axis, 3)
    return figure if ax is None else ax
