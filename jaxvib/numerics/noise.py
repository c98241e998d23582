"""Noise of measured samples: autoregressive models of it, and uncertainties of least-squares fits under coloured noise."""

from __future__ import annotations

import numpy as np

_MAX_ORDER = 40


def autoregression(residual: np.ndarray, counts: np.ndarray | None = None, most: int = _MAX_ORDER) -> tuple[np.ndarray, float]:
    """Return the filter that turns noise into white noise, and the standard deviation of the white noise.

        e_k = r_k + a_1 r_{k-1} + ... + a_p r_{k-p}

    The coefficients solve the Yule-Walker equations; the order p has the smallest Bayesian information criterion.

    **Arguments**: `residual` r (n,); `counts` (n,): False for samples to leave out; `most`: largest order.

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
    counts = np.isfinite(residual) if counts is None else counts & np.isfinite(residual)
    n = int(np.count_nonzero(counts))
    most = max(min(most, n // 20), 0)
    r = np.where(counts, residual, 0.0)
    size = 2 ** int(np.ceil(np.log2(2 * r.size + 1)))
    spectra = [np.fft.rfft(each, size) for each in (r, counts.astype(float))]
    product, pairs = (np.fft.irfft(np.abs(each) ** 2, size)[: most + 1] for each in spectra)
    covariance = product / np.maximum(pairs, 1.0)
    if covariance[0] <= 0.0:
        return np.ones(1), 0.0
    # Levinson's recursion gives the coefficients of every order.
    taps, variance = np.ones(1), float(covariance[0])
    best, least = (taps, variance), n * np.log(variance)
    for order in range(1, most + 1):
        reflection = -float(taps @ covariance[order:0:-1]) / variance
        longer = np.concatenate([taps, [0.0]])
        taps = longer + reflection * longer[::-1]
        variance = variance * (1.0 - reflection**2)
        if variance <= 1e-12 * covariance[0]:
            break
        criterion = n * np.log(variance) + order * np.log(n)
        if criterion < least:
            best, least = (taps, variance), criterion
    return best[0], float(np.sqrt(best[1]))


def colored_covariance(slopes: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the covariance (p, p) of a least-squares fit whose residuals may be coloured noise.

        (J^T J)^-1 J^T R J (J^T J)^-1

    R is the covariance of the noise by `autoregression` of the residuals. For white residuals this is the usual covariance.

    **Arguments**: `slopes` J (n, p), derivatives of the residuals by the parameters; `residual` (n,), evenly sampled.

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
