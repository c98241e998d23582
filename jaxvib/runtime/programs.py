"""Functions whose programs are cached on disk, together with the programs of their derivatives and batches.

The file `README.md` in this folder explains how a cached gradient is computed.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, ParamSpec, TypeAlias, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.code_changes import code_state
from jaxvib.runtime.compat import evaluating, inner_value, traced
from jaxvib.runtime.devices import arrays_on_device
from jaxvib.runtime.operations import pruned
from jaxvib.runtime.primitive import CAN_DEFINE_PRIMITIVES, is_zero, primitive, zero_of
from jaxvib.runtime.startup import start
from jaxvib.runtime.stored import StoredFunction, is_debugging
from jaxvib.runtime.structure import Skeleton

P = ParamSpec("P")
T = TypeVar("T")

_Types: TypeAlias = tuple[tuple[tuple[int, ...], str, bool], ...]
"""Shape, dtype and weak-type flag of each array."""


@overload
def cached(function: Callable[P, T]) -> CachedFunction[P, T]: ...


@overload
def cached(*, outputs_from_solution: Callable[..., Any] | None) -> Callable[[Callable[P, T]], CachedFunction[P, T]]: ...


def cached(function: Callable[P, T] | None = None, *, outputs_from_solution: Callable[..., Any] | None = None) -> Any:
    """Compile a function of trees like `equinox.filter_jit`, and cache its programs on disk.

    First derivatives by `jax.jvp`, `grad`, `jacfwd` and `jacrev`, and batches by `vmap`, are separate programs, which are also
    cached. For derivatives of derivatives, and inside `jit`, JAX transforms the compiled function itself.

    **Arguments**: `outputs_from_solution`: a function of the outputs and the arguments. It recomputes the outputs, with the
    same derivatives, without the search for the solution, and may return None in place of an output. Reverse derivatives are
    computed from this function, or from the whole function if a needed output is None.
    """
    return (
        CachedFunction(function) if function else functools.partial(CachedFunction, outputs_from_solution=outputs_from_solution)
    )


class CachedFunction(Generic[P, T]):
    """Function returned by `cached`: `stored` evaluates it; `outputs_from_solution` is the argument of `cached`."""

    def __init__(self, function: Callable[P, T], outputs_from_solution: Callable[..., Any] | None = None):
        self.stored, self.outputs_from_solution = StoredFunction(function), outputs_from_solution
        functools.update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        start()
        leaves, treedef = jax.tree.flatten((args, kwargs))
        tracers = [leaf for leaf in leaves if traced(leaf)]
        if not tracers:
            return self.stored(leaves, treedef)
        return self._transformed(tracers, arrays_on_device(leaves), treedef, args, kwargs)

    def is_ready(self, *args: P.args, **kwargs: P.kwargs) -> bool:
        """Return True if a call does not have to load or compile a stored program: the program is in memory already, or the
        call uses none, because it cannot be stored or an argument is traced."""
        leaves, treedef = jax.tree.flatten((args, kwargs))
        return any(map(traced, leaves)) or self.stored.is_ready(leaves, treedef)

    def prepare(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Make the program of a call ready without running it: read it from disk, or else trace and compile it."""
        start()
        self.stored.compiled(*jax.tree.flatten((args, kwargs)))

    def _transformed(self, tracers: Sequence[object], leaves: Sequence[Any], treedef: Hashable, args: Any, kwargs: Any) -> T:
        """Evaluate the function under a JAX transformation."""
        if CAN_DEFINE_PRIMITIVES and not is_debugging() and all(map(_is_simple, tracers)):
            call = _CallSignature(self, Skeleton.of(leaves, treedef))
            if call.is_hashable():
                return call.result(_stored(*(leaf for leaf in leaves if eqx.is_array(leaf)), call=call))
        return self.stored.jitted(*args, **kwargs)


def _is_simple(tracer: object) -> bool:
    """Return True if `tracer` belongs to a single derivative or batch, at a value that is not traced."""
    value = inner_value(tracer)
    return value is not None and not traced(value)


@dataclasses.dataclass(frozen=True, repr=False)
class _CallSignature:
    """Call of a cached `function`: its `arguments` with slots in place of arrays; `outputs`: structure of the last result."""

    function: CachedFunction
    arguments: Skeleton
    outputs: list[Skeleton] = dataclasses.field(default_factory=list, compare=False)

    def __call__(self, arrays: Sequence[Array]) -> Any:
        """Call the original function, which is traced."""
        args, kwargs = self.arguments.filled(arrays)
        return self.function.stored.function(*args, **kwargs)

    def split(self, result: object) -> list[Array]:
        """Return the arrays of a result, and store its structure for the method `result`."""
        leaves, treedef = jax.tree.flatten(result)
        self.outputs[:] = [Skeleton.of(leaves, treedef)]
        return [leaf for leaf in leaves if eqx.is_array(leaf)]

    def result(self, arrays: Sequence[Array]) -> Any:
        """Return the result that has these arrays."""
        return self.outputs[0].filled(arrays)

    def outputs_from_solution(self, solution: Sequence[Array], arrays: Sequence[Array]) -> list[Array | None]:
        """Return the outputs of the user's function `outputs_from_solution`, with None for those that it does not provide."""
        assert self.function.outputs_from_solution is not None
        args, kwargs = self.arguments.filled(arrays)
        result = self.result(solution)
        provided = self.function.outputs_from_solution(result, *args, **kwargs)

        def spread(part: Array | None, whole: Any) -> Any:
            return [part] * len(jax.tree.leaves(whole))

        parts = jax.tree.leaves(jax.tree.map(spread, provided, result, is_leaf=_is_none), is_leaf=_is_none)
        return [part for part, x in zip(parts, jax.tree.leaves(result), strict=True) if eqx.is_array(x)]

    def is_hashable(self) -> bool:
        """Return True if the call can be the key of a program."""
        try:
            hash(self)
        except TypeError:
            return False
        return True


def _is_none(x: object) -> bool:
    return x is None


# --- programs of derivatives; `active` is True for arrays with a tangent, `wanted` for outputs with a nonzero cotangent ---


def _differentiable(
    call: _CallSignature, active: Sequence[bool], arrays: Sequence[Array]
) -> tuple[Callable[..., tuple[list[Array], list[Array]]], list[Array]]:
    """Return a function and the active arrays, which are its arguments. The function returns the floating-point outputs and, as
    auxiliary data, all outputs."""

    def function(*active_arrays: Array) -> tuple[list[Array], list[Array]]:
        outputs = call.split(call(_replaced(active, arrays, active_arrays)))
        return [x for x in outputs if _is_inexact(x)], outputs

    return function, _select(active, arrays)


def _select(active: Sequence[bool], arrays: Sequence[Array]) -> list[Array]:
    return [x for is_active, x in zip(active, arrays, strict=True) if is_active]


def _replaced(active: Sequence[bool], arrays: Sequence[Array], active_arrays: Sequence[Array]) -> list[Array]:
    """Return the arrays with the active ones replaced by `active_arrays`."""
    others = iter(active_arrays)
    return [next(others) if is_active else x for is_active, x in zip(active, arrays, strict=True)]


def _is_inexact(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


@cached
def _jvp_program(
    call: _CallSignature, active: tuple[bool, ...], arrays: list[Array], tangents: list[Array]
) -> tuple[Any, list[Array]]:
    """Return the result of a call and the tangents of its floating-point outputs."""
    function, active_arrays = _differentiable(call, active, arrays)
    _, output_tangents, outputs = jax.jvp(function, active_arrays, tangents, has_aux=True)
    return call.result(outputs), output_tangents


@cached
def _vjp_forward(call: _CallSignature, active: tuple[bool, ...], arrays: list[Array]) -> tuple[Any, list[Array]]:
    """Return the result of a call and the residuals of its reverse derivative."""
    outputs, pullback = _pullback(call, active, arrays)
    return call.result(outputs), [leaf for leaf in jax.tree.leaves(pullback) if eqx.is_array(leaf)]


@cached
def _vjp_backward(
    call: _CallSignature,
    active: tuple[bool, ...],
    wanted: tuple[bool, ...],
    types: _Types,
    residuals: list[Array],
    cotangents: list[Array],
) -> list[Array]:
    """Return the cotangents of the active arrays; `types` are the types of all arrays."""
    pullback, zeros = _traced_pullback(call, active, types)
    nonzero = iter(cotangents)
    all_cotangents = [next(nonzero) if is_wanted else zero for is_wanted, zero in zip(wanted, zeros, strict=True)]
    return list(pullback.filled(residuals)(all_cotangents))


@cached
def _vjp_from_solution(
    call: _CallSignature,
    active: tuple[bool, ...],
    wanted: tuple[bool, ...],
    arrays: list[Array],
    solution: list[Array],
    cotangents: list[Array],
) -> list[Array]:
    """Return the cotangents of the active arrays from `outputs_from_solution`; `solution` contains all outputs of the call."""
    inexact = [k for k, x in enumerate(solution) if _is_inexact(x)]
    needed = [k for k, is_wanted in zip(inexact, wanted, strict=True) if is_wanted]

    def function(*active_arrays: Array) -> list[Array]:
        present = _replaced(active, arrays, active_arrays)
        outputs = call.outputs_from_solution(solution, present)
        provided = [x for k in needed if (x := outputs[k]) is not None]
        if len(provided) == len(needed):
            return provided
        whole = call.split(call(present))
        return [whole[k] for k in needed]

    active_arrays = _select(active, arrays)
    return list(jax.vjp(pruned(function, *active_arrays), *active_arrays)[1](cotangents))


def _pullback(call: _CallSignature, active: tuple[bool, ...], arrays: Sequence[Array]) -> tuple[list[Array], Any]:
    """Return all outputs and the pullback (a function from cotangents of the floating-point outputs to those of the active
    arrays), and store the form of the pullback for `_traced_pullback`."""
    function, active_arrays = _differentiable(call, active, arrays)
    inexact, pullback, outputs = jax.vjp(function, *active_arrays, has_aux=True)
    form = Skeleton.of(*jax.tree.flatten(pullback)), tuple(map(zero_of, inexact))
    with _pullbacks_lock:
        _pullbacks[code_state(), call, active, _types(arrays)] = form
        while len(_pullbacks) > MAX_PULLBACK_FORMS:
            _pullbacks.popitem(last=False)
    return outputs, pullback


MAX_PULLBACK_FORMS = 64
"""Largest number of forms of pullbacks in memory, about 1 MB each. A form is needed only while the backward program is traced,
which follows soon after the trace of the forward program, if at all."""

_pullbacks: collections.OrderedDict[Hashable, tuple[Skeleton, tuple[object, ...]]] = collections.OrderedDict()
_pullbacks_lock = threading.Lock()


def _traced_pullback(call: _CallSignature, active: tuple[bool, ...], types: _Types) -> tuple[Skeleton, tuple[object, ...]]:
    """Return the skeleton of the pullback, without its arrays, and zero cotangents of the floating-point outputs."""
    key = code_state(), call, active, types
    if key not in _pullbacks:  # `_vjp_forward` was read from disk and not traced
        arrays = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in types]
        jax.eval_shape(lambda *values: _pullback(call, active, values)[0], *arrays)
    return _pullbacks[key]


def _types(arrays: Sequence[Array]) -> _Types:
    types = [jax.typeof(x) for x in arrays]  # JAX passes a Python number as an object without a shape
    return tuple((each.shape, str(each.dtype), bool(each.weak_type)) for each in types)


@cached
def _batched_program(call: _CallSignature, batched: tuple[bool, ...], arrays: list[Array]) -> Any:
    """Return the results of a batch; the first axis of each `batched` array is the axis of the batch."""
    shares = _shares_result(call, batched)

    def evaluate_entry(*arrays: Array) -> Any:
        result = call(arrays)
        return (call.split(result[0]), result[1]) if shares else call.split(result)

    axes = [0 if is_batched else None for is_batched in batched]
    outputs = jax.vmap(evaluate_entry, in_axes=axes, out_axes=(None, 0) if shares else 0)(*arrays)
    return (call.result(outputs[0]), outputs[1]) if shares else call.result(outputs)


def _shares_result(call: _CallSignature, batched: Sequence[bool]) -> bool:
    """Return True if a batch consists of several tangents at the same point, and therefore has a single primal result."""
    if call.function is not _jvp_program:
        return False
    _, _, arrays, _ = call.arguments.tree[0]
    return not any(batched[: len(arrays)])


# --- rules of the primitives ---


def _evaluate(*arrays: Array, call: _CallSignature) -> list[Array]:
    leaves, treedef = jax.tree.flatten(call.arguments.filled(arrays))
    return call.split(call.function.stored(leaves, treedef))


def _differentiate(arrays: Sequence[Array], tangents: Sequence[Any], *, call: _CallSignature) -> tuple[list[Array], list[Any]]:
    with evaluating():  # JAX passes a Python number as an object that is not an array, and a result may contain it unchanged
        arrays = [x if eqx.is_array(x) else jnp.asarray(x) for x in arrays]
    active = tuple(not is_zero(tangent) for tangent in tangents)
    nonzero = [tangent for is_active, tangent in zip(active, tangents, strict=True) if is_active]
    if all(not traced(tangent) or _is_simple(tangent) for tangent in nonzero):
        result, output_tangents = _jvp_program(call, active, list(arrays), nonzero)
    else:  # the tangents have no values, because JAX will transpose the linear map
        if call.function.outputs_from_solution is not None:
            args, kwargs = call.arguments.filled(arrays)
            result = call.function(*args, **kwargs)
            residuals = call.split(result)
        else:
            result, residuals = _vjp_forward(call, active, list(arrays))
        types = tuple(jax.typeof(x) for x in jax.tree.leaves(result) if eqx.is_array(x) and _is_inexact(x))
        output_tangents = _linear_map(*nonzero, at=_LinearizationPoint(call, active, list(arrays), residuals, types))
    outputs, inexact_tangents = call.split(result), iter(output_tangents)
    return outputs, [next(inexact_tangents) if _is_inexact(x) else zero_of(x) for x in outputs]


def _batch(
    arrays: Sequence[Array], axes: Sequence[int | None], *, call: _CallSignature
) -> tuple[list[Array], list[int | None]]:
    batched = tuple(axis is not None for axis in axes)
    leading = [x if axis is None or axis == 0 else jnp.moveaxis(x, axis, 0) for x, axis in zip(arrays, axes, strict=True)]
    result = _batched_program(call, batched, leading)
    outputs = call.split(result)
    shared = sum(map(eqx.is_array, jax.tree.leaves(result[0]))) if _shares_result(call, batched) else 0
    return outputs, [None if k < shared else 0 for k in range(len(outputs))]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class _LinearizationPoint:
    """Point of a linearization.

    **Attributes**: the `call`; `active`: True for arrays with a tangent; `arrays` of the arguments; `residuals` of the reverse
    derivative, or all outputs if the function has `outputs_from_solution`; `types` of the floating-point outputs.

    JAX formats the parameters of primitives for error messages whenever it batches them; `repr=False` avoids the formatting of
    all numbers.
    """

    call: _CallSignature
    active: tuple[bool, ...]
    arrays: list[Array]
    residuals: list[Array]
    types: tuple[object, ...]


def _apply_linear_map(*tangents: Array, at: _LinearizationPoint) -> list[Array]:
    return _jvp_program(at.call, at.active, at.arrays, list(tangents))[1]


def _trace_linear_map(*tangents: Array, at: _LinearizationPoint) -> list[Array]:
    return _jvp_program.stored.function(at.call, at.active, at.arrays, list(tangents))[1]


def _batch_linear_map(
    tangents: Sequence[Array], axes: Sequence[int | None], *, at: _LinearizationPoint
) -> tuple[list[Array], list[int]]:
    outputs = jax.vmap(functools.partial(_apply_linear_map, at=at), in_axes=tuple(axes))(*tangents)
    return outputs, [0] * len(outputs)


def _transpose(cotangents: Sequence[Any], *_: object, at: _LinearizationPoint) -> list[Array]:
    wanted = tuple(not is_zero(cotangent) for cotangent in cotangents)
    nonzero = [cotangent for is_wanted, cotangent in zip(wanted, cotangents, strict=True) if is_wanted]
    if at.call.function.outputs_from_solution is not None:
        return _vjp_from_solution(at.call, at.active, wanted, at.arrays, at.residuals, nonzero)
    return _vjp_backward(at.call, at.active, wanted, _types(at.arrays), at.residuals, nonzero)


_stored = primitive("stored", impl=_evaluate, jvp=_differentiate, batching_rule=_batch)
"""Primitive that calls a cached function under a single derivative or batch."""

_linear_map = primitive(
    "stored_linear_map",
    impl=_apply_linear_map,
    batching_rule=_batch_linear_map,
    transpose=_transpose,
    lowering=_trace_linear_map,
    abstract_eval=lambda *_, at: at.types,
)
"""Primitive that maps the tangents of the arguments of a cached function to the tangents of its outputs."""
