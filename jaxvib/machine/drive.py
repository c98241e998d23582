"""What turns the rotor."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.units import Number, number

__all__ = ["ConstantSpeed", "Drive", "SpinUp"]


class Drive(eqx.Module):
    """A drive gives the rotor's speed; `speed` is the one it works at."""

    speed: eqx.AbstractVar[Array]
    kind: eqx.AbstractVar[str]

    @abc.abstractmethod
    def speed_at(self, t: Array) -> Array:
        """The rotor's speed at time t (s), rad/s."""


class ConstantSpeed(Drive):
    """A rotor that turns at a constant speed whatever the loads do.

    **Arguments**: `speed` n, rad/s or a text such as "1500 rpm"; greater than 0.

    **Raises** `InputError` for a wrong unit or a speed that is not positive.

    >>> import jaxvib as jv
    >>> round(float(jv.ConstantSpeed("1500 rpm").speed), 3)
    157.08
    """

    speed: Array
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number):
        self.speed = number(speed, "rad/s", "drive.speed", low=0.0, open_low=True)
        self.kind = "constant_speed"

    def speed_at(self, t: Array) -> Array:
        """n at every t."""
        return self.speed


class SpinUp(Drive):
    """A rotor brought smoothly from rest to its working speed, then held there.

        speed(t) = n (10 x^3 - 15 x^4 + 6 x^5),  x = min(t / duration, 1)

    twice continuously differentiable, so that an integrator meets no kink.

    **Arguments**: `speed` n, rad/s or text, greater than 0; `duration` s or text, greater than 0.

    **Raises** `InputError` for a wrong unit or a value that is not positive.

    >>> import jaxvib as jv
    >>> drive = jv.SpinUp("100 rad/s", duration="4 s")
    >>> [float(drive.speed_at(t)) for t in (0.0, 2.0, 4.0, 9.0)]
    [0.0, 50.0, 100.0, 100.0]
    """

    speed: Array
    duration: Array
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number, duration: Number):
        self.speed = number(speed, "rad/s", "drive.speed", low=0.0, open_low=True)
        self.duration = number(duration, "s", "drive.duration", low=0.0, open_low=True)
        self.kind = "spin_up"

    def speed_at(self, t: Array) -> Array:
        """The smooth step from 0 to n."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        return self.speed * x**3 * (10.0 + x * (6.0 * x - 15.0))
