"""Charts of captures, against the numbers that they show."""

import numpy as np
import pytest

from jaxvib.draw.capture import curve_chart, threshold_chart, torus_paths


def box_of(area):
    box = area.get_paths()[0].get_extents()
    return [box.x0, box.x1, box.y0, box.y1]


def test_a_share_has_its_error_within_0_and_1():
    speed, share = np.array([-0.5, -0.1]), np.array([0.05, 0.9])
    axis = threshold_chart(speed, share, np.array([0.1, 0.2]), -0.3).axes[0]
    corners = axis.collections[0].get_paths()[0].vertices
    assert {(-0.5, 0.0), (-0.1, 0.7), (-0.1, 1.0)} <= {tuple(np.round(corner, 12).tolist()) for corner in corners}
    assert axis.lines[0].get_xydata().tolist() == [[-0.5, 0.05], [-0.1, 0.9]]
    assert [line.get_label() for line in axis.lines] == ["fraction, with its standard error", "threshold -0.300"]
    plain = threshold_chart(speed, share, None, np.nan).axes[0]
    assert not plain.collections and [line.get_label() for line in plain.lines] == ["fraction"]


def test_thresholds_show_lower_captures_and_missing_ones():
    value, threshold = np.array([1.0, 2.0, 3.0]), np.array([-0.5, -0.4, np.nan])
    axis = curve_chart(value, threshold, np.array([0.1, 0.1, np.nan]), np.array([-0.55, -0.7, -0.9])).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axis.lines}
    np.testing.assert_array_equal(lines["lowest captured speed"], [[1.0, np.nan], [2.0, -0.7], [3.0, np.nan]])
    assert lines["not all starts captured"].tolist() == [[3.0, 0.0]]
    assert box_of(axis.collections[0]) == [1.0, 2.0, -0.5, 0.0]
    bars = axis.containers[0].lines[2][0].get_segments()
    np.testing.assert_allclose(bars[:2], [[[1.0, -0.6], [1.0, -0.4]], [[2.0, -0.5], [2.0, -0.3]]])
    whole = curve_chart(value[:2], threshold[:2], np.full(2, 0.1), threshold[:2]).axes[0]
    labels = [text.get_text() for text in whole.get_legend().get_texts()]
    assert labels == ["all starts captured", "threshold"]


def test_paths_on_a_torus_are_unrolled_into_one_turn():
    time = np.arange(20.0)
    around = np.radians(np.stack([np.linspace(101.0, 291.0, 20), np.full(20, 30.0)], axis=1))
    across = np.radians(np.stack([np.full(20, -80.0), np.linspace(201.0, 391.0, 20)], axis=1))
    rate = np.stack([0.1 * time, -0.1 * time], axis=1)
    paths, speeds = torus_paths(around, across, rate, time).axes
    lines = [line.get_xydata() for line in paths.lines]
    first, late, start, end = lines[:4]
    np.testing.assert_allclose(first[:8, 0], np.linspace(101.0, 171.0, 8))
    assert np.isnan(first[8, 0])  # crosses 180 degrees
    np.testing.assert_allclose(first[9:, 0], np.linspace(-169.0, -69.0, 11))
    np.testing.assert_allclose(first[:, 1], -80.0)
    np.testing.assert_allclose(late, first[18:])
    np.testing.assert_allclose(np.concatenate([start, end]), [[101.0, -80.0], [-69.0, -80.0]])
    second = lines[4]
    np.testing.assert_allclose(second[[0, 6, 7, 19], 1], [201.0, 261.0, -89.0, 31.0])
    assert np.flatnonzero(np.isnan(second[:, 0])).tolist() == [7]  # crosses 270 degrees
    labels = [text.get_text() for text in paths.get_legend().get_texts()]
    assert labels == ["ball 1, the last tenth", "start", "end", "ball 2, the last tenth", "outer equator"]
    assert [line.get_ydata()[0] for line in paths.lines if line.get_label() == "outer equator"] == [90.0]
    for k in (0, 1):
        np.testing.assert_array_equal(speeds.lines[k].get_xydata(), np.stack([time, rate[:, k]], axis=1))


def test_a_short_path_ends_with_its_last_point():
    paths = torus_paths(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 1)), np.arange(2.0)).axes[0]
    assert paths.lines[1].get_xydata() == pytest.approx(np.zeros((0, 2)))
