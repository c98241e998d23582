"""Roots of a few equations by damped Newton's method, from one start or from many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxvib.equations.torque_balance import TorqueBalance, balance_residuals
from jaxvib.numerics.linalg import solve_definite
from jaxvib.ode.scalar_programs import fenced
from jaxvib.ode.scalarize import MAX_SCALARS, arrays_program, scalarized_program, scalars_of
from jaxvib.runtime.compat import jaxpr_as_fun

Args = TypeVar("Args", bound=PyTree[Array])
Auxiliary = TypeVar("Auxiliary", bound=PyTree[Array])
_State: TypeAlias = tuple[Array, Auxiliary, Array, Array, Array, Array]
"""Best unknowns so far, auxiliary values, residuals, sum of the squared residuals, Jacobian and damping."""


def damped_newton(
    balance: Callable[[Array, Args], tuple[Array, Auxiliary]],
    start: Array,
    args: Args,
    iterations: int = 40,
    *,
    on_scalars: bool = True,
) -> tuple[Array, Auxiliary]:
    """Solve `balance(x, args) = 0` from `start` by Newton steps with the damping of Levenberg and Marquardt.

    **Arguments**

    - `balance(x, args)`: returns the residuals and auxiliary values. The residuals must be scaled such that they are at most of
      the order of 1 everywhere, because the limit below which they count as rounding errors is absolute
    - `iterations`: maximum number of steps; the iteration ends earlier if only rounding errors are left
    - `on_scalars`: compile the equations as operations on single numbers instead of arrays, see `scalarize`. For many starts
      this takes a third of the time, but it takes longer to compile

    **Returns** the unknowns with the smallest residuals (the root, if the iteration converges) and the auxiliary values there.

    >>> x, two_x = damped_newton(lambda x, a: (x**2 - a, 2.0 * x), jnp.ones(1), jnp.full(1, 2.0))
    >>> round(float(x[0]), 5), round(float(two_x[0]), 5)
    (1.41421, 2.82843)
    """
    tiny = float(jnp.finfo(start.dtype).eps) ** 1.5

    def step(state: _State, args: Args) -> _State:
        x, auxiliary, value, size, slopes, damping = state
        normal = slopes.T @ slopes
        damped = normal + damping * one * (normal + jnp.finfo(x.dtype).tiny)
        trial = x - jnp.clip(solve_definite(damped, slopes.T @ value), -0.5, 0.5)

        def derivative(direction: ArrayLike) -> tuple[Array, Array, Auxiliary]:
            return jax.jvp(lambda y: balance(y, args), (trial,), (direction,), has_aux=True)

        new_value, new_slopes, new_auxiliary = jax.vmap(derivative, out_axes=(None, 1, None))(one)
        new_size = jnp.sum(new_value**2)
        is_better = new_size < size  # and not NaN
        # An infinite damping ends the iteration.
        more_damping = jnp.where(size < tiny, jnp.inf, jnp.minimum(8.0 * damping, 1e8))
        accepted = trial, new_auxiliary, new_value, new_size, new_slopes, jnp.maximum(0.1 * damping, 1e-14)
        rejected = x, auxiliary, value, size, slopes, more_damping
        return jax.tree.map(lambda a, b: jnp.where(is_better, a, b), accepted, rejected)

    one = np.eye(start.shape[0], dtype=start.dtype)
    no_auxiliary = jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), jax.eval_shape(balance, start, args)[1])
    # The first iteration only evaluates the residuals at the start, because the initial residual is infinite.
    inf, tenth = jnp.asarray(jnp.inf, start.dtype), jnp.asarray(0.1, start.dtype)
    begin = start, no_auxiliary, jnp.zeros_like(start), inf, jnp.asarray(one), tenth
    leaves, structure = jax.tree.flatten(begin)
    small = on_scalars and sum(leaf.size for leaf in leaves) <= MAX_SCALARS
    program = scalarized_program(step, begin, args) if small else None
    if program is None:
        return jax.tree.unflatten(structure, _iterate(_on_arrays(step, begin, args), leaves, iterations))[:2]
    constants = scalars_of(args)
    numbers = iter(_iterate(lambda *now: fenced(program, [*now, *constants]), scalars_of(begin), iterations))
    arrays = [jnp.stack([next(numbers) for _ in range(leaf.size)]).reshape(leaf.shape) for leaf in leaves]
    return jax.tree.unflatten(structure, arrays)[:2]


def solve_torques(start: Array, balance: TorqueBalance, iterations: int = 40, *, on_scalars: bool = False) -> Array:
    """Return the unknowns of a torque balance with the smallest residuals, see `damped_newton` and `unknowns_of`."""

    def residuals(x: Array, balance: TorqueBalance) -> tuple[Array, None]:
        return balance_residuals(x, balance), None

    return damped_newton(residuals, start, balance, iterations, on_scalars=on_scalars)[0]


def _on_arrays(step: Callable[[_State, Args], _State], begin: _State, args: Args) -> Callable[..., Sequence[Array]]:
    """Return the step as a function of the arrays of a state. If this version of JAX permits it, sine and cosine are those of
    the programs on scalars."""
    program, structure, constants = arrays_program(step, begin, args), jax.tree.structure(begin), jax.tree.leaves(args)
    if program is None:
        return lambda *now: jax.tree.leaves(step(jax.tree.unflatten(structure, now), args))
    return lambda *now: jaxpr_as_fun(program)(*now, *constants)


def _iterate(step: Callable[..., Sequence[Array]], begin: Sequence[Array], times: int) -> Sequence[Array]:
    """Return the state after the first evaluation and `times` steps, or fewer steps if the damping, the last entry of the
    state, becomes infinite."""

    def is_unfinished(now: tuple[Array, list[Array]]) -> Array:
        return (now[0] <= times) & (now[1][-1] < jnp.inf)

    return jax.lax.while_loop(is_unfinished, lambda now: (now[0] + 1, list(step(*now[1]))), (jnp.asarray(0), list(begin)))[1]
