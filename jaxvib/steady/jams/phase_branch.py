"""One phase pattern of jammed loads over their speed."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.steady.jams.phases import PhaseStatus

_PHASE_JUMP = 0.3
"""If a phase changes by more than this, rad, between neighbouring load speeds, a figure shows another pattern."""


class PhaseBranch(Result):
    """Phase pattern over the load speed, at a fixed rotor speed.

    **Attributes** (n speeds): `omega` (n,) rad/s; `drag_factor` (n,): the factor by which the scene's drag must be multiplied
    so that the loads jam at this speed, NaN if the pattern has no jam; `phase` (n, count) rad; `growth` (n,) 1/s and `stable`
    (n,) as in `PhaseJam`; `rotor_speed` rad/s; `drag` (count,) N s/m, which the factor multiplies.
    """

    omega: Array = eqx.field(metadata=in_unit("rad/s", "omega"))
    drag_factor: Array = eqx.field(metadata=in_unit("", "omega"))
    phase: Array = eqx.field(metadata=in_unit("rad", "omega", "load"))
    growth: Array = eqx.field(metadata=in_unit("1/s", "omega"))
    stable: Array = eqx.field(metadata=in_unit("", "omega"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s"))
    drag: Array = eqx.field(metadata=in_unit("N s/m", "load"))

    @property
    def status(self) -> PhaseStatus:
        """Outcome of the search for the pattern at each load speed, a `PhaseStatus`."""
        return jax.vmap(lambda f: PhaseStatus.where(jnp.isnan(f), PhaseStatus.not_converged, PhaseStatus.found))(
            self.drag_factor
        )

    def summary(self) -> str:
        """Return the ranges of load speed and drag as text."""
        factor, omega = np.asarray(self.drag_factor), np.asarray(self.omega)
        there = np.isfinite(factor)
        if not np.any(there):
            return f"no jam from {speed_text(omega[[0, -1]], 6, ' to ')}"
        return (
            f"{np.sum(there)} of {omega.size} load speeds have a jam, {np.sum(np.asarray(self.stable))} a stable one, from "
            f"{speed_text([np.min(omega[there]), np.max(omega[there])], 6, ' to ')}, at {np.min(factor[there]):.4g} to "
            f"{np.max(factor[there]):.4g} times the drag of the scene"
        )

    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the speeds of loads and rotor over the drag; stable solid, unstable dashed.

        The drag is in N s/m, or a multiple of the scene's drag if the loads have different drags.

        **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for another unit.
        """
        from jaxvib.draw.phases import drag_diagram  # slow import

        alike = bool(np.all(np.asarray(self.drag == self.drag[0])))
        times, label = (float(self.drag[0]), "drag, N s/m") if alike else (1.0, "drag / drag of the scene")
        factor, omega, stable = drag_curve(self)
        curve = ("loads", times * factor, omega, stable)
        return drag_diagram([curve], float(self.rotor_speed), label=label, at=times, unit=unit, ax=ax)


def drag_curve(branch: PhaseBranch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return drag factor, load speed and stability for a figure; the factor is NaN if phases jump to another pattern."""
    turned = np.exp(1j * np.diff(np.asarray(branch.phase), axis=0))
    jump = np.append(False, np.max(np.abs(turned - 1.0), axis=1) > _PHASE_JUMP)
    return np.where(jump, np.nan, np.asarray(branch.drag_factor)), np.asarray(branch.omega), np.asarray(branch.stable)
