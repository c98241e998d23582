"""Step-size controllers for diffrax."""

import functools
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
"""Acceptance of a step; beginning and end of the next step; True if the field jumps at this beginning; new state of the
controller; outcome of the step (`successful` if the run can continue)."""

_State: TypeAlias = tuple[Array, Array | None]
"""State of `PIController`: the 32nd root of the last accepted step's error, and the remaining number of steps if it is
limited."""


class PIController(diffrax.AbstractAdaptiveStepSizeController):
    """A PI controller for a method of order 8 that keeps the error of each step below a tolerance.

        e = max |error| / (tolerance (unit + relative |y|)),    h_next = s e_before^(1/16) / e^(3/32) h

    The maximum is taken over all entries of the state y; e_before is e of the last accepted step, s a safety factor.

    - A step with e > 1 is rejected and repeated with h_next = s / e^(1/8) h
    - The powers are products of square roots, which cost less than a general power
    - Steps of constant length have e = s^32. In double precision s = 0.88 and e = 1/60, which leaves room for the sum of the
      errors of many steps. In single precision s = 0.97 and e = 0.38, because smaller estimates consist of rounding
      errors, which shorter steps hardly reduce
    - h_next / h lies between 0.2 and 5, after a rejected step between 0.2 and 0.9
    - |y| of an entry is the larger of its absolute values at the ends of the step
    - A step whose error is NaN is rejected with e = infinity. If no shorter step advances the time in its dtype, the run ends
      with `diffrax.RESULTS.dt_min_reached`
    - A run with more than `max_steps` steps, rejected ones included, ends with `diffrax.RESULTS.max_steps_reached`. The limit
      is an input of the compiled program: another limit needs no compilation

    **Attributes**

    - `tolerance`, a scalar without a unit
    - `unit`, a tree like the state: the scale of each entry, in its unit
    - `relative`, a tree like the state: the fraction of |y| that is added to the scale. It is 0 for angles: they grow without
      limit, and so would their permitted error
    - `max_steps`: a whole number, None for no limit

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
        """Relative tolerance with which an implicit method solves its algebraic equations."""
        return self.tolerance

    @property
    def atol(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance of implicit solvers, see `rtol`."""
        return self.tolerance

    @property
    def norm(self) -> Norm:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """Norm of implicit solvers, see `rtol`."""
        return optimistix.rms_norm

    def wrap(self, direction: IntScalarLike) -> "PIController":
        """Return the controller itself, because time runs forward only."""
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
        """Return the end of the first step, t0 + dt0, and the initial state of the controller."""
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
        """Return the acceptance of the step, the beginning and the end of the next one, and the state of the controller."""
        root_before, steps_left = controller_state

        def ratio(error: Array, a: Array, b: Array, unit: Array, relative: Array) -> Array:
            size = self.tolerance * (unit + relative * jnp.maximum(jnp.abs(a), jnp.abs(b)))
            return jnp.max(jnp.abs(error) / size)

        ratios = jax.tree.map(ratio, y_error, y0, y1_candidate, self.unit, self.relative)
        e = functools.reduce(jnp.maximum, jax.tree.leaves(ratios))
        e = jax.lax.stop_gradient(jnp.clip(jnp.where(jnp.isnan(e), jnp.inf, e), 1e-8, 1e8))
        root = jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(e)))))
        accept = e <= 1.0
        cube = root * root * root
        factor = (0.88 if e.dtype == jnp.float64 else 0.97) * jnp.where(accept, root_before * root_before, 1.0 / root) / cube
        factor = jnp.clip(factor, 0.2, jnp.where(accept, 5.0, 0.9))
        start = jnp.where(accept, t1, t0)
        end = start + factor * (t1 - t0)
        root = jnp.where(accept, root, root_before)
        result = step_success(accept, start, t1, end)
        if steps_left is not None:
            steps_left = steps_left - 1
            result = diffrax.RESULTS.where(steps_left >= 0, result, diffrax.RESULTS.max_steps_reached)
        return accept, start, end, False, (root, steps_left), result


def step_success(
    accept: BoolScalarLike, start: RealScalarLike, last_end: RealScalarLike, end: RealScalarLike
) -> diffrax.RESULTS:
    """Return the outcome of a step that ended at `last_end`. After a rejected step, `end` of the next step must lie between its
    `start` and `last_end`."""
    shorter = (end > start) & (end < last_end)
    return diffrax.RESULTS.where(accept | shorter, diffrax.RESULTS.successful, diffrax.RESULTS.dt_min_reached)


class WrappedController(diffrax.AbstractAdaptiveStepSizeController):
    """Controller that wraps another `controller` and passes its tolerances to implicit methods."""

    controller: eqx.AbstractVar[diffrax.AbstractStepSizeController]

    @property
    def rtol(self) -> RealScalarLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Tolerance of an implicit method; 0 if the inner controller has no tolerance, for example with constant steps."""
        return getattr(self.controller, "rtol", 0.0)

    @property
    def atol(self) -> RealScalarLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance of implicit solvers, see `rtol`."""
        return getattr(self.controller, "atol", 0.0)

    @property
    def norm(self) -> Norm:  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        """Norm of implicit solvers, see `rtol`."""
        return getattr(self.controller, "norm", optimistix.rms_norm)
