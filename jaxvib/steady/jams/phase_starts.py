"""Initial values of the search for jams at unequal phases: load speeds, and phases at which the torques of all loads would be
balanced if the drag of each load were multiplied by the same factor."""

from __future__ import annotations

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import estimated_frequencies
from jaxvib.equations.torque_balance import TorqueBalance, influence_of, torques_at
from jaxvib.errors import ComputationError
from jaxvib.numerics.linalg import magnitude, poles_of
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import damped_newton
from jaxvib.steady.jams.phases import solve_balance

LOAD_SPEEDS = 240
"""Number of load speeds at which phases are searched, besides those near resonances."""

_STEPS_PER_ROUND, _MAX_ROUNDS = 7, 6
"""Number of Newton steps in a round, at whose end converged phases are removed, and largest number of rounds."""

_SPEEDS_PER_PROGRAM, _PHASES_PER_PROGRAM = 400, 2048
"""Numbers of load speeds and of sets of phases in one call of the program."""

_PARTS_PER_CUT, _CUT_COUNT = 8, 2
"""Number of parts into which an interval of load speeds with a jam is divided, and number of divisions before Newton's method
starts."""


_STARTS_PER_PROGRAM = 256
"""Number of starts in one call of the program; typical scenes need a few hundred."""

_STARTS_OF_CLUSTERS, _MAX_DIVISIONS = 16, 64
"""Minimum number of random sets of phases for a division of equal loads into clusters, and largest number of divisions. If
there are more divisions, they are not searched separately, and every load has an independent phase."""


def search_clusters(balance: TorqueBalance, number: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds (n,) and phases (n, count) of solutions of the torque balance, from about `number` random sets of phases
    in total, or more if the loads have many divisions (see below).

        T_j = (w^4/2) S_j Im(e^{-i a_j} F_j),      F_j = sum_k S_k H_jk e^{i a_k}

    T_j is the mean torque of the vibration on load j, S_j the unbalance and a_j the phase of the load, w the load speed, and H
    are the influence coefficients (`influence_of`). F_j is the same for all equal loads. Equal loads also need the same torque;
    Im(e^{-i a_j} F_j) is therefore equal for them, and at most two phases a_j are possible. In every jam, each group of equal
    loads thus consists of one or two clusters, which are computed as one load each. The search covers all divisions of each
    group into two clusters, with two unknown phases per group, for any number of its loads. The same solution may occur several
    times.
    """
    divisions = _divisions(equal_loads(balance))
    each = max(number // len(divisions), min(number, _STARTS_OF_CLUSTERS))
    found = []
    for cluster in divisions:
        merged = _cluster_balance(balance, cluster)
        phases = rng.uniform(-np.pi, np.pi, (each, merged.unbalance.shape[0]))
        starts = starts_of(merged, phases)
        if balance.unbalance.size > 2:
            more = _at_resonances(balance, phases)
            starts = np.concatenate([starts[0], more[0]]), np.concatenate([starts[1], more[1]])
        omega, phase = in_chunks(_STARTS_PER_PROGRAM, lambda w, a, m=merged: _solve_balances(m, w, a), *starts)
        found.append((omega, phase[:, cluster]))
    omega, phase = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return omega, phase


@cached
def _solve_balances(balance: TorqueBalance, omega: Array, phase: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda w, a: solve_balance(balance, w, a, on_scalars=True))(omega, phase)


def equal_loads(balance: TorqueBalance) -> list[np.ndarray]:
    """Return the indices of the loads of each group of loads with equal parameters."""
    direction = np.asarray(balance.direction)
    rows = np.concatenate(
        [np.real(direction), np.imag(direction), np.stack([balance.unbalance, balance.drag, balance.averaged.inertia], 1)],
        axis=1,
    )
    _, which = np.unique(rows, axis=0, return_inverse=True)
    return [np.flatnonzero(which.ravel() == g) for g in range(int(np.max(which)) + 1)]


def _at_resonances(balance: TorqueBalance, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts at every natural frequency below the rotor speed, from each of the `phases`.

    Two clusters of equal size have a jam at the speed at which the phase lag of the carrier is exactly 90 degrees; no grid of
    load speeds contains this speed. For two loads this jam is left out: its speed does not depend on the drag, so that the
    diagram over the drag has no curve for it.
    """
    frequencies = np.asarray(estimated_frequencies(balance.model.scene))
    inside = frequencies[(frequencies > 0.0) & (frequencies < float(balance.speed))]
    return np.repeat(inside, len(phases)), np.tile(phases, (inside.size, 1))


def _divisions(groups: list[np.ndarray]) -> list[np.ndarray]:
    """Return the cluster number of each load, (count,), for each division of every group into two clusters."""
    count = sum(group.size for group in groups)
    sizes = [range(1, max(group.size // 2, 1) + 1) for group in groups]
    if np.prod([len(some) for some in sizes]) > _MAX_DIVISIONS:
        return [np.arange(count)]
    divisions = []
    for second in itertools.product(*sizes):
        cluster = np.empty(count, dtype=int)
        for group, size in zip(groups, second, strict=True):
            cluster[group] = group[0]
            cluster[group[group.size - size :]] = group[-1]
        divisions.append(np.unique(cluster, return_inverse=True)[1])
    return divisions


def _cluster_balance(balance: TorqueBalance, cluster: np.ndarray) -> TorqueBalance:
    """Return the balance of clusters of equal loads: each cluster is one load with the total unbalance and drag of its
    members."""
    first, many = np.unique(cluster, return_index=True, return_counts=True)[1:]
    averaged = balance.averaged
    scaled = [on_device(np.asarray(x)[first] * many) for x in (averaged.unbalance, averaged.drag, averaged.inertia)]
    levers = on_device(np.asarray(averaged.levers)[:, first])
    averaged = eqx.tree_at(lambda a: (a.unbalance, a.drag, a.inertia, a.levers), averaged, (*scaled, levers))
    direction = on_device(np.asarray(balance.direction)[first])
    if balance.model.modal is not None:
        residues = on_device(np.asarray(balance.model.modal.residues)[first][:, first])
        balance = eqx.tree_at(lambda b: b.model.modal.residues, balance, residues)
    motor_torque = on_device(np.asarray(balance.motor_torque)[first])
    return eqx.tree_at(lambda b: (b.averaged, b.direction, b.motor_torque), balance, (averaged, direction, motor_torque))


def starts_of(balance: TorqueBalance, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find speeds (n,) and phases (n, count) close to jams, from `phases` (sets, count) and regular sets.

    At many load speeds the equations are solved for the phases at which all loads need the same multiple of their drag. Each
    pattern is followed to the neighbouring load speeds. If this multiple crosses 1 between two speeds, a jam lies between, and
    the interval is narrowed down. Points whose multiple is near 1 are starts too. The mirror images of all starts are added:
    of two patterns that are nearly mirror images of each other, Newton's method often misses the one with steeper slopes.
    """
    speeds, at_speeds, row, factor, angles = search_phases(balance, phases)
    if not row.size:
        return speeds[:1], phases[:1]
    size = np.log(factor)
    # The angles are in the interval from -1 to 2 pi - 1 rad, because many phases are at 0 and pi, far from its ends.
    inside = angles[:, 1:] - 2.0 * np.pi * np.floor((angles[:, 1:] + 1.0) / (2.0 * np.pi))
    once = distinct_rows(np.concatenate([row[:, None], np.rint(1e4 * size[:, None]), np.rint(1e3 * inside)], axis=1))[0]
    row, size, angles = row[once], size[once], angles[once]
    near = np.abs(size) < np.log(3.0)

    source = np.tile(np.arange(row.size), 2)
    neighbour = np.clip(np.concatenate([row - 1, row + 1]), 0, speeds.size - 1)
    there, _, found = _follow_phases(balance, at_speeds, neighbour, angles[source])
    crossed = found & (size[source] * there < 0.0)
    low, high, source = speeds[row[source[crossed]]], speeds[neighbour[crossed]], source[crossed]
    at, sign = angles[source], np.sign(size[source])
    for _ in range(_CUT_COUNT if source.size else 0):
        # All intermediate points are computed at once, which for few jams takes no longer than one of them.
        share = np.arange(1, _PARTS_PER_CUT) / _PARTS_PER_CUT
        between = low[:, None] + share * (high - low)[:, None]
        each = _data_at_speeds(balance, between.ravel())
        there, turned, found = _follow_phases(balance, each, np.arange(between.size), np.repeat(at, _PARTS_PER_CUT - 1, axis=0))
        same = (found & (there * np.repeat(sign, _PARTS_PER_CUT - 1) > 0.0)).reshape(between.shape)
        cut = np.sum(np.logical_and.accumulate(same, axis=1), axis=1)
        index, ends = np.arange(source.size), np.concatenate([low[:, None], between, high[:, None]], axis=1)
        turned = np.concatenate([at[:, None], turned.reshape(*between.shape, -1)], axis=1)
        low, high, at = ends[index, cut], ends[index, cut + 1], turned[index, cut]
    every = np.concatenate([angles[near], at])
    return np.tile(np.concatenate([speeds[row[near]], low]), 2), np.concatenate([every, -every])


def search_phases(
    balance: TorqueBalance, phases: np.ndarray
) -> tuple[np.ndarray, SearchData, np.ndarray, np.ndarray, np.ndarray]:
    """Search at many load speeds, from `phases` (sets, count) and regular sets, for the phases at which all loads need the same
    multiple of their drag.

    **Returns** the load speeds, their data, and for each solution the index of its speed, the multiple, and the phases.
    """
    speeds, phases = load_speeds(balance), np.concatenate([phases, _regular_phases(balance)])
    at_speeds = _data_at_speeds(balance, speeds)
    row = np.repeat(np.arange(speeds.size), len(phases))
    factor, angles, good = _solve_phases(balance, at_speeds, row, np.tile(phases, (speeds.size, 1)))
    return speeds, at_speeds, row[good], factor[good], angles[good]


def distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of the first occurrence of each distinct row of integers (n, m), ascending, and for each row the position
    of its distinct row in this list, (n,). Fast comparison by hashes; two of 1e5 rows share a hash with a probability of
    3e-10."""
    hashes = rows.astype(int) @ np.random.default_rng(0).integers(2**63, size=rows.shape[1])
    order = np.argsort(hashes)
    begins = np.diff(hashes[order], prepend=hashes[order[:1]] - 1) != 0
    first = np.minimum.reduceat(order, np.flatnonzero(begins))
    which = np.empty(order.size, dtype=int)
    which[order] = np.argsort(np.argsort(first))[np.cumsum(begins) - 1]
    return np.sort(first), which


class SearchData(eqx.Module):
    """Data of the search for phases at a load speed `omega`, rad/s: `influence` (count, count), see `influence_of`, and the
    upper bound `most` of the multiple of the drag that a load can need. Several speeds have a leading axis."""

    omega: Array
    influence: Array
    most: Array


def search_data(balance: TorqueBalance, omega: Array) -> SearchData:
    """Return the data of the search at one load speed."""
    influence = influence_of(balance, omega)
    torque = jnp.sum(magnitude(influence) * balance.unbalance[:, None] * balance.unbalance[None, :]) * omega**4
    return SearchData(omega, influence, torque / (jnp.min(balance.drag) * jnp.abs(balance.speed - omega)))


@cached
def _data_at_each(balance: TorqueBalance, omega: Array) -> SearchData:
    return jax.vmap(search_data, in_axes=(None, 0))(balance, omega)


def _data_at_speeds(balance: TorqueBalance, omega: np.ndarray) -> SearchData:
    """Return data of the search at load speeds (n,), padded to whole chunks: one program is valid for any number of them."""
    filled = omega[np.minimum(np.arange(-(-omega.size // _SPEEDS_PER_PROGRAM) * _SPEEDS_PER_PROGRAM), omega.size - 1)]
    return on_device(in_chunks(_SPEEDS_PER_PROGRAM, lambda w: _data_at_each(balance, w), filled))


def _follow_phases(balance: TorqueBalance, at: SearchData, row: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the results of `_solve_phases` with the logarithm of the drag's multiple."""
    factor, angles, good = _solve_phases(balance, at, row, phase)
    return np.log(np.where(good, factor, 1.0)), angles, good


def _solve_phases(balance: TorqueBalance, at: SearchData, row: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, ...]:
    """Solve for phases from starts (n, count), each at the load speed with the index `row` (n,), in rounds of Newton steps;
    each round continues with the starts that have not converged.

    **Returns** the drag's multiple (n,), the phases, and True if they have converged and the multiple is positive.
    """
    factor, phase, residual = np.zeros(row.size), np.array(phase), np.full(row.size, np.inf)
    eps, left = float(np.finfo(phase.dtype).eps), np.arange(row.size)
    for _ in range(_MAX_ROUNDS):
        found = in_chunks(_PHASES_PER_PROGRAM, _newton_round, row[left], phase[left], shared=(balance, at))
        factor[left], phase[left], residual[left] = found
        # The residual must be below eps^(3/4): near a double solution, phases far from both solutions can have a residual of
        # eps^(1/2). At the end eps^(1/2) is accepted, because solutions that form a curve reach no smaller residual.
        left = left[~(residual[left] < eps**0.75)]
        if left.size == 0:
            break
    return factor, phase, (residual < eps**0.5) & (factor > 0.0)


@cached
def _newton_round(row: Array, phase: Array, balance: TorqueBalance, at: SearchData) -> tuple[Array, Array, Array]:
    each = jax.tree.map(lambda values: values[row], at)
    return jax.vmap(lambda one, start: phases_near(balance, one, start, _STEPS_PER_ROUND))(each, phase)


def load_speeds(balance: TorqueBalance) -> np.ndarray:
    """Return load speeds below the rotor speed, dense near the carrier's resonances at this rotor speed.

    **Raises** `ComputationError` with the status "lost_digits" if no floating-point number lies between 0 and the rotor speed.
    """
    model, speed = balance.model, float(balance.speed)
    matrices = model.mass, model.damping(balance.speed), model.carrier.stiffness
    poles = poles_of(*matrices) if model.modal is None else np.asarray(model.modal.poles)
    turning = np.abs(np.imag(poles))
    centres = np.unique(turning[turning > 0.0])
    offsets = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 30)])
    crowd = [w * (1.0 + side * offsets) for w in centres for side in (-1.0, 1.0)]
    top = speed * (1.0 - np.geomspace(1e-6, 0.1, 12))
    speeds = np.unique(np.concatenate([np.linspace(0.02, 0.98, LOAD_SPEEDS) * speed, top, *crowd]))
    inside = speeds[(speeds > 1e-3 * speed) & (speeds < speed)]
    if not inside.size:
        raise ComputationError("lost_digits", f"no number is a load speed below the rotor speed, {speed:.3g} rad/s")
    return inside


def _regular_phases(balance: TorqueBalance) -> np.ndarray:
    """Return regular sets of phases (ns, count): all equal, and every division of the loads into two opposite groups. Of more
    than six loads, only the first five change their group."""
    n = balance.unbalance.shape[0]
    return np.array([[np.pi * ((k >> j) & 1) for j in range(n)] for k in range(2 ** min(n - 1, 5))])


def phases_near(
    balance: TorqueBalance, at: SearchData, start: Array, steps: int = _STEPS_PER_ROUND * _MAX_ROUNDS
) -> tuple[Array, Array, Array]:
    """Solve for the phases (count,) of a jam at a given load speed by `steps` Newton steps from `start` (count,).

    All loads must need the same multiple of their drag, - T_j / (b_j R_j^2 (n - w)). The multiple is an explicit function of
    the phases, which are therefore the only unknowns.

    **Returns** the multiple, positive in a jam; the phases; and the remaining relative difference between the multiples.
    """

    def differences(x: Array, parameters: tuple[Array, Array, SearchData]) -> tuple[Array, Array]:
        unbalance, most, at = parameters
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x])
        torque = torques_at(unbalance, at.influence, at.omega, jax.lax.complex(jnp.cos(angles), jnp.sin(angles)))
        each = -torque / most
        return each[1:] - each[:-1], each

    parameters = balance.unbalance, balance.drag * (balance.speed - at.omega) * at.most, at
    x = start[1:] - start[0]
    x, each = damped_newton(differences, x, parameters, steps) if x.size else (x, differences(x, parameters)[1])
    return each[0] * at.most, jnp.concatenate([jnp.zeros(1, x.dtype), x]), jnp.max(jnp.abs(each - each[0]))
