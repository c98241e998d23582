"""Charts that compare methods of computation, against the numbers that they show."""

import itertools

import numpy as np
import pytest

from jaxvib.draw.comparison import (
    CostPanel,
    audit_chart,
    convergence_chart,
    cost_chart,
    stability_chart,
    steps_chart,
    tiers_chart,
)
from jaxvib.draw.style import HATCHED, NO_RESULT

EPS = np.finfo(float).eps


def points_of(axis, style="-"):
    """Points of the lines with a style."""
    return [line.get_xydata().tolist() for line in axis.lines if line.get_linestyle() == style and len(line.get_xdata())]


def test_differences_have_filled_points_where_jams_are_stable():
    mass, values = np.array([0.1, 1.0, 10.0]), np.array([1e-4, 1e-3, 1e-2])
    axis = tiers_chart(mass, {"force": values, "power": 2.0 * values}, np.array([True, False, True])).axes[0]
    whole, filled, hollow = (line.get_xydata().tolist() for line in axis.lines[3:6])
    assert whole == [[0.1, 2e-4], [1.0, 2e-3], [10.0, 2e-2]]
    assert filled == [whole[0], whole[2]] and hollow == [whole[1]]
    faces = [line.get_markerfacecolor() for line in axis.lines[3:6]]
    assert faces[2] == "white" and faces[1] != "white"


def test_costs_have_the_same_look_in_every_panel():
    first = {"a": np.array([[1e-3, 1e-4], [2e-3, np.nan], [4e-3, 0.0]]), "b": np.array([[1e-2, 1e-6]])}
    second = {"b": np.array([[1e-2, 1e-5]])}
    shown = {"x": CostPanel(first, 1e-9, "force", np.zeros((0, 2))), "y": CostPanel(second, 1e-3, "power", second["b"])}
    left, right = cost_chart(shown, [1e-6]).axes
    assert points_of(left) == [[[1e-3, 1e-4], [4e-3, 1e-16]], [[1e-2, 1e-6]]]
    assert left.lines[1].get_color() == right.lines[0].get_color() != left.lines[0].get_color()
    assert left.get_ylim() == pytest.approx((1e-15, 0.03)) and right.get_ylim() == pytest.approx((3e-6, 0.03))
    floors = [axis.patches[0].get_extents().transformed(axis.transData.inverted()).y1 for axis in (left, right)]
    assert floors == pytest.approx([1e-9, 1e-3])
    assert points_of(right, "None") == [[[1e-2, 1e-5]]] and points_of(left, "None") == []
    assert [line.get_ydata()[0] for line in left.lines if line.get_linestyle() == ":"] == [1e-6]


def test_three_panels_of_costs_leave_a_place_without_an_axis():
    panel = CostPanel({"a": np.array([[1e-3, 1e-4]])}, 1e-9, "force", np.zeros((0, 2)))
    figure = cost_chart(dict.fromkeys("xyz", panel), [1e-6])
    assert [axis.axison for axis in figure.axes] == [True, True, True, False]
    assert [axis.get_title() for axis in figure.axes] == ["x", "y", "z", ""]


def test_convergence_shows_errors_above_their_estimates():
    harmonics, error = np.array([2.0, 4.0]), np.array([[1e-3, 1e-2], [0.0, 1e-5]])
    axis = convergence_chart(harmonics, error, 3.0 * error, names=["5 rpm", "9 rpm"]).axes[0]
    assert points_of(axis) == [[[2.0, 1e-3], [4.0, EPS]], [[2.0, 1e-2], [4.0, 1e-5]]]
    assert points_of(axis, "--") == [[[2.0, pytest.approx(3e-3)], [4.0, EPS]], [[2.0, 0.03], [4.0, pytest.approx(3e-5)]]]


@pytest.mark.parametrize(
    ("value", "scale", "edges"),
    [
        ([5.0], "linear", [4.5, 5.5]),
        ([0.2], "linear", [0.1, 0.3]),
        ([1.0, 2.0, 3.0], "linear", [1.0, 1.5, 2.5, 3.0]),
        ([0.0, 1.0, 9.0], "linear", [0.0, 0.5, 5.0, 9.0]),
        ([1.0, 4.0, 64.0], "log", [1.0, 2.0, 16.0, 64.0]),
    ],
)
def test_bands_of_stable_jams_meet_midway(value, scale, edges):
    value = np.asarray(value)
    omega = np.tile(np.array([1.0, 2.0, 3.0]), (value.size, 1))
    stable = np.tile([True, True, False], (value.size, 1))
    marks = {"fold": np.array([[2.0, value[0]]])}
    axis = stability_chart(value, omega, stable, marks, label="x", unit="Hz").axes[0]
    boxes = [area.get_paths()[0].get_extents() for area in axis.collections]
    np.testing.assert_allclose([(box.y0, box.y1) for box in boxes], list(itertools.pairwise(edges)))
    turn = 2.0 * np.pi
    np.testing.assert_allclose([(box.x0, box.x1) for box in boxes], [(1.0 / turn, 2.0 / turn)] * value.size)
    assert axis.get_yscale() == scale and axis.get_ylim()[0] < edges[0] and edges[-1] < axis.get_ylim()[1]
    assert axis.get_xlim() == pytest.approx((1.0 / turn, 3.0 / turn))
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[2.0 / turn, value[0]]])
    assert axis.get_xlabel() == "load speed, Hz"
    (computed,) = (line for line in axis.lines if line.get_label() == "computed values")
    np.testing.assert_array_equal(computed.get_xydata(), [[0.0, each] for each in value])
    names = [text.get_text() for text in axis.get_legend().get_texts()]
    assert names == ["fold", "computed values", "stable", "unstable"]


def test_load_speeds_without_a_jam_are_hatched_and_named():
    nan = np.nan
    omega = np.array([[1.0, 2.0, 3.0, 4.0, 5.0], [nan, 2.0, 3.0, nan, 5.0], [nan] * 5])
    stable = np.array([[True, True, False, False, False], [False, True, True, False, False], [False] * 5])
    axis = stability_chart(np.array([1.0, 2.0, 3.0]), omega, stable, {}, label="x", unit="rad/s").axes[0]
    hatched = [area for area in axis.collections if area.get_hatch() == HATCHED[NO_RESULT]["hatch"]]
    spans = [[(path.get_extents().x0, path.get_extents().x1) for path in area.get_paths()] for area in hatched]
    assert spans == [[(1.0, 2.0), (3.0, 5.0)], [(1.0, 5.0)]]
    names = [text.get_text() for text in axis.get_legend().get_texts()]
    assert names == ["computed values", "stable", "unstable", "no jam found"]


def test_an_audit_shows_changes_in_percent_from_the_least():
    changes = {"force": np.array([3e-4, 0.06]), "power": np.array([np.nan, np.nan]), "speed": np.array([1e-9, np.nan])}
    axis = audit_chart(["gravity", "friction"], changes, np.array([1e-5, np.nan]), 0.01).axes[0]
    force, speed, accuracy = (line.get_xydata() for line in axis.lines)
    low = 1e-7 / 3.0
    np.testing.assert_allclose(force, [[0.03, 0.0], [6.0, 1.0]])
    np.testing.assert_allclose(speed, [[1e-7, 0.0], [np.nan, 1.0]])
    np.testing.assert_allclose(accuracy[:, 0], 1.0)
    assert axis.get_xlim()[0] == pytest.approx(low)
    assert not any(line.get_clip_on() for line in axis.lines[:2])  # the axis would cut a marker at its edge
    ranges = [segment[:, 0] for segment in axis.collections[0].get_segments()]
    np.testing.assert_allclose(ranges, [[low, 1e-3], [low, low]])


def test_an_audit_of_large_changes_begins_below_the_accuracy():
    axis = audit_chart(["gravity"], {"force": np.array([0.2])}, np.array([1e-7]), 0.03).axes[0]
    assert axis.get_xlim()[0] == pytest.approx(1.0)  # a third of 3 %
    assert axis.get_xlabel() == "size of the change, %"
    without = audit_chart(["gravity"], {"force": np.array([0.0])}, np.array([1e-7]), 0.03).axes[0]
    assert without.get_xlabel() == "size of the change, % (on the left edge: smaller)"


def test_differences_of_a_derivative_are_ringed_at_the_best_step():
    steps, difference = np.array([1e-6, 1e-4]), np.array([[1e-3, 0.0], [2e-3, 1e-5]])
    axis = steps_chart(
        steps, difference, np.array([1e-5, 1e-4]), np.array([0.0, 1e-7]), 1e-6, names=["m", "k"], route="reverse"
    ).axes[0]
    assert points_of(axis) == [[[1e-6, 1e-3], [1e-4, EPS]], [[1e-6, 2e-3], [1e-4, 1e-5]]]
    assert points_of(axis, "None") == [[[1e-5, EPS]], [[1e-4, 1e-7]]]
    assert points_of(axis, ":") == [[[0.0, 1e-6], [1.0, 1e-6]]]
    assert axis.get_ylabel() == "differences against reverse mode"


@pytest.mark.parametrize(("longest", "labels"), [(0.02, ["1 ms", "2 ms", "5 ms", "10 ms"]), (5.0, ["1 ms", "10 ms"])])
def test_times_over_many_decades_have_a_label_each_decade(longest, labels):
    points = np.array([[1e-3, 1e-3], [longest, 1e-9]])
    panel = CostPanel({"runs": points}, 1e-12, "amplitude", np.zeros((0, 2)))
    figure = cost_chart({"runs": panel}, ())
    axis = figure.axes[0]
    ticks = axis.xaxis.get_major_locator().tick_values(*axis.get_xlim())
    inside = [axis.xaxis.get_major_formatter()(x) for x in ticks if 0.9e-3 < x < 0.011]
    assert inside == labels
