"""Small charts of plain arrays: modes, phases, drag, speeds, signals, multipliers, growth rates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FormatStrFormatter, NullFormatter

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.charts import scaled_amplitudes, solid_and_dashed
from jaxvib.draw.style import (
    COLORS,
    GUIDE,
    UNSTABLE,
    WORKING,
    Look,
    color_of,
    legend_above,
    log_places,
    log_ticks,
    marker_of,
    panels,
    resonance_lines,
    series_look,
)


def modes_chart(
    mode: np.ndarray,
    omega: np.ndarray,
    stable: np.ndarray,
    amplitude: np.ndarray,
    resonances: np.ndarray | None = None,
    *,
    names: Sequence[str],
    units: Sequence[str] | None = None,
    stable_label: str = "stable by slope",
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw load speeds and amplitudes against the number of the jam mode; markers are filled for stable modes.

    **Arguments**

    - `mode` (k,): numbers of the modes
    - `omega` (k,): load speeds, rad/s, drawn in `unit`
    - `stable` (k,): True for stable modes, which the legend calls `stable_label`
    - `amplitude` (k, nd): amplitudes, m, drawn in mm or µm (tilts: rad, drawn in deg), with a marker and a colour for each
      coordinate
    - `resonances`: resonances, rad/s, drawn as horizontal lines
    - `names`, `units` (nd,): names of the coordinates and their units, "m" or "rad"; `units` None: all m
    """
    unit, scale = speed_unit(unit)
    figure, (top, bottom) = panels(2, size=(6.0, 2.6), share_x=True, ax=ax)
    labels, scaled = scaled_amplitudes(amplitude, names, units)
    shown = np.stack([values for _, values in scaled], axis=1)
    for axis, values in ((top, scale * omega[:, None]), (bottom, shown)):
        for k in range(values.shape[1]):
            color, mark = color_of(k), marker_of(k)
            for kind, face in ((stable, color), (~stable, "white")):
                axis.plot(mode[kind], values[kind, k], mark, mfc=face, mec=color)
    for k, name in enumerate(names):
        label = f"{name}, {labels[k]}" if len(set(labels)) > 1 else name
        bottom.plot([], [], marker_of(k), color=color_of(k), label=label)
    legend_above(bottom, 6)
    if resonances is not None:
        resonance_lines(top.axhline, scale * resonances)
    top.plot([], [], "o", color="black", label=stable_label)
    top.plot([], [], "o", color="black", mfc="white", label="unstable")
    legend_above(top)
    top.set_ylabel(f"load speed, {unit}")
    bottom.set(ylabel=f"amplitude, {', '.join(dict.fromkeys(labels))}, zero to peak", xlabel="number of the jam mode")
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    if shown.size:
        bottom.set(yscale="log", ylim=(0.6 * np.min(shown), 1.7 * np.max(shown)))
        log_ticks(bottom)
    existing = mode[np.isfinite(omega)]
    bottom.set_xticks(existing)
    if existing.size:
        bottom.set_xlim(np.min(existing) - 0.5, np.max(existing) + 0.5)
    return figure if ax is None else ax


def shapes_chart(
    frequency: np.ndarray, shape: np.ndarray, *, names: Sequence[str], unit: SpeedUnit | None = None, ax: Axes | None = None
) -> Drawn:
    """Draw mode shapes (k, nd) as bars, a group for each mode, labelled with its frequency (k,) rad/s, drawn in `unit`.

    `names` (nd,) are those of the coordinates.

    >>> import numpy as np
    >>> shapes_chart(np.array([10.0]), np.ones((1, 2)), names=("y1", "y2")).axes[0].get_xticklabels()[0].get_text()
    '95.49 rpm'
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(max(5.0, 1.4 * len(frequency)), 3.4), ax=ax)
    count, width = len(names), 0.8 / len(names)
    for k, name in enumerate(names):
        places = np.arange(len(frequency)) + (k - 0.5 * (count - 1)) * width
        look: Look = {
            "color": color_of(k),
            "hatch": ("", "///", "...", "xxx")[k % 4],
            "edgecolor": "white",
            "lw": 0.0,
        }
        axis.bar(places, shape[:, k], width=0.94 * width, label=name, **look)
    axis.axhline(0.0, color="black", lw=0.9)
    axis.set_xticks(range(len(frequency)), [f"{scale * w:.4g} {unit}" for w in frequency])
    axis.set(ylim=(-1.1, 1.1), ylabel="mode shape, relative")
    axis.grid(False, axis="x")
    legend_above(axis, 6)
    return figure if ax is None else ax


def phase_circles(
    sets: Sequence[tuple[str, np.ndarray]],
    *,
    weights: np.ndarray | None = None,
    imbalance: complex = 0.0,
    ax: Onto = None,
) -> Drawn:
    """Draw angles of loads (count,) rad as points on a circle, one circle for each (title, angles).

    A black arrow shows the mean of the unit vectors to the loads. Its length is 1 if all loads coincide, and 0 if they cancel.
    `weights` and `imbalance`: see `draw_circle`. `ax` must contain one axes object for each circle.
    """
    columns = max(len(sets), 1) if ax is not None else min(max(len(sets), 1), 4)
    rows = 1 if ax is not None else -(-max(len(sets), 1) // columns)
    figure, axes = panels(rows, columns, size=(3.2, 3.2), ax=ax)
    for k, axis in enumerate(axes):
        axis.set_axis_off()
        if k < len(sets):
            draw_circle(axis, *sets[k], weights=weights, imbalance=imbalance)
    return figure if ax is None else ax


def draw_circle(
    axis: Axes,
    title: str,
    angles: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    imbalance: complex = 0.0,
    resultant: bool = True,
    numbers: np.ndarray | None = None,
    plural: str = "loads",
) -> None:
    """Draw angles (count,) rad as points on a circle, with arrows, see `phase_circles`.

    `weights` (count,), whose sum is 1, are those of the mean; default: equal ones. An orange arrow shows the `imbalance` of the
    rotor, relative to the unbalance of all loads at one angle. `numbers` (count,) of the loads, from 0; default: 0, 1, ...
    `resultant`: False for masses that turn in different directions, whose mean has no meaning. `plural`: name of the points,
    for the label of many at one angle.
    """
    axis.set(aspect="equal", xlim=(-1.6, 1.6), ylim=(-1.35, 1.35))
    axis.set_axis_off()
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    axis.plot(np.cos(turn), np.sin(turn), color=GUIDE, lw=0.9)
    for degrees in range(0, 360, 45):
        e = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        tick = np.outer(e, [0.96, 1.04])
        axis.plot(tick[0], tick[1], color=GUIDE, lw=0.9)
        is_free = np.all(np.abs(np.exp(1j * angles) - complex(*e)) > 0.3)  # no load is near the label
        if degrees % 90 == 0 and is_free:
            side = {0: "right", 180: "left"}.get(degrees, "center")
            look: Look = {"ha": side, "va": "center", "fontsize": "x-small", "color": "#555555"}
            axis.text(0.88 * float(e[0]), 0.88 * float(e[1]), f"{degrees}°", **look)
    _loads_on_circle(axis, angles, np.arange(angles.size) if numbers is None else numbers, plural)
    mean = np.average(np.exp(1j * angles), weights=weights) if angles.size else 0.0
    for value, color in ((mean, "black"), (imbalance, COLORS[1])) if resultant else ():
        if abs(value) > 0.02:
            arrow = {"arrowstyle": "-|>", "lw": 1.6, "color": color, "shrinkA": 0.0, "shrinkB": 0.0}
            axis.annotate("", (np.real(value), np.imag(value)), (0.0, 0.0), arrowprops=arrow)
    axis.plot([0.0], [0.0], "+", color="black", ms=7.0)
    text = f"\n{_resultant_text(mean, imbalance)}" if resultant else ""
    axis.set_title(f"{title}{text}", fontsize="medium")


def _resultant_text(mean: complex, imbalance: complex) -> str:
    """Return the lengths of the arrows as text: of the loads, of the rotor's imbalance and of their sum."""
    loads, rotor, rest = (f"{round(round(float(abs(value)), 9), 3):g}" for value in (mean, imbalance, mean + imbalance))
    return f"loads {loads}, rotor {rotor} (orange), sum {rest}" if abs(imbalance) > 0.02 else f"resultant {loads}"


_SIDES, _ENDS = ("right", "left"), ("top", "bottom")
"""Alignments of a text on the left and on the right of a circle, and below and above it."""


def _loads_on_circle(axis: Axes, angles: np.ndarray, numbers: np.ndarray, plural: str) -> None:
    """Draw loads as points with their numbers; loads at the same angle share a label."""
    order = np.argsort(np.mod(angles + 1e-6, 2.0 * np.pi))
    groups: list[list[int]] = []
    for k in order:
        near = groups and abs(np.exp(1j * angles[k]) - np.exp(1j * angles[groups[-1][-1]])) < 0.12
        groups = [*groups[:-1], [*groups[-1], int(k)]] if near else [*groups, [int(k)]]
    for group in groups:
        for j in group:
            look = {"mfc": color_of(numbers[j]), "mec": "black", "ms": 9.0, "zorder": 3 + 0.01 * j}
            axis.plot([np.cos(angles[j])], [np.sin(angles[j])], marker_of(numbers[j]), **look)
        e = np.mean(np.exp(1j * angles[group]))
        names = ", ".join(str(j + 1) for j in sorted(numbers[group])) if len(group) < 5 else f"{len(group)} {plural}"
        x, y = 1.15 * np.real(e / abs(e)), 1.15 * np.imag(e / abs(e))
        # The text begins at the point and extends away from the circle.
        across, up = (("center" if abs(v) < 0.5 else names_of[int(v > 0.0)]) for v, names_of in ((x, _SIDES), (y, _ENDS)))
        axis.text(float(x), float(y), names, ha=across, va=up, fontsize="small", zorder=4)


def speeds_chart(
    rows: Sequence[tuple[str, np.ndarray]],
    spans: Sequence[tuple[str, np.ndarray]] = (),
    *,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw speeds as labelled points, and below them intervals of speeds as bars, one row for each label.

    `rows` contains (label, speeds (n,)), `spans` (label, intervals (n, 2)), in rad/s, drawn in `unit`. Speeds that are not
    finite are left out. An interval with an infinite end extends to the edge.

    >>> import numpy as np
    >>> figure = speeds_chart([("resonances", np.array([1.0, np.nan]))], [("balancing", np.array([[1.0, np.inf]]))])
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['balancing', 'resonances']
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.0, 0.55 * (len(rows) + len(spans)) + 1.0), ax=ax)
    values = scale * np.concatenate([np.ravel(x) for _, x in (*rows, *spans)])
    top = 1.15 * np.max(values[np.isfinite(values)], initial=1e-300)
    heights = np.arange(len(rows) + len(spans))[::-1]
    for height, (k, (_, speeds)) in zip(heights, enumerate(rows), strict=False):
        axis.plot(scale * speeds, np.full(np.shape(speeds), height), marker_of(k), color=color_of(k))
        last = -np.inf
        for w in np.sort(scale * np.ravel(speeds)[np.isfinite(np.ravel(speeds))]):
            if w - last > 0.06 * top:
                below = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center", "fontsize": "small"}
                axis.annotate(f"{w:.4g}", (w, height), **below)
                last = w
    for height, (k, (_, intervals)) in zip(heights[len(rows) :], enumerate(spans), strict=True):
        for start, end in scale * intervals[~np.isnan(intervals[:, 0])]:
            hatch = {"color": color_of(k + 2), "hatch": ("", "///")[k % 2], "edgecolor": "white", "lw": 0.0}
            axis.barh(height, min(end, top) - start, left=start, height=0.5, **hatch)
    labels = [label for label, _ in (*rows, *spans)]
    axis.set_yticks(heights[::-1], labels[::-1])
    axis.set(ylim=(-0.6, len(labels) - 0.3), xlim=(0.0, top), xlabel=f"speed, {unit}")
    return figure if ax is None else ax


def signals_chart(
    x: np.ndarray, signals: Sequence[tuple[str, np.ndarray, Sequence[str]]], *, x_label: str, ax: Onto = None
) -> Drawn:
    """Draw one panel for each signal over `x` (n,). A signal is (label with unit, values (n, k), names of its k curves)."""
    figure, axes = panels(len(signals), size=(7.5, 2.2), share_x=True, ax=ax)
    for axis, (label, values, names) in zip(axes, signals, strict=True):
        for k, name in enumerate(names):
            axis.plot(x, values[:, k], **series_look(k), label=name)
        axis.set_ylabel(label)
        if len(names) > 1:
            legend_above(axis, 6)
    axes[-1].set_xlabel(x_label)
    return figure if ax is None else ax


def points_chart(values: np.ndarray, *, x_label: str, y_label: str, ax: Axes | None = None) -> Drawn:
    """Draw values (n, k) as points over their index 1 to n."""
    figure, (axis,) = panels(1, size=(7.0, 3.2), ax=ax)
    for k in range(values.shape[1]):
        mark = marker_of(k)
        axis.plot(np.arange(1, values.shape[0] + 1), values[:, k], mark, ms=3.5, color=color_of(k))
    axis.set(xlabel=x_label, ylabel=y_label)
    return figure if ax is None else ax


def named_points_chart(names: Sequence[str], values: np.ndarray, *, x_label: str, ax: Axes | None = None) -> Drawn:
    """Draw positive values (n,) as points on a logarithmic axis, in lines with their names, the first one at the top."""
    figure, (axis,) = panels(1, size=(7.0, 1.0 + 0.32 * len(names)), ax=ax)
    axis.plot(values, np.arange(values.size), marker_of(0), ms=4.5, color=color_of(0))
    axis.set_yticks(np.arange(values.size), names)
    axis.set(xscale="log", xlabel=x_label, ylim=(values.size - 0.5, -0.5))
    axis.xaxis.set_major_locator(log_places(*axis.get_xlim()))
    axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    return figure if ax is None else ax


def shares_chart(
    share: np.ndarray, low: np.ndarray, high: np.ndarray, *, names: Sequence[str], ax: Axes | None = None
) -> Drawn:
    """Draw shares (n,), %, as bars with their intervals from `low` to `high`.

    >>> import numpy as np
    >>> shares_chart(np.array([75.0]), np.array([70.0]), np.array([79.0]), names=["regime 1"]).axes[0].get_ylabel()
    'share of the runs, %'
    """
    figure, (axis,) = panels(1, size=(5.0, 3.2), ax=ax)
    axis.bar(names, share, width=0.6, color=COLORS[0], yerr=[share - low, high - share], capsize=4.0)
    axis.set(ylabel="share of the runs, %", ylim=(0.0, 100.0))
    return figure if ax is None else ax


def multiplier_chart(multipliers: np.ndarray, *, ax: Axes | None = None) -> Drawn:
    """Draw Floquet multipliers (n,) in the complex plane with the unit circle."""
    figure, (axis,) = panels(1, size=(4.0, 4.0), ax=ax)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    axis.plot(np.cos(turn), np.sin(turn), color=GUIDE, lw=0.9, label="limit of stability")
    inside = np.abs(multipliers) <= 1.0
    for kind, look in ((inside, {"color": COLORS[0]}), (~inside, {"color": COLORS[1], "marker": "X"})):
        name = f"{'stable' if kind is inside else 'unstable'}: {int(np.sum(kind))}"
        axis.plot(
            np.real(multipliers[kind]),
            np.imag(multipliers[kind]),
            **{"marker": "o", "ls": "", "ms": 5.0, "label": name, **look},
        )
    legend_above(axis, 2)
    axis.set(aspect="equal", xlabel="real part", ylabel="imaginary part")
    return figure if ax is None else ax


def growth_chart(time: np.ndarray, rates: np.ndarray, exponent: float, uncertainty: float, *, ax: Axes | None = None) -> Drawn:
    """Draw growth rates (n,), 1/s, of intervals that end at `time` (n,), s, and the largest Lyapunov exponent, 1/s, with its
    uncertainty."""
    figure, (axes,) = panels(1, ax=ax)
    axes.plot(time, rates, "o-", ms=3.5, color=COLORS[0], label="each interval")
    half = time[time.size // 2 :]
    axes.fill_between(half[[0, -1]], exponent - uncertainty, exponent + uncertainty, color=COLORS[1], alpha=0.3, lw=0.0)
    axes.plot(half[[0, -1]], [exponent, exponent], color=COLORS[1], ls="--", label="exponent, with its uncertainty")
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set(xlabel="time, s", ylabel="growth of disturbances, 1/s")
    legend_above(axes)
    return figure if ax is None else ax


_PATTERNS = ("all together", "in two opposite groups", "spread around the circle, cancelling each other", "at other phases")
"""Patterns of phases, each of which has the same colour and marker in all figures."""

_WIDTHS = (2.2, 1.0)
"""Widths of stable and unstable lines, which differ because overlapping dashes could otherwise look like a stable line."""


def drag_diagram(
    branches: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    rotor_speed: float,
    *,
    label: str,
    at: float,
    jams: tuple[np.ndarray, np.ndarray] | None = None,
    within: tuple[float, float] | None = None,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw load speeds over the drag, on a log scale; stable parts are solid, unstable ones dashed.

    **Arguments**

    - `branches`: lines, each (name of the phase pattern, drag, load speed, True if stable), the last three as arrays (n,);
      lines of the same name have the same colour
    - `rotor_speed`: rotor speed, rad/s, drawn as a horizontal line
    - `label`: label of the drag axis
    - `at`: drag of the scene, drawn as a vertical line
    - `jams`: jams (speed, stable) at the drag of the scene; unstable ones are hollow
    - `within`: ends of the drag axis, as multiples of `at`; None: automatic range
    - `unit`: unit in which speeds, rad/s, are drawn
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.5, 4.6), ax=ax)
    shown = dict.fromkeys(name for name, *_ in branches)
    places = {name: k for k, name in enumerate(dict.fromkeys((*_PATTERNS, *shown)))}
    colors = {name: color_of(places[name]) for name in shown}
    marks = {name: marker_of(places[name]) for name in shown}
    for name, drag, speed, stable in branches:
        solid_and_dashed(axis, drag, scale * speed, stable, colors[name], widths=_WIDTHS, marker=marks.get(name, ""))
    for name, color in colors.items():
        axis.plot([], [], color=color, lw=_WIDTHS[0], marker=marks.get(name, ""), ms=4.0, mfc="white", label=name)
    axis.plot([], [], color="black", lw=_WIDTHS[0], label="stable")
    axis.plot([], [], color="black", ls=UNSTABLE, lw=_WIDTHS[1], label="unstable")
    axis.axhline(scale * rotor_speed, color=GUIDE, lw=1.2, label="rotor speed")
    axis.axvline(at, label="the scene's drag; points: its jams", **WORKING)
    if jams is not None:
        speed, stable = jams
        for kind, face in ((~stable, "white"), (stable, "black")):
            axis.plot(np.full(np.sum(kind), at), scale * speed[kind], "o", ms=4.0, mfc=face, mec="black", mew=0.8, zorder=3)
    axis.set_xscale("log")
    if within is not None:
        axis.set_xlim(at * within[0], at * within[1])
    log_ticks(axis, "x")
    axis.set(ylim=(0.0, 1.05 * scale * rotor_speed), xlabel=label, ylabel="load speed, " + unit)
    legend_above(axis, 3)
    return figure if ax is None else ax


def drag_limits_chart(
    omega: np.ndarray, drag: np.ndarray, resonances: np.ndarray, *, unit: SpeedUnit | None = None, ax: Axes | None = None
) -> Drawn:
    """Draw, for each resonance, the greatest drag (n,), N s/m, at which loads can jam there, on a logarithmic axis, over the
    load speed `omega` (n,), rad/s, of this jam.

    NaN entries are left out; `resonances`, rad/s, are dotted lines.

    >>> chart = drag_limits_chart(np.array([9.0]), np.array([0.5]), np.array([9.1]))
    >>> [axis.get_ylabel() for axis in chart.axes]
    ['greatest drag, N s/m']
    """
    figure, axes = panels(1, size=(6.4, 3.0), ax=ax)
    unit, scale = speed_unit(unit)
    axis, exists = axes[0], np.isfinite(drag)
    resonance_lines(axis.axvline, scale * resonances)
    axis.plot(scale * omega[exists], drag[exists], "o", color=COLORS[0], label="no jam above")
    axis.set(xlabel=f"load speed, {unit}", ylabel="greatest drag, N s/m", yscale="log" if exists.any() else "linear")
    legend_above(axis)
    return figure if ax is None else ax
