"""Computation of chunks on all cores of this process, and the report of the progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from typing import NamedTuple

from jaxvib.runtime.parallel import in_parallel
from jaxvib.sweeps.definition import Study
from jaxvib.sweeps.program import Chunk, compute


class Progress(NamedTuple):
    """Progress of a sweep.

    **Attributes**

    - `done`: number of finished cases of `cases`, including those of earlier calls
    - `rate`: cases per second in this call
    - `left`: estimated seconds until the end
    """

    done: int
    cases: int
    rate: float
    left: float


Report = Callable[[Progress], None]
"""Type of a function that is called after every chunk."""


def in_this_process(study: Study, todo: Iterable[int]) -> Generator[tuple[int, Chunk], None, None]:
    """Compute chunks on all cores; all threads share one program. Yield each finished chunk with its number."""
    return in_parallel(lambda chunk: compute(study, chunk), todo)


def timed(cases: int, done: int, report: Report | None) -> Callable[[int], None]:
    """Return a function that takes the number of cases of each finished chunk and reports the progress."""
    begun, before, now = time.perf_counter(), done, done

    def add(more: int) -> None:
        nonlocal now
        now += more
        if report is not None:
            rate = (now - before) / max(time.perf_counter() - begun, 1e-9)
            report(Progress(now, cases, rate, (cases - now) / rate))

    return add
