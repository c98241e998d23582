"""The one place where a scene becomes equations of motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.sliding import Kinematics, contact_force, dot, kinematics, resolve_contact, slip_rates, total
from jaxvib.errors import InputError
from jaxvib.machine.drive import Drive
from jaxvib.machine.effects.base import Effect, has_term, terms_of, total_gravity
from jaxvib.machine.effects.terms import (
    ContactFriction,
    DrillingSpinRelease,
    Friction,
    LoadInteraction,
    LoadPotential,
    LoadResistance,
    RotorImbalance,
    SlipRelease,
    SupportForce,
)
from jaxvib.machine.loads import DrillingSpin, Loads
from jaxvib.machine.mount import scaled
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import small_inverse, small_solve, times

__all__ = ["Dynamics", "Spin", "State", "vector_field"]


class Spin(eqx.Module):
    """Free rotation of rolling loads, if effects release it (`FreeSpin`, `Sliding`); also the time derivative of one.

    **Attributes**: `drilling` (count,) rad/s, a load's spin about the normal of its contact, relative to its track; `slip`, a
    (count,) array m/s for each coordinate of a load, the velocity of its point of contact relative to the track along that
    coordinate. Each is None if no effect releases it.
    """

    drilling: Array | None = None
    slip: tuple[Array, ...] | None = None


class State(eqx.Module):
    """Positions and velocities of all parts; also the time derivative of such a state.

    **Attributes**: `displacement` q (nd,) m and `velocity` q' (nd,) m/s of the carrier's coordinates; `angle` and `rate`, a
    tuple of (count,) arrays, one for each coordinate of a load: for loads on a circle ((phi_1, ...),) in rad and rad/s;
    `rotor` the rotor's angle and speed, rad and rad/s, where a motor drives it, None under an ideal drive; `spin` of the loads
    where effects make it free, see `Spin` and `with_spin`, else None.
    """

    displacement: Array
    velocity: Array
    angle: tuple[Array, ...]
    rate: tuple[Array, ...]
    rotor: tuple[Array, Array] | None = None
    spin: Spin | None = None

    @property
    def azimuth(self) -> Array:
        """The loads' angles about the rotor's axis, (..., count) rad: the first of their coordinates."""
        return self.angle[0]

    @property
    def azimuth_rate(self) -> Array:
        """Their rates, (..., count) rad/s."""
        return self.rate[0]


class _Support(eqx.Module):
    """Place of a `SupportForce`: `rows` (k, nd) of its displacements; `push` (nd, k), acceleration per force there."""

    rows: Array
    push: Array


class _Eliminated(NamedTuple):
    """The loads without their own accelerations u'' = free - answers . a, a the acceleration of what carries each of them.

    They push the port with -(weight a + reaction), and take the torque `drag` + `pull` . a (each (count,)) off the rotor.
    """

    free: tuple[Array, ...]
    answers: dict[int, tuple[Array, ...]]
    weight: list[list[Array]]
    reaction: list[Array]
    drag: Array
    pull: dict[int, Array] | None

    def change(self, a: dict[int, Array]) -> tuple[Array, ...]:
        """u''."""
        return tuple(f - sum(self.answers[axis][i] * x for axis, x in a.items()) for i, f in enumerate(self.free))


class Dynamics(eqx.Module):
    """A scene made ready for time integration: all that does not change with time is computed once, here.

    The carrier is solved for its accelerations, q'' = flow - with M's inverse already applied. P are the rows of the mount that
    move loads, one below the other, and if the rotor is out of balance those that move it too:

    - `stiffness` M^-1 K, `damping` M^-1 C, `gyroscopic` M^-1 G (or None), (nd, nd)
    - `push` M^-1 P^T (nd, nP): acceleration per force at the port; `mobility` P M^-1 P^T (nP, nP); `port` P (nP, nd)
    - `levers` of the loads and `rotor_levers`, see `Mount`; `supports`, a place for each `SupportForce`
    """

    stiffness: Array
    damping: Array
    gyroscopic: Array | None
    push: Array
    mobility: Array
    port: Array
    levers: tuple[Array | None, ...]
    rotor_levers: tuple[Array | None, ...]
    supports: tuple[_Support, ...]
    loads: Loads
    drive: Drive
    effects: tuple[Effect, ...]
    axes: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Array, state: State) -> State:
        """The time derivative of `state` at time `t`.

        Each load is eliminated first. With J = p'(u), c = (dJ/dt) u', H = kappa m J^T J and r = Q_u - kappa m J^T c it obeys
        u'' = H^-1 (r - E a), a the acceleration of the point that carries it, and pushes that point with -(W a + g),
        W = m 1 - m J H^-1 E, g = m (J H^-1 r + c). E is m J^T, less what a friction proportional to the load's reaction adds.
        A motor's rotor that is out of balance is one more such body. What is left is (1 + mobility W) a = a_free - mobility g,
        one equation for each row of P, however many platforms and loads there are.
        """
        speed = self.drive.rotor_speed(t, state.rotor)
        unforced = self._unforced(state, speed)
        throw = self._throw(t, state)
        loads = kinematics(self.loads, state.angle, state.rate)
        drag, force = self._forces(state, speed)

        def accelerations(
            friction: Sequence[Friction], force: Sequence[Array], kappa: Array
        ) -> tuple[list[Array], Array, _Eliminated, Array | None]:
            part = self._eliminate(loads, drag, force, kappa, friction)
            weight, reaction, rotor = self._with_rotor(part, throw, speed)
            a, carrier = self._close(weight, reaction, unforced)
            return a, carrier, part, None if rotor is None else rotor[0] - dot(rotor[1], a)

        friction, kappa = self._friction(state, speed), self.loads.inertia_factor()
        if any(each.normal is not None for each in friction):
            # The sign of a reaction that depends on the accelerations: that of the motion without its friction.
            plain = [each for each in friction if each.normal is None]
            at_loads = self._at_loads(accelerations(plain, force, kappa)[0])
            friction = [each if each.normal is None else each.signed(at_loads) for each in friction]
        a, carrier, part, rotor = accelerations(friction, force, kappa)
        at_loads = self._at_loads(a)
        change = part.change(at_loads)
        slip = self._slip(state)
        if slip is not None:
            # Whether a load sticks or slides: by what the motion in which all of them roll asks of its contact.
            u, rate = state.angle, state.rate
            normal_force = self.loads.normal_force(u, rate, total_gravity(self.effects))
            assert normal_force is not None
            centre = self.centre_forces(state, speed)
            needed = contact_force(self.loads, loads, change, at_loads, centre, 1.0)
            (limit,) = terms_of(self.effects, SlipRelease)
            moved = resolve_contact(self.loads, loads, slip, limit, normal_force, at_loads, needed, force, centre, friction)
            a, carrier, part, rotor = accelerations(moved.friction, moved.force, moved.kappa)
            at_loads = self._at_loads(a)
            change = part.change(at_loads)
            rolled = list(force)
            for each in friction:
                for i, f in enumerate(each.linear(at_loads)):
                    rolled[i] = rolled[i] + f
            lacking = contact_force(self.loads, loads, change, at_loads, rolled, kappa)
            inertia = (kappa - 1.0) * self.loads.mass
            slip_change = slip_rates(self.loads, u, rate, slip, [f / inertia for f in lacking])
        else:
            slip_change = None
        drilling = self._drilling_spin(state, speed)
        spin = None if drilling is None and slip is None else Spin(None if drilling is None else drilling.rate, slip_change)
        return State(state.velocity, carrier, state.rate, change, None if rotor is None else (speed, rotor), spin)

    def _slip(self, state: State) -> tuple[Array, ...] | None:
        if not has_term(self.effects, SlipRelease):
            return None
        if state.spin is None or state.spin.slip is None:
            raise InputError("state.spin", "has no slip, which an effect of the scene releases; see with_spin(scene, state)")
        return state.spin.slip

    def _drilling_spin(self, state: State, speed: Array) -> DrillingSpin | None:
        if not has_term(self.effects, DrillingSpinRelease):
            return None
        if state.spin is None or state.spin.drilling is None:
            raise InputError(
                "state.spin", "has no drilling spin, which an effect of the scene releases; see with_spin(scene, state)"
            )
        return self.loads.drilling_spin(state.angle, state.rate, speed, state.spin.slip)

    def _unforced(self, state: State, speed: Array) -> Array:
        """Accelerations of the carrier without loads and imbalance."""
        flow = -times(self.stiffness, state.displacement) - times(self.damping, state.velocity)
        if self.gyroscopic is not None:
            flow = flow - speed * times(self.gyroscopic, state.velocity)
        for term, support in zip(terms_of(self.effects, SupportForce), self.supports, strict=True):
            x, v = times(support.rows, state.displacement), times(support.rows, state.velocity)
            flow = flow - times(support.push, term.force(x, v))
        return flow

    def _friction(self, state: State, speed: Array) -> list[Friction]:
        g = total_gravity(self.effects)
        terms = terms_of(self.effects, ContactFriction)
        found = (term.friction(self.loads, state.angle, state.rate, speed, g) for term in terms)
        return [each.signed({}) if each.normal is None else each for each in found]

    def _forces(self, state: State, speed: Array, *, rotation: bool = True) -> tuple[Array, list[Array]]:
        """The torque of the drag, and the generalised forces on the loads but for friction; without a `rotation` of their own
        those at their centres alone."""
        loads = self.loads
        torque = loads.resistance(state.angle, state.rate, speed)
        force = list(torque)
        turning = loads.spin_force(state.angle, state.rate, speed) if rotation else None
        if turning is not None:
            force = [f + s for f, s in zip(force, turning, strict=True)]
        drilling = self._drilling_spin(state, speed) if rotation else None
        if drilling is not None:
            assert state.spin is not None and state.spin.drilling is not None
            force = [f + state.spin.drilling * s for f, s in zip(force, drilling.force, strict=True)]
        for term in terms_of(self.effects, LoadPotential, LoadResistance, LoadInteraction):
            for extra in term.forces(loads, state.angle, state.rate):
                force = [f + e for f, e in zip(force, extra, strict=True)]
        return torque[0], force

    def centre_forces(self, state: State, speed: Array) -> list[Array]:
        """The generalised forces that act at the loads' centres, the contact with their track left out, N m of an angle."""
        return self._forces(state, speed, rotation=False)[1]

    def _eliminate(
        self, found: Kinematics, drag: Array, force: Sequence[Array], kappa: Array, friction: Sequence[Friction]
    ) -> _Eliminated:
        loads, axes, force = self.loads, self.axes, list(force)
        columns, curvature = found.columns, found.curvature
        pulls: list[dict[int, Array]] = [{} for _ in force]
        for each in friction:
            rubs = [lever * each.reaction for lever in (each.lever, *each.others)]
            drag = drag + rubs[0]
            for i, (rub, lever) in enumerate(zip(rubs, (each.lever, *each.others), strict=True)):
                force[i] = force[i] + rub
                if each.normal is not None:
                    pulls[i] = {axis: lever * each.normal[axis] + pulls[i].get(axis, 0.0) for axis in axes}
        m = loads.mass
        inertia = kappa * m
        solve = small_inverse([[inertia * g for g in row] for row in found.metric])
        if found.turning is not None:
            force = [f - inertia * turned for f, turned in zip(force, found.turning, strict=True)]
        free = solve(tuple(force))
        rows = {axis: [m * column[axis] for column in columns] for axis in axes}
        rows = {axis: [r - p[axis] if p else r for r, p in zip(row, pulls, strict=True)] for axis, row in rows.items()}
        answers = {axis: solve(tuple(row)) for axis, row in rows.items()}
        across = {axis: [column[axis] for column in columns] for axis in axes}
        # Every row of the mount feels each load by the load's lever; rows that move no load feel none.
        levers, onto = self.levers, [(row, i) for row in range(self.port.shape[0] // len(axes)) for i in axes]
        own = {(i, k): m * (1.0 if i == k else 0.0) - m * dot(across[i], answers[k]) for i in axes for k in axes}
        pairs = [(low, high) for low in range(len(levers)) for high in range(low, len(levers))]
        moments = {(i, k, *pair): self._total(own[i, k], *(levers[row] for row in pair)) for i, k in own for pair in pairs}
        zero = jnp.zeros_like(moments[axes[0], axes[0], 0, 0])
        weight = [
            [moments.get((i, k, min(first, second), max(first, second)), zero) for second, k in onto] for first, i in onto
        ]
        push = {i: m * (dot(across[i], free) + curvature[i]) for i in axes}
        reaction = [self._total(push[i], levers[row]) if row < len(levers) else zero for row, i in onto]
        return _Eliminated(free, answers, weight, reaction, drag, pulls[0] or None)

    def _with_rotor(
        self, part: _Eliminated, throw: tuple[list[Array], list[Array]] | None, speed: Array
    ) -> tuple[list[list[Array]], list[Array], tuple[Array, list[Array]] | None]:
        """Weight and reaction with the rotor's imbalance, and its own acceleration as (free, row): theta'' = free - row . a."""
        motor = self.drive.torque_and_inertia(speed)
        if motor is None:
            if throw is None:
                return part.weight, part.reaction, None
            return part.weight, [g + b for g, b in zip(part.reaction, throw[1], strict=True)], None
        torque, inertia = motor
        free = (torque - self._total(part.drag)) / inertia
        row = [jnp.zeros_like(free)] * len(part.reaction)
        if part.pull is not None:
            row = [self._total(part.pull[i], lever) / inertia for lever in self.levers for i in self.axes]
            row += [jnp.zeros_like(free)] * (len(part.reaction) - len(row))
        if throw is None:
            return part.weight, part.reaction, (free, row)
        along, bend = throw
        row = [r + d / inertia for r, d in zip(row, along, strict=True)]
        weight = [[w - d * r for w, r in zip(line, row, strict=True)] for line, d in zip(part.weight, along, strict=True)]
        reaction = [g + b + d * free for g, b, d in zip(part.reaction, bend, along, strict=True)]
        return weight, reaction, (free, row)

    def _throw(self, t: Array, state: State) -> tuple[list[Array], list[Array]] | None:
        """With d(theta) (nP,) what is out of balance: d' and, under a motor d'' theta'^2, under an ideal drive d''/dt^2."""
        terms = terms_of(self.effects, RotorImbalance)
        if not terms:
            return None
        turn, rate = self.drive.rotor_angle(t, state.rotor), self.drive.rotor_speed(t, state.rotor)

        def thrown(angle: Array) -> tuple[Array, ...]:
            found = [term.at(angle) for term in terms]
            static = tuple(total(imbalance.static[axis] for imbalance in found) for axis in self.axes)
            if self.port.shape[0] == len(static):
                return static
            moment = tuple(total(imbalance.moment[axis] for imbalance in found) for axis in self.axes)
            for lever in self.rotor_levers[1:]:
                moment = tuple(x + scaled(lever, y) for x, y in zip(moment, static, strict=True))
            return (*static, *moment)

        def slope(angle: Array) -> tuple[Array, ...]:
            return jax.jvp(thrown, (angle,), (jnp.ones_like(angle),))[1]

        along, bend = jax.jvp(slope, (turn,), (jnp.ones_like(turn),))
        push = [b * rate**2 for b in bend]
        change = self.drive.rotor_acceleration(t)
        if change is not None:
            push = [p + d * change for p, d in zip(push, along, strict=True)]
        return list(along), push

    def _close(self, weight: list[list[Array]], reaction: list[Array], unforced: Array) -> tuple[list[Array], Array]:
        """Accelerations of P's rows and of the carrier."""
        n = len(reaction)
        free = times(self.port, unforced)
        matrix = [
            [(1.0 if i == k else 0.0) + sum(self.mobility[i, j] * weight[j][k] for j in range(n)) for k in range(n)]
            for i in range(n)
        ]
        right = tuple(free[i] - sum(self.mobility[i, j] * reaction[j] for j in range(n)) for i in range(n))
        a = small_inverse(matrix)(right)
        push = [-sum(weight[i][k] * a[k] for k in range(n)) - reaction[i] for i in range(n)]
        return list(a), unforced + sum(self.push[:, i] * push[i] for i in range(n))

    def _at_loads(self, a: list[Array]) -> dict[int, Array]:
        """Accelerations of the points that carry the loads, by axis."""
        n = len(self.axes)
        moved = (a[k : k + n] for k in range(0, len(a), n))
        terms = [[scaled(lever, x) for x in row] for lever, row in zip(self.levers, moved, strict=False)]
        return {axis: total(row[k] for row in terms) for k, axis in enumerate(self.axes)}

    def _total(self, values: Array, *levers: Array | None) -> Array:
        """The sum over all loads."""
        for lever in levers:
            values = scaled(lever, values)
        return jnp.sum(jnp.broadcast_to(values, (self.loads.count,)))


@validated
def vector_field(scene: Scene) -> Dynamics:
    """The right-hand side of the scene's equations of motion.

        M q'' + (C + speed G) q' + K q + sum_j m_j B_j^T (B_j q'' + d^2 p_j/dt^2) = what the effects add
        kappa m J^T J u'' + kappa m J^T (dJ/dt) u' + m J^T B_j q'' = Q_u        (J = dp/du, for each load)
        J_r theta'' = T(theta') - what loads and imbalance take off              (under a motor)

    **Returns** `Dynamics`, a pure function of time (s) and `State` that gives the state's time derivative; `jit`, `vmap` and
    `grad` go through it and through the scene.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> rest = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> round(float(jv.vector_field(scene)(0.0, rest).rate[0][0]), 4)     # b_W n / (kappa m), the platform giving way
    143.8746

    Source: the general form of all five papers; for platforms the antiphase paper, equation (2), for stations Artyunin 2013,
    equation (1). A gyroscopic matrix acts with the rotor's speed alone: what its change would add, C theta'' psi / 2, is left
    out as in the paper.
    """
    carrier, mount, effects = scene.machine.carrier(), scene.machine.mount(), scene.effects
    moving = mount.rows if has_term(effects, RotorImbalance) else mount.rows[: len(mount.levers)]
    port = moving[0] if len(moving) == 1 else jnp.concatenate(moving)
    places = [term.rows(scene.machine) for term in terms_of(effects, SupportForce)]
    parts = [carrier.stiffness, carrier.damping, port.T, *(rows.T for rows in places)]
    if mount.gyroscopic is not None:
        parts.append(mount.gyroscopic)
    solved = small_solve(carrier.mass, jnp.concatenate(parts, axis=1))
    stiffness, damping, push, *rest = jnp.split(solved, np.cumsum([part.shape[1] for part in parts])[:-1], axis=1)
    return Dynamics(
        stiffness=stiffness,
        damping=damping,
        gyroscopic=None if mount.gyroscopic is None else rest[-1],
        push=push,
        mobility=port @ push,
        port=port,
        levers=mount.levers,
        rotor_levers=mount.rotor_levers,
        supports=tuple(map(_Support, places, rest)),
        loads=scene.loads,
        drive=scene.drive,
        effects=tuple(effect.prepare(scene.loads) for effect in effects),
        axes=mount.axes,
    )
