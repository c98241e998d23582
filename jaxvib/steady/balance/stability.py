"""Stability of a balanced motion: the result."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from jaxvib.display import Axes, Drawn
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result


class StabilityStatus(eqx.Enumeration):
    """Stability of a balanced motion. The value of each member is the message shown to the user."""

    stable = "deviations from the balanced motion decay"
    unstable = "deviations from the balanced motion grow"
    undecided = "deviations from the balanced motion change during a turn by less than the error of the computation"


class BalancedStability(Result):
    """Stability of a balanced motion by the Floquet multipliers of the full equations over one turn of the rotor.

    **Attributes**

    - `stable`: True if deviations decay
    - `is_decided`: True if the growth over a turn is larger than the error of the computation
    - `growth`, 1/s: the largest growth rate of a deviation (if negative: the slowest decay), without neutral directions
    - `multipliers` (2 (nd + N),), complex, the largest first
    - `neutral`: the number of multipliers that are 1 because the arrangements form a family (at least by a common rotation)
    - `error` of the multipliers, estimated from half the number of steps
    """

    stable: bool = eqx.field(metadata=in_unit(""))
    is_decided: bool = eqx.field(metadata=in_unit(""))
    growth: float = eqx.field(metadata=in_unit("1/s"))
    multipliers: np.ndarray = eqx.field(metadata=in_unit("", "floquet"))
    neutral: int = eqx.field(metadata=in_unit(""))
    error: float = eqx.field(metadata=in_unit(""))

    @property
    def status(self) -> StabilityStatus:
        """Outcome, a `StabilityStatus`."""
        if not self.is_decided:
            return StabilityStatus.undecided
        return StabilityStatus.stable if self.stable else StabilityStatus.unstable

    def summary(self) -> str:
        """Return the stability and the growth rate as text."""
        largest = ", ".join(f"{abs(m):.6g}" for m in self.multipliers[:3])
        return (
            f"{self.message} at {self.growth:.4g} 1/s; largest multipliers {largest}, {self.neutral} of them neutral, "
            f"with an error of {self.error:.1e}"
        )

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the multipliers in the complex plane, and the unit circle.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.results import multiplier_chart  # slow import

        return multiplier_chart(np.asarray(self.multipliers), ax=ax)
