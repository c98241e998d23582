"""Charts of plain arrays: branch diagrams, comparisons of two designs, convergence, Pareto fronts, regimes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import (
    COLORS,
    GUIDE,
    MARKERS,
    UNSTABLE,
    WORKING,
    Look,
    axis_unit,
    legend_above,
    legend_outside,
    log_ticks,
    numbered,
    panels,
    resonance_lines,
    stacked_looks,
)
from jaxvib.errors import InputError, quoted

PARTS = ("speed", "amplitude", "force")
"""Names of the panels of a branch diagram over the rotor speed."""


def branch_diagram(
    rotor_speed: np.ndarray,
    omega: np.ndarray,
    stable: np.ndarray,
    *,
    amplitude: np.ndarray,
    force: np.ndarray,
    resonances: np.ndarray,
    modes: np.ndarray | None = None,
    marks: Sequence[tuple[str, np.ndarray, np.ndarray]] = (),
    names: Sequence[str],
    units: Sequence[str] | None = None,
    at: float | None = None,
    unit: SpeedUnit | None = None,
    stability_text: str = "",
    show: Sequence[str] = PARTS,
    linear: bool = False,
    ax: Onto = None,
) -> Drawn:
    """Draw load speed, amplitudes and foundation force, both zero to peak, over the rotor speed, a panel for each.

    Stable parts are solid lines, unstable parts dashed. If there are more than two coordinates, each has a separate panel.

    **Arguments** (n points, nd coordinates)

    - `rotor_speed` (n,), `omega` (n,): rotor speed and load speed, rad/s, drawn in `unit`
    - `stable` (n,): True if stable; `stability_text`: how stability is determined, written below the figure
    - `amplitude` (n, nd): amplitudes, m (drawn in mm or µm) or rad (drawn in deg)
    - `units` (nd,): "m" or "rad" for each coordinate; None: all m
    - `force` (n,): foundation force, N
    - `resonances`: resonances, rad/s, drawn as horizontal lines
    - `modes` (n,): numbers of the jam modes, written on the line of the working speed
    - `marks`: points, each (label, rotor speeds, load speeds), rad/s
    - `names` (nd,): names of the coordinates
    - `at`: working speed, rad/s, drawn as a vertical line
    - `show`: panels to draw, some of `PARTS`
    - `linear`: True for linear axes of amplitudes and force, False for logarithmic ones
    """
    unit, scale = speed_unit(unit)
    if not show or any(part not in PARTS for part in show):
        raise InputError("show", f"is {quoted(tuple(show))}; it names some of: {', '.join(PARTS)}")
    rows = _branch_rows(show, (unit, scale * omega), amplitude, force, names, units)
    columns = len(rows) if ax is not None else min(3, len(rows))
    figure, axes = panels(-(-len(rows) // columns), columns, size=(3.7, 3.5), ax=ax)
    for empty in axes[len(rows) :]:
        empty.set_axis_off()
    n = scale * rotor_speed
    high = float(np.max(n[np.isfinite(n)]))
    crossed = crossings(rotor_speed, stable, modes, at)
    for axis, (title, label, group) in zip(axes, rows, strict=False):
        for j, (name, values) in enumerate(group):
            label_and_marker = (name, MARKERS[j]) if len(group) > 1 else (None, "")
            solid_and_dashed(axis, n, values, stable, COLORS[j], *label_and_marker)
        axis.plot([], [], color="black", label="stable")
        axis.plot([], [], color="black", ls=UNSTABLE, label="unstable")
        axis.set(xlim=(0.0, high), xlabel="rotor speed, " + unit)
        if ax is None:
            axis.set_ylabel(label)
            axis.set_title(title, loc="left", fontsize="medium")
        else:  # the legend is above the caller's axes
            axis.set_ylabel(f"{title}, {label}")
        if title == _SPEED_TITLE:
            _speed_lines(axis, scale, resonances, marks, high)
        elif linear:
            shown = np.stack([values[np.isfinite(rotor_speed)] for _, values in group])
            axis.set_ylim(0.0, 1.08 * float(np.max(shown, initial=1e-300, where=np.isfinite(shown))))
        else:
            axis.set(yscale="log", ylim=log_limits([values for _, values in group], rotor_speed, omega, resonances))
            log_ticks(axis)
        if at is not None:
            _working_line(axis, scale * at, crossed, [values for _, values in group])
    if ax is None:
        legend_outside(figure, axes, 4 if columns > 1 else 2)
    else:
        legend_above(axes[0], 2)
    if stability_text and ax is None:
        figure.supxlabel(f"stable {stability_text}", fontsize="small", color="#555555")
    return figure if ax is None else ax


def _working_line(axis: Axes, at: float, crossed: list[tuple[int, float, str, bool]], curves: Sequence[np.ndarray]) -> None:
    """Draw the line of the working speed, with the numbers of the jams where it crosses the curves, see `crossings`."""
    axis.axvline(at, label="working speed; numbers: jam modes", **WORKING)
    points = []
    for i, share, number, filled in crossed:
        heights = [float(np.interp(share, [0, 1], values[i : i + 2])) for values in curves]
        points += [(y, number if y == max(heights) else "", filled) for y in heights]
    if points:
        numbered(axis, at, *zip(*points, strict=True))


_SPEED_TITLE = "load speed"


def _branch_rows(
    show: Sequence[str],
    speed: tuple[str, np.ndarray],
    amplitude: np.ndarray,
    force: np.ndarray,
    names: Sequence[str],
    units: Sequence[str] | None,
) -> list[tuple[str, str, list[tuple[str, np.ndarray]]]]:
    """Return the title, the label and the named curves of each panel; more than two coordinates have a panel each."""
    labels, scaled = scaled_amplitudes(amplitude, names, units)
    rows: list[tuple[str, str, list[tuple[str, np.ndarray]]]] = []
    for part in show:
        if part == "speed":
            rows.append((_SPEED_TITLE, speed[0], [("loads", speed[1])]))
        elif part == "force":
            rows.append(("foundation force, zero to peak", "N", [("force", force)]))
        elif len(names) > 2:
            each = zip(labels, scaled, strict=True)
            rows += [(f"amplitude of {curve[0]}, zero to peak", label, [curve]) for label, curve in each]
        else:
            label = ", ".join(dict.fromkeys(labels))
            named = [
                (f"{name}, {each}" if len(set(labels)) > 1 else name, y) for each, (name, y) in zip(labels, scaled, strict=True)
            ]
            rows.append(("amplitude, zero to peak", label, named))
    return rows


def scaled_amplitudes(
    amplitude: np.ndarray, names: Sequence[str], units: Sequence[str] | None
) -> tuple[list[str], list[tuple[str, np.ndarray]]]:
    """Return the display unit of each coordinate, and its name with its amplitudes (n,) in this unit.

    **Arguments**: `amplitude` (n, nd), m or rad; `names` (nd,) of the coordinates; `units` (nd,), "m" or "rad"; None: all m.

    >>> scaled_amplitudes(np.array([[0.01, np.pi]]), ("y1", "tilt"), ("m", "rad"))
    (['mm', 'deg'], [('y1', array([10.])), ('tilt', array([180.]))])
    """
    tilts = np.asarray([units is not None and each == "rad" for each in units or names])
    length, tilt = axis_unit("m", amplitude[:, ~tilts]), axis_unit("rad", amplitude[:, tilts])
    kinds = [tilt if each else length for each in tilts]
    scaled = [(name, factor * amplitude[:, k]) for k, (name, (_, factor)) in enumerate(zip(names, kinds, strict=True))]
    return [unit for unit, _ in kinds], scaled


def log_limits(
    curves: Sequence[np.ndarray], rotor_speed: np.ndarray, omega: np.ndarray, resonances: np.ndarray
) -> tuple[float, float]:
    """Return the limits of a logarithmic axis; the lower one follows from the curves at load speeds above half the lowest
    resonance.

    At lower load speeds the loads turn with the rotor, and the curves approach zero.
    """
    exists = np.isfinite(rotor_speed)
    shown = np.stack([values[exists] for values in curves])
    top = float(np.max(shown, initial=1e-300, where=np.isfinite(shown)))
    lowest = float(np.min(resonances, initial=np.inf, where=resonances > 0.0))
    included = np.isfinite(shown) & (shown > 0.0) & (omega[exists] > 0.5 * lowest)
    least = float(np.min(shown, initial=top, where=included))
    return float(np.clip(0.5 * least, 1e-5 * top, 1e-2 * top)), 2.5 * top


def _speed_lines(
    axis: Axes, scale: float, resonances: np.ndarray, marks: Sequence[tuple[str, np.ndarray, np.ndarray]], high: float
) -> None:
    """Draw resonances, the line of equal rotor and load speeds, and marks in the panel of load speeds."""
    resonance_lines(axis.axhline, scale * resonances)
    axis.plot([0.0, high], [0.0, high], color=GUIDE, lw=0.8, label="rotor speed", zorder=1.0)
    for (label, x, y), shape in zip(marks, itertools.cycle("osD^vPX"), strict=False):
        axis.plot(scale * x, scale * y, shape, ms=5.0, mfc="white", mec=COLORS[1], mew=1.2, label=label, ls="", zorder=3)
    axis.set_ylim(0.0, 1.06 * high)


def crossings(
    rotor_speed: np.ndarray, stable: np.ndarray, modes: np.ndarray | None, at: float | None
) -> list[tuple[int, float, str, bool]]:
    """Return the intersections of a branch with the rotor speed `at`.

    Each is a tuple (index of the point before it, fraction of the distance to the next point, number of the mode, True if it is
    stable).
    """
    if at is None:
        return []
    gap = rotor_speed - at
    with np.errstate(invalid="ignore"):
        places = np.flatnonzero((gap[:-1] * gap[1:] < 0.0) | (gap[:-1] == 0.0))
    found = []
    for i in places:
        if np.isfinite(gap[i]) and np.isfinite(gap[i + 1]):
            number = "" if modes is None else str(int(modes[i]))
            found.append((int(i), float(gap[i] / (gap[i] - gap[i + 1])) if gap[i] else 0.0, number, bool(stable[i])))
    return found


def solid_and_dashed(
    axis: Axes,
    x: np.ndarray,
    y: np.ndarray,
    stable: np.ndarray,
    color: str,
    label: str | None = None,
    marker: str = "",
    *,
    widths: tuple[float, float] = (1.5, 1.2),
) -> None:
    """Draw a line as segments, solid where it is `stable` and dashed elsewhere; neighbouring segments share a point.

    `widths` are those of solid and dashed segments. With a `marker`, a few markers distinguish the line without colour.
    """
    labelled = False
    for along, solid in segments(stable):
        if not np.any(np.isfinite(x[along]) & np.isfinite(y[along])):
            continue  # matplotlib cannot distribute markers on a line without points
        name = label if solid and not labelled else None
        labelled = labelled or solid
        style, width = ("-", widths[0]) if solid else (UNSTABLE, widths[1])
        # Few markers on dashed segments, which otherwise look like solid ones.
        sparse = {"marker": marker, "markevery": 0.15 if solid else 0.3, "ms": 3.5, "mfc": "white"} if marker else {}
        axis.plot(x[along], y[along], color=color, ls=style, lw=width, label=name, **sparse)


def segments(stable: np.ndarray) -> list[tuple[slice, bool]]:
    """Return the segments of a line with their stability (True if stable); neighbouring segments share a point.

    >>> segments(np.array([True, True, False]))
    [(slice(0, 3, None), True), (slice(2, 3, None), False)]
    """
    cuts = (np.flatnonzero(stable[1:] != stable[:-1]) + 1).tolist()
    stops = [*(cut + 1 for cut in cuts), len(stable)]
    return [(slice(start, stop), bool(stable[start])) for start, stop in zip([0, *cuts], stops, strict=True)]


def before_after(rows: Sequence[tuple[str, float, float]], *, title: str = "", ax: Axes | None = None) -> Drawn:
    """Draw, for each (name, before, after), a bar from 1 to after/before on a logarithmic axis, with both values beside it.

    A quantity without a finite, positive ratio has no bar, only its values.
    """
    figure, (axis,) = panels(1, size=(9.0, 0.42 * len(rows) + 1.5), ax=ax)
    ratios = np.asarray([after / before if before else np.nan for _, before, after in rows])
    has_bar = np.isfinite(ratios) & (ratios > 0.0)
    places = np.arange(len(rows))[::-1]
    # Bars of ratios beyond these limits are cut off; otherwise all other bars would be as thin as lines.
    low, high = max(min([0.7, *ratios[has_bar]]), 1e-4), min(max([1.4, *ratios[has_bar]]), 1e4)
    for place, ratio, is_drawn, (_, before, after) in zip(places, ratios, has_bar, rows, strict=True):
        look: Look = {"color": COLORS[0]} if ratio <= 1.0 else {"color": COLORS[3], "hatch": "///", "edgecolor": "white"}
        if is_drawn:
            axis.barh(place, ratio - 1.0, left=1.0, height=0.6, lw=0.0, **look)
        share = f"   ({ratio:.3g} x)" if is_drawn else ""
        text = f"{before:.4g} → {after:.4g}{share}"
        axis.text(1.02, place, text, va="center", fontsize=9, transform=axis.get_yaxis_transform())
    axis.axvline(1.0, color="black", lw=0.9)
    axis.set(xscale="log", xlim=(low**1.1, high**1.1), ylim=(-0.6, len(rows) - 0.4))
    axis.set_yticks(places, [name for name, _, _ in rows])
    log_ticks(axis, "x")
    strokes = ", strokes peak to peak" if any("stroke" in name for name, _, _ in rows) else ""
    axis.set_xlabel(f"after / before; amplitudes and forces zero to peak{strokes}")
    axis.text(1.02, 1.0, "before → after", va="bottom", fontsize=9, fontweight="bold", transform=axis.transAxes)
    if title:
        axis.set_title(title, loc="left", pad=24.0, fontsize="medium")
    axis.grid(False, axis="y")
    less, more = Patch(color=COLORS[0]), Patch(facecolor=COLORS[3], hatch="///", edgecolor="white", lw=0.0)
    # The legend ends at the axis, whose width depends on the names: the header of the values stands to the right of it.
    names = ["less than before", "more than before"]
    legend_above(axis, handles=[less, more], labels=names, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure if ax is None else ax


def convergence(history: np.ndarray, is_met: np.ndarray, *, best: int, label: str, ax: Axes | None = None) -> Drawn:
    """Draw the objective of every start (iterations, starts) over the iterations, with the start of index `best` in bold where
    `is_met`, True (iterations, starts) for designs that meet the demands; elsewhere it is dashed."""
    figure, (axis,) = panels(1, size=(7.0, 3.6), ax=ax)
    axis.plot(history, color=GUIDE, lw=0.5, alpha=0.5)
    axis.plot([], [], color=GUIDE, lw=0.8, label="other starts")
    value, met = history[:, best], is_met[:, best]
    axis.plot(np.where(met, value, np.nan), color=COLORS[1], lw=2.0, label="best start")
    if not np.all(met):
        axis.plot(value, color=COLORS[1], lw=1.0, ls="--", label="best start while it violates demands")
    if np.nanmin(history) > 0.0:
        axis.set_yscale("log")
        log_ticks(axis)
    axis.set(xlabel="iteration (descent, then polishing)", ylabel=label)
    legend_above(axis)
    return figure if ax is None else ax


def front_chart(x: np.ndarray, y: np.ndarray, *, x_label: str, y_label: str, ax: Axes | None = None) -> Drawn:
    """Draw a Pareto front: P points, each with its number, of two minimized quantities `x` (P,) and `y` (P,)."""
    figure, (axis,) = panels(1, size=(6.5, 4.4), ax=ax)
    order = np.lexsort((y, x))
    axis.plot(x[order], y[order], "o-", color=COLORS[0], mfc="white", ms=5.0, label="front; numbers: its machines")
    for k, point in enumerate(zip(x, y, strict=True)):
        axis.annotate(f"{k}", point, xytext=(5, 4), textcoords="offset points", fontsize="small")
    axis.margins(0.08)
    axis.set(xlabel=x_label, ylabel=y_label)
    legend_above(axis)
    return figure if ax is None else ax


def regime_chart(
    drag: np.ndarray,
    shares: Mapping[str, np.ndarray],
    omega: np.ndarray,
    rotor_speed: float,
    *,
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw the shares of regimes as stacked bars, and the load speeds, over the drag of the loads.

    **Arguments** (n drags)

    - `drag` (n,), N s/m
    - `shares`: for each regime, the fraction (n,) of the starts that end in it
    - `omega` (n, starts), `rotor_speed`: load speed of each start and rotor speed, rad/s, drawn in `unit`
    """
    figure, (top, bottom) = panels(2, size=(7.5, 2.8), share_x=True, ax=ax)
    unit, scale = speed_unit(unit)
    # Bars of a few, distant values are narrow: they must not look like statements about the values between them.
    width = min(0.9 * np.min(np.diff(np.log(drag))), 0.06 * np.log(drag[-1] / drag[0])) if len(drag) > 1 else 0.1
    low = np.zeros(len(drag))
    for (kind, share), look in zip(shares.items(), stacked_looks([*shares]), strict=True):
        top.bar(drag, 100.0 * share, bottom=low, width=drag * width, label=kind, **look)
        low = low + 100.0 * share
    top.set(ylabel="share of the starts, %", ylim=(0.0, 100.0))
    legend_above(top, 4)
    bottom.plot(
        np.repeat(drag, omega.shape[1]),
        scale * omega.ravel(),
        ".",
        color=COLORS[0],
        ms=4.0,
        alpha=0.6,
        label="loads, each start",
    )
    bottom.axhline(scale * rotor_speed, color="black", lw=1.0, ls="--", label="rotor")
    bottom.set(ylabel=f"load speed, {unit}", xlabel="drag, N s/m", xscale="log")
    log_ticks(bottom, "x")
    between, share = np.diff(np.log(drag)), 1.0 / 12.0  # the width of a label, relative to the axis
    if len(drag) < 2 or np.min(between) > share * np.sum(between):
        bottom.set_xticks(drag, [f"{value:.3g}" for value in drag])
    legend_above(bottom)
    return figure if ax is None else ax
