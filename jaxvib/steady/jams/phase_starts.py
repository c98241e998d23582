"""Starts of the search for jams at unequal phases: load speeds, and phases at which all loads need the same drag."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.linalg import magnitude
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import damped_newton
from jaxvib.steady.jams.phases import Parts, influence_of, torques_at

__all__ = ["LOAD_SPEEDS", "AtSpeed", "at_speed", "distinct_rows", "load_speeds", "phases_near", "starts_of"]

LOAD_SPEEDS = 240
"""Load speeds at which phases are looked for, besides those near resonances."""

_FEW, _ROUNDS = 7, 6
"""Steps of Newton's method before those that have found their phases are left out, and how often."""

_SPEEDS, _CHUNK = 400, 2048
"""Numbers of load speeds and of sets of phases in one program."""

_PARTS, _CUTS = 8, 2
"""Into so many parts the stretch between two load speeds that a jam lies in is cut, and how often, before Newton's method takes
over."""


def starts_of(parts: Parts, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speeds (n,) and phases (n, count) from which jams are to be solved for, looked for from sets of `phases` (ns, count) and
    regular ones at each of many load speeds.

    Where a pattern, followed to the next load speed up or down, passes the multiple 1 there is a jam between the two, which is
    narrowed down. Points whose own multiple is near 1 are starts too, and so are the mirror images of all: of two
    patterns that nearly are each other's image, one is often hidden by steeper slopes.
    """
    speeds, phases = load_speeds(parts), np.concatenate([phases, _regular(parts)])
    at_speeds = _at_speeds(parts, speeds)
    row = np.repeat(np.arange(speeds.size), len(phases))
    factor, angles, good = _settled(parts, at_speeds, row, np.tile(phases, (speeds.size, 1)))
    if not good.any():
        return speeds[:1], phases[:1]
    row, size, angles = row[good], np.log(factor[good]), angles[good]
    # Within the turn that begins at -1 rad: at 0 and pi, where many phases are, it has no ends.
    inside = angles[:, 1:] - 2.0 * np.pi * np.floor((angles[:, 1:] + 1.0) / (2.0 * np.pi))
    once = distinct_rows(np.concatenate([row[:, None], np.rint(1e4 * size[:, None]), np.rint(1e3 * inside)], axis=1))[0]
    row, size, angles = row[once], size[once], angles[once]
    near = np.abs(size) < np.log(3.0)

    held = np.tile(np.arange(row.size), 2)
    beside = np.clip(np.concatenate([row - 1, row + 1]), 0, speeds.size - 1)
    there, _, found = _followed(parts, at_speeds, beside, angles[held])
    passed = found & (size[held] * there < 0.0)
    low, high, held = speeds[row[held[passed]]], speeds[beside[passed]], held[passed]
    at, sign = angles[held], np.sign(size[held])
    for _ in range(_CUTS if held.size else 0):
        # At all places between at once: for few jams that takes no longer than at one of them.
        share = np.arange(1, _PARTS) / _PARTS
        between = low[:, None] + share * (high - low)[:, None]
        each = _at_speeds(parts, between.ravel())
        there, turned, found = _followed(parts, each, np.arange(between.size), np.repeat(at, _PARTS - 1, axis=0))
        same = (found & (there * np.repeat(sign, _PARTS - 1) > 0.0)).reshape(between.shape)
        cut = np.sum(np.logical_and.accumulate(same, axis=1), axis=1)
        lane, ends = np.arange(held.size), np.concatenate([low[:, None], between, high[:, None]], axis=1)
        turned = np.concatenate([at[:, None], turned.reshape(*between.shape, -1)], axis=1)
        low, high, at = ends[lane, cut], ends[lane, cut + 1], turned[lane, cut]
    every = np.concatenate([angles[near], at])
    return np.tile(np.concatenate([speeds[row[near]], low]), 2), np.concatenate([every, -every])


def distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the rows of whole numbers (n, m) that differ, each where it stands first, ascending; and for each row (n,)
    which of them it is.

    Of each row one number is compared, which is much faster: the odds that any two of 1e5 rows share theirs are 3e-10.
    """
    mixed = rows.astype(int) @ np.random.default_rng(0).integers(2**63, size=rows.shape[1])
    order = np.argsort(mixed)
    begins = np.diff(mixed[order], prepend=mixed[order[:1]] - 1) != 0
    first = np.minimum.reduceat(order, np.flatnonzero(begins))
    which = np.empty(order.size, dtype=int)
    which[order] = np.argsort(np.argsort(first))[np.cumsum(begins) - 1]
    return np.sort(first), which


class AtSpeed(eqx.Module):
    """Data of the search for phases at a load speed `omega`, rad/s: the `influence` (count, count) of `influence_of`, and
    `most`, the multiple of the drag that a load could need at most. One, or a leading axis over many."""

    omega: Array
    influence: Array
    most: Array


def at_speed(parts: Parts, omega: Array) -> AtSpeed:
    """See `AtSpeed`."""
    influence = influence_of(parts, omega)[0]
    torque = jnp.sum(magnitude(influence) * parts.unbalance[:, None] * parts.unbalance[None, :]) * omega**4
    return AtSpeed(omega, influence, torque / (jnp.min(parts.drag) * jnp.abs(parts.speed - omega)))


@cached
def _at_each(parts: Parts, omega: Array) -> AtSpeed:
    return jax.vmap(at_speed, in_axes=(None, 0))(parts, omega)


def _at_speeds(parts: Parts, omega: np.ndarray) -> AtSpeed:
    """At load speeds (n,), filled up to whole chunks: another number of them needs no other program."""
    filled = omega[np.minimum(np.arange(-(-omega.size // _SPEEDS) * _SPEEDS), omega.size - 1)]
    return on_device(in_chunks(_SPEEDS, lambda w: _at_each(parts, w), filled))


def _followed(parts: Parts, at: AtSpeed, row: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, ...]:
    """`_settled`, with the logarithm of the drag's multiple."""
    factor, angles, good = _settled(parts, at, row, phase)
    return np.log(np.where(good, factor, 1.0)), angles, good


def _settled(parts: Parts, at: AtSpeed, row: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, ...]:
    """The drag's multiple (n,) and the phases that Newton's method comes to from phases (n, count), each at the load
    speed that `row` (n,) says, and whether these are a jam's. Those that are not at their phases after some steps go
    on, ever fewer."""
    factor, phase, residual = np.zeros(row.size), np.array(phase), np.full(row.size, np.inf)
    eps, left = float(np.finfo(phase.dtype).eps), np.arange(row.size)
    for _ in range(_ROUNDS):
        found = in_chunks(_CHUNK, _few_steps, row[left], phase[left], shared=(parts, at))
        factor[left], phase[left], residual[left] = found
        # Three quarters of the digits are asked for, since near a double solution a half leaves phases that are far from
        # either; where phases that satisfy the balance lie on a curve, half of the digits is what there is.
        left = left[~(residual[left] < eps**0.75)]
        if left.size == 0:
            break
    return factor, phase, (residual < eps**0.5) & (factor > 0.0)


@cached
def _few_steps(row: Array, phase: Array, parts: Parts, at: AtSpeed) -> tuple[Array, Array, Array]:
    each = jax.tree.map(lambda values: values[row], at)
    return jax.vmap(lambda one, start: phases_near(parts, one, start, _FEW))(each, phase)


def load_speeds(parts: Parts) -> np.ndarray:
    """Load speeds below the rotor's, closer together near the carrier's resonances at this rotor speed."""
    mass, nd = np.asarray(parts.model.mass), parts.model.mass.shape[0]
    stiffness, damping = np.asarray(parts.model.carrier.stiffness), np.asarray(parts.model.damping(parts.speed))
    flow = np.linalg.solve(mass, np.concatenate([-stiffness, -damping], axis=1))
    poles = np.linalg.eigvals(np.concatenate([np.eye(nd, 2 * nd, nd), flow]))
    speed = float(parts.speed)
    centres = np.unique(np.abs(poles[np.abs(poles.imag) > 0.0].imag))
    apart = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 30)])
    crowd = [w * (1.0 + side * apart) for w in centres for side in (-1.0, 1.0)]
    top = speed * (1.0 - np.geomspace(1e-6, 0.1, 12))
    speeds = np.unique(np.concatenate([np.linspace(0.02, 0.98, LOAD_SPEEDS) * speed, top, *crowd]))
    return speeds[(speeds > 1e-3 * speed) & (speeds < speed)]


def _regular(parts: Parts) -> np.ndarray:
    """Regular sets of phases (ns, count): together, and every split into two opposite groups."""
    n = parts.unbalance.shape[0]
    splits = range(2 ** min(n - 1, 5))
    return np.array([[np.pi * ((k >> j) & 1) if j < min(n - 1, 5) else 0.0 for j in range(n)] for k in splits])


def phases_near(parts: Parts, at: AtSpeed, start: Array, steps: int = _FEW * _ROUNDS) -> tuple[Array, Array, Array]:
    """The multiple of the drag and the phases (count,) of a jam at a given load speed, to which so many steps of Newton's
    method lead from `start` (count,); how far the loads' multiples still differ, relative. A jam's multiple is positive.

    All loads must need the same multiple, - T_j / (b_j R_j^2 (n - w)): it is explicit, and the phases are all that is sought.
    """

    def differ(x: Array, given: tuple[Parts, AtSpeed]) -> tuple[Array, Array]:
        parts, at = given
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x])
        torque = torques_at(parts, at.influence, at.omega, jax.lax.complex(jnp.cos(angles), jnp.sin(angles)))
        each = -torque / (parts.drag * (parts.speed - at.omega) * at.most)
        return each[1:] - each[:-1], each

    x = start[1:] - start[0]
    x, each = damped_newton(differ, x, (parts, at), steps) if x.size else (x, differ(x, (parts, at))[1])
    return each[0] * at.most, jnp.concatenate([jnp.zeros(1, x.dtype), x]), jnp.max(jnp.abs(each - each[0]))
