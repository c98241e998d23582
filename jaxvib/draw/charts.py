"""Charts of plain arrays: time histories, branch diagrams, before and after."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, UNSTABLE, panels, speed_scale

__all__ = ["before_after", "branch_diagram", "convergence", "solid_and_dashed", "time_histories"]


def time_histories(
    time: np.ndarray,
    displacement: np.ndarray,
    rate: np.ndarray,
    force: np.ndarray,
    rotor_speed: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str] | None = None,
) -> Figure:
    """Panels over time (s): displacements (nt, nd) mm, tilts mrad where there are any, speeds of the loads (nt, count) and of
    the rotor (nt,) rad/s, force on the bed (nt, nb) N.

    `displacement` is in m, and in rad where `units` (nd,) say "rad"; if None, all is in m.

    >>> import numpy as np
    >>> t, q, one = np.linspace(0.0, 1.0, 5), np.ones((5, 2)), np.ones((5, 1))
    >>> figure = time_histories(t, q, one, one, t, names=("y", "theta"), units=("m", "rad"))
    >>> [axes.get_ylabel() for axes in figure.axes][:2]
    ['displacement, mm', 'tilt, mrad']
    """
    units = ["m"] * len(names) if units is None else units
    kinds = [(unit, label) for unit, label in (("m", "displacement, mm"), ("rad", "tilt, mrad")) if unit in units]
    figure, (*upper, middle, bottom) = panels(len(kinds) + 2, size=(8.0, 2.4), share_x=True)
    widest_first = np.argsort(-np.ptp(displacement, axis=0))  # so that none hides another
    for axis, (unit, label) in zip(upper, kinds, strict=True):
        own = [k for k in widest_first if units[k] == unit]
        for depth, k in enumerate(own):
            line = {"color": COLORS[k % len(COLORS)], "lw": 0.7, "zorder": 2 + 0.1 * depth}
            axis.plot(time, 1e3 * displacement[:, k], label=names[k], **line)
        axis.set_ylabel(label)
        axis.legend(ncols=min(len(own), 6), loc="upper right")
    for k in range(rate.shape[1]):
        middle.plot(time, rate[:, k], color=COLORS[k % len(COLORS)], lw=0.9)
    middle.plot(time, rotor_speed, color="black", ls="--", lw=1.0, label="rotor")
    middle.set_ylabel("speed of loads, rad/s")
    middle.legend(loc="lower right")
    for k in range(force.shape[1]):
        bottom.plot(time, force[:, k], color=COLORS[k % len(COLORS)], lw=0.7)
    bottom.set_ylabel("force on the bed, N")
    bottom.set_xlabel("time, s")
    return figure


def branch_diagram(
    rotor_speed: np.ndarray,
    omega: np.ndarray,
    stable: np.ndarray,
    *,
    amplitude: np.ndarray,
    force: np.ndarray,
    resonances: np.ndarray,
    marks: Sequence[tuple[str, np.ndarray, np.ndarray]] = (),
    names: Sequence[str],
    units: Sequence[str] | None = None,
    at: float | None = None,
    unit: str = "rad/s",
    title: str = "",
) -> Figure:
    """Three panels over the rotor's speed: load speed (np,), amplitudes (np, nd) mm, foundation force (np,) N.

    `amplitude` is in m, and in rad where `units` (nd,) say "rad", which is drawn in mrad; if None, all is in m.
    Stable parts are solid, unstable ones dashed. `resonances` are drawn as level lines, `marks` as points (label, rotor
    speed, load speed), `at` as an upright line; speeds are given in rad/s and drawn in `unit` ("rad/s" or "rpm").
    """
    scale = speed_scale(unit)
    figure, axes = panels(1, 3, size=(5.2, 4.2), share_x=True)
    n = scale * rotor_speed
    view = scale * rotor_speed[np.isfinite(rotor_speed)]
    series: list[tuple[Axes, np.ndarray, str, str]] = [(axes[0], scale * omega, COLORS[0], "loads")]
    tilts = [units is not None and units[k] == "rad" for k in range(len(names))]
    labels = [f"{name}, mrad" if tilts[k] else name for k, name in enumerate(names)]
    series += [(axes[1], 1e3 * amplitude[:, k], COLORS[k % len(COLORS)], name) for k, name in enumerate(labels)]
    series += [(axes[2], force, COLORS[0], "force")]
    for axis, values, color, label in series:
        solid_and_dashed(axis, n, values, stable, color, label)
    for k, w in enumerate(resonances):
        axes[0].axhline(scale * w, color="#999999", lw=0.8, ls=":", label=None if k else "resonance")
    low, high = 0.0, float(np.max(view))
    axes[0].plot([low, high], [low, high], color="#bbbbbb", lw=0.8, label="rotor")
    for (label, x, y), shape in zip(marks, itertools.cycle("os^Dv"), strict=False):
        axes[0].plot(scale * x, scale * y, shape, ms=4.5, mfc="white", mec="black", label=label)
    for axis, label in zip(axes, ("speed of loads, " + unit, "amplitude, mm", "foundation force, N"), strict=True):
        axis.set_xlabel("rotor speed, " + unit)
        axis.set_ylabel(label)
        axis.set_xlim(low, high)
        if at is not None:
            axis.axvline(scale * at, color="#c8501e", lw=0.9, ls="-.")
    figure.suptitle(title, fontsize="medium")
    axes[0].set_ylim(0.0, None)
    axes[0].legend(loc="upper left")
    axes[1].legend(loc="best")
    for axis, values in zip(axes[1:], (1e3 * amplitude, force[:, None]), strict=True):
        shown = values[np.isfinite(rotor_speed)]
        axis.set_yscale("log")
        axis.set_ylim(1e-5 * np.max(shown), 2.0 * np.max(shown))
    return figure


def solid_and_dashed(
    axis: Axes,
    x: np.ndarray,
    y: np.ndarray,
    stable: np.ndarray,
    color: str,
    label: str | None = None,
    *,
    widths: tuple[float, float] = (1.4, 1.4),
) -> None:
    """One line for each unbroken stretch, solid where `stable`; neighbouring stretches share a point so that no gap shows.
    `widths` of the solid ones and of the dashed ones."""
    cuts = np.flatnonzero(stable[1:] != stable[:-1]) + 1
    labelled = False
    for start, stop in zip([0, *cuts], [*(cuts + 1), len(x)], strict=True):
        solid = bool(stable[start])
        name = label if solid and not labelled else None
        labelled = labelled or solid
        style, width = ("-", widths[0]) if solid else (UNSTABLE, widths[1])
        axis.plot(x[start:stop], y[start:stop], color=color, ls=style, lw=width, label=name)


def before_after(rows: Sequence[tuple[str, float, float]], *, title: str = "", ax: Axes | None = None) -> Figure:
    """For each (name, before, after) a bar from 1 to after/before on a logarithmic axis, so that what falls a thousandfold is
    as plain as what grows so; the values stand beside it. What has no ratio is written only."""
    figure, (axis,) = panels(1, size=(9.0, 0.42 * len(rows) + 1.5), ax=ax)
    ratios = np.asarray([after / before if before else np.nan for _, before, after in rows])
    drawn = np.isfinite(ratios) & (ratios > 0.0)
    places = np.arange(len(rows))[::-1]
    # What nearly vanishes leaves the axis: all others would be lines.
    widest = min(max([1.5, *np.exp(np.abs(np.log(ratios[drawn])))]), 1e4)
    for place, ratio, there, (_, before, after) in zip(places, ratios, drawn, rows, strict=True):
        if there:
            axis.barh(place, ratio - 1.0, left=1.0, color=COLORS[0] if ratio <= 1.0 else COLORS[1], height=0.6)
        share = f"   ({ratio:.3g} x)" if there else ""
        axis.text(
            1.02, place, f"{before:.4g} → {after:.4g}{share}", va="center", fontsize=9, transform=axis.get_yaxis_transform()
        )
    axis.axvline(1.0, color="black", lw=0.9)
    axis.set_xscale("log")
    axis.set_xlim(widest**-1.1, widest**1.1)
    axis.set_yticks(places, [name for name, _, _ in rows])
    axis.set_xlabel("after / before")
    axis.set_title(title)
    axis.grid(False, axis="y")
    return figure


def convergence(history: np.ndarray, *, best: int, label: str, ax: Axes | None = None) -> Figure:
    """The objective of every start (iterations, starts) over the iterations, the one numbered `best` bold."""
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    axis.plot(history, color=COLORS[0], lw=0.5, alpha=0.25)
    axis.plot(history[:, best], color=COLORS[1], lw=2.0, label="best start")
    axis.set_yscale("log" if np.nanmin(history) > 0.0 else "linear")
    axis.set_xlabel("iteration")
    axis.set_ylabel(label)
    axis.legend()
    return figure
