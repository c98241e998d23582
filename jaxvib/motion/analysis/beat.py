"""Beat of the vibration of loads with that of an imbalance, which turns faster."""

from __future__ import annotations

import numpy as np

from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory

_MIN_BEATS = 2
"""Number of beats in the second half of a run that are needed to recognize a regular beat."""

_MAX_CHANGE = 0.03
"""Largest relative change of the period and of the largest displacement from beat to beat in a regular beat. Samples do not
contain the exact largest displacements."""


def beat_period(scene: Scene, trajectory: Trajectory) -> float | None:
    """Return the period, s, after which loads that turn slower than the rotor are again at the same angle from its imbalance.

    The vibration then repeats itself after each period, but never becomes steady. The result is None if there is no imbalance,
    if the loads do not all fall behind the rotor by the same number of turns, and unless the second half of the `trajectory`
    contains at least two beats that are equal.
    """
    if not (scene.is_plain and scene.exciters[0].loads is not None and has_term(scene.all_effects, RotorImbalance)):
        return None
    half = trajectory.time.shape[0] // 2
    time, turn, angle = (np.asarray(x)[half:] for x in (trajectory.time, trajectory.rotor_angle, trajectory.state.azimuth))
    # Angle, rad, by which the loads still fall behind the rotor until the end of the run.
    behind = np.abs(turn - turn[-1])[:, None] - np.abs(angle - angle[-1])
    total, lost = behind[0], np.maximum.accumulate(np.mean(behind, axis=1)[::-1])
    beats = int(lost[-1] / (2.0 * np.pi))
    if beats < _MIN_BEATS or np.ptp(total) > np.pi or not np.all(np.isfinite(total)):
        return None
    ends = np.interp(2.0 * np.pi * np.arange(beats + 1), lost, time[::-1])
    periods, step = -np.diff(ends), float(time[1] - time[0])
    if np.ptp(periods) > _MAX_CHANGE * np.mean(periods) + 2.0 * step:
        return None
    size = np.linalg.norm(np.asarray(scene.machine.carrier().as_lengths(trajectory.state.displacement[half:])), axis=1)
    middle = ends[beats // 2]
    late, early = (np.max(size[part]) for part in (time > middle, (time <= middle) & (time >= ends[-1])))
    return float(np.mean(periods)) if abs(late - early) <= _MAX_CHANGE * late else None
