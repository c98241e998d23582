"""Equations of a scene as a function of parameters, time, states and inputs, for other tools."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.model import assemble
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.drives.drive import IdealDrive, Motor, MotorWrapper
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import SupportForce, Term
from jaxvib.machine.numbers.named import NamedNumber, numbers_of
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.numerics.linalg import solve_definite

DriveBy = Literal["scene", "input"]
"""Source of the motion of the rotor: the drive of the scene, or inputs."""


_RATES = ("", "/s", "/s^2")
"""Endings of the units of a coordinate, its velocity and its acceleration."""


class Signal(NamedTuple):
    """Name of a quantity, such as "displacement.y1", and its unit."""

    name: str
    unit: str


def coordinate_signals(carrier: Carrier, name: str, order: int) -> tuple[Signal, ...]:
    """Return the signals of the coordinates (`order` 0) or of their derivatives: velocities (1) or accelerations (2)."""
    named = zip(carrier.coordinates, carrier.units, strict=True)
    return tuple(Signal(f"{name}.{coordinate}", unit + _RATES[order]) for coordinate, unit in named)


def force_inputs(carrier: Carrier) -> tuple[Signal, ...]:
    """Return the signals of the forces on the coordinates, N (on angles: N m)."""
    named = zip(carrier.coordinates, carrier.units, strict=True)
    return tuple(Signal(f"force.{coordinate}", "N" if unit == "m" else "N m") for coordinate, unit in named)


def foundation_forces(machine: Machine) -> tuple[Signal, ...]:
    """Return the signals of the force on the foundation; () if the foundation is unknown."""
    directions = machine.structure().foundation_directions if machine.has_foundation else ()
    return tuple(Signal(f"foundation_force.{direction}", "N") for direction in directions)


def omit_unknown_force(machine: Machine, force: Array) -> Array:
    """Return the force on the foundation; an empty array if the foundation is unknown, see `foundation_forces`."""
    return force if machine.has_foundation else force[:0]


class _AppliedForce(Effect):
    """External forces (nd,) on the coordinates, N (on angles: N m)."""

    force: Array
    kind: str = eqx.field(static=True, kw_only=True, default="applied_force")

    def terms(self) -> tuple[Term, ...]:
        """Return a support force that applies the external forces."""
        size = len(self.force)

        def rows(machine: Machine) -> Array:
            return jnp.eye(size, dtype=self.force.dtype)

        return (SupportForce(rows, lambda displacement: -jnp.sum(self.force * displacement)),)


class _SpeedInput(IdealDrive):
    """Drive that prescribes the angle, speed and acceleration which another tool supplies."""

    speed: Array
    angle: Array
    acceleration: Array
    kind: str = eqx.field(static=True, kw_only=True, default="speed_input")

    def speed_at(self, t: Array) -> Array:
        """Return the speed."""
        return self.speed

    def angle_at(self, t: Array) -> Array:
        """Return the angle."""
        return self.angle

    def acceleration_at(self, t: Array) -> Array:
        """Return the acceleration."""
        return self.acceleration


class _TorqueInput(MotorWrapper):
    """Motor with an additional torque on its rotor; if `is_alone` is True, this torque replaces the torque of the motor."""

    motor: Motor
    extra: Array
    is_alone: bool = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(self, motor: Motor, extra: Array, *, is_alone: bool):
        self.motor, self.extra, self.is_alone, self.kind = motor, extra, is_alone, "torque_input"

    def torque(self, speed: Array) -> Array:
        """Return the steady torque of the motor plus the additional torque; if `is_alone`, only the additional torque."""
        return self.extra if self.is_alone else self.motor.torque(speed) + self.extra

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        """Return the torque of the motor at time `t` plus the additional torque; if `is_alone`, only the additional torque."""
        return self.extra if self.is_alone else self.motor.torque_at(t, speed, states) + self.extra


class RotorInputs(NamedTuple):
    """Inputs of one rotor, positive anticlockwise.

    **Attributes**: `torque` on the rotor of a motor, N m; `speed` and `acceleration` of a rotor whose motion is an input, rad/s
    and rad/s^2. An input that the rotor does not have is None.
    """

    torque: Any = None
    speed: Any = None
    acceleration: Any = None


class Inputs(NamedTuple):
    """Inputs of the equations: `force` (nd,) on the coordinates, N (on angles: N m); `rotors`: the inputs of each exciter."""

    force: Any
    rotors: tuple[RotorInputs, ...]


class States(NamedTuple):
    """State of the equations: `machine`; `rotor_angles`: for each exciter the angle of its rotor, rad, if the speed of the
    rotor is an input, otherwise None."""

    machine: State
    rotor_angles: tuple[Any, ...]


class Outputs(NamedTuple):
    """Outputs that are neither states nor rates: `foundation_force`, N, with an entry for each direction; `rotors`: for each
    exciter the angle, rad, and the speed, rad/s, of its rotor, None if these are states or inputs."""

    foundation_force: Any
    rotors: tuple[Any, ...]


class Equations(NamedTuple):
    """Equations of a scene for another tool.

    **Attributes**: `rates`: a function (scene, time, states, inputs) -> (rates of the states, outputs); `states` and `inputs`:
    their initial values; `state_signals`, `rate_signals`, `input_signals` and `output_signals`: a `Signal` for each number of
    these trees, in the order of their leaves (`jax.tree`). In `rate_signals` only the accelerations of the coordinates have a
    signal; the other entries are None. `by_input`: True if inputs replace the drives.
    """

    rates: Callable[[Scene, Array, States, Inputs], tuple[States, Outputs]]
    states: States
    inputs: Inputs
    state_signals: list[Signal]
    rate_signals: list[Signal | None]
    input_signals: list[Signal]
    output_signals: list[Signal]
    by_input: bool


def equations_of(scene: Scene, start: State, drive: DriveBy) -> Equations:
    """Return the equations of a scene.

    **Arguments**: `start`: the initial state; `drive`: "scene", or "input" for inputs in place of the drives.
    """
    carrier = scene.machine.structure()
    zero = np.zeros((), carrier.mass.dtype)
    by_input = drive == "input"
    if by_input:
        start = without_motor_states(start)
    rotors, angles = [], []
    input_signals, output_signals = list(force_inputs(carrier)), list(foundation_forces(scene.machine))
    angle_signals = []
    for k, exciter in enumerate(scene.exciters):
        angle, speed, acceleration, torque = _rotor_signals(scene.prefix_of(k))
        is_prescribed = exciter.drive.ideal and by_input
        angles.append(zero if is_prescribed else None)
        if not exciter.drive.ideal:
            rotors.append(RotorInputs(torque=zero))
            input_signals.append(torque)
        elif is_prescribed:
            rotors.append(RotorInputs(speed=exciter.direction * np.asarray(exciter.drive.speed), acceleration=zero))
            input_signals += [speed, acceleration]
            angle_signals.append(angle)
        else:
            rotors.append(RotorInputs())
            output_signals += [angle, speed]

    def rates(scene: Scene, t: Array, states: States, values: Inputs) -> tuple[States, Outputs]:
        state = states.machine
        cases = zip(scene.exciters, states.rotor_angles, values.rotors, strict=True)
        driven_exciters = [_with_input_drive(exciter, angle, inputs, by_input) for exciter, angle, inputs in cases]
        forced = Scene(scene.machine, exciters=driven_exciters, effects=(*scene.effects, _AppliedForce(values.force)))
        rate = dynamics_of(assemble(forced), solve_definite)(t, state)
        force = omit_unknown_force(scene.machine, assemble(scene).foundation_force(state.displacement, state.velocity))
        are_outputs = [exciter.drive.ideal and not by_input for exciter in scene.exciters]
        turning = [exciter.turning_drive for exciter in scene.exciters]
        rotor_outputs = [
            (each.rotor_angle(t, None), each.rotor_speed(t, None)) if is_output else None
            for each, is_output in zip(turning, are_outputs, strict=True)
        ]
        return States(rate, tuple(inputs.speed for inputs in values.rotors)), Outputs(force, tuple(rotor_outputs))

    signals = [*state_signals(scene, start), *angle_signals]
    acceleration = iter(coordinate_signals(carrier, "acceleration", 2))
    rate_signals = [next(acceleration) if each.name.startswith("velocity.") else None for each in signals]
    inputs, states = Inputs(np.zeros(carrier.mass.shape[0], zero.dtype), tuple(rotors)), States(start, tuple(angles))
    return Equations(rates, states, inputs, signals, rate_signals, input_signals, output_signals, by_input)


def without_motor_states(state: State) -> State:
    """Return a state, or its units, without the states of motors other than the angle and the rotor speed."""
    exciters = [replace(exciter, rotor=None if exciter.rotor is None else exciter.rotor[:2]) for exciter in state.exciters]
    return replace(state, exciters=exciters)


def _rotor_signals(place: str) -> list[Signal]:
    """Return the signals of a rotor's angle, speed and acceleration, and of a torque on it."""
    named = {"angle": "rad", "speed": "rad/s", "acceleration": "rad/s^2", "torque": "N m"}
    return [Signal(f"{place}rotor.{name}", unit) for name, unit in named.items()]


def _with_input_drive(exciter: Exciter, angle: Array | None, inputs: RotorInputs, by_input: bool) -> Exciter:
    """Return the exciter with a drive to which the inputs are applied."""
    drive, sign = exciter.drive, float(exciter.direction)
    if isinstance(drive, Motor):
        input_drive = _TorqueInput(drive, sign * inputs.torque, is_alone=by_input)
    elif angle is not None:
        input_drive = _SpeedInput(sign * inputs.speed, sign * angle, sign * inputs.acceleration)
    else:
        return exciter
    return eqx.tree_at(lambda e: e.drive, exciter, input_drive)


def state_signals(scene: Scene, state: State) -> list[Signal]:
    """Return a `Signal` for each entry of a state, in the order of its arrays (leaves of `jax.tree`)."""
    carrier = scene.machine.structure()
    leaves, structure = jax.tree.flatten(state)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    shaped = [np.arange(end - np.size(leaf), end).reshape(np.shape(leaf)) for leaf, end in zip(leaves, ends, strict=True)]
    places = jax.tree.unflatten(structure, shaped)
    signals_by_index: dict[int, Signal] = {}

    def put(where: np.ndarray, signals: list[Signal] | tuple[Signal, ...]) -> None:
        signals_by_index.update(zip(np.atleast_1d(where).tolist(), signals, strict=True))

    def put_loads(name: str, unit: str, coordinates: tuple[np.ndarray, ...]) -> None:
        for k, where in enumerate(coordinates):
            exciter = name if len(coordinates) == 1 else f"{name}_{k + 1}"
            put(where, [Signal(f"{exciter}.load{j + 1}", unit) for j in range(where.size)])

    put(places.displacement, coordinate_signals(carrier, "displacement", 0))
    put(places.velocity, coordinate_signals(carrier, "velocity", 1))
    for k, exciter in enumerate(places.exciters):
        place = scene.prefix_of(k)
        put_loads(f"{place}angle", "rad", exciter.angle)
        put_loads(f"{place}rate", "rad/s", exciter.rate)
        if exciter.rotor is not None:
            states = [Signal(f"{place}motor.state{k + 1}", "") for k in range(len(exciter.rotor) - 2)]
            put(np.asarray(exciter.rotor), [*_rotor_signals(place)[:2], *states])
        if exciter.spin is not None and exciter.spin.drilling is not None:
            put_loads(f"{place}drilling_spin", "rad/s", (exciter.spin.drilling,))
        if exciter.spin is not None and exciter.spin.slip is not None:
            put_loads(f"{place}slip", "m/s", exciter.spin.slip)
    return [signals_by_index[k] for k in range(len(signals_by_index))]


def has_events(scene: Scene) -> bool:
    """Return True if the equations are piecewise smooth: forces or torques that are not smooth, or a drive whose acceleration
    jumps."""
    return bool(scene.not_smooth) or any(exciter.drive.jump_ts() for exciter in scene.exciters)


def named_entries(scene: Scene) -> list[NamedNumber]:
    """Return the named parameters of a scene, in the order of its arrays (leaves of `jax.tree`).

    **Raises** `InputError` for a scene with a parameter that has no name.
    """
    leaves, structure = jax.tree.flatten(scene)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    shaped = [np.arange(end - np.size(leaf), end).reshape(np.shape(leaf)) for leaf, end in zip(leaves, ends, strict=True)]
    places = jax.tree.unflatten(structure, shaped)
    numbers_by_index: dict[int, NamedNumber] = {}
    for parameter in (single for group in numbers_of(scene).values() for single in group.single(scene)):
        index = np.asarray(parameter.leaf(places))
        numbers_by_index[int(index.ravel()[parameter.entry or 0])] = parameter
    if len(numbers_by_index) != sum(map(np.size, leaves)):
        raise InputError(
            "scene", "has a parameter without a name, which another tool could not set; give a scene of jaxvib's parts"
        )
    return [numbers_by_index[k] for k in range(len(numbers_by_index))]
