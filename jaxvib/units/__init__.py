"""Numbers of users: their units are read here and nowhere else; inside, everything is SI."""

from __future__ import annotations

import contextlib
import contextvars
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.boundary import is_whole
from jaxvib.errors import InputError, quoted
from jaxvib.runtime.compat import traced
from jaxvib.units.reading import Number, Numbers, Quantity, in_own_unit, require_real, to_float, unit_name, unit_ratio

__all__ = [
    "FIELD_UNITS",
    "Number",
    "Numbers",
    "Quantity",
    "bounds_of_unknowns",
    "count",
    "in_own_unit",
    "known_number",
    "number",
    "numbers",
    "random_numbers",
    "require_real",
    "to_float",
    "traced",
    "unit_ratio",
]

FIELD_UNITS = {
    "mass": "kg",
    "stiffness": "N/m",
    "damping": "N s/m",
    "link_stiffness": "N/m",
    "link_damping": "N s/m",
    "radius": "m",
    "drag": "N s/m",
    "inertia": "kg m^2",
    "speed": "rad/s",
}
"""The unit of each number of a scene that a design may free or hold."""


_COLLECTED: contextvars.ContextVar[list[Array] | None] = contextvars.ContextVar("collected", default=None)


@contextlib.contextmanager
def bounds_of_unknowns() -> Iterator[list[Array]]:
    """Collect, while parts of a scene are built, a condition for each number that has no value yet: that it is allowed."""
    found: list[Array] = []
    token = _COLLECTED.set(found)
    try:
        yield found
    finally:
        _COLLECTED.reset(token)


_MAX_NUMBERS = 10**7
"""The longest list of numbers; larger ones come as arrays."""


def _checked(value: Array | np.ndarray, field: str, unit: str, low: float, open_low: bool, place: str = "") -> None:
    """Check known values; a traced one has no value yet, see `bounds_of_unknowns`."""
    if traced(value):
        collected = _COLLECTED.get()
        if collected is not None:
            collected.append(jnp.all(jnp.isfinite(value) & ((value > low) if open_low else (value >= low))))
        return
    flat = np.atleast_1d(np.asarray(value))
    for index, entry in enumerate(flat):
        name = f"{field}[{index}]" if place == "each" else field
        shown = f"{entry:g} {unit}".strip()
        if not np.isfinite(entry):
            raise InputError(name, f"is {shown}; a finite number is needed")
        if unit == "rad" and abs(entry) * np.finfo(flat.dtype).eps > 1.0:
            most = 1.0 / np.finfo(flat.dtype).eps
            raise InputError(
                name, f"is {shown}; it must be below {most:.1e} rad, above which angles have no digits within a turn"
            )
        if entry < low or (open_low and entry == low):
            raise InputError(name, f"is {shown}; it must be {'greater than' if open_low else 'at least'} {low:g}")


def number(value: Number, unit: str, field: str, *, low: float = -math.inf, open_low: bool = False) -> Array:
    """One number as a floating-point scalar array in SI units, checked against a lower bound (`open_low`: exclusive).

    **Raises** `InputError` for a wrong unit, a list, a value that is not finite or below the bound.

    >>> float(number("2 t", "kg", "machine.mass"))
    2000.0
    """
    return jnp.asarray(known_number(value, unit, field, low=low, open_low=open_low))


def known_number(value: Number, unit: str, field: str, *, low: float = -math.inf, open_low: bool = False) -> Any:
    """`number` as NumPy has it where JAX does not yet: it goes to a program with the call, in a tenth of the time that moving
    it there first takes."""
    if isinstance(value, (list, tuple)):
        raise InputError(field, f"is a list of {len(value)} values; one number in {unit_name(unit)} is needed")
    return _converted(to_float(value, unit, field), unit, field, (), low, open_low)


def numbers(
    value: Numbers,
    unit: str,
    field: str,
    length: int | None,
    *,
    low: float = -math.inf,
    open_low: bool = False,
    shared: bool = False,
) -> Array:
    """`length` numbers as an array in SI units; `length` None takes any number of them, one at least.

    A single number stands for all of them: it is repeated, or kept as one scalar that all share if `shared`.

    **Raises** `InputError` as `number` does, and for a list of another length.

    >>> numbers(["44 N/mm", 5e4], "N/m", "machine.stiffness", 2).tolist()
    [44000.0, 50000.0]
    """
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes, bytearray)):
        if len(value) > (_MAX_NUMBERS if length is None else length):
            needed = f"{length} are needed" if length is not None else f"at most {_MAX_NUMBERS} are allowed"
            raise InputError(field, f"has {len(value)} values; {needed}")
        for i, part in enumerate(value):
            if isinstance(part, (list, tuple)) or getattr(part, "ndim", 0) != 0:
                raise InputError(f"{field}[{i}]", f"is not a single number; write a number in {unit_name(unit)}")
        parts = [to_float(v, unit, f"{field}[{i}]") for i, v in enumerate(value)]
        if length is not None and len(parts) != length:
            raise InputError(field, f"has {len(parts)} values; {length} are needed")
        if not parts:
            raise InputError(field, "is an empty list; at least 1 value is needed")
        if not all(isinstance(part, jax.Array) for part in parts):
            for i, part in enumerate(parts):
                _array(part, unit, f"{field}[{i}]", (), low, open_low)
        known = not any(isinstance(part, jax.Array) for part in parts)
        stacked = np.asarray(parts, dtype=float) if known else jnp.stack([jnp.asarray(p, dtype=float) for p in parts])
        return _array(stacked, unit, field, stacked.shape, low, open_low)
    single: Any = value
    magnitude = to_float(single, unit, field)
    if np.ndim(magnitude) == 0:
        scalar = _array(magnitude, unit, field, (), low, open_low)
        if shared or length is None:
            return scalar
        known = not isinstance(magnitude, jax.Array)
        return jnp.asarray(np.full(length, magnitude), dtype=float) if known else jnp.broadcast_to(scalar, (length,))
    if np.size(magnitude) == 0 and length is None:
        raise InputError(field, "is an empty array; at least 1 value is needed")
    if np.ndim(magnitude) != 1 or (length is not None and np.shape(magnitude)[0] != length):
        raise InputError(field, f"has shape {np.shape(magnitude)}; {'a list' if length is None else f'({length},)'} is needed")
    return _array(magnitude, unit, field, np.shape(magnitude), low, open_low)


def _array(value: ArrayLike, unit: str, field: str, shape: tuple[int, ...], low: float, open_low: bool) -> Array:
    return jnp.asarray(_converted(value, unit, field, shape, low, open_low))


def _converted(
    value: ArrayLike, unit: str, field: str, shape: tuple[int, ...], low: float, open_low: bool
) -> Array | np.ndarray:
    """What JAX does not hold yet NumPy converts: no program need be compiled for it."""
    try:
        if isinstance(value, jax.Array):
            array = jnp.asarray(value, dtype=float)
        else:
            with np.errstate(over="ignore"):  # what single precision cannot hold is infinite, which `_checked` refuses
                array = np.asarray(value, dtype=float).astype(jnp.result_type(float))
    except OverflowError as error:
        raise InputError(field, f"is {quoted(value)}, which is too large; give a number below 1e308") from error
    except (TypeError, ValueError) as error:
        raise InputError(field, f"is {quoted(value)}, which is not a number; write a number in {unit_name(unit)}") from error
    if array.shape != shape:
        raise InputError(field, f"has shape {array.shape}; one number in {unit_name(unit)} is needed")
    _checked(array, field, unit, low, open_low, place="each" if shape else "")
    return array


_MAX_COUNT = 2**31 - 1
"""The largest count: arrays are indexed by numbers of 32 bits on accelerators."""


def count(value: object, field: str, *, low: int = 1, each: float = 0.0) -> int:
    """A whole number of things, at least `low`, of which `each` takes so many bytes.

    **Raises** `InputError` for anything else, and for more than fit into half of this machine's memory.

    >>> count(0, "loads.count")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: loads.count is 0; it must be a whole number, at least 1
    """
    if not isinstance(value, (int, np.integer)) or not is_whole(value) or value < low:
        raise InputError(field, f"is {quoted(value)}; it must be a whole number, at least {low}")
    if each and 2.0**30 / each < value < 2**63:
        room = 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2.0**33
        if value * each > room:
            needs = f"needs {value * each / 2.0**30:.3g} GiB, more than half of this machine's memory"
            raise InputError(field, f"is {value}, which {needs}; {int(room / each)} at most fit")
    if value > _MAX_COUNT:
        raise InputError(field, f"is {quoted(value)}; it must be a whole number from {low} to {_MAX_COUNT}")
    return int(value)


def random_numbers(seed: object) -> np.random.Generator:
    """Return the generator of random numbers that belongs to a seed, a whole number of at least 0.

    >>> random_numbers(-1)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: seed is -1; it must be a whole number, at least 0
    """
    return np.random.default_rng(count(seed, "seed", low=0))
