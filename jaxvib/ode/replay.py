"""Step-replay adjoint: reverse derivatives of runs with adaptive steps."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple, NoReturn, TypeAlias, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import PyTree

from jaxvib.errors import InputError
from jaxvib.ode.batching import flat_tangents
from jaxvib.ode.types import Args, Y
from jaxvib.runtime.compat import fast_diffrax_loop_end, no_host_checks
from jaxvib.runtime.primitive import CAN_DEFINE_PRIMITIVES, primitive

T = TypeVar("T")

_Inputs: TypeAlias = tuple[Array, Array | None, Y, Args, diffrax.SaveAt, diffrax.ODETerm, Array | None]
"""Differentiated arguments: the end, the first step, the initial state, the arguments, the saved times, the equations, and the
times at which the field jumps."""

_Rest: TypeAlias = tuple[diffrax.AbstractSolver, int, diffrax.AbstractProgressMeter]
"""Other arguments: the method, the largest number of steps, the progress meter."""


def solve(
    term: diffrax.ODETerm,
    solver: diffrax.AbstractSolver,
    *,
    end: Array,
    first_step: Array | None,
    y0: Y,
    args: Args,
    saveat: diffrax.SaveAt,
    controller: diffrax.AbstractStepSizeController,
    adjoint: diffrax.AbstractAdjoint | None,
    max_steps: int,
    progress: diffrax.AbstractProgressMeter | None = None,
) -> diffrax.Solution:
    """Integrate by `diffrax.diffeqsolve` from time 0 to `end`; a failure is reported in the result, not raised.

    Reverse derivatives replay the steps that the run has taken. If the controller chose the steps again in the backward pass,
    these steps would differ by rounding errors. After some hundred turns, the derivatives would not match the run (errors up to
    1e-3). Therefore a run that is differentiated records the end of each step and some of the states. The backward pass
    recomputes the states between the recorded states and transposes each step separately, from the last one to the first:

        (y_i+1, dense_i) = step(y_i, t_i, t_i+1, numbers),    saved(t) = within(dense_i, t_i, t_i+1, t)

    Here dense_i interpolates step i, and numbers are the arrays in the arguments and in the equations. The ends of steps are
    constants, with three exceptions: the last step ends at `end`, steps end at the jumps of the field (`jump_ts` of the
    controller), and constant steps depend on `end` and `first_step`. A run without derivatives is computed once, and records
    nothing.

    **Arguments**: `adjoint`: an adjoint of diffrax in place of the replay, such as `diffrax.ForwardMode()` for forward
    derivatives. Functions among the arguments must not contain traced arrays; pass these in `args`. `saveat` saves states at
    given times and at the end. Rates must be the only values that the method carries over to its next step; the replay computes
    them again. The other arguments are as in diffrax.

    **Returns** diffrax's `Solution`.
    """
    inputs = (end, first_step, y0, args, saveat, term, _jump_times(controller))
    rest = (solver, max_steps, diffrax.NoProgressMeter() if progress is None else progress)
    if adjoint is not None:
        return _solve(inputs, controller, adjoint, *rest)
    numbers, others = eqx.partition(controller, eqx.is_array)
    inputs = _require_reverse(inputs)
    return _with_replay(inputs, eqx.combine(jax.lax.stop_gradient(numbers), others), *rest)


@no_host_checks()
@fast_diffrax_loop_end()
def _solve(
    inputs: _Inputs,
    controller: diffrax.AbstractStepSizeController,
    adjoint: diffrax.AbstractAdjoint,
    solver: diffrax.AbstractSolver,
    max_steps: int,
    progress: diffrax.AbstractProgressMeter,
) -> diffrax.Solution:
    end, first_step, y0, args, saveat, term, _ = inputs
    return diffrax.diffeqsolve(
        term,
        solver,
        t0=jnp.zeros_like(end),
        t1=end,
        dt0=first_step,
        y0=y0,
        args=args,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=progress,
    )


def _require_reverse(inputs: _Inputs) -> _Inputs:
    """Return the inputs; a program that contains their forward derivatives raises `InputError` when it is compiled or run.

    Without this function JAX would raise its own error, `can't apply forward-mode autodiff to a custom_vjp function`. Neither
    error can be raised before the program is compiled, because `linearize` may be the beginning of a reverse derivative.
    """
    if not CAN_DEFINE_PRIMITIVES:
        return inputs
    numbers, others = eqx.partition(inputs, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(numbers)
    return eqx.combine(jax.tree.unflatten(structure, _reverse_only(leaves)), others)


@jax.custom_jvp
def _reverse_only(numbers: list[Array]) -> list[Array]:
    return numbers


@functools.partial(_reverse_only.defjvp, symbolic_zeros=True)
def _reverse_only_jvp(primals: Any, tangents: Any) -> tuple[list[Array], list[Any]]:
    (numbers,), (slopes,) = primals, tangents
    nonzero = iter(_reverse_tangents(*(slope for slope in slopes if not isinstance(slope, SymbolicZero))))
    return numbers, [slope if isinstance(slope, SymbolicZero) else next(nonzero) for slope in slopes]


def _refuse_forward(*_: object) -> NoReturn:
    raise InputError(
        "adjoint",
        "supports reverse-mode derivatives only; for jvp, jacfwd and linearize of a run use adjoint=diffrax.ForwardMode()",
    )


_reverse_tangents = primitive(
    "reverse_tangents",
    impl=_refuse_forward,
    batching_rule=_refuse_forward,
    transpose=lambda cotangents, *_: cotangents,
    lowering=_refuse_forward,
    abstract_eval=lambda *types: types,
)
"""Primitive that returns tangents and can only be transposed."""


def forward_only(outputs: T, field: str, problem: str) -> T:
    """Return the outputs; their reverse derivatives raise `InputError` instead of JAX's error about loops. They must be the
    last values of a computation without a reverse derivative, because JAX transposes these first."""
    if not CAN_DEFINE_PRIMITIVES:
        return outputs
    numbers, others = eqx.partition(outputs, eqx.is_inexact_array)

    @jax.custom_jvp
    def unchanged(leaves: list[Array]) -> list[Array]:
        return leaves

    unchanged.defjvp(lambda primals, slopes: (primals[0], _forward_tangents(*slopes[0], field=field, problem=problem)))
    leaves, structure = jax.tree.flatten(numbers)
    return eqx.combine(jax.tree.unflatten(structure, unchanged(leaves)), others)


def differentiable_once(inputs: T, field: str, problem: str) -> T:
    """Return the inputs of a computation; derivatives of its first derivatives with respect to them raise `InputError`."""
    if not CAN_DEFINE_PRIMITIVES:
        return inputs
    numbers, others = eqx.partition(inputs, eqx.is_inexact_array)

    @jax.custom_jvp
    def unchanged(leaves: list[Array]) -> list[Array]:
        return leaves

    unchanged.defjvp(lambda primals, slopes: (_constants(*primals[0], field=field, problem=problem), slopes[0]))
    leaves, structure = jax.tree.flatten(numbers)
    return eqx.combine(jax.tree.unflatten(structure, unchanged(leaves)), others)


def _refuse_derivative(primals: object, tangents: object, *, field: str, problem: str) -> NoReturn:
    raise InputError(field, problem)


_constants = primitive(
    "constants",
    impl=lambda *numbers, **_: list(numbers),
    batching_rule=lambda numbers, axes, **named: (_constants(*numbers, **named), list(axes)),
    jvp=_refuse_derivative,
    lowering=lambda *numbers, **_: list(numbers),
    abstract_eval=lambda *types, **_: types,
)
"""Primitive that returns numbers and has no derivatives. JAX drops the rule of a `custom_jvp` in reverse derivatives of loops,
but not that of a primitive."""


def _refuse_reverse(*_: object, field: str, problem: str) -> NoReturn:
    raise InputError(field, problem)


_NO_SECOND_REVERSE = (
    "has no reverse derivatives of reverse derivatives; for second derivatives of a run use forward over reverse, "
    "jax.hessian(f) or jax.jacfwd(jax.jacrev(f)), in place of jax.jacrev(jax.jacrev(f))"
)

_forward_tangents = primitive(
    "forward_tangents",
    impl=lambda *tangents, **_: list(tangents),
    batching_rule=lambda tangents, axes, **named: (_forward_tangents(*tangents, **named), list(axes)),
    transpose=_refuse_reverse,
    lowering=lambda *tangents, **_: list(tangents),
    abstract_eval=lambda *types, **_: types,
)
"""Primitive that returns tangents and cannot be transposed."""


@eqx.filter_custom_vjp
def _with_replay(inputs: _Inputs, controller: diffrax.AbstractStepSizeController, *rest: *_Rest) -> diffrax.Solution:
    return _solve(inputs, controller, diffrax.ForwardMode(), *rest)


class _Record(NamedTuple):
    """Number of `steps` of a run, their `ends` (max_steps,), s, and the `states` after every n-th step, see `_spacing`."""

    steps: Array
    ends: Array
    states: Y


class _Slopes(NamedTuple):
    """State of the backward pass. Each field is the derivative with respect to the quantity of its name; `numbers` are the
    arrays of arguments and equations. `ahead`: index of the last saved time that the pass has not reached yet."""

    state: Y
    numbers: PyTree[Array | None]
    end: Array
    first_step: Array
    jumps: Array | None
    times: Array
    ahead: Array


@_with_replay.def_fwd
def _forward(
    perturbed: PyTree[bool], inputs: _Inputs, controller: diffrax.AbstractStepSizeController, *rest: *_Rest
) -> tuple[diffrax.Solution, _Record]:
    """Integrate, and record the run."""
    end, first_step, y0, args, saveat, term, jumps = inputs
    ends = diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: None)
    states = diffrax.SubSaveAt(steps=_spacing(y0, rest[1]))
    recorded_inputs = (end, first_step, y0, args, diffrax.SaveAt(subs=[saveat.subs, ends, states]), term, jumps)
    solution = _solve(recorded_inputs, controller, diffrax.ForwardMode(), *rest)
    assert solution.ts is not None and solution.ys is not None
    record = _Record(solution.stats["num_accepted_steps"], solution.ts[1], solution.ys[2])
    return eqx.tree_at(lambda s: (s.ts, s.ys), solution, (solution.ts[0], solution.ys[0])), record


def _spacing(y0: Y, max_steps: int) -> int:
    """Return the number of steps between recorded states; 1 if this needs at most 1 MiB."""
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(y0))
    return max(1, min(-(-max_steps * size // 2**20), max_steps))


@_with_replay.def_bwd
def _backward(
    record: _Record,
    cotangents: PyTree[Array | None],
    perturbed: PyTree[bool],
    inputs: _Inputs,
    controller: diffrax.AbstractStepSizeController,
    *rest: *_Rest,
) -> PyTree[Array | None]:
    end, _, y0, _, saveat, _, _ = inputs
    differentiable, fixed = eqx.partition(inputs, perturbed)
    backward = _BackwardPass(
        record=record,
        solver=_with_tolerances(rest[0], controller),
        controller=controller,
        numbers=(differentiable[3], differentiable[5]),
        others=(fixed[3], fixed[5]),
        saved=_saved(saveat, cotangents.ys, y0),
        y0=y0,
        every=_spacing(y0, rest[1]),
    )
    slopes = forward_only(backward.slopes(jnp.zeros_like(end)), "adjoint", _NO_SECOND_REVERSE)
    return _by_inputs(differentiable, cotangents, saveat, controller, backward.saved, slopes)


@dataclasses.dataclass(frozen=True)
class _BackwardPass:
    """Backward pass over the steps of a run, from the last one to the first.

    **Attributes**: the `record`, with one state for each `every` steps; the `numbers` of arguments and equations that are
    differentiated, and the `others`; `saved`: the derivatives with respect to saved states.
    """

    record: _Record
    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    numbers: PyTree[Array | None]
    others: PyTree[Array | None]
    saved: _Saved
    y0: Y
    every: int

    def slopes(self, zero: Array) -> _Slopes:
        """Return the derivatives after the whole backward pass; `zero` has the type of times."""
        times, jumps = self.saved.times, _jump_times(self.controller)
        reached = self.span(self.record.steps - 1)[1]
        slopes = _Slopes(
            state=self.saved.last,
            numbers=jax.tree.map(jnp.zeros_like, self.numbers),
            end=zero,
            first_step=zero,
            jumps=None if jumps is None else jnp.zeros_like(jumps),
            times=jnp.zeros_like(times),
            ahead=jnp.searchsorted(times, reached, side="right") - 1,
        )
        start = ((self.record.steps - 1) // self.every, slopes)
        return jax.lax.while_loop(lambda carry: carry[0] >= 0, lambda carry: self.to_recorded_state(*carry), start)[1]

    def span(self, i: Array) -> tuple[Array, Array]:
        """Start and end of step i."""
        start = self.record.ends[jnp.maximum(i - 1, 0)]
        return jnp.where(i == 0, 0.0, start), _end_before(self.controller, self.record.ends[i])

    def share_of_jumps(self, j: Array) -> Array:
        """Return the derivatives of the start of step j with respect to the jumps of the field, (jumps,): 1 for the jump at
        this time, or equal parts of 1 for several."""
        start = self.record.ends[jnp.maximum(j - 1, 0)]
        is_at = (j > 0) & (jnp.nextafter(start, -jnp.inf) == _jump_times(self.controller))
        return is_at.astype(self.record.ends.dtype) / jnp.maximum(jnp.sum(is_at), 1)

    def step(self, y: Y, t0: Array, t1: Array, numbers: PyTree[Array | None]) -> tuple[Y, PyTree[Array]]:
        """Return the state after a step, and the data of the interpolation within it."""
        args, term = eqx.combine(numbers, self.others)
        # The step is computed without values of the previous step, as after a jump.
        y1, _, dense, _, _ = self.solver.step(term, t0, t1, y, args, self.solver.init(term, t0, t1, y, args), True)
        return y1, dense

    def over_step(self, i: Array, y: Y, slopes: _Slopes) -> _Slopes:
        """Return the derivatives before step i, which begins at the state y."""
        t0, t1 = self.span(i)
        before = jnp.where(i == 0, -jnp.inf, self.span(jnp.maximum(i - 1, 0))[1])
        (_, dense), transposed = jax.vjp(self.step, y, t0, t1, self.numbers)
        ahead, by_times, (by_dense, *by_span) = self.over_saved(dense, t0, t1, before, slopes)
        by_y, by_start, by_end, by_numbers = transposed((slopes.state, by_dense))
        by_bounds = ((i, by_start + by_span[0]), (i + 1, by_end + by_span[1]))
        steps = self.record.steps
        return _Slopes(
            state=by_y,
            numbers=jax.tree.map(jnp.add, slopes.numbers, by_numbers),
            end=slopes.end + sum(_share_of_end(self.controller, steps, j) * by for j, by in by_bounds),
            first_step=slopes.first_step + sum(jnp.where((j == 1) & (steps > 1), by, 0.0) for j, by in by_bounds),
            jumps=None if slopes.jumps is None else slopes.jumps + sum(self.share_of_jumps(j) * by for j, by in by_bounds),
            times=by_times,
            ahead=ahead,
        )

    def over_saved(
        self, dense: PyTree[Array], t0: Array, t1: Array, before: Array, slopes: _Slopes
    ) -> tuple[Array, Array, PyTree[Array]]:
        """Return the derivatives of the states saved in a step from t0 to t1 (after the time `before`) with respect to its
        interpolation, t0 and t1."""
        times = self.saved.times

        def within(dense: PyTree[Array], t0: Array, t1: Array, t: Array) -> Y:
            return self.solver.interpolation_cls(t0=t0, t1=t1, **dense).evaluate(t)

        def is_within(carry: tuple[Array, Array, PyTree[Array]]) -> Array:
            return (carry[0] >= 0) & (times[carry[0]] > before)

        def add_saved_state(carry: tuple[Array, Array, PyTree[Array]]) -> tuple[Array, Array, PyTree[Array]]:
            k, by_times, by_step = carry
            slope = jax.tree.map(lambda dy: dy[k], self.saved.states)
            *more, by_time = jax.vjp(within, dense, t0, t1, times[k])[1](slope)
            return k - 1, by_times.at[k].set(by_time), jax.tree.map(jnp.add, by_step, tuple(more))

        zeros = jax.tree.map(jnp.zeros_like, (dense, t0, t1))
        carry = (slopes.ahead, slopes.times, zeros)
        return jax.lax.while_loop(is_within, add_saved_state, carry) if times.size else carry

    def to_recorded_state(self, n: Array, slopes: _Slopes) -> tuple[Array, _Slopes]:
        """Return n - 1, and the derivatives at the n-th recorded state from those after the steps that follow it."""
        first, count = n * self.every, jnp.minimum(self.every, self.record.steps - n * self.every)
        recorded = jax.tree.map(lambda y, ys: jnp.where(n == 0, y, ys[jnp.maximum(n - 1, 0)]), self.y0, self.record.states)
        if self.every == 1:
            return n - 1, self.over_step(n, recorded, slopes)

        plain = dataclasses.replace(self, solver=_with_forward_derivatives(self.solver))

        def recompute(j: Array, states: Y) -> Y:
            y, _ = plain.step(jax.tree.map(lambda ys: ys[j], states), *self.span(first + j), self.numbers)
            return jax.tree.map(lambda ys, y: ys.at[j + 1].set(y), states, y)

        states = jax.tree.map(lambda y: jnp.zeros((self.every, *y.shape), y.dtype).at[0].set(y), recorded)
        states = jax.lax.fori_loop(0, count - 1, recompute, states)

        def from_last(j: Array, slopes: _Slopes) -> _Slopes:
            k = count - 1 - j
            return self.over_step(first + k, jax.tree.map(lambda ys: ys[k], states), slopes)

        return n - 1, jax.lax.fori_loop(0, count, from_last, slopes)


def _with_forward_derivatives(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """Return the method with loops over stages that have forward derivatives, for steps that are only computed again."""
    if not isinstance(solver, diffrax.AbstractRungeKutta) or solver.scan_kind is not None:
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, "lax", is_leaf=lambda leaf: leaf is None)


def _with_tolerances(solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController) -> diffrax.AbstractSolver:
    """Return an implicit method with the tolerances of the controller, unless the method has its own tolerances."""
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    finder = solver.root_finder
    missing = [name for name in ("rtol", "atol") if not eqx.is_inexact_array_like(getattr(finder, name))]
    missing += [] if callable(finder.norm) else ["norm"]
    values = [getattr(controller, name) for name in missing]
    return eqx.tree_at(lambda s: [getattr(s.root_finder, name) for name in missing], solver, values) if missing else solver


def _share_of_end(controller: diffrax.AbstractStepSizeController, count: Array, j: Array) -> Array:
    """Return the derivative of the start of step j of `count` with respect to the end of the run.

    With constant steps it is j/count for j > 1, because the first step ends at `first_step`. With adaptive steps only the end
    of the last step depends on the end of the run.
    """
    if isinstance(controller, diffrax.ConstantStepSize):
        return jnp.where((j > 1) | (count == 1), j / count, 0.0)
    return jnp.where(j == count, 1.0, 0.0)


def _end_before(controller: diffrax.AbstractStepSizeController, start: Array) -> Array:
    """Return the end of the step before the one that begins at `start`: the same time, or the time just before a jump of the
    field."""
    jumps = _jump_times(controller)
    if jumps is None:
        return start
    jump = jnp.nextafter(start, -jnp.inf)
    return jnp.where(jnp.any(jump == jumps), jnp.nextafter(jump, -jnp.inf), start)


def _jump_times(controller: diffrax.AbstractStepSizeController) -> Array | None:
    """Return the times at which the field jumps, (jumps,); None for a controller without jumps."""
    return getattr(controller, "jump_ts", None)


class _Saved(NamedTuple):
    """Derivatives with respect to the saved `states` at ascending `times`, and to the `last` state; `places`: index of each
    time in the concatenated lists of times."""

    times: Array
    states: Y
    last: Y
    places: Array


def _saved(saveat: diffrax.SaveAt, slopes: PyTree[Array | None], y0: Y) -> _Saved:
    times, states, last = [], [], [jax.tree.map(jnp.zeros_like, y0)]
    for sub, slope in zip(saveat.subs, slopes, strict=True):
        count = (0 if sub.ts is None else sub.ts.size) + sub.t1
        leaves, rest = jax.tree.flatten(y0)
        pairs = zip(leaves, flat_tangents(slope, y0), strict=True)
        whole = rest.unflatten([jnp.zeros((count, *y.shape), y.dtype) if dy is None else dy for y, dy in pairs])
        if sub.t1:
            last.append(jax.tree.map(lambda dy: dy[-1], whole))
        if sub.ts is not None:
            times.append(sub.ts)
            states.append(jax.tree.map(lambda dy, n=sub.ts.size: dy[:n], whole))
    all_times = jnp.concatenate(times) if times else jnp.zeros(0)
    places = jnp.argsort(all_times)
    all_states = jax.tree.map(lambda *dy: jnp.concatenate(dy)[places], *states) if states else None
    return _Saved(all_times[places], all_states, jax.tree.map(lambda *dy: sum(dy), *last), places)


def _by_inputs(
    differentiable: PyTree[Array | None],
    cotangents: PyTree[Array | None],
    saveat: diffrax.SaveAt,
    controller: diffrax.AbstractStepSizeController,
    saved: _Saved,
    slopes: _Slopes,
) -> PyTree[Array | None]:
    """Return the derivatives with respect to the differentiated inputs, None for the others."""
    by_end, by_times = slopes.end, []
    parts = jnp.zeros_like(slopes.times).at[saved.places].set(slopes.times)
    for sub, by_ts in zip(saveat.subs, cotangents.ts, strict=True):
        if sub.ts is not None:
            by_time, parts = parts[: sub.ts.size], parts[sub.ts.size :]
            by_times.append(by_time if by_ts is None else by_time + by_ts[: sub.ts.size])
        if sub.t1 and by_ts is not None:
            by_end = by_end + by_ts[-1]
    if cotangents.t1 is not None:
        by_end = by_end + cotangents.t1
    end, first_step, _, _, saves, _, jumps = differentiable
    constant = isinstance(controller, diffrax.ConstantStepSize)
    where = [k for k, sub in enumerate(saveat.subs) if sub.ts is not None and saves.subs[k].ts is not None]
    given = dict(zip([k for k, sub in enumerate(saveat.subs) if sub.ts is not None], by_times, strict=True))
    if where:
        saves = eqx.tree_at(lambda s: [s.subs[k].ts for k in where], saves, [given[k] for k in where])
    return (
        None if end is None else by_end,
        None if first_step is None else slopes.first_step if constant else jnp.zeros_like(slopes.first_step),
        slopes.state,
        slopes.numbers[0],
        saves,
        slopes.numbers[1],
        None if jumps is None else slopes.jumps,
    )
