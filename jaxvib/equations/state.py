"""State of a scene, and its time derivative."""

from __future__ import annotations

import equinox as eqx
from jax import Array

__all__ = ["Spin", "State"]


class Spin(eqx.Module):
    """Free rotation of rolling loads, if effects release it (`FreeSpin`, `Sliding`); also the time derivative of one.

    **Attributes** (each is None if no effect releases it)

    - `drilling` (count,), rad/s: a load's spin about the normal of its contact, relative to its track
    - `slip`: a (count,) array, m/s, for each coordinate of a load: the velocity of its point of contact relative to the track
      along that coordinate

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> spin = jv.Spin(drilling=jnp.array([3.0, 3.0]), slip=None)
    >>> spin.drilling.shape
    (2,)
    """

    drilling: Array | None = None
    slip: tuple[Array, ...] | None = None


class State(eqx.Module):
    """Positions and velocities of all parts; also the time derivative of such a state.

    **Attributes**

    - `displacement` q (nd,), m, and `velocity` q' (nd,), m/s, of the carrier's coordinates; tilts in rad and rad/s; typical:
      0.1 to 10 mm
    - `angle` and `rate`: a tuple of (count,) arrays, one for each coordinate of a load: for loads on a circle ((phi_1, ...),)
      in rad and rad/s
    - `rotor`: the rotor's angle and speed, rad and rad/s, if a motor drives it; None under an ideal drive
    - `spin` of the loads if effects release it, see `Spin` and `with_spin`; otherwise None

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> state = jv.State(displacement=jnp.zeros(1), velocity=jnp.zeros(1), angle=(jnp.array([0.0, 0.1]),), rate=(jnp.zeros(2),))
    >>> state.azimuth.shape, state.rotor
    ((2,), None)
    """

    displacement: Array
    velocity: Array
    angle: tuple[Array, ...]
    rate: tuple[Array, ...]
    rotor: tuple[Array, Array] | None = None
    spin: Spin | None = None

    @property
    def azimuth(self) -> Array:
        """Angles of the loads about the rotor's axis, (..., count) rad: the first of their coordinates."""
        return self.angle[0]

    @property
    def azimuth_rate(self) -> Array:
        """Rates of the azimuths, (..., count) rad/s."""
        return self.rate[0]
