"""Exact synchronous motions: every exciter turns once in a period of the machine's motion.

Choices that depend on parameters of a scene are made on the host (`plan_synchronous`), before a program is traced.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, quantity_text, speed_text
from jaxvib.equations.forces import drive_torques
from jaxvib.equations.linear import require_terms
from jaxvib.equations.state import State
from jaxvib.equations.torque_balance import mass_owners
from jaxvib.errors import InputError, quoted
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction, GravityField, LoadPotential, RotorImbalance, SupportForce
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fourier import Grid, analyzed, deviation_analysis, grid_of
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.balance.monodromy import at_constant_speed
from jaxvib.steady.orbits.describe import half_range, judgement_of, plot_period
from jaxvib.steady.orbits.whole import (
    PeriodicScene,
    WholeMotion,
    collocation_error,
    forcing_exciters,
    means_of_exciters,
    multipliers_of,
    periodic_scene,
    solve_whole,
    state_of,
)
from jaxvib.steady.outcome import REFUSED, outcome
from jaxvib.steady.points import Harmonic, PathsOfPoints
from jaxvib.steady.vibration import Samples, periodic_samples
from jaxvib.units import Number, Numbers, count, known_number, number, numbers, validate_tolerance
from jaxvib.units.known import is_known, when_known

_MAX_UNKNOWN_STEPS = 128
"""Limit of the integration steps for the multipliers under a JAX transformation; reverse derivatives need a static limit."""

_ONE_ANGLE = 1e-3
"""Largest difference between the phases of loads at one angle, rad."""


_SYNCHRONOUS_POINTS = (17, 33, 65, 129)
"""Collocation points on a period, tried one after the other until the accuracy is reached."""

_SYNCHRONOUS_TERMS = (GravityField, LoadPotential, RotorImbalance, ContactFriction, SupportForce)
"""Terms that exact synchronous motions include."""


class SynchronousStatus(eqx.Enumeration):
    """Outcomes of a search for a synchronous motion. The value of each member is the message shown to the user."""

    found = "the exciters can turn together in this periodic motion"
    not_converged = (
        "no periodic motion was found near the given speed and phases: the equations of motion could not be satisfied"
    )
    different_speeds = "ideal drives turn unbalances at different speeds, so that no motion repeats"
    under_resolved = "the periodic motion needs more harmonics for the requested accuracy; give more points"
    unresolved = (
        "the motion was found, but not its stability: the fastest vibration of the machine is too fast "
        "compared with the exciters"
    )
    at_fold = "the motion is at a fold or belongs to a continuous family of motions: it has no gradient"
    refused = REFUSED


@runtime_checkable
class HasSpeedAndPhases(Protocol):
    """Motion with a speed and phases, such as a synchronous regime of the averaged theory."""

    @property
    def speed(self) -> Array:
        """Speed Omega, rad/s."""
        ...

    @property
    def phases(self) -> Array:
        """Phases alpha (N,), rad."""
        ...


class SynchronousOrbit(PathsOfPoints, Result):
    """Exact synchronous motion: th_k = sigma_k (theta + alpha_k + psi_k(theta)), theta = Omega t, psi_k of mean 0.

    th_k is the angle of the rotor of exciter k, or of its loads if its rotor is balanced; sigma_k is the direction of the
    exciter. Returned by `synchronous_orbit`. Values except `residual` and `error` are NaN if the status is
    `not_converged` or `different_speeds`. Signals are Re sum_k c_k exp(i k theta).

    **Attributes**

    - `status`: a `SynchronousStatus`
    - `speed` Omega, rad/s, and `phases` alpha (N,), rad
    - `torque` (N,), N m: mean torque of each drive in the direction of its rotation; `power` (N,), W: its mean power
    - `amplitude` (nd,), m (rad for rotations), and `foundation_force`, N: zero to peak, (max - min)/2 over the period; for two
      directions of the force the root of their summed squares
    - `stable`: True if small disturbances decay, that is `multiplier` < 1 - `multiplier_error`
    - `multiplier`: largest modulus of the non-trivial Floquet multipliers; `multiplier_error`: its estimated numerical error
    - `multipliers`: the Floquet multipliers, complex, without the trivial one; `trivial`: computed value of the trivial
      multiplier, that of a shift in time, whose exact value is 1. It is NaN if an ideal drive turns an unbalance, because a
      shifted motion is then not a solution
    - `residual` of the equations of motion, relative; `error`: estimated relative error of speed and displacements, and error
      of angles in rad, due to the limited number of harmonics. A motion that is not at a fold and whose error is above 1 is
      `not_converged`
    - `deviation_harmonics` (bodies, K), rad: alpha_k + psi_k of each load or rotor, `displacement_harmonics` (nd, K), m (rad
      for rotations), and `force_harmonics` (directions, K), N, of the force on the foundation; orders 0, 1, 2, ...
    - `scene`
    """

    status: SynchronousStatus
    speed: Array = eqx.field(metadata=in_unit("rad/s"))
    phases: Array = eqx.field(metadata=in_unit("rad", "exciter"))
    torque: Array = eqx.field(metadata=in_unit("N m", "exciter"))
    power: Array = eqx.field(metadata=in_unit("W", "exciter"))
    stable: Array = eqx.field(metadata=in_unit(""))
    multiplier: Array = eqx.field(metadata=in_unit(""))
    multiplier_error: Array = eqx.field(metadata=in_unit(""))
    multipliers: Array = eqx.field(metadata=in_unit("", "floquet"))
    trivial: Array = eqx.field(metadata=in_unit(""))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N"))
    residual: Array = eqx.field(metadata=in_unit(""))
    error: Array = eqx.field(metadata=in_unit(""))
    deviation_harmonics: Array = eqx.field(metadata=in_unit("rad", "body", "order"))
    displacement_harmonics: Array = eqx.field(metadata=in_unit("m or rad", "coordinate", "order"))
    force_harmonics: Array = eqx.field(metadata=in_unit("N", "direction", "order"))
    scene: Scene = eqx.field(metadata=SCENE)

    @property
    def judgement(self) -> str:
        """Stability as text: "stable", "unstable", or that the stability is unknown."""
        return judgement_of(self.multiplier, self.multiplier_error, self.stable)

    @validated
    def at(self, theta: Number) -> State:
        """Return the state of the motion at the angle `theta` = Omega t, rad. For many angles use `jax.vmap(orbit.at)`.

        **Raises** `InputError` for an angle that is not finite.
        """
        angle = known_number(theta, "rad", "theta")
        return _at(self.scene, self.speed, self.displacement_harmonics, self.deviation_harmonics, angle)

    def harmonic(self) -> Harmonic:
        """Return the vibration of the coordinates at Omega, and the mean square of their other harmonics."""
        higher = self.displacement_harmonics[:, 2:]
        return Harmonic(
            self.scene.machine, self.speed, self.displacement_harmonics[:, 1], 0.5 * (higher @ higher.conj().T).real
        )

    def samples(self) -> Samples:
        """Return samples of the motion, see `periodic_samples`."""
        orders = tuple(range(self.displacement_harmonics.shape[-1]))
        return periodic_samples(orders, self.speed, self.displacement_harmonics, self.force_harmonics)

    def summary(self) -> str:
        """Return the result as a few lines of text; amplitudes zero to peak."""
        units = self.scene.machine.structure().units
        amplitudes = ", ".join(quantity_text(a, unit, 6) for a, unit in zip(self.amplitude, units, strict=True))
        phases, torques = (", ".join(f"{float(x):.6g}" for x in each) for each in (self.phases, self.torque))
        return (
            f"{self.message}\nspeed {speed_text(self.speed, 9)}, phases {phases} rad, "
            f"{self.judgement} (largest multiplier {float(self.multiplier):.6g})\n"
            f"torques {torques} N m, power {float(jnp.sum(self.power)):.6g} W\n"
            f"amplitude {amplitudes}, foundation force {quantity_text(self.foundation_force, 'N', 6)}\n"
            f"{self.displacement_harmonics.shape[-1] - 1} harmonics leave an error of {float(self.error):.1e}"
        )

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot a period over the angle Omega t: displacements, angles relative to uniform rotation, force on the foundation.

        **Returns** a matplotlib figure, or the given `ax`, which has three axes.
        """
        orders = tuple(range(self.displacement_harmonics.shape[-1]))
        deviation = orders, self.deviation_harmonics, "angle - Ωt, degrees", "body", "the body"
        structure = self.scene.machine.structure()
        named = (structure.coordinates, structure.units)
        return plot_period(orders, self.displacement_harmonics, named, deviation, self.force_harmonics, ax)


@cached
def _at(scene: Scene, omega: Array, displacement: Array, deviation: Array, theta: Array) -> State:
    k = np.arange(displacement.shape[-1])
    wave = jnp.exp(1j * k * theta)
    q, v = (displacement @ wave).real, omega * (displacement @ (1j * k * wave)).real
    return state_of(scene, theta, q, v, (deviation @ wave).real, (deviation @ (1j * k * wave)).real, omega)


@validated
def synchronous_orbit(
    scene: Scene,
    regime: HasSpeedAndPhases | None = None,
    *,
    speed: Number | None = None,
    phases: Numbers | None = None,
    accuracy: float | None = None,
    points: int | None = None,
    throw: bool = True,
) -> SynchronousOrbit:
    """Return the exact periodic motion in which all exciters turn at one mean speed Omega.

        th_k = sigma_k (theta + alpha_k + psi_k(theta)),  q(theta),    theta = Omega t,    psi_k and q periodic

    th_k is the angle of the turning body of exciter k, sigma_k its direction of rotation (1 or -1), alpha_k its phase, and
    psi_k its deviation from uniform rotation. q are the coordinates of the machine. The full equations of motion are satisfied
    at equally spaced points of the period (trigonometric collocation of q and all angles), by Newton's method from the given
    speed and phases. If this start is far from every motion, another motion may be found, or none. The turning body of an
    exciter is

    - the rotor with its unbalance, if the exciter has no loads. Omega follows from the torques of the motors; an ideal drive
      instead prescribes th_k = sigma_k n t (phase 0) and Omega = n
    - the loads, all at one angle, if the rotor is balanced and has an ideal drive: the loads of all exciters jam at one speed

    **Arguments**: `scene`, whose effects may be gravity, dry and rolling friction, nonlinear supports, and imbalances of rotors
    without loads; and

    - `regime`: a motion of the averaged theory with `speed` and `phases` of all masses, with the loads of each exciter at one
      angle; or these two arguments:
    - `speed`: starting value of Omega, rad/s or text; default: the mean of the motors' no-load speeds; typical: 60 to 320
    - `phases` (N,): starting values of alpha, rad; default: 0. If no ideal drive turns an unbalance, the first phase keeps its
      value, because it defines the origin of time
    - `accuracy`: harmonics are added until the estimated relative error is below it; typical: 1e-4 to 1e-8 (the default; in
      single precision 1e-3)
    - `points`: a fixed number of points on a period in place of an accuracy; typical: 17 to 65. Under `jit` and `vmap` the
      default is 33, and the status shows whether it is too small
    - `throw`: raise if there is no such motion; otherwise, and under a JAX transformation, the status shows it

    **Returns** `SynchronousOrbit`; its fields have derivatives with respect to every parameter of the scene (implicit function
    theorem, forward and reverse).

    **Raises** `InputError` for wrong arguments and for exciters whose motion has no common period; `ComputationError` with
    the status "not_converged" or "different_speeds".

    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(4e5, 4e5), damping=(2e3, 2e3)) for x in (-1.0, 1.0)]
    >>> screen = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    >>> motor = jv.DCMotor("1000 rpm", stall_torque=300.0, inertia=0.5)
    >>> exciters = [jv.Exciter(drive=motor, unbalance=1.5, at=(x, 0.0), direction=d) for x, d in ((-0.3, 1), (0.3, -1))]
    >>> orbit = jv.synchronous_orbit(jv.Scene(screen, exciters=exciters), phases=[0.0, 3.1])
    >>> round(float(orbit.phases[1]), 6), bool(orbit.stable)
    (3.141593, True)

    Source: Blekhman 1988, Synchronization in Science and Technology, whose averaged motions correspond to these exact ones.
    """
    plan = plan_synchronous(scene, regime, speed=speed, phases=phases, accuracy=accuracy, points=points)
    if not plan.is_known:
        return outcome(_solve(plan, plan.points[0], _MAX_UNKNOWN_STEPS), plan.scene)
    orbit = None
    for points in plan.points:
        new = _solve(plan, points)
        if orbit is None or float(new.error) < float(orbit.error):
            orbit = new
        if not float(new.error) > plan.accuracy:  # NaN if there is no motion
            break
    assert orbit is not None
    return outcome(orbit, throw=throw, failures=("not_converged", "different_speeds"))


class SynchronousPlan(NamedTuple):
    """Plan of an exact synchronous motion.

    **Attributes**: the `scene` with its drives in their final state; starting values of `speed`, rad/s, and `phases` (N,), rad;
    numbers of collocation `points` to try one after the other; relative `accuracy`; `is_known`: True if no parameter is traced.
    """

    scene: Scene
    speed: Array
    phases: Array
    points: tuple[int, ...]
    accuracy: float
    is_known: bool


def plan_synchronous(
    scene: Scene,
    regime: HasSpeedAndPhases | None,
    *,
    speed: Number | None,
    phases: Numbers | None,
    accuracy: float | None,
    points: int | None,
) -> SynchronousPlan:
    """Validate the arguments of `synchronous_orbit`, and choose start and points. **Raises** `InputError`."""
    if regime is not None and (speed is not None or phases is not None):
        raise InputError("regime", "is given together with speed or phases; leave one of them out")
    scene = validate_scene(scene)
    if regime is not None:
        speed = number(regime.speed, "rad/s", "regime.speed", low=0.0, open_low=True)
        phases = _phases_of_exciters(scene, regime)
    require_terms(scene.all_effects, _SYNCHRONOUS_TERMS, "is|are not part of a synchronous motion")
    for k, exciter in enumerate(scene.exciters):
        _require_one_body(exciter, scene.prefix_of(k))
    scene = at_constant_speed(scene)
    prescribed = [scene.exciters[k] for k in forcing_exciters(scene)]
    motors = [e.drive.speed for e in scene.exciters if not e.drive.ideal and not isinstance(e.drive, SwitchedOff)]
    if prescribed:
        start = prescribed[0].drive.speed
    elif speed is not None:
        start = number(speed, "rad/s", "speed", low=0.0, open_low=True)
    elif motors:
        start = jnp.mean(jnp.stack(motors))
    else:
        raise InputError("speed", "is missing; give the speed near which the loads turn, rad/s, for example speed=95.0")
    n = len(scene.exciters)
    field = "phases" if regime is None else "regime.phases"
    angles = jnp.zeros(n, start.dtype) if phases is None else numbers(phases, "rad", field, n)
    all_known = is_known(scene, start, angles)
    if accuracy is None:
        accuracy = 1e-8 if start.dtype.itemsize >= 8 else 1e-3
    tried = _SYNCHRONOUS_POINTS if all_known else _SYNCHRONOUS_POINTS[1:2]
    return SynchronousPlan(
        scene=scene,
        speed=start,
        phases=angles,
        points=tried if points is None else (count(points, "points", low=3, each=256.0),),
        accuracy=validate_tolerance(accuracy, "accuracy", start.dtype, 1e3),
        is_known=all_known,
    )


def _phases_of_exciters(scene: Scene, regime: HasSpeedAndPhases) -> Array:
    """Return the phases (N,) of the exciters in a regime, which may state those of all rotating masses.

    **Raises** `InputError` for a regime of some of the masses, and for loads of one exciter at different phases.
    """
    owners = mass_owners(scene)
    phases, masses = numbers(regime.phases, "rad", "regime.phases", None), getattr(regime, "masses", None)
    if masses is not None and masses.shape != owners.shape:
        raise InputError(
            "regime.masses", f"are {masses.size} of the scene's {owners.size} rotating masses; give a regime of all"
        )
    if phases.shape != owners.shape:
        return phases
    first = np.searchsorted(owners, np.arange(len(scene.exciters)))

    def check(phases: np.ndarray) -> None:
        differs = np.abs(np.exp(1j * phases) - np.exp(1j * phases[first[owners]])) > _ONE_ANGLE
        if np.any(differs):
            problem = "differ; this function is for loads of an exciter at one angle, use simulate or envelope for others"
            raise InputError("regime.phases", f"of the loads of exciter {owners[np.argmax(differs)] + 1} {problem}")

    when_known(check, phases)
    return phases[first]


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
            "do not turn at the rotor speed, as the rotor's unbalance does, so no motion repeats; "
            "leave one of them out, or simulate"
        )
        raise InputError(f"{place}loads", problem)
    if not drive.ideal:
        raise InputError(
            f"{place}drive", f"is {quoted(drive.kind)}; loads need a drive of prescribed speed here; use ConstantSpeed"
        )
    if not loads.circular:
        raise InputError(
            f"{place}loads.kind", f"is {quoted(loads.kind)}; this function needs loads on a circle; use simulate for others"
        )
    if getattr(loads, "ball_radius", None) is not None and loads.count > 1:
        raise InputError(
            f"{place}loads.ball_radius", "is given, but this function places the loads at one angle; leave it out, or simulate"
        )


def _solve(plan: SynchronousPlan, points: int, max_steps: int | None = None) -> SynchronousOrbit:
    return _solve_program(plan.scene, plan.speed, plan.phases, points, max_steps, plan.accuracy)


@cached
def _solve_program(
    scene: Scene, speed: Array, phases: Array, points: int, max_steps: int | None, accuracy: float
) -> SynchronousOrbit:
    """Solve for one synchronous motion with a number of collocation points; `max_steps`: see `multipliers_of`."""
    whole, grid, forcing = periodic_scene(scene, phases), grid_of(points, False), forcing_exciters(scene)
    forced = bool(forcing)
    motion = solve_whole(whole, grid, speed, forced=forced)
    residual, error = collocation_error(whole, grid, motion, forced=forced)
    multipliers, trivial, multiplier_error = multipliers_of(whole, grid, motion, max_steps, forced=forced)
    eps = float(jnp.finfo(speed.dtype).eps)
    largest = jnp.max(jnp.abs(multipliers))
    at_fold = jnp.min(jnp.abs(multipliers - 1.0)) < eps**0.4
    is_solved = residual < 4096.0 * eps
    is_met = is_solved & (~(error > 1.0) | at_fold)  # the estimate is useless at a fold
    has_one_speed = jnp.asarray(True)
    for k in forcing:
        has_one_speed = has_one_speed & (jnp.abs(scene.exciters[k].drive.speed / speed - 1.0) < 64.0 * eps)
    status = SynchronousStatus.where(error <= accuracy, SynchronousStatus.found, SynchronousStatus.under_resolved)
    status = SynchronousStatus.where(jnp.isnan(largest), SynchronousStatus.unresolved, status)
    status = SynchronousStatus.where(at_fold, SynchronousStatus.at_fold, status)
    status = SynchronousStatus.where(is_met, status, SynchronousStatus.not_converged)
    status = SynchronousStatus.where(has_one_speed, status, SynchronousStatus.different_speeds)
    is_solution = is_met & has_one_speed
    numbers = {
        **_quantities(whole, grid, motion), "multiplier": largest, "multiplier_error": multiplier_error,
        "multipliers": multipliers, "trivial": trivial,
    }  # fmt: skip
    numbers = {name: jnp.where(is_solution, x, jnp.nan) for name, x in numbers.items()}
    numbers["error"] = jnp.where(is_solved & has_one_speed, error, jnp.nan)
    stable = is_solution & (largest < 1.0 - multiplier_error)
    return SynchronousOrbit(status=status, stable=stable, residual=residual, scene=scene, **numbers)


def _quantities(scene: PeriodicScene, grid: Grid, motion: WholeMotion) -> dict[str, Array]:
    """Return the fields of a motion that follow from the coordinates at the points."""
    x, omega = motion
    nd, theta, rate = scene.coordinates, jnp.asarray(grid.theta, x.dtype), x @ grid.first.T
    state = jax.vmap(scene.state, in_axes=(0, 1, 1, None))(theta, x, rate, omega)
    torque, power = jax.vmap(lambda t, s: drive_torques(scene.model, scene.field, t, s))(theta / omega, state)
    force = jax.vmap(scene.model.foundation_force)(state.displacement, state.velocity)
    harmonics = analyzed(jnp.concatenate([x[:nd] * scene.length, x[nd:], force.T]), deviation_analysis(grid))
    bodies = x.shape[0]
    displacement, deviation, forces = harmonics[:nd], harmonics[nd:bodies].at[:, 0].add(scene.phases), harmonics[bodies:]
    ranges = half_range(grid.deviation_orders, jnp.concatenate([displacement, forces]))
    return {
        "speed": omega,
        "phases": means_of_exciters(scene.model.scene, deviation[:, 0].real),
        "torque": jnp.mean(torque, axis=0),
        "power": jnp.mean(power, axis=0),
        "amplitude": ranges[:nd],
        "foundation_force": jnp.sqrt(jnp.sum(ranges[nd:] ** 2)),
        "deviation_harmonics": deviation,
        "displacement_harmonics": displacement,
        "force_harmonics": forces,
    }
