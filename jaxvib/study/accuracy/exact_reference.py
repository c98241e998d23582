"""Exact jams as references of work-precision diagrams."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.equations.linear import natural_frequencies
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.orbits.jam_orbit import collocation_points, jam_orbit

WINDOW_PERIODS, MAX_RUN_PERIODS = 20.0, 2000.0
"""Measuring window at the end of a run, and longest run, in slow periods (see `slow_period`)."""


class ExactJam(NamedTuple):
    """Exact jam of a `mode` with many collocation points (`fine`), and with fewer points (`coarse`), which gives the error."""

    mode: int
    fine: Orbit
    coarse: Orbit

    def length(self, scene: Scene, tolerance: float) -> float:
        """Return the duration, s, of a run to a stable jam, at most 2000 slow periods.

        It is the time in which deviations of the start decay to the tolerance, plus the measuring window of 20 slow periods.
        """
        rate = -np.log(float(self.fine.multiplier)) * float(self.fine.omega) / (2.0 * np.pi)
        window = slow_period(scene) * WINDOW_PERIODS
        return min(window + np.log(1.0 / tolerance) / rate, slow_period(scene) * MAX_RUN_PERIODS)


def exact_jam(scene: Scene, mode: int | None) -> ExactJam:
    """Return the exact jam of a mode (default: that of `usual_mode`).

    **Raises** `InputError` for a drive whose speed is not constant, and without a `mode` if no mode is stable by slope.
    """
    if not scene.drive.constant:
        raise InputError("drive.kind", f"is {quoted(scene.drive.kind)}; a jam needs a constant speed: use ConstantSpeed")
    mode = usual_mode(scene) if mode is None else mode
    return ExactJam(mode, *(jam_orbit(scene, mode=mode, points=collocation_points(scene, points)) for points in (32, 24)))


def usual_mode(scene: Scene) -> int:
    """Return the default jam mode: the second-highest of the modes that are stable by slope, or the only one.

    **Raises** `InputError` if no mode is stable, and for the same scenes as `jam_modes`.
    """
    modes = jam_modes(scene)
    rising = [k for k in modes.mode_numbers() if bool(modes.select(k).stable)]
    if not rising:
        raise InputError("mode", "is missing, and no jam mode of this scene is stable by slope; give its number")
    return rising[-2] if len(rising) > 1 else rising[-1]  # in the last mode the loads turn almost with the rotor


def slow_period(scene: Scene) -> float:
    """Return the slow period, s: the longest natural period of the carrier; a frequency of 0 is replaced by the rotor speed."""
    frequencies = natural_frequencies(scene)
    return float(2.0 * jnp.pi / jnp.min(jnp.where(frequencies > 0.0, frequencies, scene.drive.speed)))


def unstable_reason(tiers: str, jam: ExactJam) -> str:
    """Return a sentence with the reason why time integration cannot compute an unstable jam."""
    largest = f"largest Floquet multiplier {float(jam.fine.multiplier):.4g}"
    return f"{tiers}: jam mode {jam.mode} is unstable ({largest}), and a run leaves it"
