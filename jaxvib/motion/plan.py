"""Plans of runs: choices that depend on numbers of a scene, taken on the host before a program is traced.

Only this module asks which numbers are known. The method and static sizes (samples, steps, stretches) follow from known
numbers; under a JAX transformation sizes have fixed values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.integrate import PER_TURN, IntegrationPlan, StepControl, frequency_bounds
from jaxvib.motion.start import Start, initial_state, validate_state, with_spin_up_drive
from jaxvib.motion.steps import Accuracy, EqualSteps, StepChoice, Tolerance, require, small_number
from jaxvib.motion.stiffness import stiff_solver
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.units import Number, count, known_number
from jaxvib.units.known import is_known, when_known

__all__ = ["MAX_STEPS", "Control", "RunPlan", "enough_steps", "plan_run", "start_state"]

Control = StepControl | diffrax.AbstractStepSizeController

MAX_STEPS = 2**31 - 1
"""The largest limit of steps."""

_UNKNOWN_STEPS, _UNKNOWN_SAMPLES = 2**20, 2000
"""Limit of steps, and samples, of a run whose length or speeds have no value yet."""

_FEW_SAMPLES, _MANY_SAMPLES = 2**14, 2**18

_IMPLICIT_SHARE = 16.0
"""Times the usual limit of steps that a run by the implicit method is allowed."""

_STRETCH_TURNS = 2.0e4
"""Turns after which single precision no longer resolves time; longer runs are cut into stretches."""


@dataclass(frozen=True)
class RunPlan:
    """Plan of a run.

    **Attributes**: the `asked` scene, and the `scene` that runs, with the drive that its start gives it; `end` s; `state` at
    the start; `integration` the static choices of one integration; `stretches` into which the run is cut; `is_known`: true if
    scene, end and state have values; `is_estimated`: true if a second run with larger steps estimates the error; `accuracy` to
    reach by repeated runs, or None; `fastest` rate of the motion, rad/s, NaN where nothing needs it.
    """

    asked: Scene
    scene: Scene
    end: Array
    state: State
    integration: IntegrationPlan
    stretches: int
    is_known: bool
    is_estimated: bool
    accuracy: float | None
    fastest: Array | np.ndarray


def plan_run(
    scene: Scene,
    until: Number,
    *,
    start: Start | State,
    mode: int | None,
    apart: Number | None,
    spin_up: Number | None,
    save: Literal["all", "window"],
    samples: int | None,
    turns: int,
    estimate: bool | None,
    solver: diffrax.AbstractSolver | None,
    steps: StepChoice | None,
    adjoint: diffrax.AbstractAdjoint | None,
    max_steps: int | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
    throw: bool,
) -> RunPlan:
    """Validate the arguments of `simulate` and choose method, steps and sizes of its run. **Raises** `InputError`."""
    asked = validate_scene(scene)
    end = known_number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {quoted(save)}; it must be 'all' or 'window'")
    samples = _enough_samples(asked, end) if samples is None else count(samples, "samples", low=2, each=_sample_size(asked))
    periods = np.asarray(count(turns, "turns"), end.dtype)
    control = _step_control(end, steps, estimate)
    scene = with_spin_up_drive(asked, end, start, spin_up)
    state = start_state(scene, start, mode, apart, throw=throw)

    known = is_known(scene, end, state)
    is_estimated = isinstance(control, StepControl) and (known if estimate is None else estimate)
    if isinstance(steps, Accuracy) and not known:
        raise InputError("accuracy", "needs numbers to look at; under a JAX transformation give a Tolerance")
    is_rate_needed = known or max_steps is None or is_estimated
    fastest = frequency_bounds(scene)[0] if is_rate_needed else np.asarray(np.nan, end.dtype)
    stiff = stiff_solver(scene, state, fastest) if solver is None and known else None
    if max_steps is None:
        max_steps = enough_steps((1.0 if stiff is None else _IMPLICIT_SHARE) * fastest, end)
    if (solver := stiff if solver is None else solver) is None and not known and end.dtype.itemsize >= 8:
        # Derivatives may be asked for; those of the written-out step take several times as long to compile.
        forward = isinstance(adjoint, diffrax.ForwardMode)
        solver = LoopDopri8(tangents=forward, reuse=forward or adjoint is None)
    kept, most = samples if save == "all" else 0, min(count(max_steps, "max_steps"), MAX_STEPS)
    # Time loses its digits in single precision.
    is_cut = known and state.displacement.dtype.itemsize < 8 and save == "window" and scene.drive.constant
    return RunPlan(
        asked=asked,
        scene=scene,
        end=end,
        state=state,
        integration=IntegrationPlan(solver, control, adjoint, kept, periods, most, progress_meter),
        stretches=max(1, math.ceil(float(end * fastest) / (2.0 * math.pi * _STRETCH_TURNS))) if is_cut else 1,
        is_known=known,
        is_estimated=is_estimated,
        accuracy=steps.error if isinstance(steps, Accuracy) else None,
        fastest=fastest,
    )


def start_state(scene: Scene, start: Start | State, mode: int | None, apart: Number | None, *, throw: bool = True) -> State:
    """Return the state of a start by name, or a user's state, validated. **Raises** `InputError`."""
    if isinstance(start, State):
        return validate_state(scene, start, mode, apart)
    return initial_state(scene, start, mode=mode, apart=apart, throw=throw)


def enough_steps(fastest: Array | np.ndarray, end: Array) -> int:
    """500 steps for each turn of the `fastest` motion, rad/s, rounded up to a power of 2: few programs where it is part of
    one. **Raises** `InputError` for a run that would need too many."""

    def steps_of(fastest: float, end: float) -> int:
        turns = end * fastest / (2.0 * math.pi)
        steps = 4096 + 500 * turns
        if not steps <= MAX_STEPS:
            raise InputError("until", f"is {end:g} s, {turns:.2g} turns of what moves fastest; run shorter stretches")
        return min(2 ** math.ceil(math.log2(steps)), MAX_STEPS)

    steps = when_known(steps_of, fastest, end)
    return _UNKNOWN_STEPS if steps is None else steps


def _enough_samples(scene: Scene, end: Array) -> int:
    """Samples that resolve the vibration in a figure, without a beat; one of two numbers, and therefore of two programs."""

    def samples_of(end: float, speed: float) -> int:
        return _FEW_SAMPLES if PER_TURN * end * speed / (2.0 * math.pi) <= _FEW_SAMPLES else _MANY_SAMPLES

    samples = when_known(samples_of, end, scene.drive.speed)
    return _UNKNOWN_SAMPLES if samples is None else samples


def _sample_size(scene: Scene) -> float:
    """Bytes of a kept state with its forces, held three times while it is computed."""
    structure, coordinates = scene.machine.structure(), len(scene.loads.rest())
    numbers = 2 * structure.mass.shape[0] + 2 * coordinates * scene.loads.count + structure.bed_stiffness.shape[0] + 5
    return 3.0 * scene.drive.speed.dtype.itemsize * numbers


def _step_control(end: Array, chosen: StepChoice | None, estimate: bool | None) -> Control:
    """Control of the steps. **Raises** `InputError` for a choice that the precision cannot deliver."""
    require(chosen, Tolerance, Accuracy, EqualSteps, diffrax.AbstractStepSizeController)
    if isinstance(chosen, diffrax.AbstractStepSizeController):
        if estimate:
            problem = "is True together with a controller, whose steps cannot be made larger; give a Tolerance"
            raise InputError("estimate", problem)
        return chosen
    if isinstance(chosen, EqualSteps):
        return StepControl(steps=np.asarray(count(chosen.number, "steps"), end.dtype))
    precision = float(jnp.finfo(end.dtype).eps)
    if isinstance(chosen, Accuracy):
        if estimate is False:
            raise InputError("estimate", "is False together with accuracy, which is reached by estimates; give a Tolerance")
        accuracy = small_number(chosen.error, "accuracy", end, 1e3)
        return StepControl(tolerance=np.asarray(max(1e-2 * accuracy, 10.0 * precision), end.dtype))
    default = 1e-8 if precision < 1e-10 else 1e-5
    tolerance = default if chosen is None else small_number(chosen.tolerance, "tolerance", end, 10.0)
    return StepControl(tolerance=np.asarray(tolerance, end.dtype))
