"""Segments of a nonlinear motion that is fitted to a record, and its steps."""

import math
from collections.abc import Mapping

import numpy as np

from jaxvib.equations.linear import linear_model
from jaxvib.errors import InputError
from jaxvib.machine.effects.supports import FrictionSupport, Stop
from jaxvib.machine.scene import Scene
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.integration.stiffness import equal_step_length, machine_decay

_SEGMENT_ANGLE, _MAX_SEGMENTS = 25.0, 64
"""Length of a segment of a nonlinear motion, rad of the slowest vibration, and largest number of segments. All segments of a
record are integrated at once, each from its own initial state (multiple shooting). With the first values of the unknowns, the
phase error within a segment must be less than a radian."""

_STEPS_PER_RADIAN = 1.0
"""Number of steps of order 8 per radian of the fastest motion; the errors are about 2e-7 in a turn."""

_STEPS_PER_WIDTH = 0.4
"""Number of steps in which a velocity changes by the width of a friction at the largest acceleration. With friction forces of
3 to 30 N at a mass of 95 kg, the relative errors of the accelerations are then 1e-7."""

_DERIVATIVES_TO_ACCELERATION = {"acceleration": 0, "velocity": 1, "displacement": 2}
"""Number of time derivatives from a kind of motion to the acceleration."""


def divide(scene: Scene, count: int, step: float, readings: Mapping[str, float]) -> tuple[int, int, int]:
    """Return the number of the segments of a nonlinear motion, the samples of each, and the steps per sample.

    **Arguments**: `count` of the samples, and their `step`, s; `readings`: amplitude of the readings of each kind of channel,
    in SI.
    """
    fastest, slowest = (float(each) for each in frequency_bounds(scene))
    orders = _DERIVATIVES_TO_ACCELERATION
    acceleration = max((value * fastest ** orders[kind] for kind, value in readings.items() if kind in orders), default=0.0)
    frequency, decay = _rates_with_stops(scene)
    fastest, decay = max(fastest, frequency), max(float(machine_decay(scene)), decay)
    longest, is_stiff = equal_step_length(fastest, decay, _STEPS_PER_RADIAN)
    if is_stiff:
        raise InputError(
            "scene",
            "has a decay rate much higher than the frequencies of the vibration; reduce loads.drag, machine.damping or the "
            "damping of stops, or increase the width of effects.friction_support",
        )
    for effect in scene.effects:
        if isinstance(effect, FrictionSupport) and acceleration > 0.0:
            longest = min(longest, float(effect.width) / (_STEPS_PER_WIDTH * acceleration))
    number = max(1, min(_MAX_SEGMENTS, round(count * step * slowest / _SEGMENT_ANGLE)))
    return number, -(-count // number), max(1, math.ceil(step / longest))


def _rates_with_stops(scene: Scene) -> tuple[float, float]:
    """Return the highest natural frequency, rad/s, and the fastest decay rate, 1/s, while all stops are in contact; 0 without
    stops."""
    stops = [effect for effect in scene.effects if isinstance(effect, Stop)]
    if not stops:
        return 0.0, 0.0
    model = linear_model(scene)
    stiffness, damping = np.array(model.carrier.stiffness), np.array(model.carrier.damping)
    for stop in stops:
        rows = np.asarray(stop.rows(scene.machine))
        stiffness += float(stop.stiffness) * rows.T @ rows
        damping += float(stop.damping) * rows.T @ rows
    square, decay = (
        float(np.max(np.linalg.eigvals(np.linalg.solve(np.asarray(model.mass), each)).real)) for each in (stiffness, damping)
    )
    return math.sqrt(square), decay
