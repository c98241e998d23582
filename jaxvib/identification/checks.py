"""Checks of a fit: its status, and sentences for the reader."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.identification.directions import Information, eliminate, elimination
from jaxvib.identification.fit import Fitted, angle_shares, polar_unbalances, prior_equations, run_equations
from jaxvib.identification.records.orders import foreign_vibration
from jaxvib.identification.torque import MAX_MISFIT

SIGNIFICANCE_LEVEL = 1e-5
"""p-value below which residuals do not count as noise, and below which a run deviates from other runs. One test of a channel
searches for vibrations at orders of the rotor speed, a second one at orders of the speed of jammed loads. If the residuals are
pure noise, each of these tests causes the status `patterned` with this probability."""

_ANGLE_NAMES = ("the rotor's angle", "the angle of the jammed loads")

_SEGMENTS, _ORDERS = 16, 3
"""Number of equal segments of a record in which residuals are compared with noise, and number of orders of the rotor speed that
are compared."""

_CONTRADICTION = 4.0
"""Distance of a fitted value from its known value, in standard errors, above which the records contradict the known value."""

_ANGLE_SHARE = 0.1
"""Largest share of the residuals that errors of the rotor's angle may cause. Above it, intervals count as too narrow. Only
errors that are not unknowns of the fit count. The limit is small because these errors change slowly and do not average out like
noise."""

_COARSE_ANGLE = 0.3
"""Standard error of the rotor's angle, rad, above which the response is not linear in it."""

_DECAY_TIMES = 2.0
"""Duration of a run, in decay times of the mode that decays most slowly, below which a note says that it is short."""

_ROUNDING = 1e-12
"""Information of a part of the records about an unknown, relative to that of all records, that is a rounding error."""

_UNEXPLAINED = 0.5
"""Standard deviation of a channel's residuals, relative to that of its readings, above which the model does not resemble the
channel."""

_MIN_POWER_SHARE = 0.5
"""A note names a vibration if it has at least this share of the power of its signal."""

_NOISE_LIKE = 0.01
"""Smallest variance of residuals, relative to that of the readings, for which a note names a vibration of constant
frequency."""


class FitStatus(eqx.Enumeration):
    """Outcomes of a fit of a machine. The value of each member is the message shown to the user."""

    found = "the model explains the records; only noise remains"
    patterned = (
        "the residuals are not noise, or the rotor's angle is inaccurate: see the notes. The model lacks a part, the angle has "
        "errors, or the fit has ended at a wrong minimum, and the intervals are too narrow; plot the residuals over speed, and "
        "start from better values"
    )
    undetermined = "the records do not determine all unknowns: see `undetermined` for the directions and how to determine them"
    contradicted = (
        "the records contradict one another, the scene, a known value or the calibration of a sensor: the notes name what to "
        "check"
    )
    not_converged = (
        "no fit was found: the model does not resemble the records; check places and directions of the channels and the "
        "rotor's angle, or start from better values"
    )


def status_of(fitted: Fitted, information: Information) -> tuple[FitStatus, float, list[str]]:
    """Return the status of a fit, the smallest `residual_p_value` of its channels, and notes.

    **Arguments**: `fitted`, and the `information` about its parameters.
    """
    p_value, notes = 1.0, [*_contradictions(fitted), *_disagreements(fitted)]
    contradicted = bool(notes)
    coarse = [max(rotor.error for rotor in rotors) for rotors in fitted.problem.rotors]
    for k, error in enumerate(coarse):
        if error > _COARSE_ANGLE:
            notes.append(
                f"the rotor's angle in run {k + 1} has the standard error {error:.2g} rad between its pulses, and a fit may "
                "end at a wrong minimum: use more pulses per turn, or sample them faster"
            )
    is_inaccurate, has_fit = fitted.is_absorbed, resembles(fitted)
    if fitted.is_absorbed:
        notes.append(
            "the residuals vibrate at natural frequencies of the machine, and no noise model distinguishes such residuals from "
            "the motion of the machine; the noise is assumed to be white, and the intervals are too narrow: fit runs one by "
            "one, or record them again"
        )
    for k, misfit in enumerate(fitted.misfits):
        if misfit > MAX_MISFIT:
            is_inaccurate = True
            notes.append(
                f"the rotor in run {k + 1} deviates from the torque balance of its motor by {misfit:.3g} times the scatter of "
                "its angle: the torque of the motor has another form, or a torque is missing"
            )
    foreign = list(_foreign_vibrations(fitted, has_fit))
    notes += foreign
    shares = angle_shares(fitted)
    unknowns = fitted.problem.unknowns.count - fitted.problem.unknowns.errors  # errors of the angle have a known size
    for k, (samples, residuals) in enumerate(zip(fitted.problem.runs, fitted.residuals, strict=True)):
        for c, channel in enumerate(samples.channels):
            if shares[k][c] > _ANGLE_SHARE:
                is_inaccurate = True
                notes.append(
                    f"the intervals do not include an error of {fitted.problem.angle_errors[k]:.2g} rad of the rotor's angle "
                    f"in run {k + 1}, which causes {100.0 * shares[k][c]:.0f} % of the residuals of channel {channel.name!r}: "
                    "use more pulses per turn, or sample them faster"
                )
            if fitted.outliers[k][c]:
                notes.append(
                    f"{100.0 * fitted.outliers[k][c]:.1f} % of the readings of channel {channel.name!r} in run {k + 1} are "
                    "outliers, which have little influence"
                )
            angles = fitted.problem.angles[k].T
            for angle, whose in zip(angles if fitted.problem.has_loads else angles[:1], _ANGLE_NAMES, strict=False):
                one = residual_p_value(residuals[:, c], np.asarray(samples.taps)[:, c], angle, unknowns)
                if one < SIGNIFICANCE_LEVEL:
                    notes.append(f"the residuals of channel {channel.name!r} in run {k + 1} repeat with {whose}")
                p_value = min(p_value, one)
    if not has_fit and not foreign:
        return FitStatus.not_converged, p_value, notes
    if contradicted or not has_fit:
        return FitStatus.contradicted, p_value, notes
    if foreign or p_value < SIGNIFICANCE_LEVEL or is_inaccurate or max(coarse) > _COARSE_ANGLE:
        return FitStatus.patterned, p_value, notes
    return FitStatus.undetermined if information.undetermined.size else FitStatus.found, p_value, notes


def resembles(fitted: Fitted) -> bool:
    """Return True if the model resembles the records: the fit has converged, and the standard deviation of the residuals of at
    least one channel is at most half of that of its readings."""
    problem = fitted.problem
    shares = [
        np.std(residuals[mask[:, c], c]) / max(float(np.std(raw[mask[:, c], c])), 1e-300)
        for residuals, raw, mask in zip(fitted.differences, problem.raw, problem.masks, strict=True)
        for c in range(raw.shape[1])
    ]
    return fitted.converged and bool(min(shares) <= _UNEXPLAINED)


def _foreign_vibrations(fitted: Fitted, has_fit: bool) -> Iterator[str]:
    """Yield sentences about vibrations that are not at the rotor speed: in the residuals, or in the readings if there is
    no fit."""
    problem = fitted.problem
    # Further exciters, jammed loads and contacts cause vibrations at other speeds.
    if len(problem.unbalances) > 1 or (problem.linear is not None and not has_fit):
        return
    for k, (samples, raw, mask, residuals) in enumerate(
        zip(problem.runs, problem.raw, problem.masks, fitted.residuals, strict=True)
    ):
        for c, channel in enumerate(samples.channels):
            readings = np.where(mask[:, c], raw[:, c], np.nan)
            values = residuals[:, c] if has_fit else readings
            vibration = foreign_vibration(values, problem.angles[k][:, 0], float(samples.step))
            if vibration is None or vibration.share < _MIN_POWER_SHARE:
                continue
            if has_fit and vibration.order is None and np.nanvar(values) < _NOISE_LIKE * np.nanvar(readings):
                continue
            if problem.has_loads:
                reason = ": the motion of the loads is not that of the scene, or the fit has ended at a wrong minimum"
            else:
                reason = (
                    ", but an unbalance turns with the rotor: use the tachometer of the shaft that causes the vibration, or "
                    "leave out the part of the record in which loads are jammed or another machine runs"
                )
            what = f"the {'residuals' if has_fit else 'readings'} of channel {channel.name!r} in run {k + 1}"
            yield f"{100.0 * vibration.share:.0f} % of the power of {what} is {vibration.frequency_text}{reason}"


def residual_p_value(residuals: np.ndarray, taps: np.ndarray, angle: np.ndarray, fitted_count: int) -> float:
    """Return the probability that the vibrations of pure noise at orders of the rotor speed are at least as strong as those of
    the residuals.

    The residuals are whitened by a filter and compared with vibrations at the first orders of the rotor speed in each
    segment of the record, by an F test.

    **Arguments**: `residuals` (n,), NaN for samples that do not count; `taps` of the filter; `angle` (n,) rad; `fitted_count`:
    number of fitted unknowns.

    >>> angle, rng = np.linspace(0.0, 500.0, 4000), np.random.default_rng(0)
    >>> noise = rng.normal(size=4000)
    >>> bool(residual_p_value(noise, np.ones(1), angle, 4) > 1e-3)
    True
    >>> bool(residual_p_value(noise + 0.3 * np.cos(angle), np.ones(1), angle, 4) < 1e-9)
    True
    """
    from scipy.special import fdtrc  # slow to import

    white = np.convolve(np.where(np.isfinite(residuals), residuals, 0.0), taps)[: residuals.size]
    valid = np.convolve(~np.isfinite(residuals), np.ones(len(taps)))[: residuals.size] < 0.5
    valid[: len(taps) - 1] = False
    place = np.flatnonzero(valid)
    if place.size < 8 * _SEGMENTS * (2 * _ORDERS + 1) or not np.any(white[place]):
        return 1.0
    explained, columns = 0.0, 0
    for part in np.array_split(place, _SEGMENTS):
        waves = [np.ones(part.size)]
        for k in range(1, _ORDERS + 1):
            waves += [np.cos(k * angle[part]), np.sin(k * angle[part])]
        basis, triangle = np.linalg.qr(np.stack(waves, axis=1))
        independent = np.abs(np.diagonal(triangle)) > 1e-6 * math.sqrt(part.size)
        explained += float(np.sum((basis[:, independent].T @ white[part]) ** 2))
        columns += int(np.count_nonzero(independent))
    total, freedom = float(np.sum(white[place] ** 2)), max(columns - fitted_count, 1)
    free = place.size - columns
    return float(fdtrc(freedom, free, explained / freedom / ((total - explained) / free)))


def coverage_notes(fitted: Fitted, frequency: np.ndarray, damping_ratio: np.ndarray) -> Iterator[str]:
    """Yield sentences about runs that do not pass through a resonance, and about runs that are too short.

    **Arguments**: natural frequencies, rad/s, and damping ratios (m,) of the fitted machine.
    """
    problem, spans = fitted.problem, []
    for time, angle in zip(problem.times, problem.angles, strict=True):
        speed = np.abs(np.diff(angle, axis=0) / np.diff(time)[:, None])
        spans.append((float(np.min(speed)), float(np.max(speed))))
    if frequency.size and not any(low < w < high for low, high in spans for w in frequency):
        low, high, modes = min(spans)[0], max(each for _, each in spans), ", ".join(f"{w:.4g}" for w in frequency)
        yield (
            f"no run passes through a resonance: the rotors turn at {low:.3g} to {high:.3g} rad/s, and the natural frequencies "
            f"are {modes} rad/s; record a run through a resonance"
        )
    decays = damping_ratio > 0.0
    decay = np.max(1.0 / np.where(decays, damping_ratio * frequency, 1.0), where=decays, initial=0.0)
    longest = float(decay) if np.all(decays) else math.inf
    for k, time in enumerate(problem.times):
        duration = float(time[-1] - time[0])
        if duration < _DECAY_TIMES * longest:
            if math.isfinite(longest):
                reason = f"less than two decay times of the mode that decays most slowly ({longest:.3g} s each)"
                remedy = "record a longer run"
            else:
                reason, remedy = "and a mode of the fitted machine does not decay", "check its damping"
            yield (
                f"run {k + 1} lasts {duration:.3g} s, {reason}: its response cannot be distinguished from the free vibration "
                f"at its start; {remedy}"
            )


def _contradictions(fitted: Fitted) -> Iterator[str]:
    """Yield sentences about known values that the records contradict."""
    problem = fitted.problem
    unknowns = problem.unknowns
    names = [*(number.name for number in unknowns.numbers), *(f"the gain of channel {name!r}" for name in unknowns.gains)]
    for name, x, mean, precision in zip(names, fitted.x, problem.means, problem.precisions, strict=False):
        distance = abs(x - mean) * math.sqrt(precision)
        if distance > _CONTRADICTION:
            yield f"{name} is {distance:.1f} standard errors away from its known value"
    for k, known in enumerate(problem.unbalances):
        if known is not None:
            distance = abs(float(np.hypot(*fitted.linear[2 * k : 2 * k + 2])) - known.value) / known.error
            if distance > _CONTRADICTION:
                yield f"exciters[{k}].unbalance is {distance:.1f} standard errors away from its known value"


class Disagreement(NamedTuple):
    """Deviation of a run from other runs.

    **Attributes**: `p_value`: probability of a deviation at least as large as this one if the machine is the same; `name` of
    the parameter whose change explains most of the deviation; `change` of this parameter, relative (of an angle: in rad), and
    its standard `error`.
    """

    p_value: float
    name: str
    change: float
    error: float

    def sentence(self, run: str) -> str:
        """Return the deviation of a run as a sentence."""
        kind = "change" if "(rad)" in self.name else "relative change"
        return (
            f"{run} deviates from the others by more than their errors (p-value {self.p_value:.1g}); a {kind} of {self.name} "
            f"by {self.change:+.3g} +- {1.96 * self.error:.1g} explains most of it"
        )


def disagreement(others: np.ndarray, run: np.ndarray, gradient: np.ndarray, names: Sequence[str]) -> Disagreement:
    """Return the deviation of a run from other runs, by a likelihood-ratio test of two models: either the run has parameters of
    its own, or all runs have the same parameters.

    **Arguments**: information (k, k) of the `others` and of the `run`, about relative changes of k parameters; `gradient` of
    the run, J^T residuals/noise^2, at the parameters that fit the others and the run together; `names` (k,).

    >>> others, run = np.array([[400.0]]), np.array([[100.0]])    # estimates 0 +- 0.05 and 0.6 +- 0.1; of all runs 0.12
    >>> found = disagreement(others, run, 100.0 * np.array([0.6 - 0.12]), ["mass"])
    >>> bool(abs(found.change - 0.6) < 1e-12), bool(abs(found.error**2 - 0.1**2 - 0.05**2) < 1e-12), found.p_value < 1e-7
    (True, True, True)
    """
    from scipy.special import chdtrc  # slow to import

    run, others = (_without_rounding(each, np.diagonal(others + run)) for each in (run, others))
    (of_run, rank_of_run), (of_others, rank_of_others), (of_all, rank_of_all) = (
        pseudoinverse(run),
        pseudoinverse(others),
        pseudoinverse(others + run),
    )
    freedom, size = rank_of_run + rank_of_others - rank_of_all, np.diagonal(others + run)
    shared = np.diagonal(others @ of_all @ run)  # information about the difference between the run and the others
    information = np.where(shared > 1e-9 * size, shared, np.inf)
    largest = int(np.argmax(gradient**2 / information))
    if freedom < 1 or not np.isfinite(information[largest]):
        return Disagreement(1.0, names[largest], 0.0, math.inf)
    statistic = float(gradient @ (of_run + of_others) @ gradient)
    change, error = gradient[largest] / information[largest], 1.0 / math.sqrt(information[largest])
    return Disagreement(float(chdtrc(freedom, statistic)), names[largest], float(change), float(error))


def _without_rounding(information: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the information of a part of the records with zeros for unknowns about which it contains rounding errors only.

    Such an unknown is the angle of the unbalance in a run with an unknown zero of the rotor's angle. Its diagonal has either
    sign, and would count as information after it is scaled to 1.

    **Arguments**: `size` (k,): diagonal of the information of all records.
    """
    is_rounding = np.diagonal(information) <= _ROUNDING * size
    return np.where(is_rounding[:, None] | is_rounding, 0.0, information)


def pseudoinverse(matrix: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the pseudoinverse of an information matrix, computed with a diagonal scaled to 1, and its rank."""
    size = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T) / np.outer(size, size))
    determined = values > 1e-10 * max(float(values[-1]), 1e-300)
    root = vectors[:, determined] / size[:, None]
    return (root / values[determined]) @ root.T, int(np.count_nonzero(determined))


def _disagreements(fitted: Fitted) -> Iterator[str]:
    """Yield sentences about runs that contradict the other runs."""
    problem, unknowns, p = fitted.problem, fitted.problem.unknowns, fitted.x.size
    if len(problem.runs) < 2:
        return
    exciters = range(len(problem.unbalances))
    kept = np.array([*range(p - unknowns.turns - unknowns.errors), *range(p, p + 2 * len(exciters))])
    names = [*(number.name for number in unknowns.numbers), *(f"the gain of channel {name!r}" for name in unknowns.gains)]
    names += [f"{what} exciters[{k}].unbalance" for k in exciters for what in ("the size of", "the angle (rad) of")]
    jacobian, _ = polar_unbalances(problem, fitted.linear)
    parts = []
    equations = [(each[:-1, :-1], each[:-1, -1]) for each in run_equations(problem, fitted.x, fitted.linear)]
    for matrix, gradient in (*equations, prior_equations(problem, fitted.x, fitted.linear)):
        polar = jacobian.T @ matrix @ jacobian
        parts.append((eliminate(polar, kept), elimination(polar, kept).T @ (jacobian.T @ gradient)))
    total, gradient_sum = (np.sum(each, axis=0) for each in zip(*parts, strict=True))
    # Remaining step from the fitted values to the minimum: it matters for a run with much less information than the others.
    step = pseudoinverse(total)[0] @ gradient_sum
    for k, (part, gradient) in enumerate(parts[:-1]):
        deviation = disagreement(total - part, part, gradient - part @ step, names)
        if deviation.p_value < SIGNIFICANCE_LEVEL:
            yield deviation.sentence(f"run {k + 1}")
