"""Texts of SVG drawings."""

from xml.etree import ElementTree

import numpy as np

from jaxvib.draw.machine.parts import Text
from jaxvib.draw.machine.svg import svg


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
