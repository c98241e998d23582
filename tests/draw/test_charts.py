"""Charts against the numbers that they show."""

import itertools

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxvib.draw.charts import branch_diagram
from jaxvib.draw.comparison import audit_chart
from jaxvib.draw.criterion import agreement_maps
from jaxvib.draw.motion.histories import time_histories
from jaxvib.draw.motion.spectra import path_chart
from jaxvib.draw.results import growth_chart, phase_circles, shapes_chart


def branches(**options):
    omega = np.linspace(1.0, 5.0, 21)
    arrays = dict(amplitude=np.stack([omega, omega**2], 1), force=omega**3, resonances=np.array([3.0]), names=("y1", "y2"))
    return branch_diagram(2.0 * omega, omega, omega > 2.0, **arrays, **options)


def test_curves_in_one_panel_differ_by_marker_and_colour():
    axis = branches().axes[1]
    curves = {line.get_label(): line for line in axis.lines if line.get_label() in ("y1", "y2")}
    looks = [(line.get_marker(), line.get_color()) for line in (curves["y1"], curves["y2"])]
    assert len({marker for marker, _ in looks} - {"", "None", None}) == len({color for _, color in looks}) == 2


def test_a_legend_of_given_axes_stands_above_the_first():
    axes = Figure().subplots(1, 3)
    branches(ax=axes)
    assert [axis.get_legend() is not None for axis in axes] == [True, False, False]


def test_colours_of_agreement_belong_to_their_legend():
    predicted, exact = np.array([[True, True], [False, False]]), np.array([[True, False], [True, False]])
    figure = agreement_maps(np.array([1.0, 2.0]), np.array([0.1, 1.0]), predicted, [("", exact)])
    mesh = figure.axes[0].collections[0]
    shown = [matplotlib.colors.to_hex(color) for color in mesh.to_rgba(mesh.get_array()).reshape(-1, 4)]
    legend = {text.get_text(): matplotlib.colors.to_hex(patch.get_facecolor()) for text, patch in _entries(figure.legends[0])}
    right = ["loads balance (both agree)", "criterion predicts balance, wrongly", "balance missed", "loads gather (both agree)"]
    assert shown == [legend[each] for each in right]


def _entries(legend):
    return zip(legend.get_texts(), legend.get_patches(), strict=True)


def test_a_path_is_drawn_in_millimetres_with_its_end():
    t = np.linspace(0.0, 2.0, 30)
    across, up = 1e-3 * np.cos(t), 2e-3 * np.sin(t)
    axis = path_chart({"centre": (across, up)}).axes[0]
    path, end = axis.lines[:2]
    np.testing.assert_allclose(path.get_xydata(), 1e3 * np.stack([across, up], 1), rtol=1e-14)
    np.testing.assert_allclose(end.get_xydata(), [[1e3 * across[-1], 1e3 * up[-1]]], rtol=1e-14)


@pytest.mark.parametrize(("count", "rows"), [(1, [1]), (3, [3]), (5, [4, 1])])
def test_circles_of_phases_stand_four_in_a_row(count, rows):
    figure = phase_circles([(f"{k}", np.array([0.0, 1.0])) for k in range(count)])
    titled = [axis for axis in figure.axes if axis.get_title()]
    heights = [axis.get_position().y0 for axis in titled]
    assert [sum(np.isclose(heights, height)) for height in sorted(set(np.round(heights, 6)), reverse=True)] == rows
    assert titled[0].get_title() == f"0\nresultant {np.cos(0.5):.3g}"
    ticks = [np.mean(line.get_xydata(), axis=0) for line in titled[0].lines if len(line.get_xdata()) == 2]
    turns = np.radians(np.arange(0.0, 360.0, 45.0))
    np.testing.assert_allclose(ticks, np.stack([np.cos(turns), np.sin(turns)], axis=1), atol=1e-12)


def test_bars_of_a_mode_shape_stand_side_by_side():
    axis = shapes_chart(np.array([10.0, 20.0]), np.ones((2, 4)), names=("y1", "y2", "y3", "y4")).axes[0]
    bars = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in axis.patches)
    assert len(bars) == 8 and all(right < left for (_, right), (left, _) in itertools.pairwise(bars))
    middles = np.reshape(bars, (2, 8)).mean(axis=1)
    np.testing.assert_allclose(middles, axis.get_xticks(), atol=1e-12)  # around the number of their mode


def test_an_audits_picture_grows_by_a_line_for_each_effect():
    heights = []
    for count in (5, 15):
        labels, each = [f"{k}" for k in range(count)], np.full(count, 1e-3)
        figure = audit_chart(labels, {"amplitude": each}, each, 0.01, each)
        heights.append(figure.get_size_inches()[1])
    assert heights[1] - heights[0] == pytest.approx(3.4)  # inches


def test_the_smaller_of_two_bands_lies_in_front_of_the_larger():
    time = np.linspace(0.0, 50.0, 4000)
    motion = np.sin(20.0 * time)[:, None] * [1e-3, 3e-3]
    arrays = (time, motion, np.ones((time.size, 2)), 2.0 * np.ones((time.size, 1)), motion[:, :1])
    axis = time_histories(arrays, arrays, names=("y1", "y2"), directions=("up",)).axes[0]
    depths = {line.get_label(): line.get_zorder() for line in axis.lines}
    assert depths["y1"] > depths["y2"] > axis.xaxis.get_zorder()  # of the grid


def test_growth_has_the_exponent_over_its_second_half():
    time, rates = np.arange(1.0, 9.0), np.linspace(3.0, 1.0, 8)
    axis = growth_chart(time, rates, 1.5, 0.25).axes[0]
    each, exponent = axis.lines[:2]
    np.testing.assert_array_equal(each.get_xydata(), np.stack([time, rates], 1))
    np.testing.assert_array_equal(exponent.get_xydata(), [[5.0, 1.5], [8.0, 1.5]])
    box = axis.collections[0].get_paths()[0].get_extents()
    np.testing.assert_allclose([box.x0, box.y0, box.x1, box.y1], [5.0, 1.25, 8.0, 1.75])
