"""Chart of synchronous regimes: torques of the motors over the speed, and the phases of each regime."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn, Onto, speed_unit
from jaxvib.draw.results import draw_circle
from jaxvib.draw.style import STROKES, color_of, legend_above, marker_of, panels, resonance_lines

_MAX_TITLE_MASSES = 3
"""Largest number of masses whose phases and torques fit into the title of a circle."""


class DrawnRegime(NamedTuple):
    """Synchronous regime of a chart.

    **Attributes** (count masses): `speed`, rad/s; `masses` (count,): their numbers, from 0; `phases` (count,), rad;
    `torque` (count,), N m; `stable`.
    """

    speed: float
    masses: np.ndarray
    phases: np.ndarray
    torque: np.ndarray
    stable: bool


class TorqueCurves(NamedTuple):
    """Torques on count masses at n speeds.

    **Attributes**: `speed` (n,), rad/s; `driving` (n, count): torques of the drives, N m, NaN for ideal drives; `needed`
    (n, count): torques that the vibration needs at the phases of the first regime, N m.
    """

    speed: np.ndarray
    driving: np.ndarray
    needed: np.ndarray


def regimes_chart(
    regimes: Sequence[DrawnRegime],
    curves: TorqueCurves | None,
    resonances: np.ndarray,
    *,
    names: Sequence[str],
    resultant: bool = False,
    ax: Onto = None,
) -> Drawn:
    """Draw the torques over the speed in the first panel (if there are `curves`), and the phases of each regime on a circle.

    The phase of a single mass is not drawn beside its torque.

    Points are filled for stable regimes, hollow for unstable ones.

    **Arguments**: `resonances`, rad/s; `names` (count,) of the masses; `resultant`, see `draw_circle`; `ax`: as many axes
    as there are panels.

    >>> import numpy as np
    >>> one = DrawnRegime(100.0, np.arange(2), np.zeros(2), np.ones(2), True)
    >>> curves = TorqueCurves(np.arange(3.0), np.ones((3, 2)), np.ones((3, 2)))
    >>> figure = regimes_chart([one], curves, np.ones(1), names=["motor 1", "motor 2"])
    >>> [axis.get_title().splitlines() for axis in figure.axes]
    [[], ['954.93 rpm, stable', 'phases in the direction of rotation', '0, 0 deg', 'torques 1, 1 N m']]
    """
    unit, scale = speed_unit()
    drawn = [] if curves is not None and len(names) == 1 else regimes
    count = len(drawn) + (curves is not None)
    columns = max(count, 1) if ax is not None else min(max(count, 1), 4)
    rows = 1 if ax is not None else -(-max(count, 1) // columns)
    figure, axes = panels(rows, columns, size=(3.8, 3.6), ax=ax)
    if curves is not None:
        _draw_torques(axes[0], regimes, curves, resonances, names, scale)
        axes[0].set(xlabel=f"speed, {unit}", ylabel="torque, N m")
    circles = axes[curves is not None :]
    for axis in circles:
        axis.set_axis_off()
    if not regimes:
        axes[0].text(0.5, 0.5, "no synchronous regime", ha="center", va="center", transform=axes[0].transAxes)
    for axis, regime in zip(circles, drawn, strict=False):
        lines = [
            f"{scale * regime.speed:.6g} {unit}, {'stable' if regime.stable else 'unstable'}",
            "phases in the direction of rotation",
        ]
        if regime.phases.size <= _MAX_TITLE_MASSES:
            lines.append(f"{', '.join(f'{a + 0.0:g}' for a in np.round(np.rad2deg(regime.phases), 1))} deg")
            lines.append(f"torques {', '.join(f'{t:.3g}' for t in regime.torque)} N m")
        draw_circle(axis, "\n".join(lines), regime.phases, resultant=resultant, numbers=regime.masses, plural="masses")
    return figure if ax is None else ax


def _draw_torques(
    axis: Axes,
    regimes: Sequence[DrawnRegime],
    curves: TorqueCurves,
    resonances: np.ndarray,
    names: Sequence[str],
    scale: float,
) -> None:
    """Draw the torque of each motor, the torque that the vibration needs from it, and the regimes.

    Equal curves are one line. An ideal drive has points of regimes but no curves.
    """
    drawn = curves.driving[np.isfinite(curves.driving)], np.concatenate([regime.torque for regime in regimes])
    top = float(max(np.max(np.abs(values)) for values in drawn))
    resonance_lines(axis.axvline, scale * resonances[(resonances > 0.0) & (resonances < curves.speed[-1])])
    for values, stroke, words in ((curves.driving, "-", "of {}"), (curves.needed, STROKES[1], "needed by {}")):
        groups: list[list[int]] = []
        for k in (k for k in range(values.shape[1]) if not np.isnan(curves.driving[0, k])):
            same = next((each for each in groups if np.allclose(values[:, k], values[:, each[0]], atol=1e-3 * top)), None)
            groups = [*groups, [k]] if same is None else groups
            if same is not None:
                same.append(k)
        for group in groups:
            look = {"color": color_of(group[0]), "ls": stroke, "lw": 1.2}
            axis.plot(scale * curves.speed, values[:, group[0]], label=words.format(_group_name(names, group)), **look)
    for regime in sorted(regimes, key=lambda each: each.stable):  # stable ones on top
        for k, torque in enumerate(regime.torque):
            color = color_of(k)
            look = {"mec": color, "mfc": color if regime.stable else "white", "ms": 5.0, "zorder": 4}
            axis.plot([scale * regime.speed], [torque], marker_of(k), **look)
    needed = np.clip(curves.needed[np.isfinite(curves.driving)], -top, top)  # its peaks at resonances may be much larger
    low, high = (float(each([each(values) for values in (*drawn, needed)])) for each in (np.min, np.max))
    axis.set(xlim=(0.0, 1.03 * scale * float(curves.speed[-1])), ylim=(min(-0.05 * top, 1.15 * low), 1.15 * high))
    axis.plot([], [], "o", color="black", ms=5.0, label="regime; hollow: unstable")
    legend_above(axis, 2, handlelength=1.6, columnspacing=0.8)


def _group_name(names: Sequence[str], group: Sequence[int]) -> str:
    """Return the common name of masses.

    >>> _group_name(["motor 1", "motor 2"], [0, 1])
    'motors 1, 2'
    """
    kind, _, first = names[group[0]].rpartition(" ")
    return f"{kind}{'s' * (len(group) > 1)} {', '.join([first, *(names[k].rpartition(' ')[2] for k in group[1:])])}"
