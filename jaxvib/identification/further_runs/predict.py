"""Prediction of a run that a fit did not use, and comparison of the prediction with the readings."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto
from jaxvib.identification.checks import SIGNIFICANCE_LEVEL, Disagreement, disagreement, pseudoinverse, residual_p_value
from jaxvib.identification.directions import eliminate, elimination
from jaxvib.identification.fit import differences_of, linear_at, minimize, polar_unbalances, run_equations
from jaxvib.identification.further_runs.planned import own_precisions, problem_of_run, shared_indices
from jaxvib.identification.identify import MachineFit
from jaxvib.identification.jammed.start import with_first_motion
from jaxvib.identification.problem import EXACT, Known, Problem, has_nonlinear_supports, is_nonlinear, with_noise
from jaxvib.identification.records.decimation import filter_readings
from jaxvib.identification.run import MeasuredRun
from jaxvib.identification.supports.start import with_guided_motion
from jaxvib.numerics.noise import Noise, noise_of
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result

_NOISE_RATIO = 1.5
"""Ratio of the residuals to the noise of the fit above which a note says that they are too large, and the status is
`patterned`."""

_PARAMETER_ERROR = 1e-6
"""Relative standard error that fixes the parameters while the initial state of a nonlinear motion is fitted."""


_MIN_FILTERED = 64
"""Smallest number of residuals that remain after the filter that reduces their sampling rate. If this number limits the factor
of the filter, the remaining reduction assumes that the residuals are white noise."""


class PredictionStatus(eqx.Enumeration):
    """Outcomes of a prediction. The value of each member is the message shown to the user."""

    predicted = "the fit predicts the run within its errors and the noise"
    patterned = (
        "the fit predicts the run, but the residuals are larger than the noise of the fit or repeat with the rotor's angle: "
        "the model lacks a part; see the notes"
    )
    contradicted = (
        "the run contradicts the fit: the run is of another machine, the machine has changed, or a change stated for the run "
        "is wrong; see the notes, and do not fit this run together with those of the fit"
    )


class RunPrediction(Result):
    """Prediction of a run that a fit did not use. Returned by `predict_run`.

    **Attributes** (C channels, n samples)

    - `status`: a `PredictionStatus`; `notes`: sentences for the reader
    - `p_value`: probability of a deviation at least as large as this one if the machine is the same
    - `channels` (C,): names; `noise` (C,), SI: standard deviation of the residuals; `ratio` (C,) of this standard deviation to
      that of the fit, both at the lower one of the two sampling rates; NaN for a channel that the fit does not have
    - `time` (n,) s, `readings` and `predicted` (n, C), SI, NaN for samples that do not count
    """

    status: PredictionStatus
    notes: tuple[str, ...]
    p_value: float = eqx.field(metadata=in_unit(""))
    channels: tuple[str, ...]
    noise: np.ndarray = eqx.field(metadata=in_unit("", "channel"))
    ratio: np.ndarray = eqx.field(metadata=in_unit("", "channel"))
    time: np.ndarray = eqx.field(metadata=in_unit("s", "time"))
    readings: np.ndarray = eqx.field(metadata=in_unit("", "time", "channel"))
    predicted: np.ndarray = eqx.field(metadata=in_unit("", "time", "channel"))

    def summary(self) -> str:
        """Return the outcome and the residuals as text."""
        parts = [
            f"{name} {each:.3g}" + (f" ({ratio:.2f} times the noise of the fit)" if math.isfinite(ratio) else "")
            for name, each, ratio in zip(self.channels, self.noise, self.ratio, strict=True)
        ]
        return "\n".join([self.message, f"residuals: {', '.join(parts)}", *self.notes])

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot the readings with the prediction, and the residuals, onto two axes: `ax`, or those of a new figure."""
        from jaxvib.draw.record import fit_chart  # slow import

        return fit_chart(self.time, self.readings, self.predicted, self.noise, self.channels, ax=ax)


@validated
def predict_run(fit: MachineFit, run: MeasuredRun) -> RunPrediction:
    """Return the prediction of a run that the fit did not use, and its comparison with the readings.

    - The parameters and the gains are those of the fit. The motion at the first sample and the offsets are fitted to the run
    - The zero of the rotor's angle is fitted too. It is not fitted in two cases: the scene has several exciters; or the fit
      and the run both have the mark of a tachometer, and the scene has neither loads nor nonlinear supports
    - A likelihood-ratio test compares two hypotheses: the machine has the same parameters in the run as in the fit, or it has
      other parameters. The test accounts for the errors of the fit and the noise of the run. If the p-value of the deviation is
      below 1e-5, the run contradicts the fit, and a note names the parameter whose change explains most of the deviation. In a
      run with loads or nonlinear supports, no parameter is named if the residuals are more than 1.5 times the noise

    **Arguments**: `fit` from `identify`; `run`: a `MeasuredRun`, with its own `change` of parameters.

    **Returns** `RunPrediction`. **Raises** `InputError` for a run that cannot be used.

    >>> import numpy as np, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    >>> drive = jv.RunUp(60.0, acceleration=6.0)
    >>> scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)])
    >>> motion = jv.simulate(scene, "10 s", samples=2001, estimate=False).trajectory
    >>> frame, rng = jv.Channel("frame", "velocity", at=1), np.random.default_rng(0)
    >>> runs = [jv.MeasuredRun.from_arrays([frame], np.linspace(0.0, 10.0, 2001),
    ...         {"frame": np.asarray(motion.state.velocity)[:, 0] + 1e-3 * rng.normal(size=2001)}) for _ in range(2)]
    >>> fit = jv.identify(scene, runs[0], unknown=["machine.stiffness", "machine.damping"])
    >>> jv.predict_run(fit, runs[1]).status_name
    'predicted'

    Source: this package.
    """
    at = _at_the_fit(fit, run)
    names, noise = [channel.name for channel in at.problem.runs[0].channels], np.nanstd(at.residuals, axis=0)
    ratio = np.array([_noise_ratio(fit, name, at.problem.times[0], at.residuals[:, k]) for k, name in enumerate(names)])
    deviation, notes = _deviation(fit, at), []
    for k, name in enumerate(names):
        if ratio[k] > _NOISE_RATIO:
            notes.append(f"the residuals of channel {name!r} are {ratio[k]:.3g} times the noise of the fit")
        if residual_p_value(at.residuals[:, k], at.taps[k], at.problem.angles[0][:, 0], 0) < SIGNIFICANCE_LEVEL:
            notes.append(f"the residuals of channel {name!r} repeat with the rotor's angle")
    status = PredictionStatus.patterned if notes else PredictionStatus.predicted
    if deviation.p_value < SIGNIFICANCE_LEVEL:
        status = PredictionStatus.contradicted
        is_far = at.problem.linear is not None and bool(np.any(ratio > _NOISE_RATIO))
        # Far from the fit, the linearized motion does not show which parameter has changed.
        too_far = (
            f"the run deviates from the fit by more than its errors (p-value {deviation.p_value:.1g}), "
            "too much to name a parameter"
        )
        notes.append(too_far if is_far else deviation.sentence("the run"))
    mask, raw = at.problem.masks[0], at.problem.raw[0]
    return RunPrediction(
        status=status,
        notes=(*at.problem.notes, *notes),
        p_value=deviation.p_value,
        channels=tuple(names),
        noise=noise,
        ratio=ratio,
        time=at.problem.times[0],
        readings=np.where(mask, raw, np.nan),
        predicted=raw - at.residuals,
    )


def _noise_ratio(fit: MachineFit, name: str, time: np.ndarray, residuals: np.ndarray) -> float:
    """Return the standard deviation of the residuals (n,) of a channel, relative to that of the last run of the fit with this
    channel; NaN without such a run. The residuals with the higher sampling rate are reduced to the lower rate."""
    runs = [r for r, names in enumerate(fit.channels) if name in names]
    if not runs:
        return math.nan
    r, k = runs[-1], fit.channels[runs[-1]].index(name)
    step, step_of_fit = time[1] - time[0], fit.time[r][1] - fit.time[r][0]
    noise_of_fit, noise = float(fit.noise[r][k]), float(np.nanstd(residuals))
    if step >= 1.5 * step_of_fit:
        noise_of_fit = _noise_at_lower_rate(fit.readings[r][:, k] - fit.fitted[r][:, k], step / step_of_fit)
    if step_of_fit >= 1.5 * step:
        noise = _noise_at_lower_rate(residuals, step_of_fit / step)
    return noise / noise_of_fit


def _noise_at_lower_rate(residuals: np.ndarray, ratio: float) -> float:
    """Return the standard deviation of residuals (n,) at a sampling rate that is lower by the `ratio`."""
    factor = max(min(round(ratio), residuals.size // _MIN_FILTERED), 1)
    if factor > 1:
        residuals = filter_readings(residuals, factor)[0]
    return float(np.nanstd(residuals)) * math.sqrt(factor / ratio)


class _Predicted(NamedTuple):
    """Run, evaluated with the parameters of a fit.

    **Attributes**: its `problem`; unknowns `x`; `linear`: the unknowns on which the readings depend linearly (unbalances,
    state at the first sample, offsets), fitted to the run; `residuals` (n, C); `taps` of the filters to white noise (C,);
    `has_mark`: True if the zero of the rotor's angle is that of the fit.
    """

    problem: Problem
    x: np.ndarray
    linear: np.ndarray
    residuals: np.ndarray
    taps: list[np.ndarray]
    has_mark: bool


def _at_the_fit(fit: MachineFit, run: MeasuredRun) -> _Predicted:
    problem = problem_of_run(fit, fit.scene, run)
    unbalances = [1.0 if exciter.unbalance is None else exciter.unbalance for exciter in fit.scene.exciters]
    sizes = np.array([float(np.asarray(each, float)) for each in unbalances])
    problem = problem._replace(unbalances=tuple(Known(size, EXACT * size) for size in sizes))
    has_mark = len(sizes) == 1 and problem.marked and bool(fit.information[-1, -1] > 0.0) and not is_nonlinear(fit.scene)
    pairs = np.stack([sizes * np.cos(fit.phase), sizes * np.sin(fit.phase)], axis=1).ravel()
    x, first = np.zeros(problem.unknowns.count), len(problem.unknowns.numbers)
    for k, name in enumerate(problem.unknowns.gains):
        if name in fit.gain_names:
            x[first + k] = math.log(fit.gains[fit.gain_names.index(name)].value)
    fixed, means, precisions = pairs if has_mark or len(sizes) > 1 else None, problem.means, problem.precisions
    if is_nonlinear(fit.scene):  # the initial state has a nonlinear effect; small prior errors fix the parameters
        with_fixed = problem._replace(means=x, precisions=np.full(x.size, _PARAMETER_ERROR**-2))
        problem = (with_guided_motion if has_nonlinear_supports(fit.scene) else with_first_motion)(with_fixed)[0]

    def with_filters(
        problem: Problem, noise: list[Noise], differences: list[np.ndarray] | None
    ) -> tuple[Problem, np.ndarray, np.ndarray]:
        filtered = with_noise(problem, [[each._replace(deviation=each.deviation or 1.0) for each in noise]], differences)
        if filtered.linear is not None:
            linear = minimize(filtered, x)[0].linear
            filtered = filtered._replace(linear=linear)
        else:
            linear = linear_at(filtered, x, fixed)
        return filtered, linear, differences_of(filtered, x, linear)[0]

    first_noise = [Noise(np.ones(1), float(np.std(each))) for each in problem.raw[0].T]
    filtered, _, residuals = with_filters(problem, first_noise, None)
    mask = problem.masks[0]
    noise = [noise_of(each) for each in np.where(mask, residuals, np.nan).T]
    filtered, linear, residuals = with_filters(filtered, noise, [residuals])
    filtered = filtered._replace(means=means, precisions=precisions)
    return _Predicted(filtered, x, linear, np.where(mask, residuals, np.nan), [each.taps for each in noise], has_mark)


def _deviation(fit: MachineFit, at: _Predicted) -> Disagreement:
    """Return the deviation of a run from the fit."""
    problem, p, size = at.problem, at.x.size, len(fit.information)
    equations, jacobian = run_equations(problem, at.x, at.linear)[0], polar_unbalances(problem, at.linear)[0]
    matrix, slope = jacobian.T @ equations[:-1, :-1] @ jacobian, jacobian.T @ equations[:-1, -1]
    matrix[np.arange(p), np.arange(p)] += own_precisions(fit, problem)
    if problem.load_spread is not None:
        matrix[p:, p:] += problem.load_spread
    for k in range(len(fit.scene.exciters)):
        if f"exciters[{k}].unbalance" not in fit.names:  # known exactly
            matrix[p + 2 * k, p + 2 * k] += 1.0 / EXACT**2
    in_run, in_fit = shared_indices(fit, problem, at.has_mark)
    part, gradient = np.zeros((size, size)), np.zeros(size)
    part[np.ix_(in_fit, in_fit)] = eliminate(matrix, in_run)
    gradient[in_fit] = elimination(matrix, in_run).T @ slope
    names = [*fit.names, *(f"the gain of channel {name!r}" for name in fit.gain_names), "the angle (rad) of the unbalance"]
    # The gradient was computed at the parameters of the fit. Here it becomes that at the optimum of a joint fit of all records.
    gradient = fit.information @ pseudoinverse(fit.information + part)[0] @ gradient
    return disagreement(fit.information, part, gradient, names)
