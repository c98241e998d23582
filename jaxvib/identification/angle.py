"""Angle of a rotor over time, from the pulses of a tachometer, an angle, a speed, or the schedule of the drive.

Pulses and samples are fitted by a spline of degree 5 with evenly spaced knots, whose number has the smallest Bayesian
information criterion. Its second derivative, which the force of an unbalance needs, is smooth. Marks of a wheel that are
unevenly spaced have one unknown offset each.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxvib.errors import InputError
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.scene import Exciter, Scene

_DEGREE = 5
_MIN_PULSES = 12
"""Number of pulses below which the angle between them is unknown."""

_MAX_INTERVALS = 512
"""Largest number of intervals of a spline."""

_MAX_SPEED_CHANGE = 0.1
"""Relative change of the speed between two pulses above which the angle between them is uncertain."""


class RotorAngle(NamedTuple):
    """Angle of a rotor over time.

    **Attributes**

    - `spline` of the angle over time; None if the angle follows from the `drive`
    - `drive`: drive of prescribed speed, None with a spline
    - `span`, s, in which the angle is known
    - `marked`: True if the zero of the angle is a mark on the rotor, the same in all runs
    - `error`, rad: root mean square of the standard error of the angle in the span
    - `notes`: sentences for the reader
    """

    spline: Any
    drive: Drive | None
    span: tuple[float, float]
    marked: bool
    error: float
    notes: tuple[str, ...]

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the angle (rad), the speed (rad/s) and the acceleration (rad/s^2) at times of any shape."""
        if self.drive is not None:
            drive: Any = self.drive
            flat = np.ravel(time)
            functions = (lambda t: drive.rotor_angle(t, None), lambda t: drive.rotor_speed(t, None), drive.rotor_acceleration)
            angle, speed, acceleration = (np.asarray(jax.vmap(f)(flat), dtype=float).reshape(time.shape) for f in functions)
            return angle, speed, acceleration
        spline = self.spline
        return spline(time), spline(time, 1), spline(time, 2)


def rotor_angles(scene: Scene, run: MeasuredRun) -> list[RotorAngle]:
    """Return the angle of the rotor of each exciter in a run, in its direction of rotation.

    Channels of pulses, angle or speed describe the rotor of the only exciter. Without them the drives must prescribe the angle.

    **Raises** `InputError` for a motor without such a channel, and for too few pulses.
    """
    channels = run.of_kind("pulses", "angle", "speed")
    if channels and len(scene.exciters) > 1:
        raise InputError(
            run.source,
            f"has the {channels[0].kind} of one rotor, but the scene has {len(scene.exciters)} exciters; "
            "identify needs a scene with one exciter for such a channel, or drives of prescribed speed without it",
        )
    if channels:
        return [_measured(run, min(channels, key=lambda each: ("pulses", "angle", "speed").index(each.kind)))]
    return [_prescribed(scene, k, exciter, run) for k, exciter in enumerate(scene.exciters)]


def _prescribed(scene: Scene, k: int, exciter: Exciter, run: MeasuredRun) -> RotorAngle:
    if not exciter.drive.ideal:
        raise InputError(
            run.source,
            f"has no channel of the rotor's angle, and {scene.prefix_of(k)}drive is {exciter.drive.kind!r}, whose speed "
            "depends on the machine; add a channel of kind pulses, angle or speed",
        )
    return RotorAngle(None, exciter.drive, (-math.inf, math.inf), False, 0.0, ())


def _measured(run: MeasuredRun, channel: Channel) -> RotorAngle:
    time, value = np.asarray(run.times[channel.name], float), np.asarray(run.values[channel.name], float)
    time, value = time[np.isfinite(value)], value[np.isfinite(value)]
    where = f"{run.source}: channel {channel.name!r}"
    if time.size < _MIN_PULSES:
        raise InputError(where, f"has {time.size} {channel.kind}; at least {_MIN_PULSES} are needed, record more turns")
    time = time - channel.delay
    if channel.kind == "speed":
        spline, error = fit_spline(time, np.abs(value))
        rough = spline.antiderivative()
        # The error of an integral of independent errors of the speed.
        return RotorAngle(rough, None, (time[0], time[-1]), False, error * math.sqrt((time[-1] - time[0]) * _step(time)), ())
    marks = value.astype(int) % channel.per_turn if channel.kind == "pulses" and channel.per_turn > 1 else None
    angle = 2.0 * np.pi * value / channel.per_turn if channel.kind == "pulses" else value * np.sign(value[-1] - value[0])
    spline, error = fit_spline(time, angle, marks)
    notes = []
    if channel.kind == "pulses":
        speed = spline(0.5 * (time[1:] + time[:-1]), 1)
        fast = np.abs(speed[1:]) > 0.2 * np.max(np.abs(speed))  # slower rotors excite nothing
        change = float(np.max(np.abs(np.diff(speed) / speed[1:]), where=fast, initial=0.0))
        if change > _MAX_SPEED_CHANGE:
            notes.append(
                f"{where}: the speed changes by up to {change:.0%} from one pulse to the next, and the angle between them is "
                "uncertain; use more pulses per turn"
            )
    return RotorAngle(spline, None, (time[0], time[-1]), True, error, tuple(notes))


def _step(time: np.ndarray) -> float:
    return float(np.median(np.diff(time)))


def fit_spline(time: np.ndarray, value: np.ndarray, marks: np.ndarray | None = None) -> tuple[Any, float]:
    """Return a spline of degree 5 through noisy values, and the root mean square of its standard error.

    **Arguments**: `time` (n,) s, ascending; `value` (n,); `marks` (n,): the number of a value's mark, each with an unknown
    offset (0 on average).

    >>> t = np.linspace(0.0, 2.0, 200)
    >>> spline, error = fit_spline(t, 30.0 * t**2 + 1e-3 * np.random.default_rng(0).normal(size=t.size))
    >>> bool(abs(spline(1.0, 2) - 60.0) < 0.1), bool(2e-4 < error < 2e-3)
    (True, True)
    """
    from scipy.interpolate import BSpline  # slow to import

    n = time.size
    best: tuple[float, Any, float] = (math.inf, None, math.inf)
    kinds = np.eye(1 if marks is None else int(np.max(marks)) + 1)[0 * np.arange(n) if marks is None else marks]
    offsets = kinds[:, 1:] - kinds[:, :1]
    intervals = 1
    while intervals <= min(_MAX_INTERVALS, n // 4):
        inner = np.linspace(time[0], time[-1], intervals + 1)
        knots = np.concatenate([[time[0]] * _DEGREE, inner, [time[-1]] * _DEGREE])
        basis: Any = BSpline.design_matrix(time, knots, _DEGREE)
        count = basis.shape[1] + offsets.shape[1]
        square = np.zeros((count, count))
        size = basis.shape[1]
        square[:size, :size] = (basis.T @ basis).toarray()
        square[:size, size:] = basis.T @ offsets
        square[size:, :size] = square[:size, size:].T
        square[size:, size:] = offsets.T @ offsets
        right = np.concatenate([basis.T @ value, offsets.T @ value])
        square[np.diag_indices(count)] += 1e-12 * np.trace(square) / count  # intervals without a value
        inverse = np.linalg.inv(square)
        found = inverse @ right
        found += inverse @ (right - square @ found)
        left = value - basis @ found[:size] - offsets @ found[size:]
        variance = float(left @ left) / max(n - count, 1)
        criterion = n * math.log(max(float(left @ left) / n, 1e-26)) + count * math.log(n)
        if criterion < best[0]:
            at = BSpline.design_matrix(np.linspace(time[0], time[-1], 4 * intervals + 1), knots, _DEGREE)
            spread = np.mean(np.einsum("ij,jk,ik->i", at.toarray(), inverse[:size, :size], at.toarray()))
            best = criterion, BSpline(knots, found[:size], _DEGREE), math.sqrt(variance * float(spread))
        intervals = max(intervals + 1, int(1.4 * intervals))
    return best[1], best[2]
