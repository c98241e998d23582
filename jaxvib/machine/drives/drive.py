"""Drives of the rotor: ideal drives with a prescribed speed, and motors of limited power."""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar, cast

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.units import Number

SPEED = unit("rad/s", low=0.0, open_low=True, words="rotor speed")
INERTIA = unit("kg m^2", low=0.0, open_low=True, words="moment of inertia of the rotor")

Rotor = tuple[Array, ...] | None
"""States of a rotor with a motor: its angle (rad), speed (rad/s) and further states of the motor; None for an ideal drive."""


class Drive(Part):
    """Drive of the rotor.

    **Attributes**

    - `speed`: working speed, for which steady states are computed, rad/s: the final speed of an ideal drive, the no-load speed
      of a motor; typical: 60 to 320 (600 to 3000 rpm)
    - `kind`: name of this kind of drive in scene files

    An `IdealDrive` prescribes the rotor speed. With a `Motor` the rotor's angle and speed are states.

    >>> import jaxvib as jv
    >>> drive = jv.SpinUp("100 rad/s", duration="4 s")
    >>> drive.ideal, drive.constant, float(drive.rotor_speed(2.0, None))
    (True, False, 50.0)
    """

    speed: eqx.AbstractVar[Array]
    kind: eqx.AbstractVar[str]

    ideal: ClassVar[bool]
    """True if the rotor speed is a function of time that no load changes."""

    constant: ClassVar[bool] = False
    """True if the rotor turns at `speed` from the start."""

    @property
    def largest_speed(self) -> Array:
        """Largest speed of the rotor during a run, rad/s, without vibrations of the speed; `speed` by default."""
        return self.speed

    @property
    def is_smooth(self) -> bool:
        """True if the torque of a motor has all derivatives, except at the times `jump_ts`."""
        return True

    @abc.abstractmethod
    def rotor_speed(self, t: Array, rotor: Rotor) -> Array:
        """Return the rotor speed, rad/s.

        **Arguments**: `t`, s; `rotor`: with a motor, angle (rad) and speed (rad/s) of the rotor from the state; else None.
        """

    @abc.abstractmethod
    def rotor_angle(self, t: Array, rotor: Rotor) -> Array:
        """Return the rotor's angle, rad.

        **Arguments**: `t`, s; `rotor`: with a motor, angle (rad) and speed (rad/s) of the rotor from the state; else None.
        """

    @abc.abstractmethod
    def rotor_acceleration(self, t: Array) -> Array | None:
        """Return the rotor's angular acceleration at time `t` (s), rad/s^2; None if it follows from torques."""

    @abc.abstractmethod
    def torque_and_inertia(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> tuple[Array, Array] | None:
        """Return two values at time `t` (s) and rotor `speed` (rad/s): the torque T (N m), and the rotor's inertia I (kg m^2).

        `states` are those of the motor, see `state_units`; without them T is the steady torque. Return None if no torque
        changes the speed.
        """

    def state_units(self) -> tuple[Array, ...]:
        """Return the typical magnitudes of the states of a motor other than the angle and the speed; () without such states."""
        return ()

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the time derivatives of the `states` of a motor at time `t` (s) and the rotor's `speed` (rad/s)."""
        return ()

    def supply_frequency(self) -> Array | None:
        """Return the angular frequency of the supply, rad/s, if the torque depends on its phase; otherwise None."""

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the times at which the acceleration jumps, which must be ends of steps."""
        return ()

    def settled(self) -> "Drive":
        """Return the drive in its final state: an ideal drive at its working speed, and a motor that is switched off at some
        time as one that is off from the start."""
        return self._with_changed_parts(lambda part: part.settled())

    def at_working_speed(self) -> "Drive":
        """Return the drive with the constant working speed in place of a prescribed speed, even if the rotor comes to rest."""
        return self._with_changed_parts(lambda part: part.at_working_speed())

    def _with_changed_parts(self, change: Callable[["Drive"], "Drive"]) -> "Drive":
        """Return the drive after a `change` of the drives that it contains, such as the reference of a converter."""
        names = [field.name for field in dataclasses.fields(self) if isinstance(getattr(self, field.name), Drive)]
        changed = [change(getattr(self, name)) for name in names]
        return eqx.tree_at(lambda drive: [getattr(drive, name) for name in names], self, changed) if names else self


class Directed(Drive):
    """Drive that turns its rotor in a direction: angles, speeds and torques are those of `drive` times `direction`. Everything
    else, including the attribute `speed`, is that of `drive`.

    `direction` is an array of 1 or -1, so that one compiled program serves both directions. None means clockwise;
    signs are then changed without a product.
    """

    drive: Drive
    direction: Array | None
    speed: Array
    kind: str = eqx.field(static=True)

    def __init__(self, drive: Drive, direction: Array | None = None):
        self.drive, self.direction, self.speed, self.kind = drive, direction, drive.speed, drive.kind

    def _directed(self, value: Array) -> Array:
        return -value if self.direction is None else self.direction * value

    def _undirected(self, rotor: Rotor) -> Rotor:
        return None if rotor is None else (self._directed(rotor[0]), self._directed(rotor[1]), *rotor[2:])

    @property
    def largest_speed(self) -> Array:
        return self.drive.largest_speed

    def rotor_speed(self, t: Array, rotor: Rotor) -> Array:
        return self._directed(self.drive.rotor_speed(t, self._undirected(rotor)))

    def rotor_angle(self, t: Array, rotor: Rotor) -> Array:
        return self._directed(self.drive.rotor_angle(t, self._undirected(rotor)))

    def rotor_acceleration(self, t: Array) -> Array | None:
        acceleration = self.drive.rotor_acceleration(t)
        return None if acceleration is None else self._directed(acceleration)

    def torque_and_inertia(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> tuple[Array, Array] | None:
        motor = self.drive.torque_and_inertia(t, self._directed(speed), states)
        return None if motor is None else (self._directed(motor[0]), motor[1])

    def state_units(self) -> tuple[Array, ...]:
        return self.drive.state_units()

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        return self.drive.state_rates(t, self._directed(speed), states)

    def jump_ts(self) -> tuple[Array, ...]:
        return self.drive.jump_ts()


class IdealDrive(Drive):
    """Drive that prescribes the rotor speed as a function of time. A new ideal drive is a subclass with the three methods
    `speed_at`, `angle_at` and `acceleration_at`.

    >>> import equinox as eqx, jax, jax.numpy as jnp, jaxvib as jv
    >>> class Approach(jv.IdealDrive):
    ...     '''speed(t) = n (1 - exp(-t/T)).'''
    ...
    ...     speed: jax.Array
    ...     time: jax.Array
    ...     kind: str = eqx.field(static=True, default="approach", kw_only=True)
    ...
    ...     def speed_at(self, t):
    ...         return self.speed * (1.0 - jnp.exp(-t / self.time))
    ...
    ...     def angle_at(self, t):
    ...         return self.speed * (t - self.time * (1.0 - jnp.exp(-t / self.time)))
    ...
    ...     def acceleration_at(self, t):
    ...         return self.speed / self.time * jnp.exp(-t / self.time)
    >>> drive = Approach(speed=jnp.asarray(100.0), time=jnp.asarray(2.0))
    >>> round(float(drive.rotor_speed(2.0, None)), 2)
    63.21
    """

    ideal = True

    @abc.abstractmethod
    def speed_at(self, t: Array) -> Array:
        """Return the rotor speed at time `t` (s), rad/s."""

    @abc.abstractmethod
    def angle_at(self, t: Array) -> Array:
        """Return the rotor's angle at time `t` (s), rad: the integral of its speed from 0."""

    @abc.abstractmethod
    def acceleration_at(self, t: Array) -> Array:
        """Return the rotor's angular acceleration at time `t` (s), rad/s^2."""

    def rotor_speed(self, t: Array, rotor: Rotor) -> Array:
        """Return `speed_at`."""
        return self.speed_at(t)

    def rotor_angle(self, t: Array, rotor: Rotor) -> Array:
        """Return `angle_at`."""
        return self.angle_at(t)

    def rotor_acceleration(self, t: Array) -> Array:
        """Return `acceleration_at`."""
        return self.acceleration_at(t)

    def torque_and_inertia(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> None:
        """Return None, because no torque changes the speed."""

    def settled(self) -> Drive:
        """Return `ConstantSpeed`."""
        return self.at_working_speed()

    def at_working_speed(self) -> Drive:
        """Return `ConstantSpeed`."""
        return self if self.constant else ConstantSpeed(cast(Array, self.speed))


class Motor(Drive):
    """Drive of limited power; the rotor's motion follows from its torque and the loads.

        I theta'' = T(theta') - torque of the loads on the rotor

    theta is the angle of the rotor and T the torque of the motor. I (`inertia`) is the moment of inertia of the whole rotor
    about its axis. It includes the unbalance of the rotor but not the loads; typical: 0.005 to 1 kg m^2.

    >>> import equinox as eqx, jax, jax.numpy as jnp, jaxvib as jv
    >>> class Turbine(jv.Motor):
    ...     '''T = stall_torque (1 - (theta'/speed)^2).'''
    ...
    ...     speed: jax.Array
    ...     stall_torque: jax.Array
    ...     inertia: jax.Array
    ...     kind: str = eqx.field(static=True, default="turbine", kw_only=True)
    ...
    ...     def torque(self, speed):
    ...         return self.stall_torque * (1.0 - (speed / self.speed) ** 2)
    >>> motor = Turbine(speed=jnp.asarray(300.0), stall_torque=jnp.asarray(2.0), inertia=jnp.asarray(0.01))
    >>> float(motor.torque(motor.speed / 2.0))
    1.5
    """

    ideal = False

    inertia: eqx.AbstractVar[Array]

    def rotor_speed(self, t: Array, rotor: Rotor) -> Array:
        """Return the speed in the state."""
        assert rotor is not None
        return rotor[1]

    def rotor_angle(self, t: Array, rotor: Rotor) -> Array:
        """Return the angle in the state."""
        assert rotor is not None
        return rotor[0]

    def rotor_acceleration(self, t: Array) -> None:
        """Return None, because the acceleration follows from the torques."""

    def torque_and_inertia(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> tuple[Array, Array]:
        """Return `torque_at` and `inertia`."""
        return self.torque_at(t, speed, states), self.inertia

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque at time `t` (s) and the rotor's `speed` (rad/s), N m.

        It is `torque`, unless the motor changes with time or has `states`.
        """
        return self.torque(speed)

    @abc.abstractmethod
    def torque(self, speed: Array) -> Array:
        """Return the steady torque T at the rotor's `speed` (rad/s), N m."""

    @property
    def dips(self) -> int:
        """Largest number of dips (local minima) of the torque below the no-load speed that `response` includes."""
        return 0

    def starting_torque(self) -> Array | None:
        """Return the torque at rest when a run begins, N m; None if it changes afterwards, such as that of a converter."""
        zero = jnp.zeros_like(self.speed)
        return self.torque_at(zero, zero)


class ConstantSpeed(IdealDrive):
    """Drive at a constant rotor speed, which the loads do not change.

        theta' = n,    theta the angle of the rotor

    **Arguments**: `speed` n, rad/s or a string such as "1500 rpm"; greater than 0; typical: 60 to 320 rad/s (600 to 3000 rpm).

    **Raises** `InputError` for a wrong unit or a speed that is not positive.

    >>> import jaxvib as jv
    >>> round(float(jv.ConstantSpeed("1500 rpm").speed), 3)
    157.08
    """

    constant = True

    speed: Array = eqx.field(metadata=SPEED)
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number):
        self.speed = read_numbers(ConstantSpeed, "drive", speed=speed)["speed"]
        self.kind = "constant_speed"

    def speed_at(self, t: Array) -> Array:
        """Return n."""
        return jnp.broadcast_to(self.speed, jnp.shape(t))

    def angle_at(self, t: Array) -> Array:
        """Return n t."""
        return self.speed * t

    def acceleration_at(self, t: Array) -> Array:
        """Return 0."""
        return jnp.zeros_like(self.speed, shape=jnp.shape(t))


class SpinUp(IdealDrive):
    """Smooth spin-up of the rotor from rest to its working speed, which is then constant.

        speed(t) = n (10 x^3 - 15 x^4 + 6 x^5),  x = min(t / duration, 1)

    The speed is twice continuously differentiable.

    **Arguments** (SI, or strings with a unit)

    - `speed`: working speed n, rad/s, greater than 0; typical: 60 to 320 (600 to 3000 rpm)
    - `duration` of the spin-up, s, greater than 0; typical: 1 to 20

    **Raises** `InputError` for a wrong unit or a value that is not positive.

    >>> import jaxvib as jv
    >>> drive = jv.SpinUp("100 rad/s", duration="4 s")
    >>> [float(drive.speed_at(t)) for t in (0.0, 2.0, 4.0, 9.0)]
    [0.0, 50.0, 100.0, 100.0]
    """

    speed: Array = eqx.field(metadata=SPEED)
    duration: Array = eqx.field(metadata=unit("s", low=0.0, open_low=True, words="duration of the spin-up"))
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number, duration: Number):
        self.speed, self.duration = read_numbers(SpinUp, "drive", speed=speed, duration=duration).values()
        self.kind = "spin_up"

    def speed_at(self, t: Array) -> Array:
        """Return the smooth step from 0 to n."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        return self.speed * x**3 * (10.0 + x * (6.0 * x - 15.0))

    def angle_at(self, t: Array) -> Array:
        """Return n duration (5 x^4/2 - 3 x^5 + x^6) during the spin-up; afterwards the angle grows with n."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        rise = self.duration * x**4 * (2.5 + x * (x - 3.0))
        return self.speed * (rise + jnp.maximum(t - self.duration, 0.0))

    def acceleration_at(self, t: Array) -> Array:
        """Return 30 n x^2 (1 - x)^2 / duration."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        return 30.0 * self.speed / self.duration * (x * (1.0 - x)) ** 2


class RunUp(IdealDrive):
    """Run-up of the rotor at a constant angular acceleration to its working speed, which is then constant.

        speed(t) = min(acceleration t, n)

    The acceleration jumps when the working speed is reached; `simulate` ends a step at that time.

    **Arguments** (SI, or strings with a unit)

    - `speed`: working speed n, rad/s, greater than 0; typical: 60 to 500 (600 to 4800 rpm)
    - `acceleration` during the run-up, rad/s^2, greater than 0; typical: 10 to 300. For braking use `SpeedProfile`

    **Raises** `InputError` for a wrong unit or a value that is not positive.

    >>> import jaxvib as jv
    >>> drive = jv.RunUp(460.0, acceleration=230.0)
    >>> [float(drive.speed_at(t)) for t in (0.0, 1.0, 2.0, 3.0)]
    [0.0, 230.0, 460.0, 460.0]

    Source: Artyunin 2013, section IV.
    """

    speed: Array = eqx.field(metadata=SPEED)
    acceleration: Array = eqx.field(metadata=unit("rad/s^2", low=0.0, open_low=True, words="acceleration of the run-up"))
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number, acceleration: Number):
        self.speed, self.acceleration = read_numbers(RunUp, "drive", speed=speed, acceleration=acceleration).values()
        self.kind = "run_up"

    def _end(self) -> Array:
        return self.speed / self.acceleration

    def speed_at(self, t: Array) -> Array:
        """Return min(acceleration t, n)."""
        return jnp.where(t < self._end(), self.acceleration * t, self.speed)

    def angle_at(self, t: Array) -> Array:
        """Return acceleration t^2 / 2 during the run-up; afterwards the angle grows with n."""
        end = self._end()
        return jnp.where(t < end, 0.5 * self.acceleration * t**2, self.speed * (t - 0.5 * end))

    def acceleration_at(self, t: Array) -> Array:
        """Return the acceleration of the run-up, 0 afterwards."""
        return jnp.where(t < self._end(), self.acceleration, 0.0)

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the time at which the working speed is reached."""
        return (self._end(),)


class DCMotor(Motor):
    """Direct-current motor, switched on at t = 0, whose torque falls linearly with the speed.

        T = stall_torque (1 - theta' / speed),    theta' the rotor speed

    **Arguments** (SI, or strings with a unit; all greater than 0)

    - `speed`: no-load speed, rad/s; typical: 100 to 320 (1000 to 3000 rpm)
    - `stall_torque`: torque at standstill, N m; typical: 1 to 50
    - `inertia` I of the whole rotor, kg m^2; typical: 0.005 to 0.5

    **Raises** `InputError` for a wrong unit or a value that is not positive.

    >>> import jaxvib as jv
    >>> motor = jv.DCMotor("3000 rpm", stall_torque=2.0, inertia=0.01)
    >>> round(float(motor.torque(motor.speed / 2.0)), 6)
    1.0
    """

    speed: Array = eqx.field(metadata=SPEED)
    stall_torque: Array = eqx.field(metadata=unit("N m", low=0.0, open_low=True, words="stall torque of the motor"))
    inertia: Array = eqx.field(metadata=INERTIA)
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number, stall_torque: Number, inertia: Number):
        given = {"speed": speed, "stall_torque": stall_torque, "inertia": inertia}
        self.speed, self.stall_torque, self.inertia = read_numbers(DCMotor, "drive", **given).values()
        self.kind = "dc_motor"

    def torque(self, speed: Array) -> Array:
        """Return the torque on the straight line from the stall torque to 0 at the no-load speed."""
        return self.stall_torque * (1.0 - speed / self.speed)


class InductionMotor(Motor):
    """Induction motor, switched on at t = 0, with Kloss's formula.

        T = 2 T_b s s_b / (s^2 + s_b^2),    s = 1 - theta' / speed,    theta' the rotor speed

    The torque is that at the shaft of the motor. For the friction of other bearings, such as those of a vibrator, subtract
    their torque and use a `TorqueTable`.

    **Arguments** (SI, or strings with a unit; all greater than 0)

    - `speed`: synchronous speed, rad/s; typical: "750 rpm", "1000 rpm", "1500 rpm" or "3000 rpm" on a grid of 50 Hz
    - `breakdown_torque` T_b, the largest torque, N m; typical: 2 to 3 times the rated torque, 8 to 250 for 0.5 to 15 kW at 1500
      rpm
    - `breakdown_slip` s_b, the slip at that torque, below 1; typical: 0.1 (large motors) to 0.4 (small motors)
    - `inertia` I of the whole rotor, kg m^2; typical: 0.005 to 0.5

    **Raises** `InputError` for a wrong unit or a value that is not allowed.

    >>> import jaxvib as jv
    >>> motor = jv.InductionMotor("3000 rpm", breakdown_torque=4.0, breakdown_slip=0.2, inertia=0.01)
    >>> round(float(motor.torque(0.8 * motor.speed)), 6)
    4.0

    Source: Kloss's formula for the steady torque; transients of the currents are neglected.
    """

    speed: Array = eqx.field(metadata=SPEED)
    breakdown_torque: Array = eqx.field(metadata=unit("N m", low=0.0, open_low=True, words="breakdown torque of the motor"))
    breakdown_slip: Array = eqx.field(
        metadata=unit("", low=0.0, open_low=True, high=1.0, open_high=True, words="breakdown slip of the motor")
    )
    inertia: Array = eqx.field(metadata=INERTIA)
    kind: str = eqx.field(static=True)

    def __init__(self, speed: Number, breakdown_torque: Number, breakdown_slip: Number, inertia: Number):
        given = {"speed": speed, "breakdown_torque": breakdown_torque, "breakdown_slip": breakdown_slip, "inertia": inertia}
        found = read_numbers(InductionMotor, "drive", **given)
        self.speed, self.breakdown_torque, self.breakdown_slip, self.inertia = found.values()
        self.kind = "induction_motor"

    def torque(self, speed: Array) -> Array:
        """Return the torque of Kloss's formula."""
        return kloss_torque(1.0 - speed / self.speed, self.breakdown_torque, self.breakdown_slip)


def kloss_torque(slip: Array, breakdown_torque: Array, breakdown_slip: Array) -> Array:
    """Return 2 T_b s s_b / (s^2 + s_b^2), N m."""
    return 2.0 * breakdown_torque * slip * breakdown_slip / (slip**2 + breakdown_slip**2)


class MotorWrapper(Motor):
    """Motor that changes the torque of another one, `motor`. Everything else is that of `motor`, except `supply_frequency`,
    which is None unless a subclass defines it."""

    motor: eqx.AbstractVar[Motor]

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.motor.speed

    @property
    def largest_speed(self) -> Array:
        return self.motor.largest_speed

    @property
    def is_smooth(self) -> bool:
        return self.motor.is_smooth

    @property
    def inertia(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.motor.inertia

    @property
    def dips(self) -> int:
        return self.motor.dips

    def state_units(self) -> tuple[Array, ...]:
        return self.motor.state_units()

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        return self.motor.state_rates(t, speed, states)

    def starting_torque(self) -> Array | None:
        return None if self.motor.starting_torque() is None else super().starting_torque()

    def jump_ts(self) -> tuple[Array, ...]:
        return self.motor.jump_ts()
