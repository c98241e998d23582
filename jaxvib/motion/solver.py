"""The engine: Dormand and Prince's step of order 8, written out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

__all__ = ["Wrapped", "WrittenOut"]

_TABLEAU = diffrax.Dopri8.tableau
_STAGES = len(_TABLEAU.b_sol) - 1
_ERROR = np.asarray(_TABLEAU.b_error)


class WrittenOut(diffrax.AbstractAdaptiveSolver):
    """Dormand and Prince's pair of order 8(7), its 13 stages written out one after another.

    The same numbers as `diffrax.Dopri8`, in another form: no loop over stages, no arrays of stages, so that a small time loop
    compiles into one piece of code; and a fence after each stage, without which XLA's fusion computes each stage anew for
    each use of it (a step of 900 multiplications becomes one of 4500).

    Compiling takes several times as long as for `diffrax.Dopri8`, which needs about 1.6 times the time for each step.

    **Arguments**: `lanes` whether many runs advance together, each number of the state an array over them; the fence is then
    a division by a 1 that the compiler cannot know, otherwise a detour through memory that costs less for single numbers;
    `wrap` what is done to the state after each step, such as taking whole turns out of its angles.

    >>> import diffrax, jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> solution = diffrax.diffeqsolve(diffrax.ODETerm(lambda t, y, args: (y[1], -y[0])), WrittenOut(), 0.0, 10.0, 0.1,
    ...                                (jnp.asarray(1.0), jnp.asarray(0.0)))
    >>> bool(abs(solution.ys[0][0] - jnp.cos(10.0)) < 1e-11)
    True

    Source: P. J. Prince and J. R. Dormand, J. Comp. Appl. Math. 7 (1981) 67; interpolation as in diffrax.
    """

    lanes: bool = eqx.field(static=True, default=False)
    wrap: Callable[[Any], Any] | None = None
    tableau: ClassVar[diffrax.ButcherTableau] = _TABLEAU

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Any]] = diffrax.Dopri8.interpolation_cls

    def order(self, terms: Any) -> int:
        """8."""
        return 8

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The rates at the start: the last stage of a step is the first of the next one."""
        return terms.vf(t0, y0, args)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """The vector field, for the choice of the first step."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, Any]:
        """One step from t0 to t1: the state, its error estimate, and the stages that the interpolant between them needs."""
        # Where the field may jump between steps (then `made_jump` is traced) its value is computed anew.
        first = solver_state if made_jump is False else terms.vf(t0, y0, args)
        fence = _fence_of(self.lanes, jnp.where(t1 > t0, 1.0, t1 - t0))
        dt = terms.contr(t0, t1)
        nodes = np.concatenate([[0.0], np.asarray(_TABLEAU.c)])
        stages = [first]
        for row, c in zip(_TABLEAU.a_lower[: _STAGES - 1], nodes[1:], strict=False):
            y = fence(_moved(y0, dt, row, stages))
            stages.append(_fenced(fence, terms.vf(t0 + float(c) * dt, y, args), y))
        y1 = fence(_moved(y0, dt, _TABLEAU.b_sol[:_STAGES], stages))
        last = _fenced(fence, terms.vf(t1, y1, args), y1)
        error = jax.tree.map(lambda *k: dt * _weighted(_ERROR[:_STAGES], k), *stages)
        # As increments over the step, as diffrax's interpolant takes them; the compiler drops what nobody asks for.
        k = jax.tree.map(lambda *k: jnp.stack([dt * value for value in k]), *stages, last)
        end = y1 if self.wrap is None else self.wrap(y1)
        return end, error, dict(y0=y0, y1=y1, k=k), last, diffrax.RESULTS.successful


class Wrapped(diffrax.Dopri8):
    """`diffrax.Dopri8`, after each of whose steps `wrap` is done to the state: see `WrittenOut`."""

    wrap: Callable[[Any], Any] | None = None

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, Any]:
        """As `WrittenOut.step`."""
        y1, error, dense, last, result = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1 if self.wrap is None else self.wrap(y1), error, dense, last, result


def _weighted(weights: Any, values: Any) -> Array:
    total: Any = None
    for weight, value in zip(weights, values, strict=True):
        if weight != 0.0:
            term = float(weight) * value
            total = term if total is None else total + term
    return total


def _moved(y0: Any, dt: Array, weights: Any, stages: list[Any]) -> Any:
    return jax.tree.map(lambda y, *k: y + dt * _weighted(weights, k), y0, *stages)


def _fenced(fence: Callable[[Any], Any], rates: Any, y: Any) -> Any:
    """Rates behind a fence, but those that are part of `y`, as velocities are, and have been behind one."""
    leaves, rest = jax.tree.flatten(rates)
    new = [k for k, leaf in enumerate(leaves) if not any(leaf is known for known in jax.tree.leaves(y))]
    for k, leaf in zip(new, fence([leaves[k] for k in new]) if new else [], strict=True):
        leaves[k] = leaf
    return jax.tree.unflatten(rest, leaves)


def _fence_of(lanes: bool, one: Array) -> Callable[[Any], Any]:
    one = jax.lax.stop_gradient(one)

    def through_memory(y: Any) -> Any:
        leaves, rest = jax.tree.flatten(y)
        if any(jnp.ndim(leaf) for leaf in leaves):
            return jax.tree.map(lambda leaf: leaf / one.astype(leaf.dtype), y)
        kept = jnp.stack(leaves) * one.astype(leaves[0].dtype)
        return jax.tree.unflatten(rest, [kept[i] for i in range(len(leaves))])

    def divided(y: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf / one.astype(leaf.dtype), y)

    return divided if lanes else through_memory
