"""Common style and helpers of all figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from jaxvib.display import Onto, shown_unit
from jaxvib.errors import InputError, quoted

Look: TypeAlias = dict[str, Any]
"""Drawing style: options of matplotlib, which have various types."""

COLORS = ("#004488", "#d55e00", "#44aa99", "#e69f00", "#882255", "#88ccee", "#000000", "#b3b3b3")
"""Colours that readers with any colour vision can distinguish; neighbours in this list have different grey levels. Further
series start again with the first."""

NO_RESULT = "no result"

HATCHED: dict[str, Look] = {
    "unsettled": {"facecolor": "white", "edgecolor": "#777777", "hatch": "////", "lw": 0.0},
    NO_RESULT: {"facecolor": "#e8e8e8", "edgecolor": "#777777", "hatch": "...", "lw": 0.0},
}
"""Styles of the cells of a map that have no steady motion; the other cells have a colour without a hatch."""

_HATCHES = ("", "///", "...", "\\\\\\", "xxx", "---", "ooo")
"""Hatches that distinguish neighbouring areas in greyscale."""

_REGIME_COLORS = {
    "swinging": "#b3b3b3",
    "jammed": "#004488",
    "unbalanced": "#88ccee",
    "balanced": "#44aa99",
    "parted": "#882255",
    "unsettled": "#777777",
    "not jammed": "#b3b3b3",
    NO_RESULT: "#b3b3b3",
}
_MODE_COLORS = ("#004488", "#d55e00", "#e69f00", "#332288", "#cc79a7")
"""Colours of regimes and of jam modes 1, 2, ..., equal in all figures."""

MARKERS = "osD^vPX*"
STROKES = ("-", (0, (6, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
"""Line styles of series; with `MARKERS` they distinguish series without colours."""

WHITE_OUTLINE = [withStroke(linewidth=2.5, foreground="white")]
"""Outline of texts over curves."""

UNSTABLE = (0, (3, 2))
"""Dash pattern of unstable parts."""

GUIDE = "#8a8a8a"
"""Colour of reference lines: resonances, limits, the rotor speed."""

WORKING: Look = {"color": "black", "lw": 1.0, "ls": (0, (8, 2, 2, 2)), "zorder": 1.5}
"""Style of the line of the working speed."""

_STYLE: Any = {
    "font.size": 10.0,
    "axes.grid": True,
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.4,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.1,
    "figure.dpi": 130,
}


def color_of(k: int) -> str:
    """Return the colour of series `k`, from 0."""
    return COLORS[k % len(COLORS)]


def marker_of(k: int) -> str:
    """Return the marker of series `k`, from 0."""
    return MARKERS[k % len(MARKERS)]


def series_look(k: int) -> Look:
    """Return the colour and the line style of series `k`, from 0."""
    return {"color": color_of(k), "ls": STROKES[k % len(STROKES)]}


def resonance_lines(draw_line: Callable[..., object], speeds: np.ndarray, name: str | None = "resonance", **look: Any) -> None:
    """Draw dotted lines at `speeds` by `draw_line`, the method `axvline` or `axhline` of an axis; the first has the label."""
    for k, w in enumerate(speeds):
        draw_line(w, **{"color": GUIDE, "lw": 0.8, "ls": ":", "label": None if k else name, **look})


def label_colors(names: Sequence[str]) -> list[str]:
    """Return the colour of each label."""
    modes = [name for name in names if name.startswith("jammed, mode ")]
    own = {name: _MODE_COLORS[(int(name.rpartition(" ")[2]) - 1) % len(_MODE_COLORS)] for name in modes}
    own |= _REGIME_COLORS
    return [own.get(name, color_of(k)) for k, name in enumerate(names)]


def stacked_looks(names: Sequence[str]) -> list[Look]:
    """Return the style of stacked bars for each label."""
    bars: list[Look] = [
        {"color": colour, "hatch": _HATCHES[k % len(_HATCHES)], "edgecolor": "white", "lw": 0.0}
        for k, colour in enumerate(label_colors(names))
    ]
    return [HATCHED.get(name, bar) for name, bar in zip(names, bars, strict=True)]


def panels(
    rows: int,
    columns: int = 1,
    *,
    size: Sequence[float] = (7.0, 3.0),
    widths: Sequence[float] | None = None,
    share_x: bool | Literal["col"] = False,
    ax: Onto = None,
) -> tuple[Figure, list[Axes]]:
    """Create a figure with `rows` x `columns` axes in the common style, or use the axes `ax` and their figure.

    Axes have the `size` (width, height) in inches; `widths` are relative widths of the columns.

    **Returns** the figure and its axes. **Raises** `InputError` if `ax` are not matplotlib's axes, or if their number differs
    from that of the panels.

    >>> figure, axes = panels(2)
    >>> len(axes)
    2
    """
    if ax is not None:
        given = [ax] if isinstance(ax, Axes) else ax
        if isinstance(given, (list, tuple, np.ndarray)):  # not every sequence, because a long `range` would fill the memory
            given = list(np.ravel(np.asarray(given, dtype=object)))
        if not isinstance(given, list) or not all(isinstance(each, Axes) for each in given):
            raise InputError("ax", f"is {quoted(ax)}; give matplotlib's Axes, such as those of matplotlib.pyplot.subplots()")
        if len(given) != rows * columns:
            raise InputError("ax", f"has {len(given)} axes; this figure has {rows * columns} panels; give as many")
        return given[0].figure.figure, given
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(size[0] * columns, size[1] * rows))
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=share_x, width_ratios=None if widths is None else [*widths])
    return figure, list(grid.ravel())


_MAX_OUTER_SHARE = 0.1
"""Largest part of an outer cell beyond its position, as a share of the range of all positions."""


def cell_edges(places: np.ndarray, log: bool = False) -> np.ndarray:
    """Return the edges (n + 1,) of cells around ascending positions (n,), midway between neighbours on the drawn scale.

    The first and the last cell reach at most `_MAX_OUTER_SHARE` of the range beyond the positions, where nothing is known.

    >>> cell_edges(np.array([1.0, 3.0])).tolist(), cell_edges(np.array([1.0, 1e4]), True).round(9).tolist()
    ([0.8, 2.0, 3.2], [0.398107171, 100.0, 25118.864315096])
    """
    if log:
        return np.exp(cell_edges(np.log(places)))
    if places.size == 1:
        return places[0] + max(abs(float(places[0])), 1.0) * np.array([-0.1, 0.1])
    between = (places[:-1] + places[1:]) / 2.0
    most = _MAX_OUTER_SHARE * (places[-1] - places[0])
    low, high = (min(x, most) for x in (between[0] - places[0], places[-1] - between[-1]))
    return np.concatenate([[places[0] - low], between, [places[-1] + high]])


def log_places(low: float, high: float, max_ticks: int = 9) -> LogLocator:
    """Return the tick positions of a logarithmic axis.

    An axis of three decades or more has ticks at powers of ten, at most `max_ticks` of them. A shorter axis also has ticks
    between powers of ten.

    >>> [float(x) for x in log_places(0.4, 3.0).tick_values(0.4, 3.0) if 0.4 < x < 3.0]
    [0.5, 1.0, 2.0]
    """
    decades = math.log10(high / low)
    if decades >= 3.0:
        return LogLocator(numticks=max_ticks)
    between = (1.0, 2.0, 5.0) if decades > 0.6 else (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    return LogLocator(subs=(1.0, 3.0) if decades > 1.5 else between)


def log_ticks(axis: Axes, which: Literal["x", "y"] = "y") -> None:
    """Set the ticks of a logarithmic axis, whose limits must already be set.

    The labels are powers of ten if the axis has three decades or more and its plain numbers would be long, otherwise plain
    numbers; see `log_places` for the positions.

    >>> figure, (axis,) = panels(1)
    >>> _ = axis.set_yscale("log"), axis.set_ylim(0.4, 3.0)
    >>> log_ticks(axis)
    >>> [float(y) for y in axis.get_yticks() if 0.4 < y < 3.0]
    [0.5, 1.0, 2.0]
    """
    line = axis.xaxis if which == "x" else axis.yaxis
    low, high = line.get_view_interval()
    line.set_minor_formatter(NullFormatter())
    line.set_major_locator(log_places(low, high))
    is_short = low > 0.5e-4 and high < 1e5
    line.set_major_formatter("{x:g}" if is_short or high / low < 1e3 else LogFormatterSciNotation(labelOnlyBase=False))


def axis_unit(unit: str, *values: np.ndarray) -> tuple[str, float]:
    """Return the display unit of the axis of displacements or tilts `values` in the SI `unit`, and the factor to it.

    >>> axis_unit("m", np.array([0.02])), axis_unit("m", np.array([3e-7])), axis_unit("rad", np.ones(1))[0]
    (('mm', 1000.0), ('µm', 1000000.0), 'deg')
    """
    size = max((float(np.max(np.abs(x), initial=0.0, where=np.isfinite(x))) for x in values), default=0.0)
    shown, factor = shown_unit(unit, min(max(size, 1e-12), 0.999))
    return shown.replace("um", "µm"), factor


def legend_above(axis: Axes, columns: int = 4, **options: Any) -> None:
    """Draw the legend of a panel above it, where it covers no data; draw nothing if no series has a label."""
    _, names = axis.get_legend_handles_labels()
    if not names and "handles" not in options:
        return
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2, "columnspacing": 1.2, "handlelength": 2.2}
    axis.legend(**{**place, "ncols": columns, "frameon": False, "fontsize": "small", **options})


def load_names(count: int) -> list[str | None]:
    """Return the names of loads for a legend.

    More than eight loads, whose colours repeat, have one common label, which is attached to the first.
    """
    if count == 1:
        return ["load"]
    return [f"load {k + 1}" for k in range(count)] if count <= len(COLORS) else [f"{count} loads", *[None] * (count - 1)]


def numbered(axis: Axes, x: float, heights: Sequence[float], names: Sequence[str], filled: Sequence[bool]) -> None:
    """Draw filled or hollow points at one `x` with their names, if any, to the right; names of points that nearly touch share a
    text.

    The limits of the axes must already be set, because points outside of them are left out.
    """
    low, high = axis.get_ylim()
    inside = sorted((k for k, y in enumerate(heights) if np.isfinite(y) and low <= y <= high), key=lambda k: heights[k])
    to_share = axis.transScale + axis.transLimits
    taken = [line.get_transform().transform_path(line.get_path()) for line in axis.lines]
    for k in inside:
        axis.plot([x], [heights[k]], "o", ms=4.5, mfc="black" if filled[k] else "white", mec="black", zorder=4)
    for share, text in join_names([(float(to_share.transform((x, heights[k]))[1]), names[k]) for k in inside if names[k]]):
        place = (x, to_share.inverted().transform((0.0, share))[1])
        axis.annotate(
            text,
            place,
            xytext=_free_place(axis, place, text, taken),
            textcoords="offset points",
            va="center",
            fontsize="small",
            fontweight="bold",
            zorder=5,
            path_effects=WHITE_OUTLINE,
        )


_PLACES_BESIDE = tuple((right, up) for right in (6.0, 12.0) for up in (0.0, 7.0, -7.0, 10.0, -10.0, 13.0, -13.0))
"""Places of the left end of a text beside its point, in points, the best one first."""


def _free_place(axis: Axes, place: tuple[float, float], text: str, taken: list[Path]) -> tuple[float, float]:
    """Return the first place beside a point at which a small text crosses as few of the `taken` paths, in pixels, as possible,
    and add the outline of the text to them."""
    pixels = axis.figure.dpi / 72.0
    x, y = axis.transData.transform(place)

    def box_at(beside: tuple[float, float]) -> Bbox:
        left, middle = x + pixels * (beside[0] - 1.0), y + pixels * beside[1]
        return Bbox.from_bounds(left, middle - 4.5 * pixels, (5.5 * len(text) + 2.0) * pixels, 9.0 * pixels)

    def crossed(beside: tuple[float, float]) -> int:
        box = box_at(beside)
        outside = not axis.bbox.y0 <= box.y0 < box.y1 <= axis.bbox.y1
        return sum(path.intersects_bbox(box, filled=False) for path in taken) + outside

    best = min(_PLACES_BESIDE, key=crossed)
    taken.append(Path(box_at(best).corners()[[0, 1, 3, 2, 0]]))
    return best


def join_names(named: Sequence[tuple[float, str]]) -> list[tuple[float, str]]:
    """Join names that would overlap; their heights, in ascending order, are fractions of the height of the panel.

    A joined text is placed at the mean height of its names.

    >>> join_names([(0.1, "1"), (0.5, "4"), (0.52, "3")])
    [(0.1, '1'), (0.51, '3, 4')]
    """
    groups: list[list[tuple[float, str]]] = []
    for share, name in named:
        # A name joins a group if it is near the last name and not far from the first one. The second condition is needed
        # because the text of the group is placed at the mean height.
        first, last = (groups[-1][0][0], groups[-1][-1][0]) if groups else (-1.0, -1.0)
        near = share - last < 0.045 and share - first < 0.09
        groups = [*groups[:-1], [*groups[-1], (share, name)]] if near else [*groups, [(share, name)]]
    return [(sum(share for share, _ in group) / len(group), ", ".join(sorted({name for _, name in group}))) for group in groups]


def legend_outside(figure: Figure, axes: Sequence[Axes], columns: int, **options: Any) -> None:
    """Draw a common legend of several panels above the figure, with each name once."""
    named = {name: handle for axis in axes for handle, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(
        [*named.values()], [*named], loc="outside upper left", ncols=columns, frameon=False, fontsize="small", **options
    )
