"""Reverse derivatives of runs whose steps are chosen on the way."""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.ode.control import WrappedController

__all__ = ["solve"]


def solve(
    term: diffrax.ODETerm,
    solver: diffrax.AbstractSolver,
    *,
    end: Array,
    first_step: Array | None,
    y0: Any,
    args: Any,
    saveat: diffrax.SaveAt,
    controller: diffrax.AbstractStepSizeController,
    adjoint: diffrax.AbstractAdjoint | None,
    max_steps: int,
    progress: diffrax.AbstractProgressMeter | None = None,
) -> diffrax.Solution:
    """`diffrax.diffeqsolve` from time 0 to `end`, which fails by its result alone.

    Reverse derivatives go back over checkpoints, from which the run is computed once more. An adaptive controller that
    computes its steps once more as well finds them a rounding apart, and the next ones further: after some hundred turns they
    are other steps, whose derivatives no longer fit each other (off by up to 1e-3). So the steps are noted in a first run,
    and it is those that are differentiated. A run of which no derivative is taken is done once, and notes nothing.

    **Arguments**: `adjoint` diffrax's, for another way: `diffrax.ForwardMode()` for forward derivatives. No function among the
    arguments may hold on to traced arrays; `args` is for them. The others are as in diffrax.

    **Returns** diffrax's `Solution`.
    """
    inputs = (end, first_step, y0, args, saveat, term)
    rest = (solver, max_steps, diffrax.NoProgressMeter() if progress is None else progress)
    if adjoint is not None:
        return _solve(inputs, controller, adjoint, *rest)
    numbers, others = eqx.partition(controller, eqx.is_array)
    return _once(inputs, eqx.combine(jax.lax.stop_gradient(numbers), others), *rest)


def _solve(inputs: Any, controller: Any, adjoint: Any, solver: Any, max_steps: int, progress: Any) -> diffrax.Solution:
    end, first_step, y0, args, saveat, term = inputs
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


@eqx.filter_custom_vjp
def _once(inputs: Any, controller: Any, *rest: Any) -> diffrax.Solution:
    return _solve(inputs, controller, diffrax.ForwardMode(), *rest)


@_once.def_fwd
def _recorded(perturbed: Any, inputs: Any, controller: Any, *rest: Any) -> tuple[diffrax.Solution, Array | None]:
    """The run, and the times at which its steps end."""
    if isinstance(controller, (diffrax.ConstantStepSize, diffrax.StepTo)):
        return _solve(inputs, controller, diffrax.ForwardMode(), *rest), None
    *others, saveat, term = inputs
    steps = diffrax.SubSaveAt(steps=True, fn=_nothing)
    noting = (*others, diffrax.SaveAt(subs=[saveat.subs, steps]), term)
    solution = _solve(noting, controller, diffrax.ForwardMode(), *rest)
    assert solution.ts is not None and solution.ys is not None
    times = solution.ts[1]
    return eqx.tree_at(lambda s: (s.ts, s.ys), solution, (solution.ts[0], solution.ys[0])), times


@_once.def_bwd
def _backwards(times: Array | None, slopes: Any, perturbed: Any, inputs: Any, controller: Any, *rest: Any) -> Any:
    wanted, fixed = eqx.partition(inputs, perturbed)

    def again(wanted: Any) -> Any:
        way = controller if times is None else _along(controller, times)
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=_checkpoints(inputs[2], rest[1]))
        solution = _solve(eqx.combine(wanted, fixed), way, adjoint, *rest)
        return eqx.filter(solution, eqx.is_inexact_array)

    solution, transposed = jax.vjp(again, wanted)
    # A slope of zero comes as None.
    leaves, rest = jax.tree.leaves(solution), jax.tree.structure(solution)
    given = rest.flatten_up_to(slopes)  # pyright: ignore[reportAttributeAccessIssue]
    whole = [jnp.zeros_like(leaf) if slope is None else slope for leaf, slope in zip(leaves, given, strict=True)]
    return transposed(jax.tree.unflatten(rest, whole))[0]


def _checkpoints(y0: Any, max_steps: int) -> int | None:
    """As many as take 1 MiB, for steps between checkpoints are computed once more; not fewer than diffrax's own, None."""
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(y0))
    room = min(2**20 // (3 * size), max_steps)  # the state, its rates, and about as much of the loop's own
    return room if room > (2.0 * max_steps) ** 0.5 else None


def _nothing(t: Any, y: Any, args: Any) -> None:
    return None


def _along(controller: Any, times: Array) -> Any:
    """The controller that takes the noted steps; where it jumps over jump_ts of the field, it still does."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return eqx.tree_at(lambda c: c.controller, controller, _along(controller.controller, times))
    return _RecordedSteps(controller=controller, times=times)  # pyright: ignore[reportCallIssue]


class _RecordedSteps(WrappedController):
    """Takes the steps that end at `times`."""

    controller: Any
    times: Array

    def wrap(self, direction: Any) -> _RecordedSteps:
        return self

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any) -> Any:
        return self.times[0], jnp.asarray(0)

    def adapt_step_size(
        self, t0: Any, t1: Any, y0: Any, y1_candidate: Any, args: Any, y_error: Any, error_order: Any, controller_state: Any
    ) -> Any:
        done = controller_state + 1
        return jnp.asarray(True), t1, self.times[done], False, done, diffrax.RESULTS.successful
