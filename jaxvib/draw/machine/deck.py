"""Ellipses of the points of a deck, drawn at the positions of the points."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn
from jaxvib.draw.style import GUIDE, color_of, panels


def ellipses(points: np.ndarray, amplitude: np.ndarray, magnify: float) -> list[np.ndarray]:
    """Return the path (97, 2) of each point (n, 2) with its complex amplitudes (n, 2), magnified; the first point of each path
    is at phase 0.

    >>> ellipses(np.array([[1.0, 0.0]]), np.array([[0.01, -0.01j]]), 10.0)[0][0].tolist()
    [1.1, 0.0]
    """
    phase = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 97))
    return [at + magnify * np.real(phase[:, None] * each) for at, each in zip(points, amplitude, strict=True)]


def magnification(points: np.ndarray, amplitude: np.ndarray) -> float:
    """Return the magnification at which the largest amplitude is 0.4 of the smallest distance of two points.

    It is rounded to one digit. The distance is 1 m if there is only one point.
    """
    size = max(float(np.max(np.abs(amplitude))), 1e-300)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = float(np.min(distance[distance > 0.0], initial=np.inf))
    return float(f"{0.4 * (nearest if np.isfinite(nearest) else 1.0) / size:.1g}")


def deck_chart(points: np.ndarray, amplitude: np.ndarray, *, ax: Axes | None = None) -> Drawn:
    """Draw the paths of points (n, 2) of a deck with complex amplitudes (n, 2), m, with a dot at a common time."""
    figure, (axis,) = panels(1, size=(7.0, 3.2), ax=ax)
    magnify = magnification(points, amplitude)
    for k, path in enumerate(ellipses(points, amplitude, magnify)):
        axis.plot(*path.T, color=color_of(k), lw=1.4)
        axis.plot(*path[0], "o", color=color_of(k), ms=4)
    axis.plot(*points.T, "+", color=GUIDE, ms=6)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel="x, m", ylabel="y, m")
    note = f"amplitudes drawn {magnify:g} x as large"
    axis.set_title(note, loc="left", fontsize="small")
    return figure if ax is None else ax
