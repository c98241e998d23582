"""Transition matrices of linear equations of second order by implicit collocation, stable at any rate of decay."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.polynomial import legendre

from jaxvib.numerics.linalg import small_solve
from jaxvib.numerics.loops import repeat

_STAGES = 6
"""Number of collocation points in a step; the method then has the order 11."""

PHASE = 1.0
"""Phase of the fastest oscillation in a step, rad. The relative error of a step of order 11 is then 5e-12."""

_DECAY_ERROR = 1e-11
"""Twice the relative decay of an undamped oscillation in a step of the phase 1 rad; it is proportional to the 12th power of the
phase."""


def _radau(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes c (s,) of Radau's right quadrature on [0, 1] and the matrix a (s, s) of collocation.

    a_ij is the integral of the j-th Lagrange polynomial from 0 to the node i. Both are computed from Legendre polynomials,
    whose matrices are well conditioned; with powers in place of these polynomials, five digits would be lost.
    """
    ends = np.zeros(stages + 1)
    ends[-2:] = -1.0, 1.0  # the nodes are the roots of P_s - P_(s-1), 1 is one of them
    nodes = (1.0 + np.sort(legendre.legroots(ends).real)) / 2.0  # complex since NumPy 2.5
    nodes[-1] = 1.0
    values = legendre.legvander(2.0 * nodes - 1.0, stages - 1)
    sums = [legendre.legval(2.0 * nodes - 1.0, legendre.legint(row, lbnd=-1.0)) / 2.0 for row in np.eye(stages)]
    return nodes, np.linalg.solve(values.T, np.stack(sums)).T


NODES, _WEIGHTS = _radau(_STAGES)
"""Fractions of the step at which the equations are evaluated, the last one at the end of the step, and the matrix a of
collocation."""


def _forms() -> np.ndarray:
    """Return the coefficients of the formulas of x_i and x'_i in `transition`, (3 powers of h, 2, stages, stages + 2). The last
    axis is that of all k_j, x and x'."""
    forms, ones, stages = np.zeros((3, 2, _STAGES, _STAGES + 2)), np.ones(_STAGES), slice(0, _STAGES)
    forms[2, 0, :, stages], forms[0, 0, :, -2], forms[1, 0, :, -1] = _WEIGHTS @ _WEIGHTS, ones, NODES
    forms[1, 1, :, stages], forms[0, 1, :, -1] = _WEIGHTS, ones
    return forms


_FORMS = _forms()


def steps_for(radians: Array) -> Array:
    """Return the number of steps for the total phase of the fastest oscillation, rad. Decays need no further steps."""
    return jnp.ceil(radians / PHASE).astype(int)


def decay_error(phase: Array, steps: int | Array) -> Array:
    """Return a bound of the relative decay of an undamped oscillation in `steps` steps, from its `phase` in a step, rad."""
    return _DECAY_ERROR * phase**12 * steps


def transition(slopes: Array, h: float | Array) -> Array:
    """Return the transition matrix (2 m, 2 m) of (x, x') over a step `h` of x'' = P x + R x', by Radau's collocation.

        x_i = x + h c_i x' + h^2 sum_j (a a)_ij k_j,   x'_i = x' + h sum_j a_ij k_j,   k_i = P_i x_i + R_i x'_i

    The order is 11. The method is L-stable: motions that decay fast compared with the step vanish at its end. An example is the
    motion of a load with strong drag relative to the rotor. An explicit method would have to resolve the decay.

    **Arguments**: `slopes` [P, R] (6, m, 2 m) at `NODES`; `h`: length of the step, s. **Returns** the matrix, which is
    differentiable.
    """
    stages, m, _ = slopes.shape
    constant, linear, square = jnp.asarray(_FORMS, slopes.dtype)
    forms = constant + h * (linear + h * square)
    rows = jnp.einsum("kil,iakb->ialb", forms, slopes.reshape(stages, m, 2, m)).reshape(stages * m, -1)
    matrix, right = jnp.split(rows, [stages * m], axis=1)
    accelerations = small_solve(jnp.eye(stages * m, dtype=slopes.dtype) - matrix, right)
    whole = jnp.concatenate([accelerations, jnp.eye(2 * m, dtype=slopes.dtype)]).reshape(stages + 2, m, 2 * m)
    return jnp.tensordot(forms[:, -1], whole, 1).reshape(2 * m, 2 * m)


def flow(
    slopes: Callable[[Array], Array],
    size: int,
    duration: float,
    steps: int | Array,
    dtype: jnp.dtype,
    max_steps: int | None = None,
) -> Array:
    """Return the transition matrix (2 m, 2 m) of (x, x') over a `duration`, s, of x'' = P(t) x + R(t) x', in equal `steps`,
    with [P, R] = `slopes(t)` (m, 2 m) and m = `size`; `max_steps`: the `limit` of `repeat`."""
    h = jnp.asarray(duration / steps, dtype)

    def step(k: Array, over: Array) -> Array:
        return transition(jax.vmap(slopes)((k + jnp.asarray(NODES, dtype)) * h), h) @ over

    return repeat(step, steps, jnp.eye(2 * size, dtype=dtype), max_steps)
