"""Samples of channels: order of times, gaps, missing and clipped readings, rates, units, places."""

import numpy as np
import pytest

import jaxvib as jv

T = np.arange(0.0, 4.0, 1e-3)
SIGNAL = np.sin(40.0 * T) + 0.3 * np.sin(173.0 * T + 1.0)


def run(values=SIGNAL, times=T, **options):
    channel = jv.Channel("frame", "acceleration", **options)
    return jv.MeasuredRun.from_arrays([channel], times, {"frame": values})


def changed(values, place, new):
    values = np.array(values)
    values[place] = new
    return values


def test_complete_samples_are_unchanged_and_without_notes():
    found = run()
    np.testing.assert_array_equal(found.values["frame"], SIGNAL)
    np.testing.assert_allclose(found.times["frame"], T, atol=1e-12)
    assert found.notes == () and not np.any(found.clipped["frame"])


@pytest.mark.parametrize(("unit", "factor"), [(None, 1.0), ("g", 9.80665), ("G", 9.80665), ("mm/s^2", 1e-3), ("m/s²", 1.0)])
def test_readings_are_converted_to_si(unit, factor):
    np.testing.assert_allclose(run(unit=unit).values["frame"], factor * SIGNAL, rtol=1e-12)


@pytest.mark.parametrize(
    ("times", "values", "says"),
    [
        (changed(T, 7, T[6]), SIGNAL, "has the time 0.006 s twice, at samples 7 and 8; leave one of them out"),
        (
            changed(T, 7, 0.001),
            SIGNAL,
            "has the time 0.001 s at sample 8, and 0.006 s at the sample before it; times must ascend",
        ),
        (changed(T, 7, np.nan), SIGNAL, "has the time nan at sample 8; times must be finite"),
        (T[:9], SIGNAL[:9], "has 9 samples; at least 16 are needed"),
        (T[:-1], SIGNAL, "has 3999 times but 4000 values; each value needs its time"),
        (T, changed(SIGNAL, slice(500, 1000), np.nan), "has 500 of 4000 readings that are not numbers, the first at 0.5 s"),
        (T, changed(SIGNAL, slice(500, 1000), 0.1), "is constant in segments for 500 of 4000 readings, the first at 0.5 s"),
        (np.concatenate([T[:100], T[-100:]]), SIGNAL[:200], "has 1 gap in 3.8 of 4 s; the longest is 3.8 s at 0.099 s"),
        (T.reshape(2, -1), SIGNAL, r"has an array of shape (2, 2000); one list of numbers is needed"),
    ],
)
def test_unusable_samples_raise_clear_errors(times, values, says):
    with pytest.raises(jv.InputError) as error:
        run(values, times)
    assert says in str(error.value) and "channel 'frame'" in str(error.value)


def test_gaps_are_filled_with_missing_readings():
    kept = np.delete(np.arange(T.size), np.r_[100:150, 3000:3003])
    found = run(SIGNAL[kept], T[kept])
    assert found.notes == ("run: channel 'frame' has 2 gaps; the longest is 0.051 s at 0.099 s",)
    np.testing.assert_allclose(found.times["frame"], T, atol=1e-9)
    missing = np.isnan(found.values["frame"])
    assert np.count_nonzero(missing) == 53
    np.testing.assert_array_equal(found.values["frame"][~missing], SIGNAL[kept])


def test_nan_is_left_out_and_counted():
    found = run(changed(SIGNAL, [300, 301, 900], np.nan))
    assert found.notes == ("run: channel 'frame' has 3 readings that are not numbers, the first at 0.3 s; left out",)
    assert np.count_nonzero(np.isnan(found.values["frame"])) == 3


@pytest.mark.parametrize("level", [0.0, 0.123])
def test_dropouts_are_left_out_and_counted(level):
    found = run(changed(SIGNAL, slice(800, 900), level))
    assert "is constant in segments with 100 readings in total (dropouts), the first at 0.8 s; left out" in found.notes[0]
    assert np.all(np.isnan(found.values["frame"][800:900])) and not np.any(np.isnan(found.values["frame"][:800]))


def test_coarse_converters_have_no_dropouts():
    assert run(np.round(0.02 * SIGNAL, 3)).notes == ()


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_clipping_is_seen_in_the_histogram(noise):
    true = SIGNAL + 0.2
    found = run(np.clip(true, -0.7, 1.0) + noise * np.random.default_rng(1).standard_normal(T.size))
    truly = (true < -0.7) | (true > 1.0)
    assert "is clipped at about" in found.notes[0]
    assert np.all(found.clipped["frame"][truly])
    assert np.count_nonzero(found.clipped["frame"] & ~truly) < 0.03 * T.size


@pytest.mark.parametrize(
    "values",
    [
        np.sin(2.0 * np.pi * 25.0 * T),  # 40 samples a turn: the same peaks again and again
        np.round(np.sin(3.0 * T), 2),
        np.exp(-T) * np.sin(50.0 * T),
        np.random.default_rng(0).standard_normal(T.size),
        np.round(np.random.default_rng(0).standard_normal(T.size), 1),
        np.sin(2.0 * np.pi * (1.0 + 5.0 * T) * T),
    ],
)
def test_peaks_of_smooth_and_coarse_signals_are_not_clipped(values):
    assert run(values).notes == ()


def test_readings_at_the_stated_range_are_clipped():
    found = run(range="1.2 m/s^2")
    np.testing.assert_array_equal(found.clipped["frame"], np.abs(SIGNAL) >= 0.999 * 1.2)
    assert jv.Channel("x", "acceleration", unit="g", range=50).range == pytest.approx(490.3325)


def test_slower_channel_has_a_lower_rate():
    slow = np.where(np.arange(T.size) % 4 == 0, SIGNAL, np.nan)
    found = run(slow)
    assert found.notes == ("run: channel 'frame' has a reading at only one in 4 times: its rate is 250 Hz",)
    assert found.rate("frame") == pytest.approx(250.0)
    np.testing.assert_array_equal(found.values["frame"], SIGNAL[::4])


def test_channels_may_have_different_times():
    channels = [jv.Channel("a", "acceleration", at=1), jv.Channel("b", "force")]
    found = jv.MeasuredRun.from_arrays(channels, {"a": T, "b": T[::2] + 0.01}, {"a": SIGNAL, "b": SIGNAL[::2]})
    assert (found.rate("a"), found.rate("b")) == (pytest.approx(1000.0), pytest.approx(500.0))
    assert found.span == (pytest.approx(0.0), pytest.approx(T[-2] + 0.01))


def test_uneven_times_are_interpolated_with_a_note():
    jitter = T + 2e-4 * np.random.default_rng(2).uniform(-1.0, 1.0, T.size)
    found = run(np.sin(40.0 * jitter), jitter)
    assert "its readings were interpolated to even steps of 0.001 s" in found.notes[0]
    np.testing.assert_allclose(found.values["frame"], np.sin(40.0 * found.times["frame"]), atol=3e-4)


def test_times_rounded_by_the_file_become_even():
    true = np.arange(4000) / 1024.0
    found = run(SIGNAL, np.round(true, 4))
    assert found.notes == ()
    np.testing.assert_allclose(found.times["frame"], true, atol=2e-5)
    np.testing.assert_array_equal(found.values["frame"], SIGNAL)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kind": "accelerations"}, "channel 'a': kind is 'accelerations'; allowed: acceleration, velocity"),
        (
            {"kind": "acceleration", "unit": "mm/s"},
            "channel 'a': unit is 'mm/s', which is a unit of velocity, not of acceleration",
        ),
        (
            {"kind": "acceleration", "unit": "volts"},
            "unit is 'volts', which is not a unit of acceleration; write for example m/s",
        ),
        ({"kind": "acceleration", "at": 0}, "channel 'a': at is 0; it must be the number of a platform, from 1"),
        ({"kind": "acceleration", "at": (1.0, 2.0, 3.0)}, "channel 'a': at is (1.0, 2.0, 3.0)"),
        ({"kind": "acceleration", "at": 0.5}, "channel 'a': at is 0.5; it must be the number of a platform, or a pair"),
        ({"kind": "acceleration", "at": b"12"}, "channel 'a': at is b'12'; it must be the number of a platform, or a pair"),
        ({"kind": "acceleration", "at": 10**5000}, "channel 'a': at is a whole number of 16610 bits"),
        ({"kind": "acceleration", "unit": "1e400 g"}, "channel 'a': unit is '1e400 g', which is not a unit of acceleration"),
        ({"kind": "acceleration", "direction": "left"}, "channel 'a': direction is 'left'; allowed: up, down, across"),
        ({"kind": "acceleration", "direction": (0.0, 0.0)}, "channel 'a': direction is (0, 0)"),
        ({"kind": "pulses", "per_turn": 0}, "channel 'a': per_turn is 0; it must be at least 1"),
        ({"kind": "acceleration", "gain_error": -0.1}, "channel 'a': gain_error is -0.1; it must be at least 0"),
        ({"kind": "acceleration", "range": "-5 g"}, "channel 'a': range is -49"),
    ],
)
def test_wrong_channels_raise_clear_errors(arguments, says):
    with pytest.raises(jv.InputError) as error:
        jv.Channel("a", **arguments)
    assert says in str(error.value)


def test_channel_states_gain_error_and_direction():
    channel = jv.Channel("a", "acceleration", at=("200 mm", 0.1), direction=(3.0, 4.0), gain_error="2 %", high_pass="0.5 Hz")
    assert (channel.at, channel.direction) == ((0.2, 0.1), (0.6, 0.8))
    assert (channel.gain_error, channel.high_pass) == (pytest.approx(0.02), pytest.approx(0.5))
    assert jv.Channel("a", "acceleration").gain_error == 0.01 and jv.Channel("a", "force").gain_error == 0.0


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("+10 kg", ("add", "10 kg")),
        ("-10 kg", ("add", "-10 kg")),
        ("+5 %", ("scale", 1.05)),
        ("95 kg", ("set", "95 kg")),
        (95.0, ("set", 95.0)),
    ],
)
def test_changes_of_the_machine_are_parsed(text, change):
    found = jv.MeasuredRun.from_arrays([jv.Channel("a", "force")], T, {"a": SIGNAL}, change={"machine.mass[0]": text})
    assert tuple(found.change["machine.mass[0]"]) == pytest.approx(change) if change[0] == "scale" else change


def test_wrong_lists_of_channels_are_refused():
    frame = jv.Channel("frame", "force")
    for arguments, says in [
        (([], T, {}), "channels is empty"),
        (([frame, frame], T, {"frame": SIGNAL}), "channels has the name 'frame' twice"),
        (([frame], T, {"base": SIGNAL}), "values has no entry 'frame'; it has: base"),
        (([frame], {"base": T}, {"frame": SIGNAL}), "times has no entry 'frame'; it has: base"),
        (([frame], T, {"frame": ["a"] * T.size}), "it must be"),
    ]:
        with pytest.raises(jv.InputError, match=says):
            jv.MeasuredRun.from_arrays(*arguments)
