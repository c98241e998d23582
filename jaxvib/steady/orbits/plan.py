"""Plans of exact jams: choices that depend on parameters of a scene, made on the host before a program is traced.

Only this module tests which numbers are known. Under a JAX transformation the number of collocation points is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.coincident import coincident_model
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import has_half_turn
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.devices import known, numpy_of, on_device
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.jams.jam import jams_of
from jaxvib.steady.orbits.solve import Parameter
from jaxvib.steady.orbits.stability import is_stiff
from jaxvib.units import Number, count, number
from jaxvib.units.known import is_known

__all__ = ["OrbitPlan", "plan_orbit"]

_COLLOCATION_POINTS = (16, 32, 64, 128)
"""Collocation points on half a period, tried in turn until the accuracy is reached."""

_BYTES_PER_POINT = 16.0


@dataclass(frozen=True)
class OrbitPlan:
    """Plan of an exact jam.

    **Attributes**: the `scene`; `given`: the name of the prescribed speed; its `value`, and the `start` of the other speed,
    rad/s; `exists`: true if the leading order has the mode; `direction`: the sign of dn/dOmega that the mode needs, or None;
    `mode`: its number, or None; `points`: numbers of collocation points to try in turn; relative `accuracy`; `implicit`: true
    for implicit integration of the multipliers; `is_known`: true if all numbers have values; `is_settled_first`: true if
    Newton's method starts from the motion at the load speed `start`.
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
    scene: Scene,
    *,
    mode: int | None,
    omega: Number | None,
    near: Number | None,
    accuracy: float | None,
    points: int | None,
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
    accuracy = _accuracy(scene, accuracy)
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
        # Unknown numbers may include strong drag.
        implicit=bool(_is_stiff(frozen, *speeds)) if all_known else True,
        is_known=all_known,
    )


def _accuracy(scene: Scene, accuracy: float | None) -> float:
    floor = 1e3 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    if accuracy is None:
        return 1e-9 if floor < 1e-9 else 1e-3
    if not accuracy >= floor:
        raise InputError("accuracy", f"is {accuracy}; {scene.drive.speed.dtype} numbers allow {floor:.0e} and above")
    return accuracy


def _points(scene: Scene, loads: CircularLoads, points: int | None, *, all_known: bool) -> tuple[int, ...]:
    """Return numbers of collocation points to try in turn, on half a period if the motion has that symmetry, else on one."""
    if points is not None:
        bodies = 1 if loads.alike else loads.count
        size = _BYTES_PER_POINT * bodies**2 * float(points if isinstance(points, int) else 1)
        return (count(points, "points", low=2, each=size),)
    tried = _COLLOCATION_POINTS if has_half_turn(scene.all_effects) else tuple(2 * p + 1 for p in _COLLOCATION_POINTS)
    return tried if all_known else tried[:1]


def _mode_start(scene: Scene, mode: int) -> tuple[Array, Array, Array]:
    """Return True if the leading order has the jam mode, the sign of dn/dOmega there, and its load speed, rad/s."""
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
