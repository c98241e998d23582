"""Programs stored on disk, which other processes read instead of tracing them again.

A file contains a line with a digest, a line of JSON that describes the structure of the result, and the program in the format
of `jax.export`. The form compiled by XLA is in JAX's own compilation cache. Files are data: no Python code in them is executed.
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
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, export
from jax.sharding import Sharding, SingleDeviceSharding

from jaxvib.code_changes import CodeState, clear_function_caches, code_state, digest_of_sources
from jaxvib.runtime.cache import program_folder
from jaxvib.runtime.compat import evaluating, no_host_checks, without_source_locations
from jaxvib.runtime.cpu import processor
from jaxvib.runtime.devices import arrays_on_device, jax_option
from jaxvib.runtime.structure import KNOWN_PACKAGES, Description, Skeleton, Slot, Undescribable, describe, leaf_key, rebuild

T = TypeVar("T")

_PACKAGES = (*sorted(KNOWN_PACKAGES - {"jaxvib", "optimize"}), "jaxlib", "numpy")
"""Packages on whose versions a traced program depends."""

_OPTIONS = ("jax_enable_x64", "jax_numpy_rank_promotion", "jax_numpy_dtype_promotion", "jax_default_matmul_precision")
"""Options of JAX on which a traced program depends."""


MAX_PROGRAMS_IN_MEMORY = 512
"""Largest number of programs in memory. XLA maps each program into 10 to 400 memory areas. A process with thousands of programs
therefore exceeds the limit of Linux (65530 areas) and crashes inside the compiler without a message."""

MAX_PROGRAM_MEMORY = 768 * 2**20
"""Largest estimated memory, bytes, of all programs in memory. The whole process then needs less than 1.5 GB."""

MEMORY_PER_PROGRAM, MEMORY_PER_COMPRESSED_BYTE, MEMORY_PER_STORED_BYTE = 2**20, 700, 3
"""Estimated memory of a program, bytes: a constant, and factors of the compressed and of the whole size of its stored form. XLA
does not report the memory of programs on the CPU. The compressed size measures the operations: constants of a program, such as
the incidence matrix of 200 platforms, compress to a few bytes. Measured growth of the resident memory: natural frequencies
2.0 MB (compressed 3.3 kB), jam modes 13.6 MB (19 kB), of 50 platforms 44 MB (50 kB), an exact jam 38 MB (47 kB)."""

UNKNOWN_MEMORY = 31 * 2**20
"""Assumed memory, bytes, of programs that cannot be stored because of host callbacks, mostly runs with a progress bar."""

_clock = itertools.count()
_functions: weakref.WeakSet[StoredFunction] = weakref.WeakSet()
_functions_lock = threading.Lock()


class StoredFunction(Generic[T]):
    """Compiled function of trees of arrays and hashable values, whose programs are stored on disk.

    The key of a stored program contains everything on which the program depends: the shapes and types of arrays, the static
    parts of the arguments, JAX's options, the versions of packages, the sources, the devices, the flags of XLA, and the CPU. If
    the programs in memory exceed `MAX_PROGRAMS_IN_MEMORY` or `MAX_PROGRAM_MEMORY`, the least recently used ones are freed and
    later read or traced again.

    Some programs cannot be stored. They are traced in each process, and again after they were freed:

    - programs whose arguments or results are of classes of other packages, because their sources are not part of the key
    - programs with an argument or result that is a function without a name, such as a lambda
    - programs with host callbacks

    Programs of arrays on several devices belong to `jitted`; their memory is not limited.

    In a process whose code differs from the source files (see `jaxvib.code_changes`), no program is stored or read. Programs
    that were traced from the former code are not used again.
    """

    def __init__(self, function: Callable[..., T]):
        self.function = no_host_checks()(function)
        self.jitted = eqx.filter_jit(self.function)
        self.ready: dict[Hashable, _Program | None] = {}
        self.lock = threading.RLock()  # threads that need the same program wait for the thread that compiles it
        with _functions_lock:
            _functions.add(self)

    def __call__(self, leaves: Sequence[object], treedef: Hashable) -> T:
        """Evaluate the function for arguments (args, kwargs) with these leaves, none of which may be a tracer."""
        if (program := self.compiled(leaves, treedef)) is None:
            return self._jitted(leaves, treedef)
        program.used = next(_clock)
        with evaluating():  # inside a transformation JAX would use its slow dispatch, even if no argument is traced
            return program(x for x in leaves if isinstance(x, _ARRAYS))

    def compiled(self, leaves: Sequence[object], treedef: Hashable) -> _Program | None:
        """Return the compiled program for these arguments, or None if `jitted` has to compile it."""
        call, program = self._look_up(leaves, treedef)
        if program is _UNKNOWN:
            folder, *_, sharding, _ = call
            with self.lock:
                key = (_current_code(compare=True), call)
                program = self.ready.get(key, _UNKNOWN)
                if program is _UNKNOWN:
                    with evaluating():  # inside a transformation JAX would trace these transfers
                        on_device = arrays_on_device(leaves)
                        with _compilation():
                            program = self._program(folder, on_device, treedef, sharding)
                            if program is not None:
                                program.compile(leaf for leaf in on_device if eqx.is_array(leaf))
                    self.ready[key] = program
            _evict_least_recently_used()
        return program

    def is_ready(self, leaves: Sequence[object], treedef: Hashable) -> bool:
        """Return True if the program for these arguments is in memory, or if `jitted` has to compile it."""
        return self._look_up(leaves, treedef)[1] is not _UNKNOWN

    def _look_up(self, leaves: Sequence[object], treedef: Hashable) -> tuple[Any, _Program | None]:
        """Return the key of a call and its program: `_UNKNOWN` if not in memory, None if `jitted` has to compile it."""
        if is_debugging():
            return (), None
        call = (program_folder(), treedef, tuple(map(leaf_key, leaves)), _sharding_of(leaves), _options())
        try:
            return call, self.ready.get((_current_code(), call), _UNKNOWN)
        except TypeError:  # an argument is not hashable
            return (), None

    def _jitted(self, leaves: Sequence[object], treedef: Hashable) -> T:
        args, kwargs = jax.tree.unflatten(treedef, arrays_on_device(leaves))
        return self.jitted(*args, **kwargs)

    def _program(self, folder: Path | None, leaves: Sequence[object], treedef: Hashable, sharding: Sharding) -> _Program | None:
        """Read the program from disk, or else trace it, and write it to disk if possible; return None for several devices."""
        if not all(_is_on_one_device(leaf) for leaf in leaves):
            return None
        path = self._path(folder, leaves, treedef)
        return (path and _read(path, sharding)) or self._trace(path, leaves, treedef, sharding)

    def _path(self, folder: Path | None, leaves: Sequence[object], treedef: Hashable) -> Path | None:
        """Return the path of the stored program, or None if it cannot be stored."""
        if folder is None or not code_state().is_on_disk:
            return None
        try:
            return folder / f"{self.function.__name__}-{self._key(leaves, treedef)}.program"
        except Undescribable:
            return None

    def _key(self, leaves: Sequence[object], treedef: Hashable) -> str:
        def abstract(leaf: Array) -> str:
            return f"{leaf.dtype}{leaf.shape}{jax.typeof(leaf).weak_type}"

        arguments = describe(jax.tree.unflatten(treedef, leaves), abstract)
        name = f"{self.function.__module__}:{self.function.__qualname__}"
        return _digest(json.dumps([name, _sources(), _machine(), str(_options()), arguments]).encode())[:32]

    def _trace(self, path: Path | None, leaves: Sequence[object], treedef: Hashable, sharding: Sharding) -> _Program:
        """Trace the program, and write it to `path` unless this is None or its result has no description."""
        results: list[tuple[Description, Skeleton]] = []
        # `flat` refers to a skeleton, because the arrays of this call would otherwise stay in memory with the program.
        arguments, state = Skeleton.of(leaves, treedef), code_state()

        def flat(*arrays: Array) -> list[Array]:
            args, kwargs = arguments.filled(arrays)
            result, outputs = self.function(*args, **kwargs), []
            try:
                structure = describe(result, outputs.append)
                results[:] = [(structure, _skeleton(structure))]
            except Undescribable:
                parts, tree = jax.tree.flatten(result)
                outputs = [part for part in parts if eqx.is_array(part)]
                results[:] = [(None, Skeleton.of(parts, tree))]
            return [jnp.asarray(x, x.dtype) for x in outputs]  # not weakly typed, because a stored program's outputs are not

        jitted = jax.jit(flat)
        try:
            with without_source_locations(), _no_garbage_collection():
                exported = export.export(jitted)(*(leaf for leaf in leaves if eqx.is_array(leaf)))
                stored = bytes(exported.serialize())
        except (ValueError, TypeError, NotImplementedError, ImportError):  # a host callback; JAX without flatbuffers
            if not results:  # the function itself raised the error
                raise
            return _Program(jitted, results[0][1], UNKNOWN_MEMORY)
        exported = export.deserialize(bytearray(stored))  # the former `exported` would keep its trace, 1 to 3 MB, in memory
        (structure, result), name = results[0], self.function.__name__
        program = _Program(_compiled(name, exported, sharding), result, _estimated_memory(stored))
        if path is None or structure is None or code_state(compare=True) != state:  # the code changed during the trace
            return program
        head = json.dumps({"structure": structure}).encode() + b"\n"
        with contextlib.suppress(OSError):  # a full disk or a read-only folder: the program still works in this process
            _replace(path, _digest(head + stored).encode() + b"\n" + head + stored)
        return program


def _is_on_one_device(leaf: object) -> bool:
    """Return True except for an array on several devices, or on another kind of device than the default one."""
    if not isinstance(leaf, jax.Array):
        return True
    device, *others = leaf.sharding.device_set
    return not others and device.platform == jax.devices()[0].platform


def _skeleton(structure: Description) -> Skeleton:
    """Return the skeleton of a result. **Raises** `Undescribable` if an array is in a static field."""
    indices = itertools.count()
    result = Skeleton(rebuild(structure, map(Slot, indices)))
    if result.size != next(indices):
        raise Undescribable("an array of the result is in a static field")
    return result


@dataclasses.dataclass
class _Program:
    """Function `run` of all arrays of the arguments, compiled by `jax.jit`; `result`: structure of the result; `memory`:
    estimated, bytes; `used`: a counter that orders programs by their last use."""

    run: Callable[..., list[Array]]
    result: Skeleton
    memory: int = MEMORY_PER_PROGRAM
    used: int = dataclasses.field(default_factory=lambda: next(_clock))

    def __call__(self, arrays: Iterable[Array | np.ndarray | np.generic]) -> Any:
        return self.result.filled(self.run(*arrays))

    def compile(self, arrays: Iterable[Array]) -> None:
        """Compile the program for arrays like these without running it; JAX stores the compiled form."""
        self.run.lower(*arrays).compile()  # pyright: ignore[reportFunctionMemberAccess]


def _estimated_memory(stored: bytes) -> int:
    """Return the estimated memory, bytes, of a program with this stored form."""
    operations = len(zlib.compress(stored, level=1))
    return MEMORY_PER_PROGRAM + MEMORY_PER_COMPRESSED_BYTE * operations + MEMORY_PER_STORED_BYTE * len(stored)


_compilations: list[None] = []
"""An entry for each program that a thread is making ready."""


@contextlib.contextmanager
def _compilation() -> Iterator[None]:
    _compilations.append(None)
    try:
        yield
    finally:
        _compilations.pop()


def is_compiling() -> bool:
    """Return True if a thread is tracing, compiling or reading a program."""
    return bool(_compilations)


_traces_lock = threading.Lock()
_traces: list[bool] = []
"""Entries of all traces in progress, each True if garbage collection was enabled before the first of them."""


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, which takes a fifteenth of the time of a trace because a trace creates many objects."""
    with _traces_lock:
        _traces.append(gc.isenabled() if not _traces else _traces[0])
        gc.disable()
    try:
        yield
    finally:
        with _traces_lock:
            if _traces.pop() and not _traces:
                gc.enable()


_ARRAYS = (jax.Array, np.ndarray, np.generic)
"""Types of arrays. A compiled program accepts NumPy arrays, and copies them to the device in a tenth of the time of
`jax.device_put`."""

_UNKNOWN = _Program(lambda *_: [], Skeleton(()))
"""Sentinel for a program that is not in memory."""


def _evict_least_recently_used() -> None:
    """Free the least recently used programs beyond `MAX_PROGRAMS_IN_MEMORY` and `MAX_PROGRAM_MEMORY`, never the last one
    used."""
    with _functions_lock:
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
    """Write a file atomically: another process never reads an incomplete program, and an error leaves no file."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        try:
            file.write(content)
            file.close()
            os.replace(file.name, path)
        except OSError:
            os.unlink(file.name)
            raise


def _read(path: Path, sharding: Sharding) -> _Program | None:
    """Read a program; return None if the file is missing, is damaged or belongs to another user. The caller then writes it
    again."""
    try:
        with path.open("rb") as file:
            if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid != os.geteuid():
                return None
            digest, _, content = file.read().partition(b"\n")
        if digest != _digest(content).encode():
            return None
        head, _, stored = content.partition(b"\n")
        exported = export.deserialize(bytearray(stored))
        result = _skeleton(json.loads(head)["structure"])
    except (OSError, ImportError, Undescribable):
        return None
    return _Program(_compiled(path.stem.rpartition("-")[0], exported, sharding), result, _estimated_memory(stored))


def _compiled(name: str, exported: export.Exported, sharding: Sharding) -> Callable[..., list[Array]]:
    def run(*arrays: Array) -> list[Array]:
        return exported.call(*arrays)  # pyright: ignore[reportReturnType]

    # The name is part of the key in JAX's compilation cache. The name includes the processor, which JAX's key lacks. It
    # includes no digest of the sources, because a program that is the same after an edit need not be compiled again.
    run.__name__ = f"{name}-{_digest(processor().encode())[:16]}"
    # Without `in_shardings` JAX compiles twice: for uncommitted arrays, which it may move, and for outputs of other programs.
    return jax.jit(run, in_shardings=sharding)


def _sharding_of(leaves: Sequence[object]) -> Sharding:
    """Return the sharding of the first committed array, which JAX must not move; otherwise that of the default device."""
    for leaf in leaves:
        if isinstance(leaf, jax.Array) and leaf.committed:
            return leaf.sharding
    chosen = jax_option("jax_default_device")
    return SingleDeviceSharding(chosen if isinstance(chosen, jax.Device) else jax.local_devices(backend=chosen)[0])


def is_debugging() -> bool:
    """Return True if an option of JAX makes it run programs operation by operation, always or after a NaN or infinity."""
    return any(getattr(jax.config, name) for name in ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs"))


def _options() -> tuple[Hashable, ...]:
    return tuple(getattr(jax.config, name) for name in _OPTIONS)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@functools.cache
def _sources() -> str:
    """Identify the code from which programs are traced: versions of packages, EQX_ON_ERROR and a digest of the sources."""
    versions = [importlib.metadata.version(name) for name in _PACKAGES]
    return f"{versions} {os.environ.get('EQX_ON_ERROR')} {digest_of_sources()}"


@functools.cache
def _machine() -> str:
    """Identify the devices, the compiler flags and the CPU."""
    return f"{jax.devices()} {os.environ.get('XLA_FLAGS')} {processor()}"


_clearing_lock = threading.RLock()
_traced_code = [code_state()]
"""State of the code from which the functions in JAX's caches were traced."""


def _current_code(*, compare: bool = False) -> CodeState:
    """Return the state of the code, see `code_state`; after a change, clear all caches that depend on the former code."""
    state = code_state(compare=compare)
    if state != _traced_code[0]:
        with _clearing_lock:
            if state != _traced_code[0]:
                clear_function_caches()
                eqx.clear_caches()
                jax.clear_caches()
                _traced_code[0] = state
    return state
