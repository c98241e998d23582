"""Least-squares fit of a bearing's friction to a recorded swing."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.runtime.programs import cached
from jaxvib.study.bearing.decrement import TurningPoints, period_stretch
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum, Friction, controller_to, swing_states

_MAX_ITERATIONS = 64

TOLERANCE = 1e-9
"""Relative error of a step of an integration in a fit."""


class Unknowns(NamedTuple):
    """Unknowns of a fit.

    **Attributes**: `angle` rad and `rate` rad/s at the first sample, measured from the rest position, which a constant torque
    shifts from the hanging position; `offset` rad: the recorded angle of the rest position; `frequency` rad/s of small swings;
    `friction`. With these unknowns, the estimate of the torque is nearly uncorrelated with the estimates of the others.
    """

    angle: Array
    rate: Array
    offset: Array
    frequency: Array
    friction: Friction


class Fit(NamedTuple):
    """Result of a fit with p unknowns and n samples.

    **Attributes**: the `unknowns`; their `covariance` (p, p), in the same order, from the Fisher information and the estimated
    noise, valid for white noise; `slopes` (n, p): derivatives of the fitted angles with respect to the unknowns; `residual`
    (n,), rad: fitted minus recorded angle; `noise`, rad: standard deviation of a sample; `stopped_at`, s from the first sample,
    NaN if the pendulum swings to the end; `converged`: True if the fit converged.
    """

    unknowns: Unknowns
    covariance: Array
    slopes: Array
    residual: Array
    noise: Array
    stopped_at: Array
    converged: Array


def first_guess(
    pendulum: BearingPendulum, record: Record, turns: TurningPoints, dry: bool, air: bool = False, torque: bool = False
) -> tuple[Unknowns, Array]:
    """Return the initial unknowns of a fit, from the turning points, and the smoothing width of dry friction, rad/s.

    **Arguments**: `dry`, `air`, `torque`: True if this part of the law is an unknown of the fit; the initial drag of the air
    and the initial torque are 0.

    In half a period, viscous friction reduces the amplitude by the share pi mu1/(2 J w), and dry friction with the torque T_f
    by the angle 2 T_f/(m g l). mu1, J, m, g and l are those of `BearingPendulum`; w is the frequency of small swings.
    """
    a = turns.amplitude
    stretch = period_stretch(a)
    w = math.pi * a.size / float(np.sum(np.diff(turns.time) / stretch))
    inertia, length = float(pendulum.total_inertia), float(pendulum.length)
    if dry and a.size > 3:
        (share, loss), *_ = np.linalg.lstsq(np.stack([a[:-1], np.ones(a.size - 1)], axis=1), a[:-1] - a[1:], rcond=None)
        share, loss = max(share, 0.0), max(loss, 0.0)
    else:
        weight = a**2 / np.sum(a**2)
        k = np.arange(a.size) - np.sum(weight * np.arange(a.size))
        share, loss = max(-float(np.sum(weight * k * np.log(a)) / np.sum(weight * k**2)), 0.0), 0.0
    offset = float(np.mean((turns.angle[:-2] + 2.0 * turns.angle[1:-1] + turns.angle[2:]) / 4.0))
    first = turns.angle[0] - offset
    phase = w / stretch[0] * (record.time[0] - turns.time[0])
    guess = Unknowns(
        angle=jnp.asarray(first * math.cos(phase)),
        rate=jnp.asarray(-first * w * math.sin(phase)),
        offset=jnp.asarray(offset),
        frequency=jnp.asarray(w),
        friction=Friction(
            viscous=jnp.asarray(2.0 * inertia * w * share / math.pi),
            dry=jnp.asarray(loss * length / float(pendulum.bearing)) if dry and pendulum.bearing is not None else None,
            air=jnp.asarray(0.0) if air else None,
            torque=jnp.asarray(0.0) if torque else None,
        ),
    )
    return guess, jnp.asarray(0.005 * w * float(np.min(a)))


def steps_for(start: Unknowns, time: Array | np.ndarray) -> int:
    """Return an upper bound of the number of integration steps.

    The bound is rounded up to a power of 2. Records of many different lengths then share a few compiled programs.
    """
    return 2 ** math.ceil(math.log2(4096 + 100.0 * float(jnp.max(start.frequency)) * float(np.max(time))))


@cached
def fit_swing(
    pendulum: BearingPendulum, time: Array, angle: Array, weight: Array, start: Unknowns, width: Array, max_steps: int
) -> Fit:
    """Return the least-squares fit of `identify`; `vmap` over records is supported.

    **Arguments**: `time` (n,), s, from 0; `angle` (n,), rad; `weight` (n,): 1 for samples that count and 0 for the others;
    `start`: initial unknowns; `width` of the smoothed dry friction, rad/s.
    """
    size = jnp.std(angle) * jnp.sqrt(2.0)
    inertia, length = pendulum.total_inertia, pendulum.length
    scale = _scale(pendulum, start, size, time[-1] - time[0])

    def states(at: Unknowns) -> tuple[Array, Array]:
        # Give the pendulum the gravity with which its small swings about the rest position have the trial frequency.
        stiffness, torque = at.frequency**2 * inertia, at.friction.torque
        rest = jnp.zeros(()) if torque is None else jnp.arctan(torque / stiffness)
        with_frequency = eqx.tree_at(lambda p: p.g, pendulum, stiffness / (jnp.cos(rest) * pendulum.mass * length))
        solver, adjoint = diffrax.Tsit5(), diffrax.ForwardMode()
        smooth = None if at.friction.dry is None else width
        run = swing_states(
            with_frequency,
            time,
            at.angle + rest,
            at.rate,
            at.friction,
            smooth,
            controller_to(TOLERANCE),
            solver,
            adjoint,
            max_steps,
        )
        return at.offset + run.angle - rest, run.stopped_at

    first, unravel = jax.flatten_util.ravel_pytree(start)
    unit, _ = jax.flatten_util.ravel_pytree(scale)

    def residual(x: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        fitted, stopped_at = states(unravel(first + unit * x))
        scaled_residual = jnp.where(weight > 0.0, fitted - angle, 0.0) / size
        return scaled_residual, (scaled_residual, stopped_at, fitted)

    x, scaled_residual, jacobian, rest, converged = _least_squares(residual, jnp.zeros_like(first), jnp.sum(weight))
    stopped_at, fitted = rest
    variance = jnp.sum((size * scaled_residual) ** 2) / (jnp.sum(weight) - first.shape[0])
    _, triangle = jnp.linalg.qr(size * jacobian)
    root = unit[:, None] * jnp.linalg.inv(triangle)
    covariance = variance * root @ root.T
    return Fit(
        unknowns=unravel(first + unit * x),
        covariance=covariance,
        slopes=size * jacobian / unit[None],
        residual=fitted - angle,
        noise=jnp.sqrt(variance),
        stopped_at=stopped_at,
        converged=converged & jnp.all(jnp.isfinite(covariance)),
    )


def _scale(pendulum: BearingPendulum, start: Unknowns, size: Array, duration: Array) -> Unknowns:
    """Return the typical size of each unknown, from the amplitude `size`, rad, and the `duration`, s, of the record."""
    inertia, law, rate = pendulum.total_inertia, start.friction, size * start.frequency
    return Unknowns(
        angle=size,
        rate=rate,
        offset=size,
        frequency=1.0 / duration,
        friction=Friction(
            viscous=inertia / duration,
            dry=None if law.dry is None else 2.0 * pendulum.length * size / (pendulum.diameter * start.frequency * duration),
            air=None if law.air is None else inertia / (rate * duration),
            torque=None if law.torque is None else inertia * start.frequency**2 * size,
        ),
    )


def _least_squares(
    residual: Callable[[Array], tuple[Array, tuple[Array, Array, Array]]], start: Array, n: Array
) -> tuple[Array, Array, Array, tuple[Array, Array], Array]:
    """Minimize the sum of squares of `residual`, of which `n` entries count, by the method of Levenberg and Marquardt.

    The integration appears only once in the program, because its compilation takes long. The iteration ends if the next
    undamped (Gauss-Newton) step is below 0.01 standard errors. The fit counts as converged if that step is below 0.1 standard
    errors, because the time steps of the integration limit the resolution. The code compares the squares, 1e-4 and 1e-2.

    A trial step below 0.001 standard errors is accepted even if the sum of squares increases: only the error of the integration
    causes such an increase. At a reversal of the dry friction this error may make a sum of squares too small. Without this
    rule, no later trial would be accepted, and the iteration would end there.

    **Returns** x (p,), the residual (n,), its Jacobian (n, p), the other two outputs of `residual` (`stopped_at` and the fitted
    angles (n,)), and True if the fit converged.
    """
    jacobian_of = jax.jacfwd(residual, has_aux=True)
    size, p = jax.eval_shape(residual, start)[0].shape[0], start.shape[0]
    floor = n * (0.01 * TOLERANCE) ** 2

    def is_unfinished(carry: tuple[Array, ...]) -> Array:
        return (carry[0] < _MAX_ITERATIONS) & (carry[-1] > 1e-4) & (carry[2] < 1e6)

    def step(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        count, trial, damping, length_squared, *best, _ = carry
        jacobian, (scaled_residual, stopped_at, fitted) = jacobian_of(trial)
        cost = jnp.sum(scaled_residual**2)
        better = (cost < best[0]) | ((length_squared < 1e-6) & jnp.isfinite(cost))
        latest = (cost, trial, scaled_residual, jacobian, stopped_at, fitted)
        best = [jnp.where(better, new, old) for new, old in zip(latest, best, strict=True)]
        damping = jnp.where(better, 0.1 * damping, 10.0 * damping)
        cost, x, scaled_residual, jacobian, *_ = best
        basis, triangle = jnp.linalg.qr(jacobian)
        projected = basis.T @ scaled_residual
        normal = triangle.T @ triangle
        damped = normal + damping * jnp.diag(jnp.diagonal(normal))
        change = jnp.linalg.solve(damped, triangle.T @ projected)
        variance = cost / (n - p) + floor
        # Squares of the lengths, in standard errors, of the damped and of the undamped step from the best point so far.
        length_squared, next_step_squared = jnp.sum((triangle @ change) ** 2) / variance, jnp.sum(projected**2) / variance
        return count + 1, x - change, damping, length_squared, *best, next_step_squared

    no_best = (jnp.asarray(jnp.inf), start, jnp.zeros(size), jnp.zeros((size, p)), jnp.asarray(jnp.nan), jnp.zeros(size))
    infinite = jnp.asarray(jnp.inf)
    end = jax.lax.while_loop(is_unfinished, step, (jnp.asarray(0), start, jnp.asarray(0.1), infinite, *no_best, infinite))
    return end[5], end[6], end[7], (end[8], end[9]), end[-1] < 1e-2
