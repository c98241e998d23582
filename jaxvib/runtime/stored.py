"""Programs stored on disk, so that the next process that asks the same question need not trace them.

A program is stored in the format of `jax.export`, below a line of JSON that describes the structure of its result. XLA's
compiled form is in JAX's own compilation cache. Files are data: nothing in them is run as Python.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import hashlib
import importlib.metadata
import itertools
import json
import os
import tempfile
import threading
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, export
from jax.sharding import Sharding, SingleDeviceSharding

from jaxvib.imported import CodeState, clear_derived, code_state, digest_of_sources
from jaxvib.runtime.cache import program_folder
from jaxvib.runtime.compat import evaluating, no_host_checks, without_source_locations
from jaxvib.runtime.cpu import processor
from jaxvib.runtime.devices import arrays_on_device
from jaxvib.runtime.structure import KNOWN_PACKAGES, Description, Skeleton, Slot, Undescribable, describe, leaf_key, rebuild

__all__ = ["StoredFunction", "is_debugging"]

T = TypeVar("T")

_PACKAGES = (*sorted(KNOWN_PACKAGES - {"jaxvib", "optimize"}), "jaxlib", "numpy")
"""Packages whose versions a traced program depends on."""

_OPTIONS = ("jax_enable_x64", "jax_numpy_rank_promotion", "jax_numpy_dtype_promotion", "jax_default_matmul_precision")
"""JAX's options that a traced program depends on."""


MAX_PROGRAMS_IN_MEMORY = 512
"""Largest number of programs in memory. XLA maps each into 10 to 400 areas of memory: a process with some thousand programs has
no areas left (65530 on Linux) and crashes inside the compiler without a message."""

MAX_PROGRAM_MEMORY = 768 * 2**20
"""Largest estimated memory, bytes, of all programs in memory: with the process itself less than 1.5 GB."""

MEMORY_PER_PROGRAM, MEMORY_PER_STORED_BYTE = 2**20, 300
"""Estimated memory, bytes, of a program: this, and this much for each byte of its stored form. XLA does not report the memory
of programs on the CPU. Measured growth of the resident memory: natural frequencies 2.0 MB (stored 4.3 kB), jam modes 13.6 MB
(32 kB), branches 11 to 16 MB (40 kB), an exact jam 38 MB (146 kB), a run 29 to 46 MB (280 kB)."""

UNKNOWN_STORED_SIZE = 100_000
"""Assumed stored size, bytes, of programs that cannot be stored: those with host callbacks, mostly runs with a progress bar."""

_clock = itertools.count()
_functions: weakref.WeakSet[StoredFunction] = weakref.WeakSet()
_listing = threading.Lock()  # of `_functions`


class StoredFunction(Generic[T]):
    """Compiled function of trees of arrays and hashable values, whose programs are stored on disk.

    The key of a program on disk holds all that it depends on: the shapes and types of arrays, the static parts of the
    arguments, JAX's options, the versions, the sources, and the processor. The least recently used programs in memory, beyond
    `MAX_PROGRAMS_IN_MEMORY` and `MAX_PROGRAM_MEMORY`, are freed and later read or traced again.

    Some programs are not stored, but traced in each process: those with arguments of other packages' classes (their sources
    are not part of the key), with functions that have no name, with host callbacks, with arrays on several devices. In a
    process whose code differs from the sources (see `jaxvib.imported`) no program is stored or read, and programs traced from
    the former code are not used again.
    """

    def __init__(self, function: Callable[..., T]):
        self.function = no_host_checks()(function)
        self.jitted = eqx.filter_jit(self.function)
        self.ready: dict[Hashable, _Program | None] = {}
        self.lock = threading.RLock()  # threads that need the same program wait for the one that compiles it
        with _listing:
            _functions.add(self)

    def __call__(self, leaves: Sequence[Any], treedef: Any) -> T:
        """Evaluate the function; its arguments (args, kwargs) have these leaves, none of them a tracer."""
        if (program := self.compiled(leaves, treedef)) is None:
            return self._jitted(leaves, treedef)
        program.used = next(_clock)
        with evaluating():  # inside a transformation JAX would dispatch a program of known numbers by its slow path
            return program(x for x in leaves if isinstance(x, _ARRAYS))

    def compiled(self, leaves: Sequence[Any], treedef: Any) -> _Program | None:
        """Return the compiled program of these arguments; None for calls whose program cannot be stored."""
        call, program = self._found(leaves, treedef)
        if program is _UNKNOWN:
            folder, *_, home, _ = call
            with self.lock:
                key = (_current_code(look=True), call)
                program = self.ready.get(key, _UNKNOWN)
                if program is _UNKNOWN:
                    with evaluating():  # inside a transformation JAX would trace these transfers
                        moved = arrays_on_device(leaves)
                        program = self._program(folder, moved, treedef, home)
                        if program is not None:
                            program.compile(leaf for leaf in moved if eqx.is_array(leaf))
                    self.ready[key] = program
            _evict_least_recently_used()
        return program

    def is_ready(self, leaves: Sequence[Any], treedef: Any) -> bool:
        """Return True if the program of these arguments is in memory, or cannot be stored."""
        return self._found(leaves, treedef)[1] is not _UNKNOWN

    def _found(self, leaves: Sequence[Any], treedef: Any) -> tuple[Any, _Program | None]:
        """Return the key of a call, and its program in memory, `_UNKNOWN`, or None if it cannot be stored."""
        folder = program_folder()
        if folder is None or is_debugging():
            return (), None
        call = (folder, treedef, tuple(map(leaf_key, leaves)), _home(leaves), _options())
        try:
            return call, self.ready.get((_current_code(), call), _UNKNOWN)
        except TypeError:  # an argument without a hash
            return (), None

    def _jitted(self, leaves: Sequence[Any], treedef: Any) -> T:
        args, kwargs = jax.tree.unflatten(treedef, arrays_on_device(leaves))
        return self.jitted(*args, **kwargs)

    def _program(self, folder: Path, leaves: Sequence[object], treedef: Hashable, home: Sharding) -> _Program | None:
        """Read the program from disk, or trace it and write it there; None for calls whose program cannot be stored."""
        if not code_state().is_on_disk:
            return None
        try:
            path = folder / f"{self.function.__name__}-{self._key(leaves, treedef)}.program"
            return _read(path, home) or self._write(path, leaves, treedef, home)
        except Undescribable:
            return None

    def _key(self, leaves: Sequence[object], treedef: Hashable) -> str:
        def abstract(leaf: Array) -> str:
            device, *others = leaf.sharding.device_set
            if others or device.platform != jax.devices()[0].platform:
                raise Undescribable("an array is not on one device of the default kind")
            return f"{leaf.dtype}{leaf.shape}{jax.typeof(leaf).weak_type}"

        arguments = describe(jax.tree.unflatten(treedef, leaves), abstract)
        name = f"{self.function.__module__}:{self.function.__qualname__}"
        return _digest(json.dumps([name, _sources(), _machine(), str(_options()), arguments]).encode())[:32]

    def _write(self, path: Path, leaves: Sequence[object], treedef: Hashable, home: Sharding) -> _Program:
        structure: list[Description] = []
        # The skeleton, since the arrays of this call would live as long as the program.
        arguments, state = Skeleton.of(leaves, treedef), code_state()

        def flat(*arrays: Array) -> list[Array]:
            args, kwargs = arguments.filled(arrays)
            result, outputs = self.function(*args, **kwargs), []
            structure[:] = [describe(result, outputs.append)]
            return [jnp.asarray(x, x.dtype) for x in outputs]  # outputs of a stored program have no weak types

        jitted = jax.jit(flat)
        try:
            with without_source_locations(), _no_garbage_collection():
                exported = export.export(jitted)(*(leaf for leaf in leaves if eqx.is_array(leaf)))
                stored = bytes(exported.serialize())
        except (ValueError, TypeError, NotImplementedError, ImportError):  # a host callback; JAX without flatbuffers
            if not structure:  # the function's own error
                raise
            return _Program.of(jitted, structure[0])
        exported = export.deserialize(bytearray(stored))  # the first one holds its trace, 1 to 3 MB
        program = _Program.of(_compiled(path, exported, home), structure[0], size=len(stored))
        if code_state(look=True) != state:  # the code changed during the trace
            return program
        head = json.dumps({"structure": structure[0]}).encode() + b"\n"
        with contextlib.suppress(OSError):  # a full disk or a read-only folder: the program still works in this process
            _replace(path, _digest(head + stored).encode() + b"\n" + head + stored)
        return program


@dataclasses.dataclass
class _Program:
    """Function of all arrays of the arguments, compiled by `jax.jit`.

    `result` is the structure of its result, `memory` its estimated memory in bytes, `used` the time of the last use.
    """

    run: Callable[..., list[Array]]
    result: Skeleton
    memory: int = 0
    used: int = dataclasses.field(default_factory=lambda: next(_clock))

    @classmethod
    def of(cls, run: Callable[..., list[Array]], structure: Description, size: int = UNKNOWN_STORED_SIZE) -> _Program:
        places = itertools.count()
        result = Skeleton(rebuild(structure, map(Slot, places)))
        if result.size != next(places):
            raise Undescribable("an array of the result is in a static field")
        return cls(run, result, MEMORY_PER_PROGRAM + MEMORY_PER_STORED_BYTE * size)

    def __call__(self, arrays: Iterable[Array | np.ndarray]) -> Any:
        return self.result.filled(self.run(*arrays))

    def compile(self, arrays: Iterable[Array]) -> None:
        """Compile the program, for arrays like these, without running it; JAX keeps the result."""
        self.run.lower(*arrays).compile()  # pyright: ignore[reportFunctionMemberAccess]


_pausing = threading.Lock()
_traces: list[bool] = []
"""An entry for each trace in progress: True if garbage collection was enabled before the first one."""


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, which takes a fifteenth of the time of a trace with its many objects."""
    with _pausing:
        _traces.append(gc.isenabled() if not _traces else _traces[0])
        gc.disable()
    try:
        yield
    finally:
        with _pausing:
            if _traces.pop() and not _traces:
                gc.enable()


_ARRAYS = (jax.Array, np.ndarray)  # a call moves NumPy's arrays to the device in a tenth of the time of `jax.device_put`
_UNKNOWN = _Program(lambda *_: [], Skeleton(()))


def _evict_least_recently_used() -> None:
    """Free the least recently used programs beyond `MAX_PROGRAMS_IN_MEMORY` and `MAX_PROGRAM_MEMORY`; keep the last one."""
    with _listing:
        functions = list(_functions)
    programs = [
        (p.used, p, function, key) for function in functions for key, p in list(function.ready.items()) if p is not None
    ]
    programs.sort(key=lambda each: each[0], reverse=True)
    memory = itertools.accumulate(program.memory for _, program, _, _ in programs)
    beyond = [each for k, each in enumerate(programs) if next(memory) > MAX_PROGRAM_MEMORY or k >= MAX_PROGRAMS_IN_MEMORY]
    for _, program, function, key in beyond if len(beyond) < len(programs) else beyond[1:]:
        if function.ready.pop(key, None) is not None:
            program.run.clear_cache()  # pyright: ignore[reportFunctionMemberAccess]


def _replace(path: Path, content: bytes) -> None:
    """Write a file atomically: another process never reads half a program, and a failure leaves no file behind."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        try:
            file.write(content)
            file.close()
            os.replace(file.name, path)
        except OSError:
            os.unlink(file.name)
            raise


def _read(path: Path, home: Sharding) -> _Program | None:
    """Read a program; None if the file is missing, damaged or another user's, and is to be written anew."""
    try:
        with path.open("rb") as file:
            if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid != os.geteuid():
                return None
            digest, _, content = file.read().partition(b"\n")
        if digest != _digest(content).encode():
            return None
        head, _, stored = content.partition(b"\n")
        exported = export.deserialize(bytearray(stored))
    except (OSError, ImportError):
        return None
    return _Program.of(_compiled(path, exported, home), json.loads(head)["structure"], size=len(stored))


def _compiled(path: Path, exported: export.Exported, home: Sharding) -> Callable[..., list[Array]]:
    def run(*arrays: Array) -> list[Array]:
        return exported.call(*arrays)  # pyright: ignore[reportReturnType]

    # The name is part of the key in JAX's compilation cache. It holds the processor, which JAX's key lacks, but no digest of
    # the sources: a program that an edit leaves unchanged is not compiled again.
    run.__name__ = f"{path.stem.rpartition('-')[0]}-{_digest(processor().encode())[:16]}"
    # Without shardings JAX compiles twice: for arrays that it may move, and for outputs of another program.
    return jax.jit(run, in_shardings=home)


def _home(leaves: Sequence[object]) -> Sharding:
    """Return the sharding of the first array that JAX must not move, otherwise that of the default device."""
    for leaf in leaves:
        if isinstance(leaf, jax.Array) and leaf.committed:
            return leaf.sharding
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return SingleDeviceSharding(chosen if isinstance(chosen, jax.Device) else jax.local_devices(backend=chosen)[0])


def is_debugging() -> bool:
    """Return True if JAX runs programs operation by operation, or may have to."""
    return any(getattr(jax.config, name) for name in ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs"))


def _options() -> tuple[Hashable, ...]:
    return tuple(getattr(jax.config, name) for name in _OPTIONS)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@functools.cache
def _sources() -> str:
    """Identify the code that programs are traced from: versions of packages and a digest of the sources."""
    versions = [importlib.metadata.version(name) for name in _PACKAGES]
    return f"{versions} {os.environ.get('EQX_ON_ERROR')} {digest_of_sources()}"


@functools.cache
def _machine() -> str:
    """Identify the devices, the compiler flags and the processor."""
    return f"{jax.devices()} {os.environ.get('XLA_FLAGS')} {processor()}"


_clearing = threading.RLock()
_traced_code = [code_state()]
"""State of the code that JAX's traced functions belong to."""


def _current_code(*, look: bool = False) -> CodeState:
    """Return the state of the code, see `code_state`; after a change, clear what was traced or derived from the former code."""
    state = code_state(look=look)
    if state != _traced_code[0]:
        with _clearing:
            if state != _traced_code[0]:
                clear_derived()
                eqx.clear_caches()
                jax.clear_caches()
                _traced_code[0] = state
    return state
