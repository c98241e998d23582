"""SVG figures of a machine: at rest, or moving in a jam of light loads or in a synchronous regime."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from jaxvib.display import speed_text
from jaxvib.draw.machine.deck import ellipses as draw_ellipses
from jaxvib.draw.machine.parts import Part, circle
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, Look
from jaxvib.equations.torque_balance import mass_owners
from jaxvib.errors import ComputationError
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.show.sketch import drawable_scene
from jaxvib.show.view import ARROWS_NOTE, View
from jaxvib.show.views import view_of
from jaxvib.show.wheel import Pose, RotorPose, at_rest, caption, places_of
from jaxvib.steady.jams.jam import Jam
from jaxvib.steady.regimes.synchronous import SynchronousRegime

_FRAMES_PER_PERIOD = 20
"""Number of frames in a period. Browsers interpolate linearly between them; circular paths are accurate to about 1 %."""

_PERIOD_SECONDS = 1.6
"""Duration of a period of the vibration in the figure, s."""

_THETA = 2.0 * np.pi * np.arange(_FRAMES_PER_PERIOD) / _FRAMES_PER_PERIOD
"""Phase of each frame, rad."""

_PATH: Look = {"color": COLORS[1], "lw": 1.4, "zorder": 4.0}
_POINT: Look = {"fc": COLORS[1], "ec": "none", "zorder": 4.1}
"""Styles of the path of a point, and of the point."""


def moving_svg(scene: Scene, jam: Jam) -> str:
    """Return the sketch of a scene that moves in a jam mode, with the forces on the foundation as arrows.

    The rotor turns faster than the loads. Coincident loads are drawn at the same place.

    **Arguments**: `scene` of platforms, and a `jam` of it, from `jam_modes`.

    **Returns** the text of an SVG file, which repeats one period endlessly. **Raises** `ComputationError` for a jam mode that
    does not exist or whose motion is not finite; the message names the mode.
    """
    scene = jax.device_get(drawable_scene(scene))  # see `regime_svg`
    view = view_of(scene)
    if not np.isfinite(jam.omega) or not np.isfinite(jam.displacement).all():
        raise ComputationError("absent", f"jam mode {int(jam.mode)} cannot be shown: {jam.message}")
    rotors = [(pose,) for pose in _rotor_poses(scene.exciters[0], np.zeros(scene.loads.count))]
    words = f"jam mode {int(jam.mode)}"
    return _moving(view, words, float(jam.omega), np.asarray(jam.displacement), rotors, float(jam.rotor_speed / jam.omega))


def regime_svg(scene: Scene, regime: SynchronousRegime, points: Sequence[tuple[float, float]] = ()) -> str:
    """Return the sketch of a scene that moves in a synchronous regime, with the forces on the foundation as arrows.

    The paths (ellipses) of the `points` of the body are drawn, too. If an exciter has an unbalance, the rotors are drawn with
    one turn per period of the vibration. If all exciters have loads, the number of turns per period is the rotor speed divided
    by the load speed in the first exciter.

    **Arguments**: `scene`, whose exciters have an unbalance or loads; a `regime` of it; `points` (x, y) of a body in a plane,
    m.

    **Returns** the text of an SVG file, which repeats one period endlessly. **Raises** `InputError` for a machine that cannot
    be drawn.
    """
    scene = jax.device_get(drawable_scene(scene))  # the drawing computes with single numbers, for which JAX arrays are slow
    view = view_of(scene)
    rotors = [*zip(*(_rotor_poses(scene.exciters[k], phases) for k, phases in _phases_of(scene, regime)), strict=True)]
    first = scene.exciters[0]
    has_unbalance = any(exciter.loads is None for exciter in scene.exciters)
    turns = 1.0 if has_unbalance else float(first.drive.speed / regime.speed)
    words = f"{'stable' if bool(regime.stable) else 'unstable'} regime, {speed_text(regime.speed)}"
    decks = [regime.deck(points)] if points else []
    ellipses = [(np.asarray(deck.points), np.asarray(deck.amplitude)) for deck in decks]
    return _moving(view, words, float(regime.speed), np.asarray(regime.displacement), rotors, turns, ellipses)


def _phases_of(scene: Scene, regime: SynchronousRegime) -> list[tuple[int, np.ndarray]]:
    """Return the number of each exciter with the phases of its masses, rad."""
    owners, phases = mass_owners(scene), np.asarray(regime.phases)
    return [(k, phases[owners == k]) for k in range(len(scene.exciters))]


def _rotor_poses(exciter: Exciter, phases: np.ndarray) -> list[RotorPose]:
    """Return the rotor of an exciter in each frame, with its loads or its unbalance at the `phases` (mass,), rad."""
    if exciter.loads is None:
        return [RotorPose((), exciter.direction * float(phases[0]))] * _FRAMES_PER_PERIOD
    _, *others = (np.asarray(u, float) for u in exciter.loads.rest())
    angles = exciter.direction * (_THETA[:, None] + phases)
    positions = places_of(exciter.loads, (angles, *others))  # one call for all poses
    return [RotorPose((angle, *others), 0.0, [x[k] if x.ndim > 1 else x for x in positions]) for k, angle in enumerate(angles)]


def _moving(
    view: View,
    words: str,
    omega: float,
    amplitude: np.ndarray,
    rotors: Sequence[tuple[RotorPose, ...]],
    turns: float,
    ellipses: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> str:
    """Return the drawing of one period of the motion Re(amplitude exp(i omega t)).

    **Arguments**: `words`: description of the motion; `rotors`: the rotors in each frame; `turns` of the rotors in a period;
    `ellipses`: points (n, 2), m, with their complex amplitudes (n, 2), m, whose paths are drawn.
    """
    wave = np.exp(1j * _THETA)[:, None] * amplitude
    displacement, velocity = np.real(wave), np.real(1j * omega * wave)
    poses = [Pose(*each) for each in zip(displacement, velocity, rotors, strict=True)]
    totals = displacement @ view.foundation_stiffness.T + velocity @ view.foundation_damping.T
    forces = [view.support_forces(pose) for pose in poses]
    largest_force = max(float(np.max(np.abs(np.concatenate([np.ravel(x) for x in (*forces, *totals)])))), 1e-300)
    magnification = view.magnification(displacement)
    reach = magnification * view.scale
    frames = [
        [*view.parts(pose, reach), *view.arrows(pose, total, 0.7 / largest_force)]
        for pose, total in zip(poses, totals, strict=True)
    ]
    for points, amplitudes in ellipses:
        paths = [Part(view.scale * path, _PATH) for path in draw_ellipses(points, amplitudes, magnification)]
        for frame, turn in zip(frames, np.exp(1j * _THETA), strict=True):
            places = view.scale * points + reach * np.real(turn * amplitudes)
            frame += [*paths, *(Part(circle(tuple(at.tolist()), 0.06, 13), _POINT, True) for at in places)]
    slower = _PERIOD_SECONDS * omega / (2.0 * np.pi)
    head = (
        f"{caption(view.scene)}\n{words}: slowed down {slower:.3g} x, displacements drawn {magnification:.3g} x as large\n"
        f"{ARROWS_NOTE}, longest {largest_force:.4g} N"
    )
    return svg(view.limits, frames, [view.texts(pose, reach) for pose in poses], head, _PERIOD_SECONDS, turns)


def sketch_svg(scene: Scene) -> str:
    """Return the sketch of a scene at rest as the text of an SVG file; this is much faster than `jaxvib.sketch`.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> "M = " in sketch_svg(jv.scene_from_toml(TEMPLATES["planar_rotor"]))
    True
    """
    scene = jax.device_get(drawable_scene(scene))  # see `regime_svg`
    view, pose = view_of(scene), at_rest(scene)
    return svg(view.limits, [view.parts(pose, 0.0)], [view.texts(pose, 0.0)], caption(scene), _PERIOD_SECONDS, 0.0)
