"""Charts of records and of fits to them, against the numbers that they show."""

import numpy as np
import pytest

from jaxvib.draw import record
from jaxvib.draw.record import fit_chart, recording_chart, swing_chart


def noise_lines(axis):
    return [float(line.get_ydata()[0]) for line in axis.lines if line.get_linestyle() == ":"]


def test_a_swing_is_compared_in_degrees():
    time, angle, fitted = np.arange(3.0), np.radians([10.0, 20.0, -5.0]), np.radians([11.0, 19.5, -5.0])
    top, bottom = swing_chart(time, angle, fitted, np.radians(0.25)).axes
    np.testing.assert_allclose(top.lines[0].get_xydata(), [[0.0, 11.0], [1.0, 19.5], [2.0, -5.0]])
    np.testing.assert_allclose(top.lines[1].get_ydata(), [10.0, 20.0, -5.0])
    np.testing.assert_allclose(bottom.lines[0].get_ydata(), [-1.0, 0.5, 0.0], atol=1e-12)
    assert noise_lines(bottom) == pytest.approx([-0.5, 0.5])
    assert [text.get_text() for text in bottom.get_legend().get_texts()] == ["twice the noise"]


def test_a_fit_shows_its_difference_relative_to_the_noise():
    readings, fitted = np.array([[1.0, 5.0], [2.0, 7.0]]), np.array([[1.5, 5.0], [1.0, 3.0]])
    top, bottom = fit_chart(np.array([0.0, 2.0]), readings, fitted, np.array([0.5, 2.0]), ["a", "b"]).axes
    assert [line.get_xydata().tolist() for line in top.lines] == [
        [[0.0, values[0]], [2.0, values[1]]] for values in ([1.0, 2.0], [1.5, 1.0], [5.0, 7.0], [5.0, 3.0])
    ]
    assert [line.get_ydata().tolist() for line in bottom.lines[:2]] == [[-1.0, 2.0], [0.0, 2.0]]
    assert noise_lines(bottom) == [-2.0, 2.0]
    assert top.lines[0].get_color() == top.lines[1].get_color() == bottom.lines[0].get_color() != top.lines[2].get_color()


def test_a_recording_is_drawn_with_the_speed_below():
    time, values = np.arange(4.0), np.array([1.0, -2.0, np.nan, 0.5])
    signals = [("frame, g", time, values), ("motor, g", time, 2.0 * values)]
    frame, motor, speed = recording_chart(signals, (np.array([0.0, 3.0]), np.array([np.pi, 2.0 * np.pi]))).axes
    for axis, factor in ((frame, 1.0), (motor, 2.0)):
        np.testing.assert_array_equal(axis.lines[0].get_xydata(), np.stack([time, factor * values], axis=1))
    np.testing.assert_allclose(speed.lines[0].get_xydata(), [[0.0, 30.0], [3.0, 60.0]])
    assert [axis.get_ylabel() for axis in (frame, motor, speed)] == ["frame, g", "motor, g", "rotor speed, rpm"]
    assert speed.get_xlabel() == "time, s"


def test_a_long_recording_keeps_its_extremes(monkeypatch):
    monkeypatch.setattr(record, "_MAX_SHOWN_POINTS", 8)
    time, values = np.arange(18.0), np.zeros(18)
    values[[2, 7, 17]] = 3.0, -4.0, 5.0
    values[10:15] = np.nan
    (axis,) = recording_chart([("a", time, values)]).axes
    x, y = axis.lines[0].get_data()
    assert x.tolist() == [0.0, 0.0, 5.0, 5.0, 10.0, 10.0, 15.0, 15.0]
    np.testing.assert_array_equal(y, [0.0, 3.0, -4.0, 0.0, np.nan, np.nan, 0.0, 5.0])
