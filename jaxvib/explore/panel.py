"""Axes, lines and legend of a chart in an SVG figure. Drawing them takes a tenth of the time of matplotlib."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from jaxvib.draw.machine.parts import Part, Text, box, circle
from jaxvib.draw.style import GUIDE, Look, log_places

PANEL_WIDTH, PANEL_HEIGHT, LEFT_MARGIN, PANEL_GAP, RIGHT_MARGIN = 4.2, 3.6, 0.75, 1.1, 0.25
"""Width and height of a panel; space to the left of the first panel, between two panels and to the right of the last one; in
units of the drawing."""

ROTOR = {"color": GUIDE, "lw": 0.8}
WORKING = {"color": "black", "lw": 1.0, "ls": "-."}
"""Styles of the line on which a speed is equal to the rotor speed, and of the working speed."""

_MAX_TICKS = 5
"""Maximum number of ticks of an axis."""

_MIN_POINT_DISTANCE = 0.03
"""Minimum distance between two points of a line, in units of the drawing: about two pixels. Nearer points are omitted."""

_COLUMNS = ((0.05, 1.6, 3.5), (8.3, 9.6, 10.9, 12.2), (13.1, 14.4))
"""Positions of the left ends of the columns of the legend, for each of its groups."""

_GRID = {"color": "#e2e2e2", "lw": 0.6, "zorder": 0.5}


@dataclasses.dataclass(frozen=True)
class Panel:
    """Chart over a speed.

    **Attributes**: `left`: position of its left end, in units of the drawing; `title` above it; `x` and `y`: limits of its
    axes; `log`: True for a logarithmic vertical axis; `width`: its width, in units of the drawing; `below`: title of the
    horizontal axis.
    """

    left: float
    title: str
    x: tuple[float, float]
    y: tuple[float, float]
    log: bool = False
    width: float = PANEL_WIDTH
    below: str = "rotor speed, rpm"

    def place(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of points in the drawing."""
        x, y, (left, right), (low, high) = np.asarray(x, float), np.asarray(y, float), self.x, self.y
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.log(y / low) / math.log(high / low) if self.log else (y - low) / (high - low)
        return self.left + self.width * (x - left) / (right - left), PANEL_HEIGHT * share

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return the position of one point in the drawing."""
        across, up = self.place(x, y)
        return float(across), float(up)

    def line(self, x: ArrayLike, y: ArrayLike, look: Look) -> Part:
        """Return a line through points, without the points below or above the chart."""
        points = np.stack(self.place(x, y), axis=1)
        inside = (points[:, 1] >= 0.0) & (points[:, 1] <= PANEL_HEIGHT)
        return Part(_thin_out(np.where(inside[:, None], points, np.nan)), look)

    def frame(self) -> list[Part]:
        """Return the axes and the grid lines at their ticks."""
        (left, right), (low, high) = self.x, self.y
        upright = [self.line([x, x], self.y, _GRID) for x, _ in self._x_ticks]
        level = [self.line(self.x, [y, y], _GRID) for y, _ in self._y_ticks]
        edge = np.array([self.place(left, high), self.place(left, low), self.place(right, low)], float)
        return [*upright, *level, Part(edge, {"color": "black", "lw": 0.8})]

    def texts(self) -> list[Text]:
        """Return the numbers at the ticks and the names of the axes."""
        small = {"fontsize": "small"}
        across = [Text(self.at(x, self.y[0])[0], -0.18, text, {**small, "ha": "center"}) for x, text in self._x_ticks]
        up = [Text(self.left - 0.08, self.at(self.x[0], y)[1], text, {**small, "ha": "right"}) for y, text in self._y_ticks]
        below = Text(self.left + 0.5 * self.width, -0.46, self.below, {**small, "ha": "center"})
        return [*across, *up, below, Text(self.left - LEFT_MARGIN + 0.05, PANEL_HEIGHT + 0.22, self.title, small)]

    @functools.cached_property
    def _x_ticks(self) -> list[tuple[float, str]]:
        return _ticks(MaxNLocator(_MAX_TICKS).tick_values(*self.x), self.x)

    @functools.cached_property
    def _y_ticks(self) -> list[tuple[float, str]]:
        locator = log_places(*self.y, max_ticks=_MAX_TICKS) if self.log else MaxNLocator(_MAX_TICKS)
        return _ticks(locator.tick_values(*self.y), self.y)


def _ticks(places: ArrayLike, limits: tuple[float, float]) -> list[tuple[float, str]]:
    """Return the ticks between the limits, with their numbers."""
    return [(x, f"{x:g}") for x in np.asarray(places, float).tolist() if limits[0] <= x <= limits[1]]


def _thin_out(points: np.ndarray) -> np.ndarray:
    """Return a line (n, 2) without points that are too close to other points. Its ends and the points beside a gap (NaN) are
    kept."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    distance_count = np.floor(np.concatenate([[0.0], np.nancumsum(steps)]) / _MIN_POINT_DISTANCE)
    gap = np.isnan(np.concatenate([[np.nan], steps, [np.nan]]))
    is_needed = gap[1:] | gap[:-1]
    is_needed[1:] |= distance_count[1:] != distance_count[:-1]
    return points[is_needed]


def dot(x: float, y: float, look: Look, square: bool = False) -> Part:
    """Return a round or a square dot with the given style."""
    outline = box(x - 0.045, x + 0.045, y - 0.045, y + 0.045) if square else circle((x, y), 0.05, 13)
    return Part(outline, look, filled=True)


def legend(groups: Sequence[Mapping[str, Look]]) -> tuple[list[Part], list[Text]]:
    """Return the legend above the charts, with two entries in a column: samples of lines and dots with their names.

    A style with a fill colour ("fc") is drawn as a dot, other styles as a line. The `groups` begin above the first,
    the second and the third chart.
    """
    parts, texts = [], []
    for columns, looks in zip(_COLUMNS, groups, strict=False):
        for k, (name, look) in enumerate(looks.items()):
            x, y = columns[k // 2], PANEL_HEIGHT + (0.95, 0.68)[k % 2]
            parts.append(dot(x + 0.2, y, look) if "fc" in look else Part(np.array([[x, y], [x + 0.4, y]]), look))
            texts.append(Text(x + 0.5, y, name, {"fontsize": "small"}))
    return parts, texts
