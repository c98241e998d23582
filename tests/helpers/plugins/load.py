"""Loads from outside the package with two coordinates: points that slide in a torus, drag about the axis only."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import count as read_count


class TorusPoints(Loads):
    """p = ((R + rho sin a) cos f, (R + rho sin a) sin f, -rho cos a), u = (f, a); drag b_W (R + rho)^2 (f' - speed)."""

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True, each="load"))
    radius: Array = eqx.field(metadata=unit("m", low=0.0, open_low=True))
    tube: Array = eqx.field(metadata=unit("m", low=0.0, open_low=True))
    drag: Array = eqx.field(metadata=unit("N s/m", low=0.0, each="load"))
    count: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(self, mass, radius, tube, drag, count):
        self.count, self.kind = read_count(count, "loads.count"), "torus_point"
        given = read_numbers(TorusPoints, "loads", self.count, mass=mass, radius=radius, tube=tube, drag=drag)
        self.mass, self.radius, self.tube, self.drag = given.values()

    def position(self, *u):
        f, a = u
        arm = self.radius + self.tube * jnp.sin(a)
        return arm * jnp.cos(f), arm * jnp.sin(f), -self.tube * jnp.cos(a)

    def rest(self):
        """The outer equator."""
        return jnp.full((self.count,), -0.5 * jnp.pi), jnp.full((self.count,), 0.5 * jnp.pi)

    def inertia_factor(self):
        return jnp.ones_like(self.mass)

    def resistance(self, u, rate, speed):
        return self.drag * (self.radius + self.tube) ** 2 * (speed - rate[0]), jnp.zeros_like(rate[1])
