"""Charts that compare methods of computation."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import (
    COLORS,
    HATCHED,
    MARKERS,
    NO_RESULT,
    STROKES,
    Look,
    cell_edges,
    color_of,
    legend_above,
    log_ticks,
    panels,
)


def tiers_chart(
    mass: np.ndarray, differences: Mapping[str, np.ndarray], stable: np.ndarray, *, ax: Axes | None = None
) -> Drawn:
    """Draw relative errors of the leading order over the mass of a load, on logarithmic scales.

    **Arguments** (n masses): `mass` (n,), kg; `differences`: relative differences (n,) from the exact orbit, by the name of the
    quantity; `stable` (n,): markers are hollow if it is False.
    """
    figure, (axes,) = panels(1, size=(7.0, 4.0), ax=ax)
    for color, mark, stroke, (name, values) in zip(
        COLORS, MARKERS, itertools.cycle(STROKES), differences.items(), strict=False
    ):
        axes.loglog(mass, values, color=color, ls=stroke, marker=mark, ms=0.1, label=name)
        axes.loglog(mass[stable], values[stable], mark, color=color, ms=5)
        axes.loglog(mass[~stable], values[~stable], mark, color=color, mfc="white", ms=5)
    axes.plot([], [], "o", color="black", mfc="white", label="hollow: unstable")
    log_ticks(axes, "x")
    log_ticks(axes)
    axes.set(xlabel="mass of a load, kg", ylabel="relative error of the leading order")
    legend_above(axes)
    return figure if ax is None else ax


class CostPanel(NamedTuple):
    """Panel of `cost_chart`.

    - `lines`: arrays (n, 2) of seconds and relative errors by name
    - `floor`: relative error of the reference; smaller errors are not significant
    - `quantity`: name of the quantity
    - `best`: points (m, 2) that are marked by rings
    """

    lines: Mapping[str, np.ndarray]
    floor: float
    quantity: str
    best: np.ndarray


def cost_chart(panels_by_title: Mapping[str, CostPanel], error_levels: Sequence[float], *, ax: Onto = None) -> Drawn:
    """Draw the relative error over the time in seconds, a panel for each title, two in a row.

    A name has the same colour and marker in all panels, which share a legend. Dotted lines mark the `error_levels`.
    """
    names = list(dict.fromkeys(name for panel in panels_by_title.values() for name in panel.lines))
    # Colours repeat after 8 lines and markers after 7; therefore no two of the first 56 lines look the same.
    looks = {name: (color_of(k), "os^Dv*P"[k % 7]) for k, name in enumerate(names)}
    columns = len(panels_by_title) if ax is not None else min(2, len(panels_by_title))
    figure, cells = panels(-(-len(panels_by_title) // columns), columns, size=(6.6, 4.4), ax=ax)
    for spare in cells[len(panels_by_title) :]:
        spare.set_axis_off()
    for axes, (title, panel) in zip(cells, panels_by_title.items(), strict=False):
        _cost_panel(axes, panel, error_levels, looks)
        axes.set_title(title)
    handles = [
        *(Line2D([], [], ms=5, color=color, marker=marker) for color, marker in looks.values()),
        Line2D([], [], ls=":", lw=1.0, marker="o", ms=11, mfc="none", color="black"),
        Patch(color=_FLOOR_COLOR),
    ]
    extra_labels = ["fastest within " + ", ".join(f"{error:.0e}" for error in error_levels), "error of the reference"]
    if ax is None:
        labels, place = [*names, *extra_labels], "outside upper left"
        figure.legend(handles, labels, loc=place, ncols=3 * columns, frameon=False, fontsize="small")
    else:
        legend_above(cells[0], 2, handles=handles, labels=[*names, *extra_labels])
    return figure if ax is None else ax


_FLOOR_COLOR = "#e6e6e6"


def _cost_panel(axes: Axes, panel: CostPanel, error_levels: Sequence[float], looks: Mapping[str, tuple[str, str]]) -> None:
    for name, points in panel.lines.items():
        seconds, error = points[np.isfinite(points[:, 1])].T
        color, marker = looks[name]
        axes.loglog(seconds, np.maximum(error, 1e-16), ms=5, color=color, marker=marker)
    floor = min(max(panel.floor, 1e-17), 1.0)
    axes.axhspan(1e-17, floor, color=_FLOOR_COLOR, zorder=0.4)
    if panel.best.size:
        axes.plot(*panel.best.T, "o", ms=11, mfc="none", color="black")
    errors = np.concatenate([points[:, 1] for points in panel.lines.values()])
    errors = errors[np.isfinite(errors)]
    axes.set_ylim(0.3 * max(min([floor, *errors]), 1e-15), 3.0 * max([floor, *errors, 1e-2]))
    for error in error_levels:
        axes.axhline(error, color="black", ls=":", lw=1.0, zorder=0.5)
    axes.set_xlabel("time without compilation")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100.0 * low else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(EngFormatter(unit="s"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(f"relative error of {panel.quantity}")


def convergence_chart(
    harmonics: np.ndarray, error: np.ndarray, estimate: np.ndarray, *, names: Sequence[str], ax: Axes | None = None
) -> Drawn:
    """Draw relative errors of the rotor speed over the highest harmonic, on a logarithmic scale.

    **Arguments** (n harmonics, w load speeds): `harmonics` (n,); `error` (n, w), solid lines; `estimate` (n, w) of the errors,
    dashed lines; `names` (w,) of the load speeds.
    """
    figure, (axes,) = panels(1, size=(7.0, 4.0), ax=ax)
    floor = np.finfo(float).eps
    for k, (color, name) in enumerate(zip(itertools.cycle(COLORS), names, strict=False)):
        axes.semilogy(harmonics, np.maximum(error[:, k], floor), "o-", color=color, ms=4.5, label=name)
        axes.semilogy(harmonics, np.maximum(estimate[:, k], floor), ls=(0, (3, 2)), lw=1.0, color=color)
    axes.plot([], [], ls=(0, (3, 2)), lw=1.0, color="black", label="estimate")
    axes.set(xlabel="highest harmonic", ylabel="relative error of the rotor speed")
    legend_above(axes, title="loads at")
    return figure if ax is None else ax


def stability_chart(
    value: np.ndarray,
    omega: np.ndarray,
    stable: np.ndarray,
    marks: Mapping[str, np.ndarray],
    *,
    label: str,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw a band for each `value` (n,) of the varied parameter, between the first and the last one. A band is shaded at the
    load speeds `omega` (n, P) of `stable` (n, P) jams, white at those of unstable ones, and hatched where `omega` is NaN.

    Points on the axis show the values, because a band reaches midway to the next one. `marks` contains points (k, 2), each with
    a load speed and a value, by their kind. Speeds are in rad/s and drawn in `unit`.
    """
    unit, scale = speed_unit(unit)
    figure, (axes,) = panels(1, size=(7.5, 5.0), ax=ax)
    logarithmic = value[0] > 0.0 and value[-1] > 3.0 * value[0]
    edges = cell_edges(value, logarithmic)
    if value.size > 1:
        edges = np.clip(edges, value[0], value[-1])  # nothing is known beyond the first and the last value
    ends = float(np.nanmin(omega)), float(np.nanmax(omega))
    missing = [_gaps(speeds, *ends) for speeds in omega]
    for speeds, is_stable, gaps, low, high in zip(omega, stable, missing, edges[:-1], edges[1:], strict=True):
        axes.fill_between(scale * speeds, low, high, where=is_stable, color="#cfe3d6", lw=0.0)
        if gaps:
            spans = [(scale * start, scale * (end - start)) for start, end in gaps]
            axes.broken_barh(spans, (low, high - low), **HATCHED[NO_RESULT])
    if logarithmic:
        axes.set_yscale("log")
    axes.margins(y=0.05)  # room for the marks of the first and the last value
    if ends[0] < ends[1]:
        axes.set_xlim(scale * ends[0], scale * ends[1])
    for k, (kind, points) in enumerate(marks.items()):
        # Points of different kinds can lie on each other: hollow marks of different sizes remain visible.
        look: Look = {"mec": color_of(k), "mfc": "none", "mew": 1.4, "ms": max(9.0 - 2.0 * k, 3.0), "ls": ""}
        axes.plot(scale * points[:, 0], points[:, 1], "os^D"[k % 4], label=kind, **look)
    if logarithmic:
        log_ticks(axes)
    areas: dict[str, Look] = {
        "stable": {"facecolor": "#cfe3d6", "lw": 0.0},
        "unstable": {"facecolor": "white", "edgecolor": "#b3b3b3", "lw": 0.8},
        "no jam found": HATCHED[NO_RESULT],
    }
    entries = [Patch(label=name, **look) for name, look in areas.items() if name != "no jam found" or any(missing)]
    on_axis: Look = {"transform": axes.get_yaxis_transform(), "clip_on": False}
    axes.plot(np.zeros(value.size), value, "o", ms=3.0, mfc="white", mec="black", label="computed values", **on_axis)
    axes.set(xlabel=f"load speed, {unit}", ylabel=label)
    # Long names of the marks are in the first column, otherwise the legend would be wider than the figure.
    legend_above(axes, 2, handles=[*axes.get_legend_handles_labels()[0], *entries])
    return figure if ax is None else ax


def _gaps(speeds: np.ndarray, low: float, high: float) -> list[tuple[float, float]]:
    """Return the parts of the range from `low` to `high` in which ascending `speeds` (P,) are NaN.

    >>> nan = float("nan")
    >>> _gaps(np.array([1.0, nan, 3.0, 4.0, nan]), 1.0, 5.0)
    [(1.0, 3.0), (4.0, 5.0)]
    """
    known = np.flatnonzero(np.isfinite(speeds))
    if known.size == 0:
        return [(low, high)]
    found = speeds[known]
    pairs = zip(found[:-1], found[1:], np.diff(known) > 1, strict=True)
    inside = [(float(start), float(end)) for start, end, is_gap in pairs if is_gap]
    outside = [(low, float(found[0])), (float(found[-1]), high)]
    rounding = 1e-9 * (high - low)
    return sorted(gap for gap in [*inside, *outside] if gap[1] - gap[0] > rounding)


def audit_chart(
    labels: Sequence[str],
    changes: Mapping[str, np.ndarray],
    uncertainty: np.ndarray,
    accuracy: float,
    *,
    ax: Axes | None = None,
) -> Drawn:
    """Draw the relative changes (n,) that n effects with these `labels` cause, a marker for each quantity.

    A line marks the requested `accuracy`; changes below their `uncertainty` (n,) lie in a grey range. The axis shows the sizes
    of the changes, without signs.

    >>> figure = audit_chart(["gravity"], {"amplitude": np.array([1e-4])}, np.array([1e-6]), 0.01)
    >>> figure.axes[0].get_xlabel()
    'size of the change, %'
    """
    n = len(labels)
    figure, (left,) = panels(1, size=(8.0, 1.6 + 0.34 * max(n, 3)), ax=ax)
    place = np.arange(n)
    shown = np.concatenate([100.0 * values for values in changes.values()] or [np.zeros(0)])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    low = max(min([100.0 * accuracy, *shown]) / 3.0, 1e-8)
    unresolved = np.maximum(100.0 * np.nan_to_num(uncertainty), low)
    left.hlines(place, low, unresolved, color=_FLOOR_COLOR, lw=14, label="not resolved")
    for color, mark, (name, values) in zip(COLORS, "os^D", changes.items(), strict=False):
        if not np.any(np.isfinite(values)):
            continue
        # Values below the axis are drawn on its edge.
        look: Look = {"color": color, "ms": 6, "alpha": 0.85, "clip_on": False}
        left.plot(np.maximum(100.0 * values, low), place, mark, label=name, **look)
    left.set_xscale("log")
    left.set_xlim(left=low)
    log_ticks(left, "x")
    left.axvline(100.0 * accuracy, color="black", ls=":", lw=1.2, label="requested accuracy")
    left.set_yticks(place, labels)
    beyond = any(np.any(values < low / 100.0) for values in changes.values())
    note = " (on the left edge: smaller)" if beyond else ""
    left.set(ylim=(n - 0.4, -0.6), xlabel=f"size of the change, %{note}")
    legend_above(left, 3)
    return figure if ax is None else ax


def steps_chart(
    steps: np.ndarray,
    difference: np.ndarray,
    best: np.ndarray,
    at_best: np.ndarray,
    tolerance: float,
    *,
    names: Sequence[str],
    route: str,
    ax: Axes | None = None,
) -> Drawn:
    """Draw the relative `difference` (n, k) between central differences and a derivative over the relative `steps` (k,).

    Each of n `names` has a line. For each line a ring at the `best` step (n,) shows the extrapolated difference `at_best` (n,),
    which may lie below the line. A dotted line marks the tolerance. `route`: mode of the derivative, "forward" or "reverse".
    """
    figure, (axes,) = panels(1, size=(7.5, 4.5), ax=ax)
    floor = np.finfo(float).eps
    for color, name, line, x, y in zip(itertools.cycle(COLORS), names, difference, best, at_best, strict=False):
        axes.loglog(steps, np.maximum(line, floor), color=color, label=name)
        axes.loglog([x], [max(y, floor)], "o", color=color, mfc="none", ms=8)
    axes.axhline(tolerance, color="black", ls=":", lw=1.2, label="tolerance; rings: best step")
    axes.set(xlabel="step, relative", ylabel=f"differences against {route} mode")
    legend_above(axes)
    return figure if ax is None else ax
