"""Motors by their electrical data: name plate, equivalent circuit, currents."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import speed_text
from jaxvib.errors import InputError
from jaxvib.machine.drives.drive import INERTIA, Motor, kloss_torque
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number, count
from jaxvib.units.known import when_known

_POSITIVE = {"low": 0.0, "open_low": True}

_FREQUENCY = unit("rad/s", **_POSITIVE, words="frequency of the supply", electrical=True)

_MAX_POLE_PAIRS = 48
"""Largest number of pole pairs of a motor by its name plate; usual motors have 1 to 6."""


class NamePlateMotor(Motor):
    """Induction motor, switched on at t = 0, described by the data on its name plate, with Kloss's formula.

        T_r = power / rated_speed,    T_b = breakdown_ratio T_r,    s_r = 1 - rated_speed / n_s
        s_b = s_r (breakdown_ratio + sqrt(breakdown_ratio^2 - 1)),    T = 2 T_b s s_b / (s^2 + s_b^2)

    Kloss's formula then has the rated torque T_r at the rated slip s_r. The synchronous speed n_s is the lowest speed
    frequency / p above the rated speed, for a whole number p of pole pairs.

    Kloss's formula gives less torque at standstill than most cage motors have. Their bars are deep or double, so that the
    resistance of the rotor, to which s_b is proportional, grows with the frequency of its currents. With a `starting_ratio`,
    s_b in the last formula is replaced, at slips s above s_b, by

        s_b + (s - s_b) (1/u - s_b) / (1 - s_b),    u = r + sqrt(r^2 - 1),    r = breakdown_ratio / starting_ratio

    The torque then decreases from T_b at the slip s_b to `starting_ratio` T_r at standstill; at slips below s_b it does not
    change. A minimum of the torque between standstill and s_b (pull-up torque) is not included.

    The torque is that at the shaft of the motor. For the friction of other bearings, such as those of a vibrator, subtract
    their torque and use a `TorqueTable`.

    **Arguments** (SI, or strings with a unit)

    - `power`: rated mechanical power, W; typical: "0.25 kW" to "15 kW"
    - `rated_speed`, rad/s; typical: "1440 rpm"
    - `breakdown_ratio`: breakdown torque divided by rated torque, greater than 1; typical: 2 to 3.5
    - `inertia` of the whole rotor with its unbalance, kg m^2; typical: 0.005 to 0.5
    - `frequency` of the supply, rad/s; typical: "50 Hz" (the default) or "60 Hz"
    - `starting_ratio`: starting torque (locked rotor) divided by rated torque, M_A/M_N of catalogues; None (the default): that
      of Kloss's formula; typical: 1.8 to 2.8

    **Raises** `InputError` for

    - a wrong unit and a value out of bounds
    - a rated speed that needs more than 48 pole pairs or is a synchronous speed, or a breakdown slip of 1 or more
    - a `starting_ratio` that is below that of Kloss's formula or not below `breakdown_ratio`

    >>> import jaxvib as jv
    >>> motor = jv.NamePlateMotor("4 kW", "1440 rpm", breakdown_ratio=2.8, inertia="0.02 kg m^2")
    >>> round(float(motor.speed), 2), round(float(motor.breakdown_torque), 2), round(float(motor.breakdown_slip), 4)
    (157.08, 74.27, 0.2166)
    >>> cage = jv.NamePlateMotor("4 kW", "1440 rpm", breakdown_ratio=2.8, inertia="0.02 kg m^2", starting_ratio=2.2)
    >>> round(float(motor.torque(0.0)), 2), round(float(cage.torque(0.0)), 2)    # N m; rated torque 26.53 N m
    (30.73, 58.36)

    Source: Kloss's formula, see `InductionMotor`, solved for the breakdown slip. With a `starting_ratio` the resistance of the
    rotor is a linear function of the slip above s_b that gives the starting torque (derived here).
    """

    power: Array = eqx.field(metadata=unit("W", **_POSITIVE, words="rated power of the motor"))
    rated_speed: Array = eqx.field(metadata=unit("rad/s", **_POSITIVE, words="rated speed of the motor"))
    breakdown_ratio: Array = eqx.field(
        metadata=unit("", low=1.0, open_low=True, words="breakdown torque divided by rated torque", typical=2.5)
    )
    inertia: Array = eqx.field(metadata=INERTIA)
    frequency: Array = eqx.field(metadata=_FREQUENCY)
    starting_ratio: Array | None = eqx.field(
        metadata=unit("", **_POSITIVE, words="starting torque divided by rated torque", typical=2.2)
    )
    kind: str = eqx.field(static=True)

    def __init__(
        self,
        power: Number,
        rated_speed: Number,
        breakdown_ratio: Number,
        inertia: Number,
        frequency: Number = "50 Hz",
        starting_ratio: Number | None = None,
    ):
        self.power, self.rated_speed, self.breakdown_ratio, self.inertia, self.frequency = read_numbers(
            NamePlateMotor,
            "drive",
            power=power,
            rated_speed=rated_speed,
            breakdown_ratio=breakdown_ratio,
            inertia=inertia,
            frequency=frequency,
        ).values()
        self.starting_ratio = None
        self.kind = "name_plate_motor"
        when_known(_require_plate, self.rated_speed, self.frequency, self.breakdown_ratio, self.speed, self.breakdown_slip)
        if starting_ratio is not None:
            kloss_ratio = self.torque(jnp.zeros_like(self.speed)) * self.rated_speed / self.power
            self.starting_ratio = read_numbers(NamePlateMotor, "drive", starting_ratio=starting_ratio)["starting_ratio"]
            when_known(_require_starting_ratio, self.starting_ratio, kloss_ratio, self.breakdown_ratio)

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Synchronous speed, rad/s."""
        # Without the factor, rounding would decide whether a rated speed of 1000 rpm at 50 Hz belongs to 1000 or to 1500 rpm.
        # It belongs to 1500 rpm, because a rated speed is below the synchronous speed.
        return self.frequency / (jnp.ceil(self.frequency / self.rated_speed * (1.0 - 1e-6)) - 1.0)

    @property
    def is_smooth(self) -> bool:
        """True without a starting torque, which makes the second derivative of the torque jump at the breakdown slip."""
        return self.starting_ratio is None

    @property
    def breakdown_torque(self) -> Array:
        """Largest torque T_b, N m."""
        return self.breakdown_ratio * self.power / self.rated_speed

    @property
    def breakdown_slip(self) -> Array:
        """Slip s_b at the largest torque."""
        ratio = self.breakdown_ratio
        return (1.0 - self.rated_speed / self.speed) * (ratio + jnp.sqrt(ratio**2 - 1.0))

    def torque(self, speed: Array) -> Array:
        """Return the torque of Kloss's formula, with the starting torque if it is known."""
        slip, largest, breakdown_slip = 1.0 - speed / self.speed, self.breakdown_torque, self.breakdown_slip
        if self.starting_ratio is not None:
            ratio = jnp.maximum(self.breakdown_ratio / self.starting_ratio, 1.0 + 1e-6)  # at 1 the root has no derivative
            at_standstill = ratio - jnp.sqrt(ratio**2 - 1.0)  # 1/u
            growth = (at_standstill - breakdown_slip) / (1.0 - breakdown_slip)
            breakdown_slip = breakdown_slip + growth * jnp.maximum(slip - breakdown_slip, 0.0)
        return kloss_torque(slip, largest, breakdown_slip)


def _require_starting_ratio(ratio: float, low: float, high: float) -> None:
    """**Raises** `InputError` for a starting torque below that of Kloss's formula or not below the breakdown torque."""
    if not low * (1.0 - 1e-6) <= ratio < high:
        problem = (
            f"is {ratio:.4g}; it must be at least {low:.4g}, that of Kloss's formula, and below breakdown_ratio {high:.4g}"
        )
        raise InputError("drive.starting_ratio", f"{problem}; leave it out, or give a torque_table")


def _require_plate(rated: float, frequency: float, ratio: float, synchronous: float, breakdown_slip: float) -> None:
    """**Raises** `InputError` for a rated speed that no motor with this breakdown ratio has at this frequency of the supply."""
    speed = f"is {speed_text(rated)}"
    if not rated < frequency * (1.0 - 1e-6):
        hertz = f"{frequency / (2.0 * np.pi):.4g} Hz"
        problem = f"{speed}; it must be below {speed_text(frequency)}, the synchronous speed of one pole pair at {hertz}"
        remedy = "plain numbers are in rad/s; write for example '1440 rpm' and '50 Hz'"
        raise InputError("drive.rated_speed", f"{problem}; {remedy}")
    pole_pairs = frequency / synchronous if synchronous > 0.0 else np.inf
    if pole_pairs > _MAX_POLE_PAIRS + 0.5:
        problem = f"{speed}, which needs {pole_pairs:.0f} pole pairs; motors have 1 to {_MAX_POLE_PAIRS}"
        raise InputError("drive.rated_speed", f"{problem}; give the speed of the name plate, and the supply's frequency")
    pairs_at_rated_speed = frequency / rated
    if abs(pairs_at_rated_speed - np.round(pairs_at_rated_speed)) < 1e-6 * pairs_at_rated_speed:
        problem = f"{speed}, the synchronous speed of {pairs_at_rated_speed:.0f} pole pairs, at which a motor has no torque"
        example = speed_text(0.96 * rated, 3)
        raise InputError("drive.rated_speed", f"{problem}; give the speed at rated load, some percent below it, as '{example}'")
    if not breakdown_slip < 1.0:
        slip = f"{100.0 * (1.0 - rated / synchronous):.3g} % below the synchronous speed of {speed_text(synchronous)}"
        problem = f"{speed}, {slip}; with the breakdown_ratio {ratio:.4g} the breakdown slip is {breakdown_slip:.3g}"
        remedy = "give the speed at rated load, some percent below a synchronous speed, and the supply's frequency"
        raise InputError("drive.rated_speed", f"{problem}, and must be less than 1; {remedy}")


class DCMotorElectrical(Motor):
    """Direct-current motor, switched on at t = 0, described by its electrical data.

        L i' = V - R i - K theta',    T = K i

    theta' is the rotor speed. With an inductance L the current i is a state of the motor (`state.rotor[2]`, A). Without one,
    and in theories of steady motions, the torque is K (V - K theta') / R.

    **Arguments** (SI, or strings with a unit; all greater than 0)

    - `voltage` V of the supply, V; typical: 12 to 400
    - `resistance` R of the armature, ohm; typical: 0.2 to 20
    - `torque_constant` K, N m/A, equal to the constant of the induced voltage in V s/rad; typical: 0.05 to 2
    - `inertia` of the whole rotor, kg m^2; typical: 0.005 to 0.5
    - `inductance` L of the armature, H, or None (the default); typical: 1e-4 to 0.05

    **Raises** `InputError` for a wrong unit or a value that is not positive.

    >>> import jaxvib as jv
    >>> motor = jv.DCMotorElectrical("24 V", "0.6 ohm", torque_constant=0.08, inertia=0.002, inductance="2 mH")
    >>> round(float(motor.speed), 6), round(float(motor.torque(0.0)), 6)
    (300.0, 3.2)
    """

    voltage: Array = eqx.field(metadata=unit("V", **_POSITIVE, words="voltage of the supply"))
    resistance: Array = eqx.field(metadata=unit("ohm", **_POSITIVE, words="resistance of the armature"))
    torque_constant: Array = eqx.field(metadata=unit("N m/A", **_POSITIVE, words="torque constant of the motor"))
    inertia: Array = eqx.field(metadata=INERTIA)
    inductance: Array | None = eqx.field(metadata=unit("H", **_POSITIVE, words="inductance of the armature"))
    kind: str = eqx.field(static=True)

    def __init__(
        self, voltage: Number, resistance: Number, torque_constant: Number, inertia: Number, inductance: Number | None = None
    ):
        given = {"voltage": voltage, "resistance": resistance, "torque_constant": torque_constant, "inertia": inertia}
        for name, value in read_numbers(DCMotorElectrical, "drive", **given, inductance=inductance).items():
            setattr(self, name, value)
        self.kind = "dc_motor_electrical"

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """No-load speed, V/K."""
        return self.voltage / self.torque_constant

    def torque(self, speed: Array) -> Array:
        """Return the steady torque at the rotor's `speed`."""
        return self.torque_constant * (self.voltage - self.torque_constant * speed) / self.resistance

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return K i, or the steady torque without `states`."""
        return self.torque_constant * states[0] if states else self.torque(speed)

    def state_units(self) -> tuple[Array, ...]:
        """Return the current at standstill, the typical magnitude of the current; () without an inductance."""
        return () if self.inductance is None else (self.voltage / self.resistance,)

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the rate of the current in `states`, A/s, at time `t` (s) and the rotor's `speed` (rad/s)."""
        assert self.inductance is not None
        return ((self.voltage - self.resistance * states[0] - self.torque_constant * speed) / self.inductance,)


class InductionMotorCircuit(Motor):
    """Induction motor, switched on at t = 0, with the steady torque of its equivalent circuit.

        w = frequency,  w_s = w - p theta',  L_s = L_m + stator_leakage,  L_r = L_m + rotor_leakage
        V = (R_s + i w L_s) I_s + i w L_m I_r,    0 = (R_r + i w_s L_r) I_r + i w_s L_m I_s
        T = (3/2) p L_m Im(conj(I_r) I_s)

    V = sqrt(2/3) `voltage` is the amplitude of the phase voltage. I_s and I_r are the complex amplitudes of the currents of
    stator and rotor, and theta' is the rotor speed. Transients of the currents are neglected; they are included
    in `InductionMotorElectrical`.

    **Arguments** (SI, or strings with a unit; all greater than 0). Rotor values are referred to the stator. Data sheets often
    give reactances X = w L.

    - `voltage` of the supply between two lines, root mean square, V; typical: 400
    - `frequency` of the supply, rad/s; typical: "50 Hz"; a plain number is in rad/s, as everywhere: 314.16
    - `pole_pairs` p; typical: 1 to 4
    - `stator_resistance` R_s and `rotor_resistance` R_r of a phase, ohm; typical: 0.2 to 10
    - `stator_leakage` and `rotor_leakage`: leakage inductances of a phase, H; typical: 1e-3 to 0.03
    - `magnetizing_inductance` L_m, H; typical: 0.05 to 0.7
    - `inertia` of the whole rotor, kg m^2; typical: 0.005 to 0.5

    **Raises** `InputError` for a wrong unit or a value that is not allowed.

    >>> import jaxvib as jv
    >>> motor = jv.InductionMotorCircuit("220 V", "60 Hz", 2, stator_resistance=0.435, rotor_resistance=0.816,
    ...     stator_leakage="2 mH", rotor_leakage="2 mH", magnetizing_inductance="69.31 mH", inertia=0.089)
    >>> round(float(motor.torque(178.96)), 1)                       # N m at 1709 rpm
    14.2

    Source: P. C. Krause, Analysis of Electric Machinery, the motor of 3 hp in the example.
    """

    voltage: Array = eqx.field(metadata=unit("V", **_POSITIVE, words="voltage between two lines of the supply"))
    frequency: Array = eqx.field(metadata=_FREQUENCY)
    stator_resistance: Array = eqx.field(metadata=unit("ohm", **_POSITIVE, words="resistance of the stator"))
    rotor_resistance: Array = eqx.field(metadata=unit("ohm", **_POSITIVE, words="resistance of the rotor"))
    stator_leakage: Array = eqx.field(metadata=unit("H", **_POSITIVE, words="leakage inductance of the stator"))
    rotor_leakage: Array = eqx.field(metadata=unit("H", **_POSITIVE, words="leakage inductance of the rotor"))
    magnetizing_inductance: Array = eqx.field(metadata=unit("H", **_POSITIVE, words="magnetizing inductance"))
    inertia: Array = eqx.field(metadata=INERTIA)
    pole_pairs: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    _KIND: ClassVar[str] = "induction_motor_circuit"

    def __init__(
        self,
        voltage: Number,
        frequency: Number,
        pole_pairs: int,
        stator_resistance: Number,
        rotor_resistance: Number,
        stator_leakage: Number,
        rotor_leakage: Number,
        magnetizing_inductance: Number,
        inertia: Number,
    ):
        given = {
            "voltage": voltage,
            "frequency": frequency,
            "stator_resistance": stator_resistance,
            "rotor_resistance": rotor_resistance,
            "stator_leakage": stator_leakage,
            "rotor_leakage": rotor_leakage,
            "magnetizing_inductance": magnetizing_inductance,
            "inertia": inertia,
        }
        for name, value in read_numbers(InductionMotorCircuit, "drive", **given).items():
            setattr(self, name, value)
        self.pole_pairs, self.kind = count(pole_pairs, "drive.pole_pairs"), self._KIND

    @property
    def speed(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Synchronous speed, rad/s."""
        return self.frequency / self.pole_pairs

    @property
    def _voltage_amplitude(self) -> Array:
        return np.sqrt(2.0 / 3.0).astype(self.voltage.dtype) * self.voltage

    def torque(self, speed: Array) -> Array:
        """Return the steady torque at the rotor's `speed`."""
        w, slip, mutual = self.frequency, self.frequency - self.pole_pairs * speed, self.magnetizing_inductance
        rotor = self.rotor_resistance**2 + (slip * (mutual + self.rotor_leakage)) ** 2
        coupling = slip * mutual**2 / rotor
        resistance = self.stator_resistance + w * coupling * self.rotor_resistance
        reactance = w * (mutual + self.stator_leakage) - w * coupling * slip * (mutual + self.rotor_leakage)
        current_squared = self._voltage_amplitude**2 / (resistance**2 + reactance**2)
        return 1.5 * self.pole_pairs * coupling * self.rotor_resistance * current_squared


class InductionMotorElectrical(InductionMotorCircuit):
    """Induction motor, switched on at t = 0, with the transients of its currents.

        psi_s' = V e^(i w t) - R_s i_s,    psi_r' = i p theta' psi_r - R_r i_r,    T = (3/2) p Im(conj(psi_s) i_s)
        psi_s = L_s i_s + L_m i_r,         psi_r = L_m i_s + L_r i_r

    The flux linkages psi_s and psi_r in the fixed frame, two components each, are states of the motor (`state.rotor[2:]`, V s).
    i_s and i_r are the currents of stator and rotor; V and the other symbols are those of `InductionMotorCircuit`.
    Theories of steady motions use the steady torque of `InductionMotorCircuit`. Arguments, units and typical values are those
    of `InductionMotorCircuit`.

    >>> import jaxvib as jv
    >>> motor = jv.InductionMotorElectrical("220 V", "60 Hz", 2, stator_resistance=0.435, rotor_resistance=0.816,
    ...     stator_leakage="2 mH", rotor_leakage="2 mH", magnetizing_inductance="69.31 mH", inertia=0.089)
    >>> len(motor.state_units())
    4

    Source: P. C. Krause, Analysis of Electric Machinery, equations of the symmetrical induction machine in the stationary
    frame.
    """

    _KIND = "induction_motor_electrical"

    def currents(self, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the currents i_s and i_r, two components each, A, from the flux linkages `states`, V s."""
        mutual = self.magnetizing_inductance
        stator, rotor = mutual + self.stator_leakage, mutual + self.rotor_leakage
        determinant = self.stator_leakage * rotor + mutual * self.rotor_leakage
        (sx, sy), (rx, ry) = states[:2], states[2:]
        of_stator = tuple((rotor * s - mutual * r) / determinant for s, r in ((sx, rx), (sy, ry)))
        of_rotor = tuple((stator * r - mutual * s) / determinant for s, r in ((sx, rx), (sy, ry)))
        return (*of_stator, *of_rotor)

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque of the currents, or the steady torque without `states`."""
        if not states:
            return self.torque(speed)
        ix, iy, *_ = self.currents(states)
        return 1.5 * self.pole_pairs * (states[0] * iy - states[1] * ix)

    def supply_frequency(self) -> Array:
        """Return the angular frequency of the supply, rad/s; the torque depends on the phase of the supply."""
        return self.frequency

    def state_units(self) -> tuple[Array, ...]:
        """Return the flux linkage at the voltage of the supply, the typical magnitude of each state."""
        return (self._voltage_amplitude / self.frequency,) * 4

    def state_rates(self, t: Array, speed: Array, states: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the rates of the flux linkages `states`, V, at time `t` (s) and the rotor's `speed` (rad/s)."""
        sx, sy, rx, ry = self.currents(states)
        v, turn, electrical_speed = self._voltage_amplitude, self.frequency * t, self.pole_pairs * speed
        return (
            v * jnp.cos(turn) - self.stator_resistance * sx,
            v * jnp.sin(turn) - self.stator_resistance * sy,
            -electrical_speed * states[3] - self.rotor_resistance * rx,
            electrical_speed * states[2] - self.rotor_resistance * ry,
        )
