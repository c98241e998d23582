"""Checks of the values (types, shapes, the mass matrix) that machines, loads, drives and effects return if their classes are
defined outside this package.

Parts of the package are not checked here, because the tests of the package check them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import is_real
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Carrier, Machine, Mount, Place, shape_and_dtype, shapes_of
from jaxvib.machine.drives.drive import Drive, IdealDrive, Motor
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import LoadResistance, Term
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import Part
from jaxvib.machine.structures.matrices import require_definite
from jaxvib.units.known import when_known

T = TypeVar("T", bound=Part)

Shape = tuple[int, ...]


def _is_of_package(part: Part) -> bool:
    return type(part).__module__.partition(".")[0] == "jaxvib"


def _once_for_each_structure(check: Callable[..., None]) -> Callable[..., None]:
    """Return a function that applies a check by tracing, if the class of the first part is not of this package. Parts of equal
    structure, shapes and default dtype are checked once. The other parts are those on which the check depends."""

    @functools.lru_cache(maxsize=256)
    def on_shapes(structure: Hashable, shapes: tuple[tuple[Shape, np.dtype], ...], dtype: np.dtype) -> None:
        check(*jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*each) for each in shapes]))

    @functools.wraps(check)
    def require(part: Part, *others: Part) -> None:
        if not _is_of_package(part):
            leaves, structure = jax.tree.flatten((part, *others))
            on_shapes(structure, tuple(map(shape_and_dtype, leaves)), jnp.result_type(float))

    return require


def require_machine(machine: Machine, place: Place) -> None:
    """**Raises** `InputError` for a carrier, or a mount at the `place`, whose matrices do not fit each other, and for a mass
    matrix that is not symmetric and positive definite."""
    if _is_of_package(machine):
        return
    carrier, mount = shapes_of(machine, place)
    for name, value, kind in (("carrier", carrier, Carrier), ("mount", mount, Mount)):
        if not isinstance(value, kind):
            raise InputError(f"machine.{name}", f"returns {quoted(value)}; a {kind.__name__} is needed")
    size = len(_require_tuple("machine.carrier", "coordinates: ", carrier.coordinates, "names"))
    square = (size, size)
    for name in ("mass", "damping", "stiffness"):
        _require_shape("machine.carrier", f"{name}: ", getattr(carrier, name), square)
    for name in ("foundation_stiffness", "foundation_damping"):
        _require_shape("machine.carrier", f"{name}: ", getattr(carrier, name), (1, size), (2, size))
    axes = _require_tuple("machine.mount", "axes: ", mount.axes, "1 or 2 axes")
    if axes not in ((0,), (1,), (0, 1)):
        raise InputError("machine.mount", f"returns the axes {axes}; (0,), (1,) or (0, 1) is needed: 0 horizontal, 1 up")
    for matrix in _require_tuple("machine.mount", "rows: ", mount.rows, "1 or 2 matrices"):
        _require_shape("machine.mount", "rows: ", matrix, (len(axes), size))
    if mount.gyroscopic is not None:
        _require_shape("machine.mount", "gyroscopic: ", mount.gyroscopic, square)
    if mount.turn is not None:
        _require_shape("machine.mount", "turn: ", mount.turn, (size,))
    name = "machine.carrier().mass"
    when_known(lambda _: require_definite(np.asarray(machine.carrier().mass), name, positive=True), machine)


@_once_for_each_structure
def require_loads(loads: Loads) -> None:
    """**Raises** `InputError` for loads whose coordinates, positions or forces do not have one entry for each load."""
    each, single = (loads.count,), ()
    if np.shape(loads.mass) not in (each, single):
        raise InputError("loads.mass", f"is {_described(loads.mass)}; the shape {each} or {single} is needed")
    rest = _require_tuple("loads.rest", "", eqx.filter_eval_shape(lambda loads: loads.rest(), loads), "coordinates")
    for u in rest:
        _require_shape("loads.rest", "", u, each)
    place = eqx.filter_eval_shape(lambda loads: loads.position(*loads.rest()), loads)
    position = _require_tuple("loads.position", "", place, "2 or 3 coordinates", 2, 3)
    force = eqx.filter_eval_shape(lambda loads: loads.resistance(loads.rest(), loads.rest(), jnp.ones(())), loads)
    resistance = _require_tuple("loads.resistance", "", force, f"{len(rest)}, one force for each coordinate,", len(rest))
    factor = eqx.filter_eval_shape(lambda loads: loads.inertia_factor(), loads)
    for name, values in (("position", position), ("resistance", resistance), ("inertia_factor", (factor,))):
        for value in values:
            _require_shape(f"loads.{name}", "", value, each, single)


@_once_for_each_structure
def require_drive(drive: Drive) -> None:
    """**Raises** `InputError` for a drive whose methods do not return single numbers."""
    names = ("speed_at", "angle_at", "acceleration_at") if isinstance(drive, IdealDrive) else ()
    for name in ("torque",) if isinstance(drive, Motor) else names:
        value = eqx.filter_eval_shape(lambda drive, name=name: getattr(drive, name)(jnp.ones(())), drive)
        _require_shape(f"drive.{name}", "", value, ())


def require_terms(effect: Effect) -> None:
    """**Raises** `InputError` for an effect whose method `terms` does not return terms."""
    if _is_of_package(effect):
        return
    field = f"effects.{effect.kind}.terms"
    for term in _require_tuple(field, "", effect.terms(), "terms", least=0):
        if not isinstance(term, get_args(Term)):
            kinds = ", ".join(kind.__name__ for kind in get_args(Term))
            raise InputError(field, f"returns {quoted(term)}; terms are needed: {kinds}")


@_once_for_each_structure
def require_forces(effect: Effect, loads: Loads) -> None:
    """**Raises** `InputError` for an effect whose resistance of the `loads` is not one force for each coordinate."""

    def forces(effect: Effect, loads: Loads) -> tuple[tuple[Array, ...], list[tuple[Array, ...]]]:
        rest, terms = loads.rest(), [term for term in effect.terms() if isinstance(term, LoadResistance)]
        return rest, [term.resistance(loads, rest, rest) for term in terms]

    rest, found = eqx.filter_eval_shape(forces, effect, loads)
    field = f"effects.{effect.kind}.resistance"
    for force in found:
        for value in _require_tuple(field, "", force, f"{len(rest)}, one force for each coordinate,", len(rest)):
            _require_shape(field, "", value, (loads.count,), ())


def _require_tuple(field: str, name: str, value: Any, needed: str, *lengths: int, least: int = 1) -> Sequence[Any]:
    """Return the value. **Raises** `InputError` if it is not a tuple with one of the `lengths`; default: at least `least`."""
    is_tuple = isinstance(value, (tuple, list))
    if not is_tuple or len(value) < least or (lengths and len(value) not in lengths):
        shown = f"a tuple of {len(value)}" if is_tuple else _described(value)
        raise InputError(field, f"returns {name}{shown}; a tuple of {needed} is needed")
    return value


def _require_shape(field: str, name: str, value: Any, *shapes: Shape) -> None:
    if not (hasattr(value, "shape") or is_real(value)) or np.shape(value) not in shapes:
        needed = " or ".join(str(shape) if shape else "() of a single number" for shape in shapes)
        raise InputError(field, f"returns {name}{_described(value)}; the shape {needed} is needed")


def _described(value: object) -> str:
    is_array = isinstance(value, (jax.ShapeDtypeStruct, jax.Array, np.ndarray))
    return f"an array of shape {value.shape}" if is_array else quoted(value)
