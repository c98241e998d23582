"""Drawing of a rotor with its loads, seen along its axis, and texts with the values of a machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.display import shown_unit, speed_text
from jaxvib.draw.machine.parts import Part, Text, circle, sector, turning_arrow
from jaxvib.draw.style import COLORS, GUIDE, Look, color_of
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import number_specs
from jaxvib.machine.scene import Exciter, Scene

_TURN_STYLE: Look = {"color": COLORS[1], "zorder": 3.7}


class RotorPose(NamedTuple):
    """Positions of a rotor and its loads at an instant.

    **Attributes**: `angle`: arrays (count,) with the angles of the loads, rad, and with further coordinates of the loads, if
    any; `turn`: the angle of the rotor, rad; `positions`: arrays (count,) with the positions of the loads relative to the
    centre of the rotor, m, one for each direction, or None if they are not computed yet.
    """

    angle: tuple[np.ndarray, ...]
    turn: np.ndarray | float
    positions: Sequence[np.ndarray] | None = None


class Pose(NamedTuple):
    """Positions of all parts at an instant.

    **Attributes**: `displacement` (nd,), m, and `velocity` (nd,), m/s (tilts: rad, rad/s); `rotors`: a `RotorPose` for each
    exciter.
    """

    displacement: np.ndarray
    velocity: np.ndarray
    rotors: tuple[RotorPose, ...]


_UNITS = {
    "kg": (("kg", 1.0), ("g", 1e3)),
    "m": (("mm", 1e3),),
    "N/m": (("N/mm", 1e-3), ("N/m", 1.0)),
    "N s/m": (("N s/m", 1.0),),
    "kg m": (("kg m", 1.0), ("g m", 1e3)),
    "kg m²": (("kg m²", 1.0), ("kg cm²", 1e4)),
}


def value_text(value: float, unit: str) -> str:
    """Return an SI value as text with the unit that drawings use.

    >>> value_text(5e4, "N/m"), value_text(0.12, "m"), value_text(0.05, "kg"), value_text(1.6e4, "kg m²")
    ('50 N/mm', '120 mm', '50 g', '16000 kg m²')
    """
    is_si = shown_unit("N/m", 1e3)[0] == "N/m"  # see `display_units`
    choices = ((unit, 1.0),) if is_si else _UNITS[unit]
    name, factor = next((choice for choice in choices if abs(value) * choice[1] >= 1.0), choices[-1])
    return f"{float(f'{value * factor:.4g}'):g} {name}"  # four digits, without an exponent below a million


def _span(values: np.ndarray, unit: str) -> str:
    """Return the common value of several numbers, or their range, as text."""
    low, high = float(np.min(values)), float(np.max(values))
    return value_text(low, unit) if high - low <= 1e-12 * abs(high) else f"{value_text(low, unit)} to {value_text(high, unit)}"


def places_of(loads: Loads, angle: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the loads' positions relative to the rotor's centre, m: horizontal, vertical, and along the axis for loads that
    move along it."""
    return [np.asarray(x, float) for x in loads.position(*map(jnp.asarray, angle))]


def track_radius(loads: Loads) -> float:
    """Return the distance of the loads from the axis at rest, m."""
    return float(jnp.max(loads.arm()))


def at_rest(scene: Scene) -> Pose:
    """Return the pose of a sketch: no displacement, and loads spread evenly so that each is visible."""
    zero = np.zeros(len(scene.machine.structure().coordinates))
    return Pose(zero, zero, tuple(RotorPose(_evenly_spread(exciter.loads), 0.0) for exciter in scene.exciters))


def _evenly_spread(loads: Loads | None) -> tuple[np.ndarray, ...]:
    if loads is None:
        return ()
    first, *others = (np.asarray(u, float) for u in loads.rest())
    return (first + 2.0 * np.pi * np.arange(loads.count) / loads.count + np.pi * 5.0 / 6.0, *others)


def caption(scene: Scene) -> str:
    """Return a short description of loads, unbalances, drives and effects for the title of a sketch."""
    lines: dict[str, list[int]] = {}
    for k, exciter in enumerate(scene.exciters, 1):
        lines.setdefault("\n".join(_words_of(exciter)), []).append(k)
    if len(scene.exciters) == 1:
        lines_of_text = list(lines)
    else:
        lines_of_text = [
            f"exciter {', '.join(map(str, numbers_of_exciters))}: {line.replace(chr(10), ', ')}"
            for line, numbers_of_exciters in lines.items()
        ]
    if scene.all_effects:
        lines_of_text.append("with " + ", ".join(dict.fromkeys(map(_effect_words, scene.all_effects))))
    return "\n".join(lines_of_text)


def _effect_words(effect: Effect) -> str:
    """Return the name of an effect; for an imbalance of the rotor also its size."""
    words = effect.kind.replace("_", " ")
    spec = number_specs(type(effect)).get("moment")
    if spec is None or spec.units != ("kg m",):
        return words
    moment: Any = getattr(effect, "moment")  # noqa: B009, not every effect has it
    return f"{words} {value_text(float(moment), 'kg m')}"


def _words_of(exciter: Exciter) -> list[str]:
    """Return lines with the loads and the unbalance of an exciter, and with its drive."""
    loads, drive, words = exciter.loads, exciter.drive, []
    if exciter.unbalance is not None:
        words.append(f"unbalance {value_text(float(exciter.unbalance), 'kg m')}")
    if loads is not None:
        suffix = " each" if loads.count > 1 else ""
        named = loads.kind.replace("_", " ") + ("s" if loads.count > 1 else "")
        words += [f"{loads.count} {named}, m = {_span(np.asarray(loads.mass), 'kg')}{suffix}"]
        radius = getattr(loads, "radius", None)
        words += [f"R = {value_text(track_radius(loads), 'm') if radius is None else _span(np.asarray(radius), 'm')}"]
        drag = getattr(loads, "drag", None)
        if drag is not None:
            words.append(f"drag {_span(np.asarray(drag), 'N s/m')}")
    turning = ", clockwise" if exciter.direction == -1 else ""
    synchronous = " synchronous" if hasattr(drive, "breakdown_slip") else ""
    return [", ".join(words), f"{drive.kind.replace('_', ' ')}: {speed_text(drive.speed)}{synchronous}{turning}"]


class Wheel:
    """Rotor of an exciter with its loads and its unbalance, seen along its axis.

    **Attributes**: `radius` of the circle of the loads and `rim`, the radius of the rotor, in units of the drawing; `scale`:
    units of the drawing per metre.
    """

    def __init__(self, exciter: Exciter, radius: float):
        self.loads, self.radius, self.direction = exciter.loads, radius, exciter.direction
        self.unbalanced = exciter.unbalance is not None
        self.scale = radius / (0.1 if self.loads is None else track_radius(self.loads))
        ball_radius = getattr(self.loads, "ball_radius", None)
        self.size = 0.12 * radius / 0.7 if ball_radius is None else max(float(ball_radius) * self.scale, 0.05)
        self.rim = radius + max(1.15 * self.size, 0.1)

    def places(self, pose: RotorPose) -> list[np.ndarray]:
        """Return the loads' positions relative to the axis, in units of the drawing, see `places_of`."""
        assert self.loads is not None
        positions = places_of(self.loads, pose.angle) if pose.positions is None else pose.positions
        return [self.scale * np.broadcast_to(x, (self.loads.count,)) for x in positions]

    def parts(self, centre: tuple[float, float], pose: RotorPose) -> list[Part]:
        """Return the parts of the rotor (rim, circle of the loads, two spokes, and its unbalance or a mark), and the loads."""
        parts = [
            Part(circle(centre, self.rim), {"fc": "#f4f4f4", "ec": "black", "lw": 1.4, "zorder": 3}, True),
            Part(circle(centre, self.radius), {"color": GUIDE, "lw": 0.7, "ls": ":", "zorder": 3.1}),
        ]
        for turn in (pose.turn, pose.turn + 0.5 * np.pi):
            e = np.array([np.cos(turn), np.sin(turn)])
            look = {"color": "#9a9a9a", "lw": 1.0, "zorder": 3.2}
            spoke = np.array([centre - self.rim * e, centre + self.rim * e])
            parts.append(Part(spoke, look, axis=centre, direction=self.direction))
        if self.unbalanced:
            outline, look = sector(centre, 0.85 * self.rim, pose.turn), {"fc": "#555555", "ec": "black", "zorder": 3.3}
            parts.append(Part(outline, look, True, centre, self.direction))
        else:
            mark = circle(tuple(centre + 0.82 * self.rim * np.array([np.cos(pose.turn), np.sin(pose.turn)])), 0.05)
            parts.append(Part(mark, {"fc": "#9a9a9a", "ec": "none", "zorder": 3.2}, True, centre, self.direction))
        parts += self._load_parts(centre, pose)
        parts.append(Part(circle(centre, 0.04, 13), {"fc": "black", "ec": "none", "zorder": 3.6}, True))
        return parts

    def turning_parts(self, centre: tuple[float, float]) -> list[Part]:
        """Return an arrow above the rotor in its direction of rotation."""
        arc, head = turning_arrow(centre, self.rim + 0.13, self.direction)
        head_look = {"fc": _TURN_STYLE["color"], "ec": "none", "zorder": _TURN_STYLE["zorder"]}
        return [Part(arc, {**_TURN_STYLE, "lw": 1.6}), Part(head, head_look, True)]

    def _load_parts(self, centre: tuple[float, float], pose: RotorPose) -> list[Part]:
        if self.loads is None:
            return []
        (x, y), found = centre, []
        across, up, *_ = self.places(pose)
        for j in range(self.loads.count):
            color = color_of(j)
            place = (x + float(across[j]), y + float(up[j]))
            if self.loads.has_bearing:
                found.append(Part(np.array([centre, place]), {"color": color, "lw": 2.0, "zorder": 3.4}))
            look = {"fc": color, "ec": "black", "lw": 0.8, "zorder": 3.5 + 0.001 * j}
            found.append(Part(circle(place, self.size, 31), look, True))
        return found


def numbers_of(wheels: Sequence[Wheel], centres: Sequence[Sequence[float]]) -> list[Text]:
    """Return the numbers of several exciters, written below their rotors."""
    look: Look = {"fontsize": "x-small", "ha": "center", "va": "top"}
    return [
        Text(float(x), float(y) - wheel.rim - 0.05, str(k), look)
        for k, (wheel, (x, y)) in enumerate(zip(wheels, centres, strict=True), 1)
    ]
