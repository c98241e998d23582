"""Design of machines: free parameters of a scene, quantities and demands, and the search for the best machine."""
# ruff: noqa: E402, F403

import sys

from jaxvib.code_changes import watch

watch(sys.modules[__name__])  # first, because only later imports are watched

from optimize.design import Design
from optimize.files import load_design
from optimize.pareto import Front, pareto
from optimize.quantities import exciters, jams, machine, motion, response, severity
from optimize.quantities.cases import expected, quantile, under, worst
from optimize.quantities.exciters import *
from optimize.quantities.jams import *
from optimize.quantities.machine import *
from optimize.quantities.motion import *
from optimize.quantities.quantity import Demand, Quantity, largest, least
from optimize.quantities.response import *
from optimize.quantities.severity import *
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
    "expected",
    "hold",
    "largest",
    "least",
    "load_design",
    "pareto",
    "quantile",
    "synthesize",
    "tolerance_ranges",
    "under",
    "worst",
]
__all__ += exciters.__all__
__all__ += jams.__all__
__all__ += machine.__all__
__all__ += motion.__all__
__all__ += response.__all__
__all__ += severity.__all__
