"""Identification of a machine from recorded runs, and of the friction of a bearing from a recorded swing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxvib.boundary import call_user, is_real, validated
from jaxvib.display import Drawn, Onto
from jaxvib.errors import ComputationError, InputError, quoted
from jaxvib.identification.alternatives.clocks import clock_notes
from jaxvib.identification.alternatives.descriptions import description_notes, scale_notes
from jaxvib.identification.alternatives.laws import law_notes
from jaxvib.identification.checks import FitStatus, coverage_notes, resembles, status_of
from jaxvib.identification.directions import (
    Direction,
    Information,
    combined_information,
    directions_of,
    eliminate,
    free_unbalances,
    has_kg,
    in_polar_unbalances,
    information_of,
)
from jaxvib.identification.fit import Fitted, unknown_count
from jaxvib.identification.jammed.start import first_states, with_first_motion
from jaxvib.identification.problem import Problem, build_problem, damped_modes, has_nonlinear_supports
from jaxvib.identification.profile_likelihood import QUANTILE, profile_intervals
from jaxvib.identification.records.channel import UNITS
from jaxvib.identification.run import MeasuredRun
from jaxvib.identification.start import fit_amplitudes
from jaxvib.identification.supports.start import untouched_stops, with_guided_motion
from jaxvib.identification.torque import fit_with_torques
from jaxvib.machine.numbers.named import find_number, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene
from jaxvib.results.estimate import Estimate
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.study.bearing.identify import Identified, identify_bearing
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum
from jaxvib.units import Number, count

_REFITS_NEAR_FIRST_VALUES = 2
"""Largest number of repeated fits that begin with undetermined combinations of parameters moved back towards their first
values."""

_MAX_NOISE_RATIO = 1.01
"""Largest ratio of a channel's noise in such a repeated fit to its noise in the fit before. Above it, the repeated fit has
ended at a worse minimum."""

_STEP = 1e-4
"""Relative change of a parameter in a difference quotient."""


class MachineFit(Result):
    """Machine fitted to recorded runs.

    Returned by `identify`.

    **Attributes** (k parameters of the scene, m modes that oscillate, g gains)

    - `status`: a `FitStatus`
    - `notes`: sentences with repairs, doubts and advice
    - `scene` with the fitted parameters
    - `names` (k,), `units` (k,) and `estimates` (k,) of the parameters; the interval of an undetermined parameter is unbounded
    - `scale` (k,), in `units`: reference value of each parameter. A relative change, as in `covariance` and `information`, is
      the change divided by this value: the fitted value of a positive parameter; for other parameters the absolute first value
      (a typical magnitude if the first value is 0)
    - `covariance` (k, k) of the relative errors of the parameters in the determined directions
    - `information` (k + g + 1, k + g + 1): Fisher information about relative changes of the parameters and of the gains, and
      about the angle of the first unbalance
    - `undetermined`: a `Direction` for each combination of parameters that the records do not determine
    - `by_gain`: a `Direction` for each combination that only the known gains of the sensors determine
    - `frequency` (m,), rad/s, and `damping_ratio` (m,): natural frequencies and damping ratios of the modes that
      oscillate (damping ratio below 1)
    - `gain_names` (g,) and `gains` (g,) of the channels
    - `phase`, rad: direction of the unbalance of each exciter at the rotor angle 0, anticlockwise from the horizontal
    - `first_states`, SI: of each run with loads on its rotor, the coordinates of the machine, their velocities, the angles of
      the loads, their speeds and the angle of the rotor at the first sample; empty without loads
    - `channels`: names of the compared channels of each run, and their `kinds`
    - `noise`: standard deviation of the residuals of each run's channels, SI
    - `p_value`: smallest p-value of all channels. The p-value of a channel is the probability that pure noise vibrates at
      orders of the rotor speed at least as strongly as the residuals
    - `time` (n,), s, `readings` (n, C) and `fitted` (n, C), SI: times, readings and values of the fitted model, for each run
      with n samples of C channels; NaN for readings that do not count
    """

    status: FitStatus
    notes: tuple[str, ...]
    scene: Scene = eqx.field(metadata=SCENE)
    names: tuple[str, ...]
    units: tuple[str, ...]
    estimates: tuple[Estimate, ...] = eqx.field(metadata=in_unit("", "number"))
    scale: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    covariance: np.ndarray = eqx.field(metadata=in_unit("", "number", "number_2"))
    information: np.ndarray = eqx.field(metadata=in_unit("", "unknown", "unknown_2"))
    undetermined: tuple[Direction, ...]
    by_gain: tuple[Direction, ...]
    frequency: tuple[Estimate, ...] = eqx.field(metadata=in_unit("rad/s", "mode"))
    damping_ratio: tuple[Estimate, ...] = eqx.field(metadata=in_unit("", "mode"))
    gain_names: tuple[str, ...]
    gains: tuple[Estimate, ...] = eqx.field(metadata=in_unit("", "gain"))
    phase: np.ndarray = eqx.field(metadata=in_unit("rad", "exciter"))
    first_states: tuple[np.ndarray, ...]
    channels: tuple[tuple[str, ...], ...]
    kinds: tuple[tuple[str, ...], ...]
    noise: tuple[np.ndarray, ...]
    p_value: float = eqx.field(metadata=in_unit(""))
    time: tuple[np.ndarray, ...]
    readings: tuple[np.ndarray, ...]
    fitted: tuple[np.ndarray, ...]

    @validated
    def estimate(self, name: str) -> Estimate:
        """Return the estimate of the parameter `name`. **Raises** `InputError` for a parameter that was not unknown."""
        if name not in self.names:
            raise InputError("name", f"is {quoted(name)}; the unknown parameters were: {', '.join(self.names)}")
        return self.estimates[self.names.index(name)]

    @validated
    def interval_of(self, quantity: Callable[[Scene], float]) -> Estimate:
        """Return a quantity of the fitted scene with the interval that follows from the errors of the parameters.

        **Arguments**: `quantity`: a function of a scene, such as `lambda scene: jv.natural_frequencies(scene)[0]`.

        **Returns** an `Estimate`; its interval is unbounded if the quantity changes along an undetermined direction. **Raises**
        `InputError` if the function does not return one number.
        """
        axes = np.array([each.weights for each in self.undetermined]).reshape(-1, len(self.names)).T
        errors = np.array([each.error for each in self.undetermined])

        def values(scene: Scene) -> np.ndarray:
            found = np.asarray(call_user(quantity, "quantity", scene))
            if found.size != 1:
                problem = f"returns an array of shape {found.shape}; it must return one number, such as its entry [0]"
                raise InputError("quantity", problem)
            if not is_real(found):
                raise InputError("quantity", f"returns {quoted(found.item())}; it must return one real number")
            return found.astype(float).reshape(1)

        return propagate(self.scene, self.names, self.scale, self.covariance, axes, errors, values)[0]

    def summary(self) -> str:
        """Return the parameters with their intervals, and the sentences about them, as text."""
        lines = [self.message]
        for name, unit, each in zip(self.names, self.units, self.estimates, strict=True):
            lines.append(f"{name}: {_with_interval(each)} {unit}".rstrip())
        for k, (w, ratio) in enumerate(zip(self.frequency, self.damping_ratio, strict=True)):
            lines.append(f"mode {k + 1}: {_with_interval(w)} rad/s, damping ratio {_with_interval(ratio)}")
        for name, each in zip(self.gain_names, self.gains, strict=True):
            lines.append(f"gain of channel {name}: {_with_interval(each)}")
        for k, (names, kinds, noise) in enumerate(zip(self.channels, self.kinds, self.noise, strict=True)):
            each_noise = (f"{n} {value:.3g} {UNITS[kind]}" for n, kind, value in zip(names, kinds, noise, strict=True))
            lines.append(f"noise{f' of run {k + 1}' if len(self.noise) > 1 else ''}: {', '.join(each_noise)}")
        lines += [f"not determined: {each.sentence}" for each in self.undetermined]
        lines += [each.sentence for each in self.by_gain]
        return "\n".join([*lines, *self.notes])

    @validated
    def plot(self, *, run: int = 1, ax: Onto = None) -> Drawn:
        """Plot the readings of a run with the fit, and the residuals, onto two axes: `ax`, or those of a new figure.

        **Arguments**: `run`: number of the run, counted from 1 as in the notes. **Raises** `InputError` for another number.
        """
        from jaxvib.draw.record import fit_chart  # slow import

        k = count(run, "run") - 1
        if k >= len(self.time):
            raise InputError("run", f"is {run}; the fit has the runs 1 to {len(self.time)}")
        kinds = set(self.kinds[k])
        label = f"{self.kinds[k][0]}, {UNITS[self.kinds[k][0]]}" if len(kinds) == 1 else "reading, SI units"
        return fit_chart(self.time[k], self.readings[k], self.fitted[k], self.noise[k], self.channels[k], y_label=label, ax=ax)


def _with_interval(each: Estimate) -> str:
    if not math.isfinite(each.error):
        return f"not determined ({each.value:.4g} in the fit)"
    return f"{each.value:.6g} ({each.low:.6g} to {each.high:.6g})"


@validated
def identify(
    subject: Scene | BearingPendulum,
    records: MeasuredRun | Sequence[MeasuredRun] | Record,
    *,
    unknown: Sequence[str] = (),
    known: Mapping[str, Number] | None = None,
    dry: bool = False,
    air: bool = False,
    torque: bool = False,
    instrument: float = 0.0,
    throw: bool = True,
) -> MachineFit | Identified:
    """Return the parameters of a machine from recorded runs, or the friction of a pendulum's bearing from a recorded swing.

        M q'' + C q' + K q = -S B^T p''(theta(t)),      readings = gain (motion of the sensors) + offset + noise

    S is the unbalance, p = (cos theta, sin theta), and B q the displacement of the exciter. For a scene, the angle theta of the
    rotor follows from the run (a channel of kind "pulses", "angle" or "speed") or from a drive of prescribed speed.

    - The least-squares fit uses the whole record, including the transients
    - The unknowns of the fit are the unknown parameters, the gains of the sensors (each is 1 with the standard error
      `gain_error` of its channel), the angle of the unbalance, the offsets, and the state at the first sample
    - The noise of each channel may be coloured: residuals are whitened by an autoregressive model, and the
      intervals follow from the Fisher information with the estimated noise
    - An exciter can have loads (balls, rollers, pendulums) if the scene has no other exciter. The loads must be jammed
      throughout the runs. Their motion follows from the equations of `vector_field`; their angles and speeds at the first
      sample are unknowns
    - A scene with one exciter without loads can have nonlinear supports: `CubicSupport`, `FrictionSupport` and `Stop`. The
      parameters of a stop that is not touched in the runs are not determined
    - Parameters of a motor, such as "drive.inertia" and "drive.stall_torque", can be unknown if a channel gives the angle or
      the speed of its rotor. The torque balance of the rotor, with the torque of the vibration, is then a part of the fit

    For a `BearingPendulum`, see `jaxvib.study.bearing.identify.identify_bearing`:

        record(t_i) = offset + f(t_i) + noise
        J f'' = - m g l sin f - mu1 f' - mu2 |N| (d/2) tanh(f'/width) - b |f'| f' + M

    **Arguments**

    - `subject`: a `Scene` whose parameters are first values, or a `BearingPendulum`
    - `records`: for a scene a `MeasuredRun` or a list of them; typical: 10 to 60 s at 10 to 50 samples per period. For a
      pendulum a `Record`
    - `unknown`: names of parameters of the scene or of arrays of them, such as "machine.stiffness"
    - `known`: values of parameters with their standard errors, such as {"machine.mass[1]": "95 kg +- 1 %"}; without an error
      the value is exact. All other parameters have exactly the values of the scene
    - `dry`, `air`, `torque`, `instrument`: only for a pendulum. True to identify the dry friction mu2, the drag b of the air or
      the torque M as well. `instrument`: relative uncertainty of J; typical: 0.01 to 0.03 (default 0)
    - `throw`: True (the default) to raise an error if there is no fit

    **Returns** `MachineFit`, or `Identified` for a pendulum. **Raises** `InputError` for records that cannot be fitted,
    `ComputationError` "not_converged", or "contradicted" if the records contain a vibration that is not at the rotor speed.

    >>> import numpy as np, jaxvib as jv
    >>> rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)
    >>> t = np.arange(0.0, 15.0, 0.04)
    >>> run = jv.swing(rod, t, angle="25 deg", viscous=1.5e-3)
    >>> noisy = run.angle + 0.002 * np.random.default_rng(0).normal(size=t.size)
    >>> found = jv.identify(rod, jv.Record(t, noisy))
    >>> found.viscous.low < 1.5e-3 < found.viscous.high, found.viscous.error < 1e-5
    (True, True)

    Source: this package; for pendulums Artyunin, Sumenkov 2019.
    """
    if isinstance(subject, BearingPendulum):
        for name in (name for name, value in {"unknown": unknown, "known": known}.items() if value):
            raise InputError(name, "is for a Scene; the unknowns of a BearingPendulum are selected by dry, air and torque")
        if not isinstance(records, Record):
            raise InputError(
                "records", f"is {type(records).__name__}; it must be a Record(time, angle) or come from read_record"
            )
        return identify_bearing(subject, records, dry=dry, air=air, torque=torque, instrument=instrument, throw=throw)
    of_pendulum = {"dry": dry, "air": air, "torque": torque, "instrument": instrument}
    for name in (name for name, value in of_pendulum.items() if value):
        raise InputError(name, "is for a BearingPendulum; leave it out for a Scene")
    runs = [records] if isinstance(records, MeasuredRun) else records
    if isinstance(runs, Record) or not runs or not all(isinstance(run, MeasuredRun) for run in runs):
        raise InputError("records", f"is {quoted(records)}; it must be a list of runs of read_run or MeasuredRun.from_arrays")
    scene = validate_scene(subject)
    problem = build_problem(scene, runs, unknown, known or {})
    free, readings = unknown_count(problem), sum(int(np.count_nonzero(mask)) for mask in problem.masks)
    if free >= readings:
        text = f"has {free} unknowns, including initial states and offsets of the runs, for {readings} readings"
        raise InputError("unknown", f"{text}; record longer runs")
    if problem.has_loads:
        problem, first = with_first_motion(problem)
        starts = [first]
    elif has_nonlinear_supports(scene):
        problem, first = with_guided_motion(problem)
        starts = [first]
    else:
        starts = [np.zeros(problem.unknowns.count), fit_amplitudes(problem)]
    fitted = fit_with_torques(problem, starts)
    fitted = _refit_near_first_values(scene, problem, fitted)
    found = _interpret(scene, problem, fitted)
    if found.status_name == "patterned":
        notes = clock_notes(fitted) or law_notes(fitted, found.scene, runs, unknown, known or {})
        found = dataclasses.replace(found, notes=(*notes, *found.notes))
    if throw and not resembles(fitted):
        raise ComputationError(found.status_name, "; ".join([found.message, *found.notes]))
    return found


def _refit_near_first_values(scene: Scene, problem: Problem, fitted: Fitted) -> Fitted:
    """Return a fit in which undetermined combinations of parameters have nearly their first values.

    A single fit ends at an arbitrary point of a curved valley of equal residuals, and plans of further runs would depend on
    this point.
    """
    first = [float(np.asarray(scene.exciters[k].unbalance, float)) for k in free_unbalances(problem)]
    for _ in range(_REFITS_NEAR_FIRST_VALUES):
        information = information_of(fitted)
        axes, number_count = information.undetermined, len(problem.unknowns.numbers)
        if not axes.size or not fitted.converged:
            break
        deviation = np.concatenate([fitted.x[:number_count], np.log(information.values[number_count:] / first)])
        start = fitted.x[: problem.unknowns.count].copy()
        start[:number_count] -= (axes @ (axes.T @ deviation))[:number_count]
        refit = fit_with_torques(problem, [start])
        noise_ratio = max(float(np.max(new / old)) for new, old in zip(refit.noise, fitted.noise, strict=True))
        if not refit.converged or noise_ratio > _MAX_NOISE_RATIO:
            break
        fitted = refit
    return fitted


def _interpret(scene: Scene, first: Problem, fitted: Fitted) -> MachineFit:
    """Return a fit of the problem `first` with intervals, directions, a status and notes."""
    problem, information = fitted.problem, information_of(fitted)
    status, p_value, notes = status_of(fitted, information)
    notes = ([] if status in (FitStatus.found, FitStatus.undetermined) else description_notes(first)) + list(notes)
    notes = scale_notes(problem, _ratios_to_first_values(scene, information)) + notes
    undetermined, by_gain = directions_of(information)
    fit_scene = fitted_scene(problem, fitted.x, fitted.linear)
    modes = propagate(
        fit_scene,
        information.names,
        information.scale,
        information.covariance,
        information.undetermined,
        information.errors,
        lambda scene: np.concatenate(damped_modes(scene)),
    )
    logarithmic = information.logarithmic & ~information.vanished
    spreads = np.sqrt(np.maximum(np.diagonal(information.covariance), 0.0))
    estimates = list(map(_estimate, information.values, information.scale, logarithmic, spreads, information.determined))
    estimates = [
        each._replace(low=max(each.low, 0.0)) if is_zero else each
        for each, is_zero in zip(estimates, information.vanished, strict=True)
    ]
    ends = profile_intervals(fitted, information) if resembles(fitted) and not fitted.misfits else {}
    for name, (low, high) in ends.items():
        i = information.names.index(name)
        estimates[i] = _with_ends(estimates[i], information.scale[i], bool(information.logarithmic[i]), low, high)
        if not information.vanished[i]:
            reason = "because the cost is not quadratic near its fitted value"
            notes.append(f"the interval of {name} follows from its profile likelihood, {reason}")
    for i in np.flatnonzero(information.vanished & information.determined):
        name, limit = information.names[i], estimates[i].high
        unit = find_number(scene, name, "unknown").unit
        notes.append(f"{name} is not distinguishable from 0; it is at most {limit:.3g} {unit}".rstrip())
    return MachineFit(
        status=status,
        notes=(*problem.notes, *notes, *untouched_stops(fitted), *coverage_notes(fitted, *damped_modes(fit_scene))),
        scene=fit_scene,
        names=information.names,
        units=tuple(find_number(scene, name, "unknown").unit for name in information.names),
        estimates=tuple(estimates),
        scale=information.scale,
        covariance=information.covariance,
        information=combined_information(fitted),
        undetermined=undetermined,
        by_gain=by_gain,
        frequency=tuple(modes[: len(modes) // 2]),
        damping_ratio=tuple(modes[len(modes) // 2 :]),
        gain_names=problem.unknowns.gains,
        gains=_gains(fitted),
        phase=np.array([math.atan2(*fitted.linear[2 * k : 2 * k + 2][::-1]) for k in range(len(problem.unbalances))]),
        first_states=first_states(problem, fitted.linear) if problem.has_loads else (),
        channels=tuple(tuple(channel.name for channel in samples.channels) for samples in problem.runs),
        kinds=tuple(tuple(channel.kind for channel in samples.channels) for samples in problem.runs),
        noise=fitted.noise,
        p_value=p_value,
        time=problem.times,
        readings=tuple(np.where(mask, raw, np.nan) for raw, mask in zip(problem.raw, problem.masks, strict=True)),
        fitted=tuple(raw - left for raw, left in zip(problem.raw, fitted.residuals, strict=True)),
    )


def _ratios_to_first_values(scene: Scene, information: Information) -> np.ndarray:
    """Return the ratios of the fitted parameters whose unit is proportional to kg to their first values in `scene`; an empty
    array without an unknown mass."""
    if not any(".mass" in name for name in information.names):
        return np.zeros(0)
    chosen = information.logarithmic & information.determined & ~information.vanished & has_kg(information.names)
    first = np.array([np.asarray(find_number(scene, name, "unknown").read(scene)).item() for name in information.names])
    return information.values[chosen & (first > 0.0)] / first[chosen & (first > 0.0)]


def fitted_scene(problem: Problem, x: np.ndarray, linear: np.ndarray) -> Scene:
    """Return the scene with the fitted parameters and unbalances."""
    scene: Any = problem.unknowns.scene(problem.scene, np.asarray(x))
    for k, known in enumerate(problem.unbalances):
        if known is None or not known.is_exact:
            number = find_number(scene, f"exciters[{k}].unbalance", "unknown")
            scene = put_numbers(scene, (number,), np.hypot(*linear[2 * k : 2 * k + 2])[None])
    return validate_scene(scene)


def _estimate(value: float, scale: float, logarithmic: bool, spread: float, determined: bool) -> Estimate:
    """Return an estimate with its 95 % interval. `spread` is the standard error of the logarithm of the value if `logarithmic`,
    otherwise the standard error of the value divided by `scale`."""
    value, error = float(value), float(scale * spread)
    if not determined:
        return Estimate(value, math.inf, 0.0 if logarithmic else -math.inf, math.inf)
    if logarithmic:
        return Estimate(value, error, value * math.exp(-QUANTILE * spread), value * math.exp(QUANTILE * spread))
    return Estimate(value, error, value - QUANTILE * error, value + QUANTILE * error)


def _with_ends(estimate: Estimate, scale: float, logarithmic: bool, low: float, high: float) -> Estimate:
    """Return an estimate whose interval ends at the distances `low` and `high` from its value. A distance is the logarithm of
    a factor if `logarithmic`, otherwise it is in units of `scale`."""
    if logarithmic:
        return estimate._replace(low=estimate.value * math.exp(low), high=estimate.value * math.exp(high))
    return estimate._replace(low=estimate.value + scale * low, high=estimate.value + scale * high)


def _gains(fitted: Fitted) -> tuple[Estimate, ...]:
    unknowns = fitted.problem.unknowns
    number_count = len(unknowns.numbers)
    indices = np.arange(number_count, number_count + len(unknowns.gains))
    data, prior, _ = in_polar_unbalances(fitted)
    covariance = np.linalg.inv(eliminate(data + prior, indices))
    pairs = zip(fitted.x[indices], np.sqrt(np.diagonal(covariance)), strict=True)
    return tuple(_estimate(math.exp(x), math.exp(x), True, float(spread), True) for x, spread in pairs)


def propagate(
    scene: Scene,
    names: Sequence[str],
    scale: np.ndarray,
    covariance: np.ndarray,
    axes: np.ndarray,
    errors: np.ndarray,
    function: Callable[[Scene], np.ndarray],
) -> list[Estimate]:
    """Return the values (m,) of a function of the scene with their intervals, by central differences.

    **Arguments**: `names` (k,) of the uncertain parameters, and their `scale` (k,), SI, see `MachineFit`; the `covariance`
    (k, k) of their relative errors; undetermined directions `axes` (k, u) and their `errors` (u,); the `function`, which
    returns values (m,).
    """
    values, slopes = function(scene), []
    for name, step in zip(names, _STEP * scale, strict=True):
        number = find_number(scene, name, "unknown")
        now = np.asarray(number.read(scene))
        high, low = (function(put_numbers(scene, (number,), now + sign * step)) for sign in (1.0, -1.0))
        with np.errstate(invalid="ignore"):  # infinite values
            change = high - low if high.shape == low.shape == values.shape else np.full_like(values, np.nan)
        slopes.append(change / (2.0 * _STEP))
    slopes = np.stack(slopes, axis=1)
    spread = np.sqrt(np.maximum(np.einsum("mk,kl,ml->m", slopes, covariance, slopes), 0.0))
    undetermined_changes = np.abs(slopes @ axes) * np.minimum(errors, 1e3)
    determined = np.all(undetermined_changes < 0.1 * np.abs(values)[:, None], axis=1) & np.isfinite(spread)
    sizes = np.where(values != 0.0, np.abs(values), 1.0)
    return [
        _estimate(value, size, value > 0.0, each / size, bool(is_determined))
        for value, size, each, is_determined in zip(values, sizes, spread, determined, strict=True)
    ]
