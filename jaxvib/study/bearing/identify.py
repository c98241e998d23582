"""The friction of a bearing from the recorded swing of a pendulum on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import ComputationError, InputError
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.study.bearing.decrement import Decrement, Estimate, TurningPoints, interval, ten_periods, turning_points
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum, controller_to, swing_states

if TYPE_CHECKING:
    from jaxvib.draw.style import Drawn, Onto

__all__ = ["Identified", "IdentifyStatus", "identify"]

_MOST_ITERATIONS = 64
_TOLERANCE = 1e-9

_CONTRADICTS = 0.05
"""Relative difference of frequencies, besides what instruments leave open, that no ruler and no scales explain."""


class IdentifyStatus(eqx.Enumeration):
    """What a fit is worth; the members are the sentences a user reads."""

    found = "the fit explains the record up to noise"
    patterned = "what the fit leaves of the record is no noise: the law of friction misses something, and errors are larger"
    negative = "a coefficient of friction comes out below 0: the swing grows, or its decay is not that of this law"
    contradicted = "the period contradicts the pendulum's length and inertia, and mu1 is in proportion to them"
    undetermined = "the record cannot tell friction from none: too short, too noisy, or swings of one size only"
    not_converged = "no fit was found: the record does not look like this pendulum's swing"


class Unknowns(NamedTuple):
    """What a fit finds: `angle` rad and `rate` rad/s at the first sample, counted from hanging; `offset` rad of the record's
    zero; `frequency` rad/s of small swings; `viscous` mu1 N m s; `dry` mu2 or None."""

    angle: Array
    rate: Array
    offset: Array
    frequency: Array
    viscous: Array
    dry: Array | None


class Fit(NamedTuple):
    """A fit: the `unknowns`; `covariance` (p, p) of them in their order, from the Fisher information with the noise found;
    `residual` (n,) rad, fit minus record; `noise` rad, standard deviation of a sample; `stopped_at` s; `converged`."""

    unknowns: Unknowns
    covariance: Array
    residual: Array
    noise: Array
    stopped_at: Array
    converged: Array


class Identified(Result):
    """A bearing's friction and how well it is known.

    **Attributes**

    - `status` an `IdentifyStatus`; `notes`: sentences on what a reader should know besides
    - `viscous` mu1 N m s, `dry` mu2 (None where it was not asked for): an `Estimate` each, instruments' share in the interval
    - `correlation` of the errors of mu1 and mu2 (NaN without mu2)
    - `frequency` rad/s of small swings, `offset` rad of the record's zero, `angle` rad and `rate` rad/s at the first sample: an
      `Estimate` each; `inertia` kg m^2: J that the frequency asks for with the pendulum's mass and length
    - `noise` rad, standard deviation of a sample; `pattern`: correlation of neighbouring residuals, 0 for noise
    - `fitted` (n,) rad, the record as the model has it; `stopped_at` s, NaN where the pendulum swings to the end
    - `width` rad/s that dry friction was smoothed with (NaN without mu2)
    - `decrement`: the formula of ten periods on the same record, None where the record is too short for it
    - `record`, `pendulum`: what was asked about
    """

    status: IdentifyStatus
    notes: tuple[str, ...]
    viscous: Estimate = eqx.field(metadata=in_unit("N m s"))
    dry: Estimate | None = eqx.field(metadata=in_unit(""))
    correlation: float = eqx.field(metadata=in_unit(""))
    frequency: Estimate = eqx.field(metadata=in_unit("rad/s"))
    offset: Estimate = eqx.field(metadata=in_unit("rad"))
    angle: Estimate = eqx.field(metadata=in_unit("rad"))
    rate: Estimate = eqx.field(metadata=in_unit("rad/s"))
    inertia: float = eqx.field(metadata=in_unit("kg m^2"))
    noise: float = eqx.field(metadata=in_unit("rad"))
    pattern: float = eqx.field(metadata=in_unit(""))
    fitted: np.ndarray = eqx.field(metadata=in_unit("rad", "time"))
    stopped_at: float = eqx.field(metadata=in_unit("s"))
    width: float = eqx.field(metadata=in_unit("rad/s"))
    decrement: Decrement | None = eqx.field(metadata=part(prefix="decrement_"))
    record: Record = eqx.field(metadata=part())
    pendulum: BearingPendulum

    def summary(self) -> str:
        """The numbers with their intervals, for a person to read."""
        lines = [f"mu1 {shown(self.viscous)} N m s"]
        if self.dry is not None:
            lines[0] += f", mu2 {shown(self.dry)}"
        if self.decrement is not None:
            lines.append(f"by {self.decrement.periods} periods: mu1 {shown(self.decrement.viscous)} N m s")
        lines.append(f"frequency {shown(self.frequency)} rad/s, noise {self.noise:.2g} rad; {self.message}")
        return "\n".join([*lines, *self.notes])

    def plot(self, *, ax: Onto = None) -> Drawn:
        """The record with the fit, and what the fit leaves; onto two axes `ax` if given."""
        from jaxvib.draw.record import record_chart  # slow to import: only who draws pays

        return record_chart(self.record.time, self.record.angle, self.fitted, self.noise, ax=ax)


def shown(estimate: Estimate) -> str:
    """An estimate as text: value and the half-width of its 95 % interval."""
    return f"{estimate.value:.5g} ± {(estimate.high - estimate.low) / 2.0:.2g}"


def identify(
    pendulum: BearingPendulum, record: Record, *, dry: bool = False, instrument: float = 0.0, throw: bool = True
) -> Identified:
    """mu1, or mu1 and mu2, of a bearing from a whole recorded swing.

        record(t_i) = offset + f(t_i) + noise,      J f'' = - m g l sin f - mu1 f' - mu2 |N| (d/2) tanh(f'/width)

    Least squares over the angle and rate at the first sample, the offset, the frequency of small swings and the friction, by
    Levenberg and Marquardt's method with forward-mode derivatives through the integration. The frequency is free, because a
    pendulum's size is never known well enough for its phase; it is the factor g that gives way, and J is taken from
    `pendulum`, so that mu1 is in proportion to it. `width` is 0.005 of the smallest swing's speed: dry friction on it is
    0.001 % too small, on larger ones less.

    **Arguments**: `dry`: find mu2 as well (the pendulum needs `bearing`); `instrument`: relative uncertainty of J, from ruler
    and scales (0.03 in the paper), added to the intervals in squares; `throw`: raise where no fit is found.

    **Returns** `Identified`. **Raises** `InputError` for a record that cannot be fitted, `ComputationError` "not_converged".

    >>> import numpy as np, jaxvib as jv
    >>> rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)
    >>> t = np.arange(0.0, 15.0, 0.04)
    >>> run = jv.swing(rod, t, angle="25 deg", viscous=1.5e-3)
    >>> noisy = run.angle + 0.002 * np.random.default_rng(0).normal(size=t.size)
    >>> found = jv.identify(rod, jv.Record(t, noisy))
    >>> found.viscous.low < 1.5e-3 < found.viscous.high, found.viscous.error < 1e-5
    (True, True)

    Source: Artyunin, Sumenkov 2019, who read mu1 off two amplitudes; the fit to the whole record is ours.
    """
    if not isinstance(record, Record):
        raise InputError("record", f"is {type(record).__name__}; it must be a Record(time, angle) or come from read_record")
    if not isinstance(pendulum, BearingPendulum):
        raise InputError("pendulum", f"is {pendulum!r}; it must be a BearingPendulum(mass=..., length=...)")
    if dry and pendulum.bearing is None:
        raise InputError("pendulum.bearing", "is missing; dry friction acts at the bearing's diameter, give it in m")
    if not isinstance(instrument, (int, float)) or not 0.0 <= instrument < 1.0:
        raise InputError("instrument", f"is {instrument!r}; the relative uncertainty of J is at least 0 and less than 1")
    turns = turning_points(record)
    start, width = first_guess(pendulum, record, turns, dry)
    time = record.time - record.time[0]
    given = (pendulum, jnp.asarray(time), jnp.asarray(record.angle))
    steps, everything = steps_for(start, time), np.ones(time.size)
    large = np.where(record.time <= _still_large(turns), 1.0, 0.0)
    if dry and np.sum(large) < time.size:
        # Where the pendulum comes to rest, between the ends of the dead zone, hangs on the last digits of the friction: a fit
        # to the rest from far off ends in the wrong half swing.
        start = fit_swing(*given, jnp.asarray(large), start, width, steps).unknowns
    fit = fit_swing(*given, jnp.asarray(everything), start, width, steps)
    found = _judged(pendulum, record, turns, fit, float(width), instrument)
    if throw and bool(found.status == IdentifyStatus.not_converged):
        raise ComputationError("not_converged", f"{record.name}: {found.message}")
    return found


def _still_large(turns: TurningPoints) -> float:
    """The time of the last turning point before the swing is a tenth of what it was; infinite where it stays larger."""
    small = np.flatnonzero(turns.amplitude < 0.1 * turns.amplitude[0])
    return float(turns.time[max(small[0], 4)]) if small.size else math.inf


def first_guess(pendulum: BearingPendulum, record: Record, turns: TurningPoints, dry: bool) -> tuple[Unknowns, Array]:
    """Where a fit begins, from the turning points, and the width that dry friction is smoothed with.

    A swing loses pi mu1/(2 J w) of its amplitude in half a period to viscous friction and 2 T_f/(m g l) to dry friction.
    """
    a = turns.amplitude
    stretch = 1.0 + a**2 / 16.0 + 11.0 * a**4 / 3072.0  # of the period, by the size of the swing
    w = math.pi * a.size / float(np.sum(np.diff(turns.time) / stretch))
    inertia, length = float(pendulum.total_inertia), float(pendulum.length)
    if dry and a.size > 3:
        (share, loss), *_ = np.linalg.lstsq(np.stack([a[:-1], np.ones(a.size - 1)], axis=1), a[:-1] - a[1:], rcond=None)
        share, loss = max(share, 0.0), max(loss, 0.0)
    else:
        weight = a**2 / np.sum(a**2)
        k = np.arange(a.size) - np.sum(weight * np.arange(a.size))
        share, loss = max(-float(np.sum(weight * k * np.log(a)) / np.sum(weight * k**2)), 0.0), 0.0
    offset = float(np.mean((turns.angle[:-2] + 2.0 * turns.angle[1:-1] + turns.angle[2:]) / 4.0))
    first = turns.angle[0] - offset
    phase = w / stretch[0] * (record.time[0] - turns.time[0])
    guess = Unknowns(
        angle=jnp.asarray(first * math.cos(phase)),
        rate=jnp.asarray(-first * w * math.sin(phase)),
        offset=jnp.asarray(offset),
        frequency=jnp.asarray(w),
        viscous=jnp.asarray(2.0 * inertia * w * share / math.pi),
        dry=jnp.asarray(loss * length / float(pendulum.bearing)) if dry and pendulum.bearing is not None else None,
    )
    return guess, jnp.asarray(0.005 * w * float(np.min(a)))


def steps_for(start: Unknowns, time: Array | np.ndarray) -> int:
    """More steps than the integration takes; a power of 2, so that few lengths of a record need few compilations."""
    return 2 ** math.ceil(math.log2(4096 + 100.0 * float(jnp.max(start.frequency)) * float(np.max(time))))


@cached
def fit_swing(
    pendulum: BearingPendulum, time: Array, angle: Array, weight: Array, start: Unknowns, width: Array, max_steps: int
) -> Fit:
    """The least-squares fit behind `identify`, for `vmap` over records: `time` (n,) s from 0, `angle` (n,) rad, and which of
    them count, `weight` (n,) 1 or 0."""
    size = jnp.std(angle) * jnp.sqrt(2.0)
    duration = time[-1] - time[0]
    inertia, length = pendulum.total_inertia, pendulum.length
    scale = Unknowns(
        angle=size,
        rate=size * start.frequency,
        offset=size,
        frequency=1.0 / duration,
        viscous=inertia / duration,
        dry=None if start.dry is None else 2.0 * length * size / (_bearing(pendulum) * start.frequency * duration),
    )

    def states(at: Unknowns) -> tuple[Array, Array]:
        pull = at.frequency**2 * inertia / (pendulum.mass * length)
        freed = eqx.tree_at(lambda p: p.g, pendulum, pull)
        solver, adjoint = diffrax.Tsit5(), diffrax.ForwardMode()
        smooth = None if at.dry is None else width
        run = swing_states(
            freed, time, at.angle, at.rate, at.viscous, at.dry, smooth, controller_to(_TOLERANCE), solver, adjoint, max_steps
        )
        return at.offset + run.angle, run.stopped_at

    first, shape = jax.flatten_util.ravel_pytree(start)
    unit, _ = jax.flatten_util.ravel_pytree(scale)

    def residual(x: Array) -> tuple[Array, tuple[Array, Array]]:
        fitted, stopped_at = states(shape(first + unit * x))
        left = weight * (fitted - angle) / size
        return left, (left, stopped_at)

    x, left, slopes, stopped_at, converged = _least_squares(residual, jnp.zeros_like(first))
    left = size * left
    variance = jnp.sum(left**2) / (jnp.sum(weight) - first.shape[0])
    _, triangle = jnp.linalg.qr(size * slopes)
    root = unit[:, None] * jnp.linalg.inv(triangle)
    covariance = variance * root @ root.T
    return Fit(
        unknowns=shape(first + unit * x),
        covariance=covariance,
        residual=left,
        noise=jnp.sqrt(variance),
        stopped_at=stopped_at,
        converged=converged & jnp.all(jnp.isfinite(covariance)),
    )


def _least_squares(
    residual: Callable[[Array], tuple[Array, tuple[Array, Array]]], start: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """x (p,) of the least sum of squares of `residual` (n,), with residual, slopes (n, p), what comes with it, and success.

    Levenberg and Marquardt's method, written so that the program holds the integration once: it is what takes long to compile.
    It is done where the next full step is less than 0.01 standard errors, and good where it is less than 0.1: below, the
    steps of the integration blur the sum.
    """
    slopes_of = jax.jacfwd(residual, has_aux=True)
    n, p = jax.eval_shape(residual, start)[0].shape[0], start.shape[0]
    floor = n * (0.01 * _TOLERANCE) ** 2

    def goes_on(carry: tuple[Array, ...]) -> Array:
        return (carry[0] < _MOST_ITERATIONS) & (carry[-1] > 1e-4) & (carry[2] < 1e6)

    def step(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        count, trial, damping, *best, _ = carry
        slopes, (left, stopped_at) = slopes_of(trial)
        cost = jnp.sum(left**2)
        better = cost < best[0]  # and not NaN
        best = [jnp.where(better, new, old) for new, old in zip((cost, trial, left, slopes, stopped_at), best, strict=True)]
        damping = jnp.where(better, 0.1 * damping, 10.0 * damping)
        cost, x, left, slopes, _ = best
        basis, triangle = jnp.linalg.qr(slopes)
        reached = basis.T @ left
        normal = triangle.T @ triangle
        damped = normal + damping * jnp.diag(jnp.diagonal(normal))
        trial = x - jnp.linalg.solve(damped, triangle.T @ reached)
        # The full next step in standard errors: of the best point so far, for at a kink the sum may not fall any more.
        left_to_go = jnp.sum(reached**2) / (cost / (n - p) + floor)
        return count + 1, trial, damping, *best, left_to_go

    none = (jnp.asarray(jnp.inf), start, jnp.zeros(n), jnp.zeros((n, p)), jnp.asarray(jnp.nan))
    end = jax.lax.while_loop(goes_on, step, (jnp.asarray(0), start, jnp.asarray(0.1), *none, jnp.asarray(jnp.inf)))
    return end[4], end[5], end[6], end[7], end[-1] < 1e-2


def _bearing(pendulum: BearingPendulum) -> Array:
    assert pendulum.bearing is not None
    return pendulum.bearing


def _judged(
    pendulum: BearingPendulum, record: Record, turns: TurningPoints, fit: Fit, width: float, instrument: float
) -> Identified:
    """The fit in words: intervals, a status, and what a reader should know besides."""
    values = [float(v) for v in jax.tree.leaves(fit.unknowns)]
    covariance = np.asarray(fit.covariance)
    errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    free = record.samples - len(values)
    quantile = student_quantile(free)
    plain = [interval(v, float(e), quantile, 0.0) for v, e in zip(values, errors, strict=True)]
    angle, rate, offset, frequency = plain[:4]
    viscous, *more = (interval(v, float(e), quantile, instrument) for v, e in zip(values[4:], errors[4:], strict=True))
    dry = more[0] if more else None
    left = np.asarray(fit.residual)
    pattern = float(np.sum(left[1:] * left[:-1]) / np.sum(left**2)) if np.any(left) else 0.0
    correlation = float(covariance[4, 5] / (errors[4] * errors[5])) if dry is not None else math.nan

    decrement, notes = None, []
    if turns.amplitude.size > 20:
        decrement = ten_periods(pendulum, record, instrument=instrument, turns=turns)
        if dry is None and decrement.drift > 4.0:
            notes.append("the swing decays faster the smaller it is, as by dry friction: ask for mu2 as well")
    small = float(pendulum.frequency)
    if abs(frequency.value / small - 1.0) > 0.02:
        wanted = f"the swing's frequency is {frequency.value:.4g} rad/s, the pendulum's length and inertia give {small:.4g}"
        notes.append(f"{wanted}: mu1 is in proportion to the moment of inertia, check them")
    for name, estimate in (("mu1", viscous), ("mu2", dry)):
        if estimate is not None and estimate.low <= 0.0:
            below = estimate.high < 0.0
            notes.append(
                f"{name} is below 0, its whole interval too" if below else f"{name} cannot be told from 0 in this record"
            )
    if math.isfinite(stop := float(fit.stopped_at)):
        notes.append(f"dry friction holds the pendulum from {stop + record.time[0]:.4g} s on")

    status = IdentifyStatus.found
    if not bool(fit.converged) or float(fit.noise) > 0.5 * float(np.std(record.angle)):
        status = IdentifyStatus.not_converged
    elif viscous.high < 0.0 or (dry is not None and dry.high < 0.0):
        status = IdentifyStatus.negative
    elif viscous.low <= 0.0 and (dry is None or dry.low <= 0.0):
        status = IdentifyStatus.undetermined
    elif abs(frequency.value / small - 1.0) > _CONTRADICTS + instrument:
        status = IdentifyStatus.contradicted
    elif abs(pattern) > 4.0 / math.sqrt(record.samples) and float(fit.noise) > 10.0 * _TOLERANCE:
        status = IdentifyStatus.patterned
    return Identified(
        status=status,
        notes=tuple(notes),
        viscous=viscous,
        dry=dry,
        correlation=correlation,
        frequency=frequency,
        offset=offset,
        angle=angle,
        rate=rate,
        inertia=float(pendulum.mass * pendulum.g * pendulum.length) / frequency.value**2,
        noise=float(fit.noise),
        pattern=pattern,
        fitted=record.angle + left,
        stopped_at=stop + float(record.time[0]),
        width=width if dry is not None else math.nan,
        decrement=decrement,
        record=record,
        pendulum=pendulum,
    )


def student_quantile(freedom: int) -> float:
    """The 97.5 % point of Student's t, by its series in 1/freedom: to 1e-4 from 10 on.

    >>> round(student_quantile(10), 3), round(student_quantile(1000), 3)
    (2.228, 1.962)
    """
    z = 1.959963985
    terms = (z**3 + z, (5 * z**5 + 16 * z**3 + 3 * z) / 24, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 96)
    return z + sum(term / (4.0 * freedom ** (k + 1)) for k, term in enumerate(terms))
