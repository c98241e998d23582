"""Noise of residuals: samples that are no part of it."""

import numpy as np

from jaxvib.numerics.noise import is_outlier


def test_residuals_that_decay_from_the_start_are_no_outliers():
    n = np.arange(2000)
    residual = (
        np.random.default_rng(1).uniform(-1.0, 1.0, n.size) + 200.0 * np.exp(-n / 20.0) - 200.0 * np.exp((n - 1999) / 20.0)
    )
    residual[1000] += 30.0
    assert np.flatnonzero(is_outlier(residual)).tolist() == [1000]
