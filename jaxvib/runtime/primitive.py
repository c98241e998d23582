"""JAX primitives with custom rules of differentiation, batching and transposition, for functions that JAX does not trace."""

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
CAN_DEFINE_PRIMITIVES = HAS_JAXPRS and all(
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
"""True if JAX lets other packages define primitives. If False, each process traces the derivatives of cached functions
again."""


def primitive(
    name: str,
    *,
    impl: Callable[..., list[Array]],
    batching_rule: Callable[..., tuple],
    jvp: Callable[..., tuple] | None = None,
    transpose: Callable[..., list] | None = None,
    lowering: Callable[..., list[Array]] | None = None,
    abstract_eval: Callable[..., Sequence] | None = None,
) -> Callable[..., list[Array]]:
    """Define a primitive by its rules. Its operands are arrays, and its keyword parameters are static.

    **Arguments**: the rules, each a function

    - `impl`: from concrete arrays to outputs
    - `batching_rule`: from arrays and their batch axes to outputs and their batch axes
    - `jvp`: from arrays and tangents to outputs and their tangents
    - `transpose`: from cotangents of the outputs and arrays to cotangents of the arrays
    - `lowering`: from arrays to outputs, inside `jit`
    - `abstract_eval`: from the types of the arrays to the types of the outputs

    **Returns** the function that applies the primitive; `impl` itself if `CAN_DEFINE_PRIMITIVES` is False.
    """
    if not CAN_DEFINE_PRIMITIVES:
        return impl
    defined = Primitive(name)
    defined.multiple_results = True
    defined.def_impl(impl)
    batching.primitive_batchers[defined] = batching_rule
    if jvp is not None:
        ad.primitive_jvps[defined] = jvp
    if transpose is not None:
        ad.primitive_transposes[defined] = transpose
    if abstract_eval is not None:
        defined.def_abstract_eval(abstract_eval)
    if lowering is not None:
        mlir.register_lowering(defined, mlir.lower_fun(lowering, multiple_results=True))
    return defined.bind


def is_zero(tangent: object) -> bool:
    """Return True if a tangent that is passed to a rule of a `primitive` is a symbolic zero."""
    return isinstance(tangent, ad.Zero)


def zero_of(x: Array) -> object:
    """Return the symbolic zero tangent of `x`, for rules of a `primitive`."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())
