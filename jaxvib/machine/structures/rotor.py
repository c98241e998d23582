"""Rigid rotors: on two elastic supports with tilts, and on one support without tilts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import with_known_names
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Carrier, Machine, Mount, Place
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.machine.structures.damping import damping_constants
from jaxvib.units import Number, Numbers, number
from jaxvib.units.known import require_if_known, when_known

_MASS = unit("kg", low=0.0, open_low=True, words="mass of the rotor")


class Rotor(Machine):
    """Rigid rotor on two supports, with the coordinates q = (y, z, theta, psi).

    y and z are the displacements of the centre of mass, horizontal and up; theta and psi are the tilts of the axis.

        M y'' + b1 y' + b2 theta' + c1 y + c2 theta = f_y
        M z'' + b1 z' + b2 psi' + c1 z + c2 psi = f_z
        A theta'' + C w psi' + b2 y' + b3 theta' + c2 y + c3 theta = m_y
        A psi'' - C w theta' + b2 z' + b3 psi' + c2 z + c3 psi = m_z

    w is the rotor speed; f_y and f_z are the forces, m_y and m_z the moments that increase theta and psi. If the supports have
    other values vertically, the equations of z and psi have other coefficients b and c. A point at the distance s along the
    axis moves by (y + s theta, z + s psi). A load acts at its station s_j. z is the displacement from static equilibrium.

    **Attributes**

    - `mass` M kg; `transverse_inertia` A and `polar_inertia` C kg m^2, of the rotor without loads
    - `stiffness` k (2,) N/m, `damping` (2,) N s/m and `position` L (2,) m along the axis, of the two supports
    - `stiffness_up` (2,) N/m and `damping_up` (2,) N s/m: vertical values, if `stiffness` and `damping` are the horizontal
      ones; None: both directions are equal
    - `stations` s of the loads along the axis, m: one for all (scalar) or (count,)
    - `stiffness_terms` (c1 N/m, c2 N, c3 N m), `damping_terms` (b1 N s/m, b2 N s, b3 N m s); None: the terms of the supports,
      c1 = k_1 + k_2, c2 = k_1 L_1 + k_2 L_2, c3 = k_1 L_1^2 + k_2 L_2^2, and the same for b

    Source: Artyunin 2013, equation (1), with L_2 counted negative.
    """

    mass: Array = eqx.field(metadata=_MASS)
    transverse_inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, open_low=True, words="transverse moment of inertia"))
    polar_inertia: Array = eqx.field(metadata=unit("kg m^2", low=0.0, words="polar moment of inertia"))
    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, each="support"))
    damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, each="support"))
    position: Array = eqx.field(metadata=unit("m", each="support", typical=0.1))
    stations: Array = eqx.field(metadata=unit("m", words="station", each="load", typical=0.1))
    stiffness_terms: Array | None = eqx.field(metadata=unit("N/m", "N", "N m", words="stiffness term", typical=1e4))
    damping_terms: Array | None = eqx.field(metadata=unit("N s/m", "N s", "N m s", words="damping term", typical=10.0))
    stiffness_up: Array | None = eqx.field(metadata=unit("N/m", low=0.0, each="support", words="vertical stiffness"))
    damping_up: Array | None = eqx.field(metadata=unit("N s/m", low=0.0, each="support", words="vertical damping"))
    kind: str = eqx.field(static=True)
    places = "shaft"

    def carrier(self) -> Carrier:
        """Return the matrices of the four coordinates."""

        def terms(support: Array, given: Array | None) -> tuple[Array, Array, Array]:
            if given is not None:
                return given[0], given[1], given[2]
            return jnp.sum(support), jnp.sum(support * self.position), jnp.sum(support * self.position**2)

        def matrix(one: Array, two: Array, three: Array) -> Array:
            plane = jnp.stack([jnp.stack([one, two]), jnp.stack([two, three])])
            return jnp.kron(plane, jnp.eye(2, dtype=plane.dtype))

        stiffness = terms(self.stiffness, self.stiffness_terms)
        damping = terms(self.damping, self.damping_terms)
        zero = jnp.zeros_like(self.mass)
        translation, tilt = self._directions()
        carrier = Carrier(
            mass=matrix(self.mass, zero, self.transverse_inertia),
            damping=matrix(*damping),
            stiffness=matrix(*stiffness),
            foundation_stiffness=stiffness[0] * translation + stiffness[1] * tilt,
            foundation_damping=damping[0] * translation + damping[1] * tilt,
            coordinates=("y", "z", "theta", "psi"),
            coordinate_units=("m", "m", "rad", "rad"),
        )
        is_up = np.array([[False], [True], [False], [True]])
        changed = {}
        for name, up in (("stiffness", self.stiffness_up), ("damping", self.damping_up)):
            if up is not None:
                whole = jnp.where(is_up, matrix(*terms(up, None)), getattr(carrier, name))
                changed |= {name: whole, f"foundation_{name}": whole[:2]}
        return dataclasses.replace(carrier, **changed) if changed else carrier

    def mount(self, at: Place = None) -> Mount:
        """Return the mount at the exciter's station. If each load has its own station, this is its lever, and the rows are
        those of the centre of mass and of the tilt of the axis."""
        skew = np.zeros((4, 4))
        skew[2, 3], skew[3, 2] = 1.0, -1.0
        station = self.stations if at is None else jnp.asarray(at)
        shared = at is not None or self.stations.ndim == 0
        return Mount(
            rows=(self.rows_at(at, "at"), self._directions()[1]),
            axes=(0, 1),
            levers=(None,) if shared else (None, self.stations),
            rotor_levers=(None, -station) if shared else (None,),
            gyroscopic=self.polar_inertia * jnp.asarray(skew, dtype=self.mass.dtype),
        )

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the rows of the point of the axis at a distance from the centre of mass, m; None is the common station of the
        loads, or the centre of mass if each load has its own station."""
        if isinstance(place, (int, np.integer)):
            raise InputError(
                name, f"is {place}, which numbers a platform; on a rotor give a position, m from the centre of mass"
            )
        if isinstance(place, (list, tuple)) or getattr(place, "ndim", 0) > 0:
            raise InputError(
                name, f"is {quoted(place)}, a point of a body; on a rotor give a position, m from the centre of mass"
            )
        translation, tilt = self._directions()
        shared = self.stations if self.stations.ndim == 0 else None
        distance = shared if place is None else number(cast(Number, place), "m", name)
        return translation if distance is None else translation + distance * tilt

    def _directions(self) -> tuple[Array, Array]:
        """Return rows (2, 4) of the centre of mass, and of the tilt of the axis."""
        return jnp.eye(2, 4, dtype=self.mass.dtype), jnp.eye(2, 4, 2, dtype=self.mass.dtype)

    def support_rows(self) -> tuple[Array, Array]:
        """Return the rows of the force on each support, or on one support if `stiffness_terms` or `damping_terms` are given."""
        if self.stiffness_terms is not None or self.damping_terms is not None:
            return super().support_rows()
        translation, tilt = self._directions()
        rows_at_supports = translation[None] + self.position[:, None, None] * tilt[None]

        def rows(across: Array, up: Array | None) -> Array:
            return jnp.stack([across, across if up is None else up], axis=1)[..., None] * rows_at_supports

        return rows(self.stiffness, self.stiffness_up), rows(self.damping, self.damping_up)

    def upward(self) -> np.ndarray:
        """Return the coordinates of a translation by 1 m in the second direction: upward if the axis is horizontal."""
        return np.array([0.0, 1.0, 0.0, 0.0])

    def shaft_supports(self) -> list[tuple[float, float, float]]:
        """Return the place, vertical stiffness and vertical damping of both supports. If terms replace the supports, the values
        are those that give the same c1, c2, b1 and b2."""
        position = np.asarray(self.position)

        def vertical(across: Array, up: Array | None, terms: Array | None) -> list[float]:
            if terms is None:
                return (across if up is None else up).tolist()
            return np.linalg.lstsq(np.stack([np.ones(2), position]), np.asarray(terms)[:2])[0].tolist()

        stiffness = vertical(self.stiffness, self.stiffness_up, self.stiffness_terms)
        damping = vertical(self.damping, self.damping_up, self.damping_terms)
        return list(zip(position.tolist(), stiffness, damping, strict=True))


@with_known_names
def rotor(
    *,
    mass: Number,
    transverse_inertia: Number,
    polar_inertia: Number,
    stiffness: Numbers,
    damping: Numbers,
    position: Sequence[Number],
    stations: Numbers = 0.0,
    stiffness_terms: Sequence[Number] | None = None,
    damping_terms: Sequence[Number] | None = None,
    stiffness_up: Numbers | None = None,
    damping_up: Numbers | None = None,
) -> Rotor:
    """Return a rigid rotor on two supports, with the loads at one station or at several.

        M y'' + b1 y' + b2 theta' + c1 y + c2 theta = forces
        A theta'' + C w psi' + b2 y' + b3 theta' + c2 y + c3 theta = moments
        c1 = k1 + k2,    c2 = k1 L1 + k2 L2,    c3 = k1 L1^2 + k2 L2^2

    The equations of z and psi (see `Rotor`) and the expressions of b1, b2, b3 are analogous. w is the rotor speed; L1 and L2
    are the positions of the supports with their signs.

    **Arguments** (SI, or strings with a unit)

    - `mass` M, kg, loads not included; typical: 5 to 50
    - `transverse_inertia` A about a transverse axis, kg m^2, loads not included; typical: 0.05 to 1
    - `polar_inertia` C about the axis of rotation, kg m^2, loads not included, at most 2 A; typical: 0.01 to 0.5
    - `stiffness` k (2,) of the supports, N/m; typical: 1e5 to 1e6
    - `damping` (2,) of the supports, N s/m; typical: 100 to 1000; also a ratio "5 %" or a loss factor, see `one_mass`. With
      "5 %" at both supports the translation of the rotor without tilt has this ratio (without `stiffness_terms`)
    - `position` (2,) of the supports along the axis, m from the centre of mass, one side negative; typical: 0.1 to 0.5
    - `stations` of the loads along the axis, m from the centre of mass: one number for all loads, or one for each load;
      typical: -0.3 to 0.3, default 0. A list of equal numbers counts as one number
    - `stiffness_terms` (c1, c2, c3) in N/m, N, N m: a list of three in place of the terms that follow from the supports;
      typical: c1 1e6, c2 -2e4 to 2e4, c3 3e4
    - `damping_terms` (b1, b2, b3) in N s/m, N s, N m s: a list of three in place of the terms that follow from the supports;
      typical: b1 800, b2 -10 to 10, b3 20
    - `stiffness_up` (2,), N/m, and `damping_up` (2,), N s/m: vertical values of the supports; `stiffness` and `damping` are
      then the horizontal values; typical: 0.5 to 2 times the horizontal values; default: the horizontal values

    **Returns** `Rotor`.

    **Raises** `InputError` for

    - wrong units and values that are not allowed
    - supports at one place
    - a polar inertia above twice the transverse one
    - terms that no supports can have (a negative c1 or c3, or c2^2 > c1 c3), or terms together with vertical values

    >>> import jaxvib as jv
    >>> machine = jv.rotor(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(0.604e6, 0.555e6),
    ...                    damping=(420.0, 420.0), position=(0.165, -0.155), stations=(0.28, 0.25, -0.25, -0.28))
    >>> machine.carrier().coordinates
    ('y', 'z', 'theta', 'psi')

    Source: Artyunin 2013, equation (1).
    """

    read = partial(read_numbers, Rotor, "machine")

    def terms(field: str, values: Sequence[Number] | None) -> Array | None:
        given = read(**{field: values})[field]
        if given is not None:
            when_known(partial(_require_passive, field), *given)
        return given

    places = read(2, position=position)["position"]
    if stiffness_terms is None:
        needed = "which leaves the tilt of the rotor without stiffness; give two places, such as [0.165, -0.155]"
        problem = "puts both supports at {0[0]:g} m, " + needed
        require_if_known(lambda at: at[0] != at[1], places, field="machine.position", problem=problem)
    transverse, polar = read(transverse_inertia=transverse_inertia, polar_inertia=polar_inertia).values()
    when_known(_require_possible_inertia, transverse, polar)
    for name, given, up in (("stiffness", stiffness_terms, stiffness_up), ("damping", damping_terms, damping_up)):
        if given is not None and up is not None:
            problem = f"is given together with {name}_terms, which are those of both directions; give {name} and {name}_up"
            raise InputError(f"machine.{name}_up", problem)
    found = {**read(mass=mass), **read(2, stiffness=stiffness)}
    k = found["stiffness"]
    found |= read(2, damping=damping_constants(damping, "machine.damping", k, lambda: found["mass"] * k / jnp.sum(k)))
    k_up = read(2, stiffness_up=stiffness_up)["stiffness_up"]
    c_up = None
    if damping_up is not None:
        vertical = k if k_up is None else k_up
        constants = damping_constants(
            damping_up, "machine.damping_up", vertical, lambda: found["mass"] * vertical / jnp.sum(vertical)
        )
        c_up = read(2, damping_up=constants)["damping_up"]
    return Rotor(
        **found,
        stations=_merge_equal(read(stations=stations)["stations"]),
        transverse_inertia=transverse,
        polar_inertia=polar,
        position=places,
        stiffness_terms=terms("stiffness_terms", stiffness_terms),
        damping_terms=terms("damping_terms", damping_terms),
        stiffness_up=k_up,
        damping_up=c_up,
        kind="rotor",
    )


def _merge_equal(stations: Array) -> Array:
    """Return stations (n,), or one station () if all are equal."""
    distinct = when_known(_distinct, stations)
    stations = stations if distinct is None else jnp.asarray(distinct, stations.dtype)
    return jnp.reshape(stations, ()) if stations.size == 1 else stations


def _distinct(stations: np.ndarray | float) -> np.ndarray:
    """Return stations (n,), made equal where they differ only by rounding; one station (1,) if all are equal."""
    places, which = np.unique(np.atleast_1d(stations), return_inverse=True)
    rounding = max(1e-9, 32.0 * float(np.finfo(places.dtype).eps)) * np.max(np.abs(places))
    is_new = np.diff(places, prepend=-np.inf) > rounding
    return places[is_new][np.cumsum(is_new)[which] - 1] if np.sum(is_new) > 1 else places[:1]


def _require_passive(field: str, one: float, two: float, three: float) -> None:
    if min(one, three) < 0.0 or two**2 > one * three * (1.0 + 1e-9):
        problem = (
            "are not the terms of any supports; the first and the last must be at least 0, and their product "
            "at least the square of the middle one"
        )
        raise InputError(f"machine.{field}", f"{[one, two, three]} {problem}")


def _require_possible_inertia(transverse: float, polar: float) -> None:
    if polar > 2.0 * transverse * (1.0 + 1e-6):
        most = f"it cannot exceed twice the transverse inertia, {2.0 * transverse:g} kg m^2 (a thin disc)"
        raise InputError("machine.polar_inertia", f"is {polar:g} kg m^2; {most}")


_UNITS = {"stiffness": "N/mm", "damping": "N s/m"}
"""Units of the values of a support in messages."""


class PlanarRotor(Machine):
    """Rotor on one support, moving without tilt in the two directions across its axis: horizontal and vertical if the axis is
    horizontal.

        M y'' + b y' + k y = f_y,    M z'' + b_up z' + k_up z = f_z

    **Attributes**; typical values: see `planar_rotor`

    - `mass` M, kg, loads not included
    - `stiffness` k, N/m
    - `damping` b, N s/m
    - `stiffness_up` and `damping_up`: vertical values, if `stiffness` and `damping` are the horizontal ones; None: the same

    Source: the special case of `Rotor` with both supports and all loads in the plane of its centre of mass.
    """

    mass: Array = eqx.field(metadata=_MASS)
    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, words="stiffness of the support"))
    damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, words="damping of the support"))
    stiffness_up: Array | None = eqx.field(metadata=unit("N/m", low=0.0, words="vertical stiffness of the support"))
    damping_up: Array | None = eqx.field(metadata=unit("N s/m", low=0.0, words="vertical damping of the support"))
    kind: str = eqx.field(static=True)

    def carrier(self) -> Carrier:
        """Return the matrices of the two coordinates."""
        eye = jnp.eye(2, dtype=self.mass.dtype)

        def matrix(across: Array, up: Array | None) -> Array:
            return across * eye if up is None else jnp.diag(jnp.stack([across, up]))

        return Carrier(
            mass=self.mass * eye,
            damping=matrix(self.damping, self.damping_up),
            stiffness=matrix(self.stiffness, self.stiffness_up),
            foundation_stiffness=matrix(self.stiffness, self.stiffness_up),
            foundation_damping=matrix(self.damping, self.damping_up),
            coordinates=("y", "z"),
        )

    def upward(self) -> np.ndarray:
        """Return the coordinates of a translation by 1 m in the second direction: upward if the axis is horizontal."""
        return np.array([0.0, 1.0])

    def mount(self, at: Place = None) -> Mount:
        """Return the mount, at the rotor's centre. **Raises** `InputError` if a place `at` is given."""
        if at is not None:
            self.rows_at(at, "at")
        return Mount(rows=(jnp.eye(2, dtype=self.mass.dtype),), axes=(0, 1))


@with_known_names
def planar_rotor(
    *, mass: Number, stiffness: Number, damping: Number, stiffness_up: Number | None = None, damping_up: Number | None = None
) -> PlanarRotor:
    """Return a rotor that moves without tilt on one support, in the two directions across its axis: horizontal and vertical if
    the axis is horizontal.

        M y'' + b y' + k y = f_y,    M z'' + b_up z' + k_up z = f_z

    **Arguments** (SI, or strings with a unit)

    - `mass` M, kg, loads not included; typical: 5 to 50
    - `stiffness` k, N/m; typical: 1e3 for a soft suspension, 1e5 to 1e6 for bearings
    - `damping` b, N s/m; typical: 50 to 1000; also a ratio of the critical damping 2 sqrt(k M), "5 %", or a loss factor, see
      `one_mass`
    - `stiffness_up` k_up, N/m, and `damping_up` b_up, N s/m: vertical values, if `stiffness` and `damping` are the horizontal
      values; typical: 0.5 to 2 times the horizontal values; default: the horizontal values

    **Returns** `PlanarRotor`. **Raises** `InputError` for wrong units and values that are not allowed.

    >>> import jaxvib as jv
    >>> jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0).mount().rows[0].shape
    (2, 2)

    Source: the special case of Artyunin 2013, equation (1), see `PlanarRotor`.
    """
    _require_one_value(stiffness=stiffness, damping=damping)
    read = partial(read_numbers, PlanarRotor, "machine")
    found = read(mass=mass, stiffness=stiffness)
    k = found["stiffness"]
    found |= read(damping=damping_constants(damping, "machine.damping", k, lambda: found["mass"]))
    k_up = read(stiffness_up=stiffness_up)["stiffness_up"]
    c_up = None
    if damping_up is not None:
        constant = damping_constants(damping_up, "machine.damping_up", k if k_up is None else k_up, lambda: found["mass"])
        c_up = read(damping_up=constant)["damping_up"]
    return PlanarRotor(**found, stiffness_up=k_up, damping_up=c_up, kind="planar_rotor")


def _require_one_value(**values: Number) -> None:
    """**Raises** `InputError` for a list of 2 values; the message shows how to write two directions and two supports."""
    for name, value in values.items():
        if isinstance(value, (list, tuple)) and len(value) == 2:
            across, up = map(quoted, value)
            problem = f"is a list of 2 values; for the horizontal and the vertical direction write {name} = {across}"
            raise InputError(f"machine.{name}", f"{problem}, {name}_up = {up}; two equal supports: '2 x 150 {_UNITS[name]}'")
