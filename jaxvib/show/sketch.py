"""Sketch of a scene: platforms, springs, dampers, rotor and loads, with their values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from jaxvib.boundary import validated
from jaxvib.display import Drawn
from jaxvib.draw.machine.deck import ellipses, magnification
from jaxvib.draw.machine.parts import Part, Text, draw_part
from jaxvib.draw.style import COLORS, panels
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.show.view import View
from jaxvib.show.views import view_of
from jaxvib.show.wheel import at_rest, caption
from jaxvib.steady.points import Deck
from jaxvib.units.known import require_known

_INCHES_PER_UNIT = 0.62
"""Inches per unit of a drawing."""

_LETTER_WIDTH = 0.072
"""Mean width of a letter of a small text, inches."""

Limits = tuple[float, float, float, float]
"""Left, right, bottom and top of a drawing."""


@validated
def sketch(scene: Scene, *, deck: Deck | None = None, ax: Axes | None = None) -> Drawn:
    """Draw a scene at rest: its masses, springs, dampers, rotor and loads, with their values and units.

    Platforms are drawn above each other, numbered from the foundation upward, with all their exciters. A rotor is drawn as seen
    along its axis, a rotor with tilt also as seen from the side. Loads are spread over their circle so that each is visible.
    Platforms and rotors are not to scale, except for the circles of the loads and the size of loads with a `ball_radius`; very
    small ones are enlarged. A body in a plane is drawn to scale, with an outline around its centre of mass, its supports and
    its exciters, and with its springs in their directions.

    **Arguments**

    - `scene` of platforms, of a rotor, or of one body in a plane
    - `deck`: the motion of points of a body in a plane, such as the result of `Run.deck`; the ellipses of the points are drawn,
      magnified, with dots at their positions at one time; default: none
    - `ax`: axes to draw onto; default: a new figure

    **Returns** a matplotlib figure, or the given `ax`.

    **Raises** `InputError` for

    - an argument that is not a scene, and a scene with traced values (within `jit` or `grad`)
    - a machine that cannot be drawn, such as several bodies in a plane, and a rotor with several exciters
    - a `deck` on a machine other than a body in a plane

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> [text.get_text() for text in jv.sketch(scene).axes[0].texts][:2]
    ['40 N/mm\\n30 N s/m', 'M1 = 50 kg']
    """
    view = view_of(scene := drawable_scene(scene))
    pose, title = at_rest(scene), caption(scene)
    if deck is None and any(exciter.unbalance is None for exciter in scene.exciters):
        title += "\ngrey dot: mark on the rotor"
    parts, texts = view.parts(pose, 0.0), view.texts(pose, 0.0)
    limits = left, right, bottom, top = _limits(parts, texts)
    wide = max(_INCHES_PER_UNIT * (right - left), _LETTER_WIDTH * max(map(len, title.splitlines())))
    tall = _INCHES_PER_UNIT * (top - bottom) + 0.25 + 0.18 * len(title.splitlines())
    figure, (axis,) = panels(1, size=(wide, tall), ax=ax)
    set_drawing_limits(axis, limits)
    axis.set_anchor("W")  # beside a drawing in the middle of a wider figure, the title would be cut off
    for part in parts:
        draw_part(axis, part)
    for text in texts:
        axis.text(text.x, text.y, text.text, zorder=6, **text.look)
    if deck is not None:
        _draw_deck(axis, view, deck, limits)
    axis.set_title(title, loc="left", fontsize="small", y=1.0)  # a fixed y is faster than automatic placement
    return figure if ax is None else ax


def _limits(parts: Sequence[Part], texts: Sequence[Text]) -> Limits:
    """Return the limits of a drawing without the margins that the forces of an animation need."""
    points = np.concatenate([part.points for part in parts])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    for text in texts:
        lines = text.text.splitlines()
        width, height = _LETTER_WIDTH / _INCHES_PER_UNIT * max(map(len, lines)), 0.17 / _INCHES_PER_UNIT * len(lines)
        across = {"center": 0.5, "right": 1.0}.get(text.look.get("ha", "left"), 0.0)
        up = {"center": 0.5, "top": 1.0}.get(text.look.get("va", "baseline"), 0.0)
        corner = np.array([text.x - across * width, text.y - up * height])
        low, high = np.minimum(low, corner), np.maximum(high, corner + np.array([width, height]))
    (left, bottom), (right, top) = low - 0.15, high + 0.15
    return float(left), float(right), float(bottom), float(top)


def _draw_deck(axis: Axes, view: View, deck: Deck, limits: Limits) -> None:
    if view.scene.machine.places != "plane":
        raise InputError("deck", f"needs a body in a plane, not a machine of kind {quoted(view.scene.machine.kind)}")
    points, amplitude = np.asarray(deck.points), np.asarray(deck.amplitude)
    magnify = min(magnification(points, amplitude), float(f"{0.35 / (view.scale * np.max(np.abs(amplitude))):.1g}"))
    paths = [view.scale * path for path in ellipses(points, amplitude, magnify)]
    for path in paths:
        axis.plot(*path.T, color=COLORS[1], lw=1.4, zorder=4.0)
        axis.plot(*path[0], "o", color=COLORS[1], ms=3.5, zorder=4.0)
    left, right, bottom, top = limits
    (low_x, low_y), (high_x, high_y) = (extreme(np.concatenate(paths), axis=0) for extreme in (np.min, np.max))
    axis.set(xlim=(min(left, low_x - 0.1), max(right, high_x + 0.1)), ylim=(min(bottom, low_y - 0.1), max(top, high_y + 0.1)))
    note = f"ellipses drawn {magnify:g} x as large; dots: positions at one time"
    axis.text(right, bottom, note, ha="right", va="bottom", fontsize="x-small", color="#555555")


def drawable_scene(scene: Scene) -> Scene:
    """Return `validate_scene(scene)`. **Raises** its errors, and `InputError` for a scene with traced numbers."""
    require_known(scene, "scene", "a drawing", "draw it outside")
    return validate_scene(scene)


def set_drawing_limits(axis: Axes, limits: Limits) -> None:
    """Set the limits of axes to those of a drawing, with equal scales, and hide ticks and frame."""
    left, right, bottom, top = limits
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axis.set_axis_off()
