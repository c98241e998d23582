"""One hard case: its question, its reference, and the rule by which an answer is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene

__all__ = ["PRECISIONS", "Answer", "Case", "Judgement", "Reference", "judge", "outcome"]

PRECISIONS = ("float64", "float32")

Verdict = Literal["right", "named", "FAILED"]
"""A right answer; a status that names the reason why there is none; neither."""


class Answer(NamedTuple):
    """Answer of jaxvib: `values` (n,); the error `claimed` for them, in units of the reference's scale, None if it claims none;
    `status`: "" for an answer, otherwise the name under which jaxvib declines."""

    values: ArrayLike | Sequence[ArrayLike]
    claimed: float | None = None
    status: str = ""


class Reference(NamedTuple):
    """Right answer: `values` (n,); the `scale` (n,) that errors are relative to, default: the largest value; `unknown`, the
    error of the reference itself in the same units."""

    values: ArrayLike | Sequence[ArrayLike]
    scale: ArrayLike | None = None
    unknown: float = 0.0


@dataclass(frozen=True)
class Case:
    """A hard case.

    **Attributes**: `name`; `hard`, the difficulty; `quantity` in question; `against`, the reference in words; `scene` builds
    the scene in JAX's precision; `answer` asks jaxvib, `reference` computes the same in another way from the scene's numbers,
    rounded to JAX's precision, in float64; `within` the largest error in float64 and in float32; `named` the statuses in
    float64 and in float32 that are expected in place of an answer (none: an answer is expected). `found` among them allows an
    answer as well, because the rounding of the CPU decides.
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

    def verdicts(self, precision: str) -> tuple[Verdict, ...]:
        """Expected verdicts."""
        named = self.named[PRECISIONS.index(precision)]
        return ("right", "named") if "found" in named else ("named",) if named else ("right",)


class Judgement(NamedTuple):
    """Verdict on an answer; its true `error` and the one `claimed`, NaN if there is none; the `status` in words."""

    verdict: Verdict
    status: str = ""
    error: float = np.nan
    claimed: float = np.nan


def judge(answer: Answer | Exception, reference: Reference, within: float, named: Sequence[str] = ()) -> Judgement:
    """Judge an answer, or the exception in its place.

    An answer is right if its true error is at most `within` and, less the error of the reference, at most the one it claims. A
    status is right if it is one of those `named`; `refused` stands for an `InputError`. Everything else, other exceptions
    included, has failed.
    """
    if isinstance(answer, (ComputationError, InputError)):
        name = answer.status if isinstance(answer, ComputationError) else "refused"
        return Judgement("named" if name in named else "FAILED", f"{name}: {answer}")
    if isinstance(answer, Exception):
        return Judgement("FAILED", f"{type(answer).__name__}: {answer}".splitlines()[0])
    if answer.status:
        return Judgement("named" if answer.status in named else "FAILED", answer.status)
    values, right = (np.ravel(np.asarray(x, float)) for x in (answer.values, reference.values))
    claimed = np.nan if answer.claimed is None else float(answer.claimed)
    if values.shape != right.shape:
        return Judgement("FAILED", f"{values.size} values in place of {right.size}", claimed=claimed)
    if not np.all(np.isfinite(values)):
        return Judgement("FAILED", "not finite, and no status says so", claimed=claimed)
    scale = np.max(np.abs(right)) if reference.scale is None else np.asarray(reference.scale, float)
    error = float(np.max(np.abs(values - right) / scale, initial=0.0))
    if not error <= within:
        return Judgement("FAILED", "wrong", error, claimed)
    if error - reference.unknown > claimed:
        return Judgement("FAILED", "the error is larger than the one claimed", error, claimed)
    return Judgement("right", "", error, claimed)


def outcome(case: Case, precision: str = "float64") -> Judgement:
    """Ask a case in one precision and judge the answer."""
    which = PRECISIONS.index(precision)
    with jax.enable_x64(precision == "float64"):
        scene = case.scene()
        answer: Answer | Exception
        try:
            answer = case.answer(scene)
        except Exception as error:  # a user would see a traceback: its absence is part of the question
            answer = error
        # The numbers of the scene in float64, as NumPy's own: references compute in that, whatever JAX computes in.
        rounded = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), scene)
        return judge(answer, case.reference(rounded), case.within[which], case.named[which])
