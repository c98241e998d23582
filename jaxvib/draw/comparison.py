"""Charts that set one way of computing against another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

__all__ = ["tiers_chart"]


def tiers_chart(mass: np.ndarray, differences: Mapping[str, np.ndarray], stable: np.ndarray) -> Figure:
    """Relative differences (n,) by name over the mass of a load (n,) kg; marks are hollow where `stable` (n,) is False."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for k, (name, values) in enumerate(differences.items()):
        axes.loglog(mass, values, color=f"C{k}", label=name, lw=1.2)
        axes.loglog(mass[stable], values[stable], "o", color=f"C{k}", ms=5)
        axes.loglog(mass[~stable], values[~stable], "o", color=f"C{k}", mfc="white", ms=5)
    axes.set_xlabel("mass of a load, kg")
    axes.set_ylabel("leading order against exact, relative")
    axes.grid(True, which="major", color="#dddddd", lw=0.6)
    axes.legend(frameon=False)
    return figure
