"""Creep of loads that would stick to the rotor if their dry friction were not smoothed."""

from __future__ import annotations

import numpy as np

from jaxvib.display import speed_text
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import ContactFriction
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory

_MAX_CREEP = 2.0
"""Speed of a load relative to the rotor, as a multiple of the smoothing rate of its friction, up to which it counts as creep.
The friction is then at most tanh(2) = 96 % of its largest value."""


def creep_text(scene: Scene, segment: Trajectory) -> str:
    """Return a sentence about loads that creep during the whole `segment`; an empty text if there are none."""
    if not scene.is_plain or not isinstance(loads := scene.exciters[0].loads, CircularLoads):
        return ""
    smoothing = [term.smoothing(loads) for term in terms_of(scene.all_effects, ContactFriction) if term.smoothing]
    if not smoothing:
        return ""
    rate, rotor = np.asarray(segment.state.azimuth_rate), np.asarray(segment.rotor_speed)
    slip = np.max(np.abs(rate - rotor[:, None]), axis=0)
    limit = np.broadcast_to(np.min([np.broadcast_to(np.asarray(each), slip.shape) for each in smoothing], axis=0), slip.shape)
    creeping = slip <= _MAX_CREEP * limit
    if not np.any(creeping):
        return ""
    numbers = [str(j + 1) for j in np.flatnonzero(creeping)]
    several = f"loads {', '.join(numbers)} creep" if len(numbers) > 1 else f"load {numbers[0]} creeps"
    speed, widest = speed_text(np.max(slip[creeping]), 2), speed_text(np.max(limit[creeping]), 2)
    which = "the loads creep" if np.all(creeping) else several
    return (
        f"{which}: dry friction is smoothed over {widest}, and the speed relative to the rotor is at most {speed}; "
        "exact friction would stop this motion, and the remaining vibration may be larger; "
        "reduce the width of the friction, and compare"
    )
