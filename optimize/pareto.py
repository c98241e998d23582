"""Trade-offs of two quantities, with the machine behind each point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from jaxvib.errors import ComputationError
from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.units import count
from optimize.result import Synthesis
from optimize.space import DesignSpace
from optimize.space.numbers import shown_unit
from optimize.synthesize import synthesize
from optimize.wishes.quantity import Demand, Quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn

__all__ = ["Front", "pareto"]


_ALIKE = 1e-6
"""Machines whose quantities differ by less, relative, are one point."""


class Front(Result):
    """Machines of which none is better in one quantity without being worse in the other.

    **Attributes** (P machines): `values` (P, 2) of the two quantities; `names`, `units` of these; `machines` the scenes as the
    texts of scene files; `scene(k)` is one of them.
    """

    status = Computed.done

    values: np.ndarray = eqx.field(metadata=in_unit("", "machine", "quantity"))
    names: tuple[str, ...]
    units: tuple[str, ...]
    machines: tuple[str, ...]

    def scene(self, k: int) -> Scene:
        """The machine behind a point."""
        return scene_from_toml(self.machines[k])

    def summary(self) -> str:
        """A line a machine, in the units of `plot`."""
        labels, columns = self._shown()
        return "\n".join(
            [" against ".join(labels), *("  " + "  ".join(f"{x:.5g}" for x in row) for row in zip(*columns, strict=True))]
        )

    def _shown(self) -> tuple[list[str], list[np.ndarray]]:
        """The quantities with the units in which a designer reads them, and their values in these."""
        labels, columns = [], []
        for name, unit, column in zip(self.names, self.units, self.values.T, strict=True):
            shown, factor = shown_unit(unit, float(np.max(np.abs(column), initial=0.0)))
            labels.append(f"{name}, {shown}".rstrip(", "))
            columns.append(factor * column)
        return labels, columns

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """The front, each point with the number by which `scene` gives its machine.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.charts import front_chart  # slow to import: only who draws pays

        labels, values = self._shown()
        return front_chart(values[1], values[0], across=labels[1], up=labels[0], ax=ax)


def pareto(
    space: DesignSpace,
    first: Quantity,
    second: Quantity,
    *,
    points: int = 9,
    subject_to: Sequence[Demand] = (),
    starts: int = 32,
    seed: int = 0,
) -> Front:
    """The trade-off of two quantities that both shall be small: the least of the first for each of some limits on the second.

    The limits are spread evenly from the second's least value to what it is where the first is least. Each point is a search
    of its own; all of them share their programs.

    **Arguments**: `points` at most so many machines, the rest as `synthesize`.

    **Returns** `Front`, machines with the least `first` first; a single one where it is the best of both. **Raises** as
    `synthesize`.
    """
    count(points, "points", low=2)

    def search(objective: Quantity, demands: Sequence[Demand]) -> Synthesis:
        return synthesize(space, objective, subject_to=demands, starts=starts, seed=seed, verify=False)

    def both(found: Synthesis) -> tuple[float, float]:
        return float(first(found.scene)), float(second(found.scene))

    given = list(subject_to)
    ends = [search(first, given), search(second, given)]
    (_, worst), (_, least) = (both(end) for end in ends)
    found = [ends[0]]
    # Where one machine is the best of both there is nothing to give up.
    limits = [] if np.isclose(worst, least, rtol=_ALIKE, atol=0.0) else np.linspace(worst, least, points)[1:]
    for limit in limits:
        try:
            found.append(search(first, [*given, second < float(limit)]))
        except ComputationError:  # the least value itself may be out of reach by a rounding
            continue
    values = np.asarray([both(each) for each in found])
    kept: list[int] = []
    for k, own in enumerate(values):
        beaten = np.any(np.all(values < own * (1.0 - 1e-9 * np.sign(own)), axis=1))
        if not beaten and not any(np.allclose(values[j], own, rtol=_ALIKE, atol=0.0) for j in kept):
            kept.append(k)
    return Front(
        values=values[kept],
        names=(first.words, second.words),
        units=(first.unit, second.unit),
        machines=tuple(scene_to_toml(found[k].scene) for k in kept),
    )
