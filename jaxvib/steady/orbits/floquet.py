"""Floquet multipliers of periodic jams."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.collected import CollectedModel
from jaxvib.numerics import radau
from jaxvib.numerics.fourier import Grid
from jaxvib.numerics.linalg import small_solve
from jaxvib.ode.dopri8 import NODES, ROWS
from jaxvib.steady.orbits.collocation import Harmonics, PeriodicSolution

__all__ = ["Floquet", "floquet", "is_stiff", "steps_for"]

_PHASE = 0.7
"""Phase of the carrier's fastest motion in an explicit step, rad; order 8 then leaves 1e-12 in the multipliers of loads as fast
as the carrier, and 1e-10 if they are three times as fast."""

_STIFF = 3.0
"""Decay so many times as fast as the fastest oscillation is left to the implicit method: explicit steps would have to resolve
it, and from about 15 times on they diverge."""

# The method's last stage is the end of the step, there to be evaluated for the next one.
_NODES = np.concatenate([[0.0], NODES[:-1]])
_ROWS = np.pad(ROWS[:-1, : len(_NODES)], ((1, 0), (0, 0)))
_WEIGHTS = ROWS[-1]


class Floquet(NamedTuple):
    """How small disturbances of a periodic jam grow, trailing axis over the orbits.

    **Attributes**: `roots` (2 nd + 2 G - 1, P) complex: growth over a turn of the grid, that is half a period followed by the
    half-turn where the motion has that symmetry (multipliers are their squares), else a period (they are the multipliers);
    the trivial one, a shift in time, is taken out. `inner` (2, P): the same for two loads that part while the others
    stay, None for a single load. `trivial` (P,): the trivial root, 1 but for the error of the integration.
    """

    roots: Array
    inner: Array | None
    trivial: Array


class _Rates(NamedTuple):
    """The fastest of the carrier's `oscillation` and of the linear equations' `decay`, of carrier and loads, rad/s and 1/s."""

    oscillation: Array
    damping: Array
    drag: Array


def _rates(model: CollectedModel, omega: Array, speed: Array) -> _Rates:
    """Rates of the linear equations about a jam at load speeds `omega` and the rotor's `speed`, rad/s.

    A body of loads decays by drag and friction with an inertia that the carrier lessens:

        max_g(-T_rate / I)_g / (1 - mu sum_g S_g^2 / I_g),      mu the largest eigenvalue of B M^-1 B^T
    """
    linear, carrier, mount = model.linear, model.linear.carrier, model.linear.mount
    half = jnp.linalg.inv(jnp.linalg.cholesky(linear.mass))
    oscillation = jnp.max(linear.modes()[0])
    damping = jnp.max(jnp.linalg.eigvalsh(half @ carrier.damping @ half.T))
    if mount.gyroscopic is not None:
        oscillation = oscillation + speed * jnp.linalg.norm(half @ mount.gyroscopic @ half.T)
    still = jnp.zeros((len(mount.axes), 1), linear.mass.dtype)

    def fastest(omega: Array, speed: Array) -> Array:
        one = jnp.ones((model.inertia.shape[0], 1), linear.mass.dtype)
        by_rate = model.torque_slopes(0.0 * one, omega * one, speed, still)[1]
        return jnp.max(-by_rate[:, 0] / model.inertia)

    mobility = jnp.max(jnp.linalg.eigvalsh(mount.rows[0] @ half.T @ half @ mount.rows[0].T))
    left = 1.0 - mobility * jnp.sum(model.unbalance**2 / model.inertia)
    return _Rates(oscillation, damping, jnp.vectorize(fastest)(omega, speed) / left)


def is_stiff(model: CollectedModel, omega: Array, speed: Array) -> Array:
    """True if loads or carrier decay so fast, at load speeds `omega` and the rotor's `speed` (rad/s), that multipliers need the
    implicit method."""
    rates = _rates(model, omega, speed)
    return jnp.maximum(rates.damping, rates.drag) > _STIFF * (rates.oscillation + 2.0 * omega)


def steps_for(model: CollectedModel, omega: Array, speed: Array, *, implicit: bool) -> Array:
    """Number of integration steps in a turn of the grid at load speeds `omega` and the rotor's `speed`, rad/s.

    Of an `implicit` method only what oscillates counts: it is stable at any rate of decay.
    """
    rates = _rates(model, omega, speed)
    turn = np.pi if model.half_turn else 2.0 * np.pi
    if implicit:
        return radau.steps_for(turn * (rates.oscillation / omega + 2.0))
    return jnp.ceil(turn * (jnp.maximum(rates.oscillation, rates.damping) / omega + 2.0) / _PHASE).astype(int)


class _Coefficients(NamedTuple):
    """The coefficients of the linear equations at one angle of the orbit: `moving` s e', `giving` the same less the share of
    dry friction, `moving1` and `moving2` derivatives of s e', (np, G, P); `by_angle`, `by_rate` of the torque, (G, P)."""

    moving: Array
    giving: Array
    moving1: Array
    moving2: Array
    by_angle: Array
    by_rate: Array


def floquet(
    model: CollectedModel,
    grid: Grid,
    motion: PeriodicSolution,
    harmonics: Harmonics,
    steps: int | Array,
    *,
    implicit: bool = False,
) -> Floquet:
    """Floquet multipliers of the full state about periodic motions, all linear equations integrated at once.

    With Q = q + M^-1 B^T sum_g S_g t_g d_g, t = e'(phi), d_g the disturbance of a body of loads and ' = d/dtheta:

        Q'' = - M^-1 (C + n G)/Omega q' - M^-1 K/Omega^2 q
        I_g Omega^2 d_g'' = T_rate Omega d_g' + (T_phi + S_g e.a) d_g - Omega^2 (S_g t_g - T_a).B q''

    T the torque on the body, which dry friction lets depend on the port's acceleration a = Omega^2 B q'' too;
    and for loads of one body that part from each other, sum d_j = 0, the carrier at rest: the second equation without its last
    term. Loads that lie side by side are pressed together, and do not part.
    Equal steps of the same length for all orbits, of Dormand and Prince's order 8, or `implicit` ones by `radau.transition`,
    which hold for loads with any drag and carriers with any damping.

    **Arguments**: `motion`, `harmonics` with a trailing axis over P orbits; `steps` a Python number (then reverse-mode
    derivatives exist) or a scalar array, see `steps_for`.
    """
    carrier, mount, mass = model.linear.carrier, model.linear.mount, model.linear.mass
    nd, count = mass.shape[0], model.inertia.shape[0]
    parts = [carrier.stiffness, carrier.damping, *([] if mount.gyroscopic is None else [mount.gyroscopic])]
    solved = small_solve(mass, jnp.concatenate([*parts, mount.rows[0].T], axis=1))
    stiffness, damping, *gyroscopic = (solved[:, k * nd : (k + 1) * nd] for k in range(len(parts)))
    total = jnp.sum(model.unbalance)
    share = model.unbalance / total
    shift = solved[:, len(parts) * nd :] * total
    length = jnp.max(jnp.abs(shift))
    shift = shift / length
    port = mount.rows[0] * length
    mobility = port @ shift
    # What a body of loads gives way with, per share of the unbalance.
    lever = (total / model.inertia)[None, :, None, None]
    omega, speed = motion.omega, motion.rotor_speed
    lanes, w, n = omega.shape[0], omega[None, None], speed[None, None]
    turn = np.pi if model.half_turn else 2.0 * np.pi
    h = jnp.asarray(turn / steps, omega.dtype)

    def coefficients(theta: Array, waves: Array) -> _Coefficients:
        deviation, deviation1, deviation2 = _signals(harmonics.deviation, waves[..., of_deviation])
        phi, rate = theta[None, :, None] + deviation, 1.0 + deviation1
        point, moving = model.circle(phi)
        (acceleration,) = _signals(harmonics.acceleration, waves[:1, :, of_motion])
        slopes = jax.vmap(lambda p, r, w, n, a: model.torque_slopes(p, w * r, n, a), in_axes=-1, out_axes=-1)
        by_angle, by_rate, by_acceleration = slopes(phi, rate, omega, speed, acceleration)
        stiff = by_angle + model.unbalance[:, None, None] * jnp.sum(point * acceleration[:, None], axis=0)
        moving2 = -point * deviation2[None] - moving * rate[None] ** 2
        s = share[None, :, None, None]
        unit = model.inertia[:, None, None] * omega[None, None] ** 2
        by_rate = by_rate * omega[None, None] / unit
        giving = s * moving
        giving = giving if by_acceleration is None else giving - by_acceleration / total
        return _Coefficients(s * moving, giving, -s * point * rate[None], s * moving2, stiff / unit, by_rate)

    def damped(q1: Array, w: Array, n: Array) -> Array:
        answer = _times(damping, q1) / w
        return answer + n * _times(gyroscopic[0], q1) / w if gyroscopic else answer

    def full(c: _Coefficients, x: Array, x1: Array) -> Array:
        (q, d), (q1, d1) = ((part[:nd], part[nd:]) for part in (x, x1))
        t, t1, t2 = (v[:, :, None, :] for v in (c.moving, c.moving1, c.moving2))
        below = q - _times(shift, jnp.sum(t * d[None], axis=1))
        below1 = q1 - _times(shift, jnp.sum(t * d1[None] + t1 * d[None], axis=1))
        q2 = -damped(below1, w, n) - _times(stiffness, below) / w**2
        pushed = _times(port, q2) - _times(mobility, jnp.sum(2.0 * t1 * d1[None] + t2 * d[None], axis=1))
        torque = c.by_rate[:, None] * d1 + c.by_angle[:, None] * d
        # The port's acceleration with the bodies giving way to it: an equation for each of its directions.
        answers = lever * c.giving[:, :, None]
        weight = jnp.sum(t[:, None] * answers[None], axis=2)
        acceleration = _small_solve(_times(mobility, weight), pushed - _times(mobility, jnp.sum(t * torque[None], axis=1)))
        return jnp.concatenate([q2, torque - jnp.sum(answers * acceleration[:, None], axis=0)])

    def apart(c: _Coefficients, x: Array, x1: Array) -> Array:
        return c.by_rate[:, None] * x1 + c.by_angle[:, None] * x

    def start(size: int) -> Array:
        return jnp.broadcast_to(jnp.eye(size, dtype=omega.dtype)[:, :, None], (size, size, lanes))

    loads = model.loads
    parting = loads.alike and loads.count > 1 and loads.ball_radius is None
    fields, sizes = ((full, apart), (nd + count, 1)) if parting else ((full,), (nd + count,))

    def explicit_step(at: _Coefficients, state: tuple[Array, ...]) -> tuple[Array, ...]:
        rows, weights = (jnp.asarray(x, dtype=omega.dtype) for x in (_ROWS, _WEIGHTS))

        # A loop over the stages: written out, the compiler computes every stage anew wherever it is used.
        def stage(rates: tuple[Array, ...], now: tuple[Array, Array, _Coefficients]) -> tuple[tuple[Array, ...], None]:
            i, row, c = now
            moved = (x + h * jnp.tensordot(row, y, 1) for x, y in zip(state, rates, strict=True))
            changes = (
                jnp.concatenate([x[size:], field(c, x[:size], x[size:])])
                for field, size, x in zip(fields, sizes, moved, strict=True)
            )
            put = jax.lax.dynamic_update_index_in_dim
            return tuple(put(rate, change, i, 0) for rate, change in zip(rates, changes, strict=True)), None

        rates = tuple(jnp.zeros((len(_NODES), *x.shape), dtype=x.dtype) for x in state)
        rates, _ = jax.lax.scan(stage, rates, (jnp.arange(len(_NODES)), rows, at))
        return tuple(x + h * jnp.tensordot(weights, rate, 1) for x, rate in zip(state, rates, strict=True))

    def implicit_step(at: _Coefficients, state: tuple[Array, ...]) -> tuple[Array, ...]:
        # One solve for all equations: its program is as large as the rest of the step.
        slopes = jnp.zeros((len(radau.NODES), sum(sizes), 2, sum(sizes), lanes), omega.dtype)
        for field, size, begin in zip(fields, sizes, np.cumsum((0, *sizes)), strict=False):
            unit, here = start(2 * size), slice(begin, begin + size)
            own = jax.vmap(lambda c, field=field, unit=unit, k=size: field(c, unit[:k], unit[k:]))(at)
            slopes = slopes.at[:, here, :, here].set(own.reshape(-1, size, 2, size, lanes))
        each = slopes.reshape(len(radau.NODES), sum(sizes), -1, lanes)
        over = jax.vmap(lambda a: radau.transition(a, h), in_axes=-1, out_axes=-1)(each)
        return (jnp.einsum("abp,bcp->acp", over, state[0]),)

    nodes = jnp.asarray(radau.NODES if implicit else _NODES, dtype=omega.dtype)
    # exp(i k theta) goes from step to step as a product: sines and cosines at every node took a quarter of the time.
    gap = 2 if grid.symmetric else 1
    of_deviation, of_motion = (slice(k[0], k[-1] + 1, gap) for k in (grid.deviation_orders, grid.orders))
    every = np.arange(max(grid.deviation_orders[-1], grid.orders[-1]) + 1)
    at_nodes, turning = _derivatives(every, 3, harmonics.deviation) * _wave(every, nodes * h), _wave(every, h[None])
    begin = jnp.ones_like(turning), tuple(start(2 * size) for size in ((sum(sizes),) if implicit else sizes))

    def step(k: Array, carry: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        turned, state = carry
        found = coefficients((k + nodes) * h, at_nodes * turned)
        at = _Coefficients(*(jnp.moveaxis(part, -2, 0) for part in found))
        return turned * turning, (implicit_step if implicit else explicit_step)(at, state)

    _, end = jax.lax.fori_loop(0, steps, step, begin)
    if implicit:
        both = end[0].reshape(2, sum(sizes), 2, sum(sizes), lanes)
        parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        end = tuple(both[:, k][:, :, :, k].reshape(2 * k.size, 2 * k.size, lanes) for k in parts)
    flip = np.tile(np.concatenate([np.full(nd, -1.0 if model.half_turn else 1.0), np.ones(count)]), 2)
    monodromy = flip[:, None, None] * end[0]

    # A shift in time: q' and phi' along the orbit itself.
    at, at1 = _signals(harmonics.displacement, _derivatives(grid.orders, 2, harmonics.displacement)) / length
    deviation, deviation1, deviation2 = _signals(
        harmonics.deviation, _derivatives(grid.deviation_orders, 3, harmonics.deviation)
    )
    _, moving = model.circle(deviation)
    along = jnp.concatenate([
        at1 + _times(shift, jnp.sum(share[None, :, None, None] * moving * (1.0 + deviation1)[None], axis=1)),
        1.0 + deviation1,
        -damped(at1, w, n) - _times(stiffness, at) / w**2,
        deviation2,
    ])[:, 0]  # fmt: skip
    trivial, rest = jax.vmap(_deflated, in_axes=-1)(monodromy, along)
    roots = _eigenvalues(rest).T
    inner = _eigenvalues(jnp.moveaxis(end[1], -1, 0)).T if len(end) > 1 else None
    return Floquet(roots, inner, trivial)


def _wave(orders: np.ndarray, theta: Array) -> Array:
    """exp(i k theta) at angles theta (n,): (1, n, K)."""
    return jnp.exp(1j * np.asarray(orders, theta.dtype)[None, None] * theta[None, :, None])


def _derivatives(orders: np.ndarray, number: int, like: Array) -> Array:
    """What makes so many derivatives of exp(i k theta), the 0th first: (number, 1, K), of the type of `like`."""
    return jnp.asarray((1j * orders) ** np.arange(number)[:, None, None], like.dtype)


def _signals(harmonics: Array, waves: Array) -> Array:
    """Re sum_k c_k exp(i k theta) and derivatives, from the waves' own (number, n, K); c (m, K, P) gives (number, m, n, P)."""
    parts = jnp.concatenate([harmonics.real, harmonics.imag], -2)
    return jnp.einsum("dnk,mkp->dmnp", jnp.concatenate([waves.real, -waves.imag], -1), parts)


def _times(matrix: Array, vectors: Array) -> Array:
    """Matrix (a, b) times (b, ..., P); where it is small as a sum, which melts into what surrounds it."""
    if matrix.size > 16:
        return jnp.tensordot(matrix, vectors, 1)
    return jnp.sum(matrix.reshape(*matrix.shape, *[1] * (vectors.ndim - 1)) * vectors[None], axis=1)


def _small_solve(weight: Array, right: Array) -> Array:
    """x (np, ...) of (1 - weight) x = right, np = 1 or 2 written out, weight (np, np, ...)."""
    a = np.eye(weight.shape[0]).reshape(*weight.shape[:2], *[1] * (weight.ndim - 2)) - weight
    if weight.shape[0] == 1:
        return right / a[0]
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return jnp.stack([a[1, 1] * right[0] - a[0, 1] * right[1], a[0, 0] * right[1] - a[1, 0] * right[0]]) / det[None]


def _eigenvalues(matrices: Array) -> Array:
    """Of matrices (P, n, n), (P, n). One after the other: library calls for batches may wait for each other for ever where
    several programs run side by side (jaxlib 0.10)."""
    return jnp.linalg.eigvals(matrices) if matrices.shape[0] == 1 else jax.lax.map(jnp.linalg.eigvals, matrices)


def _deflated(matrix: Array, known: Array) -> tuple[Array, Array]:
    """The eigenvalue that belongs to the eigenvector `known`, and a matrix that has the others."""
    unit = known / jnp.linalg.norm(known)
    mirror = unit.at[0].add(jnp.where(unit[0] < 0.0, -1.0, 1.0))
    mirror = mirror / jnp.linalg.norm(mirror)
    turned = matrix - 2.0 * jnp.outer(mirror, mirror @ matrix)
    turned = turned - 2.0 * jnp.outer(turned @ mirror, mirror)
    return unit @ (matrix @ unit), turned[1:, 1:]
