"""Drawings of machines: platforms from the side, a rotor along its axis, a rotor with tilt in both views."""

from __future__ import annotations

import abc
import functools

import numpy as np

from jaxvib.draw.machine.parts import Part, Text, arrow, box, circle, damper, ground, spring
from jaxvib.draw.style import COLORS, GUIDE, Look
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.show.layout import Tie, lanes
from jaxvib.show.wheel import Pose, Wheel, places_of, shown

__all__ = ["View", "view_of"]

_INK: Look = {"color": "#333333", "lw": 1.2, "zorder": 2.0}
_BED: Look = {"color": "black", "lw": 1.4, "zorder": 1.0}
_BODY: Look = {"fc": "#c9d7e8", "ec": "black", "lw": 1.3, "zorder": 2.5}
_FORCE: Look = {"fc": COLORS[1], "ec": "none", "zorder": 5.0}


def _tie(
    start: tuple[float, float], end: tuple[float, float], stiffness: float, damping: float, length: float = 1.5
) -> list[Part]:
    """Return a spring and a damper side by side; one whose value is 0 is omitted. `length` is their length at rest."""
    both = stiffness > 0.0 and damping > 0.0
    off = 0.17 if both else 0.0
    side = np.array([start[1] - end[1], end[0] - start[0]]) / max(np.hypot(end[0] - start[0], end[1] - start[1]), 1e-9)
    a, b = np.asarray(start), np.asarray(end)
    found = []
    if stiffness > 0.0:
        found.append(Part(spring(tuple(a + off * side), tuple(b + off * side), coils=round(4.0 * length)), _INK))
    if damping > 0.0:
        found.append(Part(damper(tuple(a - off * side), tuple(b - off * side), 0.24, 0.6 / length), _INK))
    return found


def _spring_text(stiffness: float, damping: float) -> str:
    """Return the values of a spring and a damper, one line for each."""
    return "\n".join([shown(stiffness, "N/m")] * (stiffness > 0.0) + [shown(damping, "N s/m")] * (damping > 0.0))


class View(abc.ABC):
    """Drawing of a scene in its own units of length.

    **Attributes**: `limits` (left, right, bottom, top) of the drawing; `wheel`, the rotor with the loads.
    """

    limits: tuple[float, float, float, float]
    wheel: Wheel

    def __init__(self, scene: Scene):
        carrier = scene.machine.carrier()
        self.scene, self.mount = scene, scene.mount()
        self.mass, self.stiffness, self.damping = (
            np.asarray(x, float) for x in (carrier.mass, carrier.stiffness, carrier.damping)
        )
        self.foundation_stiffness, self.foundation_damping = (
            np.asarray(x, float) for x in (carrier.foundation_stiffness, carrier.foundation_damping)
        )

    @abc.abstractmethod
    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the drawn parts, the same parts in the same order for every pose.

        `reach` is the number of units of the drawing per metre of displacement.
        """

    def magnified(self, displacement: np.ndarray) -> float:
        """Return the magnification of displacements (nt, nd), relative to the circle of the loads, at which the largest one is
        clearly visible; one digit. The argument `reach` of `parts` is this factor times `wheel.scale`."""
        length = [k for k, unit in enumerate(self.scene.machine.structure().units) if unit == "m"]
        largest = float(np.max(np.abs(displacement[:, length]), initial=1e-300))
        return float(f"{0.3 / largest / self.wheel.scale:.1g}")

    @abc.abstractmethod
    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the names and values of the parts; the arguments are those of `parts`."""

    @abc.abstractmethod
    def supports(self) -> list[tuple[float, float]]:
        """Return the positions of the supports on the foundation."""

    @abc.abstractmethod
    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the force of each support on the foundation, (supports, 2) N, across and up.

        Supports that are effects are not included.
        """

    def arrows(self, pose: Pose, total: np.ndarray, per_newton: float) -> list[Part]:
        """Return arrows of the forces on the foundation.

        The force of each support is drawn at the support, the `total` (nb,) N in black beside the machine.
        """
        whole = (0.0, float(total[0])) if total.size == 1 else (float(total[0]), float(total[1]))
        found = [
            Part(arrow((x, y), (per_newton * fx, per_newton * fy)), _FORCE, True)
            for (x, y), (fx, fy) in zip(self.supports(), self.support_forces(pose), strict=True)
        ]
        _, right, bottom, top = self.limits
        at = (right - 0.8, bottom + 0.5 * (top - bottom))
        return [*found, Part(arrow(at, (per_newton * whole[0], per_newton * whole[1]), 0.16), {**_FORCE, "fc": "black"}, True)]


class PlatformView(View):
    """Platforms above each other, numbered from the foundation upward, with each spring in a separate lane."""

    pitch, thick, lane = 1.9, 0.34, 2.0

    def __init__(self, scene: Scene):
        super().__init__(scene)
        n = self.mass.shape[0]
        self.rows = [np.asarray(scene.machine.rows_at(level))[0] for level in range(1, n + 1)]
        self.exciter = int(np.argmax(self.rows @ np.asarray(self.mount.rows[0])[0])) + 1
        self.ties = [
            Tie(0, i + 1, float(self.foundation_stiffness[0, i]), float(self.foundation_damping[0, i])) for i in range(n)
        ]
        self.ties += [
            Tie(i + 1, j + 1, float(-self.stiffness[i, j]), float(-self.damping[i, j])) for j in range(n) for i in range(j)
        ]
        self.ties = [tie for tie in self.ties if tie.stiffness > 0.0 or tie.damping > 0.0] + [Tie(self.exciter, self.exciter)]
        self.wheel = Wheel(scene, 0.6)
        order = lanes(self.ties, n)
        widths = [2.0 * self.wheel.rim + 0.2 if self.ties[k].exciter else self.lane for k in order]
        starts = np.concatenate([[0.0], np.cumsum(widths)])
        self.x = {k: float(starts[p] + (0.5 * widths[p] if self.ties[k].exciter else 0.45)) for p, k in enumerate(order)}
        self.spans = []
        for level in range(1, n + 1):
            own = [p for p, k in enumerate(order) if level in (self.ties[k].low, self.ties[k].high)]
            self.spans.append((float(starts[own[0]]), float(starts[own[-1] + 1])) if own else (0.0, self.lane))
        self.width = float(starts[-1])
        self.limits = (-0.3, max(self.width + 1.3, 6.5), -0.9, (n + 0.55) * self.pitch + 0.2)

    def _height(self, level: int, pose: Pose, reach: float) -> float:
        return level * self.pitch + (reach * float(self.rows[level - 1] @ pose.displacement) if level else 0.0)

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the foundation, the springs and dampers, the platforms, the exciter."""
        found = [Part(ground((-0.2, 0.0), (self.width, 0.0)), _BED)]
        for k, tie in enumerate(self.ties):
            if not tie.exciter:
                low, high = (self._height(level, pose, reach) for level in (tie.low, tie.high))
                low += 0.5 * self.thick if tie.low else 0.0
                length = (tie.high - tie.low) * self.pitch - self.thick
                ends = (self.x[k], low), (self.x[k], high - 0.5 * self.thick)
                found += _tie(*ends, tie.stiffness, tie.damping, length)
        for level, (left, right) in enumerate(self.spans, start=1):
            y = self._height(level, pose, reach)
            found.append(Part(box(left, right, y - 0.5 * self.thick, y + 0.5 * self.thick), _BODY, True))
        return found + self.wheel.parts((self.x[len(self.ties) - 1], self._height(self.exciter, pose, reach)), pose)

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the masses on the platforms and the values beside the springs."""
        found = []
        for k, tie in enumerate(self.ties):
            if not tie.exciter:
                middle = 0.5 * self.pitch * (tie.low + tie.high if tie.high - tie.low == 1 else 2 * tie.high - 1)
                place = (self.x[k] + 0.42, middle)
                found.append(Text(*place, _spring_text(tie.stiffness, tie.damping), {"va": "center", "fontsize": "small"}))
        for level, (left, right) in enumerate(self.spans, start=1):
            # The text is on the longer piece of the platform beside the exciter.
            x = self.x[len(self.ties) - 1]
            edges = [(left, x - self.wheel.rim), (x + self.wheel.rim, right)] if level == self.exciter else [(left, right)]
            a, b = max(edges, key=lambda edge: edge[1] - edge[0])
            text = f"M{level} = {shown(float(self.mass[level - 1, level - 1]), 'kg')}"
            place = (0.5 * (a + b), self._height(level, pose, reach))
            found.append(Text(*place, text, {"ha": "center", "va": "center", "fontsize": "small"}))
        return found

    def supports(self) -> list[tuple[float, float]]:
        """Return the lower ends of the supports."""
        return [(self.x[k], 0.0) for k, tie in enumerate(self.ties) if tie.low == 0]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return k_i y_i + b_i y_i' of each support, upward."""
        force = self.foundation_stiffness[0] * pose.displacement + self.foundation_damping[0] * pose.velocity
        return np.array([[0.0, force[tie.high - 1]] for tie in self.ties if tie.low == 0])


class FrontView(View):
    """Rotor seen along its axis, on a spring and a damper in each direction.

    For loads that move along the axis, the section of their track is drawn too.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.wheel = Wheel(scene, 1.0)
        self.section = len(scene.loads.position(*scene.loads.rest())) > 2
        self.limits = (-3.2, 5.5 if self.section else 3.6, -3.2, 1.8)

    def _centre(self, pose: Pose, reach: float) -> tuple[float, float]:
        across, up = reach * (np.asarray(self.mount.rows[0]) @ pose.displacement)
        return float(across), float(up)

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the foundation below, a wall on the left, springs and dampers, the rotor."""
        x, y = self._centre(pose, reach)
        k, c = self.foundation_stiffness[1], self.foundation_damping[1]
        stiffness, damping = float(np.max(k)), float(np.max(c))
        found = [Part(ground((-1.2, -2.4), (1.6, -2.4)), _BED), Part(ground((-2.7, 1.2), (-2.7, -1.6)), _BED)]
        found += _tie((x, -2.4), (x, y - self.wheel.rim), stiffness, damping)
        found += _tie((-2.7, y), (x - self.wheel.rim, y), stiffness, damping)
        found += self.wheel.parts((x, y), pose)
        return found + (self._section(pose) if self.section else [])

    def _section(self, pose: Pose) -> list[Part]:
        """Return the magnified cross-section of the track with the balls in it; the axis is on the left."""
        loads = self.scene.loads
        first, *others = (np.asarray(u, float) for u in loads.rest())
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        round_it = [np.full_like(turn, first[0]), turn, *(np.full_like(turn, u[0]) for u in others[1:])]
        across, up, along = places_of(loads, round_it)
        away = np.hypot(across, up)
        middle = 0.5 * (np.max(away) + np.min(away))
        own = float(getattr(loads, "ball_radius", 0.0))
        scale = 0.85 / (0.5 * np.ptp(away) + own)
        centre = np.array([3.2, 0.0])
        found = [Part(circle(tuple(centre), 0.85), {"fc": "white", "ec": "black", "lw": 1.4, "zorder": 3}, True)]
        found.append(
            Part(centre + scale * np.stack([away - middle, along], 1), {"color": GUIDE, "ls": ":", "lw": 0.8, "zorder": 3.1})
        )
        across, up, along = (np.broadcast_to(x, (loads.count,)) for x in places_of(loads, pose.angle))
        for j in range(loads.count):
            place = centre + scale * np.array([np.hypot(across[j], up[j]) - middle, along[j]])
            look = {"fc": COLORS[j % len(COLORS)], "ec": "black", "alpha": 0.75, "lw": 0.8, "zorder": 3.5}
            found.append(Part(circle(tuple(place), max(scale * own, 0.08), 31), look, True))
        return found

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the mass, and the values of the supports, which are equal in both directions."""
        label = _spring_text(float(np.max(self.foundation_stiffness[1])), float(np.max(self.foundation_damping[1])))
        small: Look = {"fontsize": "small"}
        mass = f"M = {shown(float(self.mass[0, 0]), 'kg')}"
        found = [
            Text(0.55, -1.75, label, {**small, "va": "center"}),
            Text(-1.95, 0.62, label, {**small, "ha": "center", "va": "center"}),
            Text(1.05, 1.2, mass, small),
        ]
        return [*found, Text(3.2, -1.15, "section of the track,\naxis to the left", {**small, "ha": "center", "va": "top"})][
            : 4 if self.section else 3
        ]

    def supports(self) -> list[tuple[float, float]]:
        """Return the ends of the supports on the foundation and on the wall."""
        return [(0.0, -2.4), (-2.7, 0.0)]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return T_K q + T_C q': the force up on the foundation, across on the wall."""
        force = self.foundation_stiffness @ pose.displacement + self.foundation_damping @ pose.velocity
        return np.array([[0.0, force[1]], [force[0], 0.0]])


class ShaftView(View):
    """Rotor with tilt: the shaft from the side, with distances from the centre of mass, and on the right along the axis."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.stands = scene.machine.shaft_supports() or []
        self._rows = functools.cache(lambda s: np.asarray(scene.machine.rows_at(s)))
        self.stations = np.asarray(self.mount.distances(scene.loads.count), float)
        all_places = [0.0, *self.stations, *(s for s, _, _ in self.stands)]
        low, high = min(all_places), max(all_places)
        half = 0.5 * (high - low) or 0.1
        self.middle, self.scale = 0.5 * (low + high), 2.6 / half
        self.wheel = Wheel(scene, 0.8)
        self.front = 5.0
        self.limits = (-3.5, self.front + 2.6, -3.0, 1.75)

    def _x(self, s: float) -> float:
        return self.scale * (s - self.middle)

    def _y(self, s: float, pose: Pose, reach: float, axis: int = 1) -> float:
        return reach * float(self._rows(float(s))[axis] @ pose.displacement)

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return foundation, supports, shaft and body, a disc with loads at each station, and the rotor along its axis."""
        found = [Part(ground((-3.2, -2.2), (3.2, -2.2)), _BED)]
        for s, k, c in self.stands:
            found += _tie((self._x(s), -2.2), (self._x(s), self._y(s, pose, reach)), k, c)
        ends = [self.middle - 3.1 / self.scale, self.middle + 3.1 / self.scale]
        line = np.array([[self._x(s), self._y(s, pose, reach)] for s in ends])
        found.append(Part(line, {"color": "black", "lw": 3.5, "zorder": 2.6, "solid_capstyle": "round"}))
        body = [-0.9 / self.scale, 0.9 / self.scale]
        corners = [(s, side) for s, side in ((body[0], -1), (body[1], -1), (body[1], 1), (body[0], 1))]
        points = np.array([[self._x(s), self._y(s, pose, reach) + 0.38 * side] for s, side in corners])
        found.append(Part(points, _BODY, True))
        up = self.wheel.places(pose)[1]
        for s in np.unique(self.stations):
            x, y = self._x(s), self._y(s, pose, reach)
            disc = box(x - 0.09, x + 0.09, y - self.wheel.rim, y + self.wheel.rim)
            found.append(Part(disc, {"fc": "#f4f4f4", "ec": "black", "lw": 1.2, "zorder": 3.0}, True))
        for j, s in enumerate(self.stations):
            place = (self._x(s), self._y(s, pose, reach) + float(up[j]))
            look = {"fc": COLORS[j % len(COLORS)], "ec": "black", "lw": 0.8, "zorder": 3.4 + 0.01 * j}
            found.append(Part(circle(place, self.wheel.size, 31), look, True))
        centre = (self.front + self._y(0.0, pose, reach, 0), self._y(0.0, pose, reach))
        return found + self.wheel.parts(centre, pose)

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return mass, inertias and supports, and the positions of supports and stations from the centre of mass."""
        small: Look = {"fontsize": "small"}
        turning = self.mount.gyroscopic
        inertia = f"M = {shown(float(self.mass[0, 0]), 'kg')}\nA = {shown(float(self.mass[2, 2]), 'kg m²')}"
        if turning is not None:
            inertia += f"\nC = {shown(float(np.max(np.abs(np.asarray(turning)))), 'kg m²')}"
        found = [Text(self._x(0.0), 0.45, inertia, {**small, "ha": "center", "va": "bottom"})]
        for s, k, c in self.stands:
            text = f"{_spring_text(k, c)}\nat {1e3 * s:+.4g} mm"
            right = s >= 0.0
            place = self._x(s) + (0.42 if right else -0.42)
            found.append(Text(place, -1.55, text, {**small, "va": "center", "ha": "left" if right else "right"}))
        shown_at = sorted({round(1e3 * float(s), 6) for s in self.stations})
        label = ", ".join(f"{s:+.4g}" for s in shown_at) + " mm"
        found.append(Text(0.0, 1.3, f"loads at {label}", {**small, "ha": "center", "va": "bottom"}))
        found.append(Text(self.front, -1.2, "along the axis", {**small, "ha": "center", "va": "top"}))
        return found

    def supports(self) -> list[tuple[float, float]]:
        """Return the lower ends of the supports."""
        return [(self._x(s), -2.2) for s, _, _ in self.stands]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the upward component of k x + c x' of each support, which is visible from the side."""
        rows = [self._rows(s)[1] for s, _, _ in self.stands]
        return np.array(
            [
                [0.0, k * row @ pose.displacement + c * row @ pose.velocity]
                for row, (_, k, c) in zip(rows, self.stands, strict=True)
            ]
        ).reshape(-1, 2)


def view_of(scene: Scene) -> View:
    """Return the drawing of a scene, chosen by the kind of places of its machine."""
    machine = scene.machine
    if machine.places == "plane" or (machine.places == "point" and machine.mounting().axes != (0, 1)):
        problem = (
            f"is {machine.kind!r}; sketches are available for machines with platforms or a shaft, or that move across and up"
        )
        raise InputError("machine.kind", problem)
    return {"platform": PlatformView, "shaft": ShaftView, "point": FrontView}[machine.places](scene)
