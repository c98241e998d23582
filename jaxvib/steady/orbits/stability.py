"""Floquet multipliers of periodic jams.

Sizes of arrays: P orbits, G bodies of loads (1 if all loads are equal), nd coordinates, K harmonics, m angles.

Symbols: theta is the angle of the mean rotation of the loads, with the speed Omega; phi is the angle of a body, e(phi) its
point on the unit circle in the directions of the mount, and t = de/dphi. M, C, K and G are the matrices of the machine with its
loads. S, I and T are the unbalance, the moment of inertia and the torque of a body. B maps the coordinates to the displacement
of the mount.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.jammed_bodies import JammedBodies
from jaxvib.numerics import radau
from jaxvib.numerics.fourier import Grid
from jaxvib.numerics.linalg import eigenvalues, relative_to, small_solve
from jaxvib.numerics.loops import repeat
from jaxvib.ode.dopri8 import NODES, ROWS
from jaxvib.steady.orbits.solve import Harmonics, PeriodicSolution

_PHASE_PER_STEP = 0.7
"""Phase of the carrier's fastest oscillation in an explicit step, rad. With order 8 the error of the multipliers is then 1e-12
if the load speed Omega is equal to the frequency of this oscillation, and 1e-10 if it is three times as high."""

_GROWTH_ERROR = 5e-8
"""Twice the relative growth of an undamped oscillation in an explicit step of the phase 1 rad; it is proportional to the 10th
power of the phase."""

_ROUNDING_ERRORS = 1e3
"""Lower bound of the error of multipliers that is reported, in multiples of the machine epsilon."""

MAX_INTEGRATION_STEPS = 2**17
"""Maximum number of integration steps over the span of the collocation grid (a period, or half a period with half-turn
symmetry); beyond it no multipliers are computed. The fastest motion of the carrier is then 1.5e4 to 4e4 times as fast as the
loads, and an orbit would take seconds to hours."""

_STIFF_DECAY_RATIO = 3.0
"""Ratio of decay rate and fastest oscillation above which the implicit method is used. Explicit steps would have to resolve
the decay, and diverge above a ratio of about 7."""

# The last stage of the method is at the end of the step; its evaluation is the first one of the next step.
_NODES = np.concatenate([[0.0], NODES[:-1]])
_ROWS = np.pad(ROWS[:-1, : len(_NODES)], ((1, 0), (0, 0)))
_WEIGHTS = ROWS[-1]


class Floquet(NamedTuple):
    """Growth of small disturbances of periodic jams, with a trailing axis over the orbits.

    **Attributes**

    - `roots` (2 nd + 2 G - 1, P) complex: growth factors of disturbances that keep the loads of a body coincident, over the
      span of the collocation grid, without the trivial root of a shift in time. The span is a period, and the roots are the
      Floquet multipliers. If the motion has the half-turn symmetry, the span is half a period, the disturbance at its end is
      rotated by half a turn, and the multipliers are the squares of the roots
    - `inner` (2, P): growth factors of the distance of two coincident loads while nothing else is disturbed, over the same
      span; None for a single load
    - `trivial` (P,): the trivial root, which is 1 except for the error of the integration
    """

    roots: Array
    inner: Array | None
    trivial: Array


def decay_error(needed: int | Array, steps: int | Array, turn: float, *, implicit: bool) -> Array:
    """Return a bound of the relative growth or decay that the integration causes in an undamped oscillation of the carrier,
    over the span `turn`, rad, of the grid. `steps` is the number of steps, and `needed` the number that `steps_for` returns."""
    phase = ((radau.PHASE if implicit else _PHASE_PER_STEP) * needed - 2.0 * turn) / jnp.asarray(steps)
    return radau.decay_error(phase, steps) if implicit else _GROWTH_ERROR * phase**10 * steps


def multiplier_error(trivial: Array, decay_error: Array) -> Array:
    """Return the error of the moduli of multipliers near 1: the largest of the error of the `trivial` multiplier, which is
    exactly 1, the decay of an undamped oscillation by the integration, and rounding."""
    rounding = _ROUNDING_ERRORS * float(jnp.finfo(trivial.dtype).eps)
    return jnp.maximum(jnp.abs(trivial - 1.0), jnp.maximum(decay_error, rounding))


def _fastest_oscillation(model: JammedBodies, speed: Array) -> Array:
    """Return the rate of the carrier's fastest oscillation at the rotor's `speed`, rad/s."""
    linear, gyroscopic = model.linear, model.linear.mount.gyroscopic
    square, half = relative_to(linear.mass, linear.carrier.stiffness)
    fastest = jnp.sqrt(jnp.max(jnp.abs(jnp.linalg.eigvalsh(square, symmetrize_input=False))))
    return fastest if gyroscopic is None else fastest + speed * jnp.linalg.norm(half @ gyroscopic @ half.T)


def _damping_rate(model: JammedBodies) -> Array:
    """Return the fastest rate of decay by damping of the carrier, 1/s."""
    square, _ = relative_to(model.linear.mass, model.linear.carrier.damping)
    return jnp.max(jnp.linalg.eigvalsh(square, symmetrize_input=False))


def _drag_rate(model: JammedBodies, omega: Array, speed: Array) -> Array:
    """Return the fastest rate of decay by drag and friction of the loads at load speeds `omega`, 1/s.

        max_g(-T_rate / I)_g / (1 - mu sum_g S_g^2 / I_g),      mu the largest eigenvalue of B M^-1 B^T

    The denominator is the factor by which the motion of the carrier reduces the inertia of a body; T_rate is the derivative of
    the torque of the body with respect to its speed.
    """
    linear, mount = model.linear, model.linear.mount
    still = jnp.zeros((len(mount.axes), 1), linear.mass.dtype)

    def fastest(omega: Array, speed: Array) -> Array:
        one = jnp.ones((model.inertia.shape[0], 1), linear.mass.dtype)
        by_rate = model.torque_slopes(0.0 * one, omega * one, speed, still)[1]
        return jnp.max(-by_rate[:, 0] / model.inertia)

    accelerance = jnp.max(jnp.linalg.eigvalsh(mount.rows[0] @ small_solve(linear.mass, mount.rows[0].T)))
    share_of_inertia = 1.0 - accelerance * jnp.sum(model.unbalance**2 / model.inertia)
    return jnp.vectorize(fastest)(omega, speed) / share_of_inertia


def is_stiff(model: JammedBodies, omega: Array, speed: Array) -> Array:
    """Return True if multipliers at load speeds `omega` and the rotor's `speed` (rad/s) need the implicit method, because of
    the decay rates of loads and carrier."""
    decay = jnp.maximum(_damping_rate(model), _drag_rate(model, omega, speed))
    return decay > _STIFF_DECAY_RATIO * (_fastest_oscillation(model, speed) + 2.0 * omega)


def steps_for(model: JammedBodies, omega: Array, speed: Array, *, implicit: bool) -> Array:
    """Return the number of integration steps over the span of the grid at load speeds `omega` and the rotor's `speed`, rad/s.

    An `implicit` method is stable at any rate of decay; its steps follow the oscillation only.
    """
    turn, fastest = np.pi if model.half_turn else 2.0 * np.pi, _fastest_oscillation(model, speed)
    if implicit:
        return radau.steps_for(turn * (fastest / omega + 2.0))
    return jnp.ceil(turn * (jnp.maximum(fastest, _damping_rate(model)) / omega + 2.0) / _PHASE_PER_STEP).astype(int)


class _Coefficients(NamedTuple):
    """Coefficients of the linear equations at one angle.

    **Attributes** (s: share of each body in the total unbalance)

    - `moving` s t, its derivatives `moving1` and `moving2` with respect to theta, and `coupling`, s t minus the part of dry
      friction, (directions, G, P)
    - `by_angle` (T_phi + S e.a)/(I Omega^2) and `by_rate` T_rate/(I Omega), (G, P), with the symbols of `floquet`
    """

    moving: Array
    coupling: Array
    moving1: Array
    moving2: Array
    by_angle: Array
    by_rate: Array


class _Disturbances(NamedTuple):
    """Linear equations of small disturbances about periodic motions, see `floquet`; displacements in units of `length`.

    **Attributes**: M^-1 K, M^-1 C and M^-1 G as `stiffness`, `damping` and `gyroscopic`; `shift` M^-1 B^T sum_g S_g, `port` B,
    `accelerance` of the mount; `share` of each body of loads in the `total` unbalance; `lever` total/I of each;
    `omega` (P,) of the loads and `speed` (P,) of the rotor; `w` and `n`: the same numbers with the shape (1, 1, P).
    """

    model: JammedBodies
    stiffness: Array
    damping: Array
    gyroscopic: Array | None
    shift: Array
    port: Array
    accelerance: Array
    share: Array
    total: Array
    lever: Array
    length: Array
    omega: Array
    speed: Array
    w: Array
    n: Array

    @classmethod
    def about(cls, model: JammedBodies, motion: PeriodicSolution) -> _Disturbances:
        """Return the equations about the motions of a model."""
        carrier, mount, mass = model.linear.carrier, model.linear.mount, model.linear.mass
        nd = mass.shape[0]
        parts = [carrier.stiffness, carrier.damping, *([] if mount.gyroscopic is None else [mount.gyroscopic])]
        solved = small_solve(mass, jnp.concatenate([*parts, mount.rows[0].T], axis=1))
        stiffness, damping, *gyroscopic = (solved[:, k * nd : (k + 1) * nd] for k in range(len(parts)))
        total = jnp.sum(model.unbalance)
        share = model.unbalance / total
        shift = solved[:, len(parts) * nd :] * total
        length = jnp.max(jnp.abs(shift))
        shift = shift / length
        port = mount.rows[0] * length
        return cls(
            model=model,
            stiffness=stiffness,
            damping=damping,
            gyroscopic=gyroscopic[0] if gyroscopic else None,
            shift=shift,
            port=port,
            accelerance=port @ shift,
            share=share,
            total=total,
            lever=(total / model.inertia)[None, :, None, None],
            length=length,
            omega=motion.omega,
            speed=motion.rotor_speed,
            w=motion.omega[None, None],
            n=motion.rotor_speed[None, None],
        )

    def coefficients(self, grid: Grid, harmonics: Harmonics, theta: Array, waves: Array) -> _Coefficients:
        """Return the coefficients at angles theta (m,); `waves` (3, m, K): exp(i k theta), k = 0, 1, ..., and its
        derivatives."""
        model, omega = self.model, self.omega
        gap = 2 if grid.symmetric else 1
        of_deviation, of_motion = (slice(k[0], k[-1] + 1, gap) for k in (grid.deviation_orders, grid.orders))
        deviation, deviation1, deviation2 = _signals(harmonics.deviation, waves[..., of_deviation])
        phi, rate = theta[None, :, None] + deviation, 1.0 + deviation1
        point, moving = model.circle(phi)
        (acceleration,) = _signals(harmonics.acceleration, waves[:1, :, of_motion])
        slopes = jax.vmap(lambda p, r, w, n, a: model.torque_slopes(p, w * r, n, a), in_axes=-1, out_axes=-1)
        by_angle, by_rate, by_acceleration = slopes(phi, rate, omega, self.speed, acceleration)
        stiff = by_angle + model.unbalance[:, None, None] * jnp.sum(point * acceleration[:, None], axis=0)
        moving2 = -point * deviation2[None] - moving * rate[None] ** 2
        s = self.share[None, :, None, None]
        unit = model.inertia[:, None, None] * omega[None, None] ** 2
        by_rate = by_rate * omega[None, None] / unit
        coupling = s * moving
        coupling = coupling if by_acceleration is None else coupling - by_acceleration / self.total
        return _Coefficients(s * moving, coupling, -s * point * rate[None], s * moving2, stiff / unit, by_rate)

    def damping_acceleration(self, q1: Array) -> Array:
        """Return the acceleration of the carrier by damping and gyroscopic forces at the velocity q1."""
        acceleration = _times(self.damping, q1) / self.w
        return acceleration if self.gyroscopic is None else acceleration + self.n * _times(self.gyroscopic, q1) / self.w

    def whole_motion(self, c: _Coefficients, x: Array, x1: Array) -> Array:
        """Return second derivatives of carrier and bodies, from x and x1: Q and d of `floquet`, and their first derivatives."""
        nd = self.stiffness.shape[0]
        (shifted, d), (shifted1, d1) = ((part[:nd], part[nd:]) for part in (x, x1))
        t, t1, t2 = (v[:, :, None, :] for v in (c.moving, c.moving1, c.moving2))
        q = shifted - _times(self.shift, jnp.sum(t * d[None], axis=1))
        q1 = shifted1 - _times(self.shift, jnp.sum(t * d1[None] + t1 * d[None], axis=1))
        shifted2 = -self.damping_acceleration(q1) - _times(self.stiffness, q) / self.w**2
        driven = _times(self.port, shifted2) - _times(self.accelerance, jnp.sum(2.0 * t1 * d1[None] + t2 * d[None], axis=1))
        torque = c.by_rate[:, None] * d1 + c.by_angle[:, None] * d
        # Acceleration of the mount including the motion of the bodies: one equation for each direction.
        responses = self.lever * c.coupling[:, :, None]
        weight = jnp.sum(t[:, None] * responses[None], axis=2)
        factor = _times(self.accelerance, weight)
        acceleration = _small_solve(factor, driven - _times(self.accelerance, jnp.sum(t * torque[None], axis=1)))
        return jnp.concatenate([shifted2, torque - jnp.sum(responses * acceleration[:, None], axis=0)])

    @staticmethod
    def relative_motion(c: _Coefficients, x: Array, x1: Array) -> Array:
        """Return the second derivative of the angle between loads of one body, which does not disturb the carrier."""
        return c.by_rate[:, None] * x1 + c.by_angle[:, None] * x

    def along_orbit(self, grid: Grid, harmonics: Harmonics) -> Array:
        """Return the direction of a shift in time, (2 nd + 2 G, P): the derivative of the motion itself."""
        at, at1 = _signals(harmonics.displacement, _derivatives(grid.orders, 2, harmonics.displacement)) / self.length
        deviation, deviation1, deviation2 = _signals(
            harmonics.deviation, _derivatives(grid.deviation_orders, 3, harmonics.deviation)
        )
        _, moving = self.model.circle(deviation)
        turning = self.share[None, :, None, None] * moving * (1.0 + deviation1)[None]
        return jnp.concatenate([
            at1 + _times(self.shift, jnp.sum(turning, axis=1)),
            1.0 + deviation1,
            -self.damping_acceleration(at1) - _times(self.stiffness, at) / self.w**2,
            deviation2,
        ])[:, 0]  # fmt: skip


def floquet(
    model: JammedBodies,
    grid: Grid,
    motion: PeriodicSolution,
    harmonics: Harmonics,
    steps: int | Array,
    *,
    implicit: bool = False,
    max_steps: int | None = None,
) -> Floquet:
    """Compute Floquet multipliers of the full state about periodic motions by one integration of all linear equations.

    q is the disturbance of the coordinates, and d_g that of the angle of a body of loads. With ' = d/dtheta and
    Q = q + M^-1 B^T sum_g S_g t_g d_g:

        Q'' = - M^-1 (C + n G)/Omega q' - M^-1 K/Omega^2 q
        I_g Omega^2 d_g'' = T_rate Omega d_g' + (T_phi + S_g e.a) d_g - Omega^2 (S_g t_g - T_a).B q''

    T_phi, T_rate and T_a are the derivatives of T with respect to the angle and the speed of the body, and to the acceleration
    a of the mount, on which T depends if there is dry friction. phi, e, t, a and these derivatives are those of the periodic
    motion; the disturbance of a is Omega^2 B q''. Loads of one body that separate (sum d_j = 0) do not disturb the carrier:
    they obey the second equation without its last term. Loads that lie side by side are pressed together and do not separate.

    All orbits are integrated with equal steps of the same length by Dormand and Prince's method of order 8 or, if `implicit`,
    by `radau.transition`, which resolves any drag of the loads and any damping of the carrier.

    **Arguments**: `motion`, `harmonics` with a trailing axis over P orbits; `steps` a Python number or a scalar array, see
    `steps_for`; `max_steps`: limit of a traced number, with which derivatives exist in reverse mode.
    """
    nd, count = model.linear.mass.shape[0], model.inertia.shape[0]
    equations = _Disturbances.about(model, motion)
    turn = np.pi if model.half_turn else 2.0 * np.pi
    h = jnp.asarray(turn / steps, motion.omega.dtype)
    has_relative_motion = model.loads.alike and model.loads.count > 1 and model.loads.ball_radius is None
    fields: tuple[_Field, ...] = (equations.whole_motion,)
    sizes: tuple[int, ...] = (nd + count,)
    if has_relative_motion:
        fields, sizes = (*fields, equations.relative_motion), (*sizes, 1)
    transition = _implicit_transition if implicit else _explicit_transition
    integrate = functools.partial(_integrate, equations, grid, harmonics, h, steps, max_steps)
    whole, *relative = transition(equations, fields, sizes, h, integrate)
    flip: Any = np.tile(np.concatenate([np.full(nd, -1.0 if model.half_turn else 1.0), np.ones(count)]), 2)
    trivial, rest = jax.vmap(deflate, in_axes=-1)(flip[:, None, None] * whole, equations.along_orbit(grid, harmonics))
    roots = _eigenvalues(rest).T
    inner = _eigenvalues(jnp.moveaxis(relative[0], -1, 0)).T if relative else None
    return Floquet(roots, inner, trivial)


_Field: TypeAlias = Callable[[_Coefficients, Array, Array], Array]
"""Second derivatives (n, ..., P) of some coordinates, from their values and first derivatives."""

_Step: TypeAlias = Callable[[_Coefficients, tuple[Array, ...]], tuple[Array, ...]]
_Integrate: TypeAlias = Callable[[np.ndarray, Sequence[int], _Step], tuple[Array, ...]]
"""`_integrate` with all arguments but the last three."""


def _explicit_transition(
    equations: _Disturbances, fields: Sequence[_Field], sizes: Sequence[int], h: Array, integrate: _Integrate
) -> tuple[Array, ...]:
    """Return transition matrices (2 n, 2 n, P) over the span of the grid, one for each field, by explicit steps of length
    `h`."""
    dtype = equations.omega.dtype

    def step(at: _Coefficients, state: tuple[Array, ...]) -> tuple[Array, ...]:
        rows, weights = (jnp.asarray(x, dtype=dtype) for x in (_ROWS, _WEIGHTS))

        # A loop over the stages: if they are unrolled, the compiler recomputes every stage at each use.
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

    return integrate(_NODES, sizes, step)


def _implicit_transition(
    equations: _Disturbances, fields: Sequence[_Field], sizes: Sequence[int], h: Array, integrate: _Integrate
) -> tuple[Array, ...]:
    """Return the transition matrices of `_explicit_transition`, by implicit steps."""
    # One solve for all equations, because its program is as large as the rest of the step.
    total, orbits, dtype = sum(sizes), equations.omega.shape[0], equations.omega.dtype

    def step(at: _Coefficients, state: tuple[Array, ...]) -> tuple[Array, ...]:
        slopes = jnp.zeros((len(radau.NODES), total, 2, total, orbits), dtype)
        for field, size, begin in zip(fields, sizes, np.cumsum((0, *sizes)), strict=False):
            unit, here = _units(2 * size, equations), slice(begin, begin + size)
            own = jax.vmap(lambda c, field=field, unit=unit, k=size: field(c, unit[:k], unit[k:]))(at)
            slopes = slopes.at[:, here, :, here].set(own.reshape(-1, size, 2, size, orbits))
        each = slopes.reshape(len(radau.NODES), total, -1, orbits)
        over = jax.vmap(lambda a: radau.transition(a, h), in_axes=-1, out_axes=-1)(each)
        return (jnp.einsum("abp,bcp->acp", over, state[0]),)

    (end,) = integrate(radau.NODES, (total,), step)
    both = end.reshape(2, total, 2, total, orbits)
    parts = np.split(np.arange(total), np.cumsum(sizes)[:-1])
    return tuple(both[:, k][:, :, :, k].reshape(2 * k.size, 2 * k.size, orbits) for k in parts)


def _integrate(
    equations: _Disturbances,
    grid: Grid,
    harmonics: Harmonics,
    h: Array,
    steps: int | Array,
    max_steps: int | None,
    nodes: np.ndarray,
    sizes: Sequence[int],
    step: _Step,
) -> tuple[Array, ...]:
    """Return the state after `steps` steps. The initial state consists of unit matrices, with 2 n rows for each n of `sizes`.
    Each step uses the coefficients at its `nodes`, which are fractions of the step."""
    places = jnp.asarray(nodes, dtype=equations.omega.dtype)
    # exp(i k theta) is updated by a product in each step, because sines and cosines at every node took a quarter of the time.
    every = np.arange(max(grid.deviation_orders[-1], grid.orders[-1]) + 1)
    at_nodes, turning = _derivatives(every, 3, harmonics.deviation) * _wave(every, places * h), _wave(every, h[None])

    def whole_step(k: Array, carry: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        turned, state = carry
        found = equations.coefficients(grid, harmonics, (k + places) * h, at_nodes * turned)
        at = _Coefficients(*(jnp.moveaxis(part, -2, 0) for part in found))
        return turned * turning, step(at, state)

    begin = jnp.ones_like(turning), tuple(_units(2 * size, equations) for size in sizes)
    return repeat(whole_step, steps, begin, max_steps)[1]


def _units(size: int, equations: _Disturbances) -> Array:
    """Return unit matrices (size, size, P), one for each orbit."""
    omega = equations.omega
    return jnp.broadcast_to(jnp.eye(size, dtype=omega.dtype)[:, :, None], (size, size, omega.shape[0]))


def _wave(orders: np.ndarray, theta: Array) -> Array:
    """Return exp(i k theta) at angles theta (m,): (1, m, K)."""
    return jnp.exp(1j * np.asarray(orders, theta.dtype)[None, None] * theta[None, :, None])


def _derivatives(orders: np.ndarray, number: int, like: Array) -> Array:
    """Return the factors of exp(i k theta) in its derivatives of order 0, 1, ...: (number, 1, K), of the type of `like`."""
    return jnp.asarray((1j * orders) ** np.arange(number)[:, None, None], like.dtype)


def _signals(harmonics: Array, waves: Array) -> Array:
    """Return Re sum_k c_k exp(i k theta) and derivatives, (number, s, m, P), of s signals, from c (s, K, P) and waves
    (number, m, K)."""
    parts = jnp.concatenate([harmonics.real, harmonics.imag], -2)
    return jnp.einsum("dmk,skp->dsmp", jnp.concatenate([waves.real, -waves.imag], -1), parts)


def _times(matrix: Array, vectors: Array) -> Array:
    """Return the matrix (a, b) times (b, ..., P); for a small matrix as a sum, which the compiler can fuse."""
    if matrix.size > 16:
        return jnp.tensordot(matrix, vectors, 1)
    return jnp.sum(matrix.reshape(*matrix.shape, *[1] * (vectors.ndim - 1)) * vectors[None], axis=1)


def _small_solve(weight: Array, right: Array) -> Array:
    """Return the solution x (n, ...) of (1 - weight) x = right for n = 1 or 2, without a library call; weight (n, n, ...)."""
    a = np.eye(weight.shape[0]).reshape(*weight.shape[:2], *[1] * (weight.ndim - 2)) - weight
    if weight.shape[0] == 1:
        return right / a[0]
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return jnp.stack([a[1, 1] * right[0] - a[0, 1] * right[1], a[0, 0] * right[1] - a[1, 0] * right[0]]) / det[None]


def _eigenvalues(matrices: Array) -> Array:
    """Return eigenvalues (P, n) of matrices (P, n, n), one matrix after the other, because batched library calls may deadlock
    if several programs run in parallel (jaxlib 0.10)."""
    return eigenvalues(matrices) if matrices.shape[0] == 1 else jax.lax.map(eigenvalues, matrices)


def deflate(matrix: Array, known: Array) -> tuple[Array, Array]:
    """Return the eigenvalue of the eigenvector `known` of a matrix (n, n), and a matrix (n - 1, n - 1) with the other
    eigenvalues."""
    unit = known / jnp.linalg.norm(known)
    mirror = unit.at[0].add(jnp.where(unit[0] < 0.0, -1.0, 1.0))
    mirror = mirror / jnp.linalg.norm(mirror)
    turned = matrix - 2.0 * jnp.outer(mirror, mirror @ matrix)
    turned = turned - 2.0 * jnp.outer(turned @ mirror, mirror)
    return unit @ (matrix @ unit), turned[1:, 1:]
