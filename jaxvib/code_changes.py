"""Comparison of the code of this process with the source files.

The keys of stored programs contain a digest of the source files. The code of a process differs from these files if a file was
edited after the import of jaxvib. It also differs if a mock, a notebook or a patch replaced a function, a constant or a member
of a class. Such a process must neither store programs nor read stored ones.

The class of each module of the package is replaced by a class that records which names are set from outside; other modules are
not changed. The members of classes are compared with those at the import, and files by their modification times. This does not
detect changes inside arrays, dictionaries and other mutable objects, a new `__code__` of a function, or replacements in other
packages.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, TypeAlias

PACKAGES = ("jaxvib", "optimize")

_CHANGING = {"__abstractmethods__", "__annotate_func__", "__annotations__", "__annotations_cache__", "__doc__", "__slotnames__"}
"""Attributes of classes that Python itself changes after the definition."""

_ABSENT = object()

_Stamp: TypeAlias = "tuple[int, int, int] | None"
"""Modification time, size and inode number of a file; None if it does not exist."""


class CodeState(NamedTuple):
    """State of the code.

    **Attributes**: `number`, which increases with each change; `is_on_disk`: True if the code equals the source files.
    """

    number: int
    is_on_disk: bool


class _WatchedModule(ModuleType):
    """Module that records which of its names are set or deleted from outside."""

    def __setattr__(self, name: str, value: object) -> None:
        if type(value) is ModuleType and value.__name__ == f"{self.__name__}.{name}":  # end of a submodule's import
            watch(value)
        else:
            _code.record(self, name)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        _code.record(self, name)
        super().__delattr__(name)


class _Code:
    """Original definitions and files of the watched modules, and the current state of the code.

    **Attributes**

    - `stamps` of the source files at the import, and `members` of the classes at the import
    - `originals`: first values of names that were set from outside
    - `doubtful`: modules whose code may already have differed from the source files at the import
    - `was_set`: True if a name was set since the last comparison
    - `last_differences`: result of the last comparison
    """

    def __init__(self) -> None:
        self.root = Path(__file__).parents[1]
        files = sorted(file for package in PACKAGES for file in (self.root / package).rglob("*.py"))
        self.stamps = {str(file): _stamp(file) for file in files}
        self.originals: dict[tuple[ModuleType, str], object] = {}
        self.members: dict[type, dict[str, object]] = {}
        self.doubtful: list[ModuleType] = []
        self.was_set = False
        self.state, self.last_differences = CodeState(0, is_on_disk=True), []
        self.lock = threading.RLock()

    def record(self, module: ModuleType, name: str) -> None:
        self.originals.setdefault((module, name), vars(module).get(name, _ABSENT))
        self.was_set = True

    def differences(self) -> Iterator[tuple[object, ...]]:
        """Yield owner, name and current value of each replaced definition, then the edited files and the `doubtful` modules."""
        for (module, name), original in list(self.originals.items()):
            if (value := vars(module).get(name, _ABSENT)) is not original:
                yield module, name, value
        for owner, members in list(self.members.items()):
            current = _members(owner)
            for name in current.keys() | members.keys():
                if current.get(name) is not members.get(name):
                    yield owner, name, current.get(name)
        yield from ((file,) for file, stamp in self.stamps.items() if _stamp(file) != stamp)
        yield from ((module,) for module in self.doubtful)

    def update(self) -> None:
        with self.lock:
            was_set, self.was_set = self.was_set, False
            now, last = list(self.differences()), self.last_differences
            if was_set or {tuple(map(id, each)) for each in now} != {tuple(map(id, each)) for each in last}:
                self.last_differences, self.state = now, CodeState(self.state.number + 1, not now)


def watch(module: ModuleType) -> None:
    """Watch a module from the end of its import, with the submodules that it has imported or will import.

    The package jaxvib itself is watched from the beginning of its import.
    """
    module.__class__ = _WatchedModule
    if module.__file__ not in _code.stamps or _is_stale(module.__file__):
        _code.doubtful.append(module)
    for name, value in list(vars(module).items()):
        if isinstance(value, type) and value.__module__ == module.__name__:
            _code.members[value] = _members(value)
        elif type(value) is ModuleType and value.__name__ == f"{module.__name__}.{name}":
            watch(value)


def _members(owner: type) -> dict[str, object]:
    return {name: value for name, value in vars(owner).items() if name not in _CHANGING}


def _stamp(file: str | Path) -> _Stamp:
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _is_stale(file: str) -> bool:
    """Return True if Python used outdated bytecode.

    Python compares the size of the source file and its modification time in whole seconds. It therefore does not detect an edit
    that keeps the size, if it is made in the same second as the edit before.
    """
    source, bytecode = _stamp(file), _stamp(importlib.util.cache_from_source(file))
    if source is None or bytecode is None:
        return False
    return bytecode[0] < source[0] and bytecode[0] // 10**9 == source[0] // 10**9


@functools.cache
def digest_of_sources() -> str:
    """Return the digest of the source files, computed at the first call."""
    digest = hashlib.sha256()
    for file in map(Path, _code.stamps):
        content = file.read_bytes()
        digest.update(f"{file.relative_to(_code.root)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def code_state(*, compare: bool = False) -> CodeState:
    """Return the state of the code in this process.

    **Arguments**: `compare`: True to compare modules, classes and files (about 2 ms); by default they are compared only after a
    name of a module was set.
    """
    if compare or _code.was_set:
        digest_of_sources()  # before the comparison, which then confirms that the digest is that of the imported code
        _code.update()
    return _code.state


def clear_function_caches() -> None:
    """Clear the caches (`functools.cache`) of all functions of both packages, except in `jaxvib.runtime` and this module."""
    for module in [module for module in list(sys.modules.values()) if isinstance(module, _WatchedModule)]:
        for value in list(vars(module).values()):
            if isinstance(value, _Cache) and not value.__module__.startswith(("jaxvib.runtime", __name__)):
                value.cache_clear()


_Cache = type(functools.cache(lambda: None))

_code = _Code()
watch(sys.modules["jaxvib"])  # its import has just begun
