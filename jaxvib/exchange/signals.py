"""Names and units of the inputs and outputs of a machine, the same in all formats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from jaxvib.machine.carrier import Carrier

_RATES = ("", "/s", "/s^2")


class Signal(NamedTuple):
    """Name of a quantity, such as "displacement.y1", and its unit."""

    name: str
    unit: str


def coordinate_signals(carrier: Carrier, name: str, order: int) -> tuple[Signal, ...]:
    """Return the signals of the coordinates (`order` 0) or of their derivatives: velocities (1) or accelerations (2)."""
    named = zip(carrier.coordinates, carrier.units, strict=True)
    return tuple(Signal(f"{name}.{coordinate}", unit + _RATES[order]) for coordinate, unit in named)


def force_inputs(carrier: Carrier) -> tuple[Signal, ...]:
    """Return the signals of the forces on the coordinates, N (on angles: N m)."""
    named = zip(carrier.coordinates, carrier.units, strict=True)
    return tuple(Signal(f"force.{coordinate}", "N" if unit == "m" else "N m") for coordinate, unit in named)


def foundation_forces(carrier: Carrier) -> tuple[Signal, ...]:
    """Return the signals of the force on the foundation."""
    return tuple(Signal(f"foundation_force.{direction}", "N") for direction in carrier.foundation_directions)


def signals_of(names: Sequence[str], unit: str) -> tuple[Signal, ...]:
    """Return signals that have the same unit."""
    return tuple(Signal(name, unit) for name in names)
