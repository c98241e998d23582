"""Names of the package `optimize`, for type checkers."""

# The modules, not the package, because a type checker can find a user's own optimize.py first.
from optimize.design import Design as Design
from optimize.files import load_design as load_design
from optimize.pareto import Front as Front
from optimize.pareto import pareto as pareto
from optimize.quantities.cases import expected as expected
from optimize.quantities.cases import quantile as quantile
from optimize.quantities.cases import under as under
from optimize.quantities.cases import worst as worst
from optimize.quantities.exciters import *  # noqa: F403
from optimize.quantities.jams import *  # noqa: F403
from optimize.quantities.machine import *  # noqa: F403
from optimize.quantities.motion import *  # noqa: F403
from optimize.quantities.quantity import Demand as Demand
from optimize.quantities.quantity import Quantity as Quantity
from optimize.quantities.quantity import largest as largest
from optimize.quantities.quantity import least as least
from optimize.quantities.response import *  # noqa: F403
from optimize.quantities.severity import *  # noqa: F403
from optimize.space import DesignSpace as DesignSpace
from optimize.space import HeldQuantity as HeldQuantity
from optimize.space import hold as hold
from optimize.synthesize import Outcome as Outcome
from optimize.synthesize import Synthesis as Synthesis
from optimize.synthesize import synthesize as synthesize
from optimize.tolerance import ToleranceRange as ToleranceRange
from optimize.tolerance import tolerance_ranges as tolerance_ranges
