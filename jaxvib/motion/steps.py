"""Choices of the steps of a time integration."""

from __future__ import annotations

from dataclasses import dataclass

import diffrax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.units import require_real


@dataclass(frozen=True)
class Tolerance:
    """Steps whose error is at most `tolerance`, both relative and absolute in natural units.

    Natural units are the unbalance radius S/M of the loads for displacements, S/M times the rotor speed for velocities, and
    1 rad for angles. The error of an angle is only absolute.

    **Arguments**: `tolerance`; typical: 1e-6 to 1e-10 in double precision, 1e-5 in single. For one hundredth of the tolerance,
    the methods of order 8 need about 1.8 times as many steps.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.Tolerance(1e-6)
    Tolerance(tolerance=1e-06)
    """

    tolerance: float

    def __post_init__(self) -> None:
        require_real(self.tolerance, "", "tolerance")


@dataclass(frozen=True)
class Accuracy:
    """Steps with which the estimated error of the whole result is at most `error`; the run is repeated to find them.

    **Arguments**: `error`, relative; typical: 1e-3 to 1e-8. An error of 1e-8 takes about twice the time of an error of 1e-4.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.Accuracy(1e-4)
    Accuracy(error=0.0001)
    """

    error: float

    def __post_init__(self) -> None:
        require_real(self.error, "", "error")


@dataclass(frozen=True)
class EqualSteps:
    """A number of steps of equal length.

    **Arguments**: `number` of steps; typical: 4 for each radian of the fastest motion, 25 for each turn. The computing time is
    proportional to it.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.EqualSteps(2000)
    EqualSteps(number=2000)
    """

    number: int

    def __post_init__(self) -> None:
        require_real(self.number, "", "steps")


StepChoice = Tolerance | Accuracy | EqualSteps | diffrax.AbstractStepSizeController
"""Types of `stepsize_controller`."""


def require(chosen: object, *kinds: type) -> None:
    """**Raises** `InputError` for a choice of steps of another type."""
    if chosen is not None and not isinstance(chosen, kinds):
        names = {diffrax.AbstractStepSizeController: "a step size controller of diffrax"}
        allowed = ", ".join(names.get(kind, f"{kind.__name__}(...)") for kind in kinds)
        raise InputError("stepsize_controller", f"is {quoted(chosen)}; it must be one of: {allowed}")


def validate_tolerance(value: float, name: str, time: Array, least: float) -> float:
    """Return a tolerance or an accuracy; it must be at least `least` times the rounding unit of the precision of `time`.

    **Raises** `InputError` for other values.
    """
    precision = float(jnp.finfo(time.dtype).eps)
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (plain and least * precision <= value < 1.0):
        # 5 % more, so that the value in the message, rounded to two digits, is allowed.
        raise InputError(
            name,
            f"is {quoted(value)}; in {time.dtype} it must be at least {1.05 * least * precision:.2g} and less than 1"
            + ("" if plain else ", a Python number such as 1e-6")
            + ("; for smaller ones switch JAX to float64" if precision > 1e-10 else ""),
        )
    return value
