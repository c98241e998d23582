"""Periodic motions of collected loads: the carrier eliminated harmonic by harmonic, the load's lag by collocation."""

from __future__ import annotations

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.effects import Effect
from jaxvib.machine.scene import Scene
from jaxvib.steady.response import circular_loads, loaded_mass, small_solve

__all__ = [
    "Along",
    "Body",
    "Grid",
    "Harmonics",
    "Motion",
    "along",
    "body",
    "circle",
    "grid_of",
    "harmonics_of",
    "has_half_turn",
    "load_torque",
    "periodic_motion",
]

_STEPS = 60
"""Newton steps, those that were refused included; ordinary points take 4 to 6."""


Points = Array | np.ndarray


class Grid(NamedTuple):
    """Points on a period of theta = Omega t and the matrices of trigonometric interpolation between them.

    With the half-turn symmetry psi(theta + pi) = psi(theta), e(theta + pi) = -e(theta), half a period says everything: psi
    has even harmonics only and the point e of the loads odd ones.

    **Attributes** (M points): `symmetric` whether it is half a period; `theta` (M,); `first`, `second` (M, M) d/dtheta and
    d^2/dtheta^2 of psi; `lag_orders` (J,) and `orders` (K,), the harmonics of psi and of e; `lag_weights` (J,): psi has the
    harmonics weight / M sum_l psi_l exp(-i k theta_l), e those with weight 2; `cosine`, `sine` (2M - 1, K): 2 / M times cos
    and sin of k times the distance of two points; `pairs` (M, M): which distance belongs to which two points.
    """

    symmetric: bool
    theta: np.ndarray
    first: np.ndarray
    second: np.ndarray
    lag_orders: np.ndarray
    lag_weights: np.ndarray
    orders: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    pairs: np.ndarray


@functools.lru_cache(maxsize=64)
def grid_of(points: int, symmetric: bool) -> Grid:
    """The grid of `points` on half a period where the motion has the half-turn symmetry, else on the whole of it.

    `points` is made even for half a period and odd for a whole one, which keeps the highest harmonic of e whole.
    """
    m = points + points % 2 if symmetric else points + 1 - points % 2
    turn = np.pi if symmetric else 2.0 * np.pi
    theta = turn * np.arange(m) / m
    if symmetric:
        lag_orders, orders = np.arange(0, m + 1, 2), np.arange(1, m, 2)
        weights = np.where((lag_orders == 0) | (lag_orders == m), 1.0, 2.0)
    else:
        lag_orders, orders = np.arange(0, (m + 1) // 2), np.arange(1, (m + 1) // 2)
        weights = np.where(lag_orders == 0, 1.0, 2.0)
    apart = theta[:, None] - theta[None, :]
    phase = lag_orders[:, None, None] * apart
    first = np.tensordot(weights * -lag_orders, np.sin(phase), 1) / m
    second = np.tensordot(weights * -(lag_orders**2), np.cos(phase), 1) / m
    distance = orders * (turn / m * np.arange(1 - m, m))[:, None]
    index = np.arange(m)
    return Grid(
        symmetric, theta, first, second, lag_orders, weights, orders,
        2.0 / m * np.cos(distance), 2.0 / m * np.sin(distance), index[:, None] - index[None, :] + m - 1,
    )  # fmt: skip


class Body(NamedTuple):
    """The collected loads as one body: `unbalance` S = sum m R, `inertia` I = sum kappa m R^2, `drag` sum b_W R^2."""

    unbalance: Array
    inertia: Array
    drag: Array


def body(scene: Scene) -> Body:
    """The collected loads of the scene as one body."""
    loads = circular_loads(scene)
    inertia = loads.inertia_factor() * loads.mass * loads.radius**2
    return Body(loads.unbalance(), jnp.sum(jnp.broadcast_to(inertia, (loads.count,))), loads.drag_sum())


def has_half_turn(scene: Scene) -> bool:
    """Whether the equations stay the same under phi + pi, -q: effects on the loads (gravity) break it."""
    return not scene.effects


def load_torque(scene: Scene, phi: Points, rate: Array, speed: Array, effects: tuple[Effect, ...] | None = None) -> Array:
    """What turns the loads besides the vibration, N m: resistance and effects, summed over loads that are all at `phi` (M,).

    `effects` are the scene's unless others are named; () leaves what the rotor gives.
    """
    loads, acting = scene.loads, scene.effects if effects is None else effects

    def each(angle: Array, angle_rate: Array) -> Array:
        torque = loads.resistance((angle,), (angle_rate,), speed)[0]
        forces = (effect.load_force(loads, (angle,)) for effect in acting)
        return sum((force[0] for force in forces if force is not None), torque)

    if all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(loads)):
        return loads.count * each(jnp.asarray(phi), rate)
    spread = (loads.count,)
    return jax.vmap(lambda p, r: jnp.sum(each(jnp.broadcast_to(p, spread), jnp.broadcast_to(r, spread))))(phi, rate)


def circle(scene: Scene, phi: Points) -> tuple[Array, Array]:
    """e(phi) and de/dphi (np, ...): where a load on the unit circle is in the port's directions, and how it moves."""
    cos, sin = jnp.cos(phi), jnp.sin(phi)
    axes = scene.machine.carrier().axes
    return jnp.stack([(cos, sin)[axis] for axis in axes]), jnp.stack([(-sin, cos)[axis] for axis in axes])


def receptance(scene: Scene, omega: Array, orders: np.ndarray) -> Array:
    """X_k = D(k w)^-1 B^T S k^2 w^2, (K, nd, np): the carrier's k-th harmonic per k-th harmonic of the loads' point e.

    D(w) = K - w^2 (M + sum m_j B^T B) + i w C.
    """
    carrier = scene.machine.carrier()
    if carrier.gyroscopic is not None:
        raise InputError("machine.kind", f"is {scene.machine.kind!r}; exact jams hold for machines of platforms")
    mass, push = loaded_mass(scene), circular_loads(scene).unbalance() * carrier.port.T

    def at(k: Array) -> Array:
        w = k * omega
        stiffness = carrier.stiffness - w**2 * mass + 1j * w * carrier.damping
        return jax.vmap(lambda column: small_solve(stiffness, w**2 * column), in_axes=1, out_axes=1)(push.astype(complex))

    return jax.vmap(at)(jnp.asarray(orders, dtype=omega.dtype))


def _feedback(scene: Scene, grid: Grid, omega: Array) -> Array:
    """(np, np, M, M): the port's acceleration at the points, from the loads' point e at the points."""
    orders = jnp.asarray(grid.orders, dtype=omega.dtype)
    port = scene.machine.carrier().port
    answer = -jnp.einsum("k,ad,kdb->abk", (orders * omega) ** 2, port, receptance(scene, omega, grid.orders))
    by_distance = jnp.einsum("abk,dk->abd", answer.real, grid.cosine) - jnp.einsum("abk,dk->abd", answer.imag, grid.sine)
    return by_distance[:, :, grid.pairs]


class _Balance(NamedTuple):
    """The torques on the loads at the points: what is left over, per drag and load speed, and what its derivative needs."""

    left_over: Array
    scale: Array
    moving: Array
    pull: Array


def _balance(scene: Scene, grid: Grid, feedback: Array, lag: Array, omega: Array, speed: Array) -> _Balance:
    whole = body(scene)
    phi, rate = grid.theta + lag, omega * (1.0 + grid.first @ lag)
    point, moving = circle(scene, phi)
    acceleration = jnp.einsum("abij,bj->ai", feedback, point)
    vibration = whole.unbalance * jnp.sum(moving * acceleration, axis=0)
    torque = load_torque(scene, phi, rate, speed)
    inertia = whole.inertia * omega**2 * (grid.second @ lag)
    unit = whole.drag * omega
    largest = jnp.max(jnp.abs(inertia) + jnp.abs(torque) + jnp.abs(vibration))
    return _Balance(
        (inertia - torque + vibration) / unit,
        1.0 + jnp.abs(speed / omega) + largest / unit,
        moving,
        -whole.unbalance * jnp.sum(point * acceleration, axis=0) / unit,
    )


def _jacobian(scene: Scene, grid: Grid, feedback: Array, balance: _Balance, lag: Array, omega: Array, speed: Array) -> Array:
    """d left_over / d lag (M, M)."""
    whole = body(scene)
    unit = whole.drag * omega
    phi, rate = grid.theta + lag, omega * (1.0 + grid.first @ lag)
    ones = jnp.ones_like(lag)
    by_angle = jax.jvp(lambda p: load_torque(scene, p, rate, speed), (phi,), (ones,))[1] / unit
    by_rate = jax.jvp(lambda r: load_torque(scene, phi, r, speed), (rate,), (ones,))[1] / unit
    moving = balance.moving
    coupling = jnp.einsum("ai,abij,bj->ij", moving, feedback, moving) * (whole.unbalance / unit)
    return (
        whole.inertia * omega**2 / unit * grid.second
        + jnp.diag(balance.pull - by_angle)
        - (omega * by_rate)[:, None] * grid.first
        + coupling
    )


class Motion(NamedTuple):
    """A periodic motion on its grid: `lag` psi (M,) rad; `omega`, `rotor_speed` rad/s; `residual` what is left of the torque
    balance at the points, relative to the torques in it."""

    lag: Array
    omega: Array
    rotor_speed: Array
    residual: Array


def periodic_motion(
    scene: Scene, grid: Grid, given: Literal["omega", "rotor_speed"], value: Array, start: Array, lag: Array | None = None
) -> Motion:
    """The periodic motion psi(theta) of the collected loads, phi = theta + psi, theta = Omega t, with mean psi 0.

        I Omega^2 psi'' = torque(phi, Omega (1 + psi'), n) - S e'(phi) . a
        a_k = - k^2 Omega^2 B D(k Omega)^-1 B^T S k^2 Omega^2 e_k,      D(w) = K - w^2 (M + sum m_j B^T B) + i w C

    at the M points of `grid`, with the a_k and e_k the harmonics of the port's acceleration and of the loads' point. The
    unknowns are psi at the points and the one of Omega and n that is not `given`; `start` is where the latter starts from,
    `lag` where psi does (0 unless said otherwise). Newton's steps are shortened until they lessen the residual.

    Derivatives with respect to `value` and every number of the scene by the implicit function theorem.
    """

    def balance(lag: Array, x: Array, value: Array) -> tuple[Array, tuple[Array, _Balance]]:
        omega, speed = (value, x) if given == "omega" else (x, value)
        feedback = _feedback(scene, grid, omega) if fixed is None else fixed
        found = _balance(scene, grid, feedback, lag, omega, speed)
        return found.left_over, (feedback, found)

    def equations(y: Array) -> Array:
        return jnp.append(balance(y[:-1], y[-1], value)[0], jnp.mean(y[:-1]))

    fixed = _feedback(scene, grid, value) if given == "omega" else None
    m = grid.theta.shape[0]
    tiny = 1024.0 * jnp.finfo(value.dtype).eps

    def newton(_: object, y: Array) -> Array:
        def size(left_over: Array) -> Array:
            return jnp.sqrt(jnp.mean(left_over**2))

        def step(carry: tuple) -> tuple:
            count, lag, x, length, norm, _ = carry
            left_over, by_x, (feedback, now) = jax.jvp(
                lambda z: balance(lag, z, value), (x,), (jnp.ones_like(x),), has_aux=True
            )
            omega, speed = (value, x) if given == "omega" else (x, value)
            matrix = _pinned(_jacobian(scene, grid, feedback, now, lag, omega, speed), by_x)
            change = -jnp.linalg.solve(matrix, jnp.append(left_over, jnp.mean(lag)))
            # A lag changes by 1 rad at most in a step, a load speed by half of itself: beyond, the linear model says nothing.
            most = 1.0 / jnp.maximum(jnp.max(jnp.abs(change[:-1])), 1e-300)
            if given == "rotor_speed":
                most = jnp.minimum(most, 0.5 * jnp.abs(x / change[-1]))
            take = jnp.minimum(length, most)
            new_lag, new_x = lag + take * change[:-1], x + take * change[-1]
            new_left_over, (_, then) = balance(new_lag, new_x, value)
            new_norm = size(new_left_over)
            better = new_norm < norm
            residual = jnp.max(jnp.abs(new_left_over)) / then.scale
            settled = (better & (residual < tiny / 8.0)) | (~better & (norm < tiny * then.scale))
            return (
                count + 1,
                jnp.where(better, new_lag, lag),
                jnp.where(better, new_x, x),
                jnp.where(better, jnp.minimum(2.0 * length, 1.0), length / 4.0),
                jnp.where(better, new_norm, norm),
                settled | (length < 1e-4) | ~jnp.all(jnp.isfinite(change)),
            )

        first = size(balance(y[:-1], y[-1], value)[0])
        carry = (0, y[:-1], y[-1], jnp.ones_like(first), first, first == 0.0)
        carry = jax.lax.while_loop(lambda c: (c[0] < _STEPS) & ~c[-1], step, carry)
        return jnp.append(carry[1], carry[2])

    def linear(g, right: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(g)(jnp.zeros_like(right)), right)

    begin = jnp.append(jnp.zeros((m,), dtype=value.dtype) if lag is None else lag, start)
    y = jax.lax.custom_root(equations, jax.lax.stop_gradient(begin), newton, linear)
    left_over, (_, found) = balance(y[:-1], y[-1], value)
    omega, speed = (value, y[-1]) if given == "omega" else (y[-1], value)
    return Motion(y[:-1], omega, speed, jnp.max(jnp.abs(left_over)) / found.scale)


class Along(NamedTuple):
    """`slope` dn/dOmega of the branch; `speed_error`, relative, of the rotor speed at this load speed and `lag_error`, rad: an
    estimate of what the number of points leaves."""

    slope: Array
    speed_error: Array
    lag_error: Array


def along(scene: Scene, grid: Grid, motion: Motion) -> Along:
    """How the branch goes on from a periodic motion, and how good the motion is.

    The error is what one Newton step would change that sees the residual at twice as many points, with the highest
    harmonic of psi for the lag.
    """
    lag, omega, speed = motion.lag, motion.omega, motion.rotor_speed

    def left_over(w: Array, n: Array) -> tuple[Array, tuple[Array, _Balance]]:
        feedback = _feedback(scene, grid, w)
        found = _balance(scene, grid, feedback, lag, w, n)
        return found.left_over, (feedback, found)

    one, zero = jnp.ones_like(omega), jnp.zeros_like(omega)
    _, by_omega, (feedback, found) = jax.jvp(left_over, (omega, speed), (one, zero), has_aux=True)
    by_speed = jax.jvp(lambda n: _balance(scene, grid, feedback, lag, omega, n).left_over, (speed,), (one,))[1]
    matrix = _pinned(_jacobian(scene, grid, feedback, found, lag, omega, speed), by_speed)

    fine = grid_of(2 * grid.theta.shape[0], grid.symmetric)
    lag_k = _lag_harmonics(grid, lag)
    there = (jnp.exp(1j * fine.theta[:, None] * grid.lag_orders) @ lag_k).real
    between = _balance(scene, fine, _feedback(scene, fine, omega), there, omega, speed).left_over
    low = _lag_harmonics(fine, between)[: grid.lag_orders.shape[0]]
    seen = (jnp.exp(1j * grid.theta[:, None] * grid.lag_orders) @ low).real
    right = jnp.stack([-jnp.append(by_omega, 0.0), jnp.append(jax.lax.stop_gradient(seen), 0.0)], axis=1)
    answer = jnp.linalg.solve(matrix, right)
    return Along(
        answer[-1, 0],
        jnp.abs(answer[-1, 1] / speed),
        jnp.maximum(jnp.max(jnp.abs(answer[:-1, 1])), jnp.sqrt(lag_k[-1].real ** 2 + lag_k[-1].imag ** 2)),
    )


def _pinned(by_lag: Array, by_unknown: Array) -> Array:
    """The whole Jacobian: the equations' derivative by psi (M, M) and by the last unknown (M,), and the row mean psi = 0."""
    m = by_lag.shape[0]
    pin = jnp.append(jnp.full((m,), 1.0 / m), 0.0)
    return jnp.concatenate([jnp.concatenate([by_lag, by_unknown[:, None]], axis=1), pin[None, :]])


def _lag_harmonics(grid: Grid, values: Array) -> Array:
    m = grid.theta.shape[0]
    return (grid.lag_weights[:, None] / m * np.exp(-1j * grid.lag_orders[:, None] * grid.theta)) @ values


class Harmonics(NamedTuple):
    """Harmonics c_k of a periodic motion, signal = Re sum_k c_k exp(i k theta): `lag` (J,) rad; `displacement` (nd, K) m of the
    carrier, `acceleration` (np, K) m/s^2 of the port, `force` (nb, K) N on the bed."""

    lag: Array
    displacement: Array
    acceleration: Array
    force: Array


def harmonics_of(scene: Scene, grid: Grid, motion: Motion) -> Harmonics:
    """The harmonics of psi and of everything that the carrier does."""
    carrier = scene.machine.carrier()
    m = grid.theta.shape[0]
    orders = jnp.asarray(grid.orders, dtype=motion.omega.dtype)
    point, _ = circle(scene, grid.theta + motion.lag)
    point_k = (2.0 / m * point) @ np.exp(-1j * grid.theta[:, None] * grid.orders)
    displacement = jnp.einsum("kdp,pk->dk", receptance(scene, motion.omega, grid.orders), point_k)
    w = orders * motion.omega
    return Harmonics(
        _lag_harmonics(grid, motion.lag),
        displacement,
        -(carrier.port @ displacement) * w[None] ** 2,
        carrier.bed_stiffness @ displacement + 1j * (carrier.bed_damping @ displacement) * w[None],
    )
