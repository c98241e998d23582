"""Charts of many cases, against the numbers that they show."""

import matplotlib.colors
import numpy as np
import pytest

from jaxvib.draw.charts import convergence, front_chart
from jaxvib.draw.style import COLORS, HATCHED
from jaxvib.draw.sweeps import distribution_chart, label_map, points_over, shares_chart, tornado_chart, value_map


def shown_colors(mesh):
    return [matplotlib.colors.to_hex(color) for color in mesh.to_rgba(mesh.get_array()).reshape(-1, 4)]


def test_cells_without_a_result_are_hatched():
    axis = label_map(
        np.arange(2.0), np.arange(3.0), np.array([[0, -1], [0, 0], [0, -1]]), ["a"], x_label="x", y_label="y"
    ).axes[0]
    legend = axis.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["a", "no result", "case"]
    plain = matplotlib.colors.to_hex(legend.get_patches()[0].get_facecolor())
    grey = HATCHED["no result"]["facecolor"]
    assert shown_colors(axis.collections[0]) == [plain, grey, plain, plain, plain, grey]
    mixed = 0.55 * np.asarray(matplotlib.colors.to_rgb(COLORS[0])) + 0.45
    np.testing.assert_allclose(legend.get_patches()[0].get_facecolor()[:3], mixed)
    (hatched,) = (patch for patch in axis.patches if patch.get_hatch())
    corners = hatched.get_path().vertices.reshape(2, 5, 2)
    np.testing.assert_allclose(corners[:, 0], [[0.5, -0.2], [0.5, 1.5]])
    np.testing.assert_allclose(corners[:, 2], [[1.1, 0.5], [1.1, 2.2]])


def test_cells_without_a_value_are_hatched_and_named():
    values = np.array([[1.0, np.nan], [3.0, 4.0]])
    axis = value_map(np.arange(2.0), np.arange(2.0), values, x_label="x", y_label="y", label="z").axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["no result", "case"]
    (hatched,) = (patch for patch in axis.patches if patch.get_hatch())
    np.testing.assert_allclose(hatched.get_path().vertices[[0, 2]], [[0.5, -0.1], [1.1, 0.5]])


def test_uneven_values_of_many_cases_are_marked():
    even, uneven = np.linspace(1.0, 2.0, 30), np.array([*np.linspace(1.0, 2.0, 29), 9.0])
    labels = dict(x_label="x", y_label="y")
    for x, y, marked in ((uneven, even, uneven), (even, uneven, uneven), (even, even, None)):
        for axis in (
            label_map(x, y, np.zeros((30, 30), int), ["a"], **labels).axes[0],
            value_map(x, y, np.zeros((30, 30)), label="z", **labels).axes[0],
        ):
            assert len(axis.lines) == (marked is not None)
            for line in axis.lines:
                assert line.get_label() == "values of the cases"
                np.testing.assert_array_equal(line.get_xdata() if x is uneven else line.get_ydata(), marked)


@pytest.mark.parametrize("log", [(True, False), (True, True)])
def test_lines_reach_the_edges_on_the_drawn_scale(log):
    x, y = np.array([1.0, 10.0, 100.0]), np.array([1.0, 2.0, 20.0])
    line = np.array([90.0, 50.0, 2.0]), y
    drawn = label_map(x, y, np.zeros((3, 3), int), ["a"], x_label="x", y_label="y", log=log, lines={"fold": [line]}).axes[0]
    xs, ys = drawn.lines[0].get_data()
    assert np.all(xs > 0.0) and ys[-1] == pytest.approx(drawn.get_ylim()[1]) and len(xs) == 5
    rise = np.diff(np.log(ys) if log[1] else ys)
    assert np.diff(np.log(xs))[-1] / rise[-1] == pytest.approx(np.diff(np.log(xs))[-2] / rise[-2])


def test_a_map_of_values_has_logarithmic_axes_on_request():
    x, y, values = np.array([1.0, 10.0]), np.array([1.0, 100.0]), np.array([[1.0, 2.0], [3.0, np.nan]])
    for log in ((False, False), (True, False), (False, True)):
        axis = value_map(x, y, values, x_label="x", y_label="y", label="z", log=log).axes[0]
        assert (axis.get_xscale() == "log", axis.get_yscale() == "log") == log
        np.testing.assert_array_equal(axis.collections[0].get_array().filled(np.nan), values)


@pytest.mark.parametrize("log", [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("count", [1, 3])
def test_cells_of_a_map_lie_around_their_points_on_its_scale(log, count):
    """Three points a factor of 10 apart: midway between the first two, a linear scale would have edges below 0."""
    x, y, kinds = 10.0 ** np.arange(count), 10.0 ** np.arange(3.0), np.zeros((3, count), int)
    labels = dict(x_label="x", y_label="y", log=log)
    for axis in (label_map(x, y, kinds, ["a"], **labels).axes[0], value_map(x, y, 1.0 * kinds, label="z", **labels).axes[0]):
        axis.figure.canvas.draw()  # sets the limits
        points = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
        corners, centres = (
            axis.transLimits.transform(axis.transScale.transform(each.reshape(-1, 2))).reshape(each.shape)
            for each in (axis.collections[0].get_coordinates(), points)
        )
        np.testing.assert_allclose(corners[[0, -1], [0, -1]], [[0.0, 0.0], [1.0, 1.0]], atol=1e-9)
        assert np.all((corners[:-1, :-1] < centres) & (centres < corners[1:, 1:]))
        for k, is_log in enumerate(log):
            if is_log:
                np.testing.assert_allclose(
                    corners[1:-1, 1:-1][..., k], (centres[:-1, :-1] + centres[1:, 1:])[..., k] / 2.0, atol=1e-9
                )


def test_points_over_a_parameter_are_drawn():
    x, values = np.array([1.0, 10.0]), np.array([[1.0, 2.0], [3.0, 4.0]])
    axis = points_over(x, values, x_label="x", y_label="y", log=True).axes[0]
    assert [line.get_xydata().tolist() for line in axis.lines] == [[[1.0, 1.0], [10.0, 3.0]], [[1.0, 2.0], [10.0, 4.0]]]
    assert axis.get_xscale() == "log" and axis.get_yscale() == "linear"


@pytest.mark.parametrize("log", [False, True])
def test_intervals_of_few_shares_are_bars_side_by_side(log):
    x, share = np.array([1.0, 100.0]), np.array([0.1, 0.5])
    shares = {"a": (share, share - 0.05, share + 0.1), "b": (share + 0.2, share, share + 0.3)}
    axis = shares_chart(x, shares, x_label="x", log=log).axes[0]
    shift = 0.003 * np.array([-1.0, 1.0])
    places = [x * 100.0**each if log else x + 99.0 * each for each in shift]
    lines = [line.get_xydata() for line in axis.lines if line.get_label() in shares]
    np.testing.assert_allclose(lines[0], np.stack([places[0], [10.0, 50.0]], axis=1))
    np.testing.assert_allclose(lines[1], np.stack([places[1], [30.0, 70.0]], axis=1))
    bars = [container.lines[2][0].get_segments() for container in axis.containers]
    np.testing.assert_allclose(np.asarray(bars)[:, :, :, 1], [[[5.0, 20.0], [45.0, 60.0]], [[10.0, 40.0], [50.0, 80.0]]])
    assert axis.get_xscale() == ("log" if log else "linear")


def test_intervals_of_many_shares_are_bands():
    x = np.linspace(0.0, 1.0, 41)
    axis = shares_chart(x, {"a": (0.5 * x, 0.25 * x, x)}, x_label="x").axes[0]
    np.testing.assert_allclose(axis.lines[0].get_xydata(), np.stack([x, 50.0 * x], axis=1))
    corners = {tuple(corner) for corner in axis.collections[0].get_paths()[0].vertices.tolist()}
    assert {(1.0, 25.0), (1.0, 100.0), (0.0, 0.0)} <= corners and not axis.containers


def test_a_distribution_adds_up_to_all_cases():
    counts, share = distribution_chart(np.array([0.0, 1.0, 3.0]), {"": np.array([1.0, 3.0])}, x_label="force, N").axes
    assert [(bar.get_x(), bar.get_width(), bar.get_height()) for bar in counts.patches] == [(0.0, 1.0, 1.0), (1.0, 2.0, 3.0)]
    assert counts.get_legend() is None
    assert share.lines[0].get_xydata().tolist() == [[0.0, 0.0], [1.0, 25.0], [3.0, 100.0]]
    none = distribution_chart(np.array([0.0, 1.0]), {"": np.zeros(1)}, x_label="force, N").axes[1]
    assert none.lines[0].get_ydata().tolist() == [0.0, 0.0]


def test_a_distribution_stacks_its_regimes():
    counts = {"jammed": np.array([1.0, 3.0]), "unsettled": np.array([2.0, 2.0])}
    axis, share = distribution_chart(np.array([0.0, 1.0, 3.0]), counts, x_label="force, N").axes
    assert [(bar.get_y(), bar.get_height()) for bar in axis.patches] == [(0.0, 1.0), (0.0, 3.0), (1.0, 2.0), (3.0, 2.0)]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["jammed: 4 cases", "unsettled: 4 cases"]
    assert axis.patches[2].get_hatch() and share.lines[0].get_ydata().tolist() == [0.0, 37.5, 100.0]


def test_the_largest_difference_of_a_tornado_is_at_the_top():
    low, high = np.array([1.0, 5.0, np.nan]), np.array([3.0, -4.0, 1.0])
    axis = tornado_chart(["a", "b", "c"], low, high, 2.0, x_label="force, N").axes[0]
    assert [text.get_text() for text in axis.get_yticklabels()] == ["c", "a", "b"]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width(), bar.get_y() + 0.5 * bar.get_height()) for bar in axis.patches]
    at = [(min(ends), max(ends), pytest.approx(y)) for *ends, y in bars]
    assert at[2:] == [(1.0, 2.0, 1.0), (2.0, 3.0, 1.0), (2.0, 5.0, 2.0), (-4.0, 2.0, 2.0)]
    colors = [matplotlib.colors.to_hex(bar.get_facecolor()) for bar in axis.patches[2:4]]
    legend = [matplotlib.colors.to_hex(patch.get_facecolor()) for patch in axis.get_legend().get_patches()]
    assert colors == legend and axis.lines[0].get_xdata()[0] == 2.0


def test_a_front_is_a_line_of_numbered_machines():
    axis = front_chart(np.array([2.0, 1.0, 1.0]), np.array([1.0, 4.0, 3.0]), x_label="x", y_label="y").axes[0]
    assert axis.lines[0].get_xydata().tolist() == [[1.0, 3.0], [1.0, 4.0], [2.0, 1.0]]
    assert [(text.get_text(), text.xy) for text in axis.texts] == [("0", (2.0, 1.0)), ("1", (1.0, 4.0)), ("2", (1.0, 3.0))]


@pytest.mark.parametrize(("least", "scale"), [(1.0, "log"), (0.0, "linear"), (-1.0, "linear")])
def test_convergence_has_the_best_start_in_bold(least, scale):
    history = np.array([[5.0, 4.0], [3.0, least], [np.nan, least]])
    is_met = np.array([[True, False], [True, True], [True, True]])
    axis = convergence(history, is_met, best=1, label="force, N").axes[0]
    lines = {line.get_label(): line for line in axis.lines}
    np.testing.assert_array_equal(lines["best start"].get_ydata(), [np.nan, least, least])
    dashed = lines["best start while it violates demands"]
    assert dashed.get_ydata().tolist() == [4.0, least, least] and dashed.get_linestyle() == "--"
    assert axis.get_yscale() == scale
    always = convergence(history, np.ones((3, 2), bool), best=1, label="force, N").axes[0]
    assert [line.get_label() for line in always.lines].count("best start while it violates demands") == 0
