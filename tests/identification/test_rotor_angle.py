"""Angle of a rotor from its channel, against ramps in closed form."""

import numpy as np
import pytest
from run_ups_by_scipy import ending_ramp, pulse_times

import jaxvib as jv
from jaxvib.identification.angle import _angle_of_channel

RATE = 4.0
"""Acceleration of the ramps, rad/s^2; they begin at 10 rad/s."""


def angle_at(t):
    return 10.0 * t + 0.5 * RATE * t**2


def measured(kind, times, values, **options):
    channel = jv.Channel("rotor", kind, **options)
    none = np.zeros(times.size, bool)
    return _angle_of_channel(
        jv.MeasuredRun((channel,), {"rotor": times}, {"rotor": values}, {"rotor": none}, {}, (), "run"), channel
    )


def pulses(per_turn, until=20.0):
    numbers = np.arange(int(per_turn * angle_at(until) / (2.0 * np.pi)))
    return numbers.astype(float), (-10.0 + np.sqrt(100.0 + 2.0 * RATE * 2.0 * np.pi * numbers / per_turn)) / RATE


def test_pulses_give_the_angle_and_the_speed():
    numbers, edges = pulses(6)
    found = measured("pulses", edges, numbers, per_turn=6)
    t = np.linspace(2.0, 18.0, 9)
    np.testing.assert_allclose(found.at(t), angle_at(t), rtol=1e-9)
    for each in t:
        assert float(found.drive.speed_at(each)) == pytest.approx(10.0 + RATE * each, rel=1e-7)
    assert found.span == (0.0, edges[-1]) and found.notes == ()
    assert not found.marked and measured("pulses", *pulses(1)[::-1]).marked  # no tooth of a wheel without a gap is special


@pytest.mark.parametrize("first", [0, 3, 5])
def test_zero_of_a_wheel_with_a_gap_is_the_tooth_after_it(first):
    """Tooth 4 of 6 is missing; the record begins at any tooth, which has the number 0."""
    numbers, edges = pulses(6)
    is_tooth = (numbers % 6 != 4) & (numbers >= first)
    found = measured("pulses", edges[is_tooth], numbers[is_tooth] - first, per_turn=6)
    t = np.linspace(2.0, 18.0, 9)
    away = (found.at(t) - angle_at(t) + 2.0 * np.pi * 5 / 6) / (2.0 * np.pi)
    np.testing.assert_allclose(away, np.rint(away[0]), atol=1e-6)
    assert found.marked and found.error < 1e-6


def test_uneven_marks_are_estimated():
    numbers, edges = pulses(3)
    shift = np.array([0.0, 0.02, -0.01])[numbers.astype(int) % 3]  # rad
    late = edges + shift / (10.0 + RATE * edges)
    t = np.linspace(2.0, 18.0, 9)
    found = measured("pulses", late, numbers, per_turn=3).at(t)
    np.testing.assert_allclose(found - found[0], angle_at(t) - angle_at(t[0]), atol=2e-3)


def test_times_rounded_down_are_within_the_error_of_the_angle():
    """All pulses are early by half a millisecond on average, which no mean over pulses shows."""
    numbers, edges = pulses(1)
    t = np.linspace(2.0, 18.0, 9)
    found = measured("pulses", 1e-3 * np.floor(edges / 1e-3), numbers)
    away = (found.at(t) - angle_at(t)) / np.linalg.norm(found.spline(t)[:, 1:], axis=1)
    np.testing.assert_allclose(away, np.sqrt(3.0), atol=0.7)
    assert found.error == pytest.approx(1e-3 / np.sqrt(12.0) * 53.0, rel=0.2)


def test_error_at_the_end_of_a_ramp_is_as_stated():
    """One pulse per turn; a spline that is smooth at the end of the ramp is wrong by more than a turn near rest."""
    numbers = np.arange(1.0, 176.0)
    t = np.linspace(1.1, 15.9, 2000)
    _, edges = pulse_times(ending_ramp, 15.98, 1)
    found = measured("pulses", 1e-4 * np.round(edges / 1e-4), numbers)
    errors = found.at(t) - ending_ramp(t)[0]
    assert np.max(np.abs(errors)) < 4e-3 and found.error < 4e-3  # 1e-4 s / sqrt(12) * 90 rad/s = 2.6e-3 rad
    assert np.max(np.abs(errors) / np.linalg.norm(found.spline(t)[:, 1:], axis=1)) < 3.0
    assert [float(found.drive.acceleration_at(at)) for at in (7.4, 7.6)] == pytest.approx([12.0, 0.0], abs=0.5)


def test_large_changes_of_speed_between_pulses_are_noted():
    """Speeds in the middle of two intervals of pulses differ by up to 27.5 % where the ramp begins."""
    numbers, edges = pulses(1, 6.0)
    middle = 10.0 + RATE * 0.5 * (edges[1:] + edges[:-1])
    largest = np.max(np.diff(middle) / middle[1:])
    (note,) = measured("pulses", edges, numbers).notes
    assert f"the speed changes by up to {100.0 * largest:.0f} % from one pulse to the next" in note


def test_a_speed_gives_the_angle_without_its_zero():
    t = np.linspace(0.0, 5.0, 500)
    found = measured("speed", t, -(10.0 + RATE * t))
    np.testing.assert_allclose(found.at(t[1:]) - found.at(t[:1]), angle_at(t[1:]), rtol=1e-8)
    assert not found.marked


def test_a_falling_angle_counts_as_rising_and_has_its_delay():
    t = np.linspace(0.0, 5.0, 500)
    found = measured("angle", t, -angle_at(t), delay=0.1)
    np.testing.assert_allclose(found.at(t - 0.1), angle_at(t), rtol=1e-8, atol=1e-8)


def test_noise_of_an_angle_becomes_its_error():
    t, noise = np.linspace(0.0, 5.0, 500), 1e-3
    angles = [angle_at(t) + noise * np.random.default_rng(k).normal(size=t.size) for k in range(30)]
    found = [measured("angle", t, each) for each in angles]
    real = np.sqrt(np.mean([np.mean((each.at(t) - angle_at(t)) ** 2) for each in found]))
    assert np.mean([each.error for each in found]) == pytest.approx(real, rel=0.25)


@pytest.mark.parametrize(("kind", "what"), [("pulses", "pulses"), ("speed", "readings"), ("angle", "readings")])
def test_too_few_readings_are_refused(kind, what):
    with pytest.raises(jv.InputError, match=f"has 3 {what}; at least .* are needed; record more turns"):
        measured(kind, np.array([0.0, 1.0, 2.0]), np.arange(3.0))
