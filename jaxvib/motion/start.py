"""Initial states by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Literal, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.sliding import dot, kinematics
from jaxvib.equations.state import ExciterState, Spin, State, require_state
from jaxvib.errors import InputError, quoted, within
from jaxvib.machine.drives.drive import SpinUp
from jaxvib.machine.effects.base import has_term, terms_of, total_gravity
from jaxvib.machine.effects.terms import DrillingSpinRelease, LoadInteraction, SlipRelease
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.devices import array_module, numpy_if_known, on_device
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import jam_modes, jams_of, require_mode_of
from jaxvib.units import Number, Numbers, known_number, numbers
from jaxvib.units.known import require_if_known, when_known

Start = Literal["rest", "jam", "spin_up"]
"""Names of initial states: at rest; near a jam mode; at rest with a smooth spin-up of the rotor."""

START_SEPARATION = math.radians(1.0)
"""Angle between neighbouring loads at the start, rad, if they are not side by side. Loads at exactly one angle would stay
there, even if this motion is unstable."""

Rotation = Literal["rolling", "none"]
"""Initial rotation of the loads about their own centres: "rolling" on their track, or "none" in space."""


@validated
def initial_state(
    scene: Scene,
    start: Start = "rest",
    *,
    mode: int | None = None,
    angles: Numbers | None = None,
    separation: Number | None = None,
    throw: bool = True,
) -> State:
    """Return an initial state.

    **Arguments**

    - `scene` of the state
    - `start`: "rest", "spin_up" or "jam". At "rest" the platforms are in equilibrium, the loads rest near the bottom of their
      track, and unbalances of motors hang down if gravity acts on them; a rotor of constant speed turns with its full speed
      from the beginning. "spin_up" is the same state, after which the rotor speed rises smoothly in `simulate`. "jam" is a
      state on the leading-order motion of a jam mode
    - `mode`: number of the jam mode, for "jam"; typical: 1, 3, 5, the modes that are stable for light loads
    - `angles` (count,): the angles of the loads about the axis of the rotor, rad; or one value for the middle of all loads
      (default: the angle of `Loads.rest` at rest, and 0 in a jam). In a jam the displacements are those of coincident loads at
      the mean angle; typical: -pi to pi
    - `separation`: angle between neighbouring loads, rad; typical: 0.02, or 1.05 to space six loads equally. Loads that touch
      (`LoadContact`) are at least side by side. Default at rest: side by side if the loads have a `ball_radius`, otherwise
      1 degree. Default in a jam (whose theory assumes coincident loads) and for `angles` (count,): 0. Loads with the same
      parameters that start at exactly one angle (`separation=0`) stay at one angle, even if slightly separated loads would not
    - `throw`: True to raise `ComputationError` if the mode does not exist; otherwise, and under a JAX transformation, the state
      is NaN

    The rotor of a motor starts at rest, without currents. Its angle is -pi/2 if gravity acts on its unbalance, otherwise 0. An
    ideal drive prescribes the angle of its rotor, which begins at 0.

    **Returns** `State`. **Raises** `InputError` for an unknown name or a missing mode, `ComputationError` for a mode that does
    not exist at the rotor speed of the scene.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> jv.initial_state(scene, "rest", angles=[0.0, 0.1]).angle[0].tolist()
    [0.0, 0.1]
    """
    if start not in ("rest", "jam", "spin_up"):
        raise InputError("start", f"is {quoted(start)}; it must be 'rest', 'jam' or 'spin_up'")
    if start != "jam" and mode is not None:
        raise InputError("mode", f"is {quoted(mode)}; it is used only with start='jam': leave it out or start in a jam")
    scene = validate_scene(scene)
    mass = scene.machine.structure().mass
    zero = cast(Array, np.zeros(mass.shape[:1], mass.dtype))
    if angles is not None and len(scene.exciters) > 1:
        raise InputError("angles", "are for a scene with one exciter; give a State with those of each exciter")

    def phases(exciter: Exciter, loads: Loads, rest: float | Array) -> Array:
        middle = numpy_if_known(rest if angles is None else numbers(angles, "rad", "angles", loads.count))
        one_each = angles is not None and not isinstance(angles, str) and np.ndim(angles) > 0  # pyright: ignore[reportArgumentType]
        return middle + _load_offsets(exciter, loads, start, separation, one_each=one_each)

    def at_rest(exciter: Exciter) -> ExciterState:
        hangs = exciter.unbalance is not None and 1 in total_gravity((*scene.effects, *exciter.effects))
        turned = cast(Array, np.full_like(zero[0], -0.5 * np.pi if hangs else 0.0))
        rotor = None if exciter.drive.ideal else (turned, *(zero[0],) * (1 + len(exciter.drive.state_units())))
        if exciter.loads is None:
            return ExciterState(rotor=rotor)
        first, *others = exciter.loads.rest()
        angle = (phases(exciter, exciter.loads, first), *others)
        zero_rates = cast(Array, np.zeros(exciter.loads.count, mass.dtype))
        return ExciterState(angle, (zero_rates,) * len(angle), rotor)

    if start != "jam":
        state = State(zero, zero, exciters=tuple(map(at_rest, scene.exciters)))
        require_start(scene, state)
        return with_spin(scene, on_device(state))
    if mode is None:
        raise InputError("mode", "is missing; start='jam' needs the number of a jam mode, for example mode=3")
    try:
        if not scene.drive.constant:
            problem = f"is 'jam', but the drive is {quoted(scene.drive.kind)} and starts at another speed; use start='rest'"
            raise InputError("start", problem)
        modes = jam_modes(scene)
    except InputError as error:
        problem, _, advice = error.problem.partition(";")
        if "simulate" not in advice:  # the caller is `simulate`; the advice to use it would be circular
            raise
        raise InputError("start", f"is 'jam', but {error.field} {problem}; start at 'rest', or from a State") from error
    row, angle = np.asarray(modes.row(mode, throw=throw), np.uint32), phases(scene.exciter, scene.loads, 0.0)
    require_start(scene, State(zero, zero, (angle,)))
    return with_spin(scene, _in_jam(modes.omega, modes.displacement, row, angle))


def must_compile_jams(scene: Scene, mode: int | None) -> bool:
    """Return True if a run that starts in a jam `mode` must first compile the jam modes of its scene. **Raises** `InputError`
    for a wrong number."""
    if mode is None or not scene.is_plain:
        return False
    require_mode_of(scene, mode)
    return not jams_of.is_ready(scene)


def _load_offsets(
    exciter: Exciter, loads: Loads, start: Start, separation: Number | None, *, one_each: bool
) -> Array | np.ndarray:
    """Return the angles (count,), rad, of the loads relative to their middle; `one_each`: True if each load has a given
    angle."""
    n = loads.count
    has_contact = has_term(exciter.effects, LoadInteraction)
    has_size = getattr(loads, "ball_radius", None) is not None
    is_default = separation is None and start != "jam"
    side_by_side = not one_each and (has_contact or (is_default and has_size))
    if separation is not None:
        gap = known_number(separation, "rad", "separation", low=0.0)
    else:
        gap = min(START_SEPARATION, math.pi / n) if is_default and not (has_size or one_each) else 0.0
    offsets = gap * (np.arange(n) - 0.5 * (n - 1)).astype(exciter.drive.speed.dtype)
    if not side_by_side:
        return offsets
    touching = numpy_if_known(loads.offsets())
    if gap == 0.0:
        return touching
    return array_module(touching).where(abs(offsets) > abs(touching), offsets, touching)  # both have equal steps


@cached
def _in_jam(omega: Array, displacement: Array, row: Array | np.ndarray, angle: Array) -> State:
    """Return the state in the jam of the given `row`, with the loads at the angles `angle` (count,), rad."""
    rotated = displacement[row] * jnp.exp(1j * jnp.mean(angle))
    return State(rotated.real, -omega[row] * rotated.imag, (angle,), (jnp.full_like(angle, omega[row]),))


@validated
def with_spin(scene: Scene, state: State, rotation: Rotation = "rolling") -> State:
    """Return the state completed by the rotation of the loads about their own centres, if effects of the scene permit it.

    A state that contains this rotation already is returned unchanged. Loads that do not rotate in space have

        c = p' - w axis x (p + r n),    s = - w axis . n

    c is the slip and s the drilling spin. p is the position of the centre of a load, r its radius and n the normal of its
    contact; w is the rotor speed, and axis the unit vector along the axis of the rotor.

    **Arguments**

    - `scene` whose effects permit the rotation (`FreeSpin`, `Sliding`)
    - `state` without this rotation
    - `rotation`: "rolling" (the default) for loads that roll on their track without spin about the contact normal; "none" for
      loads that do not rotate in space (the equations above). Their contact slides if the scene has `Sliding`; typical: slips
      of 5 to 50 m/s

    **Returns** `State`. **Raises** `InputError` for another name, and for a spin in the state that the scene does not permit
    or that has a wrong shape.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> loads = jv.balls(count=1, mass=0.1, radius=0.2, drag=0.0, ball_radius=0.01)
    >>> scene = jv.Scene(jv.planar_rotor(mass=9.0, stiffness=1e4, damping=9.0), loads, jv.ConstantSpeed(100.0), jv.Sliding(0.1))
    >>> rest = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> round(float(jv.with_spin(scene, rest, "none").spin.slip[0][0]), 6)        # - w (R + r)
    -21.0
    """
    if rotation not in get_args(Rotation):
        raise InputError("rotation", f"is {quoted(rotation)}; it must be 'rolling' or 'none'")
    exciters = []
    for k, (exciter, exciter_state) in enumerate(zip(scene.exciters, state.exciters, strict=True)):
        with within(scene.prefix_of(k)):
            exciters.append(_exciter_with_spin(exciter, exciter_state, rotation))
    return State(state.displacement, state.velocity, exciters=exciters)


def _exciter_with_spin(exciter: Exciter, state: ExciterState, rotation: Rotation) -> ExciterState:
    """Return the state of an exciter with the rotation of its loads about their own centres, see `with_spin`."""
    loads = exciter.loads
    has_drilling = has_term(exciter.effects, DrillingSpinRelease)
    has_slip = has_term(exciter.effects, SlipRelease)
    if loads is None or not (has_drilling or has_slip):
        if state.spin is not None:
            problem = "is given, but no effect of the scene allows it; leave it out, or add FreeSpin or Sliding"
            raise InputError("start.spin", problem)
        return state
    if state.spin is not None:
        n = (loads.count,)
        needed = (n if has_drilling else None, (n,) * len(state.angle) if has_slip else None)
        drilling, slip = state.spin.drilling, state.spin.slip
        shapes_found = (
            None if drilling is None else jnp.shape(drilling),
            None if slip is None else tuple(map(jnp.shape, slip)),
        )
        if shapes_found != needed:
            problem = f"has shapes {shapes_found} of drilling and slip; this scene needs {needed} (None if no effect allows it)"
            raise InputError("start.spin", problem)
        return state
    zero = jnp.zeros_like(state.angle[0])
    drilling, slip = zero, tuple(zero for _ in state.angle)
    if rotation == "none":
        u, rate, w = state.angle, state.rate, exciter.turning_drive.rotor_speed(jnp.zeros(()), state.rotor)
        spin, normal_force = loads.drilling_spin(u, rate, w), loads.normal_force(u, rate, {})
        drilling = zero if spin is None else spin.without_rotation
        if has_slip:
            assert normal_force is not None
            r = loads.ball_radius  # pyright: ignore[reportAttributeAccessIssue]
            per_acceleration = normal_force.normal_force_per_acceleration
            across, up = (x - r * y / loads.mass for x, y in zip(loads.position(*u), per_acceleration, strict=False))
            along = jax.jvp(loads.position, u, rate)[1]
            relative = (along[0] + w * up, along[1] - w * across, *along[2:])
            motion = kinematics(loads, u, rate)
            slip = tuple(dot(column, relative) / size for column, size in zip(motion.columns, motion.sizes, strict=True))
    spin = Spin(drilling if has_drilling else None, slip if has_slip else None)
    return ExciterState(state.angle, state.rate, state.rotor, spin)


def start_state(
    scene: Scene, start: Start | State, mode: int | None, separation: Number | None = None, *, throw: bool = True
) -> State:
    """Return the initial state of a named start, or the validated state of the user. **Raises** `InputError`."""
    if isinstance(start, State):
        return _validate_state(scene, start, mode, separation)
    return initial_state(scene, start, mode=mode, separation=separation, throw=throw)


def with_spin_up_drive(scene: Scene, end: Array, start: Start | State, spin_up: Number | None) -> Scene:
    """Return the scene; for the start "spin_up", with drives whose speed rises during the time `spin_up`, s (default: `end`/2).

    **Raises** `InputError` if `spin_up` is given with another start or is longer than the run, and for drives whose speed is
    not constant.
    """
    if not (isinstance(start, str) and start == "spin_up"):
        if spin_up is not None:
            raise InputError("spin_up", "is used only with start='spin_up'; leave it out or use start='spin_up'")
        return scene
    drives = []
    for exciter in scene.exciters:
        if not exciter.drive.constant:
            drive = quoted(exciter.drive.kind)
            raise InputError("start", f"is 'spin_up', which needs a constant speed, but the drive is {drive}; start at 'rest'")
        drives.append(SpinUp(exciter.drive.speed, end / 2.0 if spin_up is None else spin_up))
    times, problem = (drives[0].duration, end), "is {:g} s, longer than the run of {:g} s; shorten it, or run longer"
    require_if_known(lambda duration, end: duration <= end, *times, field="spin_up", problem=problem)
    return eqx.tree_at(lambda s: [exciter.drive for exciter in s.exciters], scene, drives)


def _validate_state(scene: Scene, state: State, mode: int | None, separation: Number | None) -> State:
    """Return the initial state of the user, converted to the precision of JAX and completed by `with_spin`. **Raises**
    `InputError` if its shapes do not fit the scene, or if a `mode` or `separation` is given together with it."""
    if separation is not None:
        problem = "it is used only with named starts: put the angles into the State"
        raise InputError("separation", f"is {quoted(separation)}; {problem}")
    if mode is not None:
        raise InputError("mode", f"is {quoted(mode)}; it is used only with start='jam': leave it out if start is a State")
    require_state(scene, state, "start")
    require_start(scene, state)
    return with_spin(scene, jax.tree.map(partial(jnp.asarray, dtype=float), state))


def require_start(scene: Scene, state: State) -> None:
    """**Raises** `InputError` if loads with contact overlap at known initial angles (..., count)."""
    for k, (exciter, exciter_state) in enumerate(zip(scene.exciters, state.exciters, strict=True)):
        for term in terms_of(exciter.effects, LoadInteraction):
            if term.validate_start is not None and exciter.loads is not None:
                with within(scene.prefix_of(k)):
                    _validate_places(scene, exciter, exciter_state.angle, term.validate_start)


def _validate_places(
    scene: Scene,
    exciter: Exciter,
    u: tuple[Array, ...],
    validate: Callable[[Loads, tuple[Array, ...], np.ndarray | None], None],
) -> None:
    loads = exciter.loads
    assert loads is not None
    machine, place = scene.machine, exciter.place
    if jnp.ndim(exciter.drive.speed):  # scenes of a batch: loads that share a track do so in all of them
        machine, place = jax.tree.map(lambda leaf: leaf[0], (machine, place))
    mount = machine.mount(place)
    if mount.at_one_point:
        when_known(lambda *u: validate(loads, u, None), *u)
    else:
        when_known(lambda at, *u: validate(loads, u, np.asarray(at)), mount.distances(loads.count), *u)
