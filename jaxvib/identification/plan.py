"""Choice of the next run: errors of the numbers that candidate runs would leave, by the Fisher information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.identification.directions import covariance_of, eliminate, in_polar_unbalances
from jaxvib.identification.fit import information_at
from jaxvib.identification.identify import MachineFit
from jaxvib.identification.problem import MOTIONS, build_problem, with_noise
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.drives.drive import Drive
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.units import Number, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn


class PlannedRun(eqx.Module):
    """Run that is not recorded yet.

    **Arguments**

    - `name` for tables
    - `drive` of prescribed speed, such as `RunUp` or `SpinUp`
    - `duration`, s; typical: 10 to 60
    - `channels` of the run; their places and the numbers of the scene may differ from those of the runs so far. A sensor keeps
      its name, and thereby its gain, at another place
    - `rate`, Hz, of the samples; typical: 200 to 2000
    - `noise`: standard deviation of the readings by the name of the channel, SI, for channels that no run so far has
    - `change`: numbers of the scene that differ in this run, as in `MeasuredRun.from_arrays`

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
        noise: Mapping[str, float] | None = None,
        change: Mapping[str, Number] | None = None,
    ):
        if not drive.ideal:
            raise InputError("drive", f"is {drive.kind!r}, whose speed depends on the machine; give a drive such as SpinUp")
        self.name, self.drive, self.channels = name, drive, tuple(channels)
        self.duration = float(number(duration, "s", "duration", low=0.0, open_low=True))
        self.rate = float(number(rate, "Hz", "rate", low=0.0, open_low=True))
        self.noise, self.change = dict(noise or {}), dict(change or {})


class RunPlan(Result):
    """Expected errors after candidate runs. Returned by `plan_runs`.

    **Attributes** (c candidates, k numbers)

    - `candidates` (c,): names of the runs, the best one first; `numbers` (k,): names of the numbers
    - `errors` (c, k): expected relative standard errors with the runs so far and this one, infinite if not determined
    - `now` (k,): relative standard errors with the runs so far
    - `minutes` (c,): durations
    - `gain` (c,): sum over the numbers of the logarithm of the ratio of errors before and after, per minute of test. An
      undetermined number counts as an error of 1
    """

    status = Computed.done

    candidates: tuple[str, ...]
    numbers: tuple[str, ...]
    errors: np.ndarray = eqx.field(metadata=in_unit("", "candidate", "number"))
    now: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    minutes: np.ndarray = eqx.field(metadata=in_unit("min", "candidate"))
    gain: np.ndarray = eqx.field(metadata=in_unit("1/min", "candidate"))

    def summary(self) -> str:
        """Return the candidates with their expected errors as text, the best one first."""
        lines = [f"errors now: {self._row(self.now)}"]
        for name, row, minutes, gain in zip(self.candidates, self.errors, self.minutes, self.gain, strict=True):
            lines.append(f"{name} ({minutes:.3g} min, {gain:.3g} per minute): {self._row(row)}")
        return "\n".join(lines)

    def _row(self, errors: np.ndarray) -> str:
        pairs = zip(self.numbers, errors, strict=True)
        return ", ".join(f"{name} {f'{each:.2g}' if np.isfinite(each) else 'not determined'}" for name, each in pairs)

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the largest error of a number after each candidate run.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.results import points_chart  # slow import

        largest = np.max(np.where(np.isfinite(self.errors), self.errors, 1.0), axis=1)
        return points_chart(largest[:, None], x_label="candidate run", y_label="largest relative error", ax=ax)


@validated
def plan_runs(fit: MachineFit, candidates: Sequence[PlannedRun]) -> RunPlan:
    """Return the errors that the fitted numbers would have after each of some candidate runs, without making them.

        errors^2 = diagonal of (F_so_far + F_candidate)^-1,       F = J^T J / noise^2

    - F is the Fisher information about the unknown numbers and the gains of the sensors; the state at the first sample and the
      offsets of the candidate are free, and so is the zero of the rotor's angle, unless a channel of kind pulses or angle has
      the mark of the runs so far
    - The model of the fit gives the expected readings. An added mass, other places of sensors, and sensors that change places
      are `change` and `channels` of a candidate

    **Arguments**: `fit` from `identify`; `candidates`: a `PlannedRun` each.

    **Returns** `RunPlan`, the candidates in the order of their gain per minute of test. **Raises** `InputError` for a channel
    whose noise is unknown.

    >>> import numpy as np, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    >>> drive = jv.RunUp(60.0, acceleration=6.0)
    >>> scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)])
    >>> t, frame = np.arange(0.0, 10.0, 0.005), jv.Channel("frame", "acceleration", at=1, gain_error=0.0)
    >>> motion = 0.01 * np.random.default_rng(0).normal(size=t.size)    # a record that shows nothing
    >>> run = jv.MeasuredRun.from_arrays([frame], t, {"frame": motion})
    >>> fit = jv.identify(scene, run, unknown=["machine.stiffness", "machine.damping"], throw=False)
    >>> plan = jv.plan_runs(fit, [jv.PlannedRun("slow", drive, "10 s", [frame], rate=200.0)])
    >>> plan.candidates, plan.errors.shape
    (('slow',), (1, 2))

    Source: this package.
    """
    if not candidates:
        raise InputError("candidates", "is empty; give at least one PlannedRun")
    k = len(fit.names)
    errors = np.stack([_errors(fit.information + _information(fit, each), k) for each in candidates])
    now, minutes = _errors(fit.information, k), np.array([each.duration for each in candidates]) / 60.0
    gain = np.sum(np.log(np.minimum(now, 1.0) / np.minimum(errors, 1.0)), axis=1) / minutes
    order = np.argsort(-gain, kind="stable")
    names = tuple(candidates[i].name for i in order)
    return RunPlan(names, fit.names, errors[order], now, minutes[order], gain[order])


def _errors(information: np.ndarray, count: int) -> np.ndarray:
    """Return the relative standard errors (count,) of the numbers, infinite for those that are not determined."""
    found = covariance_of(eliminate(information, np.arange(count)))
    return np.where(found.determined, np.sqrt(np.diagonal(found.covariance)), np.inf)


def _information(fit: MachineFit, planned: PlannedRun) -> np.ndarray:
    """Return the information of a planned run about the numbers and the gains of a fit."""
    deviations = dict(zip(fit.channels[0], fit.noise[0], strict=True))
    for names, noise in zip(fit.channels, fit.noise, strict=True):
        deviations |= dict(zip(names, noise, strict=True))
    deviations |= planned.noise
    has_mark = any(channel.kind in ("pulses", "angle") for channel in planned.channels)
    moving = [channel for channel in planned.channels if channel.kind in MOTIONS]
    for channel in moving:
        if channel.name not in deviations:
            there = f"channel {quoted(channel.name)}"
            raise InputError(f"candidates: {planned.name}: {there}", "is new; give its noise, noise={name: standard deviation}")
    time = np.arange(0.0, planned.duration, 1.0 / planned.rate)
    readings = {channel.name: np.zeros(time.size) for channel in moving}
    run = MeasuredRun.from_arrays(moving, time, readings, planned.change, planned.name)
    exciter = fit.scene.exciters[0]
    scene = eqx.tree_at(lambda s: s.exciters[0], fit.scene, exciter.with_parts(None, planned.drive))
    problem = build_problem(scene, [run], fit.names, {})
    problem = with_noise(problem, [[np.ones(1) for _ in moving]], [np.array([deviations[c.name] for c in moving])])
    size = float(np.asarray(exciter.unbalance, float))
    fitted = information_at(problem, size * np.array([np.cos(fit.phase[0]), np.sin(fit.phase[0])]))
    moved, unknowns = len(problem.unknowns.numbers), problem.unknowns
    shared = [fit.gain_names.index(name) if name in fit.gain_names else -1 for name in unknowns.gains]
    # The errors of gains that the fit already has are part of its information.
    prior = fitted.prior.copy()
    for at, index in enumerate(shared):
        if index >= 0:
            prior[moved + at, moved + at] = 0.0
    data, known, _ = in_polar_unbalances(fitted._replace(prior=prior))
    p, count = fitted.x.size, len(fit.names)
    names = [number.name for number in unknowns.numbers]
    pairs = [(at, fit.names.index(name)) for at, name in enumerate(names)]
    pairs += [(p, fit.names.index(name)) for name in fit.names if name not in names]  # the unbalance
    pairs += [(moved + at, count + index) for at, index in enumerate(shared) if index >= 0]
    pairs += [(p + 1, count + len(fit.gain_names))] * has_mark
    own, place = np.array(pairs, int).T
    total = np.zeros_like(fit.information)
    total[np.ix_(place, place)] = eliminate(data + known, own)
    return total
