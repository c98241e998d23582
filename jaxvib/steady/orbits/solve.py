"""Periodic motions of coincident loads: the carrier eliminated by harmonics, the loads' phase deviation by collocation."""

from __future__ import annotations

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.coincident import CoincidentModel
from jaxvib.numerics.fourier import Grid, analyzed, deviation_analysis, grid_of, resampling, synthesized
from jaxvib.numerics.linalg import small_solve, solve_in_turn

__all__ = ["BranchTangent", "Harmonics", "Parameter", "PeriodicSolution", "branch_tangent", "harmonics_of", "periodic_motion"]

Parameter = Literal["omega", "rotor_speed"]

_MAX_NEWTON_STEPS = 60
"""Newton steps, those that were refused included; ordinary points take 4 to 6."""


def receptance(model: CoincidentModel, omega: Array, speed: Array, orders: np.ndarray) -> Array:
    """X_k = D(k w)^-1 B^T k^2 w^2, (K, nd, np): the carrier's k-th harmonic per k-th harmonic of sum_g S_g e(phi_g).

    D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G).
    """
    port = model.linear.mount.rows[0].T.astype(complex)

    def at(k: Array) -> Array:
        w = k * omega
        return small_solve(model.linear.dynamic_stiffness(w, speed), w**2 * port)

    return jax.vmap(at)(jnp.asarray(orders, dtype=omega.dtype))


def _answer(model: CoincidentModel, grid: Grid, omega: Array, speed: Array) -> Array:
    """A_k (K, np, np): the k-th harmonic of the port's acceleration per k-th harmonic of sum_g S_g e(phi_g)."""
    return _at_port(model, grid, omega, receptance(model, omega, speed, grid.orders))


def _at_port(model: CoincidentModel, grid: Grid, omega: Array, answer: Array) -> Array:
    """`_answer` from the receptance at the orders of the grid, and others after these."""
    w = jnp.asarray(grid.orders, dtype=omega.dtype) * omega
    return -(w**2)[:, None, None] * (model.linear.mount.rows[0] @ answer[: w.size])


def _feedback(grid: Grid, answer: Array) -> Array:
    """(np, np, M, M): the port's acceleration at the points, from sum_g S_g e(phi_g) at the points."""
    by_distance = jnp.einsum("kab,dk->abd", answer.real, grid.cosine) - jnp.einsum("kab,dk->abd", answer.imag, grid.sine)
    return by_distance[:, :, grid.pairs]


class _Balance(NamedTuple):
    """The torques on the bodies at the points, per drag and load speed: what is left over (G, M), what it is judged by, and
    what its derivative needs."""

    residual: Array
    scale: Array
    acceleration: Array
    moving: Array
    pull: Array


def _balance(model: CoincidentModel, grid: Grid, answer: Array, deviation: Array, omega: Array, speed: Array) -> _Balance:
    phi, rate = grid.theta[None] + deviation, omega * (1.0 + deviation @ grid.first.T)
    point, moving = model.circle(phi)
    force = analyzed(jnp.einsum("g,agi->ai", model.unbalance, point), grid.analysis)
    acceleration = synthesized(jnp.einsum("kab,bk->ak", answer, force), grid.synthesis)
    size, unit = model.unbalance[:, None], (model.drag * omega)[:, None]
    vibration = size * jnp.einsum("agi,ai->gi", moving, acceleration)
    torque = model.torque(phi, rate, speed, acceleration)
    inertia = (model.inertia * omega**2)[:, None] * (deviation @ grid.second.T)
    largest = jnp.max((jnp.abs(inertia) + jnp.abs(torque) + jnp.abs(vibration)) / unit)
    return _Balance(
        (inertia - torque + vibration) / unit,
        1.0 + jnp.abs(speed / omega) + largest,
        acceleration,
        moving,
        -size * jnp.einsum("agi,ai->gi", point, acceleration) / unit,
    )


def _jacobian(
    model: CoincidentModel, grid: Grid, answer: Array, balance: _Balance, deviation: Array, omega: Array, speed: Array
) -> Array:
    """d residual / d deviation (G M, G M)."""
    g, m = deviation.shape
    unit = (model.drag * omega)[:, None]
    phi, rate = grid.theta[None] + deviation, omega * (1.0 + deviation @ grid.first.T)
    by_angle, by_rate, by_acceleration = model.torque_slopes(phi, rate, speed, balance.acceleration)
    own = (
        (model.inertia * omega**2 / unit[:, 0])[:, None, None] * grid.second[None]
        + (balance.pull - by_angle / unit)[:, :, None] * np.eye(m)[None]
        - (omega * by_rate / unit)[:, :, None] * grid.first[None]
    )
    shake = model.unbalance[None, :, None] * balance.moving
    # Dry friction answers to the acceleration that the others cause as well.
    answers = (shake if by_acceleration is None else shake - by_acceleration) / unit[None]
    coupling = jnp.einsum("agi,abij,bhj->gihj", answers, _feedback(grid, answer), shake)
    return (own[:, :, None, :] * np.eye(g)[:, None, :, None] + coupling).reshape(g * m, g * m)


class PeriodicSolution(NamedTuple):
    """A periodic motion on its grid: `deviation` psi (G, M) rad; `omega`, `rotor_speed` rad/s."""

    deviation: Array
    omega: Array
    rotor_speed: Array


def periodic_motion(
    model: CoincidentModel,
    grid: Grid,
    given: Parameter,
    value: Array,
    start: Array,
    deviation: Array | None = None,
    *,
    is_known: bool = False,
) -> PeriodicSolution:
    """The periodic motion psi_g(theta) of the loads' bodies, phi_g = theta + psi_g, theta = Omega t, psi with mean 0.

        I_g Omega^2 psi_g'' = torque_g(phi_g, Omega (1 + psi_g'), n, a) - S_g e'(phi_g) . a
        a_k = - k^2 Omega^2 B D(k Omega)^-1 B^T k^2 Omega^2 sum_g S_g (e(phi_g))_k
        D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G)

    at the M points of `grid`, with the index k for harmonics, a the port's acceleration, e the point of a load on the unit
    circle. The unknowns are psi at the points and the one of Omega and n that is not `given`; `start` is where the latter
    starts from, `deviation` (G, M) where psi does (0 unless said otherwise). Newton's steps are shortened until they lessen the
    residual. Where it `is_known` that these are the motion, none are taken.

    Derivatives with respect to `value` and every number of the scene by the implicit function theorem, of any order.
    """
    if deviation is None:
        deviation = jnp.zeros((*model.unbalance.shape, grid.theta.size), dtype=value.dtype)
    frozen = jax.lax.stop_gradient((start, deviation))
    psi, x = _newton(model, value, *frozen, grid=(grid.theta.size, grid.symmetric), given=given, is_known=is_known)
    return PeriodicSolution(psi, *_both(given, value, x))


def _both(given: Parameter, value: Array, x: Array) -> tuple[Array, Array]:
    """Load speed and rotor speed."""
    return (value, x) if given == "omega" else (x, value)


class _State(NamedTuple):
    """A step of Newton: the best unknowns so far with the size of their residual and the `scale` it is judged by, the change
    that Newton asks for there, how much of it may be taken, and whether this is the end: because the whole change needs no look
    at where it leads (`settled` alone), or because no part of it is any better (`lost` as well)."""

    steps: Array
    deviation: Array
    x: Array
    norm: Array
    scale: Array
    change: Array
    length: Array
    settled: Array
    lost: Array


@eqx.filter_custom_jvp
def _newton(
    model: CoincidentModel,
    value: Array,
    start: Array,
    deviation: Array,
    *,
    grid: tuple[int, bool],
    given: Parameter,
    is_known: bool,
) -> tuple[Array, Array]:
    if is_known:
        return deviation, start
    on = grid_of(*grid)
    tiny = 128.0 * jnp.finfo(value.dtype).eps
    # At a given load speed the carrier's answer is known, unless the rotor's speed is in it.
    fixed = given == "omega" and model.linear.mount.gyroscopic is None
    known = _answer(model, on, value, start) if fixed else None
    no = jnp.asarray(False)

    def moved(now: _State) -> tuple[Array, Array]:
        # A deviation changes by 1 rad at most in a step, a load speed by half of itself: beyond, the linear model says nothing.
        most = 1.0 / jnp.maximum(jnp.max(jnp.abs(now.change[:-1])), 1e-300)
        if given == "rotor_speed":
            most = jnp.minimum(most, 0.5 * jnp.abs(now.x / now.change[-1]))
        change = jnp.minimum(now.length, most) * now.change
        return now.deviation + change[:-1].reshape(now.deviation.shape), now.x + change[-1]

    def step(now: _State) -> _State:
        there = moved(now)
        residual, matrix, scale = _linearised(model, on, given, value, *there, known)
        norm = jnp.sqrt(jnp.mean(residual[:-1] ** 2))
        # Newton squares the fall of the residual: where the next step would end below rounding, nobody needs to look. What the
        # first step gains, from psi = 0, says nothing of that yet.
        sure = (norm * (norm / now.norm) ** 2 < tiny / 16.0 * scale) & (now.steps > 0)
        change = -solve_in_turn(matrix, residual)
        settled = (norm < tiny * scale) | sure
        then = _State(now.steps + 1, *there, norm, scale, change, jnp.minimum(2.0 * now.length, 1.0), settled, no)
        lost = (now.length < 4e-4) | ~jnp.all(jnp.isfinite(now.change)) | (now.norm < 16.0 * tiny * now.scale)
        stay = now._replace(steps=now.steps + 1, length=now.length / 4.0, settled=lost, lost=lost)
        return jax.tree.map(lambda a, b: jnp.where(norm < now.norm, a, b), then, stay)

    one, change = jnp.ones_like(start), jnp.zeros(deviation.size + 1, deviation.dtype)
    # The first step goes nowhere: it looks at where Newton starts, which is better than nothing.
    begin = _State(jnp.asarray(-1), deviation, start, jnp.inf * one, one, change, one, no, no)
    end = jax.lax.while_loop(lambda now: (now.steps < _MAX_NEWTON_STEPS) & ~now.settled, step, begin)
    return moved(end._replace(change=jnp.where(end.settled & ~end.lost, end.change, 0.0)))


@_newton.def_jvp
def _newton_jvp(primals, tangents, *, grid: tuple[int, bool], given: Parameter, is_known: bool):
    model, value, start, deviation = primals
    deviation, x = _newton(model, value, start, deviation, grid=grid, given=given, is_known=is_known)
    on = grid_of(*grid)

    def equations(model: CoincidentModel, value: Array) -> Array:
        omega, speed = _both(given, value, x)
        residual = _balance(model, on, _answer(model, on, omega, speed), deviation, omega, speed).residual
        return _then_zero(residual.ravel())

    change = eqx.filter_jvp(equations, (model, value), tangents[:2])[1]
    change = -jnp.linalg.solve(_linearised(model, on, given, value, deviation, x, None)[1], change)
    return (deviation, x), (change[:-1].reshape(deviation.shape), change[-1])


def _linearised(
    model: CoincidentModel, grid: Grid, given: Parameter, value: Array, deviation: Array, x: Array, known: Array | None
) -> tuple[Array, Array, Array]:
    """The equations (G M + 1,), their derivative by the unknowns and the size they are judged by."""
    if known is None:
        answer, by_x = jax.jvp(lambda z: _answer(model, grid, *_both(given, value, z)), (x,), (jnp.ones_like(x),))
    else:
        answer, by_x = known, jnp.zeros_like(known)

    def residual(z: Array, answer: Array) -> tuple[Array, _Balance]:
        found = _balance(model, grid, answer, deviation, *_both(given, value, z))
        return found.residual.ravel(), found

    at, column, found = jax.jvp(residual, (x, answer), (jnp.ones_like(x), by_x), has_aux=True)
    matrix = _jacobian(model, grid, answer, found, deviation, *_both(given, value, x))
    return jnp.append(at, jnp.mean(deviation)), _pinned(matrix, column), found.scale


class BranchTangent(NamedTuple):
    """`slope` dn/dOmega of the branch; `residual`: what is left of the torque balance at the points, relative to the torques in
    it; `speed_error`, relative, of the rotor speed at this load speed and `deviation_error`, rad: an estimate of what the
    number of points leaves; `receptance` (K, nd, np) of the carrier at the orders of the grid; `acceleration` (np, M) of the
    port at the points, m/s^2."""

    slope: Array
    residual: Array
    speed_error: Array
    deviation_error: Array
    receptance: Array
    acceleration: Array


def branch_tangent(model: CoincidentModel, grid: Grid, motion: PeriodicSolution) -> BranchTangent:
    """Continuation of the branch from a periodic motion, and the error of the motion.

    The error is what one Newton step would change that sees the residual at twice as many points, with the highest
    harmonic of psi for the deviation.
    """
    deviation, omega, speed = motion
    # Its orders are those of the grid, and as many more.
    fine = grid_of(2 * grid.theta.shape[0], grid.symmetric)

    def residual(w: Array, n: Array) -> tuple[Array, tuple[Array, Array, _Balance]]:
        received = receptance(model, w, n, fine.orders)
        answer = _at_port(model, grid, w, received)
        found = _balance(model, grid, answer, deviation, w, n)
        return found.residual.ravel(), (received, answer, found)

    def along(by_omega: Array, by_speed: Array) -> tuple[Array, Array, tuple[Array, Array, _Balance]]:
        return jax.jvp(residual, (omega, speed), (by_omega, by_speed), has_aux=True)

    both = jnp.eye(2, dtype=omega.dtype)
    at, (by_omega, by_speed), (received, answer, found) = jax.vmap(along, out_axes=(None, 0, None))(*both)
    matrix = _pinned(_jacobian(model, grid, answer, found, deviation, omega, speed), by_speed)
    there = deviation @ resampling(grid, fine)
    between = _balance(model, fine, _at_port(model, fine, omega, received), there, omega, speed).residual
    seen = (between @ resampling(fine, grid)).ravel()
    found_by = small_solve(matrix, jnp.stack([-_then_zero(by_omega), _then_zero(jax.lax.stop_gradient(seen))], axis=1))
    slope, error = found_by[-1, 0], jax.lax.stop_gradient(found_by[:, 1])
    # The highest harmonic's real part, and its imaginary one.
    last = jnp.max(jnp.sum((deviation @ deviation_analysis(grid)[:, [grid.deviation_orders.size - 1, -1]]) ** 2, axis=1))
    return BranchTangent(
        slope,
        jnp.max(jnp.abs(at)) / found.scale,
        jnp.abs(error[-1] / speed),
        jnp.maximum(jnp.max(jnp.abs(error[:-1])), jnp.sqrt(last)),
        received[: grid.orders.size],
        found.acceleration,
    )


def _then_zero(residual: Array) -> Array:
    """The right side of the whole Jacobian: psi has the mean 0."""
    return jax.lax.pad(residual, np.zeros((), residual.dtype), [(0, 1, 0)])


def _pinned(by_lag: Array, by_unknown: Array) -> Array:
    """The whole Jacobian: the equations' derivative by psi and by the last unknown, and the row mean psi = 0."""
    m = by_lag.shape[0]
    pin = jnp.append(jnp.full((m,), 1.0 / m), 0.0)
    return jnp.concatenate([jnp.concatenate([by_lag, by_unknown[:, None]], axis=1), pin[None, :]])


class Harmonics(NamedTuple):
    """Harmonics c_k of a periodic motion, signal = Re sum_k c_k exp(i k theta): `deviation` (G, J) rad; `displacement` (nd, K)
    m of the carrier, `acceleration` (np, K) m/s^2 of the port, `force` (nb, K) N on the bed."""

    deviation: Array
    displacement: Array
    acceleration: Array
    force: Array


def harmonics_of(model: CoincidentModel, grid: Grid, motion: PeriodicSolution, answer: Array | None = None) -> Harmonics:
    """The harmonics of psi and of everything that the carrier does, whose receptance `answer` (K, nd, np) may be known."""
    carrier = model.linear.carrier
    point, _ = model.circle(grid.theta[None] + motion.deviation)
    force = analyzed(jnp.einsum("g,agi->ai", model.unbalance, point), grid.analysis)
    answer = receptance(model, motion.omega, motion.rotor_speed, grid.orders) if answer is None else answer
    displacement = jnp.einsum("kdp,pk->dk", answer, force)
    w = jnp.asarray(grid.orders, dtype=motion.omega.dtype) * motion.omega
    return Harmonics(
        analyzed(motion.deviation, deviation_analysis(grid)),
        displacement,
        -(model.linear.mount.rows[0] @ displacement) * w[None] ** 2,
        carrier.bed_force(displacement, 1j * w[None] * displacement),
    )
