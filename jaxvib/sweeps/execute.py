"""Chunks computed one after another: on the cores of this process, and what is told meanwhile."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import NamedTuple

from jaxvib.sweeps.definition import Study
from jaxvib.sweeps.program import Chunk, compute

__all__ = ["Progress", "Report", "cores", "in_this_process", "timed"]


class Progress(NamedTuple):
    """How far a sweep is: `done` cases of `cases`, those of former calls included; `rate` cases a second and `left` seconds to
    go, as this call went so far."""

    done: int
    cases: int
    rate: float
    left: float


Report = Callable[[Progress], None]
"""What is called after every chunk."""


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def in_this_process(study: Study, todo: Iterable[int], threads: int | None = None) -> Generator[tuple[int, Chunk], None, None]:
    """Computes chunks on all cores, by one program that all threads share; gives each with its number as it is finished.

    No more chunks are held than twice the threads. The first chunk is computed alone, so that the program is compiled once.
    """
    chunks = iter(todo)
    for first in chunks:
        yield first, compute(study, first)
        break
    threads = threads or cores()
    pool = ThreadPoolExecutor(threads)
    running: dict[Future[Chunk], int] = {}
    try:
        for chunk in chunks:
            running[pool.submit(compute, study, chunk)] = chunk
            if len(running) >= threads + 1:
                yield from _finished(running)
        while running:
            yield from _finished(running)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _finished(running: dict[Future[Chunk], int]) -> Iterator[tuple[int, Chunk]]:
    ended, _ = wait(running, return_when=FIRST_COMPLETED)
    for future in ended:
        yield running.pop(future), future.result()


def timed(cases: int, done: int, report: Report | None) -> Callable[[int], None]:
    """A function to call with the number of cases of each chunk that is finished, which reports how far it is."""
    begun, before, now = time.perf_counter(), done, done

    def add(more: int) -> None:
        nonlocal now
        now += more
        if report is not None:
            rate = (now - before) / max(time.perf_counter() - begun, 1e-9)
            report(Progress(now, cases, rate, (cases - now) / rate))

    return add
