"""Conditions under which the fit of another model is preferred to a patterned fit."""

from __future__ import annotations

from jaxvib.identification.checks import FitStatus, resembles, status_of
from jaxvib.identification.directions import Information
from jaxvib.identification.fit import Fitted

MIN_STANDARD_ERRORS = 6.0
"""Smallest distance from 0, in standard errors, of the parameter that another model adds. Twice the logarithm of the ratio of
the likelihoods is then about 36."""

_MAX_RESIDUAL_RATIO = 0.5
"""Residuals of another model, relative to those of the patterned fit, below which it is preferred even if its residuals are not
only noise."""


def explains_better(after: Fitted, information: Information, ratio: float) -> bool:
    """Return True if the residuals of the fit `after` are only noise, or much smaller than those of the patterned fit.

    **Arguments**: `information` of the fit; `ratio` of its residuals to those of the patterned fit.
    """
    if not resembles(after) or ratio >= 1.0:
        return False
    return ratio < _MAX_RESIDUAL_RATIO or status_of(after, information)[0] in (FitStatus.found, FitStatus.undetermined)
