"""The branch diagram and the force chart as an SVG picture, in a tenth of the time that matplotlib takes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from jaxvib.draw.charts import crossings, log_limits, stretches
from jaxvib.draw.machine.parts import Part, Text, circle
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, GUIDE, log_places, speed_scale, together
from jaxvib.steady.branches import Branches
from jaxvib.steady.jams.jam import JUDGED
from jaxvib.steady.jams.picture import MARKS

__all__ = ["chart"]

_WIDE, _TALL, _LEFT, _APART, _RIGHT = 6.3, 3.6, 0.75, 1.1, 0.25
"""A panel's width and height, what is left of the first, between two and right of the last, in units of the drawing."""

_TICKS = 5
"""So many ticks, at most, an axis has."""

_FINE = 0.03
"""Points of a line that are nearer to each other than this are left out: two dots."""

_COLUMNS = (0.05, 1.9, 4.6)
"""Where the columns of the legend begin."""

_STABLE = {"color": COLORS[0], "lw": 1.5}
_UNSTABLE = {"color": COLORS[0], "lw": 1.2, "ls": "--"}
_RESONANCE = {"color": GUIDE, "lw": 0.8, "ls": ":"}
_ROTOR = {"color": GUIDE, "lw": 0.8}
_OPERATING = {"color": "black", "lw": 1.0, "ls": "-."}
_GRID = {"color": "#e2e2e2", "lw": 0.6, "zorder": 0.5}
_FOLD = {"fc": "white", "ec": COLORS[1], "lw": 1.2, "zorder": 3.0}
_LEGEND = {
    "stable": _STABLE,
    "unstable": _UNSTABLE,
    "resonance": _RESONANCE,
    "speed of the rotor": _ROTOR,
    "operating speed; numbers: jam modes": _OPERATING,
    MARKS["fold"]: None,
}
"""What lines look like, by what they are; None for the dots of folds."""


def chart(found: Branches, most: float) -> str:
    """The loads' speed and the foundation force (zero to peak) over the rotor's speed, in rpm: what `Branches.plot` draws.

    **Arguments**: `found` the branches of one scene; `most` the greatest rotor speed shown, rad/s.

    **Returns** the text of an SVG file.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    >>> "foundation force, N, zero to peak" in chart(jv.branches(scene), most=200.0)
    True
    """
    scale, at = speed_scale("rpm"), float(found.scene.drive.speed)
    omega, stable, force = np.asarray(found.omega), np.asarray(found.stable), np.asarray(found.foundation_force)
    rotor_speed, resonances = np.asarray(found.rotor_speed), np.asarray(found.resonances)
    rotor_speed = np.where(rotor_speed <= most, rotor_speed, np.nan)
    high = scale * float(np.nanmax(rotor_speed))
    speeds = _Panel(_LEFT, "speed of loads, rpm", (0.0, high), (0.0, 1.06 * high))
    limits = log_limits([force], rotor_speed, omega, resonances)
    forces = _Panel(_LEFT + _WIDE + _APART, "foundation force, N, zero to peak", (0.0, high), limits, log=True)
    parts, texts = [*speeds.frame(), *forces.frame()], [*speeds.texts(), *forces.texts()]
    parts += [speeds.line([0.0, high], [scale * w, scale * w], _RESONANCE) for w in resonances.tolist()]
    parts.append(speeds.line([0.0, high], [0.0, high], _ROTOR))
    crossed = crossings(rotor_speed, stable, np.asarray(found.mode), at)
    for panel, values in ((speeds, scale * omega), (forces, force)):
        parts += [
            panel.line(scale * rotor_speed[along], values[along], _STABLE if solid else _UNSTABLE)
            for along, solid in stretches(stable)
        ]
        parts.append(panel.line([scale * at] * 2, panel.y, _OPERATING))
        jams = []
        for i, share, name, filled in crossed:
            x, y = panel.at(scale * at, float(np.interp(share, [0, 1], values[i : i + 2])))
            if 0.0 <= y <= _TALL:
                jams.append((y / _TALL, name))
                parts.append(_dot(x, y, {"fc": "black" if filled else "white", "ec": "black", "lw": 1.0, "zorder": 4.0}))
        look = {"fontsize": "small", "fontweight": "bold", "bbox": {"fc": "white"}}
        x, _ = panel.at(scale * at, panel.y[0])
        texts += [Text(x + 0.1, _TALL * share, name, look) for share, name in together(sorted(jams))]
    folds = [
        (scale * n, scale * w)
        for n, w, there in zip(*map(np.ravel, (found.folds.rotor_speed, found.folds.omega, found.folds.exists)), strict=True)
        if there and n <= most
    ]
    parts += [_dot(*speeds.at(n, w), _FOLD) for n, w in folds]
    width = _LEFT + 2.0 * _WIDE + _APART + _RIGHT
    keys, names = _legend([name for name in _LEGEND if folds or name != MARKS["fold"]])
    texts.append(Text(0.5 * width, -0.8, f"stable {JUDGED}", {"fontsize": "small", "ha": "center"}))
    return svg((0.0, width, -0.95, _TALL + 1.1), [[*parts, *keys]], [[*texts, *names]], "", 1.0, 0.0)


@dataclasses.dataclass(frozen=True)
class _Panel:
    """Where a chart begins at the left, what stands above it, the limits of its axes, and whether its height is logarithmic."""

    left: float
    title: str
    x: tuple[float, float]
    y: tuple[float, float]
    log: bool = False

    def place(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Places in the drawing."""
        x, y, (left, right), (low, high) = np.asarray(x, float), np.asarray(y, float), self.x, self.y
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.log(y / low) / math.log(high / low) if self.log else (y - low) / (high - low)
        return self.left + _WIDE * (x - left) / (right - left), _TALL * share

    def at(self, x: float, y: float) -> tuple[float, float]:
        """One place in the drawing."""
        across, up = self.place(x, y)
        return float(across), float(up)

    def line(self, x: ArrayLike, y: ArrayLike, look: dict[str, Any]) -> Part:
        """A line through points of which those below or above the chart are left out."""
        points = np.stack(self.place(x, y), axis=1)
        inside = (points[:, 1] >= 0.0) & (points[:, 1] <= _TALL)
        return Part(_thinned(np.where(inside[:, None], points, np.nan)), look)

    def frame(self) -> list[Part]:
        """The axes and the lines at their ticks."""
        (left, right), (low, high) = self.x, self.y
        upright = [self.line([x, x], self.y, _GRID) for x, _ in self._ticks_across()]
        level = [self.line(self.x, [y, y], _GRID) for y, _ in self._ticks_up()]
        edge = np.array([self.place(left, high), self.place(left, low), self.place(right, low)], float)
        return [*upright, *level, Part(edge, {"color": "black", "lw": 0.8})]

    def texts(self) -> list[Text]:
        """The numbers at the ticks and what they are of."""
        small = {"fontsize": "small"}
        across = [Text(self.at(x, self.y[0])[0], -0.18, text, {**small, "ha": "center"}) for x, text in self._ticks_across()]
        up = [Text(self.left - 0.08, self.at(self.x[0], y)[1], text, {**small, "ha": "right"}) for y, text in self._ticks_up()]
        below = Text(self.left + 0.5 * _WIDE, -0.46, "rotor speed, rpm", {**small, "ha": "center"})
        return [*across, *up, below, Text(self.left - _LEFT + 0.05, _TALL + 0.22, self.title, small)]

    def _ticks_across(self) -> list[tuple[float, str]]:
        return _told(MaxNLocator(_TICKS).tick_values(*self.x), self.x)

    def _ticks_up(self) -> list[tuple[float, str]]:
        locator = log_places(*self.y, most=_TICKS) if self.log else MaxNLocator(_TICKS)
        return _told(locator.tick_values(*self.y), self.y)


def _told(places: ArrayLike, limits: tuple[float, float]) -> list[tuple[float, str]]:
    """The ticks between the limits, with their numbers."""
    return [(x, f"{x:g}") for x in np.asarray(places, float).tolist() if limits[0] <= x <= limits[1]]


def _thinned(points: np.ndarray) -> np.ndarray:
    """A line (n, 2) without the points that are next to others; its ends and those beside a gap (NaN) stay."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    gone = np.floor(np.concatenate([[0.0], np.nancumsum(steps)]) / _FINE)
    gap = np.isnan(np.concatenate([[np.nan], steps, [np.nan]]))
    keep = gap[1:] | gap[:-1]
    keep[1:] |= gone[1:] != gone[:-1]
    return points[keep]


def _dot(x: float, y: float, look: dict[str, Any]) -> Part:
    return Part(circle((x, y), 0.05, 13), look, filled=True)


def _legend(names: list[str]) -> tuple[list[Part], list[Text]]:
    """Samples of lines and dots with their names above the charts, two in a column."""
    parts, texts = [], []
    for k, name in enumerate(names):
        x, y, look = _COLUMNS[k // 2], _TALL + (0.95, 0.68)[k % 2], _LEGEND[name]
        if look is None:
            parts.append(_dot(x + 0.2, y, _FOLD))
        else:
            parts.append(
                Part(np.array([[x, y], [x + 0.4, y]]), {**look, "color": GUIDE if look["color"] == GUIDE else "black"})
            )
        texts.append(Text(x + 0.5, y, name, {"fontsize": "small"}))
    return parts, texts
