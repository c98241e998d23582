"""Drawings of machines: platforms from the side, a rotor along its axis, a rotor with tilt in both views."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.display import shown_unit
from jaxvib.draw.machine.parts import Part, Text, box, circle, ground
from jaxvib.draw.style import GUIDE, Look, color_of
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.show.plane import PlaneView
from jaxvib.show.view import BODY, FOUNDATION, RotorView, View, spring_and_damper, spring_text
from jaxvib.show.wheel import Pose, Wheel, numbers_of, places_of, track_radius, value_text


class Connection(NamedTuple):
    """Link between two platforms, or support of a platform.

    **Attributes**: `low` and `high`: numbers of the platforms at its ends, counted from the bottom, 0 for the foundation;
    `stiffness` N/m and `damping` N s/m. An exciter is represented by a connection from its platform to the same platform,
    without stiffness and damping.
    """

    low: int
    high: int
    stiffness: float = 0.0
    damping: float = 0.0

    @property
    def is_exciter(self) -> bool:
        """True if the connection represents an exciter."""
        return self.low == self.high


def order_of_connections(connections: list[Connection], levels: int) -> list[int]:
    """Return an order of the connections, from left to right, in which few connections cross other platforms and the platforms
    are short.

    Pairs of connections are swapped until no swap is an improvement. `levels` is the number of platforms.

    >>> order_of_connections([Connection(0, 1), Connection(0, 2), Connection(1, 2)], 2)
    [0, 2, 1]
    """
    order = list(range(len(connections)))

    def cost(order: list[int]) -> float:
        place = {each: x for x, each in enumerate(order)}
        spans = []
        for level in range(1, levels + 1):
            places = [place[k] for k, each in enumerate(connections) if level in (each.low, each.high)]
            spans.append((min(places), max(places)) if places else (0, 0))
        crossed = sum(
            spans[level - 1][0] < place[k] < spans[level - 1][1]
            for k, each in enumerate(connections)
            for level in range(each.low + 1, each.high)
        )
        return 100.0 * crossed + sum(high - low for low, high in spans)

    best = cost(order)
    while True:
        swaps = [(i, j) for i in range(len(order)) for j in range(i)]
        candidates = []
        for i, j in swaps:
            swapped = order.copy()
            swapped[i], swapped[j] = swapped[j], swapped[i]
            candidates.append((cost(swapped), swapped))
        lowest_cost, swapped = min(candidates, default=(best, order))
        if not lowest_cost < best - 1e-12:
            return order
        best, order = lowest_cost, swapped


class PlatformView(View):
    """Platforms above each other, numbered from the foundation upward, with each spring and each exciter in a separate lane."""

    pitch, thick, lane = 1.9, 0.34, 2.0
    """Distance between platforms, thickness of a platform, and width of the lane of a spring, in units of the drawing."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        n = self.mass.shape[0]
        self.rows = [np.asarray(scene.machine.rows_at(level))[0] for level in range(1, n + 1)]
        self.wheels, self.scale = _wheels_to_scale(scene.exciters, 0.6)
        springs = [
            Connection(0, i + 1, float(self.foundation_stiffness[0, i]), float(self.foundation_damping[0, i])) for i in range(n)
        ]
        springs += [
            Connection(i + 1, j + 1, float(-self.stiffness[i, j]), float(-self.damping[i, j]))
            for j in range(n)
            for i in range(j)
        ]
        springs = [each for each in springs if each.stiffness > 0.0 or each.damping > 0.0]
        levels = [
            int(np.argmax(self.rows @ np.asarray(scene.machine.mount(exciter.place).rows[0])[0])) + 1
            for exciter in scene.exciters
        ]
        self.connections = springs + [Connection(level, level) for level in levels]
        wheel_of = dict(enumerate(self.wheels, len(springs)))
        order = order_of_connections(self.connections, n)
        widths = [2.0 * wheel_of[k].rim + 0.2 if k in wheel_of else self.lane for k in order]
        starts = np.concatenate([[0.0], np.cumsum(widths)])
        self.x = {k: float(starts[p] + (0.5 * widths[p] if k in wheel_of else 0.45)) for p, k in enumerate(order)}
        # For each exciter: its horizontal position, the number of its platform and its rotor.
        self.exciters = [(self.x[k], self.connections[k].low, wheel) for k, wheel in wheel_of.items()]
        self.spans = []
        for level in range(1, n + 1):
            places = [p for p, k in enumerate(order) if level in (self.connections[k].low, self.connections[k].high)]
            self.spans.append((float(starts[places[0]]), float(starts[places[-1] + 1])) if places else (0.0, self.lane))
        self.width = float(starts[-1])
        self.limits = (-0.3, max(self.width + 1.3, 6.5), -0.9, (n + 0.55) * self.pitch + 0.2)

    def _height(self, level: int, pose: Pose, reach: float) -> float:
        return level * self.pitch + (reach * float(self.rows[level - 1] @ pose.displacement) if level else 0.0)

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the foundation, the springs and dampers, the platforms, the exciters."""
        parts = [Part(ground((-0.2, 0.0), (self.width, 0.0)), FOUNDATION)]
        for k, each in enumerate(self.connections):
            if not each.is_exciter:
                low, high = (self._height(level, pose, reach) for level in (each.low, each.high))
                low += 0.5 * self.thick if each.low else 0.0
                length = (each.high - each.low) * self.pitch - self.thick
                ends = (self.x[k], low), (self.x[k], high - 0.5 * self.thick)
                parts += spring_and_damper(*ends, each.stiffness, each.damping, length)
        for level, (left, right) in enumerate(self.spans, start=1):
            y = self._height(level, pose, reach)
            parts.append(Part(box(left, right, y - 0.5 * self.thick, y + 0.5 * self.thick), BODY, True))
        for (x, level, wheel), rotor in zip(self.exciters, pose.rotors, strict=True):
            centre = (x, self._height(level, pose, reach))
            parts += wheel.parts(centre, rotor) + (wheel.turning_parts(centre) if len(self.exciters) > 1 else [])
        return parts

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the masses on the platforms, the values beside the springs, and the numbers of several exciters."""
        texts = []
        for k, each in enumerate(self.connections):
            if not each.is_exciter:
                middle = 0.5 * self.pitch * (each.low + each.high if each.high - each.low == 1 else 2 * each.high - 1)
                place = (self.x[k] + 0.42, middle)
                texts.append(Text(*place, spring_text(each.stiffness, each.damping), {"va": "center", "fontsize": "small"}))
        for level, (left, right) in enumerate(self.spans, start=1):
            # The text is on the longest piece of the platform that no exciter covers.
            covered = sorted((x - wheel.rim, x + wheel.rim) for x, at, wheel in self.exciters if at == level)
            lefts, rights = [left, *(high for _, high in covered)], [*(low for low, _ in covered), right]
            a, b = max(zip(lefts, rights, strict=True), key=lambda edge: edge[1] - edge[0])
            text = f"M{level} = {value_text(float(self.mass[level - 1, level - 1]), 'kg')}"
            place = (0.5 * (a + b), self._height(level, pose, reach))
            texts.append(Text(*place, text, {"ha": "center", "va": "center", "fontsize": "small"}))
        if len(self.exciters) > 1:
            centres = [(x, self._height(level, pose, reach)) for x, level, _ in self.exciters]
            texts += numbers_of(self.wheels, centres)
        return texts

    def supports(self) -> list[tuple[float, float]]:
        """Return the lower ends of the supports."""
        return [(self.x[k], 0.0) for k, each in enumerate(self.connections) if each.low == 0]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return k_i y_i + b_i y_i' of each support, upward."""
        force = self.foundation_stiffness[0] * pose.displacement + self.foundation_damping[0] * pose.velocity
        return np.array([[0.0, force[each.high - 1]] for each in self.connections if each.low == 0])


def _wheels_to_scale(exciters: Sequence[Exciter], radius: float) -> tuple[list[Wheel], float]:
    """Return the rotors of exciters whose largest circle of loads has the given `radius`, and the common scale of the circles.

    Small circles are enlarged to a third of `radius`. A rotor without loads has no size; it is drawn with `radius`.
    """
    tracks = [None if exciter.loads is None else track_radius(exciter.loads) for exciter in exciters]
    largest = max((track for track in tracks if track is not None), default=0.1)
    radii = [radius if track is None else radius * max(track / largest, 1.0 / 3.0) for track in tracks]
    return [Wheel(exciter, each) for exciter, each in zip(exciters, radii, strict=True)], radius / largest


class FrontView(RotorView):
    """Rotor seen along its axis, on a spring and a damper in each direction.

    For loads that move along the axis, the section of their track is drawn too.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene, 1.0)
        loads = scene.exciter.loads
        self.section = loads is not None and len(loads.position(*loads.rest())) > 2
        self.limits = (-3.2, 5.5 if self.section else 3.6, -3.2, 1.8)

    def _centre(self, pose: Pose, reach: float) -> tuple[float, float]:
        across, up = reach * (np.asarray(self.mount.rows[0]) @ pose.displacement)
        return float(across), float(up)

    def _supports(self) -> list[tuple[float, float]]:
        """Return the stiffness and the damping of the horizontal and of the vertical support."""
        return list(
            zip(*(np.max(x, axis=1).tolist() for x in (self.foundation_stiffness, self.foundation_damping)), strict=True)
        )

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the foundation below, a wall on the left, springs and dampers, the rotor."""
        x, y = self._centre(pose, reach)
        across, up = self._supports()
        parts = [Part(ground((-1.2, -2.4), (1.6, -2.4)), FOUNDATION), Part(ground((-2.7, 1.2), (-2.7, -1.6)), FOUNDATION)]
        parts += spring_and_damper((x, -2.4), (x, y - self.wheel.rim), *up)
        parts += spring_and_damper((-2.7, y), (x - self.wheel.rim, y), *across)
        parts += self.wheel.parts((x, y), pose.rotors[0])
        return parts + (self._section(pose) if self.section else [])

    def _section(self, pose: Pose) -> list[Part]:
        """Return the magnified cross-section of the track with the balls in it; the axis is on the left."""
        loads = self.scene.loads
        first, *others = (np.asarray(u, float) for u in loads.rest())
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        circle_points = [np.full_like(turn, first[0]), turn, *(np.full_like(turn, u[0]) for u in others[1:])]
        across, up, along = places_of(loads, circle_points)
        distance = np.hypot(across, up)
        middle = 0.5 * (np.max(distance) + np.min(distance))
        ball_radius = float(getattr(loads, "ball_radius", 0.0))
        scale = 0.85 / (0.5 * np.ptp(distance) + ball_radius)
        centre = np.array([3.2, 0.0])
        parts = [Part(circle(tuple(centre), 0.85), {"fc": "white", "ec": "black", "lw": 1.4, "zorder": 3}, True)]
        parts.append(
            Part(
                centre + scale * np.stack([distance - middle, along], 1), {"color": GUIDE, "ls": ":", "lw": 0.8, "zorder": 3.1}
            )
        )
        across, up, along = (np.broadcast_to(x, (loads.count,)) for x in places_of(loads, pose.rotors[0].angle))
        places = centre + scale * np.stack([np.hypot(across, up) - middle, along], 1)
        for j, place in enumerate(places):
            hidden_count = np.sum(np.hypot(*(places[:j] - place).T) < 0.02)  # balls that a ball of the same size would cover
            look = {"fc": color_of(j), "ec": "black", "lw": 0.8, "zorder": 3.5 + 0.01 * j}
            parts.append(Part(circle(tuple(place), max(scale * ball_radius, 0.08) * 0.75**hidden_count, 31), look, True))
        return parts

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the mass, and the values of the supports."""
        across, up = (spring_text(*support) for support in self._supports())
        small: Look = {"fontsize": "small"}
        mass = f"M = {value_text(float(self.mass[0, 0]), 'kg')}"
        texts = [
            Text(0.55, -1.75, up, {**small, "va": "center"}),
            Text(-1.95, 0.62, across, {**small, "ha": "center", "va": "center"}),
            Text(1.05, 1.2, mass, small),
        ]
        return [*texts, Text(3.2, -1.15, "section of the track,\naxis to the left", {**small, "ha": "center", "va": "top"})][
            : 4 if self.section else 3
        ]

    def supports(self) -> list[tuple[float, float]]:
        """Return the ends of the supports on the foundation and on the wall."""
        return [(0.0, -2.4), (-2.7, 0.0)]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the forces on the foundation and on the wall.

        The force on the foundation is the vertical component of T_K q + T_C q'; the force on the wall is the horizontal
        component. T_K is `foundation_stiffness`, T_C is `foundation_damping`.
        """
        force = self.foundation_stiffness @ pose.displacement + self.foundation_damping @ pose.velocity
        return np.array([[0.0, force[1]], [force[0], 0.0]])


class ShaftView(RotorView):
    """Rotor with tilt in two views.

    On the left the shaft is seen from the side, with distances from the centre of mass; on the right the rotor is seen along
    its axis.

    **Attributes**: `middle`: position along the shaft, m, that is drawn in the middle of the left view; `along`: units of the
    drawing per metre of the shaft; `front`: horizontal position of the right view.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene, 0.8)
        self.shaft_supports = scene.machine.shaft_supports() or []
        self._rows = functools.cache(lambda s: np.asarray(scene.machine.rows_at(s)))
        loads = scene.exciter.loads
        self.stations = np.asarray(self.mount.distances(1 if loads is None else loads.count), float)
        distances = [0.0, *self.stations, *(s for s, _, _ in self.shaft_supports)]
        low, high = min(distances), max(distances)
        half = 0.5 * (high - low) or 0.1
        self.middle, self.along = 0.5 * (low + high), 2.6 / half
        self.front = 5.0
        self.limits = (-3.5, self.front + 2.6, -3.0, 1.75)

    def _x(self, s: float) -> float:
        return self.along * (s - self.middle)

    def _y(self, s: float, pose: Pose, reach: float, axis: int = 1) -> float:
        return reach * float(self._rows(float(s))[axis] @ pose.displacement)

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return foundation, supports, shaft and body, a disc with loads at each station, and the rotor seen along its axis."""
        parts = [Part(ground((-3.2, -2.2), (3.2, -2.2)), FOUNDATION)]
        for s, k, c in self.shaft_supports:
            parts += spring_and_damper((self._x(s), -2.2), (self._x(s), self._y(s, pose, reach)), k, c)
        ends = [self.middle - 3.1 / self.along, self.middle + 3.1 / self.along]
        line = np.array([[self._x(s), self._y(s, pose, reach)] for s in ends])
        parts.append(Part(line, {"color": "black", "lw": 3.5, "zorder": 2.6, "solid_capstyle": "round"}))
        body = [-0.9 / self.along, 0.9 / self.along]
        corners = [(s, side) for s, side in ((body[0], -1), (body[1], -1), (body[1], 1), (body[0], 1))]
        points = np.array([[self._x(s), self._y(s, pose, reach) + 0.38 * side] for s, side in corners])
        parts.append(Part(points, BODY, True))
        for s in np.unique(self.stations):
            x, y = self._x(s), self._y(s, pose, reach)
            disc = box(x - 0.09, x + 0.09, y - self.wheel.rim, y + self.wheel.rim)
            parts.append(Part(disc, {"fc": "#f4f4f4", "ec": "black", "lw": 1.2, "zorder": 3.0}, True))
        up = [] if self.wheel.loads is None else self.wheel.places(pose.rotors[0])[1]
        for j, (s, _) in enumerate(zip(self.stations, up, strict=False)):
            place = (self._x(s), self._y(s, pose, reach) + float(up[j]))
            look = {"fc": color_of(j), "ec": "black", "lw": 0.8, "zorder": 3.4 + 0.01 * j}
            parts.append(Part(circle(place, self.wheel.size, 31), look, True))
        centre = (self.front + self._y(0.0, pose, reach, 0), self._y(0.0, pose, reach))
        return parts + self.wheel.parts(centre, pose.rotors[0])

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return mass, inertias and supports, and the positions of supports and stations from the centre of mass."""
        small: Look = {"fontsize": "small"}
        length, factor = shown_unit("m", 0.1)
        gyroscopic = self.mount.gyroscopic
        inertia = f"M = {value_text(float(self.mass[0, 0]), 'kg')}\nA = {value_text(float(self.mass[2, 2]), 'kg m²')}"
        if gyroscopic is not None:
            inertia += f"\nC = {value_text(float(np.max(np.abs(np.asarray(gyroscopic)))), 'kg m²')}"
        texts = [Text(self._x(0.0), 0.45, inertia, {**small, "ha": "center", "va": "bottom"})]
        for s, k, c in self.shaft_supports:
            text = f"{spring_text(k, c)}\nat {factor * s:+.4g} {length}"
            right = s >= 0.0
            place = self._x(s) + (0.42 if right else -0.42)
            texts.append(Text(place, -1.55, text, {**small, "va": "center", "ha": "left" if right else "right"}))
        stations = sorted({round(float(s), 9) for s in self.stations})
        label = ", ".join(f"{factor * s:+.4g}" for s in stations) + f" {length}"
        texts.append(Text(0.0, 1.3, f"loads at {label}", {**small, "ha": "center", "va": "bottom"}))
        texts.append(Text(self.front, -1.2, "along the axis", {**small, "ha": "center", "va": "top"}))
        return texts

    def supports(self) -> list[tuple[float, float]]:
        """Return the lower ends of the supports."""
        return [(self._x(s), -2.2) for s, _, _ in self.shaft_supports]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the upward component of k x + c x' of each support, which is visible from the side."""
        rows = [self._rows(s)[1] for s, _, _ in self.shaft_supports]
        return np.array(
            [
                [0.0, k * row @ pose.displacement + c * row @ pose.velocity]
                for row, (_, k, c) in zip(rows, self.shaft_supports, strict=True)
            ]
        ).reshape(-1, 2)


def view_of(scene: Scene) -> View:
    """Return the drawing of a scene, chosen by the way in which places on its machine are named (`Machine.places`)."""
    machine = scene.machine
    views = {"platform": PlatformView, "shaft": ShaftView, "point": FrontView, "plane": PlaneView}
    not_drawn = machine.places == "point" and machine.mounting().axes != (0, 1)
    if not_drawn or machine.places not in views or machine.body_count > 1:
        problem = (
            f"is {quoted(machine.kind)}; sketches are available for machines with platforms, a shaft or one body in a plane, "
            "and for machines that move horizontally and vertically"
        )
        raise InputError("machine.kind", problem)
    if len(scene.exciters) > 1 and machine.places in ("shaft", "point"):
        problem = f"has {len(scene.exciters)} exciters; on a machine of kind {quoted(machine.kind)} a drawing shows one"
        raise InputError("scene", f"{problem}; several are drawn on platforms and on a body in a plane")
    return views[machine.places](scene)
