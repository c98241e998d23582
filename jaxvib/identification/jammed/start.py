"""First values of a motion with jammed loads, by multiple shooting.

The vibration at the speed of the jam gives the angle of the loads up to a constant. This constant follows, together with the
motion of the machine and the unbalance of the rotor, from a linear fit in which the loads are an unbalance that turns by that
angle. The motion is then divided into segments, whose first states are unknowns of a fit with all other unknowns. The gaps
between the segments are penalized and become small. Within a segment, errors of the first values change the angles of the loads
by less than a radian, whereas over the whole record they would change them by many turns.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.errors import InputError
from jaxvib.identification.angle import RecordedDrive, drive_of_spline
from jaxvib.identification.fit import (
    Equations,
    descend,
    known_cost,
    limited_step,
    linear_indices,
    positive_indices,
    prior_equations,
    project,
    unknown_count,
)
from jaxvib.identification.jammed.motion import ShiftedDrive, closed_motion, linearized, weighted_columns
from jaxvib.identification.problem import Problem, channel_sizes, damped_modes, with_noise
from jaxvib.identification.records.spline import fit_curve
from jaxvib.identification.response import Unknowns, model_states
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.numerics.noise import Noise

_BELOW_ROTOR = 0.95
"""Largest speed of a jam relative to the lowest rotor speed."""

_BAND_HALF_WIDTH = 0.25
"""Relative half-width of the band of frequencies about the speed of a jam from which the angle of the loads follows."""

_EDGE_TURNS = 3
"""Number of turns at each end of a record in which the angle is extrapolated with the mean speed."""

_BINS_PER_LINE, _MIN_LINE_POWER = 5, 4.0
"""Number of bins of a spectrum that are averaged, and smallest power of the jam in them relative to the mean power below the
rotor speed."""

_MIN_TURNS = 8
"""Smallest number of turns of jammed loads in a record."""

_COINCIDENT_SPREAD, _FREE_SPREAD = 1e-3, 0.2
"""Assumed scatter of the loads of a run at the first sample, for equal loads at one station and for all other loads. The
scatter is the standard deviation of the angles, rad, and that of the speeds relative to the mean speed. Equal loads at one
station gather in a jam, and a small difference of their angles changes no reading."""

_GAP_SIZE = 0.01
"""Gap between two segments, relative to the size of each state (angles: rad), that costs as much as a reading whose residual
is one standard deviation."""

_UNEXPLAINED = 0.25
"""Cost per reading, relative to the variance of the readings, above which a motion does not resemble the records."""

_REDUCTION_PER_READING = 1e-3
"""Expected reduction of the cost per reading, relative to the variance of the readings, below which the segments are fitted
well enough: the fit of the whole motion converges from there. In a curved valley of the cost, the fit of the whole motion takes
fewer steps than the fit of the segments."""

_ABOVE_JAM, _SAME_STIFFNESS = 1.04, 0.01
"""Ratio of a natural frequency to the speed of the jam near it, and change of the logarithm of the stiffnesses below which
their first values are not replaced."""

_MAX_TURN = 0.7
"""Largest change of the angle of a load in one step, rad."""


class _Jam(NamedTuple):
    """Jam of a run: `drive` that turns like the loads, except for a constant angle; its angle and speed (n,) at the samples."""

    drive: RecordedDrive
    angle: np.ndarray
    speed: np.ndarray


class _Trial(NamedTuple):
    """Values of all unknowns, with their cost and `equations`.

    **Attributes**: `x` (p,), the nonlinear unknowns; `linear` (L,), the linear ones; for each run, `starts` (J, ns), the first
    states of its J segments, and `start_changes` (J, ns, f + 1) of these states, see `Linearized`.
    """

    x: np.ndarray
    linear: np.ndarray
    starts: tuple[np.ndarray, ...]
    start_changes: tuple[np.ndarray, ...]
    cost: float
    equations: Equations


def with_first_motion(problem: Problem) -> tuple[Problem, np.ndarray]:
    """Return the problem of a scene with jammed loads, to which the first values of the linear unknowns are added, and the
    first values x of the other unknowns.

    If the motion with the first values of the scene does not resemble the records, it is computed again with other stiffnesses,
    see `_stiffnesses_of_jam`.

    **Raises** `InputError` for a run without a vibration below the rotor speed.
    """
    noise = [[Noise(np.ones(1), size) for size in of_run] for of_run in channel_sizes(problem)]
    weighted_problem, jams = with_noise(problem, noise), [_jam_of(problem, r) for r in range(len(problem.runs))]
    fitted, load_spread = _first_fit(weighted_problem, jams, np.zeros(problem.unknowns.count))
    is_found = fitted.cost < _UNEXPLAINED * _reading_count(problem)
    other = None if is_found else _stiffnesses_of_jam(problem, jams)
    if other is not None:
        again = _first_fit(weighted_problem, jams, other)
        fitted, load_spread = min((fitted, load_spread), again, key=lambda each: each[0].cost)
    angles = tuple(np.column_stack([turned, jam.angle]) for turned, jam in zip(problem.angles, jams, strict=True))
    return problem._replace(angles=angles, linear=fitted.linear, load_spread=load_spread), fitted.x


def _reading_count(problem: Problem) -> int:
    """Return the number of readings."""
    return sum(int(np.count_nonzero(mask)) for mask in problem.masks)


def _stiffnesses_of_jam(problem: Problem, jams: Sequence[_Jam]) -> np.ndarray | None:
    """Return x with the unknown stiffnesses multiplied by one number, such that the natural frequency nearest the speed of the
    loads is slightly above this speed, as in a jam; None if no stiffness is unknown, or if the number is nearly 1."""
    speed, frequency = float(np.median(np.abs(jams[0].speed))), damped_modes(problem.scene)[0]
    names = [number.name for number in problem.unknowns.numbers]
    own = [k for k in positive_indices(problem) if "stiffness" in names[k] and problem.precisions[k] == 0.0]
    if not own or not frequency.size:
        return None
    nearest = frequency[np.argmin(np.abs(np.log(frequency / speed)))]
    x = np.zeros(problem.unknowns.count)
    x[own] = 2.0 * math.log(_ABOVE_JAM * speed / nearest)
    return None if abs(x[own[0]]) < _SAME_STIFFNESS else x


def _first_fit(problem: Problem, jams: Sequence[_Jam], x: np.ndarray) -> tuple[_Trial, np.ndarray]:
    """Return the motion of all runs that is fitted from the first values x, and the information of `load_spread_of`."""
    x, linear = x.copy(), np.zeros(unknown_count(problem) - problem.unknowns.count)
    starts, pairs = [], []
    for r, (jam, indices) in enumerate(zip(jams, linear_indices(problem), strict=True)):
        states, pair, offsets = _linear_motion(problem, r, jam, x)
        linear[indices] = np.concatenate([states[0], pair, offsets])
        starts.append(states)
        pairs.append(pair)
    linear[:2] = pairs[0]
    for samples, pair in zip(problem.runs, pairs, strict=True):
        if samples.turn is not None:
            turn = math.atan2(pair[1], pair[0]) - math.atan2(pairs[0][1], pairs[0][0])
            x[problem.unknowns.first.shape[0] + len(problem.unknowns.gains) + samples.turn] = turn
    load_spread = load_spread_of(problem, linear)
    return _shoot(problem._replace(load_spread=load_spread), x, linear, starts), load_spread


def _loads_of(scene: Scene) -> CircularLoads:
    """Return the loads of a scene; `build_problem` accepts loads on a circle only."""
    loads = scene.exciters[0].loads
    assert isinstance(loads, CircularLoads)
    return loads


def first_states(problem: Problem, linear: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the states of each run at the first sample, without those of filters: displacements, velocities, angles of the
    loads, their rates; and the angle of the rotor."""
    count = 2 * (len(problem.scene.machine.structure().coordinates) + _loads_of(problem.scene).count)
    pairs = zip(linear_indices(problem), problem.angles, strict=True)
    return tuple(np.append(linear[indices[:count]], angles[0, 0]) for indices, angles in pairs)


def with_jam(problem: Problem, linear: np.ndarray, state: np.ndarray) -> tuple[Problem, np.ndarray]:
    """Return the problem of one planned run that begins with a state of `first_states`, and its linear unknowns.

    **Arguments**: `linear` (L,): values of the linear unknowns. Its entries of the first state are overwritten by `state`.
    """
    indices, samples = linear_indices(problem)[0], problem.runs[0]
    linear[indices[: state.size - 1]] = state[:-1]
    (drive,), begin = samples.drives, samples.begin
    shifted = ShiftedDrive(drive=drive, phase=state[-1] - drive.rotor_angle(begin, None), end=samples.end, speed=drive.speed)
    turned = dataclasses.replace(samples, drives=(shifted,))
    return problem._replace(runs=(turned,), linear=linear, load_spread=load_spread_of(problem, linear)), linear


def is_jammed(problem: Problem, linear: np.ndarray) -> bool:
    """Return True if the loads of the first run turn more slowly than the rotor at the first sample of each segment."""
    samples, indices = problem.runs[0], linear_indices(problem)[0]
    _, starts = closed_motion(problem.unknowns, samples, problem.scene, np.zeros(problem.unknowns.count), linear[indices])
    loads = _loads_of(problem.scene).count
    rates = starts[:, 2 * len(problem.scene.machine.structure().coordinates) + loads :][:, :loads]
    speed = np.abs(np.gradient(problem.angles[0][:, 0], float(samples.step)))[:: samples.segments[1]]
    return bool(np.all(np.abs(rates) < _BELOW_ROTOR * speed[: len(rates), None]))


def load_spread_of(problem: Problem, linear: np.ndarray) -> np.ndarray:
    """Return the information (L, L) from the assumption that the loads of each run have nearly one angle and one speed at the
    first sample."""
    loads, mount = _loads_of(problem.scene), problem.scene.mounting
    nd, information = len(problem.scene.machine.structure().coordinates), np.zeros((linear.size, linear.size))
    spread = _COINCIDENT_SPREAD if loads.alike and mount.at_one_point else _FREE_SPREAD
    for indices in linear_indices(problem):
        angles, rates = np.split(indices[2 * nd : 2 * (nd + loads.count)], 2)
        for group, size in ((angles, 1.0), (rates, abs(float(linear[rates[0]])))):
            information[np.ix_(group, group)] = (np.eye(loads.count) - 1.0 / loads.count) / (spread * size) ** 2
    return information


def _jam_of(problem: Problem, r: int) -> _Jam:
    """Return the jam of a run, from the strongest vibration below the rotor speed."""
    samples, raw, mask, time = problem.runs[r], problem.raw[r], problem.masks[r], problem.times[r]
    step = float(samples.step)
    speed = np.abs(np.gradient(problem.angles[r][:, 0], step))
    filled = [np.interp(time, time[each], values[each]) for values, each in zip(raw.T, mask.T, strict=True) if np.any(each)]
    frequency = 2.0 * np.pi * np.fft.rfftfreq(time.size, step)
    spectra = [np.fft.rfft(each - np.mean(each)) / np.std(each) for each in filled if np.std(each) > 0.0]
    low, high = 2.0 * np.pi * _MIN_TURNS / (time[-1] - time[0]), _BELOW_ROTOR * float(np.quantile(speed, 0.02))
    in_range = (frequency > low) & (frequency < high)
    power, mean = np.zeros(frequency.size), np.full(_BINS_PER_LINE, 1.0 / _BINS_PER_LINE)
    for each in spectra:
        power += np.convolve(np.where(in_range, np.abs(each) ** 2, 0.0), mean, mode="same")
    power[~in_range] = 0.0
    if not np.max(power) > _MIN_LINE_POWER * np.sum(power) / max(np.count_nonzero(in_range), 1):
        raise InputError(
            f"records[{r}]",
            f"has no vibration of jammed loads below {high:.3g} rad/s, {100.0 * _BELOW_ROTOR:.0f} % of the lowest rotor speed; "
            "identify needs records in which the loads of the scene are jammed from the first sample to the last, for at least "
            "8 turns",
        )
    peak = float(frequency[np.argmax(power)])
    band = in_range & (np.abs(frequency / peak - 1.0) < _BAND_HALF_WIDTH)
    strongest = max(spectra, key=lambda each: float(np.sum(np.abs(each[band]) ** 2)))
    analytic = np.fft.ifft(np.concatenate([np.where(band, strongest, 0.0), np.zeros(time.size - frequency.size)]))
    phase, edge = np.unwrap(np.angle(analytic)), math.ceil(2.0 * np.pi * _EDGE_TURNS / (peak * step))
    for part in (slice(edge, None, -1), slice(-edge - 1, None)):  # the filter continues the record periodically
        slope = (phase[part][0] - phase[::-1][part][0]) / (time[part][0] - time[::-1][part][0])
        phase[part] = phase[part][0] + slope * (time[part] - time[part][0])
    thinned = slice(None, None, max(1, int(1.0 / (peak * step))))
    spline = fit_curve(time[thinned], phase[thinned])
    return _Jam(drive_of_spline(spline), spline(time)[:, 0], spline(time, 1)[:, 0])


def _linear_motion(problem: Problem, r: int, jam: _Jam, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the states (J, ns) at the starts of the segments of a run, the components of its unbalance, and its offsets, at
    the values `x`."""
    samples = problem.runs[r]
    scene_of_run = samples.scene(problem.unknowns.scene(problem.scene, x))
    exciter, loads = scene_of_run.exciters[0], _loads_of(scene_of_run)
    place: dict[str, Any] = {"at": exciter.at, "body": exciter.body, "direction": exciter.direction}
    mass = np.sum(np.broadcast_to(loads.mass, loads.count))
    jammed = Exciter(drive=jam.drive, unbalance=float(mass * np.mean(loads.arm())), unbalance_mass=float(mass), **place)
    rotors = [] if exciter.unbalance is None else [exciter.with_parts(None, samples.drives[0])]
    exciters, drives = [*rotors, jammed], (*samples.drives[: len(rotors)], jam.drive)
    jammed_scene = Scene(scene_of_run.machine, exciters=exciters, effects=scene_of_run.effects)
    empty, no = jnp.zeros(0), ()
    samples = dataclasses.replace(
        samples, drives=drives, amounts=empty, changed=no, actions=no, turn=None, errors=(0, 0), segments=(0, 0, 0)
    )
    unknowns = Unknowns((), empty, empty, empty, no, 0)
    linear = project(
        problem._replace(
            scene=jammed_scene, unknowns=unknowns, runs=(samples,), unbalances=(None,) * len(exciters), linear=None,
            means=np.zeros(0), precisions=np.zeros(0),
        ),
        np.zeros(0),
    ).linear  # fmt: skip
    number, length, _ = problem.runs[r].segments
    at = length * np.arange(number)
    pairs, channels = linear[: 2 * len(exciters)], len(samples.channels)
    ordered = np.concatenate([linear[2 * len(exciters) : -channels], pairs, linear[-channels:]])
    motion = np.asarray(model_states(unknowns, samples, jammed_scene, empty, jnp.asarray(ordered)))[at]
    angle = np.repeat(exciter.direction * jam.angle[at][:, None] + math.atan2(pairs[-1], pairs[-2]), loads.count, axis=1)
    rate = np.repeat(exciter.direction * jam.speed[at][:, None], loads.count, axis=1)
    filters = np.zeros((number, sum(channel.high_pass > 0.0 for channel in samples.channels)))
    pair = pairs[:2] if rotors else np.array([1.0, 0.0])
    return np.concatenate([motion, angle, rate, filters], axis=1), pair, linear[-channels:]


def _shoot(problem: Problem, x: np.ndarray, linear: np.ndarray, starts: list[np.ndarray]) -> _Trial:
    """Return a motion near the best one, from the first values `x` and `linear`, and from the first states `starts` of the
    segments, between which there are gaps; see `_REDUCTION_PER_READING`."""
    p, size, indices_of_runs = x.size, x.size + linear.size, linear_indices(problem)
    whole = np.concatenate(starts)
    scale = np.maximum(np.sqrt(np.mean(whole**2, axis=0)), 1e-9 * np.max(np.abs(whole)))
    turns = 2 * len(problem.scene.machine.structure().coordinates) + np.arange(_loads_of(problem.scene).count)
    scale[turns] = 1.0

    def trial(x: np.ndarray, linear: np.ndarray, starts: tuple[np.ndarray, ...]) -> _Trial:
        total, prior, gradient = np.zeros((size + 2, size + 2)), np.zeros((size + 1, size + 1)), np.zeros(size + 1)
        start_changes = []
        for samples, indices, starts_of_run in zip(problem.runs, indices_of_runs, starts, strict=True):
            at = linearized(problem.unknowns, samples, problem.scene, x, linear[indices], starts_of_run)
            where = np.concatenate([np.arange(p), p + indices, [size, size + 1]])
            columns = weighted_columns(samples, at, at.columns)
            total[np.ix_(where, where)] += columns.T @ columns
            # The last unknown is the closed share of the gaps.
            total[size:, size:] += np.sum((at.gaps / (_GAP_SIZE * scale)) ** 2)
            start_changes.append(at.start_changes)
        prior[:size, :size], gradient[:size] = prior_equations(problem, x, linear)
        cost = float(total[-1, -1]) + known_cost(problem, x, linear)
        equations = total[:-1, :-1], prior, total[:-1, -1] + gradient
        return _Trial(x, linear, starts, tuple(start_changes), cost if np.isfinite(cost) else np.inf, equations)

    def stepped(at: _Trial, step: np.ndarray) -> _Trial:
        step = limited_step(problem, step)
        steps = (np.concatenate([step[:p], step[p + indices], step[size:]]) for indices in indices_of_runs)
        changes = [change @ each for change, each in zip(at.start_changes, steps, strict=True)]
        factor = min(1.0, _MAX_TURN / max(float(np.max(np.abs(each[:, turns]))) for each in changes))
        new = tuple(each + factor * change for each, change in zip(at.starts, changes, strict=True))
        return trial(at.x + factor * step[:p], at.linear + factor * step[p:size], new)

    first, tolerance = trial(x, linear, tuple(starts)), _REDUCTION_PER_READING * _reading_count(problem)
    return descend(first, lambda at: at.equations, stepped, size + 1, positive_indices(problem), tolerance=tolerance)[0]
