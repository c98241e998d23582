"""Texts of SVG drawings."""

from xml.etree import ElementTree

import numpy as np
import pytest

from jaxvib.draw.machine.parts import Part, Text
from jaxvib.draw.machine.svg import svg

NAME = "{http://www.w3.org/2000/svg}"


def drawing(frames, texts=None, head="", seconds=2.0, turns=1.0):
    """The tree of a drawing from 1 to 3 across and from 0 to 1 up, 62 units per length."""
    found = svg((1.0, 3.0, 0.0, 1.0), frames, texts or [[] for _ in frames], head, seconds, turns)
    return ElementTree.fromstring(found)


def base_lines(text, held):
    """Heights of the lines' bases, downward, of a text at the height 10."""
    drawn = ElementTree.fromstring(
        svg((0.0, 1.0, -1.0, 0.0), [[]], [[Text(0.5, -10.0 / 62.0, text, {"va": held})]], "", 1.0, 1.0)
    )
    return np.array([float(line.get("y")) for line in drawn.iter("{http://www.w3.org/2000/svg}tspan")])


def test_lines_of_a_text_stand_where_they_are_held():
    bottom, middle, top = (base_lines("a\nb\nc", held) for held in ("bottom", "center", "top"))
    assert all(lines[0] < lines[1] < lines[2] for lines in (bottom, middle, top))
    assert bottom[2] == 10.0 and middle[1] == base_lines("a", "center")[0] and top[0] == base_lines("a", "top")[0] > 10.0


def test_lines_and_areas_have_their_colours_and_strokes():
    ends, gap = [[1.0, 0.0], [2.0, 1.0]], [[np.nan, np.nan]]
    line = Part(np.array(ends + gap + ends), {"color": (1.0, 0.0, 0.0), "lw": 2.0, "ls": "--", "alpha": 0.5})
    area = Part(np.array(ends), {"fc": "0.5", "ec": "none"}, filled=True)
    figure = drawing([[line, area, Part(np.array(ends), {"zorder": 0.5})]])
    assert figure.get("viewBox") == "0 0 124 62"
    plain, filled, dashed = (path.attrib for path in figure.iter(f"{NAME}path"))
    assert plain == {"d": "M0.0 62.0L62.0 0.0", "fill": "none", "stroke": "#000000", "stroke-width": "1.39"}
    assert filled == {"d": "M0.0 62.0L62.0 0.0Z", "fill": "#808080", "stroke": "none", "stroke-width": "1.39"}
    look = {"fill": "none", "stroke": "#ff0000", "stroke-width": "2.78", "stroke-dasharray": "4 2", "opacity": "0.5"}
    assert dashed == {"d": "M0.0 62.0L62.0 0.0M0.0 62.0L62.0 0.0"} | look


def test_a_part_that_keeps_its_shape_is_shifted():
    def frame(shift, stretch):
        points = np.array([[1.0, 0.0], [2.0, 1.0]])
        moved, changed = Part(np.add(points, [shift, 0.5 * shift]), {}), Part(points * [1.0, stretch], {})
        return [moved, changed, Part(points, {})]

    moved, changed, still = drawing([frame(0.0, 1.0), frame(1.0, 0.5)])
    assert moved.tag == f"{NAME}g" and moved[0].get("d") == "M0.0 62.0L62.0 0.0"
    assert moved[1].get("values") == "0.0 0.0;62.0 -31.0;0.0 0.0" and moved[1].get("dur") == "2s"
    assert changed[0].get("values") == "M0.0 62.0L62.0 0.0;M0.0 62.0L62.0 31.0;M0.0 62.0L62.0 0.0"
    assert changed[0].get("attributeName") == "d" and changed[0].get("dur") == "2s"
    assert still.tag == f"{NAME}path" and len(still) == 0


@pytest.mark.parametrize(("direction", "end"), [(1, -360), (-1, 360)])
def test_a_part_of_the_rotor_turns_about_its_axis(direction, end):
    frames = [[Part(np.array([[2.0, 0.0], [2.0, 1.0]]), {}, axis=(2.0, y), direction=direction)] for y in (0.5, 0.25)]
    (group,) = drawing(frames, turns=4.0)
    turning, moving = group.iter(f"{NAME}animateTransform")
    assert (turning.get("from"), turning.get("to"), turning.get("dur")) == ("0 62.0 31.0", f"{end} 62.0 31.0", "0.5s")
    assert (moving.get("values"), moving.get("dur")) == ("0.0 0.0;0.0 15.5;0.0 0.0", "2s")


def test_a_head_stands_above_the_drawing():
    line = 1.35 * 8.3 * 100.0 / 72.0
    figure = drawing(
        [[Part(np.array([[1.0, 1.0], [3.0, 1.0]]), {})]], [[Text(2.0, 1.0, "a & b", {"ha": "center"})]], "one\ntwo"
    )
    assert figure.get("viewBox") == f"0 0 124 {62.0 + 2.0 * line:.0f}"
    assert figure.find(f"{NAME}path").get("d") == f"M0.0 {2.0 * line:.1f}L124.0 {2.0 * line:.1f}"
    places = [(span.text, float(span.get("x")), float(span.get("y"))) for span in figure.iter(f"{NAME}tspan")]
    middle = 0.35 * 8.3 * 100.0 / 72.0  # from the middle of a line to its base
    expected = [("a & b", 62.0, 2.0 * line + middle), ("one", 0.0, 0.5 * line + middle), ("two", 0.0, 1.5 * line + middle)]
    assert [(text, x, pytest.approx(y, abs=0.06)) for text, x, y in expected] == places
    anchors = [text.get("text-anchor") for text in figure.iter(f"{NAME}text")]
    assert anchors == ["middle", "start", "start"]


def test_texts_have_their_size_weight_and_outline():
    look = {"fontsize": "x-small", "fontweight": "bold", "bbox": {}}
    text = next(drawing([[]], [[Text(2.0, 1.0, "a", look)]]).iter(f"{NAME}text"))
    assert (text.get("font-size"), text.get("font-weight"), text.get("stroke")) == ("9.7", "bold", "white")
