"""Reading of users' functions, units, and numbers with units."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache

from jaxvib.units import Number, number, unit_ratio
from jaxvib.units.known import require_known


def arguments(function: Callable[..., object]) -> int:
    """Return the number of required arguments of a function; 1 if it is unknown."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    required = [p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return len(required)


@lru_cache(maxsize=256)
def same_unit(one: str, other: str) -> bool:
    """Return True if two units are the same, for example "N" and "kg m/s^2", but not "Hz" and "rad/s"."""
    if one == other:
        return True
    ratio = unit_ratio(one, other)
    return ratio is not None and abs(ratio - 1.0) < 1e-12


def number_in(value: Number, unit: str, name: str) -> float:
    """Convert a number, or a string with a unit, to `unit`. **Raises** `InputError` as `jaxvib.units.number` does."""
    found = number(value, unit, name)
    require_known(found, name, "a quantity", "make it outside")
    return float(found)
