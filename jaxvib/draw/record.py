"""Chart of a record and the model fitted to it."""

from __future__ import annotations

import numpy as np

from jaxvib.draw.style import COLORS, GUIDE, Drawn, Onto, legend_above, panels


def record_chart(time: np.ndarray, angle: np.ndarray, fitted: np.ndarray, noise: float, *, ax: Onto = None) -> Drawn:
    """Draw the recorded and the fitted angle over time, and their difference in a second panel, in degrees.

    `time` (n,) is in s, `angle` and `fitted` (n,) are in rad. The difference, fit minus record, is compared with twice the
    `noise`, rad.

    >>> import numpy as np
    >>> len(record_chart(np.arange(3.0), np.zeros(3), np.ones(3), 0.1).axes)
    2
    """
    degrees = 180.0 / np.pi
    figure, (top, bottom) = panels(2, size=(9.0, 2.6), share_x=True, ax=ax)
    top.plot(time, degrees * fitted, color=COLORS[0], lw=0.8, label="fit")
    top.plot(time, degrees * angle, ".", color=COLORS[1], ms=2.5, label="record")
    top.set_ylabel("angle, deg")
    legend_above(top)
    bottom.plot(time, degrees * (fitted - angle), ".", color=COLORS[0], ms=2.5)
    for sign in (-2.0, 2.0):
        bottom.axhline(sign * degrees * noise, color=GUIDE, lw=0.9, ls=":", label="twice the noise" if sign > 0.0 else None)
    legend_above(bottom)
    bottom.set_ylabel("fit - record, deg")
    bottom.set_xlabel("time, s")
    return figure if ax is None else ax
