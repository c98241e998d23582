"""Motion of points of a machine in a run, and the fit of a harmonic to the window of the run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import speed_text
from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.forces import drive_torques
from jaxvib.equations.linear import linear_model, peak_force
from jaxvib.equations.model import assemble
from jaxvib.equations.torque_balance import resultant_of
from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine, Place
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import AbstractMeasured, Trajectory, turning_angles, turning_directions
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.numerics.extrema import sampled_maximum
from jaxvib.numerics.linalg import magnitude
from jaxvib.results.fields import in_unit
from jaxvib.results.readable import Readable
from jaxvib.runtime.programs import cached
from jaxvib.steady.measures import VibrationMeasures, vibration_measures
from jaxvib.steady.points import Harmonic, rows_in_plane
from jaxvib.steady.vibration import Samples, Vibration

_MIN_TURNS = 3
"""Smallest number of turns of the exciters to which a harmonic is fitted."""

_MIN_SHARE = 0.5
"""Smallest amplitude of the harmonic at the speed of the exciters, relative to the measured amplitude, of a motion with
vibration measures. It is about 1 in a steady motion, and small if a rotor slows down or a free vibration decays."""

_PURE_SHARE = 0.95
"""Share of the amplitude at the speed of the exciters, see `_MIN_SHARE`, below which a summary states that its measures do not
describe the whole motion. Typical: 0.9 for loads that are jammed on a rotor with an imbalance, which also vibrates at the rotor
speed."""

_MIN_PEAK_RATIO = 1.02
"""Smallest ratio of the largest value during a run to that of its window for which the summary states the time."""

_HARMONICS = 3
"""Number of fitted harmonics. The second and the third are included because they would otherwise influence the first."""


class PointMotion(Readable):
    """Motion of a point of a machine at nt times.

    Returned by `Run.point`.

    **Attributes**: `time` (nt,) s; `displacement` (nt, 2) m and `velocity` (nt, 2) m/s, horizontal and up.
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    displacement: Array = eqx.field(metadata=in_unit("m", "time", "direction"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "time", "direction"))

    @property
    def largest_displacement(self) -> Array:
        """Largest distance from the place at rest, m, between the stored states as in `Run`; NaN for a run that failed."""
        return sampled_maximum(magnitude(self.displacement[..., 0] + 1j * self.displacement[..., 1]), axis=-1)

    @property
    def largest_displacement_time(self) -> Array:
        """Time of the stored state with the largest distance from the place at rest, s."""
        return peak_time(self.time, jnp.sum(self.displacement**2, axis=-1))


def peak_time(time: Array, values: Array) -> Array:
    """Return the `time` (..., nt) of the largest of the `values` (..., nt)."""
    largest = jnp.argmax(values, axis=-1)[..., None]
    return jnp.take_along_axis(jnp.broadcast_to(time, values.shape), largest, axis=-1)[..., 0]


def peak_time_text(peak: float, last: float, time: float) -> str:
    """Return the `time` of the largest value `peak` of a run as text; "" if that of the window, `last`, is about as large."""
    return f" at {float(time):.4g} s" if peak > _MIN_PEAK_RATIO * last else ""


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
    """Return the harmonic at the mean load speed, fitted to the displacements of a window, with the measured amplitudes,
    the mean torques and powers of the drives (NaN for loads that spin or slide), and samples of the whole motion.

    The exciter force is NaN for a rotor with an imbalance, or with loads and an unbalance, which can turn faster than the
    loads.
    """
    time, states, model = window.time, window.state, assemble(scene)
    harmonic, _ = fit_harmonic(time, states.displacement, measured.omega)
    torques = jax.vmap(partial(drive_torques, model, dynamics_of(model)))(time, states)
    hann = _hann(time.shape[0])
    weight = jnp.asarray(hann / np.sum(hann), time.dtype)
    torque, power = (weight @ torque_or_power for torque_or_power in torques)
    has_spin = np.array([own.spin is not None for own in states.exciters])
    is_unknown = has_term(scene.all_effects, RotorImbalance) or any(len(own.carries) > 1 for own in scene.exciters)
    angles, _ = turning_angles(scene, lambda: time, states)
    phases = turning_directions(scene)[None] * angles - (measured.omega * (time - 0.5 * (time[0] + time[-1])))[:, None]
    force = peak_force(measured.omega**2 * resultant_of(linear_model(scene), weight @ jnp.exp(1j * phases)))
    return Vibration(
        speed=measured.omega,
        displacement=harmonic,
        amplitude=measured.amplitude,
        foundation_force=measured.foundation_force,
        exciter_force=jnp.where(is_unknown, jnp.nan, force),
        torque=jnp.where(has_spin, jnp.nan, torque),
        power=jnp.where(has_spin, jnp.nan, power),
        samples=samples_of(scene, window),
    )


@cached
def samples_of(scene: Scene, window: Trajectory) -> Samples:
    """Return samples of the whole motion in a window."""
    time, states = window.time, window.state
    acceleration = jax.vmap(dynamics_of(assemble(scene)))(time, states).velocity
    return Samples(time, states.displacement, states.velocity, acceleration, window.foundation_force)


def require_turns(time: np.ndarray, speed: float) -> None:
    """**Raises** `InputError` if the exciters make too few turns for the fit of a harmonic."""
    if not (turns := _turns(time, speed)) >= _MIN_TURNS:
        raise InputError(
            "run", f"has {turns:.2g} turns in its window; a harmonic needs {_MIN_TURNS}; increase `until` or `window_periods`"
        )


def vibration_share(machine: Machine, time: Array, measured: AbstractMeasured, harmonic: Array) -> Array:
    """Return the share of the amplitude of a motion that is a vibration at the speed of the exciters, from its `harmonic`
    (nd,); 0 for too few turns. It is small for a free vibration, and if the exciters stand almost still or change their speed
    fast."""
    share = _harmonic_share(machine, harmonic, measured.amplitude)
    return jnp.where(_turns(time, measured.omega) >= _MIN_TURNS, share, 0.0)


def _harmonic_share(machine: Machine, harmonic: Array, amplitude: Array) -> Array:
    is_length = np.asarray(machine.carrier().units) == "m"
    moves = is_length if np.any(is_length) else np.ones_like(is_length)
    part, whole = (jnp.linalg.norm(magnitude(each)[moves]) for each in (harmonic, amplitude))
    return jnp.where(whole > 0.0, part / jnp.where(whole > 0.0, whole, 1.0), 1.0)


def has_vibration(share: Array) -> Array:
    """Return True for the `vibration_share` of a motion that has vibration measures."""
    return share >= _MIN_SHARE


ZERO_VIBRATION = "the amplitude is zero within the error of the run"
"""Reason for which a balanced rotor has no vibration measures."""

_ZERO_AMPLITUDE = 1e-8
"""Amplitude, relative to the natural unit of displacements, below which it is zero: the default tolerance of runs."""


def absent_vibration(scene: Scene, time: Array, measured: AbstractMeasured, harmonic: Callable[[], Harmonic]) -> str:
    """Return the reason for which a motion has no vibration measures, an empty text if it has; see `vibration_share`."""
    turns, speed = _turns(time, measured.omega), speed_text(measured.omega, 4)
    if not turns >= _MIN_TURNS:
        return f"the exciters make {float(turns):.2g} turns in the measured window, fewer than {_MIN_TURNS}"
    share = vibration_share(scene.machine, time, measured, harmonic().amplitude)
    if has_vibration(share):
        return ""
    if jnp.max(scene.machine.carrier().as_lengths(measured.amplitude)) < _ZERO_AMPLITUDE * natural_units(scene).displacement:
        return ZERO_VIBRATION
    return (
        f"{100.0 * float(share):.2g} % of the amplitude is at the mean speed of the exciters, {speed}; their speeds change or "
        "differ, the motion is a free vibration, or the vibration is smaller than the error of the run"
    )


def require_vibration(reason: str) -> None:
    """**Raises** `InputError` if a motion has no vibration measures for a `reason`."""
    if reason:
        raise InputError("run", f"has no vibration to measure: {reason}; measure a run that ends in a steady motion")


def measures_text(
    scene: Scene, reason: str, vibration: Callable[[], Vibration], measures: VibrationMeasures | None
) -> list[str]:
    """Return the lines of a summary about a vibration: its `measures` (default: at the centre of mass, for a level deck), or
    the `reason` for which there is none."""
    if reason:
        return [f"no vibration to measure: {reason}"]
    motion = vibration()
    measures = measures or vibration_measures(scene, motion)
    lines = measures.summary().splitlines()
    share = float(_harmonic_share(scene.machine, motion.displacement, motion.amplitude))
    if share >= _PURE_SHARE:
        return lines
    note = f"only {100.0 * share:.3g} % of the amplitude is at the mean speed of the exciters, {speed_text(motion.speed, 4)}"
    if motion.samples is None:
        note += "; g and mm/s are computed from the whole amplitude and this speed, forces on supports from this part only"
    elif measures.point is not None:
        note += "; the conveying speed is computed from this part only"
    return [note, *lines]


def _turns(time: Array | np.ndarray, speed: Array | float) -> Array:
    return jnp.abs(speed) * (time[-1] - time[0]) / (2.0 * np.pi)


def _hann(count: int) -> np.ndarray:
    """Return weights (count,) that vanish at both ends."""
    return np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2
