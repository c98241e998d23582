"""Angle of a rotor over time, from the pulses of a tachometer, an angle, a speed, or a prescribed drive.

Pulses and samples are fitted by a spline of degree 5 with evenly spaced knots. The number of knots minimizes the Bayesian
information criterion. The second derivative of the spline, on which the force of an unbalance depends, is smooth. If a wheel
has several marks, each mark has an unknown offset from its place, because marks are unevenly spaced. All pulses may be early or
late by a common time with the standard error of one pulse, because recorders round times up, down, or to the nearest sample.
The functions e_m(t) follow from the covariance of the coefficients:

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
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.drives.drive import Drive, IdealDrive
from jaxvib.machine.numbers import unit
from jaxvib.machine.scene import Exciter, Scene

_DEGREE = 5
_MIN_PULSES = 12
"""Number of pulses below which the angle between them is unknown."""

_MAX_INTERVALS = 512
"""Largest number of intervals of a spline."""

_MAX_SPEED_CHANGE = 0.1
"""Relative change of the speed between two pulses above which the angle between them is uncertain."""

_MIN_SPEED = 0.02
"""Speed relative to the largest one below which the error of a pulse's angle is not assumed to decrease further."""

MAX_ERRORS = 64
"""Largest number of errors z_m of an angle."""

_ERRORS_TOGETHER = 8
"""The number of errors is a multiple of this number, so that runs with nearly equal splines share a program."""


class RecordedDrive(IdealDrive):
    """Drive that follows a recorded angle, given by polynomials of the relative time in each of equal intervals.

    **Attributes**: `speed`, rad/s: the largest absolute speed; `table` (intervals, powers, 1 + m): coefficients of the angle
    and of its errors e_m; `begin`, s: start of the first interval; `width`, s, of all intervals; `last`: index of the last
    interval (further rows of the table are padding).
    """

    speed: Array = eqx.field(metadata=unit("rad/s"))
    table: Array = eqx.field(metadata=unit("rad"))
    begin: Array = eqx.field(metadata=unit("s"))
    width: Array = eqx.field(metadata=unit("s"))
    last: Array
    kind: str = eqx.field(static=True, default="recorded", kw_only=True)

    def columns_at(self, t: Array, order: int) -> Array:
        """Return the derivatives of the given `order` of the angle and of its errors e_m (1 + m,) at time `t`; order 0: the
        values."""
        place = (t - self.begin) / self.width
        k = jnp.clip(jnp.floor(place), 0.0, self.last)
        rows = self.table[k.astype(int)]
        factors = [math.perm(p, order) * (place - k) ** (p - order) for p in range(order, rows.shape[0])]
        return jnp.stack(factors) @ rows[order:] / self.width**order

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
    pulse, otherwise 0; `spread` (n,): for pulses the speed, rad/s, by which an error of time becomes an error of the angle,
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
    channels = run.of_kind("pulses", "angle", "speed")
    if channels and len(scene.exciters) > 1:
        raise InputError(
            run.source,
            f"has the {channels[0].kind} of one rotor, but the scene has {len(scene.exciters)} exciters; "
            "identify needs a scene with one exciter for such a channel; otherwise remove the channel and prescribe the speeds",
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
    return RotorAngle(exciter.drive, None, (-math.inf, math.inf), False, 0.0, 0.0, ())


def _measured(run: MeasuredRun, channel: Channel) -> RotorAngle:
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
        speed, scatter = fit_spline(time, value)
        spline = speed.antiderivative()
    elif channel.kind == "angle":
        value = value * np.sign(value[-1] - value[0])
        spline, scatter = fit_spline(time, value)
    else:
        tooth = _tooth_after_gap(value, channel.per_turn)
        value, marked = value - (tooth or 0), channel.per_turn == 1 or tooth is not None
        marks = np.unique(value % channel.per_turn, return_inverse=True)[1]  # without those of missing teeth
        value = 2.0 * np.pi * value / channel.per_turn
        rough_speed = np.convolve(np.pad(np.gradient(value, time), 2, mode="edge"), np.full(5, 0.2), mode="valid")
        spread = np.maximum(rough_speed, _MIN_SPEED * np.max(rough_speed))  # the errors of pulses are errors of their times
        spline, scatter = fit_spline(time, value, marks, spread)
        speed = spline(0.5 * (time[1:] + time[:-1]), 1)[:, 0]
        is_fast = np.abs(speed[1:]) > 0.2 * np.max(np.abs(speed))  # slower rotors excite almost no vibration
        change = float(np.max(np.abs(np.diff(speed) / speed[1:]), where=is_fast, initial=0.0))
        if change > _MAX_SPEED_CHANGE:
            notes.append(
                f"{field}: the speed changes by up to {change:.0%} from one pulse to the next, and the angle between them is "
                "uncertain; use more pulses per turn"
            )
    grid = spline(np.linspace(time[0], time[-1], 4 * spline.c.shape[0]))[:, 1:]
    sizes = np.sqrt(np.mean(grid**2, axis=0))
    error, left_out = float(np.linalg.norm(sizes)), float(np.linalg.norm(sizes[MAX_ERRORS:]))
    span = float(time[0]), float(time[-1])
    knots, samples = np.unique(spline.t), RotorSamples(channel.kind, time, value, marks, spread, scatter)
    drive = recorded_drive(knots, [spline(knots, order) for order in range(3)])
    return RotorAngle(drive, spline, span, marked, error, left_out, tuple(notes), samples)


def _tooth_after_gap(number: np.ndarray, per_turn: int) -> int | None:
    """Return the number, 0 to `per_turn` - 1, of the tooth after the gap of a wheel; None without a gap, if no tooth differs
    from the others.

    **Arguments**: `number` (n,) of the pulses, of at least two turns.

    >>> _tooth_after_gap(np.array([0.0, 1.0, 3.0, 4.0, 5.0, 7.0, 8.0]), 4), _tooth_after_gap(np.arange(9.0), 4)
    (3, None)
    """
    is_missing = ~np.isin(np.arange(per_turn), number % per_turn)
    after = np.flatnonzero(np.roll(is_missing, 1) & ~is_missing)
    return int(after[0]) if after.size == 1 and number[-1] - number[0] >= 2 * per_turn else None


def recorded_drive(time: np.ndarray, columns: Sequence[np.ndarray]) -> RecordedDrive:
    """Return the drive whose angle and errors are interpolated by polynomials of degree 5.

    **Arguments**: evenly spaced times (n,), s; `columns`: three arrays (n, 1 + m) with the angle and its m errors at these
    times and with their first and second derivatives.
    """
    count, intervals, width = min(1 + MAX_ERRORS, columns[0].shape[1]), time.size - 1, (time[-1] - time[0]) / (time.size - 1)
    value, slope, curvature = (each[:, :count] * width**order for order, each in enumerate(columns))
    table = np.zeros(
        (2 ** math.ceil(math.log2(intervals)), _DEGREE + 1, 1 - (1 - count) // _ERRORS_TOGETHER * _ERRORS_TOGETHER)
    )
    low = np.stack([value[:-1], slope[:-1], 0.5 * curvature[:-1]], axis=1)
    ends = np.stack(
        [value[1:] - low.sum(axis=1), slope[1:] - low[:, 1] - 2.0 * low[:, 2], curvature[1:] - 2.0 * low[:, 2]], axis=1
    )
    table[:intervals, :3, :count] = low
    table[:intervals, 3:, :count] = np.array([[10.0, -4.0, 0.5], [-15.0, 7.0, -1.0], [6.0, -3.0, 0.5]]) @ ends
    speed = np.max(np.abs(columns[1][:, 0]))
    speed, begin, width, last = (jnp.asarray(float(each)) for each in (speed, time[0], width, intervals - 1))
    return RecordedDrive(speed, jnp.asarray(table), begin, width, last)


def fit_spline(
    time: np.ndarray, value: np.ndarray, marks: np.ndarray | None = None, rates: np.ndarray | None = None
) -> tuple[Any, float]:
    """Return a smoothing spline of degree 5 with 1 + m columns (the values and their m errors), and the scatter.

    The scatter is the standard deviation of the values about the spline; with `rates` it is the standard deviation of the
    times, s. The errors are principal components of the covariance of the coefficients, the largest first.

    **Arguments**: `time` (n,) s, ascending; `value` (n,); `marks` (n,): index of the mark of each value; each mark has an
    unknown offset, 0 on average; `rates` (n,): time derivatives of the values, for values whose errors are errors of their
    times. A common delay of all times is then included in the covariance.

    >>> t = np.linspace(0.0, 2.0, 200)
    >>> spline, _ = fit_spline(t, 30.0 * t**2 + 1e-3 * np.random.default_rng(0).normal(size=t.size))
    >>> bool(abs(spline(1.0, 2)[0] - 60.0) < 0.1), bool(5e-5 < np.linalg.norm(spline(1.0)[1:]) < 5e-4)
    (True, True)
    """
    from scipy.interpolate import BSpline  # slow to import

    weights = np.ones(time.size) if rates is None else np.mean(rates) / rates
    offsets = _mark_offsets(np.zeros(time.size, int) if marks is None else marks, weights)
    fits = []
    intervals = 1
    while intervals <= min(_MAX_INTERVALS, time.size // 4):
        fits.append(_fit_knots(time, value * weights, weights, offsets, intervals))
        intervals = max(intervals + 1, int(1.4 * intervals))
    best = min(fits, key=lambda each: each.criterion)
    covariance, scatter = best.covariance(), math.sqrt(best.variance) / (1.0 if rates is None else float(np.mean(rates)))
    if rates is not None:
        delay_column = scatter * _derivative(best)
        covariance += np.outer(delay_column, delay_column)
    sizes, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    grid = BSpline.design_matrix(np.linspace(time[0], time[-1], 4 * len(best.coefficients)), best.knots, _DEGREE)
    errors = root @ np.linalg.svd(grid @ root, full_matrices=False)[2].T
    return BSpline(best.knots, np.concatenate([best.coefficients[:, None], errors], axis=1), _DEGREE), scatter


class _Offsets(NamedTuple):
    """Offsets of all marks but the first, whose offset is minus their sum.

    **Attributes**: `columns` (n, o): sparse matrix of the weighted values by the offsets; `gram` (o, o): its normal equations.
    """

    columns: Any
    gram: np.ndarray


def _mark_offsets(marks: np.ndarray, weights: np.ndarray) -> _Offsets:
    from scipy.sparse import csr_matrix  # slow to import

    count, first, others = int(np.max(marks)), np.flatnonzero(marks == 0), np.flatnonzero(marks)
    rows = np.concatenate([others, np.repeat(first, count)])
    columns = np.concatenate([marks[others] - 1, np.tile(np.arange(count), first.size)])
    entries = np.concatenate([weights[others], -np.repeat(weights[first], count)])
    squares = np.bincount(marks, weights**2)
    return _Offsets(csr_matrix((entries, (rows, columns)), shape=(marks.size, count)), np.diag(squares[1:]) + squares[0])


class _KnotsFit(NamedTuple):
    """Fit of a spline with given `knots`.

    **Attributes**: `coefficients` (k,) of the spline; Bayesian information `criterion`; `variance` of the values; `band`:
    diagonals of the normal equations N of the coefficients; `offset_changes` (k, o): N^-1 B, where B (k, o) couples the
    coefficients with the o offsets; `offset_covariance` (o, o): inverse of the Schur complement of N, which is the covariance
    of the offsets divided by the variance.
    """

    knots: np.ndarray
    coefficients: np.ndarray
    criterion: float
    variance: float
    band: np.ndarray
    offset_changes: np.ndarray
    offset_covariance: np.ndarray

    def covariance(self) -> np.ndarray:
        """Return the covariance (k, k) of the coefficients."""
        from scipy.linalg import solveh_banded  # slow to import

        inverse_band = solveh_banded(self.band, np.eye(len(self.coefficients)), lower=True)
        return self.variance * (inverse_band + self.offset_changes @ self.offset_covariance @ self.offset_changes.T)


def _derivative(spline_fit: _KnotsFit) -> np.ndarray:
    """Return the coefficients (k,) of the spline with the same knots that interpolates the derivative."""
    from scipy.interpolate import BSpline  # slow to import

    places = np.lib.stride_tricks.sliding_window_view(spline_fit.knots[1:-1], _DEGREE).mean(axis=1)
    places = np.clip(places, spline_fit.knots[0], spline_fit.knots[-1])  # rounding errors
    basis = BSpline.design_matrix(places, spline_fit.knots, _DEGREE).toarray()
    return np.linalg.solve(basis, BSpline(spline_fit.knots, spline_fit.coefficients, _DEGREE)(places, 1))


def _fit_knots(time: np.ndarray, value: np.ndarray, weights: np.ndarray, offsets: _Offsets, intervals: int) -> _KnotsFit:
    """Return the fit of weighted values by a spline with equal intervals."""
    from scipy.interpolate import BSpline  # slow to import
    from scipy.linalg import solveh_banded
    from scipy.sparse import diags

    n = time.size
    knots = np.concatenate([[time[0]] * _DEGREE, np.linspace(time[0], time[-1], intervals + 1), [time[-1]] * _DEGREE])
    basis: Any = diags(weights) @ BSpline.design_matrix(time, knots, _DEGREE)
    gram = basis.T @ basis
    size, count = gram.shape[0], gram.shape[0] + len(offsets.gram)
    band = np.stack([np.pad(gram.diagonal(k), (0, k)) for k in range(_DEGREE + 1)])
    band[0] += 1e-12 * np.mean(band[0])  # otherwise the matrix is singular for intervals without a value
    coupling = (basis.T @ offsets.columns).toarray()
    offset_changes = solveh_banded(band, coupling, lower=True) if coupling.size else coupling
    offset_covariance = np.linalg.inv(offsets.gram - coupling.T @ offset_changes)
    coefficients, offset_values, residuals = np.zeros(size), np.zeros(len(offsets.gram)), value
    for _ in range(2):  # the second solution corrects rounding errors of the first
        without_offsets = solveh_banded(band, basis.T @ residuals, lower=True)
        step = offset_covariance @ (offsets.columns.T @ (residuals - basis @ without_offsets))
        coefficients, offset_values = coefficients + without_offsets - offset_changes @ step, offset_values + step
        residuals = value - basis @ coefficients - offsets.columns @ offset_values
    square_sum = float(residuals @ residuals)
    criterion = n * math.log(max(square_sum / n, 1e-26)) + count * math.log(n)
    return _KnotsFit(knots, coefficients, criterion, square_sum / max(n - count, 1), band, offset_changes, offset_covariance)
