"""Printed numbers against computed ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxvib.draw.style import COLORS, Drawn, panels
from jaxvib.study.published.entry import MISPRINT, NOT_REPRODUCIBLE, REPRODUCED, PublishedRow

__all__ = ["verdict_chart"]

_LOOKS = {REPRODUCED: ("o", COLORS[0]), MISPRINT: ("D", COLORS[1]), NOT_REPRODUCIBLE: ("x", COLORS[2])}
_LEAST, _MOST = 1e-9, 30.0


def verdict_chart(rows: Sequence[PublishedRow], *, ax: Axes | None = None) -> Drawn:
    """Relative differences of printed and computed numbers, a line for each row, its bound a bar, a mark for each verdict;
    what cannot be computed stands at the right."""
    figure, (axes,) = panels(1, size=(9.0, 1.6 + 0.2 * max(len(rows), 4)), ax=ax)
    for k, row in enumerate(rows):
        mark, color = _LOOKS[row.verdict]
        size = abs(row.printed) or 1.0
        off = abs(row.difference) / size
        place = np.clip(off, _LEAST, _MOST) if np.isfinite(off) else _MOST
        axes.plot(place, k, mark, color=color, ms=5)
        axes.plot(np.clip(row.within / size, _LEAST, _MOST), k, "|", color="#777777", ms=8)
    for verdict, (mark, color) in _LOOKS.items():
        axes.plot([], [], mark, color=color, label=verdict)
    axes.plot([], [], "|", color="#777777", ms=8, label="bound")
    axes.set_xscale("log")
    axes.set_xlim(0.5 * _LEAST, 2.0 * _MOST)
    axes.set_yticks(range(len(rows)), [f"{row.paper}: {row.quantity}" for row in rows], fontsize=7)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel("computed less printed, relative (right edge: nothing to compute)")
    axes.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=4, fontsize=8)
    return figure if ax is None else ax
