"""Step-size controllers for diffrax."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import Array
from jaxtyping import PyTree

from jaxvib.ode.types import VF, Args, BoolScalarLike, IntScalarLike, Norm, RealScalarLike, Terms, Y

Decision: TypeAlias = tuple[BoolScalarLike, RealScalarLike, RealScalarLike, BoolScalarLike, PyTree[Array], diffrax.RESULTS]
"""Acceptance of a step, beginning and end of the next one, True if the field jumps there, new state of the controller, True if
the run can go on."""

_State: TypeAlias = tuple[Array, Array | None]
"""State of `PIController`: the 32nd root of the last accepted step's error, and the remaining steps if they are limited."""


class PIController(diffrax.AbstractAdaptiveStepSizeController):
    """A PI controller for a method of order 8 that keeps the error of each step below a tolerance.

        e = max |error| / (tolerance (unit + relative |y|)),    h_next = s e_before^(1/16) / e^(3/32) h

    over all numbers of the state y; a step with e > 1 is rejected and tried again with h_next = s / e^(1/8) h. The exponents
    are products of square roots, which cost less than a power. Steps that stay as long as they are have e = s^32: in double
    precision s = 0.88 and e = 1/60, so that what adds up over 10^5 steps stays near the tolerance; in single precision s = 0.97
    and e = 0.38, since estimates of less than that are soon errors of rounding, which shorter steps hardly lessen. h_next / h
    lies between 0.2 and 5. A step whose error is not a number is rejected with e = infinity; where no shorter step advances the
    time in its dtype, the run ends with `diffrax.RESULTS.dt_min_reached`, with more than `max_steps` steps with
    `diffrax.RESULTS.max_steps_reached`: a limit that is a number of the program, so that another one needs no other program.

    **Attributes**: `tolerance` scalar, without a unit; `unit` and `relative`, trees like the state, of what counts as 1 in each
    of its numbers (in its unit) and of which share of |y| is added to it. `relative` is 0 for angles: they grow without end,
    and an error relative to them would let a long run lose its phase. `max_steps` a whole number, or None.

    >>> import diffrax, jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> control = PIController(jnp.asarray(1e-9), jnp.asarray(1.0), jnp.asarray(1.0))
    >>> end = diffrax.diffeqsolve(diffrax.ODETerm(lambda t, y, args: -y), diffrax.Dopri8(), 0.0, 1.0, 0.1, jnp.asarray(1.0),
    ...                           stepsize_controller=control).ys[0]
    >>> bool(abs(end - jnp.exp(-1.0)) < 1e-9)
    True
    """

    tolerance: Array
    unit: PyTree[Array]
    relative: PyTree[Array]
    max_steps: Array | None = None

    @property
    def rtol(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Tolerance of the equations of an implicit method."""
        return self.tolerance

    @property
    def atol(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance of implicit solvers, see `rtol`."""
        return self.tolerance

    @property
    def norm(self) -> Norm:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """Norm of implicit solvers, see `rtol`."""
        return optimistix.rms_norm

    def wrap(self, direction: IntScalarLike) -> PIController:
        """Return the controller itself, since time runs forward only."""
        return self

    def init(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        dt0: RealScalarLike,
        args: Args,
        func: Callable[[Terms, RealScalarLike, Y, Args], VF],
        error_order: RealScalarLike | None,
    ) -> tuple[RealScalarLike, _State]:
        """The first step ends at t0 + dt0."""
        return t0 + dt0, (jnp.ones_like(self.tolerance), self.max_steps)

    def adapt_step_size(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        y1_candidate: Y,
        args: Args,
        y_error: Y,
        error_order: RealScalarLike,
        controller_state: _State,
    ) -> Decision:
        """Acceptance of the step, beginning and end of the next one, and state of the controller."""
        root_before, left = controller_state

        def ratio(error: Array, a: Array, b: Array, unit: Array, relative: Array) -> Array:
            size = self.tolerance * (unit + relative * jnp.maximum(jnp.abs(a), jnp.abs(b)))
            return jnp.max(jnp.abs(error) / size)

        ratios = jax.tree.leaves(jax.tree.map(ratio, y_error, y0, y1_candidate, self.unit, self.relative))
        e = ratios[0]
        for other in ratios[1:]:
            e = jnp.maximum(e, other)
        e = jax.lax.stop_gradient(jnp.clip(jnp.where(jnp.isnan(e), jnp.inf, e), 1e-8, 1e8))
        root = jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(e)))))
        accept = e <= 1.0
        cube = root * root * root
        factor = (0.88 if e.dtype == jnp.float64 else 0.97) * jnp.where(accept, root_before * root_before, 1.0 / root) / cube
        factor = jnp.clip(factor, 0.2, jnp.where(accept, 5.0, 0.9))
        start = jnp.where(accept, t1, t0)
        end = start + factor * (t1 - t0)
        root = jnp.where(accept, root, root_before)
        result = moved_on(accept, start, t1, end)
        if left is not None:
            left = left - 1
            result = diffrax.RESULTS.where(left >= 0, result, diffrax.RESULTS.max_steps_reached)
        return accept, start, end, False, (root, left), result


def moved_on(accept: BoolScalarLike, start: RealScalarLike, before: RealScalarLike, end: RealScalarLike) -> diffrax.RESULTS:
    """True if the run can go on: a rejected step from `start` to `before` must be followed by a shorter one, to `end`."""
    shorter = (end > start) & (end < before)
    return diffrax.RESULTS.where(accept | shorter, diffrax.RESULTS.successful, diffrax.RESULTS.dt_min_reached)


class WrappedController(diffrax.AbstractAdaptiveStepSizeController):
    """Controller that wraps another `controller` and passes its tolerances to implicit methods."""

    controller: eqx.AbstractVar[diffrax.AbstractStepSizeController]

    @property
    def rtol(self) -> RealScalarLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Tolerance of an implicit method; 0 if the inner controller has none, such as that of constant steps."""
        return getattr(self.controller, "rtol", 0.0)

    @property
    def atol(self) -> RealScalarLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance of implicit solvers, see `rtol`."""
        return getattr(self.controller, "atol", 0.0)

    @property
    def norm(self) -> Norm:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """Norm of implicit solvers, see `rtol`."""
        return getattr(self.controller, "norm", optimistix.rms_norm)
