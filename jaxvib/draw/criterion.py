"""Where a prediction of stability agrees with the exact answer."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch

__all__ = ["agreement_map", "pull_chart"]

_KINDS = (
    ("loads gather, both say", "#e7e7e7"),
    ("balance, both say", "#8fbf9f"),
    ("balance foretold, not so", "#c8553d"),
    ("balance missed", "#3d6fc8"),
)


def agreement_map(ax: Axes, speed: np.ndarray, height: np.ndarray, predicted: np.ndarray, exact: np.ndarray) -> list[Patch]:
    """Colours the plane of speed (S,) rad/s and another number (H,), log scale, by two Boolean arrays (H, S).

    **Returns** the entries of a legend.

    >>> import matplotlib.pyplot as plt, numpy as np
    >>> ax = plt.figure().subplots()
    >>> entries = agreement_map(ax, np.array([1.0, 2.0]), np.array([0.1, 1.0]), np.eye(2) > 0, np.eye(2) > 0)
    >>> entries[2].get_label()
    'balance foretold, not so'
    """
    both = np.where(predicted == exact, np.where(exact, 1, 0), np.where(predicted, 2, 3))
    colours = ListedColormap([colour for _, colour in _KINDS])
    norm = BoundaryNorm(np.arange(len(_KINDS) + 1) - 0.5, len(_KINDS))
    ax.pcolormesh(speed, height, both, cmap=colours, norm=norm, shading="nearest", rasterized=True)
    if np.size(height) > 1:
        ax.set_yscale("log")
    ax.set_xlabel("rotor speed, rad/s")
    return [Patch(color=colour, label=label) for label, colour in _KINDS]


def pull_chart(
    ax: Axes,
    speed: np.ndarray,
    pull: np.ndarray,
    balancing: list[list[float | None]],
    exact: list[list[float]] | None = None,
) -> None:
    """The criterion's functional (S,) over rotor speed (S,) rad/s; balancing intervals shaded, exact ones a bar below.

    The functional spans many decades near resonances, so its sign and size are drawn on a symmetric log scale.

    >>> import matplotlib.pyplot as plt, numpy as np
    >>> ax = plt.figure().subplots()
    >>> pull_chart(ax, np.array([1.0, 2.0, 3.0]), np.array([1.0, -2.0, -1.0]), [[1.5, None]])
    >>> ax.get_ylabel()
    'f: gathering > 0, balancing < 0'
    """
    size = np.abs(pull[np.isfinite(pull)])
    ax.plot(speed, pull, color="black", linewidth=1.0)
    ax.set_yscale("symlog", linthresh=np.median(size[size > 0.0]) if np.any(size > 0.0) else 1.0)
    ax.axhline(0.0, color="grey", linewidth=0.5)
    for start, end in balancing:
        ax.axvspan(start or 0.0, speed[-1] if end is None else min(end, speed[-1]), color=_KINDS[1][1], alpha=0.5, linewidth=0)
    for start, end in exact or []:
        ax.axvspan(start, end, ymax=0.03, color="black", linewidth=0)
    legend = [Patch(color=_KINDS[1][1], alpha=0.5, label="balancing, by the criterion")]
    legend += [Patch(color="black", label="balancing, exactly")] if exact is not None else []
    ax.legend(handles=legend, loc="lower right")
    ax.set_xlim(speed[0], speed[-1])
    ax.set_xlabel("rotor speed, rad/s")
    ax.set_ylabel("f: gathering > 0, balancing < 0")
