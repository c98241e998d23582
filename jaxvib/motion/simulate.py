"""Time integration of a scene, through diffrax."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.dynamics import State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.checked import checked
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.scaled_error import error_scale, estimated_error, natural_units, scaled_error, turned
from jaxvib.motion.integrate import PER_TURN, StepControl, frequency_bounds, integrate, whole_turns, wrap_angles
from jaxvib.motion.run import Run, RunStatus, judged_by_separation
from jaxvib.motion.start import Start, initial_state, validate_state, with_spin_up_drive
from jaxvib.motion.steps import FORMER, Accuracy, EqualSteps, StepChoice, Tolerance, refuse_former, require, small_number
from jaxvib.motion.stiffness import advice, stiff_solver
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.results.status import failure, status_name
from jaxvib.runtime.devices import known, on_device
from jaxvib.runtime.parallel import in_threads
from jaxvib.runtime.programs import cached
from jaxvib.steady.refused import refuse_unknowns
from jaxvib.units import Number, count, known_number, traced

__all__ = ["enough_steps", "simulate"]

_Control: TypeAlias = "StepControl | diffrax.AbstractStepSizeController"
_MOST_STEPS = 2**31 - 1
_FEW_SAMPLES, _MANY_SAMPLES = 2**14, 2**18

_COARSER = 100.0
"""The run whose difference to the run itself is its error estimate makes steps to so many times the tolerance."""

_ATTEMPTS = 6
"""Runs that an `accuracy` may take before it is given up."""

_STRETCH = 2.0e4
"""Turns after which single precision no longer resolves time; longer runs are cut into stretches."""


@validated
@refuse_former(**FORMER)
def simulate(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    apart: Number | None = None,
    spin_up: Number | None = None,
    save: Literal["all", "window"] = "all",
    samples: int | None = None,
    turns: int = 20,
    estimate: bool | None = None,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: StepChoice | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = True,
) -> Run:
    """Integrates the full equations of motion of `scene` from 0 to `until` and measures what comes out.

    **Arguments**

    - `until`: end time, s or text such as "20 s"
    - `start`: "rest", "jam" (near the jam mode with number `mode`), "spin_up" (at rest, the rotor's speed rising smoothly
      over the time `spin_up`, half of `until` unless said otherwise), or a `State`; see `initial_state`
    - `apart`: angle between neighbouring loads at a named start, rad; default: side by side or 1 degree, in a jam 0. Loads that
      start at exactly one angle (`apart=0`) stay at one angle (`Run.together`); if that motion repeats itself but is unstable
      against their separation, the status is `would_separate`
    - `save`: "all" keeps `samples` evenly spaced states (unless said otherwise 16384, for runs of more than 1024 turns of the
      rotor 262144, and 2000 under a JAX transformation); "window" keeps no trajectory, only what is measured
    - `turns`: how many periods of the lowest natural frequency the measuring window at the end is long (at most half the run,
      and 256 turns of the rotor)
    - `estimate`: whether the run's `error` is estimated, by a second run with larger steps (half as many evaluations again);
      the default is to do so where all numbers are known, that is not under a JAX transformation, and
      steps are not chosen by a controller of diffrax
    - `stepsize_controller`: how steps are chosen: `Tolerance(1e-8)` by the error that each may make (the default, in single
      precision 1e-5); `Accuracy(1e-4)` by the `error` that the result may have: the run is repeated with smaller tolerances
      until its estimated error is below it, 6 times at most, or fails as `not_accurate`; `EqualSteps(2000)` so many equal
      ones; or a step size controller of diffrax
    - `solver`, `adjoint`: diffrax's, passed through; the defaults are `Rodas4` for known scenes whose loads (or carrier) decay
      100 times as fast as anything moves, otherwise Dormand and Prince's method of order 8 as `UnrolledDopri8`, in large scenes
      and JAX transformations `LoopDopri8`, and reverse derivatives of the very steps that were taken. Forward derivatives,
      `diffrax.ForwardMode()`, take less time for up to about ten parameters
    - `max_steps`: the run fails after so many steps; unless said otherwise 500 for each turn of what moves fastest, under a JAX
      transformation of the scene 2^20. A reverse derivative keeps a time for each of them: say fewer for large batches
    - `progress_meter`: diffrax's, shows how much of the time is done
    - `throw`: raise if the run fails; otherwise, and under a JAX transformation, its status says so

    **Returns** `Run`, which carries its estimated `error` and its cost. Gradients, forward and reverse, go through all of it;
    `jit` and `vmap` too. In single precision angles are kept within a turn while time is integrated, those of the window are
    counted from a turn at its beginning, and runs of more than 20,000 turns under a constant speed that keep a window only are
    cut into stretches, so that they do not lose phase.

    **Raises** `InputError` for values that are not allowed, `ComputationError` for a run that does not finish.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> run = jv.simulate(scene, 10.0, start="jam", mode=1)
    >>> bool(run.settled), round(float(run.omega), 2)      # caught just below the resonance at 28.1 rad/s
    (True, 27.41)

    Source: the antiphase paper, section 5.3; for the method `UnrolledDopri8`.
    """
    scene = checked(scene)
    end = known_number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {quoted(save)}; it must be 'all' or 'window'")
    samples = _enough_samples(scene, end) if samples is None else count(samples, "samples", low=2, each=_sample_size(scene))
    periods = np.asarray(count(turns, "turns"), end.dtype)
    control = _control(end, stepsize_controller, estimate)
    asked, scene = scene, with_spin_up_drive(scene, end, start, spin_up)
    given = isinstance(start, State)
    state = (
        validate_state(scene, start, mode, apart) if given else initial_state(scene, start, mode=mode, apart=apart, throw=throw)
    )
    fastest = functools.cache(lambda: frequency_bounds(scene)[0])
    concrete = not any(traced(leaf) for leaf in jax.tree.leaves((scene, end, state)))
    stiff = stiff_solver(scene, state, fastest()) if solver is None and concrete else None
    max_steps = enough_steps((1.0 if stiff is None else 16.0) * fastest(), end) if max_steps is None else max_steps
    if (solver := stiff if solver is None else solver) is None and not concrete and end.dtype.itemsize >= 8:
        # Derivatives may be asked for; those of the written-out step take several times as long to compile.
        forward = isinstance(adjoint, diffrax.ForwardMode)
        solver = LoopDopri8(tangents=forward, reuse=forward or adjoint is None)

    kept, allowed = samples if save == "all" else 0, min(count(max_steps, "max_steps"), _MOST_STEPS)
    stretches = _stretches(scene, fastest, end, state, save)

    def stretch(span: Array, state: State, chosen: _Control, wanted: bool) -> Run:
        most, measuring = allowed, None
        if concrete and adjoint is None:
            chosen, most = _limited(chosen, allowed)
            measuring = np.asarray(wanted)
        return integrate(scene, span, state, solver, chosen, adjoint, kept, periods, most, progress_meter, measuring)

    def run(chosen: _Control, wanted: bool = True) -> Run:
        if stretches > 1:
            return _in_stretches(scene, end, stretches, state, chosen, stretch)
        return stretch(end, state, chosen, wanted)

    begun, estimated = time.perf_counter(), {}
    if isinstance(stepsize_controller, Accuracy):
        if not concrete:
            raise InputError("accuracy", "needs numbers to look at; under a JAX transformation give a Tolerance")
        assert isinstance(control, StepControl)
        found = _to_accuracy(scene, fastest(), run, control, stepsize_controller.error)
    elif not isinstance(control, StepControl) or not (concrete if estimate is None else estimate):
        found = run(control)
    else:
        coarser = _coarser(control)
        both = (lambda: run(control)), (lambda: run(coarser, wanted=False))
        found, coarse = in_threads(lambda k: both[k](), 2) if progress_meter is None else [each() for each in both]
        estimated = _compared(scene, fastest(), found, coarse, control, coarser, coarse.evaluations)
    if traced(found.steps):
        return refuse_unknowns(asked, dataclasses.replace(found, **estimated), RunStatus.refused)
    jax.block_until_ready((found.steps, estimated))
    found = _with(found, seconds=time.perf_counter() - begun, **estimated)
    if throw:
        _raise_if_failed(found, max_steps, stepsize_controller)
    return judged_by_separation(found) if concrete and bool(found.settled) else found


def _limited(chosen: _Control, most: int) -> tuple[_Control, int]:
    """The control with the limit of its steps as a number of the program, as far as it can be, and what limits the loop."""
    if not isinstance(chosen, StepControl) or (chosen.steps is not None and float(chosen.steps) > most):
        return chosen, most
    limit = None if chosen.tolerance is None else np.asarray(most, np.int32)
    return StepControl(chosen.tolerance, chosen.steps, limit), _MOST_STEPS


def _control(end: Array, chosen: StepChoice | None, estimate: bool | None) -> _Control:
    """What was asked for, checked: nothing that the dtype cannot deliver."""
    require(chosen, Tolerance, Accuracy, EqualSteps, diffrax.AbstractStepSizeController)
    if isinstance(chosen, diffrax.AbstractStepSizeController):
        if estimate:
            problem = "is True together with a controller, whose steps nobody can make larger; give a Tolerance"
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


def _coarser(control: StepControl) -> StepControl:
    if control.steps is not None:
        return StepControl(steps=np.asarray(np.ceil(control.steps / 2.0), control.steps.dtype))
    assert control.tolerance is not None
    larger = np.minimum(_COARSER * control.tolerance, np.sqrt(control.tolerance))
    return StepControl(tolerance=np.asarray(larger, control.tolerance.dtype))


def _shrink(fine: StepControl, coarse: StepControl) -> Array | np.ndarray:
    """What share of the difference between two runs is the error of the finer one, where the motion is smooth: for a method of
    order 8 the error falls with the tolerance's power 8/9 and the steps' power 8; less is counted on, 0.45 and 3, so that the
    estimate errs upward."""
    if fine.steps is not None and coarse.steps is not None:
        return (coarse.steps / fine.steps) ** 3
    assert fine.tolerance is not None and coarse.tolerance is not None
    return (fine.tolerance / coarse.tolerance) ** 0.45


def _compared(
    scene: Scene,
    fastest: Array,
    fine: Run,
    coarse: Run,
    control: StepControl,
    coarser: StepControl,
    before: Array | np.ndarray,
) -> dict[str, Array]:
    """The estimated error of the finer run, and what all cost: so many evaluations were made `before` it."""
    theirs = coarse.window.state, coarse.status
    counted = fine.evaluations, before
    error, evaluations = _estimated(scene, fastest, fine.window, fine.steps, *theirs, control, coarser, counted)
    return {"error": error, "evaluations": evaluations}


@cached
def _estimated(
    scene: Scene,
    fastest: Array,
    window: Trajectory,
    steps: Array,
    theirs: State,
    status: RunStatus,
    control: StepControl,
    coarser: StepControl,
    evaluations: tuple[Array, Array | np.ndarray],
) -> tuple[Array, Array]:
    """The estimated error of a run, from its window and the states and the status of a coarser one, and the sum of these
    `evaluations`; `fastest` see `frequency_bounds`."""
    # A run that is compared with itself, or with one that failed, has an error that nobody knows.
    found = status == RunStatus.done
    if control.steps is not None:
        found = found & (control.steps != coarser.steps)
    ours = window.state
    theirs = turned(theirs, ours) if wrap_angles(scene, window.time.dtype)[0] else theirs
    difference = scaled_error(ours, theirs, error_scale(ours, natural_units(scene)))
    error = estimated_error(difference, _shrink(control, coarser), scene, steps, fastest * window.time[-1])
    return jnp.where(found & jnp.isfinite(error), error, jnp.inf), evaluations[0] + evaluations[1]


def _to_accuracy(scene: Scene, fastest: Array, run: Callable[[StepControl], Run], control: StepControl, accuracy: float) -> Run:
    """Runs with ever smaller tolerances until the estimated error is small enough."""
    floor = 10.0 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    before, coarse = run(_coarser(control)), _coarser(control)
    found, spent = before, known(before.evaluations)
    for _ in range(_ATTEMPTS - 1):
        latest = run(control)
        found = dataclasses.replace(latest, **_compared(scene, fastest, latest, before, control, coarse, spent))
        if status_name(found.status) != "done":
            return found
        tolerance = float(cast(Array, control.tolerance))
        if float(found.error) <= accuracy:
            return found
        # Smaller steps only add to what rounding alone makes of the error.
        radians = fastest * latest.window.time[-1]
        if tolerance <= floor or float(estimated_error(jnp.zeros(()), 0.0, scene, latest.steps, radians)) > accuracy:
            break
        # A little more than what is missing, for the error shrinks a little slower than the tolerance.
        share = min(max(0.2 * (accuracy / float(found.error)) ** 1.2, 1e-5), 0.1) if np.isfinite(float(found.error)) else 1e-2
        before, coarse = latest, control
        spent = known(found.evaluations)
        control = StepControl(tolerance=np.asarray(max(share * tolerance, floor), found.error.dtype))
    return eqx.tree_at(lambda r: r.status, found, RunStatus.not_accurate)


def _with(run: Run, **values: Any) -> Run:
    """The run with these values, in the types of its own where they are numbers of Python."""

    def typed(name: str, value: Any) -> Any:
        return value if isinstance(value, Array) else np.asarray(value, getattr(run, name).dtype)

    return dataclasses.replace(run, **on_device({name: typed(name, value) for name, value in values.items()}))


def _stretches(scene: Scene, fastest: Callable[[], Array], end: Array, state: State, save: str) -> int:
    """Into how many stretches a run is cut: more than one in single precision, where time would lose its digits."""
    if state.displacement.dtype.itemsize >= 8 or save != "window" or not scene.drive.constant:
        return 1
    if any(traced(leaf) for leaf in jax.tree.leaves((scene, end, state))):
        return 1
    return max(1, math.ceil(float(end * fastest()) / (2.0 * math.pi * _STRETCH)))


def _in_stretches(
    scene: Scene,
    end: Array,
    number: int,
    state: State,
    controller: _Control,
    integrated: Callable[[Array, State, _Control, bool], Run],
) -> Run:
    """The run of the last of several stretches, each `integrated` from a state over a time, measured if that is wanted; each
    begins at time 0 after whole turns of the rotor, angles within one."""
    if isinstance(controller, StepControl) and controller.steps is not None:
        controller = StepControl(steps=np.asarray(np.ceil(controller.steps / number), controller.steps.dtype))
    length = whole_turns(scene, float(end) / number)
    last = float(end) - (number - 1) * length
    taken, rejected, evaluations, together, found = 0, 0, 0, True, None
    for k in range(number):
        span = jnp.asarray(length if k < number - 1 else last, end.dtype)
        found = integrated(span, state, controller, k == number - 1)
        state = last_state(scene, found)
        taken, rejected = taken + int(found.steps), rejected + int(found.rejected)
        evaluations, together = evaluations + int(found.evaluations), found.together & together
        if status_name(found.status) != "done":
            break
    assert found is not None
    counts = [jnp.asarray(n, found.steps.dtype) for n in (taken, rejected, evaluations)]
    found = eqx.tree_at(lambda r: [r.steps, r.rejected, r.evaluations], found, counts)
    found = eqx.tree_at(lambda r: r.window.time, found, found.window.time + length * (number - 1))
    return _with(found, together=together)


def last_state(scene: Scene, run: Run) -> State:
    """Where a run under a constant speed ended, as a state to go on from: angles within a turn keep their digits."""
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[-1], run.window.state)
    _, together = wrap_angles(scene, last.displacement.dtype)
    first = np.ravel(last.azimuth)[0]
    inside = tuple(x - 2.0 * np.pi * np.round((first if together else x) / (2.0 * np.pi)) for x in last.angle)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, last.displacement.dtype), eqx.tree_at(lambda y: y.angle, last, inside))


def _enough_samples(scene: Scene, end: Array) -> int:
    """So many that a picture shows the vibration and no beat of it with the samples; two numbers, so two programs, will do."""
    if traced(end) or traced(scene.drive.speed):
        return 2000
    wanted = PER_TURN * float(end) * float(scene.drive.speed) / (2.0 * math.pi)
    return _FEW_SAMPLES if wanted <= _FEW_SAMPLES else _MANY_SAMPLES


def _sample_size(scene: Scene) -> float:
    """Bytes that a state that is kept takes, with the forces that belong to it, held three times while it is made."""
    structure, coordinates = scene.machine.structure(), len(scene.loads.rest())
    numbers = 2 * structure.mass.shape[0] + 2 * coordinates * scene.loads.count + structure.bed_stiffness.shape[0] + 5
    return 3.0 * scene.drive.speed.dtype.itemsize * numbers


def enough_steps(fastest: Array, end: Array) -> int:
    """500 steps for each turn of what moves `fastest`, rad/s, rounded up to a power of 2: few programs where it is part of
    one."""
    if traced(end) or traced(fastest):
        return 2**20
    turns = float(end) * float(fastest) / (2.0 * math.pi)
    steps = 4096 + 500 * turns
    if not steps <= _MOST_STEPS:
        raise InputError("until", f"is {float(end):g} s, {turns:.2g} turns of what moves fastest; run shorter stretches")
    return min(2 ** math.ceil(math.log2(steps)), _MOST_STEPS)


def _raise_if_failed(run: Run, max_steps: int, chosen: StepChoice | None) -> None:
    name, hint = status_name(run.status), ""
    if name == "done":
        return
    kept = run.window if run.trajectory is None else run.trajectory
    times, finite = np.asarray(kept.time), np.all(np.isfinite(np.asarray(kept.state.displacement)), axis=1)
    if not bool(np.all(finite)) and bool(np.any(finite)):
        hint += f", after t = {times[finite][-1]:.6g} s"
    if name == "no_step":
        hint += "; give a smaller tolerance, or an explicit solver"
    if name == "max_steps_reached":
        hint += f" ({max_steps} steps); give a larger max_steps, a larger tolerance or a shorter run{advice(run.scene)}"
    if isinstance(chosen, Accuracy) and name == "not_accurate":
        hint += f" ({float(run.error):.1e}, asked for {chosen.error:.1e}); give a larger accuracy, or a shorter run"
    raise failure(run.status, hint)
