"""Exact jams of a mode, of a load speed, or near a load speed."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.coincident import coincident_model
from jaxvib.equations.linear import jammed_model
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.runtime.parallel import in_background
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.jams.jam import jams_of
from jaxvib.steady.orbits.describe import Orbit, OrbitStatus, differentiable_fields, orbits
from jaxvib.steady.orbits.plan import OrbitPlan, plan_orbit
from jaxvib.steady.orbits.search import exact_mode_speeds
from jaxvib.steady.orbits.solve import Parameter, periodic_motion
from jaxvib.steady.orbits.stability import steps_for
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number

_MAX_SPEED_DIFFERENCE = 0.02
"""Relative distance of an exact load speed from the leading-order one beyond which it may belong to another mode."""

_UNKNOWN_STEPS = 64
"""Number of integration steps for the multipliers under a JAX transformation; reverse derivatives need a static number."""


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
    """Return the exact motion in which coincident loads of any mass jam.

        I Omega^2 psi'' = torque(phi, Omega (1 + psi'), n, a) - S e'(phi) . a,      a = B q''
        D(k Omega) q_k = S k^2 Omega^2 B^T e_k,      D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G)

    with phi = theta + psi(theta), S = sum m R, I = sum kappa m R^2, e_k the harmonics of e = (cos phi, sin phi). The equations
    are solved by trigonometric collocation of psi. The carrier is eliminated harmonic by harmonic, and Newton's method starts
    from the leading order.

    - Loads that have equal parameters are at one point, or side by side if they have a `ball_radius` (S is then m R sin(N
      arcsin(r/R)) / (r/R); if their mean contact force over a period would be tensile, the status is `would_separate`)
    - Loads that differ have a psi_j each: they lie next to each other in the order that their torques require
    - The torque is that of drag, gravity and dry friction, whose normal force depends on the acceleration a of the port. If
      friction can hold the loads on the rotor, they stick and slip. No number of harmonics resolves this motion, and the
      status shows it

    **Arguments**: `scene`; one of `mode`, `omega` and `near`; and the other arguments

    - `mode`: number of a jam mode, see `jam_modes`; the result is the exact motion of this mode at the scene's rotor speed;
      typical: 1, 3, 5. If the mode does not exist in leading order, or its leading order is too far from the exact motion, the
      whole exact branch is searched (not under a JAX transformation)
    - `omega`: load speed of the motion, rad/s or text; the rotor speed is a result, and that of the scene is not used
    - `near`: load speed, rad/s or text, from which a motion at the scene's rotor speed is searched for
    - `accuracy`: harmonics are added until the estimated relative error is below it; typical: 1e-4 to 1e-9 (the default; in
      single precision 1e-3). A smaller value costs little, because the error falls exponentially with the number of harmonics
    - `points`: a fixed number of collocation points (on half a period without gravity, otherwise on a whole period) in place of
      an accuracy; typical: 12 to 32. The time grows at least with the square of this number. Under `jit` and `vmap` the values
      that decide on this number are not known; the default is then 16 on half a period and 33 on a whole period, and the
      status shows if it is too small
    - `throw`: raise if there is no such motion; otherwise, and under a JAX transformation, the status shows it

    **Returns** `Orbit`; its fields have derivatives with respect to every parameter of the scene (implicit function theorem,
    forward and reverse).

    **Raises** `InputError` for wrong arguments, loads without drag, and a `mode` of a machine with gyroscopic coupling (its
    resonances depend on the rotor speed; a load speed may have motions at several rotor speeds, and `omega` gives the motion
    at the lowest one); `ComputationError` with the status "absent" or "not_converged".

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
        rough = plan_orbit(scene, mode=None, omega=None, near=scene.drive.speed, accuracy=accuracy, points=points)
        rough = dataclasses.replace(rough, direction=np.ones_like(rough.value))
        in_background(partial(_solve_program.prepare, *_arguments(rough, rough.points[0])))
    plan = plan_orbit(scene, mode=mode, omega=omega, near=near, accuracy=accuracy, points=points)
    if not plan.is_known:
        return outcome(_solve(plan, plan.points[0], _UNKNOWN_STEPS), plan.scene)
    orbit = _solve_accurately(plan)
    if plan.mode is not None and not abs(float(orbit.omega) / float(plan.start) - 1.0) < _MAX_SPEED_DIFFERENCE:
        # The mode does not exist in leading order, or is far from it: search the whole exact branch.
        orbit = _solve_accurately(_from_search(plan, plan.mode))
    return outcome(orbit, throw=throw, failures=("absent", "not_converged"))


def _solve_accurately(plan: OrbitPlan) -> Orbit:
    """Return the first orbit that is accurate enough, or the best one, because more points only add rounding near a fold."""
    best, least = None, math.inf
    for points in plan.points:
        orbit = _solve(plan, points)
        error = float(orbit.error)
        if best is None or error < least:
            best, least = orbit, error
        if not error > plan.accuracy:  # NaN if there is no motion
            break
    assert best is not None
    return best


def _from_search(plan: OrbitPlan, mode: int) -> OrbitPlan:
    """Return the plan that starts from the mode in a search of the whole branch."""
    found = exact_mode_speeds(plan.scene).get(mode)
    start = plan.start if found is None else jnp.asarray(found, dtype=plan.start.dtype)
    return dataclasses.replace(plan, exists=jnp.asarray(found is not None), start=start, is_settled_first=True)


def _solve(plan: OrbitPlan, points: int, steps: int | None = None) -> Orbit:
    return _solve_program(*_arguments(plan, points, steps))


def _arguments(plan: OrbitPlan, points: int, steps: int | None = None) -> tuple[Any, ...]:
    return (
        plan.scene,
        plan.value,
        plan.start,
        plan.exists,
        plan.direction,
        plan.given,
        points,
        steps,
        plan.accuracy,
        plan.implicit,
        plan.is_settled_first,
    )


def _outputs(
    orbit: Orbit,
    scene: Scene,
    value: Array,
    start: Array,
    exists: Array,
    direction: Array | None,
    given: Parameter,
    points: int,
    *_: object,
) -> Orbit:
    """Return the outputs that follow from the solved motion, without multipliers and errors."""
    empty = jax.tree.map(lambda _: None, orbit)
    return dataclasses.replace(
        empty, **differentiable_fields(coincident_model(jammed_model(scene)), orbit, value, start, given, points)
    )


@cached(outputs_from_solution=_outputs)
def _solve_program(
    scene: Scene,
    value: Array,
    start: Array,
    exists: Array,
    direction: Array | None,
    given: Parameter,
    points: int,
    steps: int | None,
    accuracy: float,
    implicit: bool,
    settle: bool = False,
) -> Orbit:
    """Solve for one exact jam.

    **Arguments**: `steps` of the `implicit` or explicit method for the multipliers (default: as many as the speeds need,
    without reverse derivatives); `settle`: start from the motion at the load speed `start`, for a start near the solution.
    """
    model, deviation = coincident_model(jammed_model(scene)), None
    if settle:
        grid = grid_of(points, model.half_turn)
        deviation = periodic_motion(model, grid, "omega", start, light_rotor_speed(model.linear, start)).deviation[None]
    speeds = (value, start) if given == "omega" else (start, value)
    enough = steps_for(model, *speeds, implicit=implicit) if steps is None else steps
    many = jnp.reshape(value, (1,)), jnp.reshape(start, (1,))
    batch, _ = orbits(model, *many, given, points, enough, accuracy, deviation, implicit=implicit)
    orbit = jax.tree.map(lambda leaf: leaf[0], batch)
    # Odd modes lie on rising pieces of the branch, even modes on falling pieces.
    there = exists
    if direction is not None:
        there = exists & (~(orbit.slope * direction < 0.0) | (orbit.status == OrbitStatus.at_fold))
    orbit = jax.tree.map(lambda x: jnp.where(there, x, jnp.nan) if eqx.is_inexact_array(x) else x, orbit)
    status, stable = OrbitStatus.where(there, orbit.status, OrbitStatus.absent), there & orbit.stable
    return eqx.tree_at(lambda o: (o.status, o.stable), orbit, (status, stable))
