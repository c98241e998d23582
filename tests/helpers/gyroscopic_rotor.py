"""A machine that moves across and up and has a gyroscopic matrix, made of matrices alone."""

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxvib as jv


class Rotor(jv.Machine):
    """A rotor on two springs that moves across and up and tilts; G couples the two tilts."""

    stiffness: jax.Array
    polar: jax.Array
    kind: str = eqx.field(static=True)

    def carrier(self):
        plane = jnp.array([[1.0, 0.1], [0.1, 0.05]])
        return jv.Carrier(
            mass=jnp.diag(jnp.array([37.0, 37.0, 0.479, 0.479])),
            damping=jnp.kron(plane, jnp.eye(2)) * 300.0,
            stiffness=jnp.kron(plane, jnp.diag(self.stiffness)),
            foundation_stiffness=jnp.zeros((2, 4)),
            foundation_damping=jnp.zeros((2, 4)),
            coordinates=("y", "z", "theta", "psi"),
            coordinate_units=("m", "m", "rad", "rad"),
        )

    def mount(self, at=None):
        skew = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
        return jv.Mount(
            rows=(jnp.array([[1.0, 0.0, 0.2, 0.0], [0.0, 1.0, 0.0, 0.2]]),),
            axes=(0, 1),
            gyroscopic=jnp.kron(jnp.diag(jnp.array([0.0, 1.0])), skew) * self.polar,
        )


def rotor(polar, stiffness=(1.1e6, 1.1e6), mass=0.2):
    machine = Rotor(stiffness=jnp.asarray(stiffness), polar=jnp.asarray(polar), kind="rotor")
    return jv.Scene(machine, jv.balls(count=2, mass=mass, radius=0.08, drag=5.0), jv.ConstantSpeed(460.0))
