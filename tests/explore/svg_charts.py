"""Numbers and lines that are read back from SVG charts."""

import re

import numpy as np

SVG = "{http://www.w3.org/2000/svg}"


def texts(drawn):
    """The texts of a figure: where each stands, what it says, its element."""
    return [(float(t.get("x")), float(t.get("y")), t.text, e) for e in drawn.iter(f"{SVG}text") for t in e.iter(f"{SVG}tspan")]


def axes(spans, log=False):
    """Both axes of a chart from the numbers at its ticks: polynomials of the dots."""
    ticks = [(x, y, float(text), e.get("text-anchor")) for x, y, text, e in spans if re.fullmatch(r"[-+.e0-9]+", text or "")]
    across = np.polyfit(*zip(*[(x, value) for x, _, value, anchor in ticks if anchor == "middle"], strict=True), 1)
    # The base of a text stands 0.35 of its size below its middle.
    levels = [(y - 0.35 * 11.5, np.log(value) if log else value) for _, y, value, anchor in ticks if anchor == "end"]
    return across, np.polyfit(*zip(*levels, strict=True), 1)


def lines(drawn, color, filled=False):
    """The lines of a colour, in dots, with the figures of their dashes, or the outlines of what is filled."""
    paths = [p for p in drawn.iter(f"{SVG}path") if p.get("stroke") == color and (p.get("fill") != "none") == filled]
    return [(np.array(re.findall(r"[ML]([-.0-9]+) ([-.0-9]+)", p.get("d")), float), p.get("stroke-dasharray")) for p in paths]
