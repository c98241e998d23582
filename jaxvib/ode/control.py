"""Step-size control."""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import Array

__all__ = ["PIController", "WrappedController"]


class PIController(diffrax.AbstractAdaptiveStepSizeController):
    """Chooses steps whose error, in each part of the state's own unit, stays below a tolerance.

        e = max |error| / (tolerance (unit + relative |y|)),    next step = 0.9 e_before^(1/16) / e^(3/32) times this one

    a PI controller for a method of order 8, its powers made of square roots. A step with e > 1 is taken again.
    An angle grows without end; an error relative to it would let a long run lose its phase: `relative` is 0 there.
    A step whose error is not a number is taken again too, a fifth as long; where no shorter one moves time on, the run ends.

    **Attributes**: `tolerance` scalar; `unit`, `relative` trees like the integrator's state.
    """

    tolerance: Array
    unit: Any
    relative: Any

    @property
    def rtol(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What an implicit method solves its equations to."""
        return self.tolerance

    @property
    def atol(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As `rtol`."""
        return self.tolerance

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """As `rtol`."""
        return optimistix.rms_norm

    def wrap(self, direction: Any) -> PIController:
        """Time runs forward only."""
        return self

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any) -> Any:
        """The first step ends at t0 + dt0."""
        return t0 + dt0, jnp.ones_like(self.tolerance)

    def adapt_step_size(
        self, t0: Any, t1: Any, y0: Any, y1_candidate: Any, args: Any, y_error: Any, error_order: Any, controller_state: Any
    ) -> Any:
        """Whether the step is kept, and where the next one ends."""

        def ratio(error: Array, a: Array, b: Array, unit: Array, relative: Array) -> Array:
            size = self.tolerance * (unit + relative * jnp.maximum(jnp.abs(a), jnp.abs(b)))
            return jnp.max(jnp.abs(error) / size)

        ratios = jax.tree.leaves(jax.tree.map(ratio, y_error, y0, y1_candidate, self.unit, self.relative))
        e = ratios[0]
        for other in ratios[1:]:
            e = jnp.maximum(e, other)
        e = jax.lax.stop_gradient(jnp.clip(jnp.where(jnp.isnan(e), jnp.inf, e), 1e-8, 1e8))
        root = jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(e)))))
        keep = e <= 1.0
        cube = root * root * root
        factor = 0.9 * jnp.where(keep, controller_state * controller_state, 1.0 / root) / cube
        factor = jnp.clip(factor, 0.2, jnp.where(keep, 5.0, 0.9))
        start = jnp.where(keep, t1, t0)
        end = start + factor * (t1 - t0)
        before = jnp.where(keep, root, controller_state)
        return keep, start, end, False, before, moved_on(keep, start, t1, end)


def moved_on(keep: Any, start: Any, before: Any, end: Any) -> diffrax.RESULTS:
    """Whether the run can go on: a step from `start` to `before` that was refused is followed by a shorter one to `end`."""
    shorter = (end > start) & (end < before)
    return diffrax.RESULTS.where(keep | shorter, diffrax.RESULTS.successful, diffrax.RESULTS.dt_min_reached)


class WrappedController(diffrax.AbstractAdaptiveStepSizeController):
    """A controller around another one, whose tolerances it has for implicit methods."""

    controller: eqx.AbstractVar[Any]

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What an implicit method solves its equations to; a controller without one has no implicit method to serve."""
        return getattr(self.controller, "rtol", 0.0)

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As `rtol`."""
        return getattr(self.controller, "atol", 0.0)

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """As `rtol`."""
        return getattr(self.controller, "norm", optimistix.rms_norm)
