"""Newton's method for periodic motions, with steps that are shortened until they reduce the residuals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

_MAX_NEWTON_STEPS = 60
"""Maximum number of Newton steps, rejected ones included; ordinary points take 4 to 6."""


class Linearized(NamedTuple):
    """Equations at some unknowns: `norm` of their residuals, the `scale` of the terms in them, and the Newton step `change`."""

    norm: Array
    scale: Array
    change: Callable[[], Array]


class _NewtonState(NamedTuple):
    """State of Newton's iteration.

    **Attributes**: `steps` taken; the best `unknowns` so far; `norm` of their residuals and the `scale` of the terms in it;
    `change`: the Newton step there; `length`: the largest fraction of it that may be taken; `done`: True if the iteration ends;
    `stalled`: True if it ends because no fraction of the step reduces the residuals.
    """

    steps: Array
    unknowns: Any
    norm: Array
    scale: Array
    change: Array
    length: Array
    done: Array
    stalled: Array


def newton(
    linearize: Callable[..., Linearized], move: Callable[[Any, Array, Array], Any], start: Any, change: Array, one: Array
) -> Any:
    """Return the root of the equations that `linearize` evaluates at the unknowns, or the best unknowns found.

    **Arguments**: `move(unknowns, change, length)`: the unknowns after at most the fraction `length` of a Newton step; `start`
    of the unknowns; a `change` of zeros; `one`: the number 1 in the precision of the unknowns.
    """
    tiny = 128.0 * jnp.finfo(change.dtype).eps
    no = jnp.asarray(False)

    def step(now: _NewtonState) -> _NewtonState:
        there = move(now.unknowns, now.change, now.length)
        norm, scale, solve = linearize(*there)
        # Newton's method squares the reduction of the residuals: if the next step will end below rounding, the residuals after
        # it need no evaluation. The reduction by the first step, from the start, allows no such prediction.
        predicted_converged = (norm * (norm / now.norm) ** 2 < tiny / 16.0 * scale) & (now.steps > 0)
        change = solve()
        done = (norm < tiny * scale) | predicted_converged
        then = _NewtonState(now.steps + 1, there, norm, scale, change, jnp.minimum(2.0 * now.length, 1.0), done, no)
        stalled = (now.length < 4e-4) | ~jnp.all(jnp.isfinite(now.change)) | (now.norm < 16.0 * tiny * now.scale)
        stay = now._replace(steps=now.steps + 1, length=now.length / 4.0, done=stalled, stalled=stalled)
        return jax.tree.map(lambda a, b: jnp.where(norm < now.norm, a, b), then, stay)

    # The first iteration only evaluates the residuals at the start, because the initial norm is infinite.
    begin = _NewtonState(jnp.asarray(-1), start, jnp.inf * one, one, change, one, no, no)
    end = jax.lax.while_loop(lambda now: (now.steps < _MAX_NEWTON_STEPS) & ~now.done, step, begin)
    return move(end.unknowns, jnp.where(end.done & ~end.stalled, end.change, 0.0), end.length)
