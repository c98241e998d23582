"""Periodic motions of whole scenes by trigonometric collocation of the full equations of motion for all coordinates.

A body here is a rotating body with an equation of motion of its own: a load, or the rotor of a motor. The rotor of an ideal
drive is not a body, because its motion is prescribed. The machine itself is the carrier.
"""

from __future__ import annotations

import functools
import itertools
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import Dynamics, dynamics_of
from jaxvib.equations.linear import linear_model, mean_speed
from jaxvib.equations.model import Model, assemble
from jaxvib.equations.state import ExciterState, State
from jaxvib.machine.drives.drive import Motor
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.numerics import radau
from jaxvib.numerics.fourier import Grid, analyzed, deviation_analysis, grid_of, resampling
from jaxvib.numerics.linalg import eigenvalues, small_solve, solve_in_turn
from jaxvib.steady.orbits.solve import Linearized, newton
from jaxvib.steady.orbits.stability import MAX_INTEGRATION_STEPS, deflate, multiplier_error


def body_counts(scene: Scene) -> tuple[int, ...]:
    """Return the number of bodies of each exciter: its loads, or else 1 for the rotor of a motor and 0 for that of an ideal
    drive."""
    return tuple(int(not e.drive.ideal) if e.loads is None else e.loads.count for e in scene.exciters)


def means_of_exciters(scene: Scene, values: Array) -> Array:
    """Return the mean of the values (bodies,) over the bodies of each exciter, (N,); 0 for an exciter without bodies."""
    ends = np.cumsum([0, *body_counts(scene)])
    none = jnp.zeros((), values.dtype)
    return jnp.stack([jnp.mean(values[a:b]) if b > a else none for a, b in itertools.pairwise(ends)])


def unbalance_of(exciter: Exciter) -> Array:
    """Return the unbalance of an exciter's rotor, or of its loads at one angle, kg m."""
    if exciter.loads is None:
        assert exciter.unbalance is not None
        return exciter.unbalance
    loads = cast(CircularLoads, exciter.loads)
    return jnp.sum(jnp.broadcast_to(loads.mass * loads.radius, (loads.count,)))


def _inertia_of(exciter: Exciter) -> Array:
    """Return the moment of inertia of an exciter's loads or of its motor's rotor about the axis, kg m^2."""
    if exciter.loads is None:
        return cast(Motor, exciter.drive).inertia
    loads = cast(CircularLoads, exciter.loads)
    return jnp.sum(jnp.broadcast_to(loads.inertia_factor() * loads.mass * loads.radius**2, (loads.count,)))


def forcing_exciters(scene: Scene) -> list[int]:
    """Return the numbers of the exciters whose ideal drive turns an unbalance, and therefore determines the period of the
    motion."""
    return [k for k, each in enumerate(scene.exciters) if each.drive.ideal and each.loads is None]


class PeriodicScene(eqx.Module):
    """Equations of a scene whose bodies turn once in a period of theta = Omega t.

    The coordinates x (n,) are those of the carrier divided by `length`, and a deviation psi for each body, whose angle is
    sigma (theta + alpha + psi) with the direction sigma of its exciter.

    **Attributes**

    - the assembled `model`; `field`, its equations of motion
    - `length`, m: a typical displacement
    - `phases` alpha (bodies,), rad: approximate phases, so that the deviations psi are small and their derivatives with respect
      to theta lose no digits
    - `feedback`: largest d^2 psi/dtheta^2 of a body that is caused by the acceleration d^2 q/dtheta^2 = `length` of the carrier
    """

    model: Model
    field: Dynamics
    length: Array
    phases: Array
    feedback: Array

    @property
    def coordinates(self) -> int:
        """Number of the carrier's coordinates."""
        return self.model.carrier.mass.shape[0]

    @property
    def size(self) -> int:
        """Number n of all coordinates."""
        return self.coordinates + sum(body_counts(self.model.scene))

    def state(self, theta: Array, x: Array, rate: Array, omega: Array) -> State:
        """Return the state at the angle `theta`; `rate` is dx/dtheta."""
        nd = self.coordinates
        q, v, deviation = x[:nd] * self.length, rate[:nd] * (self.length * omega), self.phases + x[nd:]
        return state_of(self.model.scene, theta, q, v, deviation, rate[nd:], omega)

    def acceleration(self, theta: Array, x: Array, rate: Array, omega: Array) -> Array:
        """Return d^2 x / dtheta^2 by the equations of motion."""
        change = self.field(theta / omega, self.state(theta, x, rate, omega))
        parts = [change.velocity / self.length]
        for exciter, exciter_change in zip(self.model.scene.exciters, change.exciters, strict=True):
            if exciter_change.rate:
                parts.append(exciter.direction * exciter_change.rate[0])
            elif exciter_change.rotor is not None:
                parts.append(exciter.direction * exciter_change.rotor[1][None])
        return jnp.concatenate(parts) / omega**2

    def slopes(self, theta: Array, x: Array, rate: Array, omega: Array) -> tuple[Array, Array]:
        """Return the derivatives (n, 2 n + 1) of `acceleration` with respect to `x`, `rate` and `omega`, and its value (n,)."""

        def of_all(every: Array) -> tuple[Array, Array]:
            x, rate = jnp.split(every[:-1], 2)
            acceleration = self.acceleration(theta, x, rate, every[-1])
            return acceleration, acceleration

        return jax.jacfwd(of_all, has_aux=True)(jnp.concatenate([x, rate, omega[None]]))


def state_of(
    scene: Scene, theta: Array, displacement: Array, velocity: Array, deviation: Array, deviation_rate: Array, omega: Array
) -> State:
    """Return the state of a scene from the motion of its carrier, the deviations psi of its bodies, and d psi/dtheta."""
    ends = np.cumsum([0, *body_counts(scene)])
    exciters = []
    for exciter, begin, end in zip(scene.exciters, ends, ends[1:], strict=False):
        angle = exciter.direction * (theta + deviation[begin:end])
        rate = exciter.direction * omega * (1.0 + deviation_rate[begin:end])
        if exciter.loads is not None:
            exciters.append(ExciterState((angle,), (rate,)))
        else:
            exciters.append(ExciterState() if exciter.drive.ideal else ExciterState(rotor=(angle[0], rate[0])))
    return State(displacement, velocity, exciters=exciters)


def periodic_scene(scene: Scene, phases: Array) -> PeriodicScene:
    """Return the equations of a scene for its periodic motions; `phases` (N,), rad, are approximate phases of the exciters."""
    counts = body_counts(scene)
    model = assemble(scene)
    length = sum(map(unbalance_of, scene.exciters), jnp.zeros(())) / jnp.min(jnp.diagonal(model.carrier.mass))
    each = jnp.repeat(phases, np.asarray(counts), total_repeat_length=sum(counts))
    ratios = [unbalance_of(e) / _inertia_of(e) for e, count in zip(scene.exciters, counts, strict=True) if count]
    feedback = length * functools.reduce(jnp.maximum, ratios) if ratios else jnp.ones_like(length)
    return PeriodicScene(model, dynamics_of(model), *jax.lax.stop_gradient((length, each, feedback)))


class WholeMotion(NamedTuple):
    """Periodic motion on a grid: `x` (n, M), see `PeriodicScene`; `omega`, rad/s."""

    x: Array
    omega: Array


class _Collocation(NamedTuple):
    """Equations at the M points of a grid: `residual` (n, M); `scale` of its terms; `matrix`, its derivative with respect to
    all unknowns."""

    residual: Array
    scale: Array
    matrix: Array


def _rates(grid: Grid, x: Array) -> tuple[Array, Array]:
    return x @ grid.first.T, x @ grid.second.T


def residual_of(scene: PeriodicScene, grid: Grid, x: Array, omega: Array) -> Array:
    """Return d^2 x/dtheta^2 minus the acceleration by the equations of motion at the M points, (n, M)."""
    rate, second = _rates(grid, x)
    theta = jnp.asarray(grid.theta, x.dtype)
    return second - jax.vmap(scene.acceleration, in_axes=(0, 1, 1, None), out_axes=1)(theta, x, rate, omega)


def collocation(scene: PeriodicScene, grid: Grid, x: Array, omega: Array, *, forced: bool) -> _Collocation:
    """Return residuals and their Jacobian.

    Without forcing, the speed Omega is the last unknown, and the last equation prescribes the mean deviation of the first body.
    """
    n, m = x.shape
    rate, second = _rates(grid, x)
    theta = jnp.asarray(grid.theta, x.dtype)
    slopes, acceleration = jax.vmap(scene.slopes, in_axes=(0, 1, 1, None), out_axes=(2, 1))(theta, x, rate, omega)
    by_x, by_rate, by_omega = slopes[:, :n], slopes[:, n : 2 * n], -slopes[:, -1]
    residual = second - acceleration
    turning = rate.at[scene.coordinates :].add(1.0)
    terms = jnp.einsum("ijm,jm->im", jnp.abs(by_x), jnp.abs(x)) + jnp.einsum("ijm,jm->im", jnp.abs(by_rate), jnp.abs(turning))
    one, same = np.eye(n)[:, None, :, None], np.eye(m)[None, :, None, :]
    matrix = jnp.asarray(
        one * grid.second[None, :, None, :]
        - jnp.moveaxis(by_x, 2, 1)[:, :, :, None] * same
        - jnp.moveaxis(by_rate, 2, 1)[:, :, :, None] * grid.first[None, :, None, :]
    ).reshape(n * m, n * m)
    scale = 1.0 + jnp.max(terms)
    if forced:
        return _Collocation(residual, scale, matrix)
    pin = np.zeros((n, m))
    pin[scene.coordinates] = 1.0 / m
    row = jnp.asarray(np.append(pin.ravel(), 0.0), x.dtype)
    matrix = jnp.concatenate([jnp.concatenate([matrix, by_omega.reshape(-1, 1)], axis=1), row[None]])
    return _Collocation(residual, scale, matrix)


def solve_whole(scene: PeriodicScene, grid: Grid, omega: Array, *, forced: bool) -> WholeMotion:
    """Solve for the periodic motion of a scene by Newton's method, with derivatives by the implicit function theorem.

        x'' = f(theta, x, x', Omega)    at the M points of the grid,    ' = d/dtheta
        mean psi of the first body = 0    if the motion is not forced; Omega is then an unknown

    **Arguments**: `omega`, rad/s: the speed of a `forced` motion, otherwise the initial value of the speed.
    """
    speed = omega if forced else jax.lax.stop_gradient(omega)
    x, w = _solve(scene, speed, linear_start(scene, grid, omega), grid_key=(grid.theta.size, grid.symmetric), forced=forced)
    return WholeMotion(x, w)


def linear_start(scene: PeriodicScene, grid: Grid, omega: Array) -> Array:
    """Return the linear response of the carrier to bodies that turn uniformly.

        q = Re(Y e^(i theta)),    D(Omega) Y = Omega^2 sum_k S_k B_k^T (1, -i sigma_k) e^(i alpha_k)

    D is the dynamic stiffness of the machine. S_k is the unbalance of exciter k, sigma_k its direction, alpha_k the phase of
    its first body, and B_k maps the coordinates to the displacement of its axis.
    """
    model, phases, force = linear_model(scene.model.scene), list(scene.phases), []
    for exciter, mount, count in zip(model.scene.exciters, model.mounts, body_counts(model.scene), strict=True):
        body_phases = [phases.pop(0) for _ in range(count)]
        phase = body_phases[0] if body_phases else 0.0
        direction = jnp.stack([(1.0 + 0.0j, -1.0j * exciter.direction)[axis] for axis in mount.axes])
        force.append(unbalance_of(exciter) * jnp.exp(1j * phase) * (mount.rows[0].T @ direction))
    dynamic = model.dynamic_stiffness(omega, mean_speed(model.scene, omega))
    response = small_solve(dynamic, omega**2 * sum(force[1:], force[0]))
    q = (response[:, None] * np.exp(1j * grid.theta)[None]).real / scene.length
    no_deviation = jnp.zeros((scene.phases.size, grid.theta.size), omega.dtype)
    return jax.lax.stop_gradient(jnp.concatenate([q.astype(omega.dtype), no_deviation]))


@eqx.filter_custom_jvp
def _solve(
    scene: PeriodicScene, omega: Array, start: Array, *, grid_key: tuple[int, bool], forced: bool
) -> tuple[Array, Array]:
    grid, size, weight = grid_of(*grid_key), start.size, jnp.minimum(scene.feedback, 1.0)

    def move(unknowns: tuple[Array, Array], change: Array, length: Array) -> tuple[Array, Array]:
        x, w = unknowns
        # A step turns bodies by at most 1 rad and changes the speed by at most half, because the linear model is not valid for
        # larger changes.
        turned = change[:size].reshape(x.shape)[scene.coordinates :]
        limit = 1.0 / jnp.max(jnp.abs(turned), initial=1e-30)
        if not forced:
            limit = jnp.minimum(limit, 0.5 * jnp.abs(w / change[-1]))
        change = jnp.minimum(length, limit) * change
        return x + change[:size].reshape(x.shape), w if forced else w + change[-1]

    def linearize(x: Array, w: Array) -> Linearized:
        system = collocation(scene, grid, x, w, forced=forced)
        right = system.residual.ravel() if forced else jnp.append(system.residual.ravel(), 0.0)
        # Residuals of the carrier are weighted by the torques that they cause. Otherwise no step that turns bodies would
        # reduce the norm, because the torques between bodies are small compared with the forces on the carrier.
        carrier, bodies = jnp.split(system.residual, [scene.coordinates])
        norm = jnp.sqrt((jnp.sum((weight * carrier) ** 2) + jnp.sum(bodies**2)) / size)
        return Linearized(norm, system.scale, lambda: -solve_in_turn(system.matrix, right))

    change = jnp.zeros(size if forced else size + 1, start.dtype)
    return newton(linearize, move, (start, omega), change, jnp.ones_like(omega))


@_solve.def_jvp
def _solve_jvp(primals, tangents, *, grid_key: tuple[int, bool], forced: bool):
    scene, omega, start = primals
    x, w = _solve(scene, omega, start, grid_key=grid_key, forced=forced)
    grid = grid_of(*grid_key)
    by_omega = tangents[1] if forced else None
    change = eqx.filter_jvp(lambda s, v: residual_of(s, grid, x, v), (scene, w), (tangents[0], by_omega))[1].ravel()
    matrix = collocation(scene, grid, x, w, forced=forced).matrix
    tangent = -jnp.linalg.solve(matrix, change if forced else jnp.append(change, 0.0))
    speed = (jnp.zeros_like(w) if by_omega is None else by_omega) if forced else tangent[-1]
    return (x, w), (tangent[: x.size].reshape(x.shape), speed)


def collocation_error(scene: PeriodicScene, grid: Grid, motion: WholeMotion, *, forced: bool) -> tuple[Array, Array]:
    """Return the residual of the equations at the points, relative to their terms, and the estimated error of the motion: the
    largest of the errors of the speed (relative), of angles (rad), and of displacements (relative to the largest one).

    The error follows from one Newton step with the residuals at twice as many points, and from the highest harmonic.
    """
    scene, (x, omega) = jax.lax.stop_gradient((scene, motion))
    system, nd = collocation(scene, grid, x, omega, forced=forced), scene.coordinates
    fine = grid_of(2 * grid.theta.size, grid.symmetric)
    residual = (residual_of(scene, fine, x @ resampling(grid, fine), omega) @ resampling(fine, grid)).ravel()
    change = solve_in_turn(system.matrix, residual if forced else jnp.append(residual, 0.0))
    last = jnp.abs(analyzed(x, deviation_analysis(grid))[:, -1:])
    error = jnp.concatenate([jnp.abs(change[: x.size].reshape(x.shape)), last], axis=1)
    largest = jnp.maximum(jnp.max(jnp.abs(x[:nd])), 1e-3)  # the forces of the exciters may cancel
    errors = jnp.max(error[:nd]) / largest, jnp.max(error[nd:], initial=0.0), 0.0 if forced else jnp.abs(change[-1] / omega)
    return jnp.max(jnp.abs(system.residual)) / system.scale, jnp.max(jnp.stack([jnp.asarray(e) for e in errors]))


def multipliers_of(
    scene: PeriodicScene, grid: Grid, motion: WholeMotion, max_steps: int | None, *, forced: bool
) -> tuple[Array, Array, Array]:
    """Return the Floquet multipliers of the full state about a periodic motion (all except the trivial one, and the trivial
    one), and the error of their moduli.

    The trivial multiplier belongs to a shift in time; it is NaN with forcing. Multipliers that need more than
    `MAX_INTEGRATION_STEPS` are NaN.

    `max_steps`: limit of the steps of `radau.flow`, without which there are no derivatives in reverse mode.
    """
    x, omega = motion
    n, orders = x.shape[0], jnp.asarray(grid.deviation_orders, x.dtype)
    harmonics = analyzed(x, deviation_analysis(grid))

    def slopes(theta: Array) -> Array:
        wave = jnp.exp(1j * orders * theta)
        at = theta, (harmonics @ wave).real, (harmonics @ (1j * orders * wave)).real, omega
        return scene.slopes(*at)[0][:, : 2 * n]

    radians = _radians(*jax.lax.stop_gradient((scene, omega)))
    steps = radau.steps_for(radians)
    resolved = jnp.asarray(True) if max_steps is not None else steps <= MAX_INTEGRATION_STEPS
    steps = jnp.where(resolved, steps, 1) if max_steps is None else jnp.clip(steps, 1, max_steps)
    whole = radau.flow(slopes, n, 2.0 * np.pi, steps, x.dtype, max_steps)
    decay_error = radau.decay_error(radians / steps, steps)
    if forced:
        return _multipliers(whole, resolved), jnp.full_like(omega, jnp.nan), multiplier_error(jnp.ones_like(omega), decay_error)
    rate, second = _rates(grid, x)
    along = jnp.concatenate([rate[:, 0].at[scene.coordinates :].add(1.0), second[:, 0]])
    trivial, rest = deflate(whole, along)
    return _multipliers(rest, resolved), trivial, multiplier_error(trivial, decay_error)


def _multipliers(matrix: Array, resolved: Array) -> Array:
    """Return the eigenvalues of a transition matrix; NaN if it is not `resolved` or not finite."""
    # The library routine for eigenvalues does not terminate for a matrix that is not finite.
    valid = resolved & jnp.all(jnp.isfinite(matrix))
    return jnp.where(valid, eigenvalues(jnp.where(valid, matrix, 0.0)), jnp.nan)


def _radians(scene: PeriodicScene, omega: Array) -> Array:
    """Return the phase, rad, through which the fastest oscillation advances in a period: 2 pi (w/Omega + 2).

    w is the highest natural frequency plus an upper bound of its gyroscopic change. The rotating bodies can shift the frequency
    of an oscillation by up to 2 Omega.
    """
    carrier, gyroscopic = scene.model.carrier, scene.model.mounts[0].gyroscopic
    half = jnp.linalg.inv(jnp.linalg.cholesky(carrier.mass))
    fastest = jnp.sqrt(jnp.max(jnp.abs(jnp.linalg.eigvalsh(half @ carrier.stiffness @ half.T))))
    if gyroscopic is not None:
        fastest = fastest + scene.model.scene.top_speed * jnp.linalg.norm(half @ gyroscopic @ half.T)
    return 2.0 * np.pi * (fastest / omega + 2.0)
