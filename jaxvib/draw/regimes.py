"""Chart of the regimes of loads over their drag."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import COLORS, legend_above, log_ticks, panels

HATCHES = ("", "///", "...", "\\\\\\", "xxx", "---", "ooo")
"""Hatches that distinguish neighbouring areas in greyscale."""


def regime_chart(
    drag: np.ndarray,
    shares: Mapping[str, np.ndarray],
    omega: np.ndarray,
    rotor_speed: float,
    *,
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw the fractions of regimes as stacked bars, and the speeds of the loads, over their drag.

    `drag` (n,) is in N s/m, `shares` are fractions (n,) by regime, and `omega` (n, starts) and `rotor_speed` are in rad/s,
    drawn in `unit`.

    >>> import numpy as np
    >>> figure = regime_chart(np.array([1.0, 2.0]), {"jammed": np.array([1.0, 0.5])}, np.ones((2, 3)), 2.0)
    >>> len(figure.axes)
    2
    """
    figure, (top, bottom) = panels(2, size=(7.5, 2.8), share_x=True, ax=ax)
    unit, scale = speed_unit(unit)
    # Bars of a few, distant values are narrow: they must not look like statements about the values between them.
    width = min(0.9 * np.min(np.diff(np.log(drag))), 0.06 * np.log(drag[-1] / drag[0])) if len(drag) > 1 else 0.1
    low = np.zeros(len(drag))
    for k, (kind, share) in enumerate(shares.items()):
        look = {"color": COLORS[k % len(COLORS)], "hatch": HATCHES[k % len(HATCHES)], "edgecolor": "white", "lw": 0.0}
        top.bar(drag, 100.0 * share, bottom=low, width=drag * width, label=kind, **look)
        low = low + 100.0 * share
    top.set(ylabel="share of the starts, %", ylim=(0.0, 100.0))
    legend_above(top, 4)
    bottom.plot(
        np.repeat(drag, omega.shape[1]),
        scale * omega.ravel(),
        ".",
        color=COLORS[0],
        ms=4.0,
        alpha=0.6,
        label="loads, each start",
    )
    bottom.axhline(scale * rotor_speed, color="black", lw=1.0, ls="--", label="rotor")
    bottom.set(ylabel=f"speed of loads, {unit}", xlabel="drag, N s/m", xscale="log")
    log_ticks(bottom, "x")
    legend_above(bottom)
    return figure if ax is None else ax
