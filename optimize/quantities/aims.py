"""What a search makes small."""

from __future__ import annotations

from jaxvib.boundary import validated
from optimize.quantities.quantity import Quantity, require_quantity

__all__ = ["maximize", "minimize", "negative"]


@validated
def negative(quantity: Quantity) -> Quantity:
    """Minus a quantity: what a search makes small, to make the quantity large. The same as `-quantity`.

    >>> from optimize import amplitude, negative
    >>> negative(amplitude(mode=3)).name
    'negative amplitude'
    """
    require_quantity(quantity, "quantity")
    return -quantity


@validated
def minimize(quantity: Quantity) -> Quantity:
    """The quantity itself, which a search makes small: it says so where it is read.

    >>> from optimize import foundation_force, minimize
    >>> minimize(foundation_force(mode=3)).name
    'foundation_force'
    """
    require_quantity(quantity, "quantity")
    return quantity


maximize = negative
