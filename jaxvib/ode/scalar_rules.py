"""Rules of JAX operations on object arrays of scalars, for `jaxvib.ode.scalarize`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import PyTree

from jaxvib.runtime.compat import Primitive

Scalars: TypeAlias = np.ndarray
"""Array of dtype object whose entries are traced scalars, or NumPy scalars that are constants of the program."""

Scalar: TypeAlias = Any
"""A traced scalar, a NumPy scalar, or a `ComplexParts`: one entry of `Scalars`."""

Rule: TypeAlias = Callable[..., Scalars | list[Scalars]]
"""Function that returns the `Scalars` of an operation's results from the `Scalars` of its arguments, with its parameters as
keywords."""

_Axes: TypeAlias = tuple[Sequence[int], Sequence[int]]
_Function: TypeAlias = Callable[..., PyTree[Array]]


class NotScalarizable(Exception):
    """Raised for a program with an operation that has no rule on scalars, or to which its rule does not apply."""


def to_scalars(value: ArrayLike) -> Scalars:
    """Return an array as an object array of its entries."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    scalars = np.empty(array.shape, dtype=object)
    for index in np.ndindex(*array.shape):
        scalars[index] = array[index]
    return scalars


def is_known(x: Scalar) -> bool:
    """Return True if `x` is a constant of the program."""
    return isinstance(x, (np.generic, int, float, bool))


def _is_zero(x: Scalar) -> bool:
    """Return True if `x` is a 0 that is a constant of the program, such as an entry of an identity matrix or of a tangent.

    A product with this 0, and the operations that only this product needs, are left out. The result is then 0 even if the other
    factor is infinite or NaN, for which the program on arrays would give NaN. Parameters and states of a scene are traced;
    products with their zeros are computed.
    """
    return is_known(x) and x == 0


class ComplexParts:
    """Complex number as its two parts. One of the parts is often a known 0; XLA would compute the products with it."""

    __slots__ = ("imag", "real")

    def __init__(self, real: Scalar, imag: Scalar):
        self.real, self.imag = real, imag


def _is_complex(x: Scalar) -> bool:
    return isinstance(x, ComplexParts) or jnp.iscomplexobj(x)


def _parts(x: Scalar) -> tuple[Scalar, Scalar]:
    if isinstance(x, ComplexParts) or is_known(x):
        return x.real, x.imag
    return (lax.real(x), lax.imag(x)) if _is_complex(x) else (x, np.zeros((), x.dtype)[()])


def joined(x: Scalar) -> Scalar:
    """Return a complex number as one scalar, and any other number unchanged."""
    return lax.complex(*(jnp.asarray(part) for part in _parts(x))) if isinstance(x, ComplexParts) else x


def _by_parts(rule: Callable[..., Scalar]) -> Callable[..., Scalar]:
    """Apply a rule for real numbers to the real and imaginary parts."""

    def apply(*x: Scalar, **params: object) -> Scalar:
        if not any(_is_complex(v) for v in x):
            return rule(*x, **params)
        real, imag = zip(*(_parts(v) for v in x), strict=True)
        return ComplexParts(rule(*real, **params), rule(*imag, **params))

    return apply


@_by_parts
def _add(x: Scalar, y: Scalar, **_: object) -> Scalar:
    if is_known(x) and is_known(y):
        return x + y
    return y if _is_zero(x) else x if _is_zero(y) else x + y


@_by_parts
def _sub(x: Scalar, y: Scalar, **_: object) -> Scalar:
    if is_known(x) and is_known(y):
        return x - y
    return _neg(y) if _is_zero(x) else x if _is_zero(y) else x - y


@_by_parts
def _neg(x: Scalar, **_: object) -> Scalar:
    return -x


def _mul(x: Scalar, y: Scalar, **_: object) -> Scalar:
    if _is_complex(x) or _is_complex(y):
        (a, b), (c, d) = _parts(x), _parts(y)
        return ComplexParts(_sub(_mul(a, c), _mul(b, d)), _add(_mul(a, d), _mul(b, c)))
    if is_known(x) and is_known(y):
        return x * y
    if _is_zero(x) or _is_zero(y):
        return x if _is_zero(x) else y
    return y if is_known(x) and x == 1 else x if is_known(y) and y == 1 else x * y


def _div(x: Scalar, y: Scalar, **_: object) -> Scalar:
    if _is_complex(x) or _is_complex(y):
        (a, b), (c, d) = _parts(x), _parts(y)
        if not _is_zero(d):
            return joined(x) / joined(y)
        return ComplexParts(_div(a, c), _div(b, c))
    if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
        return lax.div(jnp.asarray(x), jnp.asarray(y))  # division of integers, which truncates
    if is_known(x) and is_known(y):
        return x / y
    return x if _is_zero(x) or (is_known(y) and y == 1) else x / y


def _power(x: Scalar, *, y: int) -> Scalar:
    if y == 2:
        return _mul(x, x)
    return lax.integer_pow(jnp.asarray(joined(x)), y)


def _convert(x: Scalar, *, new_dtype: DTypeLike, **_: object) -> Scalar:
    if is_known(x):
        return np.asarray(x, new_dtype)[()]
    if jnp.issubdtype(new_dtype, jnp.complexfloating):
        part = jnp.finfo(new_dtype).dtype
        return ComplexParts(*(_convert(v, new_dtype=part) for v in _parts(x)))
    return lax.convert_element_type(joined(x), new_dtype)


def _select(which: Scalar, *cases: Scalar) -> Scalar:
    if is_known(which):
        return cases[int(which)]
    return _choice(*cases, which=which)


@_by_parts
def _choice(*cases: Scalar, which: Scalar) -> Scalar:
    return lax.select_n(which, *(jnp.asarray(case) for case in cases))


def _by_primitive(primitive: Primitive) -> Callable[..., Scalar]:
    """Return the rule that applies an operation to traced scalars."""
    return lambda *x, **params: primitive.bind(*(jnp.asarray(joined(v)) for v in x), **params)


def elementwise(rule: Callable[..., Scalar]) -> Rule:
    """Return the rule for arrays that applies a rule for scalars to each entry; an argument of shape () applies to all."""

    def apply(*given: Scalars, **params: object) -> Scalars:
        whole = np.broadcast_arrays(*given) if len(given) > 1 else list(given)
        out = np.empty(whole[0].shape, dtype=object)
        for index in np.ndindex(*out.shape):
            out[index] = rule(*(scalars[index] for scalars in whole), **params)
        return out

    return apply


def _broadcast_in_dim(x: Scalars, *, shape: Sequence[int], broadcast_dimensions: Sequence[int], **_: object) -> Scalars:
    whole = [1] * len(shape)
    for axis, place in enumerate(broadcast_dimensions):
        whole[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(whole), shape)


def _reduce(combine: Callable[[Scalar, Scalar], Scalar]) -> Rule:
    def reduce(x: Scalars, *, axes: Sequence[int], **_: object) -> Scalars:
        moved = np.moveaxis(x, axes, range(len(axes))).reshape(-1, *np.delete(x.shape, axes).astype(int))
        out = np.empty(moved.shape[1:], dtype=object)
        for index in np.ndindex(*out.shape):
            column = moved[(slice(None), *index)]
            if not len(column):
                raise NotScalarizable("a reduction of an empty array")
            out[index] = functools.reduce(combine, column)
        return out

    return reduce


def _dot_general(x: Scalars, y: Scalars, *, dimension_numbers: tuple[_Axes, _Axes], **_: object) -> Scalars:
    (over_x, over_y), batch = dimension_numbers
    if any(batch):
        raise NotScalarizable("dot_general with batch dimensions")
    a = np.moveaxis(x, over_x, range(x.ndim - len(over_x), x.ndim))
    b = np.moveaxis(y, over_y, range(len(over_y)))
    rows, columns = a.shape[: x.ndim - len(over_x)], b.shape[len(over_y) :]
    left, right = a.reshape(math.prod(rows), -1), b.reshape(-1, math.prod(columns))
    if not left.shape[1]:
        raise NotScalarizable("dot_general over an empty axis")
    out = np.empty((left.shape[0], right.shape[1]), dtype=object)
    for i, k in np.ndindex(*out.shape):
        out[i, k] = functools.reduce(_add, (_mul(p, q) for p, q in zip(left[i], right[:, k], strict=True)))
    return out.reshape(rows + columns)


def _dynamic_slice(x: Scalars, *starts: Scalars, slice_sizes: Sequence[int]) -> Scalars:
    begin = [start[()] for start in starts]
    if not all(is_known(start) for start in begin):
        raise NotScalarizable("dynamic_slice at a traced place")
    places = [min(max(int(s), 0), n - size) for s, n, size in zip(begin, x.shape, slice_sizes, strict=True)]
    return x[tuple(slice(place, place + size) for place, size in zip(places, slice_sizes, strict=True))]


def _slice(x: Scalars, *, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None) -> Scalars:
    strides = strides or [1] * x.ndim
    return x[tuple(slice(*cut) for cut in zip(start_indices, limit_indices, strides, strict=True))]


def _iota(*, dtype: DTypeLike, shape: Sequence[int], dimension: int, **_: object) -> Scalars:
    return to_scalars(np.indices(shape)[dimension].astype(dtype))


def _unstack(x: Scalars, *, axis: int) -> list[Scalars]:
    moved = np.moveaxis(x, axis, 0)
    return [moved[k, ...] for k in range(moved.shape[0])]


def _pad(x: Scalars, value: Scalars, *, padding_config: Sequence[tuple[int, int, int]]) -> Scalars:
    low, high, inner = zip(*padding_config, strict=True)
    if min(low) < 0 or min(high) < 0 or any(inner):
        raise NotScalarizable("a pad that removes entries, or inserts values between entries")
    out = np.empty([n + before + after for n, before, after in zip(x.shape, low, high, strict=True)], dtype=object)
    out.fill(value[()])
    out[tuple(slice(before, before + n) for n, before in zip(x.shape, low, strict=True))] = x
    return out


def primitive_of(function: _Function, *arguments: ArrayLike) -> Primitive:
    """Return the only primitive of a public function of JAX. **Raises** `NotScalarizable` if it has several or none."""
    equations = jax.make_jaxpr(function)(*arguments).jaxpr.eqns
    if len(equations) != 1:
        raise NotScalarizable(f"{function} is made of {len(equations)} operations")
    return equations[0].primitive


@functools.cache
def inlined() -> tuple[Primitive, ...]:
    """Primitives that are replaced by their inner program, the parameter `jaxpr`."""
    return primitive_of(jax.jit(jnp.negative), 1.0), primitive_of(jax.checkpoint(lax.neg), 1.0)


@functools.cache
def rules() -> dict[Primitive, Rule]:
    """The rule of each primitive that has one; primitives are found by tracing public functions, not by their names. If a
    function consists of several primitives in another version of JAX, programs with this function stay on arrays."""
    x, v, yes = np.float32(1.0), np.ones((2, 2), np.float32), np.True_
    z = np.complex64(1.0)
    maps: list[tuple[_Function, tuple[ArrayLike, ...], Callable[..., Scalar]]] = [
        (lax.add, (x, x), _add),
        # JAX's sum of cotangents.
        (lambda y: jax.linear_transpose(lambda x: (x, x), x)((y, y))[0], (x,), _add),
        (lax.sub, (x, x), _sub),
        (lax.mul, (x, x), _mul),
        (lax.div, (x, x), _div),
        (lax.neg, (x,), _neg),
        (lambda x: lax.integer_pow(x, 3), (x,), _power),
        (lax.square, (x,), lambda x, **_: _mul(x, x)),
        (lambda x: lax.convert_element_type(x, np.int32), (x,), _convert),
        (lambda which, x: lax.select_n(which, x, x), (yes, x), _select),
        (lax.real, (z,), lambda x, **_: _parts(x)[0]),
        (lax.imag, (z,), lambda x, **_: _parts(x)[1]),
        (lax.complex, (x, x), lambda x, y, **_: ComplexParts(x, y)),
        (lax.conj, (z,), lambda x, **_: ComplexParts(_parts(x)[0], _neg(_parts(x)[1]))),
        (lax.stop_gradient, (x,), _by_parts(lambda x, **_: x if is_known(x) else lax.stop_gradient(x))),
        (lambda x: jnp.array(x, copy=True), (v,), lambda x, **_: x),
    ]
    one = (lax.abs, lax.sign, lax.sqrt, lax.rsqrt, lax.cbrt, lax.exp, lax.exp2, lax.expm1, lax.log, lax.log1p, lax.logistic)
    one += (lax.tan, lax.asin, lax.acos, lax.atan, lax.sinh, lax.cosh, lax.tanh, lax.asinh, lax.acosh, lax.atanh)
    one += (lax.erf, lax.floor, lax.ceil, lax.round)
    two = (lax.max, lax.min, lax.atan2, lax.pow, lax.rem, lax.lt, lax.le, lax.gt, lax.ge, lax.eq, lax.ne)
    direct = [(f, (x,)) for f in (*one, lax.is_finite)] + [(f, (x, x)) for f in two]
    direct += [(f, (yes, yes)) for f in (lax.bitwise_and, lax.bitwise_or)]
    direct += [(lax.bitwise_not, (yes,)), (lax.clamp, (x, x, x))]
    whole: list[tuple[_Function, tuple[ArrayLike, ...], Rule]] = [
        (lambda v: lax.broadcast_in_dim(v, (2, 2, 2), (0, 1)), (v,), _broadcast_in_dim),
        (lambda v: lax.reshape(v, (4,)), (v,), lambda x, *, new_sizes, **_: x.reshape(new_sizes)),
        (lambda v: lax.squeeze(v, (0,)), (v[:1],), lambda x, *, dimensions: np.squeeze(x, axis=tuple(dimensions))),
        (lambda v: lax.transpose(v, (1, 0)), (v,), lambda x, *, permutation: np.transpose(x, permutation)),
        (lambda v: lax.slice(v, (0, 0), (1, 2)), (v,), _slice),
        (lambda v: lax.dynamic_slice(v, (0, 0), (1, 1)), (v,), _dynamic_slice),
        (lambda v: lax.concatenate([v, v], 0), (v,), lambda *x, dimension: np.concatenate(x, axis=dimension)),
        (lambda v: jnp.stack([v, v]), (v,), lambda *x, axis: np.stack(x, axis)),
        (lambda v: jnp.unstack(v), (v,), _unstack),
        (lambda v: lax.split(v, (1, 1)), (v,), lambda x, *, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis=axis)),
        (lambda v: lax.rev(v, (0,)), (v,), lambda x, *, dimensions: np.flip(x, dimensions)),
        (lambda v: lax.pad(v, x, [(0, 0, 0), (0, 1, 0)]), (v,), _pad),
        (lambda: lax.iota(np.int32, 3), (), _iota),
        (lambda v: lax.reduce_sum(v, (0,)), (v,), _reduce(_add)),
        (lambda v: lax.reduce_max(v, (0,)), (v,), _reduce(lambda a, b: lax.max(jnp.asarray(a), jnp.asarray(b)))),
        (lambda v: lax.reduce_min(v, (0,)), (v,), _reduce(lambda a, b: lax.min(jnp.asarray(a), jnp.asarray(b)))),
        (lambda v: lax.dot_general(v, v, (((1,), (1,)), ((), ()))), (v,), _dot_general),
    ]
    found: dict[Primitive, Rule] = {}
    for function, arguments, rule in (
        *((f, given, elementwise(rule)) for f, given, rule in maps),
        *((f, given, None) for f, given in direct),
        *whole,
    ):
        try:
            primitive = primitive_of(function, *arguments)
        except NotScalarizable:
            continue
        found[primitive] = elementwise(_by_primitive(primitive)) if rule is None else rule
    return found
