"""Pulses of a tachometer: edges, missed and doubled pulses, uneven marks, starts from rest."""

import numpy as np
import pytest

import jaxvib as jv

RATE = 5000.0


def pulse_times(angle, per_turn=1, offsets=None):
    """Times at which an angle, given on a fine grid (times, angles), passes the marks."""
    time, turned = angle
    marks = np.arange(0, int(turned[-1] / (2.0 * np.pi) * per_turn))
    at = 2.0 * np.pi * marks / per_turn + (0.0 if offsets is None else np.asarray(offsets)[marks % per_turn])
    return np.interp(at, turned, time)


def ramp(start=20.0, rate=4.0, until=20.0):
    time = np.linspace(0.0, until, 200_001)
    return time, start * time + 0.5 * rate * time**2


def tacho(times, **options):
    channel = jv.Channel("tacho", "pulses", **options)
    return jv.MeasuredRun.from_arrays([channel], {"tacho": times}, {})


def test_complete_pulses_are_numbered_without_notes():
    times = pulse_times(ramp())
    found = tacho(times)
    np.testing.assert_array_equal(found.values["tacho"], np.arange(times.size))
    assert found.notes == ()


@pytest.mark.parametrize("per_turn", [1, 4, 60])
def test_start_from_rest_misses_no_pulse(per_turn):
    times = pulse_times(ramp(0.0, 10.0), per_turn)
    found = tacho(times, per_turn=per_turn)
    assert found.notes == () and found.values["tacho"][-1] == times.size - 1


def test_coast_down_misses_no_pulse():
    time = np.linspace(0.0, 19.9, 200_001)
    assert tacho(pulse_times((time, 200.0 * time - 5.0 * time**2))).notes == ()


def test_uneven_marks_miss_no_pulse():
    assert tacho(pulse_times(ramp(), 4, [0.0, 0.3, -0.2, 0.1]), per_turn=4).notes == ()


@pytest.mark.parametrize("start", [0.0, 20.0])
def test_missed_pulses_are_counted(start):
    times = pulse_times(ramp(start))
    lost = [10, 40, 41, 90]
    found = tacho(np.delete(times, lost))
    np.testing.assert_array_equal(found.values["tacho"], np.delete(np.arange(times.size), lost))
    assert found.notes == (f"run: channel 'tacho' missed 4 pulses, the first at {times[9]:.4g} s, which are counted",)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5])
def test_doubled_pulses_are_left_out(share):
    times = pulse_times(ramp())
    false = [times[k] + share * (times[k + 1] - times[k]) for k in (12, 50, 77)]
    found = tacho(np.sort(np.concatenate([times, false])))
    np.testing.assert_allclose(found.times["tacho"], times, atol=0.06 * np.max(np.diff(times)))
    np.testing.assert_array_equal(found.values["tacho"], np.arange(times.size))
    assert "had 3 false pulses, the first at" in found.notes[0]


def test_toothed_wheel_with_a_gap_keeps_its_angle():
    times = pulse_times(ramp(), 60)
    kept = np.flatnonzero(np.arange(times.size) % 60 < 58)
    found = tacho(times[kept], per_turn=60)
    np.testing.assert_array_equal(found.values["tacho"], kept)
    assert "missed" in found.notes[0]


def test_edges_are_interpolated_between_samples():
    time = np.arange(0.0, 10.0, 1.0 / RATE)
    turned = 20.0 * time + 2.0 * time**2
    level = 2.5 + 2.5 * np.tanh(8.0 * np.sin(turned))  # edges of a millisecond
    level += 0.02 * np.random.default_rng(0).standard_normal(time.size)
    channel = jv.Channel("tacho", "pulses", unit="V")
    found = jv.MeasuredRun.from_arrays([channel], time, {"tacho": level})
    fine = np.linspace(0.0, 10.0, 500_001)
    true = np.interp(2.0 * np.pi * np.arange(1, found.times["tacho"].size + 1), 20.0 * fine + 2.0 * fine**2, fine)
    assert np.max(np.abs(found.times["tacho"] - true)) < 0.2 / RATE
    assert found.notes == ()


def test_narrow_pulses_and_falling_edges_are_found():
    time = np.arange(0.0, 20.0, 1.0 / RATE)
    phase = (3.0 * time) % 1.0
    level = np.where(phase < 0.004, 0.0, 5.0)  # a notch: the edge that the rotor reaches first falls
    up, down = (
        jv.MeasuredRun.from_arrays([jv.Channel("tacho", "pulses", direction=each)], time, {"tacho": level})
        for each in ("up", "down")
    )
    np.testing.assert_allclose(down.times["tacho"][:50], np.arange(1, 51) / 3.0, atol=2.0 / RATE)
    np.testing.assert_allclose(up.times["tacho"][1:50] - down.times["tacho"][:49], 0.004 / 3.0, atol=2.0 / RATE)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        (np.arange(5.0), "has 5 pulses; at least 12 are needed; record more turns"),
        (np.array([*range(20), 3.0]), "has a pulse at 3 s after one at 19 s; times must ascend"),
        (np.delete(np.arange(60.0), np.arange(5, 55, 4)), "misses 13 and doubles 0 of 47 pulses; check the trigger level"),
    ],
)
def test_unusable_pulses_raise_clear_errors(times, says):
    with pytest.raises(jv.InputError) as error:
        tacho(times)
    assert says in str(error.value) and "channel 'tacho'" in str(error.value)


def test_constant_level_has_no_pulses():
    time = np.arange(0.0, 1.0, 0.001)
    with pytest.raises(jv.InputError, match="is constant; give a channel with the pulses"):
        jv.MeasuredRun.from_arrays([jv.Channel("tacho", "pulses")], time, {"tacho": np.ones(time.size)})


@pytest.mark.parametrize("per_turn", [1, 8])
def test_speed_does_not_jump_by_a_sample(per_turn):
    """A sample per turn is up to 1.4 rad/s; the pulses are rounded to samples, because the signal has two levels."""
    time = np.arange(0.0, 20.0, 1.0 / 1638.3)
    level = np.where((60.0 * time + 2.0 * time**2) * per_turn / (2.0 * np.pi) % 1.0 < 0.3, 1.0, 0.0)
    found = jv.MeasuredRun.from_arrays([jv.Channel("tacho", "pulses", per_turn=per_turn)], time, {"tacho": level})
    middles, speed = found.rotor_speed()
    np.testing.assert_allclose(speed, 60.0 + 4.0 * middles, atol=0.05)
