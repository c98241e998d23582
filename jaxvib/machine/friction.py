"""The law of friction in a load's bearing, one for everything that turns on a bearing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

__all__ = ["bearing_torque", "sliding_sign"]


def sliding_sign(slip: Array, width: Array) -> Array:
    """The sign of sliding with a smooth passage through 0: tanh(slip / width), any shape; `slip`, `width` in rad/s.

    What it costs: a swing of amplitude A and frequency w loses a share (pi^2/24) (width/(A w))^2 less to dry friction than
    with the sharp sign, and what should stick creeps at `width` or slower.

    >>> [round(float(sliding_sign(x, 0.1)), 4) for x in (-1.0, 0.0, 0.05, 1.0)]
    [-1.0, 0.0, 0.4621, 1.0]
    """
    return jnp.tanh(slip / width)


def bearing_torque(
    slip: Array,
    *,
    viscous: Array,
    dry: Array | None = None,
    radial_load: Array | None = None,
    diameter: Array | None = None,
    width: Array | None = None,
) -> Array:
    """Torque of a bearing's friction on the part that slips, N m.

        M = - mu1 slip - mu2 |N| (d/2) sign(slip)

    **Arguments**: `slip` rad/s of the part that is braked against the other; `viscous` mu1, N m s; `dry` mu2, no unit, with
    `radial_load` N of the bearing in N, its `diameter` d in m, and `width` rad/s of `sliding_sign`; left out, there is no
    dry friction.

    >>> round(float(bearing_torque(2.0, viscous=1e-3, dry=0.0015, radial_load=100.0, diameter=0.02, width=1e-3)), 6)
    -0.0035

    Source: Artyunin, Sumenkov 2019, equations (1), (2).
    """
    torque = -viscous * slip
    if dry is not None:
        assert radial_load is not None and diameter is not None and width is not None
        torque = torque - dry * jnp.abs(radial_load) * diameter / 2.0 * sliding_sign(slip, width)
    return torque
