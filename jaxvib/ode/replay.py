"""The step-replay adjoint: reverse derivatives of runs with adaptive steps."""

from __future__ import annotations

from typing import TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from jaxvib.ode.control import Decision, WrappedController
from jaxvib.ode.types import Args, IntScalarLike, RealScalarLike, Y
from jaxvib.runtime.compat import no_host_checks

__all__ = ["solve"]

_Inputs: TypeAlias = tuple[Array, Array | None, Y, Args, diffrax.SaveAt, diffrax.ODETerm]
"""What is differentiated: the end, the first step, the state at the start, the arguments, what is saved, the equations."""

_Rest: TypeAlias = tuple[diffrax.AbstractSolver, int, diffrax.AbstractProgressMeter]
"""What is not: the method, the largest number of steps, the progress meter."""


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
    """`diffrax.diffeqsolve` from time 0 to `end`, which fails by its result alone.

    Its reverse derivatives are a step-replay adjoint. They go back over checkpoints, from which the run is computed once more;
    an adaptive controller that chose its steps once more as well would find them a rounding apart, and the next ones further:
    after some hundred turns they are other steps, whose derivatives do not belong together (off by up to 1e-3). So the end of
    each step is recorded in a first run, and those steps are differentiated. A run of which no derivative is taken is done
    once, and records nothing.

    **Arguments**: `adjoint` diffrax's, for another way: `diffrax.ForwardMode()` for forward derivatives. No function among the
    arguments may hold on to traced arrays; `args` is for them. The others are as in diffrax.

    **Returns** diffrax's `Solution`.
    """
    inputs = (end, first_step, y0, args, saveat, term)
    rest = (solver, max_steps, diffrax.NoProgressMeter() if progress is None else progress)
    if adjoint is not None:
        return _solve(inputs, controller, adjoint, *rest)
    numbers, others = eqx.partition(controller, eqx.is_array)
    return _with_replay(inputs, eqx.combine(jax.lax.stop_gradient(numbers), others), *rest)


@no_host_checks()
def _solve(
    inputs: _Inputs,
    controller: diffrax.AbstractStepSizeController,
    adjoint: diffrax.AbstractAdjoint,
    solver: diffrax.AbstractSolver,
    max_steps: int,
    progress: diffrax.AbstractProgressMeter,
) -> diffrax.Solution:
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
def _with_replay(inputs: _Inputs, controller: diffrax.AbstractStepSizeController, *rest: *_Rest) -> diffrax.Solution:
    return _solve(inputs, controller, diffrax.ForwardMode(), *rest)


@_with_replay.def_fwd
def _forward(
    perturbed: PyTree[bool], inputs: _Inputs, controller: diffrax.AbstractStepSizeController, *rest: *_Rest
) -> tuple[diffrax.Solution, Array | None]:
    """The run, and the times at which its steps end."""
    if isinstance(controller, (diffrax.ConstantStepSize, diffrax.StepTo)):
        return _solve(inputs, controller, diffrax.ForwardMode(), *rest), None
    end, first_step, y0, args, saveat, term = inputs
    steps = diffrax.SubSaveAt(steps=True, fn=_nothing)
    recording = (end, first_step, y0, args, diffrax.SaveAt(subs=[saveat.subs, steps]), term)
    solution = _solve(recording, controller, diffrax.ForwardMode(), *rest)
    assert solution.ts is not None and solution.ys is not None
    times = solution.ts[1]
    return eqx.tree_at(lambda s: (s.ts, s.ys), solution, (solution.ts[0], solution.ys[0])), times


@_with_replay.def_bwd
def _backward(
    times: Array | None,
    cotangents: PyTree[Array | None],
    perturbed: PyTree[bool],
    inputs: _Inputs,
    controller: diffrax.AbstractStepSizeController,
    *rest: *_Rest,
) -> PyTree[Array | None]:
    differentiable, fixed = eqx.partition(inputs, perturbed)

    def replayed(differentiable: PyTree[Array | None]) -> PyTree[Array | None]:
        steps = controller if times is None else _recorded_steps(controller, times)
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=_checkpoints(inputs[2], rest[1]))
        solution = _solve(eqx.combine(differentiable, fixed), steps, adjoint, *rest)
        return eqx.filter(solution, eqx.is_inexact_array)

    solution, transposed = jax.vjp(replayed, differentiable)
    # A cotangent of zero comes as None.
    leaves, rest = jax.tree.leaves(solution), jax.tree.structure(solution)
    given = rest.flatten_up_to(cotangents)  # pyright: ignore[reportAttributeAccessIssue]
    whole = [jnp.zeros_like(leaf) if dy is None else dy for leaf, dy in zip(leaves, given, strict=True)]
    return transposed(jax.tree.unflatten(rest, whole))[0]


def _checkpoints(y0: Y, max_steps: int) -> int | None:
    """As many as take 1 MiB, for steps between checkpoints are computed once more; not fewer than diffrax's own, None."""
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(y0))
    room = min(2**20 // (3 * size), max_steps)  # the state, its rates, and about as much of the loop's own
    return room if room > (2.0 * max_steps) ** 0.5 else None


def _nothing(t: RealScalarLike, y: Y, args: Args) -> None:
    return None


def _recorded_steps(controller: diffrax.AbstractStepSizeController, times: Array) -> diffrax.AbstractStepSizeController:
    """The controller that takes the recorded steps; one that steps onto `jump_ts` of the field still does."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return eqx.tree_at(lambda c: c.controller, controller, _recorded_steps(controller.controller, times))
    return RecordedSteps(controller=controller, times=times)  # pyright: ignore[reportCallIssue]


class RecordedSteps(WrappedController):
    """Takes the steps that end at `times` (max_steps,), in order."""

    controller: diffrax.AbstractStepSizeController
    times: Array

    def wrap(self, direction: IntScalarLike) -> RecordedSteps:
        return self

    def init(self, *_: object, **__: object) -> tuple[RealScalarLike, Array]:
        return self.times[0], jnp.asarray(0)

    def adapt_step_size(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        y1_candidate: Y,
        args: Args,
        y_error: Y,
        error_order: RealScalarLike,
        controller_state: Array,
    ) -> Decision:
        done = controller_state + 1
        return jnp.asarray(True), t1, self.times[done], False, done, diffrax.RESULTS.successful
