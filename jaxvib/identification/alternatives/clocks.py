"""Drift between the clocks of a tachometer and of the vibration sensors of one run.

The clock of the sensors runs fast by the fraction e and differs by the delay d. A sample that has the time t on this clock was
taken at the time (1 - e) t - d of the tachometer, at the rotor's angle theta((1 - e) t - d). After a fit with the status
`patterned`, e and d of each run become unknowns, and the fit is continued.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxvib.identification.alternatives.evidence import MIN_STANDARD_ERRORS, explains_better
from jaxvib.identification.angle import RotorAngle, recorded_drive
from jaxvib.identification.checks import resembles
from jaxvib.identification.directions import eliminate, information_of
from jaxvib.identification.fit import Fitted, fit_from
from jaxvib.identification.problem import with_angle_errors

_DRIFT, _DELAY = 0.01, 0.1
"""Standard deviations of the drift and of the delay (s) before the fit; both are much larger than those of recorders."""

_MIN_SHARE = 0.1
"""Smallest explained share for which the fit is continued with a drift and a delay. The explained share of a channel is the
share of the variance of its residuals that drift and delay together explain to first order; the largest share of all channels
and runs counts."""


def clock_notes(fitted: Fitted) -> list[str]:
    """Return a sentence for each run in which the clocks of the tachometer and of the sensors drift apart, if the model
    explains the records much better with these drifts.

    **Arguments**: a fit with the status `patterned`.
    """
    problem = fitted.problem
    measured = all(rotor.samples is not None for rotors in problem.rotors for rotor in rotors)
    if not measured or not resembles(fitted) or fitted.misfits or _explained_share(fitted) < _MIN_SHARE:
        return []
    first = fitted.x.size - problem.unknowns.errors
    rotors = tuple(tuple(_with_drift(rotor) for rotor in each) for each in problem.rotors)
    free = problem._replace(rotors=rotors, unknowns=dataclasses.replace(problem.unknowns, errors=0))
    free = free._replace(means=problem.means[:first], precisions=problem.precisions[:first])
    free = with_angle_errors(free, [True] * len(problem.runs))
    starts = [fitted.x[:first]]
    if problem.linear is None:  # a large drift leads the first fit to a wrong minimum
        starts.append(np.zeros(first))
    after = fit_from(free, [np.concatenate([start, np.zeros(free.unknowns.errors)]) for start in starts])
    ratio = max(float(np.max(new / old)) for new, old in zip(after.noise, fitted.noise, strict=True))
    if not explains_better(after, information_of(after), ratio):
        return []
    indices = np.array([samples.errors[0] for samples in free.runs])
    information = eliminate(after.information + after.prior, indices)
    errors = np.sqrt(np.diagonal(np.linalg.inv(information)))
    notes = []
    for k, (index, error) in enumerate(zip(indices, errors, strict=True)):
        if abs(after.x[index]) > MIN_STANDARD_ERRORS * error:
            drift, duration = _DRIFT * after.x[index], float(problem.times[k][-1] - problem.times[k][0])
            which = "fast" if drift > 0.0 else "slow"
            notes.append(
                f"in run {k + 1} the clock of the sensors is {which} against that of the tachometer, by "
                f"{1e3 * abs(drift) * duration:.3g} ms over the record ({1e6 * abs(drift):.0f} ppm): with this drift the "
                f"residuals are {ratio:.2g} times those without it; record both signals by one device, or correct the times of "
                "one signal"
            )
    return notes


def _explained_share(fitted: Fitted) -> float:
    """Return the largest share of the variance of a channel's residuals that a drift and a delay of the model explain."""
    shares, problem = [0.0], fitted.problem
    for time, raw, mask, left in zip(problem.times, problem.raw, problem.masks, fitted.differences, strict=True):
        for c in range(raw.shape[1]):
            slope, used = np.gradient(raw[:, c] - left[:, c], time), mask[:, c]
            columns = np.stack([slope, slope * (time - time[0])], axis=1)[used]
            fit, *_ = np.linalg.lstsq(columns, left[used, c], rcond=None)
            shares.append(float(np.sum((columns @ fit) ** 2) / max(float(np.sum(left[used, c] ** 2)), 1e-300)))
    return max(shares)


def _with_drift(rotor: RotorAngle) -> RotorAngle:
    """Return a rotor whose errors of the angle are those of a drift and of a delay, followed by its own errors."""
    begin, end = rotor.span
    count = max(8 * len(np.unique(rotor.spline.t)), 64)
    time = np.linspace(begin, end, count)
    since, orders = time - begin, [rotor.spline(time, k) for k in range(4)]
    columns = []
    for k in range(3):
        value, rate, before = orders[k], orders[k + 1][:, :1], orders[k][:, :1] if k else 0.0
        drift = -_DRIFT * (rate * since[:, None] + k * before)
        columns.append(np.concatenate([value[:, :1], drift, -_DELAY * rate, value[:, 1:]], axis=1))
    return rotor._replace(drive=recorded_drive(time, columns), left_out=0.0)
