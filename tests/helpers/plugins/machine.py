"""A machine from outside the package: a rigid beam on two springs, which moves up and tilts."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.carrier import Carrier, Machine, Mount
from jaxvib.machine.numbers import read_numbers, unit


class Beam(Machine):
    """q = (y, tilt); the point at x along the beam from its centre of mass moves up by y + x tilt."""

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True))
    inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True))
    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, each="support"))
    span: Array = eqx.field(metadata=unit("m", each="support", typical=1.0))
    exciter: Array = eqx.field(metadata=unit("m", typical=0.1))
    kind: str = eqx.field(static=True)

    def __init__(self, mass, inertia, stiffness, span, exciter):
        given = read_numbers(Beam, "machine", mass=mass, inertia=inertia, exciter=exciter)
        self.mass, self.inertia, self.exciter = given.values()
        self.stiffness, self.span = read_numbers(Beam, "machine", 2, stiffness=stiffness, span=span).values()
        self.kind = "beam"

    def carrier(self):
        ends = jnp.stack([jnp.ones_like(self.span), self.span], axis=-1)
        forces, none = self.stiffness[:, None] * ends, jnp.zeros((2, 2))
        return Carrier(
            mass=jnp.diag(jnp.stack([self.mass, self.inertia])),
            damping=none,
            stiffness=ends.T @ forces,
            foundation_stiffness=jnp.sum(forces, axis=0)[None],
            foundation_damping=none[:1],
            coordinates=("y", "tilt"),
            coordinate_units=("m", "rad"),
        )

    def mount(self, at=None):
        return Mount(rows=(self.rows_at(at),), axes=(1,))

    def rows_at(self, place, name="place"):
        x = self.exciter if place is None else jnp.asarray(place)
        return jnp.stack([jnp.ones_like(x), x])[None]
