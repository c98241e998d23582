"""Drawing of a body that moves in its plane: outline, springs in their directions, exciters with their sense of rotation."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.draw.machine.parts import Part, Text, circle, ground
from jaxvib.draw.style import Look
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.plane_body import PlaneBody
from jaxvib.show.view import BODY, FOUNDATION, View, spring_and_damper
from jaxvib.show.wheel import Pose, Wheel, numbers_of, value_text

_WIDTH = 6.0
"""Size, in units of the drawing, of the rectangle around the centre of mass, the supports and the exciters of a body: the
larger of its width and 1.6 times its height."""

_OUTLINE_MARGIN = 0.32
"""Smallest distance of the outline of a body from its centre of mass, from the points of its supports, and from the rims of its
exciters."""

_SPRING_LENGTH = 1.6
"""Length of a spring from the body to the foundation, in units of the drawing."""

_STEEP_SPRING_SINE = np.sin(np.radians(40.0))
"""Sine of the angle to the horizontal above which a spring is drawn downward; a flatter spring is drawn sideways."""


_ARROW_MARGIN = 0.19
"""Distance between the circle of an exciter's loads and the middle between the exciter and its nearest neighbour, in units of
the drawing. The arrow above a rotor then does not cover its neighbour."""


class _Strut(NamedTuple):
    """Spring with its damper, from the body to the foundation.

    **Attributes**: `support`: index of its support; `start`: its end on the body; `vector`: the vector from `start` to its end
    on the foundation; `along`: unit vector of its direction (angle of the support, plus a right angle for the second spring);
    `stiffness`, N/m; `damping`, N s/m.
    """

    support: int
    start: np.ndarray
    vector: np.ndarray
    along: np.ndarray
    stiffness: float
    damping: float

    @property
    def values(self) -> tuple[float, float]:
        return self.stiffness, self.damping


class PlaneView(View):
    """Drawing of a body to scale, with an outline around its centre of mass, its supports and its exciters. Springs are not to
    scale."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        machine = scene.machine
        assert isinstance(machine, PlaneBody)
        self._supports = [np.asarray(item.at, float) for item in machine.supports]
        self._axes = [np.zeros(2) if item.position is None else np.asarray(item.position, float) for item in scene.exciters]
        points = np.array([*self._supports, *self._axes, np.zeros(2)])
        span = np.ptp(points, axis=0)
        self.scale = _WIDTH / max(float(span[0]), 1.6 * float(span[1]), 1e-9)
        distances = [float(np.hypot(*(first - second))) for k, first in enumerate(self._axes) for second in self._axes[:k]]
        nearest = self.scale * min((x for x in distances if x > 0.0), default=1.0)
        self.wheels = [Wheel(exciter, float(np.clip(0.5 * nearest - _ARROW_MARGIN, 0.12, 0.3))) for exciter in scene.exciters]
        self.struts = [strut for k in range(len(self._supports)) for strut in self._struts(k, points)]
        radii = (
            [_OUTLINE_MARGIN] * len(self._supports) + [_OUTLINE_MARGIN + wheel.rim for wheel in self.wheels] + [_OUTLINE_MARGIN]
        )
        outline = _hull(np.concatenate([circle(tuple(at), r, 41) for at, r in zip(self.scale * points, radii, strict=True)]))
        points_of_body = [*(outline / self.scale), *self._supports, *self._axes, np.zeros(2)]
        self._rest_points, self._corner_count = np.asarray(points_of_body), len(outline)
        # Displacement of each point for each coordinate of the body (points, 2, 3), a linear function of the point. A call for
        # each point would take most of the time of a drawing.
        centre, *ends = (np.asarray(machine.rows_at(jnp.asarray(at))) for at in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
        self._point_rows = centre + np.tensordot(self._rest_points, np.stack(ends) - centre, axes=1)
        low, high = np.min(outline, axis=0), np.max(outline, axis=0)
        self._mass_text_at = np.array([0.5 * (low[0] + high[0]), low[1] - 0.12])
        self.limits = self._limits(outline)

    def _struts(self, k: int, points: np.ndarray) -> list[_Strut]:
        """Return the springs of support `k`. A steep spring is drawn downward, a flat one away from the middle of the body."""
        support = self.scene.machine.supports[k]  # pyright: ignore[reportAttributeAccessIssue]
        struts = []
        for j in range(2):
            angle = float(support.angle) + 0.5 * np.pi * j
            along = np.array([np.cos(angle), np.sin(angle)])
            outward = np.sign(self._supports[k][0] - np.mean(points[:, 0])) or 1.0
            sign = -np.sign(along[1]) if abs(along[1]) > _STEEP_SPRING_SINE else outward * np.sign(along[0])
            values = float(support.stiffness[j]), float(support.damping[j])
            if max(values) > 0.0:
                struts.append(_Strut(k, self.scale * self._supports[k], _SPRING_LENGTH * sign * along, along, *values))
        return struts

    def _limits(self, outline: np.ndarray) -> tuple[float, float, float, float]:
        points = np.concatenate([outline, *([strut.start + strut.vector] for strut in self.struts)])
        tops = [self.scale * at + 2.0 * wheel.rim for at, wheel in zip(self._axes, self.wheels, strict=True)]
        points = np.concatenate([points, tops])
        (left, bottom), (right, top) = np.min(points, axis=0), np.max(points, axis=0)
        return float(left) - 0.8, float(right) + 1.7, float(bottom) - 1.1, float(top) + 0.3

    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the foundation, springs and dampers, the body, its centre of mass, the exciters."""
        positions = self.scale * self._rest_points + reach * self._point_rows @ pose.displacement
        corners, rest = positions[: self._corner_count], positions[self._corner_count :]
        ends, axes, centre = rest[: len(self._supports)], rest[len(self._supports) : -1], rest[-1]
        parts = []
        for strut in self.struts:
            end = strut.start + strut.vector
            side = 0.4 * np.array([strut.vector[1], -strut.vector[0]]) / _SPRING_LENGTH
            parts.append(Part(ground(tuple(end - side), tuple(end + side)), FOUNDATION))
            parts += spring_and_damper(tuple(ends[strut.support]), tuple(end), strut.stiffness, strut.damping, _SPRING_LENGTH)
        parts.append(Part(corners, BODY, True))
        parts += [Part(circle(tuple(at), 0.06, 15), {"fc": "black", "ec": "none", "zorder": 2.8}, True) for at in ends]
        parts += _centre_mark(centre)
        for at, wheel, rotor in zip(axes, self.wheels, pose.rotors, strict=True):
            parts += wheel.parts((float(at[0]), float(at[1])), rotor) + wheel.turning_parts((float(at[0]), float(at[1])))
        return parts

    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return mass and inertia of the body, the values of the supports, the numbers of the exciters."""
        small: Look = {"fontsize": "small"}
        mass, inertia = float(self.mass[0, 0]), float(self.mass[2, 2])
        words = f"M = {value_text(mass, 'kg')}, J = {value_text(inertia, 'kg m²')}"
        bottom = self.limits[2]
        x, y = self._mass_text_at + reach * self._point_rows[-1] @ pose.displacement  # the text moves with the centre of mass
        texts = [Text(float(x), float(y), words, {**small, "ha": "center", "va": "top"})]
        struts_of_support: dict[int, list[_Strut]] = {}
        for strut in self.struts:
            struts_of_support.setdefault(strut.support, []).append(strut)
        for struts in struts_of_support.values():
            lowest = min(struts, key=lambda strut: float((strut.start + strut.vector)[1]))
            x, y = lowest.start + lowest.vector
            two = len(struts) == 2 and struts[0].values != struts[1].values
            lines = [
                _directions(struts) if two else "",
                _pair([s.stiffness for s in struts], "N/m"),
                _pair([s.damping for s in struts], "N s/m"),
            ]
            texts.append(
                Text(
                    float(x),
                    max(float(y) - 0.25, bottom + 0.05),
                    "\n".join(filter(None, lines)),
                    {**small, "ha": "center", "va": "top"},
                )
            )
        if len(self.wheels) > 1:
            texts += numbers_of(self.wheels, [(self.scale * at).tolist() for at in self._axes])
        return texts

    def supports(self) -> list[tuple[float, float]]:
        """Return the points of the supports on the body."""
        return [tuple((self.scale * at).tolist()) for at in self._supports]

    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the force of each support on the foundation (supports, 2), N: the sum over its two springs and dampers."""
        rows = self._point_rows[self._corner_count : self._corner_count + len(self._supports)]
        displacement, rate = rows @ pose.displacement, rows @ pose.velocity
        force = np.zeros((len(self._supports), 2))
        for strut in self.struts:
            k = strut.support
            force[k] += (strut.stiffness * strut.along @ displacement[k] + strut.damping * strut.along @ rate[k]) * strut.along
        return force


def _directions(struts: list[_Strut]) -> str:
    """Return the directions of the springs of a support: "across | up", or their angles."""
    angles = [float(np.rad2deg(np.arctan2(strut.along[1], strut.along[0]))) for strut in struts]
    return " | ".join({0.0: "across", 90.0: "up"}.get(round(angle, 6), f"at {angle:.4g}°") for angle in angles)


def _pair(values: list[float], unit: str) -> str:
    """Return the values of both springs of a support; "" if all are 0."""
    if not any(values):
        return ""
    return " | ".join(value_text(value, unit) for value in dict.fromkeys(values))


def _centre_mark(at: np.ndarray) -> list[Part]:
    """Return the symbol of a centre of mass: a circle with two filled quarters."""
    quarters = [np.concatenate([[at], at + 0.12 * _arc(begin), [at]]) for begin in (0.0, np.pi)]
    look = {"fc": "black", "ec": "none", "zorder": 2.9}
    rim = Part(circle((float(at[0]), float(at[1])), 0.12, 25), {"color": "black", "lw": 0.8, "zorder": 2.9})
    return [rim, *(Part(quarter, look, True) for quarter in quarters)]


def _arc(begin: float) -> np.ndarray:
    angle = begin + np.linspace(0.0, 0.5 * np.pi, 9)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _hull(points: np.ndarray) -> np.ndarray:
    """Return the convex hull of points (n, 2), anticlockwise and closed."""
    from scipy.spatial import ConvexHull  # slow import

    corners = points[ConvexHull(points).vertices]
    return np.concatenate([corners, corners[:1]])
