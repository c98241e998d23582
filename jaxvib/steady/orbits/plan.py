"""Plans of exact jams: choices that depend on parameters of a scene, made on the host before a program is traced.

Only this module tests which values are known (not traced). Under a JAX transformation the number of collocation points is
fixed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.coincident import coincident_model
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag, require_terms
from jaxvib.errors import InputError, quoted
from jaxvib.machine.drives.drive import SwitchedOff
from jaxvib.machine.effects.base import has_half_turn_symmetry, has_term
from jaxvib.machine.effects.terms import ContactFriction, GravityField, LoadPotential, RotorImbalance, SupportForce
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.devices import known, numpy_of, on_device
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.jams.jam import jams_of
from jaxvib.steady.orbits.solve import Parameter
from jaxvib.steady.orbits.stability import is_stiff
from jaxvib.units import Number, Numbers, count, number, numbers
from jaxvib.units.known import is_known

__all__ = ["OrbitPlan", "SynchronousPlan", "plan_orbit", "plan_synchronous"]

_COLLOCATION_POINTS = (16, 32, 64, 128)
"""Collocation points on half a period, tried one after the other until the accuracy is reached."""

_BYTES_PER_POINT = 16.0


@dataclass(frozen=True)
class OrbitPlan:
    """Plan of an exact jam.

    **Attributes**: the `scene`; `given`: the name of the prescribed speed; its `value`, and the `start` of the other speed,
    rad/s; `exists`: true if the mode exists in leading order; `direction`: the sign of dn/dOmega that the mode needs, or None;
    `mode`: its number, or None; `points`: numbers of collocation points to try one after the other; relative `accuracy`;
    `implicit`: true for implicit integration of the multipliers; `is_known`: true if no parameter is traced;
    `is_settled_first`: true if Newton's method starts from the motion at the load speed `start`.
    """

    scene: Scene
    given: Parameter
    value: Array
    start: Array
    exists: Array
    direction: Array | None
    mode: int | None
    points: tuple[int, ...]
    accuracy: float
    implicit: bool
    is_known: bool
    is_settled_first: bool = False


def plan_orbit(
    scene: Scene, *, mode: int | None, omega: Number | None, near: Number | None, accuracy: float | None, points: int | None
) -> OrbitPlan:
    """Validate the arguments of `jam_orbit`, and choose start, points and method. **Raises** `InputError`."""
    named = [name for name, value in (("mode", mode), ("omega", omega), ("near", near)) if value is not None]
    if len(named) != 1:
        given = " and ".join(named) if named else "none"
        raise InputError("jam_orbit", f"was called with {given}; give exactly one of mode, omega and near, for example mode=3")
    scene = validate_scene(scene)
    all_known = is_known(scene, omega, near)
    # Starts have no derivatives. A known scene stays the same object, because it is validated already.
    frozen = scene if all_known else jax.tree.map(lambda x: x if is_known(x) else jax.lax.stop_gradient(x), scene)
    accuracy = _accuracy(scene.drive.speed.dtype, accuracy)
    loads = jammed_loads(frozen)
    require_drag(loads)

    exists, direction, start = on_device(np.asarray(True)), None, frozen.drive.speed
    which: Parameter = "rotor_speed"
    value = scene.drive.speed
    if mode is not None:
        exists, direction, start = _mode_start(frozen, mode)
    elif near is not None:
        start = number(near, "rad/s", "near", low=0.0, open_low=True)
    elif omega is not None:
        value = number(omega, "rad/s", "omega", low=0.0, open_low=True)
        which, start = "omega", _light_rotor_speed(frozen, jax.lax.stop_gradient(value))
    speeds = (value, start) if which == "omega" else (start, value)
    return OrbitPlan(
        scene=scene,
        given=which,
        value=value,
        start=start,
        exists=exists,
        direction=direction,
        mode=None if mode is None else int(mode),
        points=_points(scene, loads, points, all_known=all_known),
        accuracy=accuracy,
        # Traced parameters may include a strong drag.
        implicit=bool(_is_stiff(frozen, *speeds)) if all_known else True,
        is_known=all_known,
    )


def _accuracy(dtype: jnp.dtype, accuracy: float | None, usual: float = 1e-9) -> float:
    floor = 1e3 * float(jnp.finfo(dtype).eps)
    if accuracy is None:
        return usual if floor < 1e-9 else 1e-3
    if not accuracy >= floor:
        raise InputError("accuracy", f"is {accuracy}; {dtype} numbers allow {floor:.0e} and above")
    return accuracy


def _points(scene: Scene, loads: CircularLoads, points: int | None, *, all_known: bool) -> tuple[int, ...]:
    """Return the numbers of collocation points to try one after the other. The points lie on half a period if the motion has
    the half-turn symmetry, otherwise on a period."""
    if points is not None:
        bodies = 1 if loads.alike else loads.count
        size = _BYTES_PER_POINT * bodies**2 * float(points if isinstance(points, int) else 1)
        return (count(points, "points", low=2, each=size),)
    tried = _COLLOCATION_POINTS if has_half_turn_symmetry(scene.all_effects) else tuple(2 * p + 1 for p in _COLLOCATION_POINTS)
    return tried if all_known else tried[:1]


def _mode_start(scene: Scene, mode: int) -> tuple[Array, Array, Array]:
    """Return True if the jam mode exists in leading order, the sign of dn/dOmega there, and its load speed, rad/s."""
    if scene.mounting.gyroscopic is not None:
        raise InputError("mode", "is not defined for a machine whose resonances depend on the rotor speed; give omega or near")
    jams = jams_of(scene)
    light, speed = known(jams.omega)[jams.row(mode)], known(scene.drive.speed)
    direction = on_device(np.asarray(1.0 if mode % 2 == 1 else -1.0, speed.dtype))
    xp = numpy_of((light, speed))
    exists = on_device(xp.asarray(xp.isfinite(light)))
    return exists, direction, on_device(xp.asarray(xp.where(xp.isfinite(light), light, speed)))


@cached
def _light_rotor_speed(scene: Scene, omega: Array) -> Array:
    return light_rotor_speed(jammed_model(scene), omega)


@cached
def _is_stiff(scene: Scene, omega: Array, speed: Array) -> Array:
    return is_stiff(coincident_model(jammed_model(scene)), omega, speed)


_SYNCHRONOUS_POINTS = (17, 33, 65, 129)
"""Collocation points on a period, tried one after the other until the accuracy is reached."""

_SYNCHRONOUS_TERMS = (GravityField, LoadPotential, RotorImbalance, ContactFriction, SupportForce)
"""Terms that exact synchronous motions include."""


@dataclass(frozen=True)
class SynchronousPlan:
    """Plan of an exact synchronous motion.

    **Attributes**: the `scene` with its drives in their final state; starts of `speed`, rad/s, and `phases` (N,), rad; numbers
    of collocation `points` to try one after the other; relative `accuracy`; `is_known`: True if no parameter is traced.
    """

    scene: Scene
    speed: Array
    phases: Array
    points: tuple[int, ...]
    accuracy: float
    is_known: bool


def plan_synchronous(
    scene: Scene, regime: Any, *, speed: Number | None, phases: Numbers | None, accuracy: float | None, points: int | None
) -> SynchronousPlan:
    """Validate the arguments of `synchronous_orbit`, and choose start and points. **Raises** `InputError`."""
    if regime is not None and (speed is not None or phases is not None):
        raise InputError("regime", "is given together with speed or phases; leave one of them out")
    if regime is not None:
        speed, phases = regime.speed, regime.phases
    scene = validate_scene(scene)
    require_terms(scene.all_effects, _SYNCHRONOUS_TERMS, "is|are not part of a synchronous motion")
    for k, exciter in enumerate(scene.exciters):
        _require_one_body(exciter, scene.prefix_of(k))
        scene = eqx.tree_at(lambda s, k=k: s.exciters[k].drive, scene, exciter.drive.settled())
    shaken = [e for e in scene.exciters if e.drive.ideal and e.loads is None]
    motors = [e.drive.speed for e in scene.exciters if not e.drive.ideal and not isinstance(e.drive, SwitchedOff)]
    if shaken:
        start = shaken[0].drive.speed
    elif speed is not None:
        start = number(speed, "rad/s", "speed", low=0.0, open_low=True)
    elif motors:
        start = jnp.mean(jnp.stack(motors))
    else:
        raise InputError("speed", "is missing; give the speed near which the loads turn, rad/s, for example speed=95.0")
    count_of = len(scene.exciters)
    angles = jnp.zeros(count_of, start.dtype) if phases is None else numbers(phases, "rad", "phases", count_of)
    all_known = is_known(scene, start, angles)
    tried = _SYNCHRONOUS_POINTS if all_known else _SYNCHRONOUS_POINTS[1:2]
    return SynchronousPlan(
        scene=scene,
        speed=start,
        phases=angles,
        points=tried if points is None else (count(points, "points", low=3, each=256.0),),
        accuracy=_accuracy(start.dtype, accuracy, 1e-8),
        is_known=all_known,
    )


def _require_one_body(exciter: Exciter, place: str) -> None:
    """**Raises** `InputError` for an exciter whose bodies have no common speed."""
    loads, drive = exciter.loads, exciter.drive
    if drive.state_units():
        problem = (
            "whose states, such as currents, this function does not include; use a motor with a steady torque, or simulate"
        )
        raise InputError(f"{place}drive", f"is {quoted(drive.kind)}, {problem}")
    if loads is None:
        return
    if exciter.unbalance is not None or has_term(exciter.effects, RotorImbalance):
        problem = (
            "do not turn at the speed of the rotor's unbalance, so that no motion repeats; leave one of them out, or simulate"
        )
        raise InputError(f"{place}loads", problem)
    if not drive.ideal:
        raise InputError(
            f"{place}drive", f"is {quoted(drive.kind)}; loads need a drive of prescribed speed here, use ConstantSpeed"
        )
    if not loads.circular:
        raise InputError(
            f"{place}loads.kind", f"is {quoted(loads.kind)}; this function needs loads on a circle; use simulate for others"
        )
    if getattr(loads, "ball_radius", None) is not None and loads.count > 1:
        raise InputError(
            f"{place}loads.ball_radius", "is given, but this function places the loads at one angle; leave it out, or simulate"
        )
