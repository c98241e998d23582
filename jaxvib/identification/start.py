"""Start of an identification: a fit of the steady amplitudes of the machine to the amplitudes of the records.

In a run-up the machine does not reach its steady amplitudes, but their peaks over speed lie near the peaks of the record. The
whole records are then fitted twice: from the resulting values, and from the first values, those of the scene. The better fit is
used.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from jaxvib.equations.linear import linear_model, rotating_direction
from jaxvib.identification.problem import Problem
from jaxvib.identification.response import Samples, Unknowns, sensor_rows
from jaxvib.machine.scene import Scene
from jaxvib.runtime.programs import cached

_MAX_SEGMENTS = 128
"""Largest number of segments of a run. A segment has whole turns and gives one amplitude of each channel."""

_PRIOR_WEIGHT = 0.05
"""Weight of the change x of an unknown from its first value, relative to the weight of the logarithm of an amplitude."""


def amplitudes(
    readings: np.ndarray, mask: np.ndarray, angle: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for N segments of a run, the rotor speeds (N,), rad/s, the amplitudes (N, C) of the vibrations of C channels at
    the rotor speed, and the weights (N, C) of these amplitudes, between 0 and 1.

    The readings of each segment of whole turns are fitted by c + a cos(angle) + b sin(angle). The weight of an amplitude is
    small if the amplitude is not above its standard error.

    **Arguments**: `readings` (n, C); `mask` (n, C): True for readings that count; `angle` (n,) of the rotor, rad; `step`, s.

    >>> angle = np.linspace(0.0, 300.0, 20000)
    >>> speed, size, weight = amplitudes(2.0 * np.cos(angle)[:, None], np.ones((20000, 1), bool), angle, 1e-3)
    >>> bool(np.allclose(size, 2.0)), bool(np.all(weight > 0.99)), len(speed) == _MAX_SEGMENTS
    (True, True, False)
    """
    turns = np.abs(angle - angle[0]) / (2.0 * np.pi)
    turns_of_segment = max(1.0, np.ceil(turns[-1] / _MAX_SEGMENTS))
    cuts = np.searchsorted(turns, np.arange(0.0, turns[-1], turns_of_segment))
    speeds, sizes, weights = [], [], []
    for begin, end in itertools.pairwise(cuts):
        if end - begin < 8:
            continue
        part = slice(begin, end)
        basis = np.stack([np.ones(end - begin), np.cos(angle[part]), np.sin(angle[part])], axis=1)
        size, weight = [], []
        for values, counts in zip(readings[part].T, mask[part].T, strict=True):
            if np.count_nonzero(counts) < 8:
                size.append(0.0)
                weight.append(0.0)
                continue
            found, *_ = np.linalg.lstsq(basis[counts], values[counts], rcond=None)
            variance = float(np.var(values[counts] - basis[counts] @ found)) / np.count_nonzero(counts)
            size.append(float(np.hypot(found[1], found[2])))
            weight.append(size[-1] ** 2 / (size[-1] ** 2 + 10.0 * variance + 1e-300))
        speeds.append((angle[end - 1] - angle[begin]) / (step * (end - 1 - begin)))
        sizes.append(size)
        weights.append(weight)
    return np.abs(np.array(speeds)), np.array(sizes), np.array(weights)


def _steady_amplitudes(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, speeds: Array) -> Array:
    """Return the amplitudes (N, C) of the steady readings at the rotor `speeds` (N,), per unit of the unbalance."""
    scene_of_run = samples.scene(unknowns.scene(scene, x))
    model = linear_model(scene_of_run)
    mount, exciter = model.mounts[0], scene_of_run.exciters[0]
    direction = mount.rotor_rows().T @ rotating_direction(mount, exciter.direction)
    rows = sensor_rows(scene_of_run, model.carrier, samples.channels)

    def at(w: Array) -> Array:
        displacement = jnp.linalg.solve(model.dynamic_stiffness(w), w**2 * direction)
        return jnp.abs((rows[:, 0] + 1j * w * rows[:, 1] - w**2 * rows[:, 2]) @ displacement)

    return jax.vmap(at)(speeds)


@cached
def _fit_amplitudes(
    unknowns: Unknowns, runs: tuple[Samples, ...], scene: Scene, data: tuple[tuple[Array, Array, Array], ...]
) -> Array:
    """Return the unknowns (p,) for which the steady amplitudes over speed agree best with those of the runs. A common factor of
    all amplitudes of a run is free.

    **Arguments**: `data`: for each run, speeds, amplitudes and weights, see `amplitudes`.
    """

    def residual(x: Array, _: None) -> Array:
        parts = [_PRIOR_WEIGHT * x]
        for samples, (speeds, sizes, weights) in zip(runs, data, strict=True):
            steady = _steady_amplitudes(unknowns, samples, scene, x, speeds)
            log_ratio = jnp.log(jnp.maximum(sizes, 1e-300)) - jnp.log(steady)
            mean = jnp.sum(weights * log_ratio) / jnp.sum(weights)
            parts.append((jnp.sqrt(weights) * jnp.where(weights > 0.0, log_ratio - mean, 0.0)).ravel())
        return jnp.concatenate(parts)

    solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-4)
    start = jnp.zeros(unknowns.count)
    return optx.least_squares(residual, solver, start, options={"jac": "fwd"}, max_steps=64, throw=False).value


def fit_amplitudes(problem: Problem) -> np.ndarray:
    """Fit the steady amplitudes of the machine to those of the runs, and return x (p,), from which a fit can begin.

    In four cases x is 0, that is, the unknowns have the values of the scene: for several unbalances, without unknown parameters
    of the scene, for runs with too few turns, and if the fit fails.
    """
    zero = np.zeros(problem.unknowns.count)
    if len(problem.unbalances) > 1 or not len(problem.unknowns.first):
        return zero
    data = []
    for samples, raw, mask, angle in zip(problem.runs, problem.raw, problem.masks, problem.angles, strict=True):
        count = int(np.max(np.flatnonzero(np.any(mask, axis=1)), initial=-1)) + 1
        speeds, sizes, weights = amplitudes(raw[:count], mask[:count], angle[:count, 0], float(samples.step))
        if len(speeds) < 8:
            return zero
        size = 4 * -(-len(speeds) // 4)  # runs of nearly equal length share a program
        data.append(
            tuple(
                jnp.asarray(np.concatenate([each, np.repeat(pad, size - len(speeds), axis=0)]))
                for each, pad in ((speeds, speeds[-1:]), (sizes, sizes[-1:]), (weights, 0.0 * weights[-1:]))
            )
        )
    found = np.asarray(_fit_amplitudes(problem.unknowns, problem.runs, problem.scene, tuple(data)))
    return np.clip(found, -2.0, 2.0) if np.all(np.isfinite(found)) else zero
