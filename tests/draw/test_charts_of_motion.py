"""Charts of spectra, responses, synchronous regimes and whirls, against the numbers that they show."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.draw.capture import torus_paths
from jaxvib.draw.motion.histories import time_histories
from jaxvib.draw.motion.regimes import DrawnRegime, TorqueCurves, regimes_chart
from jaxvib.draw.motion.response import response_chart
from jaxvib.draw.motion.spectra import path_chart, spectrum_chart, waterfall_chart
from jaxvib.draw.results import drag_diagram, signals_chart
from jaxvib.draw.style import GUIDE
from jaxvib.draw.sweeps import shares_chart
from jaxvib.draw.whirl import campbell_diagram, critical_groups


def named(axis):
    return {line.get_label(): line.get_xydata().tolist() for line in axis.lines if line.get_label()[0] != "_"}


def at_x(axis, style):
    return [float(line.get_xdata()[0]) for line in axis.lines if line.get_linestyle() == style]


def at_y(axis, style):
    return [float(line.get_ydata()[0]) for line in axis.lines if line.get_linestyle() == style]


FREQUENCY = np.array([0.0, 10.0, 20.0])


def test_a_spectrum_has_its_speeds_and_resonances():
    series = {"y, m": np.array([1e-6, 0.5, 0.25]), "force, N": np.array([0.0, 2.0, 1.0])}
    speeds = np.array([[-15.0]]), np.array([[12.0, -12.5]])
    axis = spectrum_chart(FREQUENCY, series, *speeds, np.array([9.0, 11.0]), unit="rad/s").axes[0]
    assert named(axis)["y, m"] == [[0.0, 1e-6], [10.0, 0.5], [20.0, 0.25]]
    assert named(axis)["force, N"] == [[0.0, 0.0], [10.0, 2.0], [20.0, 1.0]]
    assert at_x(axis, ":") == [9.0, 11.0] and at_x(axis, "-.") == [15.0]
    assert [line.get_xdata()[0] for line in axis.lines if line.get_color() == "black"] == [12.0, 12.5, 15.0]
    assert axis.get_ylim() == pytest.approx((2e-4, 4.0)) and axis.get_xlim() == (0.0, 20.0)


def test_a_waterfall_has_its_amplitudes_over_time():
    time, values = np.array([1.0, 2.0]), np.array([[1e-9, 1.0, 2.0], [3.0, 4.0, 5.0]])
    speeds = np.array([[-15.0], [-16.0]]), np.array([[12.0], [13.0]])
    axis, bar = waterfall_chart(time, FREQUENCY, "force, N", values, *speeds, np.array([9.0]), unit="rad/s").axes
    shown = axis.collections[0]
    np.testing.assert_allclose(shown.get_array(), [[5e-4, 3.0], [1.0, 4.0], [2.0, 5.0]])
    assert (shown.norm.vmin, shown.norm.vmax) == pytest.approx((5e-4, 5.0))
    assert named(axis)["load speed"] == [[1.0, 12.0], [2.0, 13.0]]
    assert named(axis)["rotor speed"] == [[1.0, 15.0], [2.0, 16.0]] and at_y(axis, ":") == [9.0]
    assert axis.get_ylim() == (0.0, 20.0) and bar.get_ylabel() == "force, N, zero to peak"


def test_paths_share_a_unit():
    axis = path_chart({"a": (np.array([1e-6]), np.array([0.0])), "b": (np.array([0.0]), np.array([3e-6]))}).axes[0]
    assert named(axis)["a"] == [[pytest.approx(1.0), 0.0]] and axis.get_ylabel() == "vertical, µm"


SPEED = np.array([0.0, 10.0, 20.0])
CURVE = {
    "speed": SPEED,
    "amplitude": np.array([[1e-3, 1e-2], [2e-3, 3e-2], [3e-3, 2e-2]]),
    "phase": np.array([[0.0, np.nan], [3.0, 1.0], [-3.0, 2.0]]),
    "foundation_force": np.array([1.0, 4.0, 2.0]),
    "torque": np.array([0.0, 5.0, 3.0]),
}
POINTS = {name: values[1:] for name, values in CURVE.items()} | {"stable": np.array([False, True])}
FOLDS = {"speed": np.array([15.0]), "torque": np.array([2.5])}
MOTOR = {"speed": SPEED, "torque": np.array([4.0, 3.0, 0.0])}


def response(**options):
    about = {"names": ["y", "tilt"], "units": ["m", "rad"], "unit": "rad/s", "motors": 1, "motor": MOTOR}
    return response_chart(CURVE, POINTS, FOLDS, np.array([0.0, 9.0, 21.0]), **{**about, **options}).axes


def test_a_response_has_its_amplitudes_phases_and_force():
    lengths, tilts, phases, force, torque = response()
    for axis, name, k, factor in ((lengths, "y", 0, 1e3), (tilts, "tilt", 1, 180.0 / np.pi)):
        np.testing.assert_allclose(named(axis)[name], np.stack([SPEED, factor * CURVE["amplitude"][:, k]], axis=1))
    np.testing.assert_allclose(named(phases)["y"], np.stack([SPEED, np.rad2deg([0.0, 3.0, 2.0 * np.pi - 3.0])], axis=1))
    np.testing.assert_allclose(named(phases)["tilt"], np.stack([SPEED, np.rad2deg([0.0, 1.0, 2.0])], axis=1))
    assert named(force)["force on the foundation"] == [[0.0, 1.0], [10.0, 4.0], [20.0, 2.0]]
    points = [
        (line.get_xydata().tolist(), line.get_markerfacecolor() == "white") for line in force.lines if line.get_marker() == "o"
    ]
    assert points == [([[10.0, 4.0]], True), ([[20.0, 2.0]], False)]
    assert all(at_x(axis, ":") == [9.0] for axis in (lengths, tilts, phases, force, torque))
    labels = [axis.get_ylabel() for axis in (lengths, tilts, phases, force, torque)]
    assert labels == ["amplitude, mm", "amplitude, deg", "phase, deg", "force, N", "torque, N m"]
    assert torque.get_xlim() == (0.0, 20.0)


@pytest.mark.parametrize(
    ("motor", "top"), [([4.0, 3.0, 0.0], 5.0), ([1.0, 0.5, 0.0], 5.0), ([8.0, 1.0, 0.0], 8.0), (None, 5.0)]
)
def test_the_torque_of_the_motor_bounds_the_axis(motor, top):
    about = {
        "names": ["y", "tilt"],
        "units": ["m", "rad"],
        "unit": "rad/s",
        "motors": int(motor is not None),
        "motor": {} if motor is None else MOTOR | {"torque": np.asarray(motor)},
        "show": ["torque"],
    }
    (axis,) = response_chart(CURVE, POINTS, FOLDS, np.zeros(0), **about).axes
    lines = named(axis)
    assert axis.get_ylim() == pytest.approx((-0.03 * top, 1.08 * top))
    assert lines["needed by the vibration"] == [[0.0, 0.0], [10.0, 5.0], [20.0, 3.0]]
    assert "operating point; hollow: unstable" in lines and ("of the motor" in lines) == (motor is not None)
    if motor is not None:
        assert lines["fold: the speed jumps"] == [[15.0, 2.5]]
        assert lines["of the motor"] == np.stack([SPEED, motor], axis=1).tolist()


def test_the_axis_of_the_torque_contains_each_fold():
    about = {"names": ["y", "tilt"], "units": ["m", "rad"], "motors": 1, "motor": MOTOR, "show": ["torque"]}
    for torque, scale in ((39.0, "linear"), (41.0, "log")):  # a motor of 4 N m
        (axis,) = response_chart(CURVE, POINTS, FOLDS | {"torque": np.array([torque])}, np.zeros(0), **about).axes
        assert axis.get_yscale() == scale and axis.get_ylim()[1] > torque


def test_a_response_at_one_speed_is_a_point():
    curve, points = ({name: values[:1] for name, values in each.items()} for each in (CURVE | {"speed": SPEED[1:]}, POINTS))
    none = {name: values[:0] for name, values in points.items()}
    about = {"names": ["y", "tilt"], "units": ["m", "rad"], "unit": "rad/s", "motors": 0, "motor": {}}
    lengths = response_chart(curve, none, {}, np.array([9.0]), **about).axes[0]
    assert named(lengths)["y"] == [[10.0, 1.0]] and lengths.lines[-1].get_marker() == "."
    assert lengths.get_ylim() == pytest.approx((0.5, 2.0))


def test_the_curve_of_several_motors_is_that_of_all():
    (axis,) = response(motors=2, show=["torque"])
    assert named(axis)["of all motors"] == [[0.0, 4.0], [10.0, 3.0], [20.0, 0.0]]


def test_the_legend_of_the_torque_is_within_the_figure():
    torque = response()[-1]
    torque.figure.draw_without_rendering()
    assert torque.get_legend().get_window_extent().x1 <= torque.figure.bbox.x1
    assert torque.get_window_extent().width > 0.8 * torque.figure.bbox.width


def test_amplitudes_of_a_response_are_in_si_units():
    jv.display_units(si=True)
    try:
        lengths, tilts, *_ = response()
    finally:
        jv.display_units()
    assert [axis.get_ylabel() for axis in (lengths, tilts)] == ["amplitude, m", "amplitude, rad"]
    assert named(tilts)["tilt"] == [[0.0, 1e-2], [10.0, 3e-2], [20.0, 2e-2]]


def regime(stable, torque, masses=(0, 1)):
    return DrawnRegime(15.0, np.asarray(masses), np.array([0.0, np.pi]), np.asarray(torque), stable)


def test_torques_of_equal_motors_are_one_line():
    driving, needed = np.array([[4.0, 4.0, np.nan], [2.0, 2.001, np.nan]]), np.array([[1.0, 2.0, 9.0], [3.0, 5.0, 9.0]])
    curves = TorqueCurves(np.array([10.0, 20.0]), driving, needed)
    names = ["motor 1", "motor 2", "load 3"]
    regimes = [regime(True, [3.0, -2.0]), regime(False, [1.0, 2.0])]
    torques, first, second = regimes_chart(regimes, curves, np.array([0.0, 12.0, 20.0]), names=names).axes[:3]
    turn = 30.0 / np.pi
    lines = named(torques)
    expected = {"of motors 1, 2": [4.0, 2.0], "needed by motor 1": [1.0, 3.0], "needed by motor 2": [2.0, 5.0]}
    assert {name for name in lines if "motor" in name} == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(lines[name], [[10.0 * turn, values[0]], [20.0 * turn, values[1]]])
    points = [(line.get_ydata()[0], line.get_markerfacecolor() == "white") for line in torques.lines if line.get_zorder() == 4]
    assert points == [(1.0, True), (2.0, True), (3.0, False), (-2.0, False)]
    assert at_x(torques, ":") == [pytest.approx(12.0 * turn)]
    assert torques.get_xlim() == pytest.approx((0.0, 1.03 * 20.0 * turn)) and torques.get_ylim() == pytest.approx((-2.3, 4.6))
    assert first.get_title().splitlines() == [
        "143.239 rpm, stable",
        "phases in the direction of rotation",
        "0, 180 deg",
        "torques 3, -2 N m",
    ]
    assert second.get_title().startswith("143.239 rpm, unstable")


def test_regimes_of_many_masses_have_short_titles():
    many = DrawnRegime(15.0, np.arange(4), np.zeros(4), np.ones(4), True)
    figure = regimes_chart([many] * 5, None, np.zeros(0), names=[])
    assert [axis.get_title() for axis in figure.axes] == ["143.239 rpm, stable\nphases in the direction of rotation"] * 5 + [
        ""
    ] * 3


def test_a_single_mass_has_no_circle_beside_its_torque():
    curves = TorqueCurves(np.array([10.0, 20.0]), np.array([[4.0], [2.0]]), np.ones((2, 1)))
    one = regime(True, [3.0])
    assert [len(regimes_chart([one], each, np.zeros(0), names=["motor 1"]).axes) for each in (curves, None)] == [1, 1]


@pytest.mark.parametrize(
    ("needed", "torque", "limits"),
    [(-1.0, [3.0, 1.0], (-1.15, 4.6)), (-9.0, [3.0, 1.0], (-4.6, 4.6)), (0.5, [6.0, 1.0], (-0.3, 6.9))],
)
def test_the_axis_of_torques_contains_negative_ones(needed, torque, limits):
    curves = TorqueCurves(np.array([10.0, 20.0]), np.array([[4.0], [2.0]]), np.array([[1.0], [needed]]))
    axis = regimes_chart([regime(True, torque)], curves, np.zeros(0), names=["motor 1"]).axes[0]
    assert axis.get_ylim() == pytest.approx(limits)


def test_whirls_have_a_line_for_each_sense():
    n, speed = np.array([0.0, 10.0]), np.array([[5.0, 6.0], [4.0, 8.0]])
    sense = np.array([["straight at 0 deg", "backward"], ["backward", "forward"]])
    critical = np.array([4.5, 7.0, np.nan, 40.0]), np.array(["backward", "forward", "forward", "forward"])
    axis = campbell_diagram(n, speed, sense, critical=critical, at=9.0, unit="rad/s").axes[0]
    lines = named(axis)
    for name, values in (
        ("forward whirl", [np.nan, 8.0]),
        ("backward whirl", [6.0, 4.0]),
        ("straight motion at 0 deg", [5.0, np.nan]),
    ):
        np.testing.assert_array_equal(lines[name], np.stack([n, values], axis=1))
    assert lines["whirl frequency = rotor speed"] == [[0.0, 0.0], [pytest.approx(8.96)] * 2]
    marks = [(line.get_xydata().tolist(), line.get_marker()) for line in axis.lines if line.get_zorder() == 4]
    assert marks == [([[4.5, 4.5]], "s"), ([[7.0, 7.0]], "o")]
    assert axis.get_xlim() == (0.0, 10.0) and axis.get_ylim() == (0.0, pytest.approx(1.12 * 8.0))
    assert at_x(axis, "--") and [text.get_text() for text in axis.texts] == ["4.5 backward", "7 forward"]


def test_two_straight_motions_have_their_own_colours():
    n, speed = np.array([0.0, 10.0]), np.array([[5.0, 6.0], [5.0, 6.0]])
    words = np.array(["straight at 0 deg", "straight at 90 deg"])
    critical = np.array([5.0, 6.0]), words
    axis = campbell_diagram(n, speed, np.tile(words, (2, 1)), critical=critical, unit="rad/s").axes[0]
    first, second = axis.lines[:2]
    marks = [line.get_markeredgecolor() for line in axis.lines if line.get_zorder() == 4]
    assert marks == [first.get_color(), second.get_color()]
    assert first.get_color() != second.get_color()
    assert [line.get_label() for line in (first, second)] == ["straight motion at 0 deg", "straight motion at 90 deg"]


def test_critical_speeds_are_grouped_by_their_neighbour():
    speed = np.array([10.0, 10.3, 10.6, 12.0, 30.0, np.nan])
    groups = [group for group, _ in critical_groups(speed, np.full(6, "forward"), right=10.0 / 0.7)]
    assert groups == [[0, 1, 2], [3]]


TWO = np.stack([np.sin(np.arange(50.0)), np.cos(np.arange(50.0))], axis=1)
TIME = np.arange(50.0)
PANELS = {
    "phases": lambda: response(show=["phase"])[0],
    "torques": lambda: response(show=["torque"])[0],
    "spectrum": lambda: spectrum_chart(TIME, {"a": TIME, "b": TIME}, np.zeros((1, 1)), np.zeros((1, 1)), np.zeros(1)).axes[0],
    "waterfall": lambda: waterfall_chart(TIME, TIME, "a", np.ones((50, 50)), TWO[:, :1], TWO[:, 1:], np.zeros(1)).axes[0],
    "paths": lambda: path_chart({"a": TWO.T, "b": 2.0 * TWO.T}).axes[0],
    "signals": lambda: signals_chart(TIME, [("x", TWO, ["a", "b"])], x_label="t").axes[0],
    "shares": lambda: shares_chart(TIME, dict.fromkeys(("swinging", "jammed"), (TIME, TIME, TIME)), x_label="x").axes[0],
    "whirls": lambda: campbell_diagram(TIME, TWO + 1.0, np.tile(["forward", "backward"], (50, 1))).axes[0],
    "torus": lambda: torus_paths(TWO, TWO, TWO, TIME).axes[1],
    "drag": lambda: drag_diagram(
        [("all together", TIME, TIME, TIME > -1), ("at other phases", TIME, TIME, TIME > -1)], 8.0, label="drag", at=1.5
    ).axes[0],
    **{f"histories {k}": lambda k=k: histories().axes[k] for k in (0, 1, 2, 3, 4, 5)},
}


def histories():
    arrays = (TIME, TWO, TWO, 1.01 * TWO[:, :1], TWO)
    return time_histories(arrays, arrays, names=("y1", "y2"), directions=("up", "across"))


@pytest.mark.parametrize("panel", PANELS)
def test_curves_of_a_panel_differ_without_colours_and_with_them(panel):
    curves = [line for line in PANELS[panel]().lines if len(line.get_xdata()) > 2 and line.get_color() not in ("black", GUIDE)]
    curves = list({line.get_color(): line for line in curves}.values())
    strokes = {(str(line._unscaled_dash_pattern), line.get_marker()) for line in curves}
    assert len(curves) == len(strokes) == 2
