"""Axes, lines and legend of a chart as outlines, point by point."""

import numpy as np
import pytest

from jaxvib.explore.chart import _jams_at_working_speed
from jaxvib.explore.panel import PANEL_HEIGHT, PANEL_WIDTH, Panel, dot, legend

PANEL = Panel(1.0, "force, N", (0.0, 10.0), (0.0, 100.0))


def test_axes_are_drawn_along_the_left_and_the_bottom():
    *grid, edge = PANEL.frame()
    np.testing.assert_allclose(edge.points, [[1.0, PANEL_HEIGHT], [1.0, 0.0], [1.0 + PANEL_WIDTH, 0.0]])
    upright = [part.points for part in grid if part.points[0, 0] == part.points[-1, 0]]
    level = [part.points for part in grid if part.points[0, 1] == part.points[-1, 1]]
    np.testing.assert_allclose([points[0, 0] for points in upright], 1.0 + PANEL_WIDTH * np.arange(0.0, 1.1, 0.2))
    np.testing.assert_allclose([points[:, 1] for points in upright], [[0.0, PANEL_HEIGHT]] * 6)
    np.testing.assert_allclose([points[0, 1] for points in level], PANEL_HEIGHT * np.arange(0.0, 1.1, 0.2))
    np.testing.assert_allclose([points[:, 0] for points in level], [[1.0, 1.0 + PANEL_WIDTH]] * 6)


def test_numbers_stand_at_their_ticks():
    texts = {text.text: (text.x, text.y, text.look.get("ha")) for text in PANEL.texts()}
    for place, name in ((0.2, "2"), (0.8, "8"), (1.0, "10")):
        assert texts[name] == (pytest.approx(1.0 + PANEL_WIDTH * place), -0.18, "center")
    for place, name in ((0.2, "20"), (0.8, "80"), (1.0, "100")):
        assert texts[name] == (pytest.approx(0.92), pytest.approx(PANEL_HEIGHT * place), "right")
    assert texts["rotor speed, rpm"][:2] == (pytest.approx(1.0 + 0.5 * PANEL_WIDTH), -0.46)
    assert texts["force, N"][:2] == (pytest.approx(0.3), pytest.approx(PANEL_HEIGHT + 0.22))


def test_a_line_has_a_gap_outside_and_no_close_points():
    x = np.linspace(0.0, 10.0, 2001)
    y = np.where(x < 4.0, 40.0, np.where(x < 6.0, 101.0, 30.0))
    points = PANEL.line(x, y, {}).points
    inside = points[np.isfinite(points[:, 0])]
    assert len(inside) < 200 and inside[0].tolist() == pytest.approx([1.0, 0.4 * PANEL_HEIGHT])
    gap = PANEL_WIDTH * np.array([x[x < 4.0][-1], x[x >= 6.0][0]]) / 10.0 + 1.0
    assert np.isnan(points).any() and set(np.round(gap, 9)) <= set(np.round(inside[:, 0], 9))
    np.testing.assert_allclose(points[-1], [1.0 + PANEL_WIDTH, 0.3 * PANEL_HEIGHT])
    steps = np.diff(inside[inside[:, 0] < gap[0], 0])
    assert np.all(steps[:-1] > 0.02) and np.all(steps < 0.05)


def test_dots_are_round_or_square():
    around = dot(2.0, 3.0, {"fc": "white"})
    np.testing.assert_allclose(np.hypot(*(around.points - [2.0, 3.0]).T), 0.05)
    square = dot(2.0, 3.0, {}, square=True).points
    assert (np.min(square, axis=0).tolist(), np.max(square, axis=0).tolist()) == ([1.955, 2.955], [2.045, 3.045])
    assert around.filled


def test_a_legend_has_two_entries_in_a_column():
    line, point = {"color": "red"}, {"fc": "white"}
    parts, texts = legend([{"a": line, "b": point, "c": line}, {"d": line}, {"e": line}])
    places = {text.text: (text.x, text.y) for text in texts}
    expected = {
        "a": (0.55, PANEL_HEIGHT + 0.95),
        "b": (0.55, PANEL_HEIGHT + 0.68),
        "c": (2.1, PANEL_HEIGHT + 0.95),
        "d": (8.8, PANEL_HEIGHT + 0.95),
    }
    expected["e"] = (13.6, PANEL_HEIGHT + 0.95)
    assert places == {name: pytest.approx(place) for name, place in expected.items()}
    np.testing.assert_allclose(parts[0].points, [[0.05, PANEL_HEIGHT + 0.95], [0.45, PANEL_HEIGHT + 0.95]])
    np.testing.assert_allclose(np.mean(parts[1].points[:-1], axis=0), [0.25, PANEL_HEIGHT + 0.68])


def test_logarithmic_panels_omit_points_without_logarithm():
    points = (
        Panel(1.0, "", (0.0, 10.0), (1.0, 100.0), log=True).line([0.0, 2.0, 5.0, 10.0], [0.0, -1.0, 10.0, 100.0], {}).points
    )
    np.testing.assert_allclose(
        points[np.isfinite(points[:, 0])], [[1.0 + 0.5 * PANEL_WIDTH, 0.5 * PANEL_HEIGHT], [1.0 + PANEL_WIDTH, PANEL_HEIGHT]]
    )


def test_number_of_a_jam_is_beside_its_highest_dot():
    """Two coordinates at the crossing halfway between the points 0 and 1 of the branch: 30 N and 70 N."""
    curves = [np.array([20.0, 40.0]), np.array([60.0, 80.0])]
    dots, (text,) = _jams_at_working_speed(PANEL, curves, [(0, 0.5, "2", True)], 5.0)
    middles = [np.mean([np.min(each.points, axis=0), np.max(each.points, axis=0)], axis=0) for each in dots]
    np.testing.assert_allclose(
        middles, [[1.0 + 0.5 * PANEL_WIDTH, 0.3 * PANEL_HEIGHT], [1.0 + 0.5 * PANEL_WIDTH, 0.7 * PANEL_HEIGHT]], atol=1e-3
    )
    assert text.text == "2" and text.y == pytest.approx(0.7 * PANEL_HEIGHT)
