"""Checks of a fit: its status, and sentences for the reader."""

from __future__ import annotations

import math
from collections.abc import Iterator

import equinox as eqx
import numpy as np

from jaxvib.identification.directions import Information
from jaxvib.identification.fit import Fitted

_CHANCE = 1e-5
"""Share of records with pure noise about the fit that get the status `patterned`."""

_WINDOWS, _ORDERS = 16, 3
"""Number of stretches of a record, and of orders of the rotor's speed, in which residuals are compared with noise."""

_CONTRADICTION = 4.0
"""Distance of a fitted value from a known one, in standard errors, that errors cannot explain."""

_ANGLE_SHARE = 0.1
"""Share of the residuals due to errors of the rotor's angle above which intervals count as too narrow. The share is small
because these errors change slowly and do not average out like noise."""

_UNEXPLAINED = 0.5
"""Share of a channel's standard deviation in the residuals above which a fit counts as none."""


class FitStatus(eqx.Enumeration):
    """Outcomes of a fit of a machine. The value of each member is the message shown to the user."""

    found = "the model explains the records up to noise"
    patterned = (
        "the residuals are not noise: they repeat with the rotor's angle, so the model lacks a part, the angle is inaccurate, "
        "or the minimum is a wrong one, and the intervals are too narrow; see the notes, compare the residuals over speed, and "
        "start from better values"
    )
    undetermined = "the records do not determine all unknowns: see `undetermined` for the directions and how to determine them"
    contradicted = "the records contradict a known value or the calibration of a sensor: see the notes, and check that value"
    not_converged = (
        "no fit was found: the model does not resemble the records; check places and directions of the channels and the "
        "rotor's angle, or start from better values"
    )


def status_of(fitted: Fitted, found: Information) -> tuple[FitStatus, float, list[str]]:
    """Return the status of a fit, the smallest chance of its residuals under pure noise, and notes."""
    chance, notes = 1.0, list(_contradictions(fitted))
    contradicted = bool(notes)
    explained, is_inaccurate = [], False
    for k, (samples, left, raw, mask) in enumerate(
        zip(fitted.problem.runs, fitted.residuals, fitted.problem.raw, fitted.problem.masks, strict=True)
    ):
        for c, channel in enumerate(samples.channels):
            valid = mask[:, c]
            by_angle = fitted.problem.angle_errors[k] * float(np.std(raw[valid, c]))
            if by_angle > _ANGLE_SHARE * np.std(left[valid, c]):
                is_inaccurate = True
                size = np.std(left[valid, c])
                notes.append(
                    f"the standard error of the rotor's angle in run {k + 1}, {fitted.problem.angle_errors[k]:.2g} rad, "
                    f"changes channel {channel.name!r} by {by_angle:.2g}, and its residuals are {size:.2g}; the "
                    "intervals do not include this error: use more pulses per turn, or sample them faster"
                )
            explained.append(np.std(left[valid, c]) / max(float(np.std(raw[valid, c])), 1e-300))
            one = residual_chance(left[:, c], np.asarray(samples.taps)[:, c], fitted.problem.angles[k][:, 0], fitted.x.size)
            if one < _CHANCE:
                notes.append(f"the residuals of channel {channel.name!r} in run {k + 1} repeat with the rotor's angle")
            chance = min(chance, one)
    if not fitted.converged or min(explained) > _UNEXPLAINED:
        return FitStatus.not_converged, chance, notes
    if contradicted:
        return FitStatus.contradicted, chance, notes
    if chance < _CHANCE or is_inaccurate:
        return FitStatus.patterned, chance, notes
    return FitStatus.undetermined if found.undetermined.size else FitStatus.found, chance, notes


def residual_chance(left: np.ndarray, taps: np.ndarray, angle: np.ndarray, found: int) -> float:
    """Return the probability of residuals as far from noise as these, if they are noise.

    They are filtered to white noise and compared with vibrations at the first orders of the rotor's speed in each stretch of
    the record, by an F test.

    **Arguments**: `left` (n,), NaN for samples that do not count; `taps` of the filter; `angle` (n,) rad; `found`: number of
    fitted unknowns.

    >>> angle, rng = np.linspace(0.0, 500.0, 4000), np.random.default_rng(0)
    >>> noise = rng.normal(size=4000)
    >>> bool(residual_chance(noise, np.ones(1), angle, 4) > 1e-3)
    True
    >>> bool(residual_chance(noise + 0.3 * np.cos(angle), np.ones(1), angle, 4) < 1e-9)
    True
    """
    from scipy.special import fdtrc  # slow to import

    white = np.convolve(np.where(np.isfinite(left), left, 0.0), taps)[: left.size]
    valid = np.convolve(~np.isfinite(left), np.ones(len(taps)))[: left.size] < 0.5
    valid[: len(taps) - 1] = False
    place = np.flatnonzero(valid)
    if place.size < 8 * _WINDOWS * (2 * _ORDERS + 1) or not np.any(white[place]):
        return 1.0
    explained, columns = 0.0, 0
    for part in np.array_split(place, _WINDOWS):
        waves = [np.ones(part.size)]
        for k in range(1, _ORDERS + 1):
            waves += [np.cos(k * angle[part]), np.sin(k * angle[part])]
        basis, triangle = np.linalg.qr(np.stack(waves, axis=1))
        kept = np.abs(np.diagonal(triangle)) > 1e-6 * math.sqrt(part.size)
        explained += float(np.sum((basis[:, kept].T @ white[part]) ** 2))
        columns += int(np.count_nonzero(kept))
    total, known = float(np.sum(white[place] ** 2)), max(columns - found, 1)
    free = place.size - columns
    return float(fdtrc(known, free, explained / known / ((total - explained) / free)))


def _contradictions(fitted: Fitted) -> Iterator[str]:
    """Yield sentences about known values that the records contradict."""
    problem = fitted.problem
    unknowns = problem.unknowns
    names = [*(number.name for number in unknowns.numbers), *(f"the gain of channel {name!r}" for name in unknowns.gains)]
    for name, x, mean, precision in zip(names, fitted.x, problem.means, problem.precisions, strict=False):
        away = abs(x - mean) * math.sqrt(precision)
        if away > _CONTRADICTION:
            yield f"{name} is {away:.1f} standard errors away from its known value"
    for k, known in enumerate(problem.unbalances):
        if known is not None:
            away = abs(float(np.hypot(*fitted.linear[2 * k : 2 * k + 2])) - known.value) / known.error
            if away > _CONTRADICTION:
                yield f"exciters[{k}].unbalance is {away:.1f} standard errors away from its known value"
