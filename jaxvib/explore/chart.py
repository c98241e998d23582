"""Branch diagram and force chart as an SVG picture."""

from __future__ import annotations

import numpy as np

from jaxvib.display import speed_unit
from jaxvib.draw.charts import crossings, log_limits, stretches
from jaxvib.draw.machine.parts import Text
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, GUIDE, join_names
from jaxvib.explore.panel import APART, FIRST, LAST, OPERATING, ROTOR, TALL, WIDE, Panel, dot, legend
from jaxvib.steady.branches import Branches
from jaxvib.steady.jams.branch_plot import MARKS
from jaxvib.steady.jams.jam import STABILITY_CRITERION

_STABLE = {"color": COLORS[0], "lw": 1.5}
_UNSTABLE = {"color": COLORS[0], "lw": 1.2, "ls": "--"}
_RESONANCE = {"color": GUIDE, "lw": 0.8, "ls": ":"}
_FOLD = {"fc": "white", "ec": COLORS[1], "lw": 1.2, "zorder": 3.0}
_LEGEND = {
    "stable": {**_STABLE, "color": "black"},
    "unstable": {**_UNSTABLE, "color": "black"},
    "resonance": _RESONANCE,
    "rotor speed": ROTOR,
    "operating speed; numbers: jam modes": OPERATING,
}
"""Styles of the lines in the legend, by their names."""


def chart(result: Branches, max_speed: float) -> str:
    """Draw the load speed, rpm, and the foundation force (zero to peak) over the rotor speed, rpm, like `Branches.plot`.

    **Arguments**: `result`: the branches of one scene; `max_speed`: the highest rotor speed in the diagram, rad/s.

    **Returns** the text of an SVG file.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    >>> "foundation force, N, zero to peak" in chart(jv.branches(scene), max_speed=200.0)
    True
    """
    scale, at = speed_unit("rpm")[1], float(result.scene.drive.speed)
    omega, stable, force = np.asarray(result.omega), np.asarray(result.stable), np.asarray(result.foundation_force)
    rotor_speed, resonances = np.asarray(result.rotor_speed), np.asarray(result.resonances)
    rotor_speed = np.where(rotor_speed <= max_speed, rotor_speed, np.nan)
    high = scale * float(np.nanmax(rotor_speed))
    speeds = Panel(FIRST, "load speed, rpm", (0.0, high), (0.0, 1.06 * high))
    limits = log_limits([force], rotor_speed, omega, resonances)
    forces = Panel(FIRST + WIDE + APART, "foundation force, N, zero to peak", (0.0, high), limits, log=True)
    parts, texts = [*speeds.frame(), *forces.frame()], [*speeds.texts(), *forces.texts()]
    parts += [speeds.line([0.0, high], [scale * w, scale * w], _RESONANCE) for w in resonances.tolist()]
    parts.append(speeds.line([0.0, high], [0.0, high], ROTOR))
    crossed = crossings(rotor_speed, stable, np.asarray(result.mode), at)
    for panel, values in ((speeds, scale * omega), (forces, force)):
        parts += [
            panel.line(scale * rotor_speed[along], values[along], _STABLE if solid else _UNSTABLE)
            for along, solid in stretches(stable)
        ]
        parts.append(panel.line([scale * at] * 2, panel.y, OPERATING))
        jams = []
        for i, share, name, filled in crossed:
            x, y = panel.at(scale * at, float(np.interp(share, [0, 1], values[i : i + 2])))
            if 0.0 <= y <= TALL:
                jams.append((y / TALL, name))
                parts.append(dot(x, y, {"fc": "black" if filled else "white", "ec": "black", "lw": 1.0, "zorder": 4.0}))
        look = {"fontsize": "small", "fontweight": "bold", "bbox": {"fc": "white"}}
        x, _ = panel.at(scale * at, panel.y[0])
        texts += [Text(x + 0.1, TALL * share, name, look) for share, name in join_names(sorted(jams))]
    folds = [
        (scale * n, scale * w)
        for n, w, exists in zip(
            *map(np.ravel, (result.folds.rotor_speed, result.folds.omega, result.folds.exists)), strict=True
        )
        if exists and n <= max_speed
    ]
    parts += [dot(*speeds.at(n, w), _FOLD) for n, w in folds]
    width = FIRST + 2.0 * WIDE + APART + LAST
    keys, names = legend({**_LEGEND, MARKS["fold"]: _FOLD} if folds else _LEGEND)
    texts.append(Text(0.5 * width, -0.8, f"stable {STABILITY_CRITERION}", {"fontsize": "small", "ha": "center"}))
    return svg((0.0, width, -0.95, TALL + 1.1), [[*parts, *keys]], [[*texts, *names]], "", 1.0, 0.0)
