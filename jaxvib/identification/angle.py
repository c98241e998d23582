"""Angle of a rotor over time, from the pulses of a tachometer, an angle, a speed, or a prescribed drive.

Pulses and samples are fitted by a spline of degree 5 (`records/spline.py`). If a wheel has several marks, each mark has an
unknown offset from its nominal place, because marks are unevenly spaced. All pulses have an unknown common delay, because
recorders round times up, down, or to the nearest sample; its standard error is that of the time of one pulse. The errors e_m(t)
of the angle follow from the covariance of the coefficients:

    angle(t) = spline(t) + sum_m z_m e_m(t),      z_m independent and standard normal

The numbers z_m can be further unknowns of a fit: vibrations then make the angle more accurate, and the intervals of all other
unknowns include its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.records.pulses import fit_pulses
from jaxvib.identification.records.spline import DEGREE, fit_spline
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.drives.drive import Drive, IdealDrive
from jaxvib.machine.numbers import unit
from jaxvib.machine.scene import Exciter, Scene

_MIN_PULSES = 12
"""Number of pulses below which the angle between them is unknown."""

_MAX_SPEED_CHANGE = 0.1
"""Relative change of the speed between two pulses above which the angle between them is uncertain."""

MAX_ERRORS = 64
"""Largest number of errors z_m of an angle."""

_ERROR_COUNT_STEP = 8
"""The number of errors is a multiple of this number. Runs with nearly equal splines therefore share a program."""


class RecordedDrive(IdealDrive):
    """Drive that follows a recorded angle, given by polynomials of the time since the start of each of several intervals.

    **Attributes**: `speed`, rad/s: the largest absolute speed; `table` (intervals, powers, 1 + m): coefficients of the angle
    and of its errors e_m; `starts` (intervals,), s: start of each interval, infinite for rows that are padding.
    """

    speed: Array = eqx.field(metadata=unit("rad/s"))
    table: Array = eqx.field(metadata=unit("rad"))
    starts: Array = eqx.field(metadata=unit("s"))
    kind: str = eqx.field(static=True, default="recorded", kw_only=True)

    def columns_at(self, t: Array, order: int) -> Array:
        """Return the derivatives (1 + m,) of the given `order` of the angle and of its errors e_m at the time `t`; order 0: the
        values."""
        k = jnp.maximum(jnp.searchsorted(self.starts, t, side="right") - 1, 0)
        rows, since = self.table[k], t - self.starts[k]
        factors = [math.perm(p, order) * since ** (p - order) for p in range(order, rows.shape[0])]
        return jnp.stack(factors) @ rows[order:]

    def angle_at(self, t: Array) -> Array:
        """Return the angle, rad."""
        return self.columns_at(t, 0)[0]

    def speed_at(self, t: Array) -> Array:
        """Return the speed, rad/s."""
        return self.columns_at(t, 1)[0]

    def acceleration_at(self, t: Array) -> Array:
        """Return the acceleration, rad/s^2."""
        return self.columns_at(t, 2)[0]

    def with_errors(self, z: Array) -> RecordedDrive:
        """Return the drive whose angle has the errors `z` (m,)."""
        angle_table = self.table[:, :, :1] + (self.table[:, :, 1:] @ z)[:, :, None]
        return eqx.tree_at(lambda drive: drive.table, self, jnp.concatenate([angle_table, self.table[:, :, 1:]], axis=2))


class RotorSamples(NamedTuple):
    """Samples of a rotor.

    **Attributes**: `kind` of the channel; `time` (n,), s; `value` (n,), rad or rad/s; `marks` (n,): index of the mark of each
    pulse, otherwise 0; `spread` (n,): for pulses the speed, rad/s (the ratio of an error of the angle to an error of the time),
    otherwise 1; `scatter`: standard deviation of the values about a smooth curve, divided by `spread` (for pulses in s).
    """

    kind: str
    time: np.ndarray
    value: np.ndarray
    marks: np.ndarray
    spread: np.ndarray
    scatter: float


class RotorAngle(NamedTuple):
    """Angle of a rotor over time.

    **Attributes**

    - `drive` that turns the rotor by this angle
    - `spline` of the angle and its errors over time; None if the angle follows from the drive of the scene
    - `span`, s: first and last time at which the angle is known
    - `marked`: True if the zero of the angle is a mark on the rotor, the same in all runs
    - `error`, rad: root mean square of the standard error of the angle in the span
    - `left_out`, rad: part of `error` that the m errors do not contain
    - `notes`: sentences for the reader
    - `samples` from which the angle follows; None if it follows from the drive of the scene
    """

    drive: Drive
    spline: Any
    span: tuple[float, float]
    marked: bool
    error: float
    left_out: float
    notes: tuple[str, ...]
    samples: RotorSamples | None = None

    @property
    def error_count(self) -> int:
        """Number m of errors."""
        return self.drive.table.shape[2] - 1 if isinstance(self.drive, RecordedDrive) else 0

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the angle (rad) at times (n,)."""
        if self.spline is not None:
            return self.spline(time)[:, 0]
        return np.asarray(jax.vmap(lambda t: self.drive.rotor_angle(t, None))(time), dtype=float)

    def without_errors(self) -> Drive:
        """Return the drive without the errors of its angle."""
        if not isinstance(self.drive, RecordedDrive):
            return self.drive
        return eqx.tree_at(lambda drive: drive.table, self.drive, self.drive.table[:, :, :1])


def rotor_angles(scene: Scene, run: MeasuredRun) -> list[RotorAngle]:
    """Return the angle of the rotor of each exciter in a run, positive in the direction of rotation.

    Channels of pulses, angle or speed describe the rotor of the only exciter. Without such channels the drives must prescribe
    the angle.

    **Raises** `InputError` for a motor without such a channel, for a scene with several exciters and such a channel, and for
    fewer than 12 pulses or readings of the channel.
    """
    channel = run.rotor_channel
    if channel and len(scene.exciters) > 1:
        raise InputError(
            run.source,
            f"has the {channel.kind} of one rotor, but the scene has {len(scene.exciters)} exciters; "
            "identify needs a scene with one exciter for such a channel; otherwise remove the channel and prescribe the speeds",
        )
    if channel:
        return [_angle_of_channel(run, channel)]
    return [_angle_of_drive(scene, k, exciter, run) for k, exciter in enumerate(scene.exciters)]


def _angle_of_drive(scene: Scene, k: int, exciter: Exciter, run: MeasuredRun) -> RotorAngle:
    if not exciter.drive.ideal:
        raise InputError(
            run.source,
            f"has no channel of the rotor's angle, and {scene.prefix_of(k)}drive is {exciter.drive.kind!r}, whose speed "
            "depends on the machine; add a channel of kind pulses, angle or speed",
        )
    return RotorAngle(exciter.drive, None, (-math.inf, math.inf), False, 0.0, 0.0, ())


def _angle_of_channel(run: MeasuredRun, channel: Channel) -> RotorAngle:
    time, value = np.asarray(run.times[channel.name], float), np.asarray(run.values[channel.name], float)
    time, value = time[np.isfinite(value)], value[np.isfinite(value)]
    field = f"{run.source}: channel {channel.name!r}"
    if time.size < _MIN_PULSES:
        what = "pulses" if channel.kind == "pulses" else "readings"
        raise InputError(field, f"has {time.size} {what}; at least {_MIN_PULSES} are needed; record more turns")
    time = time - channel.delay
    notes: list[str] = []
    marks, spread, marked = np.zeros(time.size, int), np.ones(time.size), channel.kind == "angle"
    if channel.kind == "speed":
        value = np.abs(value)
        speed, scatter = fit_spline(time, value, jump_order=1)
        spline = speed.antiderivative()
    elif channel.kind == "angle":
        value = value * np.sign(value[-1] - value[0])
        spline, scatter = fit_spline(time, value, jump_order=2)
    else:
        tooth = _tooth_after_gap(value, channel.per_turn)
        value, marked = value - (tooth or 0), channel.per_turn == 1 or tooth is not None
        spline, scatter, value, marks, spread = fit_pulses(time, value, channel.per_turn)
        speed = spline(0.5 * (time[1:] + time[:-1]), 1)[:, 0]
        is_fast = np.abs(speed[1:]) > 0.2 * np.max(np.abs(speed))  # slower rotors excite almost no vibration
        change = float(np.max(np.abs(np.diff(speed) / speed[1:]), where=is_fast, initial=0.0))
        if change > _MAX_SPEED_CHANGE:
            notes.append(
                f"{field}: the speed changes by up to {100.0 * change:.0f} % from one pulse to the next, and the angle between "
                "them is uncertain; use more pulses per turn"
            )
    grid = spline(np.linspace(time[0], time[-1], 4 * spline.c.shape[0]))[:, 1:]
    sizes = np.sqrt(np.mean(grid**2, axis=0))
    error, left_out = float(np.linalg.norm(sizes)), float(np.linalg.norm(sizes[MAX_ERRORS:]))
    span = float(time[0]), float(time[-1])
    samples = RotorSamples(channel.kind, time, value, marks, spread, scatter)
    return RotorAngle(drive_of_spline(spline), spline, span, marked, error, left_out, tuple(notes), samples)


def _tooth_after_gap(number: np.ndarray, per_turn: int) -> int | None:
    """Return the number, 0 to `per_turn` - 1, of the tooth after the gap of a wheel; None for a wheel without a gap or with
    several gaps.

    **Arguments**: `number` (n,) of the pulses, of at least two turns.

    >>> _tooth_after_gap(np.array([0.0, 1.0, 3.0, 4.0, 5.0, 7.0, 8.0]), 4), _tooth_after_gap(np.arange(9.0), 4)
    (3, None)
    """
    is_missing = ~np.isin(np.arange(per_turn), number % per_turn)
    after = np.flatnonzero(np.roll(is_missing, 1) & ~is_missing)
    return int(after[0]) if after.size == 1 and number[-1] - number[0] >= 2 * per_turn else None


def drive_of_spline(spline: Any) -> RecordedDrive:
    """Return the drive whose angle and errors are the columns of a spline."""
    from scipy.interpolate import BSpline, PPoly  # slow to import

    pieces = [PPoly.from_spline(BSpline(spline.t, column, spline.k)) for column in spline.c.T[: 1 + MAX_ERRORS]]
    is_piece = np.diff(pieces[0].x) > 0.0
    coefficients = np.stack([each.c[::-1, is_piece].T for each in pieces], axis=2)
    return _drive_of(pieces[0].x[:-1][is_piece], coefficients, spline(np.unique(spline.t), 1)[:, 0])


def recorded_drive(time: np.ndarray, columns: Sequence[np.ndarray]) -> RecordedDrive:
    """Return the drive whose angle and errors are interpolated by polynomials of degree 5.

    **Arguments**: `time` (n,), s, evenly spaced; `columns`: three arrays (n, 1 + m): the angle and its m errors at these times,
    their first derivatives, and their second derivatives.
    """
    width = (time[-1] - time[0]) / (time.size - 1)
    value, slope, curvature = (each[:, : 1 + MAX_ERRORS] * width**order for order, each in enumerate(columns))
    low = np.stack([value[:-1], slope[:-1], 0.5 * curvature[:-1]], axis=1)
    ends = np.stack(
        [value[1:] - low.sum(axis=1), slope[1:] - low[:, 1] - 2.0 * low[:, 2], curvature[1:] - 2.0 * low[:, 2]], axis=1
    )
    high = np.array([[10.0, -4.0, 0.5], [-15.0, 7.0, -1.0], [6.0, -3.0, 0.5]]) @ ends
    coefficients = np.concatenate([low, high], axis=1) / width ** np.arange(DEGREE + 1.0)[:, None]
    return _drive_of(time[:-1], coefficients, columns[1][:, 0])


def _drive_of(starts: np.ndarray, coefficients: np.ndarray, speeds: np.ndarray) -> RecordedDrive:
    """Return the drive with polynomials (intervals, powers, 1 + m), padded to a power of two and to 1 + 8 k columns."""
    intervals, powers, count = coefficients.shape
    padded = 2 ** math.ceil(math.log2(intervals))
    table = np.zeros((padded, powers, 1 - (1 - count) // _ERROR_COUNT_STEP * _ERROR_COUNT_STEP))
    table[:intervals, :, :count] = coefficients
    starts = np.concatenate([starts, np.full(padded - intervals, np.inf)])
    return RecordedDrive(jnp.asarray(float(np.max(np.abs(speeds)))), jnp.asarray(table), jnp.asarray(starts))
