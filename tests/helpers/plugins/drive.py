"""A drive from outside the package: a motor whose torque falls with the square of its speed."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.drives.drive import Motor


class Turbine(Motor):
    """T = `stall_torque` (1 - (theta' / speed)^2)."""

    speed: Array
    stall_torque: Array
    inertia: Array
    kind: str = eqx.field(static=True)

    def __init__(self, speed, stall_torque, inertia):
        self.speed, self.stall_torque, self.inertia = (jnp.asarray(x) for x in (speed, stall_torque, inertia))
        self.kind = "turbine"

    def torque(self, speed):
        return self.stall_torque * (1.0 - (speed / self.speed) ** 2)
