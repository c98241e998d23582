"""Charts against the numbers that they show."""

import itertools

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxvib.draw.charts import before_after, branch_diagram, crossings, regime_chart
from jaxvib.draw.criterion import agreement_maps, criterion_chart
from jaxvib.draw.machine.parts import ground
from jaxvib.draw.motion.histories import amplitude_histories, time_histories
from jaxvib.draw.motion.response import response_chart
from jaxvib.draw.motion.spectra import path_chart
from jaxvib.draw.results import draw_circle, growth_chart, phase_circles, shapes_chart, speeds_chart
from jaxvib.draw.style import panels
from jaxvib.draw.sweeps import label_map
from jaxvib.draw.whirl import campbell_diagram


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
    right = [
        "loads balance (both agree)",
        "criterion predicts balance, wrongly",
        "balance not predicted",
        "loads gather (both agree)",
    ]
    assert shown == [legend[each] for each in right]


def _entries(legend):
    return zip(legend.get_texts(), legend.get_patches(), strict=False)


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


def test_the_smaller_of_two_bands_lies_in_front_of_the_larger():
    time = np.linspace(0.0, 50.0, 4000)
    motion = np.sin(20.0 * time)[:, None] * [1e-3, 3e-3]
    arrays = (time, motion, np.ones((time.size, 2)), 2.0 * np.ones((time.size, 1)), motion[:, :1])
    figure = time_histories(arrays, arrays, names=("y1", "y2"), directions=("up",))
    axis = figure.axes[0]
    areas, lines = ([each.get_zorder() for each in kind] for kind in (axis.collections, axis.lines))
    assert areas[0] > areas[1] > axis.xaxis.get_zorder()  # of the grid
    assert [line.get_label() for line in axis.lines[::2]] == ["y1", "y2"]
    assert max(areas) < min(lines[:2]) < min(lines[2:])  # dashes of y2 are visible on the solid line of y1
    assert axis.texts[0].get_text() == "the whole run"
    legends = [[text.get_text() for text in figure.axes[k].get_legend().get_texts()] for k in (0, 4)]
    assert legends == [["y1", "y2", "band: lowest to highest value"], ["up", "band: lowest to highest value"]]
    assert figure.axes[2].get_legend().get_texts()[-1].get_text() == "band: lowest to highest value"
    short = [values[:400] for values in arrays]
    axis = time_histories(short, short, names=("y1", "y2"), directions=("up",)).axes[0]
    assert not axis.collections and axis.texts[0].get_text() == "the whole run"
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["y1", "y2"]


def test_a_motion_that_decays_to_rounding_errors_is_zero():
    time = np.linspace(0.0, 50.0, 4000)
    motion = (1e-3 * np.sin(20.0 * time) * np.exp(-time))[:, None]
    speed = 30.0 + np.sin(200.0 * time)[:, None]
    arrays = (time, motion, np.ones((time.size, 0)), speed, np.ones((time.size, 1)) + 1e3 * motion)
    axes = time_histories(arrays, arrays, names=("y",), directions=("up",), unit="rad/s").axes
    assert [any("zero within rounding" in text.get_text() for text in axis.texts) for axis in axes] == [False, True] + 4 * [
        False
    ]
    (rotor,) = axes[2].lines  # the middle of the band
    assert np.ptp(rotor.get_ydata()[5:-5]) < 0.5 and len(axes[2].collections) == 1


def test_growth_has_the_exponent_over_its_second_half():
    time, rates = np.arange(1.0, 9.0), np.linspace(3.0, 1.0, 8)
    axis = growth_chart(time, rates, 1.5, 0.25).axes[0]
    each, exponent = axis.lines[:2]
    np.testing.assert_array_equal(each.get_xydata(), np.stack([time, rates], 1))
    np.testing.assert_array_equal(exponent.get_xydata(), [[5.0, 1.5], [8.0, 1.5]])
    box = axis.collections[0].get_paths()[0].get_extents()
    np.testing.assert_allclose([box.x0, box.y0, box.x1, box.y1], [5.0, 1.25, 8.0, 1.75])


def test_loads_that_move_equally_are_one_line():
    time = np.linspace(0.0, 50.0, 4000)
    motion = 1e-3 * np.sin(20.0 * time)[:, None]
    one = 10.0 + 0.1 * np.sin(20.0 * time)
    loads = np.stack([one, one * (1.0 + 1e-7), one + 0.5, one], axis=1)
    arrays = (time, motion, loads, 20.0 + 0.0 * motion, motion)
    figure = time_histories(arrays, arrays, names=("y1",), directions=("up",))
    names = [text.get_text() for text in figure.axes[2].get_legend().get_texts()]
    assert names == ["loads 1, 2 and 4", "load 3", "rotor", "band: lowest to highest value"]
    assert len(figure.axes[3].lines) == 2


def test_a_branch_diagram_has_linear_axes_on_request():
    axes = branches(linear=True).axes
    assert [axis.get_yscale() for axis in axes] == ["linear"] * 3
    assert axes[1].get_ylim() == pytest.approx((0.0, 1.08 * 25.0e3))


@pytest.mark.parametrize(("rotor", "lines"), [(100.005, 2), (100.02, 1)])
def test_the_rotor_is_drawn_beside_loads_at_its_speed(rotor, lines):
    t = np.linspace(0.0, 1.0, 401)
    wave = np.sin(80.0 * np.pi * t)[:, None]
    arrays = (t, wave, 100.0 + 1e-6 * wave, np.full_like(wave, rotor), wave)
    axis = time_histories(arrays, arrays, names=("y",), directions=("up",), unit="rad/s").axes[3]
    assert len(axis.lines) == lines
    assert [text.get_text() for text in axis.texts] == ["rotor speed (outside this panel): 100.02 rad/s"][: 2 - lines]


def test_labels_of_close_critical_speeds_are_below_their_curves():
    n = np.linspace(0.0, 300.0, 7)
    critical = np.array([150.0, 151.0]), np.array(["backward", "forward"])
    axis = campbell_diagram(n, np.full((7, 1), 150.0), np.full((7, 1), "forward"), critical=critical, unit="rad/s").axes[0]
    axis.figure.draw_without_rendering()
    box = axis.texts[0].get_window_extent().transformed(axis.transData.inverted())
    assert axis.texts[0].get_text() == "150 backward\n151 forward" and box.y1 < 0.8 * 150.0


def test_small_motions_at_the_end_have_their_own_unit():
    t = np.linspace(0.0, 1.0, 8001)
    wave = np.sin(80.0 * np.pi * t)[:, None]
    one = np.full_like(wave, 100.0)
    whole = (t, np.hstack([2e-3 * wave, 1e-2 * wave]), one, one, wave)
    end = (t, np.hstack([7e-8 * wave, 3e-9 * wave]), one, one, wave)
    axes = time_histories(whole, end, names=("y", "theta"), units=("m", "rad"), directions=("up",)).axes
    assert [axis.get_ylabel() for axis in axes[:4]] == ["displacement, mm", "displacement, µm", "tilt, deg", ""]
    assert np.max(axes[1].lines[0].get_ydata()) == pytest.approx(0.07, rel=1e-3)
    assert np.max(axes[3].lines[0].get_ydata()) == pytest.approx(np.rad2deg(3e-9), rel=1e-3)


def test_a_history_says_at_what_time_it_begins():
    time = np.linspace(0.0, 50.0, 4000)
    motion = 1e-3 * np.sin(20.0 * time)[:, None]
    for begin, words in ((0.0, "the whole run"), (120.0, "the last part of the run, from 120 s")):
        arrays = (begin + time, motion, motion, motion, motion)
        figure = time_histories(arrays, arrays, names=("y1",), directions=("up",))
        assert figure.axes[0].texts[0].get_text() == words


def test_exact_intervals_of_the_criterion_cover_no_text():
    figure = Figure(figsize=(7.0, 3.0))
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    criterion_chart(axis, np.linspace(1.0, 3.0, 5), np.linspace(-2.0, 2.0, 5), [[2.0, None]], exact=[[1.5, 3.0]])
    figure.canvas.draw()
    (bar,) = (patch for patch in axis.patches if patch.get_facecolor()[:3] == (0.0, 0.0, 0.0))
    assert all(not bar.get_window_extent().overlaps(text.get_window_extent()) for text in axis.texts)


def test_the_scale_of_the_criterion_has_no_kink():
    axis = Figure().subplots()
    criterion_chart(axis, np.linspace(1.0, 3.0, 5), np.linspace(-2.0, 2.0, 5), [[2.0, None]], at=2.0)
    step = 1e-6
    slopes = [(axis.transScale.transform((1.0, y + step)) - axis.transScale.transform((1.0, y)))[1] for y in (0.999, 1.001)]
    assert slopes[0] == pytest.approx(slopes[1], rel=0.01)  # at the median, where a symlog scale has a kink
    assert "working speed" in [text.get_text() for text in axis.get_legend().get_texts()]
    assert all(text.get_fontsize() < axis.xaxis.label.get_fontsize() for text in axis.texts) and len(axis.texts) == 2
    assert list(axis.lines[-1].get_xdata()) == pytest.approx([2.0 * 30.0 / np.pi] * 2)


@pytest.mark.parametrize("count", [2, 12])
def test_bars_of_few_drags_do_not_fill_the_axis(count):
    drag = np.geomspace(0.5, 5.0, count)
    axis, speeds = regime_chart(drag, {"jammed": np.ones(count)}, np.ones((count, 2)), 2.0).axes
    assert ([label.get_text() for label in speeds.get_xticklabels()] == ["0.5", "5"]) == (count == 2)
    widths = [np.log(bar.get_x() + bar.get_width()) - np.log(bar.get_x()) for bar in axis.patches]
    assert np.sum(widths) < np.log(10.0) and [bar.get_height() for bar in axis.patches] == [100.0] * count
    assert count > 2 or np.sum(widths) < 0.15 * np.log(10.0)


def test_a_regime_and_a_mode_have_their_colour_in_every_map():
    names = ["swinging", "unsettled", "jammed, mode 1", "jammed, mode 3"]
    maps = []
    for codes, own in ((np.array([[0, 2], [1, 3]]), names), (np.array([[2, 1], [0, 0]]), [names[3], names[2], names[1]])):
        axis = label_map(np.arange(2.0), np.arange(2.0), codes, own, x_label="x", y_label="y").axes[0]
        maps.append({t.get_text(): p.get_facecolor() for t, p in _entries(axis.get_legend())})
    same = maps[0].keys() & maps[1].keys()
    assert len(same) == 3 and all(maps[0][name] == maps[1][name] for name in same)


def test_a_line_of_folds_reaches_the_edges_of_its_map():
    x, y = np.linspace(0.0, 4.0, 5), np.linspace(0.0, 2.0, 3)
    lines = {"fold": [(np.array([1.0, 2.0, 3.0]), y)], "torus bifurcation": [(np.array([7.0, 7.0]), y[[0, -1]])]}
    axis = label_map(x, y, np.zeros((3, 5), int), ["a"], x_label="x", y_label="y", lines=lines).axes[0]
    np.testing.assert_allclose(axis.lines[0].get_xydata()[[0, -1]], [[0.8, -0.2], [3.2, 2.2]])
    assert [t.get_text() for t in axis.get_legend().get_texts()] == ["a", "fold of exact jams", "case"]


def test_a_dotted_line_of_a_map_remains_visible_on_a_solid_one():
    x, y, line = np.linspace(0.0, 4.0, 5), np.linspace(0.0, 2.0, 3), [(np.array([1.0, 1.0]), np.array([0.0, 2.0]))]
    lines = {"fold": line, "loss of symmetry": line}
    axis = label_map(x, y, np.zeros((3, 5), int), ["a"], x_label="x", y_label="y", lines=lines).axes[0]
    fold, symmetry, _ = axis.lines
    assert symmetry.get_linewidth() > 2.0 * fold.get_linewidth()


def test_run_up_shows_the_resonances_that_it_passes():
    time = np.linspace(0.0, 1.0, 50)
    speeds = 100.0 * np.stack([time, -time], 1)
    one, no_loads = np.ones((50, 1)), np.zeros((50, 0))
    about = {"names": ["x"], "units": ["m"], "unit": "rad/s"}
    figure = amplitude_histories(time, one, no_loads, one, speeds, resonances=[20.0, 30.0, 500.0], **about)
    dotted = [line for line in figure.axes[1].lines if line.get_linestyle() == ":"]
    assert sorted(float(line.get_ydata()[0]) for line in dotted) == [-30.0, -20.0, 20.0, 30.0]


def test_axes_of_averaged_amplitudes_and_forces_say_zero_to_peak():
    time = np.linspace(0.0, 1.0, 50)
    one, two, no_loads = np.ones((50, 1)), np.ones((50, 2)), np.zeros((50, 0))
    figure = amplitude_histories(time, two, no_loads, one, one, names=["x", "psi"], units=["m", "rad"], unit="rad/s")
    labels = [axis.get_ylabel().split("\n") for axis in figure.axes]
    assert [label[1:] for label in labels] == [["zero to peak"], ["zero to peak"], [], ["zero to peak"]]
    assert labels[-1][0] == "foundation force, N" and not any(axis.texts for axis in figure.axes)


def test_the_band_of_an_averaged_run_names_short_intervals():
    time = np.linspace(0.0, 1.0, 4000)
    amplitude, one = 1.0 + 0.2 * np.sin(400.0 * time)[:, None], np.ones((4000, 1))
    figure = amplitude_histories(time, amplitude, one[:, :0], one, one, names=["x"], units=["m"], unit="rad/s")
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert names == ["x", "band: lowest to highest value within short intervals"]


def test_a_legend_ends_before_the_header_of_the_values():
    figure = before_after([("foundation force divided by the amplitude of a point at (0, 0.1) m, N/mm", 2.0, 1.0)])
    FigureCanvasAgg(figure).draw()
    axis = figure.axes[0]
    header = next(text for text in axis.texts if text.get_text() == "before → after")
    assert axis.get_legend().get_window_extent().x1 <= header.get_window_extent().x0


def test_points_on_a_circle_are_numbered_from_1():
    texts = [text.get_text() for text in phase_circles([("", np.array([0.5, 2.0]))]).axes[0].texts]
    assert {"1", "2"} <= set(texts) and "0" not in texts


@pytest.mark.parametrize("named", [{}, {"plural": "masses"}])
def test_many_points_at_one_angle_share_a_label(named):
    axis = Figure().subplots()
    draw_circle(axis, "", np.zeros(6), **named)
    texts = [text.get_text() for text in axis.texts]
    assert f"6 {named.get('plural', 'loads')}" in texts


def test_a_branch_crosses_a_speed_between_its_points():
    rotor_speed = np.array([0.0, np.nan, 1.0, 2.0, 4.0, 2.0, 2.0])
    stable, modes = np.arange(7) < 4, np.array([0, 0, 1, 1, 1, 2, 2])
    found = crossings(rotor_speed, stable, modes, 2.5)
    assert found == [(3, pytest.approx(0.25), "1", True), (4, pytest.approx(0.75), "1", False)]


def test_the_ground_has_a_stroke_for_each_step():
    outline = ground((1.0, 0.0), (3.0, 0.0), step=0.25)
    strokes = np.split(outline, np.flatnonzero(np.isnan(outline[:, 0])))[1:]
    np.testing.assert_allclose([stroke[1] for stroke in strokes], [(1.125 + 0.25 * k, 0.0) for k in range(8)])
    np.testing.assert_allclose([stroke[2] - stroke[1] for stroke in strokes], 8 * [(-0.15, -0.15)])


def test_a_response_ends_at_half_the_least_and_twice_the_most():
    force = np.array([2.0, 30.0, 100.0])
    curve = {"speed": np.arange(3.0), "amplitude": 1e-3 * np.array([[1e-7], [2.0], [1.0]]), "foundation_force": force}
    points = {**{name: each[:0] for name, each in curve.items()}, "stable": np.zeros(0, bool)}
    about = {"names": ["y"], "units": ["m"], "motors": 0, "motor": {}, "show": ["amplitude", "force"]}
    axes = response_chart(curve, points, {}, np.zeros(0), **about).axes
    assert axes[1].get_ylim() == pytest.approx((1.0, 200.0))
    assert axes[0].get_ylim() == pytest.approx((4e-4, 4.0))  # mm, four decades


def test_the_resultant_of_phases_is_weighted():
    _, axes = panels(1, 2)
    for axis, w in zip(axes, (None, np.array([0.75, 0.25])), strict=True):
        draw_circle(axis, "", np.array([0.0, np.pi]), weights=w)
    assert [axis.get_title() for axis in axes] == ["\nresultant 0", "\nresultant 0.5"]


def test_equal_arrows_have_equal_lengths_in_the_title():
    (axis,) = panels(1)[1]
    angle = np.arccos(-0.0625)
    draw_circle(axis, "", np.array([angle, -angle]), imbalance=0.0625)  # the mean is -0.06250000000000003
    assert axis.get_title() == "\nloads 0.062, rotor 0.062 (orange), sum 0"


def test_labels_of_speeds_that_would_overlap_are_left_out():
    axis = speeds_chart([("a", np.array([20.0, 10.1, 10.0, 12.0])), ("b", np.array([10.2]))], unit="rad/s").axes[0]
    assert [text.get_text() for text in axis.texts] == ["10", "12", "20", "10.2"]


def test_bars_of_changes_lie_inside_their_axis():
    (axis, *_) = before_after([("force, N", 100.0, 2.0), ("power, W", 1.0, 30.0)]).axes
    low, high = axis.get_xlim()
    assert low < 0.02 and high > 30.0
    assert axis.get_xlabel().endswith("zero to peak")
    with_stroke = before_after([("stroke (at = 2), mm", 2.0, 3.0)]).axes[0]
    assert with_stroke.get_xlabel().endswith("zero to peak, strokes peak to peak")
