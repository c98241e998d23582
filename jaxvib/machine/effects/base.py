"""Base class of effects; gravity and imbalances. The traced program contains only the effects of the scene."""

import abc
from collections.abc import Iterable
from typing import ClassVar, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import Machine, Mount
from jaxvib.machine.effects.terms import ContactFriction, Coordinates, GravityField, LoadPotential, RotorImbalance, Term
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.units import Number

T = TypeVar("T", bound=Term)

BALANCE_GRADE = 6.3e-3
"""Eccentricity times speed of an ordinary rotor, m/s: grade G6.3 of ISO 21940-11."""


_AXES = {"up": 1, "axis": 2}
"""Index of the coordinate of a load's position along which gravity acts, by direction."""


class Typical(NamedTuple):
    """Effect with typical values, for a scene that does not have it; `note` describes these values."""

    effect: "Effect"
    note: str


def terms_of(effects: Iterable["Effect"], *kinds: type[T]) -> list[T]:
    """Return the terms of these `kinds` that the effects add.

    >>> import jaxvib as jv
    >>> [float(field.g) for field in terms_of([jv.Gravity(), jv.FreeSpin()], GravityField)]
    [9.81]
    """
    return [term for effect in effects for term in effect.terms() if isinstance(term, kinds)]


def has_term(effects: Iterable["Effect"], *kinds: type[Term]) -> bool:
    """Return True if an effect adds a term of one of these `kinds`."""
    return bool(terms_of(effects, *kinds))


def static_imbalances(effects: Iterable["Effect"]) -> list[RotorImbalance]:
    """Return the imbalances that the effects add, kg m, without moment imbalances."""
    return [term for term in terms_of(effects, RotorImbalance) if not term.about_tilts]


def total_gravity(effects: Iterable["Effect"]) -> dict[int, Array]:
    """Return the acceleration of gravity of a scene with these `effects`, m/s^2, by axis. Gravity points in the negative
    direction of the axis."""
    total: dict[int, Array] = {}
    for field in terms_of(effects, GravityField):
        total[field.axis] = total[field.axis] + field.g if field.axis in total else field.g
    return total


def has_half_turn_symmetry(effects: Iterable["Effect"]) -> bool:
    """Return True if phi -> phi + pi, q -> -q leaves the equations with these `effects` unchanged.

    In a jam the vibration then has odd harmonics only, and the deviation of the load angle even ones. Effects other than
    friction are not examined: the result is then False.
    """
    terms = [term for effect in effects for term in effect.terms()]
    return all(isinstance(term, ContactFriction) and term.is_half_turn_symmetric for term in terms)


class Effect(Part):
    """Physical effect that a scene includes. A new effect is a subclass with its parameters as fields and the method `terms`.
    `kind` is its name in scene files.

    >>> import equinox as eqx, jax, jax.numpy as jnp, jaxvib as jv
    >>> from jaxvib.machine.effects.terms import LoadResistance
    >>> class AirDrag(jv.Effect):
    ...     '''Torque - c phi' on each load, c = `drag`, N m s.'''
    ...
    ...     drag: jax.Array
    ...     kind: str = eqx.field(static=True, default="air_drag", kw_only=True)
    ...
    ...     def terms(self):
    ...         return (LoadResistance(self.resistance, is_smooth=True),)
    ...
    ...     def resistance(self, loads, u, rate):
    ...         return (-self.drag * rate[0],)
    >>> machine, loads = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0)
    >>> scene = jv.Scene(machine, loads, jv.ConstantSpeed(100.0), (AirDrag(drag=jnp.asarray(0.001)),))
    >>> state = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.array([20.0]),))
    >>> round(float(jv.power(scene, 0.0, state)[1]), 2)         # b_W R^2 (n - phi')^2 + c phi'^2
    64.4
    """

    kind: eqx.AbstractVar[str]

    repeatable: ClassVar[bool] = False
    """True if a scene may contain several effects of this class, for example supports at several places."""

    @abc.abstractmethod
    def terms(self) -> tuple[Term, ...]:
        """Return the terms that the effect adds to the equations.

        Terms contain functions and parameters; this method computes nothing.
        """

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """Return the effect with typical values, as `jaxvib.audit` adds it; None for an effect without typical values.

        **Arguments**

        - `machine` and `loads` of the scene
        - `speed` of the rotor, rad/s
        - `amplitude` (nd,) of the motion, m (rad for tilts)
        """
        return None

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` if the effect cannot act on this `machine` or these `loads`."""

    def prepare(self, loads: Loads, mount: Mount) -> "Effect":
        """Return the effect with the quantities that depend on the parameters of the `loads` and on their `mount`, but not on
        time."""
        return self

    def fastest_rate(self, loads: Loads, speed: Array) -> Array | None:
        """Return the fastest rate of the motion that the effect adds, rad/s or 1/s, which steps must resolve.

        The result is None if the effect adds no motion that is faster than that of the `loads` without it. `speed` is the rotor
        speed, rad/s.
        """
        return None


class Gravity(Effect):
    """Gravity on loads, unbalances and static imbalances: V = m g p_up(u).

    V is the potential energy of a load of mass m at its position p(u). On a load on a circle the torque is -m g R cos phi, with
    the radius R and the angle phi. On the rotor of an unbalance S the torque is -S g cos theta, with the angle theta of the
    rotor. Angles are measured from the horizontal direction.

    Displacements of platforms are measured from static equilibrium under the weight of platforms and loads. Gravity therefore
    adds no force on the platforms.

    **Arguments**

    - `g`, m/s^2, at least 0; typical: 9.81 (the default)
    - `along`: "up", in the plane of rotation (horizontal axis, the default), or "axis", along the axis of a vertical rotor, for
      loads that move in that direction: V = m g p_axis(u)

    **Raises** `InputError` for a wrong unit, a negative value or an unknown direction. A scene raises it for gravity along an
    axis in whose direction the loads do not move.

    >>> import jaxvib as jv
    >>> float(jv.Gravity().g)
    9.81
    """

    g: Array = eqx.field(metadata=unit("m/s^2", low=0.0, words="acceleration of gravity"))
    along: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    def __init__(self, g: Number = 9.81, along: Literal["up", "axis"] = "up"):
        self.g = read_numbers(Gravity, "effects.gravity", g=g)["g"]
        require_one_of(along, _AXES, "effects.gravity.along")
        self.along = along
        self.kind = "gravity"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Return gravity in the rotor's plane, or along the axis if loads move in that direction."""
        if len(jax.eval_shape(loads.position, *loads.rest())) > _AXES["axis"]:
            return Typical(cls(along="axis"), "g = 9.81 m/s^2 along a vertical axis")
        return Typical(cls(), "g = 9.81 m/s^2 in the rotor's plane, for a horizontal axis")

    def terms(self) -> tuple[Term, ...]:
        """Return the gravity field, and the potential energy of the loads in it."""
        return GravityField(_AXES[self.along], self.g), LoadPotential(self.energy, is_smooth=True)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for gravity along the axis if the loads do not move in that direction."""
        if len(jax.eval_shape(loads.position, *loads.rest())) <= _AXES[self.along]:
            problem = f"needs loads that move along the rotor's axis, which {loads.kind!r} do not; remove gravity"
            raise InputError("effects.gravity.along", f"is {quoted(self.along)}; it {problem}")

    def energy(self, loads: Loads, u: Coordinates) -> Array:
        """Return m g p_up(u), or m g p_axis(u), (count,) J, of `loads` at the coordinates `u`."""
        return loads.mass * self.g * loads.position(*u)[_AXES[self.along]]


class StaticImbalance(Effect):
    """Static imbalance: the offset of the rotor's centre of mass from its axis is e (cos(theta + angle), sin(theta + angle)).

    theta is the rotor's angle, and M its mass. The force on the machine at the rotor is - M e d^2/dt^2 (cos(theta + angle),
    sin(theta + angle)). With `Gravity` the torque of its weight on the rotor is - M e g cos(theta + angle).

    **Arguments** (SI, or strings with a unit)

    - `moment` M e, kg m, not negative; text: "72 g m" or "0.3 kg x 0.24 m"; typical: 1e-4 to 0.05. Grade G6.3 of ISO 21940-11
      allows M times 6.3 mm/s divided by the speed: 5e-4 for 37 kg at 460 rad/s
    - `angle` of the heavy side at the rotor's angle 0, rad; typical: 0 (the default)

    **Raises** `InputError` for a wrong unit or a negative moment.

    >>> import jaxvib as jv
    >>> float(jv.StaticImbalance("9.25 g m").moment)
    0.00925

    Source: Artyunin 2013, equation (1), the terms with M e.
    """

    moment: Array = eqx.field(metadata=unit("kg m", low=0.0, words="imbalance of the rotor"))
    angle: Array = eqx.field(metadata=unit("rad", words="angle of the imbalance", typical=1.0))
    kind: str = eqx.field(static=True)

    def __init__(self, moment: Number, angle: Number = 0.0):
        given = read_numbers(StaticImbalance, "effects.static_imbalance", moment=moment, angle=angle)
        self.moment, self.angle = given.values()
        self.kind = "static_imbalance"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Return the imbalance at `BALANCE_GRADE` of all the mass that moves with the rotor."""
        moment = _moved_inertia(machine)[0] * BALANCE_GRADE / speed
        return Typical(cls(moment), f"{1e3 * float(moment):.3g} g m, grade G6.3 of all the mass that moves with the rotor")

    def terms(self) -> tuple[Term, ...]:
        """Return the term of the imbalance M e (cos, sin) toward the heavy side."""
        return (RotorImbalance(self.moment, self.angle),)


class MomentImbalance(Effect):
    """Moment imbalance: the rotor's principal axis is inclined to its axis of rotation by a small angle delta.

    The moment about the tilts of the machine is - (A - C) delta d^2/dt^2 (cos(theta + angle), sin(theta + angle)). theta is the
    rotor's angle, A the transverse and C the polar moment of inertia of the rotor.

    **Arguments** (SI, or strings with a unit)

    - `moment` (A - C) delta, kg m^2, of either sign; typical: 1e-5 to 1e-3
    - `angle` (- gamma in the source), rad; typical: 0 (the default)

    **Raises** `InputError` for a wrong unit. A scene raises it for a machine that cannot tilt.

    >>> import jaxvib as jv
    >>> float(jv.MomentImbalance(4e-4).moment)
    0.0004

    Source: Artyunin 2013, equation (1), the terms with (A - C) delta.
    """

    moment: Array = eqx.field(metadata=unit("kg m^2", words="moment imbalance of the rotor", typical=1e-4))
    angle: Array = eqx.field(metadata=unit("rad", words="angle of the moment imbalance", typical=1.0))
    kind: str = eqx.field(static=True)

    def __init__(self, moment: Number, angle: Number = 0.0):
        given = read_numbers(MomentImbalance, "effects.moment_imbalance", moment=moment, angle=angle)
        self.moment, self.angle = given.values()
        self.kind = "moment_imbalance"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical | None:
        """Return mass x radius of gyration x `BALANCE_GRADE` / speed: a couple whose lever arm is the radius of gyration.

        The result is None if the machine cannot tilt.
        """
        mass, inertia = _moved_inertia(machine)
        if inertia is None:
            return None
        moment = jnp.sqrt(mass * inertia) * BALANCE_GRADE / speed
        return Typical(cls(moment), f"{1e3 * float(moment):.3g} g m^2, grade G6.3 at the radius of gyration")

    def terms(self) -> tuple[Term, ...]:
        """Return the term of the moment (A - C) delta (cos, sin)."""
        return (RotorImbalance(self.moment, self.angle, about_tilts=True),)


def _moved_inertia(machine: Machine) -> tuple[Array, Array | None]:
    """Return the mass (kg) that a force on the exciter accelerates, and the inertia (kg m^2) that a moment accelerates (None
    if the machine cannot tilt)."""
    mass, mount = machine.carrier().mass, machine.mount()

    def inertia(rows: Array) -> Array:
        return 1.0 / (rows @ jnp.linalg.solve(mass, rows.T))[0, 0]

    return inertia(mount.rows[0]), None if mount.tilt is None else inertia(mount.tilt)
