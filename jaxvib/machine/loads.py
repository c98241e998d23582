"""Base class of loads, and loads on a circle: balls, rollers and pendulums."""

import abc
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.boundary import validated, with_known_names
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.units import Number, Numbers, count, number
from jaxvib.units.known import when_known

MASS = unit("kg", low=0.0, open_low=True, each="load")
DRAG = unit("N s/m", low=0.0, each="load")
BALL_RADIUS = unit("m", low=0.0, open_low=True, words="radius of each {load}")


class NormalForce(NamedTuple):
    """Normal force N = `static_normal_force` + `normal_force_per_acceleration` . a of each load on its track.

    a is the acceleration of the point that carries the load. `static_normal_force` (count,), N, is the value of N at a = 0: it
    contains the centrifugal force and the weight. `normal_force_per_acceleration` is in kg, two arrays (count,) for horizontal
    and up.
    """

    static_normal_force: Array
    normal_force_per_acceleration: tuple[Array, Array]

    def at(self, a: Mapping[int, Array]) -> Array:
        """Return N (count,) if the points that carry the loads have the acceleration `a`, by axis."""
        return self.static_normal_force + sum(self.normal_force_per_acceleration[axis] * x for axis, x in a.items())


class DrillingSpin(NamedTuple):
    """Dynamics of the drilling spin s of each load: its spin about the normal of its contact, relative to its track.

    - `rate` s' (count,) rad/s^2 of a free spin
    - `force`: generalized forces divided by the spin s, one (count,) array for each coordinate
    - `inertia`, kg m^2; the energy of the spin is inertia s^2/2
    - `without_rotation` (count,) rad/s: the value of s for a load that does not rotate in space
    """

    rate: Array
    force: tuple[Array, ...]
    inertia: Array
    without_rotation: Array


class Loads(Part):
    """Loads that move on the machine. A new kind of load is a subclass with its own position function.

    Arrays have one entry per load, or are scalars shared by all loads; functions act elementwise on (count,) arrays.

    A load has one or several coordinates u. The first is its angle about the rotor's axis, rad; its generalized force is the
    torque that the load takes from the rotor. The analyses of jams and of balance accept `CircularLoads` only.

    **Attributes**

    - `mass` of a load, kg; typical: 0.05 to 1
    - `count`: number of loads; typical: 1 to 4
    - `kind`: name of this kind of loads in scene files

    >>> import equinox as eqx, jax, jax.numpy as jnp, jaxvib as jv
    >>> class Beads(jv.Loads):
    ...     '''Beads on an elliptic wire with the half axes R and R/2.'''
    ...
    ...     mass: jax.Array
    ...     radius: jax.Array
    ...     drag: jax.Array
    ...     count: int = eqx.field(static=True)
    ...     kind: str = eqx.field(static=True, default="bead", kw_only=True)
    ...
    ...     def position(self, u):
    ...         return self.radius * jnp.cos(u), 0.5 * self.radius * jnp.sin(u)
    ...
    ...     def rest(self):
    ...         return (jnp.full((self.count,), -0.5 * jnp.pi),)
    ...
    ...     def inertia_factor(self):
    ...         return jnp.ones_like(self.mass)
    ...
    ...     def resistance(self, u, rate, speed):
    ...         return (self.drag * self.radius**2 * (speed - rate[0]),)
    >>> Beads(mass=jnp.asarray(0.5), radius=jnp.asarray(0.1), drag=jnp.asarray(1.0), count=2).arm().round(3).tolist()
    [0.05, 0.05]
    """

    mass: eqx.AbstractVar[Array]
    count: eqx.AbstractVar[int]
    kind: eqx.AbstractVar[str]

    one_sided: ClassVar[bool] = False
    """True if the track only pushes: a load whose normal force is negative would leave it."""

    circular: ClassVar[bool] = False
    """True if position and forces are those of `CircularLoads`, which the analyses of jams and of balance require."""

    @property
    def has_bearing(self) -> bool:
        """True if each load is attached to the shaft by its own bearing, as a pendulum is."""
        return False

    @abc.abstractmethod
    def position(self, *u: Array) -> tuple[Array, ...]:
        """Return the load's position p(u), m: (horizontal, up), and along the rotor's axis if the load moves in this direction.

        **Arguments**: the coordinates `u`, (count,) each.
        """

    def tangent_lengths(self) -> tuple[Array, ...] | None:
        """Return |dp/du_i| m if they are constant along the track and the tangents are orthogonal; otherwise None.

        With J = dp/du, J^T J is then a constant diagonal matrix and J^T (dJ/dt) u' = 0; the equations compute neither.
        """
        return None

    @abc.abstractmethod
    def rest(self) -> tuple[Array, ...]:
        """Return the coordinates u of loads at rest, all at one point, (count,) each."""

    def arm(self) -> Array:
        """Return the distance of each load at rest from the rotor's axis, (count,) m."""
        across, up, *_ = self.position(*self.rest())
        return jnp.hypot(across, up)

    @abc.abstractmethod
    def inertia_factor(self) -> Array:
        """Return kappa: the inertia of a load along its track, divided by the inertia of an equal point mass."""

    @abc.abstractmethod
    def resistance(self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array) -> tuple[Array, ...]:
        """Return the generalized force of the viscous resistance against the rotor, (count,) N m for the angle.

        **Arguments**: coordinates `u` and their rates `rate`, (count,) each; `speed` of the rotor, rad/s.
        """

    def spin_force(self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array) -> tuple[Array, ...] | None:
        """Return the generalized force, N m, of the gyroscopic moment of a rolling load; it does no work. None if there is no
        such moment.

        **Arguments**: coordinates `u` and their rates `rate`, (count,) each; `speed` of the rotor, rad/s.
        """
        return None

    def drilling_spin(
        self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array, slip: tuple[Array, ...] | None = None
    ) -> DrillingSpin | None:
        """Return the dynamics of a spin about the normal of the contact; None for loads that are not coupled to it.

        **Arguments**: coordinates `u` and their rates `rate`, (count,) each; `speed` of the rotor, rad/s; `slip` of the contact
        along each coordinate, m/s, if it may slide.
        """
        return None

    def normal_force(self, u: tuple[Array, ...], rate: tuple[Array, ...], g: Mapping[int, Array | float]) -> NormalForce | None:
        """Return the force of the loads on their track; None if it is not defined.

        **Arguments**: coordinates `u` and their rates `rate`, (count,) each; `g`: the vector opposite to the acceleration of
        gravity, m/s^2, as a mapping from the axis (0 horizontal, 1 up, 2 along the rotor's axis) to the component.
        """
        return None

    def offsets(self) -> Array:
        """Return the angles of loads at rest that lie side by side, relative to their middle, (count,) rad; 0 if all are at
        one point."""
        return jnp.zeros((self.count,), dtype=jnp.result_type(self.mass))

    def natural_frequency(self, speed: Array) -> Array | None:
        """Return the natural frequency of the loads, rad/s, which steps must resolve in addition to the rotor's `speed`.

        None if there is no such frequency.
        """
        return None


def ball_radius(loads: Loads, field: str = "loads.ball_radius") -> Array:
    """Return the radius r of loads that have a size, m. **Raises** `InputError`, which names the `field`, for other loads."""
    radius = getattr(loads, "ball_radius", None)
    if radius is None:
        advice = "give balls or rollers their ball_radius"
        raise InputError(
            field, f"needs loads that roll and have a ball_radius, and these ({quoted(loads.kind)}) have none; {advice}"
        )
    return radius


class CircularLoads(Loads):
    """Loads on a circle of radius R about the rotor's axis: p(phi) = R (cos phi, sin phi).

        kappa m R^2 phi'' = - b_W R^2 (phi' - speed) - m p'(phi) . (acceleration of the mount)

    kappa is 7/5 for a ball and 3/2 for a roller that roll on the track, 1 + J_C/(m R^2) for a pendulum.

    **Attributes** (scalar: shared by all loads; or (count,)); typical values: see `balls` and `pendulums`

    - `mass` m, kg
    - `radius` R of the circle of the centres of mass, m
    - `drag` b_W at that radius, N s/m
    - `inertia` J_C about the centre of mass, kg m^2 (pendulums; None for the others)
    - `count` N of loads
    - `kind`: "ball", "roller" or "pendulum"
    - `ball_radius` r of a ball or roller, m (scalar); None for loads that can all be at one point. If it is set, gathered
      loads lie side by side on an arc, 2 arcsin(r/R) apart

    Source: the antiphase paper, equations (1), (2), (6).
    """

    mass: Array = eqx.field(metadata=MASS)
    radius: Array = eqx.field(metadata=unit("m", low=0.0, open_low=True, words="track radius", each="load"))
    drag: Array = eqx.field(metadata=DRAG)
    inertia: Array | None = eqx.field(metadata=unit("kg m^2", low=0.0, words="moment of inertia", each="load"))
    count: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    ball_radius: Array | None = eqx.field(metadata=BALL_RADIUS, default=None)

    circular: ClassVar[bool] = True

    def __init_subclass__(cls, **options: Any) -> None:
        """Set `circular` of a subclass: False if it has a position or forces of its own."""
        super().__init_subclass__(**options)
        methods = ("position", "resistance", "spin_force", "drilling_spin")
        cls.circular = not any(
            name in vars(base) for base in cls.__mro__[: cls.__mro__.index(CircularLoads)] for name in methods
        )

    @property
    def has_bearing(self) -> bool:
        """True for pendulums; balls and rollers roll on their track."""
        return self.inertia is not None

    @property
    def alike(self) -> bool:
        """True if each parameter is a single number that all loads share; False for arrays, even of equal numbers."""
        return all(x is None or x.ndim == 0 for x in (self.mass, self.radius, self.drag, self.inertia))

    def position(self, *u: Array) -> tuple[Array, Array]:
        """Return R (cos phi, sin phi)."""
        (phi,) = u
        return self.radius * jnp.cos(phi), self.radius * jnp.sin(phi)

    def tangent_lengths(self) -> tuple[Array]:
        """Return R."""
        return (self.radius,)

    def rest(self) -> tuple[Array]:
        """Return phi = -pi/2, the bottom of the track."""
        return (jnp.full((self.count,), -0.5 * jnp.pi, dtype=jnp.result_type(self.radius)),)

    def inertia_factor(self) -> Array:
        """Return 7/5 (ball), 3/2 (roller), 1 + J_C/(m R^2) (pendulum)."""
        if self.inertia is not None:
            return 1.0 + self.inertia / (self.mass * self.radius**2)
        factors = {"ball": 1.4, "roller": 1.5}
        if self.kind not in factors:
            needed = "loads of this kind need a moment of inertia, or a method inertia_factor of their own"
            raise InputError("loads.kind", f"is {quoted(self.kind)}; {needed}")
        return jnp.asarray(factors[self.kind], dtype=self.mass.dtype)

    def resistance(self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array) -> tuple[Array, ...]:
        """Return - b_W R^2 (phi' - speed)."""
        (rate_phi,) = rate
        return (self.drag * self.radius**2 * (speed - rate_phi),)

    def normal_force(self, u: tuple[Array, ...], rate: tuple[Array, ...], g: Mapping[int, Array | float]) -> NormalForce:
        """Return N = m (R phi'^2 - n . (a + g)), n the load's direction, away from the axis."""
        (phi,), (turn,), m = u, rate, self.mass
        normal = (jnp.cos(phi), jnp.sin(phi))
        return NormalForce(m * (self.radius * turn**2 - g.get(1, 0.0) * normal[1]), (-m * normal[0], -m * normal[1]))

    def offsets(self) -> Array:
        """Return (2 j - N + 1) arcsin(r/R), (count,) rad: the angles of loads j = 0 .. N - 1 side by side, relative to their
        middle."""
        if self.ball_radius is None:
            return jnp.zeros((self.count,), dtype=jnp.result_type(self.radius))
        return side_by_side(self.count, self.ball_radius / self.radius)

    def unbalance(self) -> Array:
        """Return the unbalance of coincident loads, kg m: sum m R at one point, m R sin(N arcsin(r/R)) / (r/R) side by side."""
        whole = jnp.sum(jnp.broadcast_to(self.mass * self.radius, (self.count,)))
        return whole if self.ball_radius is None else whole * jnp.mean(jnp.cos(self.offsets()))

    def drag_sum(self) -> Array:
        """Return sum b_W R^2 of all loads, N m s: the driving torque per difference of speed from the rotor."""
        return jnp.sum(jnp.broadcast_to(self.drag * self.radius**2, (self.count,)))


def _circular(
    kind: str,
    count_: int,
    mass: Numbers,
    radius: Number,
    drag: Numbers,
    inertia: Numbers | None,
    ball_radius: Number | None = None,
) -> CircularLoads:
    n = count(count_, "loads.count", each=256)
    given = {"mass": mass, "radius": radius, "drag": drag, "inertia": inertia, "ball_radius": ball_radius}
    loads = CircularLoads(**read_numbers(CircularLoads, "loads", n, **given), count=n, kind=kind)
    if loads.ball_radius is not None:
        _require_room(loads, loads.ball_radius)
    return loads


def _require_room(loads: CircularLoads, r: Array) -> None:
    """**Raises** `InputError` if the loads, of radius `r`, have no room side by side."""
    if not loads.alike:
        raise InputError("loads.ball_radius", "needs equal loads; give one mass, radius and drag for all")
    when_known(partial(require_side_by_side, loads.count), loads.radius, r)


def side_by_side(count: int, ratio: Array) -> Array:
    """Return (2 j - N + 1) arcsin(`ratio`), (count,) rad: angles of touching loads j = 0 .. N - 1, relative to their middle."""
    angle = jnp.arcsin(ratio)
    return jnp.arange(1 - count, count, 2, dtype=angle.dtype) * angle


def require_side_by_side(count: int, radius: float, ball_radius: float) -> None:
    """**Raises** `InputError` if `count` loads of `ball_radius`, m, have no room side by side on a circle of `radius`, m."""
    limit = radius * (1.0 if count == 1 else math.sin(math.pi / count))
    if not ball_radius < limit:
        problem = f"{count} side by side on a circle of {radius:.6g} m need a ball_radius below {limit:.6g} m"
        raise InputError("loads.ball_radius", f"is {ball_radius:.6g} m; {problem}")


DENSITIES = {"steel": 7850.0, "silicon nitride": 3200.0, "tungsten carbide": 14900.0}
"""Densities of materials of balls, kg/m^3."""


@validated
def ball_mass(ball_radius: Number, material: str = "steel") -> Array:
    """Return the mass of a solid ball, m = (4/3) pi r^3 rho, kg.

    **Arguments**

    - `ball_radius` r, m, or a string with a unit; typical: 0.005 to 0.03
    - `material`: "steel" (7850 kg/m^3), "silicon nitride" (3200 kg/m^3) or "tungsten carbide" (14900 kg/m^3)

    In scene files `mass = { material = "steel" }` of balls computes the mass with their `ball_radius`.

    **Returns** an array with one number, with derivatives. **Raises** `InputError` for another material, and for a radius that
    is not positive.

    >>> import jaxvib as jv
    >>> round(1e3 * float(jv.ball_mass("12.5 mm")), 1)     # g
    64.2

    Source: volume of a sphere; densities from data sheets of balls for bearings.
    """
    require_one_of(material, tuple(DENSITIES), "material")
    return 4.0 / 3.0 * jnp.pi * number(ball_radius, "m", "ball_radius", low=0.0, open_low=True) ** 3 * DENSITIES[material]


@with_known_names
def balls(*, count: int, mass: Numbers, radius: Number, drag: Numbers, ball_radius: Number | None = None) -> CircularLoads:
    """Return balls that roll in an annular track, kappa = 7/5.

        kappa m R^2 phi'' = - b_W R^2 (phi' - speed) - m p'(phi) . (acceleration of the track),    p = R (cos phi, sin phi)

    phi is the angle of a ball, p its position relative to the rotor's axis, and speed the rotor speed. kappa is the inertia of
    a ball along the track, divided by that of an equal point mass.

    **Arguments** (SI, or strings with a unit such as "800 g")

    - `count` N: number of balls, at least 1; typical: 1 to 4
    - `mass` m of a ball, kg, positive, one number for all or N of them; typical: 0.05 to 1
    - `radius` R of the circle of the balls' centres (radius of an outer track minus `ball_radius`), m, positive, one number for
      all or N of them; typical: 0.05 to 0.3
    - `drag` b_W: viscous resistance of a ball against the rotor, N s/m, one number for all or N of them, 0 is allowed; typical:
      0.5 to 5 for balls of 0.1 to 1 kg in oil
    - `ball_radius` r of a ball, m, one number; typical: 0.01 to 0.03. Without it balls can all be at one point

    Balls with a `ball_radius` are in one track and cannot all be at one point:

    - In jams and in the criterion, gathered balls lie side by side, with the unbalance m R sin(N arcsin(r/R)) / (r/R) instead
      of N m R
    - In time integration only the effect `LoadContact` uses the `ball_radius`. Without this effect loads pass through each
      other, and a run in which they end inside each other has the status `overlapping`

    **Returns** `CircularLoads`.

    **Raises** `InputError` for a count below 1, wrong units, a mass or radius that is not positive, a negative drag, and balls
    that have no room side by side.

    >>> import jaxvib as jv
    >>> float(jv.balls(count=3, mass="800 g", radius=0.12, drag=1.5).unbalance().round(6))
    0.288
    >>> float(jv.balls(count=3, mass="800 g", radius=0.12, drag=1.5, ball_radius="20 mm").unbalance().round(6))
    0.277333

    Source: the antiphase paper, equations (1), (2), (6).
    """
    return _circular("ball", count, mass, radius, drag, None, ball_radius)


@with_known_names
def rollers(*, count: int, mass: Numbers, radius: Number, drag: Numbers, ball_radius: Number | None = None) -> CircularLoads:
    """Return cylindrical rollers in an annular track, kappa = 3/2.

    **Arguments** as for `balls`; the equation is the same

    - `count` N: number of rollers; typical: 1 to 4
    - `mass` m of a roller, kg; typical: 0.1 to 2
    - `radius` R of the circle of the rollers' axes, m; typical: 0.05 to 0.3
    - `drag` b_W: viscous resistance of a roller against the rotor, N s/m; typical: 0.5 to 5
    - `ball_radius` r of a roller, m; typical: 0.01 to 0.03

    **Returns** `CircularLoads`. **Raises** `InputError` in the cases of `balls`.

    >>> import jaxvib as jv
    >>> float(jv.rollers(count=2, mass=1.0, radius=0.1, drag=1.0).inertia_factor())
    1.5

    Source: as for `balls`.
    """
    return _circular("roller", count, mass, radius, drag, None, ball_radius)


@with_known_names
def pendulums(*, count: int, mass: Numbers, radius: Number, drag: Numbers, inertia: Numbers = 0.0) -> CircularLoads:
    """Return pendulums on the shaft, kappa = 1 + J_C/(m R^2).

    **Arguments** as for `balls`; the equation is the same

    - `count` N: number of pendulums; typical: 1 to 4
    - `mass` m of a pendulum, kg; typical: 0.05 to 1
    - `radius` R: distance of the centre of mass from the axis, m; typical: 0.05 to 0.2
    - `drag` b_W at that radius, N s/m: a bearing with the viscous coefficient mu (N m s) has b_W = mu/R^2; typical: 5e-4 to 3,
      that is mu from 3e-6 to 0.02 N m s at R = 0.08 m, up to 0.05 for ball bearings, see `drag_of`
    - `inertia` J_C about the centre of mass, kg m^2 (default 0: a point mass); typical: 0 to 0.5 m R^2

    **Returns** `CircularLoads`. **Raises** `InputError` in the cases of `balls`.

    >>> import jaxvib as jv
    >>> float(jv.pendulums(count=1, mass=2.0, radius=0.1, drag=1.0, inertia=0.01).inertia_factor())
    1.5

    Source: as for `balls`; on a rotor Artyunin 2013, equation (1).
    """
    return _circular("pendulum", count, mass, radius, drag, inertia)
