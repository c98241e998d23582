"""Every quantity that a search can minimise, hold or demand, by one name."""

from __future__ import annotations

from jaxvib.errors import InputError
from optimize.wishes.cases import expected, quantile, under, worst
from optimize.wishes.jams import (
    amplitude,
    between,
    fold_margin,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    largest_multiplier,
    phase,
    power,
)
from optimize.wishes.machine import product, spring_cost, static_deflection, support_frequency_squared, total, total_mass
from optimize.wishes.motion import peak_force, settling_time
from optimize.wishes.quantity import Pair, Quantity, largest, least

__all__ = [
    "Pair",
    "Quantity",
    "amplitude",
    "between",
    "expected",
    "fold_margin",
    "force_per_amplitude",
    "foundation_force",
    "jam_frequency",
    "largest",
    "largest_multiplier",
    "least",
    "maximize",
    "minimize",
    "negative",
    "peak_force",
    "phase",
    "power",
    "product",
    "quantile",
    "settling_time",
    "spring_cost",
    "static_deflection",
    "support_frequency_squared",
    "total",
    "total_mass",
    "under",
    "worst",
]


def negative(quantity: Quantity) -> Quantity:
    """Minus a quantity: what a search makes small, to make the quantity large. The same as `-quantity`.

    >>> from optimize import amplitude, negative
    >>> negative(amplitude(mode=3)).name
    'negative amplitude'
    """
    if not isinstance(quantity, Quantity):
        raise InputError("quantity", f"is {quantity!r}; it must be a Quantity, for example amplitude(mode=3)")
    return -quantity


def minimize(quantity: Quantity) -> Quantity:
    """The quantity itself, which a search makes small: it says so where it is read.

    >>> from optimize import foundation_force, minimize
    >>> minimize(foundation_force(mode=3)).name
    'foundation_force'
    """
    if not isinstance(quantity, Quantity):
        raise InputError("quantity", f"is {quantity!r}; it must be a Quantity, for example amplitude(mode=3)")
    return quantity


maximize = negative
