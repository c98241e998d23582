"""Comparison of the criterion of auto-balancing with exact stability over rotor speed, load mass and drag."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit
from jaxvib.equations.linear import turning_loads
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.runtime.parallel import in_parallel
from jaxvib.steady.balance.criterion import criterion
from jaxvib.steady.balance.states import balanced_growth, decays_over_turn, stability_changes


class CriterionMap(Result):
    """Comparison of the criterion with exact stability for a machine with lighter or heavier loads and weaker or stronger drag.

    **Attributes** (D drags, M masses, S speeds, B = 2 nd - 1 boundaries for nd coordinates)

    - `speeds` (S,), rad/s; `mass_factor` (M,) and `drag_factor` (D,): factors on the mass and drag of the scene's loads
    - `predicted` (M, S): True if the criterion predicts stable auto-balancing (it does not depend on the drag)
    - `growth` (D, M, S), 1/s: exact growth rate, stable if negative
    - `agreement` (D, M): share of the rotor speeds at which criterion and exact stability agree
    - `boundary` (M, B), rad/s: the boundaries of the criterion, ascending, NaN for an absent boundary
    - `shift` (D, M, B): (exact - predicted)/predicted for each lower or upper end of an interval of the criterion. Each end
      is compared with the same end of the exact interval of stability that overlaps most with this interval; NaN if no exact
      end is in the range of speeds
    """

    status = Computed.done

    speeds: np.ndarray = eqx.field(metadata=in_unit("rad/s", "speeds"))
    mass_factor: np.ndarray = eqx.field(metadata=in_unit("", "mass_factor"))
    drag_factor: np.ndarray = eqx.field(metadata=in_unit("", "drag_factor"))
    predicted: np.ndarray = eqx.field(metadata=in_unit("", "mass_factor", "speeds"))
    growth: np.ndarray = eqx.field(metadata=in_unit("1/s", "drag_factor", "mass_factor", "speeds"))
    agreement: np.ndarray = eqx.field(metadata=in_unit("", "drag_factor", "mass_factor"))
    boundary: np.ndarray = eqx.field(metadata=in_unit("rad/s", "mass_factor", "end"))
    shift: np.ndarray = eqx.field(metadata=in_unit("", "drag_factor", "mass_factor", "end"))

    def summary(self) -> str:
        """Return a table as text: the share of rotor speeds at which criterion and exact stability agree, and the mean modulus
        of the shift of the boundaries."""
        lines = ["share of rotor speeds with the right prediction (mean shift of the boundaries)"]
        lines.append("drag factor \\ mass factor " + "".join(f"{m:>16.3g}" for m in self.mass_factor))
        for d, factor in enumerate(self.drag_factor):
            cells = []
            for m in range(self.mass_factor.size):
                shift = np.abs(self.shift[d, m][~np.isnan(self.shift[d, m])])
                mean = f" ({100.0 * np.mean(shift):.2f} %)" if shift.size else ""
                cells.append(f"{self.agreement[d, m]:.3f}{mean}")
            lines.append(f"{factor:>16.3g}" + "".join(f"{cell:>16}" for cell in cells))
        return "\n".join(lines)

    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot agreement and disagreement of the criterion over rotor speed in `unit` and load mass, one panel for each drag,
        onto as many axes `ax` if given.
        """
        from jaxvib.draw.criterion import agreement_maps  # slow import

        maps = [(f"drag x {d:.3g}", growth < 0.0) for d, growth in zip(self.drag_factor, self.growth, strict=True)]
        return agreement_maps(self.speeds, self.mass_factor, self.predicted, maps, unit=unit, ax=ax)


@validated
def criterion_map(
    scene: Scene, *, speeds: Sequence[float], mass: Sequence[float], drag: Sequence[float], steps: int | None = None
) -> CriterionMap:
    """Compare `criterion` with the exact stability of the balanced motion over rotor speed, load mass and drag.

    **Arguments**

    - `scene` with loads on a circle; exact stability is that of the first arrangement of `balanced_states`
    - `speeds`, rad/s, ascending; typical: 50 to 200 from half the lowest to twice the highest resonance
    - `mass` and `drag`: factors greater than 0, times the mass and the drag of the scene's loads; typical: 0.1 to 10
    - `steps`: as for `balanced_states(scene).stability`; default: the number that the natural frequencies need. The computing
      time is proportional to this number

    **Returns** `CriterionMap`.

    **Raises** `InputError` for values that are not positive or not ascending, and the errors of
    `balanced_states(scene).stability`.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(40.0))
    >>> found = jv.criterion_map(scene, speeds=[20.0, 26.0, 29.5, 40.0], mass=[0.1, 2.0], drag=[1.0], steps=24)
    >>> found.agreement.tolist()
    [[1.0, 0.75]]

    Source: the limits of the criterion are named in Filimonikhin et al. 2022, section 6, without numbers.
    """
    axes = {"speeds": speeds, "mass": mass, "drag": drag}
    values = {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in axes.items()}
    for name, value in values.items():
        bad = value.ndim != 1 or not value.size or not np.all(np.isfinite(value)) or np.any(value <= 0.0)
        if bad or np.any(np.diff(value) <= 0.0):
            raise InputError(name, "must be an ascending list of at least one number; all numbers must be greater than 0")
    grid, mass_factor, drag_factor = values.values()

    scene_loads = turning_loads(scene, at_one_point=True)

    def scene_with(m: jax.Array, d: float = 1.0) -> Scene:
        factors = scene_loads.mass * m, scene_loads.drag * d
        loads = eqx.tree_at(lambda x: (x.mass, x.drag), scene_loads, factors)
        return eqx.tree_at(lambda s: s.loads, scene, loads)

    results = [criterion(scene_with(jnp.asarray(m))) for m in mass_factor]
    predicted = np.stack([np.asarray(result.balances(jnp.asarray(grid))) for result in results])
    boundary = np.stack([np.sort([*r.speeds.damped_resonances, *r.speeds.damped_additional]) for r in results])
    growth = np.zeros((drag_factor.size, mass_factor.size, grid.size))
    shift = np.full((drag_factor.size, *boundary.shape), np.nan)

    def exact(cell: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        d, m = cell
        scene_of_cell = scene_with(jnp.asarray(mass_factor[m]), drag_factor[d])
        growth = balanced_growth(scene_of_cell, grid, steps=steps)
        stable = decays_over_turn(grid, growth)
        changes = stability_changes(scene_of_cell, grid, stable, rtol=1e-5, steps=steps)
        ends = [*([np.nan] if stable[0] else []), *changes, *([np.nan] if stable[-1] else [])]
        return growth, _shifts(np.reshape(ends, (-1, 2)), grid, boundary[m])

    for cell, found in in_parallel(exact, np.ndindex(shift.shape[:2])):
        growth[cell], shift[cell] = found
    agreement = np.mean((growth < 0.0) == predicted[None], axis=-1)
    return CriterionMap(grid, mass_factor, drag_factor, predicted, growth, agreement, boundary, shift)


def _shifts(exact: np.ndarray, grid: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """Return the relative shifts of the ends of each interval of the criterion, compared with the exact interval that overlaps
    most with it.

    The interval with the largest overlap is used, because a second, short interval of stability can exist at a resonance.
    """
    shifts = np.full(boundary.shape, np.nan)
    low, high = np.nan_to_num(exact[:, 0], nan=grid[0]), np.nan_to_num(exact[:, 1], nan=grid[-1])
    for k in range(0, boundary.size, 2):
        start, end = boundary[k], boundary[k + 1] if k + 1 < boundary.size else np.inf
        shared = np.minimum(high, np.inf if np.isnan(end) else end) - np.maximum(low, start)
        if shared.size and np.max(shared) > 0.0:
            interval = exact[np.argmax(shared)]
            shifts[k] = interval[0] / start - 1.0
            if np.isfinite(end):
                shifts[k + 1] = interval[1] / end - 1.0
    return shifts
