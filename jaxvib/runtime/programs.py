"""Functions whose programs are stored on disk, and those of their derivatives too.

A stored program cannot be differentiated; what can be is a primitive that stands for it. The rules of that primitive ask for
further stored programs, which were traced from derivatives of the function: its tangents, its values with what the reverse
derivative needs of them, the reverse derivative itself, and batches of these.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, ParamSpec, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.imported import code_state
from jaxvib.runtime.cache import program_folder
from jaxvib.runtime.compat import primal_of, traced
from jaxvib.runtime.devices import arrays_on_device
from jaxvib.runtime.operations import pruned
from jaxvib.runtime.primitive import HAS_RULES, is_zero, primitive, pulled_back, zero_of
from jaxvib.runtime.startup import start
from jaxvib.runtime.stored import StoredFunction, is_debugging
from jaxvib.runtime.structure import Skeleton, Undescribable, describe

__all__ = ["CachedFunction", "cached"]

P = ParamSpec("P")
T = TypeVar("T")


@overload
def cached(function: Callable[P, T]) -> CachedFunction[P, T]: ...


@overload
def cached(*, from_result: Callable[..., Any]) -> Callable[[Callable[P, T]], CachedFunction[P, T]]: ...


def cached(function: Callable[P, T] | None = None, *, from_result: Callable[..., Any] | None = None) -> Any:
    """Compiles a function of trees, as `equinox.filter_jit` does, and caches its programs on disk, see `StoredFunction`.

    Derivatives by `jax.jvp`, `grad`, `jacfwd`, `jacrev` and batches by `vmap` have programs of their own, cached alike. Where
    these are derivatives of derivatives, or `jit` is around them, it is just the compiled function that JAX transforms.

    **Arguments**: `from_result`: a function of the result and of the arguments that gives the numbers of the result once more,
    with the same derivatives: what the function searches for is known there. It gives None for those that it does not tell.
    The reverse derivative is taken of it; where others are asked for as well, of the function, computed once more as far as
    they need it. Else the function notes what the reverse derivative needs of all of its results.
    """
    return CachedFunction(function) if function else functools.partial(CachedFunction, from_result=from_result)


class CachedFunction(Generic[P, T]):
    """What `cached` returns: the function, whose programs and those of its derivatives are `stored`; and its argument."""

    def __init__(self, function: Callable[P, T], from_result: Callable[..., Any] | None = None):
        self.stored, self.from_result = StoredFunction(function), from_result
        functools.update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        start()
        leaves, treedef = jax.tree.flatten((args, kwargs))
        moved = [leaf for leaf in leaves if traced(leaf)]
        if not moved:
            return self.stored(leaves, treedef)
        try:
            return self._transformed(moved, arrays_on_device(leaves), treedef, args, kwargs)
        except TypeError as error:
            if "forward-mode" not in str(error):
                raise
            # JAX's own words for a reverse derivative of the step-replay adjoint, which is the default of time integration.
            raise InputError(
                "adjoint", "allows reverse derivatives only; for jvp and jacfwd of a run write adjoint=diffrax.ForwardMode()"
            ) from error

    def _transformed(self, moved: Sequence[Any], leaves: Sequence[Any], treedef: Any, args: Any, kwargs: Any) -> T:
        """The function of arguments some of which, `moved`, JAX is transforming."""
        if HAS_RULES and program_folder() is not None and not is_debugging() and all(map(_is_simple, moved)):
            question = _Question(self, Skeleton.of(leaves, treedef))
            if question.is_describable():
                return question.result(_stored(*(leaf for leaf in leaves if eqx.is_array(leaf)), question=question))
        return self.stored.jitted(*args, **kwargs)


def _is_simple(tracer: object) -> bool:
    """Whether one derivative or one batch is asked for, of numbers that are known."""
    value = primal_of(tracer)
    return value is not None and not traced(value)


@dataclasses.dataclass(frozen=True, repr=False)
class _Question:
    """A function of the arrays of its arguments, all else being given; `skeletons` what its results were last put into."""

    function: CachedFunction
    arguments: Skeleton
    skeletons: list[Skeleton] = dataclasses.field(default_factory=list, compare=False)

    def __call__(self, arrays: Sequence[Array]) -> Any:
        """Traced, by the function itself."""
        args, kwargs = self.arguments.filled(arrays)
        return self.function.stored.function(*args, **kwargs)

    def split(self, result: Any) -> list[Array]:
        """The arrays of a result; what is left is kept for `result`."""
        leaves, treedef = jax.tree.flatten(result)
        self.skeletons[:] = [Skeleton.of(leaves, treedef)]
        return [leaf for leaf in leaves if eqx.is_array(leaf)]

    def result(self, arrays: Sequence[Array]) -> Any:
        return self.skeletons[0].filled(arrays)

    def told(self, found: Sequence[Array], arrays: Sequence[Array]) -> list[Array | None]:
        """What the function's `from_result` gives for the arrays of a result that was `found`; None for others."""
        assert self.function.from_result is not None
        args, kwargs = self.arguments.filled(arrays)
        result = self.result(found)
        told = self.function.from_result(result, *args, **kwargs)

        def spread(part: Array | None, whole: Any) -> Any:
            return [part] * len(jax.tree.leaves(whole))

        parts = jax.tree.leaves(jax.tree.map(spread, told, result, is_leaf=_is_none), is_leaf=_is_none)
        return [part for part, x in zip(parts, jax.tree.leaves(result), strict=True) if eqx.is_array(x)]

    def is_describable(self) -> bool:
        """Whether its program can be told from others on disk."""
        try:
            return _is_describable(self)
        except TypeError:  # an argument without a hash
            return False


def _is_none(x: object) -> bool:
    return x is None


@functools.lru_cache(256)
def _is_describable(question: _Question) -> bool:
    try:
        describe((question.function, question.arguments), lambda _: None)
    except Undescribable:
        return False
    return True


# --- programs of derivatives ---


def _moving(question: _Question, active: Sequence[bool], arrays: Sequence[Array]) -> tuple[Callable[..., Any], list[Array]]:
    """The function of its `active` arrays, which returns the numbers that have derivatives and, beside them, all; and these."""

    def function(*moving: Array) -> tuple[list[Array], list[Array]]:
        found = question.split(question(_filled(active, arrays, moving)))
        return [x for x in found if _has_slope(x)], found

    return function, _active(active, arrays)


def _active(active: Sequence[bool], arrays: Sequence[Array]) -> list[Array]:
    return [x for moves, x in zip(active, arrays, strict=True) if moves]


def _filled(active: Sequence[bool], arrays: Sequence[Array], moving: Sequence[Array]) -> list[Array]:
    """The arrays with these in place of the `active` ones."""
    given = iter(moving)
    return [next(given) if moves else x for moves, x in zip(active, arrays, strict=True)]


def _has_slope(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


@cached
def _pushed(
    question: _Question, active: tuple[bool, ...], arrays: list[Array], tangents: list[Array]
) -> tuple[Any, list[Array]]:
    """The result, and the tangents of its numbers."""
    function, moving = _moving(question, active, arrays)
    _, slopes, found = jax.jvp(function, moving, tangents, has_aux=True)
    return question.result(found), slopes


@cached
def _noted(question: _Question, active: tuple[bool, ...], arrays: list[Array]) -> tuple[Any, list[Array]]:
    """The result, and what the reverse derivative needs."""
    found, pullback = _pullback(question, active, arrays)
    return question.result(found), [leaf for leaf in jax.tree.leaves(pullback) if eqx.is_array(leaf)]


@cached
def _pulled(
    question: _Question,
    active: tuple[bool, ...],
    asked: tuple[bool, ...],
    types: tuple[tuple[tuple[int, ...], str, bool], ...],
    notes: list[Array],
    slopes: list[Array],
) -> list[Array]:
    """Cotangents of the `active` arrays from those of the result's numbers, as far as these are `asked`."""
    pullback, zeros = _traced_pullback(question, active, types)
    given = iter(slopes)
    cotangents = [next(given) if wanted else zero for wanted, zero in zip(asked, zeros, strict=True)]
    return pulled_back(pullback.filled(notes), cotangents)


@cached
def _pulled_again(
    question: _Question,
    active: tuple[bool, ...],
    asked: tuple[bool, ...],
    arrays: list[Array],
    found: list[Array],
    slopes: list[Array],
) -> list[Array]:
    """`_pulled` of a function that has a `from_result`, of arrays for which these were `found`."""
    numbers = [k for k, x in enumerate(found) if _has_slope(x)]
    wanted = [k for k, is_asked in zip(numbers, asked, strict=True) if is_asked]

    def function(*moving: Array) -> list[Array]:
        given = _filled(active, arrays, moving)
        parts = question.told(found, given)
        told = [part for k in wanted if (part := parts[k]) is not None]
        if len(told) == len(wanted):
            return told
        whole = question.split(question(given))
        return [whole[k] for k in wanted]

    moving = _active(active, arrays)
    return list(jax.vjp(pruned(function, *moving), *moving)[1](slopes))


def _pullback(question: _Question, active: tuple[bool, ...], arrays: Sequence[Array]) -> tuple[list[Array], Any]:
    """The result's arrays and the reverse derivative, whose form is noted for `_traced_pullback`."""
    function, moving = _moving(question, active, arrays)
    numbers, pullback, found = jax.vjp(function, *moving, has_aux=True)
    form = Skeleton.of(*jax.tree.flatten(pullback)), tuple(map(zero_of, numbers))
    with _noting:
        _pullbacks[code_state(), question, active, _types(arrays)] = form
        while len(_pullbacks) > MAX_PULLBACK_FORMS:
            _pullbacks.popitem(last=False)
    return found, pullback


MAX_PULLBACK_FORMS = 64
"""Largest number of forms of reverse derivatives in memory, some 1 MB each. They are needed when a program of one is traced,
which is soon after or never."""

_pullbacks: collections.OrderedDict[Hashable, tuple[Skeleton, tuple[Any, ...]]] = collections.OrderedDict()
_noting = threading.Lock()


def _traced_pullback(question: _Question, active: tuple[bool, ...], types: Any) -> tuple[Skeleton, tuple[Any, ...]]:
    """The reverse derivative without the numbers it needs, and zeros of the kind of what it is a function of."""
    key = code_state(), question, active, types
    if key not in _pullbacks:  # `_noted` came from the disk
        arrays = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in types]
        jax.eval_shape(lambda *known: _pullback(question, active, known)[0], *arrays)
    return _pullbacks[key]


def _types(arrays: Sequence[Array]) -> tuple[tuple[tuple[int, ...], str, bool], ...]:
    return tuple((x.shape, str(x.dtype), bool(jax.typeof(x).weak_type)) for x in arrays)


@cached
def _mapped(question: _Question, batched: tuple[bool, ...], arrays: list[Array]) -> Any:
    """The results of many, as far as arrays are `batched` along their first axis."""
    shares = _shares_result(question, batched)

    def one(*arrays: Array) -> Any:
        found = question(arrays)
        return (question.split(found[0]), found[1]) if shares else question.split(found)

    axes = [0 if is_batched else None for is_batched in batched]
    found = jax.vmap(one, in_axes=axes, out_axes=(None, 0) if shares else 0)(*arrays)
    return (question.result(found[0]), found[1]) if shares else question.result(found)


def _shares_result(question: _Question, batched: Sequence[bool]) -> bool:
    """Whether these are many tangents of one result."""
    if question.function is not _pushed:
        return False
    _, _, arrays, _ = question.arguments.tree[0]
    return not any(batched[: len(arrays)])


# --- the rules of the primitives ---


def _computed(*arrays: Array, question: _Question) -> list[Array]:
    leaves, treedef = jax.tree.flatten(question.arguments.filled(arrays))
    return question.split(question.function.stored(leaves, treedef))


def _differentiated(arrays: Sequence[Array], tangents: Sequence[Any], *, question: _Question) -> tuple[list[Array], list[Any]]:
    active = tuple(not is_zero(tangent) for tangent in tangents)
    moving = [tangent for moves, tangent in zip(active, tangents, strict=True) if moves]
    if all(not traced(tangent) or _is_simple(tangent) for tangent in moving):
        result, slopes = _pushed(question, active, list(arrays), moving)
    else:  # tangents that nobody knows: the derivative is to be transposed
        if question.function.from_result is not None:
            args, kwargs = question.arguments.filled(arrays)
            result = question.function(*args, **kwargs)
            notes = question.split(result)
        else:
            result, notes = _noted(question, active, list(arrays))
        types = tuple(jax.typeof(x) for x in jax.tree.leaves(result) if eqx.is_array(x) and _has_slope(x))
        slopes = _slopes(*moving, at=_Known(question, active, list(arrays), notes, types))
    found, given = question.split(result), iter(slopes)
    return found, [next(given) if _has_slope(x) else zero_of(x) for x in found]


def _in_batch(arrays: Sequence[Array], axes: Sequence[Any], *, question: _Question) -> tuple[list[Array], list[Any]]:
    batched = tuple(axis is not None for axis in axes)
    first = [x if axis is None or axis == 0 else jnp.moveaxis(x, axis, 0) for x, axis in zip(arrays, axes, strict=True)]
    result = _mapped(question, batched, first)
    found = question.split(result)
    shared = sum(map(eqx.is_array, jax.tree.leaves(result[0]))) if _shares_result(question, batched) else 0
    return found, [None if k < shared else 0 for k in range(len(found))]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class _Known:
    """Where a derivative is taken, what the reverse one needs (the results, of a function that has a `from_result`), and the
    types of results that have one. JAX writes parameters of primitives out whenever it maps them: no `repr`, which would write
    out all the numbers."""

    question: _Question
    active: tuple[bool, ...]
    arrays: list[Array]
    notes: list[Array]
    types: tuple[Any, ...]


def _known_slopes(*tangents: Array, at: _Known) -> list[Array]:
    return _pushed(at.question, at.active, at.arrays, list(tangents))[1]


def _traced_slopes(*tangents: Array, at: _Known) -> list[Array]:
    return _pushed.stored.function(at.question, at.active, at.arrays, list(tangents))[1]


def _slopes_in_batch(tangents: Sequence[Array], axes: Sequence[Any], *, at: _Known) -> tuple[list[Array], list[int]]:
    found = jax.vmap(functools.partial(_known_slopes, at=at), in_axes=tuple(axes))(*tangents)
    return found, [0] * len(found)


def _transposed(slopes: Sequence[Any], *_: Any, at: _Known) -> list[Array]:
    asked = tuple(not is_zero(slope) for slope in slopes)
    wanted = [slope for is_asked, slope in zip(asked, slopes, strict=True) if is_asked]
    if at.question.function.from_result is not None:
        return _pulled_again(at.question, at.active, asked, at.arrays, at.notes, wanted)
    return _pulled(at.question, at.active, asked, _types(at.arrays), at.notes, wanted)


_stored = primitive("stored", computed=_computed, differentiated=_differentiated, in_batch=_in_batch)
"""A function of known numbers, under one derivative or one batch."""

_slopes = primitive(
    "stored_slopes",
    computed=_known_slopes,
    in_batch=_slopes_in_batch,
    transposed=_transposed,
    traced=_traced_slopes,
    abstract=lambda *_, at: at.types,
)
"""Tangents of its results, as a linear function of those of its arguments."""
