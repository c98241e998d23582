"""Where a prediction of stability agrees with the exact answer."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch

__all__ = ["agreement_map"]

_KINDS = (
    ("loads gather, both say", "#e7e7e7"),
    ("balance, both say", "#8fbf9f"),
    ("balance foretold, not so", "#c8553d"),
    ("balance missed", "#3d6fc8"),
)


def agreement_map(
    ax: Axes, speed: np.ndarray, height: np.ndarray, predicted: np.ndarray, exact: np.ndarray
) -> list[Patch]:
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
