"""Drives that follow tables or controllers: speed profiles, torque tables, converters, speed control."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError, counted, quoted
from jaxvib.machine.drives.drive import INERTIA, Drive, IdealDrive, Motor, MotorWrapper
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number, Numbers
from jaxvib.units.known import require_if_known, when_known

_MAX_DIPS = 4
"""Largest number of dips (local minima) of a torque table that a response includes. Each of them takes as much computing time
as an additional coordinate."""


class TorqueTable(Motor):
    """Motor, switched on at t = 0, with a measured or catalogued torque as a function of its speed.

    The torque follows straight lines between the points. The first and the last line continue beyond them. In
    a scene file, `file = "torque.csv"` replaces the two lists: a CSV file with two columns, whose header states their units,
    such as "speed (rpm);torque (N m)". The friction of bearings and belts between the motor and the unbalance can be included:
    subtract its torque from the torques.

    **Arguments** (SI, or strings with a unit)

    - `speeds` of the points, rad/s, ascending or descending, at least 2; typical: ["0 rpm", "1000 rpm", "1500 rpm"]
    - `torques` at these speeds, N m: the first must be positive, the last 0 or negative and not above the one before it;
      typical: -10 to 200
    - `inertia` I of the whole rotor, kg m^2; typical: 0.005 to 0.5

    **Attributes**: the arguments; the no-load `speed`, the largest speed at which the torque falls to 0.

    **Raises** `InputError` for a wrong unit, for speeds in no order, for torques that do not fall to 0, and for torques
    that rise at the end.

    >>> import jaxvib as jv
    >>> motor = jv.TorqueTable([0.0, 100.0, 160.0], ["10 N m", "20 N m", "-4 N m"], inertia=0.02)
    >>> float(motor.speed), float(motor.torque(50.0)), float(motor.torque(170.0))
    (150.0, 15.0, -8.0)
    """

    speeds: Array = eqx.field(metadata=unit("rad/s", low=0.0, words="speed of the torque table", each="point"))
    torques: Array = eqx.field(metadata=unit("N m", words="torque of the torque table", each="point", typical=10.0))
    inertia: Array = eqx.field(metadata=INERTIA)
    kind: str = eqx.field(static=True)

    def __init__(self, speeds: Numbers, torques: Numbers, inertia: Number):
        self.speeds, self.torques = _points(TorqueTable, speeds=speeds, torques=torques)
        self.inertia = read_numbers(TorqueTable, "drive", inertia=inertia)["inertia"]
        self.kind = "torque_table"
        problem = "must begin with a positive torque and end with 0 or a negative one, at the no-load speed of the motor"
        require_if_known(lambda torques: torques[0] > 0.0 >= torques[-1], self.torques, field="drive.torques", problem=problem)
        problem = "rise at the end, and the last line leads to positive torques; repeat the last torque at a higher speed"
        require_if_known(lambda torques: torques[-1] <= torques[-2], self.torques, field="drive.torques", problem=problem)

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """No-load speed: the last one at which the torque becomes 0, rad/s."""
        torque, after = self.torques[:-1], self.torques[1:]
        is_zero = (torque > 0.0) & (after <= 0.0)  # within the segment
        share = torque / jnp.where(is_zero, torque - after, 1.0)
        return jnp.max(jnp.where(is_zero, self.speeds[:-1] + jnp.diff(self.speeds) * share, 0.0))

    @property
    def is_smooth(self) -> bool:
        """False: the slope of the torque jumps at each point."""
        return False

    @property
    def dips(self) -> int:
        """Largest possible number of dips (local minima) of the torque, at most 4: each needs two points between the first and
        the last point."""
        return min((self.speeds.shape[0] - 2) // 2, _MAX_DIPS)

    def torque(self, speed: Array) -> Array:
        """Return the torque by linear interpolation between the points, and extrapolation beyond them."""
        inner, infinite = self.speeds[1:-1], np.full(1, np.inf, self.speeds.dtype)
        low, high = jnp.concatenate([-infinite, inner]), jnp.concatenate([inner, infinite])
        slopes = jnp.diff(self.torques) / jnp.diff(self.speeds)
        rise = jnp.clip(jnp.asarray(speed)[..., None], low, high) - self.speeds[:-1]
        return self.torques[0] + jnp.sum(slopes * rise, axis=-1)


def _points(part: type[eqx.Module], **lists: Numbers) -> list[Array]:
    """Return the lists of a table of points as arrays.

    **Raises** `InputError` if the first list has fewer than 2 values or does not ascend (the speeds of a torque table may also
    descend; the lists are then reversed), and for lists of another length.
    """
    (first, *others), (name, *names) = (found := read_numbers(part, "drive", **lists)).values(), found
    n = np.size(first)
    if np.ndim(first) != 1 or n < 2:
        raise InputError(f"drive.{name}", f"has {counted(n)}; a list of at least 2 is needed")
    for other, values in zip(names, others, strict=True):
        if np.shape(values) != (n,):
            raise InputError(f"drive.{other}", f"has {counted(np.size(values))}; {n} are needed, one for each of the {name}")
    may_descend = part is TorqueTable
    if may_descend and when_known(lambda known: bool(np.all(np.diff(known) < 0.0)), first):
        return [values[::-1] for values in (first, *others)]
    when_known(lambda known: _require_ascending(known, name, may_descend), first)
    return [first, *others]


def _require_ascending(values: np.ndarray, name: str, may_descend: bool) -> None:
    steps = np.diff(values)
    if may_descend and steps[0] < 0.0:
        steps = -steps
    if np.any(steps <= 0.0):
        k = int(np.argmax(steps <= 0.0)) + 1
        order = "ascending or descending order" if may_descend else "ascending order"
        raise InputError(f"drive.{name}[{k}]", f"is {values[k]:g} after {values[k - 1]:g}; list the {name} in {order}")


_at_each_time = partial(jnp.vectorize, excluded=(0,))
"""Decorator of methods of a single time, which then accept arrays of times."""


class SpeedProfile(IdealDrive):
    """Drive that prescribes the rotor speed at several times, with constant accelerations between them.

    The speed before the first time is the first speed, and the speed after the last time is the last one. The acceleration
    jumps at each of the `times`; `simulate` therefore ends a step there.

    **Arguments** (SI, or strings with a unit)

    - `times` of the points, s, in ascending order, at least 2; typical: [0, 5, 60, 70]
    - `speeds` at these times, rad/s, at least 0; typical: ["0 rpm", "1500 rpm", "1500 rpm", "0 rpm"]

    **Attributes**: the arguments; the working speed `speed`, which is the last one, or the largest if the rotor comes to rest.

    **Raises** `InputError` for a wrong unit, times that do not ascend, and a rotor that never turns.

    >>> import jaxvib as jv
    >>> drive = jv.SpeedProfile([0.0, 2.0, 6.0, 8.0], [0.0, 100.0, 100.0, 0.0])
    >>> [float(drive.speed_at(t)) for t in (1.0, 4.0, 7.0, 9.0)], float(drive.angle_at(9.0))
    ([50.0, 100.0, 50.0, 0.0], 600.0)
    """

    times: Array = eqx.field(metadata=unit("s", low=0.0, words="time of the speed profile", each="point"))
    speeds: Array = eqx.field(metadata=unit("rad/s", low=0.0, words="speed of the speed profile", each="point"))
    kind: str = eqx.field(static=True)

    def __init__(self, times: Numbers, speeds: Numbers):
        self.times, self.speeds = _points(SpeedProfile, times=times, speeds=speeds)
        self.kind = "speed_profile"
        problem = "are all 0; at least one must be greater than 0"
        require_if_known(lambda speeds: np.any(speeds > 0.0), self.speeds, field="drive.speeds", problem=problem)

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Working speed: the last one, or the largest if the rotor comes to rest, rad/s."""
        return jnp.where(self.speeds[-1] > 0.0, self.speeds[-1], jnp.max(self.speeds))

    @property
    def largest_speed(self) -> Array:
        """Largest speed of the points, rad/s."""
        return jnp.max(self.speeds)

    def _elapsed(self, t: Array) -> tuple[Array, Array]:
        """Return the time spent in each segment until `t`, and the acceleration in it."""
        lengths = jnp.diff(self.times)
        return jnp.clip(t - self.times[:-1], 0.0, lengths), jnp.diff(self.speeds) / lengths

    @_at_each_time
    def speed_at(self, t: Array) -> Array:
        """Return the speed by linear interpolation between the points."""
        elapsed, acceleration = self._elapsed(t)
        return self.speeds[0] + jnp.sum(acceleration * elapsed)

    @_at_each_time
    def angle_at(self, t: Array) -> Array:
        """Return the angle: the sum of v T + a T^2 / 2 over the segments, plus the angles before and after them."""
        elapsed, acceleration = self._elapsed(t)
        within = jnp.sum(elapsed * (self.speeds[:-1] + 0.5 * acceleration * elapsed))
        before, after = jnp.minimum(t, self.times[0]), jnp.maximum(t - self.times[-1], 0.0)
        return within + self.speeds[0] * before + self.speeds[-1] * after

    @_at_each_time
    def acceleration_at(self, t: Array) -> Array:
        """Return the acceleration of the segment, 0 before the first and after the last time."""
        _, acceleration = self._elapsed(t)
        return jnp.sum(jnp.where((t >= self.times[:-1]) & (t < self.times[1:]), acceleration, 0.0))

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the times of the points."""
        return tuple(self.times)

    def settled(self) -> Drive:
        """Return `ConstantSpeed` at the last speed. **Raises** `InputError` if the rotor comes to rest."""
        problem = "end at 0, so there is no steady motion; use simulate, or a profile whose last speed is greater than 0"
        require_if_known(lambda speeds: speeds[-1] != 0.0, self.speeds, field="drive.speeds", problem=problem)
        return self.at_working_speed()


class SwitchedOff(MotorWrapper):
    """Motor that is switched off at a time and then turns with the friction of its bearings only.

        T = torque of the motor  (t < at),    T = -bearing theta'  (t >= at),    theta' the rotor speed

    `simulate` ends a step at the time `at`. In analyses of steady motions the motor is off: `torque` is the friction. States of
    the motor, such as currents, have no effect and no meaning after that time.

    **Arguments** (SI, or strings with a unit)

    - `motor` before that time, such as an `InductionMotor`
    - `at`: time at which it is switched off, s, at least 0 (the default: off from the start); typical: 0 to 60
    - `bearing` b, N m s: viscous friction of bearings and belts, at least 0; typical: 0.001 to 0.1

    **Raises** `InputError` for a wrong unit, a negative value, and a motor of the wrong type.

    >>> import jaxvib as jv
    >>> motor = jv.DCMotor("3000 rpm", stall_torque=2.0, inertia=0.01)
    >>> off = jv.SwitchedOff(motor, at="10 s", bearing=0.01)
    >>> [round(float(off.torque_at(t, 50.0)), 3) for t in (9.0, 11.0)]
    [1.682, -0.5]
    """

    motor: Motor
    at: Array = eqx.field(metadata=unit("s", low=0.0, words="time at which the motor is switched off"))
    bearing: Array = eqx.field(metadata=unit("N m s", low=0.0, words="friction of the bearings"))
    kind: str = eqx.field(static=True)

    def __init__(self, motor: Motor, at: Number = 0.0, bearing: Number = 0.0):
        if not isinstance(motor, Motor) or isinstance(motor, SwitchedOff):
            raise InputError(
                "drive.motor",
                f"is {quoted(motor)}; it must be a motor that is not switched off already, for example InductionMotor(...)",
            )
        self.motor, self.kind = motor, "switched_off"
        self.at, self.bearing = read_numbers(SwitchedOff, "drive", at=at, bearing=bearing).values()

    def torque(self, speed: Array) -> Array:
        """Return the friction of the bearings."""
        return -self.bearing * speed

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque of the motor at `speed` before the time `at`, afterwards the friction of the bearings."""
        return jnp.where(t < self.at, self.motor.torque_at(t, speed, states), self.torque(speed))

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the time at which the motor is switched off, and the times of the motor's jumps."""
        return (self.at, *self.motor.jump_ts())

    def settled(self) -> Drive:
        """Return the motor, switched off from the start."""
        return eqx.tree_at(lambda drive: drive.at, self, jnp.zeros_like(self.at))


class Converter(MotorWrapper):
    """Motor on a frequency or voltage converter, which varies the motor's no-load speed over time.

        T(t, theta') = T_motor(theta' + n_motor - n(t))

    theta' is the rotor speed, and n_motor the no-load speed of the motor without the converter (`motor.speed`). The converter
    shifts the torque curve of the motor along the speed axis, so that the torque is 0 at the speed n(t). This is exact for a
    `DCMotor` whose voltage is changed, and for Kloss's formula at constant flux (voltage in proportion to the frequency).

    **Arguments**

    - `motor` without states (such as currents) and without switching times, such as an `InductionMotor`; not another converter
    - `reference` n(t): an ideal drive, such as a `RunUp`, a `SpinUp` or a `SpeedProfile`

    **Raises** `InputError` for a motor or a reference of the wrong type.

    >>> import jaxvib as jv
    >>> motor = jv.InductionMotor("1500 rpm", breakdown_torque=70.0, breakdown_slip=0.2, inertia=0.02)
    >>> ramp = jv.Converter(motor, jv.RunUp("1500 rpm", acceleration=50.0))
    >>> round(float(ramp.torque_at(1.0, 50.0)), 6), round(float(ramp.torque_at(1.0, 50.0 - 31.41592653589793)), 6)
    (0.0, 70.0)
    """

    motor: Motor
    reference: IdealDrive
    kind: str = eqx.field(static=True)

    def __init__(self, motor: Motor, reference: IdealDrive):
        if not isinstance(motor, Motor) or motor.jump_ts() or motor.state_units() or isinstance(motor, Converter):
            needed = (
                "it must be a motor such as InductionMotor(...), without currents as states, without switching times, "
                "and without a converter"
            )
            raise InputError("drive.motor", f"is {quoted(motor)}; {needed}")
        _require_ideal(reference)
        self.motor, self.reference, self.kind = motor, reference, "converter"

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Working speed of the reference."""
        return self.reference.speed

    @property
    def largest_speed(self) -> Array:
        """Largest speed of the reference, rad/s."""
        return self.reference.largest_speed

    def torque(self, speed: Array) -> Array:
        """Return the torque at the rotor's `speed` while the reference is at its working speed."""
        return self.motor.torque(speed + self.motor.speed - self.speed)

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque at time `t`."""
        return self.motor.torque(speed + self.motor.speed - self.reference.speed_at(t))

    def starting_torque(self) -> Array | None:
        """Return the torque at standstill, N m; None if the reference speed changes, because the torque at standstill then
        passes through its maximum."""
        return super().starting_torque() if self.reference.constant else None

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the times of the jumps of the reference."""
        return self.reference.jump_ts()


class SpeedControl(Motor):
    """Motor whose torque is controlled so that its speed follows a reference (proportional and integral, with a limit).

        T_u = gain (n(t) - theta') + z,    T = T_u, limited to the range -torque_limit to torque_limit
        z' = integral_gain (n(t) - theta' + (T - T_u) / gain)

    theta' is the rotor speed. The integral z is a state of the motor (`state.rotor[2]`, N m). The last term prevents z from
    growing while the torque is at its limit. Theories of steady motions need the torque as a function of the speed, which this
    drive does not have; use `ConstantSpeed` for them.

    **Arguments** (SI, or strings with a unit; all greater than 0)

    - `reference` n(t): an ideal drive, such as a `RunUp`
    - `gain`, N m s; typical: 0.05 to 5
    - `integral_gain`, N m; typical: gain divided by 0.1 to 1 s
    - `torque_limit`, N m; typical: 1.5 to 2.5 times the rated torque
    - `inertia` I of the whole rotor, kg m^2; typical: 0.005 to 0.5

    **Raises** `InputError` for a wrong unit, a value that is not positive, and a reference of the wrong type.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> drive = jv.SpeedControl(jv.ConstantSpeed(100.0), gain=0.5, integral_gain=2.0, torque_limit=8.0, inertia=0.02)
    >>> [float(drive.torque_at(0.0, speed, (jnp.asarray(1.0),))) for speed in (0.0, 95.0, 100.0)]
    [8.0, 3.5, 1.0]
    """

    reference: IdealDrive
    gain: Array = eqx.field(metadata=unit("N m s", low=0.0, open_low=True, words="gain of the speed control"))
    integral_gain: Array = eqx.field(metadata=unit("N m", low=0.0, open_low=True, words="integral gain of the speed control"))
    torque_limit: Array = eqx.field(metadata=unit("N m", low=0.0, open_low=True, words="torque limit of the motor"))
    inertia: Array = eqx.field(metadata=INERTIA)
    kind: str = eqx.field(static=True)

    def __init__(self, reference: IdealDrive, gain: Number, integral_gain: Number, torque_limit: Number, inertia: Number):
        _require_ideal(reference)
        given = {"gain": gain, "integral_gain": integral_gain, "torque_limit": torque_limit, "inertia": inertia}
        self.gain, self.integral_gain, self.torque_limit, self.inertia = read_numbers(SpeedControl, "drive", **given).values()
        self.reference, self.kind = reference, "speed_control"

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Working speed of the reference."""
        return self.reference.speed

    @property
    def largest_speed(self) -> Array:
        """Largest speed of the reference, rad/s."""
        return self.reference.largest_speed

    @property
    def is_smooth(self) -> bool:
        """False: the slope of the torque jumps at its limit."""
        return False

    def _torques(self, t: Array, speed: Array, integral: Array) -> tuple[Array, Array, Array]:
        """Return the error of the speed, the torque without a limit, and the torque."""
        error = self.reference.speed_at(t) - speed
        unlimited = self.gain * error + integral
        return error, unlimited, jnp.clip(unlimited, -self.torque_limit, self.torque_limit)

    def torque(self, speed: Array) -> Array:
        """**Raises** `InputError`, because the torque does not follow from the speed."""
        problem = "whose torque does not follow from the speed; use ConstantSpeed at its working speed, or simulate"
        raise InputError("drive", f"is a speed control, {problem}")

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque at time `t`."""
        return self._torques(t, speed, states[0])[2] if states else self.torque(speed)

    def starting_torque(self) -> None:
        """Return None, because the integral raises the torque at rest up to its limit."""

    def state_units(self) -> tuple[Array, ...]:
        """Return the torque limit, the typical magnitude of the integral."""
        return (self.torque_limit,)

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the rate of the integral in `states`, N m/s, at time `t` (s) and the rotor's `speed` (rad/s)."""
        error, unlimited, torque = self._torques(t, speed, states[0])
        return (self.integral_gain * (error + (torque - unlimited) / self.gain),)

    def jump_ts(self) -> tuple[Array, ...]:
        """Return the times of the jumps of the reference."""
        return self.reference.jump_ts()


def _require_ideal(reference: object) -> None:
    if not isinstance(reference, IdealDrive):
        raise InputError("drive.reference", f"is {quoted(reference)}; it must be an ideal drive, for example RunUp(...)")
