"""Seals of a store: digests of its files, and the lock of the process that writes to the store.

The folder `.seals` contains

- for every finished chunk, a file with a digest of all files of that chunk
- the digests of the files that are written only once, when the store is created
- the file that a process locks for writing
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from jaxvib.errors import InputError, open_regular, read_text, written

FOLDER = ".seals"

_LAYOUT, _LOCK = "layout", "lock"

_intact: dict[str, tuple[object, ...]] = {}
"""Stamps (time of change, size, inode number) of the files of chunks that this process has read and verified, by the path of
the seal."""


def seal_of(store: Path, chunk: int) -> Path:
    """Return the path of a chunk's seal."""
    return store / FOLDER / str(chunk)


def _digest(files: Mapping[str, Path]) -> str:
    """Return a digest of the names and contents of files; a missing file changes the digest too."""
    total = hashlib.sha256()
    for name, path in files.items():
        try:
            with open_regular(path) as file:
                content = hashlib.sha256(file.read()).hexdigest()
        except FileNotFoundError:
            content = "absent"
        except OSError as error:
            content = f"unreadable: {error}"
        total.update(f"{name} {content}\n".encode())
    return total.hexdigest()


def _stamps(files: Mapping[str, Path]) -> tuple[object, ...]:
    """Return stamps of files (time of change, size, inode number), which differ if a file was rewritten or replaced."""

    def stamp(path: Path) -> object:
        try:
            status = path.stat()
            return status.st_mtime_ns, status.st_size, status.st_ino
        except OSError:
            return None

    return tuple(stamp(path) for path in files.values())


def seal(store: Path, chunk: int, files: Mapping[str, Path]) -> None:
    """Write a chunk's seal."""
    with written(seal_of(store, chunk)) as part:
        part.write_text(f"{chunk} {_digest(files)}\n", encoding="ascii")


def is_sealed(store: Path, chunk: int, files: Mapping[str, Path]) -> bool | None:
    """Return True if the seal of a chunk agrees with its files, False if it does not, and None if the chunk has no seal."""
    path = seal_of(store, chunk)
    stamps = _stamps({**files, "": path})
    if _intact.get(str(path)) == stamps:
        return True
    try:
        with open_regular(path) as file:
            stored_seal = file.read(256)
    except FileNotFoundError:
        return None
    except OSError:
        return False
    if stored_seal != f"{chunk} {_digest(files)}\n".encode():
        return False
    _intact[str(path)] = stamps
    return True


def seal_layout(store: Path) -> None:
    """Record the digests of all files of a new store, before it has chunks: metadata and values of axes."""
    files = {path.relative_to(store).as_posix(): path for path in sorted(store.rglob("*")) if path.is_file()}
    digests = {name: _digest({name: path}) for name, path in files.items()}
    (store / FOLDER).mkdir()
    (store / FOLDER / _LOCK).touch()
    body = json.dumps(digests, sort_keys=True)
    layout = json.dumps({"files": digests, "digest": hashlib.sha256(body.encode()).hexdigest()})
    (store / FOLDER / _LAYOUT).write_text(layout, encoding="utf-8")


def changed_layout(store: Path) -> str | None:
    """Describe the first file that has changed since the creation of the store; None if no file has changed."""
    try:
        layout = json.loads(read_text(store / FOLDER / _LAYOUT, "a store"))
        digests = layout["files"]
        body = json.dumps(digests, sort_keys=True)
        if layout["digest"] != hashlib.sha256(body.encode()).hexdigest():
            return f"{FOLDER}/{_LAYOUT} was changed"
        for name, digest in digests.items():
            if Path(name).is_absolute() or ".." in Path(name).parts or digest != _digest({name: store / name}):
                return f"{name} is missing or was changed"
    except (InputError, RecursionError, ValueError, KeyError, TypeError, AttributeError):
        return f"{FOLDER}/{_LAYOUT} is missing or was changed"
    return None


def _lock(file: int, *, exclusive: bool) -> bool:
    """Lock an open file, and return False if another process has the lock. The system releases the lock when the process
    ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        except OSError:
            return False
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


@contextlib.contextmanager
def locked(store: Path) -> Iterator[bool]:
    """Lock a store while the context is active; yield False if another process or thread has the lock.

    **Raises** `OSError` if the lock file does not exist and cannot be created.
    """
    path = store / FOLDER / _LOCK
    file = os.open(path, os.O_RDONLY if path.exists() and not os.access(path, os.W_OK) else os.O_RDWR | os.O_CREAT, 0o666)
    try:
        yield _lock(file, exclusive=True)
    finally:
        os.close(file)


def is_locked(store: Path) -> bool:
    """Return True if a process is writing into a store."""
    try:
        file = os.open(store / FOLDER / _LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        return not _lock(file, exclusive=False)
    finally:
        os.close(file)
