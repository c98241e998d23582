"""A progress meter for one time integration."""

from __future__ import annotations

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.ode.types import RealScalarLike


class ProgressMeter(diffrax.AbstractProgressMeter):
    """Progress of a run, in steps of one percent.

    **Arguments**: `show`: a function that is called with the finished share of the time (0 to 1).
    """

    show: Callable[[float], None] = eqx.field(static=True)

    def init(self) -> Array:
        """Return the state of the meter, the progress that is shown: 0."""
        return jnp.array(0.0)

    def step(self, state: Array, progress: RealScalarLike) -> Array:
        """Show `progress` if it has increased by one percent."""
        progress = jnp.asarray(progress, dtype=state.dtype)
        further = (progress - state > 0.01) | (progress >= 1.0)
        jax.lax.cond(further, lambda p: jax.debug.callback(self._show, p), lambda p: None, progress)
        return jnp.where(further, progress, state)

    def close(self, state: Array) -> None:
        """End without a further call."""

    def _show(self, progress: Array) -> None:
        self.show(float(progress))
