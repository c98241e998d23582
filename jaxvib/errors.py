"""Errors of jaxvib, and common checks: allowed names, paths, files that are read or written, and optional packages."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import os
import re
import stat
import threading
from collections.abc import Container, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import IO

MAX_TEXT_BYTES = 2**24
"""Largest size, bytes, of a text file that is read."""

CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""Characters that control a terminal or change the direction of writing, except line breaks and tabs."""

_MAX_PATH_CHARACTERS = 4096
"""Largest number of characters of a path, as in Linux."""

_MAX_WORD, _MAX_MESSAGE = 300, 2000
"""Largest numbers of characters of a word and of a message. In longer ones, the middle is replaced by " ... "."""


def legible(text: object) -> str:
    """Return a text on one line for a terminal, with control characters escaped, and long words and texts shortened.

    >>> legible("a\\x1b[31m" + 1000 * "b")[:20]
    'a\\\\x1b[31mbbbbbbbbbbb'
    """
    text = text if isinstance(text, str) else quoted(text)
    plain = re.sub(f"{CONTROL.pattern}|[\n\t\ud800-\udfff]", lambda found: repr(found[0])[1:-1], text)
    plain = re.sub(rf"\S{{{_MAX_WORD + 1},}}", lambda found: _shortened(found[0], _MAX_WORD), plain)
    return _shortened(plain, _MAX_MESSAGE)


def _shortened(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 4 :]}"


class InputError(ValueError):
    """Error for an argument whose value is not allowed.

    The message is one sentence: the argument, its value, the allowed range and the change that fixes it.

    **Arguments**, also attributes

    - `field`: dotted name of the argument ("machine.mass[1]"), so that a message about a file or a form can locate it
    - `problem`: the rest of the sentence, "is 0; a machine needs at least 1 load"

    >>> raise InputError("loads.count", "is 0; a machine needs at least 1 load")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: loads.count is 0; a machine needs at least 1 load
    """

    field: str
    problem: str

    def __init__(self, field: str, problem: str):
        self.field, self.problem = legible(field), legible(problem)
        super().__init__(f"{self.field} {self.problem}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str]]:
        return type(self), (self.field, self.problem)  # for pickle, which passes errors between processes


@contextlib.contextmanager
def within(place: str) -> Iterator[None]:
    """Prefix the names of fields in errors by `place`.

    >>> with within("exciters[1]."):
    ...     raise InputError("drive.speed", "is -1 rad/s; it must be greater than 0")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: exciters[1].drive.speed is -1 rad/s; it must be greater than 0
    """
    try:
        yield
    except InputError as error:
        if not place:
            raise
        raise InputError(place + error.field, error.problem) from error


def counted(number: int) -> str:
    """Return a number of values as text.

    >>> counted(1), counted(2)
    ('1 value', '2 values')
    """
    return f"{number} value{'' if number == 1 else 's'}"


def quoted(value: object, longest: int = 60) -> str:
    """Return the value as an error message quotes it: its representation, at most `longest` characters of one line.

    >>> quoted("left"), quoted(10**5000)
    ("'left'", 'a whole number of 16610 bits')
    """
    if isinstance(value, int) and abs(value).bit_length() > 1024:  # Python does not convert integers of more than 4300 digits
        return f"a whole number of {abs(value).bit_length()} bits"
    try:
        text = " ".join(repr(value).split())
    except Exception:  # `repr` of a user's class may raise any error
        text = f"a {type(value).__name__}"
    return text if len(text) <= longest else f"{text[: longest - 4].rstrip()} ..."


def suggest_name(name: str, allowed: list[str], present: Container[str] = ()) -> str:
    """Return the end of an error message about an unknown name: the most similar allowed name that is not `present` in the same
    table, and all allowed names."""
    similar = difflib.get_close_matches(name, [other for other in allowed if other not in present], n=1)
    question = f"did you mean {similar[0]!r}? " if similar else ""
    return f"{question}allowed: {', '.join(allowed)}"


def require_one_of(value: object, allowed: Iterable[str], field: str) -> None:
    """Check a choice. **Raises** `InputError` for a value that is not one of the `allowed` names.

    >>> require_one_of("left", ("above", "below"), "effects.stop.side")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: effects.stop.side is 'left'; allowed: above, below
    """
    allowed = tuple(allowed)
    if not isinstance(value, str) or value not in allowed:
        raise InputError(field, f"is {quoted(value)}; allowed: {', '.join(allowed)}")


def require_path(value: object, field: str) -> Path:
    """Return a path.

    **Raises** `InputError` for a value that is not a path, and for a path that is empty, has more than 4096 characters, or
    contains the character NUL or a lone surrogate.

    >>> require_path(3, "path")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: path is 3; it must be the path of a file
    """
    if not isinstance(value, (str, os.PathLike)) or isinstance(os.fspath(value), bytes):
        raise InputError(field, f"is {quoted(value)}; it must be the path of a file")
    text = os.fspath(value)
    if not text:
        raise InputError(field, "is empty; it must be the path of a file")
    if len(text) > _MAX_PATH_CHARACTERS:
        problem = f"has {len(text)} characters and begins with {quoted(value)}; a path has {_MAX_PATH_CHARACTERS} at most"
        raise InputError(field, problem)
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise InputError(field, f"is {quoted(value)}; a path cannot contain the character NUL or a lone surrogate")
    return Path(value)


def with_ending(path: str | Path, ending: str) -> Path:
    """Return the path of a file to be written; `ending` is appended to its name if it is missing.

    **Raises** `InputError` for a path without the name of a file.

    >>> with_ending("results/run", ".npz").as_posix(), with_ending("run.npz", ".npz").as_posix()
    ('results/run.npz', 'run.npz')
    """
    path = Path(path)
    if path.name in ("", ".."):
        raise InputError("path", f"is {quoted(str(path))}, which is a folder; name a file in it")
    return path if path.suffix == ending else path.with_name(path.name + ending)


@contextlib.contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file. At the end of the context, this file replaces the file at `path`.

    An existing file at `path` is unchanged until then. If `path` is a device, such as /dev/null, `path` itself is yielded.
    **Raises** `InputError` if the file cannot be written.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.txt"
    >>> with written(path) as part:
    ...     _ = part.write_text("whole")
    >>> path.read_text(), len(list(path.parent.iterdir()))
    ('whole', 1)
    """
    part = None
    try:
        target = path.resolve()  # the target of a symbolic link is replaced, not the link
        if target.exists() and not target.is_file():  # a device such as /dev/null must not be replaced
            yield path
            return
        part = target.with_name(f".{os.getpid()}-{threading.get_ident()}.part{path.suffix}")
        yield part
        os.replace(part, target)
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) and "null" not in str(error):
            raise
        why, remedy = getattr(error, "strerror", None) or str(error), "name another file"
        if not os.path.exists(path.parent):
            why, remedy = "its folder does not exist", "create the folder first"
        raise InputError("path", f"is {quoted(str(path))}, which cannot be written ({why}); {remedy}") from error
    finally:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink()  # fails, without effect, if this file has already replaced the one at `path`


def optional_module(name: str, extra: str) -> ModuleType:
    """Import the module `name` of an optional package.

    **Raises** `InputError` if the package is missing. The message states the command that installs it, with the `extra` of
    jaxvib.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise InputError(package, f"is not installed; install it with: pip install '.[{extra}]'") from error


def require_writable(path: Path) -> None:
    """Check that a file can be written, before the computation begins.

    **Raises** `InputError` for a missing folder, a path that is itself a folder, a read-only file and a name that is not
    allowed.
    """
    try:
        if not path.parent.is_dir():
            raise InputError("path", f"is {quoted(str(path))}, and its folder does not exist; create it or name another one")
        if path.is_dir() or (path.exists() and not path.stat().st_mode & 0o222):
            kind = "a folder" if path.is_dir() else "read-only"
            raise InputError("path", f"is {quoted(str(path))}, which is {kind}; name another file")
    except OSError as error:
        problem = f"is {quoted(str(path))}, which cannot be written ({error.strerror}); name another file"
        raise InputError("path", problem) from error


def open_regular(path: str | Path) -> IO[bytes]:
    """Open a file for reading. **Raises** `OSError` if it is missing, or is a folder, a pipe or a device."""

    def opener(name: str, flags: int) -> int:
        file = os.open(name, flags | getattr(os, "O_NONBLOCK", 0))  # a pipe without a writer would block
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(None, "it is a folder, a pipe or a device, not a file")
        return file

    try:
        return open(path, "rb", opener=opener)
    except ValueError as error:  # a name with a null character
        raise OSError(None, str(error)) from error


def read_text(path: str | Path, what: str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a file.

    **Arguments**: `path`; `what`: expected file, for messages, such as "a TOML file"; `max_bytes`: largest size.

    **Raises** `InputError` for a file that cannot be read, is not UTF-8 text, or is larger than `max_bytes`.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError("path", f"is {quoted(path)}; give the path of {what}")
    try:
        with open_regular(path) as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise InputError(str(path), f"cannot be read ({error.strerror}); give the path of {what}") from error
    if len(content) > max_bytes:
        raise InputError(str(path), f"is larger than {max_bytes >> 20} MB; give the path of {what}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        archive = f"is an archive, such as a saved result; give the path of {what}"
        problem = archive if content.startswith(b"PK") else "is not UTF-8 text; save it as UTF-8"
        raise InputError(str(path), problem) from error


class ComputationError(RuntimeError):
    """Error for a computation with allowed input that has no result; `status` names the reason.

    A function that has an argument `throw` returns the status instead if `throw` is False.

    **Arguments**, also attributes: `status`, a name such as "absent" or "max_steps_reached"; `message`, a sentence.

    >>> raise ComputationError("max_steps_reached", "the run needs more than 16 steps")
    Traceback (most recent call last):
        ...
    jaxvib.errors.ComputationError: max_steps_reached: the run needs more than 16 steps
    """

    status: str

    def __init__(self, status: str, message: str):
        lines = "\n".join(map(legible, message.split("\n"))) if isinstance(message, str) else quoted(message)
        super().__init__(f"{legible(status)}: {lines}")
        self.status, self.message = status, message

    def __reduce__(self) -> tuple[type[ComputationError], tuple[str, str]]:
        return type(self), (self.status, self.message)
