"""Compiled programs cached on disk, so that the next process that asks the same question neither traces nor compiles."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import pickle
import re
import tempfile
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.experimental import serialize_executable

from jaxvib.runtime.cpu import processor

__all__ = ["cached", "keep_programs"]

P = ParamSpec("P")
T = TypeVar("T")

_folder: list[Path] = []


def keep_programs(folder: Path | None) -> None:
    """From now on `cached` functions are looked for in `folder` and written there; None: they are not.

    JAX's own compilation cache saves compiling, not tracing and lowering, which take as long for a program of this kind.
    Whoever can write to the folder can run code as you: it must be your own.
    """
    _folder[:] = [] if folder is None else [folder]


class _CachedFunction(Generic[P, T]):
    """`equinox.filter_jit` of a function, whose programs outlive the process where `keep_programs` has named a folder."""

    def __init__(self, function: Callable[P, T]):
        self.function = function
        self.jitted = eqx.filter_jit(function)
        self.ready: dict[str, tuple[Callable[..., list[Any]], Any]] = {}
        functools.update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        leaves, rest = jax.tree.flatten((args, kwargs))
        if not _folder or any(isinstance(leaf, Tracer) for leaf in leaves):
            return self.jitted(*args, **kwargs)
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        key = self._key(leaves, rest)
        if key is None:
            return self.jitted(*args, **kwargs)
        if key not in self.ready:
            path = _folder[0] / f"{self.function.__name__}-{key}"
            self.ready[key] = _read(path) or self._write(path, leaves, rest)
        run, skeleton = self.ready[key]
        values = iter(run(*arrays))
        return jax.tree.map(lambda leaf: next(values) if leaf is _ARRAY else leaf, skeleton)

    def _key(self, leaves: list[Any], rest: Any) -> str | None:
        """All that the traced program depends on; None where that cannot be told, as with a function made on the spot."""
        shown = [f"{x.dtype}{x.shape}{jax.typeof(x).weak_type}" if eqx.is_array(x) else repr(x) for x in leaves]
        modes = [str(jax.config.values[name]) for name in ("jax_enable_x64", "jax_numpy_rank_promotion")]
        said = "\n".join([self.function.__module__, _sources(), jax.__version__, _machine(), *modes, str(rest), *shown])
        said = re.sub(r"<function ([\w.]+) at 0x[0-9a-f]+>", r"\1", said)
        return None if re.search(r" at 0x|<lambda>|<locals>", said) else hashlib.sha256(said.encode()).hexdigest()[:32]

    def _write(self, path: Path, leaves: list[Any], rest: Any) -> tuple[Callable[..., list[Any]], Any]:
        skeleton: list[Any] = []

        def flat(*arrays: Any) -> list[Any]:
            given = iter(arrays)
            args, kwargs = jax.tree.unflatten(rest, [next(given) if eqx.is_array(leaf) else leaf for leaf in leaves])
            out = self.function(*args, **kwargs)  # pyright: ignore[reportCallIssue]
            skeleton[:] = [jax.tree.map(lambda leaf: _ARRAY if eqx.is_array(leaf) else leaf, out)]
            return [jnp.asarray(leaf) for leaf in jax.tree.leaves(out) if eqx.is_array(leaf)]

        # A name of its own keeps JAX's compilation cache away: what that has loaded cannot be written again.
        flat.__name__ = f"{self.function.__name__}_{uuid.uuid4().hex}"
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        compiled = jax.jit(flat).lower(*arrays).compile()
        try:
            calls = set(re.findall(r'custom_call_target="(\w+)"', compiled.as_text() or ""))
            if all(name.startswith("lapack_") for name in calls):  # anything else may be an address in this process
                program, given, given_back = serialize_executable.serialize(compiled)
                written = pickle.dumps((program, given, given_back, bool(calls), skeleton[0]))
                path.parent.mkdir(parents=True, exist_ok=True)
                with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                    file.write(written)
                os.replace(file.name, path)  # at once: another process never reads half a program
        except (RuntimeError, ValueError, TypeError, OSError, pickle.PicklingError, AttributeError):
            pass  # a program of no fixed form, or a folder that cannot be written: this process has it all the same
        return compiled, skeleton[0]


class _Array:
    """Stands where an array of a result goes."""

    def __reduce__(self) -> str:
        return "_ARRAY"


_ARRAY = _Array()


def _read(path: Path) -> tuple[Callable[..., list[Any]], Any] | None:
    try:
        program, given, given_back, lapack, skeleton = pickle.loads(path.read_bytes())
        with ThreadPoolExecutor(1) as beside:
            loaded = beside.submit(
                serialize_executable.deserialize_and_load, program, given, given_back, execution_devices=jax.devices()[:1]
            )
            if lapack:  # JAX binds the library only when it lowers a call of it; an unbound call would end the process
                jax.jit(jnp.linalg.eigvalsh).lower(jax.ShapeDtypeStruct((1, 1), float))
            return loaded.result(), skeleton
    except Exception:  # no such file, or whatever a damaged one makes of its reader: it is written anew
        return None


@functools.cache
def _sources() -> str:
    """Changes whenever a line of the code that programs are traced from may have changed."""
    files = [file.stat() for file in sorted(Path(__file__).parent.rglob("*.py"))]
    versions = [importlib.metadata.version(name) for name in ("jaxlib", "equinox", "diffrax")]
    return f"{versions} {[(file.st_size, file.st_mtime_ns) for file in files]}"


@functools.cache
def _machine() -> str:
    """What a compiled program can run on."""
    return f"{jax.devices()} {os.environ.get('XLA_FLAGS')} {processor()}"


def cached(function: Callable[P, T]) -> Callable[P, T]:
    """Compiles a function of pytrees, as `equinox.filter_jit` does, and keeps its programs where a folder is named.

    Under a JAX transformation it is just the compiled function. The key holds everything a program depends on: the shapes,
    the static parts of the arguments, the processor, the versions, and when the sources were changed.
    """
    return _CachedFunction(function)
