"""Array programs of small size, rewritten as programs on scalars.

XLA runs a program on arrays of two or three entries as a chain of small loops, and under `vmap` their entries lie interleaved
in memory. The same program on scalars is straight-line code, and under `vmap` every scalar becomes a contiguous array over the
batch, which a compiler vectorizes best. The equations are written once, on arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxvib.numerics.sincos import sine_and_cosine
from jaxvib.ode.scalar_programs import fenced, is_floating, substituted, without_repeats
from jaxvib.ode.scalar_rules import (
    NotScalarizable,
    Scalar,
    Scalars,
    elementwise,
    inlined,
    is_known,
    joined,
    primitive_of,
    rules,
)
from jaxvib.ode.scalar_rules import to_scalars as _to_scalars
from jaxvib.runtime.compat import (
    HAS_JAXPRS,
    Atoms,
    ClosedJaxpr,
    Jaxpr,
    JaxprEqn,
    Literal,
    Primitive,
    Replacement,
    Var,
    operation_like,
)

X = TypeVar("X")
Shared = TypeVar("Shared")
Out = TypeVar("Out")

_Sines: TypeAlias = dict[int, tuple[Scalar, tuple[Array, Array]]]
"""Dictionary from the `id` of an angle to the angle, its sine and its cosine. The angle is stored so that its id is not
reused."""

MAX_SCALARS, _MAX_OPERATIONS = 32, 1200
"""Largest numbers of state entries and of operations for which equations are compiled on scalars."""

_BLOCK = 4096
"""Number of entries of a batch in one call of a program on scalars, which may store a thousand values for each entry."""


def scalarize(function: Callable[..., PyTree[Array]], *arguments: PyTree[Array]) -> Callable[..., PyTree[Scalars]]:
    """Return `function`, traced for arguments of these shapes, as a function of scalars.

    **Returns** a function of the same arguments. Its arguments and results are object arrays of scalars.
    Sines and cosines are those of `jaxvib.numerics.sincos`. Products with zeros that are constants of the program are omitted.

    **Raises** `NotScalarizable` if an operation of the program has no rule on scalars, here or at a call of the returned
    function. There is no rule for functions with a custom derivative (`jax.custom_jvp`), because the derivative would be lost.

    >>> import jax.numpy as jnp, numpy as np
    >>> on_scalars = scalarize(lambda x: x[0] * jnp.ones(2) + x, jnp.zeros(2))
    >>> [float(x) for x in on_scalars(np.array([3.0, 4.0], dtype=object))]
    [6.0, 7.0]
    """
    shape = jax.eval_shape(lambda *a: a, *arguments)
    closed, out = jax.make_jaxpr(function, return_shape=True)(*shape)
    structure = jax.tree.structure(out)
    _require_rules(closed.jaxpr)

    def run(*given: PyTree[Scalars]) -> PyTree[Scalars]:
        leaves = jax.tree.leaves(given, is_leaf=lambda x: isinstance(x, np.ndarray))
        try:
            found = _run(closed.jaxpr, closed.consts, [_to_scalars(leaf) for leaf in leaves], {})
            return jax.tree.unflatten(structure, [elementwise(joined)(value) for value in found])
        except NotScalarizable:
            raise
        except Exception as error:  # any error of a rule
            raise NotScalarizable(f"a rule failed: {error!r}") from error

    return run


def scalar_program(function: Callable[..., PyTree[Array]], *arguments: PyTree[Array]) -> ClosedJaxpr:
    """Trace the function of `scalarize`: a program from the entries of all arguments to the entries of the result, in order.

    **Raises** `NotScalarizable` if an operation has no rule on scalars.
    """
    leaves, structure = jax.tree.flatten(arguments)

    def run(*numbers: Array) -> list[Array]:
        given = iter(numbers)

        def arranged(leaf: Array) -> Scalars:
            scalars = np.empty(leaf.shape, dtype=object)
            for index in np.ndindex(*leaf.shape):
                scalars[index] = next(given)
            return scalars

        found = on_scalars(*jax.tree.unflatten(structure, [arranged(leaf) for leaf in leaves]))
        arrays = jax.tree.leaves(found, is_leaf=lambda x: isinstance(x, np.ndarray))
        return [jnp.asarray(x, leaves[0].dtype) for array in arrays for x in array.ravel()]

    shapes = [jax.ShapeDtypeStruct((), leaf.dtype) for leaf in leaves for _ in range(leaf.size)]
    on_scalars = scalarize(function, *arguments)
    return without_repeats(jax.make_jaxpr(run)(*shapes))


def scalarized_program(function: Callable[..., PyTree[Array]], *arguments: PyTree[Array]) -> ClosedJaxpr | None:
    """Return `scalar_program`, or None if an operation has no rule on scalars, if there are too many operations, or if this
    version of JAX does not give access to its programs."""
    if not HAS_JAXPRS:
        return None
    try:
        program = scalar_program(function, *arguments)
    except NotScalarizable:
        return None
    return program if len(program.jaxpr.eqns) <= _MAX_OPERATIONS else None


def arrays_program(function: Callable[..., PyTree[Array]], *arguments: PyTree[Array]) -> ClosedJaxpr | None:
    """Trace `function` on arrays, with the sines and cosines of `jaxvib.numerics.sincos`; return None if this version of JAX
    does not give access to its programs."""
    if not HAS_JAXPRS:
        return None
    known: dict[Var, list[Var]] = {}

    def polynomial(equation: JaxprEqn, inputs: Atoms) -> Replacement | None:
        place = _trigonometric_primitives().get(equation.primitive)
        if place is None or not isinstance(angle := inputs[0], Var) or not is_floating(angle):
            return None
        made: list[tuple[JaxprEqn, Atoms]] = []
        if angle not in known:
            both = operation_like(sine_and_cosine, angle)
            made.append((both, [angle]))
            known[angle] = list(both.outvars)
        return made, known[angle][place]

    return substituted(jax.make_jaxpr(function)(*jax.eval_shape(lambda *a: a, *arguments)), polynomial)


def scalars_of(tree: PyTree[Array]) -> list[Array]:
    """Return all entries of a tree of arrays, in order."""
    return [number for leaf in jax.tree.leaves(tree) for number in (jnp.unstack(leaf.ravel()) if leaf.shape else (leaf,))]


def scalarized_vmap(function: Callable[[X, Shared], Out]) -> Callable[[X, Shared], Out]:
    """Return `jax.vmap(function, in_axes=(0, None))`, on scalars if `function` is small enough; intended for evaluation
    without derivatives.

    The program on scalars computes intermediate values once (see `fenced`), therefore its time is proportional to the number
    of operations. It processes a large batch in blocks, therefore its memory does not grow with the batch. Its derivatives are
    correct but may be slow.

    **Arguments**: `function(x, shared)` returns a tree of arrays. The first leaf of x must be a finite scalar, such as a time,
    because `fenced` computes a 1 from this number, which the compiler does not recognize.

    >>> import jax.numpy as jnp
    >>> scalarized_vmap(lambda x, c: c * x)(jnp.asarray([1.0, 2.0]), jnp.asarray(3.0)).tolist()
    [3.0, 6.0]
    """

    def run(batch: X, shared: Shared) -> Out:
        one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), batch)
        size = sum(leaf.size for leaf in jax.tree.leaves(one))
        shared = jax.tree.map(jnp.asarray, shared)
        program = scalarized_program(function, one, shared) if size <= MAX_SCALARS else None
        if program is None:
            # The batch is the last axis of every array. If `vmap` can keep it there, this halves the time.
            last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), batch)
            found = jax.vmap(function, in_axes=(-1, None), out_axes=-1)(last, shared)
            return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), found)
        shapes, structure = jax.tree.flatten(jax.eval_shape(function, one, shared))
        constants = scalars_of(shared)

        def single(x: X) -> Array:
            return jnp.stack(fenced(program, [*scalars_of(x), *constants]))

        count = jax.tree.leaves(batch)[0].shape[0]
        rows = jax.vmap(single)(batch) if count <= _BLOCK else lax.map(single, batch, batch_size=_BLOCK)
        ends = np.cumsum([leaf.size for leaf in shapes])
        parts = [
            rows[:, end - leaf.size : end].reshape(len(rows), *leaf.shape).astype(leaf.dtype)
            for end, leaf in zip(ends, shapes, strict=True)
        ]
        return jax.tree.unflatten(structure, parts)

    return run


@functools.cache
def _trigonometric_primitives() -> dict[Primitive, int]:
    """Return the primitives of sine and cosine, with the position of each in the result of `sine_and_cosine`."""
    return {primitive_of(lax.sin, np.float32(1.0)): 0, primitive_of(lax.cos, np.float32(1.0)): 1}


def _require_rules(jaxpr: Jaxpr) -> None:
    for equation in jaxpr.eqns:
        if equation.primitive in inlined():
            _require_rules(_inner(equation)[0])
        elif equation.primitive not in rules() and equation.primitive not in _trigonometric_primitives():
            raise NotScalarizable(equation.primitive.name)


def _inner(equation: JaxprEqn) -> tuple[Jaxpr, Sequence[ArrayLike]]:
    inner = equation.params["jaxpr"]
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


def _run(jaxpr: Jaxpr, consts: Sequence[ArrayLike], arguments: list[Scalars], sines: _Sines) -> list[Scalars]:
    known: dict[Var, Scalars] = {}

    def read(atom: Var | Literal) -> Scalars:
        if isinstance(atom, Literal):
            return _to_scalars(np.asarray(atom.val, getattr(atom.aval, "dtype", None)))
        return known[atom]

    known.update(zip(jaxpr.constvars, (_to_scalars(c) for c in consts), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        if equation.primitive in inlined():
            results = _run(*_inner(equation), given, sines)
        elif equation.primitive in _trigonometric_primitives():
            place = _trigonometric_primitives()[equation.primitive]
            results = elementwise(lambda x, place=place: _of_angle(x, place, sines))(*given)
        else:
            results = rules()[equation.primitive](*given, **equation.params)
        results = results if isinstance(results, list) else [results]
        for atom, result in zip(equation.outvars, results, strict=True):
            known[atom] = _check_result(result, atom.aval, equation.primitive.name)
    return [read(atom) for atom in jaxpr.outvars]


def _check_result(result: Scalars, aval: Any, name: str) -> Scalars:
    """Return the result of an operation after a check of shape and dtype against the program on arrays."""
    scalars = (x for x in result.flat if hasattr(x, "dtype"))
    if result.shape != aval.shape or any(x.dtype != aval.dtype for x in scalars):
        raise NotScalarizable(f"{name}: its rule returned a shape or dtype different from {aval}")
    return result


def _of_angle(x: Scalar, place: int, sines: _Sines) -> Scalar:
    """Return the sine or cosine of an angle; both are computed once for all uses in a program."""
    if is_known(x):
        return np.cos(x) if place else np.sin(x)
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise NotScalarizable(f"the sine or cosine of a number of type {x.dtype}")
    if id(x) not in sines:
        sines[id(x)] = x, sine_and_cosine(x)
    return sines[id(x)][1][place]
