"""One style for every figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxvib.errors import InputError

__all__ = ["COLORS", "UNSTABLE", "panels", "speed_scale"]

COLORS = ("#1f5aa6", "#c8501e", "#2d8a4e", "#7a4fa3", "#b8860b", "#555555", "#0f8b8d", "#a8324a")
"""Colours told apart by every reader; further series start over."""

UNSTABLE = (0, (3, 2))
"""The dashes of what is not stable."""

_STYLE: Any = {
    "font.size": 10.0,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
}


def speed_scale(unit: str) -> float:
    """By what speeds in rad/s are multiplied to be drawn in `unit`. **Raises** `InputError` but for "rad/s" and "rpm".

    >>> round(speed_scale("rpm"), 3)
    9.549
    """
    if unit not in ("rad/s", "rpm"):
        raise InputError("unit", f"is {unit!r}; it must be 'rad/s' or 'rpm'")
    return 30.0 / math.pi if unit == "rpm" else 1.0


def panels(
    rows: int, columns: int = 1, *, size: Sequence[float] = (7.0, 3.0), share_x: bool = False, ax: Axes | None = None
) -> tuple[Figure, list[Axes]]:
    """A figure with `rows` x `columns` axes in the house's style, `size` inches each; with `ax` those axes and their figure.

    **Returns** the figure and its axes.

    >>> figure, axes = panels(2)
    >>> len(axes)
    2
    """
    if ax is not None:
        return ax.figure.figure, [ax]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(size[0] * columns, size[1] * rows))
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=share_x)
    return figure, list(grid.ravel())
