"""Decay of a recorded swing from one turning point to the next: the formula of ten periods."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn
from jaxvib.errors import InputError, quoted
from jaxvib.results.estimate import Estimate, interval
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum
from jaxvib.units import count

_LARGE_AMPLITUDE, _LARGE_AMPLITUDE_ERROR = np.pi / 3.0, 1e-3
"""Amplitude, rad, above which a relative error of the averaged formula and of the fitted arcs is assumed, and this error."""

_MAX_AMPLITUDE = np.pi / 2.0
"""Amplitude, rad, beyond which the error of the arcs fitted to the turning points is unknown. With 25 samples a second and
weak friction this error changed mu1 by 0.4 to 0.9 percent, up to three times the interval that follows from the noise."""


class TurningPoints(NamedTuple):
    """Turning points of a swing: `time` (K,) s, `angle` (K,) rad, its standard `error` (K,) rad, and the standard deviation
    `noise`, rad, of a sample."""

    time: np.ndarray
    angle: np.ndarray
    error: np.ndarray
    noise: float

    @property
    def amplitude(self) -> np.ndarray:
        """Half the distance from each turning point to the next, (K - 1,) rad; it does not depend on the zero of the angle."""
        return np.abs(np.diff(self.angle)) / 2.0


class Decrement(Result):
    """Result of the formula of ten periods, applied to every pair of swings of a record.

    **Attributes** (n pairs)

    - `viscous` mu1, N m s: an `Estimate`; typical: 3e-4 to 2e-3
    - `estimates` (n,): mu1 of each pair, first to last, N m s
    - `amplitude` (n,): amplitude of the first swing of each pair, rad
    - `scatter`: largest relative deviation of an estimate from the mean of all estimates
    - `drift`: mu1 of the last pair minus mu1 of the first pair, in standard errors
    - `period`, s
    - `periods`: number of periods between the two swings of a pair
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
        """Return mu1 with its interval as text."""
        return (
            f"over {self.periods} periods: mu1 {self.viscous.value:.5g} N m s, from {self.viscous.low:.5g} to "
            f"{self.viscous.high:.5g}; the values of {len(self.estimates)} pairs scatter by {self.scatter:.2g} (relative)"
            + (
                f", and drift by {self.drift:.2g} standard errors: the decay is not caused by viscous friction alone"
                if self.is_drifting
                else ""
            )
        )

    @property
    def is_drifting(self) -> bool:
        """True if noise does not explain the difference of the first and the last pair; the interval is then not valid for
        mu1."""
        return abs(self.drift) > 4.0

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot mu1 of each pair of swings, first to last."""
        from jaxvib.draw.results import points_chart  # slow import

        return points_chart(self.estimates[:, None], x_label="pair of swings", y_label="mu1, N m s", ax=ax)


def turning_points(record: Record) -> TurningPoints:
    """Return the turning points of a recorded swing, each from the samples within a sixth of a period before and after it.

    The arc c + a cos(v t) + b sin(v t) is fitted to these samples; its extremum is the turning point. With v = w sqrt(cos A),
    the fourth derivative of the arc at the turning point is also that of a large swing. w is the frequency of small swings, and
    A the amplitude. The noise is computed from the deviations of the samples from all these arcs.

    **Returns** `TurningPoints`. **Raises** `InputError` for a record with fewer than three turning points, or too few samples
    in a period.

    >>> import numpy as np, jaxvib as jv
    >>> t = np.arange(0.0, 3.0, 0.04)
    >>> found = turning_points(jv.Record(t, 0.1 * np.cos(2.0 * np.pi * t)))
    >>> np.round(found.time, 5).tolist(), np.round(found.angle, 5).tolist()
    ([0.5, 1.0, 1.5, 2.0, 2.5], [-0.1, 0.1, -0.1, 0.1, -0.1])

    Source: this package.
    """
    t, f = record.time, record.angle
    # Fourth differences of a smooth signal are negligible; those of white noise are sqrt(70) times as large as the noise.
    noise = float(np.median(np.abs(np.diff(f, 4)))) / 0.6745 / np.sqrt(70.0)
    peaks = _longest_regular_sequence(t, _alternating_extrema(f, max(8.0 * noise, 1e-3 * float(np.ptp(f)))))
    if len(peaks) < 3:
        raise InputError(record.name, f"has {len(peaks)} turning points; at least 3 are needed; record more of the swing")
    frequency = np.pi / float(np.median(np.diff(t[peaks])))
    ends = f[peaks]
    middle = float(np.mean((ends[:-2] + 2.0 * ends[1:-1] + ends[2:]) / 4.0))
    small = np.pi * (len(peaks) - 1) / float(np.sum(np.diff(t[peaks]) / period_stretch(np.abs(np.diff(ends)) / 2.0)))
    times, angles, gains, squares, degrees_of_freedom = [], [], [], 0.0, 0
    for k in peaks:
        if t[k] - t[0] < 0.5 / frequency or t[-1] - t[k] < 0.5 / frequency:
            continue
        size = min(abs(f[k] - middle), np.pi)
        phase_distance = np.abs(frequency * (t - t[k]))
        # The arc describes a large swing only close to the turning point; a record with few samples needs the whole sixth.
        near = phase_distance <= np.pi / 3.0 / (1.0 + size**2 / 3.0)
        near = near if np.count_nonzero(near) >= 9 else phase_distance <= np.pi / 3.0
        # Time x in units of 1/w and square = (v/w)^2, which is negative beyond 90 deg: the arc is then a hyperbolic cosine.
        square = float(np.cos(size))
        x = small * (t[near] - t[k])
        basis = _arcs(x, square)
        if len(x) < 5:
            raise InputError(
                record.name, f"has {len(x)} samples about the turning point at {t[k]:.4g} s; 5 are needed, about 15 in a period"
            )
        inverse = np.linalg.inv(basis.T @ basis)
        c, a, b = inverse @ (basis.T @ f[near])
        place = 0.0
        for _ in range(3):  # Newton's method: the middle sample is next to the turning point
            ((_, even, odd),) = _arcs(np.array([place]), square)
            place -= (a * odd + b * (1.0 - square * even)) / (a * (1.0 - square * even) - square * b * odd)
        (gradient,) = _arcs(np.array([place]), square)
        times.append(t[k] + place / small)
        angles.append(float(gradient @ np.array([c, a, b])))
        gains.append(gradient @ inverse @ gradient)
        squares += float(np.sum((f[near] - basis @ np.array([c, a, b])) ** 2))
        degrees_of_freedom += len(x) - 3
    if len(times) < 3:
        raise InputError(
            record.name,
            f"has {len(times)} turning points that are far enough from both ends; at least 3 are "
            "needed; record more of the swing",
        )
    noise = np.sqrt(squares / degrees_of_freedom)
    return TurningPoints(np.array(times), np.array(angles), noise * np.sqrt(gains), float(noise))


def _arcs(x: np.ndarray, square: float) -> np.ndarray:
    """Return 1, (1 - cos(v x))/v^2 and sin(v x)/v, (n, 3), for v^2 = `square`, positive or negative."""
    phase = np.sqrt(complex(square)) * x / np.pi
    return np.stack([np.ones_like(x), 0.5 * x**2 * (np.sinc(0.5 * phase) ** 2).real, x * np.sinc(phase).real], axis=1)


def period_stretch(amplitude: np.ndarray) -> np.ndarray:
    """Return the period of a swing of the `amplitude`, rad, divided by that of small swings: 1 + A^2/16 + 11 A^4/3072."""
    return 1.0 + amplitude**2 / 16.0 + 11.0 * amplitude**4 / 3072.0


def _alternating_extrema(f: np.ndarray, min_change: float) -> list[int]:
    """Return the indices of alternating maxima and minima, after each of which the angle `f` changes by more than `min_change`.

    The first and the last sample are not included.
    """
    extrema: list[int] = []
    high = low = 0
    rising: bool | None = None
    for k in range(1, f.size):
        high = k if f[k] > f[high] else high
        low = k if f[k] < f[low] else low
        if rising is not False and f[high] - f[k] > min_change:
            extrema.append(high)
            rising, low = False, k
        elif rising is not True and f[k] - f[low] > min_change:
            extrema.append(low)
            rising, high = True, k
    return [k for k in extrema if 0 < k < f.size - 1]


def _longest_regular_sequence(t: np.ndarray, peaks: list[int]) -> list[int]:
    """Return the longest sequence of turning points at regular intervals; noise at rest and the release by hand are
    excluded."""
    steps = np.diff(t[peaks])
    even = [True, *((steps[1:] < 1.6 * steps[:-1]) & (steps[1:] > 0.6 * steps[:-1])), False]
    cuts = [0, *(k for k, is_even in enumerate(even) if not is_even)]
    longest = int(np.argmax(np.diff(cuts))) if len(peaks) > 2 else 0
    return peaks[cuts[longest] : cuts[longest + 1] + 1] if len(peaks) > 2 else peaks


def require_uncertainty(instrument: object) -> None:
    """**Raises** `InputError` for a relative uncertainty of J that is not a number of at least 0 and less than 1."""
    if not isinstance(instrument, (int, float)) or not 0.0 <= instrument < 1.0:
        problem = "it is the relative uncertainty of J and must be at least 0 and less than 1"
        raise InputError("instrument", f"is {quoted(instrument)}; {problem}")


@validated
def ten_periods(
    pendulum: BearingPendulum, record: Record, *, periods: int = 10, instrument: float = 0.0, turns: TurningPoints | None = None
) -> Decrement:
    """Return mu1 from the decay of a swing over ten periods.

        mu1 = J ln(phi_1/phi_11) / (5 T)                                          (small swings)
        mu1 = J [G(phi_1) - G(phi_11)] / (10 T),     G' = sin A / (4 [E/K - cos^2(A/2)]) = 2/A - 5 A/48 - ...

    - The amplitude of small swings with viscous friction decays as exp(-mu1 t/(2 J)); the first line follows from this law
    - In one period, a large swing of amplitude A loses an energy of mu1 times the integral of the angular speed over the angle.
      With the complete elliptic integrals K and E of modulus sin(A/2) it follows that A' = -(mu1/J)/G'(A). The second line is
      the integral of this equation. This function computes the second line. Beyond 60 deg an error of 0.1 % is assumed, and the
      interval includes it
    - Beyond 90 deg the error of the turning points is unknown, and the interval is 0 to infinity; `identify` gives a finite
      interval in this case
    - Dry friction is neglected. If it is present, it increases the result by 4 T_f/(pi w A) (torque T_f of the friction,
      amplitude A, frequency w), more for smaller swings. The attribute `drift` then differs from 0 by several standard errors,
      and the interval is not valid for mu1. `identify` determines both the viscous and the dry friction

    **Arguments**

    - `pendulum`: a `BearingPendulum`, whose J is known
    - `record` of its swing; typical: 10 to 60 s, first amplitude 3 to 30 deg
    - `periods` between the two amplitudes; typical: 10 (the default). More periods average more noise and need a larger first
      swing
    - `instrument`: relative uncertainty of J, from ruler and scales. The half-width of the interval is
      sqrt(s^2 + (instrument mu1)^2), where s is the half-width without it; typical: 0.01 to 0.03 (default 0)
    - `turns`: the `turning_points` of the record; default: they are computed

    **Returns** `Decrement`; typical: mu1 of 3e-4 to 2e-3 N m s, 0.0015 in the source. **Raises** `InputError` if the record has
    fewer periods.

    >>> import numpy as np, jaxvib as jv
    >>> rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)
    >>> t = np.arange(0.0, 15.0, 0.04)
    >>> run = jv.swing(rod, t, angle="3 deg", viscous=1.5e-3)
    >>> round(jv.ten_periods(rod, jv.Record(t, run.angle)).viscous.value, 5)
    0.0015

    Source: Artyunin, Sumenkov 2019, equation (3).
    """
    require_uncertainty(instrument)
    n = 2 * count(periods, "periods")
    turns = turning_points(record) if turns is None else turns
    a, middles = turns.amplitude, (turns.time[1:] + turns.time[:-1]) / 2.0
    pairs = a.size - n
    if pairs < 1:
        problem = f"has {a.size / 2.0:g} periods between turning points"
        raise InputError(record.name, f"{problem}; {periods + 0.5:g} are needed; record longer or give fewer periods")
    span = middles[n : n + pairs] - middles[:pairs]
    factor = 2.0 * float(pendulum.total_inertia) / span
    estimates = factor * _log_decrement(a[:pairs], a[n:])

    # The error of an angle enters every pair that contains it; the derivative of G(a)/2 by the two angles is +-G'(a)/4.
    slopes = np.zeros((pairs, turns.angle.size))
    signs = np.sign(np.diff(turns.angle))
    for k in range(pairs):
        for j, sign in ((k, 1.0), (k + n, -1.0)):
            change = sign * factor[k] * signs[j] * float(_slope(a[j])) / 4.0
            slopes[k, j + 1] += change
            slopes[k, j] -= change
    covariance = (slopes * turns.error**2) @ slopes.T
    value, error = float(np.mean(estimates)), float(np.sqrt(np.mean(covariance)))
    variance_of_drift = covariance[0, 0] + covariance[-1, -1] - 2.0 * covariance[0, -1]
    viscous = interval(value, error, 1.959964, float(np.hypot(instrument, _LARGE_AMPLITUDE_ERROR * (a[0] > _LARGE_AMPLITUDE))))
    if a[0] > _MAX_AMPLITUDE:
        viscous = Estimate(value, np.inf, 0.0, np.inf)
    return Decrement(
        viscous=viscous,
        estimates=estimates,
        amplitude=a[:pairs],
        scatter=float(np.max(np.abs(estimates / value - 1.0))),
        drift=float((estimates[-1] - estimates[0]) / np.sqrt(variance_of_drift)) if pairs > 1 else 0.0,
        period=float(np.mean(span)) / periods,
        periods=periods,
    )


def _log_decrement(large: np.ndarray, small: np.ndarray) -> np.ndarray:
    """Return [G(large) - G(small)]/2 of two amplitudes, rad: ln(large/small) of small swings."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    at = 0.5 * (large + small)[:, None] + 0.5 * (large - small)[:, None] * nodes
    return np.log(large / small) + 0.25 * (large - small) * np.sum(weights * (_slope(at) - 2.0 / at), axis=1)


def _slope(amplitude: np.ndarray) -> np.ndarray:
    """Return G'(A), 1/rad, see `ten_periods`."""
    from scipy.special import ellipe, ellipk  # slow to import

    m = np.sin(0.5 * amplitude) ** 2
    safe = np.maximum(m, 1e-6)
    exact = np.sin(amplitude) / (4.0 * (ellipe(safe) / ellipk(safe) - 1.0 + safe))
    return np.where(m < 1e-6, 2.0 / amplitude - 5.0 * amplitude / 48.0, exact)
