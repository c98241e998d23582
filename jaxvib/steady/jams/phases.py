"""Jams of light loads that turn together at unequal phases: torque balance on any carrier, every solution, stability."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import loaded_mass, turning, turning_loads
from jaxvib.errors import InputError
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import damped_newton, eliminate, magnitude
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import sentence, status_name
from jaxvib.steady.jams.patterns import PhasePattern, phase_pattern
from jaxvib.units import traced

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["AbstractPhaseJam", "PhaseJam", "PhaseStatus", "phase_jam", "phase_torques"]


class PhaseStatus(eqx.Enumeration):
    """What is known of a jam; the members are the sentences a user reads."""

    found = "the loads can jam in this way"
    with_rotor = "the loads turn with the rotor and leave it at rest: they balance, and are not jammed"
    not_converged = "no jam was found from this start"
    unbounded = "the loads turn at a resonance that nothing damps: the vibration has no bound"


class AbstractPhaseJam(Result):
    """Jams whose loads need not stand at one angle, phi_j = Omega t + phase_j, one or several.

    **Attributes**: `status` a `PhaseStatus`; `omega`, `rotor_speed` rad/s; `phase` (count,) rad, of the first load 0;
    `pattern` a `PhasePattern`; `growth` 1/s, of the fastest growing small disturbance, and `stable` where it is negative;
    `displacement` (nd,) complex amplitudes at Omega t, m, of tilts rad; `amplitude` (nd,) m, of tilts rad, and
    `foundation_force` N, zero to peak (of two directions the root of the summed squares of their peaks: sqrt 2 times the force
    of a circular whirl); `torque` (count,) N m, the mean torque of the vibration on each load; `residual` of the balance,
    relative to the drag's torque. NaN where there is no jam.
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
    """A jam whose loads need not stand at one angle, see `AbstractPhaseJam`."""

    @property
    def pattern_label(self) -> str:
        """The pattern's own word: "together", "opposite", "spread" or "other"."""
        return status_name(self.pattern)

    def summary(self) -> str:
        """A line a person can read; phases in degrees."""
        if not np.isfinite(self.omega):
            return self.message
        phases = ", ".join(f"{np.rad2deg(float(a)):.4g}" for a in self.phase)
        stable = f"{'stable' if bool(self.stable) else 'unstable'} ({float(self.growth):.3g} 1/s)"
        return f"Omega {float(self.omega):.6g} rad/s, {stable}, {sentence(self.pattern)}: {phases} deg"

    def plot(self) -> Figure:
        """Where the loads stand, on a circle. **Returns** a matplotlib figure."""
        from jaxvib.draw.results import phase_circles  # slow to import: only who draws pays

        return phase_circles([(f"{float(self.omega):.4g} rad/s", np.asarray(self.phase))])


class Parts(NamedTuple):
    """A scene as the balance needs it: matrices (nd, nd), what each load shakes (count, nd) complex, and the loads' numbers."""

    mass: Array
    damping: Array
    stiffness: Array
    shake: Array
    unbalance: Array
    drag: Array
    inertia: Array
    speed: Array


def parts_of(scene: Scene) -> Parts:
    """The scene's matrices and numbers at its own rotor speed, see `Parts`."""
    carrier, loads = scene.machine.carrier(), turning_loads(scene)

    def each(value: Array) -> Array:
        return jnp.broadcast_to(value, (loads.count,))

    stations = jnp.zeros(loads.count, carrier.port.dtype) if carrier.stations is None else carrier.stations
    rows = jax.vmap(carrier.port_at)(stations)
    speed = scene.drive.speed
    return Parts(
        mass=loaded_mass(scene),
        damping=carrier.damping if carrier.gyroscopic is None else carrier.damping + speed * carrier.gyroscopic,
        stiffness=carrier.stiffness,
        shake=jnp.einsum("jka,k->ja", rows, turning(carrier)),
        unbalance=each(loads.mass * loads.radius),
        drag=each(loads.drag * loads.radius**2),
        inertia=each(loads.inertia_factor() * loads.mass * loads.radius**2),
        speed=speed,
    )


def influence_of(parts: Parts, omega: Array) -> tuple[Array, Array]:
    """A_jk (count, count) complex and D^-1 P^T (nd, count): what load k does to load j, and to the carrier, per throw."""
    dynamic = parts.stiffness - omega**2 * parts.mass + 1j * omega * parts.damping
    answer = eliminate(dynamic, parts.shake.T.astype(dynamic.dtype))
    return parts.shake.conj() @ answer, answer


def torques_at(parts: Parts, influence: Array, omega: Array, phase: Array) -> Array:
    """The formula of `phase_torques`, (count,) N m, from what loads do to each other (count, count)."""
    turned = jnp.exp(1j * phase)
    coupled = jnp.conj(turned) * (influence @ (parts.unbalance * turned))
    return 0.5 * omega**4 * parts.unbalance * coupled.imag


def phase_torques(scene: Scene, omega: Array, phase: Array) -> Array:
    """Mean torque (count,) N m of the vibration on each load; they turn at `omega` (scalar, rad/s), at `phase` (count,).

        T_j = (w^4/2) S_j sum_k S_k Im[exp(i (a_k - a_j)) e^H L_j D(w)^-1 L_k^T e],     S = m R
        D(w) = K - w^2 (M + sum_j m_j L_j^T L_j) + i w (C + n G)

    L_j (np, nd) is how load j's point moves with the carrier's coordinates: its port, at its station; n the rotor's speed.

    **Returns** an array (count,). **Raises** `InputError` for loads that are not on a circle, drives without a given speed, and
    effects that this theory leaves out.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.14), jv.ConstantSpeed(460.0))
    >>> abs(float(phase_torques(scene, 170.0, jnp.array([0.0, jnp.pi]))[0])) < 1e-12    # opposite: nothing vibrates
    True

    Source: Artyunin 2013, the pendulums' equation of (1), averaged over a turn.
    """
    return _phase_torques(scene, jnp.asarray(omega, dtype=scene.drive.speed.dtype), jnp.asarray(phase))


@eqx.filter_jit
def _phase_torques(scene: Scene, omega: Array, phase: Array) -> Array:
    parts = parts_of(scene)
    return torques_at(parts, influence_of(parts, omega)[0], omega, phase)


def phase_jam(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    """The jam that Newton's method finds from a speed `omega` (scalar, rad/s) and phases (count,) rad of the loads.

        b_j R_j^2 (n - w) + T_j(w, a) = 0,     j = 1 .. count

    for w and all phases but the first, see `phase_torques`. Stability: growth of small disturbances of the averaged motion,
    q = Re(z(t) exp(i w t)) with the loads' angles free, an autonomous system of 4 nd + 2 count numbers; no quasi-static step is
    taken. On supports that are alike both ways nothing is averaged away.

    **Returns** `PhaseJam`; `vmap` over starts and scenes goes through it, derivatives of all but stability are those of the
    implicit function theorem. An imbalance of the rotor is left out of amplitudes and forces, see `phase_jams`.

    **Raises** `InputError` for loads without drag, phases of another number than the loads, drives without a given speed, and
    effects that this theory leaves out.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jam = phase_jam(scene, 165.0, jnp.array([0.0, 0.3]))
    >>> round(float(jam.omega), 2), [abs(round(float(a), 6)) for a in jam.phase], bool(jam.stable)
    (164.63, [0.0, 0.0], True)

    Source: Artyunin 2013, section V, for phases that are equal or opposite.
    """
    loads = loads_with_drag(scene)
    phase = jnp.asarray(phase)
    if phase.shape != (loads.count,):
        raise InputError("phase", f"has shape {phase.shape}; one phase for each load is needed, ({loads.count},)")
    return jam_from(scene, jnp.asarray(omega, dtype=phase.dtype), phase)


def loads_with_drag(scene: Scene) -> CircularLoads:
    """The scene's loads. **Raises** `InputError` where one has no drag."""
    loads = turning_loads(scene)
    if not traced(loads.drag) and not np.all(np.asarray(loads.drag) > 0.0):
        raise InputError("loads.drag", "is 0; loads without drag never follow the rotor, give a drag greater than 0")
    return loads


def balanced(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array]:
    """Speed and phases (count,) of the balance that Newton's method finds, differentiable in the parts."""

    def balance(x: Array, given: Parts) -> Array:
        w = x[0] * jax.lax.stop_gradient(given.speed)
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x[1:]])
        torque = torques_at(given, influence_of(given, w)[0], w, angles)
        return ((given.speed - w) + torque / given.drag) / given.speed

    frozen = jax.lax.stop_gradient(parts)
    start = jnp.concatenate([jnp.reshape(omega / parts.speed, (1,)), phase[1:] - phase[0]])
    x = damped_newton(lambda y: balance(y, frozen), jax.lax.stop_gradient(start))
    # One more step, whose derivative with respect to the scene is the implicit function theorem's.
    x = x - eliminate(jax.jacfwd(balance)(x, frozen), balance(x, parts))
    return x[0] * frozen.speed, jnp.concatenate([jnp.zeros(1, x.dtype), jnp.arctan2(jnp.sin(x[1:]), jnp.cos(x[1:]))])


@eqx.filter_jit
def jam_from(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    """`phase_jam` of arguments that are known to be right."""
    parts = parts_of(scene)
    frozen = jax.lax.stop_gradient(parts)
    w, angles = balanced(parts, omega, phase)
    influence, answer = influence_of(parts, w)
    torque = torques_at(parts, influence, w, angles)
    z = w**2 * answer @ (parts.unbalance * jnp.exp(1j * angles))
    carrier = scene.machine.carrier()
    force = (carrier.bed_stiffness + 1j * w * carrier.bed_damping) @ z
    residual = jnp.max(jnp.abs(parts.drag * (parts.speed - w) + torque)) / jnp.max(parts.drag * parts.speed)
    growth = growth_of(frozen, *jax.lax.stop_gradient((w, angles, z)))

    tiny = jnp.sqrt(jnp.finfo(w.dtype).eps)
    slip = (frozen.speed - w) / frozen.speed
    good = (residual < tiny) & (w > 0.0) & (slip > -tiny)
    at_rest = good & (slip < tiny)
    status = PhaseStatus.where(good, PhaseStatus.found, PhaseStatus.not_converged)
    status = PhaseStatus.where(at_rest, PhaseStatus.with_rotor, status)
    size = jnp.where(parts.unbalance > 0.0, parts.unbalance, 1.0) / jnp.min(jnp.diagonal(parts.mass))
    bounded = jnp.all(magnitude(z) * 100.0 * jnp.finfo(w.dtype).eps < jnp.max(size))
    status = PhaseStatus.where(bounded | ~good, status, PhaseStatus.unbounded)
    there = good & bounded

    def kept(value: Array) -> Array:
        return jnp.where(there, value, jnp.nan)

    return PhaseJam(
        status=status,
        omega=kept(w),
        rotor_speed=parts.speed,
        phase=kept(angles),
        pattern=phase_pattern(angles),
        growth=kept(growth),
        stable=there & (growth < 0.0),
        displacement=kept(z),
        amplitude=kept(magnitude(z)),
        foundation_force=kept(jnp.sqrt(jnp.sum(magnitude(force) ** 2)) if force.shape[0] > 1 else magnitude(force[0])),
        torque=kept(torque),
        residual=residual,
    )


def growth_of(parts: Parts, omega: Array, phase: Array, z: Array) -> Array:
    """Growth of the averaged motion's disturbances, 1/s: its largest eigenvalue but that of a common turn of all phases.

    M (z'' + 2 i w z' - w^2 z) + (C + n G) (z' + i w z) + K z = sum_k S_k P_k ((w + a_k')^2 - i a_k'') exp(i a_k)
    I_j a_j'' + b_j R_j^2 (w + a_j' - n) + (S_j/2) Im[exp(-i a_j) P_j^H (w^2 z - 2 i w z' - z'')] ... = 0
    """
    nd, loads = parts.mass.shape[0], phase.shape[0]

    def flow(state: Array) -> Array:
        re, im, re_rate, im_rate = (state[k * nd : (k + 1) * nd] for k in range(4))
        a, rate = state[4 * nd : 4 * nd + loads], state[4 * nd + loads :]
        y, y_rate = re + 1j * im, re_rate + 1j * im_rate
        shakes = (parts.unbalance * jnp.exp(1j * a))[:, None] * parts.shake  # (count, nd), S_k P_k exp(i a_k)
        rest = 2j * omega * y_rate - omega**2 * y
        right = shakes.T @ (omega + rate) ** 2 - parts.mass @ rest
        right = right - parts.damping @ (y_rate + 1j * omega * y) - parts.stiffness @ y
        coupling = 1j * shakes  # its real and imaginary parts tie a'' and z'' together, both ways alike
        zero = jnp.zeros_like(parts.mass)
        matrix = jnp.block(
            [
                [parts.mass, zero, coupling.real.T],
                [zero, parts.mass, coupling.imag.T],
                [0.5 * coupling.real, 0.5 * coupling.imag, jnp.diag(parts.inertia)],
            ]
        )
        torque = parts.drag * (parts.speed - omega - rate) - 0.5 * (coupling.conj() @ rest).real
        second = eliminate(matrix, jnp.concatenate([right.real, right.imag, torque]))
        return jnp.concatenate([re_rate, im_rate, second[: 2 * nd], rate, second[2 * nd :]])

    at = jnp.concatenate([z.real, z.imag, jnp.zeros(2 * nd, phase.dtype), phase, jnp.zeros(loads, phase.dtype)])
    matrix = jax.jacfwd(flow)(at)
    # Eigenvalues of a matrix that is not finite keep a library busy for ever.
    finite = jnp.all(jnp.isfinite(matrix))
    values = jnp.linalg.eigvals(jnp.where(finite, matrix, 0.0))
    common = jnp.argmin(jnp.abs(values))
    growth = jnp.max(jnp.where(jnp.arange(values.shape[0]) == common, -jnp.inf, values.real))
    return jnp.where(finite, growth, jnp.nan)
