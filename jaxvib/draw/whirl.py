"""Campbell diagrams."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jaxvib.draw.style import COLORS, GUIDE, OPERATING, Drawn, SpeedUnit, legend_above, panels, speed_scale

__all__ = ["campbell_diagram"]


def campbell_diagram(
    rotor_speed: np.ndarray,
    speed: np.ndarray,
    forward: np.ndarray,
    *,
    critical: tuple[np.ndarray, np.ndarray] | None = None,
    at: float | None = None,
    unit: SpeedUnit = "rad/s",
    ax: Axes | None = None,
) -> Drawn:
    """Whirl speeds (ns, nd) rad/s over rotor speed (ns,) rad/s, drawn in `unit`: forward ones solid, backward ones dashed; the
    line w = n with the `critical` speeds (k,), forward or not (k,), written beside it; `at` the operating speed.

    >>> import numpy as np
    >>> n = np.linspace(0.0, 2.0, 5)
    >>> len(campbell_diagram(n, np.ones((5, 1)), np.ones((5, 1), dtype=bool)).axes)
    1
    """
    scale = speed_scale(unit)
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    for with_rotor, line, color, label in ((True, "-", COLORS[0], "forward whirl"), (False, "--", COLORS[1], "backward whirl")):
        # The k-th motion of one sense keeps its place among its kind while speeds of different sense cross.
        count = int(np.max(np.sum(forward == with_rotor, axis=1), initial=0))
        for k in range(count):
            values = np.full(len(rotor_speed), np.nan)
            for i, (w, f) in enumerate(zip(speed, forward, strict=True)):
                own = np.sort(w[f == with_rotor])
                values[i] = own[k] if k < len(own) else np.nan
            alone = {"marker": "o", "ms": 4.0} if len(rotor_speed) == 1 else {}
            axis.plot(scale * rotor_speed, scale * values, ls=line, color=color, label=None if k else label, **alone)
    found = np.zeros(0) if critical is None else critical[0][np.isfinite(critical[0])]
    right = scale * max(float(np.max(rotor_speed)), 0.0 if at is None else 1.05 * at)
    top = 1.12 * scale * max(float(np.nanmax(speed)), *(w for w in found if scale * w <= right), 1e-300)
    axis.plot([0.0, top], [0.0, top], color=GUIDE, lw=0.9, ls=":", label="whirl speed = rotor speed")
    if critical is not None:
        _critical_marks(axis, scale * critical[0], critical[1], right, top)
        axis.plot([], [], "o", ms=6.0, mfc="white", mec="black", label=f"critical speeds (no damping), {unit}", ls="")
    if at is not None:
        axis.axvline(scale * at, label="operating speed", **OPERATING)
    left = scale * float(np.min(rotor_speed)) if len(rotor_speed) > 1 else 0.0
    axis.set_xlim(left, right)
    axis.set_ylim(0.0, top)
    axis.set_xlabel(f"rotor speed, {unit}")
    axis.set_ylabel(f"whirl speed, {unit}")
    legend_above(axis, 3)
    return figure if ax is None else ax


def _critical_marks(axis: Axes, speed: np.ndarray, forward: np.ndarray, right: float, top: float) -> None:
    """Points on the synchronous line, and their speeds beside lines that drop to the axis; close ones in one text."""
    order = [k for k in np.argsort(speed) if np.isfinite(speed[k]) and speed[k] <= right]
    groups: list[list[int]] = []
    for k in order:
        look = {"mfc": "white", "mec": COLORS[0] if forward[k] else COLORS[1], "mew": 1.4, "zorder": 4}
        axis.plot([speed[k]], [speed[k]], "o" if forward[k] else "s", ms=6.0, **look)
        axis.vlines(float(speed[k]), 0.0, float(speed[k]), color=GUIDE, lw=0.7, zorder=1.2)
        near = groups and speed[k] - speed[groups[-1][-1]] < 0.035 * right
        groups = [*groups[:-1], [*groups[-1], k]] if near else [*groups, [k]]
    for group in groups:
        word = ", ".join(f"{speed[k]:.4g} {'forward' if forward[k] else 'backward'}" for k in group)
        at = (speed[group[-1]], 0.02 * top)
        axis.annotate(word, at, xytext=(3, 0), textcoords="offset points", rotation=90, va="bottom", fontsize="small")
