"""SVG pictures of a machine: at rest, or moving in a jam of light loads."""

from __future__ import annotations

import numpy as np

from jaxvib.draw.machine.svg import svg
from jaxvib.errors import ComputationError
from jaxvib.machine.scene import Scene
from jaxvib.show.sketch import drawable_scene
from jaxvib.show.view import ARROWS_NOTE
from jaxvib.show.views import view_of
from jaxvib.show.wheel import Pose, RotorPose, at_rest, caption, places_of
from jaxvib.steady.jams.jam import Jam

_FRAMES_PER_PERIOD = 20
"""Number of frames in a period. Browsers interpolate linearly between them; circular paths are accurate to about 1 %."""

_PERIOD_SECONDS = 1.6
"""Duration of a period of the vibration in the picture, s."""


def moving_svg(scene: Scene, jam: Jam) -> str:
    """Return the sketch of a scene that moves in a jam mode, with the forces on the foundation as arrows.

    The rotor turns faster than the loads. Coincident loads are drawn at the same place.

    **Arguments**: `scene` of platforms, and a `jam` of it, from `jam_modes`.

    **Returns** the text of an SVG file, which repeats one period endlessly. **Raises** `ComputationError` for a jam mode that
    does not exist or whose motion is not finite; the message names the mode.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
    >>> moving_svg(scene, jv.jam_modes(scene).select(1)).count("<animate") > 10
    True
    """
    view = view_of(drawable_scene(scene))
    omega, amplitude = float(jam.omega), np.asarray(jam.displacement)
    if not np.isfinite(omega) or not np.isfinite(amplitude).all():
        raise ComputationError("absent", f"jam mode {int(jam.mode)} cannot be shown:  {jam.message}")
    theta = 2.0 * np.pi * np.arange(_FRAMES_PER_PERIOD) / _FRAMES_PER_PERIOD
    first, *others = (np.asarray(u, float) for u in scene.loads.rest())
    wave = np.exp(1j * theta)[:, None] * amplitude
    displacement, velocity = np.real(wave), np.real(1j * omega * wave)
    angles = theta[:, None] + np.zeros_like(first)
    load_positions = places_of(scene.loads, (angles, *others))  # one call for all poses
    poses = [
        Pose(q, v, (RotorPose((angle, *others), 0.0, [x[k] if x.ndim > 1 else x for x in load_positions]),))
        for k, (q, v, angle) in enumerate(zip(displacement, velocity, angles, strict=True))
    ]
    forces = [view.support_forces(pose) for pose in poses]
    totals = [np.array([force[:, 1].sum()]) for force in forces]
    largest_force = max(float(np.max(np.abs(np.concatenate([np.ravel(x) for x in (*forces, *totals)])))), 1e-300)
    magnified = view.magnified(displacement)
    reach = magnified * view.scale
    frames = [
        [*view.parts(p, reach), *view.arrows(p, total, 0.7 / largest_force)] for p, total in zip(poses, totals, strict=True)
    ]
    slower = _PERIOD_SECONDS * omega / (2.0 * np.pi)
    head = (
        f"{caption(scene)}\njam mode {int(jam.mode)}, {jam.judgement}: slowed down {slower:.3g} x, displacements drawn "
        f"{magnified:.3g} x as large\n{ARROWS_NOTE}, longest {largest_force:.4g} N"
    )
    return svg(
        view.limits, frames, [view.texts(pose, reach) for pose in poses], head, _PERIOD_SECONDS, float(jam.rotor_speed) / omega
    )


def sketch_svg(scene: Scene) -> str:
    """Return the sketch of a scene at rest as the text of an SVG file; this is much faster than `jaxvib.sketch`.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> "M = " in sketch_svg(jv.scene_from_toml(TEMPLATES["planar_rotor"]))
    True
    """
    view, pose = view_of(drawable_scene(scene)), at_rest(scene)
    return svg(view.limits, [view.parts(pose, 0.0)], [view.texts(pose, 0.0)], caption(scene), _PERIOD_SECONDS, 0.0)
