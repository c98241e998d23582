"""Identification of the friction of a bearing from the recorded swing of a pendulum on it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto
from jaxvib.errors import ComputationError, InputError
from jaxvib.numerics.noise import colored_covariance
from jaxvib.results.estimate import Estimate, interval, shown, student_quantile
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.study.bearing.decrement import Decrement, TurningPoints, require_uncertainty, ten_periods, turning_points
from jaxvib.study.bearing.fit import TOLERANCE, Fit, Unknowns, first_guess, fit_swing, steps_for
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum, Friction

_MAX_HALF_PERIODS = 1.3
"""Longest time, in half periods, between an end of the record and the next turning point, if the pendulum swings (a swing needs
at most 1.2). If the time is longer, the record begins before the release, or ends with the pendulum at rest."""

_PATTERN_PROBABILITY = 1e-5
"""Probability with which the F test of residuals that are pure noise gives the status `patterned`."""

_MAX_FREQUENCY_DIFFERENCE = 0.05
"""Largest relative difference between the fitted frequency and that of the pendulum, in addition to the argument `instrument`.
A larger difference gives the status `contradicted`."""


class IdentifyStatus(eqx.Enumeration):
    """Outcomes of a fit. The value of each member is the message shown to the user."""

    found = "the fit explains the record; only noise remains"
    patterned = "the residuals of the fit are not noise: the friction law is incomplete; its coefficients depend on the swing"
    negative = "a coefficient of friction is below 0: the swing grows, or its decay does not follow this law"
    contradicted = "the period contradicts the length and inertia of the pendulum: check both, because mu1 is proportional to J"
    undetermined = "the record does not determine the friction: it is too short, too noisy, or has swings of one amplitude only"
    not_converged = "no fit was found: the record does not resemble a swing of this pendulum"


class Identified(Result):
    """Friction of a bearing, with its uncertainty.

    Returned by `identify` for a `BearingPendulum`.

    **Attributes**

    - `status`: an `IdentifyStatus`
    - `notes`: sentences with further advice for the reader
    - `viscous` mu1, N m s, and `dry` mu2 (None if it was not requested): an `Estimate` each, whose interval includes the error
      of the instruments; typical: 3e-4 to 2e-3 N m s and 0.001 to 0.005
    - `air` b, N m s^2, and `torque` M, N m: an `Estimate` each, None if it was not requested
    - `correlation` of the errors of mu1 and mu2 (NaN without mu2)
    - `frequency` of small swings, rad/s; `offset`: the recorded angle of the rest position, rad; `angle` from the rest
      position, rad, and `rate`, rad/s, at the first sample: an `Estimate` each
    - `inertia`, kg m^2: J that follows from the frequency, with the mass, the length and the g of the pendulum
    - `noise`: standard deviation of a sample, rad
    - `pattern`: correlation of neighbouring residuals, 0 for noise
    - `structure`: F statistic of the residuals for slow changes and for vibrations at the frequency of the swing and its
      multiples, about 1 for noise
    - `fitted` (n,): the fitted angles, rad
    - `until`: end of the used part of the record, s; after it the pendulum is at rest, its swing is below the noise, or the
      record ends
    - `stopped_at`: time of the stop, s; NaN if the pendulum swings to the end
    - `width`: width over which the sign of dry friction was smoothed, rad/s (NaN without mu2)
    - `decrement`: result of the formula of ten periods for the same record, None if the record is too short
    - `record` and `pendulum` of the fit
    """

    status: IdentifyStatus
    notes: tuple[str, ...]
    viscous: Estimate = eqx.field(metadata=in_unit("N m s"))
    dry: Estimate | None = eqx.field(metadata=in_unit(""))
    air: Estimate | None = eqx.field(metadata=in_unit("N m s^2"))
    torque: Estimate | None = eqx.field(metadata=in_unit("N m"))
    correlation: float = eqx.field(metadata=in_unit(""))
    frequency: Estimate = eqx.field(metadata=in_unit("rad/s"))
    offset: Estimate = eqx.field(metadata=in_unit("rad"))
    angle: Estimate = eqx.field(metadata=in_unit("rad"))
    rate: Estimate = eqx.field(metadata=in_unit("rad/s"))
    inertia: float = eqx.field(metadata=in_unit("kg m^2"))
    noise: float = eqx.field(metadata=in_unit("rad"))
    pattern: float = eqx.field(metadata=in_unit(""))
    structure: float = eqx.field(metadata=in_unit(""))
    until: float = eqx.field(metadata=in_unit("s"))
    fitted: np.ndarray = eqx.field(metadata=in_unit("rad", "time"))
    stopped_at: float = eqx.field(metadata=in_unit("s"))
    width: float = eqx.field(metadata=in_unit("rad/s"))
    decrement: Decrement | None = eqx.field(metadata=part(prefix="decrement_"))
    record: Record = eqx.field(metadata=part())
    pendulum: BearingPendulum

    def summary(self) -> str:
        """Return the estimates with their intervals as text."""
        further = (("mu2", self.dry, ""), ("air drag", self.air, " N m s^2"), ("torque", self.torque, " N m"))
        parts = [f"{name} {shown(estimate)}{unit}" for name, estimate, unit in further if estimate is not None]
        lines = [", ".join([f"mu1 {shown(self.viscous)} N m s", *parts])]
        if self.decrement is not None:
            lines.append(f"formula of {self.decrement.periods} periods: mu1 {shown(self.decrement.viscous)} N m s")
        lines.append(f"frequency {shown(self.frequency)} rad/s, noise {self.noise:.2g} rad; {self.message}")
        return "\n".join([*lines, *self.notes])

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot the record with the fit, and its residuals, onto two axes `ax` if given."""
        from jaxvib.draw.record import swing_chart  # slow import

        return swing_chart(self.record.time, self.record.angle, self.fitted, self.noise, ax=ax)


def identify_bearing(
    pendulum: BearingPendulum,
    record: Record,
    *,
    dry: bool = False,
    air: bool = False,
    torque: bool = False,
    instrument: float = 0.0,
    throw: bool = True,
) -> Identified:
    """Identify mu1 of a bearing, and if requested mu2, the drag of the air and a constant torque, from a whole recorded swing.

        record(t_i) = offset + f(t_i) + noise
        J f'' = - m g l sin f - mu1 f' - mu2 |N| (d/2) tanh(f'/width) - b |f'| f' + M

    f is the angle; the other symbols are those of `BearingPendulum`.

    - The unknowns of the least-squares fit are the angle and rate at the first sample, the offset, the frequency of small
      swings and the friction. The method is that of Levenberg and Marquardt, with forward-mode derivatives through the
      integration
    - The frequency is a free parameter, because the dimensions of a pendulum are never known accurately enough to predict the
      phase of many swings; g is adapted to the frequency. J is taken from `pendulum`; therefore mu1 is proportional to this J
    - Samples before the release are not used. If the record continues for more than 1.3 half periods after the last clear
      turning point, the samples after this point are not used either: the pendulum is at rest, or its swing is below the noise.
      The position at which it comes to rest is not a smooth function of the friction
    - `width` is 0.005 of the speed of the smallest swing. In this swing the dry friction then dissipates 0.001 % less energy
      than with a sudden change of its sign; the difference is smaller for larger swings

    **Arguments**

    - `pendulum`: a `BearingPendulum`
    - `record` of its swing; typical: 250 to 10,000 samples over 10 to 60 s, first amplitude 3 to 60 deg
    - `dry`: True to identify the dry friction mu2 as well (the pendulum then needs the diameter `bearing`)
    - `air`: True to identify b as well; `torque`: True to identify M as well. Only large swings distinguish M from the offset
    - `instrument`: relative uncertainty of J, from ruler and scales; the half-width of the intervals of the friction (and of M)
      is sqrt(s^2 + (instrument value)^2), where s is the half-width without it; typical: 0.01 to 0.03 (0.03 in the source;
      default 0)
    - `throw`: True to raise `ComputationError` if no fit is found; otherwise the status shows it

    **Returns** `Identified`. **Raises** `InputError` for a record that cannot be fitted, `ComputationError` "not_converged".

    Source: Artyunin, Sumenkov 2019, who determine mu1 from two amplitudes; the fit to the whole record: this package.
    """
    if dry:
        _ = pendulum.diameter  # raises if it is missing
    require_uncertainty(instrument)
    turns = turning_points(record)
    half = float(np.median(np.diff(turns.time)))
    released = turns.time[0] - record.time[0] <= _MAX_HALF_PERIODS * half
    swing = record if released else record.between(float(turns.time[0]), math.inf)
    until = float(turns.time[-1]) if record.time[-1] - turns.time[-1] > _MAX_HALF_PERIODS * half else float(record.time[-1])
    start, width = first_guess(pendulum, swing, turns, dry, air, torque)
    time = swing.time - swing.time[0]
    arguments = (pendulum, jnp.asarray(time), jnp.asarray(swing.angle))
    steps, swinging = steps_for(start, time), np.where(swing.time <= until, 1.0, 0.0)
    if np.sum(swinging) < len(jax.tree.leaves(start)) + 2:
        raise InputError(record.name, f"swings for {until - swing.time[0]:.3g} s before it rests; record more of the swing")
    large = np.where(swing.time <= min(_decay_time(turns), until), 1.0, 0.0)
    if dry and np.sum(large) < np.sum(swinging):
        # The position at which the pendulum comes to rest depends on the last digits of the friction. From distant initial
        # values, a fit that includes the samples at rest converges to the wrong half swing.
        start = fit_swing(*arguments, jnp.asarray(large), start, width, steps).unknowns
    fit = fit_swing(*arguments, jnp.asarray(swinging), start, width, steps)
    result = _interpret_fit(pendulum, swing, turns, fit, float(width), instrument, until)
    if result.status_name == "patterned":
        note = _better_law(result, jnp.asarray(swinging), fit.unknowns, width, steps)
        result = dataclasses.replace(result, notes=(*result.notes, *note))
    if throw and bool(result.status == IdentifyStatus.not_converged):
        raise ComputationError("not_converged", f"{record.name}: {result.message}")
    return result


def _decay_time(turns: TurningPoints) -> float:
    """Return the time, s, at which the swing has decayed to a tenth, but not before the fifth turning point (or the last one,
    if there are fewer).

    **Returns** infinity if the swing does not decay to a tenth.
    """
    small = np.flatnonzero(turns.amplitude < 0.1 * turns.amplitude[0])
    return float(turns.time[min(max(small[0], 4), turns.time.size - 1)]) if small.size else math.inf


def _interpret_fit(
    pendulum: BearingPendulum, record: Record, turns: TurningPoints, fit: Fit, width: float, instrument: float, until: float
) -> Identified:
    """Return the result of a fit with intervals, a status and notes."""
    values = [float(v) for v in jax.tree.leaves(fit.unknowns)]
    used = record.time <= until
    slopes, residuals = np.asarray(fit.slopes)[used], np.asarray(fit.residual)[used]
    # A fit that failed may have derivatives that are not finite; its status says so.
    usable = np.all(np.isfinite(slopes)) and np.all(np.isfinite(np.asarray(fit.covariance))) and np.any(residuals)
    covariance = colored_covariance(slopes, residuals) if usable else np.asarray(fit.covariance)
    errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    samples = int(np.count_nonzero(used))
    quantile = student_quantile(samples - len(values))
    statistical = [interval(v, float(e), quantile, 0.0) for v, e in zip(values, errors, strict=True)]
    angle, rate, offset, frequency = statistical[:4]
    intervals = [interval(v, float(e), quantile, instrument) for v, e in zip(values[4:], errors[4:], strict=True)]
    law = jax.tree.unflatten(jax.tree.structure(fit.unknowns.friction), intervals)
    viscous, dry = law.viscous, law.dry
    pattern = float(np.sum(residuals[1:] * residuals[:-1]) / np.sum(residuals**2)) if np.any(residuals) else 0.0
    structure, p_value = _structure(record.time[used], residuals, turns, len(values))
    correlation = float(covariance[4, 5] / (errors[4] * errors[5])) if dry is not None else math.nan

    is_long, weight = turns.amplitude.size > 20, float(pendulum.mass * pendulum.g * pendulum.length)
    stop = float(fit.stopped_at) + float(record.time[0])
    result = Identified(
        status=IdentifyStatus.found,
        notes=(),
        viscous=viscous,
        dry=dry,
        air=law.air,
        torque=law.torque,
        correlation=correlation,
        frequency=frequency,
        offset=offset,
        angle=angle,
        rate=rate,
        inertia=math.sqrt(max(weight**2 - (0.0 if law.torque is None else law.torque.value) ** 2, 0.0)) / frequency.value**2,
        noise=float(fit.noise),
        pattern=pattern,
        structure=structure,
        until=until,
        fitted=record.angle + np.asarray(fit.residual),
        stopped_at=stop,
        width=width if dry is not None else math.nan,
        decrement=ten_periods(pendulum, record, instrument=instrument, turns=turns) if is_long else None,
        record=record,
        pendulum=pendulum,
    )
    is_patterned = abs(pattern) > 4.0 / math.sqrt(samples) or p_value < _PATTERN_PROBABILITY
    is_patterned = is_patterned and result.noise > 10.0 * TOLERANCE
    has_converged = bool(fit.converged) and result.noise <= 0.5 * float(np.std(record.angle[used]))
    status = _status(result, has_converged=has_converged, is_patterned=is_patterned, instrument=instrument)
    return dataclasses.replace(result, status=status, notes=tuple(_notes(result, is_patterned=is_patterned)))


def _status(result: Identified, *, has_converged: bool, is_patterned: bool, instrument: float) -> IdentifyStatus:
    """Return the status of a fit from its intervals."""
    coefficients = [estimate for estimate in (result.viscous, result.dry, result.air) if estimate is not None]
    if not has_converged:
        return IdentifyStatus.not_converged
    if any(estimate.high < 0.0 for estimate in coefficients):
        return IdentifyStatus.negative
    if all(estimate.low <= 0.0 for estimate in coefficients):
        return IdentifyStatus.undetermined
    if abs(result.frequency.value / float(result.pendulum.frequency) - 1.0) > _MAX_FREQUENCY_DIFFERENCE + instrument:
        return IdentifyStatus.contradicted
    return IdentifyStatus.patterned if is_patterned else IdentifyStatus.found


def _notes(result: Identified, *, is_patterned: bool) -> Iterator[str]:
    """Yield the notes about a fit; each is a sentence."""
    decrement, frequency, small = result.decrement, result.frequency.value, float(result.pendulum.frequency)
    if decrement is not None and result.dry is None and decrement.drift > 4.0:
        yield "the swing decays faster at small amplitudes, as with dry friction: identify mu2 as well"
    elif decrement is not None and decrement.drift < -4.0:
        yield "the swing decays more slowly at small amplitudes, as with air drag: mu1 is too large"
    if abs(frequency / small - 1.0) > 0.02:
        differs = f"the swing's frequency is {frequency:.4g} rad/s, the pendulum's length and inertia give {small:.4g}"
        yield f"{differs}: mu1 is proportional to the moment of inertia; check these values"
    for name, estimate in (("mu1", result.viscous), ("mu2", result.dry), ("the drag of the air", result.air)):
        if estimate is not None and estimate.low <= 0.0:
            is_below = estimate.high < 0.0
            yield (
                f"{name} and its whole interval are below 0"
                if is_below
                else f"{name} cannot be distinguished from 0 in this record"
            )
    if math.isfinite(result.stopped_at):
        yield f"dry friction stops the pendulum at {result.stopped_at:.4g} s"
    if np.any(result.record.time > result.until):
        yield f"the record after {result.until:.4g} s is left out: the pendulum rests, or its swing is below the noise"
    if is_patterned:
        yield "the residuals of the fit are not noise: the intervals include their correlation, but not the error of the law"
    if decrement is not None and decrement.is_drifting:
        yield "the formula of ten periods assumes viscous friction only: here its interval is not valid for mu1"


_LAWS = {"dry": "dry friction", "air": "drag of the air", "torque": "a constant torque"}
"""Parts of the law other than viscous friction, by the argument of `identify` that adds them."""

_MIN_STANDARD_ERRORS = 4.0
"""Distance of a coefficient from 0, in standard errors, above which its part of the law is named."""

_MAX_NOISE_RATIO = 0.9
"""A law with further parts fits clearly better if it reduces the residuals to less than this fraction."""


def _better_law(result: Identified, weight: Array, start: Unknowns, width: Array, steps: int) -> Iterator[str]:
    """Yield a sentence about the parts of the law of friction that the record needs in addition, from a fit with all parts."""
    law, pendulum, record = start.friction, result.pendulum, result.record
    missing = [name for name in _LAWS if getattr(law, name) is None]
    if not missing:
        return
    if pendulum.bearing is None:  # only the product of mu2 and the diameter counts here
        pendulum = dataclasses.replace(pendulum, bearing=0.1 * pendulum.length)
    start = start._replace(friction=law._replace(**{name: jnp.asarray(0.0) for name in missing}))
    time = jnp.asarray(record.time - record.time[0])
    fit = fit_swing(pendulum, time, jnp.asarray(record.angle), weight, start, width, steps)
    used = np.asarray(weight) > 0.0
    if not bool(fit.converged) or float(fit.noise) > _MAX_NOISE_RATIO * result.noise:
        return
    covariance = colored_covariance(np.asarray(fit.slopes)[used], np.asarray(fit.residual)[used])
    values, errors = fit.unknowns.friction, Friction(*np.sqrt(np.diagonal(covariance))[4:])
    needed = []
    for name in missing:
        value, error = float(getattr(values, name)), float(getattr(errors, name))
        if abs(value) > _MIN_STANDARD_ERRORS * error and (name == "torque" or value > 0.0):
            needed.append(name)
    if needed:
        words, options = (
            " and ".join(_LAWS[name_needed] for name_needed in needed),
            ", ".join(f"{name_needed}=True" for name_needed in needed),
        )
        yield (
            f"a law with {words} fits clearly better: residuals of {float(fit.noise):.2g} rad in place of {result.noise:.2g} "
            f"rad; identify with {options}"
        )


def _structure(time: np.ndarray, residuals: np.ndarray, turns: TurningPoints, unknowns: int) -> tuple[float, float]:
    """Return the F statistic of n residuals after a fit of so many `unknowns`, and its probability for residuals that are
    noise.

    The residuals are compared with slow changes of the zero, and with slowly changing vibrations at one, two and three times
    the frequency of the swing. Another law of friction, a torque or another restoring force leaves such residuals.
    """
    from scipy.special import fdtrc  # slow to import

    half = float(np.median(np.diff(turns.time)))
    times = np.concatenate([[turns.time[0] - 2.0 * half], turns.time, [turns.time[-1] + 2.0 * half]])
    phase = np.pi * np.interp(time, times, np.concatenate([[-2.0], np.arange(turns.time.size), [turns.time.size + 1.0]]))
    slow = np.polynomial.legendre.legvander(2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0, 4)
    columns = [slow[:, :3]]
    for k, order in ((1, 5), (2, 3), (3, 3)):
        columns += [slow[:, :order] * np.cos(k * phase)[:, None], slow[:, :order] * np.sin(k * phase)[:, None]]
    basis, _ = np.linalg.qr(np.concatenate(columns, axis=1))
    pattern_count, free = basis.shape[1] - unknowns, time.size - basis.shape[1]
    if free < 8 or not np.any(residuals):
        return 1.0, 1.0
    explained = float(np.sum((basis.T @ residuals) ** 2))
    statistic = explained / pattern_count / ((float(np.sum(residuals**2)) - explained) / free)
    return statistic, float(fdtrc(pattern_count, free, statistic))
