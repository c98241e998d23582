"""Batches of tangents (derivatives in several directions) or of runs.

The batch is the last axis of each array; vector instructions compute this layout fastest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree

from jaxvib.ode.types import Batched, Tangents

VECTOR_WIDTH = 8
"""Number of values in a vector register of a CPU. The number of tangents is padded to a multiple of this number."""

X = TypeVar("X")
Out = TypeVar("Out")
_WithTangents: TypeAlias = Callable[[PyTree, Tangents], tuple[PyTree[Array], Tangents]]
"""Function of values and tangents that returns results and their tangents."""


def multi_tangent_jvp(function: Callable[[X], Out], jvp: Callable[[X, Tangents], tuple[Out, Tangents]]) -> Callable[[X], Out]:
    """Return `function` with forward derivatives by `jvp`, and without reverse derivatives.

    `jacfwd` of JAX applies the derivative along one tangent to all tangents by `vmap`; the axis of the tangents is then the
    first one. Here `jvp` is called once for all tangents (unless x is batched too), and their axis is the last one. Every
    number of the program is then a vector over the tangents, contiguous in memory.

    **Arguments**: `jvp(x, tangents)` returns `function(x)` and its tangents. The tangents of x and of the result are
    `Tangents`, with the axis of the tangents last.

    >>> import jax, jax.numpy as jnp
    >>> square = multi_tangent_jvp(lambda x: x**2, lambda x, slope: (x**2, 2.0 * x[:, None] * slope))
    >>> jax.jacfwd(square)(jnp.asarray([1.0, 3.0])).tolist()
    [[2.0, 0.0], [0.0, 6.0]]
    """

    @eqx.filter_custom_jvp
    def call(x: X) -> Out:
        return function(x)

    @call.def_jvp
    def _(primals: tuple[X], tangents: tuple[Tangents]) -> tuple[Out, Tangents]:
        leaves, structure = jax.tree.flatten(primals[0])
        directions = flat_tangents(tangents[0], primals[0])
        arrays = [leaf if eqx.is_array(leaf) else None for leaf in leaves]
        places = [k for k, direction in enumerate(directions) if direction is not None]

        def on_arrays(arrays: list[Array | None], directions: list[Array]) -> tuple[Out, Tangents]:
            inputs = [leaf if array is None else array for array, leaf in zip(arrays, leaves, strict=True)]
            given = dict(zip(places, directions, strict=True))
            return jvp(
                jax.tree.unflatten(structure, inputs), jax.tree.unflatten(structure, [given.get(k) for k in range(len(leaves))])
            )

        return _tangents_last(on_arrays)(arrays, [directions[k] for k in places])

    return call


def batch_last(function: Callable[[X], Out], batched: Callable[[X, Batched], Out]) -> Callable[[X], Out]:
    """Return `function` with a rule for batches: under `vmap`, `batched` computes it. JAX batches its derivatives as usual.

    JAX makes the batch the first axis of the state of a loop. `batched` may make the batch the last axis: every number of the
    program is then a vector over the batch, contiguous in memory.

    **Arguments**: `batched(x, is_batched)`: `function(x)` for the whole batch. The batch is the last axis of the arrays of x
    that are True in the tree `is_batched`, and of all arrays of the result.

    >>> import jax, jax.numpy as jnp
    >>> total = batch_last(jnp.sum, lambda x, is_batched: jnp.sum(x, axis=0))
    >>> jax.vmap(total)(jnp.asarray([[1.0, 2.0], [3.0, 4.0]])).tolist()
    [3.0, 7.0]
    """

    @eqx.filter_custom_jvp
    def call(x: X) -> Out:
        leaves, structure = jax.tree.flatten(x)
        places = [k for k, leaf in enumerate(leaves) if eqx.is_array(leaf)]

        def unflatten(arrays: Sequence[Array]) -> X:
            given = dict(zip(places, arrays, strict=True))
            return jax.tree.unflatten(structure, [given.get(k, leaf) for k, leaf in enumerate(leaves)])

        mapped = custom_vmap(lambda *arrays: function(unflatten(arrays)))

        @mapped.def_vmap
        def _(size: int, is_batched: Sequence[bool], *arrays: Array) -> tuple[Out, Batched]:
            last = [jnp.moveaxis(a, 0, -1) if along else a for a, along in zip(arrays, is_batched, strict=True)]
            known = dict(zip(places, is_batched, strict=True))
            out = batched(unflatten(last), jax.tree.unflatten(structure, [known.get(k, False) for k in range(len(leaves))]))
            return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), out), jax.tree.map(lambda _: True, out)

        return mapped(*(leaves[k] for k in places))

    @call.def_jvp
    def _(primals: tuple[X], tangents: tuple[Tangents]) -> tuple[Out, Tangents]:
        return eqx.filter_jvp(function, primals, tangents)

    return call


def flat_tangents(tangents: Tangents, like: PyTree) -> list[Array | None]:
    """Return the tangents of the leaves of `like`, in order."""
    return jax.tree.structure(like).flatten_up_to(tangents)  # pyright: ignore[reportAttributeAccessIssue]


def _tangents_last(function: _WithTangents) -> _WithTangents:
    """Convert a function of x and many tangents (last axis) to a function of x and one tangent. Under `vmap` over tangents
    alone the original function is called once for all of them."""

    def single(x: PyTree, tangents: Tangents) -> tuple[PyTree[Array], Tangents]:
        y, out = function(x, jax.tree.map(lambda dx: dx[..., None], tangents))
        return y, jax.tree.map(lambda dy: dy[..., 0], out)

    mapped = custom_vmap(single)

    @mapped.def_vmap
    def _(size: int, is_batched: Batched, x: PyTree, tangents: Tangents) -> tuple[tuple[PyTree[Array], Tangents], Batched]:
        if any(jax.tree.leaves(is_batched[0])):
            axes = jax.tree.map(lambda which: 0 if which else None, is_batched)
            out = jax.vmap(single, in_axes=tuple(axes))(x, tangents)
            return out, jax.tree.map(lambda _: True, out)
        padded = -(-size // VECTOR_WIDTH) * VECTOR_WIDTH

        def last(tangent: Array, is_batched: bool) -> Array:
            every = jnp.moveaxis(tangent, 0, -1) if is_batched else jnp.repeat(tangent[..., None], size, axis=-1)
            return jnp.pad(every, [(0, 0)] * (every.ndim - 1) + [(0, padded - size)])

        y, out = function(x, jax.tree.map(last, tangents, is_batched[1]))
        out = jax.tree.map(lambda tangent: jnp.moveaxis(tangent[..., :size], -1, 0), out)
        return (y, out), (jax.tree.map(lambda _: False, y), jax.tree.map(lambda _: True, out))

    return mapped
