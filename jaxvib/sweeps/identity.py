"""Identity of a value: plain data that differ if two values can give different results.

Numbers, containers and dataclasses are described by their entries, large arrays by a digest of their bytes with type and shape.
A user's function is described by its bytecode, defaults and closure, and recursively by everything to which it refers: global
numbers, helper functions, classes, entries of the user's modules. The source text is not read, because it may have been edited
after the import. Objects of installed packages and of Python are described by name and version.

A value whose influence cannot be followed raises `UnknownIdentity`: open files, calls of `open` or `eval`, the clock, random
numbers of the operating system.
"""

from __future__ import annotations

import builtins
import contextlib
import dataclasses
import dis
import enum
import functools
import hashlib
import importlib
import json
import os
import sys
import sysconfig
import types
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxvib.results.fields import Plain

_MAX_VALUES = 100_000
"""Maximum number of values in one description."""

_MAX_ENTRIES = 64
"""Maximum number of entries of an array that is described by its entries; a larger array is described by a digest."""

_UNKNOWN_BUILTINS = {"open", "input", "eval", "exec", "compile", "globals", "locals", "vars", "breakpoint", "__import__"}
_UNKNOWN_MODULES = {
    "asyncio", "datetime", "glob", "importlib", "io", "multiprocessing", "os", "pathlib", "random", "secrets", "shelve",
    "shutil", "socket", "sqlite3", "subprocess", "sys", "tempfile", "time", "urllib", "uuid",
}  # fmt: skip
_UNKNOWN_ATTRIBUTES = {
    "fromfile", "genfromtxt", "load", "loadtxt", "memmap", "open", "open_dataset", "read_bytes", "read_csv", "read_excel",
    "read_text",
}  # fmt: skip
"""Names of functions whose results depend on files, the clock or the environment."""

_CLASS_ENTRIES_WITHOUT_EFFECT = {"_abc_impl"}


class UnknownIdentity(Exception):
    """Raised for a value whose influence on results cannot be followed; the message gives the reason."""


def digest(value: Plain) -> str:
    """Return a digest of plain data, a text of 32 hexadecimal digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


def identity(value: object) -> Plain:
    """Describe a value by everything on which its results depend. **Raises** `UnknownIdentity`.

    >>> identity((1.0, "N"))
    {'tuple': [1.0, 'N']}
    >>> gain = 2.0
    >>> def doubled(x):
    ...     return gain * x
    >>> before = identity(doubled)
    >>> gain = 3.0
    >>> before == identity(doubled)
    False
    """
    return _Description().of(value)


def difference(one: Plain, other: Plain, name: str = "") -> tuple[str, Plain, Plain] | None:
    """Return the place of the first difference between two plain values, and both entries there; None for equal values."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        pairs = [(f"{name}.{key}" if name else key, one[key], other[key]) for key in one]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(zip(one, other, strict=True))]
    else:  # compared as text, because Python takes 1, 1.0 and True for equal
        return None if json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True) else (name, one, other)
    return next((found for key, a, b in pairs if (found := difference(a, b, key))), None)


class _Description:
    """State of one description: the values in progress, the finished ones, and their number."""

    def __init__(self) -> None:
        self.active: dict[int, int] = {}
        self.described: dict[int, tuple[object, Plain]] = {}
        self.count = 0

    def of(self, value: Any) -> Plain:
        """Describe any value."""
        self.count += 1
        if self.count > _MAX_VALUES:
            raise UnknownIdentity(f"refers to more than {_MAX_VALUES} values")
        kind = type(value)
        if value is None or kind in (bool, int, str):
            return value
        if kind is float:
            return value if np.isfinite(value) else {"float": repr(value)}
        if kind in (complex, bytes, type(Ellipsis), type(NotImplemented), range, slice, np.dtype):
            return {kind.__name__: repr(value)}
        if id(value) in self.active:  # a function that calls itself, or an object that refers to itself
            return {"again": len(self.active) - self.active[id(value)]}
        if id(value) in self.described:
            return self.described[id(value)][1]
        self.active[id(value)] = len(self.active)
        try:
            found = self._composed(value)
        finally:
            del self.active[id(value)]
        self.described[id(value)] = (value, found)  # a reference to the value keeps Python from reusing its id
        return found

    def _composed(self, value: Any) -> Plain:
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return self._array(value)
        if isinstance(value, types.ModuleType):
            return self._module(value)
        if isinstance(value, enum.Enum):
            return {"member": f"{_name(type(value))}.{value.name}", "value": self.of(value.value)}
        if isinstance(value, type):
            return self._class(value)
        if (named := _library_name(value)) is not None:
            return {"name": named}
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, types.MethodType):
            return {"method": self.of(value.__func__), "self": self.of(value.__self__)}
        if isinstance(value, functools.partial):
            return {"partial": self.of(value.func), "args": self.of(value.args), "keywords": self.of(value.keywords)}
        if isinstance(value, (property, staticmethod, classmethod, functools.cached_property)):
            parts = [getattr(value, part, None) for part in ("fget", "fset", "fdel", "__func__", "func")]
            return {type(value).__name__: [self.of(part) for part in parts]}
        if isinstance(value, (list, tuple, dict, set, frozenset, types.MappingProxyType)):
            return self._container(value)
        if dataclasses.is_dataclass(value) and not _is_users(type(value)):
            fields = {field.name: self.of(getattr(value, field.name, None)) for field in dataclasses.fields(value)}
            return {"class": _name(type(value)), **fields}
        if callable(value) and hasattr(value, "__wrapped__"):  # jax.jit, functools.lru_cache
            return {"wrapper": _name(type(value)), "of": self.of(getattr(value, "__wrapped__", None))}
        return self._object(value)

    def _array(self, value: Any) -> Plain:
        try:
            array = np.asarray(value)
        except jax.errors.TracerArrayConversionError as error:
            raise UnknownIdentity("refers to an array under a JAX transformation") from error
        if array.dtype == object:
            return {"array": self.of(array.tolist())}
        kind = f"{array.dtype.str}{list(array.shape)}"
        if array.dtype.kind in "biuf" and array.size <= _MAX_ENTRIES:
            return {"array": kind, "values": [repr(x) for x in array.ravel().tolist()]}
        return {"array": kind, "digest": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:32]}

    def _container(self, value: Any) -> Plain:
        if isinstance(value, Mapping):
            entries: list[Plain] = [[self.of(key), self.of(entry)] for key, entry in value.items()]
        else:
            entries = [self.of(entry) for entry in value]
        if isinstance(value, (set, frozenset)):
            entries.sort(key=lambda entry: json.dumps(entry, sort_keys=True))
        kind = type(value)
        if kind in (list, tuple, dict, set, frozenset, types.MappingProxyType):
            return {kind.__name__: entries}
        return {"class": self.of(kind), "entries": entries, "state": self.of(getattr(value, "__dict__", None))}

    def _object(self, value: Any) -> Plain:
        kind = type(value)
        if _is_users(kind):
            slots = [name for base in kind.__mro__ for name in _slots(base)]
            state = {name: getattr(value, name) for name in slots if hasattr(value, name)} | getattr(value, "__dict__", {})
            return {"class": self.of(kind), "state": self.of(state)}
        try:
            reduced = value.__reduce_ex__(4)
        except Exception as error:  # locks, files, generators and other objects that cannot be pickled
            raise UnknownIdentity(f"refers to a value of the class {_name(kind)}, which cannot be compared") from error
        if isinstance(reduced, str):
            return {"class": _name(kind), "name": reduced}
        entries = [list(part) if isinstance(part, Iterator) else part for part in reduced]
        return {"class": _name(kind), "state": self.of(entries)}

    def _class(self, kind: type) -> Plain:
        if not _is_users(kind):
            return {"name": _name(kind)}
        entries: dict[str, Plain] = {}
        for name, entry in sorted(vars(kind).items()):
            hidden = name.startswith("__") and name.endswith("__") and not callable(entry)
            slot = isinstance(entry, (types.MemberDescriptorType, types.GetSetDescriptorType))
            if not (hidden or slot or name in _CLASS_ENTRIES_WITHOUT_EFFECT):
                entries[name] = self.of(entry)
        return {"class": _name(kind), "bases": self.of(list(kind.__bases__)), "digest": digest(entries)}

    def _function(self, function: types.FunctionType) -> Plain:
        home = str(function.__globals__.get("__name__"))  # `functools.wraps` overwrites `__module__`
        if _is_library(home) and function.__globals__ is getattr(sys.modules.get(home), "__dict__", None):
            code: Plain = _version(home)  # the version of the package identifies its wrappers and closures
        else:
            code = self._code(function.__code__, function.__globals__)
        names = function.__code__.co_freevars
        closure = {name: self._cell(cell) for name, cell in zip(names, function.__closure__ or (), strict=True)}
        rest = [self.of(x) for x in (function.__defaults__, function.__kwdefaults__, function.__dict__ or None)]
        version = "python {}.{}".format(*sys.version_info)
        return {"function": _name(function), "digest": digest([code, closure, *rest, version])}

    def _cell(self, cell: types.CellType) -> Plain:
        try:
            return self.of(cell.cell_contents)
        except ValueError:  # the name has no value yet
            return {"missing": True}

    def _code(self, code: types.CodeType, scope: dict[str, Any]) -> Plain:
        steps: list[Plain] = [list(code.co_varnames[: code.co_argcount]), code.co_flags, code.co_exceptiontable.hex()]
        shown = [step for step in dis.get_instructions(code) if step.opname not in ("EXTENDED_ARG", "CACHE", "NOP")]
        for k, step in enumerate(shown):
            if isinstance(step.argval, types.CodeType):
                steps.append([step.opname, self._code(step.argval, scope)])
            elif step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
                steps.append([step.opname, step.argval, self._global(step.argval, scope, shown[k + 1 :])])
            elif step.opname == "IMPORT_NAME":
                steps.append(
                    [step.opname, step.argval, self._imported(shown[k - 2].argval, step.argval, shown[k - 1].argval, scope)]
                )
            else:
                if step.opname in ("LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM") and step.argval in _UNKNOWN_ATTRIBUTES:
                    raise UnknownIdentity(f"calls {step.argval}, which can read a file")
                steps.append([step.opname, self.of(step.argval)])
        return steps

    def _global(self, name: str, scope: dict[str, Any], rest: list[dis.Instruction]) -> Plain:
        if name not in scope:
            if name in _UNKNOWN_BUILTINS:
                raise UnknownIdentity(f"calls {name}")
            return name if hasattr(builtins, name) else {"missing": name}
        value = scope[name]
        for step in rest:  # only the used entry of a module counts; other entries may change
            if not isinstance(value, types.ModuleType) or _is_library(value.__name__):
                break
            if step.opname not in ("LOAD_ATTR", "LOAD_METHOD") or not hasattr(value, step.argval):
                break
            value = getattr(value, step.argval)
        return self.of(value)

    def _imported(self, level: Any, name: str, entries: Any, scope: dict[str, Any]) -> Plain:
        """Describe a module that a function imports, or the `entries` that the function imports from it."""
        try:
            module = importlib.import_module("." * int(level or 0) + name, scope.get("__package__"))
        except ImportError:
            return {"missing": name}
        if not entries or _is_library(module.__name__):
            return self.of(module)
        return {entry: self.of(getattr(module, entry, None)) for entry in entries}

    def _module(self, module: types.ModuleType) -> Plain:
        name = module.__name__
        if _is_library(name):
            if name.partition(".")[0] in _UNKNOWN_MODULES:
                raise UnknownIdentity(f"uses the module {name}: files, the clock and the environment can change unnoticed")
            return {"module": name, "version": _version(name)}
        entries = {key: self.of(value) for key, value in sorted(vars(module).items()) if not key.startswith("__")}
        return {"module": name, "digest": digest(entries)}


def _name(value: Any) -> str:
    return f"{value.__module__}:{value.__qualname__}"


def _slots(kind: type) -> list[str]:
    slots = vars(kind).get("__slots__", ())
    return [slots] if isinstance(slots, str) else list(slots)


def _is_users(kind: type) -> bool:
    return not _is_library(kind.__module__)


def _library_name(value: Any) -> str | None:
    """Return name and version of an object that a package or Python defines under that name; None for other objects."""
    module, inner = getattr(value, "__module__", None), getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if not isinstance(inner, str) or isinstance(value, types.MethodType):
        return None
    if module is None and isinstance(getattr(value, "__self__", None), types.ModuleType):
        module = value.__self__.__name__
    if not isinstance(module, str) or not _is_library(module):
        return None
    found: Any = sys.modules.get(module)
    with contextlib.suppress(AttributeError):
        for part in inner.split("."):
            found = getattr(found, part)
        if found is value:
            if module.partition(".")[0] in _UNKNOWN_MODULES or (module == "builtins" and inner in _UNKNOWN_BUILTINS):
                raise UnknownIdentity(f"refers to {module}.{inner}: files, the clock and the environment can change unnoticed")
            return f"{module}:{inner} {_version(module)}"
    return None


@functools.cache
def _is_library(module: str) -> bool:
    """True if a module belongs to Python or to an installed package, including jaxvib."""
    root = module.partition(".")[0]
    if root in ("jaxvib", "optimize"):
        return True
    loaded = sys.modules.get(root)
    file = getattr(loaded, "__file__", None) or next(iter(getattr(loaded, "__path__", ())), None)
    if file is None:
        return root in sys.builtin_module_names or (root in sys.stdlib_module_names and root != "__main__")
    homes = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return any(os.path.realpath(file).startswith(os.path.realpath(home) + os.sep) for home in homes)


def _version(module: str) -> str:
    return str(getattr(sys.modules.get(module.partition(".")[0]), "__version__", ""))
