"""Choice of the next run by the expected errors of the fitted parameters, computed from the Fisher information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.errors import InputError
from jaxvib.identification.further_runs.planned import (
    PlannedRun,
    expected_errors,
    expected_information,
    expected_run,
    range_of_errors,
)
from jaxvib.identification.further_runs.speed_profile import optimized_profile, read_limits, require_within
from jaxvib.identification.identify import MachineFit
from jaxvib.identification.problem import require_linear_motion
from jaxvib.machine.drives.controlled import SpeedProfile
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.units import Number

_MAX_SINGLE_RATIO = 1.2
"""Ratio of the largest to the smallest expected error above which texts state both."""


class RunPlan(Result):
    """Expected errors after candidate runs. Returned by `plan_runs`.

    **Attributes** (c candidates, k parameters)

    - `candidates` (c,): names of the runs, the best one first; `numbers` (k,): names of the parameters
    - `errors` (c, k): expected relative standard errors after the runs so far and the candidate, infinite for parameters that
      remain undetermined. They are computed with the fitted parameters
    - `errors_low`, `errors_high` (c, k): smallest and largest expected errors if the parameters of the machine differ from the
      fitted ones by two standard errors along each direction whose standard error is above 2 %. NaN for a nonlinear motion
    - `now` (k,): relative standard errors after the runs so far
    - `minutes` (c,): durations, min
    - `benefit` (c,): sum over the parameters of log(error now / error after the run), per minute of the run. An error above 1,
      or of an undetermined parameter, counts as 1
    - `profile`: the `SpeedProfile` of the run with the optimized speed; None if no limits were given, or if the optimized run
      is not better than the candidates
    """

    status = Computed.done

    candidates: tuple[str, ...]
    numbers: tuple[str, ...]
    errors: np.ndarray = eqx.field(metadata=in_unit("", "candidate", "number"))
    errors_low: np.ndarray = eqx.field(metadata=in_unit("", "candidate", "number"))
    errors_high: np.ndarray = eqx.field(metadata=in_unit("", "candidate", "number"))
    now: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    minutes: np.ndarray = eqx.field(metadata=in_unit("min", "candidate"))
    benefit: np.ndarray = eqx.field(metadata=in_unit("1/min", "candidate"))
    profile: SpeedProfile | None

    @property
    def has_wide_range(self) -> np.ndarray:
        """True (c, k) for expected errors whose largest value is more than 20 % above the smallest one."""
        return self.errors_high > _MAX_SINGLE_RATIO * self.errors_low

    @property
    def reduction(self) -> np.ndarray:
        """Geometric mean (c,) of error now / error after the run over the parameters; an error above 1 counts as 1."""
        return np.exp(self.benefit * self.minutes / len(self.numbers))

    def summary(self) -> str:
        """Return the candidates with their expected errors as text, the best one first."""
        lines = [f"errors now: {self._row(self.now, self.now, self.now, np.zeros(len(self.now), bool))}"]
        rows = map(self._row, self.errors, self.errors_low, self.errors_high, self.has_wide_range)
        for name, row, minutes, benefit in zip(self.candidates, rows, self.minutes, self.benefit, strict=True):
            lines.append(f"{name} ({minutes:.3g} min, benefit {benefit:.3g} per minute): {row}")
        if self.profile is not None:
            points = zip(np.asarray(self.profile.times), np.asarray(self.profile.speeds), strict=True)
            lines.append("optimized speed: " + ", ".join(f"{speed_text(float(n), 4)} at {t:.4g} s" for t, n in points))
        return "\n".join(lines)

    def _row(self, errors: np.ndarray, low: np.ndarray, high: np.ndarray, is_wide: np.ndarray) -> str:
        words = []
        for name, *values, wide in zip(self.numbers, errors, low, high, is_wide, strict=True):
            error, least, most = (f"{each:.2g}" if np.isfinite(each) else "not determined" for each in values)
            words.append(f"{name} {error}" + (f" ({least} to {most})" if wide else ""))
        return ", ".join(words)

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the largest relative error of the parameters so far and after each candidate run, the best run first; an
        undetermined parameter counts as 1."""
        from jaxvib.draw.results import named_points_chart  # slow import

        errors = np.concatenate([self.now[None], self.errors])
        largest = np.max(np.where(np.isfinite(errors), errors, 1.0), axis=1)
        label = "largest relative standard error of a parameter, %"
        return named_points_chart(("so far", *self.candidates), 100.0 * largest, x_label=label, ax=ax)


@validated
def plan_runs(fit: MachineFit, candidates: Sequence[PlannedRun], limits: Mapping[str, Number] | None = None) -> RunPlan:
    """Return the errors that the fitted parameters would have after each candidate run, before a candidate is recorded.

        errors^2 = diagonal of (F_so_far + F_candidate)^-1,       F = J^T J / noise^2,       J = d readings / d unknowns

    - F is the Fisher information about the unknown parameters and the gains of the sensors
    - Each candidate has further unknowns: its state at the first sample and the offsets of its channels. The zero of the
      rotor's angle is also unknown, unless the candidate has a channel of kind "pulses" or "angle"; the mark of such a channel
      is assumed to be the mark of the runs so far. A wheel with several pulses per turn has a mark if it has a gap
    - The model of the fit gives the expected readings. `change` of a candidate describes an added mass; its `channels` describe
      new sensors and sensors at other places
    - A run with loads on the rotor begins with the state at the first sample of the first run of the fit, and the loads must
      stay jammed. All other runs begin at rest
    - With `limits`, the speeds of the best candidate at 9 evenly spaced times are optimized for the smallest errors, with
      gradients, by sequential quadratic programming. If the result is better than all candidates, it is one more candidate, of
      the same duration
    - If a direction of the fitted parameters has a standard error above 2 %, the errors have a range, see `RunPlan`

    **Arguments**

    - `fit` from `identify`
    - `candidates`: a list of `PlannedRun`
    - `limits`: {"speed": largest rotor speed, rad/s, "acceleration": largest absolute angular acceleration, rad/s^2}; typical:
      {"speed": "1500 rpm", "acceleration": "10 rad/s^2"}; default: no run with an optimized speed

    **Returns** `RunPlan`, the candidates in the order of their `benefit`. **Raises** `InputError` for a channel whose noise is
    unknown, for a candidate beyond the limits or in which the loads do not stay jammed, and for limits of a fit with loads or
    nonlinear supports.

    >>> import numpy as np, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    >>> drive = jv.RunUp(60.0, acceleration=6.0)
    >>> scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)])
    >>> t, frame = np.arange(0.0, 10.0, 0.005), jv.Channel("frame", "acceleration", at=1, gain_error=0.0)
    >>> motion = 0.01 * np.random.default_rng(0).normal(size=t.size)    # a record of noise only
    >>> run = jv.MeasuredRun.from_arrays([frame], t, {"frame": motion})
    >>> fit = jv.identify(scene, run, unknown=["machine.stiffness", "machine.damping"], throw=False)
    >>> plan = jv.plan_runs(fit, [jv.PlannedRun("slow", drive, "10 s", [frame], rate=200.0)])
    >>> plan.candidates, plan.errors.shape
    (('slow',), (1, 2))

    Source: this package.
    """
    if not candidates:
        raise InputError("candidates", "is empty; give at least one PlannedRun")
    checked_limits = None if limits is None else read_limits(limits)
    if limits is not None:
        require_linear_motion(fit.scene, "the optimization of the speed within `limits`")
    if checked_limits is not None:
        for each in candidates:
            require_within(each, checked_limits)
    k = len(fit.names)
    runs = [expected_run(fit, each) for each in candidates]
    errors = [expected_errors(fit.information + expected_information(fit, each), k) for each in runs]
    now, minutes = expected_errors(fit.information, k), [each.duration / 60.0 for each in candidates]
    benefit = [_benefit(now, *each) for each in zip(errors, minutes, strict=True)]
    ranges = [range_of_errors(fit, *each) for each in zip(candidates, errors, strict=True)]
    names, profile = [each.name for each in candidates], None
    if checked_limits is not None:
        best = int(np.argmax(benefit))
        profile = optimized_profile(fit, candidates[best], runs[best], checked_limits)
        planned = eqx.tree_at(lambda run: run.drive, candidates[best], profile)
        optimized_errors = expected_errors(fit.information + expected_information(fit, expected_run(fit, planned)), k)
        if _benefit(now, optimized_errors, minutes[best]) > benefit[best]:
            names.append(f"{names[best]}, optimized speed")
            errors.append(optimized_errors)
            ranges.append(range_of_errors(fit, planned, optimized_errors))
            benefit.append(_benefit(now, optimized_errors, minutes[best]))
            minutes.append(minutes[best])
        else:
            profile = None
    order = np.argsort(-np.array(benefit), kind="stable")
    low, high = np.swapaxes(np.array(ranges)[order], 0, 1)
    return RunPlan(
        tuple(names[i] for i in order),
        fit.names,
        np.array(errors)[order],
        low,
        high,
        now,
        np.array(minutes)[order],
        np.array(benefit)[order],
        profile,
    )


def _benefit(now: np.ndarray, errors: np.ndarray, minutes: float) -> float:
    return float(np.sum(np.log(np.minimum(now, 1.0) / np.minimum(errors, 1.0)))) / minutes
