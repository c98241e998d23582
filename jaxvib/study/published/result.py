"""What became of printed numbers: rows of a table, a figure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import equinox as eqx

from jaxvib.boundary import validated
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member
from jaxvib.study.published.entry import MISPRINT, NOT_REPRODUCIBLE, REPRODUCED, PublishedRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn

__all__ = ["Reproduced", "ReproducedStatus", "reproduced_of"]


class ReproducedStatus(eqx.Enumeration):
    """How printed numbers came out; the members are the sentences a user reads."""

    as_known = "every number has the verdict that it is known to have"
    changed = "at least one number has another verdict than the one it is known to have: jaxvib computes something else now"


class Reproduced(Result):
    """Printed numbers beside computed ones: `status` a `ReproducedStatus`; a `PublishedRow` for each number, `rows`."""

    status: ReproducedStatus
    rows: list[PublishedRow] = eqx.field(metadata=in_unit("", "number", name="number"))

    @validated
    def of(self, paper: str) -> list[PublishedRow]:
        """The rows of one paper."""
        return [row for row in self.rows if row.paper == paper]

    @property
    def papers(self) -> list[str]:
        """The papers that rows are of, in order."""
        return list(dict.fromkeys(row.paper for row in self.rows))

    @property
    def unexpected(self) -> list[PublishedRow]:
        """The rows whose verdict is not the one that is known."""
        return [row for row in self.rows if not row.expected]

    def summary(self) -> str:
        """For each paper how many numbers have which verdict, and every one that is not reproduced with the reason why."""
        lines = []
        for paper in self.papers:
            rows = self.of(paper)
            counts = [f"{sum(row.verdict == v for row in rows)} {v}" for v in (REPRODUCED, MISPRINT, NOT_REPRODUCIBLE)]
            numbers = sum(row.kind == "number" for row in rows)
            lines.append(f"{paper}: {numbers} numbers, {len(rows) - numbers} formulas: {', '.join(counts)}")
            for row in rows:
                if row.verdict != REPRODUCED or not row.expected:
                    lines.append(f"  {row.quantity} ({row.place}): {_told(row)}")
        return "\n".join([*lines, self.message])

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """How far each number is from the printed one, relative, by verdict, on a logarithmic scale.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.study.published.chart import verdict_chart  # slow to import: only who draws pays

        return verdict_chart(self.rows, ax=ax)


def _told(row: PublishedRow) -> str:
    computed = "nothing to compare with" if math.isnan(row.computed) else f"computed {row.computed:.6g}"
    known = "" if row.expected else f" (known as {row.known})"
    return f"{row.verdict}{known}: printed {row.printed:.6g}, {computed}; {row.note}"


def reproduced_of(rows: list[PublishedRow]) -> Reproduced:
    """The result that these rows make."""
    return Reproduced(member(ReproducedStatus, "as_known" if all(row.expected for row in rows) else "changed"), rows)
