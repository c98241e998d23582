"""Periodic motions of jammed loads, by collocation of their phase deviation.

The unknowns are the deviations and one speed. The motion of the carrier is not an unknown: the carrier is linear, and each
harmonic of its motion is computed from the same harmonic of the motion of the loads.

Symbols: the carrier has the matrices K (stiffness), M (mass), C (damping) and G (gyroscopic, multiplied by the rotor speed n),
and B maps its coordinates to the displacement of the mount. The loads form bodies g with the unbalances S_g and the moments of
inertia I_g (see `JammedBodies`); e(phi) is the point of the unit circle at the angle phi, in the directions of the mount. m_j
is the mass of load j. Omega is the load speed.

In shapes of arrays the letters are numbers: G bodies, M points of the grid, K harmonics of the carrier, J harmonics of the
deviation, nd coordinates of the carrier, p directions of the mount.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.jammed_bodies import JammedBodies
from jaxvib.numerics.fourier import Grid, analyzed, deviation_analysis, grid_of, resampling, synthesized
from jaxvib.numerics.linalg import small_solve, solve_in_turn

Parameter = Literal["omega", "rotor_speed"]


def unbalance_response(model: JammedBodies, omega: Array, speed: Array, orders: np.ndarray) -> Array:
    """Return the response X_k = D(k Omega)^-1 B^T k^2 Omega^2 of the carrier to unbalance, (K, nd, p) 1/kg: k-th harmonic of
    its displacement per k-th harmonic of sum_g S_g e(phi_g), at the load speed `omega` and the rotor's `speed`, rad/s."""
    port = model.linear.mount.rows[0].T.astype(complex)

    def at(k: Array) -> Array:
        w = k * omega
        return small_solve(model.linear.dynamic_stiffness(w, speed), w**2 * port)

    return jax.vmap(at)(jnp.asarray(orders, dtype=omega.dtype))


def _port_response(model: JammedBodies, grid: Grid, omega: Array, speed: Array) -> Array:
    return _port_response_from(model, grid, omega, unbalance_response(model, omega, speed, grid.orders))


def _port_response_from(model: JammedBodies, grid: Grid, omega: Array, response: Array) -> Array:
    """Return the response A_k (K, p, p) of the mount: k-th harmonic of its acceleration per k-th harmonic of
    sum_g S_g e(phi_g). The first orders of `response`, the `unbalance_response` of the carrier, are those of the grid."""
    w = jnp.asarray(grid.orders, dtype=omega.dtype) * omega
    return -(w**2)[:, None, None] * (model.linear.mount.rows[0] @ response[: w.size])


def _feedback(grid: Grid, port_response: Array) -> Array:
    """Return the matrix (p, p, M, M) from sum_g S_g e(phi_g) to the acceleration of the mount, both at the points."""
    by_distance = jnp.einsum("kab,dk->abd", port_response.real, grid.cosine) - jnp.einsum(
        "kab,dk->abd", port_response.imag, grid.sine
    )
    return by_distance[:, :, grid.pairs]


class _Balance(NamedTuple):
    """Torque balance of the bodies at the points.

    **Attributes**: `residual` (G, M) of the balance, divided by drag times load speed of each body; `scale` of the terms in it;
    `acceleration` (p, M) of the mount, m/s^2; `moving` (p, G, M): de/dphi; `vibration_stiffness` (G, M): minus the derivative
    of the vibrational torque with respect to the angle, at a fixed acceleration, in the units of the residual.
    """

    residual: Array
    scale: Array
    acceleration: Array
    moving: Array
    vibration_stiffness: Array


def _balance(model: JammedBodies, grid: Grid, port_response: Array, deviation: Array, omega: Array, speed: Array) -> _Balance:
    phi, rate = grid.theta[None] + deviation, omega * (1.0 + deviation @ grid.first.T)
    point, moving = model.circle(phi)
    force = analyzed(jnp.einsum("g,agi->ai", model.unbalance, point), grid.analysis)
    acceleration = synthesized(jnp.einsum("kab,bk->ak", port_response, force), grid.synthesis)
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
    model: JammedBodies, grid: Grid, port_response: Array, balance: _Balance, deviation: Array, omega: Array, speed: Array
) -> Array:
    """Return the Jacobian d residual / d deviation, (G M, G M)."""
    g, m = deviation.shape
    unit = (model.drag * omega)[:, None]
    phi, rate = grid.theta[None] + deviation, omega * (1.0 + deviation @ grid.first.T)
    by_angle, by_rate, by_acceleration = model.torque_slopes(phi, rate, speed, balance.acceleration)
    of_one_body = (
        (model.inertia * omega**2 / unit[:, 0])[:, None, None] * grid.second[None]
        + (balance.vibration_stiffness - by_angle / unit)[:, :, None] * np.eye(m)[None]
        - (omega * by_rate / unit)[:, :, None] * grid.first[None]
    )
    force_change = model.unbalance[None, :, None] * balance.moving
    # Dry friction also depends on the acceleration that the other bodies cause.
    torque_response = (force_change if by_acceleration is None else force_change - by_acceleration) / unit[None]
    coupling = jnp.einsum("agi,abij,bhj->gihj", torque_response, _feedback(grid, port_response), force_change)
    return (of_one_body[:, :, None, :] * np.eye(g)[:, None, :, None] + coupling).reshape(g * m, g * m)


class PeriodicSolution(NamedTuple):
    """Periodic motion on a grid: `deviation` psi (G, M) rad; `omega`, `rotor_speed` rad/s."""

    deviation: Array
    omega: Array
    rotor_speed: Array


def periodic_motion(
    model: JammedBodies,
    grid: Grid,
    given: Parameter,
    value: Array,
    start: Array,
    deviation: Array | None = None,
    *,
    is_known: bool = False,
) -> PeriodicSolution:
    """Solve for the periodic motion phi_g = theta + psi_g(theta) of the bodies of loads, with theta = Omega t.

        I_g Omega^2 psi_g'' = torque_g(phi_g, Omega (1 + psi_g'), n, a) - S_g e'(phi_g) . a
        a_k = - k^2 Omega^2 B D(k Omega)^-1 B^T k^2 Omega^2 sum_g S_g (e(phi_g))_k
        D(w) = K - w^2 (M + sum m_j B^T B) + i w (C + n G)

    at the points of `grid`. Primes are derivatives with respect to the argument, the index k denotes the k-th harmonic, and a
    is the acceleration of the mount. The unknowns are psi at the points and one of Omega and n; the other one is `given`. The
    mean of psi over all points and bodies is 0, which selects the zero of time.

    **Arguments**

    - `value`: the given speed, rad/s
    - `start`: initial value of the unknown speed, rad/s
    - `deviation`: initial psi (G, M); default 0
    - `is_known`: True if the initial values are the solution; Newton's method is then omitted

    Newton steps are shortened until they reduce the residuals. Derivatives with respect to `value` and every parameter of the
    scene, of any order, follow from the implicit function theorem.
    """
    if deviation is None:
        deviation = jnp.zeros((*model.unbalance.shape, grid.theta.size), dtype=value.dtype)
    frozen = jax.lax.stop_gradient((start, deviation))
    psi, x = _newton(model, value, *frozen, grid=(grid.theta.size, grid.symmetric), given=given, is_known=is_known)
    return PeriodicSolution(psi, *_speed_pair(given, value, x))


def _speed_pair(given: Parameter, value: Array, x: Array) -> tuple[Array, Array]:
    """Return load speed and rotor speed."""
    return (value, x) if given == "omega" else (x, value)


@eqx.filter_custom_jvp
def _newton(
    model: JammedBodies,
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
    points = grid_of(*grid)
    # At a given load speed the response of the carrier is fixed, unless it depends on the rotor speed.
    fixed = given == "omega" and model.linear.mount.gyroscopic is None
    fixed_response = _port_response(model, points, value, start) if fixed else None

    def move(unknowns: tuple[Array, Array], change: Array, length: Array) -> tuple[Array, Array]:
        deviation, x = unknowns
        # A step changes deviations by at most 1 rad and the load speed by at most half, because the linear model is not valid
        # beyond.
        largest = 1.0 / jnp.maximum(jnp.max(jnp.abs(change[:-1])), 1e-300)
        if given == "rotor_speed":
            largest = jnp.minimum(largest, 0.5 * jnp.abs(x / change[-1]))
        change = jnp.minimum(length, largest) * change
        return deviation + change[:-1].reshape(deviation.shape), x + change[-1]

    def linearize(deviation: Array, x: Array) -> Linearized:
        residual, matrix, scale = _linearize(model, points, given, value, deviation, x, fixed_response)
        norm = jnp.sqrt(jnp.mean(residual[:-1] ** 2))
        return Linearized(norm, scale, lambda: -solve_in_turn(matrix, residual))

    one, change = jnp.ones_like(start), jnp.zeros(deviation.size + 1, deviation.dtype)
    return newton(linearize, move, (deviation, start), change, one)


@_newton.def_jvp
def _newton_jvp(primals, tangents, *, grid: tuple[int, bool], given: Parameter, is_known: bool):
    model, value, start, deviation = primals
    deviation, x = _newton(model, value, start, deviation, grid=grid, given=given, is_known=is_known)
    points = grid_of(*grid)

    def equations(model: JammedBodies, value: Array) -> Array:
        omega, speed = _speed_pair(given, value, x)
        residual = _balance(model, points, _port_response(model, points, omega, speed), deviation, omega, speed).residual
        return _append_mean_condition(residual.ravel())

    change = eqx.filter_jvp(equations, (model, value), tangents[:2])[1]
    change = -jnp.linalg.solve(_linearize(model, points, given, value, deviation, x, None)[1], change)
    return (deviation, x), (change[:-1].reshape(deviation.shape), change[-1])


def _linearize(
    model: JammedBodies, grid: Grid, given: Parameter, value: Array, deviation: Array, x: Array, fixed_response: Array | None
) -> tuple[Array, Array, Array]:
    """Return residuals (G M + 1,), their Jacobian, and the scale of the torques in them."""
    if fixed_response is None:
        port_response, by_x = jax.jvp(
            lambda z: _port_response(model, grid, *_speed_pair(given, value, z)), (x,), (jnp.ones_like(x),)
        )
    else:
        port_response, by_x = fixed_response, jnp.zeros_like(fixed_response)

    def residual(z: Array, port_response: Array) -> tuple[Array, _Balance]:
        balance = _balance(model, grid, port_response, deviation, *_speed_pair(given, value, z))
        return balance.residual.ravel(), balance

    residuals, column, balance = jax.jvp(residual, (x, port_response), (jnp.ones_like(x), by_x), has_aux=True)
    matrix = _jacobian(model, grid, port_response, balance, deviation, *_speed_pair(given, value, x))
    return jnp.append(residuals, jnp.mean(deviation)), _bordered(matrix, column), balance.scale


class BranchTangent(NamedTuple):
    """Tangent of a branch and errors of a point on it.

    **Attributes**

    - `slope` dn/dOmega
    - `residual` of the torque balance at the points, relative to its torques
    - `speed_error`: estimated relative error of the rotor speed at this load speed, due to the number of points
    - `deviation_error`: estimated error of psi, rad
    - `response` (K, nd, p): `unbalance_response` of the carrier at the orders of the grid
    - `acceleration` (p, M) of the mount at the points, m/s^2
    """

    slope: Array
    residual: Array
    speed_error: Array
    deviation_error: Array
    response: Array
    acceleration: Array


def branch_tangent(model: JammedBodies, grid: Grid, motion: PeriodicSolution) -> BranchTangent:
    """Return the tangent of the branch at a periodic motion, and the error of the motion.

    The error is estimated as the change in one Newton step with the residuals at twice as many points. The error of the
    deviation is the amplitude of the highest harmonic of psi, if this is larger.
    """
    deviation, omega, speed = motion
    # The orders of the fine grid are those of `grid`, followed by higher orders.
    fine = grid_of(2 * grid.theta.shape[0], grid.symmetric)

    def residual(w: Array, n: Array) -> tuple[Array, tuple[Array, Array, _Balance]]:
        response = unbalance_response(model, w, n, fine.orders)
        port_response = _port_response_from(model, grid, w, response)
        balance = _balance(model, grid, port_response, deviation, w, n)
        return balance.residual.ravel(), (response, port_response, balance)

    def along(by_omega: Array, by_speed: Array) -> tuple[Array, Array, tuple[Array, Array, _Balance]]:
        return jax.jvp(residual, (omega, speed), (by_omega, by_speed), has_aux=True)

    both = jnp.eye(2, dtype=omega.dtype)
    residuals, (by_omega, by_speed), (response, port_response, balance) = jax.vmap(along, out_axes=(None, 0, None))(*both)
    matrix = _bordered(_jacobian(model, grid, port_response, balance, deviation, omega, speed), by_speed)
    on_fine = deviation @ resampling(grid, fine)
    between = _balance(model, fine, _port_response_from(model, fine, omega, response), on_fine, omega, speed).residual
    fine_residual = (between @ resampling(fine, grid)).ravel()
    changes = small_solve(
        matrix,
        jnp.stack([-_append_mean_condition(by_omega), _append_mean_condition(jax.lax.stop_gradient(fine_residual))], axis=1),
    )
    slope, error = changes[-1, 0], jax.lax.stop_gradient(changes[:, 1])
    # Real and imaginary part of the highest harmonic.
    last = jnp.max(jnp.sum((deviation @ deviation_analysis(grid)[:, [grid.deviation_orders.size - 1, -1]]) ** 2, axis=1))
    return BranchTangent(
        slope,
        jnp.max(jnp.abs(residuals)) / balance.scale,
        jnp.abs(error[-1] / speed),
        jnp.maximum(jnp.max(jnp.abs(error[:-1])), jnp.sqrt(last)),
        response[: grid.orders.size],
        balance.acceleration,
    )


def _append_mean_condition(residual: Array) -> Array:
    """Append a zero to the residuals of the balance, or to their derivative: the residual of the condition mean psi = 0."""
    return jax.lax.pad(residual, np.zeros((), residual.dtype), [(0, 1, 0)])


def _bordered(by_deviation: Array, by_unknown: Array) -> Array:
    """Return the bordered Jacobian: derivatives with respect to psi and to the unknown speed; the last row is the condition
    mean psi = 0."""
    m = by_deviation.shape[0]
    mean = jnp.append(jnp.full((m,), 1.0 / m), 0.0)
    return jnp.concatenate([jnp.concatenate([by_deviation, by_unknown[:, None]], axis=1), mean[None, :]])


class Harmonics(NamedTuple):
    """Harmonics c_k of a periodic motion, signal = Re sum_k c_k exp(i k theta): `deviation` (G, J) rad; `displacement` (nd, K)
    m of the carrier, `acceleration` (p, K) m/s^2 of the mount, `force` (directions of the foundation, K) N on the
    foundation."""

    deviation: Array
    displacement: Array
    acceleration: Array
    force: Array


def harmonics_of(model: JammedBodies, grid: Grid, motion: PeriodicSolution, response: Array | None = None) -> Harmonics:
    """Return harmonics of psi and of the carrier's motion; `response`: its `unbalance_response`, if known."""
    point, _ = model.circle(grid.theta[None] + motion.deviation)
    force = analyzed(jnp.einsum("g,agi->ai", model.unbalance, point), grid.analysis)
    if response is None:
        response = unbalance_response(model, motion.omega, motion.rotor_speed, grid.orders)
    displacement = jnp.einsum("kdp,pk->dk", response, force)
    w = jnp.asarray(grid.orders, dtype=motion.omega.dtype) * motion.omega
    return Harmonics(
        analyzed(motion.deviation, deviation_analysis(grid)),
        displacement,
        -(model.linear.mount.rows[0] @ displacement) * w[None] ** 2,
        model.linear.vibration_force(displacement, w[None]),
    )


_MAX_NEWTON_STEPS = 60
"""Maximum number of Newton steps, rejected ones included; ordinary points take 4 to 6."""


class Linearized(NamedTuple):
    """Equations at some unknowns: `norm` of their residuals, the `scale` of the terms in them, and the Newton step `change`."""

    norm: Array
    scale: Array
    change: Callable[[], Array]


class _NewtonState(NamedTuple):
    """State of Newton's iteration after a number of `steps`: the best `unknowns` so far with their `Linearized` values; the
    `length` of the next step, the largest fraction of `change` that is allowed; `done`: True if the iteration ends; `stalled`:
    True if it ends because no fraction of the step reduces the residuals."""

    steps: Array
    unknowns: Any
    norm: Array
    scale: Array
    change: Array
    length: Array
    done: Array
    stalled: Array


Unknowns = TypeVar("Unknowns", bound=tuple)


def newton(
    linearize: Callable[..., Linearized],
    move: Callable[[Unknowns, Array, Array], Unknowns],
    start: Unknowns,
    change: Array,
    one: Array,
) -> Unknowns:
    """Return the root of the equations that `linearize` evaluates at the unknowns, or the unknowns with the smallest residuals
    if the iteration does not converge.

    **Arguments**: `move(unknowns, change, length)` returns the unknowns after at most the fraction `length` of the Newton step
    `change`; `start`: initial unknowns; `change`: zeros with the shape of a Newton step; `one`: 1 in their precision.
    """
    tiny = 128.0 * jnp.finfo(change.dtype).eps
    no = jnp.asarray(False)

    def step(now: _NewtonState) -> _NewtonState:
        unknowns = move(now.unknowns, now.change, now.length)
        norm, scale, solve = linearize(*unknowns)
        # Newton's method squares the reduction of the residuals: if the next step will end below rounding, the residuals after
        # it need no evaluation. The reduction by the first step, from the start, allows no such prediction.
        predicted_converged = (norm * (norm / now.norm) ** 2 < tiny / 16.0 * scale) & (now.steps > 0)
        change = solve()
        done = (norm < tiny * scale) | predicted_converged
        accepted = _NewtonState(now.steps + 1, unknowns, norm, scale, change, jnp.minimum(2.0 * now.length, 1.0), done, no)
        stalled = (now.length < 4e-4) | ~jnp.all(jnp.isfinite(now.change)) | (now.norm < 16.0 * tiny * now.scale)
        rejected = now._replace(steps=now.steps + 1, length=now.length / 4.0, done=stalled, stalled=stalled)
        return jax.tree.map(lambda a, b: jnp.where(norm < now.norm, a, b), accepted, rejected)

    # The first iteration only evaluates the residuals at the start, because the initial norm is infinite.
    begin = _NewtonState(jnp.asarray(-1), start, jnp.inf * one, one, change, one, no, no)
    end = jax.lax.while_loop(lambda now: (now.steps < _MAX_NEWTON_STEPS) & ~now.done, step, begin)
    return move(end.unknowns, jnp.where(end.done & ~end.stalled, end.change, 0.0), end.length)
