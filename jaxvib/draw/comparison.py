"""Charts that set one way of computing against another."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

__all__ = ["convergence_chart", "cost_chart", "stability_chart", "tiers_chart"]


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
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def convergence_chart(harmonics: np.ndarray, error: np.ndarray, known: np.ndarray, *, names: Sequence[str]) -> Figure:
    """Errors (n, w) over the highest harmonic (n,), log scale; their estimates `known` (n, w) dashed."""
    figure, (axes,) = panels(1, size=(7.0, 4.0))
    floor = np.finfo(float).eps
    for k, (color, name) in enumerate(zip(itertools.cycle(COLORS), names, strict=False)):
        axes.semilogy(harmonics, np.maximum(error[:, k], floor), "o-", color=color, ms=4.5, label=name)
        axes.semilogy(harmonics, np.maximum(known[:, k], floor), ls=(0, (3, 2)), lw=1.0, color=color)
    axes.plot([], [], ls=(0, (3, 2)), lw=1.0, color="black", label="estimate")
    axes.set_xlabel("highest harmonic")
    axes.set_ylabel("relative error of the rotor speed")
    axes.legend(title="loads at")
    return figure


def stability_chart(
    value: np.ndarray, omega: np.ndarray, stable: np.ndarray, marks: Mapping[str, np.ndarray], *, label: str
) -> Figure:
    """Where `stable` (n, P) over load speed `omega` (n, P) rad/s and another number (n,), with marks (k, 2) by kind."""
    figure, (axes,) = panels(1, size=(7.5, 4.5))
    height = np.broadcast_to(value[:, None], omega.shape)
    if value.size > 1:
        axes.contourf(omega, height, stable.astype(float), levels=[0.5, 1.5], colors=["#cfe3d6"])
        axes.set_yscale("log" if value[0] > 0.0 and value[-1] > 3.0 * value[0] else "linear")
    for (kind, points), color, shape in zip(marks.items(), COLORS, itertools.cycle("os^D"), strict=False):
        axes.plot(points[:, 0], points[:, 1], shape, color=color, ms=4.0, label=kind)
    axes.plot([], [], "s", color="#cfe3d6", ms=9.0, label="stable")
    axes.set_xlabel("speed of loads, rad/s")
    axes.set_ylabel(label)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
