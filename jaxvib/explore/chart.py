"""Branch diagram with charts of amplitudes and foundation force as an SVG figure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxvib.display import speed_unit
from jaxvib.draw.charts import crossings, log_limits, scaled_amplitudes, segments
from jaxvib.draw.machine.parts import Part, Text
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, GUIDE, join_names
from jaxvib.explore.panel import (
    LEFT_MARGIN,
    PANEL_GAP,
    PANEL_HEIGHT,
    PANEL_WIDTH,
    RIGHT_MARGIN,
    ROTOR,
    WORKING,
    Panel,
    dot,
    legend,
)
from jaxvib.steady.branches import Branches
from jaxvib.steady.jams.branch_plot import MARKS

_STABLE = {"color": COLORS[0], "lw": 1.5}
_UNSTABLE = {"color": COLORS[0], "lw": 1.2, "ls": "--"}
_RESONANCE = {"color": GUIDE, "lw": 0.8, "ls": ":"}
_FOLD = {"fc": "white", "ec": COLORS[1], "lw": 1.2, "zorder": 3.0}
_LEGEND = {
    "stable": {**_STABLE, "color": "black"},
    "unstable": {**_UNSTABLE, "color": "black"},
    "resonance": _RESONANCE,
    "rotor speed": ROTOR,
    "working speed; numbers: jam modes": WORKING,
}
"""Styles of the lines in the legend, by their names."""

_STABILITY_STRIDE = 16
"""Stride of the points at which the stability of free loads is computed. Its computation at all points would take five times as
long as the chart."""


def chart(result: Branches, max_speed: float) -> str:
    """Draw load speed, rpm, amplitudes and foundation force (zero to peak) over the rotor speed, rpm, like `Branches.plot`.

    Each coordinate has a colour. If there are more coordinates than colours, only their largest amplitude is drawn.

    **Arguments**: `result`: the branches of one scene; `max_speed`: the highest rotor speed in the diagram, rad/s.

    **Returns** the text of an SVG file.
    """
    scale, at = speed_unit("rpm")[1], float(result.scene.drive.speed)
    result, criterion = result.with_free_loads(_STABILITY_STRIDE)
    rotor_speed = np.asarray(result.rotor_speed)
    rotor_speed = np.where(rotor_speed <= max_speed, rotor_speed, np.nan)
    panels = _panels(result, scale, rotor_speed)
    parts, texts = [each for panel, _ in panels for each in panel.frame()], [t for panel, _ in panels for t in panel.texts()]
    speeds, high = panels[0][0], scale * float(np.nanmax(rotor_speed))
    parts += [speeds.line([0.0, high], [scale * w, scale * w], _RESONANCE) for w in np.asarray(result.resonances).tolist()]
    parts.append(speeds.line([0.0, high], [0.0, high], ROTOR))
    stable = np.asarray(result.stable)
    crossed = crossings(rotor_speed, stable, np.asarray(result.mode), at)
    for panel, curves in panels:
        parts += [
            panel.line(scale * rotor_speed[along], values[along], {**(_STABLE if solid else _UNSTABLE), "color": color})
            for values, color in zip(curves.values(), COLORS, strict=False)
            for along, solid in segments(stable)
            if np.any(np.isfinite(rotor_speed[along]))
        ]
        dots, numbers = _jams_at_working_speed(panel, [*curves.values()], crossed, scale * at)
        parts += [panel.line([scale * at] * 2, panel.y, WORKING), *dots]
        texts += numbers
    folds = [
        (scale * n, scale * w)
        for n, w, exists in zip(
            *map(np.ravel, (result.folds.rotor_speed, result.folds.omega, result.folds.exists)), strict=True
        )
        if exists and n <= max_speed
    ]
    parts += [dot(*speeds.at(n, w), _FOLD) for n, w in folds]
    platforms = {name: {**_STABLE, "color": color} for name, color in zip(panels[1][1], COLORS, strict=False)}
    keys, names = legend([{**_LEGEND, MARKS["fold"]: _FOLD} if folds else _LEGEND, platforms])
    width = LEFT_MARGIN + 3.0 * PANEL_WIDTH + 2.0 * PANEL_GAP + RIGHT_MARGIN
    texts.append(Text(0.5 * width, -0.8, f"stable {criterion}", {"fontsize": "small", "ha": "center"}))
    return svg((0.0, width, -0.95, PANEL_HEIGHT + 1.1), [[*parts, *keys]], [[*texts, *names]], "", 1.0, 0.0)


def _panels(result: Branches, scale: float, rotor_speed: np.ndarray) -> list[tuple[Panel, dict[str, np.ndarray]]]:
    """Return the three panels with their curves by name; `rotor_speed` is NaN at points that are not drawn, and `scale` is the
    factor from rad/s to rpm."""
    structure, omega, resonances = result.scene.machine.structure(), np.asarray(result.omega), np.asarray(result.resonances)
    units, amplitudes = scaled_amplitudes(np.asarray(result.amplitude), structure.coordinates, structure.units)
    curves = dict(amplitudes)
    if len(curves) > len(COLORS):
        curves = {f"largest of {len(curves)}": np.max([*curves.values()], axis=0)}
    high = scale * float(np.nanmax(rotor_speed))
    panels = [(Panel(LEFT_MARGIN, "load speed, rpm", (0.0, high), (0.0, 1.06 * high)), {"loads": scale * omega})]
    for title, drawn in (
        (f"amplitude, {', '.join(dict.fromkeys(units))}, zero to peak", curves),
        ("foundation force, N, zero to peak", {"force": np.asarray(result.foundation_force)}),
    ):
        limits = log_limits([*drawn.values()], rotor_speed, omega, resonances)
        panels.append(
            (Panel(LEFT_MARGIN + len(panels) * (PANEL_WIDTH + PANEL_GAP), title, (0.0, high), limits, log=True), drawn)
        )
    return panels


def _jams_at_working_speed(
    panel: Panel, curves: Sequence[np.ndarray], crossed: Sequence[tuple[int, float, str, bool]], at: float
) -> tuple[list[Part], list[Text]]:
    """Return the dots at which the curves cross the working speed, and the number of each jam beside the highest of its dots.

    **Arguments**: `curves`: values along the branch; `crossed`: the jams at the working speed, see `crossings`; `at`: the
    working speed, rpm.
    """
    dots, numbers = [], []
    for i, share, name, filled in crossed:
        heights = [panel.at(at, float(np.interp(share, [0, 1], values[i : i + 2])))[1] for values in curves]
        shown = [y for y in heights if 0.0 <= y <= PANEL_HEIGHT]
        look = {"fc": "black" if filled else "white", "ec": "black", "lw": 1.0, "zorder": 4.0}
        dots += [dot(panel.at(at, panel.y[0])[0], y, look) for y in shown]
        numbers += [(max(shown) / PANEL_HEIGHT, name)] if shown else []
    look = {"fontsize": "small", "fontweight": "bold", "bbox": {"fc": "white"}}
    x = panel.at(at, panel.y[0])[0] + 0.1
    return dots, [Text(x, PANEL_HEIGHT * share, name, look) for share, name in join_names(sorted(numbers))]
