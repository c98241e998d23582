"""Motors that turn the shaft of the exciter by a belt or by gears."""

from __future__ import annotations

import equinox as eqx
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.drives.drive import INERTIA, Motor, MotorWrapper
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number


class BeltDrive(MotorWrapper):
    """Motor that turns the shaft of the exciter by a belt or by gears, without slip, elasticity and losses.

        r = speed of the motor / speed of the shaft
        T(t, theta') = r T_motor(t, r theta'),    I = shaft_inertia + r^2 I_motor

    The torque T and the inertia I are referred to the shaft, whose speed is theta'. Speeds of the results are those of the
    shaft.

    **Arguments** (SI, or strings with a unit)

    - `motor`, such as a `NamePlateMotor`, with the data of its own shaft; its `inertia` I_motor is that of its rotor and
      pulley. To switch it off use `SwitchedOff(BeltDrive(...), at)`
    - `ratio` r, greater than 0; the diameter of the pulley on the shaft divided by that of the pulley on the motor;
      typical: 1 to 3
    - `shaft_inertia` of the shaft of the exciter with its unbalance and pulley, kg m^2, greater than 0; typical: 0.05 to 2

    **Attributes**: the arguments; `speed` and `inertia`, referred to the shaft.

    **Raises** `InputError` for a wrong unit, a value that is not positive, and a motor of the wrong type.

    >>> import jaxvib as jv
    >>> motor = jv.NamePlateMotor("7.5 kW", "1450 rpm", breakdown_ratio=2.6, inertia=0.045)
    >>> drive = jv.BeltDrive(motor, ratio=1450 / 900, shaft_inertia=1.0)
    >>> shaft = 94.24778                             # 900 rpm, in rad/s
    >>> round(float(drive.torque(shaft)), 2), round(float(drive.torque(shaft) * shaft), 1)    # N m, W
    (79.58, 7500.0)
    >>> round(float(drive.inertia), 4)
    1.1168
    """

    motor: Motor
    ratio: Array = eqx.field(metadata=unit("", low=0.0, open_low=True, words="speed of the motor divided by that of the shaft"))
    shaft_inertia: Array = eqx.field(metadata=INERTIA)
    kind: str = eqx.field(static=True)

    def __init__(self, motor: Motor, ratio: Number, shaft_inertia: Number):
        if not isinstance(motor, Motor) or isinstance(motor, BeltDrive | SwitchedOff):
            needed = "it must be a motor, for example NamePlateMotor(...), without a belt and not switched off"
            raise InputError("drive.motor", f"is {quoted(motor)}; {needed}; SwitchedOff(BeltDrive(...), at) is allowed")
        self.motor, self.kind = motor, "belt_drive"
        self.ratio, self.shaft_inertia = read_numbers(BeltDrive, "drive", ratio=ratio, shaft_inertia=shaft_inertia).values()

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """No-load speed of the shaft, rad/s."""
        return self.motor.speed / self.ratio

    @property
    def largest_speed(self) -> Array:
        """Largest speed of the shaft, rad/s."""
        return self.motor.largest_speed / self.ratio

    @property
    def inertia(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Inertia of the shaft and of the motor, referred to the shaft."""
        return self.shaft_inertia + self.ratio**2 * self.motor.inertia

    def torque(self, speed: Array) -> Array:
        """Return the steady torque on the shaft at its `speed` (rad/s), N m."""
        return self.ratio * self.motor.torque(self.ratio * speed)

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque on the shaft at time `t` (s) and its `speed` (rad/s), N m."""
        return self.ratio * self.motor.torque_at(t, self.ratio * speed, states)

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the rates of the `states` of the motor at time `t` (s) and the `speed` of the shaft (rad/s)."""
        return self.motor.state_rates(t, self.ratio * speed, states)

    def supply_frequency(self) -> Array | None:
        """Return the angular frequency of the motor's supply, rad/s, if the torque depends on its phase; otherwise None."""
        return self.motor.supply_frequency()
