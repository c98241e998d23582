"""Outlines of parts of a drawing, point by point."""

import numpy as np
import pytest

from jaxvib.draw.machine.parts import arrow, box, circle, damper, sector, spring, turning_arrow


def pieces(outline):
    """Lines of an outline, which NaN separates."""
    breaks = np.flatnonzero(np.isnan(outline[:, 0]))
    return [part[~np.isnan(part[:, 0])].tolist() for part in np.split(outline, breaks)]


def test_a_spring_is_a_zigzag_between_its_ends():
    along = spring((1.0, 2.0), (1.0, 12.0), width=0.4, coils=2)
    heights = [2.0, 3.5, 5.25, 7.0, 8.75, 10.5, 11.3, 12.0]
    np.testing.assert_allclose(along, np.stack([1.0 - np.array([0.0, 0.0, 0.2, -0.2, 0.2, 0.0, 0.0, 0.0]), heights], axis=1))


def test_a_damper_has_a_cup_and_a_piston():
    stem, cup, rod, piston = pieces(damper((0.0, 1.0), (10.0, 1.0), width=0.5, cup=0.4))
    np.testing.assert_allclose(stem, [[0.0, 1.0], [3.0, 1.0]])
    np.testing.assert_allclose(cup, [[7.0, 1.25], [3.0, 1.25], [3.0, 0.75], [7.0, 0.75]])
    np.testing.assert_allclose(rod, [[10.0, 1.0], [5.2, 1.0]])
    np.testing.assert_allclose(piston, [[5.2, 1.18], [5.2, 0.82]])


def test_boxes_circles_and_sectors_have_their_places():
    assert box(0.0, 3.0, 1.0, 2.0).tolist() == [[0.0, 1.0], [3.0, 1.0], [3.0, 2.0], [0.0, 2.0], [0.0, 1.0]]
    np.testing.assert_allclose(
        circle((5.0, 1.0), 2.0, 5), [[7.0, 1.0], [5.0, 3.0], [3.0, 1.0], [5.0, -1.0], [7.0, 1.0]], atol=1e-12
    )
    cut = sector((5.0, 1.0), 2.0, 0.5 * np.pi, half=0.5 * np.pi)
    np.testing.assert_allclose(
        cut[[0, 1, 13, 25, 26]], [[5.0, 1.0], [7.0, 1.0], [5.0, 3.0], [3.0, 1.0], [5.0, 1.0]], atol=1e-12
    )


@pytest.mark.parametrize("direction", [1, -1])
def test_a_turning_arrow_points_in_the_direction_of_rotation(direction):
    arc, head = turning_arrow((5.0, 1.0), 2.0, direction)
    angle = 0.5 * np.pi + 0.8 * direction
    end = np.array([5.0, 1.0]) + 2.0 * np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(np.hypot(*(arc - [5.0, 1.0]).T), 2.0)
    np.testing.assert_allclose(arc[-1], end)
    np.testing.assert_allclose(arc[10], [5.0, 3.0])
    forward = direction * np.array([-np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(head[[0, 3]], [end + 0.2 * forward] * 2)
    np.testing.assert_allclose(head[1] + head[2], 2.0 * end)
    np.testing.assert_allclose((head[1] - head[2]) @ forward, 0.0, atol=1e-12)
    assert np.hypot(*(head[1] - head[2])) == pytest.approx(0.18)


@pytest.mark.parametrize(("length", "head", "width"), [(2.0, 0.28, 0.1), (0.14, 0.084, 0.05), (0.0, 0.0, 0.0)])
def test_a_short_arrow_has_a_shorter_head(length, head, width):
    outline = arrow((1.0, 3.0), (length, 0.0), width=0.1)
    shaft = 1.0 + length - head
    x = [1.0, 1.0, shaft, shaft, 1.0 + length, shaft, shaft, 1.0, 1.0]
    y = 3.0 + width * np.array([0.0, 0.5, 0.5, 1.3, 0.0, -1.3, -0.5, -0.5, 0.0])
    np.testing.assert_allclose(outline, np.stack([x, y], axis=1))
