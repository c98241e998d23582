"""Exact jams of a mode, of a load speed, or near a load speed.

Choices that depend on parameters of a scene are made in Python (`plan_orbit`), before a program is traced. Under a JAX
transformation the number of collocation points is fixed.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import speed_text
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import has_half_turn_symmetry
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.results.status import sentence, status_names
from jaxvib.runtime.devices import array_module, numpy_if_known, on_device
from jaxvib.runtime.parallel import in_background
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.jams.jam import JamStatus, jams_of
from jaxvib.steady.orbits.describe import Orbit, OrbitStatus, differentiable_fields, orbits
from jaxvib.steady.orbits.search import exact_mode_speeds
from jaxvib.steady.orbits.solve import Parameter, periodic_motion
from jaxvib.steady.orbits.stability import is_stiff, steps_for
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number, count, number, validate_tolerance
from jaxvib.units.known import is_known

_MAX_SPEED_DIFFERENCE = 0.02
"""Relative distance of an exact load speed from the leading-order one beyond which it may belong to another mode."""

_MAX_TRACED_STEPS = 128
"""Limit of the integration steps for the multipliers under a JAX transformation; reverse derivatives need a static limit."""

_COLLOCATION_POINTS = (16, 32, 64, 128)
"""Collocation points on half a period, tried one after the other until the accuracy is reached."""

_BYTES_PER_ENTRY = 16.0
"""Memory per entry of the matrix of the collocation equations, (points * loads)^2 entries."""


@validated
def jam_orbit(
    scene: Scene,
    *,
    mode: int | None = None,
    omega: Number | None = None,
    near: Number | None = None,
    accuracy: float | None = None,
    points: int | None = None,
    throw: bool = True,
) -> Orbit:
    """Return the exact motion in which loads of any mass jam.

        I Omega^2 psi'' = torque(phi, Omega (1 + psi'), n, a) - S e'(phi) . a,      a = B q''
        D(k Omega) q_k = S k^2 Omega^2 B^T e_k,      D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G)

    phi = theta + psi(theta) is the angle of the loads, with theta = Omega t. q are the coordinates of the machine, q_k their
    harmonics, and e_k the harmonics of e = (cos phi, sin phi). S = sum m R, I = sum kappa m R^2, and n is the rotor speed. K,
    M, C and G are the matrices of the machine; B maps q to the displacement of the point that carries the loads.

    The equations are solved by trigonometric collocation of psi. The carrier is eliminated harmonic by harmonic, and Newton's
    method starts from the leading order.

    - Loads that have equal parameters are at one point. If they have a `ball_radius`, they are side by side, with the unbalance
      S = m R sin(N arcsin(r/R)) / (r/R); if their mean contact force over a period would be tensile, the status is
      `would_separate`
    - Different loads have a deviation psi_j each. Its mean over a period is the phase of the load. The phases follow from the
      torque balance of each load, and their sum is 0
    - The torque is that of drag, gravity and dry friction; the normal force of the friction depends on the acceleration a of
      the mount. If friction can hold the loads on the rotor, they stick and slip. No number of harmonics resolves this motion;
      its status is then `under_resolved` or `not_converged`

    **Arguments**: `scene`; one of `mode`, `omega` and `near`; and the other arguments

    - `mode`: number of a jam mode, see `jam_modes`; the result is the exact motion of this mode at the scene's rotor speed;
      typical: 1, 3, 5. If the mode does not exist in leading order, or its leading order is too far from the exact motion, the
      whole exact branch is searched (not under a JAX transformation)
    - `omega`: load speed of the motion, rad/s or text; the rotor speed is a result, and that of the scene is not used
    - `near`: load speed, rad/s or text, from which a motion at the scene's rotor speed is searched for
    - `accuracy`: harmonics are added until the estimated relative error is below it; typical: 1e-4 to 1e-9 (the default; in
      single precision 1e-3). A smaller value costs little, because the error falls exponentially with the number of harmonics
    - `points`: a fixed number of collocation points in place of an accuracy; typical: 12 to 32. They are on half a period if
      the scene has half-turn symmetry, otherwise (with gravity on the loads) on a whole period. The time grows at least with
      the square of this number. Under JAX transformations the values that decide on this number are not known; the default is
      then 16 on half a period and 33 on a whole period, and the status shows whether it is too small
    - `throw`: raise if there is no such motion; otherwise, and under a JAX transformation, the status shows it

    **Returns** `Orbit`; its fields have derivatives with respect to every parameter of the scene (implicit function theorem,
    forward and reverse).

    **Raises** `ComputationError` with the status "absent" or "not_converged", and `InputError` for

    - wrong arguments
    - loads without drag, at different stations, or not on a circle
    - a motor, an imbalance of the rotor, nonlinear supports and bodies in a plane
    - a `mode` of a machine with gyroscopic coupling, whose resonances depend on the rotor speed. Use `omega` or `near` instead.
      Such a machine may have motions with the same load speed at several rotor speeds; `omega` then gives the motion at the
      lowest rotor speed

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=0.05, beta=1.0, speed=3.0)
    >>> orbit = jv.jam_orbit(form.scene(), mode=3)
    >>> round(float(orbit.omega), 6), bool(orbit.stable)
    (0.972666, True)

    Source: the antiphase paper, equations (2) and (21), solved without its expansion in eps.
    """
    scene = validate_scene(scene)
    if mode is not None and not jams_of.is_ready(scene):
        # Compile the program of the orbit in the background while the jam modes are computed. Only the shapes of its
        # arguments matter; therefore the start may be the rotor speed.
        rough = plan_orbit(scene, mode=None, omega=None, near=scene.drive.speed, accuracy=accuracy, points=points)
        problem = rough.problem._replace(direction=np.ones_like(rough.problem.value))
        in_background(partial(_solve_program.prepare, problem, rough.points[0], None))
    plan = plan_orbit(scene, mode=mode, omega=omega, near=near, accuracy=accuracy, points=points)
    if not plan.is_known:
        return outcome(_solve_program(plan.problem, plan.points[0], _MAX_TRACED_STEPS), scene)
    orbit = _solve_accurately(plan)
    if plan.mode is not None and not abs(float(orbit.omega) / float(plan.problem.start) - 1.0) < _MAX_SPEED_DIFFERENCE:
        # The mode does not exist in leading order, or its exact load speed is far from that of leading order.
        plan = _plan_from_search(plan, plan.mode)
        orbit = _solve_accurately(plan)
    return outcome(orbit, throw=throw, failures=("absent", "not_converged"), hint=partial(_advice, plan))


def _advice(plan: OrbitPlan, status: str) -> str:
    """Return the advice that follows the message of a failed search."""
    if status != "absent" or plan.mode is None:
        return ""
    if "ambiguous" in status_names(jams_of(plan.problem.scene).status):
        return f", or this search does not find it: {sentence(JamStatus.ambiguous)}"
    there = ", ".join(map(str, sorted({*plan.existing} - {plan.mode})))
    return f" (jam mode {plan.mode}, {speed_text(plan.problem.value)}); existing modes: {there or 'none'}"


class JamProblem(NamedTuple):
    """Problem whose solution is one exact jam.

    **Attributes**: the `scene`; `given`: the name of the prescribed speed; its `value`, and the `start` of the other speed,
    rad/s; `exists`: True if the mode exists, in leading order or in the search of the exact branch; `direction`: the sign of
    dn/dOmega that the mode needs, or None; relative `accuracy`; `implicit`: True for implicit integration of the multipliers;
    `is_start_solved`: True if the motion at the load speed `start` is solved first, and Newton's method starts from it.
    """

    scene: Scene
    given: Parameter
    value: Array
    start: Array
    exists: Array
    direction: Array | np.ndarray | None
    accuracy: float
    implicit: bool
    is_start_solved: bool = False


class OrbitPlan(NamedTuple):
    """Plan of an exact jam.

    **Attributes**: the `problem`; `mode`: its number, or None; `points`: numbers of collocation points to try one after the
    other; `is_known`: True if no parameter is traced; `existing`: modes that the search of the exact branch finds.
    """

    problem: JamProblem
    mode: int | None
    points: tuple[int, ...]
    is_known: bool
    existing: tuple[int, ...] = ()


def plan_orbit(
    scene: Scene, *, mode: int | None, omega: Number | None, near: Number | None, accuracy: float | None, points: int | None
) -> OrbitPlan:
    """Validate the arguments of `jam_orbit` except `scene` and `throw`, and choose start, points and method.

    **Raises** `InputError`.
    """
    named = [name for name, value in (("mode", mode), ("omega", omega), ("near", near)) if value is not None]
    if len(named) != 1:
        given = " and ".join(named) if named else "none"
        raise InputError("jam_orbit", f"was called with {given}; give exactly one of mode, omega and near, for example mode=3")
    all_known = is_known(scene, omega, near)
    # Starts have no derivatives. A scene without traced values is not copied, because a copy would be validated again.
    frozen = scene if all_known else jax.tree.map(lambda x: x if is_known(x) else jax.lax.stop_gradient(x), scene)
    loads = jammed_loads(frozen)
    require_drag(loads, each=True)
    dtype = scene.drive.speed.dtype
    if accuracy is None:
        accuracy = 1e-9 if dtype.itemsize >= 8 else 1e-3
    accuracy = validate_tolerance(accuracy, "accuracy", dtype, 1e3)
    if points is None:
        tried = tuple(collocation_points(scene, points) for points in _COLLOCATION_POINTS)
        tried = tried if all_known else tried[:1]
    else:
        size = _BYTES_PER_ENTRY * (1 if loads.alike else loads.count) ** 2 * float(points if isinstance(points, int) else 1)
        tried = (count(points, "points", low=2, each=size),)

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
    # Traced parameters may include a strong drag.
    implicit = bool(_is_stiff(frozen, *speeds)) if all_known else True
    problem = JamProblem(scene, which, value, start, exists, direction, accuracy, implicit)
    return OrbitPlan(problem, None if mode is None else int(mode), tried, all_known)


def _mode_start(scene: Scene, mode: int) -> tuple[Array, Array, Array]:
    """Return three values of the jam mode in leading order: existence, sign of dn/dOmega, and load speed, rad/s."""
    if scene.mounting.gyroscopic is not None:
        raise InputError("mode", "is not defined for a machine whose resonances depend on the rotor speed; give omega or near")
    jams = jams_of(scene)
    light, speed = numpy_if_known(jams.omega)[jams.row(mode)], numpy_if_known(scene.drive.speed)
    direction = on_device(np.asarray(1.0 if mode % 2 == 1 else -1.0, speed.dtype))
    xp = array_module((light, speed))
    exists = on_device(xp.asarray(xp.isfinite(light)))
    return exists, direction, on_device(xp.asarray(xp.where(xp.isfinite(light), light, speed)))


@cached
def _light_rotor_speed(scene: Scene, omega: Array) -> Array:
    return light_rotor_speed(jammed_model(scene), omega)


def collocation_points(scene: Scene, points: int) -> int:
    """Return the number of collocation points: `points` on half a period for a scene with half-turn symmetry, otherwise
    2 `points` + 1 on the whole period."""
    return points if has_half_turn_symmetry(scene.all_effects) else 2 * points + 1


@cached
def _is_stiff(scene: Scene, omega: Array, speed: Array) -> Array:
    return is_stiff(jammed_bodies(jammed_model(scene)), omega, speed)


def _solve_accurately(plan: OrbitPlan) -> Orbit:
    """Return the first orbit that is accurate enough. If there is none, return the orbit with the smallest error: near a fold,
    more points only add rounding errors."""
    best, best_error = None, math.inf
    for points in plan.points:
        orbit = _solve_program(plan.problem, points, None)
        error = float(orbit.error)
        if best is None or error < best_error:
            best, best_error = orbit, error
        if not error > plan.problem.accuracy:  # NaN if there is no motion
            break
    assert best is not None
    return best


def _plan_from_search(plan: OrbitPlan, mode: int) -> OrbitPlan:
    """Return the plan that starts at the load speed of the mode that a search of the whole exact branch finds."""
    speeds, start = exact_mode_speeds(plan.problem.scene), plan.problem.start
    speed = speeds.get(mode)
    start = start if speed is None else jnp.asarray(speed, dtype=start.dtype)
    problem = plan.problem._replace(exists=jnp.asarray(speed is not None), start=start, is_start_solved=True)
    return plan._replace(problem=problem, existing=tuple(speeds))


def _outputs(orbit: Orbit, problem: JamProblem, points: int, max_steps: int | None) -> Orbit:
    """Return the outputs that follow from the solved motion, without multipliers and errors."""
    model = jammed_bodies(jammed_model(problem.scene))
    fields = differentiable_fields(model, orbit, problem.value, problem.start, problem.given, points)
    return dataclasses.replace(jax.tree.map(lambda _: None, orbit), **fields)


@cached(outputs_from_solution=_outputs)
def _solve_program(problem: JamProblem, points: int, max_steps: int | None) -> Orbit:
    """Solve for one exact jam; `max_steps`: see `floquet`."""
    scene, given, value, start, exists, direction, accuracy, implicit, is_start_solved = problem
    model, deviation = jammed_bodies(jammed_model(scene)), None
    if is_start_solved:
        grid = grid_of(points, model.half_turn)
        deviation = periodic_motion(model, grid, "omega", start, light_rotor_speed(model.linear, start)).deviation[None]
    speeds = (value, start) if given == "omega" else (start, value)
    steps = steps_for(model, *speeds, implicit=implicit)
    batch_of_one = jnp.reshape(value, (1,)), jnp.reshape(start, (1,))
    batch, _ = orbits(model, *batch_of_one, given, points, steps, accuracy, deviation, implicit=implicit, max_steps=max_steps)
    orbit = jax.tree.map(lambda leaf: leaf[0], batch)
    # Odd modes lie on rising pieces of the branch, even modes on falling pieces.
    is_mode = exists
    if direction is not None:
        is_mode = exists & (~(orbit.slope * direction < 0.0) | (orbit.status == OrbitStatus.at_fold))
    orbit = jax.tree.map(lambda x: jnp.where(is_mode, x, jnp.nan) if eqx.is_inexact_array(x) else x, orbit)
    status, stable = OrbitStatus.where(is_mode, orbit.status, OrbitStatus.absent), is_mode & orbit.stable
    return eqx.tree_at(lambda o: (o.status, o.stable), orbit, (status, stable))
