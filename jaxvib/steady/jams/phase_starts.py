"""Where jams at unequal phases are solved from: load speeds, and phases there at which all loads need as much drag."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.numerics.linalg import damped_newton
from jaxvib.runtime.many import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.phases import Parts, influence_of, torques_at

__all__ = ["LOAD_SPEEDS", "load_speeds", "phases_near", "starts_of"]

LOAD_SPEEDS = 240
"""Load speeds at which phases are looked for, besides those near resonances."""

_FEW, _ROUNDS = 7, 6
"""Steps of Newton's method before those that have found their phases are left out, and how often."""

_SPEEDS, _CHUNK = 64, 256
"""So many speeds a program takes with all sets of phases, and so many speeds each with its own."""

_HALVINGS = 6
"""Of the stretch between two load speeds that a jam lies in, before Newton's method takes over."""


def starts_of(parts: Parts, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speeds (n,) and phases (n, count) from which jams are to be solved for, looked for from sets of `phases` (ns, count) and
    regular ones at each of many load speeds.

    Where a pattern, followed to the next load speed up or down, passes the multiple 1 there is a jam between the two, which is
    narrowed down by halving. Points whose own multiple is near 1 are starts too, and so are the mirror images of all: of two
    patterns that nearly are each other's image, one is often hidden by steeper slopes.
    """
    speeds, phases = load_speeds(parts), np.concatenate([phases, _regular(parts)])
    first = in_chunks(_SPEEDS, lambda w: _first_steps(parts, w, jnp.asarray(phases)), speeds)
    row = np.repeat(np.arange(speeds.size), len(phases))
    factor, angles, good = _gone_on(parts, speeds[row], *(x.reshape(-1, *x.shape[2:]) for x in first))
    if not good.any():
        return speeds[:1], phases[:1]
    row, size, angles = row[good], np.log(factor[good]), angles[good]
    digits = [1e4 * size[:, None], 1e3 * np.cos(angles), 1e3 * np.sin(angles)]
    kinds = np.concatenate([row[:, None], *(np.round(d).astype(int) for d in digits)], axis=1)
    # Of each row one number is compared, which is much faster: the odds that any two of 1e5 rows share theirs are 3e-10.
    mixed = kinds @ np.random.default_rng(0).integers(2**63, size=kinds.shape[1])
    once = np.sort(np.unique(mixed, return_index=True)[1])
    row, size, angles = row[once], size[once], angles[once]
    near = np.abs(size) < np.log(3.0)
    omega, turned_to = [speeds[row[near]]], [angles[near]]
    for side in (-1, 1):
        beside = speeds[np.clip(row + side, 0, speeds.size - 1)]
        there, _, found = _follow(parts, beside, angles)
        low, high, held = (x[found & (size * there < 0.0)] for x in (speeds[row], beside, np.arange(row.size)))
        at, sign = angles[held], np.sign(size[held])
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            there, turned, found = _follow(parts, middle, at)
            same = found & (there * sign > 0.0)
            low, high, at = np.where(same, middle, low), np.where(same, high, middle), np.where(same[:, None], turned, at)
        omega.append(low)
        turned_to.append(at)
    every = np.concatenate(turned_to)
    return np.tile(np.concatenate(omega), 2), np.concatenate([every, -every])


def _follow(parts: Parts, omega: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phases at each of some load speeds (n,) near its own (n, count), with the logarithm of the drag's multiple."""
    if omega.size == 0:
        return omega, phase, omega > 0.0
    found = in_chunks(_CHUNK, lambda w, a: _few_steps(parts, w, a), omega, phase)
    factor, angles, good = _gone_on(parts, omega, *found)
    return np.log(np.where(good, factor, 1.0)), angles, good


def _gone_on(
    parts: Parts, omega: np.ndarray, factor: np.ndarray, phase: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What Newton's method comes to from where its first steps left it, and whether that is a jam's: those that are not at
    their phases yet go on, ever fewer."""
    factor, phase, residual = (np.array(x) for x in (factor, phase, residual))
    eps = np.finfo(residual.dtype).eps
    for _ in range(_ROUNDS - 1):
        # Three quarters of the digits are asked for, since near a double solution a half leaves phases that are far from
        # either; where phases that satisfy the balance lie on a curve, half of the digits is what there is.
        left = np.flatnonzero(~(residual < eps**0.75))
        if left.size == 0:
            break
        again = in_chunks(_CHUNK, lambda w, a: _few_steps(parts, w, a), omega[left], phase[left])
        for whole, part in zip((factor, phase, residual), again, strict=True):
            whole[left] = part
    return factor, phase, (residual < eps**0.5) & (factor > 0.0)


@cached
def _few_steps(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array, Array]:
    return jax.vmap(lambda w, start: phases_near(parts, influence_of(parts, w)[0], w, start, _FEW))(omega, phase)


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


@cached
def _first_steps(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array, Array]:
    influences = jax.vmap(lambda w: influence_of(parts, w)[0])(omega)
    return jax.vmap(lambda w, a: jax.vmap(lambda start: phases_near(parts, a, w, start, _FEW))(phase))(omega, influences)


def phases_near(
    parts: Parts, influence: Array, omega: Array, start: Array, steps: int = _FEW * _ROUNDS
) -> tuple[Array, Array, Array]:
    """The multiple of the drag and the phases (count,) of a jam at a given load speed, to which so many steps of Newton's
    method lead from `start` (count,); how far the loads' multiples still differ, relative. A jam's multiple is positive.

    All loads must need the same multiple, - T_j / (b_j R_j^2 (n - w)): it is explicit, and the phases are all that is sought.
    """

    def needs(x: Array) -> Array:
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x])
        return -torques_at(parts, influence, omega, angles) / (parts.drag * (parts.speed - omega))

    scale = jnp.sum(jnp.abs(influence) * parts.unbalance[:, None] * parts.unbalance[None, :]) * omega**4 / jnp.min(parts.drag)
    scale = scale / jnp.abs(parts.speed - omega)

    def differ(x: Array) -> Array:
        each = needs(x) / scale
        return each[1:] - each[:-1]

    x = damped_newton(differ, start[1:] - start[0], steps) if start.shape[0] > 1 else start[1:]
    each = needs(x)
    return each[0], jnp.concatenate([jnp.zeros(1, x.dtype), x]), jnp.max(jnp.abs(each - each[0])) / scale
