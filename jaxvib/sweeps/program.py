"""Program that computes a chunk of cases, and the search for cases that raise errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import estimated_frequencies
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.batch import PARTS_OF_RUN, BatchPlan, BatchRun, run_in_batch
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.integration.stiffness import equal_step_length, fastest_decay, fastest_motion
from jaxvib.motion.start import START_SEPARATION, Start, initial_state
from jaxvib.runtime.operations import program_digest
from jaxvib.runtime.programs import cached
from jaxvib.sweeps.axes import Axis, Target, extreme_cases, put_start, put_values
from jaxvib.sweeps.definition import CASE_STATUSES, Study
from jaxvib.sweeps.measures import Measure, RunMeasure
from optimize.quantities.evaluation import Evaluation

_STATES_IN_WINDOW = 1024
"""Number of stored states in the measuring window of a run."""

_STATES_PER_TURN = 8
"""Smallest number of stored states per turn of the rotor. Jammed loads turn more slowly, with more states per turn."""

_SLOW_PERIODS = 20
"""Length of the window in periods of the lowest natural frequency, as in `simulate`. The window has at most 128 turns of the
fastest rotor (in `simulate` 256)."""

_CASES_PER_BLOCK = 64
"""Number of cases whose rates are computed together in the search for the fastest and the slowest case."""

_STEPS_PER_RADIAN_OF_CONTACT = 4.0
"""Number of steps for each radian of a contact with a stop or between loads: about 12 in a contact. Other motions have one,
because they are smooth."""

_MAX_STEPS = 1e9
"""Maximum number of steps of a run, about an hour of computation."""

_STATUS_NUMBER = {name: k for k, name in enumerate(CASE_STATUSES)}


class Chunk(NamedTuple):
    """Results of the cases of a chunk.

    **Attributes**: `values` (cases, ...) of each measure, by name; `status` (cases,): indices of `CASE_STATUSES`;
    `errors`: the message of each failed case, by its index.
    """

    values: dict[str, np.ndarray]
    status: np.ndarray
    errors: dict[int, str]


def _measure_cases(
    scene: Scene,
    values: Array,
    batch: int,
    targets: tuple[Target, ...],
    measures: tuple[Measure, ...],
    plan: BatchPlan | None,
    start: Start,
    mode: int | None,
) -> tuple[tuple[Array, ...], Array]:
    """Compute the measures of the cases with the `values` (cases, axes) of the axes, `batch` cases at a time.

    **Returns** the measures (cases, ...), and indices of `CASE_STATUSES` (cases,): done, not_finite or not_resolved.
    """

    def measure_case(value: Array) -> tuple[tuple[Array, ...], Array]:
        varied = put_values(scene, targets, value)
        evaluation, run = Evaluation(varied), None
        if plan is not None:
            separation = (
                START_SEPARATION if start == "jam" else None
            )  # loads that start at one angle stay together, even in an unstable jam
            state = put_start(initial_state(varied, start, mode=mode, separation=separation, throw=False), targets, value)
            run = run_in_batch(varied, state, plan)

        def read(measure: Measure) -> Array:
            if not isinstance(measure, RunMeasure):
                return measure.read(evaluation)
            assert run is not None
            return measure.read(run)

        return tuple(jnp.asarray(read(measure)) for measure in measures), jnp.asarray(_ending(run), jnp.uint8)

    return jax.lax.map(measure_case, values, batch_size=batch)


def _ending(run: BatchRun | None) -> Array | int:
    """Return the index in `CASE_STATUSES` of the outcome of a run, or that of done if there is no run."""
    done, not_finite, not_resolved = (_STATUS_NUMBER[name] for name in ("done", "not_finite", "not_resolved"))
    if run is None:
        return done
    return jnp.where(run.resolved, jnp.where(run.finite, done, not_finite), not_resolved)


@cached
def _measure_cases_compiled(scene: Scene, values: Array, program: str, *choices: Any) -> tuple[tuple[Array, ...], Array]:
    """Compute cases by a compiled program. `program` is the digest of `traced_program`; a new digest compiles a new program.

    The digest is an argument, because a user's function still compares equal after a change of its global variables. Without
    the digest, the program from before the change would be used again.
    """
    return _measure_cases(scene, values, *choices)


@cached
def _rates(scene: Scene, values: Array, targets: tuple[Target, ...]) -> Array:
    """Return rates (cases, 5) of cases (cases, axes): fastest rate, minus the slowest rate, decay, rotor speed, and the sum of
    the squared natural frequencies.

    The sum serves the search of `extreme_cases`, which changes one axis at a time: if the rotor is faster than all vibrations,
    a stiffness does not change the fastest rate, but it changes the sum.
    """

    def rates_of_case(value: Array) -> Array:
        varied = put_values(scene, targets, value)
        fastest, slowest = fastest_motion(varied, _STEPS_PER_RADIAN_OF_CONTACT), frequency_bounds(varied)[1]
        total = jnp.sum(estimated_frequencies(varied) ** 2)
        return jnp.stack([fastest, -slowest, fastest_decay(varied), varied.top_speed, total])

    return jax.vmap(rates_of_case)(values)


def plan_runs_of_cases(scene: Scene, axes: Sequence[Axis], until: float, steps: int | None) -> BatchPlan:
    """Return the plan of steps and window for all cases of a study, from the fastest and the slowest case in the range of the
    axes, see `extreme_cases`."""
    targets = tuple(axis.target for axis in axes)

    def rates(values: np.ndarray) -> np.ndarray:
        """Compute the rates in blocks of equal shape, for which one program is compiled."""
        number = -(-len(values) // _CASES_PER_BLOCK)
        filled = np.resize(values, (number * _CASES_PER_BLOCK, len(axes)))
        blocks = [np.asarray(_rates(scene, jnp.asarray(block), targets)) for block in np.split(filled, number)]
        return np.nan_to_num(np.concatenate(blocks)[: len(values)], nan=-np.inf)

    fastest, minus_slowest, decay, rotor, _ = (float(x) for x in np.max(rates(extreme_cases(axes, rates)), axis=0))
    # Loads that start faster than the rotor are the fastest motion of a run.
    fastest = max(fastest, *(max(abs(a.low), abs(a.high)) for a in axes if a.target.field == "rate"), 0.0)
    max_window = 2.0 * np.pi * _STATES_IN_WINDOW / (_STATES_PER_TURN * rotor)
    window = min(2.0 * np.pi * _SLOW_PERIODS / -minus_slowest, max_window, until / 2.0)
    step_given = None if steps is None else until / min(steps, 10 * int(_MAX_STEPS))
    step, implicit = equal_step_length(fastest, decay, 1.0, step_given)
    if until / step > _MAX_STEPS:
        name = "until" if steps is None else "steps"
        raise InputError(name, f"needs {until / step:.3g} steps for every run; give a shorter run or fewer steps")
    steps_per_part, steps_between = (until - window) / (PARTS_OF_RUN * step), window / ((_STATES_IN_WINDOW - 1) * step)
    # 1e-9: a number that is whole up to rounding errors is not rounded up
    counts = (int(np.ceil(x - 1e-9)) or 1 for x in (steps_per_part, steps_between))
    return BatchPlan(until, window, _STATES_IN_WINDOW, *counts, implicit=implicit)


def traced_program(study: Study) -> tuple[list[jax.ShapeDtypeStruct], str]:
    """Return shape and type of each measure of one case, and the digest of the program of a case.

    The digest changes with every value or operation on which results depend: parameters of the scene, and all values to which
    the functions of measures refer. If the program of a measure calls Python, it cannot be compared: the digest begins with
    `PYTHON` and is different in each call. Errors of tracing are passed on.
    """
    values = jnp.zeros((1, len(study.targets)))

    def cases(values: Array) -> tuple[tuple[Array, ...], Array]:
        return _measure_cases(study.scene, values, *study.choices)

    program, (leaves, _) = jax.make_jaxpr(cases, return_shape=True)(values)
    return [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves], program_digest(program)


def compute(study: Study, chunk: int) -> Chunk:
    """Compute the cases of a chunk. A case that raises an error is found by bisection and recorded with its message.

    The arrays always have the same shapes: a chunk with fewer cases is filled up with copies of its first case.
    """
    values = study.grid.values(chunk)
    errors: dict[int, str] = {}
    parts = _compute_cases(study, values, np.arange(len(values)), errors)
    leaves, endings = parts
    is_complete = np.all([np.all(np.isfinite(leaf.reshape(len(values), -1)), axis=1) for leaf in leaves], axis=0)
    is_absent = (endings == _STATUS_NUMBER["done"]) & ~is_complete
    status = np.where(is_absent, _STATUS_NUMBER["absent"], endings).astype(np.uint8)
    status[list(errors)] = _STATUS_NUMBER["failed"]
    return Chunk(dict(zip(study.names, leaves, strict=True)), status, errors)


def _compute_cases(
    study: Study, values: np.ndarray, cases: np.ndarray, errors: dict[int, str]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the results of a chunk, of which only the `cases` (indices) are computed.

    A case that raises an error has NaN (-1 in integer results), and its message is added to `errors`. The entries of other
    cases have no meaning: they are results of the first of the `cases`, or NaN.
    """
    filled = np.repeat(values[cases[:1]], study.size, axis=0)
    filled[cases] = values[cases]
    try:
        leaves, endings = _measure_cases_compiled(study.scene, jnp.asarray(filled), study.program, *study.choices)
        return [np.asarray(leaf)[: len(values)] for leaf in leaves], np.asarray(endings)[: len(values)]
    except RuntimeError as error:  # raised by a running program; an error of its compilation would concern all cases
        if "RESOURCE_EXHAUSTED" in str(error):
            raise
        if len(cases) == 1:
            errors[int(cases[0])] = _sentence(error)
            return study.placeholders(len(values)), np.full(len(values), _STATUS_NUMBER["done"])
        halves = [_compute_cases(study, values, half, errors) for half in np.array_split(cases, 2)]
    is_second_half = np.isin(np.arange(len(values)), np.array_split(cases, 2)[1])
    chosen = [
        np.where(is_second_half.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(*(h[0] for h in halves), strict=True)
    ]
    return chosen, np.where(is_second_half, halves[1][1], halves[0][1])


def _sentence(error: Exception) -> str:
    """Return the line of an error message that describes the error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    messages = [line for line in lines if line.split(":")[0].endswith(("Error", "Exception")) and ": " in line]
    return (messages or lines or [type(error).__name__])[-1]
