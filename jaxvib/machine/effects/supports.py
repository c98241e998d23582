"""Nonlinear supports: cubic springs, stops and dry friction."""

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect, Typical
from jaxvib.machine.effects.friction import length, sliding_share, sliding_sign
from jaxvib.machine.effects.terms import SupportForce, Term
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number

Side = Literal["above", "below", "both"]


class _Support(Effect):
    """Support on the foundation at a platform, or around a rotor's axis at a distance from the rotor's centre of mass. A
    subclass may also act between two platforms."""

    repeatable = True
    platform: eqx.AbstractVar[int | None]
    position: eqx.AbstractVar[Array | None]

    def rows(self, machine: Machine) -> Array:
        """Return the matrix (1, nd) or (2, nd) that gives the displacement of the platform, or of the point of the axis in its
        two directions, from the nd coordinates of a `machine`.

        **Raises** `InputError` for a place that the machine does not have.
        """
        if machine.places in ("plane", "number"):
            problem = f"acts on a platform or around a rotor's axis, not on {quoted(machine.kind)}; leave it out"
            raise InputError(f"effects.{self.kind}", problem)
        if self.position is None:
            return machine.rows_at(self.platform, f"effects.{self.kind}.platform")
        return machine.rows_at(self.position, f"effects.{self.kind}.position")


def _read_place(
    part: type[_Support], kind: str, platform: int | None, position: Number | None
) -> tuple[int | None, Array | None]:
    if platform is not None and position is not None:
        raise InputError(f"effects.{kind}", "has both a platform and a position; give one of them")
    platform = None if platform is None else _read_platform(kind, "platform", platform)
    return platform, read_numbers(part, f"effects.{kind}", position=position)["position"]


def _read_platform(kind: str, name: str, number: int) -> int:
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise InputError(f"effects.{kind}.{name}", f"is {quoted(number)}; it must be a whole number, at least 1")
    return number


class CubicSupport(_Support):
    """Hardening (or softening) support: force k3 r^2 x on the foundation; x is the displacement of the supported point from its
    rest position, and r = |x|.

    **Arguments** (SI, or strings with a unit)

    - `stiffness` k3, N/m^3, negative for a softening support; typical: 1e7 to 1e10. It stiffens a support k by 1 % at the
      amplitude a if (3/4) k3 a^2 = 0.01 k: 3e7 for 5e4 N/m and 5 mm
    - `platform`: number, from 1, of the platform on which the support acts (default: 1)
    - `position`: distance along a rotor's axis from the rotor's centre of mass, m, in place of the platform; typical: -0.5 to
      0.5; default: the station of the loads, or the centre of mass if each load has a separate station

    **Raises** `InputError` for values that are not allowed. A scene raises it for a place that the machine does not have.

    >>> import jaxvib as jv
    >>> float(jv.CubicSupport("2e9 N/m^3", platform=2).stiffness)
    2000000000.0
    """

    stiffness: Array = eqx.field(metadata=unit("N/m^3", words="stiffness of the cubic support", typical=1e9))
    platform: int | None = eqx.field(static=True)
    position: Array | None = eqx.field(metadata=unit("m", words="position of the cubic support", typical=0.1))
    kind: str = eqx.field(static=True)

    def __init__(self, stiffness: Number, platform: int | None = None, position: Number | None = None):
        self.kind = "cubic_support"
        self.stiffness = read_numbers(CubicSupport, "effects.cubic_support", stiffness=stiffness)["stiffness"]
        self.platform, self.position = _read_place(CubicSupport, self.kind, platform, position)

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """Return a cubic support whose stiffness, averaged over an oscillation of the amplitude a, is 1 % of the linear one k.

        Its coefficient follows from (3/4) k3 a^2 = 0.01 k. The support is at the supported platform with the largest motion, or
        around the rotor's axis.
        """
        carrier = machine.carrier()
        is_length = jnp.asarray([each == "m" for each in carrier.units])
        is_supported = jnp.any(carrier.foundation_stiffness != 0.0, axis=0)
        motion = jnp.where(is_supported & is_length, jnp.abs(amplitude), 0.0)
        largest = int(jnp.argmax(motion))
        a = motion[largest]
        if not float(a) > 0.0:
            return None
        platform = largest + 1 if machine.places == "platform" else None
        position = 0.0 if machine.places == "shaft" else None
        stiffness = jnp.max(jnp.abs(carrier.foundation_stiffness[:, largest])) * 0.04 / (3.0 * a**2)
        return Typical(
            cls(stiffness, platform, position),
            f"mean stiffness 1 % of that of the support at an amplitude of {1e3 * float(a):.3g} mm",
        )

    def terms(self) -> tuple[Term, ...]:
        """Return the force of the spring."""
        return (SupportForce(self.rows, self.energy, is_smooth=True),)

    def energy(self, displacement: Array) -> Array:
        """Return k3 r^4 / 4, J, at the `displacement` (k,), m."""
        return 0.25 * self.stiffness * jnp.sum(displacement**2) ** 2


class Stop(_Support):
    """Stop beyond a gap: force k (x - gap) + c x' on the foundation while it presses; it never pulls.

    x is the displacement toward the stop. A stop of a platform is above the platform, below it, or on both sides. Around a
    rotor's axis it is a ring of radius `gap`.

    **Arguments** (SI, or strings with a unit)

    - `stiffness` k, N/m, at least 0; typical: 1e5 to 1e7, that is 10 to 100 times that of the support. A stiffer stop needs
      shorter steps
    - `gap`: displacement at which the contact begins, m, at least 0; typical: 0.001 to 0.02
    - `damping` c, N s/m, at least 0 (the default); typical: 0 to 5000. Equal steps must resolve the decay rate c/M of a mass M
    - `side` of the platform: "above", "below" or "both" (the default); around a rotor's axis only "both"
    - `platform`: number, from 1, of the platform whose motion the stop limits (default: 1)
    - `position`: distance along a rotor's axis from the rotor's centre of mass, m, in place of the platform; typical: -0.5 to
      0.5; default: the station of the loads, or the centre of mass if each load has a separate station

    **Raises** `InputError` for values that are not allowed. A scene raises it for a place that the machine does not have.

    >>> import jaxvib as jv
    >>> float(jv.Stop("5 kN/mm", gap="3 mm", side="below").gap)
    0.003
    """

    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, words="stiffness of the stop"))
    gap: Array = eqx.field(metadata=unit("m", low=0.0, words="gap of the stop"))
    damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, words="damping of the stop"))
    side: Side = eqx.field(static=True)
    platform: int | None = eqx.field(static=True)
    position: Array | None = eqx.field(metadata=unit("m", words="position of the stop", typical=0.1))
    kind: str = eqx.field(static=True)

    def __init__(
        self,
        stiffness: Number,
        gap: Number,
        damping: Number = 0.0,
        side: Side = "both",
        platform: int | None = None,
        position: Number | None = None,
    ):
        self.kind = "stop"
        given = read_numbers(Stop, "effects.stop", stiffness=stiffness, gap=gap, damping=damping)
        self.stiffness, self.gap, self.damping = given.values()
        require_one_of(side, get_args(Side), "effects.stop.side")
        self.side = side
        self.platform, self.position = _read_place(Stop, self.kind, platform, position)

    def penetration(self, displacement: Array, side: Side | None = None) -> tuple[Array, Array]:
        """Return the penetration beyond the gap, m (negative without contact), and its direction (k,).

        **Arguments**: `displacement` (k,), m; `side` of a platform (default: the `side` of the stop). For the side "both" the
        displacement is compared with the gap on the side to which it points.
        """
        if displacement.shape[0] == 1:
            x = displacement[0]
            signs = {"above": jnp.ones_like(x), "below": -jnp.ones_like(x)}
            sign = signs.get(side or self.side, jnp.where(x < 0.0, -1.0, 1.0))
            return sign * x - self.gap, sign[None]
        square = jnp.sum(displacement**2)
        distance = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
        return distance - self.gap, displacement / jnp.where(distance > 0.0, distance, 1.0)

    def terms(self) -> tuple[Term, ...]:
        """Return the force of spring and damper."""
        force = SupportForce(
            self.rows,
            self.energy,
            self.resistance,
            stiffness=self.stiffness,
            contact_damping=self.damping,
            penetration=self.penetration,
        )
        return (force,)

    def rows(self, machine: Machine) -> Array:
        """Return the matrix (1, nd) or (2, nd) that gives the displacement of the place on a `machine` with nd coordinates.

        **Raises** `InputError` for a ring with a `side` other than "both".
        """
        rows = super().rows(machine)
        if rows.shape[0] > 1 and self.side != "both":
            raise InputError("effects.stop.side", f"is {quoted(self.side)}; around a rotor's axis it must be 'both'")
        return rows

    def energy(self, displacement: Array) -> Array:
        """Return k (x - gap)^2 / 2 beyond the gap, J, at the `displacement` (k,), m."""
        penetration, _ = self.penetration(displacement)
        return 0.5 * self.stiffness * jnp.maximum(penetration, 0.0) ** 2

    def resistance(self, displacement: Array, velocity: Array) -> Array:
        """Return the force of the damper, (k,) N, at the `displacement` (m) and the `velocity` (m/s).

        It is c x' during contact, but at least minus the force of the spring, because a stop never pulls.
        """
        penetration, direction = self.penetration(displacement)
        closing = self.damping * jnp.sum(direction * velocity)
        return jnp.where(penetration > 0.0, jnp.maximum(closing, -self.stiffness * penetration), 0.0) * direction


class FrictionSupport(_Support):
    """Dry friction at a support or in a link: guides, rubbing shear mounts, leaf springs whose leaves rub.

        force F tanh(|v|/width) v/|v| on the foundation,    v the velocity of the platform, or relative to the platform `to`

    - Coulomb friction is the limit of a small `width`. An oscillation with the largest speed v loses less energy than with
      Coulomb friction; the relative difference is (pi^2/24) (width/v)^2 = 0.41 (width/v)^2
    - A machine that would stick under the force f < F creeps at the speed width artanh(f/F)
    - The amplitude of a free vibration on a spring k decreases by 4 F/k per period

    **Arguments** (SI, or strings with a unit)

    - `force` F, N, at least 0; typical: 1 % to 10 % of the largest force of the spring next to it
    - `width`, m/s: range of velocities over which the sign of v is smoothed; typical: 0.01 (the default), 1 % to 10 % of the
      largest velocity. Explicit steps must resolve the decay rate F/(width M) of a mass M that sticks
    - `platform`: number, from 1, of the platform on which the friction acts (default: 1)
    - `position`: distance along a rotor's axis from the rotor's centre of mass, m, in place of the platform; typical: -0.5 to
      0.5; default: the station of the loads, or the centre of mass if each load has a separate station
    - `to`: number of a second platform if the friction acts in the link between both; default: on the foundation

    **Raises** `InputError` for values that are not allowed. A scene raises it for a place that the machine does not have.

    >>> import jaxvib as jv
    >>> float(jv.FrictionSupport("0.2 kN", platform=2, to=1).force)
    200.0

    Source: Den Hartog 1931 for the vibration with Coulomb friction, with which the tests compare.
    """

    force: Array = eqx.field(metadata=unit("N", low=0.0, words="friction force at the support"))
    width: Array = eqx.field(metadata=unit("m/s", low=0.0, open_low=True, words="smoothing width of support friction"))
    platform: int | None = eqx.field(static=True)
    position: Array | None = eqx.field(metadata=unit("m", words="position of the friction support", typical=0.1))
    to: int | None = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(
        self,
        force: Number,
        width: Number = 0.01,
        platform: int | None = None,
        position: Number | None = None,
        to: int | None = None,
    ):
        self.kind = "friction_support"
        given = read_numbers(FrictionSupport, "effects.friction_support", force=force, width=width)
        self.force, self.width = given.values()
        self.platform, self.position = _read_place(FrictionSupport, self.kind, platform, position)
        self.to = to if to is None else _read_platform(self.kind, "to", to)
        if to is not None and (position is not None or to == (platform or 1)):
            problem = f"is {to}, and the friction acts between two different platforms; give their numbers"
            raise InputError("effects.friction_support.to", problem)

    def rows(self, machine: Machine) -> Array:
        """Return the matrix (1, nd) or (2, nd) that gives the displacement on which the friction acts: that of the platform
        (relative to the platform `to`, if there is one), or that of the point of the axis in its two directions.

        **Raises** `InputError` for a place that the machine does not have.
        """
        rows = super().rows(machine)
        return rows if self.to is None else rows - machine.rows_at(self.to, "effects.friction_support.to")

    def terms(self) -> tuple[Term, ...]:
        """Return the force of the friction."""
        damping, is_link = self.force / self.width, self.to is not None
        return (SupportForce(self.rows, self.energy, self.resistance, damping=damping, is_link=is_link),)

    def energy(self, displacement: Array) -> Array:
        """Return 0 at any `displacement`: friction has no potential."""
        return jnp.zeros_like(displacement[0])

    def resistance(self, displacement: Array, velocity: Array) -> Array:
        """Return F tanh(|v|/width) v/|v|, (k,) N, at the `velocity` v (k,), m/s, and any `displacement`."""
        if velocity.shape[0] == 1:
            return self.force * sliding_sign(velocity, self.width)
        return self.force * sliding_share(length(tuple(velocity)), self.width) * velocity
