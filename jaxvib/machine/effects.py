"""Effects that a scene may call for. An effect that is not in the scene is not in the traced program."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.loads import Loads
from jaxvib.machine.units import Number, number

__all__ = ["Effect", "Gravity"]


class Effect(eqx.Module):
    """One effect says what it adds; a new effect is a new subclass."""

    kind: eqx.AbstractVar[str]

    @abc.abstractmethod
    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array:
        """Potential energy of each load, (count,) J."""

    def load_force(self, loads: Loads, u: tuple[Array, ...]) -> tuple[Array, ...]:
        """Generalised force on each load: minus the potential's derivative by automatic differentiation."""
        _, back = jax.vjp(lambda *v: self.load_potential(loads, v), *u)
        return tuple(-g for g in back(jnp.ones_like(u[0])))


class Gravity(Effect):
    """Gravity on the loads: V = m g p_up(u), so a load on a circle feels the torque - m g R cos phi.

    Platforms are counted from static equilibrium, loads' weight included, so that gravity adds nothing there.

    **Arguments**: `g` m/s^2.

    >>> import jaxvib as jv
    >>> float(jv.Gravity().g)
    9.81
    """

    g: Array
    kind: str = eqx.field(static=True)

    def __init__(self, g: Number = 9.81):
        self.g = number(g, "m/s^2", "effects.gravity.g", low=0.0)
        self.kind = "gravity"

    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array:
        """m g p_up(u)."""
        return loads.mass * self.g * loads.position(*u)[1]
