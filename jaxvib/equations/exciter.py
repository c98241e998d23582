"""One exciter of a machine: its loads and its rotor, eliminated from the equations of motion.

A load of mass m and inertia factor kappa (7/5 for balls) has the coordinates u, the position p(u) relative to the point that
carries it, and the generalized forces Q_u. With J = p'(u), c = (dJ/dt) u', H = kappa m J^T J and r = Q_u - kappa m J^T c, it
obeys u'' = H^-1 (r - E a). Here a is the acceleration of the point that carries the load. E is m J^T; if a friction is
proportional to the normal force of the load, the factor of a in this friction is subtracted. The load exerts the force
-(W a + g) on that point, with W = m 1 - m J H^-1 E (1 is the unit matrix) and g = m (J H^-1 r + c). The unbalanced rotor of a
motor exerts a force of the same form. The added mass and the reaction of the exciter are the sums of W and g over all loads,
with the levers of the loads on the rows of the mount. (The added mass is the apparent mass of the exciter, not that of a
fluid; the reaction has the sign opposite to the force.) These two contain the whole effect of the exciter on the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.sliding import (
    ContactSolution,
    Kinematics,
    contact_force,
    dot,
    kinematics,
    resolve_contact,
    slip_rates,
    total,
)
from jaxvib.equations.state import ExciterState, Spin
from jaxvib.errors import InputError
from jaxvib.machine.carrier import scaled
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.base import Effect, has_term, static_imbalances, terms_of, total_gravity
from jaxvib.machine.effects.terms import (
    ContactFriction,
    DrillingSpinRelease,
    Friction,
    LoadInteraction,
    LoadPotential,
    LoadResistance,
    RotorImbalance,
    SlipRelease,
)
from jaxvib.machine.loads import DrillingSpin, Loads
from jaxvib.numerics.linalg import small_inverse, times

Axes = dict[int, Array]
"""Components of a vector by axis, 0 horizontal, 1 up: arrays (count,) with an entry for each load."""


class Motion(NamedTuple):
    """State of an exciter, and quantities that do not depend on the accelerations.

    **Attributes**

    - `state`; `speed` of the rotor, rad/s
    - `imbalance_derivatives` of the rotor, see `RotorDynamics._imbalance_derivatives`
    - `kinematics` of the loads
    - `drag_torque` of the rotor on the loads, (count,) N m; a scalar 0 without loads
    - `weight_torque` of gravity on the rotor, see `RotorDynamics.weight_torque`
    - `rolling`: forces on the loads if all of them roll
    - `housing_speed` at which the housing turns with the machine, rad/s; None if it does not turn
    - `time`, s
    """

    state: ExciterState
    speed: Array
    imbalance_derivatives: tuple[list[Array], list[Array]] | None
    kinematics: Kinematics
    drag_torque: Array
    weight_torque: Array | None
    rolling: ContactSolution
    housing_speed: Array | None
    time: Array

    @property
    def driven_speed(self) -> Array:
        """Speed of the rotor relative to its housing, rad/s."""
        return self.speed if self.housing_speed is None else self.speed - self.housing_speed


class Eliminated(NamedTuple):
    """Exciter whose own accelerations are expressed in terms of a, the accelerations of the mount's rows.

    **Attributes**

    - `acceleration_without_carrier`, `response_to_carrier`: loads move with
      u'' = `acceleration_without_carrier` - `response_to_carrier` . a_load, where a_load is the acceleration of the point that
      carries each load, by axis
    - `added_mass`, `reaction`: the force of the exciter on the rows is -(`added_mass` a + `reaction`)
    - `rotor`: the rotor of a motor moves with theta'' = `rotor`[0] - `rotor`[1] . a; None under an ideal drive
    """

    acceleration_without_carrier: tuple[Array, ...]
    response_to_carrier: dict[int, tuple[Array, ...]]
    added_mass: Sequence[Sequence[Array | float]]
    reaction: Sequence[Array | float]
    rotor: tuple[Array, list[Array]] | None

    def acceleration(self, a_load: Axes) -> tuple[Array, ...]:
        """Return u'' from `a_load`, the accelerations of the points that carry the loads."""
        return tuple(
            f - sum(self.response_to_carrier[axis][i] * x for axis, x in a_load.items())
            for i, f in enumerate(self.acceleration_without_carrier)
        )


class RotorDynamics(eqx.Module):
    """Rotor of an exciter without loads; base of the rotor with loads.

    **Attributes**

    - `levers` of the loads and `rotor_levers`, see `Mount`
    - `housing_row`: row (1, nd) of the rotation of the housing, None if it does not turn
    - `drive`, whose angle and speed are positive anticlockwise for either direction of the exciter
    - `unbalance` about the axis, kg m, or None
    - `effects`, prepared for the loads
    - `axes` of the mount
    - `block_count`: number of entries of `Mount.rows`, from the first, on which loads or an unbalanced rotor act. Each entry is
      a block of scalar rows, one for each of the `axes`; "the mount's rows" are the scalar rows of these blocks
    """

    levers: tuple[Array | None, ...]
    rotor_levers: tuple[Array | None, ...]
    housing_row: Array | None
    drive: Drive
    unbalance: Array | None
    effects: tuple[Effect, ...]
    axes: tuple[int, ...] = eqx.field(static=True)
    block_count: int = eqx.field(static=True)

    @property
    def can_slide(self) -> bool:
        """True if an effect lets loads slide."""
        return False

    def housing_speed(self, velocity: Array) -> Array | None:
        """Return the speed at which the housing turns with the machine; None if it does not turn."""
        return None if self.housing_row is None else times(self.housing_row, velocity)[0]

    def motion(self, t: Array, state: ExciterState, speed: Array, housing: Array | None) -> Motion:
        """Return the quantities that do not depend on the accelerations, for a rotor that turns at `speed`."""
        no_loads, no_contact = Kinematics([], (), ()), ContactSolution(jnp.ones_like(speed), [], [])
        no_drag, weight = jnp.zeros_like(speed), self._weight_torque_if_needed(t, state, housing)
        return Motion(state, speed, self._imbalance_derivatives(t, state), no_loads, no_drag, weight, no_contact, housing, t)

    def eliminate(self, motion: Motion, contact: ContactSolution) -> Eliminated:
        """Express the exciter's own accelerations in terms of the accelerations of the mount's rows.

        The friction of `contact` must be linear in the accelerations, see `signed`.
        """
        n = self.block_count * len(self.axes)
        added_mass: list[list[Array | float]] = [[0.0] * n for _ in range(n)]
        rotor = self._add_rotor(motion, added_mass, [0.0] * n, motion.drag_torque, {})
        return self._add_housing(motion, Eliminated((), {}, *rotor), motion.drag_torque, {})

    def at_loads(self, a: Sequence[Array]) -> Axes:
        """Return the accelerations of the points that carry the loads from those of the mount's rows."""
        return {}

    def slide(self, motion: Motion, contact: ContactSolution, part: Eliminated, a: Sequence[Array]) -> ContactSolution:
        """Decide which loads slide, from the contact forces that the motion needs if all loads roll."""
        return contact

    def rates(self, motion: Motion, rolling: ContactSolution, part: Eliminated, a: Sequence[Array]) -> ExciterState:
        """Return the time derivative of the exciter's state from the accelerations of the mount's rows.

        `rolling` contains the forces on the loads if all of them roll; the rate of each load's slip follows from it.
        """
        return ExciterState(rotor=self._rotor_rates(motion, part, a))

    def _rotor_rates(self, motion: Motion, part: Eliminated, a: Sequence[Array]) -> tuple[Array, ...] | None:
        if part.rotor is None or motion.state.rotor is None:
            return None
        states = motion.state.rotor[2:]
        rates = self.drive.state_rates(motion.time, motion.driven_speed, states) if states else ()
        return (motion.speed, part.rotor[0] - dot(part.rotor[1], a), *rates)

    def _add_rotor(
        self,
        motion: Motion,
        added_mass: list[list[Array | float]],
        reaction: list[Array | float],
        drag_torque: Array,
        coupling: Axes,
    ) -> tuple[list[list[Array | float]], list[Array | float], tuple[Array, list[Array]] | None]:
        """Return added mass and reaction with the rotor's imbalance, and the acceleration of the rotor, see `Eliminated`."""
        motor = self._motor(motion)
        if motor is None:
            if motion.imbalance_derivatives is not None:
                reaction = [g + b for g, b in zip(reaction, motion.imbalance_derivatives[1], strict=True)]
            return added_mass, reaction, None
        torque, inertia = motor
        braking, slopes = self._braking_torque(motion, drag_torque, coupling)
        free = (torque - braking) / inertia
        row = [f / inertia for f in slopes] + [jnp.zeros_like(free)] * (len(reaction) - len(slopes))
        if motion.imbalance_derivatives is None:
            return added_mass, reaction, (free, row)
        first, curvature = motion.imbalance_derivatives
        added_mass = [[w - d * r for w, r in zip(line, row, strict=True)] for line, d in zip(added_mass, first, strict=True)]
        reaction = [g + b + d * free for g, b, d in zip(reaction, curvature, first, strict=True)]
        return added_mass, reaction, (free, row)

    def _motor(self, motion: Motion) -> tuple[Array, Array] | None:
        """Return the torque of a motor, at its speed relative to the housing, and its inertia; None under an ideal drive."""
        states = () if motion.state.rotor is None else motion.state.rotor[2:]
        return self.drive.torque_and_inertia(motion.time, motion.driven_speed, states)

    def _braking_torque(self, motion: Motion, drag_torque: Array, coupling: Axes) -> tuple[Array, list[Array]]:
        """Return T and c: loads, gravity and imbalance brake the rotor with the torque T + c . a, N m. c has entries for the
        first scalar rows of the mount; for the other rows it is 0."""
        torque = self._total(drag_torque)
        torque = torque if motion.weight_torque is None else torque + motion.weight_torque
        by_loads = [self._total(coupling[i], lever) for lever in self.levers for i in self.axes] if coupling else []
        if motion.imbalance_derivatives is None:
            return torque, by_loads
        first = motion.imbalance_derivatives[0]
        return torque, [f + d for f, d in zip(by_loads, first, strict=False)] + first[len(by_loads) :]

    def _add_housing(self, motion: Motion, part: Eliminated, drag_torque: Array, coupling: Axes) -> Eliminated:
        """Add the row of the housing's rotation, on which the reaction torque of the drive acts."""
        if motion.housing_speed is None:
            return part
        motor, n = self._motor(motion), len(part.reaction)
        if motor is None:
            torque, row = self._braking_torque(motion, drag_torque, coupling)
        else:
            torque, row = motor[0], []
        zero = jnp.zeros_like(torque)
        added_mass = [[*line, zero] for line in part.added_mass] + [row + [zero] * (n + 1 - len(row))]
        rotor = None if part.rotor is None else (part.rotor[0], [*part.rotor[1], zero])
        return part._replace(added_mass=added_mass, reaction=[*part.reaction, torque], rotor=rotor)

    def _imbalance_derivatives(self, t: Array, state: ExciterState) -> tuple[list[Array], list[Array]] | None:
        """Return two derivatives of d(theta), which has an entry for each row of the mount: the first moment of the unbalance
        and of the imbalances of the effects, kg m (kg m^2 for tilts). Return None without unbalance and imbalances.

        The first derivative is d'. The second is d'' theta'^2 under a motor, and the second time derivative of d under an ideal
        drive.
        """
        terms = terms_of(self.effects, RotorImbalance)
        if not terms and self.unbalance is None:
            return None
        rotor_angle, rate = self.drive.rotor_angle(t, state.rotor), self.drive.rotor_speed(t, state.rotor)

        def imbalance(angle: Array) -> tuple[Array, ...]:
            of_effects = [term.at(angle) for term in terms]
            vectors = [each.static for each in of_effects]
            if self.unbalance is not None:
                vectors.append((self.unbalance * jnp.cos(angle), self.unbalance * jnp.sin(angle)))
            static = tuple(total(each[axis] for each in vectors) for axis in self.axes)
            if self.block_count == 1:
                return static
            moments = [[each.moment[axis] for each in of_effects] for axis in self.axes]
            for lever in self.rotor_levers[1:]:
                for each, axis in zip(moments, self.axes, strict=True):
                    each.append(scaled(lever, total(imbalance.static[axis] for imbalance in of_effects)))
            return (*static, *(total(each) if each else jnp.zeros_like(angle) for each in moments))

        def slope(angle: Array) -> tuple[Array, ...]:
            return jax.jvp(imbalance, (angle,), (jnp.ones_like(angle),))[1]

        first, curvature = jax.jvp(slope, (rotor_angle,), (jnp.ones_like(rotor_angle),))
        second = [c * rate**2 for c in curvature]
        acceleration = self.drive.rotor_acceleration(t)
        if acceleration is not None:
            second = [s + d * acceleration for s, d in zip(second, first, strict=True)]
        return list(first), second

    def weight_torque(self, t: Array, state: ExciterState) -> Array | None:
        """Return g dh/dtheta, the torque of gravity against the rotor's rotation, N m; None without unbalance and imbalances,
        or without gravity in the rotor's plane.

        h = S sin(theta) + sum M e sin(theta + angle) is the upward component of the first moment of the unbalance and of the
        imbalances of the effects, kg m.
        """
        g, imbalances = total_gravity(self.effects), static_imbalances(self.effects)
        if 1 not in g or (self.unbalance is None and not imbalances):
            return None
        angle = self.drive.rotor_angle(t, state.rotor)
        torques = [] if self.unbalance is None else [self.unbalance * g[1] * jnp.cos(angle)]
        torques += [g[1] * term.at(angle).static[0] for term in imbalances]  # d sin/dtheta = cos, the horizontal component
        return total(torques)

    def _weight_torque_if_needed(self, t: Array, state: ExciterState, housing: Array | None) -> Array | None:
        """Return `weight_torque`; None under an ideal drive whose reaction on the housing has no effect."""
        return None if state.rotor is None and housing is None else self.weight_torque(t, state)

    def _total(self, values: Array, *levers: Array | None) -> Array:
        """Return the sum of `values` over all loads; for a rotor without loads, return `values` unchanged."""
        return values


class ExciterDynamics(RotorDynamics):
    """Rotor of an exciter with its `loads`."""

    loads: Loads

    @property
    def can_slide(self) -> bool:
        return has_term(self.effects, SlipRelease)

    def motion(self, t: Array, state: ExciterState, speed: Array, housing: Array | None) -> Motion:
        imbalance_derivatives = self._imbalance_derivatives(t, state)
        of_loads = kinematics(self.loads, state.angle, state.rate)
        drag_torque, force = self._forces(state, speed)
        g = total_gravity(self.effects)
        terms = terms_of(self.effects, ContactFriction)
        unsigned = (term.friction(self.loads, state.angle, state.rate, speed, g) for term in terms)
        friction = [each.signed({}) if each.normal_force_per_acceleration is None else each for each in unsigned]
        contact = ContactSolution(self.loads.inertia_factor(), force, friction)
        weight = self._weight_torque_if_needed(t, state, housing)
        return Motion(state, speed, imbalance_derivatives, of_loads, drag_torque, weight, contact, housing, t)

    def eliminate(self, motion: Motion, contact: ContactSolution) -> Eliminated:
        loads, axes, of_loads = self.loads, self.axes, motion.kinematics
        drag_torque, force, coupling = self._add_friction(motion.drag_torque, contact)
        m = loads.mass
        inertia = contact.kappa * m
        solve = small_inverse([[inertia * g for g in row] for row in of_loads.metric])
        if of_loads.curvature_along is not None:
            force = [f - inertia * along for f, along in zip(force, of_loads.curvature_along, strict=True)]
        free = solve(tuple(force))
        rows = {axis: [m * column[axis] for column in of_loads.columns] for axis in axes}
        rows = {axis: [r - p[axis] if p else r for r, p in zip(row, coupling, strict=True)] for axis, row in rows.items()}
        response_to_carrier = {axis: solve(tuple(row)) for axis, row in rows.items()}
        added_mass, reaction = self._reaction_of_loads(of_loads, free, response_to_carrier)
        added_mass, reaction, rotor = self._add_rotor(motion, added_mass, reaction, drag_torque, coupling[0])
        part = Eliminated(free, response_to_carrier, added_mass, reaction, rotor)
        if contact.on_rotor is not None and self.housing_row is not None:
            drag_torque, _, coupling = self._add_friction(motion.drag_torque, contact._replace(friction=contact.on_rotor))
        return self._add_housing(motion, part, drag_torque, coupling[0])

    def at_loads(self, a: Sequence[Array]) -> Axes:
        n = len(self.axes)
        moved = (a[k : k + n] for k in range(0, len(a), n))
        terms = [[scaled(lever, x) for x in row] for lever, row in zip(self.levers, moved, strict=False)]
        return {axis: total(row[k] for row in terms) for k, axis in enumerate(self.axes)}

    def slide(self, motion: Motion, contact: ContactSolution, part: Eliminated, a: Sequence[Array]) -> ContactSolution:
        slip, state = self._slip(motion.state), motion.state
        if slip is None:
            return contact
        at_loads = self.at_loads(a)
        acceleration = part.acceleration(at_loads)
        normal_force = self.loads.normal_force(state.angle, state.rate, total_gravity(self.effects))
        assert normal_force is not None
        centre = self.centre_forces(state, motion.speed)
        needed = contact_force(self.loads, motion.kinematics, acceleration, at_loads, centre, 1.0)
        (limit,) = terms_of(self.effects, SlipRelease)
        return resolve_contact(
            self.loads, motion.kinematics, slip, limit, normal_force, at_loads, needed, contact.force, centre, contact.friction
        )

    def rates(self, motion: Motion, rolling: ContactSolution, part: Eliminated, a: Sequence[Array]) -> ExciterState:
        state, speed = motion.state, motion.speed
        rotor = self._rotor_rates(motion, part, a)
        at_loads = self.at_loads(a)
        acceleration = part.acceleration(at_loads)
        slip = self._slip(state)
        slip_change = None if slip is None else self._slip_change(motion, slip, rolling, acceleration, at_loads)
        drilling = self._drilling_spin(state, speed)
        spin = None if drilling is None and slip is None else Spin(None if drilling is None else drilling.rate, slip_change)
        return ExciterState(state.rate, acceleration, rotor, spin)

    def centre_forces(self, state: ExciterState, speed: Array) -> list[Array]:
        """Return the generalized forces at the centres of the loads, without contact forces; N m for an angle."""
        return self._forces(state, speed, rotation=False)[1]

    def _forces(self, state: ExciterState, speed: Array, *, rotation: bool = True) -> tuple[Array, list[Array]]:
        """Return the torque of the drag, and the generalized forces on the loads without friction. If `rotation` is False, the
        forces that turn a load about its own centre are not included either."""
        loads = self.loads
        resistance = loads.resistance(state.angle, state.rate, speed)
        force = list(resistance)
        spin_force = loads.spin_force(state.angle, state.rate, speed) if rotation else None
        if spin_force is not None:
            force = [f + s for f, s in zip(force, spin_force, strict=True)]
        drilling = self._drilling_spin(state, speed) if rotation else None
        if drilling is not None:
            assert state.spin is not None and state.spin.drilling is not None
            force = [f + state.spin.drilling * s for f, s in zip(force, drilling.force, strict=True)]
        for term in terms_of(self.effects, LoadPotential, LoadResistance, LoadInteraction):
            for extra in term.forces(loads, state.angle, state.rate):
                force = [f + e for f, e in zip(force, extra, strict=True)]
        return resistance[0], force

    def _add_friction(self, drag_torque: Array, contact: ContactSolution) -> tuple[Array, list[Array], list[Axes]]:
        """Return the drag torque and the forces, both with the friction at zero acceleration, and for each coordinate of a load
        the friction per acceleration, by axis; {} if the friction does not depend on the accelerations."""
        force, coupling = list(contact.force), [dict[int, Array]() for _ in contact.force]
        for each in contact.friction:
            frictions = [lever * each.static_normal_force for lever in (each.lever, *each.others)]
            drag_torque = drag_torque + frictions[0]
            for i, (friction, lever) in enumerate(zip(frictions, (each.lever, *each.others), strict=True)):
                force[i] = force[i] + friction
                if each.normal_force_per_acceleration is not None:
                    coupling[i] = {
                        axis: lever * each.normal_force_per_acceleration[axis] + coupling[i].get(axis, 0.0)
                        for axis in self.axes
                    }
        return drag_torque, force, coupling

    def _reaction_of_loads(
        self, of_loads: Kinematics, free: tuple[Array, ...], response_to_carrier: Mapping[int, tuple[Array, ...]]
    ) -> tuple[list[list[Array | float]], list[Array | float]]:
        """Return added mass and reaction of the loads, each of which acts on a row of the mount with its lever on this row."""
        m, axes, levers = self.loads.mass, self.axes, self.levers
        columns = {axis: [column[axis] for column in of_loads.columns] for axis in axes}
        mass = {(i, k): m * (1.0 if i == k else 0.0) - m * dot(columns[i], response_to_carrier[k]) for i in axes for k in axes}
        moments = {
            (i, k, low, high): self._total(mass[i, k], levers[low], levers[high])
            for i, k in mass
            for low in range(len(levers))
            for high in range(low, len(levers))
        }
        rows = [(row, axis) for row in range(self.block_count) for axis in axes]
        added_mass = [[moments.get((i, k, min(a, b), max(a, b)), 0.0) for b, k in rows] for a, i in rows]
        load_reaction = {i: m * (dot(columns[i], free) + of_loads.curvature[i]) for i in axes}
        return added_mass, [self._total(load_reaction[i], levers[row]) if row < len(levers) else 0.0 for row, i in rows]

    def _slip_change(
        self, motion: Motion, slip: tuple[Array, ...], rolling: ContactSolution, acceleration: tuple[Array, ...], at_loads: Axes
    ) -> tuple[Array, ...]:
        """Return the rate of each slip: the part of the force required for rolling that the contact cannot transmit, divided
        by the inertia of the load's rotation."""
        force, state, loads = list(rolling.force), motion.state, self.loads
        for each in rolling.friction:
            for i, f in enumerate(each.linear(at_loads)):
                force[i] = force[i] + f
        lacking = contact_force(loads, motion.kinematics, acceleration, at_loads, force, rolling.kappa)
        inertia = (rolling.kappa - 1.0) * loads.mass
        return slip_rates(loads, state.angle, state.rate, slip, [f / inertia for f in lacking])

    def _slip(self, state: ExciterState) -> tuple[Array, ...] | None:
        if not self.can_slide:
            return None
        if state.spin is None or state.spin.slip is None:
            raise InputError(
                "state.spin",
                "has no sliding velocity (spin.slip), but an effect of the scene needs it; use with_spin(scene, state)",
            )
        return state.spin.slip

    def _drilling_spin(self, state: ExciterState, speed: Array) -> DrillingSpin | None:
        if not has_term(self.effects, DrillingSpinRelease):
            return None
        if state.spin is None or state.spin.drilling is None:
            raise InputError(
                "state.spin",
                "has no spin about the contact normal (spin.drilling), but an effect of the scene "
                "needs it; use with_spin(scene, state)",
            )
        return self.loads.drilling_spin(state.angle, state.rate, speed, state.spin.slip)

    def _total(self, values: Array, *levers: Array | None) -> Array:
        for lever in levers:
            values = scaled(lever, values)
        return jnp.sum(jnp.broadcast_to(values, (self.loads.count,)))


def depends_on_acceleration(contact: ContactSolution) -> bool:
    return any(each.normal_force_per_acceleration is not None for each in contact.friction)


def without_coupling(contact: ContactSolution) -> ContactSolution:
    """Return the contact without the friction that depends on the accelerations."""
    return contact._replace(friction=[each for each in contact.friction if each.normal_force_per_acceleration is None])


def signed(contact: ContactSolution, at_loads: Axes) -> ContactSolution:
    """Return the contact with friction that is linear in the accelerations: each normal force keeps its sign at `at_loads`."""
    friction: list[Friction] = [
        each if each.normal_force_per_acceleration is None else each.signed(at_loads) for each in contact.friction
    ]
    return contact._replace(friction=friction)
