"""Hard cases, each with an independent reference: an answer stays right, or a status names the reason why there is none."""

from hard_cases import extreme_scales, long_runs, nonsmooth, resonances
from hard_cases.case import Case

CASES: tuple[Case, ...] = (*resonances.CASES, *extreme_scales.CASES, *nonsmooth.CASES, *long_runs.CASES)
"""Every hard case."""
