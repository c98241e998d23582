"""Error and computing time of one quantity by several methods: the table, the fastest method, the figure."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed

T = TypeVar("T")

SHOWN_ERRORS = (1e-2, 1e-4, 1e-6)
"""Errors for which tables and figures show the fastest method."""

_MAX_TIMING_SECONDS = 1.0
"""Total time after which a timing is not repeated, s."""


class CostRow(NamedTuple):
    """Cost of one method.

    **Attributes**: names of the `tier`, the `method` and the `dtype`; `setting`: a tolerance or a number of points, as text;
    relative `error`; `seconds` of a compiled call; `compile`: additional seconds of the first call.
    """

    tier: str
    method: str
    dtype: str
    setting: str
    error: float
    seconds: float
    compile: float


class Cost(Result):
    """Error and computing time of one quantity by every method.

    Returned by `work_precision`.

    **Attributes**

    - `quantity`: name of the quantity
    - `reference`: its reference values, SI; for a final state the entries divided by their scales (displacements and
      velocities: the largest modulus at the end of the run; angles: 1 rad; rates: the rotor speed)
    - `reference_error`: relative error of these values
    - `rows`: a `CostRow` for each tier, method, tolerance and dtype
    - `left_out`: for each tier that cannot compute the quantity, a sentence with the reason
    """

    status = Computed.done

    quantity: str
    reference: list[float] = eqx.field(metadata=in_unit("", "entry"))
    reference_error: float = eqx.field(metadata=in_unit(""))
    rows: list[CostRow] = eqx.field(metadata=in_unit("", "way", name="way"))
    left_out: tuple[str, ...] = ()

    @validated
    def cheapest(self, error: float) -> CostRow | None:
        """Return the row of the fastest method whose relative error, plus that of the reference, is at most `error`.

        **Arguments**: `error`: largest allowed relative error; typical: 1e-2 to 1e-6.

        **Returns** None if no method is accurate enough, or if the reference is not accurate enough.
        """
        if not self.reference_error < error:
            return None
        accurate = [row for row in self.rows if row.error + self.reference_error <= error]
        return min(accurate, key=lambda row: row.seconds, default=None)

    def summary(self) -> str:
        """Return the fastest method for each of `SHOWN_ERRORS`, and the omitted tiers, as text."""
        lines = [
            f"{self.quantity.replace('_', ' ')}: {len(self.rows)} methods, error of the reference {self.reference_error:.1e}"
        ]
        for limit in SHOWN_ERRORS:
            row = self.cheapest(limit)
            method = "none here" if row is None else f"{', '.join(x for x in row[:4] if x)}: {row.seconds:.3g} s"
            lines.append(f"  to {limit:.0e}: {method}")
        return "\n".join([*lines, *(f"  {reason}" for reason in self.left_out)])

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot error over computing time, with a line for each method; see `cost_figure`."""
        return cost_figure({"": self}, ax=ax)


def cost_figure(costs: Mapping[str, Cost], *, ax: Onto = None) -> Drawn:
    """Plot error over computing time, with a panel for each of `costs`. A method has the same line style in all panels.

    Rings mark the fastest method for each of `SHOWN_ERRORS`.

    **Arguments**: `costs`: a mapping from the title of each panel to its `Cost`; typical: 1 to 4 panels; `ax`: as many axes;
    default: a new figure.

    **Returns** a matplotlib figure, or the given `ax`.

    >>> import jaxvib as jv
    >>> rows = [CostRow("full", "Tsit5", "float64", f"{error:.0e}", error, seconds, 1.0)
    ...         for error, seconds in ((1e-3, 0.1), (1e-6, 0.3))]
    >>> figure = cost_figure({"a jam": jv.Cost("amplitude", [1.0], 1e-9, rows)})
    >>> figure.axes[0].get_title()
    'a jam'

    Source: this package.
    """
    from jaxvib.draw.comparison import CostPanel, cost_chart  # slow import

    def panel(cost: Cost) -> CostPanel:
        names = list(dict.fromkeys(row[:3] for row in cost.rows))
        lines = {
            ", ".join(part for part in name if part): np.array([row[5:3:-1] for row in cost.rows if row[:3] == name])
            for name in names
        }
        chosen = [row for row in map(cost.cheapest, SHOWN_ERRORS) if row is not None]
        best = np.reshape(np.array([row[5:3:-1] for row in chosen]), (-1, 2))
        return CostPanel(lines, cost.reference_error, cost.quantity.replace("_", " "), best)

    return cost_chart({title: panel(cost) for title, cost in costs.items()}, SHOWN_ERRORS, ax=ax)


def timed(call: Callable[[], T], repeats: int) -> tuple[T, float, float]:
    """Return the result of a call, the time of the fastest repetition, s, and the additional time of the first call, s."""
    begun = time.perf_counter()
    value = jax.block_until_ready(call())
    first, best, spent = time.perf_counter() - begun, np.inf, 0.0
    for _ in range(repeats):
        begun = time.perf_counter()
        value = jax.block_until_ready(call())
        took = time.perf_counter() - begun
        best, spent = min(best, took), spent + took
        if spent > _MAX_TIMING_SECONDS:
            break
    return value, best, max(first - best, 0.0)


def relative(value: ArrayLike, reference: np.ndarray, units: Sequence[str] = ()) -> float:
    """Return the largest difference, relative to the largest reference value; infinite for values that are not finite.

    **Arguments**: `units` of the values, if they differ; a difference is then relative to the largest value of its unit.
    """
    differences = np.abs(np.ravel(np.asarray(value, float)) - reference)
    largest = largest_by_unit(np.abs(reference), units or [""] * len(reference))
    difference = float(np.max(differences[largest > 0.0] / largest[largest > 0.0], initial=-np.inf))
    return difference if np.isfinite(difference) else np.inf


def largest_by_unit(values: ArrayLike, units: Sequence[str]) -> np.ndarray:
    """Return the largest of the `values` (n,) with the same unit, for each of the `units` (n,).

    >>> largest_by_unit([1e-3, 2e-3, 0.1], ["m", "m", "rad"]).tolist()
    [0.002, 0.002, 0.1]
    """
    numbers, names = np.asarray(values, float), np.asarray(units)
    return np.array([np.max(numbers[names == unit]) for unit in names])


def row_of(
    tier: str,
    method: str,
    setting: str,
    call: Callable[[], T],
    error: Callable[[T], float],
    repeats: int,
    dtype: str = "float64",
) -> CostRow:
    """Time a `call` and return its row; the `error` is computed after the timing."""
    value, seconds, compiling = timed(call, repeats)
    return CostRow(tier, method, dtype, setting, error(value), seconds, compiling)
