"""Machines: their linear structure, places on it, and the mounts of exciters there."""

import abc
import functools
from collections.abc import Hashable, Sequence
from typing import ClassVar, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.boundary import is_whole
from jaxvib.errors import InputError, quoted
from jaxvib.machine.numbers import Part
from jaxvib.results.readable import Readable
from jaxvib.units import Number, conditions_of_traced_values, count, number, numbers


class BodyPoint(Readable):
    """Point (x, y) of one of several bodies, m from its centre of mass; None for the centre itself. `body`: its number,
    counted from 0."""

    at: Array | None
    body: int = eqx.field(static=True)


Place = int | float | Sequence[float] | Array | BodyPoint | None
"""Place on a machine: the number of a platform, the distance along a rotor's axis from its centre of mass, m, or the point (x,
y) of a body in a plane, m; None is the default place of the machine."""


def read_place(at: int | Number | Sequence[Number] | None) -> int | Array | None:
    """Return a place from a user's argument `at`: the number of a platform, or a distance or a point in m.

    **Raises** `InputError` for values that are neither a number nor a list of two numbers, or not in m.

    >>> read_place(["100 mm", 0.2]).tolist()
    [0.1, 0.2]
    """
    if at is None:
        return None
    if isinstance(at, (int, np.integer)):
        if at == 0 and not isinstance(at, bool):
            raise InputError("at", "is 0; platforms and places are numbered from 1, and a distance of 0 m is written 0.0")
        return count(at, "at")
    if isinstance(at, (list, tuple)) or getattr(at, "ndim", 0) > 0:
        return numbers(at, "m", "at", 2)
    return number(cast(Number, at), "m", "at")


def read_number_of_place(place: object, allowed: str, last: int, name: str) -> int:
    """Return the number of a place, 1 to `last`; None is 1. **Raises** `InputError` with the text `allowed` otherwise."""
    if place is None:
        return 1
    if not is_whole(place) or not 1 <= cast(int, place) <= last:
        raise InputError(name, f"is {quoted(place)}; {allowed}")
    return int(cast(int, place))


def on_body(at: int | Array | None, body: int) -> Place:
    """Return the place `at` on the body with the number `body`, from 0."""
    return at if body == 0 or isinstance(at, int) else BodyPoint(at, body)


class Mount(Readable):
    """Mount of an exciter on a machine with nd coordinates q, whose points move in np directions.

        load j moves by sum_l levers[l][j] rows[l] q,      the rotor's centre of mass by sum_l rotor_levers[l] rows[l] q

    **Attributes**

    - `rows`: one or two matrices (np, nd). The first times q is the displacement of a point of the rotor's axis, m. The second
      times q is the tilt of the axis, rad. Machines that do not tilt have the first only
    - `axes` (np,): the direction of each row in the plane of the loads (0 horizontal, 1 up)
    - `levers`: a lever (count,) for each entry of `rows`; None stands for 1, an absent entry for 0. `levers` is (None,) if all
      loads run at the first point, and (None, distances from this point in m) if each load has its own station
    - `rotor_levers`: the same for the rotor's centre of mass, scalars
    - `gyroscopic` G (nd, nd), kg m^2, for the term (speed G) q' of the equations, see `Carrier`; typical entries: 0.01 to
      0.5 kg m^2, the polar inertia of the rotor; None for a machine without gyroscopic coupling
    - `turn` c (nd,): the exciter's housing turns by c q, and the reaction torque of the drive acts on it; None if it does not
      turn

    >>> import jaxvib as jv
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> mount = machine.mount()
    >>> mount.rows[0].tolist(), mount.axes, mount.levers        # the exciter moves up with platform 2
    ([[0.0, 1.0]], (1,), (None,))
    """

    rows: tuple[Array, ...]
    axes: tuple[int, ...] = eqx.field(static=True)
    levers: tuple[Array | None, ...] = (None,)
    rotor_levers: tuple[Array | None, ...] = (None,)
    gyroscopic: Array | None = None
    turn: Array | None = None

    @property
    def tilt(self) -> Array | None:
        """Matrix (directions, nd) that gives the tilt of the axis from q; None if the axis cannot tilt."""
        return self.rows[1] if len(self.rows) > 1 else None

    @property
    def at_one_point(self) -> bool:
        """True if all loads run at the first point.

        >>> import jaxvib as jv
        >>> jv.planar_rotor(mass=37.0, stiffness="1160 N/mm", damping=840.0).mount().at_one_point
        True
        """
        return len(self.levers) == 1 and self.levers[0] is None

    def load_rows(self, count: int) -> Array:
        """Return the matrices (count, directions, nd) that give the displacement of each load's point from q.

        `count` is the number of loads.
        """
        if self.at_one_point:
            return jnp.broadcast_to(self.rows[0], (count, *self.rows[0].shape))
        return jax.vmap(lambda levers: _combine(levers, self.rows))(self.levers)

    def load_rates(self, rate: Array) -> dict[int, Array]:
        """Return the velocities (or accelerations) of the loads' points by axis, from those of the coordinates, `rate` (nd,).

        Each is a scalar if all loads run at one point, otherwise (count,). The unit is that of `rate`: m/s for velocities.
        """
        if self.at_one_point:
            return dict(zip(self.axes, self.rows[0] @ rate, strict=True))
        levers = [None if lever is None else lever[None, :] for lever in self.levers]
        of_rows = [(row @ rate)[:, None] for row in self.rows[: len(levers)]]
        return dict(zip(self.axes, _combine(levers, of_rows), strict=True))

    def rotor_rows(self) -> Array:
        """Return the matrix (directions, nd) that gives the displacement of the rotor's centre of mass from q."""
        return _combine(self.rotor_levers, self.rows)

    def distances(self, count: int) -> Array:
        """Return the distance of each of `count` loads from the rotor's centre of mass along the axis, (count,) m.

        The distances are 0 on a machine that does not tilt.
        """
        zero = jnp.zeros((), self.rows[0].dtype)
        load, rotor = (levers[1] if len(levers) > 1 else zero for levers in (self.levers, self.rotor_levers))
        return jnp.broadcast_to((zero if load is None else load) - (zero if rotor is None else rotor), (count,))


def scaled(lever: Array | None, value: Array) -> Array:
    """Return a value times a lever; None is 1."""
    return value if lever is None else lever * value


def _combine(levers: Sequence[Array | None], values: Sequence[Array]) -> Array:
    terms = [scaled(lever, value) for lever, value in zip(levers, values, strict=False)]
    return sum(terms[1:], terms[0])


def force_directions(coordinates: Sequence[str], count: int) -> tuple[str, ...]:
    """Return the names of the `count` directions of the force on the foundation: "up", or "across" and "up".

    Those of a rotor are its coordinates "y" and "z", because its axis may be vertical.

    >>> force_directions(("y", "z"), 2), force_directions(("x", "y", "psi"), 2), force_directions(("y1",), 1)
    (('y', 'z'), ('across', 'up'), ('up',))
    """
    rotor = ("y", "z")
    return ("up",) if count == 1 else rotor if tuple(coordinates[:2]) == rotor else ("across", "up")


class Carrier(Readable):
    """Linear structure of a machine.

        M q'' + (C + speed G) q' + K q = forces,        force on the foundation = T_K q + T_C q'

    `mass` does not include the loads: each load adds its mass at its own place. The gyroscopic matrix G is that of the `Mount`.

    **Attributes** (nd coordinates, nb directions of the force on the foundation)

    - `mass` M (nd, nd), kg (kg m^2 for tilts); typical: 50 to 5000 kg, for rotors 5 to 50 kg
    - `damping` C (nd, nd), N s/m; typical: 0.01 to 0.05 of the critical damping 2 sqrt(K M)
    - `stiffness` K (nd, nd), N/m; typical: 1e4 to 1e6
    - `foundation_stiffness` T_K and `foundation_damping` T_C (nb, nd): the supports on the foundation, N/m and N s/m
    - `coordinates` (nd,): the name of each coordinate
    - `coordinate_units` (nd,): the unit of each coordinate, "m" or "rad"; None if all are "m"

    >>> import jaxvib as jv
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> machine.carrier().mass.tolist()
    [[120.0, 0.0], [0.0, 95.0]]

    Source: the general form of all five papers; for platforms Filimonikhin et al. 2022, equations (1)-(6), for rotors
    Artyunin 2013, equation (1).
    """

    mass: Array
    damping: Array
    stiffness: Array
    foundation_stiffness: Array
    foundation_damping: Array
    coordinates: tuple[str, ...] = eqx.field(static=True)
    coordinate_units: tuple[str, ...] | None = eqx.field(static=True, default=None)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each coordinate, (nd,): "m" or "rad".

        >>> import jaxvib as jv
        >>> jv.planar_rotor(mass=37.0, stiffness="1160 N/mm", damping=840.0).structure().units
        ('m', 'm')
        """
        return self.coordinate_units or ("m",) * len(self.coordinates)

    def as_lengths(self, values: Array) -> Array:
        """Return `values` (..., nd) of the coordinates as lengths, m, so that translations and rotations can be compared.

        A rotation is multiplied by the radius of gyration: the square root of the mean moment of inertia divided by the mean
        mass, both from the diagonal of M. A rotation and a translation of equal length then have about the same energy. The
        values are returned unchanged if all coordinates have the same unit.

        >>> import jax.numpy as jnp, jaxvib as jv
        >>> springs = [jv.support(at=(x, 0.0), stiffness=(1e4, 1e4), damping=(10.0, 10.0)) for x in (-1.0, 1.0)]
        >>> machine = jv.plane_body(mass=100.0, inertia=25.0, supports=springs)
        >>> machine.carrier().as_lengths(jnp.asarray([1e-3, 2e-3, 4e-3])).tolist()  # 0.5 m is sqrt(25/100) m
        [0.001, 0.002, 0.002]
        """
        is_rotation = np.array(self.units) == "rad"
        if np.all(is_rotation) or not np.any(is_rotation):
            return values
        shares = [np.diag(kind / np.sum(kind)).astype(self.mass.dtype) for kind in (is_rotation, ~is_rotation)]
        inertia, mass = (jnp.sum(self.mass * share) for share in shares)
        return jnp.where(is_rotation, jnp.sqrt(inertia / mass) * values, values)

    @property
    def foundation_directions(self) -> tuple[str, ...]:
        """Names of the directions of the force on the foundation, see `force_directions`."""
        return force_directions(self.coordinates, self.foundation_stiffness.shape[0])

    def foundation_force(self, displacement: Array, velocity: Array) -> Array:
        """Return the force on the foundation, T_K q + T_C q', N, one entry for each direction, without effects.

        **Arguments**

        - `displacement` q (nd,), m (rad for tilts); complex amplitudes are allowed
        - `velocity` q' (nd,), m/s (rad/s for tilts)
        """
        return self.foundation_stiffness @ displacement + self.foundation_damping @ velocity


class Machine(Part):
    """Machine with the parameters that a designer chooses. A new kind of machine is a subclass that defines its matrices and
    the mount of an exciter.

    `kind` is its name in scene files. `places` states how effects and drawings name a place on the machine:

    - "platform": by the number of the platform
    - "shaft": by the distance along a rotor's axis from its centre of mass, m
    - "number": by the number of a place in a list
    - "plane": by the point (x, y) of a body, m from its centre of mass
    - "point": the exciter's place is the only one, and is not named

    >>> import equinox as eqx, jax, jax.numpy as jnp, jaxvib as jv
    >>> class Table(jv.Machine):
    ...     mass: jax.Array
    ...     stiffness: jax.Array
    ...     kind: str = eqx.field(static=True, default="table", kw_only=True)
    ...
    ...     def carrier(self):
    ...         mass, stiffness, zero = self.mass[None, None], self.stiffness[None, None], jnp.zeros((1, 1))
    ...         return jv.Carrier(mass, zero, stiffness, foundation_stiffness=stiffness, foundation_damping=zero,
    ...                           coordinates=("y1",))
    ...
    ...     def mount(self, at=None):
    ...         return jv.Mount(rows=(jnp.ones((1, 1)),), axes=(1,))
    >>> loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0)
    >>> machine = Table(mass=jnp.asarray(49.5), stiffness=jnp.asarray(5e3))
    >>> scene = jv.Scene(machine, loads, jv.ConstantSpeed(60.0))
    >>> round(float(jv.natural_frequencies(scene)[0]), 3)       # sqrt(5000 / 50)
    10.0
    """

    kind: eqx.AbstractVar[str]
    places: ClassVar[Literal["platform", "shaft", "plane", "number", "point"]] = "point"

    @abc.abstractmethod
    def carrier(self) -> Carrier:
        """Return the linear structure, see `Carrier`."""

    @abc.abstractmethod
    def mount(self, at: Place = None) -> Mount:
        """Return the mount of an exciter, see `Mount`.

        **Arguments**: `at`, the place of the exciter; None for the default.
        """

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the matrix (directions, nd) that gives the displacement of a point: rows q. Exciters, supports, stops and
        drawings use this method.

        **Arguments**

        - `place`: the number of a platform, a distance along the axis, m, or a point of a body, see `Place`; None for the
          default place
        - `name` of the place in error messages

        **Raises** `InputError` for a place that the machine does not have.

        >>> import jaxvib as jv
        >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
        ...                       link_stiffness=2e5, link_damping=60.0)
        >>> machine.rows_at(2).tolist()
        [[0.0, 1.0]]
        """
        if place is not None:
            problem = f"names a place on a machine of kind {quoted(self.kind)}, which has only the place of its exciter"
            raise InputError(name, f"{problem}; leave it out")
        return self.mount().rows[0]

    def moment_rows(self, about: Array) -> Array:
        """Return the rows (2, nd) of the moment of all supports on the foundation, anticlockwise: N m per q and per q'.

        **Arguments**: `about` (2,), m: the point fixed in the foundation to which the moment refers.

        **Raises** `InputError` for a machine other than a body in a plane.
        """
        problem = f"is of kind {quoted(self.kind)}; the moment on the foundation is defined for bodies in a plane"
        raise InputError("machine", problem)

    def support_rows(self) -> tuple[Array, Array]:
        """Return the rows (support, directions, nd) of the force on each support: N per q and N per q'.

        The default is one support that carries the whole force on the foundation.
        """
        carrier = self.carrier()
        return carrier.foundation_stiffness[None], carrier.foundation_damping[None]

    def upward(self) -> np.ndarray | None:
        """Return the coordinates (nd,) of a translation of the whole machine upward by 1 m; None if they are unknown."""
        return None

    def require_valid(self) -> None:
        """**Raises** `InputError` for arrays that were replaced and do not fit together. By default nothing is examined here,
        because each analysis calls the constructor again with the new values."""

    @property
    def has_foundation(self) -> bool:
        """True if the force on the foundation is known, see `Carrier`; otherwise results state NaN."""
        return True

    @property
    def body_count(self) -> int:
        """Number of bodies; 1 for every machine other than a network of bodies in a plane."""
        return 1

    def require_body(self, body: int) -> int:
        """Return the number `body` of a body, from 0. **Raises** `InputError` for a body that the machine does not have."""
        if isinstance(body, bool) or not isinstance(body, (int, np.integer)) or not 0 <= body < self.body_count:
            last = self.body_count - 1
            allowed = f"bodies 0 to {last}" if last else "one body, number 0"
            raise InputError("body", f"is {quoted(body)}; the machine has {allowed}")
        return int(body)

    def shaft_supports(self) -> list[tuple[float, float, float]] | None:
        """Return the supports along a rotor's axis, for a drawing; None if a drawing needs only the matrices.

        **Returns** a list with the distance from the centre of mass (m), the stiffness (N/m) and the damping (N s/m) of each
        support.
        """
        return None

    def structure(self) -> Carrier:
        """Return the names, directions and shapes of the carrier, without values."""
        return shapes_of(self)[0]

    def mounting(self, at: Place = None) -> Mount:
        """Return the directions and shapes of the mount of an exciter at the place `at`, without values."""
        return shapes_of(self, at)[1]


def shapes_of(machine: Machine, at: Place = None) -> tuple[Carrier, Mount]:
    """Return the names, directions and shapes of the carrier, and of the mount of an exciter at `at`, without values."""
    platform, position = (at, None) if isinstance(at, int) else (None, at)
    leaves, treedef = jax.tree.flatten((machine, position))
    try:
        return _structure(treedef, tuple(map(shape_and_dtype, leaves)), jnp.result_type(float), platform)
    except InputError:
        machine.mount(at)  # raises the same error, which then names the place
        raise
    except (TypeError, ValueError, IndexError) as error:
        if not type(machine).__module__.startswith("jaxvib."):  # an error in a user's class
            raise
        raise InputError("machine", f"has an array of a shape that its constructor does not allow ({error})") from error


def shape_and_dtype(leaf: ArrayLike) -> tuple[tuple[int, ...], np.dtype]:
    """Return the shape and the dtype of an array, or those of the array that JAX makes of a Python number."""
    array = leaf if isinstance(leaf, (jax.Array, np.ndarray)) else jnp.asarray(leaf)
    return array.shape, array.dtype


@functools.lru_cache(maxsize=128)
def _structure(
    treedef: Hashable, kinds: tuple[tuple[tuple[int, ...], np.dtype], ...], precision: np.dtype, platform: int | None
) -> tuple[Carrier, Mount]:
    """Trace the carrier and the mount once for each structure and `precision`, because a trace takes longer than many runs."""
    machine, position = jax.tree.unflatten(treedef, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds])

    def shapes(machine: Machine, position: Array | None) -> tuple[Carrier, Mount]:
        return machine.carrier(), machine.mount(position if platform is None else platform)

    # Constructors collect the checks of traced values. Those of this trace have no values and must not reach an outer trace;
    # the list of this block, which is not used, receives them.
    with conditions_of_traced_values():
        return eqx.filter_eval_shape(shapes, machine, position)
