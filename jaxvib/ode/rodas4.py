"""Rosenbrock method, without iterations, for small stiff systems with cheap Jacobians."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from typing import ClassVar, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxvib.numerics.linalg import unrolled_inverse
from jaxvib.ode.batching import VECTOR_WIDTH
from jaxvib.ode.interpolation import StepInterpolation
from jaxvib.ode.types import Args, BoolScalarLike, RealScalarLike, StepResult, Terms

_A = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.544, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.9466785280815826, 0.2557011698983284, 0.0, 0.0, 0.0, 0.0],
        [3.314825187068521, 2.896124015972201, 0.9986419139977817, 0.0, 0.0, 0.0],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895, 0.0, 0.0],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895, 1.0, 0.0],
    ]
)
_C = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-5.6688, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-2.430093356833875, -0.2063599157091915, 0.0, 0.0, 0.0, 0.0],
        [-0.1073529058151375, -9.594562251023355, -20.47028614809616, 0.0, 0.0, 0.0],
        [7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616, 0.0, 0.0],
        [8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054, 0.0],
    ]
)
_NODES = np.array([0.0, 0.386, 0.21, 0.63, 1.0, 1.0])
_TIME_WEIGHTS = np.array([0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0])
_GAMMA = 0.25
_DENSE = (
    (10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662),
    (-0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872),
)

Linearization: TypeAlias = tuple[Callable[[Array], Callable[[Array], Array]], Array]
"""Function that maps a shift to the function r -> (shift - J)^-1 r, with the Jacobian J; and the time derivative df/dt."""


class _Interpolation(StepInterpolation):
    """Interpolant (1 - s) y0 + s (y1 + (1 - s) (c_0 + s c_1)) of order 3, with the fraction s of the step and `coefficients` c
    (2, n). The rates at the ends of the step are not used, because they are inaccurate for stiff equations."""

    y0: Array
    y1: Array
    coefficients: Array

    def at(self, share: Array, span: Array) -> Array:
        inner = self.coefficients[0] + share * self.coefficients[1]
        return (1.0 - share) * self.y0 + share * (self.y1 + (1.0 - share) * inner)


class Rodas4(diffrax.AbstractAdaptiveSolver):
    """Hairer and Wanner's RODAS: a Rosenbrock method of order 4 with 6 stages, an embedded method of order 3 for the error
    estimate, and an interpolant of order 3. The method is L-stable and stiffly accurate.

        (1/(gamma h) - J) k_i = f(t + s_i h, y + sum_j a_ij k_j) + sum_j (c_ij / h) k_j + h d_i df/dt,   y_new = y + sum b_i k_i

    with nodes s_i and coefficients gamma, a_ij, b_i, c_ij and d_i.

    A step of any length costs one Jacobian J by forward mode, one inverse and 6 evaluations, without a Newton iteration. The
    state must be one vector, of at most a few dozen entries unless `linearize` is given.

    **Attribute** `linearize`: function of (terms, t, y, args) for a Jacobian that is not a dense matrix; t, y and args are the
    arguments of `terms.vf`. It returns the function that maps a shift to the function r -> (shift - J)^-1 r, and df/dt.
    Default: dense matrices

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.7.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., _Interpolation]] = _Interpolation

    linearize: Callable[[Terms, RealScalarLike, Array, Args], Linearization] | None = eqx.field(static=True, default=None)

    def order(self, terms: Terms) -> int:
        """Return 4."""
        return 4

    def error_order(self, terms: Terms) -> int:
        """Return 4: the estimated error of a step (embedded method of order 3) is proportional to the fourth power of its
        length."""
        return 4

    def init(self, terms: Terms, t0: RealScalarLike, t1: RealScalarLike, y0: Array, args: Args) -> None:
        """Return the initial state of the method, None."""

    def func(self, terms: Terms, t0: RealScalarLike, y0: Array, args: Args) -> Array:
        """Return the rates."""
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Array,
        args: Args,
        solver_state: None,
        made_jump: BoolScalarLike,
    ) -> StepResult:
        """Compute a step from t0 to t1."""
        h = t1 - t0
        # Arrays of steps are filled up with steps of length 0; 1/h must not divide by 0.
        per_step = 1.0 / jnp.where(h == 0.0, 1.0, h)
        shifted_inverse, time_derivative = (self.linearize or _dense_linearization)(terms, t0, y0, args)
        solve = shifted_inverse(per_step / _GAMMA)

        def combine(weights: Array | Sequence[float], stages: Array) -> Array:
            return functools.reduce(operator.add, (weights[i] * stages[i] for i in range(len(_A) - 1)))

        def stage(i: Array, stages: Array) -> Array:
            a, c, node, weight = (jnp.asarray(table, y0.dtype)[i] for table in (_A, _C, _NODES, _TIME_WEIGHTS))
            right = (
                terms.vf(t0 + node * h, y0 + combine(a, stages), args)
                + weight * h * time_derivative
                + per_step * combine(c, stages)
            )
            return lax.dynamic_update_index_in_dim(stages, solve(right), i, 0)

        stages = lax.fori_loop(0, len(_A), stage, jnp.zeros((len(_A), *y0.shape), y0.dtype))
        y1 = y0 + combine(_A[-1].tolist(), stages) + stages[-1]
        dense = dict(y0=y0, y1=y1, coefficients=jnp.stack([combine(row, stages) for row in _DENSE]))
        return y1, stages[-1], dense, None, diffrax.RESULTS.successful


def _dense_linearization(terms: Terms, t: RealScalarLike, y: Array, args: Args) -> Linearization:
    jacobian, time_derivative = _jacobian(terms, t, y, args)

    def shifted_inverse(shift: Array) -> Callable[[Array], Array]:
        inverse = unrolled_inverse(shift * jnp.eye(y.shape[0], dtype=y.dtype) - jacobian)
        return lambda right: jnp.sum(inverse * right[None, :], axis=1)

    return shifted_inverse, time_derivative


def _jacobian(terms: Terms, t: RealScalarLike, y: Array, args: Args) -> tuple[Array, Array]:
    """Return df/dy (n, n) and df/dt (n,), by forward mode with the tangents along a last axis, padded to whole CPU vectors."""
    n = y.shape[0]
    directions = jnp.eye(n + 1, -(-(n + 1) // VECTOR_WIDTH) * VECTOR_WIDTH, dtype=y.dtype)

    def tangent(*direction: Array) -> Array:
        numbers = (t, *(y[i] for i in range(n)))
        return jax.jvp(lambda t, *y: terms.vf(t, jnp.stack(y), args), numbers, direction)[1]

    tangents = jax.vmap(tangent, in_axes=-1, out_axes=-1)(*directions)
    return tangents[:, 1 : n + 1], tangents[:, 0]
