"""Charts that set one way of computing against another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

__all__ = ["cost_chart", "tiers_chart"]


def tiers_chart(mass: np.ndarray, differences: Mapping[str, np.ndarray], stable: np.ndarray) -> Figure:
    """Relative differences (n,) by name over the mass of a load (n,) kg; marks are hollow where `stable` (n,) is False."""
    figure, (axes,) = panels(1, size=(7.0, 4.0))
    for color, (name, values) in zip(COLORS, differences.items(), strict=False):
        axes.loglog(mass, values, color=color, label=name)
        axes.loglog(mass[stable], values[stable], "o", color=color, ms=5)
        axes.loglog(mass[~stable], values[~stable], "o", color=color, mfc="white", ms=5)
    axes.set_xlabel("mass of a load, kg")
    axes.set_ylabel("leading order against exact, relative")
    axes.legend()
    return figure


def cost_chart(lines: Mapping[str, tuple[np.ndarray, np.ndarray]], floor: float, quantity: str) -> Figure:
    """Relative error over seconds, a line of (seconds, error) for each name; below `floor` the reference itself may be wrong.

    >>> figure = cost_chart({"exact": (np.array([1e-3, 2e-3]), np.array([1e-4, 1e-8]))}, 1e-9, "amplitude")
    >>> figure.axes[0].get_ylabel()
    'relative error of amplitude'
    """
    figure, (axes,) = panels(1, size=(7.5, 4.5))
    for k, (name, (seconds, error)) in enumerate(lines.items()):
        there = np.isfinite(error)
        shape = "os^Dv*P"[k % 7]
        axes.loglog(
            seconds[there], np.maximum(error[there], 1e-16), f"{shape}-", color=COLORS[k % len(COLORS)], ms=5, label=name
        )
    axes.axhspan(1e-17, max(floor, 1e-17), color="#eeeeee", label="the reference's own error")
    errors = np.concatenate([error[np.isfinite(error)] for _, error in lines.values()])
    axes.set_ylim(0.3 * max(min([floor, *errors]), 1e-15), 3.0 * max([*errors, 1e-2]))
    axes.set_xlabel("seconds, once compiled")
    axes.set_ylabel(f"relative error of {quantity}")
    axes.legend()
    return figure
