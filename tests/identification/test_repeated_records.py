"""Intervals and errors of fits to repeated records by SciPy, from wrong first values."""

import functools

import numpy as np
import pytest
from repeated_records.fits import CASES, NAMES, NOISE, SINGLE, TIMES, repeated, run_up
from run_ups_by_scipy import TRUTH, record, scene_of

import jaxvib as jv


@functools.cache
def few(name):
    return repeated(6, seed=1, **CASES[name])


@pytest.mark.parametrize("name", ["2 % outliers, 20 times the noise", "one pulse per turn, times rounded to 1 ms"])
def test_few_intervals_hold_the_truth(name):
    found = few(name)
    assert not np.any(found.wrong)
    assert np.mean(np.abs(found.away) < 1.96) > 0.8
    assert 0.6 < np.sqrt(np.mean(found.ratio**2)) < 1.4


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_intervals_hold_the_truth(name):
    """40 records of 7 numbers: the bounds are three standard deviations of the shares of a right method."""
    found = repeated(40, **CASES[name])
    assert not np.any(found.wrong & (found.statuses == "found"))
    assert np.mean(found.wrong) <= 0.05
    assert 0.9 < np.mean(found.held) < 0.99
    assert np.sqrt(np.mean(found.ratio**2)) < 1.25


def first_values():
    return scene_of(TRUTH)


def test_outliers_are_named_and_have_little_influence():
    clean, _ = run_up(False)
    run = record(TIMES, clean, NOISE, np.random.default_rng(0), outliers=0.02)
    fit = jv.identify(first_values(), run, unknown=NAMES)
    assert fit.status_name == "found"
    assert sum("are outliers, which have little influence" in note for note in fit.notes) == 2
    without = jv.identify(first_values(), record(TIMES, clean, NOISE, np.random.default_rng(0)), unknown=NAMES)
    ratio = [each.error / other.error for each, other in zip(fit.estimates, without.estimates, strict=True)]
    assert max(ratio) < 1.06  # about 3 by least squares


def test_clipped_readings_are_bounds():
    """Clipped readings that are left out would shift the damping, because large noise is clipped more often."""
    clean, _ = run_up(False)
    away = []
    for seed in range(4):
        run = record(TIMES, clean, 0.5, np.random.default_rng(seed), full_scale=0.4 * np.max(np.abs(clean)))
        fit = jv.identify(first_values(), run, unknown=NAMES)
        away.append([(each.value - TRUTH[name]) / each.error for name, each in zip(SINGLE, fit.estimates, strict=True)])
    assert np.max(np.abs(np.mean(away, axis=0))) < 2.0
