"""Validation of functions of the user, comparison of units, and conversion of numbers with units."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import lru_cache

from jaxvib.errors import InputError, quoted
from jaxvib.units import Number, number
from jaxvib.units.known import require_known
from jaxvib.units.reading import unit_ratio

Point = tuple[float, float]
"""Point (x, y) of a body, m from its centre of mass."""


def count_required_arguments(function: Callable[..., object]) -> int:
    """Return the number of required positional arguments of a function; 1 if the signature cannot be read."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    required = [p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return len(required)


@lru_cache(maxsize=256)
def same_unit(first: str, second: str) -> bool:
    """Return True if two units are the same, for example "N" and "kg m/s^2", but not "Hz" and "rad/s"."""
    if first == second:
        return True
    ratio = unit_ratio(first, second)
    return ratio is not None and abs(ratio - 1.0) < 1e-12


def number_in(value: Number, unit: str, name: str) -> float:
    """Convert a number, or a string with a unit, to `unit`.

    **Raises** `InputError` for a wrong unit, for text that is not a number, and for a value that is traced by JAX.
    """
    converted = number(value, unit, name)
    require_known(converted, name, "a quantity", "make it outside")
    return float(converted)


def read_point(at: Sequence[Number], field: str) -> Point:
    """Return a point of a body. **Raises** `InputError` if `at` does not have two coordinates."""
    if not isinstance(at, (list, tuple)) or len(at) != 2:
        raise InputError(field, f"is {quoted(at)}; it must be a point (x, y) of the body")
    return number_in(at[0], "m", f"{field}[0]"), number_in(at[1], "m", f"{field}[1]")
