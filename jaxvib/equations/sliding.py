"""Contact of rolling loads with their track: force required for rolling, Coulomb's limit, sliding."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.effects.terms import Coordinates, Friction, SlipRelease
from jaxvib.machine.loads import Loads, NormalForce


class Kinematics(NamedTuple):
    """Kinematics of loads: `columns` of J = dp/du, and `curvature` c = (dJ/dt) u'.

    Each column and the curvature have the components (x, y), or (x, y, z) if the loads move along the axis. `lengths` contains
    the lengths of the columns if these lengths are constant along the track, see `Loads.tangent_lengths`; otherwise it is None.
    """

    columns: list[tuple[Array, ...]]
    curvature: tuple[Array, ...]
    lengths: tuple[Array, ...] | None

    @property
    def sizes(self) -> list[Array]:
        """Lengths |dp/du_i| of the columns of J, m."""
        if self.lengths is not None:
            return list(self.lengths)
        return [jnp.sqrt(dot(column, column)) for column in self.columns]

    @property
    def metric(self) -> list[list[Array | float]]:
        """Matrix J^T J, m^2."""
        if self.lengths is not None:
            return [[length**2 if i == k else 0.0 for k in range(len(self.columns))] for i, length in enumerate(self.lengths)]
        return [[dot(a, b) for b in self.columns] for a in self.columns]

    @property
    def curvature_along(self) -> list[Array] | None:
        """Components J^T c of the curvature along the coordinates, m^2/s^2; None if they are 0 for every motion."""
        return None if self.lengths is not None else [dot(column, self.curvature) for column in self.columns]


def kinematics(loads: Loads, u: Coordinates, rate: Coordinates) -> Kinematics:
    """Return J and (dJ/dt) u' of all loads at once, because the position acts elementwise."""

    def along(direction: Coordinates) -> Callable[..., tuple[Array, ...]]:
        return lambda *v: jax.jvp(loads.position, v, direction)[1]

    columns = [along(_unit(u, i))(*u) for i in range(len(u))]
    return Kinematics(columns, jax.jvp(along(rate), u, rate)[1], loads.tangent_lengths())


def contact_force(
    loads: Loads,
    found: Kinematics,
    acceleration: Coordinates,
    a: Mapping[int, Array],
    force: Sequence[Array],
    kappa: Array | float,
) -> list[Array]:
    """Return the force along each coordinate's unit tangent, (count,) N each, that the motion requires from the contact in
    addition to the generalized `force` Q.

        [kappa m J^T (J u'' + (dJ/dt) u') + m J^T a - Q]_i / |dp/du_i|

    **Arguments**: `acceleration` u''; `a` of the points that carry the loads, by axis; `kappa`: 1 for the translation of the
    loads alone, or their inertia factor to include the inertia of their rotation.
    """
    curvature, needed = found.curvature_along, []
    for i, (column, metric, f, size) in enumerate(zip(found.columns, found.metric, force, found.sizes, strict=True)):
        inertial = total(g * x for g, x in zip(metric, acceleration, strict=True))
        inertial = inertial if curvature is None else curvature[i] + inertial
        carried = total(column[axis] * x for axis, x in a.items())
        needed.append((loads.mass * (kappa * inertial + carried) - f) / size)
    return needed


class ContactSolution(NamedTuple):
    """Inertia factor `kappa`, generalized `force` and `friction` of loads, each of which either rolls or slides.

    `on_rotor`: the friction that brakes the rotor; None if it is `friction`. It does not include the contact forces of sliding
    and rolling loads.
    """

    kappa: Array
    force: list[Array]
    friction: list[Friction]
    on_rotor: list[Friction] | None = None


def resolve_contact(
    loads: Loads,
    found: Kinematics,
    slip: Coordinates,
    limit: SlipRelease,
    normal_force: NormalForce,
    a: Mapping[int, Array],
    needed: Sequence[Array],
    rolling: Sequence[Array],
    centre: Sequence[Array],
    friction: Sequence[Friction],
) -> ContactSolution:
    """Determine which loads slide, from the motion in which all loads roll, and return the forces on each load.

    **Arguments**

    - `slip` of the loads, m/s; `limit`: Coulomb's law of the contact; `normal_force` of the loads
    - `needed`: force along the track in the motion in which all loads roll, N
    - `a`: acceleration in that motion of the points that carry the loads, by axis
    - `rolling`: generalized forces on loads that roll
    - `centre`: generalized forces at the centres of the loads, without the contact forces
    - `friction` of rolling loads
    """
    kappa = loads.inertia_factor()
    normal = normal_force.at(a)
    friction_limit = limit.coefficient * (jnp.maximum(normal, 0.0) if loads.one_sided else jnp.abs(normal))
    required = [f - friction_limit * c / limit.width for f, c in zip(needed, slip, strict=True)]
    fast = dot(slip, slip) > limit.width**2
    slides = fast | (dot(required, required) > friction_limit**2)
    along = [jnp.where(fast, -c, f) for c, f in zip(slip, required, strict=True)]
    size = jnp.sqrt(jnp.where(slides, dot(along, along), 1.0))
    levers = [jnp.where(slides, limit.coefficient * f / size, 0.0) * arm for f, arm in zip(along, found.sizes, strict=True)]
    sliding_friction = Friction(levers[0], *normal_force, tuple(levers[1:]), loads.one_sided).signed(a)
    # A slip smaller than the width decays while the load rolls.
    slip_decay = [arm * kappa * friction_limit * c / limit.width for c, arm in zip(slip, found.sizes, strict=True)]
    force = [jnp.where(slides, c, r - d) for c, r, d in zip(centre, rolling, slip_decay, strict=True)]
    rolling_friction = [
        each._replace(
            lever=jnp.where(slides, 0.0, each.lever), others=tuple(jnp.where(slides, 0.0, lever) for lever in each.others)
        )
        for each in friction
    ]
    return ContactSolution(jnp.where(slides, 1.0, kappa), force, [*rolling_friction, sliding_friction], list(friction))


def slip_rates(loads: Loads, u: Coordinates, rate: Coordinates, slip: Coordinates, change: Sequence[Array]) -> Coordinates:
    """Return the rates, m/s^2, of the components `slip` of the slip vector c along the tangents of the track from the
    components `change` of c'. They differ, because the tangents rotate while the load moves."""

    def tangents(*v: Array) -> list[list[Array]]:
        columns = [jax.jvp(loads.position, v, _unit(v, i))[1] for i in range(len(v))]
        return [[x / jnp.sqrt(dot(column, column)) for x in column] for column in columns]

    straight, turning = jax.jvp(tangents, u, rate)
    return tuple(
        h - total(c * dot(turn, along) for c, turn in zip(slip, turning, strict=True))
        for h, along in zip(change, straight, strict=True)
    )


def _unit(u: Coordinates, i: int) -> Coordinates:
    return tuple(jnp.ones_like(x) if k == i else jnp.zeros_like(x) for k, x in enumerate(u))


def total(values: Iterable[Array]) -> Array:
    """Return the sum of arrays."""
    return functools.reduce(operator.add, values)


def dot(x: Sequence[Array], y: Sequence[Array]) -> Array:
    """Return the scalar product of two vectors."""
    return total(a * b for a, b in zip(x, y, strict=True))
