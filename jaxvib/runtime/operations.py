"""The operations of a program: how many there are, and which of them are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, jaxpr_as_fun, rewritten

__all__ = ["operations", "pruned"]


def operations(function: Callable[..., Any], *arguments: Any) -> int:
    """Operations of the program that `function` is traced to, those of loop bodies and of called programs counted once.

    **Arguments**: the function's own; of arrays shapes and types are enough (`jax.ShapeDtypeStruct`). **Returns** a count.

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
    """A function of such arrays, traced, without the operations that none of its results needs: who differentiates it does not
    differentiate these."""
    if not HAS_JAXPRS:
        return lambda *arrays: list(function(*arrays))
    program = jax.make_jaxpr(function)(*like)
    needed, kept = {id(result) for result in program.jaxpr.outvars}, []
    for equation in reversed(program.jaxpr.eqns):
        if equation.effects or any(id(result) in needed for result in equation.outvars):
            needed |= {id(atom) for atom in equation.invars}
            kept.append((equation, equation.invars))
    return jaxpr_as_fun(rewritten(program, kept[::-1], program.jaxpr.outvars))
