"""Resonances that catch rotating masses: they stay below a resonance, slower than their drive."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.display import speed_text
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.scene import Exciter, Scene

_BELOW_RESONANCE = 1.05
"""Speed, relative to a natural frequency, up to which a mass counts as not having passed the resonance. Masses are caught
slightly below the natural frequency."""

_WORKING_SHARE = 0.95
"""Largest natural frequency, relative to the working speed of a drive, that counts as a resonance below this speed."""

_HELD_SHARE = 0.85
"""Smallest speed, relative to a natural frequency, at which a resonance can hold a rotor at the end of a run. Other rotors are
still on their way."""

_MAX_HELD_CHANGE = 0.02
"""Largest relative difference between the mean speeds in the two halves of a window of a rotor that a resonance holds."""


def catching_resonance(speed: ArrayLike, working_speed: ArrayLike, resonances: Array | np.ndarray) -> Array:
    """Return the number, from 1, of the lowest of the `resonances` (nd,), ascending, below 0.95 of the `working_speed` of the
    drive that a mass at `speed` has not passed; 0 if all of them are passed."""
    missed = (resonances < _WORKING_SHARE * jnp.asarray(working_speed)) & ~(jnp.asarray(speed) > _BELOW_RESONANCE * resonances)
    return jnp.where(jnp.any(missed), jnp.argmax(missed) + 1, 0)


def has_no_resonance(exciter: Exciter) -> bool:
    """Return True if no resonance can catch the rotor: its drive prescribes its speed, or its motor is switched off."""
    return exciter.drive.ideal or isinstance(exciter.drive, SwitchedOff)


def caught_rotors(scene: Scene, speeds: ArrayLike, resonances: np.ndarray) -> np.ndarray:
    """Return the number of the resonance that catches the rotor of each exciter (N,), see `catching_resonance`; 0 for a rotor
    that no resonance can catch. `speeds` (N,), rad/s, are positive in the direction of each exciter."""
    return np.asarray(
        [
            0 if has_no_resonance(exciter) else int(catching_resonance(speed, exciter.drive.speed, resonances))
            for exciter, speed in zip(scene.exciters, np.asarray(speeds), strict=True)
        ]
    )


def held_rotors(scene: Scene, rotor_speeds: Sequence[ArrayLike], resonances: np.ndarray) -> np.ndarray:
    """Return the number of the resonance that holds the rotor of each exciter without loads at the end of a run, (N,): one that
    catches the rotor (`caught_rotors`), which stays near it with a constant mean speed; 0 for other rotors.

    **Arguments**: `rotor_speeds` (nt,), rad/s, of each exciter in the window; `resonances` (nd,), rad/s, ascending.
    """
    signed = [exciter.direction * np.asarray(n) for exciter, n in zip(scene.exciters, rotor_speeds, strict=True)]
    early, late = np.transpose([[np.mean(half) for half in np.array_split(n, 2)] for n in signed])
    mean = np.asarray([np.mean(n) for n in signed])
    number = caught_rotors(scene, mean, resonances)
    is_near = mean > _HELD_SHARE * resonances[number - 1]
    is_constant = np.abs(late - early) < _MAX_HELD_CHANGE * np.abs(mean)
    has_no_loads = [exciter.loads is None for exciter in scene.exciters]
    return np.where(is_near & is_constant & has_no_loads, number, 0)


def caught_text(number: int, resonances: np.ndarray) -> str:
    """Return the resonance with the `number`, from 1, that catches an exciter as text."""
    return f"caught by resonance {number} at {speed_text(resonances[number - 1])}"


def held_lines(numbers: np.ndarray, resonances: np.ndarray) -> list[str]:
    """Return a line for each resonance that holds rotors, with the `numbers` (N,) of `held_rotors`."""
    lines = []
    for number in sorted(set(numbers.tolist()) - {0}):
        held = (np.flatnonzero(numbers == number) + 1).tolist()
        names = f"exciter {held[0]} is" if len(held) == 1 else f"exciters {', '.join(map(str, held))} are"
        lines.append(f"{names} {caught_text(number, resonances)}: the motion is not that of the working speed")
    return lines
