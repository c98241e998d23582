"""Campbell diagrams."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

__all__ = ["campbell_diagram"]


def campbell_diagram(rotor_speed: np.ndarray, speed: np.ndarray, forward: np.ndarray, *, ax: Axes | None = None) -> Figure:
    """Whirl speeds (ns, nd) rad/s over rotor speed (ns,) rad/s: forward ones solid, backward ones dashed; the line w = n.

    >>> import numpy as np
    >>> n = np.linspace(0.0, 2.0, 5)
    >>> len(campbell_diagram(n, np.ones((5, 1)), np.ones((5, 1), dtype=bool)).axes)
    1
    """
    figure, (axis,) = panels(1, size=(7.0, 4.6), ax=ax)
    for with_rotor, line, color, label in ((True, "-", COLORS[0], "forward"), (False, "--", COLORS[1], "backward")):
        # The k-th motion of one sense keeps its place among its kind while speeds of different sense cross.
        count = int(np.max(np.sum(forward == with_rotor, axis=1), initial=0))
        for k in range(count):
            values = np.full(len(rotor_speed), np.nan)
            for i, (w, f) in enumerate(zip(speed, forward, strict=True)):
                own = np.sort(w[f == with_rotor])
                values[i] = own[k] if k < len(own) else np.nan
            axis.plot(rotor_speed, values, ls=line, color=color, label=None if k else label)
    top = float(np.nanmax(speed)) * 1.1
    axis.plot([0.0, top], [0.0, top], color="#999999", lw=0.9, ls=":", label="whirl = rotor")
    axis.set_xlim(float(np.min(rotor_speed)), float(np.max(rotor_speed)))
    axis.set_ylim(0.0, top)
    axis.set_xlabel("rotor speed, rad/s")
    axis.set_ylabel("whirl speed, rad/s")
    axis.legend(loc="upper left")
    return figure
