"""Overviews of recorded channels, and the run of the rotor's channel."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.exchange.recordings.overview import overview_of, speed_of
from jaxvib.identification.records.recorded import Recorded

T = 5.0 + 0.01 * np.arange(400)
WAVE = np.sin(7.0 * T)


def test_overview_of_a_complete_channel():
    values = WAVE.copy()
    values[[3, 9]] = np.nan
    found = overview_of(Recorded("frame", "mm", T, values))
    assert (found.name, found.unit, found.kinds, found.samples) == ("frame", "mm", ("displacement",), 400)
    assert found.rate == pytest.approx(100.0) and (found.start, found.end) == (5.0, T[-1])
    assert (found.low, found.high) == (np.nanmin(values), np.nanmax(values)) and (found.missing, found.clipped) == (2, 0)
    (note,) = found.notes
    assert "has 2 readings that are not numbers" in note
    nothing = overview_of(Recorded("frame", "", T, WAVE))
    assert nothing.kinds == () and nothing.notes == ()


@pytest.mark.parametrize(("low", "high", "ends"), [(-9.0, 0.8, "0.7"), (-0.8, 9.0, "-0.7"), (-0.8, 0.8, "-0.7")])
def test_clipped_readings_are_counted(low, high, ends):
    values = np.clip(WAVE, low, high)
    found = overview_of(Recorded("frame", "g", T, values))
    near = np.count_nonzero((values <= low + 0.01) | (values >= high - 0.01))
    assert near <= found.clipped <= near + 20 and found.notes[0].startswith("channel 'frame' is clipped at " + ends)
    assert (" and 0.7" in found.notes[0]) == (low == -0.8 and high == 0.8)


def test_two_levels_are_no_clipping():
    levels = np.where((3.0 * T) % 1.0 < 0.5, 5.0, 0.0)
    found = overview_of(Recorded("tacho", "V", T, levels))
    assert found.clipped == 0 and found.notes == ("channel 'tacho' has two levels, like the pulses of a tachometer",)


def test_problems_are_notes():
    short = overview_of(Recorded("frame", "g", T[:-1], WAVE))
    assert short.notes == ("channel 'frame' has 399 times but 400 values",) and np.isnan(short.rate) and short.end == T[-2]
    no_times = overview_of(Recorded("frame", "g", None, np.full(30, np.nan)))
    assert np.isnan([no_times.rate, no_times.start, no_times.low]).all() and no_times.missing == 30 and no_times.notes == ()
    partly = overview_of(Recorded("frame", "g", None, np.array([1.0, np.nan, 3.0])))
    assert (partly.samples, partly.missing, partly.low, partly.high, partly.rms) == (3, 1, 1.0, 3.0, 1.0)


CHANNELS = [
    Recorded("frame", "g", T, WAVE),
    Recorded("Shaft", "RPM", T, 60.0 + T),
    Recorded("motor", "", T, 30.0 + T),
    Recorded("tacho", "V", T, np.where((6.0 * T) % 1.0 < 0.3, 5.0, 0.0)),
    Recorded("clockless", "rad/s", None, WAVE),
]


def test_speed_of_a_named_channel():
    (channel,) = speed_of(CHANNELS, None, None, 1).channels  # the first one in a unit of speed
    assert (channel.name, channel.kind, channel.unit) == ("Shaft", "speed", "RPM")
    run = speed_of(CHANNELS, None, "SHAFT", 1)
    np.testing.assert_allclose(run.values["Shaft"], (60.0 + T) * 2.0 * np.pi / 60.0)
    np.testing.assert_allclose(speed_of(CHANNELS, None, "motor", 1).values["motor"], 30.0 + T)
    pulses = speed_of(CHANNELS, "tacho", None, 3)
    assert pulses.channels[0].per_turn == 3 and pulses.channels[0].kind == "pulses" and pulses.source == "recording"
    np.testing.assert_allclose(pulses.rotor_speed()[1], 4.0 * np.pi, rtol=0.002)
    assert speed_of(CHANNELS[:1], None, None, 1) is None


@pytest.mark.parametrize(
    ("pulses", "speed", "says"),
    [
        ("none", None, "pulses is 'none'; the channels are 'frame', 'Shaft', 'motor'"),
        (None, "none", "speed is 'none'; the channels are 'frame'"),
        (None, "frame", "speed is 'frame', which is in 'g'; give a channel in rpm, rad/s or Hz"),
        (None, "clockless", "speed is 'clockless', which has no times in the file; give the sampling rate, `rate`"),
        ("clockless", None, "pulses is 'clockless', which has no times in the file"),
    ],
)
def test_unusable_channels_of_the_rotor(pulses, speed, says):
    with pytest.raises(jv.InputError) as error:
        speed_of(CHANNELS, pulses, speed, 1)
    assert str(error.value).startswith(says)


def test_vibrations_have_their_frequency_and_velocity():
    """Two sines, 2 g at 20 Hz and 1 g at 5 Hz, which is below the band: v = 2 g / (2 pi 20 Hz sqrt 2)."""
    t = np.arange(0.0, 4.0, 1e-3)
    wave = 2.0 * np.sin(2.0 * np.pi * 20.0 * t) + np.sin(2.0 * np.pi * 5.0 * t) + 0.3
    found = overview_of(Recorded("frame", "g", t, wave))
    np.testing.assert_allclose(found.main_frequency, 20.0, rtol=1e-3)
    np.testing.assert_allclose(found.rms, np.sqrt(2.5), rtol=1e-3)
    velocity = 2.0 * 9.80665 / (2.0 * np.pi * 20.0 * np.sqrt(2.0))
    np.testing.assert_allclose(found.velocity, velocity, rtol=1e-3)
    as_velocity = overview_of(Recorded("frame", "mm/s", t, 1e3 * velocity * np.sqrt(2.0) * np.cos(2.0 * np.pi * 20.0 * t)))
    np.testing.assert_allclose(as_velocity.velocity, velocity, rtol=1e-3)
    assert np.isnan(overview_of(Recorded("key", "V", t, (np.sin(30.0 * t) > 0.0) * 5.0)).main_frequency)
    assert np.isnan(overview_of(Recorded("bed", "N", t, wave)).velocity)
    slow = overview_of(Recorded("bed", "g", t[::100], np.sin(9.0 * t[::100])))  # 10 Hz, below the band
    assert slow.main_frequency > 1.0 and np.isnan(slow.velocity)
