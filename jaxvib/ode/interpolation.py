"""States within a step."""

from __future__ import annotations

import abc
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.ode.types import RealScalarLike, Y


class StepInterpolation(diffrax.AbstractLocalInterpolation):
    """States within a step from `t0` to `t1` as functions of the fraction of the step, which is 0 for a step of length 0."""

    t0: Any
    t1: Any

    @abc.abstractmethod
    def at(self, share: Array, span: Array) -> Y:
        """Return the state at the fraction `share` of a step of length `span`."""

    def evaluate(self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True) -> Y:
        """Return the state at `t0`; if `t1` is given, return the change of the state from `t0` to `t1`."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        span = self.t1 - self.t0
        share = jnp.where(span == 0.0, 0.0, (t0 - self.t0) / jnp.where(span == 0.0, 1.0, span))
        return self.at(share, span)
