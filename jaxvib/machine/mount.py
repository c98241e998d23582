"""Mount of an exciter: the displacements of its points as functions of the coordinates of the machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.units import Number, count, number, numbers


class BodyPoint(eqx.Module):
    """Point (x, y) of one of several bodies, m from its centre of mass (None: the centre itself); `body` is the number of the
    body, from 0."""

    at: Array | None
    body: int = eqx.field(static=True)


Place = int | float | Sequence[float] | Array | BodyPoint | None
"""Place on a machine: the number of a platform, the distance along a rotor's axis from its centre of mass, m, or the point (x,
y) of a body in a plane, m; None is the default place of the machine."""


def read_place(at: int | Number | Sequence[Number] | None, name: str) -> int | Array | None:
    """Return a place from a user's argument `name`: the number of a platform, or a distance or a point in m.

    **Raises** `InputError` for values that are neither a number nor a list of two numbers, or not in m.

    >>> read_place(["100 mm", 0.2], "at").tolist()
    [0.1, 0.2]
    """
    if at is None:
        return None
    if isinstance(at, (int, np.integer)):
        return count(at, name)
    if isinstance(at, (list, tuple)) or getattr(at, "ndim", 0) > 0:
        return numbers(at, "m", name, 2)
    distance: Any = at
    return number(distance, "m", name)


def on_body(at: int | Array | None, body: int) -> Place:
    """Return the place `at` on the body with this number."""
    return at if body == 0 or isinstance(at, int) else BodyPoint(at, body)


class Mount(eqx.Module):
    """Mount of an exciter on a machine with nd coordinates q, whose points move in np directions.

        load j moves by sum_l levers[l][j] rows[l] q,      the rotor's centre of mass by sum_l rotor_levers[l] rows[l] q

    **Attributes**

    - `rows`: arrays (np, nd), which times q give a displacement. The first is that of a point of the rotor's axis. The second
      is the tilt of the axis, in 1/m times the unit of a displacement. Machines that do not tilt have the first only
    - `axes` (np,): the direction of each row in the plane of the loads (0 horizontal, 1 up)
    - `levers`: a lever (count,) for each entry of `rows`; None stands for 1, an absent entry for 0. `levers` is (None,) if all
      loads run at the first point, and (None, distances from this point in m) if each load has its own station
    - `rotor_levers`: the same for the rotor's centre of mass, scalars
    - `gyroscopic` G (nd, nd), kg m^2: G times the rotor's speed times q' is a force on the coordinates; None without one.
      typical: 0.01 to 0.5 kg m^2, the polar inertia of the rotor
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
        moved = [(row @ rate)[:, None] for row in self.rows[: len(levers)]]
        return dict(zip(self.axes, _combine(levers, moved), strict=True))

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
