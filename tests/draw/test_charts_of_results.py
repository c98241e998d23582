"""Small charts of results, against the numbers that they show."""

import numpy as np
import pytest

from jaxvib.draw.results import (
    drag_diagram,
    drag_limits_chart,
    modes_chart,
    multiplier_chart,
    points_chart,
    shapes_chart,
    signals_chart,
    speeds_chart,
)


def named(axis):
    return {line.get_label(): line.get_xydata().tolist() for line in axis.lines if len(line.get_xdata())}


def marks(axis):
    return [(line.get_xydata().tolist(), line.get_markerfacecolor()) for line in axis.lines if line.get_linestyle() == "None"]


def test_jam_modes_are_filled_where_they_are_stable():
    mode, stable = np.array([1, 2, 3]), np.array([True, False, True])
    omega, amplitude = np.array([1.0, 2.0, np.nan]), np.array([[1e-3, np.deg2rad(2.0)], [4e-3, 0.0], [np.nan, np.nan]])
    about = {"names": ["y", "tilt"], "units": ["m", "rad"], "unit": "rad/s"}
    top, bottom = modes_chart(mode, omega, stable, amplitude, np.array([0.9, 2.1]), **about).axes
    filled, hollow = marks(top)[:2]
    np.testing.assert_array_equal(filled[0], [[1.0, 1.0], [3.0, np.nan]])
    assert hollow == ([[2.0, 2.0]], "white") and filled[1] != "white"
    np.testing.assert_array_equal(marks(bottom)[0][0], [[1.0, 1.0], [3.0, np.nan]])
    assert marks(bottom)[1][0] == [[2.0, 4.0]] and marks(bottom)[3][0] == [[2.0, 0.0]]
    assert [line.get_ydata()[0] for line in top.lines if line.get_linestyle() == ":"] == [0.9, 2.1]
    assert bottom.get_ylim() == pytest.approx((0.6, 6.8)) and bottom.get_xlim() == (0.5, 2.5)
    assert bottom.get_xticks().tolist() == [1.0, 2.0]
    assert [text.get_text() for text in bottom.get_legend().get_texts()] == ["y, mm", "tilt, deg"]
    assert bottom.get_ylabel() == "amplitude, mm, deg, zero to peak" and top.get_ylabel() == "load speed, rad/s"


def test_no_jam_mode_leaves_a_linear_axis():
    bottom = modes_chart(np.array([1]), np.array([np.nan]), np.array([False]), np.array([[np.nan]]), names=["y"]).axes[1]
    assert bottom.get_yscale() == "linear" and bottom.get_xticks().tolist() == []


def test_bars_of_a_mode_shape_have_its_heights():
    shape = np.array([[1.0, -0.5], [0.25, 1.0]])
    axis = shapes_chart(np.array([10.0, 20.0]), shape, names=("y1", "y2"), unit="rad/s").axes[0]
    np.testing.assert_array_equal([bar.get_height() for bar in axis.patches], shape.T.ravel())
    assert not any(line.get_visible() for line in axis.get_xgridlines()) and axis.get_ygridlines()[0].get_visible()
    assert [text.get_text() for text in axis.get_xticklabels()] == ["10 rad/s", "20 rad/s"]


def test_speeds_are_points_and_intervals_are_bars_below():
    rows = [("resonances", np.array([10.0, np.nan])), ("other", np.array([30.0]))]
    spans = [("balancing", np.array([[12.0, 20.0], [np.nan, np.nan], [31.0, np.inf]])), ("exact", np.array([[5.0, 6.0]]))]
    axis = speeds_chart(rows, spans, unit="rad/s").axes[0]
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), [[10.0, 3.0], [np.nan, 3.0]])
    assert axis.lines[1].get_xydata().tolist() == [[30.0, 2.0]]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width(), bar.get_y() + 0.5 * bar.get_height()) for bar in axis.patches]
    np.testing.assert_allclose(bars, [(12.0, 20.0, 1.0), (31.0, 1.15 * 31.0, 1.0), (5.0, 6.0, 0.0)])
    assert axis.get_xlim() == pytest.approx((0.0, 1.15 * 31.0))
    labels = dict(zip(axis.get_yticks().tolist(), [text.get_text() for text in axis.get_yticklabels()], strict=True))
    assert labels == {3.0: "resonances", 2.0: "other", 1.0: "balancing", 0.0: "exact"}


def test_every_signal_has_a_panel_with_its_curves():
    x, values = np.arange(3.0), np.array([[1.0, 2.0], [3.0, 5.0], [7.0, 11.0]])
    top, bottom = signals_chart(x, [("angle, rad", values, ["a", "b"]), ("force, N", values[:, :1], ["c"])], x_label="t").axes
    assert named(top) == {name: np.stack([x, values[:, k]], 1).tolist() for k, name in enumerate("ab")}
    assert named(bottom) == {"c": np.stack([x, values[:, 0]], 1).tolist()}
    assert top.get_legend() is not None and bottom.get_legend() is None
    assert (top.get_ylabel(), bottom.get_ylabel(), bottom.get_xlabel()) == ("angle, rad", "force, N", "t")


def test_points_are_counted_from_1():
    axis = points_chart(np.array([[1.0, 2.0], [3.0, 5.0]]), x_label="run", y_label="y").axes[0]
    assert [line.get_xydata().tolist() for line in axis.lines] == [[[1.0, 1.0], [2.0, 3.0]], [[1.0, 2.0], [2.0, 5.0]]]


def test_multipliers_are_told_apart_by_the_unit_circle():
    axis = multiplier_chart(np.array([0.5 + 0.1j, -1.0, 0.9 + 0.9j])).axes[0]
    lines = named(axis)
    assert lines["stable: 2"] == [[0.5, 0.1], [-1.0, 0.0]] and lines["unstable: 1"] == [[0.9, 0.9]]
    limit = np.asarray(lines["limit of stability"])
    np.testing.assert_allclose(np.hypot(*limit.T), 1.0)
    np.testing.assert_allclose(limit[[0, 45, 90, 180]], [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]], atol=1e-12)


def test_jams_over_the_drag_have_the_scenes_jams_as_points():
    drag, speed = np.array([1.0, 2.0, 3.0]), np.array([5.0, 6.0, 7.0])
    branch, jams = ("all together", drag, speed, np.array([True, True, False])), (np.array([5.5, 6.5]), np.array([True, False]))
    about = {"label": "drag, N s/m", "at": 1.5, "unit": "rad/s"}
    axis = drag_diagram([branch], 8.0, jams=jams, within=(0.25, 4.0), **about).axes[0]
    assert [line.get_xydata().tolist() for line in axis.lines[:2]] == [[[1.0, 5.0], [2.0, 6.0], [3.0, 7.0]], [[3.0, 7.0]]]
    assert [line.get_linestyle() for line in axis.lines[:2]] == ["-", "--"]
    points = [(xy, face) for xy, face in marks(axis) if xy]
    assert points == [([[1.5, 6.5]], "white"), ([[1.5, 5.5]], "black")]
    assert axis.get_xlim() == pytest.approx((0.375, 6.0)) and axis.get_ylim() == pytest.approx((0.0, 8.4))
    lines = named(axis)
    assert [y for _, y in lines["rotor speed"]] == [8.0, 8.0]
    assert [x for x, _ in lines["the scene's drag; points: its jams"]] == [1.5, 1.5]


def test_limits_of_drag_leave_out_resonances_without_one():
    omega, drag = np.array([9.0, 20.0]), np.array([0.5, np.nan])
    axis = drag_limits_chart(omega, drag, np.array([9.1, 20.2]), unit="rad/s").axes[0]
    assert named(axis)["no jam above"] == [[9.0, 0.5]] and axis.get_yscale() == "log"
    assert [line.get_xdata()[0] for line in axis.lines if line.get_linestyle() == ":"] == [9.1, 20.2]
    assert drag_limits_chart(omega, np.full(2, np.nan), omega).axes[0].get_yscale() == "linear"
