"""Design: what may change, what is wanted, who searches."""

from optimize.files import Design, load_design
from optimize.quantities import (
    Quantity,
    amplitude,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    negative,
    support_frequency_squared,
    total,
)
from optimize.space import DesignSpace, Held, hold
from optimize.synthesize import Outcome, Synthesis, synthesize

__all__ = [
    "Design",
    "DesignSpace",
    "Held",
    "Outcome",
    "Quantity",
    "Synthesis",
    "amplitude",
    "force_per_amplitude",
    "foundation_force",
    "hold",
    "jam_frequency",
    "load_design",
    "negative",
    "support_frequency_squared",
    "synthesize",
    "total",
]
