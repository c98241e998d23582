"""Outlines of springs, dampers, boxes, circles and arrows, and texts.

An outline is an array of points (n, 2); NaN separates its lines.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from jaxvib.draw.style import Look

Point = tuple[float, float]


class Part(NamedTuple):
    """Outline of a part of a drawing.

    - `points` (n, 2): points of the outline
    - `look`: options of matplotlib
    - `filled`: True for a filled outline
    - `axis`: position of the rotor's axis, for a part that turns with the rotor
    - `direction` in which it turns: 1 anticlockwise, -1 clockwise
    """

    points: np.ndarray
    look: Look
    filled: bool = False
    axis: Point | None = None
    direction: int = 1


class Text(NamedTuple):
    """Text at the point x, y of a drawing; `look` contains options of matplotlib."""

    x: float
    y: float
    text: str
    look: Look


def _along(start: Point, end: Point, forward: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return points (n, 2) beside the line from `start` to `end`.

    **Arguments**: `forward` (n,): fractions of the line; `side` (n,): distances to the left of the line.
    """
    a, b = np.asarray(start, float), np.asarray(end, float)
    direction = b - a
    length = np.hypot(*direction)
    left = np.array([-direction[1], direction[0]]) / (length if length > 0.0 else 1.0)
    return a + forward[:, None] * direction + side[:, None] * left


def spring(start: Point, end: Point, width: float = 0.2, coils: int = 6) -> np.ndarray:
    """Return a zigzag line from one point to another.

    >>> spring((0.0, 0.0), (0.0, 1.0)).shape
    (16, 2)
    """
    forward, side = _zigzag(coils)
    return _along(start, end, forward, width * side)


@functools.cache
def _zigzag(coils: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a spring: fractions of its length along its axis, and fractions of its width to the side."""
    side = np.where(np.arange(2 * coils + 1) % 2, 0.5, -0.5)
    side[[0, -1]] = 0.0
    zigzag = np.linspace(0.15, 0.85, 2 * coils + 1)
    return np.concatenate([[0.0], zigzag, [0.93, 1.0]]), np.concatenate([[0.0], side, [0.0, 0.0]])


def damper(start: Point, end: Point, width: float = 0.2, cup: float = 0.4) -> np.ndarray:
    """Return a dashpot from one point to another: a cup on the side of the first point, and a piston. The length of the cup is
    the fraction `cup` of the distance."""
    gap, low, high = np.nan, 0.5 - 0.5 * cup, 0.5 + 0.5 * cup
    forward = np.array([0.0, low, gap, high, low, low, high, gap, 1.0, 0.52, gap, 0.52, 0.52])
    side = np.array([0.0, 0.0, gap, 0.5, 0.5, -0.5, -0.5, gap, 0.0, 0.0, gap, 0.36, -0.36]) * width
    return _along(start, end, forward, side)


def box(left: float, right: float, bottom: float, top: float) -> np.ndarray:
    """Return a rectangle."""
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])


def circle(centre: Point, radius: float, points: int = 61) -> np.ndarray:
    """Return a circle as a polygon."""
    return np.asarray(centre) + radius * _unit_circle(points)


@functools.cache
def _unit_circle(points: int) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, points)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


def sector(centre: Point, radius: float, turn: float | np.ndarray, half: float = 1.0) -> np.ndarray:
    """Return a sector of a circle about the direction `turn`, to the angle `half` on both sides; angles in rad."""
    angle = np.linspace(turn - half, turn + half, 25)
    arc = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([[centre], arc, [centre]])


def turning_arrow(centre: Point, radius: float, direction: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an arc above a centre, and the head that shows the direction of rotation, 1 anticlockwise or -1 clockwise."""
    angle = 0.5 * np.pi + direction * np.linspace(-0.8, 0.8, 21)
    arc = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = direction * np.array([-np.sin(angle[-1]), np.cos(angle[-1])])
    across = np.array([-along[1], along[0]])
    return arc, arc[-1] + np.array([0.2 * along, 0.09 * across, -0.09 * across, 0.2 * along])


def arrow(start: Point, direction: Point, width: float = 0.09) -> np.ndarray:
    """Return the outline of an arrow; a short arrow has a shorter head, and an arrow of zero length is a point."""
    length = float(np.hypot(*direction))
    head = min(0.28, 0.6 * length)
    shaft = (length - head) / length if length > 0.0 else 0.0
    slim = width * min(1.0, length / 0.28)
    forward = np.array([0.0, 0.0, shaft, shaft, 1.0, shaft, shaft, 0.0, 0.0])
    side = np.array([0.0, 0.5, 0.5, 1.3, 0.0, -1.3, -0.5, -0.5, 0.0]) * slim
    return _along(start, (start[0] + direction[0], start[1] + direction[1]), forward, side)


def ground(start: Point, end: Point, step: float = 0.22) -> np.ndarray:
    """Return the symbol of a fixed body: a line with short strokes on its right side."""
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    count = max(2, int(length / step))
    forward, side = [0.0, 1.0], [0.0, 0.0]
    for share in (np.arange(count) + 0.5) / count:
        forward += [np.nan, share, share - 0.6 * step / length]
        side += [np.nan, 0.0, -0.6 * step]
    return _along(start, end, np.array(forward), np.array(side))


def draw_part(axis: Axes, part: Part) -> Line2D | Polygon:
    """Draw a part. **Returns** its artist, whose points are changed by `set_data` (line) or `set_xy` (filled outline)."""
    if part.filled:
        outline = Polygon(part.points, closed=True, **part.look)
        axis.add_patch(outline)
        return outline
    return axis.plot(part.points[:, 0], part.points[:, 1], **{"solid_joinstyle": "miter", **part.look})[0]
