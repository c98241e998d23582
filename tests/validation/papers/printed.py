"""A number that a paper prints, the number that jaxvib computes for it, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

__all__ = ["Misprint", "PrintedNumber"]

Verdict = Literal["reproduced", "misprint", "not reproducible"]

Value = float | Callable[[], float]


@dataclass(frozen=True)
class Misprint:
    """Correction of a misprint.

    **Attributes**: `printed` and `right`, both in words; `proof`, an independent computation that proves it; `corrected`, the
    number that the corrected formula or datum gives.
    """

    printed: str
    right: str
    proof: str
    corrected: Value


@dataclass(frozen=True)
class PrintedNumber:
    """A printed number, or a printed formula with numbers put in.

    **Attributes**: `place` in the `paper`; the `quantity` and its `unit`; `printed`, the number, or a function that evaluates
    the printed formula; `computed`, a function that asks jaxvib, None if nothing can be computed; `within`, half a unit of the
    last printed digit if `note` gives no other reason; `note`, the reading of the paper's data; `misprint`, the correction of
    a printed formula or datum that is wrong; `reason` why a number is not reproduced, with the number that jaxvib computes
    in its place, `differs` (NaN: there is no such motion), or, of a chaotic outcome, which changes with the steps, its largest
    distance from the printed number, `chaotic`; `is_slow`, True if it takes minutes.
    """

    paper: str
    place: str
    quantity: str
    printed: Value
    computed: Callable[[], float] | None
    within: float
    unit: str = ""
    note: str = ""
    misprint: Misprint | None = None
    reason: str = ""
    differs: float = math.nan
    chaotic: float = 0.0
    is_slow: bool = False

    @property
    def is_formula(self) -> bool:
        """True for a formula, False for a number."""
        return callable(self.printed)

    @property
    def verdict(self) -> Verdict:
        """Expected verdict."""
        if self.misprint is not None:
            return "misprint"
        return "not reproducible" if self.reason else "reproduced"

    def check(self) -> None:
        """Compute the number and assert the verdict.

        - reproduced: the computed number differs from the printed one by at most `within`
        - misprint: it does not, and differs from the corrected one by at most `within`
        - not reproducible: it does not, and has the known difference from the printed one, to 5 %
        - not reproducible since chaotic: it differs from the printed one by at most `chaotic`
        """
        if self.computed is None:
            assert self.reason
            return
        printed, computed = _value(self.printed), self.computed()
        if self.chaotic:
            assert abs(computed - printed) <= self.chaotic, (printed, computed)
            return
        is_near = abs(computed - printed) <= self.within
        assert is_near == (self.verdict == "reproduced"), (printed, computed, self.within)
        if self.misprint is not None:
            corrected = _value(self.misprint.corrected)
            assert abs(computed - corrected) <= self.within, (corrected, computed, self.within)
        elif self.reason:
            is_missing = math.isnan(computed) and math.isnan(self.differs)
            assert is_missing or abs(computed - self.differs) <= 0.05 * abs(self.differs - printed), (self.differs, computed)


def _value(value: Value) -> float:
    return float(value() if callable(value) else value)
