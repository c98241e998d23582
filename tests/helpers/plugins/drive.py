"""A drive from outside the package: a motor whose torque falls with the square of its speed."""

import equinox as eqx
from jax import Array

from jaxvib.machine.drives.drive import Motor
from jaxvib.machine.numbers import read_numbers, unit


class Turbine(Motor):
    """T = `stall_torque` (1 - (theta' / speed)^2)."""

    speed: Array = eqx.field(metadata=unit("rad/s", low=0.0, open_low=True))
    stall_torque: Array = eqx.field(metadata=unit("N m", low=0.0, open_low=True))
    inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True))
    kind: str = eqx.field(static=True)

    def __init__(self, speed, stall_torque, inertia):
        given = read_numbers(Turbine, "drive", speed=speed, stall_torque=stall_torque, inertia=inertia)
        self.speed, self.stall_torque, self.inertia = given.values()
        self.kind = "turbine"

    def torque(self, speed):
        return self.stall_torque * (1.0 - (speed / self.speed) ** 2)
