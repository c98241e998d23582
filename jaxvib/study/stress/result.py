"""How the hard cases ended: rows of a table, a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member
from jaxvib.study.stress.case import StressRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn

__all__ = ["Stress", "StressStatus", "stress_of"]


class StressStatus(eqx.Enumeration):
    """How a catalogue of hard cases ended; the members are the sentences a user reads."""

    passed = "every case ended in a right answer or in a named status"
    failed = "at least one case ended in a wrong answer, or without a name for why there is none"


class Stress(Result):
    """How hard cases ended: `status` a `StressStatus`; a `StressRow` for each case and precision, `rows`."""

    status: StressStatus
    rows: list[StressRow] = eqx.field(metadata=in_unit("", "case", name="case"))

    @property
    def failures(self) -> list[StressRow]:
        """The rows that failed."""
        return [row for row in self.rows if row.verdict == "FAILED"]

    def summary(self) -> str:
        """How many ended how, and each failure, for a person to read."""
        counts = {verdict: sum(row.verdict == verdict for row in self.rows) for verdict in ("right", "named", "FAILED")}
        lines = [f"{len(self.rows)} questions: " + ", ".join(f"{number} {verdict}" for verdict, number in counts.items())]
        for row in self.failures:
            known = "" if np.isnan(row.error) else f" (error {row.error:.1e}, claimed {row.claimed:.1e}, bound {row.bound:.0e})"
            lines.append(f"  {row.case}, {row.dtype}: {row.status}{known}")
        return "\n".join([*lines, self.message])

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """True errors of all cases in both precisions on a logarithmic scale, the errors claimed, and the bounds.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.comparison import StressMark, stress_chart  # slow to import: only who draws pays

        marks = [StressMark(row.case, row.dtype, row.verdict, row.error, row.claimed, row.bound) for row in self.rows]
        return stress_chart(marks, ax=ax)


def stress_of(rows: list[StressRow]) -> Stress:
    """The result that these rows make."""
    failed = any(row.verdict == "FAILED" for row in rows)
    return Stress(member(StressStatus, "failed" if failed else "passed"), rows)
