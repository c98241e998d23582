"""Noise of residuals: samples that are no part of it."""

import numpy as np
import pytest

from jaxvib.numerics.noise import autoregression, is_outlier, noise_of


def test_residuals_that_decay_from_the_start_are_no_outliers():
    n = np.arange(2000)
    residual = (
        np.random.default_rng(1).uniform(-1.0, 1.0, n.size) + 200.0 * np.exp(-n / 20.0) - 200.0 * np.exp((n - 1999) / 20.0)
    )
    residual[1000] += 30.0
    assert np.flatnonzero(is_outlier(residual)).tolist() == [1000]


@pytest.mark.parametrize(
    "present",
    [pytest.param(slice(None, None, n), id=f"each {n}") for n in (1, 2, 3, 10)] + [pytest.param(slice(3600, None), id="end")],
)
def test_missing_samples_do_not_change_the_noise(present):
    residual = np.full(6000, np.nan)
    residual[present] = np.random.default_rng(0).normal(size=6000)[present]
    noise = noise_of(residual)
    assert noise.taps.tolist() == [1.0]
    assert noise.outliers == 0.0
    assert noise.deviation == pytest.approx(1.0, rel=0.05)


def test_outliers_are_found_between_missing_samples():
    residual = np.full(3000, np.nan)
    residual[::3] = np.random.default_rng(0).normal(size=1000)
    residual[[300, 1500]] = 50.0
    assert np.flatnonzero(is_outlier(residual)).tolist() == [300, 1500]
    assert not np.any(is_outlier(np.full(5, np.nan)))


def test_short_white_residuals_of_a_fit_are_not_coloured():
    """The fit takes up noise near the frequency of a decay; without the margin, 3 % of these residuals count as coloured."""
    rng, t = np.random.default_rng(0), np.arange(400.0)
    waves = [t**k * np.exp(-0.004 * t) * wave(0.4 * t) for k in range(4) for wave in (np.cos, np.sin)]
    basis, _ = np.linalg.qr(np.stack(waves, axis=1))
    lengths = []
    for noise in rng.normal(size=(300, t.size)):
        lengths.append(len(autoregression(noise - basis @ (basis.T @ noise))[0]))
    assert set(lengths) == {1}
    coloured = np.convolve(rng.normal(size=t.size + 20), 0.5 ** np.arange(20), "valid")
    assert len(autoregression(coloured)[0]) > 1
