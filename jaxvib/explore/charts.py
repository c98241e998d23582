"""Branch diagram and Campbell diagram as plotly figures, in which a reader can zoom and point at values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
import plotly.graph_objects as go

from jaxvib.display import speed_unit
from jaxvib.draw.charts import crossings, log_limits, stretches
from jaxvib.draw.style import COLORS, GUIDE, join_names
from jaxvib.draw.whirl import critical_groups, whirl_lines
from jaxvib.steady.branches import Branches
from jaxvib.steady.jams.branch_plot import MARKS
from jaxvib.steady.whirl import Whirl

_Trace: TypeAlias = "dict[str, Any]"
_Limits: TypeAlias = "tuple[float, float]"

_SENSES = {
    "forward": ("forward whirl", COLORS[0], "solid", "circle-open"),
    "backward": ("backward whirl", COLORS[1], "dash", "square-open"),
    "straight": ("straight motion", COLORS[2], "dashdot", "square-open"),
}
"""Name, colour, line and marker of each sense of a whirl."""

_OPERATING = {"color": "black", "width": 1.2, "dash": "dashdot"}
_ROTOR = {"color": GUIDE, "width": 1.0}
_RESONANCE = {"color": GUIDE, "width": 1.0, "dash": "dot"}
_DROP_LINE = {"color": GUIDE, "width": 0.8}
_FOLD = {"color": COLORS[1], "size": 9, "symbol": "circle-open", "line": {"width": 2}}
"""Styles of lines and markers by kind."""

_RPM = speed_unit("rpm")[1]
"""Revolutions per minute in 1 rad/s."""

_MIN_POINT_DISTANCE = 0.005
"""Minimum distance between two points of a curve, in units of the size of its chart: about two pixels."""


def branch_chart(found: Branches, most: float) -> go.Figure:
    """Draw the load speed, rpm, and the foundation force (zero to peak) over the rotor speed, rpm, like `Branches.plot`.

    **Arguments**: `found`, the branches of one scene; `most`, the highest rotor speed in the diagram, rad/s.

    **Returns** a plotly figure with two charts.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    >>> branch_chart(jv.branches(scene), most=200.0).layout.yaxis2.title.text
    'foundation force, N, zero to peak'
    """
    at, omega, stable = _RPM * float(found.scene.drive.speed), np.asarray(found.omega), np.asarray(found.stable)
    force, resonances = np.asarray(found.foundation_force), np.asarray(found.resonances)
    rotor_speed = np.where(np.asarray(found.rotor_speed) <= most, np.asarray(found.rotor_speed), np.nan)
    crossed = crossings(rotor_speed, stable, np.asarray(found.mode), at / _RPM)
    x, high = _RPM * rotor_speed, _RPM * float(np.nanmax(rotor_speed))
    speed_limits, force_limits = (0.0, 1.06 * high), log_limits([force], rotor_speed, omega, resonances)
    traces = [
        *_lines("resonance", [([0.0, high], [_RPM * w] * 2) for w in resonances.tolist()], _RESONANCE, hover="%{y:.5g} rpm"),
        *_lines("speed of the rotor", [([0.0, high], [0.0, high])], _ROTOR),
    ]
    for panel, y, limits, hover in (
        (1, _RPM * omega, speed_limits, "rotor %{x:.5g} rpm<br>loads %{y:.5g} rpm"),
        (2, force, force_limits, "rotor %{x:.5g} rpm<br>force %{y:.4g} N"),
    ):
        shares = np.stack([x / high, _shares(y, limits, log=panel == 2)], axis=1)
        for name, solid in (("stable", True), ("unstable", False)):
            curves = [
                (x[along][keep], y[along][keep])
                for along, one in stretches(stable)
                if one == solid
                for keep in [_kept(shares[along])]
            ]
            traces += _lines(name, curves, {"color": COLORS[0], "dash": "solid" if solid else "dash"}, panel, hover)
        traces += _lines("operating speed; numbers: jam modes", [([at] * 2, limits)], _OPERATING, panel)
        values = np.array([np.interp(share, [0, 1], y[i : i + 2]) for i, share, *_ in crossed])
        jams = [(y, *jam[2:]) for y, jam in zip(values, crossed, strict=True) if limits[0] <= y <= limits[1]]
        symbols = ["circle" if filled else "circle-open" for *_, filled in jams]
        looks = {"color": "black", "size": 8, "symbol": symbols}
        traces += _markers("jam mode", [(at, y, f"jam mode {name}") for y, name, _ in jams], looks, panel)
        names = join_names(sorted((float(_shares(y, limits, log=panel == 2)), name) for y, name, _ in jams))
        traces += _texts([(at, _value(share, limits, log=panel == 2), f"<b>{name}</b>") for share, name in names], panel)
    folds = [
        (_RPM * n, _RPM * w, "fold")
        for n, w, there in zip(*map(np.ravel, (found.folds.rotor_speed, found.folds.omega, found.folds.exists)), strict=True)
        if there and n <= most
    ]
    traces += _markers(MARKS["fold"], folds, _FOLD, 1, legend=True)
    titles = (("speed of loads, rpm", speed_limits, False), ("foundation force, N, zero to peak", force_limits, True))
    return _figure(traces, (0.0, high), titles)


def campbell_chart(found: Whirl, at: float) -> go.Figure:
    """Draw the whirl speeds over the rotor speed, with the critical speeds, in rpm, like `Whirl.plot`.

    **Arguments**: `found`, whirl speeds of one scene at several rotor speeds; `at`, the operating speed, rad/s.

    **Returns** a plotly figure.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import numpy as np
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["planar_rotor"])
    >>> campbell_chart(jv.whirl(scene, np.linspace(0.0, 600.0, 31)), at=460.0).layout.yaxis.title.text
    'whirl speed, rpm'
    """
    rotor_speed, speed = _RPM * np.asarray(found.rotor_speed), _RPM * np.asarray(found.speed)
    critical, sense = _RPM * np.asarray(found.critical.speed), found.critical.sense
    right = max(float(np.max(rotor_speed)), 1.05 * _RPM * at)
    groups = critical_groups(critical, sense, right)
    shown = [k for group, _ in groups for k in group]
    top = 1.12 * max(float(np.nanmax(speed)), *critical[shown].tolist(), 1e-300)
    traces = _lines("whirl speed = rotor speed", [([0.0, min(top, right)],) * 2], _ROTOR)
    for word, (name, color, dash, symbol) in _SENSES.items():
        hover = f"{name} %{{y:.5g}} rpm<br>rotor %{{x:.5g}} rpm"
        curves = [(rotor_speed, values) for values in whirl_lines(speed, found.sense == word)]
        traces += _lines(name, curves, {"color": color, "dash": dash}, hover=hover)
        own = [float(critical[k]) for k in shown if sense[k] == word]
        traces += _lines("critical speed", [([w, w], [0.0, w]) for w in own], _DROP_LINE, legend=False)
        looks = {"color": color, "size": 9, "symbol": symbol, "line": {"width": 2}}
        traces += _markers(f"critical, {name}", [(w, w, f"critical speed, {word}") for w in own], looks, 1, legend=True)
    traces += _lines("operating speed", [([_RPM * at] * 2, [0.0, top])], _OPERATING)
    words = [(float(critical[group[-1]]), (0.03 + 0.06 * (k % 3)) * top, word) for k, (group, word) in enumerate(groups)]
    return _figure([*traces, *_texts(words, 1)], (0.0, right), [("whirl speed, rpm", (0.0, top), False)])


def _figure(traces: list[_Trace], x: _Limits, charts: Iterable[tuple[str, _Limits, bool]]) -> go.Figure:
    """Return a figure with charts side by side over the rotor speed.

    **Arguments**: `traces` of all charts; `x`, limits of the rotor speed, rpm; `charts`: the title of each chart, the limits of
    its vertical axis, and True if that axis is logarithmic.
    """
    charts = list(charts)
    legend = {"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0.0}
    layout: dict[str, Any] = {"template": "none", "dragmode": "zoom", "height": 420, "legend": legend}
    layout["margin"] = {"l": 60, "r": 15, "t": 70, "b": 45}
    for k, (title, limits, log) in enumerate(charts):
        place = ((k + 0.07 * (k > 0)) / len(charts), (k + 1 - 0.07 * (k + 1 < len(charts))) / len(charts))
        below = {"title": {"text": "rotor speed, rpm"}, "domain": place, "range": x}
        beside = {
            "title": {"text": title},
            "range": np.log10(limits).tolist() if log else limits,
            "type": "log" if log else "linear",
        }
        layout[f"xaxis{k + 1}"] = {**below, "anchor": f"y{k + 1}", "gridcolor": "#e2e2e2"}
        layout[f"yaxis{k + 1}"] = {**beside, "anchor": f"x{k + 1}", "gridcolor": "#e2e2e2", "exponentformat": "power"}
    return go.Figure({"data": traces, "layout": layout})


def _axes(panel: int) -> _Trace:
    return {"type": "scatter", "xaxis": f"x{panel}", "yaxis": f"y{panel}"}


def _lines(
    name: str, curves: Iterable[Any], look: Mapping[str, Any], panel: int = 1, hover: str = "", legend: bool = True
) -> list[_Trace]:
    """Return curves of one kind as one trace with a gap (NaN) after each; the legend names it once for all charts."""
    parts = [(np.append(x, np.nan), np.append(y, np.nan)) for x, y in curves]
    if not parts:
        return []
    x, y = (np.concatenate(values) for values in zip(*parts, strict=True))
    shown = {"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}
    group = {"legendgroup": name, "showlegend": legend and panel == 1}
    return [{**_axes(panel), "x": x, "y": y, "name": name, "mode": "lines", "line": look, **shown, **group}]


def _markers(
    name: str, places: list[tuple[float, float, str]], look: Mapping[str, Any], panel: int, legend: bool = False
) -> list[_Trace]:
    """Return markers at places (x, y, text) as one trace; pointing at one shows its text and its place."""
    hover = "%{text}<br>%{x:.5g}, %{y:.5g}<extra></extra>"
    x, y, texts = zip(*places, strict=True) if places else ((), (), ())
    look = {"mode": "markers", "marker": look, "hovertemplate": hover, "cliponaxis": False, "showlegend": legend}
    return [{**_axes(panel), "x": x, "y": y, "text": texts, "name": name, **look}] if places else []


def _texts(places: list[tuple[float, float, str]], panel: int) -> list[_Trace]:
    """Return texts to the right of places (x, y, text) as one trace."""
    x, y, texts = zip(*places, strict=True) if places else ((), (), ())
    look = {"mode": "text", "textposition": "middle right", "hoverinfo": "skip", "showlegend": False}
    return [{**_axes(panel), "x": x, "y": y, "text": [f"\u2002{text}" for text in texts], **look}] if places else []


def _shares(values: Any, limits: _Limits, log: bool) -> Any:
    """Return the heights of values on an axis: 0 at its lower limit, 1 at its upper limit."""
    low, high = limits
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(values / low) / np.log(high / low) if log else (values - low) / (high - low)


def _value(share: float, limits: _Limits, log: bool) -> float:
    low, high = limits
    return low * (high / low) ** share if log else low + share * (high - low)


def _kept(points: np.ndarray) -> np.ndarray:
    """Return True (n,) for the points (n, 2) of a curve to be drawn: the others are too close to their neighbours."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    gone = np.floor(np.concatenate([[0.0], np.nancumsum(steps)]) / _MIN_POINT_DISTANCE)
    gap = np.isnan(np.concatenate([[np.nan], steps, [np.nan]]))
    keep = gap[1:] | gap[:-1]
    keep[1:] |= gone[1:] != gone[:-1]
    return keep
