"""Charts of the criterion of auto-balancing, and of its agreement with the exact stability."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_unit
from jaxvib.draw.style import GUIDE, WORKING, cell_edges, legend_above, log_ticks, panels

_KINDS = (
    ("loads gather (both agree)", "#ececec"),
    ("loads balance (both agree)", "#9bd3c7"),
    ("criterion predicts balance, wrongly", "#d55e00"),
    ("balance not predicted", "#004488"),
)


def agreement_maps(
    speed: np.ndarray,
    height: np.ndarray,
    predicted: np.ndarray,
    maps: Sequence[tuple[str, np.ndarray]],
    *,
    unit: SpeedUnit | None = None,
    ax: Onto = None,
) -> Drawn:
    """Draw maps over rotor speed and load mass, coloured by the agreement of predicted and exact balancing.

    **Arguments** (S speeds, H load masses)

    - `speed` (S,): rotor speed, rad/s, drawn in `unit`
    - `height` (H,): load mass relative to that of the scene, on a log scale
    - `predicted` (H, S): True if the criterion predicts balancing
    - `maps`: a panel for each (title, exact), `exact` (H, S) True if the loads balance
    """
    colours = ListedColormap([colour for _, colour in _KINDS])
    norm = BoundaryNorm(np.arange(len(_KINDS) + 1) - 0.5, len(_KINDS))
    unit, scale = speed_unit(unit)
    is_log = np.size(height) > 1
    figure, axes = panels(1, len(maps), size=(3.8, 3.6), ax=ax)
    for axis, (title, exact) in zip(axes, maps, strict=True):
        kind = np.where(predicted == exact, np.where(exact, 1, 0), np.where(predicted, 2, 3))
        corners = cell_edges(scale * speed), cell_edges(height, is_log)
        axis.pcolormesh(*corners, kind, cmap=colours, norm=norm, rasterized=True)
        if is_log:
            axis.set_yscale("log")
            log_ticks(axis)
        axis.set_xlabel(f"rotor speed, {unit}")
        axis.set_title(title, loc="right", fontsize="medium")
    axes[0].set_ylabel("load mass / load mass of the scene")
    entries = [Patch(color=colour, label=label) for label, colour in _KINDS]
    if ax is None:
        figure.legend(handles=entries, loc="outside upper left", ncols=min(2, len(maps)), fontsize="small", frameon=False)
    else:
        legend_above(axes[0], 1, handles=entries)
    return figure if ax is None else ax


def criterion_chart(
    ax: Axes,
    speed: np.ndarray,
    functional: np.ndarray,
    balancing: list[list[float | None]],
    exact: list[list[float]] | None = None,
    at: float | None = None,
) -> None:
    """Draw the `functional` of the criterion (S,), kg m^2, over the rotor `speed` (S,), rad/s.

    The intervals `balancing` of the criterion (start, end), rad/s, are shaded; None is an open end. The intervals `exact` of
    the exact stability, rad/s, are bars at the bottom. `at` is the working speed, rad/s. The functional spans many decades
    near resonances; therefore its scale is that of arsinh, which is logarithmic for large values of both signs and smooth at 0.

    >>> import matplotlib.pyplot as plt, numpy as np
    >>> ax = plt.figure().subplots()
    >>> criterion_chart(ax, np.array([1.0, 2.0, 3.0]), np.array([1.0, -2.0, -1.0]), [[1.5, None]])
    >>> ax.get_ylabel()
    'criterion f, kg m²'
    """
    size = np.abs(functional[np.isfinite(functional)])
    unit, scale = speed_unit()
    speed = scale * speed
    ax.plot(speed, functional, color="black", linewidth=1.0)
    width = float(np.median(size[size > 0.0])) if np.any(size > 0.0) else 1.0
    ax.set_yscale("asinh", linear_width=width)
    least, most = np.ceil(np.log10(width)), np.floor(np.log10(max(width, np.max(size, initial=0.0))))
    decades = 10.0 ** np.arange(least, max(most, least) + 1.0)
    ax.set_yticks([*-decades[::-1], 0.0, *decades], minor=False)
    ax.yaxis.set_minor_locator(NullLocator())
    ax.axhline(0.0, color=GUIDE, linewidth=0.8)
    for start, end in balancing:
        ax.axvspan(
            scale * (start or 0.0),
            speed[-1] if end is None else min(scale * end, speed[-1]),
            color=_KINDS[1][1],
            alpha=0.5,
            linewidth=0,
        )
    for start, end in exact or []:
        ax.axvspan(scale * start, scale * end, ymax=0.03, color="black", linewidth=0)  # below the text at 0.08
    legend: list[Patch | Line2D] = [Patch(color=_KINDS[1][1], alpha=0.5, label="balancing, by the criterion")]
    legend += [Patch(color="black", label="balancing, exactly")] if exact is not None else []
    if at is not None:
        legend.append(ax.axvline(scale * at, label="working speed", **WORKING))
    legend_above(ax, handles=legend)
    for y, words in ((0.96, "f > 0: loads gather"), (0.08, "f < 0: loads balance the rotor")):
        ax.text(0.99, y, words, transform=ax.transAxes, ha="right", va="center", fontsize="small", color="#555555")
    ax.set(xlim=(speed[0], speed[-1]), xlabel=f"rotor speed, {unit}", ylabel="criterion f, kg m²")
