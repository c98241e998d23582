"""Continuation of jam modes and folds to a slightly different machine by a few Newton steps."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.linear import JammedModel
from jaxvib.steady.jams.folds import branch_slope, rotor_speed_at
from jaxvib.steady.jams.jam import Jam, jam_at

_NEWTON_STEPS = 6
"""Number of Newton steps; the method converges quadratically from a similar machine. The result is NaN without convergence."""


def follow_jam(model: JammedModel, mode: int, near: Array) -> Jam:
    """Solve for the jam mode with number `mode` and a load speed near `near` (scalar, rad/s), at the scene's rotor speed n.

    Newton's method solves (n(w) - w)^(-1/2) = (n - w)^(-1/2), see `rotor_speed_at`. Near a resonance w_r the left side is
    almost proportional to |w - w_r|; a few steps are therefore sufficient even from a distant start. `jam_modes` computes the
    whole branch, which takes about fifty times as long, and determines the number of the mode. This function keeps the number;
    it does not detect that two modes have exchanged their numbers.

    **Returns** `Jam`, with NaN if the iteration has not converged, or has ended on a piece of the branch whose slope has the
    wrong sign. First derivatives are exact.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.equations.linear import jammed_model
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(follow_jam(jammed_model(form.scene()), 3, 0.95).omega), 4)
    0.9721
    """
    speed = model.scene.drive.speed
    frozen = jax.lax.stop_gradient(model)
    target = jax.lax.stop_gradient(speed)

    def residual(w: Array) -> Array:
        difference = rotor_speed_at(frozen, w) - w
        return jax.lax.rsqrt(jnp.maximum(difference, 1e-300)) - jax.lax.rsqrt(target - w)

    omega = _newton(residual, near, target)
    reached, slope = jax.jvp(lambda w: rotor_speed_at(frozen, w), (omega,), (jnp.ones_like(omega),))
    # A further Newton step does not change the root; differentiating it gives the derivatives of the root.
    omega = omega - (rotor_speed_at(model, omega) - speed) / slope
    converged = jnp.abs(reached - target) < 1e-9 * (target + jnp.abs(slope) * omega)
    is_valid = converged & (omega > 0.0) & (omega < target) & ((slope > 0.0) == (mode % 2 == 1))
    jam = jam_at(model, jnp.asarray(mode), jnp.where(is_valid, omega, jnp.nan), speed, jnp.asarray(False))
    return eqx.tree_at(lambda j: j.stable, jam, is_valid & jam.stable)


def follow_fold(model: JammedModel, near: Array) -> tuple[Array, Array]:
    """Solve for the fold near the load speed `near` (scalar, rad/s), see `Folds`.

    Newton's method solves n'(w)/(n(w) - w)^2 = 0, which is almost linear near a resonance.

    **Returns** the load speed and the rotor speed of the fold, rad/s, NaN without convergence. First derivatives are exact.
    The derivative of the rotor speed does not need that of the load speed, because the branch is flat at a fold.
    """
    frozen = jax.lax.stop_gradient(model)

    def scaled_slope(w: Array) -> Array:
        return branch_slope(frozen, w) / jnp.maximum(rotor_speed_at(frozen, w) - w, 1e-300) ** 2

    omega = _newton(scaled_slope, near, jnp.asarray(jnp.inf, near.dtype))
    slope, curvature = jax.jvp(lambda w: branch_slope(frozen, w), (omega,), (jnp.ones_like(omega),))
    omega = omega - branch_slope(model, omega) / curvature
    converged = jnp.abs(slope) < 1e-7 * jnp.abs(curvature * omega)
    omega = jnp.where(converged & (omega > 0.0), omega, jnp.nan)
    return omega, rotor_speed_at(model, omega)


def _newton(f: Callable[[Array], Array], start: Array, upper: Array) -> Array:
    """Return a root of `f` by Newton's method. The unknown stays below `upper`, and no Newton step changes it by more than a
    tenth of its value."""

    def step(_: int, w: Array) -> Array:
        value, slope = jax.jvp(f, (w,), (jnp.ones_like(w),))
        limit = 0.1 * w
        new = w - jnp.clip(jnp.nan_to_num(value / slope), -limit, limit)
        return jnp.where(new < upper, new, 0.5 * (w + upper))

    return jax.lax.stop_gradient(jax.lax.fori_loop(0, _NEWTON_STEPS, step, jax.lax.stop_gradient(start)))
