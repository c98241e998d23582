"""Charts of many cases: maps of labels and of values, fractions with uncertainty, distributions, sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxvib.draw.style import COLORS, Drawn, log_ticks, panels

_NO_ANSWER_COLOR = "#f4f4f4"
"""Background colour of a map, which is visible for cases without a result."""

_DASHES = {"fold": "-", "torus": "--", "period doubling": "-.", "symmetry": ":"}


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

    >>> import numpy as np
    >>> figure = label_map(np.arange(2.0), np.arange(3.0), np.eye(3, 2, dtype=int), ["a", "b"], x_label="x", y_label="y")
    >>> figure.axes[0].get_xlabel()
    'x'
    """
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    there = [k for k in range(len(names)) if np.any(codes == k)]
    place = np.full(len(names) + 1, -1)
    place[there] = np.arange(len(there))
    colours = [_NO_ANSWER_COLOR, *(_light(COLORS[k % len(COLORS)]) for k in range(len(there)))]
    norm = BoundaryNorm(np.arange(-1, len(there) + 1) - 0.5, len(colours))
    axis.pcolormesh(x, y, place[codes], cmap=ListedColormap(colours), norm=norm, shading="nearest", rasterized=True)
    entries: list[Patch | Line2D] = [Patch(color=colours[k + 1], label=names[which]) for k, which in enumerate(there)]
    if np.any(codes < 0):
        entries.append(Patch(color=_NO_ANSWER_COLOR, label="no result"))
    edges = axis.get_xlim(), axis.get_ylim()
    for kind, parts in (lines or {}).items():
        dashes = _DASHES.get(kind, ":")
        for xs, ys in parts:
            axis.plot(xs, ys, color="black", lw=1.1, ls=dashes, marker="." if len(xs) == 1 else None)
        if parts:
            entries.append(Line2D([], [], color="black", lw=1.1, ls=dashes, label=f"{kind} bifurcations of exact jams"))
    axis.set_xlim(edges[0])
    axis.set_ylim(edges[1])
    _scales(axis, x_label, y_label, log)
    axis.grid(False)
    axis.legend(handles=entries, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small")
    return figure if ax is None else ax


def _light(colour: str) -> tuple[float, float, float]:
    """Return the colour mixed with white, which makes black lines on it visible."""
    red, green, blue = (int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return 0.55 * red + 0.45, 0.55 * green + 0.45, 0.55 * blue + 0.45


def _scales(axis: Axes, x_label: str, y_label: str, log: tuple[bool, bool]) -> None:
    axis.set_xlabel(x_label)
    axis.set_ylabel(y_label)
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
    """Draw a map over x (n,) and y (m,), coloured by values (m, n); NaN is grey.

    >>> import numpy as np
    >>> len(value_map(np.arange(2.0), np.arange(3.0), np.ones((3, 2)), x_label="x", y_label="y", label="z").axes)
    2
    """
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    axis.set_facecolor("#dddddd")
    drawn = axis.pcolormesh(x, y, values, cmap="viridis", shading="nearest", rasterized=True)
    figure.colorbar(drawn, ax=axis, label=label)
    _scales(axis, x_label, y_label, log)
    axis.grid(False)
    return figure if ax is None else ax


def points_over(
    x: np.ndarray, values: np.ndarray, *, x_label: str, y_label: str, log: bool = False, ax: Axes | None = None
) -> Drawn:
    """Draw values (n, k) as points over x (n,).

    >>> import numpy as np
    >>> points_over(np.arange(3.0), np.ones((3, 2)), x_label="x", y_label="y").axes[0].get_ylabel()
    'y'
    """
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    for k in range(values.shape[1]):
        axis.plot(x, values[:, k], ".", color=COLORS[k % len(COLORS)], ms=4.0)
    _scales(axis, x_label, y_label, (log, False))
    return figure if ax is None else ax


def shares_chart(
    x: np.ndarray,
    shares: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    *,
    x_label: str,
    log: bool = False,
    level: str = "95 %",
    ax: Axes | None = None,
) -> Drawn:
    """Draw fractions (n,) over x (n,) by name, each with its confidence interval as a band.

    `shares` contains the fraction, the lower end and the upper end of its interval, of the confidence `level`.

    >>> import numpy as np
    >>> share = np.array([0.1, 0.5])
    >>> len(shares_chart(np.arange(2.0), {"mode 3": (share, share - 0.1, share + 0.1)}, x_label="x").axes[0].lines)
    1
    """
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    for k, (name, (share, low, high)) in enumerate(shares.items()):
        colour = COLORS[k % len(COLORS)]
        axis.fill_between(x, low, high, color=colour, alpha=0.25, lw=0.0)
        axis.plot(x, share, color=colour, marker=".", ms=4.0, lw=1.0, label=name)
    axis.set_ylim(-0.03, 1.03)
    _scales(axis, x_label, f"fraction of the cases (band: {level} confidence)", (log, False))
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small")
    return figure if ax is None else ax


def distribution_chart(edges: np.ndarray, counts: np.ndarray, *, x_label: str, ax: Axes | None = None) -> Drawn:
    """Draw a histogram of `counts` (n,) between edges (n + 1,), and the cumulative fraction on a second axis.

    >>> import numpy as np
    >>> distribution_chart(np.arange(4.0), np.ones(3), x_label="force, N").axes[0].get_xlabel()
    'force, N'
    """
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    axis.bar(edges[:-1], counts, width=np.diff(edges), align="edge", color=COLORS[0], alpha=0.55)
    axis.set_ylabel("cases")
    axis.set_xlabel(x_label)
    share = axis.twinx()
    share.plot(edges, np.concatenate([[0.0], np.cumsum(counts)]) / max(np.sum(counts), 1), color=COLORS[1])
    share.set_ylim(0.0, 1.02)
    share.set_ylabel("cumulative fraction", color=COLORS[1])
    share.grid(False)
    return figure if ax is None else ax


def tornado_chart(
    names: list[str], low: np.ndarray, high: np.ndarray, middle: float, *, x_label: str, ax: Axes | None = None
) -> Drawn:
    """Draw bars from `low` (n,) to `high` (n,) about `middle`, the longest at the top.

    They are values of a quantity for the lowest and the highest fifth of the values of each parameter in `names`.

    >>> import numpy as np
    >>> figure = tornado_chart(["a", "b"], np.array([1.0, 0.0]), np.array([3.0, 9.0]), 2.0, x_label="force, N")
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['a', 'b']
    """
    order = np.argsort(np.nan_to_num(np.abs(high - low)))
    figure, (axis,) = panels(1, size=(7.0, 0.45 * len(names) + 1.3), ax=ax)
    for height, k in enumerate(order):
        for end, colour in ((low[k], COLORS[0]), (high[k], COLORS[1])):
            axis.barh(height, end - middle, left=middle, color=colour, height=0.55, alpha=0.8)
    axis.axvline(middle, color="black", lw=0.8)
    axis.set_yticks(np.arange(len(names)), [names[k] for k in order])
    axis.set_xlabel(x_label)
    axis.grid(False, axis="y")
    entries = [Patch(color=COLORS[0], label="lowest fifth"), Patch(color=COLORS[1], label="highest fifth")]
    axis.legend(handles=entries, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize="small")
    return figure if ax is None else ax
