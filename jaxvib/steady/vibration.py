"""Vibration of a machine at one speed, with or without the samples of its whole motion, and its peaks."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import with_known_names
from jaxvib.numerics.extrema import sampled_maximum
from jaxvib.numerics.linalg import magnitude
from jaxvib.runtime.programs import cached
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


_PERIOD_SAMPLES = 1024
"""Number of samples of a period of an exact motion."""


@cached
def periodic_samples(orders: tuple[int, ...], speed: Array, displacement: Array, force: Array) -> Samples:
    """Return samples of two periods of a motion Re sum_k c_k exp(i k w t) of the `orders` k, with the `speed` w, rad/s, and the
    harmonics (nd, K) and (nb, K) of displacement and foundation force. Each peak of a period is then between other samples."""
    k, theta = np.asarray(orders), 2.0 * np.pi * np.arange(2 * _PERIOD_SAMPLES + 1) / _PERIOD_SAMPLES
    wave = jnp.asarray(np.exp(1j * np.outer(k, theta)), displacement.dtype)
    q, v, a = ((displacement * ((1j * k * speed) ** order)[None] @ wave).real.T for order in range(3))
    return Samples(jnp.asarray(theta) / speed, q, v, a, (force @ wave).real.T)


@with_known_names
class Vibration(NamedTuple):
    """Vibration of a machine at one speed of its exciters, q = Re(displacement exp(i w t)).

    Returned by `Run.vibration`, and by the same method of envelopes, synchronous regimes and responses.

    **Attributes** (nd coordinates)

    - `speed` w, rad/s
    - `displacement` (nd,): complex amplitudes, and `amplitude` (nd,), zero to peak, m (rad for rotations)
    - `foundation_force` and `exciter_force`, N zero to peak: force on the foundation, and resultant of the centrifugal forces
    - `torque` (exciter,), N m, and `power` (exciter,), W: means at the shaft of each drive; `power` is the mean of torque times
      speed, which differs from the product of the means if both vary within a turn
    - `samples` of the whole motion of a run or an exact jam, which has further frequencies; None for other motions
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
    """Largest extent of a path: `stroke`, m peak to peak, and its `direction`, rad from the first coordinate, above -pi/2 and
    at most pi/2; 0 for a circle, whose extent is the same in all directions."""

    stroke: Array
    direction: Array


_DIRECTIONS = 64
"""Number of directions in which the largest extent is searched for first."""

_SPACING = np.pi / _DIRECTIONS
"""Angle between neighbouring directions, rad."""

_DIRECTION_STEPS = 4
"""Steps of Newton's method from the best of these directions."""

_MIN_DIFFERENCE = 1e-3
"""Smallest relative difference between the widths in two directions of a path that is not a circle."""


def largest_extent(path: Array) -> Extent:
    """Return the largest extent, in any direction, of an evenly sampled path (nt, 2).

    The width of the path has a maximum in the direction of the extent. A change of the direction therefore has no influence on
    the derivatives of the stroke; those of the direction follow from the implicit function theorem. If the extents in several
    directions are equal, one of them is used.
    """
    known = jax.lax.stop_gradient(path)

    def width(direction: Array, path: Array) -> Array:
        return 2.0 * half_range(path @ jnp.stack([jnp.cos(direction), jnp.sin(direction)]))

    def improved(direction: Array, path: Array) -> Array:
        """Return the direction after a step of Newton's method."""
        one = jnp.ones_like(direction)
        slope, bend = jax.jvp(lambda a: jax.jvp(lambda b: width(b, path), (a,), (one,))[1], (direction,), (one,))
        bend = jax.lax.stop_gradient(bend)
        moves = has_axis & (bend < 0.0)
        change = jnp.where(moves, slope, 0.0) / jnp.where(moves, -bend, 1.0)
        return direction + jnp.clip(change, -_SPACING, _SPACING)

    angles = jnp.asarray(_SPACING * np.arange(1, _DIRECTIONS + 1) - 0.5 * np.pi, path.dtype)
    widths = jnp.ptp(known @ jnp.stack([jnp.cos(angles), jnp.sin(angles)]), axis=0)
    has_axis = jnp.min(widths) < (1.0 - _MIN_DIFFERENCE) * jnp.max(widths)
    best = angles[jnp.argmax(widths)]
    # A loop is compiled in a fraction of the time of its steps one after another. The last step carries the derivatives.
    found = jax.lax.fori_loop(0, _DIRECTION_STEPS - 1, lambda _, direction: improved(direction, known), best)
    direction = improved(jax.lax.stop_gradient(found), path)
    stroke = width(jax.lax.stop_gradient(direction), path)
    turned = jnp.where(has_axis, direction, 0.0)
    return Extent(stroke, 0.5 * jnp.arctan2(jnp.sin(2.0 * turned), jnp.cos(2.0 * turned)))


def _turn_weights(time: Array, speed: Array) -> Array:
    """Return weights (nt,) with the sum 1 for a mean value. They increase linearly over the first turn and decrease over the
    last one, so that the mean of a sine with the period of a turn does not depend on the end of the time interval."""
    time, speed = jax.lax.stop_gradient((time, speed))
    turn = jnp.minimum(2.0 * jnp.pi / jnp.abs(speed), 0.5 * (time[-1] - time[0]))
    weights = jnp.clip(jnp.minimum(time - time[0], time[-1] - time) / turn, 0.0, 1.0)
    return weights / jnp.sum(weights)
