"""Dry friction in the bearings of pendulums."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect, Typical
from jaxvib.machine.effects.terms import ContactFriction, Coordinates, Friction, Term
from jaxvib.machine.loads import CircularLoads, Loads
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number

Reaction = Literal["exact", "run_up", "steady"]


def sliding_sign(slip: Array, width: Array) -> Array:
    """Return tanh(slip / width), the sign of a sliding speed, smooth over the `width`.

    With the exact sign, a bearing does not turn if the torque on it is the fraction f < 1 of the largest friction torque. With
    the smooth sign it creeps at the speed width artanh(f), which tends to 0 with the width. An oscillation with the largest
    speed v loses less energy to dry friction than with the exact sign; the relative difference is (pi^2/24) (width/v)^2.

    >>> [round(float(sliding_sign(x, 0.1)), 4) for x in (-1.0, 0.0, 0.05, 1.0)]
    [-1.0, 0.0, 0.4621, 1.0]
    """
    return jnp.tanh(slip / width)


def length(v: tuple[Array, ...]) -> Array:
    """Return the length of a vector, given by its entries; its derivative at 0 is 0."""
    square = sum(x**2 for x in v)
    zero = square == 0.0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def sliding_share(speed: Array, width: Array) -> Array:
    """Return tanh(speed / width) / speed, with its limit 1 / width at 0: friction per sliding velocity, for a speed >= 0."""
    moving = speed > 1e-6 * width
    return jnp.where(moving, sliding_sign(speed, width) / jnp.where(moving, speed, 1.0), 1.0 / width)


def dry_lever(coefficient: Array, diameter: Array, slip: Array, width: Array) -> Array:
    """Return mu2 (d/2) sign(slip), m: the torque of dry friction per radial load |N| of a bearing.

    >>> round(float(dry_lever(0.0015, 0.02, -3.0, 0.01)), 9)
    -1.5e-05
    """
    return 0.5 * coefficient * diameter * sliding_sign(slip, width)


class DryFriction(Effect):
    """Dry friction in the bearing of each load, proportional to the radial load N of the bearing.

        M = mu2 (d / 2) |N| sign(speed - phi')

    - `reaction="exact"`: N = m (R phi'^2 - n . a - g sin phi), n the load's direction, a the acceleration of the point that
      carries it, g the gravity of the scene. N is linear in the accelerations and is solved together with them
    - `"run_up"`: N = m R phi'^2 - 2 m R speed (speed - phi'), as printed for a run-up (its second term mixes quantities of the
      fixed and the rotating frame)
    - `"steady"`: N = m R speed^2, as printed for loads that turn with the rotor

    Viscous bearing friction is the loads' `drag`, with mu1 = b_W R^2; typical: 3e-4 to 2e-3 N m s.

    |N| is computed as N times the sign that N has in the motion without this friction. This sign is wrong only if |N| is
    smaller than mu2 times the other forces on the load; the error of |N| is then also smaller than this product.

    **Arguments** (SI, or strings with a unit)

    - `coefficient` mu2, at least 0; typical: about 0.0015 for ball bearings, 0.001 to 0.005 for rolling bearings
    - `diameter` d of the bearing, m; typical: 0.005 to 0.05
    - `reaction`: one of the three names above (default: "exact")
    - `width`, rad/s: range of sliding speeds over which the sign is smoothed to tanh((speed - phi')/width); typical: 0.01 (the
      default) to 1. A smaller width is more exact and needs more steps. A load that would stick creeps at the speed width
      artanh(f) relative to the rotor, if the torque on it is the fraction f of the largest friction torque

    **Raises** `InputError` for values that are not allowed. A scene raises it for loads without bearings: balls and rollers,
    and loads that do not move on a circle.

    >>> import jaxvib as jv
    >>> jv.DryFriction(0.0015, diameter="12 mm").reaction
    'exact'

    Source: Artyunin and Sumenkov 2019, equations (1)-(5).
    """

    coefficient: Array = eqx.field(metadata=unit("", low=0.0, words="coefficient of dry friction"))
    diameter: Array = eqx.field(metadata=unit("m", low=0.0, words="diameter of the bearings of the loads"))
    width: Array = eqx.field(metadata=unit("rad/s", low=0.0, open_low=True, words="smoothing width of dry friction"))
    reaction: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(self, coefficient: Number, diameter: Number, reaction: Reaction = "exact", width: Number = 0.01):
        given = {"coefficient": coefficient, "diameter": diameter, "width": width}
        self.coefficient, self.diameter, self.width = read_numbers(DryFriction, "effects.dry_friction", **given).values()
        require_one_of(reaction, get_args(Reaction), "effects.dry_friction.reaction")
        self.reaction = reaction
        self.kind = "dry_friction"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """Return the friction of a ball bearing whose diameter is a fifth of the loads' radius."""
        if not loads.circular:
            return None
        assert isinstance(loads, CircularLoads)
        diameter = 0.2 * jnp.max(loads.radius)
        return Typical(cls(0.0015, diameter), f"a ball bearing, mu2 = 0.0015, of {1e3 * float(diameter):.3g} mm")

    def terms(self) -> tuple[Term, ...]:
        """Return the friction. Without gravity, the half turn phi -> phi + pi, q -> -q does not change the radial load."""
        return (ContactFriction(self.friction, is_half_turn_symmetric=True, smoothing=lambda _: self.width),)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads without bearings, and for loads that do not move on a circle."""
        if not loads.circular:
            raise InputError("effects.dry_friction", f"needs loads on a circle, and the loads are {quoted(loads.kind)}")
        if not loads.has_bearing:
            raise InputError(
                "effects.dry_friction",
                f"needs loads with bearings, and a {loads.kind} has none (property has_bearing); use pendulums, or drag",
            )

    def friction(self, loads: Loads, u: Coordinates, rate: Coordinates, speed: Array, g: Mapping[int, Array]) -> Friction:
        """Return the friction with the lever mu2 (d/2) sign(speed - phi') and the radial load N.

        **Arguments**: `loads` at `u` with rates `rate`; rotor `speed`, rad/s; gravity `g` by axis, m/s^2.
        """
        assert isinstance(loads, CircularLoads)
        turn = rate[0]
        lever = dry_lever(self.coefficient, self.diameter, speed - turn, self.width)
        m, r = loads.mass, loads.radius
        if self.reaction == "steady":
            return Friction(lever, m * r * speed**2 * jnp.ones_like(turn), None)
        if self.reaction == "run_up":
            return Friction(lever, m * r * (turn**2 - 2.0 * speed * (speed - turn)), None)
        return Friction(lever, *loads.normal_force(u, rate, g))
