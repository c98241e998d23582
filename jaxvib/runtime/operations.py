"""How large a program is: its operations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax

__all__ = ["operations"]


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
