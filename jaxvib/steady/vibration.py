"""Vibration of a machine at one speed, with or without the samples of its whole motion, and its peaks."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.extrema import sampled_maximum
from jaxvib.numerics.linalg import magnitude
from jaxvib.units.reading import STANDARD_GRAVITY


class Samples(NamedTuple):
    """Motion at nt evenly spaced times.

    **Attributes**: `time` (nt,), s; `displacement`, m (rad for rotations), `velocity` and `acceleration` (nt, nd);
    `foundation_force` (nt, nb), N.
    """

    time: Array
    displacement: Array
    velocity: Array
    acceleration: Array
    foundation_force: Array


class Vibration(NamedTuple):
    """Vibration of a machine at one speed of its exciters, q = Re(displacement exp(i w t)).

    Returned by `Run.vibration`, and by the same method of envelopes, synchronous regimes and responses.

    **Attributes** (nd coordinates)

    - `speed` w, rad/s
    - `displacement` (nd,): complex amplitudes, and `amplitude` (nd,), zero to peak, m (rad for rotations)
    - `foundation_force` and `exciter_force`, N zero to peak: force on the foundation, and resultant of the centrifugal forces
    - `torque` (exciter,), N m, and `power` (exciter,), W: means at the shaft of each drive; `power` is the mean of torque times
      speed, which differs from the product of the means if both vary within a turn
    - `samples` of the whole motion of a run, which may have further frequencies; None for other motions
    """

    speed: Array
    displacement: Array
    amplitude: Array
    foundation_force: Array
    exciter_force: Array
    torque: Array
    power: Array
    samples: Samples | None = None


def acceleration_of(amplitude: Array, speed: Array | float) -> Array:
    """Return the amplitude of the acceleration, in g, of a sine of `amplitude`, m zero to peak, and `speed`, rad/s."""
    return speed**2 * amplitude / STANDARD_GRAVITY


def rms_velocity_of(amplitude: Array, speed: Array | float) -> Array:
    """Return the root mean square of the velocity, m/s, of a sine of `amplitude`, m zero to peak, and `speed`, rad/s."""
    return speed * amplitude / np.sqrt(2.0)


def peak_acceleration(motion: Vibration) -> Array:
    """Return the largest magnitude of the acceleration of each coordinate (nd,), in g."""
    if motion.samples is None:
        return acceleration_of(motion.amplitude, motion.speed)
    return sampled_maximum(jnp.abs(motion.samples.acceleration), axis=0) / STANDARD_GRAVITY


def rms_velocity(motion: Vibration) -> Array:
    """Return the root mean square of the velocity of each coordinate (nd,), m/s."""
    if motion.samples is None:
        return rms_velocity_of(motion.amplitude, jnp.abs(motion.speed))
    square = _turn_weights(motion.samples.time, motion.speed) @ motion.samples.velocity**2
    moves = square > 0.0  # the square root has no derivative at 0
    return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), square)


def peak_forces(stiffness: Array, damping: Array, displacement: Array, speed: Array, samples: Samples | None) -> Array:
    """Return the forces (...) of rows (..., nd) of stiffness and damping, N zero to peak, of the `samples`, or without them of
    the complex amplitudes `displacement` at a positive `speed`."""
    if samples is None:
        return magnitude((stiffness + 1j * speed * damping) @ displacement)
    forces = jnp.tensordot(samples.displacement, stiffness, (1, -1)) + jnp.tensordot(samples.velocity, damping, (1, -1))
    return half_range(forces)


def half_range(values: Array) -> Array:
    """Return half of the difference between the largest and the smallest value of evenly sampled functions (nt, ...)."""
    above = values - jnp.min(values, axis=0, keepdims=True)
    return sampled_maximum(sampled_maximum(above, axis=0)[None] - above, axis=0) / 2.0


class Extent(NamedTuple):
    """Largest extent of a path: `stroke`, m peak to peak, and its `direction`, rad from the first coordinate, above -pi/2 and at
    most pi/2; 0 for a circle, whose extent is the same in all directions."""

    stroke: Array
    direction: Array


_DIRECTIONS = 64
"""Number of directions in which the largest extent is searched for first."""

_SPACING = np.pi / _DIRECTIONS
"""Angle between neighbouring directions, rad."""

_DIRECTION_STEPS = 4
"""Steps of Newton's method from the best of these directions."""


def largest_extent(path: Array) -> Extent:
    """Return the largest extent, in any direction, of an evenly sampled path (nt, 2).

    The width of the path has a maximum in the direction of the extent. A change of the direction therefore has no influence on
    the derivatives of the stroke; those of the direction follow from the implicit function theorem. If the extents in several
    directions are equal, one of them is used.
    """

    def width(direction: Array) -> Array:
        return 2.0 * half_range(path @ jnp.stack([jnp.cos(direction), jnp.sin(direction)]))

    def improved(direction: Array) -> Array:
        bend, size = jax.lax.stop_gradient((jax.grad(jax.grad(width))(direction), width(direction)))
        is_maximum = -bend > max(1e-9, 64.0 * float(jnp.finfo(path.dtype).eps)) * size
        change = jax.grad(width)(direction) / jnp.where(is_maximum, -bend, 1.0)
        return jnp.where(is_maximum, direction + jnp.clip(change, -_SPACING, _SPACING), 0.0)

    angles = jnp.asarray(_SPACING * np.arange(1, _DIRECTIONS + 1) - 0.5 * np.pi, path.dtype)
    widths = jnp.ptp(jax.lax.stop_gradient(path) @ jnp.stack([jnp.cos(angles), jnp.sin(angles)]), axis=0)
    direction = angles[jnp.argmax(widths)]
    for _ in range(_DIRECTION_STEPS):
        direction = improved(jax.lax.stop_gradient(direction))
    stroke = width(jax.lax.stop_gradient(direction))
    return Extent(stroke, 0.5 * jnp.arctan2(jnp.sin(2.0 * direction), jnp.cos(2.0 * direction)))


def _turn_weights(time: Array, speed: Array) -> Array:
    """Return weights (nt,) with the sum 1 for a mean value. They increase linearly over the first turn and decrease over the
    last one, so that the mean of a sine with the period of a turn does not depend on the end of the time interval."""
    time, speed = jax.lax.stop_gradient((time, speed))
    turn = jnp.minimum(2.0 * jnp.pi / jnp.abs(speed), 0.5 * (time[-1] - time[0]))
    weights = jnp.clip(jnp.minimum(time - time[0], time[-1] - time) / turn, 0.0, 1.0)
    return weights / jnp.sum(weights)
