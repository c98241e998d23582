"""Steps of runs whose outcomes are compared: rates that they resolve, and doubling until the answer no longer moves.

Two scans that agree prove nothing while both leave a rate unresolved: with a third of the steps that a friction needs no ball
is captured, with two thirds neither. The first scan therefore resolves every rate of the equations of motion at the state in
which balls turn with the rotor, and only from there on steps are doubled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.motion.ensemble import Equations, field_of
from jaxvib.motion.integrate import effects_rate
from jaxvib.motion.start import with_spin
from jaxvib.runtime.programs import cached

__all__ = ["DOUBLINGS", "Refined", "refine", "steps_per_second"]

DOUBLINGS = 2
"""Default number of times that steps are doubled at most."""

_STEPS_PER_RADIAN = 1.0
"""Steps per radian of the fastest oscillation, balls up and down their tube: errors far below those of chance."""

_STEPS_PER_ADDED_RADIAN = 2.0
"""Steps per radian of contacts between balls and of slips (`Effect.fastest_rate`): six for a collision."""

_DECAY_PER_STEP = 3.0
"""Decay rate times the step. The method of order 8 is stable up to 5.2; normal forces rise above the one on the equator."""

Answer = TypeVar("Answer")


class Refined(NamedTuple, Generic[Answer]):
    """Answers of the finest scans.

    **Attributes**: `answers` of P points; `multiple` (P,) of the first scan's steps that each took; `moved` (P, K), by how much
    its K borders moved at the last doubling: infinite if a border exists by one scan only, NaN without a doubling.
    """

    answers: list[Answer]
    multiple: np.ndarray
    moved: np.ndarray


def refine(
    scan: Callable[[np.ndarray, int], list[Answer]],
    borders: Callable[[Answer], np.ndarray],
    points: int,
    tolerance: float,
    doublings: int = DOUBLINGS,
) -> Refined[Answer]:
    """Scans points with ever more steps, each until its borders stay.

    **Arguments**: `scan(indices, multiple)` gives the answers of points by `multiple` times the steps; `borders` of an answer,
    NaN for one that does not exist; `points` P; `tolerance` of borders that stay; `doublings` of the steps at most.

    >>> found = refine(lambda i, n: [1.0 / n] * i.size, lambda x: np.array([x]), 1, tolerance=0.3)
    >>> found.answers, found.multiple.tolist(), found.moved.tolist()
    ([0.25], [4], [[0.25]])
    """
    multiple, moving = np.ones(points, dtype=int), np.arange(points)
    answers = scan(moving, 1)
    moved = np.full((points, *borders(answers[0]).shape), np.nan)
    for k in range(1, doublings + 1):
        if moving.size == 0:
            break
        multiple[moving] = 2**k
        for i, finer in zip(moving, scan(moving, 2**k), strict=True):
            moved[i] = _distance(borders(answers[i]), borders(finer))
            answers[i] = finer
        moving = moving[np.any(moved[moving] > tolerance, axis=1)]
    return Refined(answers, multiple, moved)


def _distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Differences; 0 between two NaN, infinite between NaN and a number."""
    apart = np.abs(one - other)
    missing = np.isnan(one) != np.isnan(other)
    return np.where(missing, np.inf, np.where(np.isnan(apart), 0.0, apart))


def steps_per_second(scene: Scene, equations: Equations = vector_field) -> float:
    """Number of equal steps a second that resolve the motion of balls in a torus under a constant rotor speed.

    Oscillations and decays are the eigenvalues of the linearized `equations` with the balls on the equator, turning with the
    rotor. Friction overdamps the balls there and saturates elsewhere, so that their own frequency counts besides; contacts and
    slips, which do not act there, are those that effects tell.
    """
    values = np.linalg.eigvals(np.asarray(_jacobian(scene, equations)))
    own = scene.loads.natural_frequency(scene.drive.speed)
    oscillation = max(np.max(np.abs(values.imag)), float(scene.drive.speed if own is None else jnp.max(own)))
    decay, added = np.max(-values.real, initial=0.0), float(effects_rate(scene))
    return float(max(_STEPS_PER_RADIAN * oscillation, decay / _DECAY_PER_STEP, _STEPS_PER_ADDED_RADIAN * added))


@cached
def _jacobian(scene: Scene, equations: Equations) -> Array:
    around, across = scene.loads.rest()
    zero, still = jnp.zeros_like(around), jnp.zeros(scene.machine.structure().mass.shape[:1], around.dtype)
    angle, rate = (around + scene.loads.offsets(), across), (zero + scene.drive.speed, zero)
    flat, unravel = ravel_pytree(with_spin(scene, State(still, still, angle, rate)))
    field = field_of(equations, scene)

    def change(flat: Array) -> Array:
        return ravel_pytree(field(jnp.zeros((), flat.dtype), unravel(flat)))[0]

    return jax.jacfwd(change)(flat)
