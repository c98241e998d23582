"""One printed number beside the computed one, and the verdict on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["MISPRINT", "NOT_REPRODUCIBLE", "REPRODUCED", "Kind", "PaperAnswer", "PublishedRow", "Verdict", "compared"]

Verdict = Literal["reproduced", "misprint", "not reproducible"]

REPRODUCED: Verdict = "reproduced"
MISPRINT: Verdict = "misprint"
NOT_REPRODUCIBLE: Verdict = "not reproducible"

Kind = Literal["number", "formula"]
"""A number that the paper prints; a formula of the paper, with numbers put in."""


class PublishedRow(NamedTuple):
    """A printed number beside the computed one.

    **Attributes**: `paper`; `kind`; `place` in the paper; `quantity` and its `unit`; `printed`: the number, or what the printed
    formula gives; `computed` by this package, NaN where nothing can be computed; `difference` of the two; `within`: how far
    they may be apart, half a unit of the last printed digit unless the note says otherwise; `corrected`: what the corrected
    formula or datum gives, NaN where nothing is corrected; `verdict`; `known`: the verdict that this version is known to
    come to; `note`: under which reading, why not, or the correction and the check that proves it.
    """

    paper: str
    kind: str
    place: str
    quantity: str
    unit: str
    printed: float
    computed: float
    difference: float
    within: float
    corrected: float
    verdict: str
    known: str
    note: str

    @property
    def expected(self) -> bool:
        """Whether the verdict is the one that is known."""
        return self.verdict == self.known


@dataclass
class PaperAnswer:
    """What comes out for one paper: its `rows`, and by name what draws its `figures` again."""

    rows: list[PublishedRow]
    figures: dict[str, Callable[[], Figure]] = field(default_factory=dict)


def compared(
    paper: str,
    place: str,
    quantity: str,
    printed: float,
    computed: float,
    *,
    within: float,
    unit: str = "",
    kind: Kind = "number",
    known: Verdict = REPRODUCED,
    corrected: float = math.nan,
    note: str = "",
) -> PublishedRow:
    """The row of a printed number, its verdict from the numbers alone.

    "reproduced" where printed and computed are not further apart than `within`; else "misprint" where what the corrected
    formula gives is that near to the computed number; else "not reproducible".

    >>> compared("a", "(1)", "x", 0.33, 0.3349, within=0.005).verdict
    'reproduced'
    >>> compared("a", "(1)", "x", 0.3, 0.4, within=0.005, corrected=0.4).verdict
    'misprint'
    >>> compared("a", "(1)", "x", 0.3, math.nan, within=0.005).verdict
    'not reproducible'
    """
    difference = computed - printed
    verdict = NOT_REPRODUCIBLE
    if abs(difference) <= within:
        verdict = REPRODUCED
    elif abs(computed - corrected) <= within:
        verdict = MISPRINT
    return PublishedRow(
        paper, kind, place, quantity, unit, printed, computed, difference, within, corrected, verdict, known, note
    )
