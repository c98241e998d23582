"""Sketch of a scene: platforms, springs, dampers, rotor and loads, with their values."""

from __future__ import annotations

from matplotlib.axes import Axes

from jaxvib.boundary import validated
from jaxvib.draw.machine.parts import put
from jaxvib.draw.style import Drawn, panels
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.show.views import View, view_of
from jaxvib.show.wheel import at_rest, caption
from jaxvib.units.known import require_known

_INCH = 0.62
"""Inches per unit of a drawing."""


@validated
def sketch(scene: Scene, *, ax: Axes | None = None) -> Drawn:
    """Draw a scene at rest: its masses, springs, dampers, rotor and loads, with their values and units.

    Platforms are drawn above each other, numbered from the foundation upward. A rotor is drawn along its axis, a rotor with
    tilt also from the side. Loads are spread over their circle so that each is visible. Only the loads and their circle are to
    scale.

    **Arguments**: `scene`, of any machine; `ax`: axes to draw onto.

    **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for an argument that is not a scene, or a scene
    with traced numbers (within `jit` or `grad`).

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> [text.get_text() for text in jv.sketch(scene).axes[0].texts][:2]
    ['40 N/mm\\n30 N s/m', 'M1 = 50 kg']
    """
    view = view_of(checked_scene(scene))
    left, right, bottom, top = view.limits
    figure, (axis,) = panels(1, size=(_INCH * (right - left), _INCH * (top - bottom) + 0.6), ax=ax)
    fit(axis, view)
    pose = at_rest(scene)
    for part in view.parts(pose, 0.0):
        put(axis, part)
    for text in view.texts(pose, 0.0):
        axis.text(text.x, text.y, text.text, zorder=6, **text.look)
    axis.set_title(caption(scene), loc="left", fontsize="small", y=1.0)  # a fixed y is faster than automatic placement
    return figure if ax is None else ax


def checked_scene(scene: object) -> Scene:
    """Return the scene. **Raises** `InputError` for an object that is not a scene, and for a scene with traced numbers."""
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {quoted(scene)}; it must be a Scene, for example load_scene('machine.toml')")
    require_known(scene, "scene", "a drawing", "draw it outside")
    return scene


def fit(axis: Axes, view: View) -> None:
    """Set the limits of axes to those of the drawing, with equal scales, and hide ticks and frame."""
    left, right, bottom, top = view.limits
    axis.set_xlim(left, right)
    axis.set_ylim(bottom, top)
    axis.set_aspect("equal")
    axis.set_axis_off()
