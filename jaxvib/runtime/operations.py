"""Number of operations of a program, and removal of unused operations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, jaxpr_as_fun, rewritten


def operations(function: Callable[..., Any], *arguments: Any) -> int:
    """Count the operations of the program of a function; those of loop bodies and called programs count once.

    **Arguments**: those of the function; `jax.ShapeDtypeStruct` may stand for arrays. **Returns** a count.

    >>> operations(lambda x: x * x + 1.0, 2.0)
    2
    """
    return sum(1 for _ in _walk(jax.make_jaxpr(function)(*arguments).jaxpr))


def _walk(jaxpr: Any) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        inner = [each for value in equation.params.values() for each in _programs(value)]
        if inner:
            for each in inner:
                yield from _walk(each)
        else:
            yield equation


def _programs(value: Any) -> Iterator[Any]:
    if hasattr(value, "jaxpr"):
        yield value.jaxpr
    elif hasattr(value, "eqns"):
        yield value
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _programs(each)


def pruned(function: Callable[..., Sequence[Array]], *like: Array) -> Callable[..., list[Array]]:
    """Return the traced function of arrays like `like`, without the operations on which no result depends.

    It is called before a derivative, which would otherwise include these operations.
    """
    if not HAS_JAXPRS:
        return lambda *arrays: list(function(*arrays))
    program = jax.make_jaxpr(function)(*like)
    needed, kept = {id(result) for result in program.jaxpr.outvars}, []
    for equation in reversed(program.jaxpr.eqns):
        if equation.effects or any(id(result) in needed for result in equation.outvars):
            needed |= {id(atom) for atom in equation.invars}
            kept.append((equation, equation.invars))
    return jaxpr_as_fun(rewritten(program, kept[::-1], program.jaxpr.outvars))
