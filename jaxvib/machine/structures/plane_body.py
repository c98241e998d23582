"""Rigid body that moves in its plane on springs and dampers: screens, feeders, conveyors."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.mount import Mount, Place
from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.units import Number


class PlaneSupport(Part):
    """Pair of springs and dampers between a point of a body and the foundation, at right angles to each other.

    **Attributes**

    - `at` (2,), m: the point of the body, (x, y) from its centre of mass
    - `stiffness` (2,) N/m and `damping` (2,) N s/m, along the directions at `angle` and `angle` + 90 degrees
    - `angle`, rad: of the first spring, anticlockwise from x
    """

    at: Array = eqx.field(metadata=unit("m", "m", words="position of the support", typical=0.5))
    stiffness: Array = eqx.field(metadata=unit("N/m", "N/m", low=0.0, words="stiffness of the support"))
    damping: Array = eqx.field(metadata=unit("N s/m", "N s/m", low=0.0, words="damping of the support"))
    angle: Array = eqx.field(metadata=unit("rad", words="angle of the support", typical=0.5))


def support(
    *, at: Sequence[Number], stiffness: Sequence[Number], damping: Sequence[Number], angle: Number = 0.0
) -> PlaneSupport:
    """Return a support of a body in its plane: two springs with dampers at right angles.

        force on the foundation = R^T diag(k1, k2) R u + R^T diag(c1, c2) R u',    R = [[cos a, sin a], [-sin a, cos a]]

    u is the displacement (x, y) of the point `at`, a the `angle`.

    **Arguments** (SI, or strings with a unit)

    - `at` (2,): the point of the body, (x, y) m from its centre of mass without unbalances; typical: 0.2 to 3 m
    - `stiffness` (k1, k2), N/m; typical: 1e4 to 1e6
    - `damping` (c1, c2), N s/m; typical: 0.01 to 0.05 of the critical damping 2 sqrt(k m)
    - `angle` of the first spring, rad, anticlockwise from x; typical: 0 (the default)

    **Returns** `PlaneSupport`. **Raises** `InputError` for wrong units, wrong lengths and negative coefficients.

    >>> import jaxvib as jv
    >>> jv.support(at=(1.2, -0.2), stiffness=("200 N/mm", "400 N/mm"), damping=(2e3, 4e3)).stiffness.tolist()
    [200000.0, 400000.0]

    Source: equilibrium of two linear springs.
    """
    return PlaneSupport(**read_numbers(PlaneSupport, "", at=at, stiffness=stiffness, damping=damping, angle=angle))


class PlaneBody(Machine):
    """Rigid body with the coordinates q = (x, y, psi): its centre of mass across and up, and its anticlockwise rotation.

        m x'' = f_x,    m y'' = f_y,    J psi'' = moment of the forces
        a point at (a, b) moves by B q,    B = [[1, 0, -b], [0, 1, a]]

    The torque of a drive acts between its rotor and the body. The torque of a motor depends on its speed relative to the body.
    An ideal drive prescribes the speed of its rotor in the fixed frame.

    **Attributes**

    - `mass` m, kg, and `inertia` J, kg m^2, about the centre of mass; exciters included, loads not
    - `supports`, see `PlaneSupport`
    """

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True, words="mass of the body"))
    inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True, words="moment of inertia of the body"))
    supports: tuple[PlaneSupport, ...]
    kind: str = eqx.field(static=True)
    places = "plane"

    def carrier(self) -> Carrier:
        """Return the matrices of the three coordinates."""
        zero = jnp.zeros((3, 3), self.mass.dtype)
        force = {"stiffness": zero[:2], "damping": zero[:2]}
        matrix = {"stiffness": zero, "damping": zero}
        for each in self.supports:
            rows = _rows(each.at)
            turn = jnp.stack([jnp.cos(each.angle), jnp.sin(each.angle)])
            along = jnp.stack([turn, jnp.stack([-turn[1], turn[0]])])
            for name in matrix:
                at_point = (along.T * getattr(each, name)[None]) @ along @ rows
                force[name] = force[name] + at_point
                matrix[name] = matrix[name] + rows.T @ at_point
        return Carrier(
            mass=jnp.diag(jnp.stack([self.mass, self.mass, self.inertia])),
            damping=matrix["damping"],
            stiffness=matrix["stiffness"],
            foundation_stiffness=force["stiffness"],
            foundation_damping=force["damping"],
            coordinates=("x", "y", "psi"),
            coordinate_units=("m", "m", "rad"),
        )

    def mount(self, at: Place = None) -> Mount:
        """Return the motion of the axis at the point `at`, and the rotation of the exciter's housing with the body."""
        return Mount(rows=(self.rows_at(at, "at"),), axes=(0, 1), turn=jnp.asarray(np.eye(3)[2], self.mass.dtype))

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the rows of the point (x, y) of the body, m from its centre of mass; None is the centre of mass."""
        if place is None:
            return _rows(jnp.zeros(2, self.mass.dtype))
        size = len(place) if isinstance(place, (list, tuple)) else getattr(place, "size", 1)
        if size != 2:
            raise InputError(name, f"is {quoted(place)}; on a body in a plane give (x, y), m from its centre of mass")
        return _rows(jnp.asarray(place, self.mass.dtype))


def _rows(at: Array) -> Array:
    """Return the rows (2, 3) of the point `at`."""
    lever = jnp.stack([-at[1], at[0]])
    return jnp.concatenate([jnp.eye(2, dtype=at.dtype), lever[:, None]], axis=1)


def plane_body(*, mass: Number, inertia: Number, supports: Sequence[PlaneSupport]) -> PlaneBody:
    """Return a rigid body that moves in its plane.

        m x'' = f_x,    m y'' = f_y,    J psi'' = moment of the forces

    Displacements are measured from static equilibrium, x to the right, y up, psi anticlockwise. The rotation is assumed to be
    small: kinematics are linear in q.

    **Arguments** (SI, or strings with a unit)

    - `mass` m, kg, exciters included, loads not; typical: 100 to 10000
    - `inertia` J about the centre of mass, kg m^2, exciters included, loads not; typical: 20 to 20000
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
    if not isinstance(supports, (list, tuple)) or not supports:
        raise InputError("machine.supports", f"is {quoted(supports)}; it must be a list of supports, [support(at=...), ...]")
    for k, each in enumerate(supports):
        if not isinstance(each, PlaneSupport):
            problem = f"is {quoted(each)}; it must be a support(at=..., stiffness=..., damping=...)"
            raise InputError(f"machine.supports[{k}]", problem)
    found = read_numbers(PlaneBody, "machine", mass=mass, inertia=inertia)
    return PlaneBody(**found, supports=tuple(supports), kind="plane_body")
