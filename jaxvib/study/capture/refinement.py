"""Number of steps in scans for capture: the first scan resolves all rates, then steps are doubled until the result is constant.

Two scans can agree although both have too few steps: with one third of the steps that a friction needs, no ball is captured,
and with two thirds no ball is captured either. Therefore the first scan already resolves every rate of the equations of motion
at the state in which the balls turn with the rotor. The number of steps is then doubled.
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

DOUBLINGS = 2
"""Default of the largest number of doublings of the steps."""

_STEPS_PER_RADIAN = 1.0
"""Number of steps per radian of the fastest oscillation, which is that of balls across their tube. The errors are far below the
statistical error of captured fractions."""

_STEPS_PER_ADDED_RADIAN = 2.0
"""Number of steps per radian of contacts between balls and of slips (`Effect.fastest_rate`), that is, six steps in a
collision."""

_DECAY_PER_STEP = 3.0
"""Largest product of decay rate and step. The method of order 8 is stable up to 5.2; the margin is needed because normal forces
rise above the force on the equator."""

Found = TypeVar("Found")


class Refined(NamedTuple, Generic[Found]):
    """Results of the finest scans.

    **Attributes**: `results` of P points; `multiple` (P,): the number of steps of each result, in units of the first scan's;
    `last_change` (P, K): the change of its K borders by the last doubling, infinite if only one of the two scans has the
    border, NaN without a doubling.
    """

    results: list[Found]
    multiple: np.ndarray
    last_change: np.ndarray


def refine(
    scan: Callable[[np.ndarray, int], list[Found]],
    borders: Callable[[Found], np.ndarray],
    points: int,
    tolerance: float,
    doublings: int = DOUBLINGS,
) -> Refined[Found]:
    """Double the steps of each point until its borders change by less than the tolerance.

    **Arguments**: `scan(indices, multiple)` returns the results of points with `multiple` times the steps; `borders` returns
    the borders of a result, NaN for one that does not exist; `points`: their number P; `tolerance`: the largest allowed change
    of a border; `doublings`: the largest number of doublings.

    >>> found = refine(lambda i, n: [1.0 / n] * i.size, lambda x: np.array([x]), 1, tolerance=0.3)
    >>> found.results, found.multiple.tolist(), found.last_change.tolist()
    ([0.25], [4], [[0.25]])
    """
    multiple, moving = np.ones(points, dtype=int), np.arange(points)
    results = scan(moving, 1)
    last_change = np.full((points, *borders(results[0]).shape), np.nan)
    for k in range(1, doublings + 1):
        if moving.size == 0:
            break
        multiple[moving] = 2**k
        for i, finer in zip(moving, scan(moving, 2**k), strict=True):
            last_change[i] = _distance(borders(results[i]), borders(finer))
            results[i] = finer
        moving = moving[np.any(last_change[moving] > tolerance, axis=1)]
    return Refined(results, multiple, last_change)


def _distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the absolute differences: 0 between two NaN, infinite between NaN and a number."""
    apart = np.abs(one - other)
    missing = np.isnan(one) != np.isnan(other)
    return np.where(missing, np.inf, np.where(np.isnan(apart), 0.0, apart))


def steps_per_second(scene: Scene, equations: Equations = vector_field) -> float:
    """Return the number of equal steps per second that resolve the motion of balls in a torus at a constant rotor speed.

    Rates of oscillation and decay are the eigenvalues of the `equations`, linearized about balls on the equator that turn with
    the rotor. In this state friction overdamps the balls, but it saturates at larger speeds; therefore the natural frequency
    without friction is resolved too. Contacts and slips do not act in this state; their rates are given by
    `Effect.fastest_rate`.
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
