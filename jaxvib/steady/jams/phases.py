"""Jams of light loads that rotate at one speed with unequal phases: torque balance for any carrier, solutions, stability."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.averaged import averaged_growth, decays
from jaxvib.equations.linear import JAM_TERMS, peak_force, require_drag, turning_loads
from jaxvib.equations.torque_balance import (
    TorqueBalance,
    assemble_torque_balance,
    balance_residuals,
    motion_of,
    response_of,
    torques_at,
    unknowns_of,
)
from jaxvib.errors import InputError
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import eliminate, magnitude
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import sentence, status_name
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import solve_torques
from jaxvib.steady.outcome import REFUSED, outcome
from jaxvib.units import number, numbers

_SAME_JAM_DISTANCE = 0.02
"""Largest relative difference of load speeds at which jams of two methods count as the same."""


class PhaseStatus(eqx.Enumeration):
    """Outcomes of the search for a jam of loads at different angles. The value of each member is the message shown to the
    user."""

    found = "the loads can jam at these phases"
    with_rotor = "the loads turn with the rotor and cause no vibration: they balance each other and are not jammed"
    not_converged = "the search from this initial guess found no jam"
    unbounded = "the loads turn at an undamped resonance: the vibration grows without bounds"
    refused = REFUSED


def degrees(angle: float) -> float:
    """Convert an angle from rad to degrees, rounded for display: a rounding error of 0 is shown as 0.

    >>> degrees(2.5e-19), degrees(3.141592653589793)
    (0.0, 180.0)
    """
    return round(math.degrees(angle), 9) + 0.0


class AbstractPhaseJam(Result):
    """One or several jams whose loads may be at different angles, phi_j = Omega t + phase_j.

    If there is no jam, values are NaN, except for `rotor_speed` and `residual`.

    **Attributes**

    - `status`: a `PhaseStatus`
    - `omega` and `rotor_speed`, rad/s
    - `phase` (count,), rad; 0 for the first load
    - `pattern`: a `PhasePattern`
    - `growth`: growth rate of the fastest growing small disturbance, 1/s, and `stable`: True if it is negative beyond rounding
    - `displacement` (nd,): complex amplitudes of q = Re(displacement exp(i Omega t)), m (rad for tilts)
    - `amplitude` (nd,), m (rad for tilts), zero to peak
    - `foundation_force`, N, zero to peak; for two directions the root of the sum of the squares of their peaks, which is sqrt
      2 times the force of a circular whirl
    - `torque` (count,), N m: the mean torque of the vibration on each load
    - `residual` of the torque balance, relative to the torque of the drag
    """

    status: PhaseStatus
    omega: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    phase: Array = eqx.field(metadata=in_unit("rad", "*", "load"))
    pattern: PhasePattern
    growth: Array = eqx.field(metadata=in_unit("1/s", "*"))
    stable: Array = eqx.field(metadata=in_unit("", "*"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "*"))
    torque: Array = eqx.field(metadata=in_unit("N m", "*", "load"))
    residual: Array = eqx.field(metadata=in_unit("", "*"))


class PhaseJam(AbstractPhaseJam):
    """Jam whose loads may be at different angles, see `AbstractPhaseJam`.

    Returned by `PhaseJams.select` and `phase_jams(scene, near=...)`.
    """

    @property
    def pattern_label(self) -> str:
        """Short name of the pattern: "together", "opposite", "spread" or "other"."""
        return status_name(self.pattern)

    def summary(self) -> str:
        """Return one line of text; phases in degrees."""
        if not np.isfinite(self.omega):
            return self.message
        phases = ", ".join(f"{degrees(float(a)):.4g}" for a in self.phase)
        stable = f"{'stable' if bool(self.stable) else 'unstable'} ({float(self.growth):.3g} 1/s)"
        return f"Omega {speed_text(self.omega, 6)}, {stable}, {sentence(self.pattern)}: {phases} deg"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the phases of the loads on a circle."""
        from jaxvib.draw.results import phase_circles  # slow import

        return phase_circles([(speed_text(self.omega, 4), np.asarray(self.phase))], ax=ax)


def phase_jam(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    """Return the jam that Newton's method finds from a speed `omega` (scalar, rad/s) and phases (count,) rad of the loads.

        b_j R_j^2 (n - w) + T_j(w, a) = 0,     j = 1 .. count

    is solved for w and all phases a except the first. b_j is the drag of load j, R_j its radius, n the rotor speed, and T_j the
    mean torque of the vibration on the load (`torques_at`). Stability is determined by the growth rate of small disturbances of
    the averaged equations (`averaged_growth`), in which the angle of each load is free. For isotropic supports the averaged
    equations are exact.

    **Raises** `InputError` as `phase_jams`, and for a number of phases that differs from the number of loads.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jam = phase_jam(scene, 165.0, jnp.array([0.0, 0.3]))
    >>> round(float(jam.omega), 2), [abs(round(float(a), 6)) for a in jam.phase], bool(jam.stable)
    (164.63, [0.0, 0.0], True)

    Source: Artyunin 2013, section V, for phases that are equal or opposite.
    """
    loads = loads_with_drag(scene)
    if np.shape(phase) != (loads.count,):
        raise InputError("phase", f"has shape {np.shape(phase)}; one phase for each load is needed, ({loads.count},)")
    speed, phases = number(omega, "rad/s", "omega", low=0.0, open_low=True), numbers(phase, "rad", "phase", loads.count)
    return outcome(jam_from(scene, speed, phases), scene)


def loads_with_drag(scene: Scene) -> CircularLoads:
    """Return the loads of a scene. **Raises** `InputError` if one has no drag."""
    loads = turning_loads(scene)
    require_drag(loads, each=True)
    return loads


def solve_balance(balance: TorqueBalance, omega: Array, phase: Array, *, on_scalars: bool = False) -> tuple[Array, Array]:
    """Solve the torque balance for the load speed and the phases (count,) by Newton's method, differentiable with respect to
    the balance; `on_scalars`: see `damped_newton`."""
    frozen = jax.lax.stop_gradient(balance)
    start = jax.lax.stop_gradient(unknowns_of(balance, omega, phase))
    on_scalars = on_scalars and balance.model.modal is None  # a sum over many modes has too many operations
    x = solve_torques(start, frozen, on_scalars=on_scalars)
    # One more Newton step: its derivative with respect to the scene is that of the implicit function theorem.
    x = x - eliminate(jax.jacfwd(balance_residuals)(x, frozen), balance_residuals(x, balance))
    w, angles = motion_of(balance, x)
    return w, jnp.concatenate([angles[:1], jnp.arctan2(jnp.sin(angles[1:]), jnp.cos(angles[1:]))])


@cached
def jam_from(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    """Return `phase_jam` for validated arguments."""
    balance = assemble_torque_balance(scene)
    frozen = jax.lax.stop_gradient(balance)
    w, angles = solve_balance(balance, omega, phase)
    turn, response = jnp.exp(1j * angles), response_of(balance, w)
    torque = torques_at(balance.unbalance, balance.direction.conj() @ response, w, turn)
    z = w**2 * response @ (balance.unbalance * turn)
    force = balance.model.vibration_force(z, w)
    residual = jnp.max(jnp.abs(balance.drag * (balance.speed - w) + torque)) / jnp.max(balance.drag * balance.speed)
    tiny = jnp.sqrt(jnp.finfo(w.dtype).eps)
    lag = (frozen.speed - w) / frozen.speed
    good = (residual < tiny) & (w > 0.0) & (lag > -tiny)
    is_with_rotor = good & (lag < tiny)
    status = PhaseStatus.where(good, PhaseStatus.found, PhaseStatus.not_converged)
    status = PhaseStatus.where(is_with_rotor, PhaseStatus.with_rotor, status)
    size = jnp.where(balance.unbalance > 0.0, balance.unbalance, 1.0) / jnp.min(jnp.diagonal(balance.model.mass))
    bounded = jnp.all(magnitude(z) * 100.0 * jnp.finfo(w.dtype).eps < jnp.max(size))
    status = PhaseStatus.where(bounded | ~good, status, PhaseStatus.unbounded)
    exists = good & bounded
    # Eigenvalues take as long as everything else; if there is no jam, the speed is NaN and they are skipped.
    growth = averaged_growth(frozen.averaged, *jax.lax.stop_gradient((jnp.where(exists, w, jnp.nan), angles, z)))

    def or_nan(value: Array) -> Array:
        return jnp.where(exists, value, jnp.nan)

    return PhaseJam(
        status=status,
        omega=or_nan(w),
        rotor_speed=balance.speed,
        phase=or_nan(angles),
        pattern=phase_pattern(angles),
        growth=or_nan(growth),
        stable=exists & decays(growth, w),
        displacement=or_nan(z),
        amplitude=or_nan(magnitude(z)),
        foundation_force=or_nan(peak_force(force)),
        torque=or_nan(torque),
        residual=residual,
    )


def growth_of_free_loads(scene: Scene, omega: Array, rotor_speed: Array | None = None) -> np.ndarray:
    """Return the `growth` (n,), 1/s, of jams of coincident loads with load speeds `omega` and the given rotor speeds (default:
    that of the scene), rad/s, with each load free to move separately.

    Loads count as points, also those with a `ball_radius`. The growth is NaN if there is no such jam nearby, if `omega` is NaN,
    or for loads with dry friction, which is not included.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> [round(float(x), 1) for x in growth_of_free_loads(scene, jv.jam_modes(scene).omega[jnp.array([0, 1, 4])])]
    [-0.4, 19.4, 23.3]
    """
    turning_loads(scene, JAM_TERMS)  # raises an error for effects that jams do not include
    speeds = np.asarray(omega)
    is_finite = np.isfinite(speeds)
    if has_term(scene.all_effects, ContactFriction):
        return np.full(speeds.shape, np.nan)
    working = float(scene.drive.speed)
    starts = np.where(is_finite, speeds, working)
    rotor = np.full(speeds.shape, working) if rotor_speed is None else np.where(is_finite, np.asarray(rotor_speed), working)
    found = _coincident_jams(scene, jnp.asarray(starts), jnp.asarray(rotor))
    near = (
        is_finite
        & (np.abs(found.omega - starts) < _SAME_JAM_DISTANCE * starts)
        & np.asarray(found.pattern == PhasePattern.together)
    )
    return np.where(near, found.growth, np.nan)


@cached
def _coincident_jams(scene: Scene, omega: Array, rotor_speed: Array) -> PhaseJam:
    together = jnp.zeros(scene.loads.count, omega.dtype)
    return jax.vmap(lambda w, n: jam_from(scene.replace(drive=ConstantSpeed(n)), w, together))(omega, rotor_speed)


class PhasePattern(eqx.Enumeration):
    """Relative phases of loads that turn at one speed. The value of each member is the message shown to the user."""

    together = "all together"
    opposite = "in two opposite groups"
    spread = "spread around the circle, cancelling each other"
    other = "at other phases"


def phase_pattern(phase: Array) -> PhasePattern:
    """Return the pattern of phases (count,) rad, from their resultants mean exp(i k phase) for k = 1 and 2.

    Loads are together if each is within 30 degrees of their mean direction, and in two opposite groups if each is within 15
    degrees of their common axis and the groups almost cancel.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> bool(phase_pattern(jnp.array([0.0, 0.1, 3.1, 3.2])) == jv.PhasePattern.opposite)
    True
    """
    turns = [jnp.exp(1j * k * phase) for k in (1, 2)]
    means = [jnp.mean(turn) for turn in turns]
    pairs = zip(turns, means, strict=True)
    close, parallel = (jnp.min((turn * mean.conj()).real) > _MIN_COSINE * jnp.abs(mean) for turn, mean in pairs)
    first = jnp.abs(means[0])
    pattern = PhasePattern.where(first < 0.1, PhasePattern.spread, PhasePattern.other)
    pattern = PhasePattern.where((first < 0.25) & parallel, PhasePattern.opposite, pattern)
    return PhasePattern.where((first > 0.5) & close, PhasePattern.together, pattern)


_MIN_COSINE = math.cos(math.radians(30.0))
"""Cosine of the largest angle between a load and the mean direction of loads that are together."""
