"""Grids of samples, their repairs and their notes, from samples in closed form."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification.records.sampling import (
    _clipped_above,
    _resolution,
    clipped_at,
    dropouts,
    even_samples,
    require_ascending,
    without_spikes,
)

N = 400
T = 2.0 + 0.01 * np.arange(N)
WAVE = np.sin(7.0 * T)


def notes_of(time, value):
    return [note.removeprefix("a: ") for note in even_samples(time, value, "a:")[2]]


def test_small_jitter_moves_the_times_only():
    moved = T + 0.0045 * 0.01 * np.random.default_rng(0).uniform(-1.0, 1.0, N)
    time, value, notes = even_samples(moved, WAVE, "a:")
    np.testing.assert_array_equal(time, np.linspace(moved[0], moved[-1], N))
    assert value is WAVE and notes == []


@pytest.mark.parametrize(("late", "is_moved"), [(0.0099, False), (0.0101, True), (-0.0099, False), (-0.0101, True)])
def test_jitter_above_a_hundredth_of_a_step_is_interpolated(late, is_moved):
    moved = T.copy()
    moved[200] += late * 0.01
    time, value, notes = even_samples(moved, 3.0 * moved, "a:")
    np.testing.assert_allclose(time, T, atol=1e-12)
    np.testing.assert_allclose(value, 3.0 * (T if is_moved else moved), atol=1e-12)
    assert (notes == []) is not is_moved


def test_interpolated_readings_and_their_note():
    moved = T + 0.2 * 0.01 * np.sin(np.arange(N))
    moved[[0, -1]] = T[[0, -1]]
    time, value, notes = even_samples(moved, 3.0 * moved, "a:")
    np.testing.assert_allclose(time, T, atol=1e-12)
    np.testing.assert_allclose(value, 3.0 * T, atol=1e-12)
    low, high = np.min(np.diff(moved)), np.max(np.diff(moved))
    assert notes == [f"a: has steps of {low:.3g} to {high:.3g} s; its readings were interpolated to even steps of 0.01 s"]


def test_gaps_between_uneven_samples_stay_open():
    """Missing readings in a gap of 0.5 s; interpolated ones elsewhere. One reading is not a number."""
    moved = T + 0.2 * 0.01 * np.sin(np.arange(N))
    moved[[0, -1]] = T[[0, -1]]
    kept = np.delete(np.arange(N), np.arange(100, 150))
    values = 3.0 * moved
    values[300] = np.nan
    time, value, notes = even_samples(moved[kept], values[kept], "a:")
    np.testing.assert_allclose(time, T, atol=1e-12)
    inside = (moved[99] < T) & (moved[150] > T)
    beside = (moved[299] < T) & (moved[301] > T)
    assert np.all(np.isnan(value[inside])) and np.array_equal(np.isnan(value), inside | beside)
    known = np.isfinite(value)
    np.testing.assert_allclose(value[known], 3.0 * T[known], atol=1e-12)
    assert [note.split(" ", 1)[1] for note in notes[:2]] == [
        f"has 1 reading that is not a number, the first at {moved[300]:g} s; left out",
        f"has 1 gap; the longest is {moved[150] - moved[99]:.3g} s at {moved[99]:g} s",
    ] and f"to {np.max(np.diff(moved)):.3g} s; its" in notes[2]  # fmt: skip


def test_two_gaps_of_even_samples():
    kept = np.delete(np.arange(N), [50, 51, 52, 200])
    time, value, notes = even_samples(T[kept], WAVE[kept], "a:")
    np.testing.assert_allclose(time, T, atol=1e-12)
    assert np.flatnonzero(np.isnan(value)).tolist() == [50, 51, 52, 200]
    assert notes == ["a: has 2 gaps; the longest is 0.04 s at 2.49 s"]
    np.testing.assert_array_equal(value[kept], WAVE[kept])


@pytest.mark.parametrize(("lost", "is_refused"), [(197, False), (205, True)])
def test_half_of_a_record_may_be_missing(lost, is_refused):
    kept = np.delete(np.arange(N), np.arange(100, 100 + lost))
    if not is_refused:
        assert even_samples(T[kept], WAVE[kept], "a:")[0].size == N
        return
    with pytest.raises(jv.InputError, match=r"has 1 gap in 2\.06 of 3\.99 s; the longest is 2\.06 s at 2\.99 s: use a part"):
        even_samples(T[kept], WAVE[kept], "a:")


def test_times_rounded_by_a_file_are_even():
    """Steps of 1/300 s, rounded to 1 ms and to 0.1 ms."""
    exact = np.arange(600) / 300.0
    for digits in (3, 4):
        time, value, notes = even_samples(np.round(exact, digits), WAVE[:1] + exact, "a:")
        np.testing.assert_allclose(time, exact, atol=2.0 * 10.0**-digits / 600.0)
        np.testing.assert_array_equal(value, WAVE[:1] + exact)
        assert notes == []


@pytest.mark.parametrize(
    ("time", "found"),
    [([0.1, 0.2, 12.3], 0.051), ([0.123, 5.0], 0.51e-3), ([1.0, 2.0], 0.051), ([0.12345, 7.5], 0.51e-5)],
)
def test_digits_of_times(time, found):
    assert _resolution(np.array(time)) == pytest.approx(found)


def test_slow_channel_begins_at_its_first_reading():
    value = np.where(np.arange(N) % 4 == 3, WAVE, np.nan)
    time, found, notes = even_samples(T, value, "a:")
    np.testing.assert_allclose(time, T[3::4], atol=1e-12)
    np.testing.assert_array_equal(found, WAVE[3::4])
    assert notes == ["a: has a reading at only one in 4 times: its rate is 25 Hz"]
    value[11] = np.nan
    _, found, notes = even_samples(T, value, "a:")
    assert np.flatnonzero(np.isnan(found)).tolist() == [2] and len(notes) == 2
    with pytest.raises(jv.InputError, match="has 15 readings; at least 16 are needed; record more"):
        even_samples(T, np.where(np.arange(N) < 15, WAVE, np.nan), "a:")
    assert even_samples(T, np.where(np.arange(N) < 395, WAVE, np.inf), "a:")[1].size == N


@pytest.mark.parametrize(
    ("count", "says"), [(1, "has 1 reading that is not a number"), (3, "has 3 readings that are not numbers")]
)
def test_missing_readings_in_words(count, says):
    value = WAVE.copy()
    value[30 : 30 + count] = np.nan
    assert notes_of(T, value) == [f"{says}, the first at 2.3 s; left out"]


@pytest.mark.parametrize(("count", "is_refused"), [(40, False), (41, True)])
def test_a_tenth_of_the_readings_may_be_missing(count, is_refused):
    value, constant = WAVE.copy(), WAVE.copy()
    value[100 : 100 + count] = np.nan
    constant[100 : 100 + count] = 0.123
    if not is_refused:
        assert np.count_nonzero(np.isnan(even_samples(T, constant, "a:")[1])) == count
        assert notes_of(T, constant) == [
            "is constant in segments with 40 readings in total (dropouts), the first at 3 s; left out"
        ]
        assert np.count_nonzero(np.isnan(even_samples(T, value, "a:")[1])) == count
        return
    with pytest.raises(jv.InputError, match="has 41 of 400 readings that are not numbers, the first at 3 s; at most 10 % may"):
        even_samples(T, value, "a:")
    with pytest.raises(jv.InputError, match="is constant in segments for 41 of 400 readings, the first at 3 s: the sensor"):
        even_samples(T, constant, "a:")


@pytest.mark.parametrize(
    ("length", "level", "expected"), [(19, 0.1, 0), (20, 0.1, 20), (40, 0.1, 40), (40, 1.5, 0), (40, -1.5, 0)]
)
def test_length_and_level_of_dropouts(length, level, expected):
    """Segments of fewer than 20 equal readings, and those at the ends of the range, are no dropouts."""
    value = WAVE.copy()
    value[100 : 100 + length] = level
    found = dropouts(value)
    assert np.count_nonzero(found) == expected
    assert expected == 0 or np.flatnonzero(found)[[0, -1]].tolist() == [100, 99 + length]


def test_dropouts_beside_the_steps_of_a_slow_channel():
    """Readings that are held for four samples: a dropout is ten times longer."""
    held = np.repeat(np.sin(0.7 * np.arange(500)), 4)
    held[1000:1036] = 0.05
    assert not np.any(dropouts(held))
    held[1000:1044] = 0.05
    assert np.flatnonzero(dropouts(held)).tolist() == list(range(1000, 1044))


@pytest.mark.parametrize(("low", "high"), [(-9.0, 0.9), (-0.9, 9.0), (-0.8, 0.9)])
def test_levels_of_clipping(low, high):
    value = np.clip(np.sin(0.01 * np.arange(4000.0)), low, high)
    value[::90] = np.nan
    found = clipped_at(value)
    assert np.isinf(found[0]) == (low == -9.0) and np.isinf(found[1]) == (high == 9.0)
    size = np.nanmax(value) - np.nanmin(value)
    for level, end, sign in zip(found, (low, high), (-1.0, 1.0), strict=True):
        assert np.isinf(level) or 0.0 < sign * (end - level) <= 0.0201 * size


def test_converter_steps_and_single_peaks_are_no_clipping():
    assert _clipped_above(np.full(40, 3.0)) == np.inf
    coarse = np.round(4.0 * np.sin(0.01 * np.arange(4000.0))) / 4.0
    assert _clipped_above(coarse) == np.inf  # a step of the converter is a bin
    peak = np.sin(0.01 * np.arange(4000.0))
    assert _clipped_above(peak) == np.inf


@pytest.mark.parametrize("count", [1, 8])
def test_spikes_do_not_count_as_clipping(count):
    """A spike far above all other readings leaves no reading in the bins below it."""
    value = np.sin(0.1 * np.arange(4000.0))
    value[17 :: 4000 // count][:count] = 500.0
    assert clipped_at(value) == (-np.inf, np.inf)


@pytest.mark.parametrize(
    ("places", "value", "says"),
    [
        ([3, 7], [np.inf, np.nan], "has the time inf at sample 4; times must be finite numbers"),
        ([3, 7], [T[2], T[6]], "has the time 2.02 s twice, at samples 3 and 4; leave one of them out"),
        ([3, 7], [1.0, 1.5], "has the time 1 s at sample 4, and 2.02 s at the sample before it; times must ascend"),
    ],
)
def test_the_first_wrong_time_is_named(places, value, says):
    time = T.copy()
    time[places] = value
    with pytest.raises(jv.InputError, match=says):
        require_ascending(time, "a")


def test_spikes_are_left_out_and_high_peaks_are_not():
    time = 0.01 * np.arange(1000.0)
    decay = np.exp(-time) * np.sin(7.0 * time)
    assert without_spikes(time, decay, "run")[1] == []
    value = decay.copy()
    value[[300, 5]] = 40.0, -40.0
    found, (note,) = without_spikes(time, value, "run")
    assert np.flatnonzero(np.isnan(found)).tolist() == [5, 300]
    assert note == "run has 2 spikes, the first at 0.05 s, far beyond all other readings; left out"
