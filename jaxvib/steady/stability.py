"""Floquet multipliers: whether a periodic jam lasts."""

from __future__ import annotations

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.machine.scene import Scene
from jaxvib.steady.collocation import Grid, Harmonics, Motion, body, circle, has_half_turn, load_torque
from jaxvib.steady.response import loaded_mass, natural_frequencies

__all__ = ["Floquet", "floquet", "steps_for"]

_PHASE = 0.4
"""What the fastest part of the carrier turns through in a step, rad; order 8 then leaves about 1e-10 in the multipliers."""

_TABLEAU = diffrax.Dopri8.tableau


class Floquet(NamedTuple):
    """How small disturbances of a periodic jam grow, trailing axis over the orbits.

    **Attributes**: `roots` (2 nd + 1, P) complex: growth over a turn of the grid, that is half a period followed by the
    half-turn where the motion has that symmetry (multipliers are their squares), else a period (they are the multipliers);
    the trivial one, a shift in time, is taken out. `inner` (2, P): the same for two loads that part while the others
    stay, None for a single load. `trivial` (P,): the trivial root, 1 but for the error of the integration.
    """

    roots: Array
    inner: Array | None
    trivial: Array


def steps_for(scene: Scene, omega: Array) -> Array:
    """How many integration steps a turn of the grid asks for at the load speed `omega` (rad/s)."""
    carrier = scene.machine.carrier()
    half = jnp.linalg.inv(jnp.linalg.cholesky(loaded_mass(scene)))
    decay = jnp.max(jnp.linalg.eigvalsh(half @ carrier.damping @ half.T))
    fastest = jnp.maximum(jnp.max(natural_frequencies(scene)), decay)
    turn = np.pi if has_half_turn(scene) else 2.0 * np.pi
    return jnp.ceil(turn * (fastest / omega + 2.0) / _PHASE).astype(int)


class _Coefficients(NamedTuple):
    """What of the orbit enters the linear equations at one angle; (np, P) and (1, 1, P)."""

    moving: Array
    moving1: Array
    moving2: Array
    by_angle: Array
    by_rate: Array


def floquet(scene: Scene, grid: Grid, motion: Motion, harmonics: Harmonics, steps: int | Array) -> Floquet:
    """Floquet multipliers of the full state about periodic motions, all linear equations integrated at once.

    With Q = q + P t d, P = M^-1 B^T S, t = e'(phi), d the disturbance of the loads and ' = d/dtheta:

        Q'' = - M^-1 C/Omega q' - M^-1 K/Omega^2 q,                                          q = Q - P t d
        I Omega^2 d'' = T_rate Omega d' + (T_phi + S e.a) d - S Omega^2 t.B q''

    and for loads that part from each other, sum d_j = 0, the carrier at rest: the second equation without its last term.
    Fixed steps of Dormand and Prince's order 8, of the same length for all orbits.

    **Arguments**: `motion`, `harmonics` with a trailing axis over P orbits; `steps` a Python number (then reverse-mode
    derivatives exist) or a scalar array.
    """
    carrier, whole = scene.machine.carrier(), body(scene)
    mass = loaded_mass(scene)
    nd = mass.shape[0]
    inverse = jnp.linalg.inv(mass)
    stiffness, damping = inverse @ carrier.stiffness, inverse @ carrier.damping
    shift = inverse @ carrier.port.T * whole.unbalance
    length = jnp.max(jnp.abs(shift))
    shift = shift / length
    port = carrier.port * length
    mobility = port @ shift
    omega, speed = motion.omega, motion.rotor_speed
    lanes, w = omega.shape[0], omega[None, None]
    turn = np.pi if has_half_turn(scene) else 2.0 * np.pi
    h = turn / steps

    def coefficients(theta: Array) -> _Coefficients:
        lag, lag1, lag2 = (_signal(grid.lag_orders, harmonics.lag, theta, k) for k in range(3))
        phi, rate = theta + lag, 1.0 + lag1
        point, moving = circle(scene, phi)
        acceleration = _signal(grid.orders, harmonics.acceleration, theta, 0)
        ones = jnp.ones_like(phi)
        each = jax.vmap(lambda p, r, w, n: load_torque(scene, p[None], w * r[None], n)[0])
        by_angle = jax.jvp(lambda p: each(p, rate, omega, speed), (phi,), (ones,))[1]
        by_rate = jax.jvp(lambda r: each(phi, r, omega, speed), (rate,), (ones,))[1]
        stiff = by_angle + whole.unbalance * jnp.sum(point * acceleration, axis=0)
        rate, lag2 = rate[None], lag2[None]
        moving2 = -point * lag2 - moving * rate**2
        return _Coefficients(moving, -point * rate, moving2, (stiff / omega**2)[None, None], (by_rate / omega**2)[None, None])

    def full(c: _Coefficients, x: Array) -> Array:
        q, q1, d, d1 = x[:nd], x[nd : 2 * nd], x[None, 2 * nd], x[None, 2 * nd + 1]
        t, t1, t2 = (v[:, None, :] for v in (c.moving, c.moving1, c.moving2))
        below = q - _times(shift, t * d)
        below1 = q1 - _times(shift, t * d1 + t1 * d)
        q2 = -_times(damping, below1) / w - _times(stiffness, below) / w**2
        pushed = _times(port, q2) - _times(mobility, 2.0 * t1 * d1 + t2 * d)
        inertia = whole.inertia - whole.unbalance * jnp.sum(t * _times(mobility, t), axis=0, keepdims=True)
        torque = c.by_rate * d1 + c.by_angle * d - whole.unbalance * jnp.sum(t * pushed, axis=0, keepdims=True)
        return jnp.concatenate([q1, q2, d1, torque / inertia])

    def apart(c: _Coefficients, x: Array) -> Array:
        d, d1 = x[None, 0], x[None, 1]
        return jnp.concatenate([d1, (c.by_rate * d1 + c.by_angle * d) / whole.inertia])

    def start(n: int) -> Array:
        return jnp.broadcast_to(jnp.eye(n, dtype=omega.dtype)[:, :, None], (n, n, lanes))

    fields = (full, apart) if scene.loads.count > 1 else (full,)
    begin = tuple(start(n) for n in (2 * nd + 2, 2)[: len(fields)])

    def step(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        rates: list[list[Array]] = [[] for _ in fields]
        nodes = [0.0, *_TABLEAU.c]
        rows = [(), *_TABLEAU.a_lower]
        # The last row of the tableau is the step itself, evaluated again for the next one only.
        for node, row in list(zip(nodes, rows, strict=True))[:-1]:
            c = coefficients((k + node) * h)
            for field, x, made in zip(fields, state, rates, strict=True):
                moved = x + h * sum(a * r for a, r in zip(row, made, strict=True) if a != 0.0) if made else x
                made.append(field(c, moved))
        return tuple(
            x + h * sum(b * r for b, r in zip(_TABLEAU.b_sol, made, strict=False) if b != 0.0)
            for x, made in zip(state, rates, strict=True)
        )

    end = jax.lax.fori_loop(0, steps, step, begin)
    flip = np.concatenate([np.full(2 * nd, -1.0 if has_half_turn(scene) else 1.0), [1.0, 1.0]])
    monodromy = flip[:, None, None] * end[0]

    # A shift in time: q' and phi' along the orbit itself.
    at = [_signal(grid.orders, harmonics.displacement, 0.0, k) / length for k in range(2)]
    lag1, lag2 = (_signal(grid.lag_orders, harmonics.lag, 0.0, k) for k in (1, 2))
    _, moving = circle(scene, _signal(grid.lag_orders, harmonics.lag, 0.0, 0))
    along = jnp.concatenate([
        at[1] + _times(shift, (moving * (1.0 + lag1)[None])[:, None])[:, 0],
        (-_times(damping, at[1][:, None]) / w - _times(stiffness, at[0][:, None]) / w**2)[:, 0],
        (1.0 + lag1)[None],
        lag2[None],
    ])  # fmt: skip
    trivial, rest = jax.vmap(_deflated, in_axes=-1)(monodromy, along)
    roots = jnp.linalg.eigvals(rest).T
    inner = jnp.linalg.eigvals(jnp.moveaxis(end[1], -1, 0)).T if len(end) > 1 else None
    return Floquet(roots, inner, trivial)


def _signal(orders: np.ndarray, harmonics: Array, theta: Array | float, derivative: int) -> Array:
    """A derivative of Re sum_k c_k exp(i k theta) at one angle; c (..., K, P)."""
    k = jnp.asarray(orders, dtype=harmonics.real.dtype)
    wave = (1j * k) ** derivative * jnp.exp(1j * k * theta)
    return jnp.tensordot(wave.real, harmonics.real, (0, -2)) - jnp.tensordot(wave.imag, harmonics.imag, (0, -2))


def _times(matrix: Array, vectors: Array) -> Array:
    """Matrix (a, b) times (b, columns, P); written out where it is small, so that it melts into what surrounds it."""
    a, b = matrix.shape
    if a * b > 16:
        return jnp.tensordot(matrix, vectors, 1)
    return jnp.stack([sum(matrix[i, k] * vectors[k] for k in range(b)) for i in range(a)])


def _deflated(matrix: Array, known: Array) -> tuple[Array, Array]:
    """The eigenvalue that belongs to the eigenvector `known`, and a matrix that has the others."""
    unit = known / jnp.linalg.norm(known)
    mirror = unit.at[0].add(jnp.where(unit[0] < 0.0, -1.0, 1.0))
    mirror = mirror / jnp.linalg.norm(mirror)
    turned = matrix - 2.0 * jnp.outer(mirror, mirror @ matrix)
    turned = turned - 2.0 * jnp.outer(turned @ mirror, mirror)
    return unit @ (matrix @ unit), turned[1:, 1:]
