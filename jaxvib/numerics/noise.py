"""Noise of measured samples: its autoregressive models, outliers, bounds, and uncertainties of fits under coloured noise.

A least-squares fit takes account of outliers and bounds by modified residuals. Let psi(e) be the score of a residual e: the
negative derivative of the logarithm of its probability density. The modified residuals are psi(e)/mean(psi'), and their
standard deviation is sqrt(mean(psi^2))/mean(psi'). The least-squares fit with them has its minimum where the probability of the
readings is greatest, and its covariance is that of a fit with this score (Huber 1981).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

_MAX_ORDER = 40
"""Largest order of an autoregressive model."""

_COLOUR_GAIN = 10.0
"""Difference of the information criteria of white and coloured noise above which noise counts as coloured. A fit takes up part
of the noise at the natural frequencies of its model, which leaves gaps in the spectrum of the residuals. In a short record
these gaps look like coloured noise, and a filter for it makes standard errors too small. With 400 white residuals of a fit with
17 unknowns, the difference is larger in 1 of 1000 cases."""

_FREQUENCIES = 2**14
"""Number of frequencies at which a spectral density is evaluated."""

_EM_ITERATIONS = 40
"""Number of iterations of the expectation-maximization algorithm for the distribution of outliers."""

_MAX_COMPARED = 100_000
"""Largest number of residuals from which the distribution of outliers is estimated."""

_OUTLIER_DISTANCE = 6.0
"""Distance of an outlier from the samples around it, in standard deviations."""

_NEIGHBORS = 2
"""Number of samples on each side of an outlier with which it is compared."""


class Noise(NamedTuple):
    """Noise of the readings of a channel: an autoregressive process driven by white noise, a part of which are outliers.

    **Attributes**

    - `taps` (1, a_1, ...): coefficients of the whitening filter, which turns the noise into white noise
    - `deviation`: standard deviation of the white noise without outliers
    - `outliers`: share of outliers among the white noise, 0 to 1
    - `width`: standard deviation of the outliers divided by `deviation`
    """

    taps: np.ndarray
    deviation: float
    outliers: float = 0.0
    width: float = 1.0


def resampled(noise: Noise, ratio: float) -> Noise:
    """Return noise with the same spectral density at a sampling step that is `ratio` times as long. The result has no outliers.

    Above the highest frequency of the given noise, its density is that at this frequency. The coefficients follow from the
    covariances at the new step by the Yule-Walker equations.

    >>> white = resampled(Noise(np.ones(1), 3.0), 9.0)
    >>> white.taps.tolist(), white.deviation
    ([1.0], 1.0)
    >>> resampled(Noise(np.array([1.0, -0.9]), 1.0), 1.0).taps.round(6).tolist()
    [1.0, -0.9]
    """
    from scipy.linalg import solve_toeplitz  # slow to import

    if len(noise.taps) == 1:
        return Noise(noise.taps, noise.deviation / math.sqrt(ratio))
    order = len(noise.taps) - 1 if ratio == 1.0 else _MAX_ORDER
    frequency = (np.arange(_FREQUENCIES) + 0.5) / (2.0 * _FREQUENCIES * ratio)  # per old step
    density = np.abs(np.exp(-2j * np.pi * np.minimum(frequency, 0.5)[:, None] * np.arange(len(noise.taps))) @ noise.taps) ** -2
    waves = np.cos(2.0 * np.pi * ratio * np.arange(order + 1)[:, None] * frequency)
    covariance = noise.deviation**2 / ratio * (waves @ density) / _FREQUENCIES
    taps = np.asarray(solve_toeplitz(covariance[:-1], -covariance[1:]))
    return Noise(np.concatenate([[1.0], taps]), math.sqrt(covariance[0] + float(covariance[1:] @ taps)))


def noise_of(residual: np.ndarray) -> Noise:
    """Return the noise of residuals (n,); samples that are NaN are left out.

    >>> rng = np.random.default_rng(0)
    >>> noise = rng.normal(size=8000)
    >>> noise_of(noise).outliers
    0.0
    >>> noise[::50] += rng.normal(size=160) * 20.0
    >>> estimate = noise_of(noise)
    >>> estimate.taps.tolist(), round(estimate.outliers, 2), bool(0.95 < estimate.deviation < 1.05)
    ([1.0], 0.02, True)
    """
    taps, deviation = autoregression(residual, ~is_outlier(residual))
    white = np.convolve(np.where(np.isfinite(residual), residual, 0.0), taps)[: residual.size]
    valid = np.convolve(~np.isfinite(residual), np.ones(len(taps)))[: residual.size] < 0.5
    core, share, width = outliers_of(white[valid][len(taps) - 1 :])
    return Noise(taps, core, share, width) if share > 0.0 else Noise(taps, deviation)


def is_outlier(residual: np.ndarray) -> np.ndarray:
    """Return True for samples (n,) far from the median of the samples around them; samples that are NaN are left out.

    >>> residual = np.random.default_rng(0).normal(size=1000)
    >>> residual[[200, 500]] = 50.0
    >>> np.flatnonzero(is_outlier(residual)).tolist()
    [200, 500]
    """
    present = np.flatnonzero(np.isfinite(residual))
    values, flags = residual[present], np.zeros(residual.size, bool)
    if np.max(np.abs(values), initial=0.0) > _OUTLIER_DISTANCE * _spread(values):
        around = np.lib.stride_tricks.sliding_window_view(np.pad(values, _NEIGHBORS, mode="edge"), 2 * _NEIGHBORS + 1)
        distance = values - np.median(around, axis=1)
        flags[present] = np.abs(distance) > _OUTLIER_DISTANCE * max(_spread(distance), 1e-300)
    return flags


def _spread(values: np.ndarray) -> float:
    """Return the standard deviation of normally distributed values, from the median of their absolute values."""
    return 1.4826 * float(np.median(np.abs(values))) if values.size else 0.0


def outliers_of(white: np.ndarray) -> tuple[float, float, float]:
    """Return the distribution of outliers in white noise (n,).

    **Returns** the standard deviation of the noise without outliers, the share of outliers, and the standard deviation of the
    outliers divided by that of the others. The share is 0 if a distribution with outliers is not more probable than the normal
    distribution.

    >>> rng = np.random.default_rng(0)
    >>> white = rng.normal(size=4000)
    >>> outliers_of(white)[1]
    0.0
    >>> white[:80] *= 20.0
    >>> deviation, share, width = outliers_of(white)
    >>> bool(abs(deviation - 1.0) < 0.05), bool(0.015 < share < 0.025), bool(15.0 < width < 25.0)
    (True, True, True)
    """
    white = white[:: -(-white.size // _MAX_COMPARED) or 1]
    variance = float(np.mean(white**2)) if white.size else 0.0
    if variance == 0.0 or float(np.mean(white**4)) < (3.0 + 3.0 * math.sqrt(24.0 / white.size)) * variance**2:
        return math.sqrt(variance), 0.0, 1.0
    likelihood_of_normal = -0.5 * white.size * (1.0 + math.log(variance)) + math.log(white.size)
    core, share, width = max(_spread(white), 1e-3 * math.sqrt(variance)), 0.05, 5.0
    for _ in range(_EM_ITERATIONS):
        outlying = _outlying(white / core, share, width)
        share = float(np.mean(outlying))
        core = math.sqrt(float(np.sum((1.0 - outlying) * white**2)) / (white.size * (1.0 - share)))
        width = max(math.sqrt(float(np.sum(outlying * white**2)) / (white.size * max(share, 1e-12))) / core, 1.5)
    square = (white / core) ** 2
    mixed = np.logaddexp(math.log(1.0 - share) - 0.5 * square, math.log(max(share, 1e-300) / width) - 0.5 * square / width**2)
    if float(np.sum(mixed)) - white.size * math.log(core) < likelihood_of_normal:
        return math.sqrt(variance), 0.0, 1.0
    return core, share, width


def _outlying(relative: np.ndarray, share: float, width: float) -> np.ndarray:
    """Return the probabilities (n,) that residuals are outliers; `relative`: residuals divided by the standard deviation of
    those that are not outliers."""
    exponent = 0.5 * relative**2 * (1.0 - 1.0 / width**2)
    return 1.0 / (1.0 + (1.0 - share) / max(share, 1e-300) * width * np.exp(-np.minimum(exponent, 700.0)))


def limited(relative: np.ndarray, used: np.ndarray, share: float, width: float) -> tuple[np.ndarray, float]:
    """Return residuals (n,) for a least-squares fit in which outliers have little influence, and their standard deviation,
    relative to that of the residuals without outliers.

        psi(e) = e (1 - c P(e)),      c = 1 - 1/width^2

    P(e) is the probability that a residual is an outlier.

    **Arguments**: `relative` e, residuals relative to the standard deviation of those that are not outliers; `used` (n,):
    False for samples to leave out; `share` and `width` of the outliers, see `outliers_of`.

    >>> moved, deviation = limited(np.array([-1.0, 0.1, 1.0, 50.0]), np.ones(4, bool), 0.02, 20.0)
    >>> bool(abs(moved[3]) < 0.2), bool(moved[2] > 1.0)
    (True, True)
    """
    outlying, factor = _outlying(relative, share, width), 1.0 - 1.0 / width**2
    score = relative * (1.0 - factor * outlying)
    slope = 1.0 - factor * outlying - (factor * relative) ** 2 * outlying * (1.0 - outlying)
    mean = float(np.mean(slope[used]))
    return score / mean, math.sqrt(float(np.mean(score[used] ** 2))) / mean


def bounded(excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (n,) and weights (n,) of readings that are known to lie above a bound.

        psi = phi(z)/Phi(z),      -psi' = psi (psi + z),      z = -excess

    phi and Phi are the density and the distribution function of the standard normal distribution. The residuals are
    psi/(-psi') and the weights sqrt(-psi'); psi' is here the derivative with respect to z.

    **Arguments**: `excess` (n,): the bound minus the value of the model, in standard deviations of the normal noise.

    >>> moved, weight = bounded(np.array([-8.0, 0.0, 40.0]))
    >>> np.round(moved * weight**2, 1).tolist(), np.round(weight, 2).tolist()    # scores and weights
    ([0.0, 0.8, 40.0], [0.0, 0.8, 1.0])
    """
    from scipy.special import log_ndtr  # slow to import

    z = -np.maximum(np.asarray(excess, float), -30.0)
    ratio = np.exp(-0.5 * z**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(z))
    ratio_plus_z = np.where(z < -20.0, 1.0 / np.maximum(-z, 1.0), ratio + z)
    return 1.0 / ratio_plus_z, np.sqrt(ratio * ratio_plus_z)


def autoregression(residual: np.ndarray, used: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the whitening filter of noise, and the standard deviation of the white noise.

        e_k = r_k + a_1 r_{k-1} + ... + a_p r_{k-p}

    The coefficients solve the Yule-Walker equations; the order p has the smallest Bayesian information criterion. The order is
    0 unless the noise is clearly coloured, see `_COLOUR_GAIN`.

    **Arguments**: `residual` r (n,); `used` (n,): False for samples to leave out.

    **Returns** (1, a_1, ..., a_p) and the standard deviation of e.

    >>> rng = np.random.default_rng(0)
    >>> white = rng.normal(size=20000)
    >>> colored = np.zeros(20000)
    >>> for k in range(1, 20000):
    ...     colored[k] = 0.8 * colored[k - 1] + white[k]
    >>> taps, deviation = autoregression(colored)
    >>> bool(abs(taps[1] + 0.8) < 0.02), bool(abs(deviation - 1.0) < 0.02), autoregression(white)[0].tolist()
    (True, True, [1.0])
    """
    used = np.isfinite(residual) if used is None else used & np.isfinite(residual)
    n = int(np.count_nonzero(used))
    max_order = max(min(_MAX_ORDER, n // 20), 0)
    r = np.where(used, residual, 0.0)
    size = 2 ** int(np.ceil(np.log2(2 * r.size + 1)))
    spectra = [np.fft.rfft(each, size) for each in (r, used.astype(float))]
    product, pairs = (np.fft.irfft(np.abs(each) ** 2, size)[: max_order + 1] for each in spectra)
    covariance = product / np.maximum(pairs, 1.0)
    if covariance[0] <= 0.0:
        return np.ones(1), 0.0
    # Levinson's recursion gives the coefficients of every order.
    taps, variance = np.ones(1), float(covariance[0])
    best, best_criterion = (taps, variance), n * np.log(variance) - _COLOUR_GAIN
    for order in range(1, max_order + 1):
        reflection = -float(taps @ covariance[order:0:-1]) / variance
        longer = np.concatenate([taps, [0.0]])
        taps = longer + reflection * longer[::-1]
        variance = variance * (1.0 - reflection**2)
        if variance <= 1e-12 * covariance[0]:
            break
        criterion = n * np.log(variance) + order * np.log(n)
        if criterion < best_criterion:
            best, best_criterion = (taps, variance), criterion
    return best[0], float(np.sqrt(best[1]))


def colored_covariance(slopes: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the covariance (p, p) of a least-squares fit whose residuals may be coloured noise.

        (J^T J)^-1 J^T R J (J^T J)^-1

    R is the covariance of the noise by `autoregression` of the residuals. For white residuals this is the usual covariance.

    **Arguments**: `slopes` J (n, p), derivatives of the residuals with respect to the parameters; `residual` (n,), evenly
    sampled.

    >>> slopes, noise = np.ones((4000, 1)), np.random.default_rng(0).normal(size=4000)
    >>> round(float(colored_covariance(slopes, noise)[0, 0] * 4000), 1)
    1.0
    >>> for k in range(1, 4000):
    ...     noise[k] += 0.8 * noise[k - 1]
    >>> round(float(colored_covariance(slopes, noise)[0, 0] * 4000))    # 1 / (1 - 0.8)^2
    25
    """
    from scipy.signal import lfilter  # slow to import

    n, p = slopes.shape
    basis, triangle = np.linalg.qr(slopes)
    taps, deviation = autoregression(residual)
    # R = deviation^2 A^-1 A^-T with the filter A: the columns pass A^-T, which runs backwards in time.
    shaped = lfilter([1.0], taps, basis[::-1], axis=0)
    root = np.linalg.solve(triangle, deviation * np.asarray(shaped).T)
    return root @ root.T * n / max(n - p, 1)
