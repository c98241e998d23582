"""One hard case: what is asked, what it is compared with, and how it is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene

__all__ = ["Answer", "Case", "Precision", "Reference", "StressRow", "Verdict", "judged", "rounded"]

Precision = Literal["float64", "float32"]

Verdict = Literal["right", "named", "FAILED"]
"""A right answer; a status that says by name why there is none; neither."""


class Answer(NamedTuple):
    """What jaxvib says: `values` (n,); the error that it `claimed` for them, in units of the reference's scale, None where it
    claims none; its `status`: "" where it gave an answer, else the name under which it declines to."""

    values: ArrayLike | Sequence[ArrayLike]
    claimed: float | None = None
    status: str = ""


class Reference(NamedTuple):
    """What is right: `values` (n,); the `scale` (n,) that errors are relative to, the largest value unless said otherwise;
    how far the reference itself may be wrong, `unknown`, in the same units."""

    values: ArrayLike | Sequence[ArrayLike]
    scale: ArrayLike | None = None
    unknown: float = 0.0


@dataclass(frozen=True)
class Case:
    """A hard case.

    **Attributes**: `name`; `hard`: what makes it hard; `quantity` that is asked; `against` what; `scene` makes the scene, in
    JAX's precision; `answer` asks jaxvib, `reference` something else, about the scene in that precision: the reference's
    numbers are in float64, rounded as the scene was; `within` the largest error that is right in float64 and float32;
    `named` the statuses that are an honest end in float64 and float32, where an answer cannot be asked for.
    """

    name: str
    hard: str
    quantity: str
    against: str
    scene: Callable[[], Scene]
    answer: Callable[[Scene], Answer]
    reference: Callable[[Scene], Reference]
    within: tuple[float, float]
    named: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())


class StressRow(NamedTuple):
    """How a case ended in one precision: `verdict` "right", "named" or "FAILED"; `error` the true one, `claimed` the one that
    jaxvib said, NaN where it says none; `bound` the largest that is right; `status` in words; `seconds`, compiling included,
    the reference not."""

    case: str
    dtype: str
    verdict: str
    error: float
    claimed: float
    bound: float
    status: str
    seconds: float


def judged(case: Case, dtype: Precision, answered: tuple[Answer | Exception, float], reference: Reference) -> StressRow:
    """The verdict on an answer (or what was raised in its place, and the seconds it took).

    Right is an answer whose true error is below the case's bound and, less what the reference itself may be wrong, below the
    one it claims. A named status is right where the case admits it: `refused` stands for an `InputError`. Everything else,
    another exception included, has failed.
    """
    answer, seconds = answered
    which = 0 if dtype == "float64" else 1
    bound, allowed = case.within[which], case.named[which]

    def row(verdict: Verdict, status: str, error: float = np.nan, claimed: float = np.nan) -> StressRow:
        return StressRow(case.name, dtype, verdict, error, claimed, bound, status, seconds)

    if isinstance(answer, (ComputationError, InputError)):
        name = answer.status if isinstance(answer, ComputationError) else "refused"
        return row("named" if name in allowed else "FAILED", f"{name}: {answer}" if name == "refused" else str(answer))
    if isinstance(answer, Exception):
        return row("FAILED", f"{type(answer).__name__}: {answer}".splitlines()[0])
    if answer.status:
        return row("named" if answer.status in allowed else "FAILED", answer.status)
    values, right = (np.ravel(np.asarray(x, float)) for x in (answer.values, reference.values))
    claimed = np.nan if answer.claimed is None else float(answer.claimed)
    if values.shape != right.shape:
        return row("FAILED", f"{values.size} values in place of {right.size}", claimed=claimed)
    if not np.all(np.isfinite(values)):
        return row("FAILED", "not finite, and no status says so", claimed=claimed)
    scale = np.max(np.abs(right)) if reference.scale is None else np.asarray(reference.scale, float)
    error = float(np.max(np.abs(values - right) / scale, initial=0.0))
    if not error <= bound:
        return row("FAILED", "wrong", error, claimed)
    if error - reference.unknown > claimed:
        return row("FAILED", "the error is larger than the one claimed", error, claimed)
    return row("right", "", error, claimed)


def rounded(scene: Scene) -> Scene:
    """The scene's numbers in float64, as NumPy's own: references compute in that whatever JAX is switched to."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), scene)
