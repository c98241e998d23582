"""Reasons for which the motion at the end of a run is not settled: the drives are off, or a balanced motion decays."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxvib.display import speed_text
from jaxvib.equations.torque_balance import mass_owners
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory, turning_directions
from jaxvib.motion.analysis.regime import Regime, RegimeName

_LATE = 1e9
"""Time, s, after which a prescribed speed no longer changes."""


def coasting_text(scene: Scene, time: np.ndarray, speeds: np.ndarray) -> str:
    """Return a text on the exciters that slow down to rest because their drives are off or stop; an empty text without them.

    The text contains no time at which they come to rest: a resonance or the weight of an unbalance can change it by a multiple.

    **Arguments**: `time` (nt,), s, and `speeds` (nt, n), rad/s, of the turning masses (`turning_angles`) in the window.
    """
    off = [_stops(exciter.drive, float(time[0]), float(time[-1])) for exciter in scene.exciters]
    if not any(off):
        return ""
    speed = np.mean((turning_directions(scene) * speeds)[:, np.asarray(off)[mass_owners(scene)]], axis=1)
    halves = [np.mean(part) for part in np.split(speed, [len(time) // 2])]
    numbers = [str(k) for k, is_off in enumerate(off, 1) if is_off]
    coasts = f"exciter {numbers[0]} coasts down" if len(numbers) == 1 else f"exciters {', '.join(numbers)} coast down"
    first, second = (speed_text(mean, 4) for mean in halves)
    text = "coasting down" if all(off) else coasts
    return f"{text}, mean speed {first} in the first and {second} in the second half of the window"


def last_turn_text(scene: Scene, time: np.ndarray, angles: np.ndarray) -> str:
    """Return the time of the end of the last full turn of stopped exciters as text; an empty text if the drives are on.

    **Arguments**: `time` (nt,), s, and `angles` (nt, n), rad, of the turning masses (`turning_angles`) in the whole run.
    """
    off = [_stops(exciter.drive, float(time[0]), float(time[-1])) for exciter in scene.exciters]
    turning = np.any(np.abs(angles - angles[-1]) > np.pi, axis=1)  # a stopped unbalance can swing by less than half a turn
    if not (all(off) and np.any(turning)):
        return ""
    return f", and their last full turn ended at {float(time[np.flatnonzero(turning)[-1]]):.4g} s"


def _stops(drive: Drive, start: float, end: float) -> bool:
    """Return True for a motor that is switched off before the time `end`, s, and for a prescribed speed, such as the reference
    of a converter, that finally is 0 and falls from `start` to `end`."""
    if isinstance(drive, SwitchedOff):
        return float(drive.at) < end
    if drive.ideal:
        first, last, final = (float(drive.rotor_speed(jnp.asarray(t), None)) for t in (start, end, _LATE))
        return final == 0.0 and (last < first or last == 0.0)
    inner = (getattr(drive, field.name) for field in dataclasses.fields(drive))
    return any(_stops(each, start, end) for each in inner if isinstance(each, Drive))


def balanced_text(regime: Regime, window: Trajectory) -> str:
    """Return a text on loads that balance the rotor while the remaining vibration decays; an empty text for other motions."""
    displacement = np.asarray(window.state.displacement)
    early, late = (np.linalg.norm(np.ptp(part, axis=0)) for part in np.split(displacement, [len(displacement) // 2]))
    if not bool(regime.name == RegimeName.balanced) or late > early:
        return ""
    left = regime.unbalance_text(float(regime.unbalance))
    return f"balanced: the remaining unbalance is {left}; the remaining vibration decays"
