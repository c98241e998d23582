"""Dimensionless numbers that indicate effects which a scene may lack."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.equations.linear import linear_model
from jaxvib.machine.effects.base import has_term, total_gravity
from jaxvib.machine.effects.terms import ContactFriction, LoadInteraction, SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.study.audit.comparisons import MotionValues, total_drag_torque

_G = 9.81
_STEEL_DENSITY = 7850.0
_ROLLING, _BEARING, _BEARING_DIAMETER = 3e-5, 0.0015, 0.2
"""Typical values: arm of rolling friction of steel on steel, m; friction coefficient mu2 of a ball bearing; diameter of the
bearing of a load, relative to the radius of its track."""


class NumberRow(NamedTuple):
    """Dimensionless number of a scene.

    **Attributes**: its `name` and `value`; the `limit` above which an effect may be needed; the `advice` ("perhaps needed"
    above the limit, otherwise "negligible"); `note`: a sentence about the number.
    """

    name: str
    value: float
    limit: float
    advice: str
    note: str


def dimensionless_numbers(scene: Scene, values: MotionValues, accuracy: float) -> list[NumberRow]:
    """Return the dimensionless numbers of effects that `scene` lacks.

    **Arguments**: `values` of the motion; relative `accuracy`: limit of the numbers, except for the filled share of the track,
    contact and lift, whose limit is 1.

    - gravity on the loads: g/(R Omega^2), its share in the normal force of a load on its track
    - crowding: if the N loads do not fit on the track, the share of the track that their diameters fill, N arcsin(r/R)/pi. If
      they fit and have no `ball_radius`: the share of the unbalance that is lost if they lie side by side, 1 - sin(N a)/(N sin
      a), sin a = r/R. r is `ball_radius`, or the radius of steel balls of the same mass
    - contact: diameter of the loads divided by the smallest distance of two loads, if the scene has no contact between loads
    - dry friction divided by viscous friction: friction of a ball bearing, or of steel on steel, divided by the drag torque
      b_W R^2 (n - Omega)
    - gyroscopic, if the machine cannot tilt: sum kappa m / M. This is a ratio of two moments of inertia: that of the loads
      about the axis of the rotor (effective, sum kappa m R^2), and that of a machine with the radius of gyration R (M R^2)
    - lift, for machines that move up and down: foundation force divided by the weight; above 1, supports under the machine
      would have to pull

    An effect that the scene contains has no row. **Returns** a list of `NumberRow`.

    Source: this package; for the first number Artyunin and Sumenkov 2019, who state that gravity is below 0.5 %.
    """
    if not np.isfinite(values.omega) or values.omega == 0.0:
        return []
    rows = [compute(scene, values, accuracy) for compute in _NUMBERS]
    return [row for row in rows if row is not None]


def gravity_share(radius: float, omega: float) -> float:
    """Return g/(R Omega^2): the share of gravity in the normal force of a load at `radius`, m, with the speed `omega`, rad/s.

    >>> round(100.0 * gravity_share(0.08, 169.6), 3)      # percent, of the published rotor's pendulums in their first jam
    0.426

    Source: Artyunin and Sumenkov 2019, who state that it is below 0.5 %. This is true for load speeds above sqrt(g/(0.005 R)),
    which is 157 rad/s for R = 0.08 m.
    """
    return _G / (radius * omega**2)


def _row(name: str, value: float, limit: float, note: str) -> NumberRow:
    return NumberRow(name, value, limit, "perhaps needed" if value > limit else "negligible", note)


def _arm(scene: Scene) -> float:
    return float(np.mean(scene.loads.arm()))


def _ball_radius(scene: Scene) -> tuple[float, str] | None:
    """Return the radius of the loads, m, and "", or the radius of steel balls of the same mass and a text that states this;
    None for loads on bearings without a radius."""
    stated = getattr(scene.loads, "ball_radius", None)
    if stated is not None:
        return float(stated), ""
    if scene.loads.has_bearing:
        return None
    radius = (3.0 * float(np.mean(np.asarray(scene.loads.mass))) / (4.0 * math.pi * _STEEL_DENSITY)) ** (1.0 / 3.0)
    return radius, f"balls of steel of this mass have the radius {1e3 * radius:.3g} mm; "


def _gravity(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    if total_gravity(scene.all_effects):
        return None
    share = gravity_share(_arm(scene), values.omega)
    return _row("gravity: g/(R Omega^2)", share, accuracy, "share of gravity in the normal force of the loads on their track")


def _crowding(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    ball, n = _ball_radius(scene), scene.loads.count
    if ball is None or n < 2 or not scene.loads.circular:
        return None
    radius, origin = ball
    ratio = radius / _arm(scene)
    half = math.asin(min(ratio, 1.0))
    filled = n * half / math.pi
    if filled >= 1.0:
        note = f"{origin}the loads do not fit on the track; use lighter loads, or more than one track"
        return NumberRow("crowding: N arcsin(r/R)/pi", filled, 1.0, "perhaps needed", note)
    if not origin:
        return None
    lost = 1.0 - math.sin(n * half) / (n * math.sin(half))
    note = (
        f"{origin}side by side they fill {100.0 * filled:.3g} % of the track and lose this share of unbalance; give ball_radius"
    )
    return _row("loads side by side: 1 - sin(N a)/(N sin a)", lost, accuracy, note)


def _distance(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    if not np.isfinite(values.closest) or has_term(scene.all_effects, LoadInteraction):
        return None
    note = "diameter divided by the smallest distance of two loads; above 1 they pass through each other; add load_contact"
    return _row("contact: 2 r / distance", 1.0 / max(values.closest, 1e-9), 1.0, note)


def _friction(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    drag = total_drag_torque(scene, values.omega)
    if has_term(scene.all_effects, ContactFriction) or not drag > 0.0:
        return None
    arm, n = _arm(scene), scene.loads.count
    normal_force = float(jnp.sum(jnp.broadcast_to(scene.loads.mass, (n,)))) * arm * values.omega**2
    if scene.loads.has_bearing:
        diameter = _BEARING_DIAMETER * arm
        lever, bearing = 0.5 * _BEARING * diameter, f"mu2 = {_BEARING:g}, d = {1e3 * diameter:.3g} mm"
        note = f"friction of a ball bearing ({bearing}); effect dry_friction"
        name = "bearing: mu2 (d/2) m R Omega^2 / drag torque"
    else:
        ball = _ball_radius(scene)
        assert ball is not None
        radius, origin = ball
        lever, name = _ROLLING / radius * arm, "rolling: k (R/r) m R Omega^2 / drag torque"
        note = f"{origin}friction of steel on steel (k = {1e3 * _ROLLING:g} mm); effect rolling_friction, or more drag"
    return _row(name, lever * normal_force / drag, accuracy, note)


def _gyroscopic(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    if scene.mounting.tilt is not None:
        return None
    model = linear_model(scene)
    (port,) = model.mount.rows
    effective_mass = float(1.0 / (port @ jnp.linalg.solve(model.mass, port.T))[0, 0])
    n = scene.loads.count
    loads = float(jnp.sum(jnp.broadcast_to(scene.loads.inertia_factor() * scene.loads.mass, (n,))))
    note = (
        "the model has no tilts: if the machine can tilt, the rotating loads couple its tilts (as the inertia of a rotor does)"
    )
    return _row("gyroscopic: sum kappa m / M", loads / effective_mass, accuracy, note)


def _lift(scene: Scene, values: MotionValues, accuracy: float) -> NumberRow | None:
    machine = scene.machine
    if scene.mounting.axes != (1,) or has_term(scene.all_effects, SupportForce):
        return None
    loads = float(jnp.sum(jnp.broadcast_to(scene.loads.mass, (scene.loads.count,))))
    weight = _G * (float(jnp.trace(machine.carrier().mass)) + loads)
    note = "foundation force divided by weight; above 1, springs under it would have to pull; effect stop or cubic_support"
    return _row("lift: R / (M g)", values.foundation_force / weight, 1.0, note)


_NUMBERS: tuple[Callable[[Scene, MotionValues, float], NumberRow | None], ...] = (
    _gravity,
    _crowding,
    _distance,
    _friction,
    _gyroscopic,
    _lift,
)
