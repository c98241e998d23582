"""Dormand and Prince's step of order 8 as a loop over its stages, with forward derivatives along many tangents at once."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from jaxvib.ode.batching import batch_last, flat_tangents, multi_tangent_jvp
from jaxvib.ode.dopri8 import (
    ERROR,
    NODES,
    ROWS,
    AbstractDopri8,
    Dopri8Interpolation,
    linear_combination,
    ravel,
    unravel,
)
from jaxvib.ode.types import VF, Args, Batched, BoolScalarLike, RealScalarLike, Tangents, Terms, Y

_PreviousStage: TypeAlias = "tuple[Array, Array] | None"
"""Last stage of the previous step (n,), and the number of stages that it provides: 1, or 0 without a previous step. None if
each step computes all of its stages."""

_Inputs: TypeAlias = tuple[RealScalarLike, Array, Y, _PreviousStage, Args, Terms]
"""Inputs of a step: the time at its start, its length, the state, the last stage before it, the arguments of the equations, the
equations."""

_Step: TypeAlias = tuple[Y, Array, Y]
"""The state at the end of a step, the rates of its stages (stages, n), the error of the state."""

_ROWS = np.concatenate([np.zeros((1, ROWS.shape[1])), ROWS])
"""Weights of earlier stages in each stage (stages, stages - 1)."""

_NODES = np.concatenate([np.zeros(1), NODES])
"""Time of each stage, as a fraction of the step."""

Numbers = TypeVar("Numbers", Array, tuple[Array, Array])
"""A vector (n,), a batch of them (n, batch), or a vector and its tangents (n, directions)."""


class LoopDopri8(AbstractDopri8):
    """Method of `UnrolledDopri8` with a loop over the stages. It compiles in a fraction of the time.

    The program of the loop contains the equations once, for all stages.

    **Arguments**

    - `tangents`: True if only forward derivatives are needed. The derivatives of a step are then computed along all tangents at
      once; eight tangents cost little more than one
    - `reuse`: True to use the last stage of a step as the first one of the next step, which saves one of fourteen evaluations.
      The first stage of the loop is then known at run time only; therefore diffrax's adjoints cannot compute reverse
      derivatives. The derivatives of `jaxvib.ode.replay` are not affected
    - `wrap` as in `UnrolledDopri8`

    >>> import diffrax, jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> def end(rate):
    ...     term = diffrax.ODETerm(lambda t, y, rate: -rate * y)
    ...     return diffrax.diffeqsolve(term, LoopDopri8(tangents=True), 0.0, 2.0, 0.1, jnp.asarray(1.0), rate,
    ...                                adjoint=diffrax.ForwardMode()).ys[0]
    >>> bool(abs(jax.jacfwd(end)(0.5) + 2.0 * jnp.exp(-1.0)) < 1e-12)
    True

    Source: that of `UnrolledDopri8`.
    """

    tangents: bool = eqx.field(static=True, default=False)
    reuse: bool = eqx.field(static=True, default=False)

    @property
    def interpolation_cls(self) -> Callable[..., Dopri8Interpolation]:  # pyright: ignore
        """Interpolation for states within a step."""
        return _WITH_TANGENTS if self.tangents else _WITHOUT_TANGENTS

    def init(self, terms: Terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> _PreviousStage:
        """Return the initial state of the method, without a known stage."""
        return (jnp.zeros_like(ravel(y0)), jnp.asarray(0)) if self.reuse else None

    def advance(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _PreviousStage,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Array, Y, _PreviousStage]:
        """See `AbstractDopri8.advance`."""
        advance = multi_tangent_jvp(_advance_batch_last, _advance_jvp) if self.tangents else _advance_batch_last
        known = None if made_jump is True else solver_state
        if known is not None and made_jump is not False:
            known = (known[0], jnp.where(made_jump, 0, known[1]))
        end, stages, error = advance((t0, terms.contr(t0, t1), y0, known, args, terms))
        return end, stages, error, (stages[-1], jnp.asarray(1)) if self.reuse else None


def _linear_combination(inputs: tuple[Array, Array]) -> Array:
    return linear_combination(*inputs)


def _linear_combination_jvp(inputs: tuple[Array, Array], tangents: tuple[Array | None, Array | None]) -> tuple[Array, Array]:
    (weights, stages), (dweights, dstages) = inputs, tangents
    parts = [] if dweights is None else [linear_combination(dweights.T, stages).T]
    parts += [] if dstages is None else [linear_combination(weights, dstages)]
    return linear_combination(weights, stages), sum(parts[1:], parts[0])


def _linear_combination_batched(inputs: tuple[Array, Array], is_batched: tuple[bool, bool]) -> Array:
    weights, stages = (x if along else x[..., None] for x, along in zip(inputs, is_batched, strict=True))
    return functools.reduce(operator.add, (w * k for w, k in zip(weights[:, None, :], stages, strict=True)))


class _BatchedInterpolation(Dopri8Interpolation):
    """`Dopri8Interpolation` with special rules for derivatives and batches."""

    combine: Callable[[tuple[Array, Array]], Array] = eqx.field(static=True)

    def from_weights(self, weights: Array) -> Y:
        """Interpolation from the weights of stages, see `Dopri8Interpolation.from_weights`."""
        return jax.tree.map(lambda y, more: y + more, self.y0, unravel(self.combine((weights, self.stages)), self.y0))


_combination = batch_last(_linear_combination, _linear_combination_batched)
_WITHOUT_TANGENTS = functools.partial(_BatchedInterpolation, combine=_combination)
_WITH_TANGENTS = functools.partial(_BatchedInterpolation, combine=multi_tangent_jvp(_combination, _linear_combination_jvp))


def _advance(inputs: _Inputs) -> _Step:
    """Compute a step."""
    t0, dt, y0, known, args, terms = inputs

    def rates(share: RealScalarLike, y: Array) -> Array:
        return ravel(terms.vf(t0 + share * dt, unravel(y, y0), args))

    end, stages, error = _stages(ravel(y0), known, rates, lambda total: dt * total, dt)
    return unravel(end, y0), stages, unravel(error, y0)


def _advance_batched(inputs: _Inputs, is_batched: Batched) -> _Step:
    """Compute `_advance` for a batch along a last axis."""
    t0, dt, y0, known, args, terms = inputs
    t0_batched, dt_batched, y0_batched, known_batched, *others_batched = is_batched
    leaves, rest = jax.tree.flatten((t0, dt, args, terms))
    flags = flat_tangents((t0_batched, dt_batched, *others_batched), (t0, dt, args, terms))
    places = [k for k, along in enumerate(flags) if along]
    like = jax.tree.map(lambda leaf, along: leaf[..., 0] if along else leaf, y0, y0_batched)
    size = next(leaf.shape[-1] for leaf, along in zip(*map(jax.tree.leaves, (inputs, is_batched)), strict=True) if along)

    def whole(tree: PyTree[Array], along: Batched) -> Array:
        spread = lambda leaf, here: leaf if here else jnp.broadcast_to(leaf[..., None], (*leaf.shape, size))  # noqa: E731
        return ravel(jax.tree.map(spread, tree, along), 1)

    if known is not None:
        # All runs start at the earliest stage that any of them still has to compute.
        known = (whole(known[0], known_batched[0]), jnp.min(known[1]))

    def rates(share: RealScalarLike, y: Array) -> Array:
        def rate(y: Y, moving: list[Array]) -> VF:
            given = dict(zip(places, moving, strict=True))
            t0, dt, args, terms = jax.tree.unflatten(rest, [given.get(k, leaf) for k, leaf in enumerate(leaves)])
            return terms.vf(t0 + share * dt, y, args)

        found = jax.vmap(rate, in_axes=-1, out_axes=-1)(unravel(y, like), [leaves[k] for k in places])
        return ravel(found, 1)

    dt = dt[None, :] if dt_batched else dt
    end, stages, error = _stages(whole(y0, y0_batched), known, rates, lambda total: dt * total, dt)
    return unravel(end, like), stages, unravel(error, like)


_advance_batch_last = batch_last(_advance, _advance_batched)


def _advance_jvp(inputs: _Inputs, tangents: Tangents) -> tuple[_Step, _Step]:
    """Compute `_advance` with the tangents of its results."""
    t0, dt, y0, known, args, terms = inputs
    dt0, ddt, dy0, dknown, *others = tangents
    leaves, rest = jax.tree.flatten((t0, dt, args, terms))
    moves = flat_tangents((dt0, ddt, *others), (t0, dt, args, terms))
    places = [k for k, move in enumerate(moves) if move is not None]

    def field(share: RealScalarLike, y: Y, moving: list[Array]) -> VF:
        given = dict(zip(places, moving, strict=True))
        t0, dt, args, terms = jax.tree.unflatten(rest, [given.get(k, leaf) for k, leaf in enumerate(leaves)])
        return terms.vf(t0 + share * dt, y, args)

    def rates(share: RealScalarLike, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        here = unravel(pair[0], y0), [leaves[k] for k in places]
        along = unravel(pair[1], y0), [move for move in moves if move is not None]

        def tangent(direction: tuple[Y, list[Array]]) -> VF:
            return jax.jvp(lambda y, moving: field(share, y, moving), here, direction)[1]

        tangents = jax.vmap(tangent, in_axes=-1, out_axes=-1)(along)
        return ravel(field(share, *here)), ravel(tangents, 1)

    def over_step(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        total, change = pair
        return dt * total, dt * change if ddt is None else dt * change + total[:, None] * ddt[None, :]

    def whole(tangents: Tangents, like: PyTree[Array]) -> Array:
        size = jax.tree.leaves((dt0, ddt, dy0, dknown, others))[0].shape[-1]
        pairs = zip(flat_tangents(tangents, like), jax.tree.leaves(like), strict=True)
        return ravel([jnp.zeros((*leaf.shape, size), leaf.dtype) if dx is None else dx for dx, leaf in pairs], 1)

    if known is not None:
        known = ((known[0], whole(dknown[0], known[0])), known[1])
    (end, dend), (stages, dstages), (error, derror) = _stages((ravel(y0), whole(dy0, y0)), known, rates, over_step, dt)
    return (unravel(end, y0), stages, unravel(error, y0)), (unravel(dend, y0), dstages, unravel(derror, y0))


def _weighted_sum(weights: Array | np.ndarray, stages: Array) -> Array:
    """Return sum_j weights_j stages_j as an unrolled sum, which in a loop is faster than a matrix product."""
    if isinstance(weights, np.ndarray):
        return functools.reduce(operator.add, (weights[j].astype(stages.dtype) * stages[j] for j in np.flatnonzero(weights)))
    return _written_sum(weights.astype(stages.dtype), stages)


@jax.custom_jvp
def _written_sum(weights: Array, stages: Array) -> Array:
    return functools.reduce(operator.add, (weights[j] * stages[j] for j in range(len(weights))))


@_written_sum.defjvp
def _written_sum_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the derivative as a matrix product. Reverse mode transposes the derivative; the transpose of an unrolled sum would
    add a whole array of stages for each pair of stages."""
    (weights, stages), (_, change) = primals, tangents  # the weights of the method are constant
    return _written_sum(weights, stages), linear_combination(weights, change[: len(weights)])


def _stages(
    y0: Numbers,
    known: tuple[Numbers, Array] | None,
    rates: Callable[[RealScalarLike, Numbers], Numbers],
    over_step: Callable[[Numbers], Numbers],
    dt: Array,
) -> tuple[Numbers, Numbers, Numbers]:
    """Return the end, the stages and the error of a step; y0, the known stage and the rates are trees of arrays (n, ...) of
    equal structure."""
    stages = jax.tree.map(lambda y: jnp.zeros((len(_ROWS), *y.shape), y.dtype), y0)
    if known is not None:
        stages = jax.tree.map(lambda k, first: k.at[0].set(first), stages, known[0])
    # A division by a 1 that the compiler does not recognize prevents recomputation of the state for each use.
    one = lax.stop_gradient(jnp.where(dt >= 0.0, 1.0, dt))

    def weighted(stages: Numbers, weights: Array | np.ndarray) -> Numbers:
        return over_step(jax.tree.map(functools.partial(_weighted_sum, weights), stages))

    def moved(stages: Numbers, weights: Array | np.ndarray) -> Numbers:
        return jax.tree.map(lambda start, change: (start + change) / one, y0, weighted(stages, weights))

    def stage(j: Array, stages: Numbers) -> Numbers:
        row, share = (jnp.asarray(table, one.dtype)[j] for table in (_ROWS, _NODES))
        new = rates(share, moved(stages, row))
        return jax.tree.map(lambda k, value: lax.dynamic_update_index_in_dim(k, value, j, 0), stages, new)

    stages = lax.fori_loop(0 if known is None else known[1], len(_ROWS), stage, stages)
    # The state at the last stage is the end of the step. It is computed here, so that the loop does not have to carry it.
    return moved(stages, ROWS[-1]), stages, weighted(stages, ERROR)
