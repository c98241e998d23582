"""Forces, energy and power of a state.

Symbols: q are the coordinates of the carrier, M, C and K its mass, damping and stiffness matrices. P maps q to the displacement
of the axis of the rotor, and B_j to that of the point that carries load j. theta is the angle of the rotor. Load j has the mass
m_j, the inertia factor kappa_j (7/5 for balls), the coordinates u_j, and the position p_j(u_j) relative to its point. u_j is
the angle phi_j for a load on a circle of radius R. b_W is the drag. The prime of d(theta) is d/dtheta; all other primes are
time derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.dynamics import Dynamics, dynamics_of
from jaxvib.equations.exciter import ExciterDynamics, RotorDynamics
from jaxvib.equations.model import Model, assemble
from jaxvib.equations.sliding import contact_force, dot, kinematics
from jaxvib.equations.state import ExciterState, State, require_motion, require_state
from jaxvib.errors import InputError
from jaxvib.machine.carrier import Mount
from jaxvib.machine.effects.base import Effect, static_imbalances, terms_of, total_gravity
from jaxvib.machine.effects.terms import (
    ContactFriction,
    LoadInteraction,
    LoadPotential,
    LoadResistance,
    RotorImbalance,
    SupportForce,
)
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.devices import float_dtype
from jaxvib.runtime.programs import cached
from jaxvib.units import Number, known_number, numbers
from jaxvib.units.known import require_finite


@validated
def foundation_force(scene: Scene, state: State) -> Array:
    """Return the force of all supports on the foundation, gravity excluded, N.

        F = sum_i (k_i y_i + b_i y_i')

    y_i is the displacement of the machine at support i, k_i and b_i are its stiffness and damping: numbers for platforms, 2 x 2
    matrices for other machines.

    **Arguments**

    - `scene`: supports of the machine and effects that are supports (`CubicSupport`, `Stop`, `FrictionSupport`) are included
    - `state` of the scene; typical: displacements of 0.1 to 10 mm

    **Returns** an array, N: one entry (up) for platforms, two (horizontal, up) for rotors and bodies in a plane; NaN for
    `from_matrices` without a `foundation`.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> state = jv.State(jnp.array([1e-3]), jnp.array([0.1]), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> float(jv.foundation_force(scene, state)[0])
    43.0

    Source: the antiphase paper, equation (7).
    """
    require_motion(scene := validate_scene(scene), state, "state")
    model = assemble(scene)
    return model.known_force(model.foundation_force(jnp.asarray(state.displacement), jnp.asarray(state.velocity)))


@validated
def foundation_moment(scene: Scene, state: State, about: Sequence[Number] = (0.0, 0.0)) -> Array:
    """Return the moment of all supports on the foundation about a fixed point, gravity excluded, N m, anticlockwise.

        sum_i (r_i - p) x (k_i y_i + b_i y_i')

    r_i is the position of support i at rest; y_i, k_i and b_i as in `foundation_force`.

    **Arguments**

    - `scene`, whose machine is a body in a plane, or several bodies, only one of which stands on the foundation
    - `state` of the scene
    - `about` p (2,), m, measured from the position of this body's centre of mass at rest (the default); typical: the middle of
      the foundation

    **Returns** a number, N m. **Raises** `InputError` for another machine; `ComputationError` with the status "overflow" if the
    number is not finite.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(1e5, 2e5), damping=(500.0, 900.0)) for x in (-0.5, 1.0)]
    >>> motor = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
    >>> screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    >>> scene = jv.Scene(screen, exciters=[jv.Exciter(drive=motor, unbalance=0.4)])
    >>> state = jv.State(jnp.array([0.0, 1e-3, 0.0]), jnp.zeros(3), exciters=[jv.ExciterState(rotor=(0.0, 0.0))])
    >>> float(jv.foundation_moment(scene, state)), float(jv.foundation_moment(scene, state, about=(0.25, 0.0)))
    (100.0, 0.0)

    Source: equilibrium of the foundation.
    """
    rows = validate_scene(scene).machine.moment_rows(numbers(about, "m", "about", 2))
    require_motion(scene, state, "state")
    moment = rows[0] @ jnp.asarray(state.displacement) + rows[1] @ jnp.asarray(state.velocity)
    require_finite("parts of the foundation moment", moment)
    return moment


@validated
def energy(scene: Scene, state: State, t: Array | float = 0.0) -> Array:
    """Return the kinetic and potential energy of a state, J.

        E = q'.M q'/2 + q.K q/2 + sum_j [ m_j |B_j q' + p_j'|^2/2 + (kappa_j - 1) m_j |p_j'|^2/2 + V_j(u_j) ] + V(q)
            + theta' d'(theta).P q' + I_r theta'^2/2 + g d_up(theta)
            + sum_j [ (kappa_j - 1) m_j (|c_j|^2/2 - p_j'.c_j) + I_j s_j^2/2 ]

    - q are the coordinates of the carrier with the mass matrix M and the stiffness matrix K
    - load j has the mass m_j, the coordinates u_j, the position p_j relative to the point that carries it, and the inertia
      factor kappa_j (7/5 for balls); B_j q is the displacement of this point
    - theta is the angle of the rotor, and P q the displacement of its axis
    - V_j and V are the potentials of the effects on the loads and on the supports
    - d(theta) is the vector of the unbalance of the rotor and of its other imbalances, d_up its upward component, and d' the
      derivative with respect to theta
    - I_r is the inertia of a motor's rotor (an ideal drive has none); g is the gravity in the plane of the rotor
    - the terms of the loads and of the rotor are added over all exciters
    - c is the sliding velocity of a load's contact point and s its spin about the contact normal; each is 0 unless an effect
      permits it
    - I_j is the moment of inertia of a load about the contact normal

    **Arguments**

    - `scene` and a `state` of it
    - `t`, s: the time, which determines the angle of an ideal drive's rotor. The energy depends on it only if such a rotor has
      an unbalance or an imbalance; typical: 0 (the default)

    **Returns** a scalar, J. `jit`, `vmap` and `grad` apply to the function.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> state = jv.State(jnp.array([1e-3]), jnp.zeros(1), (jnp.zeros(1),), (jnp.array([20.0]),))
    >>> round(float(jv.energy(scene, state)), 4)      # k y^2 / 2 + 7/5 m (R phi')^2 / 2
    1.42

    Source: the energy of the equations in `vector_field`, derived here.
    """
    scene, state = _validated(scene, state)
    found = _energy(scene, state, known_number(t, "s", "t"))
    require_finite("parts of the energy", found)
    return found


def _validated(scene: Scene, state: State) -> tuple[Scene, State]:
    """Return the scene and the state with arrays in the precision of JAX. **Raises** `InputError` if they do not fit."""

    def array(leaf: Any) -> Array:
        return leaf if isinstance(leaf, Array) and leaf.dtype == float_dtype() else jnp.asarray(leaf, dtype=float)

    require_state(scene := validate_scene(scene), state, "state")
    return scene, jax.tree.map(array, state)


@cached
def _energy(scene: Scene, state: State, t: Array) -> Array:
    model = assemble(scene)
    q, v = state.displacement, state.velocity
    parts = [0.5 * (v @ model.carrier.mass @ v + q @ model.carrier.stiffness @ q)]
    t = jnp.asarray(t, q.dtype)
    for exciter, mount, part in zip(scene.exciters, model.mounts, state.exciters, strict=True):
        drive = exciter.turning_drive
        turn, rate = drive.rotor_angle(t, part.rotor), drive.rotor_speed(t, part.rotor)
        effects = (*scene.effects, *exciter.effects)
        if exciter.loads is not None:
            effects = tuple(effect.prepare(exciter.loads, mount) for effect in effects)
        parts += _load_energies(exciter.loads, mount, effects, v, part, rate)
        parts.append(rate * _imbalance_rate(exciter, mount, turn) @ v)
        weight = total_gravity(effects).get(1)
        if weight is not None:
            parts += [] if exciter.unbalance is None else [exciter.unbalance * weight * jnp.sin(turn)]
            parts += [weight * term.at(turn).static[1] for term in static_imbalances(effects)]
        motor = drive.torque_and_inertia(t, rate, (part.rotor or ())[2:])
        if motor is not None:
            parts.append(0.5 * motor[1] * rate**2)
    supports = zip(terms_of(scene.effects, SupportForce), model.supports, strict=True)
    parts += [term.energy(rows @ q) for term, rows in supports]
    return sum(parts[1:], parts[0])


def _load_energies(
    loads: Loads | None, mount: Mount, effects: tuple[Effect, ...], velocity: Array, state: ExciterState, speed: Array
) -> list[Array]:
    """Return the kinetic and potential energies of an exciter's loads, and the energy of their spin, J."""
    if loads is None:
        return []
    p_rate = jax.jvp(loads.position, state.angle, state.rate)[1]
    at_load = mount.load_rates(velocity)
    total = [rate + at_load.get(axis, 0.0) for axis, rate in enumerate(p_rate)]
    rotation = loads.inertia_factor() - 1.0
    parts = [jnp.sum(0.5 * loads.mass * (sum(w**2 for w in total) + rotation * sum(w**2 for w in p_rate)))]
    for term in terms_of(effects, LoadPotential, LoadInteraction):
        parts.append(jnp.sum(jnp.broadcast_to(term.energy(loads, state.angle), (loads.count,))))
    if state.spin is not None and state.spin.slip is not None:
        found = kinematics(loads, state.angle, state.rate)
        pairs = zip(state.spin.slip, found.columns, found.sizes, strict=True)
        parts += [jnp.sum(rotation * loads.mass * c * (0.5 * c - dot(column, p_rate) / size)) for c, column, size in pairs]
    if state.spin is not None and state.spin.drilling is not None:
        drilling = loads.drilling_spin(state.angle, state.rate, speed)
        assert drilling is not None
        parts.append(jnp.sum(0.5 * drilling.inertia * state.spin.drilling**2))
    return parts


@validated
def power(scene: Scene, t: Array | float, state: State) -> tuple[Array, Array]:
    """Return the power input by the rotor, and the power that dampers, drag and friction dissipate, W.

        P_in = speed T,    T = sum_j M_j + d'(theta).P q'' + g d_up'(theta)  (ideal drive),    the motor's torque otherwise
        P_diss = q'.C q' + sum_j M_j (speed - phi_j') + power of effects
        M_j = b_W R^2 (speed - phi_j') + friction

    - M_j is the torque of the rotor on load j with the angle phi_j, the drag b_W and the radius R; `friction` is the torque of
      contact friction
    - T is the torque with which an ideal drive turns its rotor against the loads, the unbalance with the other imbalances, and
      their weight; g is the gravity in the plane of the rotor
    - q are the coordinates of the carrier with the damping matrix C; d, P and theta as in `energy`
    - `speed` is the rotor speed. If the housing of the drive turns with the machine, the speed in P_in is that of the
      rotor relative to the housing
    - the effects that dissipate power are those on supports, contacts between loads, and resistances to the motion of the loads
    - loads that slide also dissipate the power -F_t.c of the contact force F_t at the sliding velocity c, and P_in includes the
      power that the spin of the loads needs

    The powers of all exciters are added. The rate of the energy is the difference, dE/dt = P_in - P_diss.

    **Arguments**

    - `scene` and a `state` of it
    - `t`, s: the time, which determines angle and speed of an ideal drive's rotor; typical: that of the state

    **Returns** two scalars, W: the power input and the dissipated power; typical: 10 to 5000 W.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> state = jv.State(jnp.zeros(1), jnp.array([0.1]), (jnp.zeros(1),), (jnp.array([20.0]),))
    >>> [round(float(p), 2) for p in jv.power(scene, 0.0, state)]     # b_W R^2 n (n - phi'), b_W R^2 (n - phi')^2 + b y'^2
    [80.0, 64.3]

    Source: derived here from `vector_field`; the drag of loads on machines with platforms: the antiphase paper, equation (2).
    """
    scene, state = _validated(scene, state)
    found = _power(scene, known_number(t, "s", "t"), state)
    require_finite("parts of the power", found)
    return found


@cached
def _power(scene: Scene, t: Array, state: State) -> tuple[Array, Array]:
    model = assemble(scene)
    field = dynamics_of(model)
    change = field(t, state)
    supplied, dissipated = [], [state.velocity @ model.carrier.damping @ state.velocity]
    for exciter, dynamics, mount, part, part_change in zip(
        scene.exciters, field.exciters, model.mounts, state.exciters, change.exciters, strict=True
    ):
        turn, speed = dynamics.drive.rotor_angle(t, part.rotor), dynamics.drive.rotor_speed(t, part.rotor)
        braking = jnp.zeros_like(speed)
        if isinstance(dynamics, ExciterDynamics):
            braking, spun, losses = _load_power(dynamics, part, part_change, mount.load_rates(change.velocity), speed)
            supplied.append(spun)
            dissipated += losses
        driven = speed if mount.turn is None else speed - mount.turn @ state.velocity
        supplied.append(driven * _drive_torque(t, exciter, dynamics, mount, part, change.velocity, (turn, driven, braking)))
    for term, rows in zip(terms_of(scene.effects, SupportForce), model.supports, strict=True):
        x, v = rows @ state.displacement, rows @ state.velocity
        if term.resistance is not None:
            dissipated.append(term.resistance(x, v) @ v)
    return sum(supplied[1:], supplied[0]), sum(dissipated[1:], dissipated[0])


def _drive_torque(
    t: Array,
    exciter: Exciter,
    dynamics: RotorDynamics,
    mount: Mount,
    state: ExciterState,
    acceleration: Array,
    rotor: tuple[Array, Array, Array],
) -> Array:
    """Return the torque of a drive, N m.

    **Arguments**: `acceleration` of the carrier; `rotor`: angle of the rotor, its speed relative to the housing, and the torque
    with which the loads brake it.
    """
    turn, driven, braking = rotor
    motor = dynamics.drive.torque_and_inertia(t, driven, (state.rotor or ())[2:])
    if motor is not None:
        return motor[0]
    torque = braking + _imbalance_rate(exciter, mount, turn) @ acceleration
    weight_torque = dynamics.weight_torque(t, state)
    return torque if weight_torque is None else torque + weight_torque


def drive_torques(model: Model, field: Dynamics, t: Array, state: State) -> tuple[Array, Array]:
    """Return the torque of each drive in the direction of its rotation, N m, and its power, W, as arrays (exciters,).

    The torque with which the rotor changes the spin of loads that spin or slide is not included. `field`: `dynamics_of(model)`.
    """
    change, torques, powers = field(t, state), [], []
    for exciter, dynamics, mount, part in zip(model.scene.exciters, field.exciters, model.mounts, state.exciters, strict=True):
        turn, speed = dynamics.drive.rotor_angle(t, part.rotor), dynamics.drive.rotor_speed(t, part.rotor)
        braking = jnp.zeros_like(speed)
        if isinstance(dynamics, ExciterDynamics):
            loads = dynamics.loads
            braking = jnp.sum(loads.resistance(part.angle, part.rate, speed)[0])
            for term in terms_of(dynamics.effects, ContactFriction):
                friction = term.friction(loads, part.angle, part.rate, speed, total_gravity(dynamics.effects))
                braking = braking + jnp.sum(friction.forces(mount.load_rates(change.velocity))[0])
        driven = speed if mount.turn is None else speed - mount.turn @ state.velocity
        torque = _drive_torque(t, exciter, dynamics, mount, part, change.velocity, (turn, driven, braking))
        torques.append(exciter.direction * torque)
        powers.append(driven * torque)
    return jnp.stack(torques), jnp.stack(powers)


def _load_power(
    exciter: ExciterDynamics, state: ExciterState, change: ExciterState, at_load: Mapping[int, Array], speed: Array
) -> tuple[Array, Array, list[Array]]:
    """Return the torque of the rotor on the loads, N m, the power of the rotor to spinning and sliding loads, W, and the
    dissipated powers, W."""
    loads, g = exciter.loads, total_gravity(exciter.effects)
    of_rotor = loads.resistance(state.angle, state.rate, speed)
    sliding, (supplied, lost_in_contact) = _spin_power(exciter, state, change, at_load, speed)
    dissipated = [lost_in_contact]
    for term in terms_of(exciter.effects, ContactFriction):
        friction = term.friction(loads, state.angle, state.rate, speed, g).forces(at_load)
        of_rotor = (*(f + r for f, r in zip(of_rotor, friction, strict=False)), *of_rotor[len(friction) :])
        dissipated += [jnp.sum(f * w) for f, w in zip(friction, sliding, strict=False)]
    for term in terms_of(exciter.effects, LoadResistance, LoadInteraction):
        if term.resistance is not None:
            resistance = term.resistance(loads, state.angle, state.rate)
            dissipated += [-jnp.sum(f * w) for f, w in zip(resistance, state.rate, strict=True)]
    braking = jnp.sum(of_rotor[0])
    dissipated += [speed * braking, *(-jnp.sum(f * w) for f, w in zip(of_rotor, state.rate, strict=True))]
    return braking, supplied, dissipated


def _spin_power(
    exciter: ExciterDynamics, state: ExciterState, change: ExciterState, at_load: Mapping[int, Array], speed: Array
) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
    """Return the sliding velocity c as rates of the coordinates, c_i / |dp/du_i|, and two powers, W: that of the rotor to loads
    that spin and slide, and that which sliding dissipates, without rolling friction."""
    loads, spin, zero = exciter.loads, state.spin, jnp.zeros(())
    if spin is None:
        return (), (zero, zero)
    u, rate = state.angle, state.rate
    supplied, lost, rates = zero, zero, ()
    if spin.drilling is not None:
        drilling = loads.drilling_spin(u, rate, speed)
        assert drilling is not None
        supplied = speed * jnp.sum(drilling.force[0] * spin.drilling)
    if spin.slip is not None:
        found = kinematics(loads, u, rate)
        rates = tuple(c / size for c, size in zip(spin.slip, found.sizes, strict=True))
        contact = contact_force(loads, found, change.rate, at_load, exciter.centre_forces(state, speed), 1.0)
        lost = -jnp.sum(dot(contact, spin.slip))
        turning = loads.spin_force(u, rate, speed)
        if turning is not None:
            supplied = supplied - jnp.sum(dot(turning, rates))
    return rates, (supplied, lost)


@validated
def normal_force(scene: Scene, t: Array | float, state: State) -> Array:
    """Return the force N with which each load presses on its track, (count,) N; negative if the track would have to pull.

        N = m (z - n . (a + g e)),      z = R phi'^2 for a load on a circle,      see `Loads.normal_force`

    m is the mass of the load, R the radius of its circle and phi its angle. z is the centrifugal acceleration of the motion of
    the load relative to the point that carries it, and a the acceleration of this point. The load presses in the direction n. g
    is the acceleration of gravity, and e the unit vector against gravity.
    If N is negative, the equations keep the load on its track. Its friction is then proportional to |N| on a circle and 0 in a
    torus.

    **Arguments**

    - `scene`, whose loads have a defined normal force
    - `t`, s: the time, which determines angle and speed of an ideal drive's rotor
    - `state` of the scene

    **Returns** an array (count,), N; typical: m R speed^2, 100 to 5000 N.

    **Raises** `InputError` for loads whose normal force is not defined.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> state = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.array([20.0]),))
    >>> float(jv.normal_force(scene, 0.0, state)[0])      # m R phi'^2
    20.0

    Source: Strautmanis et al. 2018, equation (10), with the acceleration of the rotor.
    """
    scene, state = _validated(scene, state)
    return _normal_force(scene, known_number(t, "s", "t"), state)


@cached
def _normal_force(scene: Scene, t: Array, state: State) -> Array:
    model = assemble(scene)
    acceleration = dynamics_of(model)(jnp.asarray(t, state.displacement.dtype), state).velocity
    forces = []
    for exciter, mount, part in zip(scene.exciters, model.mounts, state.exciters, strict=True):
        if exciter.loads is None:
            continue
        found = exciter.loads.normal_force(part.angle, part.rate, total_gravity(scene.effects))
        if found is None:
            problem = f"is {exciter.loads.kind!r}, whose normal force on the track is not defined (Loads.normal_force)"
            raise InputError("loads.kind", problem)
        forces.append(found.at(mount.load_rates(acceleration)))
    return forces[0] if len(forces) == 1 else jnp.concatenate([jnp.zeros(0, acceleration.dtype), *forces])


def _imbalance_rate(exciter: Exciter, mount: Mount, turn: Array) -> Array:
    """Return d'(theta).P (nd,) of the rotor's imbalance: its momentum along the coordinates of the carrier, per rotor speed."""
    static, moment = mount.rotor_rows(), mount.tilt
    row = jnp.zeros_like(static[0])
    for term in terms_of(exciter.effects, RotorImbalance):
        rate = jax.jvp(term.at, (turn,), (jnp.ones_like(turn),))[1]
        row = row + jnp.stack([rate.static[axis] for axis in mount.axes]) @ static
        if moment is not None:
            row = row + jnp.stack([rate.moment[axis] for axis in mount.axes]) @ moment
    if exciter.unbalance is not None:
        along = -jnp.sin(turn), jnp.cos(turn)
        row = row + exciter.unbalance * jnp.stack([along[axis] for axis in mount.axes]) @ mount.rows[0]
    return row
