"""Exact jams by name: the one of a mode, of a load speed, or near one."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.collected import collected_model
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import has_half_turn
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.runtime.devices import known, on_device
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import fold_points, light_rotor_speed, piece_modes, without_ripples
from jaxvib.steady.jams.jam import jams_of
from jaxvib.steady.orbits.describe import Orbit, OrbitStatus, numbers_of, orbits
from jaxvib.steady.orbits.solve import Parameter, branch_tangent, periodic_motion
from jaxvib.steady.orbits.stability import is_stiff, steps_for
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number, count, number, traced

__all__ = ["branch_at", "exact_mode_speeds", "jam_orbit"]

_POINTS = (16, 32, 64, 128)
"""Points on half a period, tried in turn until the asked accuracy holds."""

_SEARCH, _LANES = 800, 100
"""Points of the exact branch that are looked at where the leading order does not lead to a mode, and of them at once."""

_PARTS = 32
"""Into so many parts cubics divide what lies between two of these points."""

_NEAR_FOLD = 1e-6
"""Relative distance of the rotor's speed from a fold, so far as the cubics say, below which the fold itself is looked for."""

_FAR = 0.02
"""Relative distance of an exact load speed from the leading-order one beyond which it may belong to another mode."""


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
    """The exact motion in which collected loads jam: no assumption that they are light.

        I Omega^2 psi'' = torque(phi, Omega (1 + psi'), n, a) - S e'(phi) . a,      a = B q''
        D(k Omega) q_k = S k^2 Omega^2 B^T e_k,      D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G)

    with phi = theta + psi(theta), S = sum m R, I = sum kappa m R^2, e_k the harmonics of e = (cos phi, sin phi). Solved by
    trigonometric collocation of psi, the carrier eliminated harmonic by harmonic, Newton from the leading order. Loads
    that share every number are collected at one point, or side by side where they have a `ball_radius` (S is then
    m R sin(N arcsin(r/R)) / (r/R); where they would have to pull at each other, on the average of a period, the status is
    `held`). Loads that differ have a psi_j each: they take the places next to each other that their torques ask for.
    The torque is that of drag, gravity and dry friction, whose radial load follows the port's acceleration a. Where friction
    can hold the loads to the rotor, they stick and slip, which no number of harmonics resolves: the status says so.

    **Arguments**, one of the first three

    - `mode`: the number of a jam mode, see `jam_modes`: the motion at the scene's rotor speed that continues it. Where the
      leading order lacks it or is too far from it, the whole exact branch is searched (not under a JAX transformation)
    - `omega`: a load speed, rad/s or text: the motion with that speed; its rotor speed is a result, the scene's is not used
    - `near`: a load speed to start from: a motion at the scene's rotor speed
    - `accuracy`: harmonics are added until the estimated relative error is below it (1e-9 unless said otherwise, in single
      precision 1e-3)
    - `points`: a fixed number of collocation points (on half a period without gravity, else on a period) in place of that.
      Under `jit` and `vmap` shapes cannot follow numbers: there it is 16 (33) unless said otherwise, the status tells
    - `throw`: raise where there is no such motion; else, and under a JAX transformation, the status says so

    **Returns** `Orbit`; derivatives of its numbers with respect to every number of the scene by the implicit function
    theorem, forward and reverse.

    **Raises** `InputError` for wrong arguments, loads without drag, a `mode` of a machine with gyroscopic coupling (its
    resonances move with the rotor's speed; there a load speed may have motions at several rotor speeds, and `omega` gives
    that at the lowest one); `ComputationError` with the status "absent" or "not_converged".

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=0.05, beta=1.0, speed=3.0)
    >>> orbit = jv.jam_orbit(form.scene(), mode=3)
    >>> round(float(orbit.omega), 6), bool(orbit.stable)
    (0.972666, True)

    Source: the antiphase paper, equations (2) and (21), solved without its expansion in eps.
    """
    named = [name for name, value in (("mode", mode), ("omega", omega), ("near", near)) if value is not None]
    if len(named) != 1:
        given = " and ".join(named) if named else "none"
        raise InputError("jam_orbit", f"was asked with {given}; give one of mode=3, omega=95.0, near=95.0")
    scene = validate_scene(scene)
    concrete = not any(traced(leaf) for leaf in jax.tree.leaves((scene, omega, near)))
    # What is known has no gradient to stop: a scene that was checked stays itself, and numbers need no operation.
    frozen = scene if concrete else jax.tree.map(lambda x: jax.lax.stop_gradient(x) if traced(x) else x, scene)
    floor = 1e3 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    if accuracy is None:
        accuracy = 1e-9 if floor < 1e-9 else 1e-3
    if not accuracy >= floor:
        raise InputError("accuracy", f"is {accuracy}; {scene.drive.speed.dtype} numbers allow {floor:.0e} and above")
    loads = jammed_loads(frozen)
    require_drag(loads)

    exists, direction, start = on_device(np.asarray(True)), None, frozen.drive.speed
    if mode is not None:
        if frozen.machine.mounting().gyroscopic is not None:
            raise InputError("mode", "is asked of a machine whose resonances move with the rotor's speed; give omega or near")
        jams = jams_of(frozen)
        light, speed = known(jams.omega)[jams.row(mode)], known(frozen.drive.speed)
        direction = on_device(np.asarray(1.0 if mode % 2 == 1 else -1.0, speed.dtype))
        within = jnp if traced(light) or traced(speed) else np
        exists = on_device(within.asarray(within.isfinite(light)))
        start = on_device(within.asarray(within.where(within.isfinite(light), light, speed)))
    elif near is not None:
        start = number(near, "rad/s", "near", low=0.0, open_low=True)
    which: Parameter = "rotor_speed"
    value = scene.drive.speed
    if omega is not None:
        value = number(omega, "rad/s", "omega", low=0.0, open_low=True)
        which, start = "omega", _light_rotor_speed(frozen, jax.lax.stop_gradient(value))

    if points is not None:
        bodies = 1 if loads.alike else loads.count
        count(points, "points", low=2, each=16.0 * bodies**2 * float(points if isinstance(points, int) else 1))
    half = has_half_turn(scene.effects)
    if points is None and not concrete:
        points = 16 if half else 33
    tried = [points] if points is not None else [p if half else 2 * p + 1 for p in _POINTS]
    still = jax.lax.stop_gradient(value)
    differentiated = any(traced(leaf) for leaf in jax.tree.leaves((scene, value)))
    many, found, settle = tried[0], None, False
    speeds = (still, start) if which == "omega" else (start, still)
    # Unknown numbers may be those of loads with much drag.
    implicit = bool(_is_stiff(frozen, *speeds)) if concrete else True

    def attempt() -> Orbit:
        """The first that is accurate enough, or the best: beside a fold more points add rounding, and no accuracy."""
        nonlocal many
        best, least = None, math.inf
        for each in tried:
            orbit = _orbit(frozen, still, start, exists, direction, which, each, None, accuracy, implicit, settle)
            error = float(orbit.error)
            if best is None or error < least:
                best, least, many = orbit, error, each
            if not error > accuracy:  # nor is it where there is no motion
                break
        assert best is not None
        return best

    if concrete:
        found = attempt()
        if mode is not None and not abs(float(found.omega) / float(start) - 1.0) < _FAR:
            # The leading order has no such mode, or it is far from the exact one: look at the whole exact branch.
            searched = exact_mode_speeds(frozen).get(int(mode))
            exists = jnp.asarray(searched is not None)
            start = start if searched is None else jnp.asarray(searched, dtype=start.dtype)
            settle = True
            found = attempt()
    if found is None or differentiated:
        # Reverse-mode derivatives ask for a number of steps that is part of the program.
        steps = 64
        if concrete:
            wanted = _steps_for(frozen, *speeds, implicit)
            steps = 2 ** int(np.ceil(np.log2(float(wanted))))
        found = _orbit(scene, value, start, exists, direction, which, many, steps, accuracy, implicit, settle)
    return outcome(found, scene, throw=throw and concrete, failures=("absent", "not_converged"))


@cached
def _light_rotor_speed(scene: Scene, omega: Array) -> Array:
    return light_rotor_speed(jammed_model(scene), omega)


@cached
def _is_stiff(scene: Scene, omega: Array, speed: Array) -> Array:
    return is_stiff(collected_model(jammed_model(scene)), omega, speed)


@cached
def _steps_for(scene: Scene, omega: Array, speed: Array, implicit: bool) -> Array:
    return steps_for(collected_model(jammed_model(scene)), omega, speed, implicit=implicit)


@cached
def _fold_points(scene: Scene) -> tuple[Array, Array]:
    return fold_points(jammed_model(scene), _SEARCH)


def _from_orbit(
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
    """What follows from the motion, which is known; neither multipliers nor how good it is."""
    untold = jax.tree.map(lambda _: None, orbit)
    return dataclasses.replace(untold, **numbers_of(collected_model(jammed_model(scene)), orbit, value, start, given, points))


@cached(outputs_from_solution=_from_orbit)
def _orbit(
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
    """One exact jam.

    Its multipliers take so many `steps` of the `implicit` or the explicit method, or those that the speeds ask for (no reverse
    derivatives then); to `settle` is to start from the motion at the load speed `start`, where that is near the answer.
    """
    model, deviation = collected_model(jammed_model(scene)), None
    if settle:
        grid = grid_of(points, model.half_turn)
        deviation = periodic_motion(model, grid, "omega", start, light_rotor_speed(model.linear, start)).deviation[None]
    speeds = (value, start) if given == "omega" else (start, value)
    enough = steps_for(model, *speeds, implicit=implicit) if steps is None else steps
    many = jnp.reshape(value, (1,)), jnp.reshape(start, (1,))
    lanes, _ = orbits(model, *many, given, points, enough, accuracy, deviation, implicit=implicit)
    orbit = jax.tree.map(lambda leaf: leaf[0], lanes)
    # A motion on a falling piece of the branch is not the odd mode that was asked for, nor one on a rising piece the even.
    there = exists
    if direction is not None:
        there = exists & (~(orbit.slope * direction < 0.0) | (orbit.status == OrbitStatus.at_fold))
    orbit = jax.tree.map(lambda x: jnp.where(there, x, jnp.nan) if eqx.is_inexact_array(x) else x, orbit)
    status, stable = OrbitStatus.where(there, orbit.status, OrbitStatus.absent), there & orbit.stable
    return eqx.tree_at(lambda o: (o.status, o.stable), orbit, (status, stable))


def exact_mode_speeds(scene: Scene) -> dict[int, float]:
    """Load speeds (rad/s) of the exact jams at the scene's rotor speed, by mode: where to start from for each.

    The exact branch n(Omega) is looked at point by point, cut where it turns, and its pieces numbered as `jam_modes` does.
    """
    crowded, resonances = _fold_points(scene)
    crowded, target, nd = np.asarray(crowded), float(scene.drive.speed), resonances.shape[0]
    crowded = np.unique(np.append(crowded, target))  # twice the same point would look like a turn
    omega = np.interp(np.linspace(0.0, 1.0, _SEARCH), np.linspace(0.0, 1.0, crowded.size), crowded)
    speed, slope = (np.ravel(x) for x in branch_at(scene, jnp.asarray(omega).reshape(-1, _LANES)))
    known = np.isfinite(speed)
    omega, speed = _between(omega[known], speed[known], slope[known])
    rising = speed[1:] > speed[:-1]
    turn = 1 + np.flatnonzero(rising[1:] != rising[:-1])[: 4 * nd]
    padded = np.pad(turn, (0, 4 * nd - turn.size))
    main = np.asarray(without_ripples(jnp.asarray(speed[padded]), jnp.asarray(turn.size), 2 * nd))
    there = main < turn.size
    cuts = np.where(there, omega[padded[main]], np.inf)
    modes = np.asarray(piece_modes(jnp.asarray(cuts), jnp.asarray(there), resonances))
    crossed = (speed[1:] - target) * (speed[:-1] - target) <= 0.0
    near = turn[np.abs(speed[turn] - target) < _NEAR_FOLD * target]
    close = []
    for k in near:
        around = np.clip([k - _PARTS, k + _PARTS], 0, omega.size - 1)
        low, high = (float(w) for w in omega[around])
        if _ends_before(scene, low, high, target):
            crossed[around[0] : around[1]] = False  # what seems to cross there is the error of the interpolation
        else:
            close.append(k)
    found: dict[int, float] = {}
    for k in np.flatnonzero(crossed):
        part = (target - speed[k]) / (speed[k + 1] - speed[k])
        found.setdefault(int(modes[np.searchsorted(cuts, omega[k])]), float(omega[k] + part * (omega[k + 1] - omega[k])))
    # So close to a fold that it lies between two points: both of its modes are about there.
    for k in close:
        for side in (k - 1, k + 1):
            found.setdefault(int(modes[np.searchsorted(cuts, omega[side])]), float(omega[side]))
    return found


def _ends_before(scene: Scene, low: float, high: float, target: float, looks: int = 2) -> bool:
    """Whether the exact branch turns back, between two load speeds, before it comes to the rotor speed `target`.

    The fold is looked at through ever smaller windows; that its slope is 0 says where it is, to rounding.
    """
    omega = np.linspace(low, high, _SEARCH)
    speed, slope = (np.ravel(x) for x in branch_at(scene, jnp.asarray(omega).reshape(-1, _LANES)))
    (turns,) = np.nonzero(slope[1:] * slope[:-1] <= 0.0)
    if turns.size != 1:
        return False
    ends = slice(turns[0], turns[0] + 2)
    if looks > 1:
        low, high = (float(w) for w in omega[ends])
        return _ends_before(scene, low, high, target, looks - 1)
    rounding = 4096.0 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    fold = _between(omega[ends], speed[ends], slope[ends])[1]
    return bool(np.max(fold) < target * (1.0 - rounding) if slope[turns[0]] > 0.0 else np.min(fold) > target * (1.0 + rounding))


def _between(x: np.ndarray, y: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of the cubics through (x, y) with these slopes, `_PARTS` an interval."""
    t, h = np.arange(_PARTS) / _PARTS, np.diff(x)[:, None]
    a, b, c, d = y[:-1, None], h * slope[:-1, None], y[1:, None], h * slope[1:, None]
    cubic = (1.0 + 2.0 * t) * (1.0 - t) ** 2 * a + t * (1.0 - t) ** 2 * b + t**2 * (3.0 - 2.0 * t) * c + t**2 * (t - 1.0) * d
    return np.append(x[:-1, None] + h * t, x[-1]), np.append(cubic, y[-1])


@cached
def branch_at(scene: Scene, omega: Array) -> tuple[Array, Array]:
    """Rotor speeds (rad/s) and slopes dn/dOmega of exact jams at load speeds `omega` (batches, many), rad/s; NaN where there is
    none."""
    model = collected_model(jammed_model(scene))
    grid = grid_of(*((16, True) if model.half_turn else (33, False)))

    def one(w: Array) -> tuple[Array, Array]:
        motion = periodic_motion(model, grid, "omega", w, light_rotor_speed(model.linear, w))
        branch = branch_tangent(model, grid, motion)
        there = branch.residual < 4096.0 * jnp.finfo(w.dtype).eps
        return jnp.where(there, motion.rotor_speed, jnp.nan), jnp.where(there, branch.slope, jnp.nan)

    return jax.lax.map(jax.vmap(one), omega)
