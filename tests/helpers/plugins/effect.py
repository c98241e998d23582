"""An effect from outside the package: friction in the loads' bearings that does not depend on their load (a seal's)."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import ContactFriction, Friction
from jaxvib.machine.numbers import read_numbers, unit


class SealFriction(Effect):
    """A torque `torque` tanh(slip / `width`), N m, of the rotor on each load, slip = the rotor speed less the load's."""

    torque: Array = eqx.field(metadata=unit("N m", low=0.0))
    width: Array = eqx.field(metadata=unit("rad/s", low=0.0, open_low=True))
    kind: str = eqx.field(static=True)

    def __init__(self, torque, width):
        self.torque, self.width = read_numbers(SealFriction, "effects.seal_friction", torque=torque, width=width).values()
        self.kind = "seal_friction"

    def terms(self):
        return (ContactFriction(self.friction, is_half_turn_symmetric=True),)

    def friction(self, loads, u, rate, speed, g):
        slip = speed - rate[0]
        return Friction(self.torque * jnp.tanh(slip / self.width), jnp.ones_like(slip), None)
