"""Speed of a planned run, optimized by gradients within limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import speed_text
from jaxvib.errors import InputError
from jaxvib.identification.directions import elimination, in_polar_unbalances
from jaxvib.identification.fit import linear_indices, polar_unbalances
from jaxvib.identification.further_runs.planned import Expected, PlannedRun
from jaxvib.identification.identify import MachineFit
from jaxvib.identification.response import Samples, Unknowns, normal_equations
from jaxvib.machine.drives.controlled import SpeedProfile
from jaxvib.machine.scene import Scene
from jaxvib.runtime.programs import cached
from jaxvib.units import Number, number

_SEGMENTS = 8
"""Number of equal parts of a run; the acceleration is constant in each part."""

_MAX_ITERATIONS = 30

_SLACK = 1e-6
"""Relative amount by which a run may exceed a limit, because of rounding errors."""


class Limits(NamedTuple):
    """Largest rotor `speed`, rad/s, and largest absolute angular `acceleration`, rad/s^2, of a run."""

    speed: float
    acceleration: float


def read_limits(limits: Mapping[str, Number]) -> Limits:
    """Return the limits of runs. **Raises** `InputError` for a missing or unknown limit, and values that are not positive.

    >>> read_limits({"speed": "955 rpm", "acceleration": 5.0})
    Limits(speed=100.00736613927508, acceleration=5.0)
    """
    units = {"speed": "rad/s", "acceleration": "rad/s^2"}
    for name in {**limits, **units}:
        if name not in units or name not in limits:
            problem = "is missing" if name in units else "is not a limit"
            raise InputError(f"limits.{name}", f'{problem}; give {{"speed": "1500 rpm", "acceleration": "10 rad/s^2"}}')
    return Limits(
        *(float(number(limits[name], unit, f"limits.{name}", low=0.0, open_low=True)) for name, unit in units.items())
    )


def require_within(planned: PlannedRun, limits: Limits) -> None:
    """**Raises** `InputError` for a run whose speed or acceleration exceeds the limits."""
    time = np.linspace(0.0, planned.duration, 1001)
    drive = planned.drive
    speed = float(np.max(jax.vmap(lambda t: drive.rotor_speed(t, None))(time)))  # pyright: ignore[reportArgumentType]
    rates: Any = jax.vmap(drive.rotor_acceleration)(time)  # pyright: ignore[reportArgumentType]
    acceleration = float(np.max(np.abs(rates)))
    field = f"candidates: {planned.name}: drive"
    if speed > (1.0 + _SLACK) * limits.speed:
        raise InputError(field, f"reaches {speed_text(speed, 4)}; limits.speed is {speed_text(limits.speed, 4)}")
    if acceleration > (1.0 + _SLACK) * limits.acceleration:
        limit_text = f"limits.acceleration is {limits.acceleration:.4g} rad/s^2"
        raise InputError(field, f"has an acceleration of {acceleration:.4g} rad/s^2; {limit_text}")


def optimized_profile(fit: MachineFit, planned: PlannedRun, expected: Expected, limits: Limits) -> SpeedProfile:
    """Return the speed profile with the smallest expected errors within the limits. It is a local minimum: the search starts
    from the speed of the planned run. The profile is linear between evenly spaced times.

    The objective is half the sum of the logarithms of the variances of the unknown parameters, with the prior standard error 1
    of each.
    """
    from scipy.optimize import minimize  # slow to import

    times = np.linspace(0.0, planned.duration, _SEGMENTS + 1)
    drive = planned.drive
    speeds = np.asarray(jax.vmap(lambda t: drive.rotor_speed(t, None))(times))  # pyright: ignore[reportArgumentType]
    slope = np.diff(np.eye(_SEGMENTS + 1), axis=0) / (limits.acceleration * times[1]) * limits.speed
    rows = np.concatenate([slope, -slope])

    def objective(shares: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = _spread(fit, expected, times, shares * limits.speed)
        return value, gradient * limits.speed

    optimum = minimize(
        objective,
        np.clip(speeds / limits.speed, 0.0, 1.0),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * (_SEGMENTS + 1),
        constraints={"type": "ineq", "fun": lambda v: 1.0 - rows @ v, "jac": lambda v: -rows},
        options={"maxiter": _MAX_ITERATIONS, "ftol": 1e-3},
    )
    return SpeedProfile(times, np.clip(optimum.x, 0.0, 1.0) * limits.speed)


def _spread(fit: MachineFit, expected: Expected, times: np.ndarray, speeds: np.ndarray) -> tuple[float, np.ndarray]:
    """Return half the sum of the logarithms of the expected variances of the parameters, and its gradient with respect to the
    speeds.

    F is the Fisher information of the run (the matrix of its normal equations), and L is the projection onto the parameters
    that are not eliminated. A change dF changes L^T F L by L^T dF L to first order: the simultaneous change of L has no effect
    of first order. The gradient is therefore one vector-Jacobian product of F: the vector contains the derivatives of the
    objective with respect to the entries of F.
    """
    fitted, k, p = expected.fitted, len(fit.names), expected.fitted.x.size
    problem, indices = fitted.problem, linear_indices(fitted.problem)[0]
    where = np.concatenate([np.arange(p), p + indices])

    def of_run(speeds: Array) -> Array:
        x, linear = jnp.asarray(fitted.x), jnp.asarray(fitted.linear[indices])
        return _information(problem.unknowns, problem.runs[0], problem.scene, x, linear, jnp.asarray(times), speeds)

    equations, vector_product = jax.vjp(of_run, jnp.asarray(speeds))
    run = np.zeros_like(fitted.information)
    run[np.ix_(where, where)] = np.asarray(equations)[:-1, :-1]
    data, known, _ = in_polar_unbalances(fitted._replace(information=run))
    inner = elimination(data + known, expected.indices_in_run)
    total = fit.information + expected.shared(data + known, len(fit.information))
    outer = elimination(total, np.arange(k))
    covariance = np.linalg.inv(outer.T @ total @ outer + np.eye(k))
    variances = np.diagonal(covariance)

    weights = -0.5 * outer @ (covariance / variances) @ covariance @ outer.T
    polar, _ = polar_unbalances(problem, fitted.linear)
    weights = polar @ inner @ weights[np.ix_(expected.indices_in_fit, expected.indices_in_fit)] @ inner.T @ polar.T
    padded = np.zeros(equations.shape)
    padded[:-1, :-1] = weights[np.ix_(where, where)]
    (gradient,) = vector_product(jnp.asarray(padded))
    return 0.5 * float(np.sum(np.log(variances))), np.asarray(gradient)


@cached
def _information(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, linear: Array, times: Array, speeds: Array
) -> Array:
    """Return the normal equations of a run whose rotor has these `speeds` at these `times`."""
    driven = dataclasses.replace(samples, drives=(SpeedProfile(times, speeds),))
    return normal_equations(unknowns, driven, scene, x, linear)
