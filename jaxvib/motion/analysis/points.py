"""Motion of points of a machine in a run, and the fit of a harmonic to the window of the run."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.forces import drive_torques
from jaxvib.equations.linear import linear_model, peak_force
from jaxvib.equations.model import assemble
from jaxvib.equations.torque_balance import resultant_of
from jaxvib.machine.carrier import Machine, Place
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import AbstractMeasured, Trajectory, turning_angles, turning_directions
from jaxvib.results.fields import in_unit
from jaxvib.runtime.programs import cached
from jaxvib.steady.measures import Vibration
from jaxvib.steady.points import rows_in_plane

_HARMONICS = 3
"""Number of fitted harmonics. The second and the third are included because they would otherwise influence the first."""


class PointMotion(eqx.Module):
    """Motion of a point of a machine at nt times.

    Returned by `Run.point`.

    **Attributes**: `time` (nt,) s; `displacement` (nt, 2) m and `velocity` (nt, 2) m/s, horizontal and up.
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    displacement: Array = eqx.field(metadata=in_unit("m", "time", "direction"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "time", "direction"))


@cached
def motion_of_point(machine: Machine, trajectory: Trajectory, place: Place) -> PointMotion:
    """Return the motion of the point at `place` at the times of a trajectory."""
    rows = rows_in_plane(machine, place)
    return PointMotion(trajectory.time, trajectory.state.displacement @ rows.T, trajectory.state.velocity @ rows.T)


@cached
def fit_harmonic(time: Array, displacement: Array, speed: Array) -> tuple[Array, Array]:
    """Return the first harmonic of evenly sampled displacements (nt, nd), and the mean square of the remaining motion.

    The means and the harmonics of `speed` are fitted by least squares. Weights that vanish at both ends (Hann window) make the
    result insensitive to frequencies that are not a multiple of `speed`.

    **Returns** the complex amplitudes (nd,), whose phase is measured from the middle of the time interval, and the matrix
    `Harmonic.rest` (nd, nd).
    """
    count = time.shape[0]
    weight = jnp.asarray(_hann(count), time.dtype)[:, None]
    angle = speed * (time - 0.5 * (time[0] + time[-1]))
    orders = jnp.arange(1, _HARMONICS + 1, dtype=time.dtype)
    waves = jnp.outer(angle, orders)
    basis = jnp.concatenate([jnp.cos(waves), jnp.sin(waves), jnp.ones_like(angle)[:, None]], axis=1)
    coefficients = jnp.linalg.solve(basis.T @ (weight * basis), basis.T @ (weight * displacement))
    first_harmonic = jnp.array([0, _HARMONICS])
    rest = displacement - coefficients[None, -1] - basis[:, first_harmonic] @ coefficients[first_harmonic]
    return coefficients[0] - 1j * coefficients[_HARMONICS], rest.T @ (weight * rest) / jnp.sum(weight)


@cached
def vibration_of(scene: Scene, window: Trajectory, measured: AbstractMeasured) -> Vibration:
    """Return the harmonic at the mean speed of the loads, fitted to the displacements of a window, with the measured amplitudes
    and the mean torques and powers of the drives.

    The exciter force is NaN for a rotor with an imbalance, because the rotor can turn faster than the loads. Torques and powers
    are NaN for loads that spin or slide.
    """
    time, states, model = window.time, window.state, assemble(scene)
    harmonic, _ = fit_harmonic(time, states.displacement, measured.omega)
    torques = jax.vmap(partial(drive_torques, model, dynamics_of(model)))(time, states)
    hann = _hann(time.shape[0])
    weight = jnp.asarray(hann / np.sum(hann), time.dtype)
    torque, power = (weight @ torque_or_power for torque_or_power in torques)
    has_spin = np.array([own.spin is not None for own in states.exciters])
    angles, _ = turning_angles(scene, lambda: time, states)
    phases = turning_directions(scene)[None] * angles - (measured.omega * (time - 0.5 * (time[0] + time[-1])))[:, None]
    force = peak_force(measured.omega**2 * resultant_of(linear_model(scene), weight @ jnp.exp(1j * phases)))
    return Vibration(
        speed=measured.omega,
        displacement=harmonic,
        amplitude=measured.amplitude,
        foundation_force=measured.foundation_force,
        exciter_force=jnp.where(has_term(scene.all_effects, RotorImbalance), jnp.nan, force),
        torque=jnp.where(has_spin, jnp.nan, torque),
        power=jnp.where(has_spin, jnp.nan, power),
    )


def _hann(count: int) -> np.ndarray:
    """Return weights (count,) that vanish at both ends."""
    return np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2
