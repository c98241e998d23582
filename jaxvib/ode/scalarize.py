"""Small programs on arrays, rewritten as programs on single numbers.

XLA runs a program on arrays of two or three entries as a chain of small loops, and under `vmap` their entries lie interleaved
in memory. The same program on numbers is one straight piece of code, and under `vmap` every number becomes a contiguous array
over the batch: what a compiler turns into vector instructions best. The equations are written once, on arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from jaxvib.ode.sincos import sine_and_cosine

__all__ = ["MOST_NUMBERS", "Unwritten", "numbers_of", "on_numbers", "program_on_numbers"]

MOST_NUMBERS, _MOST_OPERATIONS = 32, 1200
"""With more numbers in a state, or operations on them, equations written out take too long to compile for what they save."""

Cells = np.ndarray
"""An array of dtype object: every entry is a traced scalar, or a NumPy number that is known while tracing."""


class Unwritten(Exception):
    """The program has an operation that is not written out on numbers."""


def on_numbers(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """`function`, traced for arguments of these shapes, on numbers.

    **Returns** a function of the same arguments in which every array is an object array of scalars; so is what it returns.
    Sines and cosines are those of `jaxvib.ode.sincos`.

    **Raises** `Unwritten` where an operation of the program has no rule here.
    """
    shape = jax.eval_shape(lambda *a: a, *arguments)
    closed, out = jax.make_jaxpr(function, return_shape=True)(*shape)
    rest = jax.tree.structure(out)
    _require_rules(closed.jaxpr)

    def run(*cells: Any) -> Any:
        leaves = jax.tree.leaves(cells, is_leaf=lambda x: isinstance(x, np.ndarray))
        found = _run(closed.jaxpr, closed.consts, [_cells(leaf) for leaf in leaves], {})
        return jax.tree.unflatten(rest, [_elementwise(_joined, [value], {}) for value in found])

    return run


def program_on_numbers(function: Callable[..., Any], *arguments: Any) -> core.ClosedJaxpr | None:
    """`on_numbers`, traced once: a program that takes the numbers of all arguments and gives those of the result, in order.

    **Returns** None where an operation has no rule here, or where there are too many of them.
    """
    leaves, rest = jax.tree.flatten(arguments)
    try:
        written = on_numbers(function, *arguments)
    except Unwritten:
        return None

    def run(*numbers: Any) -> list[Any]:
        given = iter(numbers)

        def arranged(leaf: Any) -> Cells:
            cells = np.empty(leaf.shape, dtype=object)
            for index in np.ndindex(*leaf.shape):
                cells[index] = next(given)
            return cells

        found = written(*jax.tree.unflatten(rest, [arranged(leaf) for leaf in leaves]))
        cells = jax.tree.leaves(found, is_leaf=lambda x: isinstance(x, np.ndarray))
        return [jnp.asarray(x, leaves[0].dtype) for array in cells for x in array.ravel()]

    shapes = [jax.ShapeDtypeStruct((), leaf.dtype) for leaf in leaves for _ in range(leaf.size)]
    program = jax.make_jaxpr(run)(*shapes)
    return program if len(program.jaxpr.eqns) <= _MOST_OPERATIONS else None


def numbers_of(tree: Any) -> list[Array]:
    """All numbers of a tree of arrays, in order."""
    return [leaf[index] for leaf in jax.tree.leaves(tree) for index in np.ndindex(*leaf.shape)]


def split(value: Any) -> Cells:
    """An array as an object array of its entries."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value
    if not isinstance(value, jax.Array):
        return _cells(value)
    cells = np.empty(value.shape, dtype=object)
    for index in np.ndindex(*value.shape):
        cells[index] = value[index]
    return cells


def _cells(value: Any) -> Cells:
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value
    if isinstance(value, jax.Array):
        return split(value)
    known = np.asarray(value)
    cells = np.empty(known.shape, dtype=object)
    for index in np.ndindex(*known.shape):
        cells[index] = known[index]
    return cells


def _known(x: Any) -> bool:
    return isinstance(x, (np.generic, int, float, bool))


class _Pair:
    """A complex number by its parts, of which one is often known to be 0; XLA multiplies that out."""

    __slots__ = ("imag", "real")

    def __init__(self, real: Any, imag: Any):
        self.real, self.imag = real, imag


def _is_complex(x: Any) -> bool:
    return isinstance(x, _Pair) or jnp.iscomplexobj(x)


def _parts(x: Any) -> tuple[Any, Any]:
    if isinstance(x, _Pair) or _known(x):
        return x.real, x.imag
    return (lax.real(x), lax.imag(x)) if _is_complex(x) else (x, np.zeros((), x.dtype)[()])


def _joined(x: Any) -> Any:
    return lax.complex(*(jnp.asarray(part) for part in _parts(x))) if isinstance(x, _Pair) else x


def _by_parts(rule: Callable[..., Any]) -> Callable[..., Any]:
    """A rule for real numbers, applied to the real and to the imaginary parts."""

    def apply(*x: Any, **params: Any) -> Any:
        if not any(_is_complex(v) for v in x):
            return rule(*x, **params)
        real, imag = zip(*(_parts(v) for v in x), strict=True)
        return _Pair(rule(*real, **params), rule(*imag, **params))

    return apply


@_by_parts
def _add(x: Any, y: Any, **_: Any) -> Any:
    if _known(x) and _known(y):
        return x + y
    return y if _known(x) and x == 0 else x if _known(y) and y == 0 else x + y


@_by_parts
def _sub(x: Any, y: Any, **_: Any) -> Any:
    if _known(x) and _known(y):
        return x - y
    return _neg(y) if _known(x) and x == 0 else x if _known(y) and y == 0 else x - y


@_by_parts
def _neg(x: Any, **_: Any) -> Any:
    return -x


def _mul(x: Any, y: Any, **_: Any) -> Any:
    if _is_complex(x) or _is_complex(y):
        (a, b), (c, d) = _parts(x), _parts(y)
        return _Pair(_sub(_mul(a, c), _mul(b, d)), _add(_mul(a, d), _mul(b, c)))
    if _known(x) and _known(y):
        return x * y
    if (_known(x) and x == 0) or (_known(y) and y == 0):  # a term that is not there
        return (x if _known(x) else y) * 0
    return y if _known(x) and x == 1 else x if _known(y) and y == 1 else x * y


def _div(x: Any, y: Any, **_: Any) -> Any:
    if _is_complex(x) or _is_complex(y):
        (a, b), (c, d) = _parts(x), _parts(y)
        if not (_known(d) and d == 0):
            return _joined(x) / _joined(y)
        return _Pair(_div(a, c), _div(b, c))
    if _known(x) and (x == 0 or _known(y)):
        return x / y if _known(y) else x
    return x if _known(y) and y == 1 else x / y


def _plain(name: str) -> Callable[..., Any]:
    def apply(*x: Any, **params: Any) -> Any:
        return getattr(lax, f"{name}_p").bind(*(jnp.asarray(_joined(v)) for v in x), **params)

    return apply


def _power(x: Any, *, y: int, **_: Any) -> Any:
    if _known(x):
        return x**y
    return _mul(x, x) if y == 2 else lax.integer_pow(_joined(x), y)


def _convert(x: Any, *, new_dtype: Any, **_: Any) -> Any:
    if _known(x):
        return np.asarray(x, new_dtype)[()]
    if jnp.issubdtype(new_dtype, jnp.complexfloating):
        part = np.empty((), new_dtype).real.dtype
        return _Pair(*(_convert(v, new_dtype=part) for v in _parts(x)))
    return lax.convert_element_type(_joined(x), new_dtype)


def _select(which: Any, *cases: Any, **_: Any) -> Any:
    if _known(which):
        return cases[int(which)]
    return _choice(*cases, which=which)


@_by_parts
def _choice(a: Any, b: Any, *, which: Any) -> Any:
    return jnp.where(which, b, a)


_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "integer_pow": _power,
    "square": lambda x, **_: _mul(x, x),
    "convert_element_type": _convert,
    "select_n": _select,
    "real": lambda x, **_: _parts(x)[0],
    "imag": lambda x, **_: _parts(x)[1],
    "complex": lambda x, y, **_: _Pair(x, y),
    "conj": lambda x, **_: _Pair(_parts(x)[0], _neg(_parts(x)[1])),
    "stop_gradient": _by_parts(lambda x, **_: lax.stop_gradient(x)),
    "copy": lambda x, **_: x,
    "copy_p": lambda x, **_: x,
    **{
        name: _plain(name)
        for name in (
            *("max", "min", "abs", "sign", "sqrt", "rsqrt", "exp", "log", "tanh", "atan2", "tan", "pow", "log1p", "expm1"),
            *("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "floor", "ceil", "round", "rem", "is_finite", "clamp"),
            *("logistic", "asin", "acos", "atan", "sinh", "cosh", "erf", "cbrt", "exp2"),
        )
    },
}
_INNER = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr", "remat": "jaxpr"}


def _broadcast_in_dim(x: Cells, *, shape: Any, broadcast_dimensions: Any, **_: Any) -> Cells:
    whole = [1] * len(shape)
    for axis, place in enumerate(broadcast_dimensions):
        whole[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(whole), shape)


def _reduced(combine: Callable[[Any, Any], Any], start: float | None) -> Callable[..., Cells]:
    def reduce(x: Cells, *, axes: Any, **_: Any) -> Cells:
        moved = np.moveaxis(x, axes, range(len(axes))).reshape(-1, *np.delete(x.shape, axes).astype(int))
        out = np.empty(moved.shape[1:], dtype=object)
        for index in np.ndindex(*out.shape):
            column = moved[(slice(None), *index)]
            total = column[0] if len(column) else start
            for entry in column[1:]:
                total = combine(total, entry)
            out[index] = total
        return out

    return reduce


def _dot_general(x: Cells, y: Cells, *, dimension_numbers: Any, **_: Any) -> Cells:
    (over_x, over_y), batch = dimension_numbers
    if any(batch):
        raise Unwritten("dot_general with batch dimensions")
    a = np.moveaxis(x, over_x, range(x.ndim - len(over_x), x.ndim))
    b = np.moveaxis(y, over_y, range(len(over_y)))
    rows, columns = a.shape[: x.ndim - len(over_x)], b.shape[len(over_y) :]
    left, right = a.reshape(math.prod(rows), -1), b.reshape(-1, math.prod(columns))
    out = np.empty((left.shape[0], right.shape[1]), dtype=object)
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            total: Any = np.float64(0.0)
            for p, q in zip(left[i], right[:, k], strict=True):
                total = _add(total, _mul(p, q))
            out[i, k] = total
    return out.reshape(rows + columns)


def _dynamic_slice(x: Cells, *starts: Cells, slice_sizes: Any) -> Cells:
    begin = [s[()] for s in starts]
    if not all(_known(s) for s in begin):
        raise Unwritten("dynamic_slice at a traced place")
    places = [min(max(int(s), 0), n - size) for s, n, size in zip(begin, x.shape, slice_sizes, strict=True)]
    return x[tuple(slice(p, p + size) for p, size in zip(places, slice_sizes, strict=True))]


_STRUCTURAL: dict[str, Callable[..., Cells]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, axis=tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "slice": lambda x, *, start_indices, limit_indices, strides: x[
        tuple(slice(a, b, c) for a, b, c in zip(start_indices, limit_indices, strides or [1] * x.ndim, strict=True))
    ],
    "concatenate": lambda *x, dimension: np.concatenate(x, axis=dimension),
    "stack": lambda *x, axis: np.stack(x, axis),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "reduce_sum": _reduced(_add, 0.0),
    "reduce_max": _reduced(lambda a, b: jnp.maximum(a, b), None),
    "reduce_min": _reduced(lambda a, b: jnp.minimum(a, b), None),
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
}


def _require_rules(jaxpr: core.Jaxpr) -> None:
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        if name in _INNER:
            inner = equation.params[_INNER[name]]
            _require_rules(getattr(inner, "jaxpr", inner))
        elif name not in _ELEMENTWISE and name not in _STRUCTURAL and name not in ("iota", "split", "unstack", "sin", "cos"):
            raise Unwritten(name)


def _run(jaxpr: core.Jaxpr, consts: Any, arguments: list[Cells], angles: dict[int, Any]) -> list[Cells]:
    known: dict[Any, Cells] = {}

    def read(atom: Any) -> Cells:
        return (
            _cells(np.asarray(atom.val, getattr(atom.aval, "dtype", None))) if isinstance(atom, core.Literal) else known[atom]
        )

    known.update(zip(jaxpr.constvars, (_cells(c) for c in consts), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        given = [read(atom) for atom in equation.invars]
        if name in _INNER:
            inner = params[_INNER[name]]
            results = _run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), given, angles)
        elif name == "iota":
            results = [_cells(np.indices(params["shape"])[params["dimension"]].astype(params["dtype"]))]
        elif name == "split":
            cuts = np.cumsum(params["sizes"])[:-1]
            results = np.split(given[0], cuts, axis=params["axis"])
        elif name == "unstack":
            moved = np.moveaxis(given[0], params["axis"], 0)
            results = [moved[k, ...] for k in range(moved.shape[0])]
        elif name in _STRUCTURAL:
            results = [_STRUCTURAL[name](*given, **params)]
        elif name in ("sin", "cos"):
            (given_cells,) = given
            results = [_elementwise(lambda x, which=name == "cos", **_: _of_angle(x, which, angles), [given_cells], {})]
        else:
            results = [_elementwise(_ELEMENTWISE[name], given, params)]
        known.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _of_angle(x: Any, cosine: bool, angles: dict[int, Any]) -> Any:
    """The sine or cosine of an angle, both computed once however often a program asks."""
    if _known(x):
        return np.cos(x) if cosine else np.sin(x)
    if id(x) not in angles:
        angles[id(x)] = x, sine_and_cosine(x)
    return angles[id(x)][1][int(cosine)]


def _elementwise(rule: Callable[..., Any], given: list[Cells], params: dict[str, Any]) -> Cells:
    whole = np.broadcast_arrays(*given) if len(given) > 1 else given
    out = np.empty(whole[0].shape, dtype=object)
    for index in np.ndindex(*out.shape):
        out[index] = rule(*(cells[index] for cells in whole), **params)
    return out
