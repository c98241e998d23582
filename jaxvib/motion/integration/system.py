"""Vector field and state in the form that is integrated fastest: on scalars for small states, otherwise on arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import TypeAlias, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.numerics.fence import entries, hidden_one
from jaxvib.ode.dopri8 import UnrolledDopri8, ravel
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.ode.replay import differentiable_once
from jaxvib.ode.scalar_programs import fenced, with_reciprocals
from jaxvib.ode.scalarize import MAX_SCALARS, arrays_program, scalarized_program, scalars_of
from jaxvib.ode.types import Args, RealScalarLike
from jaxvib.runtime.compat import ClosedJaxpr, jaxpr_as_fun

T = TypeVar("T")

IntegratorState: TypeAlias = PyTree[Array]
"""State of the integrator: the entries of a `State`; if angles are wrapped, a pair of the entries and the numbers of whole
turns."""

_TURN = 2.0 * math.pi

_LONG_ARRAY = 4
"""Smallest number of entries in an array of the state for which arrays are used instead of scalars. With arrays, derivatives
take less time and programs compile faster. Runs take the same time as with scalars, or two thirds of it for 8 entries or
more."""

_MAX_UNROLLED_SIZE = 8
"""Largest size of a state for which the stages of the method are unrolled."""


class PackedSystem(eqx.Module):
    """Conversion between a `State` and the state of the integrator.

    The state of the integrator is a vector of the entries of the `State`, or, for a batch with equations on scalars, a tuple of
    these entries.

    With a vector, a compiled step moves fewer values to and from memory, and diffrax stores, compares and copies one array
    instead of many. In a batch each entry is an array over the runs, which is contiguous in memory.

    If angles are wrapped, the state of the integrator contains each angle within one turn and, separately, the number of whole
    turns. Long runs in single precision then keep their phase: neighbouring numbers of single precision near a million
    radians differ by 0.06 rad.

    **Arguments**

    - `field`: the vector field; `state`: a state
    - `wrapped`: True if angles are wrapped
    - `has_common_turns`: True if the same number of turns is subtracted from a coordinate of all loads of an exciter, which
      keeps their differences
    - `batch`: True if many runs advance as one batch
    - `contacts` of the scene, a second part of `args`, see `jaxvib.motion.integration.contacts`; default: none
    - `solver` with which the equations will be integrated; default: that of `method`

    **Attributes**

    - `program`: jaxpr of the equations, on scalars if `is_scalarized`, otherwise on arrays; None if this version of JAX gives
      no access to jaxprs
    - `size`: number of entries of the state; `treedef` and `shapes` of its arrays; `is_on_scalars`: True if the state of the
      integrator is a tuple of scalars
    - `has_fences`: True if intermediate values are computed only once, see `fenced`
    - `args`: arguments of `term`; `has_contacts`: True if they contain `contacts`
    """

    args: Args
    program: ClosedJaxpr | None = eqx.field(static=True)
    is_scalarized: bool = eqx.field(static=True)
    size: int = eqx.field(static=True)
    is_on_scalars: bool = eqx.field(static=True)
    has_fences: bool = eqx.field(static=True)
    treedef: Hashable = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    wrapped: bool = eqx.field(static=True)
    has_common_turns: bool = eqx.field(static=True)
    batch: bool = eqx.field(static=True)
    has_contacts: bool = eqx.field(static=True)

    def __init__(
        self,
        field: Callable[[Array, State], State],
        state: State,
        *,
        wrapped: bool = False,
        has_common_turns: bool = False,
        batch: bool = False,
        contacts: PyTree | None = None,
        solver: diffrax.AbstractSolver | None = None,
    ):
        self.wrapped, self.has_common_turns, self.batch = wrapped, has_common_turns, batch
        self.has_contacts = contacts is not None
        leaves, self.treedef = jax.tree.flatten(state)
        self.shapes = tuple(leaf.shape for leaf in leaves)
        self.size = sum(leaf.size for leaf in leaves)
        self.args, arguments = field, (jnp.zeros((), leaves[0].dtype), state, field)
        # Without a batch, arrays over the angles of many loads already fill the vector registers.
        is_small = self.size <= MAX_SCALARS and (batch or max(leaf.size for leaf in leaves) < _LONG_ARRAY)
        program = scalarized_program(_rates_of, *arguments) if is_small else None
        if program is not None:
            program = with_reciprocals(program, 1 + self.size)
        self.is_scalarized = program is not None
        self.program = arrays_program(_rates_of, *arguments) if program is None else program
        if program is not None:
            # Arrays are split into entries here; the time loop then contains no arrays.
            self.args = scalars_of(field)
        self.args = (self.args, contacts) if self.has_contacts else self.args
        self.is_on_scalars = self.is_scalarized and batch
        self.has_fences = self.is_scalarized and solver is None and (batch or self.size <= _MAX_UNROLLED_SIZE)

    @property
    def term(self) -> diffrax.ODETerm:
        """Equations of motion for the state of the integrator."""
        return diffrax.ODETerm(self._rates)

    def method(self, adjoint: diffrax.AbstractAdjoint | None = None) -> diffrax.AbstractSolver:
        """Return the method of order 8 in its fastest form, with derivatives by `adjoint` (default: `jaxvib.ode.replay`)."""
        # `args` is removed, because a method must not contain traced arrays.
        wrap = eqx.tree_at(lambda system: system.args, self, None)._wrap if self.wrapped else None
        if self.size <= _MAX_UNROLLED_SIZE:
            return UnrolledDopri8(wrap=wrap)
        return LoopDopri8(reuse=adjoint is None or isinstance(adjoint, diffrax.ForwardMode), wrap=wrap)

    def pack(self, state: State) -> IntegratorState:
        """Convert a state, or a tree with the same structure, to the state of the integrator."""
        y = tuple(scalars_of(state)) if self.is_on_scalars else ravel(state)
        return (y, jax.tree.map(jnp.zeros_like, y)) if self.wrapped else y

    def unpack(self, packed: IntegratorState) -> State:
        """Return states along a leading axis from states of the integrator. The whole turns of the first state are subtracted
        from wrapped angles."""
        if not self.wrapped:
            return self.state(packed)
        y, turns = packed
        return self.state(_add_turns(y, jax.tree.map(lambda n: n - n[:1], turns), 1.0))

    def _wrap(self, packed: IntegratorState) -> IntegratorState:
        """Move whole turns from the angles to their counts."""
        y, turns = packed
        is_angle, leader = self._angles()
        lead = tuple(y[k] for k in leader) if self.is_on_scalars else y[leader]

        def whole(x: Array, is_angle: np.ndarray) -> Array:
            return jnp.where(is_angle, jnp.round(x / _TURN), 0.0)

        whole_turns = jax.tree.map(whole, lead, tuple(is_angle) if self.is_on_scalars else is_angle)
        return _add_turns(y, whole_turns, -1.0), jax.tree.map(jnp.add, turns, whole_turns)

    def _angles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return True for entries that are angles, and for each entry the index of the angle that defines its number of
        turns."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        places = jax.tree.unflatten(
            self.treedef, [np.arange(end - math.prod(s), end) for end, s in zip(ends, self.shapes, strict=True)]
        )
        is_angle, leader = np.zeros(self.size, bool), np.arange(self.size)
        for exciter in places.exciters:
            for coordinate in exciter.angle:
                is_angle[coordinate] = True
                if self.has_common_turns:
                    leader[coordinate] = coordinate[0]
            if exciter.rotor is not None:
                is_angle[exciter.rotor[0]] = True
        return is_angle, leader

    def state(self, y: IntegratorState) -> State:
        """Return states along a leading axis from entries of the integrator's state."""
        rows = jnp.stack(y, axis=-1) if self.is_on_scalars else y
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        parts = [
            rows[..., end - math.prod(shape) : end].reshape(*rows.shape[:-1], *shape)
            for end, shape in zip(ends, self.shapes, strict=True)
        ]
        return jax.tree.unflatten(self.treedef, parts)

    def unwrap(self, packed: IntegratorState, like: IntegratorState) -> IntegratorState:
        """Return a state of the integrator whose angles are counted from the whole turns of the state `like`."""
        if not self.wrapped:
            return packed
        (y, turns), (_, first) = packed, like
        return _add_turns(y, jax.tree.map(jnp.subtract, turns, first), 1.0), first

    def _rates(self, t: RealScalarLike, y: IntegratorState, args: Args) -> IntegratorState:
        args = args[0] if self.has_contacts else args
        if self.wrapped:
            y, turns = y
            return self._plain_rates(t, y, args), jax.tree.map(jnp.zeros_like, turns)
        return self._plain_rates(t, y, args)

    def _plain_rates(self, t: RealScalarLike, y: IntegratorState, args: Args) -> IntegratorState:
        if self.program is None:
            return ravel(args(t, self.state(y)))
        run = jaxpr_as_fun(self.program)
        if not self.is_scalarized:
            return ravel(run(jnp.asarray(t, y.dtype), *jax.tree.leaves(self.state(y)), *jax.tree.leaves(args)))
        numbers = y if self.is_on_scalars else entries(y, hidden_one(y[0])) if self.has_fences else jnp.unstack(y)
        arguments = [jnp.asarray(t, numbers[0].dtype), *numbers, *args]
        rates = fenced(self.program, arguments) if self.has_fences else run(*arguments)
        return tuple(rates) if self.is_on_scalars else jnp.stack(rates)


def _add_turns(y: IntegratorState, turns: IntegratorState, sign: float) -> IntegratorState:
    """Add whole turns to entries, with 2 pi in two parts, because the rounding error of 2 pi would accumulate."""

    def add_to_entry(x: Array, n: Array) -> Array:
        high = np.asarray(_TURN, x.dtype)
        low = np.asarray(_TURN - float(high), x.dtype)
        return (x + sign * n * high) + sign * n * low

    return jax.tree.map(add_to_entry, y, turns)


def _rates_of(t: Array, y: State, field: Callable[[Array, State], State]) -> State:
    return field(t, y)


def with_first_derivatives(scene: Scene, inputs: T) -> tuple[Scene, T]:
    """Return a scene and the other inputs of a run; second derivatives with respect to them raise `InputError` if the scene has
    forces or torques that are not smooth.

    Without the error, second derivatives would be wrong for a step in which a force has a kink: they would omit the change of
    the time of the kink.
    """
    if not scene.not_smooth:
        return scene, inputs
    parts = ", ".join(dict.fromkeys(type(part).__name__ for part in scene.not_smooth))
    problem = f"has no second derivatives of runs, because {parts} is not smooth; use central differences of first derivatives"
    return differentiable_once((scene, inputs), "scene", problem)
