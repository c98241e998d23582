"""Estimates: measured numbers with their uncertainty."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxvib.boundary import validated, with_known_names
from jaxvib.errors import InputError, quoted


class Estimate(NamedTuple):
    """Measured number with its uncertainty.

    **Attributes**: `value`; `error`: standard error from the noise of the record; `low` and `high`: confidence interval of
    95 %, which includes the error of the instruments.
    """

    value: float
    error: float
    low: float
    high: float


@with_known_names
class Share(NamedTuple):
    """Share of the cases in which a statement is true.

    Returned by `estimate_share`.

    **Attributes**: `value`: the share, 0 to 1; `low` and `high`: Wilson's confidence interval of 95 % for the probability;
    `hits`: number of cases in which the statement is true; `cases`: number of all cases.
    """

    value: float
    low: float
    high: float
    hits: int
    cases: int

    @property
    def text(self) -> str:
        """The share in percent, with its interval and the numbers of hits and cases."""
        low, high = 100.0 * self.low, 100.0 * self.high
        return f"{self.hits} of {self.cases} runs, {100.0 * self.value:.3g} % (95 % interval: {low:.3g} to {high:.3g} %)"


@validated
def estimate_share(flags: Any) -> Share:
    """Return the share of True among Boolean `flags` of independent cases, with Wilson's confidence interval of 95 %.

    The share of an `Ensemble` estimates a probability if the values of its runs are random samples of their distribution. The
    width of the interval is proportional to 1/sqrt(number of cases).

    **Arguments**: `flags`, Boolean array; typical: 100 to 10,000 runs.

    **Returns** `Share`. **Raises** `InputError` for anything other than a Boolean array with at least one value.

    >>> import numpy as np, jaxvib as jv
    >>> share = jv.estimate_share(np.arange(50) < 40)
    >>> round(share.value, 3), round(share.low, 3), round(share.high, 3)
    (0.8, 0.67, 0.888)

    Source: see `wilson`.
    """
    if getattr(getattr(flags, "dtype", None), "kind", "") != "b" or not np.size(flags) or np.ma.is_masked(flags):
        raise InputError("flags", f"is {quoted(flags)}; it must be an array of at least one Boolean value")
    hits, cases = int(np.sum(np.asarray(flags))), np.size(flags)
    low, high = (float(end) for end in wilson(np.asarray(hits), np.asarray(cases)))
    return Share(hits / cases, low, high, hits, cases)


def interval(value: float, error: float, quantile: float, instrument: float) -> Estimate:
    """Return an estimate with the interval value +- sqrt((quantile * error)^2 + (instrument * value)^2). `error`: standard
    error from noise; `quantile` of its distribution, such as 1.96; `instrument`: relative error of the instruments."""
    half = float(np.hypot(quantile * error, instrument * value))
    return Estimate(value, error, value - half, value + half)


def shown(estimate: Estimate) -> str:
    """Return an estimate as text: value and half-width of its 95 % interval."""
    return f"{estimate.value:.5g} ± {(estimate.high - estimate.low) / 2.0:.2g}"


def student_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t with the given degrees of freedom.

    >>> round(student_quantile(1), 3), round(student_quantile(10), 3), round(student_quantile(1000), 3)
    (12.706, 2.228, 1.962)
    """
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, 0.975))


def wilson(hits: np.ndarray, cases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Wilson's confidence interval (95 %) of the share `hits` / `cases`; 0 to 1 if there are no cases.

    The interval contains all shares p with |hits/cases - p| <= z sqrt(p (1 - p) / cases), z = 1.96.

    >>> [round(float(end), 4) for end in wilson(np.asarray(0), np.asarray(10))]
    [0.0, 0.2775]

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference, 1927.
    """
    n, z = np.maximum(cases, 1), 1.959964
    share, more = hits / n, z**2 / n
    middle = (share + more / 2.0) / (1.0 + more)
    half = z * np.sqrt(share * (1.0 - share) / n + more / (4.0 * n)) / (1.0 + more)
    is_empty = np.asarray(cases) == 0
    return np.where(is_empty, 0.0, np.maximum(middle - half, 0.0)), np.where(is_empty, 1.0, np.minimum(middle + half, 1.0))
