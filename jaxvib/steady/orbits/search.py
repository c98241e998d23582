"""Search of the whole exact branch n(Omega) for the jams at one rotor speed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_model
from jaxvib.errors import ComputationError
from jaxvib.machine.scene import Scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import grid_near_poles, light_rotor_speed, sampled_modes
from jaxvib.steady.orbits.solve import branch_tangent, periodic_motion

_BRANCH_POINTS, _POINTS_PER_BATCH = 800, 100
"""Number of points of the exact branch, and of points in a batch."""

_PARTS_PER_INTERVAL = 32
"""Number of interpolated parts of the interval between two neighbouring points of the branch."""

_NEAR_FOLD_DISTANCE = 1e-6
"""Relative distance of the rotor speed from a fold of the interpolated branch below which the fold itself is computed."""


@cached
def _search_grid(scene: Scene) -> tuple[Array, Array]:
    return grid_near_poles(jammed_model(scene), _BRANCH_POINTS)


def exact_mode_speeds(scene: Scene) -> dict[int, float]:
    """Return starting values of the load speeds (rad/s) of the exact jams at the scene's rotor speed, by mode.

    The exact branch n(Omega) is computed point by point and cut at its folds; its pieces are numbered as in `jam_modes`. The
    load speeds are interpolated between these points.
    """
    grid, resonances = _search_grid(scene)
    grid, resonances, target = np.asarray(grid), np.asarray(resonances), float(scene.drive.speed)
    grid = np.unique(np.append(grid, target))  # a duplicate point would look like a fold
    omega = np.interp(np.linspace(0.0, 1.0, _BRANCH_POINTS), np.linspace(0.0, 1.0, grid.size), grid)
    speed, slope = (np.ravel(x) for x in branch_at(scene, jnp.asarray(omega).reshape(-1, _POINTS_PER_BATCH)))
    known = np.isfinite(speed)
    if np.sum(known) < 2:
        problem = "no exact jam was found at any load speed; check the largest and the smallest numbers of the scene"
        raise ComputationError("not_converged", problem)
    omega, speed = _interpolate(omega[known], speed[known], slope[known])
    folds, ends, modes = sampled_modes(omega, speed, resonances)
    crossed = (speed[1:] - target) * (speed[:-1] - target) <= 0.0
    near = folds[np.abs(speed[folds] - target) < _NEAR_FOLD_DISTANCE * target]
    close = []
    for k in near:
        around = np.clip([k - _PARTS_PER_INTERVAL, k + _PARTS_PER_INTERVAL], 0, omega.size - 1)
        low, high = (float(w) for w in omega[around])
        if _ends_before(scene, low, high, target):
            crossed[around[0] : around[1]] = False  # the crossing is an interpolation error
        else:
            close.append(k)
    found: dict[int, float] = {}
    for k in np.flatnonzero(crossed):
        share = (target - speed[k]) / (speed[k + 1] - speed[k])
        found.setdefault(int(modes[np.searchsorted(ends, k)]), float(omega[k] + share * (omega[k + 1] - omega[k])))
    # If a fold lies between two points, the two modes that meet at the fold are near these points.
    for k in close:
        for side in (k - 1, k + 1):
            found.setdefault(int(modes[np.searchsorted(ends, side)]), float(omega[side]))
    return found


def _ends_before(scene: Scene, low: float, high: float, target: float, refinements: int = 2) -> bool:
    """Return True if the exact branch has a fold between two load speeds, at which it turns back before it reaches the rotor
    speed `target`, up to rounding.

    The interval around the fold is made smaller `refinements` times. The fold is that of the interpolated cubic in the last
    interval.
    """
    omega = np.linspace(low, high, _BRANCH_POINTS)
    speed, slope = (np.ravel(x) for x in branch_at(scene, jnp.asarray(omega).reshape(-1, _POINTS_PER_BATCH)))
    (folds,) = np.nonzero(slope[1:] * slope[:-1] <= 0.0)
    if folds.size != 1:
        return False
    ends = slice(folds[0], folds[0] + 2)
    if refinements > 1:
        low, high = (float(w) for w in omega[ends])
        return _ends_before(scene, low, high, target, refinements - 1)
    rounding = 4096.0 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    fold = _interpolate(omega[ends], speed[ends], slope[ends])[1]
    return bool(np.max(fold) < target * (1.0 - rounding) if slope[folds[0]] > 0.0 else np.min(fold) > target * (1.0 + rounding))


def _interpolate(x: np.ndarray, y: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the cubics through (x, y) with the given slopes, `_PARTS_PER_INTERVAL` in each interval."""
    t, h = np.arange(_PARTS_PER_INTERVAL) / _PARTS_PER_INTERVAL, np.diff(x)[:, None]
    a, b, c, d = y[:-1, None], h * slope[:-1, None], y[1:, None], h * slope[1:, None]
    cubic = (1.0 + 2.0 * t) * (1.0 - t) ** 2 * a + t * (1.0 - t) ** 2 * b + t**2 * (3.0 - 2.0 * t) * c + t**2 * (t - 1.0) * d
    return np.append(x[:-1, None] + h * t, x[-1]), np.append(cubic, y[-1])


@cached
def branch_at(scene: Scene, omega: Array) -> tuple[Array, Array]:
    """Return rotor speeds (rad/s) and slopes dn/dOmega of exact jams at load speeds `omega` (batches, points), rad/s.

    The values are NaN at load speeds without a jam.
    """
    model = jammed_bodies(jammed_model(scene))
    grid = grid_of(*((16, True) if model.half_turn else (33, False)))

    def one(w: Array) -> tuple[Array, Array]:
        motion = periodic_motion(model, grid, "omega", w, light_rotor_speed(model.linear, w))
        branch = branch_tangent(model, grid, motion)
        has_converged = branch.residual < 4096.0 * jnp.finfo(w.dtype).eps
        return jnp.where(has_converged, motion.rotor_speed, jnp.nan), jnp.where(has_converged, branch.slope, jnp.nan)

    return jax.lax.map(jax.vmap(one), omega)
