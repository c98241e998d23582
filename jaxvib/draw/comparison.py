"""Charts that set one way of computing against another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

__all__ = ["tiers_chart"]


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
