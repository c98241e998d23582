"""Animations of a moving machine: platforms, springs, rotor, loads, forces on the foundation."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from jaxvib.boundary import validated
from jaxvib.draw.charts import scaled_amplitudes
from jaxvib.draw.machine.animation import Animation
from jaxvib.draw.machine.parts import Part, draw_part
from jaxvib.draw.motion.histories import period_of
from jaxvib.draw.style import COLORS, GUIDE, STROKES, legend_above, panels, series_look
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.run import Run
from jaxvib.show.sketch import drawable_scene, set_drawing_limits
from jaxvib.show.view import ARROWS_NOTE
from jaxvib.show.views import view_of
from jaxvib.show.wheel import Pose, RotorPose
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.units import Number, number

_MAX_TURNS_PER_FRAME = 0.42
"""Largest rotation between two frames, turns. Near half a turn, a rotor seems to turn at another speed or backward."""

_TURNS_PER_FRAME = 0.09
"""Default rotation between frames, turns of the rotor."""

_MAX_FRAMES = 600
"""Maximum number of frames of an animation."""

_MIN_WIDTH, _MAX_WIDTH = 1.0, 50.0
"""Range of the width of a frame, inches."""

_MAX_DRAWN_HEIGHTS = 100.0
"""Largest drawn displacement of the machine, in heights of the frame."""


@validated
def animate(
    motion: Run | Orbit,
    path: str | Path | None = None,
    *,
    scene: Scene | None = None,
    begin: Number | None = None,
    end: Number | None = None,
    seconds: Number | None = None,
    fps: int = 20,
    magnify: float | None = None,
    width: float = 6.4,
) -> Animation:
    """Return an animation of a run or of an exact jam in slow motion, with a clock.

    Platforms, springs, rotor and loads move. Arrows show the forces of the supports on the foundation (black: total force on
    the foundation). The displacements and the force are plotted over time below the machine.

    **Arguments**

    - `motion`: a `Run`, or an `Orbit` together with its `scene`
    - `path` of the file: a GIF (".gif") or one HTML page with embedded frames (".html"); None writes no file
    - `begin`, `end`: first and last time that is shown, s or text; default: the last four periods of the vibration of a run, or
      four periods of an orbit
    - `seconds`: duration of the animation; at most 600 frames are possible; typical: 5 to 10; default: a duration with which
      the rotor turns by about a tenth of a turn between frames
    - `fps`: frames per second, 1 to 50; typical: 20 (the default). Drawing takes most of the computing time, in proportion to
      the number of frames, `seconds` times `fps`
    - `magnify`: magnification of displacements relative to the circle of the loads; a note in the frame states it; typical: 1
      to 50; default: a factor with which the largest displacement is clearly visible
    - `width` of the frame, 1 to 50 inches (100 pixels each); typical: 6.4 (the default)

    **Returns** a matplotlib animation, whose `save` writes further files. Repeated calls give identical files.

    **Raises** `InputError` for

    - a part of the run that is not stored, or that has too few samples
    - an animation in which loads or rotor would turn by nearly half a turn from one frame to the next
    - an animation of more than 600 frames, and values of `fps`, `width` and `magnify` that are not possible
    - an orbit without its scene
    - a path whose ending is not that of a GIF or HTML file, or that cannot be written to

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
    >>> animation = jv.animate(jv.jam_orbit(scene, mode=1), scene=scene)
    >>> animation.count, animation.figure.axes[2].get_xlabel()
    (98, 'time, s')
    """
    owner = drawable_scene(_scene_of(motion, scene))
    if path is not None and Path(path).suffix.lower() not in (".gif", ".html", ".htm"):
        raise InputError("path", f"is {quoted(str(path))}; an animation must be a .gif or .html file")
    if isinstance(fps, bool) or not isinstance(fps, int) or not 1 <= fps <= 50:
        raise InputError("fps", f"is {quoted(fps)}; it must be a whole number of frames per second, 1 to 50")
    first, last = _time_range(motion, begin, end)
    speed = _highest_speed(motion, owner, first, last)
    turns = speed * (last - first) / (2.0 * np.pi)
    duration = None if seconds is None else float(number(seconds, "s", "seconds", low=0.0, open_low=True))
    if duration is not None and round(duration * fps) > _MAX_FRAMES:
        problem = f"is {duration:g} s, which makes {duration * fps:.0f} frames; at most {_MAX_FRAMES} are possible"
        raise InputError("seconds", f"{problem}; give at most {_MAX_FRAMES / fps:g} s, or a lower fps")
    frames = int(np.ceil(turns / _TURNS_PER_FRAME)) if duration is None else duration * fps
    count = round(float(np.clip(frames, 2, _MAX_FRAMES)))
    if turns / count > _MAX_TURNS_PER_FRAME:
        latest_end = first + _MAX_TURNS_PER_FRAME * 2.0 * np.pi * count / speed
        problem = (
            f"lets rotor or loads turn by {turns / count:.3g} turns from one frame to the next, which looks like another speed"
        )
        more = "" if count == _MAX_FRAMES else ", or make the animation longer"
        raise InputError("end", f"{problem}; end at {latest_end:.4g} s or before{more}")
    # An orbit is periodic; the frame after the last frame would be the first frame.
    time = first + (last - first) * np.arange(count) / (count if isinstance(motion, Orbit) else count - 1)
    dense = np.linspace(time[0], time[-1], max(400, count))
    shown_motion, history = (
        motion_of_run(motion, times) if isinstance(motion, Run) else motion_of_orbit(motion, owner, times)
        for times in (time, dense)
    )
    animation = _animation(owner, shown_motion, history, float(fps), magnify, width)
    if path is not None:
        animation.save(path)
    return animation


def _scene_of(motion: Run | Orbit, scene: Scene | None) -> Scene:
    if isinstance(motion, Run):
        if scene is not None:
            raise InputError("scene", "is only for an Orbit, because a run contains its scene; leave it out")
        return motion.scene
    if scene is None:
        raise InputError("scene", "is missing; an Orbit does not contain it: animate(orbit, scene=scene)")
    return scene


def _time_range(motion: Run | Orbit, begin: Number | None, end: Number | None) -> tuple[float, float]:
    """Return the beginning and the end of the animation, s."""
    if isinstance(motion, Run):
        window = motion.window
        last = float(window.time[-1])
        period = period_of(np.asarray(window.time), np.asarray(window.state.displacement))
        ends = (max(last - 4.0 * period, float(window.time[0])), last)
    else:
        ends = (0.0, 8.0 * np.pi / float(motion.omega) if np.isfinite(motion.omega) else 1.0)
    requested = [None if x is None else float(number(x, "s", name, low=0.0)) for x, name in ((begin, "begin"), (end, "end"))]
    first, last = (default if x is None else x for x, default in zip(requested, ends, strict=True))
    if not first < last:
        raise InputError("end", f"is {last:.6g} s; it must be after the beginning, {first:.6g} s")
    return first, last


def _highest_speed(motion: Run | Orbit, scene: Scene, first: float, last: float) -> float:
    """Return the highest speed of rotor and loads from the time `first` to `last`, s, in rad/s."""
    if isinstance(motion, Run):
        stored = _stored_states(motion, np.array([first, last]))
        begin, end = np.searchsorted(np.asarray(stored.time, float), [first, last])
        shown = slice(max(begin - 1, 0), end + 1)
        speeds = [*stored.rotor_speeds, *(state.rate[0] for state in stored.state.exciters if state.rate)]
        return max(float(np.max(np.abs(np.asarray(speed)[shown]), initial=1e-300)) for speed in speeds)
    return float(max(motion.rotor_speed, motion.omega)) if np.isfinite(motion.rotor_speed) else float(scene.drive.speed)


def _animation(
    scene: Scene, shown_motion: SampledMotion, history: SampledMotion, fps: float, magnify: float | None, width: float
) -> Animation:
    if not _MIN_WIDTH <= width <= _MAX_WIDTH:
        raise InputError("width", f"is {width:g} inches; it must be from {_MIN_WIDTH:g} to {_MAX_WIDTH:g}")
    view = view_of(scene)
    left, right, bottom, top = view.limits
    tall = width * (top - bottom) / (right - left)
    figure, (stage, lower, lowest) = panels(3, size=(width, (0.8 * tall + 2.9) / 3.0))
    grid = stage.get_gridspec()
    assert grid is not None
    grid.set_height_ratios([0.8 * tall + 0.3, 1.3, 1.3])
    figure.set_dpi(100.0)
    set_drawing_limits(stage, view.limits)
    magnify_given = None if magnify is None else float(number(magnify, "", "magnify", low=0.0, open_low=True))
    magnification = view.magnification(shown_motion.displacement) if magnify_given is None else magnify_given
    reach = magnification * view.scale
    farthest = float(np.max(np.abs(shown_motion.displacement), initial=0.0)) * view.scale
    if magnification * farthest > (max_shift := _MAX_DRAWN_HEIGHTS * (top - bottom)):
        raise InputError(
            "magnify", f"is {magnification:g}, which moves the machine out of the figure; at most {max_shift / farthest:.3g}"
        )
    poses = list(map(shown_motion.pose, range(shown_motion.time.size)))
    forces = np.array([view.support_forces(pose) for pose in poses])
    largest_force = max(float(np.max(np.abs(forces), initial=0.0)), float(np.max(np.abs(shown_motion.force))), 1e-300)
    per_newton = 0.7 / largest_force

    def parts(k: int) -> list[Part]:
        return [*view.parts(poses[k], reach), *view.arrows(poses[k], shown_motion.force[k], per_newton)]

    artists = [draw_part(stage, part) for part in parts(0)]
    clock = stage.set_title("t", loc="left", family="monospace", fontsize="medium")
    slower = (shown_motion.time.size / fps) / (shown_motion.time[-1] - shown_motion.time[0])
    note = f"slowed down {slower:.3g} x, displacements drawn {magnification:.3g} x as large\n{ARROWS_NOTE}"
    stage.text(1.0, 0.0, note, transform=stage.transAxes, ha="right", va="top", fontsize="x-small", color="#555555")
    # Texts that are wider than the frame must not reduce the size of the drawing.
    for text in stage.texts:
        text.set_in_layout(False)
    cursors = _plot_histories((lower, lowest), scene, history)
    directions = scene.machine.structure().foundation_directions
    directions = directions if len(directions) > 1 else ("foundation force",)
    heading = "    " if len(directions) == 1 else "  force "  # both components fit above the frame

    def update(k: int) -> None:
        for artist, part in zip(artists, parts(k), strict=True):
            _move_artist(artist, part.points)
        total = ", ".join(f"{name}{force:7.0f} N" for name, force in zip(directions, shown_motion.force[k], strict=True))
        clock.set_text(f"t = {shown_motion.time[k]:7.3f} s{heading}{total}")
        for cursor in cursors:
            cursor.set_xdata([shown_motion.time[k]] * 2)

    update(0)
    moving: list[Artist] = [*artists, clock, *cursors]
    return Animation(figure, update, moving, shown_motion.time.size, fps)


def _move_artist(artist: Line2D | Polygon, points: np.ndarray) -> None:
    if isinstance(artist, Line2D):
        artist.set_data(points[:, 0], points[:, 1])
    else:
        artist.set_xy(points)


def _plot_histories(axes: tuple[Axes, Axes], scene: Scene, history: SampledMotion) -> list[Line2D]:
    """Plot displacements and force over time, and return the time cursor of each plot."""
    upper, lower = axes
    structure = scene.machine.structure()
    units, scaled = scaled_amplitudes(history.displacement, structure.coordinates, structure.units)
    for k, ((name, values), unit) in enumerate(zip(scaled, units, strict=True)):
        label = name if len(set(units)) == 1 else f"{name} ({unit})"
        upper.plot(history.time, values, label=label, **{**series_look(k), "lw": 1.2})
    upper.set_ylabel(", ".join(dict.fromkeys(units)))
    legend_above(upper, 6)
    for k, name in enumerate(structure.foundation_directions):
        look = {"color": "black" if k else COLORS[1], "ls": STROKES[k], "lw": 1.2}
        lower.plot(history.time, history.force[:, k], label=f"foundation force, {name}", **look)
    lower.set(ylabel="N", xlabel="time, s")
    legend_above(lower)
    for axis in (upper, lower):
        axis.set_xlim(history.time[0], history.time[-1])
    return [axis.axvline(history.time[0], color=GUIDE, lw=1.2) for axis in (upper, lower)]


_MAX_ANGLE_BETWEEN_SAMPLES = 1.2
"""Largest rotation of a load between two samples of a run, rad, at which interpolation is accurate enough."""


class SampledMotion(NamedTuple):
    """Motion of a machine at the times of an animation.

    **Attributes**: `time` (nt,), s; `displacement` (nt, nd), m, and `velocity` (nt, nd), m/s (tilts: rad, rad/s); `rotors`: a
    `RotorPose` for each exciter, whose arrays have a leading axis over the times; `force` on the foundation (nt, directions),
    N.
    """

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    rotors: tuple[RotorPose, ...]
    force: np.ndarray

    def pose(self, k: int) -> Pose:
        """Return the pose at time `k`."""
        return Pose(self.displacement[k], self.velocity[k], jax.tree.map(lambda x: x[k], self.rotors))


def motion_of_run(run: Run, time: np.ndarray) -> SampledMotion:
    """Return a run at these times, by cubic Hermite interpolation between the stored states.

    Velocities and forces are interpolated linearly. **Raises** `InputError` for times outside the stored states, and for states
    that are too far apart.
    """
    stored = _stored_states(run, time)
    t = np.asarray(stored.time, float)
    k = np.clip(np.searchsorted(t, time, side="right") - 1, 0, t.size - 2)
    h = t[k + 1] - t[k]
    share = (time - t[k]) / h
    state = stored.state
    used_states = np.unique(np.concatenate([k, k + 1]))
    speeds = [
        state_of_exciter.rate[0] if state_of_exciter.rate else rotor
        for state_of_exciter, rotor in zip(state.exciters, stored.rotor_speeds, strict=True)
    ]
    rate = max(float(np.max(np.abs(np.asarray(speed_history)[used_states]), initial=0.0)) for speed_history in speeds)
    if rate * np.max(h) > _MAX_ANGLE_BETWEEN_SAMPLES:
        needed_samples = int(np.ceil(t.size * rate * np.max(h) / _MAX_ANGLE_BETWEEN_SAMPLES))
        problem = f"has {t.size} samples, between which loads turn by up to {rate * np.max(h):.3g} rad"
        raise InputError("run", f"{problem}; simulate with samples={needed_samples}, or animate the last turns only")

    def cubic(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
        s, step = (x.reshape(-1, *[1] * (value.ndim - 1)) for x in (share, h))
        a, b = value[k], value[k + 1]
        da, db = step * slope[k], step * slope[k + 1]
        return a + s * (da + s * (3.0 * (b - a) - 2.0 * da - db + s * (2.0 * (a - b) + da + db)))

    def arrays(parts: object) -> list[np.ndarray]:
        return [np.asarray(leaf, float) for leaf in jax.tree.leaves(parts)]

    q, v = np.asarray(state.displacement, float), np.asarray(state.velocity, float)
    rotors = []
    for state_of_exciter, *rotor in zip(state.exciters, stored.rotor_angles, stored.rotor_speeds, strict=True):
        angle = [
            cubic(_continuous_angle(u, w, t), w)
            for u, w in zip(arrays(state_of_exciter.angle), arrays(state_of_exciter.rate), strict=True)
        ]
        turn, speed = arrays(rotor)
        rotors.append(RotorPose(tuple(angle), cubic(_continuous_angle(turn, speed, t), speed)))
    force = np.asarray(stored.foundation_force, float)
    force_at_times = (1.0 - share)[:, None] * force[k] + share[:, None] * force[k + 1]
    velocity = (1.0 - share)[:, None] * v[k] + share[:, None] * v[k + 1]
    return SampledMotion(time, cubic(q, v), velocity, tuple(rotors), force_at_times)


def _stored_states(run: Run, time: np.ndarray) -> Trajectory:
    """Return stored states of a run that include these times: the window if it includes them, otherwise the trajectory.

    **Raises** `InputError` if neither includes them.
    """
    slack = 1e-9 * max(float(run.window.time[-1]), 1e-300)
    available = [run.window, *([] if run.trajectory is None else [run.trajectory])]
    for states in available:
        if float(states.time[0]) - slack <= time[0] and time[-1] <= float(states.time[-1]) + slack:
            return states
    first, last = float(available[-1].time[0]), float(available[-1].time[-1])
    problem = f"selects {time[0]:.6g} to {time[-1]:.6g} s; the run keeps {first:.6g} to {last:.6g} s"
    raise InputError("begin", problem + ("" if run.trajectory is not None else " (simulate with save='all' for the rest)"))


def _continuous_angle(angle: np.ndarray, rate: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return continuous angles (nt, ...) from angles modulo 2 pi; the rates determine the number of whole turns."""
    step = np.diff(time).reshape(-1, *[1] * (angle.ndim - 1))
    predicted = 0.5 * step * (rate[1:] + rate[:-1])
    change = np.diff(angle, axis=0)
    change = change + 2.0 * np.pi * np.round((predicted - change) / (2.0 * np.pi))
    return np.concatenate([angle[:1], angle[:1] + np.cumsum(change, axis=0)])


def motion_of_orbit(orbit: Orbit, scene: Scene, time: np.ndarray) -> SampledMotion:
    """Return an exact jam of a `scene` at these times, from its Fourier series.

    **Raises** `InputError` for a jam that does not exist, or a scene with other coordinates or loads.
    """
    omega = float(orbit.omega)
    if not np.isfinite(omega) or not np.isfinite(np.asarray(orbit.amplitude)).all():
        raise InputError("orbit", f"is not a motion that can be shown: {orbit.message}")
    if len(orbit.units) != len(scene.machine.structure().coordinates) or orbit.offsets.shape != (scene.loads.count,):
        raise InputError("scene", "is not the scene of the orbit: it has other coordinates or loads")
    theta = omega * time
    q, v, (phi,), _ = jax.vmap(orbit.at)(jnp.asarray(theta))
    wave = np.exp(1j * np.asarray(orbit.orders)[:, None] * theta)
    force = np.real(np.asarray(orbit.force_harmonics) @ wave).T
    rotor = RotorPose((np.asarray(phi),), float(orbit.rotor_speed) * time)
    return SampledMotion(time, np.asarray(q), np.asarray(v), (rotor,), force)
