"""Base of the drawings of machines, and parts that they share."""

from __future__ import annotations

import abc

import numpy as np

from jaxvib.draw.machine.parts import Part, Text, arrow, damper, spring
from jaxvib.draw.style import COLORS, Look
from jaxvib.machine.scene import Scene
from jaxvib.show.wheel import Pose, Wheel, value_text

INK: Look = {"color": "#333333", "lw": 1.2, "zorder": 2.0}
FOUNDATION: Look = {"color": "black", "lw": 1.4, "zorder": 1.0}
BODY: Look = {"fc": "#c9d7e8", "ec": "black", "lw": 1.3, "zorder": 2.5}
FORCE: Look = {"fc": COLORS[1], "ec": "none", "zorder": 5.0}


def spring_and_damper(
    start: tuple[float, float], end: tuple[float, float], stiffness: float, damping: float, length: float = 1.5
) -> list[Part]:
    """Return a spring and a damper side by side. An element with the value 0 is omitted.

    **Arguments**: `length`: distance of the ends at rest, in units of the drawing.
    """
    is_pair = stiffness > 0.0 and damping > 0.0
    off = 0.17 if is_pair else 0.0
    side = np.array([start[1] - end[1], end[0] - start[0]]) / max(np.hypot(end[0] - start[0], end[1] - start[1]), 1e-9)
    a, b = np.asarray(start), np.asarray(end)
    parts = []
    if stiffness > 0.0:
        parts.append(Part(spring(tuple(a + off * side), tuple(b + off * side), coils=round(4.0 * length)), INK))
    if damping > 0.0:
        parts.append(Part(damper(tuple(a - off * side), tuple(b - off * side), 0.24, 0.6 / length), INK))
    return parts


def spring_text(stiffness: float, damping: float) -> str:
    """Return the values of a spring and a damper as text, with a line for each; a value of 0 is omitted."""
    return "\n".join([value_text(stiffness, "N/m")] * (stiffness > 0.0) + [value_text(damping, "N s/m")] * (damping > 0.0))


class View(abc.ABC):
    """Drawing of a scene. Its lengths are in arbitrary units (units of the drawing).

    **Attributes**: `limits` (left, right, bottom, top) of the drawing; `scale`: units of the drawing per metre.
    """

    limits: tuple[float, float, float, float]
    scale: float

    def __init__(self, scene: Scene):
        carrier = scene.machine.carrier()
        self.scene = scene
        self.mass, self.stiffness, self.damping = (
            np.asarray(x, float) for x in (carrier.mass, carrier.stiffness, carrier.damping)
        )
        self.foundation_stiffness, self.foundation_damping = (
            np.asarray(x, float) for x in (carrier.foundation_stiffness, carrier.foundation_damping)
        )

    @abc.abstractmethod
    def parts(self, pose: Pose, reach: float) -> list[Part]:
        """Return the parts of the drawing; for every pose there are the same parts in the same order.

        **Arguments**: `reach`: number of units of the drawing per metre of displacement.
        """

    def magnification(self, displacement: np.ndarray) -> float:
        """Return the magnification of displacements (nt, nd) with which the largest displacement is clearly visible.

        The factor is relative to the parts that are drawn to scale, and has one digit. The argument `reach` of `parts` is this
        factor times `scale`.
        """
        length = [k for k, unit in enumerate(self.scene.machine.structure().units) if unit == "m"]
        largest = float(np.max(np.abs(displacement[:, length]), initial=1e-300))
        return float(f"{0.3 / largest / self.scale:.1g}")

    @abc.abstractmethod
    def texts(self, pose: Pose, reach: float) -> list[Text]:
        """Return the names and values of the parts; the arguments are those of `parts`."""

    @abc.abstractmethod
    def supports(self) -> list[tuple[float, float]]:
        """Return the positions at which the forces of the supports are drawn."""

    @abc.abstractmethod
    def support_forces(self, pose: Pose) -> np.ndarray:
        """Return the force of each support on the foundation, (supports, 2) N: the horizontal and the upward component.

        Nonlinear supports and stops, which are effects (`SupportForce`), are not included.
        """

    def arrows(self, pose: Pose, total: np.ndarray, per_newton: float) -> list[Part]:
        """Return arrows of the forces on the foundation.

        The force of each support is drawn at the support, the `total` (directions,), N, in black beside the machine.

        **Arguments**: `per_newton`: length of an arrow per force, in units of the drawing per N.
        """
        total_force = (0.0, float(total[0])) if total.size == 1 else (float(total[0]), float(total[1]))
        arrow_parts = [
            Part(arrow((x, y), (per_newton * fx, per_newton * fy)), FORCE, True)
            for (x, y), (fx, fy) in zip(self.supports(), self.support_forces(pose), strict=True)
        ]
        _, right, bottom, top = self.limits
        at = (right - 0.8, bottom + 0.5 * (top - bottom))
        return [
            *arrow_parts,
            Part(arrow(at, (per_newton * total_force[0], per_newton * total_force[1]), 0.16), {**FORCE, "fc": "black"}, True),
        ]


ARROWS_NOTE = "arrows: forces of the supports on the foundation (black: total force)"
"""Meaning of the arrows, written below animations."""


class RotorView(View):
    """Drawing of a machine with one exciter; `wheel` is its rotor with the loads, `mount` its place on the machine."""

    def __init__(self, scene: Scene, radius: float):
        super().__init__(scene)
        self.mount, self.wheel = scene.mount(), Wheel(scene.exciter, radius)
        self.scale = self.wheel.scale
