"""The catalogue of hard cases, and what runs it in both precisions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp

import jaxvib.study.stress
from jaxvib.boundary import validated
from jaxvib.errors import ComputationError, InputError, quoted
from jaxvib.study.stress import bends, courses, resonances, sizes
from jaxvib.study.stress.case import Answer, Case, Precision, StressRow, judged, rounded
from jaxvib.study.stress.result import Stress, stress_of

__all__ = ["CATALOGUE", "PRECISIONS", "chosen_cases", "outcome", "stress"]

CATALOGUE: tuple[Case, ...] = (*resonances.CASES, *sizes.CASES, *bends.CASES, *courses.CASES)
"""Every hard case."""

PRECISIONS: tuple[Precision, ...] = ("float64", "float32")

Report = Callable[[StressRow], None]


@validated
def stress(only: Sequence[str] = (), *, precisions: Sequence[Precision] = PRECISIONS, report: Report | None = None) -> Stress:
    """Asks hard questions and compares the answers with independent references: closed forms, SciPy, shooting, sharp laws.

    Each case ends in a right answer, in a named status that says why there is none, or has failed: then jaxvib has a defect
    on this computer. A right answer has an error below the case's bound and below the one that it claims.

    **Arguments**

    - `only`: names of cases, or parts of names; all unless said otherwise, which takes minutes
    - `precisions`: "float64", "float32" or both; the one that JAX is not switched to is asked in a process of its own
    - `report`: is called with each `StressRow` as it is known

    **Returns** `Stress`. **Raises** `InputError` for a name that no case has and for another precision, `ComputationError`
    (status "no_process") where the second process ends without an answer.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> found = jv.stress(["light fold"], precisions=["float64"])
    >>> [(row.case, row.verdict) for row in found.rows]
    [('light fold, 1e-8 below', 'right'), ('light fold, 1e-8 above', 'right')]

    Source: ours; what is compared with is written in `jaxvib.study.stress.plain` and `motions`, apart from the equations.
    """
    cases = chosen_cases(only)
    for precision in precisions:
        if precision not in PRECISIONS:
            raise InputError("precisions", f"is {quoted(precision)}; it must be 'float64' or 'float32'")
    own = PRECISIONS[0] if _is_double() else PRECISIONS[1]
    tell = report or (lambda row: None)
    others = {precision: _child(precision, cases) for precision in precisions if precision != own}
    rows: list[StressRow] = []
    for case in cases if own in precisions else ():
        rows.append(outcome(case))
        tell(rows[-1])
    for precision, child in others.items():
        with child:
            for line in child.stdout or ():
                rows.append(StressRow(*json.loads(line)))
                tell(rows[-1])
        if child.returncode != 0:
            raise ComputationError("no_process", f"the process that computes in {precision} ended with code {child.returncode}")
    order = {case.name: k for k, case in enumerate(cases)}
    return stress_of(sorted(rows, key=lambda row: order[row.case]))


def chosen_cases(only: Sequence[str]) -> list[Case]:
    """The cases whose names have one of these as a part, or all. **Raises** `InputError` for a part that none has."""
    for part in only:
        if not any(part in case.name for case in CATALOGUE):
            raise InputError("only", f"is {quoted(part)}, which is part of no case's name; there are: {_names()}")
    return [case for case in CATALOGUE if not only or any(part in case.name for part in only)]


def _names() -> str:
    return "; ".join(case.name for case in CATALOGUE)


def _is_double() -> bool:
    return jnp.result_type(float).itemsize == 8


def outcome(case: Case) -> StressRow:
    """How a case ends in the precision that JAX computes in."""
    dtype: Precision = "float64" if _is_double() else "float32"
    scene, begun = case.scene(), time.perf_counter()
    answer: Answer | Exception
    try:
        answer = case.answer(scene)
    except Exception as error:  # a traceback is what a user would see: that it never comes is part of what is asked
        answer = error
    seconds = time.perf_counter() - begun
    return judged(case, dtype, (answer, seconds), case.reference(rounded(scene)))


def _child(precision: Precision, cases: Sequence[Case]) -> subprocess.Popen[str]:
    """A process that asks these cases in the other precision and prints their rows, one JSON list a line."""
    root = str(Path(jaxvib.study.stress.__file__).parents[3])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    asked = {**os.environ, "JAX_ENABLE_X64": "1" if precision == "float64" else "0", "PYTHONPATH": path}
    names = json.dumps([case.name for case in cases])
    code = f"import jaxvib as jv; jv.prepare_cpu(); from jaxvib.study.stress.run import answer_all; answer_all({names!r})"
    return subprocess.Popen([sys.executable, "-c", code], env=asked, stdout=subprocess.PIPE, text=True)


def answer_all(names: str) -> None:
    """Prints the rows of the cases of these names (JSON), each on a line of its own as it is known."""
    wanted = json.loads(names)
    for case in CATALOGUE:
        if case.name in wanted:
            print(json.dumps(outcome(case)), flush=True)
