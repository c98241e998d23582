"""Resonances at which loads or motors stayed for a time before they passed them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxvib.display import speed_text
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.regime import estimated_mode, excited_frequencies

_BAND = 0.03
"""Largest distance of the speed from its mean during a stay, relative to the mean."""

_MIN_TURNS = 10.0
"""Smallest number of turns of a stay."""

_MIN_SLOWNESS = 3.0
"""Smallest ratio of the duration of a stay to two times: that in which the speed passes an equal band at its mean acceleration
without the stay, and that in which it passes the next band. A load that approaches the speed of its rotor, or a motor its
no-load speed, passes each band more slowly than the last one."""

_MAX_SPEED_RATIO = 0.95
"""Largest speed during a stay, relative to that of the rotor, or to the no-load speed of a motor."""

_MIN_SHARE_NEARBY, _NEARBY = 0.8, 0.12
"""Smallest share of a stay during which the speed is near that of the stay, and the largest relative distance that is near. The
speeds of motors that a resonance holds together swing by about 10 %."""

_NEAR_RESONANCE = (0.85, 1.1)
"""Speeds of a rotor, relative to a natural frequency, at which a resonance can hold it. Other stays follow from the supply."""

_SPEEDS = np.geomspace(0.05, 0.95, 400)
"""Examined speeds, relative to the speed at the end of the run."""


class Stay(NamedTuple):
    """Time during which loads or the rotor of a motor stayed near one speed before they passed a resonance.

    **Attributes**: `masses` in words; mean `speed`, rad/s; `start` and `end`, s; number `resonance`, from 1, of the nearest
    natural frequency, and its value `resonance_speed`, rad/s; estimated jam `mode` as in `Regime`, 0 for rotors and for scenes
    that are not plain.
    """

    masses: str
    speed: float
    start: float
    end: float
    resonance: int
    resonance_speed: float
    mode: int

    def summary(self) -> str:
        """Return the stay as a sentence."""
        mode = f"mode {self.mode}, " if self.mode else ""
        resonance = f"resonance {self.resonance} at {speed_text(self.resonance_speed, 4)}"
        times = f"from {self.start:.4g} to {self.end:.4g} s"
        return f"{self.masses} stayed near {speed_text(self.speed, 4)} {times} ({mode}{resonance}), then passed"


def find_stays(scene: Scene, time: np.ndarray, speeds: np.ndarray, rotor_speeds: Sequence[ArrayLike]) -> list[Stay]:
    """Return the stays of a run in the order of their times.

    A mass stays near a speed if it turns at least 10 times within 3 % of it, at least three times as long as at its mean
    acceleration and as in the next band of speeds, and slower than 0.95 of its rotor or of the no-load speed of its motor.
    Swings by up to 12 % from this speed, and larger ones for a fifth of the time, do not end a stay.

    Falling speeds have no stay before they pass. Above a resonance the torque of the vibration grows as the speed falls, so
    that a rotor falls faster than the reference of its motor, up to the speed at which no equilibrium above it is left.
    Only below the resonance, after it has passed, can it fall more slowly than the reference for a time.

    **Arguments**: `time` (nt,), s, evenly spaced; `speeds` (nt, n), rad/s, of the turning masses as in `turning_angles`;
    `rotor_speeds` (nt,) of each exciter.
    """
    stays, column, several = [], 0, len(scene.exciters) > 1
    natural = np.asarray(estimated_frequencies(scene))
    if not np.any(springs := natural > 0.0):
        return []
    period = 2.0 * np.pi / float(np.min(natural[springs]))
    for k, exciter in enumerate(scene.exciters):
        direction, rotor = exciter.direction, exciter.direction * np.asarray(rotor_speeds[k], float)
        of = f" of exciter {k + 1}" if several else ""
        count = 1 if exciter.loads is None else exciter.loads.count
        if exciter.loads is not None:
            own = [(j, part) for j in range(count) for part in _parts(time, direction * speeds[:, column + j], rotor, period)]
            for group in _groups(own):
                numbers = sorted({j + 1 for j, _ in group})
                name = f"load{'s'[: len(numbers) > 1]} {', '.join(map(str, numbers))}"
                masses = ("the load" if count == 1 else "the loads") if len(numbers) == count else name
                stays.append(_stay(scene, f"{masses}{of}", [part for _, part in group], is_load=True))
        if not exciter.drive.ideal:
            target = np.full_like(rotor, float(exciter.drive.speed))
            found = [_stay(scene, f"the rotor{of}", [part], is_load=False) for part in _parts(time, rotor, target, period)]
            low, high = _NEAR_RESONANCE
            stays += [stay for stay in found if low < stay.speed / stay.resonance_speed < high]
        column += count
    return sorted(stays, key=lambda stay: stay.start)


class _Part(NamedTuple):
    """Part of a run, from `start` to `end`, s, with the mean `speed` of a mass and that of its rotor, `target`, rad/s."""

    start: float
    end: float
    speed: float
    target: float


def _parts(time: np.ndarray, speed: np.ndarray, target: np.ndarray, period: float) -> list[_Part]:
    """Return the parts of a run in which a mass with the `speed` (nt,) stays, see `find_stays`; `period`: longest period of a
    free vibration, s."""
    count, step = len(time), (time[-1] - time[0]) / (len(time) - 1)
    # The mean over two periods removes the ripple within each turn.
    half = round(period / step)
    total, total_target = (np.concatenate([[0.0], np.cumsum(values, dtype=float)]) for values in (speed, target))
    first, last = np.maximum(np.arange(count) - half, 0), np.minimum(np.arange(count) + half + 1, count)
    mean = (total[last] - total[first]) / (last - first)
    if not mean[-1] > 0.0:
        return []
    climb = time[np.argmax(mean >= 0.9 * mean[-1])] - time[0]
    # Largest speed until each time, and smallest one from then on: both rise, and differ only if the speed also falls.
    reached, left = np.maximum.accumulate(mean), np.minimum.accumulate(mean[::-1])[::-1]
    levels = _SPEEDS * mean[-1] / (1.0 + 3.0 * _BAND)
    begin, end = np.searchsorted(reached, levels * (1.0 - _BAND)), np.searchsorted(left, levels * (1.0 + _BAND)) - 1
    next_end = np.minimum(np.searchsorted(left, levels * (1.0 + 3.0 * _BAND)), count - 1)
    is_part, parts = end > begin, []
    begin, end = np.minimum(begin, count - 1), np.maximum(end, 0)
    duration = np.where(is_part, time[end] - time[begin], 0.0)
    at_mean_rate = 2.0 * _BAND * levels * np.maximum(climb - duration, 0.0) / (0.9 * mean[-1])
    longer = _MIN_SLOWNESS * np.maximum(at_mean_rate, time[next_end] - time[end])
    duration = np.where((duration >= longer) & (duration * levels >= 2.0 * np.pi * _MIN_TURNS), duration, 0.0)
    for j in np.flatnonzero(duration):
        is_near = np.abs(mean[begin[j] : end[j] + 1] - levels[j]) < _NEARBY * levels[j]
        if np.mean(is_near) < _MIN_SHARE_NEARBY:
            duration[j] = 0.0
    while np.max(duration) > 0.0:
        j = int(np.argmax(duration))
        n = end[j] + 1 - begin[j]
        speed_and_target = [(each[end[j] + 1] - each[begin[j]]) / n for each in (total, total_target)]
        has_passed = speed_and_target[0] < mean[-1] / (1.0 + _NEARBY)
        if has_passed and speed_and_target[0] < _MAX_SPEED_RATIO * speed_and_target[1]:
            parts.append(_Part(float(time[begin[j]]), float(time[end[j]]), *map(float, speed_and_target)))
        duration = np.where((begin <= end[j]) & (end >= begin[j]), 0.0, duration)
    return parts


def _groups(parts: list[tuple[int, _Part]]) -> list[list[tuple[int, _Part]]]:
    """Return the parts of several loads, with the numbers of the loads, in groups that overlap in time and in speed."""
    groups: list[list[tuple[int, _Part]]] = []
    for number, part in parts:
        for group in groups:
            other = group[0][1]
            is_near = abs(part.speed - other.speed) < 2.0 * _BAND * other.speed
            if is_near and part.start < other.end and other.start < part.end:
                group.append((number, part))
                break
        else:
            groups.append([(number, part)])
    return groups


def _stay(scene: Scene, masses: str, parts: list[_Part], *, is_load: bool) -> Stay:
    speed, target = (float(np.mean([getattr(part, name) for part in parts])) for name in ("speed", "target"))
    natural = excited_frequencies(scene, jnp.asarray(target))
    natural = jnp.where(natural > 0.0, natural, jnp.inf)
    nearest = int(jnp.argmin(jnp.abs(natural - speed)))
    mode = int(estimated_mode(natural, jnp.asarray(speed), jnp.asarray(target))) if is_load and scene.is_plain else 0
    start, end = min(part.start for part in parts), max(part.end for part in parts)
    return Stay(masses, speed, start, end, nearest + 1, float(natural[nearest]), mode)
