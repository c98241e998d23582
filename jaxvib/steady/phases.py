"""Jams of light loads that turn together at unequal phases: torque balance on any carrier, every solution, stability."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import count, traced
from jaxvib.motion.regime import PhasePattern, phase_pattern
from jaxvib.steady.response import loaded_mass, magnitude, turning, turning_loads

__all__ = ["PhaseJam", "PhaseJams", "PhaseStatus", "phase_jam", "phase_jams", "phase_torques"]

_ITERATIONS = 60
_GRID = 160
"""Load speeds at which phases are looked for, before the speed is solved for too."""


class PhaseStatus(eqx.Enumeration):
    """What is known of a jam; the members are the sentences a user reads."""

    found = "the loads can jam in this way"
    with_rotor = "the loads turn with the rotor and leave it at rest: they balance, and are not jammed"
    not_converged = "no jam was found from this start"
    unbounded = "the loads turn at a resonance that nothing damps: the vibration has no bound"


class PhaseJam(eqx.Module):
    """A jam whose loads need not stand at one angle: phi_j = Omega t + phase_j.

    **Attributes**: `status` a `PhaseStatus`; `omega`, `rotor_speed` rad/s; `phase` (count,) rad, of the first load 0;
    `pattern` a `PhasePattern`; `growth` 1/s, of the fastest growing small disturbance, and `stable` where it is negative;
    `displacement` (nd,) complex amplitudes at Omega t; `amplitude` (nd,) and `foundation_force` N, zero to peak; `torque`
    (count,) N m, the mean torque of the vibration on each load; `residual` of the balance, relative to the drag's torque.
    NaN where there is no jam.
    """

    status: PhaseStatus
    omega: Array
    rotor_speed: Array
    phase: Array
    pattern: PhasePattern
    growth: Array
    stable: Array
    displacement: Array
    amplitude: Array
    foundation_force: Array
    torque: Array
    residual: Array


class PhaseJams(PhaseJam):
    """Every jam that was found: the arrays of `PhaseJam` with a leading axis, by falling speed of the loads, stable ones first
    where speeds are equal; `starts` (n,): how many of the starts led to each."""

    starts: Array

    def select(self, index: int) -> PhaseJam:
        """The jam of that place, counted from 0. **Raises** `InputError` where there are not so many."""
        n = self.omega.shape[0]
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < n:
            raise InputError("index", f"is {index!r}; there are {n} jams, counted from 0")
        fields = {name: getattr(self, name) for name in PhaseJam.__dataclass_fields__}
        return PhaseJam(**jax.tree.map(lambda leaf: leaf[index], fields))

    def summary(self) -> str:
        """A table a person can read; amplitudes zero to peak, phases in degrees."""
        lines = []
        for k in range(self.omega.shape[0]):
            jam = self.select(k)
            phases = ", ".join(f"{np.rad2deg(float(a)):.4g}" for a in jam.phase)
            name = PhasePattern[jam.pattern]  # pyright: ignore[reportInvalidTypeArguments]
            stable = "stable" if bool(jam.stable) else "unstable"
            lines.append(f"Omega {float(jam.omega):.6g} rad/s, {stable} ({float(jam.growth):.3g} 1/s), {name}: {phases} deg")
        return "\n".join(lines) or "no jam"


class _Parts(NamedTuple):
    """A scene as the balance needs it: matrices (nd, nd), what each load shakes (count, nd) complex, and the loads' numbers."""

    mass: Array
    damping: Array
    stiffness: Array
    shake: Array
    throw: Array
    drag: Array
    inertia: Array
    speed: Array


def _parts(scene: Scene) -> _Parts:
    carrier, loads = scene.machine.carrier(), turning_loads(scene)

    def each(value: Array) -> Array:
        return jnp.broadcast_to(value, (loads.count,))

    stations = jnp.zeros(loads.count, carrier.port.dtype) if carrier.stations is None else carrier.stations
    rows = jax.vmap(carrier.port_at)(stations)
    speed = scene.drive.speed
    return _Parts(
        mass=loaded_mass(scene),
        damping=carrier.damping if carrier.gyroscopic is None else carrier.damping + speed * carrier.gyroscopic,
        stiffness=carrier.stiffness,
        shake=jnp.einsum("jka,k->ja", rows, turning(carrier)),
        throw=each(loads.mass * loads.radius),
        drag=each(loads.drag * loads.radius**2),
        inertia=each(loads.inertia_factor() * loads.mass * loads.radius**2),
        speed=speed,
    )


def _influence(parts: _Parts, omega: Array) -> tuple[Array, Array]:
    """A_jk (count, count) complex and D^-1 P^T (nd, count): what load k does to load j, and to the carrier, per throw."""
    dynamic = parts.stiffness - omega**2 * parts.mass + 1j * omega * parts.damping
    answer = _solve(dynamic, parts.shake.T.astype(dynamic.dtype))
    return parts.shake.conj() @ answer, answer


def _torques(parts: _Parts, influence: Array, omega: Array, phase: Array) -> Array:
    turned = jnp.exp(1j * phase)
    coupled = jnp.conj(turned) * (influence @ (parts.throw * turned))
    return 0.5 * omega**4 * parts.throw * coupled.imag


def phase_torques(scene: Scene, omega: Array, phase: Array) -> Array:
    """Mean torque (count,) N m of the vibration on each load; they turn at `omega` (scalar, rad/s), at `phase` (count,).

        T_j = (w^4/2) S_j sum_k S_k Im[exp(i (a_k - a_j)) e^H L_j D(w)^-1 L_k^T e],     S = m R
        D(w) = K - w^2 (M + sum_j m_j L_j^T L_j) + i w (C + n G)

    L_j (np, nd) is how load j's point moves with the carrier's coordinates: its port, at its station; n the rotor's speed.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.14), jv.ConstantSpeed(460.0))
    >>> abs(float(jv.phase_torques(scene, 170.0, jnp.array([0.0, jnp.pi]))[0])) < 1e-12    # opposite: nothing vibrates
    True

    Source: Artyunin 2013, the pendulums' equation of (1), averaged over a turn.
    """
    parts = _parts(scene)
    omega = jnp.asarray(omega, dtype=parts.speed.dtype)
    return _torques(parts, _influence(parts, omega)[0], omega, jnp.asarray(phase))


def phase_jam(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    """The jam that Newton's method finds from a speed `omega` (scalar, rad/s) and phases (count,) rad of the loads.

        b_j R_j^2 (n - w) + T_j(w, a) = 0,     j = 1 .. count

    for w and all phases but the first, see `phase_torques`. Stability: growth of small disturbances of the averaged motion,
    q = Re(z(t) exp(i w t)) with the loads' angles free, an autonomous system of 4 nd + 2 count numbers; no quasi-static step is
    taken. On supports that are alike both ways nothing is averaged away.

    **Returns** `PhaseJam`; `vmap` over starts and scenes goes through it, derivatives of all but stability are those of the
    implicit function theorem. **Raises** `InputError` for loads without drag.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jam = jv.phase_jam(scene, 165.0, jnp.array([0.0, 0.3]))
    >>> round(float(jam.omega), 2), [abs(round(float(a), 6)) for a in jam.phase], bool(jam.stable)
    (164.63, [0.0, 0.0], True)

    Source: Artyunin 2013, section V, for phases that are equal or opposite.
    """
    loads = _with_drag(scene)
    phase = jnp.asarray(phase)
    if phase.shape != (loads.count,):
        raise InputError("phase", f"has shape {phase.shape}; one phase for each load is needed, ({loads.count},)")
    return _phase_jam(scene, jnp.asarray(omega, dtype=phase.dtype), phase)


def _with_drag(scene: Scene) -> CircularLoads:
    loads = turning_loads(scene)
    if not traced(loads.drag) and not np.all(np.asarray(loads.drag) > 0.0):
        raise InputError("loads.drag", "is 0; loads without drag never follow the rotor, give a drag greater than 0")
    return loads


def _solution(parts: _Parts, omega: Array, phase: Array) -> tuple[Array, Array]:
    """Speed and phases (count,) of the balance that Newton's method finds, differentiable in the parts."""

    def balance(x: Array, given: _Parts) -> Array:
        w = x[0] * jax.lax.stop_gradient(given.speed)
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x[1:]])
        torque = _torques(given, _influence(given, w)[0], w, angles)
        return ((given.speed - w) + torque / given.drag) / given.speed

    frozen = jax.lax.stop_gradient(parts)
    start = jnp.concatenate([jnp.reshape(omega / parts.speed, (1,)), phase[1:] - phase[0]])
    x = _newton(lambda y: balance(y, frozen), jax.lax.stop_gradient(start))
    # One more step, whose derivative with respect to the scene is the implicit function theorem's.
    x = x - _solve(jax.jacfwd(balance)(x, frozen), balance(x, parts))
    return x[0] * frozen.speed, jnp.concatenate([jnp.zeros(1, x.dtype), jnp.arctan2(jnp.sin(x[1:]), jnp.cos(x[1:]))])


@eqx.filter_jit
def _phase_jam(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    parts = _parts(scene)
    frozen = jax.lax.stop_gradient(parts)
    w, angles = _solution(parts, omega, phase)
    influence, answer = _influence(parts, w)
    torque = _torques(parts, influence, w, angles)
    z = w**2 * answer @ (parts.throw * jnp.exp(1j * angles))
    carrier = scene.machine.carrier()
    force = (carrier.bed_stiffness + 1j * w * carrier.bed_damping) @ z
    residual = jnp.max(jnp.abs(parts.drag * (parts.speed - w) + torque)) / jnp.max(parts.drag * parts.speed)
    growth = _growth(frozen, *jax.lax.stop_gradient((w, angles, z)))

    tiny = jnp.sqrt(jnp.finfo(w.dtype).eps)
    slip = (frozen.speed - w) / frozen.speed
    good = (residual < tiny) & (w > 0.0) & (slip > -tiny)
    balanced = good & (slip < tiny)
    status = PhaseStatus.where(good, PhaseStatus.found, PhaseStatus.not_converged)
    status = PhaseStatus.where(balanced, PhaseStatus.with_rotor, status)
    size = jnp.where(parts.throw > 0.0, parts.throw, 1.0) / jnp.min(jnp.diagonal(parts.mass))
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


def _newton(balance: Callable[[Array], Array], start: Array) -> Array:
    """A zero of `balance`, by steps that are damped where they do not help (Levenberg, Marquardt), from `start`."""

    def step(_: int, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        x, value, slopes, damping = carry
        normal = slopes.T @ slopes
        damped = normal + damping * jnp.diag(jnp.diagonal(normal) + jnp.finfo(x.dtype).tiny)
        change = _solve(damped, slopes.T @ value)
        trial = x - jnp.clip(change, -0.5, 0.5)
        new = balance(trial)
        better = jnp.sum(new**2) < jnp.sum(value**2)  # and not NaN
        slopes = jnp.where(better, jax.jacfwd(balance)(trial), slopes)
        damping = jnp.clip(jnp.where(better, 0.1 * damping, 8.0 * damping), 1e-14, 1e8)
        return jnp.where(better, trial, x), jnp.where(better, new, value), slopes, damping

    first = (start, balance(start), jax.jacfwd(balance)(start), jnp.asarray(1e-2, start.dtype))
    return jax.lax.fori_loop(0, _ITERATIONS, step, first)[0]


def _solve(a: Array, b: Array) -> Array:
    """x (n,) or (n, m) of a x = b, by elimination with pivots, written out.

    Library calls for large batches in one program can wait for each other for ever (jaxlib 0.10, two cores).
    """
    n = a.shape[0]
    rows = jnp.concatenate([a, b.reshape(n, -1).astype(a.dtype)], axis=1)
    for k in range(n):
        pivot = k + jnp.argmax(jnp.abs(rows[k:, k]))
        order = jnp.arange(n)
        order = jnp.where(order == k, pivot, jnp.where(order == pivot, k, order))
        rows = rows[order]
        line = rows[k] / rows[k, k]
        rows = jnp.where((jnp.arange(n) == k)[:, None], line[None, :], rows - rows[:, k : k + 1] * line[None, :])
    return rows[:, n:].reshape(b.shape)


def _growth(parts: _Parts, omega: Array, phase: Array, z: Array) -> Array:
    """Growth of the averaged motion's disturbances, 1/s: its largest eigenvalue but that of a common turn of all phases.

    M (z'' + 2 i w z' - w^2 z) + (C + n G) (z' + i w z) + K z = sum_k S_k P_k ((w + a_k')^2 - i a_k'') exp(i a_k)
    I_j a_j'' + b_j R_j^2 (w + a_j' - n) + (S_j/2) Im[exp(-i a_j) P_j^H (w^2 z - 2 i w z' - z'')] ... = 0
    """
    nd, loads = parts.mass.shape[0], phase.shape[0]

    def flow(state: Array) -> Array:
        re, im, re_rate, im_rate = (state[k * nd : (k + 1) * nd] for k in range(4))
        a, rate = state[4 * nd : 4 * nd + loads], state[4 * nd + loads :]
        y, y_rate = re + 1j * im, re_rate + 1j * im_rate
        shakes = (parts.throw * jnp.exp(1j * a))[:, None] * parts.shake  # (count, nd), S_k P_k exp(i a_k)
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
        second = _solve(matrix, jnp.concatenate([right.real, right.imag, torque]))
        return jnp.concatenate([re_rate, im_rate, second[: 2 * nd], rate, second[2 * nd :]])

    at = jnp.concatenate([z.real, z.imag, jnp.zeros(2 * nd, phase.dtype), phase, jnp.zeros(loads, phase.dtype)])
    matrix = jax.jacfwd(flow)(at)
    # Eigenvalues of a matrix that is not finite keep a library busy for ever.
    finite = jnp.all(jnp.isfinite(matrix))
    values = jnp.linalg.eigvals(jnp.where(finite, matrix, 0.0))
    common = jnp.argmin(jnp.abs(values))
    growth = jnp.max(jnp.where(jnp.arange(values.shape[0]) == common, -jnp.inf, values.real))
    return jnp.where(finite, growth, jnp.nan)


def phase_jams(scene: Scene, *, starts: int = 48, seed: int = 0) -> PhaseJams:
    """Every way in which the scene's light loads can jam at its rotor speed, whatever their phases.

    At each of many load speeds, closer together near resonances, phases are looked for at which all loads need the same
    multiple of their drag, from `starts` random sets of phases and some regular ones; where that multiple is near 1, the
    speed is solved for as well (`phase_jam`). What differs by a common turn, or by which of several equal loads stands
    where, is one jam. Loads that turn with the rotor and balance it are left out.

    **Arguments**: `starts`: random sets of phases at each load speed; `seed` which.

    **Returns** `PhaseJams`. **Raises** `InputError` for loads without drag, drives without a given speed, and effects that
    this theory leaves out.

    >>> import jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jams = jv.phase_jams(scene)
    >>> [round(float(w), 1) for w in jams.omega], [bool(s) for s in jams.stable]
    ([412.8, 199.4, 164.6], [False, False, True])

    Source: Artyunin 2013, section V; leading order of the loads' mass, see `jam_modes` for loads at one angle.
    """
    loads = _with_drag(scene)
    number = count(starts, "starts")
    parts = _parts(scene)
    speeds = _load_speeds(parts)
    rng = np.random.default_rng(count(seed, "seed", low=0))
    sets = [rng.uniform(-np.pi, np.pi, (number, loads.count)), _regular(parts)]
    phases = np.concatenate(sets)
    factor, angles, good = _phases_at(parts, jnp.asarray(speeds), jnp.asarray(phases))
    chosen = _near(np.asarray(factor), np.asarray(good))
    rows, columns = np.unravel_index(chosen, good.shape)
    omega, phase = (np.asarray(x) for x in _many(parts, jnp.asarray(speeds[rows]), angles[rows, columns]))
    groups = _equal_loads(parts)
    unique: list[tuple[float, np.ndarray]] = []
    reached: list[int] = []
    for k in np.argsort(-omega, kind="stable"):
        if not (np.isfinite(omega[k]) and 0.0 < omega[k] < float(parts.speed)):
            continue
        places = (i for i, (w, a) in enumerate(unique) if abs(w - omega[k]) < 1e-6 * w and _same(a, phase[k], groups))
        place = next(places, None)
        if place is None:
            unique.append((float(omega[k]), phase[k]))
            reached.append(1)
        else:
            reached[place] += 1
    jams = [_phase_jam(scene, jnp.asarray(w), jnp.asarray(a)) for w, a in unique]
    keep = [k for k, jam in enumerate(jams) if bool(jam.status == PhaseStatus.found)]
    if not keep:
        # Nothing was found: the arrays are empty.
        jams, keep, reached = [_phase_jam(scene, parts.speed, jnp.asarray(phases[0]))], [], []
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves)[np.asarray(keep, dtype=int)], *jams)
    fields = {name: getattr(stacked, name) for name in PhaseJam.__dataclass_fields__}
    return PhaseJams(**fields, starts=jnp.asarray([reached[k] for k in keep], dtype=int))


def _near(factor: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Which places (flat) of a table of drag multiples (no, ns) to start from: those near 1, four of a kind at most.

    A power of 2 of them, so that few scenes compile anew; they start over where there are fewer.
    """
    near = good & (np.abs(np.log(np.where(good, factor, 1.0))) < np.log(3.0))
    places = np.flatnonzero(near)
    kinds = np.stack([places // good.shape[1], np.round(1e4 * np.log(factor.ravel()[places])).astype(int)], axis=1)
    _, which = np.unique(kinds, axis=0, return_inverse=True)
    seen: dict[int, int] = {}
    kept = []
    for place, kind in zip(places, which.ravel(), strict=True):
        seen[int(kind)] = seen.get(int(kind), 0) + 1
        if seen[int(kind)] <= 4:
            kept.append(place)
    kept = kept or [0]
    return np.resize(np.asarray(kept), 2 ** int(np.ceil(np.log2(max(len(kept), 256)))))


_many = eqx.filter_jit(eqx.filter_vmap(_solution, in_axes=(None, 0, 0)))


@eqx.filter_jit
def _phases_at(parts: _Parts, omega: Array, phase: Array) -> tuple[Array, Array, Array]:
    """Phases (no, ns, count) at given load speeds (no,), from starts (ns, count), the multiple of the drag (no, ns) that goes
    with them, and whether they were found."""

    def at(w: Array, start: Array, influence: Array) -> tuple[Array, Array, Array]:
        def needs(x: Array) -> Array:
            angles = jnp.concatenate([jnp.zeros(1, x.dtype), x])
            return -_torques(parts, influence, w, angles) / (parts.drag * (parts.speed - w))

        scale = jnp.sum(jnp.abs(influence) * parts.throw[:, None] * parts.throw[None, :]) * w**4 / jnp.min(parts.drag)
        scale = scale / (parts.speed - w)

        def differ(x: Array) -> Array:
            each = needs(x) / scale
            return each[1:] - each[:-1]

        x = _newton(differ, start[1:] - start[0]) if start.shape[0] > 1 else start[1:]
        each = needs(x)
        good = (jnp.max(jnp.abs(each - each[0])) < 1e-8 * scale) & (each[0] > 0.0)
        return each[0], jnp.concatenate([jnp.zeros(1, x.dtype), x]), good

    influences = jax.vmap(lambda w: _influence(parts, w)[0])(omega)
    return jax.vmap(lambda w, a: jax.vmap(lambda s: at(w, s, a))(phase))(omega, influences)


def _load_speeds(parts: _Parts) -> np.ndarray:
    """Load speeds below the rotor's, closer together near the carrier's resonances at this rotor speed."""
    nd = parts.mass.shape[0]
    flow = np.linalg.solve(parts.mass, np.concatenate([-parts.stiffness, -parts.damping], axis=1))
    poles = np.linalg.eigvals(np.concatenate([np.eye(nd, 2 * nd, nd), flow]))
    speed = float(parts.speed)
    centres = np.unique(np.abs(poles[np.abs(poles.imag) > 0.0].imag))
    apart = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 24)])
    crowd = [w * (1.0 + side * apart) for w in centres for side in (-1.0, 1.0)]
    top = speed * (1.0 - np.geomspace(1e-6, 0.1, 12))
    speeds = np.unique(np.concatenate([np.linspace(0.02, 0.98, _GRID) * speed, top, *crowd]))
    return speeds[(speeds > 1e-3 * speed) & (speeds < speed)]


def _regular(parts: _Parts) -> np.ndarray:
    """Regular sets of phases (ns, count): together, and every split into two opposite groups."""
    n = parts.throw.shape[0]
    splits = range(2 ** min(n - 1, 5))
    return np.array([[np.pi * ((k >> j) & 1) if j < min(n - 1, 5) else 0.0 for j in range(n)] for k in splits])


def _equal_loads(parts: _Parts) -> list[np.ndarray]:
    """Groups of loads that are alike in every number, by their places."""
    rows = np.concatenate([parts.shake.real, parts.shake.imag, np.stack([parts.throw, parts.drag, parts.inertia], 1)], axis=1)
    _, which = np.unique(rows, axis=0, return_inverse=True)
    return [np.flatnonzero(which.ravel() == g) for g in range(int(np.max(which)) + 1)]


def _same(first: np.ndarray, second: np.ndarray, groups: list[np.ndarray]) -> bool:
    """Whether two sets of phases differ by a common turn, and by an exchange of equal loads, only."""

    def points(phase: np.ndarray, group: np.ndarray) -> np.ndarray:
        return np.exp(1j * phase[group])

    lead = points(first, groups[0])[0]
    for start in points(second, groups[0]):
        turned = [points(second, g) * lead / start for g in groups]
        if all(_match(points(first, g), other) for g, other in zip(groups, turned, strict=True)):
            return True
    return False


def _match(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two sets of points are the same in some order."""
    left = list(second)
    for point in first:
        near = int(np.argmin([abs(point - other) for other in left]))
        if abs(point - left.pop(near)) > 1e-5:
            return False
    return True
