"""Operations of a program (here a jaxpr, not machine code): their text, their number, and removal of unused ones."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import json
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, ClosedJaxpr, jaxpr_as_fun, rewritten


def count_operations(function: Callable[..., object], *arguments: object) -> int:
    """Count the operations of the program of a function.

    The operations of a loop body count once, not once for each iteration; those of a called program count once for each call.
    Loops and calls themselves do not count.

    **Arguments**: those of the function; `jax.ShapeDtypeStruct` may stand for arrays. **Returns** a count.

    >>> count_operations(lambda x: x * x + 1.0, 2.0)
    2
    """
    return sum(1 for _ in _walk(jax.make_jaxpr(function)(*arguments).jaxpr))


def _walk(jaxpr: Any) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        called = [program for value in equation.params.values() for program in _programs(value)]
        if called:
            for program in called:
                yield from _walk(program)
        else:
            yield equation


def _programs(value: object) -> Iterator[Any]:
    if hasattr(value, "eqns"):
        yield value
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _programs(each)


PYTHON = "calls Python"
"""First words of the digest of a program that calls Python; such a program cannot be compared with other programs."""

_IRRELEVANT_PARAMETERS = ("name", "debug_info", "source_info")
"""Parameters of operations that do not change results."""


def program_text(program: ClosedJaxpr, decimals: int | None = None) -> list[str]:
    """Return a program as text with one operation in each line; the text is the same in every process.

    The text has the operations with their parameters, literals and constants, the operands of each, and the shapes and types of
    the results. Names, source lines and Python functions are left out.

    **Arguments**: `decimals`: number of decimals to which constants are rounded, relative to the largest entry of an array;
    None: exact. NumPy's linear algebra computes constants that differ by rounding errors between CPUs.

    >>> program_text(jax.make_jaxpr(lambda x: 2.0 * x)(np.float32(1.0)))
    ['arguments v0:float32[]', 'v1:float32[] = mul[...] ...2.0 v0', 'results v1']
    """
    return list(_lines(program, decimals))


def calls_python(program: ClosedJaxpr) -> bool:
    """Return True if a program calls a Python function whose result it uses, other than a run-time check of Equinox.

    >>> calls_python(jax.make_jaxpr(lambda x: jax.pure_callback(np.sin, x, x))(1.0))
    True
    """
    called = [e.params["callback"] for e in _walk(program.jaxpr) if e.primitive.name in ("pure_callback", "io_callback")]
    functions = [getattr(each, "callback_func", each) for each in called]
    return not all(str(getattr(each, "__module__", "")).startswith("equinox.") for each in functions)


def program_digest(program: ClosedJaxpr) -> str:
    """Return a digest of the text of a program, a string of 32 hexadecimal digits, the same in every process.

    If the program calls Python, the digest begins with `PYTHON` and is different in each call.
    """
    if calls_python(program):
        return f"{PYTHON} {uuid.uuid4().hex}"
    return hashlib.sha256(json.dumps(program_text(program)).encode()).hexdigest()[:32]


def _lines(closed: Any, decimals: int | None, depth: int = 0) -> Iterator[str]:
    jaxpr, constants = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
    names: dict[object, str] = {}

    def named(atom: Any) -> str:
        if hasattr(atom, "val"):
            return _text(atom.val, decimals)
        return names.setdefault(atom, f"v{len(names)}")

    indent = "  " * depth
    for variable, value in zip(jaxpr.constvars, constants, strict=False):
        yield f"{indent}{named(variable)} = {_text(value, decimals)}"
    yield f"{indent}arguments {' '.join(f'{named(v)}:{v.aval.str_short()}' for v in jaxpr.invars)}"
    for equation in jaxpr.eqns:
        inner: list[object] = []
        parameters = sorted((key, value) for key, value in equation.params.items() if key not in _IRRELEVANT_PARAMETERS)
        shown = ", ".join(f"{key}={_text(value, decimals, inner)}" for key, value in parameters)
        operands = " ".join(named(atom) for atom in equation.invars)
        results = " ".join(f"{named(v)}:{v.aval.str_short()}" for v in equation.outvars)
        yield f"{indent}{results} = {equation.primitive.name}[{shown}] {operands}"
        for each in inner:
            yield from _lines(each, decimals, depth + 1)
    yield f"{indent}results {' '.join(named(atom) for atom in jaxpr.outvars)}"


def _text(value: object, decimals: int | None, inner: list[object] | None = None) -> str:
    """Return a parameter or constant as text. Programs are appended to `inner`; functions and objects are named by type."""
    if hasattr(value, "eqns") or hasattr(value, "jaxpr"):
        if inner is None:
            return "program"
        inner.append(value)
        return f"program{len(inner)}"
    if value is None or isinstance(value, (bool, int, float, complex, str, enum.Enum, np.dtype)):
        return repr(value)
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        array = np.asarray(value)
        precision = decimals if array.dtype.kind in "fc" else None
        if array.size == 1:
            return f"{array.dtype}:{array.item()!r}" if precision is None else f"{array.dtype}:{array.item():.{precision}g}"
        if precision is not None:
            finite = np.where(np.isfinite(array), array, 0.0)
            scale = np.max(np.abs(finite), initial=0.0) or 1.0
            array = np.append(np.round(array / scale, precision) + 0.0, float(f"{scale:.{precision}g}"))  # no -0
        return f"{array.dtype}{list(array.shape)}:{hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:12]}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_text(x, decimals, inner)}" for key, x in sorted(value.items(), key=str)) + "}"
    if isinstance(value, (tuple, list)):
        return f"{type(value).__name__}({', '.join(_text(x, decimals, inner) for x in value)})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ", ".join(f"{f.name}={_text(getattr(value, f.name), decimals, inner)}" for f in dataclasses.fields(value))
        return f"{type(value).__name__}({fields})"
    return type(value).__name__


def pruned(function: Callable[..., Sequence[Array]], *like: Array) -> Callable[..., list[Array]]:
    """Trace a function of arrays like `like`, and return it without the operations on which no result depends.

    Prune a function before it is differentiated; its derivative would otherwise include these operations.
    """
    if not HAS_JAXPRS:
        return lambda *arrays: list(function(*arrays))
    program = jax.make_jaxpr(function)(*like)
    needed, remaining = {id(result) for result in program.jaxpr.outvars}, []
    for equation in reversed(program.jaxpr.eqns):
        if equation.effects or any(id(result) in needed for result in equation.outvars):
            needed |= {id(atom) for atom in equation.invars}
            remaining.append((equation, equation.invars))
    return jaxpr_as_fun(rewritten(program, remaining[::-1], program.jaxpr.outvars))
