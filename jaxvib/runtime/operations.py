"""The operations of a program: how many there are, and which of them some results need."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, ClosedJaxpr, jaxpr_as_fun, rewritten

__all__ = ["operations", "results_of"]


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


def results_of(
    function: Callable[..., Sequence[Array]],
    wanted: Sequence[bool],
    *like: Array,
    traced: tuple[ClosedJaxpr, Sequence[int]] | None = None,
) -> Callable[..., list[Array]]:
    """A function of such arrays, of which those results are `wanted`, traced, without the operations that the others alone
    need: who differentiates it does not differentiate these. It may have been `traced` before, as a part of a program, among
    whose results its own have these places."""

    def all_of_it(*arrays: Array) -> list[Array]:
        return [x for is_wanted, x in zip(wanted, function(*arrays), strict=True) if is_wanted]

    if not HAS_JAXPRS:
        return all_of_it
    program, places = traced or (jax.make_jaxpr(all_of_it)(*like), ())
    results = program.jaxpr.outvars
    if traced is not None:
        results = [results[k] for is_wanted, k in zip(wanted, places, strict=True) if is_wanted]
    needed, kept = {id(result) for result in results}, []
    for equation in reversed(program.jaxpr.eqns):
        if equation.effects or any(id(result) in needed for result in equation.outvars):
            needed |= {id(atom) for atom in equation.invars}
            kept.append((equation, equation.invars))
    fewer = rewritten(program, kept[::-1], results)
    return all_of_it if fewer is program and traced is not None else jaxpr_as_fun(fewer)
