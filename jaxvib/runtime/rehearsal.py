"""The programs of one question, which asks for several one after the other: compiled at the same time."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import numpy as np

from jaxvib.runtime.compat import resuming

__all__ = ["Unstored", "begin_others", "beginning", "compiled_together", "is_rehearsing", "rehearsal"]

P = ParamSpec("P")
T = TypeVar("T")


class _Rest(threading.local):
    """Of a thread: the question that asks for programs, if it is `compiled_together`, whether it is gone through with zeros,
    and what is to be begun, see `beginning`."""

    question: Callable[[], object] | None = None
    others: Callable[[], None] | None = None
    resuming: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    rehearsing: bool = False


_rest = _Rest()


class Unstored(Exception):
    """Ends a rehearsal: what comes next depends on numbers of a program that can only be run."""


def compiled_together(question: Callable[P, T]) -> Callable[P, T]:
    """A question that asks for several programs, one after the other: those that are new are compiled at the same time.

    Where the first new one is met, the question is asked once more with zeros for results of all programs, only to trace them
    and to begin to compile them: tracing takes one core, compiling others. That ends at the first error, and where a program
    depends on numbers, in which case it may be one that nobody needs.
    """

    @functools.wraps(question)
    def asked(*args: P.args, **kwargs: P.kwargs) -> T:
        if _rest.question is not None:  # a part of another question
            return question(*args, **kwargs)
        _rest.question, _rest.resuming = functools.partial(question, *args, **kwargs), resuming()
        try:
            return question(*args, **kwargs)
        finally:
            _rest.question = None

    return asked


def is_rehearsing() -> bool:
    """Whether programs are only traced and compiled here, see `compiled_together`."""
    return _rest.rehearsing


@contextlib.contextmanager
def beginning(others: Callable[[], None]) -> Iterator[None]:
    """In here `others`, which ask for the same programs in other threads, are begun once one runs that has run before."""
    before, _rest.others = _rest.others, others
    try:
        yield
    finally:
        _rest.others = before


def begin_others() -> None:
    """What is to be begun, if it has not been yet."""
    if (others := _rest.others) is not None:
        _rest.others = None
        others()


def rehearsal() -> Callable[[], None] | None:
    """What goes through the question that is asked with zeros for results, once; None where there is none."""
    return _rehearse if _rest.question is not None or _rest.rehearsing else None


def _rehearse() -> None:
    if _rest.question is None or _rest.rehearsing:
        return
    _rest.rehearsing = True
    try:
        with contextlib.suppress(Exception), np.errstate(all="ignore"), _rest.resuming():
            _rest.question()
    finally:
        _rest.rehearsing = False
