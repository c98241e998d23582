"""Private interfaces of JAX, Equinox, diffrax and XLA that the project uses, each with a fallback.

Each has a test in tests/runtime/test_compat.py, which fails if a new version changes the interface.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib.metadata
import inspect
import json
import os
import re
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

if TYPE_CHECKING:
    import equinox as eqx

_TESTED_JAXLIB = ((0, 10), (0, 12))
"""First and last version (major, minor) of jaxlib with tested flags, see `accepted_flags`."""

_REMOVED_FLAGS = {"--xla_cpu_use_fusion_emitters": (0, 11)}
"""Flags of `prepare_cpu` that were removed from jaxlib, with the first version (major, minor) that lacks each."""

try:
    from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive, Var, jaxpr_as_fun

    HAS_JAXPRS = True
except ImportError:
    HAS_JAXPRS = False
    if TYPE_CHECKING:
        raise
    ClosedJaxpr = Jaxpr = JaxprEqn = Literal = Primitive = Var = jaxpr_as_fun = None
"""Classes of traced programs, from `jax.extend.core`, which may change at any time. Without them jaxvib.ode cannot rewrite the
equations as operations on scalars, and integrates them on arrays, which is slower."""


def rewritten(
    program: ClosedJaxpr, equations: Sequence[tuple[JaxprEqn, list[Var | Literal]]], results: list[Var | Literal]
) -> ClosedJaxpr:
    """Return the `program` with its operations replaced by `equations` (each with new inputs) and its results by `results`; the
    same program if JAX does not allow it."""
    try:
        changed = [equation.replace(invars=inputs) for equation, inputs in equations]
        return program.replace(jaxpr=program.jaxpr.replace(eqns=changed, outvars=results))
    except (AttributeError, TypeError):
        return program


Atoms: TypeAlias = "list[Var | Literal]"
"""The inputs of an operation."""

Replacement: TypeAlias = "tuple[list[tuple[JaxprEqn, Atoms]], Var]"
"""Operations with their inputs that replace another operation, and the variable that replaces its result."""


def operation_like(function: Callable[..., object], *like: Any) -> JaxprEqn:
    """Return the only operation of a `function`, with new variables; its arguments have the types of `like`."""
    shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in like]
    # A new lambda, because JAX returns the cached program with the same variables if the function is the same.
    (equation,) = jax.make_jaxpr(lambda *x: function(*x))(*shapes).jaxpr.eqns
    return equation


def traced(value: object) -> bool:
    """Return True if `value` is a tracer of JAX: its computation is being transformed.

    >>> traced(1.0)
    False
    """
    return isinstance(value, Tracer)


def inner_value(tracer: object) -> object | None:
    """Return the value whose derivative or batch a `tracer` represents; None for a tracer of `jit`. The value may be a tracer
    too."""
    kind = type(tracer).__name__
    return getattr(tracer, {"JVPTracer": "primal", "LinearizeTracer": "primal", "BatchTracer": "val"}.get(kind, ""), None)


def value_of(number: object) -> object:
    """Return the value of a number that is being differentiated, without its tangent (the primal value). Other numbers, such as
    those under `jit` or `vmap`, are returned unchanged."""
    while type(number).__name__ in ("JVPTracer", "LinearizeTracer") and hasattr(number, "primal"):
        number = number.primal  # pyright: ignore[reportAttributeAccessIssue]
    return number


def evaluating() -> contextlib.AbstractContextManager[None]:
    """Evaluate operations on concrete numbers immediately, even inside a transformation, unless JAX lacks the private
    context."""
    context = getattr(getattr(jax, "core", None), "eval_context", contextlib.nullcontext)
    return context()


@contextlib.contextmanager
def without_source_locations() -> Iterator[None]:
    """Trace without recording the source location of each operation, which saves time, if JAX has the private option."""
    limit = getattr(sys.modules.get("jax._src.config"), "traceback_in_locations_limit", None)
    with contextlib.nullcontext() if limit is None else limit(0):
        yield


def backend_started() -> bool:
    """Return True if JAX has started a backend, after which compiler flags have no effect; False if that is unknown. The public
    functions of JAX would start a backend."""
    return bool(getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", None))


def accepted_flags(flags: list[str]) -> list[str]:
    """Return those of the `flags` that this jaxlib supports. An unknown flag in XLA_FLAGS would end the process.

    For a version of jaxlib outside `_TESTED_JAXLIB` each flag is tried in a separate process, which takes seconds; the result
    is stored in a file.
    """
    version, number = importlib.metadata.version("jaxlib"), _jaxlib_version()
    if _TESTED_JAXLIB[0] <= number <= _TESTED_JAXLIB[1]:
        return [flag for flag in flags if number < _REMOVED_FLAGS.get(flag.partition("=")[0], (number[0], number[1] + 1))]
    path = user_folder() / f"flags-{version}.json"
    is_accepted: dict[str, bool] = {}
    with contextlib.suppress(OSError, ValueError):
        is_accepted = {str(flag): value is True for flag, value in json.loads(path.read_text(encoding="utf-8")).items()}
    untested = [flag for flag in flags if flag not in is_accepted]
    if untested:
        is_accepted |= {flag: jax_starts_with([flag]) for flag in untested}
        with contextlib.suppress(OSError):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            path.write_text(json.dumps(is_accepted), encoding="utf-8")
    return [flag for flag in flags if is_accepted[flag]]


def loops_need_a_flag() -> bool:
    """Return True for jaxlib before 0.12, which without a flag runs the body of a time loop as a chain of small functions.

    Measured ratio of the CPU time of a run without the flag to that with it: 7 to 10 with jaxlib 0.10.2. The ratio of the
    times with jaxlib 0.12.0 is 0.9 to 1.1.
    """
    return _jaxlib_version() < (0, 12)


def wide_vectors_are_right(flags: list[str]) -> bool:
    """Return True if programs with vectors of 512 bits are correct under these XLA_FLAGS.

    Such programs are wrong with XLA's fusion emitters (flag xla_cpu_use_fusion_emitters), the default of jaxlib 0.10: the
    arctangent of an array of 64 or more numbers is then 0. In jaxlib 0.11 the fusion emitters cannot be switched off; vectors
    of 512 bits are not used there.
    """
    return "--xla_cpu_use_fusion_emitters=false" in flags or _jaxlib_version() >= (0, 12)


def _jaxlib_version() -> tuple[int, ...]:
    return tuple(int(part) for part in importlib.metadata.version("jaxlib").split(".")[:2])


def jax_starts_with(flags: list[str]) -> bool:
    """Return True if JAX starts with these XLA_FLAGS in a separate process."""
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0


_patch_lock = threading.Lock()
_patches: dict[tuple[str, str], tuple[list[int], Any]] = {}
"""Replaced attributes by module and name: the threads for which they are replaced, and the original attribute."""


@contextlib.contextmanager
def _patched(module: ModuleType, name: str, instead: Callable[..., object]) -> Iterator[None]:
    """Replace a function of a module in the current thread only; several threads may use this context at the same time."""
    key, thread = (module.__name__, name), threading.get_ident()
    with _patch_lock:
        if key not in _patches:
            threads: list[int] = []
            original = getattr(module, name)
            _patches[key] = threads, original
            setattr(module, name, lambda *a, **k: (instead if threading.get_ident() in threads else original)(*a, **k))
        _patches[key][0].append(thread)
    try:
        yield
    finally:
        with _patch_lock:
            threads, original = _patches[key]
            threads.remove(thread)
            if not threads:
                del _patches[key]
                setattr(module, name, original)


def _unpatched(module: ModuleType | None, name: str) -> Any:
    """Return the original function of a module, even while `_patched` replaces it; None if the module has no such function."""
    with _patch_lock:
        patch = _patches.get((getattr(module, "__name__", ""), name))
    return getattr(module, name, None) if patch is None else patch[1]


@contextlib.contextmanager
def no_host_checks() -> Iterator[None]:
    """Trace run-time checks of Equinox (`equinox.error_if`) so that they return NaN and raise no error.

    Errors need a callback into Python, and a program with a callback cannot be stored on disk. Equinox's own setting, the
    environment variable EQX_ON_ERROR, is not sufficient: it is read when Equinox is imported, and applies to the whole process.
    If the variable differs from its default, or if Equinox lacks one of the private functions that are used here, the checks
    are not changed.
    """
    errors = sys.modules.get("equinox._errors")
    unjitted = getattr(errors, "branched_error_if_impl", None)
    is_default = hasattr(errors, "branched_error_if_impl_jit") and getattr(errors, "EQX_ON_ERROR", None) == "raise"
    if errors is None or unjitted is None or not is_default:
        yield
        return

    frames = getattr(errors, "traceback_util", None)

    def to_nan(*args: object, on_error: str) -> object:
        on_error = "nan" if on_error == "default" else on_error
        with contextlib.ExitStack() as stack:
            if on_error == "nan" and frames is not None and hasattr(frames, "include_frame"):
                # NaN has no message. For a message Equinox reads the source lines of the whole stack, which takes up to a fifth
                # of the time of a trace.
                stack.enter_context(_patched(frames, "include_frame", lambda frame: False))
            # The function without `jit` is called; JAX would reuse the trace of the compiled one outside of this context.
            return unjitted(*args, on_error=on_error)

    with _patched(errors, "branched_error_if_impl_jit", to_nan):
        yield


class _ModuleWithReplacements:
    """Module in which some names are replaced."""

    def __init__(self, module: ModuleType, **names: object):
        self._module = module
        self.__dict__.update(names)

    def __getattr__(self, name: str) -> object:
        return getattr(self._module, name)


_ULPS = 100
"""Distance from the end of diffrax's time loop, in units in the last place, within which a step is extended to the end."""

_REPLACEMENT_LOCK = threading.RLock()

_ULPS_ONE_BY_ONE = re.compile(rf"for _ in range\({_ULPS}\):\s+t1_clip_floor = eqxi\.prevbefore\(t1_clip_floor\)\n")


@contextlib.contextmanager
def fast_diffrax_loop_end() -> Iterator[None]:
    """Trace diffrax's time loops with a single computation of the time `_ULPS` units in the last place before the end.

    diffrax computes this time by `_ULPS` unrolled steps of one unit each. They add 300 operations to the program, 2000
    operations in the compiler and 0.4 s of compile time for each loop. If diffrax's code does not match `_ULPS_ONE_BY_ONE`,
    nothing is changed.
    """
    integrate = sys.modules.get("diffrax._integrate")
    loop, internals = _unpatched(integrate, "loop"), getattr(integrate, "eqxi", None)
    is_replaceable = inspect.isfunction(loop) and internals is not None and len(_ULPS_ONE_BY_ONE.findall(_source(loop))) == 1
    if integrate is None or not is_replaceable:
        yield
        return

    def shorter(**arguments: object) -> object:
        remaining, thread = _ULPS, threading.get_ident()

        def prevbefore(x: Array) -> Array:
            nonlocal remaining
            if remaining == 0 or threading.get_ident() != thread:
                return internals.prevbefore(x)
            remaining -= 1
            return x if remaining else ulps_below(x, _ULPS)

        with _REPLACEMENT_LOCK:  # another thread may trace another loop at the same time
            internals = integrate.eqxi
            setattr(integrate, "eqxi", _ModuleWithReplacements(internals, prevbefore=prevbefore))  # noqa: B010
            try:
                return loop(**arguments)
            finally:
                setattr(integrate, "eqxi", internals)  # noqa: B010

    with _patched(integrate, "loop", shorter):
        yield


@functools.cache
def _source(function: FunctionType) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):  # the source files are not installed
        return ""


def ulps_below(x: Array, number: int) -> Array:
    """Return the floating-point number that is `number` units in the last place below `x`; `x` must be a normal
    number, not 0."""
    whole = jax.lax.bitcast_convert_type(x, jnp.int64 if x.dtype.itemsize == 8 else jnp.int32)
    return jax.lax.bitcast_convert_type(jnp.where(x > 0.0, whole - number, whole + number), x.dtype)


def enumeration_of(item: object) -> type[eqx.Enumeration]:
    """Return the `equinox.Enumeration` of members, by the name in their representation if Equinox lacks the attribute."""
    enumeration = getattr(item, "_enumeration", None)
    if enumeration is None:
        module, _, name = repr(item).split("<")[0].rpartition(".")
        enumeration = getattr(sys.modules[module], name)
    return enumeration


def enumeration_names(enumeration: type[eqx.Enumeration]) -> tuple[str, ...]:
    """Return the names of the members in the order of their numbers, from the source if Equinox lacks its table of names."""
    members = getattr(enumeration, "_name_to_item", None)
    if members is not None:
        return tuple(members)
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(enumeration))).body
    assert isinstance(definition, ast.ClassDef)
    targets = [target for node in definition.body if isinstance(node, ast.Assign) for target in node.targets]
    return tuple(target.id for target in targets if isinstance(target, ast.Name))


def user_folder() -> Path:
    """Return jaxvib's folder for cached files: `$XDG_CACHE_HOME/jaxvib`, or `~/.cache/jaxvib` if the variable is not set."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxvib"
