"""Channels of a run compared with one another: units, signs, swapped channels, shafts, clocks, aliasing."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification.records.agreement import _factor, _Signal, turn_speed

T = np.arange(0.0, 20.0, 1e-3)
SPEED = 20.0 + 4.0 * T + 3.0 * np.sin(0.7 * T)
ANGLE = 20.0 * T + 2.0 * T**2 - 3.0 / 0.7 * np.cos(0.7 * T)


def motion(seed):
    """Displacement, velocity and acceleration of one motion with 60 frequencies, exact."""
    rng = np.random.default_rng(seed)
    w, a, b = rng.uniform(15.0, 400.0, 60), rng.normal(size=60), rng.uniform(0.0, 6.28, 60)
    phase = np.outer(T, w) + b
    return (np.sin(phase) / w**2) @ a, (np.cos(phase) / w) @ a, -np.sin(phase) @ a


FIRST, SECOND = motion(0), motion(1)
NOISE = np.random.default_rng(2).standard_normal((4, T.size))
KINDS = ("displacement", "velocity", "acceleration")


def run(*readings, times=T):
    """A run from pairs of a channel and its values."""
    channels, values = zip(*readings, strict=True)
    own = {channel.name: times for channel in channels}
    own |= {channel.name: pulse_times(channel.per_turn) for channel in channels if channel.kind == "pulses"}
    named = {channel.name: value for channel, value in zip(channels, values, strict=True) if value is not None}
    return jv.MeasuredRun.from_arrays(channels, own, named)


def pulse_times(per_turn=1):
    marks = np.arange(int((ANGLE[-1] - ANGLE[0]) / (2.0 * np.pi) * per_turn))
    return np.interp(ANGLE[0] + 2.0 * np.pi * marks / per_turn, ANGLE, T)


def sensor(kind, at=1, unit=None, direction=None, name=None):
    return jv.Channel(name or f"{kind}{at}", kind, at=at, unit=unit, direction=direction)


def noisy(k, values):
    return values + 0.02 * np.std(values) * NOISE[k]


TACHO = jv.Channel("tacho", "pulses"), None


def speed(unit=None):
    return jv.Channel("n", "speed", unit=unit)


def test_the_time_at_which_records_begin_changes_no_factor():
    def factor(begin):
        pairs = (("velocity", FIRST[1]), ("acceleration", FIRST[2]))
        return _factor(*(_Signal(sensor(kind), "", T + begin, value) for kind, value in pairs))

    assert factor(0.0) == pytest.approx(1.0, abs=0.01) and factor(64.0) == pytest.approx(factor(0.0), rel=1e-9)


def test_agreeing_channels_have_no_notes():
    found = run(
        TACHO,
        (speed("rpm"), noisy(0, SPEED * 30.0 / np.pi)),
        (jv.Channel("phi", "angle", unit="deg"), np.rad2deg(ANGLE)),
        *((sensor(kind), noisy(k, FIRST[k])) for k, kind in enumerate(KINDS)),
        (sensor("acceleration", 2, "g"), SECOND[2] / 9.80665),
        (sensor("acceleration", 2, direction="down", name="upside down"), -SECOND[2]),
    )
    assert found.notes == ()


@pytest.mark.parametrize(
    ("stated", "real", "factor"),
    [(None, "rpm", 30.0 / np.pi), ("rpm", "rad/s", 1.0), ("rpm", "Hz", 0.5 / np.pi), ("Hz", "rpm", 30.0 / np.pi)],
)
def test_error_of_a_wrong_unit_of_a_speed_names_a_fitting_unit(stated, real, factor):
    with pytest.raises(jv.InputError) as error:
        run(TACHO, (speed(stated), SPEED * factor))
    assert "channel 'n' is " in str(error.value) and f"the unit '{real}' would fit" in str(error.value)


@pytest.mark.parametrize("ratio", [2.0, 0.5, 1.37])
def test_ratio_of_shafts_is_named(ratio):
    with pytest.raises(jv.InputError) as error:
        run(TACHO, (speed(), noisy(0, ratio * SPEED)))
    assert f"channel 'n' turns {ratio:.3g}" in str(error.value)
    assert "times as fast as 'tacho' at all times: correct per_turn, or leave out" in str(error.value)


def test_wrong_number_of_marks_is_seen():
    wrong = jv.Channel("tacho", "pulses", per_turn=4)
    times = {"tacho": pulse_times(8), "n": T}
    with pytest.raises(jv.InputError, match=r"turns 0.5 times as fast as 'tacho' at all times: correct per_turn"):
        jv.MeasuredRun.from_arrays([wrong, speed()], times, {"n": SPEED})


def test_speeds_of_different_rotors_are_refused():
    with pytest.raises(jv.InputError, match=r"and 'tacho' are not the speed of one rotor: their ratio changes by \d+ %"):
        run(TACHO, (speed(), 180.0 - SPEED))


def test_angle_that_turns_against_pulses_is_refused():
    with pytest.raises(jv.InputError, match=r"turns in the opposite direction to '(phi|tacho)'"):
        run(TACHO, (jv.Channel("phi", "angle"), -ANGLE))


def test_uneven_marks_agree_with_a_speed():
    offsets = np.array([0.0, 0.3, -0.2, 0.1])
    marks = np.arange(int((ANGLE[-1] - ANGLE[0]) / (2.0 * np.pi) * 4) - 1)
    times = np.interp(ANGLE[0] + 0.5 * np.pi * marks + offsets[marks % 4], ANGLE, T)
    tacho = jv.Channel("tacho", "pulses", per_turn=4)
    assert jv.MeasuredRun.from_arrays([tacho, speed()], {"tacho": times, "n": T}, {"n": SPEED}).notes == ()


@pytest.mark.parametrize(("one", "other"), [(0, 1), (0, 2), (1, 2), (2, 2)])
def test_reversed_sign_is_named(one, other):
    first, second = sensor(KINDS[one], name="one"), sensor(KINDS[other], name="other")
    with pytest.raises(jv.InputError, match=r"channel 'other' has the reversed sign of 'one' at the same place"):
        run((first, noisy(0, FIRST[one])), (second, noisy(1, -FIRST[other])))


@pytest.mark.parametrize(
    ("kinds", "stated", "factor", "fits"),
    [
        ((0, 2), (None, None), (1.0, 1.0 / 9.80665), "the unit 'g' for 'other' would fit"),
        ((0, 2), ("mm", "g"), (1.0, 1.0 / 9.80665), "the unit 'm' for 'one' would fit"),
        ((1, 2), ("m/s", None), (1e3, 1.0), "the unit 'mm/s' for 'one' would fit"),
        ((0, 1), ("m", None), (1e6, 1.0), "the unit 'um' for 'one' would fit"),
        ((0, 1), ("m", None), (1.0, 2.0), "correct the unit, the place or the gain of one of them"),
    ],
)
def test_error_of_a_wrong_unit_of_a_motion_names_a_fitting_unit(kinds, stated, factor, fits):
    readings = [
        (sensor(KINDS[k], unit=unit, name=name), FIRST[k] * scale)
        for k, unit, scale, name in zip(kinds, stated, factor, ("one", "other"), strict=True)
    ]
    with pytest.raises(jv.InputError) as error:
        run(*readings)
    assert "times the motion that follows from 'one' at the same place; " in str(error.value) and fits in str(error.value)


def test_swapped_channels_are_named():
    with pytest.raises(jv.InputError, match=r"channels 'acceleration1' and 'acceleration2' are swapped"):
        run(
            (sensor("velocity", 1), noisy(0, FIRST[1])),
            (sensor("velocity", 2), noisy(1, SECOND[1] + 0.5 * FIRST[1])),
            (sensor("acceleration", 1), noisy(2, SECOND[2] + 0.5 * FIRST[2])),
            (sensor("acceleration", 2), noisy(3, FIRST[2])),
        )


def test_swapped_directions_of_one_point_are_named():
    with pytest.raises(jv.InputError, match=r"channels 'across acceleration' and 'up acceleration' are swapped"):
        run(
            (sensor("velocity", direction="across", name="across velocity"), noisy(0, FIRST[1])),
            (sensor("velocity", direction="up", name="up velocity"), noisy(1, SECOND[1])),
            (sensor("acceleration", direction="across", name="across acceleration"), noisy(2, SECOND[2])),
            (sensor("acceleration", direction="up", name="up acceleration"), noisy(3, FIRST[2])),
        )


def test_missing_teeth_do_not_change_the_speed_of_a_wheel():
    marks = np.arange(12 * 30)
    uneven = marks + 0.2 * np.sin(2.0 * np.pi * marks / 12.0)  # the same error in every turn
    time = np.sqrt(marks[1:].size + uneven) / 10.0  # angle = 100 t^2 - 359 teeth
    kept = marks % 12 != 11
    channel = jv.Channel("tacho", "pulses", per_turn=12)
    found, speeds = turn_speed(channel, time[kept], marks[kept].astype(float))
    np.testing.assert_allclose(speeds, 200.0 * found * 2.0 * np.pi / 12.0, rtol=1e-12)


def test_rotor_above_half_the_sampling_rate_is_refused():
    t = np.arange(0.0, 20.0, 0.05)
    times = {"tacho": pulse_times(), "acceleration1": t}
    with pytest.raises(jv.InputError) as error:
        jv.MeasuredRun.from_arrays([TACHO[0], sensor("acceleration")], times, {"acceleration1": np.sin(t)})
    assert "is sampled at 20 Hz, less than twice the highest rotor speed, 16" in str(error.value)
    assert "its vibration is aliased; record at more than 41" in str(error.value)


def test_power_near_half_the_sampling_rate_is_noted():
    found = run((sensor("acceleration"), np.sin(2.0 * np.pi * 560.0 * T) + 0.1 * NOISE[0]))
    assert "between 0.4 and 0.5 times its sampling rate of 1000 Hz: it is probably aliased" in found.notes[0]


@pytest.mark.parametrize("drift", [1e-3, -1e-3])
def test_drifting_clock_is_measured(drift):
    late = np.interp((1.0 - drift) * T, T, SPEED)  # the reading at time t is of the time t - drift t
    found = run(TACHO, (speed(), late + 0.01 * NOISE[0]))
    assert "the clocks of 'tacho' and 'n' drift by " in found.notes[0]
    assert float(found.notes[0].split("drift by ")[1].split(" ms")[0]) == pytest.approx(20.0, rel=0.2)


def test_constant_delay_is_no_drift():
    assert run(TACHO, (speed(), np.interp(T - 0.01, T, SPEED) + 0.01 * NOISE[0])).notes == ()
