"""Campbell diagrams of rotors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn, SpeedUnit, speed_unit
from jaxvib.draw.style import COLORS, GUIDE, WHITE_OUTLINE, WORKING, Look, legend_above, panels

_SENSES = {
    "forward": (COLORS[0], "-", "forward whirl"),
    "backward": (COLORS[1], "--", "backward whirl"),
}
"""Colour, line and name of each sense."""

_STRAIGHT_COLORS = (COLORS[2], COLORS[4])
"""Colours of straight motions, in the order of their angles."""


def campbell_diagram(
    rotor_speed: np.ndarray,
    speed: np.ndarray,
    sense: np.ndarray,
    *,
    critical: tuple[np.ndarray, np.ndarray] | None = None,
    at: float | None = None,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw whirl frequencies over the rotor speed: lines of forward whirls are solid, of backward whirls dashed, of straight
    motions dash-dotted.

    **Arguments** (ns rotor speeds, at least 2, and nd whirls at each)

    - `rotor_speed` (ns,), `speed` (ns, nd): rotor speed and whirl frequencies, rad/s, drawn in `unit`
    - `sense` (ns, nd): "forward", "backward" or the angle of a straight motion such as "straight at 90 deg"
    - `critical`: critical speeds (k,), rad/s, and their senses (k,), marked with their values on the line whirl frequency =
      rotor speed
    - `at`: working speed, rad/s; default: none
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    senses = dict(_SENSES)
    for k, word in enumerate(np.setdiff1d(sense if critical is None else [*sense.flat, *critical[1]], list(senses)).tolist()):
        senses[word] = (_STRAIGHT_COLORS[k % 2], "-.", word.replace("straight", "straight motion"))
    for word, (color, line, label) in senses.items():
        for k, values in enumerate(whirl_lines(speed, sense == word)):
            look: Look = {"color": color, "label": None if k else label}
            axis.plot(scale * rotor_speed, scale * values, ls=line, **look)
    found = np.zeros(0) if critical is None else critical[0][np.isfinite(critical[0])]
    right = scale * max(float(np.max(rotor_speed)), 0.0 if at is None else 1.05 * at)
    top = 1.12 * scale * max(float(np.nanmax(speed)), *(w for w in found if scale * w <= right), 1e-300)
    axis.plot([0.0, top], [0.0, top], color=GUIDE, lw=0.9, ls=":", label="whirl frequency = rotor speed")
    if critical is not None:
        _critical_marks(axis, scale * critical[0], critical[1], {word: look[0] for word, look in senses.items()}, right, top)
        axis.plot([], [], "o", ms=6.0, mfc="white", mec="black", label=f"critical speeds (no damping), {unit}", ls="")
    if at is not None:
        axis.axvline(scale * at, label="working speed", **WORKING)
    axis.set(
        xlim=(scale * float(np.min(rotor_speed)), right),
        ylim=(0.0, top),
        xlabel=f"rotor speed, {unit}",
        ylabel=f"whirl frequency, {unit}",
    )
    legend_above(axis, 3)
    return figure if ax is None else ax


def _critical_marks(axis: Axes, speed: np.ndarray, sense: np.ndarray, colors: dict[str, str], right: float, top: float) -> None:
    """Draw critical speeds as points on the line whirl frequency = rotor speed, with their values beside vertical lines.

    Close critical speeds share a text.

    **Arguments**: `colors` of the senses.
    """
    for group, word in critical_groups(speed, sense, right):
        for k in group:
            look = {"mfc": "white", "mec": colors[str(sense[k])], "mew": 1.4, "zorder": 4}
            axis.plot([speed[k]], [speed[k]], "o" if sense[k] == "forward" else "s", ms=6.0, **look)
            axis.vlines(float(speed[k]), 0.0, float(speed[k]), color=GUIDE, lw=0.7, zorder=1.2)
        at = (speed[group[-1]], 0.02 * top)
        look = {"rotation": 90, "va": "bottom", "fontsize": "small", "linespacing": 1.0, "path_effects": WHITE_OUTLINE}
        lines = word.replace(", ", "\n")  # one long line would reach the curves
        axis.annotate(lines, at, xytext=(3, 0), textcoords="offset points", **look)


def whirl_lines(speed: np.ndarray, has_sense: np.ndarray) -> np.ndarray:
    """Return the lines (k, ns) of the whirls of one sense over ns rotor speeds.

    **Arguments**: `speed` (ns, nd): all whirl frequencies; `has_sense` (ns, nd): True for whirls of the requested sense.

    Line k has the k-th lowest speed of this sense, and is therefore continuous if lines of different sense cross. The line is
    NaN at rotor speeds with fewer whirls of this sense.

    >>> import numpy as np
    >>> whirl_lines(np.array([[1.0, 2.0], [1.5, 1.4]]), np.array([[True, False], [False, True]])).tolist()
    [[1.0, 1.4]]
    """
    count = int(np.max(np.sum(has_sense, axis=1), initial=0))
    return np.sort(np.where(has_sense, speed, np.nan), axis=1)[:, :count].T


def critical_groups(speed: np.ndarray, sense: np.ndarray, right: float) -> list[tuple[list[int], str]]:
    """Return groups of close critical speeds (k,) up to `right`, in ascending order, as indices and a text for each group.

    >>> import numpy as np
    >>> critical_groups(np.array([1.0, 10.0, 10.1]), np.array(["forward", "forward", "backward"]), right=20.0)
    [([0], '1 forward'), ([1, 2], '10 forward, 10.1 backward')]
    """
    groups: list[list[int]] = []
    for k in np.argsort(speed).tolist():
        if np.isfinite(speed[k]) and speed[k] <= right:
            near = groups and speed[k] - speed[groups[-1][-1]] < 0.035 * right
            groups = [*groups[:-1], [*groups[-1], k]] if near else [*groups, [k]]
    return [(group, ", ".join(f"{speed[k]:.4g} {sense[k]}" for k in group)) for group in groups]
