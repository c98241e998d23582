"""Search for all synchronous regimes: starts, solutions of the torque balance, and distinct ones among them."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import estimated_frequencies
from jaxvib.equations.torque_balance import TorqueBalance, balance_residuals, influence_of, motion_of, unknowns_of
from jaxvib.numerics.linalg import eliminate
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import solve_torques
from jaxvib.steady.regimes.local import slopes_of, vibration_scale
from jaxvib.steady.regimes.symmetry import Exchange, distinct_regimes, exchanges_of
from jaxvib.units.known import require_finite

_EVEN_SPEEDS, _NEAR_SPEEDS = 200, 40
"""Numbers of speeds at equal distances, and on each side of a resonance or of a drive's working speed."""

MAX_COMPLETE = 6
"""Largest number of rotating masses for which the search finds all regimes. The number of regimes about doubles with each
further mass."""

_PHASES_PER_UNKNOWN, _MAX_REGULAR_SETS = 24, 64
"""Number of random sets of phases divided by the square of the number of unknown phases, and largest number of sets of phases
that are multiples of half a turn."""

_SETS_AT_ONCE = 64
"""Number of sets of phases whose torques are computed in one operation, which limits the memory."""

_RELAXATIONS, _RELAXATION_TIME, _RELAXATION_GROWTH = 80, 0.3, 1.15
"""Number of steps that approach a stable regime, size of the first one, and ratio of the sizes of two steps."""

_STARTS_PER_PROGRAM = 256
"""Number of starts in one program."""

_MAX_ROUNDS = 3
"""Largest number of rounds of the search. Rounds after the first start from phases that are related to those of known
regimes."""

_ITERATIONS = 60
"""Maximum number of steps of Newton's method."""


def all_regimes(balance: TorqueBalance) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds (n,) rad/s and phases (n, count) rad of all distinct regimes.

    1. The sum of all torques is an explicit function of the speed for given phases. Every root of this sum, for regular and
    random sets of phases, is a start of Newton's method for the speed and all phases
    2. Further starts are the phases of the solutions, exchanged between masses, mirrored, or with one phase shifted by half a
    turn
    3. Regimes that differ by a common shift of all phases or by an exchange of equal masses are one regime. Regimes of one
    speed whose phases can change without a change of torques belong to a family, of which one member is kept

    For more than `MAX_COMPLETE` masses the starts first approach stable regimes, see `relax`, and step 2 is left out.
    """
    count, speed = balance.unbalance.size, np.asarray(balance.speed)
    if balance.is_prescribed.all():
        return np.asarray(motion_of(balance, jnp.zeros(0, speed.dtype))[0])[None], np.zeros((1, count), speed.dtype)
    exchanges, tolerance = exchanges_in(balance), tolerances(speed.dtype)
    sets, speeds = sets_of_phases(balance.is_prescribed, speed.dtype), _speeds(balance)
    known = np.zeros(0, speed.dtype), np.zeros((0, count), speed.dtype), np.zeros(0, int)
    for _ in range(_MAX_ROUNDS):
        *solved, good = in_chunks(_STARTS_PER_PROGRAM, _solved, *_starts(balance, speeds, sets), shared=(balance,))
        omega, phases, neutral = (np.concatenate([old, new[good]]) for old, new in zip(known, solved, strict=True))
        before = known[0].size
        kept = _one_of_each_family(omega, neutral, tolerance[0])
        kept = kept[distinct_regimes(omega[kept], phases[kept], exchanges, tolerance, int(np.sum(kept < before)))]
        known = omega[kept], phases[kept], neutral[kept]
        grown = kept[kept >= before]
        if grown.size == 0 or count == 1 or count > MAX_COMPLETE:
            break
        sets = _related_sets(phases[grown], balance.is_prescribed)
    return known[:2]


def _one_of_each_family(omega: np.ndarray, neutral: np.ndarray, tolerance: float) -> np.ndarray:
    """Return indices of isolated regimes and of one member of each family, with the fewest neutral directions.

    At some members of a family more phases can change than at others, for example if two pairs of exciters are in antiphase.
    """
    kept: list[int] = []
    for k in sorted(np.flatnonzero(neutral), key=lambda k: neutral[k]):
        if not any(abs(omega[i] - omega[k]) <= tolerance * omega[k] for i in kept):
            kept.append(int(k))
    return np.sort(np.concatenate([np.flatnonzero(neutral == 0), np.asarray(kept, dtype=int)]))


def tolerances(dtype: np.dtype) -> tuple[float, float]:
    """Return the differences of speed (relative) and of phase (rad) below which two regimes count as one."""
    eps = float(np.finfo(dtype).eps)
    return eps**0.4, eps**0.33


def exchanges_in(balance: TorqueBalance) -> list[Exchange]:
    """Return the exchanges of masses that leave the torque balance unchanged, see `exchanges_of`."""
    speeds = float(balance.speed) * np.array([0.31, 0.57, 0.83, 0.99])
    influence, torque = map(np.asarray, _at_speeds(balance, on_device(speeds.astype(balance.unbalance.dtype))))
    with np.errstate(over="ignore", invalid="ignore"):
        largest = influence * (np.max(np.asarray(balance.unbalance)) ** 2 * speeds**4)[:, None, None]
    require_finite("torques of the vibration", largest)
    numbers = [balance.unbalance, balance.averaged.inertia, balance.is_prescribed, *torque]
    return exchanges_of(influence, np.stack([np.nan_to_num(np.asarray(x, float)) for x in numbers], axis=1))


@cached
def _at_speeds(balance: TorqueBalance, speeds: Array) -> tuple[Array, Array]:
    """Return influence coefficients (n, count, count) and driving torques (n, count) at speeds (n,)."""
    return jax.vmap(lambda w: (influence_of(balance, w), balance.driving_torque(w)))(speeds)


@cached
def _total_torques(phases: Array, balance: TorqueBalance, speeds: Array) -> Array:
    """Return the sum of all torques, (sets, n) N m, for sets of phases (sets, count) at speeds (n,)."""
    influence, torque = _at_speeds(balance, speeds)
    unbalances = balance.unbalance[None, :] * jnp.exp(1j * phases)
    products = unbalances.conj()[:, :, None] * unbalances[:, None, :]
    braking = jnp.einsum("aik,gik->ag", products, influence, precision="highest").imag
    return jnp.sum(torque, axis=1)[None, :] + braking * (speeds**4 / 2.0)[None, :]


def _speeds(balance: TorqueBalance) -> np.ndarray:
    """Return speeds up to 1.02 times the largest working speed. They are dense near resonances and near the working speeds of
    the drives. Above the largest working speed there is no balance, because drives and vibration both brake.

    The largest speed is repeated, so that the number of speeds, and with it the compiled program, is always the same.
    """
    drives = np.array([float(drive.speed) for drive in balance.averaged.drives])
    top = drives.max()
    resonances = np.asarray(estimated_frequencies(balance.model.scene), float)
    centres = np.concatenate([drives, resonances[(resonances > 0.0) & (resonances < 1.2 * top)]])
    distance = np.concatenate([[0.0], np.geomspace(1e-7, 0.3, _NEAR_SPEEDS)])
    near = [w * (1.0 + side * distance) for w in centres for side in (-1.0, 1.0)]
    all_speeds = np.concatenate([np.linspace(0.005, 1.01, _EVEN_SPEEDS) * top, *near])
    speeds = np.unique(all_speeds[all_speeds < 1.02 * top])
    return np.pad(speeds, (0, all_speeds.size - speeds.size), constant_values=1.02 * top).astype(balance.unbalance.dtype)


def sets_of_phases(prescribed: np.ndarray, dtype: np.dtype, per_unknown: int = _PHASES_PER_UNKNOWN) -> np.ndarray:
    """Return regular and random sets of phases (n, count); those of masses with prescribed speed are 0.

    The number of random sets is `per_unknown` times the square of the number of unknown phases, and not larger than that for
    `MAX_COMPLETE` masses. A single unknown phase has `per_unknown` evenly spaced values instead of random ones.
    """
    free = np.flatnonzero(~prescribed) if prescribed.any() else np.arange(1, prescribed.size)
    n = free.size
    even = np.linspace(-np.pi, np.pi, per_unknown, endpoint=False)[:, None] if n == 1 else np.zeros((0, n))
    random_count = per_unknown * min(n, MAX_COMPLETE - 1) ** 2 if n > 1 else 0
    random = np.random.default_rng(0).uniform(-np.pi, np.pi, (random_count, n))
    sets = np.concatenate([_regular_sets(n), even, random])
    phases = np.zeros((len(sets), prescribed.size), dtype)
    phases[:, free] = sets
    return phases


def _regular_sets(n: int) -> np.ndarray:
    """Return sets (sets, n) of phases that are multiples of half a turn, or spread evenly."""
    halves = np.pi * (np.arange(min(2**n, _MAX_REGULAR_SETS))[:, None] >> np.arange(n) & 1)
    evenly_spread = 2.0 * np.pi / (n + 1) * np.arange(1, n + 1)[:, None] * np.arange(1, n + 1)
    return np.concatenate([halves, evenly_spread])


def _starts(balance: TorqueBalance, speeds: np.ndarray, sets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds (n,) and phases (n, count) at which the sum of all torques passes 0, one for each root.

    If the sum nearly touches 0 at one of the given speeds, it has two roots near this speed, or none. Newton's method then
    starts from both neighbouring speeds.
    """
    if balance.is_prescribed.any():
        return np.full(len(sets), np.asarray(balance.speed)), sets
    total = in_chunks(_SETS_AT_ONCE, _total_torques, sets, shared=(balance, on_device(speeds)))
    sign = np.sign(total)  # products of large torques overflow
    place, passed = np.nonzero(sign[:, :-1] * sign[:, 1:] <= 0.0)
    low, high = total[place, passed], total[place, passed + 1]
    with np.errstate(over="ignore"):
        share = low / np.where(low == high, 1.0, low - high)
    roots = speeds[passed] + share * (speeds[passed + 1] - speeds[passed])
    touched, middle = _nearly_touching(total)
    starts = np.concatenate([roots, speeds[middle - 1], speeds[middle + 1]])
    return starts.astype(speeds.dtype), sets[np.concatenate([place, touched, touched])]


def _nearly_touching(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of local minima of |values| (n, points) without a change of sign. Both neighbours of such a point have
    the same sign, and the larger of their absolute values is at least twice that of the point."""
    left, size, right = (np.abs(x) for x in (values[:, :-2], values[:, 1:-1], values[:, 2:]))
    sign = np.sign(values)
    same = (sign[:, :-2] * sign[:, 1:-1] > 0.0) & (sign[:, 1:-1] * sign[:, 2:] > 0.0)
    row, point = np.nonzero(same & (size <= np.minimum(left, right)) & (size <= 0.5 * np.maximum(left, right)))
    return row, point + 1


def _related_sets(phases: np.ndarray, prescribed: np.ndarray) -> np.ndarray:
    """Return sets of phases that follow from those of regimes (n, count) by exchanges, mirroring and half turns."""
    count = phases.shape[1]
    swaps = [np.arange(count)]
    for i, k in itertools.combinations(range(count), 2):
        order = np.arange(count)
        order[[i, k]] = k, i
        swaps.append(order)
    swapped = [sign * phases[:, order] for order in swaps for sign in (1.0, -1.0)]
    turned = [phases + np.pi * (np.arange(count) == k) for k in range(count)]
    return np.where(prescribed, 0.0, np.concatenate([*swapped, *turned])).astype(phases.dtype)


@cached
def _solved(omega: Array, phases: Array, balance: TorqueBalance) -> tuple[Array, Array, Array, Array]:
    """Return `solve_near` for starts: speeds (n,) and phases (n, count)."""
    return jax.vmap(lambda w, phase: solve_near(w, phase, balance))(omega, phases)


def solve_near(omega: Array, phase: Array, balance: TorqueBalance) -> tuple[Array, Array, Array, Array]:
    """Return speed, phases, number of neutral directions, and True if the start leads to a solution."""
    start = relax(unknowns_of(balance, omega, phase), balance)
    x = solve_torques(start, balance, _ITERATIONS)
    w, angles = motion_of(balance, x)
    good = is_balanced(balance, x)
    neutral = slopes_of(jnp.where(good, x, start), balance).neutral
    return w, jnp.arctan2(jnp.sin(angles), jnp.cos(angles)), neutral, good


def relax(x: Array, balance: TorqueBalance) -> Array:
    """Return unknowns near a regime of more than `MAX_COMPLETE` masses that is stable according to the quasi-static criterion.

        Omega' = mean of r,     alpha_k' - alpha_0' = r_k - r_0,     r_i = (L_i + V_i)/(largest possible V_i)

    L_i is the driving torque and V_i the vibrational torque of mass i.

    Steps of the implicit Euler method with growing sizes first follow this slow motion and then become those of Newton's
    method. Newton's method alone leads from most starts to unstable regimes if there are many masses.
    """
    if balance.unbalance.size <= MAX_COMPLETE:
        return x
    n, free = x.size, np.flatnonzero(~balance.is_prescribed)
    mix: Any = np.eye(n, dtype=x.dtype)
    if free.size == balance.is_prescribed.size:
        mix[:, 0], mix[0] = -1.0, 1.0 / n

    def rates(x: Array) -> Array:
        scale = vibration_scale(balance, jax.lax.stop_gradient(motion_of(balance, x)[0]))
        return mix @ (balance_residuals(x, balance) * (balance.torque_scale / scale)[free])

    def step(k: int, x: Array) -> Array:
        size = _RELAXATION_TIME * _RELAXATION_GROWTH**k
        matrix = jnp.eye(n, dtype=x.dtype) / size - jax.jacfwd(rates)(x)
        return x + jnp.clip(eliminate(matrix, rates(x)), -0.5, 0.5)

    return jax.lax.fori_loop(0, _RELAXATIONS, step, x)


def is_balanced(balance: TorqueBalance, x: Array) -> Array:
    """Return True if the unknowns solve the balance up to rounding of the largest vibrational torques at their speed."""
    free = np.flatnonzero(~balance.is_prescribed)
    w, _ = motion_of(balance, x)
    eps = jnp.finfo(x.dtype).eps
    allowed = eps**0.5 * vibration_scale(balance, w) + 64.0 * eps * balance.torque_scale
    wrong = jnp.abs(balance_residuals(x, balance)) * balance.torque_scale[free]
    return jnp.all(wrong < allowed[free]) & (w > 0.0) & (w < 1.01 * balance.speed)
