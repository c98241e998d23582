"""Chart of the response to unbalances over the speed: amplitudes, phases, force, and torque with the curve of the motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import (
    COLORS,
    STROKES,
    Look,
    axis_unit,
    legend_above,
    log_ticks,
    panels,
    resonance_lines,
    series_look,
)
from jaxvib.errors import InputError, quoted

Arrays: TypeAlias = Mapping[str, np.ndarray]

PARTS = ("amplitude", "phase", "force", "torque")
"""Names of the panels."""

_DECADES = 4.0
"""Largest number of decades of a logarithmic axis."""

_MAX_TORQUE_RATIO = 10.0
"""Largest ratio of the torques at points and folds and the torque of the motors on a linear axis."""


def response_chart(
    curve: Arrays,
    points: Arrays,
    folds: Arrays,
    resonances: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str],
    motors: int,
    motor: Arrays,
    unit: SpeedUnit | None = None,
    show: Sequence[str] = PARTS,
    ax: Onto = None,
) -> Drawn:
    """Draw the response over the speed, a panel for each part; filled points are stable operating points, hollow ones unstable.

    **Arguments** (n speeds, nd coordinates)

    - `curve`: the arrays `speed` (n,), rad/s; `amplitude` (n, nd), m or rad; `phase` (n, nd), rad; `foundation_force` (n,), N;
      `torque` (n,), N m, which the vibration needs
    - `points`: the same arrays for the operating points, and the Boolean array `stable`
    - `folds`: `speed` and `torque` of the folds
    - `resonances` (k,), rad/s, drawn as dotted lines
    - `names` and `units` (nd,) of the coordinates; lengths are drawn in mm or µm, tilts in deg
    - `motors`: number of motors, whose torques are added in one curve; 0 for an ideal drive, which has no such curve
    - `motor`: `speed` and `torque` of this curve, ascending in speed
    - `unit` of the speeds; `show`: names of panels; `ax`: axes to draw onto

    **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for an unknown panel.
    """
    if isinstance(show, str) or not show or any(name not in PARTS for name in show):
        raise InputError("show", f"is {quoted(show)}; it must be a list of {', '.join(PARTS)}")
    unit, scale = speed_unit(unit)
    curve, points, folds, motor = (
        {name: scale * values if name == "speed" else values for name, values in arrays.items()}
        for arrays in (curve, points, folds, motor)
    )
    last = float(np.max(curve["speed"]))
    resonances = scale * resonances
    resonances = resonances[(resonances > 0.0) & (resonances <= last)]
    amplitude = curve["amplitude"]
    kinds = {kind: axis_unit(kind, amplitude[:, np.asarray(units) == kind]) for kind in ("m", "rad") if kind in units}
    drawn = [(name, kind) for name in show for kind in (kinds if name == "amplitude" else ("",))]
    figure, axes = panels(len(drawn), size=(7.2, 2.5), share_x=True, ax=ax)
    for axis, (name, kind) in zip(axes, drawn, strict=True):
        resonance_lines(axis.axvline, resonances, "resonance" if axis is axes[0] else None)
        if name in ("amplitude", "phase"):
            which = [k for k, each in enumerate(units) if kind in ("", each)]
            for k, number in enumerate(which):
                look = {**series_look(k), "label": names[number]}
                values = curve[name][:, number]
                if name == "phase":
                    angle = np.rad2deg(np.unwrap(np.where(np.isfinite(values), values, 0.0)))
                    axis.plot(curve["speed"], angle, **look)
                else:
                    factor = kinds[kind][1]
                    _line(axis, curve, points, factor * values, factor * points[name][:, number], look)
            axis.set_ylabel(f"{name}, {kinds[kind][0] if kind else 'deg'}")
        elif name == "force":
            look = {"color": COLORS[0], "label": "force on the foundation"}
            _line(axis, curve, points, curve["foundation_force"], points["foundation_force"], look)
            axis.set_ylabel("force, N")
        else:
            _torque(axis, curve, points, folds, motors, motor)
            axis.set_ylabel("torque, N m")
        if name in ("amplitude", "force"):
            _logarithmic(axis)
        legend_above(axis, columns=2 if name == "torque" else 4)  # four long names in one row are wider than the panel
    axes[-1].set(xlabel=f"speed of the exciter, {unit}", xlim=(0.0, last))
    return figure if ax is None else ax


def _line(axis: Axes, curve: Arrays, points: Arrays, line: np.ndarray, at_points: np.ndarray, look: Look) -> None:
    """Draw the values `line` over the speeds of the curve, and the values `at_points` of the operating points."""
    axis.plot(curve["speed"], line, marker="" if curve["speed"].size > 1 else ".", **look)
    for x, y, stable in zip(points["speed"], at_points, points["stable"], strict=True):
        axis.plot([x], [y], "o", ms=5.0, mfc=look["color"] if stable else "white", mec=look["color"], zorder=4)


def _torque(axis: Axes, curve: Arrays, points: Arrays, folds: Arrays, motors: int, motor: Arrays) -> None:
    """Draw the torque that the vibration needs, the torque of the motors, the operating points and the folds."""
    look = {"color": COLORS[0], "label": "needed by the vibration"}
    _line(axis, curve, points, curve["torque"], points["torque"], look)
    if points["speed"].size:
        label = "operating point" + ("" if np.all(points["stable"]) else "; hollow: unstable")
        axis.plot([], [], "o", ms=5.0, color=COLORS[0], label=label)
    finite = curve["torque"][np.isfinite(curve["torque"])]
    top = float(np.max(finite, initial=0.0))
    if motors:
        label = "of the motor" if motors == 1 else "of all motors"
        axis.plot(motor["speed"], motor["torque"], color=COLORS[1], ls=STROKES[1], label=label)
        if np.any(np.isfinite(folds["speed"])):
            look = {"ms": 5.0, "mfc": "white", "mec": COLORS[4], "label": "fold: the speed jumps"}
            axis.plot(folds["speed"], folds["torque"], "D", **look)
        drives = float(np.max(motor["torque"]))
        markers = np.concatenate([points["torque"], folds["torque"]])
        top = max(drives, min(top, 3.0 * drives), float(np.max(markers[np.isfinite(markers)], initial=0.0)))
        if top > _MAX_TORQUE_RATIO * drives > 0.0:
            _logarithmic(axis)
            return
    if top > 0.0:
        axis.set_ylim(-0.03 * top, 1.08 * top)


def _logarithmic(axis: Axes) -> None:
    """Set a logarithmic axis that covers at most `_DECADES` decades below the largest value."""
    lines = [line for line in axis.get_lines() if line.get_transform() == axis.transData]  # without those of resonances
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in lines])
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size == 0:
        return
    top = 2.0 * float(np.max(positive))
    axis.set(yscale="log", ylim=(max(0.5 * float(np.min(positive)), top / 10.0**_DECADES), top))
    log_ticks(axis)
