"""Primitives with rules of their own, by which JAX differentiates, maps and transposes what it cannot look into."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import Array

from jaxvib.runtime.compat import HAS_JAXPRS, Primitive

__all__ = ["HAS_RULES", "is_zero", "primitive", "pulled_back", "zero_of"]


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
"""Rules of primitives. Without them derivatives of cached functions are traced in each process."""


def primitive(
    name: str,
    *,
    computed: Callable[..., list[Array]],
    in_batch: Callable[..., tuple],
    differentiated: Callable[..., tuple] | None = None,
    transposed: Callable[..., list] | None = None,
    traced: Callable[..., list[Array]] | None = None,
    abstract: Callable[..., Sequence] | None = None,
) -> Callable[..., list[Array]]:
    """A function of arrays, and of what else it is given by name, of which JAX knows no more than these rules.

    **Arguments**: what it computes, in numbers; in a batch, of arrays and the axis of each; differentiated, of arrays and
    tangents; transposed, of cotangents and arrays; what is traced in its place, and the types of its results. **Returns** a
    function, of numbers only where rules have another form (`HAS_RULES`).
    """
    if not HAS_RULES:
        return computed
    made = Primitive(name)
    made.multiple_results = True
    made.def_impl(computed)
    batching.primitive_batchers[made] = in_batch
    if differentiated is not None:
        ad.primitive_jvps[made] = differentiated
    if transposed is not None:
        ad.primitive_transposes[made] = transposed
    if abstract is not None:
        made.def_abstract_eval(abstract)
    if traced is not None:
        mlir.register_lowering(made, mlir.lower_fun(traced, multiple_results=True))
    return made.bind


def is_zero(tangent: object) -> bool:
    """Whether a rule of a `primitive` is given no tangent."""
    return isinstance(tangent, ad.Zero)


def zero_of(x: Array) -> object:
    """No tangent of `x`, as rules of a `primitive` return it."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def pulled_back(pullback: Callable[[list], Sequence[Array]], cotangents: list) -> list[Array]:
    """What a function that `jax.vjp` returned gives, of cotangents that may be `zero_of`; with JAX 0.10.0, whose functions know
    no such zeros, of numbers 0 in their place."""
    try:
        return list(pullback(cotangents))
    except ValueError:
        return list(pullback([ad.instantiate_zeros(x) for x in cotangents]))
