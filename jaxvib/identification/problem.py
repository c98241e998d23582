"""Least-squares problem of an identification: unknowns, known values, and the samples of all runs on even grids."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import linear_model
from jaxvib.errors import InputError, quoted
from jaxvib.identification.angle import RotorAngle, rotor_angles
from jaxvib.identification.jammed.segments import divide
from jaxvib.identification.records.agreement import ROTOR_KINDS, turn_speed
from jaxvib.identification.records.channel import Channel, gain_errors
from jaxvib.identification.records.decimation import MIN_SAMPLES, decimated
from jaxvib.identification.response import BLOCK, SEGMENT, Samples, Unknowns, rows_of_channel, state_count
from jaxvib.identification.run import MeasuredRun
from jaxvib.machine.effects.base import has_term, terms_of
from jaxvib.machine.effects.supports import FrictionSupport, Stop
from jaxvib.machine.effects.terms import ContactFriction, GravityField, LoadResistance, SupportForce, Term
from jaxvib.machine.numbers.named import NamedNumber, find_number, present_numbers, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import require_double
from jaxvib.numerics.linalg import poles_of
from jaxvib.numerics.noise import Noise, bounded, limited
from jaxvib.runtime.programs import cached
from jaxvib.units import Bounds, Number

MOTIONS = ("acceleration", "velocity", "displacement", "force")
"""Kinds of channels that are compared with the model."""

UNUSED = ("torque", "current")
"""Kinds of channels that a fit does not use."""

_MAX_UNEVENNESS = 0.02
"""Largest deviation of a sample from the even grid, in steps."""

EXACT = 1e-4
"""Relative standard error that an exactly known unbalance has in a fit, in place of 0."""

_FILTER_LENGTHS = (1, 9, 49, 129, 513)
"""Lengths to which filters are extended with zeros, so that filters of nearly equal length share a program."""

_FREQUENCY_MARGIN, _SPEED_TIMES = 1.5, 64
"""Factor on the highest natural frequency, and number of times at which the speed of a drive is evaluated, for the choice of a
sampling rate."""

DELAY_MARGIN = 2
"""Number of steps by which both readings and model are delayed, so that the interpolation has samples on both sides."""

_MAX_DELAY = 450
"""Largest delay of readings in steps. The longest filter must contain this delay and a whitening filter."""


_LEAST_RELATIVE_ERROR = 1e-12
"""Relative standard error up to which a value counts as exactly known. With a smaller one, 1/error^2 would be so large that its
rounding errors hide the information of the readings."""


class Known(NamedTuple):
    """Known parameter: its `value`, SI, and its standard `error`, SI, 0 if it is exact."""

    value: float
    error: float

    @property
    def is_exact(self) -> bool:
        """True for a parameter without an error. An exactly known unbalance has the relative error `EXACT` instead of 0."""
        return self.error <= 1.001 * EXACT * abs(self.value)


class Problem(NamedTuple):
    """Least-squares problem of an identification.

    **Attributes** (p unknowns x, E exciters, C channels, n samples)

    - `scene` with the known values; `unknowns`, see `Unknowns`
    - `runs`: the samples of each run, padded to whole segments
    - for each run, without the padding: `masks` (n, C), True for samples that count; `raw` (n, C), readings without a filter;
      `bounds` (n, C), 1 for readings clipped at the upper end of the range, -1 at the lower end, otherwise 0; `times` (n,), s;
      `angles` of the rotors (n, E), rad
    - `rotors`: for each run, the angles of the rotors as functions of time
    - `means` and `precisions` (p,): known values of x, and 1/error^2 of these values; both are 0 for a free parameter
    - `marked`: True if the zero of the rotor's angle is the same mark in all runs
    - `unbalances`: for each exciter its known value, None if it is free
    - `angle_errors`, rad: for each run, the part of the standard error of the rotor's angle that no unknown describes
    - `notes`: sentences for the reader
    - `linear` (L,), for a motion with loads or on nonlinear supports: first values of the initial states, unbalances and
      offsets. The readings are not linear in these unknowns. None for a linear response, whose readings are linear in them
    - `load_spread` (L, L): information from the assumption that all loads of a run have nearly the same angle and speed at the
      first sample; None without loads
    """

    scene: Scene
    unknowns: Unknowns
    runs: tuple[Samples, ...]
    masks: tuple[np.ndarray, ...]
    raw: tuple[np.ndarray, ...]
    bounds: tuple[np.ndarray, ...]
    times: tuple[np.ndarray, ...]
    angles: tuple[np.ndarray, ...]
    rotors: tuple[tuple[RotorAngle, ...], ...]
    means: np.ndarray
    precisions: np.ndarray
    marked: bool
    unbalances: tuple[Known | None, ...]
    angle_errors: tuple[float, ...]
    notes: tuple[str, ...]
    linear: np.ndarray | None = None
    load_spread: np.ndarray | None = None

    @property
    def has_loads(self) -> bool:
        """True for loads that move on the rotor."""
        return has_loads(self.scene)


def read_known(text: Number, number: NamedNumber, field: str) -> Known:
    """Return a known value with its standard error: "95 kg", "95 kg +- 1 %" or "95 kg +- 0.5 kg".

    The number after the sign is the standard error. An error of at most 1e-12 of the value counts as 0.
    """
    parts = re.split(r"\+-|\+/-|±", text) if isinstance(text, str) else []
    if not isinstance(text, str) or len(parts) < 2:
        return Known(number.value(text, field), 0.0)
    value = number.value(parts[0].strip(), field)
    if len(parts) > 2:
        raise InputError(field, f"is {quoted(text)}; write for example '95 kg +- 1 %'")
    error = parts[1].strip()
    if error.endswith("%"):
        try:
            size = abs(value) * float(error[:-1]) / 100.0
        except ValueError as problem:
            raise InputError(field, f"is {quoted(text)}; write for example '95 kg +- 1 %'") from problem
    else:
        size = float(_unbounded(number).value(error, field))
    if not 0.0 <= size < math.inf:
        raise InputError(field, f"is {quoted(text)}; the standard error after +- must be a finite number, at least 0")
    return Known(value, size if size > _LEAST_RELATIVE_ERROR * abs(value) else 0.0)


def _unbounded(number: NamedNumber) -> NamedNumber:
    """Return the parameter without bounds, to read a difference of its values."""
    return number._replace(spec=number.spec._replace(bounds=Bounds()))


def build_problem(scene: Scene, runs: Sequence[MeasuredRun], unknown: Sequence[str], known: Mapping[str, Number]) -> Problem:
    """Return the least-squares problem of an identification.

    **Raises** `InputError` for unknowns that the scene does not have; for loads, effects and motors that are not included; for
    runs without a usable channel; and if JAX computes in single precision.
    """
    scene = require_double(scene, "an identification")
    _require_included(scene, runs)
    if isinstance(unknown, str) or not unknown:
        raise InputError("unknown", f"is {quoted(unknown)}; it must be a list of names, such as ['machine.stiffness']")
    numbers = _single_numbers(scene, unknown)
    known_numbers = {
        number.name: (number, read_known(text, number, f"known[{name!r}]"))
        for name, text in known.items()
        for number in _single_numbers(scene, [name], "known")
    }
    fixed = [(number, each) for number, each in known_numbers.values() if each.error == 0.0]
    if fixed:
        scene = put_numbers(scene, [number for number, _ in fixed], np.array([each.value for _, each in fixed]))
    free = {number.name: number for number in numbers if number.name not in {each.name for each, _ in fixed}}
    free |= {name: number for name, (number, each) in known_numbers.items() if each.error > 0.0}
    _require_torque_balance(scene, free, runs)
    nonlinear = [number for number in free.values() if number.path[-1] != "unbalance"]
    unbalances = tuple(_known_unbalance(scene, k, free, known_numbers) for k in range(len(scene.exciters)))

    if not nonlinear and all(known is not None and known.is_exact for known in unbalances):
        raise InputError("unknown", f"is {quoted(unknown)}; these parameters are exactly known, and nothing is left to find")

    values = np.array([float(number.read(scene)[0]) for number in nonlinear])
    positive = (values > 0.0) & np.array([number.spec.bounds.low == 0.0 for number in nonlinear], bool)
    scale = np.where(values != 0.0, np.abs(values), [number.spec.typical or 1.0 for number in nonlinear])
    means, errors = _known_means(nonlinear, known_numbers, values, positive, scale)

    runs = [_with_reduced_rate(scene, run) for run in runs]
    notes = [note for run in runs for note in run.notes]
    notes += [f"{run.source}: channel {c.name!r} of kind {c.kind} is not used" for run in runs for c in run.of_kind(*UNUSED)]
    angles = [rotor_angles(_changed_scene(scene, run), run) for run in runs]
    notes += [note for each in angles for angle in each for note in angle.notes]
    marked = [all(angle.marked for angle in each) for each in angles]
    gains = gain_errors(channel for run in runs for channel in run.of_kind(*MOTIONS))
    # With several exciters, each drive's schedule fixes its angle in every run.
    turns = [k for k, is_marked in enumerate(marked) if k and not (is_marked and marked[0]) and len(scene.exciters) == 1]
    arrays = jnp.asarray(values), jnp.asarray(scale), jnp.asarray(positive)
    unknowns = Unknowns(tuple(nonlinear), *arrays, tuple(gains), len(turns))
    cases = enumerate(zip(runs, angles, strict=True))
    prepared = [_samples(scene, run, angle, turns.index(k) if k in turns else None) for k, (run, angle) in cases]
    samples, masks, raw, bounds, times, turned = zip(*prepared, strict=True)
    errors = np.concatenate([errors, list(gains.values()), np.full(len(turns), np.inf)])
    return Problem(
        scene,
        unknowns,
        samples,
        masks,
        raw,
        bounds,
        times,
        turned,
        tuple(map(tuple, angles)),
        means=np.concatenate([means, np.zeros(len(gains) + len(turns))]),
        precisions=1.0 / errors**2,
        marked=all(marked),
        unbalances=unbalances,
        angle_errors=tuple(max(angle.error for angle in each) for each in angles),
        notes=tuple(dict.fromkeys(notes)),
    )


def _known_means(
    nonlinear: Sequence[NamedNumber],
    known_numbers: Mapping[str, tuple[NamedNumber, Known]],
    values: np.ndarray,
    positive: np.ndarray,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means and standard errors of the unknowns whose values are known with an error; 0 and infinity for others.

    **Raises** `InputError` for the value 0 of a positive parameter, whose logarithm is the unknown.
    """
    means, errors = np.zeros(len(nonlinear)), np.full(len(nonlinear), np.inf)
    for k, number in enumerate(nonlinear):
        if number.name in known_numbers and known_numbers[number.name][1].error > 0.0:
            each = known_numbers[number.name][1]
            if positive[k] and each.value == 0.0:
                problem = "is 0 with an error; the value of a parameter that cannot be negative must be above 0"
                raise InputError(f"known[{number.name!r}]", f"{problem}: give a positive value, or 0 without an error")
            means[k] = math.log(each.value / values[k]) if positive[k] else (each.value - values[k]) / scale[k]
            errors[k] = each.error / each.value if positive[k] else each.error / scale[k]
    return means, errors


def is_of_drive(number: NamedNumber) -> bool:
    """Return True for a parameter of a drive."""
    return number.path[0] == "exciters" and "drive" in number.path


def _require_torque_balance(scene: Scene, free: Mapping[str, NamedNumber], runs: Sequence[MeasuredRun]) -> None:
    """Raise if the records do not determine an unknown parameter of a drive."""
    drive, measured = scene.exciters[0].drive, all(run.of_kind(*ROTOR_KINDS) for run in runs)
    if len(scene.exciters) == 1 and not drive.ideal and not drive.state_units() and measured and not is_nonlinear(scene):
        return
    for name, number in free.items():
        if is_of_drive(number):
            raise InputError(
                f"unknown.{name}",
                "is a parameter of the drive, which these records do not determine; leave it out. Parameters of a drive can be "
                "unknown only if it is a motor without currents as states, the scene has one exciter, no loads and linear "
                "supports, and each run has a channel of pulses, angle or speed",
            )


def _with_reduced_rate(scene: Scene, run: MeasuredRun) -> MeasuredRun:
    """Return a long run with its sampling rate reduced to what the highest frequency needs; return other runs unchanged.

    The natural frequencies are increased by a margin, because they are computed with the first values of the unknowns. Runs
    with a stop or with friction at a support are not changed, because contacts and friction change accelerations faster than
    the highest natural frequency.
    """
    is_smooth = all(term.is_smooth for term in terms_of(scene.effects, SupportForce))
    if not is_smooth or max(time.size for time in run.times.values()) < MIN_SAMPLES:
        return run
    if channel := run.rotor_channel:
        speeds = turn_speed(channel, run.times[channel.name], run.values[channel.name])[1]
        fastest = float(np.quantile(np.abs(speeds), 0.999))
    else:
        times = jnp.linspace(*run.span, _SPEED_TIMES)
        drives = [exciter.drive for exciter in scene.exciters if exciter.drive.ideal]
        speeds = [jax.vmap(lambda t, drive=drive: drive.rotor_speed(t, None))(times) for drive in drives]
        fastest = float(np.max(np.abs(np.asarray(speeds)), initial=0.0))
    return decimated(run, max(fastest, _FREQUENCY_MARGIN * float(np.max(damped_modes(scene)[0], initial=0.0)), 1e-300))


def has_loads(scene: Scene) -> bool:
    """Return True if an exciter has loads that move on its rotor."""
    return any(exciter.loads is not None for exciter in scene.exciters)


def is_nonlinear(scene: Scene) -> bool:
    """Return True for a scene whose motion is not linear in its state and its unbalance: with loads or nonlinear supports."""
    return has_loads(scene) or has_nonlinear_supports(scene)


def has_nonlinear_supports(scene: Scene) -> bool:
    """Return True if a scene has nonlinear supports, such as stops."""
    return has_term(scene.effects, SupportForce)


def require_linear_motion(scene: Scene, function: str) -> None:
    """Raise for a scene with loads or nonlinear supports in a `function` that does not include them."""
    if is_nonlinear(scene):
        what = "loads that move on the rotor" if has_loads(scene) else "nonlinear supports"
        raise InputError("fit.scene", f"has {what}; {function} needs linear supports and exciters with an unbalance only")


def _require_included(scene: Scene, runs: Sequence[MeasuredRun]) -> None:
    """Raise for parts of a scene that an identification does not include."""
    is_alone = len(scene.exciters) == 1
    if has_loads(scene) and not is_alone:
        problem = f"has {len(scene.exciters)} exciters, one of them with loads; identify needs loads to be on the only exciter"
        raise InputError("scene", problem)
    for exciter in scene.exciters:
        if exciter.loads is not None and not exciter.loads.circular:
            problem = f"is of kind {exciter.loads.kind!r}; identify needs loads on a circle: balls, rollers or pendulums"
            raise InputError("scene.loads", problem)
    for effect in scene.all_effects:
        kind, terms = f"effects.{effect.kind}", effect.terms()
        is_smooth = all(isinstance(term, SupportForce) and term.is_smooth for term in terms)
        is_support = is_smooth or isinstance(effect, (Stop, FrictionSupport))
        if is_support and (has_loads(scene) or not is_alone):
            raise InputError(kind, "is a nonlinear support; identify includes it only in scenes with one exciter without loads")
        if is_support and any(run.of_kind("force") for run in runs):
            raise InputError(
                kind,
                "is a nonlinear support, which the model of a 'force' channel does not contain; leave out the channel",
            )
        is_friction = has_loads(scene) and all(_resists_loads(term) for term in terms)
        if not is_support and not is_friction and not has_term([effect], GravityField):
            raise InputError(
                kind,
                "is not included in identify, which allows gravity, friction of loads, cubic supports, stops and supports with "
                "dry friction; remove the effect",
            )
    if any(scene.machine.mounting(exciter.place).gyroscopic is not None for exciter in scene.exciters):
        raise InputError(
            "scene.machine", f"is of kind {scene.machine.kind!r} with gyroscopic forces, which identify does not include"
        )


def _resists_loads(term: Term) -> bool:
    """Return True for a term that dissipates energy of loads, and is smooth while they slip against the rotor."""
    return isinstance(term, ContactFriction) or (isinstance(term, LoadResistance) and term.is_smooth)


def _single_numbers(scene: Scene, names: Sequence[str], field: str = "unknown") -> list[NamedNumber]:
    """Return the named parameters, each entry of a named array as one parameter. Entries 0 of an array of springs or dampers
    are left out, because these parts are absent."""
    singles: dict[str, NamedNumber] = {}
    for name in names:
        for part in present_numbers(scene, find_number(scene, name, field), field):
            singles |= {each.name: each for each in part.single(scene)}
    return list(singles.values())


def _known_unbalance(
    scene: Scene, k: int, free: Mapping[str, NamedNumber], known_numbers: Mapping[str, tuple[NamedNumber, Known]]
) -> Known | None:
    if scene.exciters[k].unbalance is None:
        return Known(1.0, EXACT)  # any unbalance, because it has no effect
    number = find_number(scene, f"exciters[{k}].unbalance", "unknown")
    if number.name in known_numbers and known_numbers[number.name][1].error > 0.0:
        return known_numbers[number.name][1]
    value = float(number.read(scene)[0])
    return None if number.name in free else Known(value, EXACT * value)


def _changes(scene: Scene, run: MeasuredRun) -> tuple[list[NamedNumber], list[str], list[float]]:
    """Return the changed parameters of a run, the actions, and their amounts (SI, or a factor).

    **Raises** `InputError` for a change of an unbalance, because all runs share the unknown unbalance.
    """
    numbers, actions, amounts = [], [], []
    for name, change in run.change.items():
        for number in _single_numbers(scene, [name], "change"):
            if number.path[-1] == "unbalance":
                problem = "is an unbalance, which must be the same in all runs; fit runs with other unbalances on their own"
                raise InputError(f"{run.source}: change[{name!r}]", problem)
            amount = change.amount if change.action == "scale" else _unbounded(number).value(change.amount, f"change[{name!r}]")
            numbers.append(number)
            actions.append(change.action)
            amounts.append(float(amount))
    return numbers, actions, amounts


def _changed_scene(scene: Scene, run: MeasuredRun) -> Scene:
    numbers, actions, amounts = _changes(scene, run)
    for number, action, amount in zip(numbers, actions, amounts, strict=True):
        now = np.asarray(number.read(scene))
        new = {"add": now + amount, "scale": now * amount, "set": np.full_like(now, amount)}[action]
        number.value(float(new[0]), f"{run.source}: change of {number.name}")  # raises for a value out of bounds
        scene = put_numbers(scene, (number,), new)
    return scene


def with_angle_errors(problem: Problem, is_included: Sequence[bool]) -> Problem:
    """Return the problem with the errors of the rotor's angle as further unknowns, which have the standard normal distribution.

    **Arguments**: `is_included`: for each run, True if its errors become unknowns.
    """
    first, samples, left_out = problem.unknowns.count, list(problem.runs), list(problem.angle_errors)
    count = 0
    for k, (of_run, rotors, included) in enumerate(zip(problem.runs, problem.rotors, is_included, strict=True)):
        if included:
            first_error, errors = first + count, max(rotor.error_count for rotor in rotors)
            drives = tuple(rotor.drive for rotor in rotors)
            samples[k] = dataclasses.replace(of_run, drives=drives, errors=(first_error, errors))
            left_out[k], count = max(rotor.left_out for rotor in rotors), count + errors
    return problem._replace(
        unknowns=dataclasses.replace(problem.unknowns, errors=count),
        runs=tuple(samples),
        means=np.concatenate([problem.means, np.zeros(count)]),
        precisions=np.concatenate([problem.precisions, np.ones(count)]),
        angle_errors=tuple(left_out),
    )


def _samples(
    scene: Scene, run: MeasuredRun, angles: Sequence[RotorAngle], turn: int | None
) -> tuple[Samples, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the samples of a run, and its entries of `masks`, `raw`, `bounds`, `times` and `angles` of `Problem`.

    **Arguments**: `angles` of the rotors; `turn`: see `Samples`.
    """
    channels = run.of_kind(*MOTIONS)
    if not channels:
        kinds = f"{', '.join(MOTIONS[:-1])} or {MOTIONS[-1]}"
        raise InputError(run.source, f"has no channel that the model can be compared with; add a channel of kind {kinds}")
    axes = scene.machine.mounting().axes
    for channel in channels:
        rows_of_channel(scene, channel)  # raises for a place that the machine does not have
        if not any(channel.direction[axis] for axis in axes):
            moves = " and ".join(("horizontally", "vertically")[axis] for axis in axes)
            problem = f"is {channel.direction}, but the machine moves {moves} only; correct it, or leave out the channel"
            raise InputError(f"{run.source}: channel {channel.name!r}: direction", problem)
    step = min(1.0 / run.rate(channel.name) for channel in channels)
    begin = max([min(float(run.times[c.name][0]) for c in channels), *(angle.span[0] for angle in angles)])
    end = min([max(float(run.times[c.name][-1]) for c in channels), *(angle.span[1] for angle in angles)])
    origin = float(run.times[channels[0].name][0])
    first = math.ceil((begin - origin) / step - _MAX_UNEVENNESS)
    count = math.floor((end - origin) / step + _MAX_UNEVENNESS) - first + 1
    if count < 4 * (state_count(scene, channels) + 2):
        raise InputError(
            run.source,
            f"has {max(count, 0)} samples while the angle of the rotor is known; record more, or check the times",
        )
    segment = min(SEGMENT, max(BLOCK, 2 ** math.ceil(math.log2(count))))
    segments = -(-count // segment)
    time = origin + step * (first + np.arange(count))
    raw, mask, bounds = _on_grid(run, channels, time)
    numbers, actions, amounts = _changes(scene, run)
    largest = _largest_readings(channels, raw, mask)
    samples = Samples(
        drives=tuple(angle.without_errors() for angle in angles),
        begin=jnp.asarray(time[0]),
        end=jnp.asarray(time[-1]),
        readings=jnp.zeros((segments, segment, len(channels))),
        weights=jnp.zeros((segments, segment, len(channels))),
        taps=jnp.ones((1, len(channels))),
        step=jnp.asarray(step),
        amounts=jnp.asarray(np.array(amounts)),
        channels=channels,
        changed=tuple(numbers),
        actions=tuple(actions),
        turn=turn,
        segments=divide(_changed_scene(scene, run), count, step, largest) if is_nonlinear(scene) else (0, 0, 0),
        guide=jnp.zeros((state_count(scene, channels), len(channels))) if has_nonlinear_supports(scene) else None,
    )
    return samples, mask, raw, bounds, time, np.stack([angle.at(time) for angle in angles], axis=1)


def _largest_readings(channels: Sequence[Channel], raw: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Return, for each kind of channels, half of the largest range of the readings of a channel, in SI."""
    ranges: dict[str, float] = {}
    for channel, values, used in zip(channels, raw.T, mask.T, strict=True):
        ranges[channel.kind] = max(ranges.get(channel.kind, 0.0), 0.5 * float(np.ptp(values[used])))
    return ranges


def _on_grid(run: MeasuredRun, channels: Sequence[Channel], time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the readings (n, C) of channels at even times (n,), the mask of those that count, and their bounds."""
    count, step = time.size, (time[-1] - time[0]) / (time.size - 1)
    raw, mask = np.zeros((count, len(channels))), np.zeros((count, len(channels)), bool)
    bounds = np.zeros((count, len(channels)), np.int8)
    for k, channel in enumerate(channels):
        values, clipped = run.values[channel.name], run.clipped[channel.name]
        position = (run.times[channel.name] - time[0]) / step
        index = np.rint(position).astype(int)
        if np.max(np.abs(position - index)) > _MAX_UNEVENNESS:
            raise InputError(
                f"{run.source}: channel {channel.name!r}",
                f"is not sampled on the even grid of the others ({1.0 / step:.6g} Hz); resample it to this grid",
            )
        earliest = max(math.ceil(channel.delay / step - _MAX_UNEVENNESS), 0)  # the motion before the first sample is unknown
        used = np.isfinite(values) & (index >= earliest) & (index < count)
        raw[index[used], k], mask[index[used], k] = values[used], ~clipped[used]
        if not np.any(mask[:, k]):
            problem = "has no unclipped reading while the motion is known; correct its range or delay, or leave it out"
            raise InputError(f"{run.source}: channel {channel.name!r}", problem)
        bounded_by = index[used & clipped]
        bounds[bounded_by, k] = np.sign(raw[bounded_by, k] - np.median(values[used]))
    return raw, mask, bounds


def with_noise(problem: Problem, noise: Sequence[Sequence[Noise]], differences: Sequence[np.ndarray] | None = None) -> Problem:
    """Return the problem with readings and models filtered such that the noise of the readings is white.

    **Arguments**: `noise` of the channels of each run; `differences` (n, C) of each run: readings minus model at the values
    of the previous fit. The influence of outliers and of clipped readings follows from them. Without them (None), outliers
    count like other readings, and clipped readings are not used.
    """
    runs = []
    for r, (samples, mask, raw, of_channels) in enumerate(zip(problem.runs, problem.masks, problem.raw, noise, strict=True)):
        delayed = any(channel.delay != 0.0 for channel in samples.channels)
        filters = []
        for channel, each in zip(samples.channels, of_channels, strict=True):
            shift, lag = (np.ones(1), np.ones(1)) if not delayed else _delay_taps(channel.delay / float(samples.step))
            filters.append((np.convolve(each.taps, shift), np.convolve(each.taps, lag)))
        longest = next(n for n in _FILTER_LENGTHS if n >= max(len(taps) for pair in filters for taps in pair))
        shape, n = samples.readings.shape, raw.shape[0]
        readings, weights = np.zeros((shape[0] * shape[1], raw.shape[1])), np.zeros((shape[0] * shape[1], raw.shape[1]))
        for k, ((data, model), each) in enumerate(zip(filters, of_channels, strict=True)):
            readings[:n, k] = np.convolve(raw[:, k], data)[:n]
            valid = mask[:, k].copy()
            for j in np.flatnonzero(data):
                if j:
                    valid[j:] &= mask[:-j, k]
            valid[: max(len(data), len(model)) - 1] = False
            weights[:n, k] = valid / each.deviation
            if differences is None:
                continue
            if each.outliers:
                white = np.convolve(differences[r][:, k], data)[:n] / each.deviation
                shifted, factor = limited(white, valid, each.outliers, each.width)
                readings[:n, k] += np.where(valid, each.deviation * (shifted - white), 0.0)
                weights[:n, k] /= factor
            if longest == 1:  # the bound of a reading contains little information if the noise is coloured
                at = np.flatnonzero(problem.bounds[r][:, k])
                side = problem.bounds[r][at, k]
                shifted, weight = bounded(side * differences[r][at, k] / each.deviation)
                readings[at, k] += side * each.deviation * shifted - differences[r][at, k]
                weights[at, k] = weight / each.deviation
        padded = np.stack([np.pad(taps, (0, longest - len(taps))) for _, taps in filters], axis=1)
        runs.append(
            dataclasses.replace(
                samples,
                readings=jnp.asarray(readings.reshape(shape)),
                weights=jnp.asarray(weights.reshape(shape)),
                taps=jnp.asarray(padded),
            )
        )
    return problem._replace(runs=tuple(runs))


def channel_sizes(problem: Problem) -> list[list[float]]:
    """Return the standard deviation of the readings of each run's channels, 1 for a channel with constant readings."""
    return [
        [float(np.std(raw[mask[:, k], k])) or 1.0 if np.any(mask[:, k]) else 1.0 for k in range(raw.shape[1])]
        for raw, mask in zip(problem.raw, problem.masks, strict=True)
    ]


def _delay_taps(delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the filters of the readings and of the model for a delay of the readings in steps: interpolation of degree 5.

    The filter of the readings delays them by two steps, and the filter of the model delays the model by two steps more than
    `delay`, because the interpolation needs samples on both sides.
    """
    late = delay + DELAY_MARGIN
    base = math.floor(late) - 2
    if not 0 <= base <= _MAX_DELAY:
        problem = f"is {delay:g} sampling steps; it must be between 0 and {_MAX_DELAY}"
        raise InputError("delay", f"{problem}: shift the times of the channel instead")
    nodes = np.arange(base, base + 6)
    weights = np.array([np.prod([(late - b) / (a - b) for b in nodes if b != a]) for a in nodes])
    return np.eye(DELAY_MARGIN + 1)[-1], np.concatenate([np.zeros(base), weights])


@cached
def _matrices(scene: Scene) -> tuple[Array, Array, Array]:
    """Return the matrices (nd, nd) of mass, damping and stiffness of the linear model."""
    model = linear_model(scene)
    return model.mass, model.carrier.damping, model.carrier.stiffness


def damped_modes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the natural frequencies (k,) rad/s and damping ratios (k,) of the damped modes with complex eigenvalues."""
    poles = poles_of(*_matrices(scene))
    poles = poles[poles.imag > 0.0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles), -poles.real / np.abs(poles)
