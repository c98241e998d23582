"""Result of an averaged run: motion, measured quantities and status."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import speed_text
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.motion.analysis.measure import AbstractMeasured
from jaxvib.motion.run import SETTLED_DRIFT
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.steady.outcome import REFUSED

if TYPE_CHECKING:
    from jaxvib.display import SpeedUnit
    from jaxvib.draw.style import Drawn, Onto


class EnvelopeStatus(eqx.Enumeration):
    """Outcomes of an averaged run. The value of each member is the message shown to the user."""

    done = "the averaged run reached its end"
    max_steps_reached = "the averaged run needs more steps than max_steps to reach its end"
    not_finite = "the motion grew without bounds"
    no_step = "a step of the method could not be computed: its implicit equations were not solved"
    no_start = "the initial state does not exist or is not finite"
    would_separate = (
        "all loads are at nearly one angle, and this motion is unstable: slightly separated loads move away from it"
    )
    refused = REFUSED
    not_turning = "gravity does not average out: a load turns too slowly, or its drag cannot lift it against gravity"


class Envelopes(eqx.Module):
    """Averaged motion at some times.

    **Attributes** (nt times)

    - `time` (nt,), s
    - `displacement` (nt, nd), m, and `velocity` (nt, nd), m/s: complex amplitudes at the loads' mean angle
    - `amplitude` (nt, nd), m, and `foundation_force` (nt, nb), N, zero to peak
    - `omega` (nt,): mean speed of the loads, and `load_speed` (nt, count), rad/s
    - `phase` (nt, count) of each load relative to the mean angle, rad
    - `rotor_speed` (nt,), rad/s
    - `ripple` (nt, count), rad, see `Envelope`
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "time", "coordinate"))
    velocity: Array = eqx.field(metadata=in_unit("m/s or rad/s", "time", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "time", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "time", "direction"))
    omega: Array = eqx.field(metadata=in_unit("rad/s", "time"))
    load_speed: Array = eqx.field(metadata=in_unit("rad/s", "time", "load"))
    phase: Array = eqx.field(metadata=in_unit("rad", "time", "load"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "time"))
    ripple: Array = eqx.field(metadata=in_unit("rad", "time", "load"))


class Envelope(AbstractMeasured, Result):
    """Averaged run of a scene: the quantities of `AbstractMeasured` over the last turns, and the averaged motion.

    Returned by `envelope`.

    **Attributes**: those of `AbstractMeasured`, and

    - `status`: an `EnvelopeStatus`
    - `ripple` (count,), rad: amplitude of the oscillation of each load's angle that averaging omits, the largest in the window.
      It estimates the relative error of amplitudes and speeds; typical: 1e-3 to 0.1
    - `trajectory` and `window`: `Envelopes`; `trajectory` is None if only the window was requested
    - `steps`: number of accepted and rejected steps; `rejected`: number of rejected steps
    - `scene`
    """

    ripple: Array = eqx.field(metadata=in_unit("rad", "load"))
    status: EnvelopeStatus
    trajectory: Envelopes | None = eqx.field(metadata=part(prefix="trajectory_"))
    window: Envelopes = eqx.field(metadata=part(prefix="window_"))
    steps: Array = eqx.field(metadata=in_unit(""))
    rejected: Array = eqx.field(metadata=in_unit(""))
    scene: Scene = eqx.field(metadata=SCENE)

    @property
    def settled(self) -> Array:
        """True if amplitudes and speed no longer change, and slightly separated loads do not leave the motion."""
        return (self.drift < SETTLED_DRIFT) & (self.status != EnvelopeStatus.would_separate)

    def summary(self) -> str:
        """Return the outcome of the run as text; amplitudes zero to peak."""
        unstable, first = bool(self.status == EnvelopeStatus.would_separate), []
        state = "settled" if bool(self.settled) else "not settled: run longer"
        end = EnvelopeStatus[EnvelopeStatus.done] if unstable else self.message
        if unstable:
            first, state = [f"not settled: {self.message}"], "periodic only while the loads are at one angle"
        return "\n".join(
            [
                *first,
                f"{end}: {float(self.window.time[-1]):.6g} s, {int(self.steps)} steps "
                f"({int(self.rejected)} rejected), {state} (drift {float(self.drift):.1e})",
                f"  loads turn at {speed_text(self.omega, 6)} (each: {speed_text(self.load_speed, 6)}), "
                f"rotor at {speed_text(self.window.rotor_speed[-1], 6)}",
                f"  {self.extent(self.scene)}",
                f"  averaged: relative error of the order of {float(jnp.max(self.ripple)):.1e}",
            ]
        )

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot amplitudes, load and rotor speeds, and the amplitude of the foundation force over time.

        **Arguments**: `unit` and `ax` as `Run.plot`.
        """
        from jaxvib.draw.motion.histories import amplitude_histories  # slow import

        kept, structure = self.window if self.trajectory is None else self.trajectory, self.scene.machine.structure()
        return amplitude_histories(
            *map(np.asarray, (kept.time, kept.amplitude, kept.load_speed, kept.foundation_force, kept.rotor_speed)),
            names=structure.coordinates,
            units=structure.units,
            directions=structure.foundation_directions,
            unit=unit,
            ax=ax,
        )
