"""Limits of synchronization: folds of exact synchronous motions over a parameter of the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto
from jaxvib.errors import InputError
from jaxvib.machine.numbers.named import NamedNumber, find_number, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.numerics.linalg import solve_in_turn
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member
from jaxvib.runtime.programs import cached
from jaxvib.steady.balance.monodromy import at_constant_speed
from jaxvib.steady.orbits.solve import Linearized, newton
from jaxvib.steady.orbits.synchronous import HasSpeedAndPhases, synchronous_orbit
from jaxvib.steady.orbits.whole import (
    PeriodicScene,
    body_counts,
    collocation,
    forcing_exciters,
    linear_start,
    means_of_exciters,
    periodic_scene,
    residual_of,
)
from jaxvib.units import Bounds

_STEP = 0.1
"""Distance between two points of a branch: change of the phase, rad, or relative change of the speed divided by
`_SPEED_PER_RADIAN`."""

_SPEED_PER_RADIAN = 0.1
"""Relative change of the speed that counts as a phase of 1 rad, if no phase is free."""

_SAME_VALUE = 1e-4
"""Largest relative difference between the parameter's value at the first point of the branch and its value in the scene. The
first point has the phase of the given motion, so that the values agree. They differ if the parameter has no effect on the
motion: its value is then not determined."""

_MAX_BRANCH_POINTS = 70
"""Largest number of points of a branch up to its fold; their phases cover more than a full turn."""


class LimitStatus(eqx.Enumeration):
    """Outcomes of a search for the limit of synchronization. The value of each member is the message shown to the user."""

    found = "the motion ends at this fold and does not exist beyond it"
    not_found = "no fold was found among the allowed values in this direction: the motion could not be followed to a fold"
    no_effect = "the parameter changes neither the phases nor the speed of this motion: there is no fold over it"


class SynchronizationLimit(Result):
    """Range of a parameter of the scene in which a synchronous motion exists, (2,): its lower and its upper end.

    Returned by `synchronization_limit`. At both ends the motion meets another one and vanishes.

    **Attributes**

    - `status`: a `LimitStatus` for each end
    - `value` (2,) of the parameter `over`, SI; NaN without a fold
    - `speed` (2,), rad/s, and `phases` (2, N), rad, of the motion at each end, see `SynchronousOrbit`
    - `start`: value of the parameter in the scene, SI, and `stable`: True if the motion is stable at this value
    - `branch_values`, `branch_phases`, rad, and `branch_speeds`, rad/s, (P,): value of the parameter, phase of one exciter and
      speed along the branch
    """

    outer_axes = ("end",)

    status: LimitStatus
    value: np.ndarray = eqx.field(metadata=in_unit("", "end"))
    speed: np.ndarray = eqx.field(metadata=in_unit("rad/s", "end"))
    phases: np.ndarray = eqx.field(metadata=in_unit("rad", "end", "exciter"))
    start: np.ndarray = eqx.field(metadata=in_unit(""))
    stable: np.ndarray = eqx.field(metadata=in_unit(""))
    branch_values: np.ndarray = eqx.field(metadata=in_unit("", "branch_point"))
    branch_phases: np.ndarray = eqx.field(metadata=in_unit("rad", "branch_point"))
    branch_speeds: np.ndarray = eqx.field(metadata=in_unit("rad/s", "branch_point"))
    over: str = eqx.field(static=True, metadata=in_unit(""))

    def summary(self) -> str:
        """Return both ends of the range as text."""
        low, high = (float(x) for x in self.value)
        now = f"{float(self.start):.8g}, {'stable' if self.stable else 'not stable'}"
        return f"{self.over} from {low:.8g} to {high:.8g} (now {now})\n{self.message}"

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot the parameter over the phase, or over the speed of a single motor, along the branch."""
        from jaxvib.draw.results import signals_chart  # slow import

        values = [(self.over, np.asarray(self.branch_values)[:, None], [self.over])]
        label, along = "phase, degrees", np.rad2deg(np.asarray(self.branch_phases))
        if np.ptp(along) < 1e-6:
            label, along = "speed, rad/s", np.asarray(self.branch_speeds)
        return signals_chart(along, values, x_label=label, ax=ax)


@validated
def synchronization_limit(scene: Scene, regime: HasSpeedAndPhases, *, over: str) -> SynchronizationLimit:
    """Return the range of a parameter of the scene in which a synchronous motion exists; folds of the exact motion limit it.

    Along a branch of motions the parameter is a smooth function of the phase of an exciter, or of the speed if only one motor
    turns; a fold is a maximum or minimum of this function. Each point of the branch is therefore solved for the parameter at a
    given phase or speed, and the fold is the root of the slope. The equations are not singular at a fold.

    For a single motor, the range is that in which a resonance catches the motor, or in which the motor has passed it.

    **Arguments**

    - `scene` with at least one exciter that has a motor or loads
    - `regime`: a motion with `speed` and `phases`, such as a `SynchronousOrbit` of the scene
    - `over`: name of the parameter, such as "exciters[1].drive.speed", "exciters[0].unbalance"

    **Returns** `SynchronizationLimit`; an end without a fold is NaN and has the status "not_found" or "no_effect". The motion
    can lose its stability before its fold.

    **Raises** `ComputationError` if the scene has no such motion, and `InputError` for

    - a name that the scene does not have, and the name of an array
    - the speed of one of several ideal drives with unbalances
    - scenes in which neither the speed nor a phase is free

    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(4e5, 4e5), damping=(2e3, 2e3)) for x in (-1.0, 1.0)]
    >>> screen = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    >>> motor = jv.DCMotor("1000 rpm", stall_torque=300.0, inertia=0.5)
    >>> exciters = [jv.Exciter(drive=motor, unbalance=1.5, at=(x, 0.0), direction=d) for x, d in ((-0.3, 1), (0.3, -1))]
    >>> scene = jv.Scene(screen, exciters=exciters)
    >>> limit = jv.synchronization_limit(scene, jv.synchronous_orbit(scene, phases=[0.0, 3.1]), over="exciters[1].drive.speed")
    >>> bool(limit.value[0] < motor.speed < limit.value[1])
    True

    Source: Blekhman 1988: a synchronous motion exists while the differences of the torques are below the vibrational torque.
    """
    scene = at_constant_speed(validate_scene(scene))
    number = find_number(scene, over, "over")
    if number.size != 1:
        raise InputError(f"over.{over}", f"has {number.size} entries; name one, for example {over}[0]")
    counts, forced = body_counts(scene), bool(forcing_exciters(scene))
    free = [k for k, count in enumerate(counts) if count][not forced :]
    if not free and forced:
        raise InputError("scene", "has no exciter whose speed or phase is free; give an exciter with a motor, or with loads")
    _require_one_period(scene, number)
    own = number.path[1] if number.path[0] == "exciters" else None
    exciter = (own if own in free else free[0]) if free else None
    orbit = synchronous_orbit(scene, regime)
    points = 2 * orbit.displacement_harmonics.shape[1] - 1
    value = float(np.ravel(np.asarray(number.leaf(scene)))[number.entry or 0])
    unit = float(orbit.speed)
    near = _Point(*map(np.asarray, (value, orbit.speed, orbit.phases, 0.0, True, 0.0)))

    def at(point: _Point, along: float) -> _Point:
        phases, speed = np.array(point.phases), np.asarray(point.speed)
        if exciter is None:
            speed = np.asarray(unit * (1.0 + _SPEED_PER_RADIAN * along), speed.dtype)
        else:
            phases[exciter] = along
        solution = map(np.asarray, _branch_point(scene, over, point.value, speed, phases, exciter, points))
        new = _Point(*solution, along=np.asarray(along))
        return new if exciter is not None else new._replace(slope=new.slope * unit * _SPEED_PER_RADIAN)

    first = at(near, 0.0 if exciter is None else float(near.phases[exciter]))
    has_effect = bool(first.is_met) and abs(float(first.value) - value) <= _SAME_VALUE * max(abs(value), 1e-6)
    first = first if has_effect else near
    rising = 1.0 if float(first.slope) > 0.0 else -1.0
    ends = [_find_fold(at, first, towards, number.spec.bounds) if has_effect else (None, []) for towards in (-rising, rising)]
    branch, failure = [*reversed(ends[0][1]), first, *ends[1][1]], "not_found" if has_effect else "no_effect"
    return SynchronizationLimit(
        status=member(LimitStatus, np.array([failure if end is None else "found" for end, _ in ends])),
        value=np.array([np.nan if end is None else float(end.value) for end, _ in ends]),
        speed=np.array([np.nan if end is None else float(end.speed) for end, _ in ends]),
        phases=np.stack([np.full_like(first.phases, np.nan) if end is None else end.phases for end, _ in ends]),
        start=np.asarray(value),
        stable=np.asarray(orbit.stable),
        branch_values=np.array([float(point.value) for point in branch]),
        branch_phases=np.array([float(point.phases[exciter or 0]) for point in branch]),
        branch_speeds=np.array([float(point.speed) for point in branch]),
        over=over,
    )


def _require_one_period(scene: Scene, number: NamedNumber) -> None:
    """**Raises** `InputError` for the speed of one of several ideal drives with unbalances, whose speeds must be equal."""
    forcing = forcing_exciters(scene)
    if len(forcing) > 1 and any(number.path[:3] == ("exciters", k, "drive") for k in forcing):
        problem = "changes the speed of one of several ideal drives, so that no motion repeats; name another parameter"
        raise InputError(f"over.{number.name}", problem)


class _Point(NamedTuple):
    """Point of a branch: `value` of the parameter, `speed`, rad/s, and `phases` (N,), rad; `slope`: derivative of the value
    with respect to the coordinate `along` the branch (phase of one exciter, rad, or relative change of the speed divided by
    `_SPEED_PER_RADIAN`); `is_met`: True if the equations are satisfied."""

    value: np.ndarray
    speed: np.ndarray
    phases: np.ndarray
    slope: np.ndarray
    is_met: np.ndarray
    along: np.ndarray


def _find_fold(
    at: Callable[[_Point, float], _Point], first: _Point, towards: float, bounds: Bounds
) -> tuple[_Point | None, list[_Point]]:
    """Return the fold in one direction along the branch within the `bounds` of the parameter, or None, and the points of the
    branch up to it."""
    points, here, step = [], first, _STEP
    while len(points) < _MAX_BRANCH_POINTS and step > 1e-3 * _STEP:
        new = at(here, float(here.along) + towards * step)
        if not (new.is_met and bounds.allow(new.value)):
            step /= 4.0
            continue
        points.append(new)
        if float(new.slope) * float(first.slope) < 0.0:
            return _refine_fold(at, here, new), points
        here = new
    return None, points


def _refine_fold(at: Callable[[_Point, float], _Point], a: _Point, b: _Point) -> _Point | None:
    """Return the point between two others at which the slope is zero, by the Illinois method."""
    x, y = [float(p.along) for p in (a, b)], [float(p.slope) for p in (a, b)]
    for _ in range(30):
        middle = x[1] - y[1] * (x[1] - x[0]) / (y[1] - y[0])
        b = at(b, middle)
        if not b.is_met:
            return None
        if abs(middle - x[1]) < 1e-9:
            return b
        if float(b.slope) * y[1] < 0.0:
            x[0], y[0] = x[1], y[1]
        else:
            y[0] *= 0.5
        x[1], y[1] = middle, float(b.slope)
    return b


@cached
def _branch_point(
    scene: Scene,
    over: str,
    value: Array | np.ndarray,
    speed: Array | np.ndarray,
    phases: Array | np.ndarray,
    exciter: int | None,
    points: int,
) -> tuple[Array, ...]:
    """Solve for the fields of `_Point` except `along`.

    The motion has the given phase of an `exciter`, or the given speed if `exciter` is None; `slope` is the derivative with
    respect to this phase or speed.
    """
    value, speed, phases = jnp.asarray(value), jnp.asarray(speed), jnp.asarray(phases)
    number, grid, counts = find_number(scene, over, "over"), grid_of(points, False), body_counts(scene)
    forced = bool(forcing_exciters(scene))
    unit = jnp.maximum(jnp.abs(value), 1e-6)

    def scene_at(share: Array) -> PeriodicScene:
        return periodic_scene(put_numbers(scene, [number], (share * unit)[None]), phases)

    start = value / unit
    whole = scene_at(start)
    speed = _forced_speed(whole, speed)
    x, nd = linear_start(whole, grid, speed), whole.coordinates
    size, weight = x.size, jnp.minimum(whole.feedback, 1.0)
    pin = np.zeros(x.shape)
    if exciter is not None:
        pin[nd + sum(counts[:exciter])] = 1.0 / grid.theta.size

    def equations(x: Array, w: Array, share: Array) -> tuple[Array, Array, Array]:
        def residual(whole: PeriodicScene) -> Array:
            return residual_of(whole, grid, x, _forced_speed(whole, w))

        whole = scene_at(share)
        system = collocation(whole, grid, x, _forced_speed(whole, w), forced=forced)
        by_value = jax.jvp(lambda s: residual(scene_at(s)), (share,), (jnp.ones_like(share),))[1]
        rest = system.matrix.shape[0] - size
        column = jnp.concatenate([by_value.ravel(), jnp.zeros(rest)])[:, None]
        row = jnp.asarray(np.concatenate([pin.ravel(), [0.0 if exciter is not None else 1.0] * rest, [0.0]]))[None]
        matrix = jnp.concatenate([jnp.concatenate([system.matrix, column], axis=1), row])
        return system.residual, system.scale, matrix

    def linearize(x: Array, w: Array, share: Array) -> Linearized:
        residual, scale, matrix = equations(x, w, share)
        carrier, bodies = jnp.split(residual, [nd])
        norm = jnp.sqrt((jnp.sum((weight * carrier) ** 2) + jnp.sum(bodies**2)) / size)
        right = jnp.concatenate([residual.ravel(), jnp.zeros(matrix.shape[0] - size)])
        return Linearized(norm, scale, lambda: -solve_in_turn(matrix, right))

    def move(unknowns: tuple[Array, ...], change: Array, length: Array) -> tuple[Array, ...]:
        x, w, share = unknowns
        limit = 1.0 / jnp.max(jnp.abs(change[:size].reshape(x.shape)[nd:]), initial=1e-30)
        limit = jnp.minimum(limit, 0.5 / jnp.maximum(jnp.abs(change[-1]), 1e-30))
        change = jnp.minimum(length, limit) * change
        return x + change[:size].reshape(x.shape), w if forced else w + change[size], share + change[-1]

    change = jnp.zeros(size + (1 if forced else 2), x.dtype)
    x, w, share = newton(linearize, move, (x, speed, start), change, jnp.ones_like(start))
    residual, scale, matrix = equations(x, w, share)
    slope = solve_in_turn(matrix, jnp.zeros(matrix.shape[0]).at[-1].set(1.0))[-1] * unit
    moved = means_of_exciters(scene, jnp.mean(x[nd:], axis=1))
    met = jnp.max(jnp.abs(residual)) < 4096.0 * jnp.finfo(x.dtype).eps * scale
    return share * unit, _forced_speed(scene_at(share), w), phases + moved, slope, met


def _forced_speed(whole: PeriodicScene, w: Array) -> Array:
    """Return the speed of a motion: that of an ideal drive with an unbalance, or else the unknown `w`."""
    forcing = forcing_exciters(whole.model.scene)
    return whole.model.scene.exciters[forcing[0]].drive.speed if forcing else w
