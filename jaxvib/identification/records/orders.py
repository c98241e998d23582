"""Vibrations of other frequencies than the rotor speed: of jammed loads, of another shaft, of another machine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_SEGMENTS = 4
"""Number of segments of a record. Their spectra are averaged together with those of segments that begin at their middles."""

_LINE, _AROUND = 2, 8
"""Number of bins of a spectrum on each side of a peak that belong to its line, and number of the next bins on each side, with
which the line is compared."""

_STEEP = 10.0
"""Mean power of the bins of a peak, relative to that of the bins around them, from which the peak counts as a line."""

_MIN_TURNS, _MIN_SAMPLES = 16, 512
"""Smallest number of turns and of samples whose spectra are examined."""


class ForeignVibration(NamedTuple):
    """Vibration that is not at the rotor speed.

    **Attributes**: `order`: frequency relative to the rotor speed, None for a vibration of constant frequency; `frequency`,
    Hz, None for a vibration whose frequency follows the rotor; `share` of the power of the signal.
    """

    order: float | None
    frequency: float | None
    share: float

    @property
    def frequency_text(self) -> str:
        """Frequency of the vibration, in words."""
        return f"at {self.frequency:.3g} Hz" if self.order is None else f"at {self.order:.3g} times the rotor speed"


def foreign_vibration(values: np.ndarray, angle: np.ndarray, step: float) -> ForeignVibration | None:
    """Return the strongest vibration of a signal if it is not at the rotor speed; otherwise None.

    The spectra over the rotor's angle and over time are compared. A vibration that follows the rotor is a line in the first
    spectrum, and a vibration of constant frequency is a line in the second spectrum.

    **Arguments**: `values` (n,), NaN for samples that do not count; `angle` (n,) of the rotor, rad; `step`, s.

    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> angle = 10.0 * t + 2.0 * t**2
    >>> found = foreign_vibration(np.cos(0.7 * angle) + 0.3 * np.cos(angle), angle, 0.01)
    >>> round(found.order, 2), found.share > 0.8
    (0.7, True)
    >>> foreign_vibration(np.cos(25.0 * t) + 0.3 * np.cos(angle), angle, 0.01).frequency_text
    'at 3.98 Hz'
    >>> print(foreign_vibration(0.3 * np.cos(25.0 * t) + np.cos(angle), angle, 0.01))
    None
    """
    is_finite = np.isfinite(values)
    turns = np.maximum.accumulate(np.abs(angle - angle[0])) / (2.0 * np.pi)
    if np.count_nonzero(is_finite) < _MIN_SAMPLES or turns[-1] < _MIN_TURNS:
        return None
    values = np.where(is_finite, values - np.mean(values[is_finite]), 0.0)
    if not np.any(values):
        return None
    over_turns = np.interp(np.linspace(0.0, turns[-1], values.size), turns, values)
    over_angle, spacing = _spectrum(over_turns, turns[-1] / (values.size - 1))
    over_time, width = _spectrum(values, step)
    rotor = round(1.0 / spacing)
    near = slice(max(rotor - 2 * _LINE, 0), rotor + 2 * _LINE + 1)
    rotor_share, without_rotor = float(np.sum(over_angle[near])), over_angle.copy()
    without_rotor[near] = 0.0
    order, by_order = _line(without_rotor)
    frequency, by_time = _line(over_time)
    if rotor_share >= max(by_order, by_time) or max(by_order, by_time) == 0.0:
        return None
    if by_order >= by_time:
        return ForeignVibration(float(order * spacing), None, by_order)
    return ForeignVibration(None, float(frequency * width), by_time)


def _spectrum(values: np.ndarray, step: float) -> tuple[np.ndarray, float]:
    """Return the power in each bin of an averaged spectrum, relative to the whole power, and the width of a bin."""
    from scipy.signal import welch  # slow to import

    frequency, power = welch(values, 1.0 / step, nperseg=2 * (values.size // (2 * _SEGMENTS)))
    return power / max(float(np.sum(power)), 1e-300), float(frequency[1])


def _line(power: np.ndarray) -> tuple[float, float]:
    """Return the position of the strongest line of a spectrum, in bins, and its share of the power; (0, 0) without a line."""
    inner = power[_LINE + 1 :]
    peak = int(np.argmax(inner)) + _LINE + 1
    line = slice(peak - _LINE, peak + _LINE + 1)
    share = float(np.sum(power[line]))
    around = np.concatenate([power[max(line.start - _AROUND, 0) : line.start], power[line.stop : line.stop + _AROUND]])
    if share == 0.0 or share / (2 * _LINE + 1) < _STEEP * float(np.mean(around)):
        return 0.0, 0.0
    return float(np.sum(np.arange(line.start, line.stop) * power[line])) / share, share
