"""Torque balance near a synchronous regime: rank, derivative with respect to the scene, quasi-static stability, margin.

Symbols: the rotating mass i has the unbalance S_i, the moment of inertia I_i, the angular velocity w_i, the phase alpha_i, the
driving torque L_i and the vibrational torque V_i. Omega is the speed of the regime. H_ik is the influence coefficient of the
carrier: the complex displacement at mass i per force of mass k, m/N.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import averaged_growth, largest_growth, mean_torque
from jaxvib.equations.torque_balance import TorqueBalance, balance_residuals, influence_of, motion_of, response_of
from jaxvib.numerics.linalg import eliminate, magnitude, small_solve, svd_in_turn

_TRIALS, _NEWTON_STEPS, _POLISHING_STEPS = 120, 6, 8
"""Maximum number of steps of the search for a fold, number of Newton steps in each of them, and number of Newton steps that
refine the fold."""

_SHORTEST_STEP = 1e-9
"""Relative step of the factor below which the search for a fold ends. The distance of the unknowns from the fold is about the
square root of the step, close enough for Newton's method."""

_LARGEST_FACTOR = 1e6
"""Largest finite margin; see `margin_of`."""

_LONGEST_STEP = 0.3
"""Largest change of a phase in a step of the search for a fold, rad."""


class Slopes(NamedTuple):
    """Singular value decomposition U, s, V^T (`left`, `values`, `right`) of the scaled Jacobian of the balance. `rows` and
    `columns` are the factors by which its rows and columns are multiplied."""

    rows: Array
    columns: Array
    left: Array
    values: Array
    right: Array

    @property
    def neutral(self) -> Array:
        """Number of singular values that are 0 up to rounding: directions in which torques do not change."""
        return jnp.sum(self.values < _rank_tolerance(self.values))


def _rank_tolerance(values: Array) -> Array:
    return jnp.finfo(values.dtype).eps ** 0.45 * jnp.maximum(1.0, values[0])


def vibration_scale(balance: TorqueBalance, omega: Array) -> Array:
    """Return the largest vibrational torque that is possible at the speed `omega`, (count,) N m, for each mass."""
    influence = influence_of(balance, omega)
    return omega**4 / 2.0 * balance.unbalance * jnp.sum(magnitude(influence) * balance.unbalance[None, :], axis=1)


def slopes_of(x: Array, balance: TorqueBalance, factor: Array | None = None) -> Slopes:
    """Return the decomposed Jacobian of the balance at the unknowns `x` of a regime."""
    free = np.flatnonzero(~balance.is_prescribed)
    omega = motion_of(balance, x)[0]
    rows = (balance.torque_scale / jnp.maximum(vibration_scale(balance, omega), jnp.finfo(x.dtype).tiny))[free]
    jacobian = rows[:, None] * jax.jacfwd(balance_residuals)(x, balance, factor)
    first = jnp.sqrt(jnp.sum(jacobian[:, 0] ** 2))
    # The speed is measured in units in which its slope is 1, phases in rad.
    by_speed = jnp.where((jnp.arange(x.size) == 0) & (first > 0.0) & (free.size == balance.is_prescribed.size), first, 1.0)
    scaled = jacobian / by_speed[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    left, values, right = svd_in_turn(jnp.where(finite, scaled, 0.0))
    return Slopes(rows, 1.0 / by_speed, left, values, right)


def implicit_step(x: Array, slopes: Slopes, residuals: Array) -> Array:
    """Return the unknowns after a Newton step without a change in neutral directions, with the derivatives of the implicit
    function theorem if the `residuals` at `x` are functions of the scene."""
    known = slopes.values > _rank_tolerance(slopes.values)
    inverse = jnp.where(known, 1.0 / jnp.where(known, slopes.values, 1.0), 0.0)
    along = inverse * (slopes.left.T @ (slopes.rows * residuals))
    return x - slopes.columns * (slopes.right.T @ along)


def regime_growth(balance: TorqueBalance, omega: Array, phase: Array, neutral: Array | int) -> Array:
    """Return the growth rate of small disturbances of a regime according to the averaged equations, 1/s."""
    vibration = omega**2 * response_of(balance, omega) @ (balance.unbalance * jnp.exp(1j * phase))
    return averaged_growth(balance.averaged, omega, phase, vibration, balance.averaged.free_shifts + neutral)


def quasi_static_growth(balance: TorqueBalance, omega: Array, phase: Array, neutral: Array | int) -> Array:
    """Return the growth rate of small disturbances of a regime if the machine follows the rotating masses without delay, 1/s.

        I_i w_i' = L_i(w_i) + (S_i/2) sum_k S_k w_k^4 Im(exp(i (alpha_k - alpha_i)) H_ik(w_k)),      alpha_i' = w_i - Omega

    This is the usual criterion of synchronization. It neglects the free vibrations of the machine.
    """
    prescribed, averaged = balance.is_prescribed, balance.averaged
    free = np.flatnonzero(~prescribed)
    if free.size == 0:
        return jnp.full_like(omega, -jnp.inf)

    def response(w: Array, direction: Array) -> Array:
        """Return w^4 D(w)^-1 B^T e of one mass that turns at `w`."""
        dynamic = balance.dynamic_stiffness(w)
        return w**4 * small_solve(dynamic, direction.astype(dynamic.dtype)[:, None])[:, 0]

    def acceleration(x: Array) -> Array:
        w = jnp.full_like(phase, omega).at[free].set(x[: free.size])
        turn = jnp.exp(1j * phase.at[free].set(x[free.size :]))
        forward = -balance.direction.conj() @ (jax.vmap(response)(w, balance.direction).T @ (balance.unbalance * turn))
        torque = balance.driving_torques(w) + mean_torque(balance.unbalance, jnp.conj(turn) * forward)
        return (torque / averaged.inertia)[free]

    slopes = jax.jacfwd(acceleration)(jnp.concatenate([jnp.full(free.size, omega, phase.dtype), phase[free]]))
    below = jnp.eye(free.size, 2 * free.size, dtype=slopes.dtype)
    shift = 0 if prescribed.any() else 1
    return largest_growth(jnp.concatenate([slopes, below]), neutral + shift)


def margin_of(balance: TorqueBalance, x: Array) -> Array:
    """Return the factor by which all differences of the driving torques can grow until the regime ends in a fold.

        mean L(Omega) + factor (L_i(Omega) - mean L(Omega)) + V_i = 0

    If an ideal drive turns an unbalance, the mean is replaced by 0. The factor is infinite if there are no differences, and if
    there is no fold up to a factor of 1e6. Its derivatives with respect to parameters of the scene are those of the fold.
    """
    if x.size == 0:
        return jnp.full((), jnp.inf, balance.unbalance.dtype)
    frozen, one = jax.lax.stop_gradient(balance).decomposed(), jnp.ones((), x.dtype)
    start = jax.lax.stop_gradient(x)
    free = np.flatnonzero(~frozen.is_prescribed)
    tolerance = jnp.finfo(x.dtype).eps ** 0.5

    def size(x: Array, factor: Array) -> Array:
        scale = frozen.torque_scale / vibration_scale(frozen, motion_of(frozen, x)[0])
        return jnp.max(jnp.abs(balance_residuals(x, frozen, factor)) * scale[free])

    def newton(_: int, at: tuple[Array, Array]) -> tuple[Array, Array]:
        x, factor = at
        slopes = jax.jacfwd(balance_residuals)(x, frozen, factor)
        return x - jnp.clip(eliminate(slopes, balance_residuals(x, frozen, factor)), -0.5, 0.5), factor

    def trial(x: Array, factor: Array, step: Array) -> tuple[Array, Array, Array]:
        new_x, new_factor = jax.lax.fori_loop(0, _NEWTON_STEPS, newton, (x, factor * (1.0 + step)))
        good = size(new_x, new_factor) < tolerance
        good = good & (jnp.max(jnp.abs(new_x - x)) < _LONGEST_STEP) & (factor < _LARGEST_FACTOR)
        return (
            jnp.where(good, new_x, x),
            jnp.where(good, new_factor, factor),
            jnp.where(good, jnp.minimum(1.5 * step, 1.0), 0.4 * step),
        )

    def continues(state: tuple[Array, Array, Array, Array]) -> Array:
        k, _, factor, step = state
        return (k < _TRIALS) & (factor < _LARGEST_FACTOR) & (step > _SHORTEST_STEP)

    begin = jnp.asarray(0), start, one, 0.1 * one
    _, at, factor, _ = jax.lax.while_loop(continues, lambda state: (state[0] + 1, *trial(*state[1:])), begin)
    fold, fold_factor, slopes = _fold_near(frozen, at, factor)
    polished = (jnp.abs(fold_factor - factor) < 1e-2 * factor) & (jnp.max(jnp.abs(fold - at)) < _LONGEST_STEP)
    at, factor = jnp.where(polished, fold, at), jnp.where(polished, fold_factor, factor)
    ends = factor < _LARGEST_FACTOR
    # If there is no fold, the values below are not used. They must be finite, because a NaN would appear in derivatives.
    at, factor = jnp.where(ends, at, start), jnp.where(ends, factor, one)
    # At the fold, changes of the unknowns do not change the left null vector times the residuals to first order.
    left = jnp.where(ends, slopes.rows * slopes.left[:, -1], 1.0)
    by_factor = left @ jax.jvp(lambda f: balance_residuals(at, frozen, f), (factor,), (one,))[1]
    by_factor = jnp.where(ends, by_factor, 1.0)
    moved = factor - (left @ balance_residuals(at, balance, factor) - left @ balance_residuals(at, frozen, factor)) / by_factor
    return jnp.where(ends, jnp.where(polished, moved, factor), jnp.inf)


def _fold_near(balance: TorqueBalance, x: Array, factor: Array) -> tuple[Array, Array, Slopes]:
    """Return the unknowns, the factor and the slopes at the fold near a regime, where the residuals are 0 and their Jacobian J
    is singular: J v = 0 with v0 . v = 1, where v0 is the vector of the smallest singular value at `x`."""
    begin = slopes_of(x, balance, factor)
    normal = begin.right[-1] / begin.columns
    normal = normal / jnp.sqrt(jnp.sum(normal**2))
    n = x.size

    def equations(z: Array) -> Array:
        def residuals(x: Array) -> Array:
            return begin.rows * balance_residuals(x, balance, z[n])

        value, along = jax.jvp(residuals, (z[:n],), (z[n + 1 :],))
        return jnp.concatenate([value, along, (normal @ z[n + 1 :] - 1.0)[None]])

    def newton(_: int, z: Array) -> Array:
        return z - eliminate(jax.jacfwd(equations)(z), equations(z))

    direction = begin.right[-1] * begin.columns
    z = jnp.concatenate([x, factor[None], direction / (normal @ direction)])
    z = jax.lax.fori_loop(0, _POLISHING_STEPS, newton, z)
    return z[:n], z[n], slopes_of(z[:n], balance, z[n])
