"""Rotor with its loads, seen along its axis, and numbers in the units of a drawing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.draw.machine.parts import Part, circle
from jaxvib.draw.style import COLORS, GUIDE
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene

__all__ = ["Pose", "Wheel", "at_rest", "caption", "places_of", "shown"]


class Pose(NamedTuple):
    """Positions of all parts at an instant.

    **Attributes**: `displacement` (nd,) m and `velocity` (nd,) m/s, for tilts rad and rad/s; `angle`, the loads' coordinates,
    (count,) each; `turn`, the angle of the rotor, rad; `own`, the loads' positions relative to its centre, (count,) each, or
    None if they have not been computed yet.
    """

    displacement: np.ndarray
    velocity: np.ndarray
    angle: tuple[np.ndarray, ...]
    turn: float
    own: Sequence[np.ndarray] | None = None


_UNITS = {
    "kg": (("kg", 1.0), ("g", 1e3)),
    "m": (("mm", 1e3),),
    "N/m": (("N/mm", 1e-3), ("N/m", 1.0)),
    "N s/m": (("N s/m", 1.0),),
    "kg m²": (("kg m²", 1.0), ("kg cm²", 1e4)),
}


def shown(value: float, unit: str) -> str:
    """Return a number with its unit as a drawing shows it.

    >>> shown(5e4, "N/m"), shown(0.12, "m"), shown(0.05, "kg")
    ('50 N/mm', '120 mm', '50 g')
    """
    choices = _UNITS[unit]
    name, factor = next((choice for choice in choices if abs(value) * choice[1] >= 1.0), choices[-1])
    return f"{value * factor:.4g} {name}"


def _span(values: np.ndarray, unit: str) -> str:
    """Return the common value of several numbers, or their range."""
    low, high = float(np.min(values)), float(np.max(values))
    return shown(low, unit) if high - low <= 1e-12 * abs(high) else f"{shown(low, unit)} to {shown(high, unit)}"


def places_of(loads: Loads, angle: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the loads' positions relative to the rotor's centre, m: across, up, and along the axis if they move along it."""
    return [np.asarray(x, float) for x in loads.position(*map(jnp.asarray, angle))]


def track_radius(loads: Loads) -> float:
    """Return the distance of the loads from the axis at rest, m."""
    return float(jnp.max(loads.arm()))


def at_rest(scene: Scene) -> Pose:
    """Return the pose of a sketch: no displacement, and loads spread evenly so that each is visible."""
    first, *others = (np.asarray(u, float) for u in scene.loads.rest())
    spread = first + 2.0 * np.pi * np.arange(scene.loads.count) / scene.loads.count + np.pi * 5.0 / 6.0
    zero = np.zeros(len(scene.machine.structure().coordinates))
    return Pose(zero, zero, (spread, *others), 0.0)


def caption(scene: Scene) -> str:
    """Return a short description of loads, drive and effects for the title of a sketch."""
    loads, drive = scene.loads, scene.drive
    each = " each" if loads.count > 1 else ""
    named = loads.kind.replace("_", " ") + ("s" if loads.count > 1 else "")
    words = [f"{loads.count} {named}, m = {_span(np.asarray(loads.mass), 'kg')}{each}"]
    words += [f"R = {shown(track_radius(loads), 'm')}"]
    drag = getattr(loads, "drag", None)
    if drag is not None:
        words.append(f"drag {_span(np.asarray(drag), 'N s/m')}")
    speed = float(drive.speed)
    lines = [", ".join(words), f"{drive.kind.replace('_', ' ')}: {30.0 / np.pi * speed:.5g} rpm ({speed:.5g} rad/s)"]
    if scene.all_effects:
        lines.append("with " + ", ".join(effect.kind.replace("_", " ") for effect in scene.all_effects))
    return "\n".join(lines)


class Wheel:
    """Rotor of a scene with its loads, seen along its axis; `radius` of the loads' circle in the drawing."""

    def __init__(self, scene: Scene, radius: float):
        self.loads, self.radius = scene.loads, radius
        self.scale = radius / track_radius(scene.loads)
        own = getattr(scene.loads, "ball_radius", None)
        self.size = 0.12 * radius / 0.7 if own is None else max(float(own) * self.scale, 0.05)
        self.rim = radius + max(1.15 * self.size, 0.1)

    def places(self, pose: Pose) -> list[np.ndarray]:
        """Return the loads' positions relative to the axis in the drawing: across, up, and along if they move along it."""
        own = places_of(self.loads, pose.angle) if pose.own is None else pose.own
        return [self.scale * np.broadcast_to(x, (self.loads.count,)) for x in own]

    def parts(self, centre: tuple[float, float], pose: Pose) -> list[Part]:
        """Return the rim, the loads' circle, two spokes that turn with the rotor, and the loads."""
        x, y = centre
        found = [
            Part(circle(centre, self.rim), {"fc": "#f4f4f4", "ec": "black", "lw": 1.4, "zorder": 3}, True),
            Part(circle(centre, self.radius), {"color": GUIDE, "lw": 0.7, "ls": ":", "zorder": 3.1}),
        ]
        for turn in (pose.turn, pose.turn + 0.5 * np.pi):
            e = np.array([np.cos(turn), np.sin(turn)])
            look = {"color": "#9a9a9a", "lw": 1.0, "zorder": 3.2}
            found.append(Part(np.array([centre - self.rim * e, centre + self.rim * e]), look, axis=centre))
        mark = circle(tuple(centre + 0.82 * self.rim * np.array([np.cos(pose.turn), np.sin(pose.turn)])), 0.05)
        found.append(Part(mark, {"fc": "#9a9a9a", "ec": "none", "zorder": 3.2}, True, centre))
        across, up, *_ = self.places(pose)
        for j in range(self.loads.count):
            color = COLORS[j % len(COLORS)]
            place = (x + float(across[j]), y + float(up[j]))
            if self.loads.has_bearing:
                found.append(Part(np.array([centre, place]), {"color": color, "lw": 2.0, "zorder": 3.4}))
            look = {"fc": color, "ec": "black", "lw": 0.8, "zorder": 3.5 + 0.001 * j}
            found.append(Part(circle(place, self.size, 31), look, True))
        found.append(Part(circle(centre, 0.04, 13), {"fc": "black", "ec": "none", "zorder": 3.6}, True))
        return found
