"""Primitives with custom rules for derivatives, batches and transposes, for functions that JAX does not trace."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, Primitive


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
"""True if JAX lets other packages define primitives. If not, each process traces the derivatives of cached functions again."""


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
    """Define a primitive of arrays and keyword parameters by its rules.

    **Arguments**: the rules, each a function

    - `evaluate`: from arrays that are not traced to outputs
    - `batch`: from arrays and their batch axes to outputs and their batch axes
    - `differentiate`: from arrays and tangents to outputs and their tangents
    - `transpose`: from cotangents of the outputs and arrays to cotangents of the arrays
    - `trace`: from arrays to outputs, inside `jit`
    - `abstract`: from types of arrays to types of outputs

    **Returns** a function of arrays, which is `evaluate` itself if `HAS_RULES` is False.
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
    """Return True if a tangent that is passed to a rule of a `primitive` is a symbolic zero."""
    return isinstance(tangent, ad.Zero)


def zero_of(x: Array) -> object:
    """Return the symbolic zero tangent of `x`, for rules of a `primitive`."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def apply_pullback(pullback: Callable[[list], Sequence[Array]], cotangents: list) -> list[Array]:
    """Apply a pullback of `jax.vjp` to cotangents, some of which may be symbolic zeros from `zero_of`.

    JAX 0.10.0 does not accept symbolic zeros; arrays of zeros replace them.
    """
    try:
        return list(pullback(cotangents))
    except ValueError:
        return list(pullback([ad.instantiate_zeros(x) for x in cotangents]))
