"""Machines of the rotor paper and of the torus paper, which tests and benchmarks use too."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jax import Array

from jaxvib.machine.drives.drive import ConstantSpeed, RunUp
from jaxvib.machine.effects.base import Gravity, StaticImbalance
from jaxvib.machine.effects.rolling import RollingFriction
from jaxvib.machine.loads import pendulums
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.rotor import planar_rotor, rotor
from jaxvib.machine.torus import torus_balls
from jaxvib.study.maps.run_up_map import RunUpMap, run_up_map

__all__ = ["VARIANTS", "published_rotor", "published_torus", "rotor_run_up_map"]

Number = float | Array

_STIFFNESS, _POSITION, _LENGTH = (0.604e6, 0.555e6), (0.165, -0.155), 0.08

VARIANTS = {
    "printed": "c2 = k1 L1 - k2 L2, b as printed",
    "uncoupled": "c2 = 0, b as printed",
    "uncoupled, both dampers": "c2 = 0, b3 = 21.56 N m s, the sum of b L^2 over both dampers "
    "(the printed 10.41 is b L^2 of one damper, with L1 and L2 exchanged)",
}
"""Readings of the printed data under which a part of what the paper reports comes out."""


def published_rotor(mu: float = 9.2e-4, variant: str = "printed", *, eccentricity: float = 2.2e-4) -> Scene:
    """The rotor with four pendulums of the paper, run up at 230 rad/s^2 to 460 rad/s.

    **Arguments**: `mu` N m s, of the pendulums' bearings; `variant` one of `VARIANTS`; `eccentricity` m (the printed 25*10^-1
    is not a length; 2.2e-4 reproduces the ripple).

    Source: Artyunin 2013, section IV; the length 0.08 m of the pendulums is printed as "L1=L2=0,8".
    """
    (k1, k2), (l1, l2) = _STIFFNESS, _POSITION
    machine = rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=_STIFFNESS,
        damping=0.0,
        position=_POSITION,
        stations=(0.28, 0.25, -0.25, -0.28),
        stiffness_terms=(k1 + k2, k1 * l1 + k2 * l2 if variant == "printed" else 0.0, k1 * l1**2 + k2 * l2**2),
        damping_terms=(843.17, -0.47, 21.56 if variant == "uncoupled, both dampers" else 10.41),
    )
    bobs = pendulums(count=4, mass=0.05, radius=_LENGTH, drag=mu / _LENGTH**2)
    return Scene(machine, bobs, RunUp(460.0, 230.0), (Gravity(), StaticImbalance(37.0 * eccentricity)))


def rotor_run_up_map(mu: Sequence[float], variant: str, *, until: float = 6.0) -> RunUpMap:
    """Run-ups of the published rotor at each friction `mu`, N m s, from pendulums that hang at exactly one angle."""
    drag = [each / _LENGTH**2 for each in mu]
    return run_up_map(published_rotor(variant=variant), until, drag=drag, angles=[[-0.5 * math.pi] * 4], batch=8)


TORUS_SPEED, ECCENTRICITY, RADIUS, TUBE, _DENSITY = 140.0, 1e-3, 0.2, 15e-3, 7812.0
"""Rotor speed w, rad/s; e, radius of the torus and of its tube, m; density of the balls, kg/m^3."""


def published_torus(
    gap: Number,
    *,
    damping: Number = 0.1,
    stiffness: Number = 0.01,
    friction: Number = 4e-5,
    mass: Number = 7.0,
    width: Number = 0.1,
) -> Scene:
    """The paper's vertical rotor with two balls in a torus. Numbers are not checked, so that JAX may transform them.

    **Arguments**: `gap` (R_1 - r)/e, above 0 and below 15; `damping` n = b/(M w); `stiffness` p = c/(M w^2); `friction` k m;
    `mass` M kg of everything, balls included, which is not printed: 7.0 kg fits the tables; `width` m/s of `RollingFriction`.

    **Returns** `Scene`, with this package's own equations; `printed_torus` gives the paper's for it.

    Source: Strautmanis et al. 2018, sections 2 and 3.
    """
    own = TUBE - gap * ECCENTRICITY
    ball = _DENSITY * 4.0 / 3.0 * math.pi * own**3
    body = mass - 2.0 * ball
    return Scene(
        planar_rotor(mass=body, stiffness=stiffness * mass * TORUS_SPEED**2, damping=damping * mass * TORUS_SPEED),
        torus_balls(count=2, mass=ball, radius=RADIUS, tube=TUBE, ball_radius=own),
        ConstantSpeed(TORUS_SPEED),
        (
            Gravity(0.5005 * ECCENTRICITY * TORUS_SPEED**2, along="axis"),
            StaticImbalance(body * ECCENTRICITY),
            RollingFriction(friction, width=width),
        ),
    )
