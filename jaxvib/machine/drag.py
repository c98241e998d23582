"""Drag of a load from its cause: oil, rolling friction, or the friction of a bearing."""

from __future__ import annotations

from functools import partial
from typing import Literal, get_args

import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.errors import InputError, require_one_of
from jaxvib.units import Number, number
from jaxvib.units.known import require_if_known

Cause = Literal["oil", "rolling", "bearing"]
"""Cause of the drag."""

_NEEDED = {
    "oil": {"ball_radius": "m", "viscosity": "Pa s", "density": "kg/m^3"},
    "rolling": {"ball_radius": "m", "mass": "kg", "rolling_lever": "m"},
    "bearing": {"mass": "kg", "friction": "", "diameter": "m"},
}
"""Arguments and SI units of each cause."""

_MAX_REYNOLDS = 3e5
"""Reynolds number above which the flow at a sphere changes suddenly, and the formula does not apply."""


@validated
def drag_of(
    cause: Cause,
    *,
    radius: Number,
    load_speed: Number,
    rotor_speed: Number,
    ball_radius: Number | None = None,
    viscosity: Number | None = None,
    density: Number | None = None,
    mass: Number | None = None,
    rolling_lever: Number | None = None,
    friction: Number | None = None,
    diameter: Number | None = None,
) -> Array:
    """Return the drag b_W of a load, N s/m, from its cause: the viscous drag that has the same force at the given speeds of
    load and rotor.

        b_W = F / v,    v = R (n - Omega)
        "oil":      F = C_D rho pi r^2 v^2 / 2,    C_D = 24/Re (1 + 0.15 Re^0.687) + 0.42 / (1 + 42500 Re^-1.16)
        "rolling":  F = m R Omega^2 f / r
        "bearing":  F = mu m R Omega^2 d / (2 R)

    with the Reynolds number Re = 2 rho r v / eta. Only a slow ball in thick oil (Re below 0.1) has a drag that hardly depends
    on the speed: 6 pi eta r within about 3 %. In all other cases the drag holds for the given speeds: compute it again for the
    load speed of a jam. Rolling and bearing friction can also be simulated as they are, by `RollingFriction` and
    `DryFriction`.

    The balls of a balancer need two values of the drag. Compute the first with `load_speed` = critical speed and
    `rotor_speed` = working speed; it decides whether the balls jam at the critical speed. Compute the second with two nearly
    equal speeds; the balanced motion and its stability follow from it.

    **Arguments** (SI, or strings with a unit)

    - `cause`: "oil" for a ball in an oil bath, "rolling" for a roller or a ball on a dry track, "bearing" for a pendulum
    - `radius` R of the circle of the loads' centres, m; typical: 0.05 to 0.3. It must be that of the loads that get this drag;
      only scene files check this, because the drag is a plain number
    - `load_speed` Omega, less than `rotor_speed` n, rad/s; typical: "800 rpm" and "1500 rpm"
    - `ball_radius` r of a ball or roller, m; typical: 0.01 to 0.03
    - `viscosity` eta of the oil at its working temperature, Pa s; typical: 0.05 to 0.5. Data sheets of oils state the
      kinematic viscosity: "100 mm^2/s" (ISO VG 100 at 40 degrees Celsius) is multiplied by the density
    - `density` rho of the oil, kg/m^3; typical: 870
    - `mass` m of the load, kg; typical: 0.1 to 1
    - `rolling_lever` f of the rolling friction, m; typical: 1e-5 to 5e-5 for steel on steel
    - `friction` mu of the bearing, a coefficient without unit; typical: 0.001 to 0.002 for ball and roller bearings, 0.01 to
      0.02 for plain bearings, for which it depends strongly on the lubrication; `diameter` d of its bore, m; typical: 0.005 to
      0.05

    **Returns** an array with one number, with derivatives.

    **Raises** `InputError` for a missing argument, for one that the cause does not use, and outside the range of validity:

    - oil: Re up to 3e5
    - oil, rolling: r below R
    - rolling: f up to r/10
    - bearing: d up to R

    Conditions that are not checked:

    - oil: the oil turns with the rotor. The formula is that of a ball far from walls. A ball on its track has a larger
      drag, especially in a channel narrower than about five ball diameters. Measure this drag
    - oil: the formula is that of a sphere, also for a roller, whose length it ignores: measure the drag of a roller
    - bearing: the values of mu for rolling bearings hold for open bearings with good lubrication, at about a tenth of their
      dynamic load rating. Seals add their own friction

    >>> import jaxvib as jv
    >>> speeds = dict(radius="120 mm", load_speed="780 rpm", rotor_speed="1500 rpm")
    >>> round(float(jv.drag_of("oil", ball_radius="20 mm", viscosity="0.1 Pa s", density=870.0, **speeds)), 2)
    1.91
    >>> round(float(jv.drag_of("bearing", mass="0.8 kg", friction=0.0015, diameter="12 mm", **speeds)), 4)
    0.0053

    Source: R. Clift, W. H. Gauvin, The motion of particles in turbulent gas streams, 1970 (C_D of a sphere, Re up to 3e5);
    Coulomb's law of rolling friction; SKF, Rolling bearings, 2018 (moment mu P d / 2, mu 0.0015 for deep groove ball bearings).
    """
    require_one_of(cause, get_args(Cause), "cause")
    given = {
        "ball_radius": ball_radius,
        "density": density,  # before the viscosity, which may need it
        "viscosity": viscosity,
        "mass": mass,
        "rolling_lever": rolling_lever,
        "friction": friction,
        "diameter": diameter,
    }
    read, needed = partial(number, low=0.0, open_low=True), _NEEDED[cause]
    value = {}
    for name, each in given.items():
        if name in needed and each is None:
            raise InputError(name, f"is missing; the drag by {cause} needs {', '.join(needed)}")
        if name not in needed and each is not None:
            raise InputError(name, f"is not used for the drag by {cause}, which needs {', '.join(needed)}; leave it out")
        if each is not None:
            value[name] = _viscosity(each, value["density"]) if name == "viscosity" else read(each, needed[name], name)
    speeds = {"load_speed": load_speed, "rotor_speed": rotor_speed}
    arm, (slow, fast) = read(radius, "m", "radius"), (read(speed, "rad/s", name) for name, speed in speeds.items())
    if "ball_radius" in value:
        problem = "is {:.6g} m; it must be less than the radius of {:.6g} m, on which the centres of the loads move"
        require_if_known(lambda r, arm: r < arm, value["ball_radius"], arm, field="ball_radius", problem=problem)
    problem = (
        "is {:.6g} rad/s; it must be less than the rotor_speed of {:.6g} rad/s (a ball that turns with the rotor: give a speed "
        "slightly below it)"
    )
    require_if_known(lambda slow, fast: slow < fast, slow, fast, field="load_speed", problem=problem)
    relative_speed, acceleration = arm * (fast - slow), arm * slow**2
    if cause == "oil":
        return _oil_drag(relative_speed, value["ball_radius"], value["viscosity"], value["density"])
    if cause == "rolling":
        lever, problem = value["rolling_lever"], "is {:g} m; it must be at most a tenth of the ball_radius of {:g} m"
        require_if_known(lambda k, r: k <= 0.1 * r, lever, value["ball_radius"], field="rolling_lever", problem=problem)
        return value["mass"] * acceleration * lever / (value["ball_radius"] * relative_speed)
    problem = "is {:g} m; it must be at most the radius of {:g} m"
    require_if_known(lambda d, r: d <= r, value["diameter"], arm, field="diameter", problem=problem)
    return 0.5 * value["friction"] * value["mass"] * acceleration * value["diameter"] / (arm * relative_speed)


def _viscosity(given: Number, density: Array) -> Array:
    """Return the dynamic viscosity, Pa s, also from a kinematic viscosity, whose unit is that of an area per time."""
    read = partial(number, field="viscosity", low=0.0, open_low=True)
    try:
        return read(given, "Pa s")
    except InputError as error:
        try:
            kinematic = read(given, "m^2/s")
        except InputError:
            raise error from None
        return kinematic * density


def _oil_drag(speed: Array, r: Array, viscosity: Array, density: Array) -> Array:
    reynolds = 2.0 * density * r * speed / viscosity
    limit = f"the formula holds up to {_MAX_REYNOLDS:g}; give a thicker oil or speeds that are closer together"
    problem = "gives a Reynolds number of {:.3g}; " + limit
    require_if_known(lambda number: number <= _MAX_REYNOLDS, reynolds, field="viscosity", problem=problem)
    # C_D rho pi r^2 v / 2 = (pi/4) eta r (Re C_D). The product Re C_D needs no division by Re, which can be very small.
    inertial = 0.42 * reynolds / (1.0 + 42500.0 * reynolds**-1.16)
    return np.pi / 4.0 * viscosity * r * (24.0 * (1.0 + 0.15 * reynolds**0.687) + inertial)
