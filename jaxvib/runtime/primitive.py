"""Primitives with rules of their own for derivatives, batches and transposes of functions that JAX does not trace."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, Primitive

__all__ = ["HAS_RULES", "apply_pullback", "is_zero", "primitive", "zero_of"]


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


ad, batching, mlir = map(_module, ("jax.interpreters.ad", "jax.interpreters.batching", "jax.interpreters.mlir"))
HAS_RULES = HAS_JAXPRS and all(
    hasattr(module, name)
    for module, name in (
        (ad, "Zero"),
        (ad, "primitive_jvps"),
        (ad, "primitive_transposes"),
        (batching, "primitive_batchers"),
        (mlir, "lower_fun"),
        (mlir, "register_lowering"),
    )
)
"""True if JAX lets other packages define primitives. Otherwise derivatives of cached functions are traced in each process."""


def primitive(
    name: str,
    *,
    evaluate: Callable[..., list[Array]],
    batch: Callable[..., tuple],
    differentiate: Callable[..., tuple] | None = None,
    transpose: Callable[..., list] | None = None,
    trace: Callable[..., list[Array]] | None = None,
    abstract: Callable[..., Sequence] | None = None,
) -> Callable[..., list[Array]]:
    """Define a primitive of arrays, with further parameters by name, by its rules.

    **Arguments**

    - `evaluate`: arrays to outputs, for known numbers
    - `batch`: arrays and the axis of each to outputs and their axes
    - `differentiate`: arrays and tangents to outputs and their tangents
    - `transpose`: cotangents and arrays to cotangents
    - `trace`: arrays to outputs, inside `jit`
    - `abstract`: types of arrays to types of outputs

    **Returns** a function of arrays. Without `HAS_RULES` it is `evaluate`.
    """
    if not HAS_RULES:
        return evaluate
    defined = Primitive(name)
    defined.multiple_results = True
    defined.def_impl(evaluate)
    batching.primitive_batchers[defined] = batch
    if differentiate is not None:
        ad.primitive_jvps[defined] = differentiate
    if transpose is not None:
        ad.primitive_transposes[defined] = transpose
    if abstract is not None:
        defined.def_abstract_eval(abstract)
    if trace is not None:
        mlir.register_lowering(defined, mlir.lower_fun(trace, multiple_results=True))
    return defined.bind


def is_zero(tangent: object) -> bool:
    """Return True if a rule of a `primitive` gets a symbolic zero in place of a tangent."""
    return isinstance(tangent, ad.Zero)


def zero_of(x: Array) -> object:
    """Return the symbolic zero tangent of `x`, for rules of a `primitive`."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def apply_pullback(pullback: Callable[[list], Sequence[Array]], cotangents: list) -> list[Array]:
    """Apply a function from `jax.vjp` to cotangents that may be `zero_of`; JAX 0.10.0 gets arrays of zeros instead."""
    try:
        return list(pullback(cotangents))
    except ValueError:
        return list(pullback([ad.instantiate_zeros(x) for x in cotangents]))
