"""Run that is not recorded yet, and the information that it would give about the parameters of a fit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.identification.directions import covariance_of, eliminate, in_polar_unbalances, principal_errors
from jaxvib.identification.fit import Fitted, information_at, unknown_count
from jaxvib.identification.identify import MachineFit
from jaxvib.identification.jammed.start import is_jammed, with_jam
from jaxvib.identification.problem import MOTIONS, Problem, build_problem, has_nonlinear_supports, is_nonlinear, with_noise
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.numbers.named import find_number, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.numerics.noise import Noise, noise_of, resampled
from jaxvib.results.readable import Readable
from jaxvib.units import Number, count, number

_BYTES_PER_SAMPLE = 1000.0
"""Memory for each sample of a planned run, bytes: readings, their derivatives and copies."""

_INACCURATE, _MAX_ERROR, _MAX_DECREASE = 0.02, 1.0, 0.9
"""Limits of the changes, relative to the parameters, that give the range of expected errors. The fit is changed along a
direction if the standard error of this direction is above the first number. A larger standard error than the second number
counts as this number, because the standard error of an undetermined direction can be arbitrarily large. The third number is
the largest decrease of a positive parameter."""


class PlannedRun(Readable):
    """Run that is not recorded yet.

    **Arguments**

    - `name` for tables
    - `drive` of prescribed speed: a run-up (`RunUp`, `SpinUp`), a constant speed (`ConstantSpeed`), or any other speed over
      time, such as a coast-down (`SpeedProfile`)
    - `duration`, s; typical: 10 to 60
    - `channels` of the run; their places may differ from those of the runs so far. A sensor that is moved to another place
      keeps its name: the name identifies its gain
    - `rate`, Hz, of the samples; typical: 200 to 2000
    - `noise`: standard deviation of the readings by the name of the channel, for channels that no run so far has, in SI units
      or as strings; typical: "0.05 m/s^2". Other channels have the noise of the fit, with the same spectral density
    - `change`: parameters of the scene that differ in this run, as in `MeasuredRun.from_arrays`

    **Raises** `InputError` for a drive whose speed depends on the machine, and for values that are not positive.

    >>> import jaxvib as jv
    >>> frame = jv.Channel("frame", "acceleration", at=1)
    >>> jv.PlannedRun("slow", jv.SpinUp("900 rpm", "30 s"), "30 s", [frame], rate="500 Hz").duration
    30.0
    """

    name: str
    drive: Drive
    duration: float
    channels: tuple[Channel, ...]
    rate: float
    noise: dict[str, float]
    change: dict[str, Number]

    @validated
    def __init__(
        self,
        name: str,
        drive: Drive,
        duration: Number,
        channels: Sequence[Channel],
        *,
        rate: Number,
        noise: Mapping[str, Number] | None = None,
        change: Mapping[str, Number] | None = None,
    ):
        if not drive.ideal:
            raise InputError("drive", f"is {drive.kind!r}, whose speed depends on the machine; give a drive such as SpinUp")
        self.name, self.drive, self.channels = name, drive, tuple(channels)
        self.duration = float(number(duration, "s", "duration", low=0.0, open_low=True))
        self.rate = float(number(rate, "Hz", "rate", low=0.0, open_low=True))
        samples = min(self.duration * self.rate, 2.0**62)
        count(math.ceil(samples), "samples (duration times rate)", each=_BYTES_PER_SAMPLE)
        self.change = dict(change or {})
        units, self.noise = {each.name: UNITS[each.kind] for each in channels}, {}
        for channel, value in (noise or {}).items():
            field = f"noise[{quoted(channel)}]"
            if channel not in units:
                raise InputError(field, f"is not of a channel of the run; its channels are: {', '.join(units)}")
            self.noise[channel] = float(number(value, units[channel], field, low=0.0, open_low=True))


class Expected(NamedTuple):
    """Planned run, evaluated with the parameters of a fit.

    **Attributes**

    - `fitted`: the run as a fit without iterations
    - `indices_in_run` (k,): the positions, among the unknowns of the run, of the k unknowns that run and fit have in common
    - `indices_in_fit` (k,): the positions of the same unknowns in the information of the fit
    """

    fitted: Fitted
    indices_in_run: np.ndarray
    indices_in_fit: np.ndarray

    def shared(self, information: np.ndarray, size: int) -> np.ndarray:
        """Return the information (size, size) of the run about the unknowns of the fit, from its `information` about all
        unknowns of the run."""
        total = np.zeros((size, size))
        total[np.ix_(self.indices_in_fit, self.indices_in_fit)] = eliminate(information, self.indices_in_run)
        return total


def expected_run(fit: MachineFit, planned: PlannedRun) -> Expected:
    """Return a planned run, evaluated with the parameters of a fit.

    If the scene has loads, the planned run begins with the state at the first sample of the first run of the fit, otherwise at
    rest.

    **Raises** `InputError` for a channel whose noise is unknown, for a scene with several exciters, and for loads that do not
    stay jammed.
    """
    noises = _noises(fit) | {name: (Noise(np.ones(1), each), 1.0 / planned.rate) for name, each in planned.noise.items()}
    vibration_channels = [channel for channel in planned.channels if channel.kind in MOTIONS]
    kinds = dict(pair for run in zip(fit.channels, fit.kinds, strict=True) for pair in zip(*run, strict=True))
    for channel in vibration_channels:
        there = f"channel {quoted(channel.name)}"
        if (kind := kinds.get(channel.name, channel.kind)) != channel.kind:
            problem = (
                f"is of kind {channel.kind}, but {kind} in the fit; channels with the same name have the same noise and gain: "
                "give the channel another name"
            )
            raise InputError(f"candidates: {planned.name}: {there}", problem)
        if channel.name not in noises:
            raise InputError(f"candidates: {planned.name}: {there}", "is new; give its noise, noise={name: standard deviation}")
    time = np.arange(0.0, planned.duration, 1.0 / planned.rate)
    readings = {channel.name: np.zeros(time.size) for channel in vibration_channels}
    run = MeasuredRun.from_arrays(vibration_channels, time, readings, planned.change, planned.name)
    exciter, count = fit.scene.exciters[0], len(fit.scene.exciters)
    if count > 1:
        raise InputError("fit.scene", f"has {count} exciters; plan_runs needs a scene with one exciter")
    scene = eqx.tree_at(lambda s: s.exciters[0], fit.scene, exciter.with_parts(exciter.loads, planned.drive))
    problem = problem_of_run(fit, scene, run)
    step, of_channels = float(problem.runs[0].step), [noises[channel.name] for channel in vibration_channels]
    # The spectral density of the noise is the same at all sampling rates.
    problem = with_noise(problem, [[resampled(noise, round(step / own, 9)) for noise, own in of_channels]])
    problem = problem._replace(precisions=own_precisions(fit, problem))
    linear = np.zeros(unknown_count(problem) - problem.unknowns.count)
    size = 1.0 if exciter.unbalance is None else float(np.asarray(exciter.unbalance, float))
    linear[:2] = size * np.cos(fit.phase[0]), size * np.sin(fit.phase[0])
    if problem.has_loads:
        problem, linear = with_jam(problem, linear, fit.first_states[0])
        if not is_jammed(problem, linear):
            raise InputError(
                f"candidates: {planned.name}: drive",
                "has a speed at which the loads do not stay jammed below the rotor speed; give a faster drive",
            )
    elif has_nonlinear_supports(scene):
        problem = problem._replace(linear=linear)
    fitted = information_at(problem, linear)
    has_mark = any(channel.kind in ("pulses", "angle") for channel in planned.channels)
    return Expected(fitted, *shared_indices(fit, problem, has_mark))


def _noises(fit: MachineFit) -> dict[str, tuple[Noise, float]]:
    """Return the noise of each channel in the first run of the fit that has the channel, and the sampling step, s."""
    noises: dict[str, tuple[Noise, float]] = {}
    for r in reversed(range(len(fit.channels))):
        step, residuals = float(fit.time[r][1] - fit.time[r][0]), (fit.readings[r] - fit.fitted[r]).T
        for name, deviation, each in zip(fit.channels[r], fit.noise[r], residuals, strict=True):
            noise = noise_of(each)
            noises[name] = (noise if len(noise.taps) > 1 or noise.outliers else Noise(noise.taps, float(deviation)), step)
    return noises


def problem_of_run(fit: MachineFit, scene: Scene, run: MeasuredRun) -> Problem:
    """Return the problem of a run with the parameters of a fit as unknowns, in the units of `fit.scale`. Parameters of the
    motor are left out, because the vibrations do not determine them.

    **Arguments**: `scene`: the fitted scene with the drive of the run.
    """
    problem = build_problem(scene, [run], [name for name in fit.names if "drive." not in name], {})
    unknowns = problem.unknowns
    scale = jnp.asarray([fit.scale[fit.names.index(number.name)] for number in unknowns.numbers])
    linear = dataclasses.replace(unknowns, scale=scale, positive=jnp.zeros(scale.shape, bool))
    return problem._replace(unknowns=linear)


def own_precisions(fit: MachineFit, problem: Problem) -> np.ndarray:
    """Return 1/error^2 (p,) of the stated errors of the unknowns of a run; 0 for gains that the information of `fit` already
    contains."""
    precisions = problem.precisions.copy()
    for k, name in enumerate(problem.unknowns.gains):
        if name in fit.gain_names:
            precisions[len(problem.unknowns.numbers) + k] = 0.0
    return precisions


def shared_indices(fit: MachineFit, problem: Problem, has_mark: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the shared unknowns of a run and a fit: among the unknowns of the run, and in `fit.information`.

    **Arguments**: `has_mark`: True if the zero of the rotor's angle in the run is that of the fit.
    """
    unknowns, p, count = problem.unknowns, problem.unknowns.count, len(fit.names)
    names, number_count = [number.name for number in unknowns.numbers], len(unknowns.numbers)
    pairs = [(at, fit.names.index(name)) for at, name in enumerate(names)]
    unbalances = {f"exciters[{k}].unbalance": p + 2 * k for k in range(len(problem.unbalances))}
    pairs += [(at, fit.names.index(name)) for name, at in unbalances.items() if name in fit.names]
    gains = enumerate(unknowns.gains)
    pairs += [(number_count + at, count + fit.gain_names.index(name)) for at, name in gains if name in fit.gain_names]
    pairs += [(p + 1, count + len(fit.gain_names))] * has_mark
    indices_in_run, indices_in_fit = np.array(pairs, int).T
    return indices_in_run, indices_in_fit


def expected_information(fit: MachineFit, expected: Expected) -> np.ndarray:
    """Return the information of a planned run about the unknowns of a fit."""
    data, known, _ = in_polar_unbalances(expected.fitted)
    return expected.shared(data + known, len(fit.information))


def expected_errors(information: np.ndarray, count: int) -> np.ndarray:
    """Return the relative standard errors (count,) of the parameters, infinite for those that are not determined."""
    result = covariance_of(eliminate(information, np.arange(count)))
    return np.where(result.determined, np.sqrt(np.diagonal(result.covariance)), np.inf)


def range_of_errors(fit: MachineFit, planned: PlannedRun, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest expected errors (k,) after a planned run, for machines that differ from the fitted
    one by two standard errors of each inaccurate direction. NaN for a nonlinear motion.

    The information of the runs so far is not computed again.

    **Arguments**: the `errors` (k,) that are expected for the fitted machine.
    """
    count, found = len(fit.names), [errors]
    if is_nonlinear(fit.scene):
        return np.full(count, np.nan), np.full(count, np.nan)
    sizes, axes = principal_errors(eliminate(fit.information, np.arange(count)))
    for size, axis in zip(sizes, axes.T, strict=True):
        for sign in (-1.0, 1.0) if size > _INACCURATE else ():
            other = _changed_fit(fit, sign * 2.0 * min(float(size), _MAX_ERROR) * axis)
            found.append(expected_errors(fit.information + expected_information(other, expected_run(other, planned)), count))
    return np.min(found, axis=0), np.max(found, axis=0)


def _changed_fit(fit: MachineFit, change: np.ndarray) -> MachineFit:
    """Return the fit with relative changes (k,) of its parameters.

    If a positive parameter would decrease by more than 90 %, all changes are reduced by a common factor. The parameters are
    changed and not their logarithms, because the modal dampings, which the runs so far may determine, are linear in the
    damping coefficients.
    """
    numbers = [find_number(fit.scene, name, "unknown") for name in fit.names]
    values = np.array([float(each.read(fit.scene)[0]) for each in numbers])
    is_positive = values == fit.scale
    new = values + fit.scale * change * min(1.0, _MAX_DECREASE / np.max(-change, where=is_positive, initial=_MAX_DECREASE))
    scene = put_numbers(fit.scene, numbers, new)
    return dataclasses.replace(fit, scene=scene, scale=np.where(is_positive, new, fit.scale))
