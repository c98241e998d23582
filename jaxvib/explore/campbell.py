"""Campbell diagram of a rotor as an SVG figure."""

from __future__ import annotations

import numpy as np

from jaxvib.display import speed_unit
from jaxvib.draw.machine.parts import Text
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, GUIDE
from jaxvib.draw.whirl import critical_groups, whirl_lines
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
from jaxvib.steady.whirl import Whirl

_SENSE_STYLES = {
    "forward": {"color": COLORS[0], "lw": 1.5},
    "backward": {"color": COLORS[1], "lw": 1.5, "ls": "--"},
    "straight": {"color": COLORS[2], "lw": 1.5, "ls": "-."},
}
"""Styles of whirls by their sense."""

_CRITICAL = {"fc": "white", "ec": "black", "lw": 1.2, "zorder": 4.0}
_DROP_LINE = {"color": GUIDE, "lw": 0.7, "zorder": 1.2}
_LETTER_WIDTH = 0.11
"""Upper bound of the mean width of a letter, in units of the drawing."""

_LEGEND = {
    "forward whirl": _SENSE_STYLES["forward"],
    "backward whirl": _SENSE_STYLES["backward"],
    "whirl frequency = rotor speed": ROTOR,
    "working speed": WORKING,
    "critical speeds (no damping), rpm": _CRITICAL,
}
"""Styles of the lines and dots in the legend, by their names."""


def campbell(result: Whirl, at: float) -> str:
    """Draw the whirl frequencies over the rotor speed, with the critical speeds, in rpm, like `Whirl.plot`.

    **Arguments**: `result`: whirl frequencies of one scene at several rotor speeds; `at`: the working speed, rad/s.

    **Returns** the text of an SVG file.
    """
    scale, rotor_speed = speed_unit("rpm")[1], np.asarray(result.rotor_speed)
    speed, sense = np.asarray(result.speed), result.sense
    critical, critical_sense = scale * np.asarray(result.critical.speed), result.critical.sense
    right = scale * max(float(np.max(rotor_speed)), 1.05 * at)
    groups = critical_groups(critical, critical_sense, right)
    shown = [k for group, _ in groups for k in group]
    top = 1.12 * max(scale * float(np.nanmax(speed)), *critical[shown].tolist(), 1e-300)
    panel = Panel(LEFT_MARGIN, "whirl frequency, rpm", (0.0, right), (0.0, top), width=3.0 * PANEL_WIDTH + 2.0 * PANEL_GAP)
    parts, texts = panel.frame(), panel.texts()
    for word, look in _SENSE_STYLES.items():
        parts += [
            panel.line(scale * rotor_speed, scale * values, look)
            for values in whirl_lines(speed, np.char.startswith(sense, word))
        ]
    end = min(top, right)
    parts += [panel.line([0.0, end], [0.0, end], ROTOR), panel.line([scale * at] * 2, panel.y, WORKING)]
    for k in shown:
        w = float(critical[k])
        look = {**_CRITICAL, "ec": _SENSE_STYLES[str(critical_sense[k]).split()[0]]["color"]}
        square = critical_sense[k] != "forward"
        parts += [panel.line([w, w], [0.0, w], _DROP_LINE), dot(*panel.at(w, w), look, square=square)]
    ends: list[float] = []  # right end of the texts in each row, from the lowest row upward
    for group, word in groups:
        x, _ = panel.at(float(critical[group[-1]]), 0.0)
        row = next((k for k, end in enumerate(ends) if end < x), len(ends))
        ends[row:] = [x + _LETTER_WIDTH * len(word), *ends[row + 1 :]]
        texts.append(Text(x + 0.08, 0.2 + 0.27 * row, word, {"fontsize": "small", "bbox": {"fc": "white"}}))
    keys, names = legend([_LEGEND])
    limits = (0.0, LEFT_MARGIN + panel.width + RIGHT_MARGIN, -0.6, PANEL_HEIGHT + 1.1)
    return svg(limits, [[*parts, *keys]], [[*texts, *names]], "", 1.0, 0.0)
