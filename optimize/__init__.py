"""Design of machines: free parameters of a scene, quantities and demands, and the search for the best machine."""
# ruff: noqa: E402

import sys

from jaxvib.code_changes import watch

watch(sys.modules[__name__])  # first, because only later imports are watched

from optimize.design import Design
from optimize.files import load_design
from optimize.pareto import Front, pareto
from optimize.quantities.cases import expected, quantile, under, worst
from optimize.quantities.exciters import (
    amplitude_spread,
    conveying_speed,
    force_per_throw,
    least_torque,
    motion_spread,
    resonance_distance,
    roundness,
    synchronization_margin,
    throw_angle,
    throw_number,
    throw_stroke,
)
from optimize.quantities.jams import (
    amplitude,
    fold_margin,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    largest_multiplier,
    phase,
    power,
)
from optimize.quantities.machine import product, spring_cost, static_deflection, support_frequency_squared, total, total_mass
from optimize.quantities.motion import peak_displacement, peak_force, settling_time
from optimize.quantities.quantity import Demand, Quantity, largest, least
from optimize.quantities.response import (
    fold_distance,
    response_amplitude,
    response_force,
    response_stroke,
    response_torque,
    response_transmissibility,
)
from optimize.quantities.severity import acceleration, shaft_torque, stroke, support_load, transmissibility, velocity
from optimize.space import DesignSpace, HeldQuantity, hold
from optimize.synthesize import Outcome, Synthesis, synthesize
from optimize.tolerance import ToleranceRange, tolerance_ranges

__all__ = [
    "Demand",
    "Design",
    "DesignSpace",
    "Front",
    "HeldQuantity",
    "Outcome",
    "Quantity",
    "Synthesis",
    "ToleranceRange",
    "acceleration",
    "amplitude",
    "amplitude_spread",
    "conveying_speed",
    "expected",
    "fold_distance",
    "fold_margin",
    "force_per_amplitude",
    "force_per_throw",
    "foundation_force",
    "hold",
    "jam_frequency",
    "largest",
    "largest_multiplier",
    "least",
    "least_torque",
    "load_design",
    "motion_spread",
    "pareto",
    "peak_displacement",
    "peak_force",
    "phase",
    "power",
    "product",
    "quantile",
    "resonance_distance",
    "response_amplitude",
    "response_force",
    "response_stroke",
    "response_torque",
    "response_transmissibility",
    "roundness",
    "settling_time",
    "shaft_torque",
    "spring_cost",
    "static_deflection",
    "stroke",
    "support_frequency_squared",
    "support_load",
    "synchronization_margin",
    "synthesize",
    "throw_angle",
    "throw_number",
    "throw_stroke",
    "tolerance_ranges",
    "total",
    "total_mass",
    "transmissibility",
    "under",
    "velocity",
    "worst",
]
