"""Sources and definitions of the imported modules of jaxvib and optimize.

The keys of stored programs hold a digest of the sources. That says nothing about the code of a process in which a file was
edited between its import and the first question, or in which a function, a class or a constant was replaced (by a mock, a
notebook, a patch). Such a process must neither store programs nor read those of others. Importing this module puts a finder
before Python's own: it notes the state of each source file at its import, and what the module then defines.

Replacements of names in modules, of members of classes, of functions' code and of names in those modules of JAX and NumPy that
the package uses are noticed. Not noticed are changes inside arrays and other mutable objects, and inside other packages.
"""

from __future__ import annotations

import builtins
import functools
import hashlib
import importlib.abc
import importlib.machinery
import importlib.util
import itertools
import operator
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple, TypeAlias

__all__ = ["CodeState", "code_state", "digest_of_sources", "forget_derived"]

PACKAGES = ("jaxvib", "optimize")
_LIBRARIES = ("jax", "equinox", "diffrax", "optimistix", "optax", "lineax", "numpy", "math")
_CHANGING = {"__abstractmethods__", "__annotations__", "__doc__", "__dict__", "__weakref__"}
"""Attributes of classes that Python itself sets again."""

_BUILTINS = frozenset(vars(builtins)) - {"__doc__", "__loader__", "__name__", "__package__", "__spec__", "__build_class__"}

_Stamp: TypeAlias = "tuple[int, int, int] | None"
"""Time of change, size and number of a file; None if the code may be of another text."""

_Difference: TypeAlias = "tuple[object, object]"
"""An owner of definitions and the definition that differs."""


class CodeState(NamedTuple):
    """`number` of the state, which grows with each change, and whether the code `is_on_disk` as it was at its import."""

    number: int
    is_on_disk: bool


class _Definitions:
    """Names and values of a module or a class."""

    def __init__(self, owner: ModuleType | type):
        self.owner, self.found = owner, vars(owner)
        known = {name: value for name, value in self.found.items() if name not in _CHANGING}
        self.names, self.values = tuple(known), tuple(known.values())
        self.size = len(self.found)

    def are_same(self) -> bool:
        values = map(self.found.get, self.names)
        return all(map(operator.is_, values, self.values)) and (len(self.found) == self.size or not self.new())

    def new(self) -> set[str]:
        """New names that hide others: those of builtins in a module, those of base classes in a class."""
        new = self.found.keys() - self.names - _CHANGING
        hidden = _BUILTINS if isinstance(self.owner, ModuleType) else {name for base in self.bases for name in vars(base)}
        return new & hidden

    @property
    def bases(self) -> Sequence[type]:
        return self.owner.__mro__[1:] if isinstance(self.owner, type) else ()

    def differences(self) -> Iterator[_Difference]:
        if not self.are_same():
            for name, value in zip(self.names, self.values, strict=True):
                if self.found.get(name) is not value:
                    yield self.owner, self.found.get(name)
            yield from ((self.owner, self.found[name]) for name in sorted(self.new()))


class _Contents:
    """Entries of a dictionary, a list or a set that is a constant of a module."""

    def __init__(self, owner: dict | list | set):
        self.owner, self.entries = owner, tuple(_entries(owner))

    def are_same(self) -> bool:
        found = tuple(_entries(self.owner))
        return len(found) == len(self.entries) and all(map(operator.is_, found, self.entries))

    def differences(self) -> Iterator[_Difference]:
        if not self.are_same():
            yield from ((self.owner, entry) for entry in _entries(self.owner))


def _entries(container: dict | list | set) -> Iterable[object]:
    return itertools.chain(container, container.values()) if isinstance(container, dict) else container


class _Code:
    """Code and defaults of functions."""

    def __init__(self, functions: Sequence[FunctionType]):
        self.functions = functions
        self.codes, self.defaults = self._now()

    def _now(self) -> tuple[list[object], list[object]]:
        defaults = (map(attribute, self.functions) for attribute in _DEFAULTS)
        return [*map(_CODE, self.functions)], [*itertools.chain(*defaults)]

    def are_same(self) -> bool:
        codes, defaults = self._now()
        return all(map(operator.is_, codes, self.codes)) and all(map(operator.is_, defaults, self.defaults))

    def differences(self) -> Iterator[_Difference]:
        if not self.are_same():
            then, now = [*self.codes, *self.defaults], itertools.chain(*self._now())
            yield from ((self, new) for old, new in zip(then, now, strict=True) if old is not new)


_CODE = operator.attrgetter("__code__")
_DEFAULTS = operator.attrgetter("__defaults__"), operator.attrgetter("__kwdefaults__")


_INSIDE = {staticmethod: "__func__", classmethod: "__func__", property: "fget", functools.cached_property: "func"}


def _functions_of(owner: ModuleType | type, module: str) -> Iterator[FunctionType]:
    """Functions that a module or a class defines; of methods, properties and decorated functions the innermost one."""
    for value in vars(owner).values():
        kind = type(value)
        inner = getattr(value, _INSIDE[kind]) if kind in _INSIDE else value
        while hasattr(inner, "__wrapped__"):
            inner = inner.__wrapped__
        if isinstance(inner, FunctionType) and inner.__module__ == module:
            yield inner


class _Watched(ModuleType):
    """A module that tells when one of its names is set from outside."""

    def __setattr__(self, name: str, value: object) -> None:
        if not isinstance(value, ModuleType):
            _imports.was_set = True
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        _imports.was_set = True
        super().__delattr__(name)


class _Imports:
    """All that was noted of imported modules."""

    def __init__(self) -> None:
        self.stamps: dict[str, _Stamp] = {}
        self.definitions: dict[str, list[_Definitions | _Contents | _Code]] = {}
        self.of_libraries: dict[str, _Definitions] = {}
        self.elsewhere: set[str] = set()  # names of modules that no source file was found for
        self.was_set = False
        self.state = CodeState(0, is_on_disk=True)
        self.found: list[_Difference] = []
        self.lock = threading.RLock()

    def note(self, module: ModuleType, stamp: _Stamp) -> None:
        """Notes a module at the end of its import."""
        values = list(vars(module).items())
        classes = [value for _, value in values if isinstance(value, type) and value.__module__ == module.__name__]
        constants = [value for name, value in values if name.isupper() and type(value) in (dict, list, set)]
        functions = [f for owner in (module, *classes) for f in _functions_of(owner, module.__name__)]
        noted = [*map(_Definitions, (module, *classes)), *map(_Contents, constants), _Code(functions)]
        with self.lock:
            self.stamps[str(module.__file__)] = (
                stamp if module.__name__ not in self.definitions else None
            )  # None: imported again
            self.definitions[module.__name__] = noted
            for _, value in values:
                if isinstance(value, ModuleType):
                    self._note_library(value)
        module.__class__ = _Watched

    def _note_library(self, module: ModuleType) -> None:
        name = module.__name__
        if name.partition(".")[0] in _LIBRARIES and name not in self.of_libraries:
            self.of_libraries[name] = _Definitions(module)
            for part, value in list(vars(module).items()):
                if isinstance(value, ModuleType) and value.__name__ == f"{name}.{part}" and not part.startswith("_"):
                    self._note_library(value)

    def look(self, digested: Mapping[str, _Stamp]) -> CodeState:
        """Compares all that was noted with what is there now."""
        with self.lock:
            found: list[_Difference] = [
                (None, file) for file, stamp in self.stamps.items() if stamp is None or digested.get(file) != stamp
            ]
            for each in itertools.chain(*self.definitions.values(), self.of_libraries.values()):
                if not each.are_same():
                    found.extend(each.differences())
            is_same = len(found) == len(self.found) and all(
                a is b and x is y for (a, x), (b, y) in zip(found, self.found, strict=True)
            )
            if self.was_set or not is_same:
                self.was_set = False
                self.found, self.state = found, CodeState(self.state.number + 1, not found)
            return self.state


_imports = _Imports()


class _Loader(importlib.machinery.SourceFileLoader):
    """Python's own loader of source files, which notes what it imports."""

    def get_code(self, fullname: str) -> CodeType | None:
        """The code of the source, not of bytecode older than it, which Python takes if both are of the same second."""
        if _is_older(importlib.util.cache_from_source(self.path), _stamp(self.path)):
            return self.source_to_code(self.get_data(self.path), self.path)
        return super().get_code(fullname)

    def exec_module(self, module: ModuleType) -> None:
        stamp = _stamp(self.path)
        super().exec_module(module)
        _imports.note(module, stamp)


class _Finder(importlib.abc.MetaPathFinder):
    """Python's own finder of source files, for the modules of the two packages."""

    def find_spec(self, name: str, path: Sequence[str] | None, _: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name.partition(".")[0] not in PACKAGES:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None and type(spec.loader) is importlib.machinery.SourceFileLoader:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        elif spec is None or spec.origin is not None:
            _imports.elsewhere.add(name)
        return spec


def _stamp(file: str | int) -> _Stamp:
    try:
        found = os.stat(file)
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def _is_older(bytecode: str | None, source: _Stamp) -> bool:
    """True if the bytecode was written before the last change of the source, which Python does not notice within a second."""
    written = None if bytecode is None else _stamp(bytecode)
    return written is not None and source is not None and written[0] < source[0]


@functools.cache
def _digested() -> tuple[str, dict[str, _Stamp]]:
    """The digest of all source files, and the state of each file when it was read."""
    digest, stamps = hashlib.sha256(), {}
    package = Path(__file__).parent
    for folder in (package, package.parent / "optimize"):
        for path in sorted(folder.rglob("*.py")):
            with path.open("rb") as file:
                stamps[str(path)] = _stamp(file.fileno())
                content = file.read()
            digest.update(f"{path.relative_to(package.parent)} {len(content)}\n".encode() + content)
    return digest.hexdigest(), stamps


def digest_of_sources() -> str:
    """Digest of the source files as they were when it was first called; imports before and after are compared with it."""
    return _digested()[0]


def code_state(*, look: bool = False) -> CodeState:
    """State of the code in this process.

    **Arguments**: `look` compares all definitions (some 0.2 ms); otherwise they are compared only if a name of a module was set
    since the last time.
    """
    return _imports.look(_digested()[1]) if look or _imports.was_set else _imports.state


def forget_derived() -> None:
    """Empties the caches (`functools.cache`) of the functions of all modules but those of `jaxvib.runtime`."""
    for name, noted in _imports.definitions.items():
        for value in noted[0].values if isinstance(noted[0], _Definitions) and not name.startswith("jaxvib.runtime") else ():
            if type(value) is _CACHE:
                value.cache_clear()


_CACHE = type(functools.cache(lambda: None))


def _watch() -> None:
    """Notes the modules imported so far, whose imports have just begun, and those to come."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in PACKAGES:
            _imports.note(module, _stamp(str(module.__file__)))
    sys.meta_path.insert(0, _Finder())


_watch()
