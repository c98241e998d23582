"""How fast a recorded swing decays from one turning point to the next: the formula of ten periods."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.errors import InputError
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum
from jaxvib.units import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn

__all__ = ["Decrement", "Estimate", "TurningPoints", "ten_periods", "turning_points"]


class Estimate(NamedTuple):
    """A number from measurements: its `value`, its standard `error` from the record's noise, and the interval from
    `low` to `high` that holds it with a probability of 95 %, the instruments' share counted."""

    value: float
    error: float
    low: float
    high: float


class TurningPoints(NamedTuple):
    """Where a swing turns: `time` (K,) s, `angle` (K,) rad, its standard `error` (K,) rad, and a sample's `noise` rad."""

    time: np.ndarray
    angle: np.ndarray
    error: np.ndarray
    noise: float

    @property
    def amplitude(self) -> np.ndarray:
        """(K - 1,) rad: half the way from each turning point to the next, which any zero of the angle leaves as it is."""
        return np.abs(np.diff(self.angle)) / 2.0


class Decrement(Result):
    """The formula of ten periods, on every pair of swings that a record has.

    **Attributes**: `viscous` mu1, N m s, an `Estimate`; `estimates` (n,) N m s, one a pair, first to last; `amplitude` (n,) rad
    at the start of each; `scatter`: largest deviation of one from their mean, relative; `drift`: by how many standard errors
    the last pair's mu1 is above the first's; `period` s; `periods` between the two of a pair.
    """

    status = Computed.done

    viscous: Estimate = eqx.field(metadata=in_unit("N m s"))
    estimates: np.ndarray = eqx.field(metadata=in_unit("N m s", "pair"))
    amplitude: np.ndarray = eqx.field(metadata=in_unit("rad", "pair"))
    scatter: float = eqx.field(metadata=in_unit(""))
    drift: float = eqx.field(metadata=in_unit(""))
    period: float = eqx.field(metadata=in_unit("s"))
    periods: int = eqx.field(metadata=in_unit(""))

    def summary(self) -> str:
        """The number with its interval, for a person to read."""
        return (
            f"by {self.periods} periods: mu1 {self.viscous.value:.5g} N m s, from {self.viscous.low:.5g} to "
            f"{self.viscous.high:.5g}; {len(self.estimates)} pairs scatter by {self.scatter:.2g}"
        )

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """mu1 of each pair of swings, first to last.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.results import points_chart  # slow to import: only who draws pays

        return points_chart(self.estimates[:, None], across="pair of swings", up="mu1, N m s", ax=ax)


def turning_points(record: Record) -> TurningPoints:
    """The turning points of a recorded swing, each from all samples within a sixth of a period about it.

    There the angle is fitted by c + a cos + b sin of the swing's own frequency, whose extremum is the turning point; the
    spread of the samples about all these arcs gives the noise.

    **Returns** `TurningPoints`. **Raises** `InputError` for a record with fewer than three turning points, or too few samples
    in a period.

    >>> import numpy as np, jaxvib as jv
    >>> t = np.arange(0.0, 3.0, 0.04)
    >>> found = turning_points(jv.Record(t, 0.1 * np.cos(2.0 * np.pi * t)))
    >>> np.round(found.time, 6).tolist(), np.round(found.angle, 6).tolist()
    ([0.5, 1.0, 1.5, 2.0, 2.5], [-0.1, 0.1, -0.1, 0.1, -0.1])

    Source: ours.
    """
    t, f = record.time, record.angle
    rough = np.diff(f, 4)
    noise = float(np.median(np.abs(rough))) / 0.6745 / np.sqrt(70.0)  # a smooth signal has hardly a fourth difference
    peaks = _regular(t, _alternating(f, max(8.0 * noise, 1e-3 * float(np.ptp(f)))))
    if len(peaks) < 3:
        raise InputError(
            record.name, f"turns {len(peaks)} times; at least 3 turning points are needed, record more of the swing"
        )
    frequency = np.pi / float(np.median(np.diff(t[peaks])))
    times, angles, gains, squares, spare = [], [], [], 0.0, 0
    for k in peaks:
        near = np.abs(frequency * (t - t[k])) <= np.pi / 3.0
        if t[k] - t[0] < 0.5 / frequency or t[-1] - t[k] < 0.5 / frequency:
            continue
        x = frequency * (t[near] - t[k])
        basis = np.stack([np.ones_like(x), np.cos(x), np.sin(x)], axis=1)
        if len(x) < 5:
            raise InputError(
                record.name, f"has {len(x)} samples about the turning point at {t[k]:.4g} s; 5 are needed, about 15 in a period"
            )
        inverse = np.linalg.inv(basis.T @ basis)
        c, a, b = inverse @ (basis.T @ f[near])
        size = np.hypot(a, b)
        gradient = np.array([1.0, a / size, b / size]) * np.array([1.0, np.sign(a), np.sign(a)])
        times.append(t[k] + np.arctan2(np.sign(a) * b, abs(a)) / frequency)
        angles.append(c + np.sign(a) * size)
        gains.append(gradient @ inverse @ gradient)
        squares += float(np.sum((f[near] - basis @ np.array([c, a, b])) ** 2))
        spare += len(x) - 3
    if len(times) < 3:
        raise InputError(
            record.name, f"shows {len(times)} whole turning points; at least 3 are needed, record more of the swing"
        )
    noise = np.sqrt(squares / spare)
    return TurningPoints(np.array(times), np.array(angles), noise * np.sqrt(gains), float(noise))


def _alternating(f: np.ndarray, least: float) -> list[int]:
    """Indices of maxima and minima in turn, each confirmed by a way back of `least`; the two ends are none."""
    found: list[int] = []
    high = low = 0
    rising: bool | None = None
    for k in range(1, f.size):
        high = k if f[k] > f[high] else high
        low = k if f[k] < f[low] else low
        if rising is not False and f[high] - f[k] > least:
            found.append(high)
            rising, low = False, k
        elif rising is not True and f[k] - f[low] > least:
            found.append(low)
            rising, high = True, k
    return [k for k in found if 0 < k < f.size - 1]


def _regular(t: np.ndarray, peaks: list[int]) -> list[int]:
    """The longest stretch of turning points in step: noise about a pendulum at rest, or the hand that let go, is not."""
    steps = np.diff(t[peaks])
    even = [True, *((steps[1:] < 1.6 * steps[:-1]) & (steps[1:] > 0.6 * steps[:-1])), False]
    cuts = [0, *(k for k, is_even in enumerate(even) if not is_even)]
    longest = int(np.argmax(np.diff(cuts))) if len(peaks) > 2 else 0
    return peaks[cuts[longest] : cuts[longest + 1] + 1] if len(peaks) > 2 else peaks


def ten_periods(
    pendulum: BearingPendulum, record: Record, *, periods: int = 10, instrument: float = 0.0, turns: TurningPoints | None = None
) -> Decrement:
    """mu1 from how much a swing shrinks over ten periods.

        mu1 = J ln(phi_1/phi_11) / (5 T)

    Small swings with viscous friction shrink by exp(-mu1 t/(2 J)), hence 2 J ln(ratio)/(10 T). It is exact for neither large
    swings nor dry friction: dry friction adds 4 T_f/(pi w A) to mu1 (torque T_f, amplitude A, frequency w), more the smaller
    the swing; `drift` shows it. `identify` has neither limit.

    **Arguments**: `periods` between the two amplitudes; `instrument`: relative uncertainty of J, from ruler and scales, added
    to the interval in squares; `turns` of the record, if known already.

    **Returns** `Decrement`. **Raises** `InputError` where the record is shorter.

    >>> import numpy as np, jaxvib as jv
    >>> rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)
    >>> t = np.arange(0.0, 15.0, 0.04)
    >>> run = jv.swing(rod, t, angle="3 deg", viscous=1.5e-3)
    >>> round(jv.ten_periods(rod, jv.Record(t, run.angle)).viscous.value, 5)
    0.0015

    Source: Artyunin, Sumenkov 2019, equation (3).
    """
    n = 2 * count(periods, "periods")
    turns = turning_points(record) if turns is None else turns
    a, when = turns.amplitude, turns.time
    pairs = a.size - n
    if pairs < 1:
        there = f"has {a.size / 2.0:g} periods between turning points"
        raise InputError(record.name, f"{there}; {periods + 0.5:g} are needed, record longer or ask for fewer periods")
    span = when[n : n + pairs] - when[:pairs]
    factor = 2.0 * float(pendulum.total_inertia) / span
    estimates = factor * np.log(a[:pairs] / a[n:])

    # Errors of the angles go into every pair they are part of; the derivative of ln a by the two angles is +-1/(2 a).
    slopes = np.zeros((pairs, turns.angle.size))
    signs = np.sign(np.diff(turns.angle))
    for k in range(pairs):
        for where, sign in ((k, 1.0), (k + n, -1.0)):
            change = sign * factor[k] * signs[where] / (2.0 * a[where])
            slopes[k, where + 1] += change
            slopes[k, where] -= change
    covariance = (slopes * turns.error**2) @ slopes.T
    value, error = float(np.mean(estimates)), float(np.sqrt(np.mean(covariance)))
    apart = covariance[0, 0] + covariance[-1, -1] - 2.0 * covariance[0, -1]
    return Decrement(
        viscous=interval(value, error, 1.959964, instrument),
        estimates=estimates,
        amplitude=a[:pairs],
        scatter=float(np.max(np.abs(estimates / value - 1.0))),
        drift=float((estimates[-1] - estimates[0]) / np.sqrt(apart)) if pairs > 1 else 0.0,
        period=float(np.mean(span)) / periods,
        periods=periods,
    )


def interval(value: float, error: float, quantile: float, instrument: float) -> Estimate:
    """The estimate with its interval: noise and instruments in squares."""
    half = float(np.hypot(quantile * error, instrument * value))
    return Estimate(value, error, value - half, value + half)
