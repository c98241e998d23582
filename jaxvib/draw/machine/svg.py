"""Animated SVG drawings of a machine, without JavaScript."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.colors import to_hex

from jaxvib.draw.machine.parts import Part, Text

_UNITS_PER_LENGTH = 62.0
"""SVG units per unit of length of the drawing."""

_UNITS_PER_POINT = 100.0 / 72.0
"""SVG units per typographic point."""

_FONT_SIZES = {"small": 8.3, "x-small": 7.0}
_ANCHORS = {"left": "start", "center": "middle", "right": "end"}
_DASHES = {":": "1 2", "--": "4 2", "-.": "9 2 2 2"}


def svg(
    limits: tuple[float, float, float, float],
    frames: Sequence[Sequence[Part]],
    texts: Sequence[Sequence[Text]],
    head: str,
    seconds: float,
    turns: float,
) -> str:
    """Return an animated image that repeats periodically, or a still image if there is only one frame.

    **Arguments**

    - `limits`: (left, right, bottom, top) of the drawing
    - `frames`: the parts at equal time steps over one period, the same parts in each frame. All frames show the rotor at the
      same angle, because `turns` adds the rotation
    - `texts`: texts at the same times
    - `head`: lines of text above the drawing
    - `seconds`: duration of a period, s
    - `turns`: revolutions of the rotor in a period, not necessarily a whole number

    **Returns** the text of an SVG file.

    >>> ball = [[Part(np.array([[x, 0.0], [x, 1.0]]), {"color": "red"})] for x in (0.0, 0.5)]
    >>> "<animateTransform" in svg((0.0, 1.0, 0.0, 1.0), ball, [[], []], "", 1.0, 1.5)
    True
    """
    left, right, bottom, top = limits
    lines = head.split("\n") if head else []
    above = 1.35 * _FONT_SIZES["small"] * _UNITS_PER_POINT * len(lines)

    def place(points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) * (_UNITS_PER_LENGTH, -_UNITS_PER_LENGTH) + (
            -left * _UNITS_PER_LENGTH,
            top * _UNITS_PER_LENGTH + above,
        )

    wide, tall = (right - left) * _UNITS_PER_LENGTH, (top - bottom) * _UNITS_PER_LENGTH + above
    found = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {tall:.0f}" width="{wide:.0f}" height="{tall:.0f}">'
    ]
    order = sorted(range(len(frames[0])), key=lambda k: frames[0][k].look.get("zorder", 1.0 if frames[0][k].filled else 2.0))
    found += [_part([frame[k] for frame in frames], place, seconds, turns) for k in order]
    for k, text in enumerate(texts[0]):
        places = place(np.array([(frame[k].x, frame[k].y) for frame in texts]))
        x, y = places[0].tolist()
        found.append(_shifted(_text(x, y, text.text, text.look), places - places[0], seconds))
    found += [_text(0.0, 1.35 * _FONT_SIZES["small"] * _UNITS_PER_POINT * (k + 0.5), line, {}) for k, line in enumerate(lines)]
    return "".join([*found, "</svg>"])


def _part(frames: Sequence[Part], place: Callable[[np.ndarray], np.ndarray], seconds: float, turns: float) -> str:
    """Return a part with its motion.

    The motion is a rotation with the rotor, a translation if the shape is constant, otherwise a sequence of outlines.
    """
    first = frames[0]
    outlines = place(np.array([frame.points for frame in frames]))
    shift = np.array([outline[0] for outline in outlines]) - outlines[0, 0]
    draw = f'<path d="{_path(outlines[0], first.filled)}"{_style(first)}'
    if len(frames) == 1:
        return f"{draw}/>"
    if first.axis is not None:
        x, y = place(np.asarray(first.axis))
        angles = f'from="0 {x:.1f} {y:.1f}" to="{-360 * first.direction} {x:.1f} {y:.1f}"'
        turning = f'<animateTransform attributeName="transform" type="rotate" {angles} {_repeat_attributes(seconds / turns)}'
        draw = f"{draw}>{turning}</path>"
        moved = place(np.array([frame.axis for frame in frames])) - (x, y)
    elif np.nanmax(np.abs(outlines - outlines[0] - shift[:, None])) < 0.05:
        draw, moved = f"{draw}/>", shift
    else:
        shapes = ";".join(_path(outline, first.filled) for outline in [*outlines, outlines[0]])
        return f'{draw}><animate attributeName="d" values="{shapes}" {_repeat_attributes(seconds)}</path>'
    return _shifted(draw, moved, seconds)


def _shifted(drawn: str, moved: np.ndarray, seconds: float) -> str:
    """Return an SVG element that moves through the offsets `moved` (n, 2) and back to the first."""
    if np.max(np.abs(moved)) < 0.05:
        return drawn
    values = ";".join(f"{x:.1f} {y:.1f}" for x, y in [*moved.tolist(), moved[0].tolist()])
    motion = f'<animateTransform attributeName="transform" type="translate" values="{values}" {_repeat_attributes(seconds)}'
    return f"<g>{drawn}{motion}</g>"


def _repeat_attributes(seconds: float) -> str:
    return f'dur="{seconds:.4g}s" repeatCount="indefinite"/>'


def _path(points: np.ndarray, closed: bool) -> str:
    pen, found = "M", []
    for x, y in points.tolist():
        if x != x:  # NaN: begin a new line
            pen = "M"
        else:
            found.append(f"{pen}{x:.1f} {y:.1f}")
            pen = "L"
    return "".join([*found, "Z" if closed else ""])


def _style(part: Part) -> str:
    look = part.look
    fill, stroke = (look.get("fc", "none"), look.get("ec", "none")) if part.filled else ("none", look.get("color", "black"))
    fill, stroke = (color if color == "none" else to_hex(color) for color in (fill, stroke))
    dash = look.get("ls", "-")
    dashed = f' stroke-dasharray="{_DASHES[dash]}"' if dash in _DASHES else ""
    alpha = f' opacity="{look["alpha"]:g}"' if "alpha" in look else ""
    return f' fill="{fill}" stroke="{stroke}" stroke-width="{look.get("lw", 1.0) * _UNITS_PER_POINT:.2f}"{dashed}{alpha}'


def _text(x: float, y: float, text: str, look: dict[str, object]) -> str:
    size = _FONT_SIZES[str(look.get("fontsize", "small"))] * _UNITS_PER_POINT
    lines = text.split("\n")
    step = 1.25 * size
    # Offset of the baseline of the first line for each vertical alignment of the whole text.
    first = {"center": 0.35 * size - 0.5 * step * (len(lines) - 1), "bottom": -step * (len(lines) - 1), "top": 0.8 * size}
    base = y + first[str(look.get("va", "center"))]
    anchor = _ANCHORS[str(look.get("ha", "left"))]
    spans = "".join(f'<tspan x="{x:.1f}" y="{base + k * step:.1f}">{html.escape(line)}</tspan>' for k, line in enumerate(lines))
    style = f' font-weight="{look["fontweight"]}"' if "fontweight" in look else ""
    if "bbox" in look:  # a white outline covers the drawing behind the letters
        style += ' stroke="white" stroke-width="4" paint-order="stroke"'
    return f'<text font-family="sans-serif" font-size="{size:.1f}"{style} text-anchor="{anchor}">{spans}</text>'
