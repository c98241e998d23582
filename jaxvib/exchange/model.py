"""Equations of a scene as a function of its numbers, of time, states and inputs, for other tools."""

from __future__ import annotations

from collections.abc import Callable
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
from jaxvib.exchange.signals import Signal, coordinate_signals, force_inputs, foundation_forces
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drive import Drive, IdealDrive, Motor
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import SupportForce, Term
from jaxvib.machine.numbers.named import NamedNumber, numbers_of
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import solve_definite

DriveBy = Literal["scene", "input"]
"""Source of the rotor's motion: the drive of the scene, or inputs."""


class _AppliedForce(Effect):
    """External forces on the coordinates, (nd,), N, for angles N m."""

    force: Array
    kind: str = eqx.field(static=True, kw_only=True, default="applied_force")

    def terms(self) -> tuple[Term, ...]:
        """Return a support force that applies the external forces."""
        size = len(self.force)

        def rows(machine: Machine) -> Array:
            return jnp.eye(size, dtype=self.force.dtype)

        return (SupportForce(rows, lambda displacement: -jnp.sum(self.force * displacement), is_smooth=True),)


class _SpeedInput(IdealDrive):
    """Rotor whose angle, speed and acceleration are inputs."""

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


class _TorqueInput(Motor):
    """Motor with an additional torque on its rotor; only that torque acts if `motor` is None."""

    speed: Array
    inertia: Array
    extra: Array
    motor: Motor | None
    kind: str = eqx.field(static=True, kw_only=True, default="torque_input")

    def torque(self, speed: Array) -> Array:
        """Return the sum of the motor's torque and the additional torque."""
        return self.extra if self.motor is None else self.motor.torque(speed) + self.extra

    def torque_at(self, t: Array, speed: Array) -> Array:
        """Return the sum of the motor's torque at time `t` and the additional torque."""
        return self.extra if self.motor is None else self.motor.torque_at(t, speed) + self.extra


class Inputs(NamedTuple):
    """Inputs of the equations.

    **Attributes**: `force` on the coordinates (nd,), N, for angles N m; `torque` on the rotor of a motor, N m; `speed` and
    `acceleration` of a rotor whose motion is an input, rad/s and rad/s^2. An input that the scene does not have is None.
    """

    force: Any
    torque: Any = None
    speed: Any = None
    acceleration: Any = None


class States(NamedTuple):
    """State of the equations: `machine`; `rotor_angle`, rad, if the rotor speed is an input, otherwise None."""

    machine: State
    rotor_angle: Any = None


class Outputs(NamedTuple):
    """Outputs that are not states or rates: `foundation_force` (nb,) N; `rotor`, its angle and speed, None if they are states
    or inputs."""

    foundation_force: Any
    rotor: Any = None


class Equations(NamedTuple):
    """Equations of a scene for another tool.

    **Attributes**: `rates`, a function (scene, time, states, inputs) -> (rates of the states, outputs); initial values of
    `states` and `inputs`; `state_signals`, `rate_signals`, `input_signals` and `output_signals`, a `Signal` for each number in
    the order of the leaves. In `rate_signals`, only the rates of velocities have a signal; the others are None.
    """

    rates: Callable[[Scene, Array, States, Inputs], tuple[States, Outputs]]
    states: States
    inputs: Inputs
    state_signals: list[Signal]
    rate_signals: list[Signal | None]
    input_signals: list[Signal]
    output_signals: list[Signal]


def equations_of(scene: Scene, start: State, drive: DriveBy) -> Equations:
    """Return the equations of a scene that starts in a state."""
    carrier, ideal, by_input = scene.machine.structure(), scene.drive.ideal, drive == "input"
    zero = np.zeros((), scene.drive.speed.dtype)
    inputs = Inputs(np.zeros(carrier.mass.shape[0], zero.dtype))
    input_signals = list(force_inputs(carrier))
    output_signals = list(foundation_forces(carrier))
    rotor = [Signal("rotor.angle", "rad"), Signal("rotor.speed", "rad/s")]
    if not ideal:
        inputs = inputs._replace(torque=zero)
        input_signals.append(Signal("rotor.torque", "N m"))
    elif by_input:
        inputs = inputs._replace(speed=np.asarray(scene.drive.speed), acceleration=zero)
        input_signals += [rotor[1], Signal("rotor.acceleration", "rad/s^2")]
    else:
        output_signals += rotor
    states = States(start, zero if ideal and by_input else None)

    def rates(scene: Scene, t: Array, states: States, given: Inputs) -> tuple[States, Outputs]:
        state, angle = states
        turned = _driven(scene.drive, angle, given, by_input)
        effects = (*scene.all_effects, _AppliedForce(given.force))
        field = dynamics_of(assemble(scene.replace(drive=turned, effects=effects)), solve_definite)
        force = assemble(scene).foundation_force(state.displacement, state.velocity)
        known = (turned.rotor_angle(t, None), turned.rotor_speed(t, None)) if ideal and not by_input else None
        return States(field(t, state), given.speed if angle is not None else None), Outputs(force, known)

    signals = state_signals(scene, start)
    acceleration = iter(coordinate_signals(carrier, "acceleration", 2))
    own = [next(acceleration) if each.name.startswith("velocity.") else None for each in signals]
    if states.rotor_angle is not None:
        signals, own = [*signals, rotor[0]], [*own, None]
    return Equations(rates, states, inputs, signals, own, input_signals, output_signals)


def _driven(drive: Drive, angle: Array | None, given: Inputs, by_input: bool) -> Drive:
    """Return the drive to which the inputs are applied."""
    if isinstance(drive, Motor):
        return _TorqueInput(drive.speed, drive.inertia, given.torque, None if by_input else drive)
    if by_input:
        assert angle is not None
        return _SpeedInput(given.speed, angle, given.acceleration)
    return drive


def state_signals(scene: Scene, state: State) -> list[Signal]:
    """Return a `Signal` for each number of a state, in the order of its leaves."""
    carrier = scene.machine.structure()
    leaves, structure = jax.tree.flatten(state)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    shaped = [np.arange(end - np.size(leaf), end).reshape(np.shape(leaf)) for leaf, end in zip(leaves, ends, strict=True)]
    places = jax.tree.unflatten(structure, shaped)
    found: dict[int, Signal] = {}

    def put(where: np.ndarray, signals: list[Signal] | tuple[Signal, ...]) -> None:
        found.update(zip(np.atleast_1d(where).tolist(), signals, strict=True))

    def put_loads(name: str, unit: str, coordinates: tuple[np.ndarray, ...]) -> None:
        for k, where in enumerate(coordinates):
            own = name if len(coordinates) == 1 else f"{name}_{k + 1}"
            put(where, [Signal(f"{own}.load{j + 1}", unit) for j in range(where.size)])

    put(places.displacement, coordinate_signals(carrier, "displacement", 0))
    put(places.velocity, coordinate_signals(carrier, "velocity", 1))
    put_loads("angle", "rad", places.angle)
    put_loads("rate", "rad/s", places.rate)
    if places.rotor is not None:
        put(np.asarray(places.rotor), [Signal("rotor.angle", "rad"), Signal("rotor.speed", "rad/s")])
    if places.spin is not None and places.spin.drilling is not None:
        put_loads("drilling_spin", "rad/s", (places.spin.drilling,))
    if places.spin is not None and places.spin.slip is not None:
        put_loads("slip", "m/s", places.spin.slip)
    return [found[k] for k in range(len(found))]


def has_events(scene: Scene) -> bool:
    """True if the equations have branches: nonsmooth forces, or a drive whose acceleration jumps."""
    smooth = all(term.is_smooth for effect in scene.all_effects for term in effect.terms())
    return not smooth or bool(scene.drive.jump_ts())


def named_entries(scene: Scene) -> list[NamedNumber]:
    """Return the name of each parameter of a scene, in the order of its leaves.

    **Raises** `InputError` for a scene with a number that has no name.
    """
    leaves, structure = jax.tree.flatten(scene)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    shaped = [np.arange(end - np.size(leaf), end).reshape(np.shape(leaf)) for leaf, end in zip(leaves, ends, strict=True)]
    places = jax.tree.unflatten(structure, shaped)
    found: dict[int, NamedNumber] = {}
    for each in (single for group in numbers_of(scene).values() for single in group.single(scene)):
        where = np.asarray(each.leaf(places))
        found[int(where if each.entry is None else where[each.entry])] = each
    if len(found) != sum(map(np.size, leaves)):
        raise InputError(
            "scene", "has a number without a name, which another tool could not set; give a scene of jaxvib's parts"
        )
    return [found[k] for k in range(len(found))]
