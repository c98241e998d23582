"""Dormand and Prince's step of order 8 with unrolled stages, and the common parts of its forms."""

from __future__ import annotations

import abc
import functools
import operator
from collections.abc import Callable, Sequence
from typing import ClassVar, TypeVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.numerics.fence import fence, hidden_one
from jaxvib.ode.interpolation import StepInterpolation
from jaxvib.ode.types import VF, Args, BoolScalarLike, RealScalarLike, StepResult, Terms, Y

Tree = TypeVar("Tree")

_TABLEAU = diffrax.Dopri8.tableau
_FIRST_LATE_STAGE = 5
"""First stage after stage 0 that contributes to states within a step."""

_POLYNOMIALS = np.array(
    [
        [-6.34483493928604, 22.139650499809406, -30.061056828966645, 19.999006933368396, -6.6910181737837595, 1.0],
        [-39.61079198522025, 116.44221495503422, -121.49996277313346, 52.227353279294555, -7.6142658045872675, 0.0],
        [20.376121380879145, -67.14513188259572, 83.17210046398478, -46.89191641810936, 10.728139263042886, 0.0],
        [7.334709882679536, -16.56722435274965, 9.572450755599366, -0.18908932250105956, 0.5526637063753649, 0.0],
        [32.88017743524592, -89.9916014847245, 87.84060576772056, -35.70759759462221, 4.218656262566515, 0.0],
        [-10.158899052642676, 22.623748964853284, -17.415210777076297, 6.273644808324035, -0.6627209125361597, 0.0],
        [-12.540126809878256, 32.23623401673554, -28.590328951479098, 10.316088127245076, -1.2636789001135462, 0.0],
        [29.555300148451604, -82.10203154883598, 81.66309505843414, -34.76507698666118, 5.410603789859042, 0.0],
        [-41.79234864243906, 116.26621857911195, -114.93752913770093, 47.745797107822554, -7.032137906794574, 0.0],
        [20.300692582210083, -53.90207774663854, 50.255836422617605, -19.008209934160803, 2.3537586759714983, 0.0],
    ]
)
"""Coefficients (10, 6), highest power first, of the polynomials that weight the `dense_stages` in a state within a step. Their
variable is the fraction of the step.

Source: P. Kidger's diffrax 0.7 (Apache 2.0), `diffrax/_solver/dopri8.py`, without the stages whose polynomials are 0.
"""

NODES = np.asarray(_TABLEAU.c)
"""Time of each stage except the first, as a fraction of the step."""

ROWS = np.stack([np.concatenate([row, np.zeros(len(NODES) - len(row))]) for row in _TABLEAU.a_lower])
"""Weights of earlier stages in each stage but the first; the last stage is the end of the step."""

ERROR = np.asarray(_TABLEAU.b_error)
"""Weights of the stages in the error of the step."""


def ravel(tree: PyTree[Array], directions: int = 0) -> Array:
    """Return the entries of a tree as a vector (n,), or as (n, ...) with the last `directions` axes of every array, such as an
    axis over tangents."""
    return jnp.concatenate([leaf.reshape(-1, *leaf.shape[leaf.ndim - directions :]) for leaf in jax.tree.leaves(tree)])


def unravel(flat: Array, like: Tree) -> Tree:
    """Return the tree of a vector, the inverse of `ravel`; `like` has the structure and the shapes of the tree."""
    leaves, rest = jax.tree.flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = [
        flat[end - leaf.size : end].reshape(*leaf.shape, *flat.shape[1:]) if leaf.shape else flat[end - 1]
        for end, leaf in zip(ends, leaves, strict=True)
    ]
    return jax.tree.unflatten(rest, parts)


def dense_stages(stages: Array) -> Array:
    """Return the stages that contribute to states within a step, (10, ...): the first, and all from the sixth on."""
    return jnp.concatenate([stages[:1], stages[_FIRST_LATE_STAGE:]])


def linear_combination(weights: Array, stages: Array) -> Array:
    """Return sum_j weights_j stages_j; weights (..., stages), stages (stages, ...). XLA computes a matrix product once; it
    would repeat an unrolled sum, with its weights, for each use of an entry."""
    return jnp.tensordot(weights.astype(stages.dtype), stages, 1, precision="highest")


class Dopri8Interpolation(StepInterpolation):
    """Motion within a step: y0 + (t - t0) sum_j w_j(s) k_j with the fraction s of the step, the rates k_j of the `stages`
    (10, n), see `dense_stages`, and the polynomials w_j of diffrax."""

    y0: Y
    stages: Array

    def at(self, share: Array, span: Array) -> Y:
        weights = jnp.zeros(len(_POLYNOMIALS), share.dtype)
        for column in _POLYNOMIALS.T:
            weights = weights * share + jnp.asarray(column, share.dtype)
        return self.from_weights(share * span * weights)

    def from_weights(self, weights: Array) -> Y:
        """Return y0 + sum_j weights_j k_j."""
        return jax.tree.map(lambda y, change: y + change, self.y0, unravel(linear_combination(weights, self.stages), self.y0))


class AbstractDopri8(diffrax.AbstractAdaptiveSolver):
    """Common part of the forms of Dormand and Prince's pair: everything except the computation of stages and of states within
    a step. `wrap`: function that is applied to the state after each step, or None."""

    wrap: Callable[[Y], Y] | None = None
    tableau: ClassVar[diffrax.ButcherTableau] = _TABLEAU
    term_structure: ClassVar = diffrax.AbstractTerm

    def order(self, terms: Terms) -> int:
        """Return 8."""
        return 8

    def func(self, terms: Terms, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        """Return the rates, for the choice of the first step."""
        return terms.vf(t0, y0, args)

    @abc.abstractmethod
    def advance(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: VF,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Array, Y, VF]:
        """Return the state at t1, the rates of all stages (stages, n), the error, and the internal state of the method."""

    def step(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: VF,
        made_jump: BoolScalarLike,
    ) -> StepResult:
        """Compute a step from t0 to t1: the state, its error estimate, and the stages for the interpolation within the step."""
        end, stages, error, solver_state = self.advance(terms, t0, t1, y0, args, solver_state, made_jump)
        end = end if self.wrap is None else self.wrap(end)
        return end, error, dict(y0=y0, stages=dense_stages(stages)), solver_state, diffrax.RESULTS.successful


class UnrolledDopri8(AbstractDopri8):
    """Dormand and Prince's pair of order 8(7), its 13 stages and the rates at the end of a step written out one after another.

    The results are those of `diffrax.Dopri8`. There is no loop over stages and no array of stages, so that a small time loop
    compiles into one piece of code. Each stage is fenced (see `jaxvib.numerics.fence`). Without the fences, XLA's fusion
    recomputes each stage for each use, and a step of 900 multiplications needs 4500.

    Compilation takes longer than for `LoopDopri8`; with derivatives it takes several times as long.

    For a single run, a state of one vector takes less time than a tuple of scalars: the compiled step moves fewer values to and
    from memory. For a batch, a tuple of arrays over the runs takes less time than one array.

    **Arguments**: `wrap`: function that is applied to the state after each step, for example to remove whole turns from angles.

    >>> import diffrax, jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> solution = diffrax.diffeqsolve(diffrax.ODETerm(lambda t, y, args: (y[1], -y[0])), UnrolledDopri8(), 0.0, 10.0, 0.1,
    ...                                (jnp.asarray(1.0), jnp.asarray(0.0)))
    >>> bool(abs(solution.ys[0][0] - jnp.cos(10.0)) < 1e-11)
    True

    Source: P. J. Prince and J. R. Dormand, J. Comp. Appl. Math. 7 (1981) 67; interpolation as in diffrax.
    """

    interpolation_cls: ClassVar[Callable[..., Dopri8Interpolation]] = Dopri8Interpolation

    def init(self, terms: Terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> VF:
        """Return the rates at the start, because the last stage of a step is the first stage of the next one."""
        return terms.vf(t0, y0, args)

    def advance(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: VF,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Array, Y, VF]:
        """See `AbstractDopri8.advance`."""
        # If the field may jump between steps (`made_jump` is traced), its value is computed again.
        first = solver_state if made_jump is False else terms.vf(t0, y0, args)
        one = hidden_one(jnp.asarray(t1, jax.tree.leaves(y0)[0].dtype))
        dt = terms.contr(t0, t1)
        stages = [first]
        y = y0
        for row, c in zip(ROWS, NODES, strict=True):
            y = _fenced(_stage_state(y0, dt, row[: len(stages)], stages), one)
            stages.append(_fenced(terms.vf(t0 + float(c) * dt, y, args), one, known=y))
        error = jax.tree.map(lambda *k: dt * _weighted(ERROR, k), *stages)
        return y, jnp.stack([ravel(k) for k in stages]), error, stages[-1]


def _fenced(values: Y, one: Array, known: Y = ()) -> Y:
    """Fence the values, except those that are `known` and already fenced, such as velocities among rates."""
    done = {id(leaf) for leaf in jax.tree.leaves(known)}
    return jax.tree.map(lambda leaf: leaf if id(leaf) in done else fence(leaf, one), values)


def _weighted(weights: np.ndarray, values: Sequence[Array]) -> Array:
    terms = [float(weight) * value for weight, value in zip(weights, values, strict=True) if weight != 0.0]
    return functools.reduce(operator.add, terms)


def _stage_state(y0: Y, dt: Array, weights: np.ndarray, stages: Sequence[VF]) -> Y:
    return jax.tree.map(lambda y, *k: y + dt * _weighted(weights, k), y0, *stages)
