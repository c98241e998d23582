"""Lower sampling rate of long records."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification.records.decimation import decimated, filter_readings

RATE, FACTOR = 1000.0, 20
T = np.arange(40_000) / RATE
KEPT = slice(8 * FACTOR, T.size - 8 * FACTOR, FACTOR)
HIGHEST = 2.0 * np.pi * RATE / FACTOR / 10.0
SIGNAL = np.sin(20.0 * T) + 0.5 * np.cos(31.0 * T)


def run_of(values, **options):
    return jv.MeasuredRun.from_arrays([jv.Channel("frame", "acceleration", at=1, **options)], T, {"frame": values})


@pytest.mark.parametrize(("place", "gain"), [(0.01, 1.0), (0.29, 1.0), (0.5, 0.5), (0.72, 0.0), (1.0, 0.0), (3.3, 0.0)])
def test_gain_of_the_filter_over_frequency(place, gain):
    """A vibration of `place` times the new rate."""
    wave = np.exp(2j * np.pi * place * RATE / FACTOR * T + 1j)
    found = filter_readings(wave.real, FACTOR)[0] + 1j * filter_readings(wave.imag, FACTOR)[0]
    np.testing.assert_allclose(found, gain * wave[KEPT], atol=1e-2 if gain == 0.5 else 2e-5)


def test_white_noise_keeps_its_power_in_each_frequency():
    noise = np.random.default_rng(0).normal(size=T.size)
    found, outliers = filter_readings(noise, FACTOR)
    assert outliers == 0
    np.testing.assert_allclose(np.var(found) * FACTOR, 0.95, atol=0.1)
    next_ones = found[1:] @ found[:-1] / (found @ found)
    assert abs(next_ones) < 0.2


def test_outliers_and_short_gaps_leave_no_trace():
    rng = np.random.default_rng(1)
    noise = 1e-3 * rng.normal(size=T.size)
    places = rng.choice(np.arange(400, T.size - 400), 40, replace=False)
    values = SIGNAL + noise
    values[places[:20]] += 5.0
    values[places[20:]] = np.nan
    found, outliers = filter_readings(values, FACTOR)
    assert 20 <= outliers <= 40  # with some of their neighbours
    np.testing.assert_allclose(found, filter_readings(SIGNAL + noise, FACTOR)[0], atol=2e-3)


def test_readings_near_a_gap_are_missing():
    values = SIGNAL.copy()
    values[20_000:20_100] = np.nan
    found, _ = filter_readings(values, FACTOR)
    missing = np.isnan(found)
    reach = 8 * FACTOR
    assert np.array_equal(np.flatnonzero(missing), np.arange((20_000 - 2 * reach) // FACTOR, 20_100 // FACTOR + 1))
    np.testing.assert_allclose(found[~missing], SIGNAL[KEPT][~missing], atol=2e-5)


def test_missing_readings_make_no_outliers_of_the_others():
    values = SIGNAL + 0.05 * np.random.default_rng(0).normal(size=T.size)
    whole, _ = filter_readings(values, FACTOR)
    values[15_000:35_000] = np.nan
    found, outliers = filter_readings(values, FACTOR)
    assert outliers == 0
    np.testing.assert_allclose(found[np.isfinite(found)], whole[np.isfinite(found)], atol=1e-12)


def test_long_run_is_filtered_with_a_note():
    found = decimated(run_of(SIGNAL), HIGHEST)
    assert found.notes == (
        "run: the readings were filtered to the band of the machine, and their rate was lowered from 1000 to 50 Hz",
    )
    np.testing.assert_allclose(found.times["frame"], T[KEPT], atol=1e-12)
    np.testing.assert_allclose(found.values["frame"], SIGNAL[KEPT], atol=2e-5)
    assert found.clipped["frame"].shape == found.values["frame"].shape


@pytest.mark.parametrize(
    ("run", "highest"),
    [
        (run_of(SIGNAL, range=1.2), HIGHEST),
        (run_of(SIGNAL), 6.0 * HIGHEST),
        (jv.MeasuredRun.from_arrays([jv.Channel("frame", "force")], T[:16_000], {"frame": SIGNAL[:16_000]}), HIGHEST),
    ],
)
def test_clipped_fast_and_short_runs_are_unchanged(run, highest):
    assert decimated(run, highest) is run
