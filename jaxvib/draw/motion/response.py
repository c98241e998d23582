"""Chart of the response to unbalances over the speed: amplitudes, phases, force, and torque with the curve of the motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import COLORS, GUIDE, STROKES, legend_above, log_ticks, panels
from jaxvib.errors import InputError, quoted

PARTS = ("amplitude", "phase", "force", "torque")
"""Names of the panels."""

_DECADES = 4.0
"""Largest number of decades of a logarithmic axis."""


def response_chart(
    curve: Mapping[str, np.ndarray],
    points: Mapping[str, np.ndarray],
    folds: Mapping[str, np.ndarray],
    resonances: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str],
    has_motor: bool,
    unit: SpeedUnit | None = None,
    show: Sequence[str] = PARTS,
    ax: Onto = None,
) -> Drawn:
    """Draw the response over the speed, a panel for each part; filled points are stable operating points, hollow ones unstable.

    **Arguments** (n speeds, nd coordinates)

    - `curve`: the arrays `speed` (n,), rad/s; `amplitude` (n, nd), m or rad; `phase` (n, nd), rad; `foundation_force` (n,), N;
      `torque` (n,), which the vibration needs, and `motor_torque` (n,), N m
    - `points`: the same arrays for the operating points, and the Boolean array `stable`
    - `folds`: `speed` and `torque` of the folds
    - `resonances` (k,), rad/s, drawn as dotted lines
    - `names` and `units` (nd,) of the coordinates; lengths are drawn in mm, angles in mrad
    - `has_motor`: True to draw the curve of the motor
    - `unit` of the speeds; `show`: names of panels; `ax`: axes to draw onto

    **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for an unknown panel.
    """
    if isinstance(show, str) or not show or any(name not in PARTS for name in show):
        raise InputError("show", f"is {quoted(show)}; it must be a list of {', '.join(PARTS)}")
    unit, scale = speed_unit(unit)
    kinds = [kind for kind in ("m", "rad") if kind in units]
    drawn = [(name, kind) for name in show for kind in (kinds if name == "amplitude" else ("",))]
    figure, axes = panels(len(drawn), size=(7.2, 2.5), share_x=True, ax=ax)
    for axis, (name, kind) in zip(axes, drawn, strict=True):
        for k, w in enumerate(resonances[(resonances > 0.0) & (resonances <= np.max(curve["speed"]))]):
            axis.axvline(scale * w, color=GUIDE, lw=0.8, ls=":", label=None if k or axis is not axes[0] else "resonance")
        if name in ("amplitude", "phase"):
            which = [k for k, each in enumerate(units) if kind in ("", each)]
            _coordinates(axis, curve, points, scale, name, which, names)
            axis.set_ylabel(f"{name}, { ({'m': 'mm', 'rad': 'mrad', '': 'deg'}[kind]) }")
        elif name == "force":
            _line(axis, curve, points, scale, "foundation_force", 1.0, COLORS[0], "-", "force on the foundation")
            axis.set_ylabel("force, N")
        else:
            _torque(axis, curve, points, folds, scale, has_motor=has_motor)
            axis.set_ylabel("torque, N m")
        if name in ("amplitude", "force"):
            _logarithmic(axis)
        legend_above(axis)
    axes[-1].set(xlabel=f"speed of the exciter, {unit}", xlim=(0.0, scale * float(np.max(curve["speed"]))))
    return figure if ax is None else ax


def _coordinates(
    axis: Axes,
    curve: Mapping[str, np.ndarray],
    points: Mapping[str, np.ndarray],
    scale: float,
    name: str,
    which: Sequence[int],
    names: Sequence[str],
) -> None:
    """Draw amplitudes, in mm or mrad, or phases, in degrees, of the coordinates `which`."""
    for k, number in enumerate(which):

        def of(arrays: Mapping[str, np.ndarray], number: int = number) -> dict[str, np.ndarray]:
            return {**arrays, "shown": arrays[name][:, number]}

        color, stroke = COLORS[k % len(COLORS)], STROKES[k % len(STROKES)]
        lines = of(curve)
        if name == "phase":
            angle = np.unwrap(np.where(np.isfinite(lines["shown"]), lines["shown"], 0.0))
            axis.plot(scale * curve["speed"], np.rad2deg(angle), color=color, ls=stroke, label=names[number])
        else:
            _line(axis, lines, of(points), scale, "shown", 1e3, color, stroke, names[number])


def _line(
    axis: Axes,
    curve: Mapping[str, np.ndarray],
    points: Mapping[str, np.ndarray],
    scale: float,
    name: str,
    factor: float,
    color: str,
    stroke: object,
    label: str,
) -> None:
    """Draw a line and its operating points."""
    axis.plot(scale * curve["speed"], factor * curve[name], color=color, ls=stroke, label=label)
    for x, y, stable in zip(points["speed"], points[name], points["stable"], strict=True):
        axis.plot([scale * x], [factor * y], "o", ms=5.0, mfc=color if stable else "white", mec=color, zorder=4)


def _torque(
    axis: Axes,
    curve: Mapping[str, np.ndarray],
    points: Mapping[str, np.ndarray],
    folds: Mapping[str, np.ndarray],
    scale: float,
    *,
    has_motor: bool,
) -> None:
    """Draw the torque that the vibration needs, the torque of the motor, the operating points and the folds."""
    _line(axis, curve, points, scale, "torque", 1.0, COLORS[0], "-", "needed by the vibration")
    if points["speed"].size:
        label = "operating point" + ("" if np.all(points["stable"]) else "; hollow: unstable")
        axis.plot([], [], "o", ms=5.0, color=COLORS[0], label=label)
    finite = curve["torque"][np.isfinite(curve["torque"])]
    top = float(np.max(finite, initial=0.0))
    if has_motor:
        motor = curve["motor_torque"]
        axis.plot(scale * curve["speed"], motor, color=COLORS[1], ls=STROKES[1], label="of the motor")
        if np.any(np.isfinite(folds["speed"])):
            look = {"ms": 5.0, "mfc": "white", "mec": COLORS[4], "label": "fold: the speed jumps"}
            axis.plot(scale * folds["speed"], folds["torque"], "D", **look)
        top = min(max(top, float(np.max(motor))), 3.0 * float(np.max(motor)))
    if top > 0.0:
        axis.set_ylim(-0.03 * top, 1.08 * top)


def _logarithmic(axis: Axes) -> None:
    """Set a logarithmic axis that covers at most `_DECADES` decades below the largest value."""
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axis.get_lines() if np.size(line.get_xdata()) > 2])
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size == 0:
        return
    top = 2.0 * float(np.max(positive))
    axis.set(yscale="log", ylim=(max(0.5 * float(np.min(positive)), top / 10.0**_DECADES), top))
    log_ticks(axis)
