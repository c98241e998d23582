"""Motion of points of a machine in a run, and the fit of a harmonic to the last turns of the run."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.machine.carrier import Machine
from jaxvib.machine.mount import Place
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.results.fields import in_unit
from jaxvib.runtime.programs import cached
from jaxvib.steady.points import rows_in_plane

_HARMONICS = 3
"""Number of fitted harmonics. The second and the third are fitted so that they do not influence the first."""


class PointMotion(eqx.Module):
    """Motion of a point of a machine, (nt,) samples.

    Returned by `Run.point`.

    **Attributes**: `time` (nt,) s; `displacement` (nt, 2) m and `velocity` (nt, 2) m/s, horizontal and up.
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    displacement: Array = eqx.field(metadata=in_unit("m", "time", "direction"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "time", "direction"))


@cached
def motion_of_point(machine: Machine, kept: Trajectory, place: Place) -> PointMotion:
    """Return the motion of the point at `place` at the times of a trajectory."""
    rows = rows_in_plane(machine, place)
    return PointMotion(kept.time, kept.state.displacement @ rows.T, kept.state.velocity @ rows.T)


@cached
def fit_harmonic(time: Array, displacement: Array, speed: Array) -> tuple[Array, Array]:
    """Return the first harmonic of evenly sampled displacements (nt, nd), and the mean square of the remaining motion.

    The means and the harmonics of `speed` are fitted by least squares. Weights that vanish at both ends (Hann window) make the
    result insensitive to frequencies that are not a multiple of `speed`.

    **Returns** the complex amplitudes (nd,), whose phase is measured from the middle of the time interval, and the matrix
    `Harmonic.rest` (nd, nd).
    """
    count = time.shape[0]
    weight = jnp.asarray(np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2, time.dtype)[:, None]
    angle = speed * (time - 0.5 * (time[0] + time[-1]))
    orders = jnp.arange(1, _HARMONICS + 1, dtype=time.dtype)
    waves = jnp.outer(angle, orders)
    basis = jnp.concatenate([jnp.cos(waves), jnp.sin(waves), jnp.ones_like(angle)[:, None]], axis=1)
    found = jnp.linalg.solve(basis.T @ (weight * basis), basis.T @ (weight * displacement))
    own = jnp.array([0, _HARMONICS])
    rest = displacement - found[None, -1] - basis[:, own] @ found[own]
    return found[0] - 1j * found[_HARMONICS], rest.T @ (weight * rest) / jnp.sum(weight)
