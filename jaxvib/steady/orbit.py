"""Exact jams: the periodic motions of the full equations in which collected loads are stuck."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import Number, number, traced
from jaxvib.steady.collocation import (
    Grid,
    Harmonics,
    Motion,
    along,
    bodies,
    circle,
    grid_of,
    harmonics_of,
    has_half_turn,
    load_torque,
    per_load,
    periodic_motion,
)
from jaxvib.steady.jam import jam_modes, jam_rotor_speed
from jaxvib.steady.response import circular_loads
from jaxvib.steady.stability import Floquet, floquet, steps_for

__all__ = ["Orbit", "OrbitStatus", "jam_orbit", "orbits"]

_POINTS = (16, 32, 64, 128)
"""Points on half a period, tried in turn until the asked accuracy holds."""


class OrbitStatus(eqx.Enumeration):
    """What is known of an exact jam; the members are the sentences a user reads."""

    found = "the loads can jam in this periodic motion"
    absent = "this mode does not exist at this rotor speed"
    not_converged = "no periodic motion was found: the torque balance could not be met"
    coarse = "the periodic motion needs more harmonics than were used for the asked accuracy"
    held = "the loads would have to pull at each other: this is their motion side by side, which nothing holds together"
    at_fold = "the rotor speed is that of a fold: the motion merges with its neighbour and has no gradient"


class Orbit(eqx.Module):
    """An exact jam: phi = theta + psi(theta), theta = Omega t, psi periodic with mean 0; everything else follows it.

    Numbers are NaN where the status is `absent` or `not_converged`. Signals are Re sum_k c_k exp(i k theta).

    **Attributes**

    - `status` an `OrbitStatus`; `residual` of the torque balance, relative; `error` estimate of the relative error of the
      speeds (and, rad, of psi) that the number of harmonics leaves
    - `omega`, `rotor_speed` rad/s; `slope` dn/dOmega along the branch
    - `amplitude` (nd,) m and `foundation_force` N: zero to peak, (max - min)/2 over the period
    - `power` W: mean power that the loads take from the rotor
    - `stable`: every load keeps to this motion, that is `multiplier` < 1; `multiplier`: largest modulus of the non-trivial
      Floquet multipliers; `multipliers` complex: all of them, those of loads that part from each other last; `trivial`:
      the multiplier that is 1, as computed
    - `lag_harmonics` (G, J) rad, `displacement_harmonics` (nd, K) m, `force_harmonics` (nb, K) N: the c_k; loads that share
      every number have one lag (G = 1), else each has its own (G = count)
    - `lag_orders`, `orders`: the k they belong to; `offsets` (count,) rad: how far each load is ahead of phi
    """

    status: OrbitStatus
    omega: Array
    rotor_speed: Array
    slope: Array
    stable: Array
    multiplier: Array
    multipliers: Array
    trivial: Array
    amplitude: Array
    foundation_force: Array
    power: Array
    residual: Array
    error: Array
    lag_harmonics: Array
    displacement_harmonics: Array
    force_harmonics: Array
    offsets: Array
    lag_orders: tuple[int, ...] = eqx.field(static=True)
    orders: tuple[int, ...] = eqx.field(static=True)

    @property
    def message(self) -> str:
        """What is known of this motion, a sentence."""
        return OrbitStatus[self.status]  # pyright: ignore[reportInvalidTypeArguments]

    @property
    def harmonics(self) -> int:
        """The highest harmonic of the carrier's motion that was used."""
        return self.orders[-1]

    def at(self, theta: Array) -> tuple[Array, Array, tuple[Array], tuple[Array]]:
        """The motion at the angle `theta` = Omega t (scalar, rad): q (nd,) m, q' m/s, (phi,) (count,) rad, (phi',) rad/s.

        These are what a state of `vector_field` is made of: `jv.State(*orbit.at(0.0))` is a point of the motion.
        """
        k, j = np.asarray(self.orders), np.asarray(self.lag_orders)
        wave, lag_wave = jnp.exp(1j * k * theta), jnp.exp(1j * j * theta)
        phi = theta + (self.lag_harmonics @ lag_wave).real
        rate = self.omega * (1.0 + (self.lag_harmonics @ (1j * j * lag_wave)).real)
        return (
            (self.displacement_harmonics @ wave).real,
            self.omega * (self.displacement_harmonics @ (1j * k * wave)).real,
            (self.offsets + phi,),
            (jnp.broadcast_to(rate, self.offsets.shape),),
        )

    def summary(self) -> str:
        """A few lines a person can read; amplitudes zero to peak."""
        amplitude = ", ".join(f"{float(a):.6g}" for a in self.amplitude)
        return (
            f"loads {float(self.omega):.9g} rad/s, rotor {float(self.rotor_speed):.9g} rad/s, "
            f"{'stable' if self.stable else 'unstable'} (largest multiplier {float(self.multiplier):.6g})\n"
            f"amplitude {amplitude} m, foundation force {float(self.foundation_force):.6g} N, "
            f"power {float(self.power):.6g} W\n"
            f"{self.harmonics} harmonics leave an error of {float(self.error):.1e}, residual {float(self.residual):.1e}"
        )


def jam_orbit(
    scene: Scene,
    *,
    mode: int | None = None,
    omega: Number | None = None,
    near: Number | None = None,
    accuracy: float = 1e-9,
    points: int | None = None,
    throw: bool = True,
) -> Orbit:
    """The exact motion in which collected loads jam: no assumption that they are light.

        I Omega^2 psi'' = torque(phi, Omega (1 + psi'), n) - S e'(phi) . a,      a = B q''
        D(k Omega) q_k = S k^2 Omega^2 B^T e_k,      D(w) = K - w^2 (M + sum m_j B^T B) + i w C

    with phi = theta + psi(theta), S = sum m R, I = sum kappa m R^2, e_k the harmonics of e = (cos phi, sin phi). Solved by
    trigonometric collocation of psi, the carrier eliminated harmonic by harmonic, Newton from the leading order. Loads
    that share every number are collected at one point, or side by side where they have an `own_radius` (S is then
    m R sin(N arcsin(r/R)) / (r/R); where they would have to pull at each other the status is `held`). Loads that differ each
    have their own psi_j, and take the places next to each other that their torques ask for.

    **Arguments**, one of the first three

    - `mode`: the number of a jam mode, see `jam_modes`: the motion at the scene's rotor speed that continues it
    - `omega`: a load speed, rad/s or text: the motion with that speed; its rotor speed is a result, the scene's is not used
    - `near`: a load speed to start from: a motion at the scene's rotor speed
    - `accuracy`: harmonics are added until the estimated relative error is below it
    - `points`: a fixed number of collocation points (on half a period without effects, else on a period) in place of that.
      Under `jit` and `vmap` shapes cannot follow numbers: there it is 16 (33) unless said otherwise, the status tells
    - `throw`: raise where there is no such motion; else, and under a JAX transformation, the status says so

    **Returns** `Orbit`; derivatives of its numbers with respect to every number of the scene by the implicit function
    theorem, forward and reverse.

    **Raises** `InputError` for wrong arguments, loads without drag or a machine that is not of platforms;
    `ComputationError` with the status "absent" or "not_converged".

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
    scene = jax.tree.map(jnp.asarray, scene)
    frozen = jax.lax.stop_gradient(scene)
    concrete = not any(traced(leaf) for leaf in jax.tree.leaves((frozen, omega, near)))
    floor = 1e3 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    if not accuracy >= floor:
        raise InputError("accuracy", f"is {accuracy}; {scene.drive.speed.dtype} numbers allow {floor:.0e} and above")
    drag = circular_loads(frozen).drag_sum()
    if not traced(drag) and not float(drag) > 0.0:
        raise InputError("loads.drag", "is 0; loads without drag never follow the rotor, give a drag greater than 0")

    exists, direction, start = jnp.asarray(True), None, frozen.drive.speed
    if mode is not None:
        direction = jnp.asarray(1.0 if mode % 2 == 1 else -1.0)
        jam = jam_modes(frozen).select(mode, throw=throw)
        exists = jnp.isfinite(jam.omega)
        start = jnp.where(exists, jam.omega, frozen.drive.speed)
    elif near is not None:
        start = number(near, "rad/s", "near", low=0.0, open_low=True)
    which: Literal["omega", "rotor_speed"] = "rotor_speed"
    value = scene.drive.speed
    if omega is not None:
        value = number(omega, "rad/s", "omega", low=0.0, open_low=True)
        which, start = "omega", light_rotor_speed(frozen, jax.lax.stop_gradient(value))

    half = has_half_turn(scene)
    if points is None and not concrete:
        points = 16 if half else 33
    tried = [points] if points is not None else [p if half else 2 * p + 1 for p in _POINTS]
    still = jax.lax.stop_gradient(value)
    # Reverse-mode derivatives ask for a number of steps that is part of the program.
    steps = steps_for(frozen, *((still, start) if which == "omega" else (start, still)))
    static = 2 ** int(np.ceil(np.log2(float(steps)))) if concrete else 64
    differentiated = any(traced(leaf) for leaf in jax.tree.leaves((scene, value)))
    many, found = tried[0], None
    for many in tried if concrete else ():
        found = _orbit(frozen, still, start, exists, direction, which, many, steps, accuracy)
        if not float(found.error) > accuracy:
            break
    if found is None or differentiated:
        found = _orbit(scene, value, start, exists, direction, which, many, static, accuracy)
    elif throw:
        for status in ("absent", "not_converged"):
            if bool(found.status == getattr(OrbitStatus, status)):
                raise ComputationError(status, OrbitStatus[getattr(OrbitStatus, status)])
    return found


@eqx.filter_jit
def _orbit(
    scene: Scene,
    value: Array,
    start: Array,
    exists: Array,
    direction: Array | None,
    given: Literal["omega", "rotor_speed"],
    points: int,
    steps: int | Array,
    accuracy: float,
) -> Orbit:
    lanes, _ = orbits(scene, jnp.reshape(value, (1,)), jnp.reshape(start, (1,)), given, points, steps, accuracy)
    orbit = jax.tree.map(lambda leaf: leaf[0], lanes)
    # A motion on a falling piece of the branch is not the odd mode that was asked for, nor one on a rising piece the even.
    there = exists if direction is None else exists & ~(orbit.slope * direction < 0.0)
    orbit = jax.tree.map(lambda x: jnp.where(there, x, jnp.nan) if eqx.is_inexact_array(x) else x, orbit)
    status, stable = OrbitStatus.where(there, orbit.status, OrbitStatus.absent), there & orbit.stable
    return eqx.tree_at(lambda o: (o.status, o.stable), orbit, (status, stable))


def light_rotor_speed(scene: Scene, omega: Array) -> Array:
    """Where the rotor's speed starts from at a load speed (rad/s): that of light loads, see `jam_rotor_speed`.

    Where the rotor's speed turns the carrier's answer (gyroscopic), n = w + torque(w, n)/drag is solved for by Newton from
    n = w: the jam at the lowest rotor speed, if there are several.
    """
    if scene.machine.carrier().gyroscopic is None:
        return jam_rotor_speed(scene, omega)

    def left_over(n: Array) -> Array:
        return n - jam_rotor_speed(scene, omega, n)

    def newton(_: int, n: Array) -> Array:
        value, slope = jax.jvp(left_over, (n,), (jnp.ones_like(n),))
        return jnp.maximum(n - jnp.where(slope > 0.5, value / slope, value), omega)

    return jax.lax.fori_loop(0, 12, newton, omega)


def orbits(
    scene: Scene,
    value: Array,
    start: Array,
    given: Literal["omega", "rotor_speed"],
    points: int,
    steps: int | Array,
    accuracy: float,
) -> tuple[Orbit, Floquet]:
    """Many exact jams of one scene: `value` (P,) what is given of each, `start` (P,) where the other speed starts from.

    **Returns** `Orbit` with a leading axis P on each of its arrays, and their `Floquet`. `steps` as there.
    """
    grid = grid_of(points, has_half_turn(scene))

    def one(v: Array, s: Array) -> tuple[Motion, Harmonics, tuple[Array, ...]]:
        motion = periodic_motion(scene, grid, given, v, s)
        harmonics = harmonics_of(scene, grid, motion)
        return motion, harmonics, _measured(scene, grid, motion, harmonics)

    motion, harmonics, measured = jax.vmap(one, out_axes=-1)(value, start)
    growth = floquet(scene, grid, motion, harmonics, steps)
    roots = growth.roots if growth.inner is None else jnp.concatenate([growth.roots, growth.inner])
    multipliers = roots**2 if grid.symmetric else roots
    trivial = growth.trivial**2 if grid.symmetric else growth.trivial
    largest = jnp.sqrt(jnp.max(multipliers.real**2 + multipliers.imag**2, axis=0))

    slope, speed_error, lag_error, amplitude, force, power, push = measured
    tiny = jnp.finfo(slope.dtype).eps
    relative = jnp.abs(slope) * motion.omega / motion.rotor_speed
    met = motion.residual < 4096.0 * tiny
    error = jnp.maximum(speed_error / (jnp.maximum(relative, tiny) if given == "rotor_speed" else 1.0), lag_error)
    flat = (relative < tiny**0.25) & (given == "rotor_speed")

    parts = push < 0.0

    def status(is_met: Array, is_flat: Array, is_good: Array, pulls: Array) -> OrbitStatus:
        known = OrbitStatus.where(is_good, OrbitStatus.found, OrbitStatus.coarse)
        known = OrbitStatus.where(is_flat, OrbitStatus.at_fold, known)
        known = OrbitStatus.where(pulls, OrbitStatus.held, known)
        return OrbitStatus.where(is_met, known, OrbitStatus.not_converged)

    def or_nan(values: Array) -> Array:
        return jnp.moveaxis(jnp.where(met, values, jnp.nan), -1, 0)

    orbit = Orbit(
        status=jax.vmap(status)(met, flat, error <= accuracy, parts),
        omega=or_nan(motion.omega),
        rotor_speed=or_nan(motion.rotor_speed),
        slope=or_nan(slope),
        stable=met & (largest < 1.0) & ~parts,
        multiplier=or_nan(largest),
        multipliers=or_nan(multipliers),
        trivial=or_nan(trivial),
        amplitude=or_nan(amplitude),
        foundation_force=or_nan(force),
        power=or_nan(power),
        residual=motion.residual,
        error=or_nan(error),
        lag_harmonics=or_nan(harmonics.lag),
        displacement_harmonics=or_nan(harmonics.displacement),
        force_harmonics=or_nan(harmonics.force),
        lag_orders=tuple(map(int, grid.lag_orders)),
        orders=tuple(map(int, grid.orders)),
        offsets=jnp.broadcast_to(bodies(scene).offsets, (value.shape[0], scene.loads.count)),
    )
    return orbit, growth


def _measured(scene: Scene, grid: Grid, motion: Motion, harmonics: Harmonics) -> tuple[Array, ...]:
    """Slope, the two errors, amplitude, foundation force, power and least push between loads of one motion."""
    branch = along(scene, grid, motion)
    phi, rate = grid.theta[None] + motion.lag, motion.omega * (1.0 + motion.lag @ grid.first.T)
    drive = jnp.mean(jnp.sum(load_torque(scene, phi, rate, motion.rotor_speed, effects=()), axis=0))
    # Directions of the force on the bed are put together as those of a vector.
    force = jnp.sqrt(jnp.sum(_swing(grid, harmonics.force) ** 2))
    push = _least_push(scene, grid, motion, harmonics, phi, rate)
    return (*branch, _swing(grid, harmonics.displacement), force, motion.rotor_speed * drive, push)


def _least_push(scene: Scene, grid: Grid, motion: Motion, harmonics: Harmonics, phi: Array, rate: Array) -> Array:
    """The least torque, N m, with which in a period a load that lies side by side with others pushes the next one ahead.

    Load j needs  kappa m R^2 phi'' - torque_j + m R e'(phi_j).a  from its neighbours, the loads up to j the sum of these.
    """
    loads = circular_loads(scene)
    if loads.own_radius is None or loads.count == 1:
        return jnp.zeros_like(motion.omega)
    each, acceleration = phi + loads.offsets()[:, None], (harmonics.acceleration @ grid.synthesis).real
    torque = loads.resistance((each,), (per_load(scene, rate),), motion.rotor_speed)[0]
    torque = sum((effect.load_force(loads, (each,))[0] for effect in scene.effects), torque)
    inertia = loads.inertia_factor() * loads.mass * loads.radius**2 * motion.omega**2 * (motion.lag @ grid.second.T)
    vibration = loads.mass * loads.radius * jnp.einsum("aji,ai->ji", circle(scene, each)[1], acceleration)
    return jnp.min(-jnp.cumsum(inertia - torque + vibration, axis=0)[:-1])


def _swing(grid: Grid, harmonics: Array) -> Array:
    """(max - min)/2 over the period of the signals with these harmonics (n, K), between the samples too."""
    orders = grid.orders
    samples = 2.0 * np.pi * np.arange(max(64, 4 * int(orders[-1]))) / max(64, 4 * int(orders[-1]))
    spacing = samples[1]
    signal = (harmonics @ np.exp(1j * orders[:, None] * samples)).real

    def extremum(c: Array, values: Array, sign: float) -> Array:
        def newton(_: int, theta: Array) -> Array:
            wave = still * jnp.exp(1j * orders * theta)
            first, second = jnp.sum(-orders * wave.imag), jnp.sum(-(orders**2) * wave.real)
            step = first / jnp.where(sign * second < 0.0, second, -sign * jnp.inf)
            return theta - jnp.clip(step, -spacing, spacing)

        still = jax.lax.stop_gradient(c)
        theta = jnp.asarray(samples, dtype=values.dtype)[jnp.argmax(sign * values)]
        # The value at an extremum does not change with where the extremum is: its place needs no derivative.
        theta = jax.lax.fori_loop(0, 3, newton, theta)
        return jnp.sum(c * jnp.exp(1j * orders * theta)).real

    def swing(c: Array, values: Array) -> Array:
        highest = extremum(c, values, 1.0)
        return highest if grid.symmetric else (highest - extremum(c, values, -1.0)) / 2.0

    return jax.vmap(swing)(harmonics, signal)
