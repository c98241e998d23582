"""What users give: functions, units, numbers in a unit."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache

from jaxvib.units import Number, number

__all__ = ["arguments", "number_in", "same_unit"]


def arguments(function: Callable[..., object]) -> int:
    """How many arguments a function must be given; 1 where nobody says."""
    try:
        given = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    free = [p for p in given if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return len(free)


@lru_cache(maxsize=256)
def same_unit(one: str, other: str) -> bool:
    """Whether two units are one."""
    if one == other:
        return True
    import pint  # half a second, and most units are written alike

    units = pint.get_application_registry()
    try:
        return abs(float((1.0 * units(one or "dimensionless")).m_as(other or "dimensionless")) - 1.0) < 1e-12
    except (pint.PintError, AttributeError, TypeError, ValueError, AssertionError):
        return False


def number_in(value: Number, unit: str, name: str) -> float:
    """A number or text in a unit."""
    return float(number(value, unit, name))
