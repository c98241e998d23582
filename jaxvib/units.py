"""Numbers with units come in here and nowhere else; inside, everything is SI."""

from __future__ import annotations

import math
import os
import re
import tokenize
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.errors import InputError
from jaxvib.runtime.compat import traced

__all__ = ["FIELD_UNITS", "Number", "Numbers", "count", "known_number", "number", "numbers", "to_float", "traced"]


@runtime_checkable
class Quantity(Protocol):
    """A number with a unit, such as pint's."""

    def m_as(self, units: str, /) -> Any:
        """Its magnitude in a unit."""
        ...


Number: TypeAlias = float | Array | np.ndarray | np.number | str | Quantity
"""A number as public functions accept it: a float, an array, a traced value, a string with a unit, a pint quantity."""

Numbers: TypeAlias = Number | Sequence[Number]
"""Several of them, or one that stands for all."""


_TEXT = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\W\d_](?:(?!\s\d)[^,;()])*)")
"""One number with a decimal point, then one unit: everything else a unit library might make a number of is a slip."""

_FACTORS = {
    "kg": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "N/m": {"N/m": 1.0, "N/mm": 1e3, "kN/m": 1e3, "kN/mm": 1e6},
    "N s/m": {"N s/m": 1.0, "N s/mm": 1e3, "kN s/m": 1e3},
    "kg m^2": {"kg m^2": 1.0, "kg cm^2": 1e-4},
    "rad/s": {"rad/s": 1.0, "rpm": math.pi / 30.0, "Hz": 2.0 * math.pi},
}
"""What most drawings are written in. pint reads everything else, and takes half a second to get ready for it."""

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


_UNREADABLE = (AttributeError, TypeError, ValueError, ArithmeticError, AssertionError, SyntaxError, tokenize.TokenError)
"""What pint, which reads a unit as Python, raises beside its own errors for a text that is none."""


def _unit_name(unit: str) -> str:
    return unit or "no unit"


def _example(unit: str) -> str:
    return "'1500 rpm', '157.1 rad/s' or '25 Hz'" if unit == "rad/s" else f"'1.5 {unit}'" if unit else "1.5"


def to_float(value: Number, unit: str, field: str) -> float | Array | np.ndarray | np.number:
    """The SI magnitude of `value` in `unit`; numbers without a unit are taken to be in `unit` already.

    Strings and pint quantities are converted. A frequency in hertz given where rad/s is wanted counts as
    revolutions per second (pint alone would take 25 Hz for 25 rad/s).

    **Raises** `InputError` for a text that is no number, an unknown unit or a unit of another dimension.

    >>> round(to_float("1500 rpm", "rad/s", "drive.speed"), 4)
    157.0796
    >>> round(to_float("25 Hz", "rad/s", "drive.speed"), 4)
    157.0796
    >>> to_float("3 kg", "N/m", "machine.stiffness")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: machine.stiffness is '3 kg', which is not in N/m; write for example '1.5 N/m'
    """
    if isinstance(value, bool):
        raise InputError(field, f"is {value}, which is not a number; write a number in {_unit_name(unit)}")
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            pass
    if isinstance(value, (str, Quantity)):
        wrong = InputError(field, f"is {str(value)!r}, which is not in {_unit_name(unit)}; write for example {_example(unit)}")
        parts = _TEXT.fullmatch(value.strip()) if isinstance(value, str) else None
        if isinstance(value, str) and parts is None:
            raise wrong
        if parts is not None and parts[2] in _FACTORS.get(unit, ()):
            return float(parts[1]) * _FACTORS[unit][parts[2]]
        import pint

        try:
            given: Any = value if parts is None else pint.get_application_registry().Quantity(float(parts[1]), parts[2])
            magnitude = given.m_as(unit or "dimensionless")
        except (pint.PintError, *_UNREADABLE) as error:
            raise wrong from error
        hertz = sum(power for name, power in given.unit_items() if name.endswith("hertz"))
        return magnitude * (2.0 * math.pi) ** hertz if "rad" in unit else magnitude
    if value is None or isinstance(value, (dict, set)):
        raise InputError(field, f"is {value!r}, which is not a number; write a number in {_unit_name(unit)}")
    return value


def _checked(value: Array | np.ndarray, field: str, unit: str, low: float, open_low: bool, place: str = "") -> None:
    """Value checks, for concrete numbers only: a traced value has none to look at."""
    if traced(value):
        return
    flat = np.atleast_1d(np.asarray(value))
    for index, entry in enumerate(flat):
        name = f"{field}[{index}]" if place == "each" else field
        shown = f"{entry:g} {unit}".strip()
        if not np.isfinite(entry):
            raise InputError(name, f"is {shown}; a finite number is needed")
        if entry < low or (open_low and entry == low):
            raise InputError(name, f"is {shown}; it must be {'greater than' if open_low else 'at least'} {low:g}")


def number(value: Number, unit: str, field: str, *, low: float = -math.inf, open_low: bool = False) -> Array:
    """One number as a floating-point scalar array in SI units, checked against a lower bound (`open_low`: exclusive).

    **Raises** `InputError` for a wrong unit, a list, a value that is not finite or below the bound.

    >>> float(number("2 t", "kg", "machine.mass"))
    2000.0
    """
    return jnp.asarray(known_number(value, unit, field, low=low, open_low=open_low), dtype=float)


def known_number(value: Number, unit: str, field: str, *, low: float = -math.inf, open_low: bool = False) -> Any:
    """`number` as NumPy has it where JAX does not yet: it goes to a program with the call, in a tenth of the time that moving
    it there first takes."""
    if isinstance(value, (list, tuple)):
        raise InputError(field, f"is a list of {len(value)} values; one number in {_unit_name(unit)} is needed")
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
    if isinstance(value, Sequence) and not isinstance(value, str):
        parts = [to_float(v, unit, f"{field}[{i}]") for i, v in enumerate(value)]
        for i, part in enumerate(parts):
            if np.ndim(part) != 0:
                raise InputError(f"{field}[{i}]", f"is not a single number; write a number in {_unit_name(unit)}")
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
    magnitude = to_float(value, unit, field)
    if np.ndim(magnitude) == 0:
        scalar = _array(magnitude, unit, field, (), low, open_low)
        if shared or length is None:
            return scalar
        known = not isinstance(magnitude, jax.Array)
        return jnp.asarray(np.full(length, magnitude), dtype=float) if known else jnp.broadcast_to(scalar, (length,))
    if np.ndim(magnitude) != 1 or (length is not None and np.shape(magnitude)[0] != length):
        raise InputError(field, f"has shape {np.shape(magnitude)}; {'a list' if length is None else f'({length},)'} is needed")
    return _array(magnitude, unit, field, np.shape(magnitude), low, open_low)


def _array(value: ArrayLike, unit: str, field: str, shape: tuple[int, ...], low: float, open_low: bool) -> Array:
    return jnp.asarray(_converted(value, unit, field, shape, low, open_low), dtype=float)


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
    except (TypeError, ValueError) as error:
        raise InputError(field, f"is {value!r}, which is not a number; write a number in {_unit_name(unit)}") from error
    if array.shape != shape:
        raise InputError(field, f"has shape {array.shape}; one number in {_unit_name(unit)} is needed")
    _checked(array, field, unit, low, open_low, place="each" if shape else "")
    return array


def count(value: object, field: str, *, low: int = 1, each: float = 0.0) -> int:
    """A whole number of things, at least `low`, of which `each` takes so many bytes.

    **Raises** `InputError` for anything else, and for more than fit into half of this machine's memory.

    >>> count(0, "loads.count")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: loads.count is 0; it must be a whole number, at least 1
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low:
        raise InputError(field, f"is {value!r}; it must be a whole number, at least {low}")
    if each and value * each > 2.0**30:
        room = 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2.0**33
        if value * each > room:
            needs = f"needs {value * each / 2.0**30:.3g} GiB, more than half of this machine's memory"
            raise InputError(field, f"is {value}, which {needs}; {int(room / each)} at most fit")
    return int(value)
