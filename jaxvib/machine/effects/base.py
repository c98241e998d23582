"""Effects that a scene may call for. An effect that is not in the scene is not in the traced program."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.loads import Loads, Pressing
from jaxvib.units import Number, number

__all__ = [
    "BALANCE_GRADE",
    "Effect",
    "Friction",
    "Gravity",
    "Imbalance",
    "MomentImbalance",
    "SlipLimit",
    "StaticImbalance",
    "Typical",
    "has_half_turn",
    "total_gravity",
]

BALANCE_GRADE = 6.3e-3
"""Eccentricity times speed of a rotor of an ordinary machine, m/s: grade G6.3 of ISO 21940-11."""


_AXES = {"up": 1, "axis": 2}
"""Directions of gravity by the coordinate of a load's position."""


class Friction(NamedTuple):
    """A friction torque `lever` |N| on each load, N = reaction + normal . a, a the acceleration of the point that carries it.

    `lever` (count,) m, signed as the torque on the load; `reaction` (count,) N; `normal` two (count,) arrays (across, up) in
    kg, or None where the reaction does not depend on accelerations; `others` the levers of a load's further coordinates, where
    friction acts on them; `one_sided` whether there is none where N is negative.
    """

    lever: Array
    reaction: Array
    normal: tuple[Array, Array] | None
    others: tuple[Array, ...] = ()
    one_sided: bool = False

    def torque(self, a: Mapping[int, Array]) -> Array:
        """The torque on each load where the points that carry them have the acceleration `a`, by axis, m/s^2; {} for none."""
        return self.forces(a)[0]

    def forces(self, a: Mapping[int, Array]) -> tuple[Array, ...]:
        """The same and the generalised forces on a load's further coordinates that friction acts on."""
        reaction = self._reaction(a)
        size = jnp.maximum(reaction, 0.0) if self.one_sided else jnp.abs(reaction)
        return tuple(lever * size for lever in (self.lever, *self.others))

    def signed(self, a: Mapping[int, Array]) -> Friction:
        """The friction linear in the accelerations, its reaction taken to have the sign that it has at `a`."""
        sign = jnp.where(self._reaction(a) < 0.0, 0.0 if self.one_sided else -1.0, 1.0)
        return self._replace(lever=self.lever * sign, others=tuple(lever * sign for lever in self.others))

    def linear(self, a: Mapping[int, Array]) -> tuple[Array, ...]:
        """As `forces` of a friction that is `signed` already."""
        reaction = self._reaction(a)
        return tuple(lever * reaction for lever in (self.lever, *self.others))

    def _reaction(self, a: Mapping[int, Array]) -> Array:
        if self.normal is None:
            return self.reaction
        return Pressing(self.reaction, self.normal).at(a)


class Imbalance(NamedTuple):
    """A rotor's imbalance: `static` (across, up) kg m, `moment` about the tilts kg m^2."""

    static: tuple[Array, Array]
    moment: tuple[Array, Array]


class SlipLimit(NamedTuple):
    """How far the contact of a rolling load holds: a force along the track up to `coefficient` times N; a slip below `width`,
    m/s, dies out."""

    coefficient: Array
    width: Array


class Typical(NamedTuple):
    """An `effect` with usual numbers, for a scene that leaves it out, and what `says` which numbers these are."""

    effect: Effect
    says: str


def total_gravity(effects: Iterable[Effect]) -> dict[int, Array]:
    """The acceleration of gravity of a scene with these `effects`, m/s^2, by the axis it pulls against; see `Effect`."""
    total: dict[int, Array] = {}
    for effect in effects:
        for axis, g in effect.gravity.items():
            total[axis] = total[axis] + g if axis in total else g
    return total


def has_half_turn(effects: Iterable[Effect]) -> bool:
    """Whether equations with these `effects` stay the same under phi + pi, -q: gravity on the loads breaks it."""
    return all(effect.half_turn_symmetric for effect in effects)


class Effect(eqx.Module):
    """One effect says what it adds by the methods it overrides; what it leaves alone is not in the traced program.

    Its properties say which theories may hold a scene with it; what they refuse, they refuse by naming the property.

    Energies and forces are in J and N; a load's generalised force is in N m for an angle.
    """

    kind: eqx.AbstractVar[str]

    repeatable: ClassVar[bool] = False
    """Whether a scene may hold several of them (supports at several places)."""

    averages_out: ClassVar[bool] = False
    """Whether it leaves the carrier linear, and its mean torque on loads that turn together, over a turn, is 0 to leading order
    of their mass. Theories of turning loads admit such effects, and besides them friction where they say so."""

    half_turn_symmetric: ClassVar[bool] = False
    """Whether the equations with it stay the same under phi + pi, -q: then a jam's deviations have even harmonics only."""

    smooth: ClassVar[bool] = False
    """Whether its forces have all derivatives. Where they bend, or change as fast as dry friction, errors of a time integration
    do not fall with the method's order, and less is counted on where they are estimated."""

    couples_loads: ClassVar[bool] = False
    """Whether loads act on each other by it, so that their order and their distances count."""

    frees_twist: ClassVar[bool] = False
    """Whether rolling loads may spin about the normal of their contact (`Loads.twisting`, `Spin.twist`)."""

    needs_ideal_drive: ClassVar[bool] = False
    """Whether it goes with a drive of given speed alone (property `ideal`)."""

    @property
    def slip_limit(self) -> SlipLimit | None:
        """From which force on the contact of a rolling load slides (`Spin.slip`); None where it always rolls."""
        return None

    @property
    def gravity(self) -> dict[int, Array]:
        """The acceleration of gravity that the effect brings into the scene, m/s^2, by the axis of a load's position (0 across,
        1 up, 2 along the rotor's axis) that it pulls against; {} where it brings none."""
        return {}

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """The effect with usual numbers, as it may be in a `machine` with these `loads` whose scene leaves it out, for an audit
        to put in; None where no number is usual. `speed` of the rotor, rad/s; `amplitude` (nd,) of the motion, m or rad."""
        return None

    def check(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` where the effect does not go with this machine or these loads."""

    def own_rate(self, loads: Loads, speed: Array) -> Array | None:
        """How fast what it adds to the loads' motion goes, rad/s or 1/s, for steps to resolve, at the rotor's `speed`, rad/s;
        None where it adds nothing faster than the loads have by themselves."""
        return None

    def check_start(self, loads: Loads, u: tuple[Array, ...]) -> None:
        """**Raises** `InputError` where loads cannot start from the coordinates `u`, (..., count) each and known."""

    def prepared(self, loads: Loads) -> Effect:
        """The effect for these loads, with all computed that does not change in time; the equations of motion hold this one."""
        return self

    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array | None:
        """Potential energy of the loads, J, an entry a load or a pair of them; None where the effect has none."""
        return None

    def load_resistance(self, loads: Loads, u: tuple[Array, ...], rate: tuple[Array, ...]) -> tuple[Array, ...] | None:
        """Generalised force that takes energy out of the loads' motion among each other, (count,) each; or None."""
        return None

    def friction(
        self, loads: Loads, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array, g: Mapping[int, Array]
    ) -> Friction | None:
        """Friction of each load against the rotor that turns at `speed` under gravity `g`, by axis; see `Friction`. Or None."""
        return None

    def imbalance(self, angle: Array) -> Imbalance | None:
        """The rotor's imbalance at its `angle`, see `Imbalance`; or None."""
        return None

    def place(self, carrier: Carrier) -> Array | None:
        """Rows (k, nd) that give the displacements at which the effect supports the carrier; or None."""
        return None

    def support_potential(self, displacement: Array) -> Array:
        """Potential energy at the displacements (k,) of its place, J."""
        raise NotImplementedError

    def support_resistance(self, displacement: Array, velocity: Array) -> Array | None:
        """Dissipative force on the bed at its place, (k,) N; or None."""
        return None

    @property
    def has_imbalance(self) -> bool:
        """Whether the effect puts the rotor out of balance."""
        return type(self).imbalance is not Effect.imbalance

    @property
    def has_load_potential(self) -> bool:
        """Whether the effect gives the loads a potential energy."""
        return type(self).load_potential is not Effect.load_potential

    @property
    def has_friction(self) -> bool:
        """Whether the effect adds friction of the loads against the rotor."""
        return type(self).friction is not Effect.friction

    def load_force(self, loads: Loads, u: tuple[Array, ...]) -> tuple[Array, ...] | None:
        """Generalised force of the potential on each load, by automatic differentiation; None where there is none."""
        energy, back = jax.vjp(lambda *v: self.load_potential(loads, v), *u)
        return None if energy is None else tuple(-g for g in back(jnp.ones_like(energy)))

    def support_force(self, displacement: Array, velocity: Array) -> Array:
        """Force on the bed at its place, (k,) N; minus that on the carrier."""
        force = jax.grad(self.support_potential)(displacement)
        resistance = self.support_resistance(displacement, velocity)
        return force if resistance is None else force + resistance


class Gravity(Effect):
    """Gravity on the loads: V = m g p_up(u), so a load on a circle feels the torque - m g R cos phi.

    Platforms are counted from static equilibrium, loads' weight included, so that gravity adds nothing there.

    **Arguments**: `g` m/s^2; `along` "up", in the plane in which the rotor turns, or "axis", along a vertical rotor's axis, for
    loads that move along it: V = m g p_axis(u).

    **Raises** `InputError` for a wrong unit, a negative value or another direction, and, by the scene, for loads that do not
    move along the axis where gravity does.

    >>> import jaxvib as jv
    >>> float(jv.Gravity().g)
    9.81
    """

    averages_out = True
    smooth = True

    g: Array
    along: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(self, g: Number = 9.81, along: Literal["up", "axis"] = "up"):
        self.g = number(g, "m/s^2", "effects.gravity.g", low=0.0)
        require_one_of(along, _AXES, "effects.gravity.along")
        self.along = along
        self.kind = "gravity"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """In the rotor's plane, along the axis where loads move there."""
        if len(jax.eval_shape(loads.position, *loads.rest())) > _AXES["axis"]:
            return Typical(cls(along="axis"), "g = 9.81 m/s^2 along the axis, where that is vertical")
        return Typical(cls(), "g = 9.81 m/s^2 in the rotor's plane, where the axis lies level")

    @property
    def gravity(self) -> dict[int, Array]:
        """g, against the direction it is given for."""
        return {_AXES[self.along]: self.g}

    def check(self, machine: Machine, loads: Loads) -> None:
        """Loads that move in gravity's direction."""
        if len(jax.eval_shape(loads.position, *loads.rest())) <= _AXES[self.along]:
            problem = f"goes with loads that move along the rotor's axis, which {loads.kind!r} do not; leave gravity out"
            raise InputError("effects.gravity.along", f"is {quoted(self.along)}; it {problem}")

    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array:
        """m g p_up(u), or p_axis(u)."""
        return loads.mass * self.g * loads.position(*u)[_AXES[self.along]]


class StaticImbalance(Effect):
    """The rotor's mass centre lies off its axis, by e (cos(theta + angle), sin(theta + angle)) at the rotor's angle theta.

    The force on the carrier, where the rotor sits, is - M e d^2/dt^2 of that direction.

    **Arguments**: `moment` M e, kg m, not negative; `angle` rad, of the heavy side when the rotor's angle is 0.

    **Raises** `InputError` for a wrong unit or a negative moment.

    >>> import jaxvib as jv
    >>> float(jv.StaticImbalance("9.25 g m").moment)
    0.00925

    Source: Artyunin 2013, equation (1), the terms with M e.
    """

    averages_out = True
    smooth = True

    moment: Array
    angle: Array
    kind: str = eqx.field(static=True)

    def __init__(self, moment: Number, angle: Number = 0.0):
        self.moment = number(moment, "kg m", "effects.static_imbalance.moment", low=0.0)
        self.angle = number(angle, "rad", "effects.static_imbalance.angle")
        self.kind = "static_imbalance"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """`BALANCE_GRADE` of all the mass that the rotor moves."""
        moment = _carried(machine)[0] * BALANCE_GRADE / speed
        return Typical(cls(moment), f"{1e3 * float(moment):.3g} g m, grade G6.3 of all the mass that moves with the rotor")

    def imbalance(self, angle: Array) -> Imbalance:
        """M e (cos, sin) of the heavy side."""
        zero = jnp.zeros_like(self.moment)
        turned = angle + self.angle
        return Imbalance((self.moment * jnp.cos(turned), self.moment * jnp.sin(turned)), (zero, zero))


class MomentImbalance(Effect):
    """The rotor's principal axis leans by a small angle delta to its axis of rotation.

    It turns the carrier about its tilts with the moment - (A - C) delta d^2/dt^2 (cos(theta + angle), sin(theta + angle)).

    **Arguments**: `moment` (A - C) delta, kg m^2, of either sign; `angle` rad (- gamma in the paper).

    **Raises** `InputError` for a wrong unit, and, by the scene, for a machine that cannot tilt.

    >>> import jaxvib as jv
    >>> float(jv.MomentImbalance(4e-4).moment)
    0.0004

    Source: Artyunin 2013, equation (1), the terms with (A - C) delta.
    """

    averages_out = True
    smooth = True

    moment: Array
    angle: Array
    kind: str = eqx.field(static=True)

    def __init__(self, moment: Number, angle: Number = 0.0):
        self.moment = number(moment, "kg m^2", "effects.moment_imbalance.moment")
        self.angle = number(angle, "rad", "effects.moment_imbalance.angle")
        self.kind = "moment_imbalance"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """`BALANCE_GRADE` at the radius of gyration on either side, where the machine can tilt."""
        mass, inertia = _carried(machine)
        if inertia is None:
            return None
        moment = jnp.sqrt(mass * inertia) * BALANCE_GRADE / speed
        return Typical(cls(moment), f"{1e3 * float(moment):.3g} g m^2, grade G6.3 at the radius of gyration")

    def imbalance(self, angle: Array) -> Imbalance:
        """(A - C) delta (cos, sin) of the moment."""
        zero = jnp.zeros_like(self.moment)
        turned = angle + self.angle
        return Imbalance((zero, zero), (self.moment * jnp.cos(turned), self.moment * jnp.sin(turned)))

    def check(self, machine: Machine, loads: Loads) -> None:
        """A machine that can tilt."""
        if machine.carrier().tilt is None:
            raise InputError("effects.moment_imbalance", f"goes with a rotor that can tilt, not with {quoted(machine.kind)}")


def _carried(machine: Machine) -> tuple[Array, Array | None]:
    """The mass (kg) that a force at the port meets, and the inertia (kg m^2) that a moment meets; None where nothing tilts."""
    carrier = machine.carrier()
    mass = 1.0 / (carrier.port @ jnp.linalg.solve(carrier.mass, carrier.port.T))[0, 0]
    if carrier.tilt is None:
        return mass, None
    return mass, 1.0 / (carrier.tilt @ jnp.linalg.solve(carrier.mass, carrier.tilt.T))[0, 0]
