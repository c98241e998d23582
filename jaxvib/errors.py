"""The two ways in which a question to jaxvib can fail."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

__all__ = ["ComputationError", "InputError", "require_one_of", "shown", "written"]


class InputError(ValueError):
    """A value that was given is not allowed.

    The message is one sentence that says which value it is, what is allowed and how to mend it.
    `field` holds the dotted name of the value ("machine.mass[1]"), so that a file or a form can point at it.

    >>> raise InputError("loads.count", "is 0; a machine needs at least 1 load")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: loads.count is 0; a machine needs at least 1 load
    """

    field: str
    problem: str

    def __init__(self, field: str, problem: str):
        super().__init__(f"{field} {problem}")
        self.field = field
        self.problem = problem


def shown(value: object, longest: int = 60) -> str:
    """Return the value as an error message quotes it: its representation, at most `longest` characters of one line.

    >>> shown("left"), shown(10**5000)
    ("'left'", 'a whole number of 16610 bits')
    """
    if isinstance(value, int) and abs(value).bit_length() > 1024:  # Python refuses to write numbers of more than 4300 digits
        return f"a whole number of {abs(value).bit_length()} bits"
    try:
        text = " ".join(repr(value).split())
    except Exception:  # the representation is the user's code
        text = f"a {type(value).__name__}"
    return text if len(text) <= longest else f"{text[: longest - 4].rstrip()} ..."


def require_one_of(value: object, allowed: Iterable[str], field: str, verb: str = "is") -> None:
    """Check a choice. **Raises** `InputError` for a value that is not one of the `allowed` names.

    >>> require_one_of("left", ("above", "below"), "effects.stop.side")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: effects.stop.side is 'left'; allowed: above, below
    """
    allowed = tuple(allowed)
    if not isinstance(value, str) or value not in allowed:
        raise InputError(field, f"{verb} {shown(value)}; allowed: {', '.join(allowed)}")


@contextlib.contextmanager
def written(path: Path) -> Iterator[None]:
    """**Raises** `InputError` where what stands inside cannot write the file."""
    try:
        yield
    except OSError as error:
        raise InputError("path", f"is {str(path)!r}, which cannot be written ({error.strerror}); name another file") from error


class ComputationError(RuntimeError):
    """The input is good, the computation still has no answer; `status` names why.

    Functions that raise it take `throw=False` to return the status in place of raising.

    >>> raise ComputationError("max_steps_reached", "the run needs more than 16 steps")
    Traceback (most recent call last):
        ...
    jaxvib.errors.ComputationError: max_steps_reached: the run needs more than 16 steps
    """

    status: str

    def __init__(self, status: str, message: str):
        super().__init__(f"{status}: {message}")
        self.status = status
