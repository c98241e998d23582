"""Rigid bodies that move in their plane on springs and dampers: screens, feeders, conveyors."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import with_known_names
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import BodyPoint, Carrier, Machine, Mount, Place
from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.machine.structures.damping import damping_constants
from jaxvib.units import Number, Numbers, count, numbers


class PlaneSupport(Part):
    """Pair of springs and dampers at right angles, between a point of a body and the foundation or another body.

    **Attributes**

    - `at` (2,), m: the point of the body, (x, y) from its centre of mass
    - `stiffness` (2,) N/m and `damping` (2,) N s/m, along the directions at `angle` and `angle` + 90 degrees
    - `angle`, rad: of the first spring, anticlockwise from x
    - `body`: number of the body, from 0; `to`: number of the other body, None for the foundation
    - `at_other` (2,), m: the point of the other body, from its centre of mass; None for the foundation
    """

    at: Array = eqx.field(metadata=unit("m", "m", words="position of the support", typical=0.5))
    stiffness: Array = eqx.field(metadata=unit("N/m", "N/m", low=0.0, words="stiffness of the support"))
    damping: Array = eqx.field(metadata=unit("N s/m", "N s/m", low=0.0, words="damping of the support"))
    angle: Array = eqx.field(metadata=unit("rad", words="angle of the support", typical=0.5))
    at_other: Array | None = eqx.field(metadata=unit("m", "m", words="position of the support on the other body", typical=0.5))
    body: int = eqx.field(static=True)
    to: int | None = eqx.field(static=True)


@with_known_names
def support(
    *,
    at: Sequence[Number],
    stiffness: Sequence[Number],
    damping: Sequence[Number],
    angle: Number = 0.0,
    body: int = 0,
    to: int | None = None,
    at_other: Sequence[Number] | None = None,
) -> PlaneSupport:
    """Return a support of a body in its plane: two springs with dampers at right angles.

        force on the foundation = R^T diag(k1, k2) R u + R^T diag(c1, c2) R u',    R = [[cos a, sin a], [-sin a, cos a]]

    u is the displacement (x, y) of the point `at`, a the `angle`. Between two bodies u is the displacement of `at` relative to
    that of `at_other`.

    **Arguments** (SI, or strings with a unit)

    - `at` (2,): the point of the body, (x, y), m from the body's centre of mass; typical: 0.2 to 3 m. The centre of mass
      is that of all parts in `mass`, with each unbalance as a mass on the axis of its exciter
    - `stiffness` (k1, k2), N/m; typical: 1e4 to 1e6. Also a static deflection with the mass or force on this support, "25 mm
      under 325 kg"
    - `damping` (c1, c2), N s/m; typical: 0.01 to 0.08 of the critical damping 2 sqrt(k m). Also a ratio to the critical damping
      with the mass m that this support carries, "5 % of 250 kg". Also a loss factor of rubber at a frequency of vibration,
      "loss factor 0.1 at 16 Hz"
    - `angle` of the first spring, rad, anticlockwise from x; typical: 0 (the default)
    - `body`: number of the body in a `plane_network`, from 0; typical: 0 (the default)
    - `to`: number of the body at the other end; default: the foundation
    - `at_other` (2,): the point of that body, m from its centre of mass; typical: 0.2 to 3 m

    **Returns** `PlaneSupport`. **Raises** `InputError` for wrong units, wrong lengths, negative coefficients, and `to`
    without `at_other` or the reverse.

    >>> import jaxvib as jv
    >>> jv.support(at=(1.2, -0.2), stiffness=("200 N/mm", "400 N/mm"), damping=(2e3, 4e3)).stiffness.tolist()
    [200000.0, 400000.0]

    Source: equilibrium of two linear springs.
    """
    body, to = count(body, "body", low=0), None if to is None else count(to, "to", low=0)
    if (to is None) != (at_other is None):
        raise InputError("at_other", f"is {quoted(at_other)} and to is {to}; a support between two bodies needs both")
    if to == body:
        raise InputError("to", f"is {to}, the body itself; a support joins two different bodies")
    found = read_numbers(PlaneSupport, "", at=at, stiffness=stiffness)
    constants = damping_constants(damping, "damping", found["stiffness"])
    found |= read_numbers(PlaneSupport, "", damping=constants, angle=angle, at_other=at_other)
    return PlaneSupport(**found, body=body, to=to)


class Body(Part):
    """Rigid body of a `plane_network`: `mass`, kg, and `inertia` about its centre of mass, kg m^2."""

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True, words="mass of the body"))
    inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True, words="moment of inertia of the body"))


@with_known_names
def body(*, mass: Number, inertia: Number) -> Body:
    """Return a rigid body of a `plane_network`.

    **Arguments** (SI, or strings with a unit, greater than 0; of the same parts as in `plane_body`)

    - `mass`, kg; typical: 100 to 10000
    - `inertia` about its centre of mass, kg m^2; typical: 20 to 20000

    **Returns** `Body`. **Raises** `InputError` for wrong units and values that are not positive.

    >>> import jaxvib as jv
    >>> float(jv.body(mass="2 t", inertia=600.0).mass)
    2000.0
    """
    return Body(**read_numbers(Body, "", mass=mass, inertia=inertia))


class _Bodies(Machine):
    """Bodies in a plane, three coordinates each. A subclass has `supports`."""

    if TYPE_CHECKING:  # a field here would come before those of the subclasses
        supports: tuple[PlaneSupport, ...] = eqx.field(init=False)
    places = "plane"

    @abc.abstractmethod
    def _inertias(self) -> list[tuple[Array, Array]]:
        """Return the mass and the moment of inertia of each body."""

    @property
    def body_count(self) -> int:
        """Number of bodies."""
        return len(self._inertias())

    def carrier(self) -> Carrier:
        """Return the matrices of the coordinates x, y and psi of each body."""
        inertias = self._inertias()
        size = 3 * len(inertias)
        zero = jnp.zeros((size, size), inertias[0][0].dtype)
        force = {"stiffness": zero[:2], "damping": zero[:2]}
        matrix = {"stiffness": zero, "damping": zero}
        for each in self.supports:
            rows, along = self._relative_motion(each)
            for name in matrix:
                at_point = _force_rows(each, rows, along, name)
                if each.to is None:
                    force[name] = force[name] + at_point
                matrix[name] = matrix[name] + rows.T @ at_point
        bodies = [""] if len(inertias) == 1 else map(str, range(len(inertias)))
        return Carrier(
            mass=jnp.diag(jnp.stack([value for mass, inertia in inertias for value in (mass, mass, inertia)])),
            damping=matrix["damping"],
            stiffness=matrix["stiffness"],
            foundation_stiffness=force["stiffness"],
            foundation_damping=force["damping"],
            coordinates=tuple(f"{name}{body}" for body in bodies for name in ("x", "y", "psi")),
            coordinate_units=("m", "m", "rad") * len(inertias),
        )

    def mount(self, at: Place = None) -> Mount:
        """Return the motion of the axis at the point `at`, and the rotation of the exciter's housing with its body."""
        rows = self.rows_at(at, "at")
        housing_row = np.eye(rows.shape[1])[3 * (at.body if isinstance(at, BodyPoint) else 0) + 2]
        return Mount(rows=(rows,), axes=(0, 1), turn=jnp.asarray(housing_row, rows.dtype))

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the matrix that gives the displacement of a point (x, y) of a body, m from its centre of mass; None: the
        centre."""
        point, body = (place.at, place.body) if isinstance(place, BodyPoint) else (place, 0)
        dtype = self._inertias()[0][0].dtype
        if point is None:
            return self._point_rows(jnp.zeros(2, dtype), body)
        size = len(point) if isinstance(point, (list, tuple)) else getattr(point, "size", 1)
        if size != 2:
            many = f"{size} number{'s' * (size != 1)}"
            raise InputError(name, f"has {many}; on a body in a plane give (x, y), m from its centre of mass")
        return self._point_rows(numbers(cast(Numbers, point), "m", name, 2).astype(dtype), body)

    def support_rows(self) -> tuple[Array, Array]:
        """Return the rows of the forces of all supports, including those between two bodies, see `Machine.support_rows`."""
        found: dict[str, list[Array]] = {"stiffness": [], "damping": []}
        for each in self.supports:
            rows, along = self._relative_motion(each)
            for name, of_kind in found.items():
                of_kind.append(_force_rows(each, rows, along, name))
        return jnp.stack(found["stiffness"]), jnp.stack(found["damping"])

    def upward(self) -> np.ndarray:
        """Return the coordinates of a translation of all bodies upward by 1 m."""
        return np.tile([0.0, 1.0, 0.0], self.body_count)

    def moment_rows(self, about: Array) -> Array:
        """Return the rows (2, nd), see `Machine.moment_rows`. **Raises** `InputError` unless exactly one body stands on the
        foundation, because the distances between bodies are not known."""
        on_foundation = [each for each in self.supports if each.to is None]
        bodies = sorted({each.body for each in on_foundation})
        if len(bodies) != 1:
            standing = f"the bodies {' and '.join(map(str, bodies))}" if bodies else "no body"
            problem = f"has {standing} on the foundation; the foundation moment is defined only for one such body, because its "
            problem += "point is given from the centre of mass of that body"
            raise InputError("machine.supports", problem)
        found = [jnp.zeros(3 * self.body_count, about.dtype)] * 2
        for each in on_foundation:
            lever = jnp.stack([about[1] - each.at[1], each.at[0] - about[0]])
            rows, along = self._relative_motion(each)
            names = ("stiffness", "damping")
            found = [row + lever @ _force_rows(each, rows, along, name) for row, name in zip(found, names, strict=True)]
        return jnp.stack(found)

    def _relative_motion(self, each: PlaneSupport) -> tuple[Array, Array]:
        """Return the rows (2, nd) of the relative motion of a support's ends, and the directions (2, 2) of its springs."""
        rows = self._point_rows(each.at, each.body)
        if each.to is not None and each.at_other is not None:
            rows = rows - self._point_rows(each.at_other, each.to)
        first = jnp.stack([jnp.cos(each.angle), jnp.sin(each.angle)])
        return rows, jnp.stack([first, jnp.stack([-first[1], first[0]])])

    def _point_rows(self, at: Array, body: int) -> Array:
        """Return the rows (2, nd) of the point `at` of a body."""
        lever = jnp.stack([-at[1], at[0]])
        of_body = jnp.concatenate([jnp.eye(2, dtype=at.dtype), lever[:, None]], axis=1)
        before, after = 3 * body, 3 * (self.body_count - body - 1)
        return of_body if before + after == 0 else jnp.pad(of_body, ((0, 0), (before, after)))


def _force_rows(each: PlaneSupport, rows: Array, along: Array, name: str) -> Array:
    """Return the rows (2, nd) of the force of a support due to its "stiffness" or "damping"."""
    return (along.T * getattr(each, name)[None]) @ along @ rows


class PlaneBody(_Bodies):
    """Rigid body with the coordinates q = (x, y, psi): displacement of its centre of mass to the right and up, anticlockwise
    rotation.

        m x'' = f_x,    m y'' = f_y,    J psi'' = moment of the forces
        a point at (a, b) moves by B q,    B = [[1, 0, -b], [0, 1, a]]

    The torque of a drive acts between its rotor and the body. The torque of a motor depends on its speed relative to the body.
    An ideal drive prescribes the speed of its rotor in the fixed frame.

    **Attributes**

    - `mass` m, kg, and `inertia` J, kg m^2, about the centre of mass, see `plane_body`
    - `supports`, see `PlaneSupport`
    """

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True, words="mass of the body"))
    inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True, words="moment of inertia of the body"))
    supports: tuple[PlaneSupport, ...]
    kind: str = eqx.field(static=True)

    def _inertias(self) -> list[tuple[Array, Array]]:
        return [(self.mass, self.inertia)]


class PlaneNetwork(_Bodies):
    """Rigid bodies in a plane, joined to each other and to the foundation; coordinates (x, y, psi) of each, see `PlaneBody`.

    **Attributes**: `bodies`, see `Body`; `supports`, see `PlaneSupport`.
    """

    bodies: tuple[Body, ...]
    supports: tuple[PlaneSupport, ...]
    kind: str = eqx.field(static=True)

    @property
    def mass(self) -> Array:
        """Mass of each body, kg."""
        return jnp.stack([each.mass for each in self.bodies])

    def _inertias(self) -> list[tuple[Array, Array]]:
        return [(each.mass, each.inertia) for each in self.bodies]


@with_known_names
def plane_body(*, mass: Number, inertia: Number, supports: Sequence[PlaneSupport]) -> PlaneBody:
    """Return a rigid body that moves in its plane.

        m x'' = f_x,    m y'' = f_y,    J psi'' = moment of the forces

    Displacements are measured from static equilibrium, x to the right, y up, psi anticlockwise. The rotation is assumed to be
    small: the kinematics are linear in x, y and psi.

    **Arguments** (SI, or strings with a unit)

    - `mass` m, kg, with the exciters, but without loads and without unbalances that have an `unbalance_mass`; typical: 100 to
      10000
    - `inertia` J about the centre of mass, kg m^2, of the same parts; typical: 20 to 20000
    - `supports`: a list of `support`, at least one

    **Returns** `PlaneBody`.

    **Raises** `InputError` for wrong units, values that are not allowed, and a list without supports.

    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.2, 1.2)]
    >>> screen = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    >>> screen.carrier().coordinates
    ('x', 'y', 'psi')

    Source: Blekhman 1988, Synchronization in Science and Technology: equations of a body with unbalance exciters.
    """
    read = _read_supports(supports, 1)
    found = read_numbers(PlaneBody, "machine", mass=mass, inertia=inertia)
    return PlaneBody(**found, supports=read, kind="plane_body")


@with_known_names
def plane_network(bodies: Sequence[Body], supports: Sequence[PlaneSupport]) -> PlaneNetwork:
    """Return rigid bodies that move in a plane, joined to each other and to the foundation by springs.

        M_b x_b'' = f_x,    M_b y_b'' = f_y,    J_b psi_b'' = moment of the forces          for each body b

    Examples are a screen on a frame that is isolated from the building, and a conveyor with a counterweight. Displacements are
    measured from static equilibrium; rotations are assumed to be small.

    **Arguments**

    - `bodies`: a list of `body`; they are numbered from 0, in `Exciter(body=)` and `support(body=, to=)`
    - `supports`: a list of `support`, at least one

    **Returns** `PlaneNetwork`. **Raises** `InputError` for lists without an entry, entries of another type, and supports of a
    body that does not exist.

    >>> import jaxvib as jv
    >>> frame = [jv.support(at=(x, -0.2), stiffness=(1e5, 2e5), damping=(500, 900), body=1) for x in (-1.5, 1.5)]
    >>> joints = [jv.support(at=(x, -0.3), stiffness=(2e5, 4e5), damping=(800, 900), to=1, at_other=(x, 0.2)) for x in (-1, 1)]
    >>> machine = jv.plane_network([jv.body(mass=2000, inertia=600), jv.body(mass=900, inertia=400)], frame + joints)
    >>> machine.carrier().coordinates
    ('x0', 'y0', 'psi0', 'x1', 'y1', 'psi1')

    Source: Newton's and Euler's equations of rigid bodies, linear in the displacements.
    """
    if not isinstance(bodies, (list, tuple)) or not bodies:
        raise InputError("machine.bodies", f"is {quoted(bodies)}; it must be a list of bodies, [body(mass=..., inertia=...)]")
    for k, each in enumerate(bodies):
        if not isinstance(each, Body):
            raise InputError(f"machine.bodies[{k}]", f"is {quoted(each)}; it must be a body(mass=..., inertia=...)")
    return PlaneNetwork(bodies=tuple(bodies), supports=_read_supports(supports, len(bodies)), kind="plane_network")


def _read_supports(supports: Sequence[PlaneSupport], bodies: int) -> tuple[PlaneSupport, ...]:
    """Return supports. **Raises** `InputError` for parts of another type, and for bodies that do not exist."""
    if not isinstance(supports, (list, tuple)) or not supports:
        raise InputError("machine.supports", f"is {quoted(supports)}; it must be a list of supports, [support(at=...), ...]")
    for k, each in enumerate(supports):
        if not isinstance(each, PlaneSupport):
            problem = f"is {quoted(each)}; it must be a support(at=..., stiffness=..., damping=...)"
            raise InputError(f"machine.supports[{k}]", problem)
        for name, number in (("body", each.body), ("to", each.to)):
            if number is not None and number >= bodies:
                has = f"bodies 0 to {bodies - 1}" if bodies > 1 else "one body, number 0"
                raise InputError(f"machine.supports[{k}].{name}", f"is {number}; the machine has {has}")
    return tuple(supports)
