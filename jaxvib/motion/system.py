"""A vector field and a state in the form in which they are integrated fastest: as single numbers, where it is small."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.equations.dynamics import State
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.ode.scalarize import MAX_SCALARS, scalarized_program, scalars_of
from jaxvib.ode.types import Args, RealScalarLike
from jaxvib.runtime.compat import ClosedJaxpr, jaxpr_as_fun

__all__ = ["PackedSystem"]

Held: TypeAlias = PyTree[Array]
"""What the integrator holds: a state or a tuple of its numbers; where angles are wrapped a pair, that and the turns done."""

_TURN = 2.0 * math.pi

_MOST_WRITTEN = 8
"""With more numbers in a state, the method's stages written out one after another take too long to compile as well."""


class PackedSystem(eqx.Module):
    """Translates between a `State` and what the integrator holds: a tuple of numbers, or the state itself where it is large.

    Where angles are wrapped the integrator holds each within a turn, and beside it the whole turns it has done: a long run in
    single precision keeps its phase, for an angle of a million radians has no digits left of where in a turn it is.

    **Arguments**: the vector field; a state; `wrapped` whether angles are; `together` whether all loads' angles are wrapped by
    the same turns, so that their differences stay.

    **Attributes**: `program` the equations on numbers, None where the state is held itself; `size` how many numbers it has;
    `args` the arguments of `term`.
    """

    args: Args
    program: ClosedJaxpr | None = eqx.field(static=True)
    size: int = eqx.field(static=True)
    like: Any = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    wrapped: bool = eqx.field(static=True)
    together: bool = eqx.field(static=True)

    def __init__(self, field: Callable[[Array, State], State], state: State, *, wrapped: bool = False, together: bool = False):
        self.wrapped, self.together = wrapped, together
        leaves, self.like = jax.tree.flatten(state)
        self.shapes = tuple(leaf.shape for leaf in leaves)
        self.size = sum(leaf.size for leaf in leaves)
        self.args, self.program = field, None
        if self.size <= MAX_SCALARS:
            self.program = scalarized_program(lambda t, y, f: f(t, y), jnp.zeros((), leaves[0].dtype), state, field)
        if self.is_scalarized:
            # Entry by entry already here, so that the time loop has no arrays to take apart.
            self.args = scalars_of(field)

    @property
    def is_scalarized(self) -> bool:
        """Whether the state is held as single numbers."""
        return self.program is not None

    @property
    def term(self) -> diffrax.ODETerm:
        """The equations of motion on what the integrator holds."""
        return diffrax.ODETerm(self._rates)

    def method(self, lanes: bool = False) -> diffrax.AbstractSolver:
        """The method of order 8 in the form that is fastest here; `lanes` whether many runs advance together."""
        # Without the equations' numbers: a method holds no traced arrays.
        wrap = eqx.tree_at(lambda system: system.args, self, None)._wrap if self.wrapped else None
        return UnrolledDopri8(lanes=lanes, wrap=wrap) if self.size <= _MOST_WRITTEN else LoopDopri8(wrap=wrap)

    def pack(self, state: State) -> Held:
        """A state (or a tree like it) as the integrator holds it."""
        y = tuple(scalars_of(state)) if self.is_scalarized else state
        return (y, jax.tree.map(jnp.zeros_like, self._angles(y))) if self.wrapped else y

    def unpack(self, held: Held) -> State:
        """States along a leading axis, from what the integrator held then; wrapped angles count from the first one's turn."""
        if not self.wrapped:
            return self._state(held)
        y, turns = held
        return self._state(self._turned(y, jax.tree.map(lambda n: n - n[:1], turns), 1.0))

    def _wrap(self, held: Held) -> Held:
        """Takes whole turns out of the angles and counts them."""
        y, turns = held
        angles = self._angles(y)
        first = jnp.ravel(angles[0])[0]
        done = [
            jnp.round((first if self.together and k < len(angles) - self._rotors else x) / _TURN) for k, x in enumerate(angles)
        ]
        done = [jnp.broadcast_to(n, x.shape) for n, x in zip(done, angles, strict=True)]
        return self._turned(y, done, -1.0), [n + more for n, more in zip(turns, done, strict=True)]

    @property
    def _rotors(self) -> int:
        return int(jax.tree.unflatten(self.like, self.shapes).rotor is not None)

    def _places(self) -> list[int]:
        """Where the angles are among the leaves of what is held."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        numbered = jax.tree.unflatten(
            self.like, [range(end - math.prod(s), end) for end, s in zip(ends, self.shapes, strict=True)]
        )
        leaves = jax.tree.unflatten(self.like, range(len(self.shapes)))
        chosen = numbered if self.is_scalarized else jax.tree.map(lambda k: [k], leaves)
        rotor = [] if chosen.rotor is None else [chosen.rotor[0]]
        return [place for places in (*chosen.angle, *rotor) for place in places]

    def _angles(self, y: Held) -> list[Array]:
        leaves = jax.tree.leaves(y)
        return [leaves[place] for place in self._places()]

    def _turned(self, y: Held, turns: list[Array], sign: float) -> Held:
        """Angles changed by whole turns, 2 pi in two parts: the rounding of 2 pi would add up to a drift."""
        leaves, rest = jax.tree.flatten(y)
        for place, n in zip(self._places(), turns, strict=True):
            high = np.asarray(_TURN, leaves[place].dtype)
            low = np.asarray(_TURN - float(high), leaves[place].dtype)
            leaves[place] = (leaves[place] + sign * n * high) + sign * n * low
        return jax.tree.unflatten(rest, leaves)

    def _state(self, y: Held) -> State:
        if not self.is_scalarized:
            return y
        rows = iter(y)
        parts = []
        for shape in self.shapes:
            entries = [next(rows) for _ in np.ndindex(*shape)]
            parts.append(jnp.stack(entries, axis=-1).reshape(*entries[0].shape, *shape))
        return jax.tree.unflatten(self.like, parts)

    def _rates(self, t: RealScalarLike, y: Held, args: Args) -> Held:
        if self.wrapped:
            y, turns = y
            return self._plain_rates(t, y, args), jax.tree.map(jnp.zeros_like, turns)
        return self._plain_rates(t, y, args)

    def _plain_rates(self, t: RealScalarLike, y: Held, args: Args) -> Held:
        if self.program is None:
            return args(t, y)
        return tuple(jaxpr_as_fun(self.program)(jnp.asarray(t, y[0].dtype), *y, *args))
