"""Colours that every reader tells apart, legends that cover no data, axes that are given."""

import itertools

import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxvib as jv
from jaxvib.draw.charts import before_after, branch_diagram, solid_and_dashed
from jaxvib.draw.comparison import audit_chart
from jaxvib.draw.motion.histories import band, time_histories
from jaxvib.draw.results import shapes_chart, speeds_chart
from jaxvib.draw.style import COLORS, legend_above, load_names, numbered, panels
from jaxvib.draw.sweeps import tornado_chart

# Machado, Oliveira, Fernandes 2009: what readers without one kind of cones see, of linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]),
}


def lab(color, vision):
    """CIELAB of a colour as seen with that vision."""
    levels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = vision @ np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ np.clip(linear, 0, 1)
    f = xyz / [0.9505, 1.0, 1.089]
    f = np.where(f > 0.008856, np.cbrt(f), 7.787 * f + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", VISION)
def test_the_first_six_colours_differ_for_every_reader(vision):
    seen = [lab(color, VISION[vision]) for color in COLORS[:6]]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 15.0


def test_the_first_four_colours_differ_in_grey():
    grey = sorted(lab(color, np.eye(3))[0] for color in COLORS[:4])
    assert min(np.diff(grey)) > 6.0


def test_a_legend_stands_above_its_panel():
    figure, (axis,) = panels(1)
    axis.plot([0.0, 1.0], [0.0, 1.0], label="line")
    legend_above(axis)
    figure.canvas.draw()
    assert axis.get_legend().get_window_extent().y0 >= axis.get_window_extent().y1 - 1.0


def test_labels_that_nearly_touch_are_merged():
    axis = Figure().subplots()
    axis.set_ylim(0.0, 1.0)
    numbered(axis, 0.5, [0.5, 0.51, 0.9, 7.0, np.nan], ["3", "4", "5", "6", "7"], [True, False, True, True, True])
    assert [text.get_text() for text in axis.texts] == ["3, 4", "5"]
    assert [line.get_markerfacecolor() for line in axis.lines] == ["black", "white", "black"]


def test_numbers_of_points_cross_no_curve_and_no_other_number():
    figure, (axis,) = panels(1)
    x, levels = np.linspace(0.0, 1.0, 11), [0.3, 0.46, 0.62]
    for y in levels:
        axis.plot(x, np.full(11, y))
    axis.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    numbered(axis, 0.5, levels, ["1", "2", "3"], [True, True, False])
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axis.texts]
    curves = [line.get_transform().transform_path(line.get_path()) for line in axis.lines[:3]]
    assert len(boxes) == 3 and not any(curve.intersects_bbox(box, filled=False) for curve in curves for box in boxes)
    assert not any(box.overlaps(other) for box, other in itertools.combinations(boxes, 2))


def diagram(**options):
    omega = np.linspace(1.0, 5.0, 81)
    speed = omega + 4.0 / (1.0 + 9.0 * (omega - 3.0) ** 2)
    arrays = dict(force=omega**3, resonances=np.array([3.0]))
    marks = [("fold: the jam ends", np.array([7.0]), np.array([3.0]))]
    modes = np.where(omega < 3.0, 1, np.where(omega < 3.6, 2, 3))
    own = dict(
        amplitude=np.stack([omega, omega**2], 1),
        modes=modes,
        marks=marks,
        names=("y1", "y2"),
        at=5.0,
        stability_text="by slope",
    )
    return branch_diagram(speed, omega, modes != 2, **arrays, **{**own, **options}), speed, omega


def test_branch_diagram_labels_lines_and_modes():
    figure, speed, omega = diagram(unit="rpm")
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"stable", "unstable", "resonance", "rotor speed", "working speed; numbers: jam modes", "y1", "y2"} < set(told)
    assert "fold: the jam ends" in told and figure.get_supxlabel() == "stable by slope"
    assert [(axis.get_title(loc="left"), axis.get_ylabel()) for axis in figure.axes] == [
        ("load speed", "rpm"),
        ("amplitude, zero to peak", "mm"),
        ("foundation force, zero to peak", "N"),
    ]
    numbers = sorted(",".join(text.get_text() for text in figure.axes[0].texts).replace(" ", "").split(","))
    assert numbers == ["1", "2", "3"]
    drawn = figure.axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(drawn, np.stack([speed, omega], 1)[: len(drawn)] * 30.0 / np.pi)


def test_three_coordinates_have_one_panel_each():
    figure, _, omega = diagram(amplitude=np.ones((81, 4)), names=("y1", "y2", "y3", "y4"))
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles[1:5] == [f"amplitude of y{k}, zero to peak" for k in (1, 2, 3, 4)]
    axis = Figure().subplots()
    figure, _, omega = diagram(show=("force",), ax=axis)
    assert figure is axis and axis.get_ylabel() == "foundation force, zero to peak, N"
    assert np.isin(axis.lines[0].get_ydata(), omega**3).all()
    with pytest.raises(jv.InputError, match=r"show is \('power',\); it names some of: speed, amplitude, force"):
        diagram(show=("power",))


def test_empty_pieces_of_a_branch_are_left_out():
    axis = panels(1)[1][0]
    there = np.where(np.arange(20) < 10, 1.0, np.nan)
    solid_and_dashed(axis, there, there, np.arange(20) < 12, "black", "loads", marker="o")
    axis.figure.canvas.draw()
    assert [line.get_label() for line in axis.lines] == ["loads"]


def test_a_logarithmic_axis_reaches_down_to_what_matters():
    speed = np.linspace(0.1, 20.0, 400)
    omega = 0.5 * speed
    force = omega**4 / ((1.0 - (omega / 4.0) ** 2) ** 2 + 1e-2)
    own = dict(amplitude=force[:, None], force=force, resonances=np.array([4.0]), names=("y1",))
    low, high = branch_diagram(speed, omega, omega > 0.0, **own).axes[2].get_ylim()
    assert low == pytest.approx(0.5 * np.min(force[omega > 2.0])) and high > np.max(force) and np.min(force) < 1e-5 * low


def test_band_contains_the_signal():
    t = np.linspace(0.0, 10.0, 10_001)
    y = np.sin(2.0 * np.pi * 10.0 * t) * t
    middle, low, high = band(t, y, 50)
    assert middle.size == 50 and np.all(high >= np.interp(middle, t, y)) and np.all(low <= np.interp(middle, t, y))
    np.testing.assert_allclose(high[-1], 10.0, rtol=0.01)
    arrays = (t, np.stack([y, -y], 1), np.ones((t.size, 2)), 2.0 * np.ones((t.size, 1)), y[:, None])
    figure = time_histories(arrays, arrays, names=("y1", "y2"), directions=("up",))
    left, right = figure.axes[:2]
    names = [text.get_text() for text in left.get_legend().get_texts()]
    assert len(left.collections) == 2 and names == ["y1", "y2", "band: lowest to highest value"]
    x, shown = right.lines[0].get_data()
    np.testing.assert_allclose(shown, 1e3 * y[-x.size :])
    np.testing.assert_allclose(x[-1] - x[0], 0.3, rtol=0.02)  # three periods, in which antiphase is seen
    np.testing.assert_allclose(right.lines[1].get_ydata(), -shown)


@pytest.mark.parametrize("amplitude", [0.0, 0.5])
def test_the_band_of_a_ramp_is_its_oscillation(amplitude):
    """The end of a ramp has no influence beyond the five intervals beside it."""
    t = np.linspace(0.0, 20.0, 20_001)
    for rate in (10.0, 7.3, 31.0):  # periods per s, in intervals of 0.2 s
        middle, low, high = band(t, 30.0 * np.minimum(t, 10.0) + amplitude * np.sin(2.0 * np.pi * rate * t), 100)
        straight = np.abs(middle - 10.0) > 1.0
        trend = 30.0 * np.minimum(middle, 10.0)
        np.testing.assert_allclose((high - trend)[straight], amplitude, rtol=0.06, atol=1e-9)
        np.testing.assert_allclose((low - trend)[straight], -amplitude, rtol=0.06, atol=1e-9)
        assert np.max(np.abs(high - trend)) < amplitude + 2.0 and np.max(high) <= 300.0 + amplitude + 1e-9


def test_the_band_of_a_jump_stays_within_the_signal():
    t = np.linspace(0.0, 20.0, 20_001)
    _, low, high = band(t, np.where(t < 10.0, 0.0, np.exp(10.0 - t)), 100)
    assert np.min(low) >= 0.0 and np.max(high) <= 1.0 and np.all(high >= low)


def test_before_and_after_shows_what_falls_a_thousandfold():
    figure = before_after([("force, N", 1424.0, 2.1), ("speed, rpm", 570.0, 570.0), ("more", 1.0, 3.0)])
    axis = figure.axes[0]
    bars = [bar for bar in axis.patches if bar.get_width() and bar.get_height()]
    np.testing.assert_allclose([bar.get_x() + bar.get_width() for bar in bars], [2.1 / 1424.0, 3.0])
    level = [line.get_color() for line in axis.lines if list(line.get_xdata()) == [1.0, 1.0]]
    assert level == ["black"]  # what has not changed
    assert axis.get_xscale() == "log" and "1424 → 2.1   (0.00147 x)" in [text.get_text() for text in axis.texts]


def test_the_figure_of_jam_modes_names_the_coordinates():
    scene = jv.Scene(
        jv.two_mass(mass=[50.0, 80.0], stiffness=[4e4, 6e4], damping=[100.0, 100.0], link_stiffness=2e4, link_damping=20.0),
        jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25),
        jv.ConstantSpeed("60 rad/s"),
    )
    modes = jv.jam_modes(scene)
    for found in (modes, modes.select(modes.mode_numbers()[0])):
        legend = found.plot().axes[1].get_legend()
        assert [text.get_text() for text in legend.get_texts()] == ["y1", "y2"]


@pytest.mark.parametrize(
    ("axis", "draw", "inches"),
    [
        (1, lambda n: audit_chart(n * ["a"], {"amplitude": np.full(n, 1e-3)}, np.full(n, 1e-3), 0.01), 0.34),
        (1, lambda n: before_after(n * [("a", 1.0, 2.0)]), 0.42),
        (1, lambda n: tornado_chart(n * ["a"], np.zeros(n), np.ones(n), 0.5, x_label="x"), 0.45),
        (1, lambda n: speeds_chart(n * [("a", np.ones(1))]), 0.55),
        (0, lambda n: shapes_chart(np.ones(n), np.ones((n, 1)), names=["y"]), 1.4),
    ],
    ids=["audit", "before and after", "tornado", "speeds", "shapes"],
)
def test_a_figure_grows_by_a_line_for_each_entry(axis, draw, inches):
    sizes = [draw(count).get_size_inches()[axis] for count in (5, 15)]
    assert sizes[1] - sizes[0] == pytest.approx(10.0 * inches)


def test_axes_that_are_none_are_refused():
    with pytest.raises(jv.InputError, match=r"ax is \[1.0\]; give matplotlib's Axes"):
        panels(1, ax=[1.0])
    with pytest.raises(jv.InputError, match=r"ax is range\(0, 1000000000\); give matplotlib's Axes"):
        panels(1, ax=range(10**9))


def test_diagram_of_no_rotor_speed_is_refused():
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed(60),
    )
    with pytest.raises(jv.InputError, match=r"most is -1 rad/s; the branches begin at"):
        jv.branches(scene, points=50).plot(most=-1.0)


def test_loads_are_numbered_from_two_and_up_to_eight():
    assert load_names(1) == ["load"] and load_names(2) == ["load 1", "load 2"]
    assert load_names(8)[-1] == "load 8" and load_names(9) == ["9 loads", *[None] * 8]
