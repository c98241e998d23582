"""Charts of many cases: maps of labels and of values, fractions with uncertainty, distributions, sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import BoundaryNorm, ListedColormap, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path

from jaxvib.display import Drawn
from jaxvib.draw.style import (
    COLORS,
    HATCHED,
    NO_RESULT,
    STROKES,
    WHITE_OUTLINE,
    Look,
    cell_edges,
    color_of,
    label_colors,
    legend_above,
    log_ticks,
    marker_of,
    panels,
    stacked_looks,
)

_DASHES = {"fold": "-", "torus bifurcation": "--", "period doubling": "-.", "loss of symmetry": ":"}


def label_map(
    x: np.ndarray,
    y: np.ndarray,
    codes: np.ndarray,
    names: Sequence[str],
    *,
    x_label: str,
    y_label: str,
    lines: Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]] | None = None,
    log: tuple[bool, bool] = (False, False),
    ax: Axes | None = None,
) -> Drawn:
    """Draw a map over x (n,) and y (m,), coloured by labels, with lines over it.

    The labels are codes (m, n), which are indices into `names`, or -1 for no label. `lines` contains pairs of x and y for each
    kind of bifurcation.
    """
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    # A code -1 becomes the index of `NO_RESULT`, which is appended as the last name.
    names, codes = [*names, NO_RESULT], np.where(codes < 0, len(names), codes)
    present = np.unique(codes)
    plain = dict(zip(names, map(_light, label_colors(names)), strict=True))
    looks: list[Look] = [HATCHED.get(names[k], {"color": plain[names[k]]}) for k in present]
    colours = [look["facecolor"] if "facecolor" in look else look["color"] for look in looks]
    norm = BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present))
    places, shown = np.searchsorted(present, codes), ListedColormap(colours)
    mesh = axis.pcolormesh(cell_edges(x, log[0]), cell_edges(y, log[1]), places, cmap=shown, norm=norm, rasterized=True)
    for code, look in zip(present, looks, strict=True):
        if "hatch" in look:
            _hatch(axis, mesh, codes == code, look)
    entries: list[Patch | Line2D] = [Patch(label=names[k], **look) for k, look in zip(present, looks, strict=True)]
    limits = axis.get_xlim(), axis.get_ylim()
    for kind, parts in (lines or {}).items():
        entries += _bifurcation_lines(axis, kind, parts, (x, y), limits, log)
    entries += _case_points(axis, x, y, log)
    axis.set(xlim=limits[0], ylim=limits[1])
    _scales(axis, x_label, y_label, log)
    axis.grid(False)
    legend_above(axis, 3, handles=entries)
    return figure if ax is None else ax


def _bifurcation_lines(
    axis: Axes,
    kind: str,
    parts: Sequence[tuple[np.ndarray, np.ndarray]],
    centres: tuple[np.ndarray, np.ndarray],
    limits: tuple[tuple[float, float], tuple[float, float]],
    log: tuple[bool, bool],
) -> list[Line2D]:
    """Draw the lines of one kind of bifurcation up to the `limits` of a map with the `centres` of its cells, and return their
    entry of the legend if a part of them is visible."""
    dashes, inside = _DASHES.get(kind, ":"), False
    width = 1.1 if dashes == "-" else 2.4  # dots remain visible on a solid line at the same place
    # Lines are extended on the drawn scale; on a linear one, an end on a logarithmic axis could become negative.
    drawn = [(np.log, np.exp) if is_log else (np.asarray, np.asarray) for is_log in log]
    x, y = (scale(each) for (scale, _), each in zip(drawn, centres, strict=True))
    x_edges, y_edges = (tuple(scale(np.asarray(each))) for (scale, _), each in zip(drawn, limits, strict=True))
    for part in parts:
        xs, ys = (scale(each) for (scale, _), each in zip(drawn, part, strict=True))
        if xs.size > 1:
            xs, ys = _to_edges(xs, ys, y, y_edges)
            ys, xs = _to_edges(ys, xs, x, x_edges)
        within = (x_edges[0] <= xs) & (xs <= x_edges[1]) & (y_edges[0] <= ys) & (ys <= y_edges[1])
        inside = inside or bool(np.any(within))
        marker = "." if xs.size == 1 else None
        axis.plot(drawn[0][1](xs), drawn[1][1](ys), color="black", lw=width, ls=dashes, marker=marker)
    return [Line2D([], [], color="black", lw=width, ls=dashes, label=f"{kind} of exact jams")] if inside else []


def _hatch(axis: Axes, mesh: QuadMesh, chosen: np.ndarray, look: Look) -> None:
    """Draw the chosen cells (m, n) of a map in a hatched style."""
    axis.add_patch(PathPatch(_cells_path(np.asarray(mesh.get_coordinates()), chosen), rasterized=True, **look))


_MAX_MARKED_CASES = 150
"""Number of cases up to which each is marked by a point in a map."""

_MAX_UNEVEN = 1.01
"""Ratio of the largest to the smallest distance of neighbouring cases up to which their spacing counts as even."""


def _case_points(axis: Axes, x: np.ndarray, y: np.ndarray, log: tuple[bool, bool]) -> list[Line2D]:
    """Mark the cases of a map over x (n,) and y (m,) by points, and return their entry of the legend.

    If there are many cases, only unevenly spaced values are marked, by points on their axis. The cells of evenly spaced values
    show by themselves where the cases are.
    """
    look: Look = {"ls": "none", "marker": "o", "ms": 3.0, "mfc": "white", "mec": "black", "mew": 0.7, "clip_on": False}
    if x.size * y.size <= _MAX_MARKED_CASES:
        return axis.plot(np.tile(x, y.size), np.repeat(y, x.size), label="case", **look)
    entries: list[Line2D] = []
    for values, is_log, turn, share in (
        (x, log[0], 1, axis.get_xaxis_transform()),
        (y, log[1], -1, axis.get_yaxis_transform()),
    ):
        gaps = np.diff(np.log(values) if is_log else values)
        if gaps.size and np.max(gaps) > _MAX_UNEVEN * np.min(gaps):
            places = (values, np.zeros(values.size))[::turn]
            entries = axis.plot(*places, transform=share, label="values of the cases", **look)
    return entries


def _to_edges(
    across: np.ndarray, along: np.ndarray, centres: np.ndarray, edges: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a line on a map of cells, extended to the edges of the map.

    **Arguments**: `along`: coordinates of the points of the line on one axis of the map; `across`: those on the other axis;
    `centres` of the cells and the two `edges` of the map, both on the first axis. An end of the line at the first or the last
    centre is extended with the slope of the line to the edge beside it.

    >>> _to_edges(np.array([3.0, 4.0]), np.array([1.0, 2.0]), np.array([1.0, 2.0]), (0.5, 2.5))
    (array([2.5, 3. , 4. , 4.5]), array([0.5, 1. , 2. , 2.5]))
    """
    for end, (centre, edge) in zip((0, -1), zip(centres[[0, -1]], edges, strict=True), strict=True):
        if along[end] == centre and along[0] != along[-1]:
            inner = 1 if end == 0 else -2
            slope = (across[inner] - across[end]) / (along[inner] - along[end])
            place = 0 if end == 0 else len(along)
            across, along = np.insert(across, place, across[end] + slope * (edge - centre)), np.insert(along, place, edge)
    return across, along


def _cells_path(corners: np.ndarray, chosen: np.ndarray) -> Path:
    """Return one path of all chosen cells (m, n) of a map with the corners (m + 1, n + 1, 2).

    With a separate path for each cell, hatching of many cells takes seconds.

    >>> corners = np.stack(np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0]), axis=-1)
    >>> _cells_path(corners, np.array([[False, True]])).vertices.tolist()
    [[1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 0.0]]
    """
    around = (corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1], corners[:-1, :-1])
    cells = np.stack(around, axis=2)[chosen]
    return Path(cells.reshape(-1, 2), np.tile([Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY], len(cells)))


def _light(colour: str) -> tuple[float, ...]:
    """Return the colour mixed with white, which makes black lines on it visible."""
    return tuple(0.55 * part + 0.45 for part in to_rgb(colour))


def _scales(axis: Axes, x_label: str, y_label: str, log: tuple[bool, bool]) -> None:
    axis.set(xlabel=x_label, ylabel=y_label)
    if log[0]:
        axis.set_xscale("log")
        log_ticks(axis, "x")
    if log[1]:
        axis.set_yscale("log")
        log_ticks(axis)


def value_map(
    x: np.ndarray,
    y: np.ndarray,
    values: np.ndarray,
    *,
    x_label: str,
    y_label: str,
    label: str,
    log: tuple[bool, bool] = (False, False),
    ax: Axes | None = None,
) -> Drawn:
    """Draw a map over x (n,) and y (m,), coloured by values (m, n); cells with NaN are hatched."""
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    drawn = axis.pcolormesh(cell_edges(x, log[0]), cell_edges(y, log[1]), values, cmap="viridis", rasterized=True)
    limits = axis.get_xlim(), axis.get_ylim()
    entries: list[Patch | Line2D] = []
    if np.any(np.isnan(values)):
        _hatch(axis, drawn, np.isnan(values), HATCHED[NO_RESULT])
        entries = [Patch(label=NO_RESULT, **HATCHED[NO_RESULT])]
    figure.colorbar(drawn, ax=axis, label=label)
    entries += _case_points(axis, x, y, log)
    axis.set(xlim=limits[0], ylim=limits[1])
    _scales(axis, x_label, y_label, log)
    axis.grid(False)
    legend_above(axis, handles=entries)
    return figure if ax is None else ax


def points_over(
    x: np.ndarray, values: np.ndarray, *, x_label: str, y_label: str, log: bool = False, ax: Axes | None = None
) -> Drawn:
    """Draw values (n, k) as points over x (n,)."""
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    for k in range(values.shape[1]):
        axis.plot(x, values[:, k], ".", color=color_of(k), ms=4.0)
    _scales(axis, x_label, y_label, (log, False))
    return figure if ax is None else ax


_MAX_BARS = 40
"""Number of values up to which confidence intervals are drawn as bars, above it as bands."""


def shares_chart(
    x: np.ndarray,
    shares: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    *,
    x_label: str,
    log: bool = False,
    intervals: bool = True,
    ax: Axes | None = None,
) -> Drawn:
    """Draw fractions (n,) over x (n,) by name, each with its confidence interval as a bar or a band if `intervals` is True.

    `shares` contains for each name the fraction and the lower and the upper end of its confidence interval, of 95 %.

    >>> import numpy as np
    >>> share = np.array([0.1, 0.5])
    >>> shares_chart(np.arange(2.0), {"mode 3": (share, share - 0.1, share + 0.1)}, x_label="x").axes[0].get_ylabel()
    'share of the cases, % (95 % confidence)'
    """
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    for k, (colour, (name, (share, low, high))) in enumerate(zip(label_colors([*shares]), shares.items(), strict=True)):
        look = {"color": colour, "ls": STROKES[k % len(STROKES)], "marker": marker_of(k)}
        shift = (
            0.006 * (k - 0.5 * (len(shares) - 1)) if intervals and len(x) <= _MAX_BARS else 0.0
        )  # bars stand beside each other
        place = x * (x[-1] / x[0]) ** shift if log else x + shift * np.ptp(x)
        axis.plot(place, 100.0 * share, ms=3.5, lw=1.1, label=name, **look)
        if not intervals:
            continue
        if len(x) > _MAX_BARS:
            axis.fill_between(x, 100.0 * low, 100.0 * high, color=colour, alpha=0.15, lw=0.0)
        else:  # overlapping bands of a few wide intervals could not be distinguished
            reach = 100.0 * np.maximum([share - low, high - share], 0.0)
            axis.errorbar(place, 100.0 * share, reach, fmt="none", ecolor=colour, elinewidth=0.9, capsize=2.0)
    axis.set_ylim(-3.0, 103.0)
    _scales(axis, x_label, f"share of the cases, %{' (95 % confidence)' if intervals else ''}", (log, False))
    legend_above(axis, 3)
    return figure if ax is None else ax


def distribution_chart(edges: np.ndarray, counts: Mapping[str, np.ndarray], *, x_label: str, ax: Axes | None = None) -> Drawn:
    """Draw a stacked histogram between edges (n + 1,), and the cumulative fraction of all cases on a second axis.

    `counts` contains the numbers of cases (n,) for each regime; the only entry of a study without regimes has the name "".
    """
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    total = np.zeros(len(edges) - 1)
    for (name, count), look in zip(counts.items(), stacked_looks([*counts]), strict=True):
        label = f"{name}: {np.sum(count):.0f} cases" if name else None
        axis.bar(edges[:-1], count, width=np.diff(edges), align="edge", bottom=total, label=label, **look)
        total = total + count
    axis.set(ylabel="cases", xlabel=x_label)
    legend_above(axis, 3)
    share = axis.twinx()
    cumulative = 100.0 * np.concatenate([[0.0], np.cumsum(total)]) / max(np.sum(total), 1)
    share.plot(edges, cumulative, color="black", lw=1.1, ls="--", path_effects=WHITE_OUTLINE)
    share.set(ylim=(0.0, 102.0), ylabel="cases up to this value, % (dashed)")
    share.grid(False)
    return figure if ax is None else ax


def tornado_chart(
    names: list[str], low: np.ndarray, high: np.ndarray, middle: float, *, x_label: str, ax: Axes | None = None
) -> Drawn:
    """Draw bars from `middle` to `low` (n,) and from `middle` to `high` (n,), the largest difference at the top.

    Each pair of bars belongs to a parameter in `names`. `middle` is the mean of a quantity over the shown cases. `low` is its
    mean over the fifth of them with the lowest values of the parameter, `high` over the fifth with the highest.

    >>> import numpy as np
    >>> figure = tornado_chart(["a", "b"], np.array([1.0, 0.0]), np.array([3.0, 9.0]), 2.0, x_label="force, N")
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['a', 'b']
    """
    order = np.argsort(np.nan_to_num(np.abs(high - low)))
    figure, (axis,) = panels(1, size=(7.0, 0.45 * len(names) + 1.3), ax=ax)
    for height, k in enumerate(order):
        for end, colour, hatch in ((low[k], COLORS[0], ""), (high[k], COLORS[1], "///")):
            look = {"color": colour, "hatch": hatch, "edgecolor": "white", "lw": 0.0}
            axis.barh(height, end - middle, left=middle, height=0.55, **look)
    axis.axvline(middle, color="black", lw=0.8)
    axis.set_yticks(np.arange(len(names)), [names[k] for k in order])
    axis.set_xlabel(x_label)
    axis.grid(False, axis="y")
    entries = [
        Patch(color=COLORS[0], label="lowest fifth of the parameter's values"),
        Patch(facecolor=COLORS[1], hatch="///", edgecolor="white", label="highest fifth"),
    ]
    legend_above(axis, 2, handles=entries)
    return figure if ax is None else ax
