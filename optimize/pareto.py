"""Trade-offs of two quantities, with the machine at each point."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, shown_unit
from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.units import count
from optimize.quantities.quantity import Demand, Quantity
from optimize.result import Synthesis
from optimize.space import DesignSpace
from optimize.synthesize import synthesize

_SAME_POINT_DIFFERENCE = 1e-6
"""Difference of quantities, relative to the range of the front, below which two machines count as one point."""

_NO_LIMIT = 1e30
"""Limit that no quantity reaches."""


class Front(Result):
    """Machines of a trade-off of two quantities: a machine that is better than another in one quantity is worse in the other.

    Returned by `pareto`.

    **Attributes** (P machines)

    - `values` (P, 2) of the two quantities, with their `names` and `units`
    - `machines`: texts of the scene files of the machines; `scene(k)` returns one of them as a `Scene`
    """

    status = Computed.done

    values: np.ndarray = eqx.field(metadata=in_unit("", "machine", "quantity"))
    names: tuple[str, ...]
    units: tuple[str, ...]
    machines: tuple[str, ...]

    @validated
    def scene(self, k: int) -> Scene:
        """Return the machine of point `k`, counted from 0. **Raises** `InputError` for a point that the front does not have."""
        if count(k, "k", low=0) >= len(self.machines):
            raise InputError("k", f"is {k}; the points of this front are numbered 0 to {len(self.machines) - 1}")
        return scene_from_toml(self.machines[k])

    def summary(self) -> str:
        """Return the names of the quantities, and a line of text for each machine, in the units of `plot`."""
        labels, columns = self._shown()
        return "\n".join(
            [" against ".join(labels), *("  " + "  ".join(f"{x:.5g}" for x in row) for row in zip(*columns, strict=True))]
        )

    def _shown(self) -> tuple[list[str], list[np.ndarray]]:
        """Return names of the quantities with practical units, and their values in these units."""
        labels, columns = [], []
        for name, unit, column in zip(self.names, self.units, self.values.T, strict=True):
            shown, factor = shown_unit(unit, float(np.max(np.abs(column), initial=0.0)))
            labels.append(f"{name}, {shown}".rstrip(", "))
            columns.append(factor * column)
        return labels, columns

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the front; each point is labelled with its number `k`, for which `scene(k)` returns the machine."""
        from jaxvib.draw.charts import front_chart  # slow import

        labels, values = self._shown()
        return front_chart(values[1], values[0], x_label=labels[1], y_label=labels[0], ax=ax)


@validated
def pareto(
    space: DesignSpace,
    first: Quantity,
    second: Quantity,
    *,
    points: int = 9,
    subject_to: Demand | Sequence[Demand] = (),
    starts: int = 32,
    seed: int = 0,
) -> Front:
    """Return the trade-off of two quantities, which are both minimized.

    - At each end of the front, one quantity has its least value. Of all machines with this value, the one with the least value
      of the other quantity is returned
    - Between the ends, upper limits on the second quantity are spaced evenly. For each limit, the first quantity is minimized,
      then the second quantity among machines with this value of the first
    - Each point needs two searches; all searches share their compiled programs
    - A machine is left out if another machine is not worse in any quantity

    **Arguments**

    - `space`: a `DesignSpace`
    - `first` and `second`: the two quantities
    - `points`: largest number of machines, at least 2; typical: 9 (the default). The computing time is proportional to this
      number
    - `subject_to`, `starts`, `seed`: as for `synthesize`; typical: 32 starts (the default) for each point

    **Returns** `Front`, in ascending order of `first`. The front has one machine if this machine has the least values of both.

    **Raises** the errors of `synthesize`; `KeyboardInterrupt` if a search is interrupted.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from optimize import DesignSpace, pareto, spring_cost, static_deflection
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> space = DesignSpace(scene, free={"machine.stiffness": (1e4, 1e5)})
    >>> cost = spring_cost([("10 N/mm", 20.0), ("100 N/mm", 55.0)])
    >>> print(pareto(space, static_deflection(), cost, points=3, starts=2).summary())
    static deflection, mm against cost of the springs
      5.0014  55
      9.0934  37.5
      50.014  20
    """
    count(points, "points", low=2)
    demands = (subject_to,) if isinstance(subject_to, Demand) else tuple(subject_to)

    def values_of(synthesis: Synthesis) -> tuple[float, float]:
        return float(first(synthesis.scene)), float(second(synthesis.scene))

    def search_with_limit(objective: Quantity, other: Quantity, limit: float) -> Synthesis:
        """Search for the least objective with a limit on the other quantity, then for the least value of that quantity among
        machines with the same objective. The second search may fail; its machine counts only if it is not worse."""
        best = synthesize(space, objective, subject_to=[*demands, other < limit], starts=starts, seed=seed, verify=False)
        # A flat objective has many minima; the first search ends at any of them.
        with_best_objective = [*demands, objective < float(objective(best.scene))]
        refined = synthesize(space, other, subject_to=with_best_objective, begin=best, seed=seed, verify=False, throw=False)
        if "interrupted" in (best.status_name, refined.status_name):
            raise KeyboardInterrupt  # a front needs all of its searches
        return refined if not_dominated(np.asarray([values_of(refined), values_of(best)])) == [0] else best

    # This limit excludes only machines that do not have the other quantity. With it, the first two searches have the same form
    # as the later ones, and all searches share two programs.
    lowest = search_with_limit(first, second, _NO_LIMIT)
    highest = search_with_limit(second, first, _NO_LIMIT)
    (_, worst), (_, least) = values_of(lowest), values_of(highest)
    results = [lowest, highest]
    for limit in np.linspace(worst, least, points)[1:-1] if worst > least else ():
        with contextlib.suppress(ComputationError):  # a search may not find a narrow range of feasible machines
            results.append(search_with_limit(first, second, float(limit)))
    values = np.asarray([values_of(result) for result in results])
    indices = not_dominated(values)
    return Front(
        values=values[indices],
        names=(first.words, second.words),
        units=(first.unit, second.unit),
        machines=tuple(scene_to_toml(results[k].scene) for k in indices),
    )


def not_dominated(values: np.ndarray) -> list[int]:
    """Return the indices of rows of `values` (n, q) that no other row dominates, ordered by their first column.

    If rows are equal, one of them is returned. Row a is not worse than row b if a exceeds b in no column by more than a
    tolerance. The tolerance is 1e-6 of the range of the column or 1e-7 of its largest value, whichever is larger, because
    demands are met to this accuracy.
    """
    span = np.maximum(np.ptp(values, axis=0), 0.1 * np.max(np.abs(values), axis=0))
    scaled = values / np.where(span > 0.0, span, 1.0)
    indices: list[int] = []
    for k in np.argsort(np.sum(scaled, axis=1), kind="stable"):  # a row with a larger sum cannot dominate
        if not any(np.all(scaled[j] <= scaled[k] + _SAME_POINT_DIFFERENCE) for j in indices):
            indices.append(int(k))
    return sorted(indices, key=lambda k: (values[k, 0], -values[k, 1]))
