"""Time integration of the full equations of motion of a scene."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from functools import partial
from typing import Literal, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.state import ExciterState, State
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.scaled_error import error_scale, estimated_error, natural_units, scaled_error, with_nearest_turns
from jaxvib.motion.integrate import IntegrationPlan, StepControl, angle_wrapping, integrate, whole_turns
from jaxvib.motion.integration.stiffness import advice_on_stiffness
from jaxvib.motion.plan import MAX_STEPS, Control, RunPlan, StepChoice, plan_run
from jaxvib.motion.run import SETTLED_DRIFT, Run, RunStatus, with_separation_status
from jaxvib.motion.start import Start, must_compile_jams
from jaxvib.results.status import status_name
from jaxvib.runtime.devices import numpy_if_known, on_device
from jaxvib.runtime.parallel import in_background, in_threads
from jaxvib.runtime.programs import cached
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number


@validated
def simulate(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    separation: Number | None = None,
    spin_up: Number | None = None,
    save: Literal["all", "window"] = "all",
    samples: int | None = None,
    window_periods: int = 20,
    estimate: bool | None = None,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: StepChoice | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = True,
) -> Run:
    """Integrate the full equations of motion of a scene from 0 to `until`, and measure the end of the run.

    **Arguments**

    - `scene` to integrate, see `vector_field` for its equations
    - `until`: end time, s or text such as "20 s"; typical: 5 to 60 s, that is 100 or more vibrations
    - `start`: "rest", "jam" (near the jam mode with number `mode`), "spin_up" (at rest; the rotor speed rises smoothly during
      the time `spin_up`, default: half of `until`), or a `State`; see `initial_state`
    - `mode`: number of the jam mode for "jam"; typical: 1, 3, 5, the modes that are stable for light loads
    - `spin_up`, s; typical: 1 to 20
    - `separation`: angle between neighbouring loads at a named start, rad; default: 1 degree (loads with a `ball_radius`: side
      by side), in a jam 0. Loads that start at exactly one angle (`separation=0`) stay at one angle (`Run.coincident`). If this
      motion settles although slightly separated loads would leave it, the status is `would_separate`
    - `save`: "all" keeps `samples` evenly spaced states; "window" keeps the measured quantities and the window, but no
      trajectory
    - `samples` (default: 16384; 262144 for runs of more than 1024 turns of the rotor; 2000 under a JAX transformation);
      typical: 20 for each period of the vibration. Samples need memory, but hardly any time
    - `window_periods`: length of the measuring window at the end, in periods of the lowest natural frequency (at most half the
      run, and 256 turns of the rotor); typical: 20 (the default). The window has 4096 samples, with stiff stops up to 131072;
      under a JAX transformation always 4096, which may miss short contacts
    - `estimate`: True to estimate the `error` of the run by a second run with larger steps, which needs about half as many
      evaluations. The default is True, but False under a JAX transformation and with a step size controller of diffrax
    - `stepsize_controller`: choice of the steps, see below
    - `solver` and `adjoint` of diffrax. The default solver is `Rodas4` if drag, damping or a motor causes a decay 100 times as
      fast as the motion and the `State` has at most 64 entries (not under a JAX transformation). Otherwise it is the method of
      Dormand and Prince of order 8: `UnrolledDopri8` for up to 8 entries, `LoopDopri8` for more entries and under JAX
      transformations. The default adjoint gives reverse derivatives of exactly the steps that were taken. Forward derivatives,
      `diffrax.ForwardMode()`, take less time for up to about ten parameters
    - `max_steps`: the run fails after this number of steps; default: at least 500 for each turn of the fastest motion (16 times
      as many for `Rodas4`), 2^20 under a JAX transformation of the scene, and at least the number of `EqualSteps`. A reverse
      derivative stores a time for each of these steps: use a smaller value for large batches
    - `progress_meter` of diffrax, which shows the finished share of the time
    - `throw`: True to raise `ComputationError` if the run fails; otherwise, and under a JAX transformation, its status shows
      the failure

    Choices of `stepsize_controller`:

    - `Tolerance(1e-8)`: the error of each step (the default; 1e-5 in single precision); typical: 1e-6 to 1e-10
    - `Accuracy(1e-4)`: the `error` of the result; typical: 1e-3 to 1e-8. The run is repeated with smaller tolerances, in at
      most 6 runs, until its estimated error is at most this value; otherwise the status is `not_accurate`. An error of 1e-8
      needs about three times as many evaluations as an error of 1e-4
    - `EqualSteps(2000)`: a number of equal steps; typical: 4 for each radian of the fastest motion. The steps do not end at the
      jumps of a drive: derivatives with respect to the times of jumps are then 0
    - a step size controller of diffrax

    **Returns** `Run`, with its estimated `error` and its cost.

    - Forward and reverse derivatives, `jit` and `vmap` are supported. If a `Stop` or a `LoadContact` has damping, its force
      jumps at the beginning of a contact; first derivatives contain the shift of this time. Second derivatives
      (`jax.hessian`) exist for scenes whose forces and torques are smooth
    - In single precision, the default methods of order 8 keep angles within one turn during the integration, and angles of the
      window do not contain the whole turns before the window. Runs of one exciter at constant speed that keep only a window
      are divided into segments of up to 20,000 turns of the fastest motion. Long runs therefore keep their phase

    **Raises** `InputError` for values that are not allowed, `ComputationError` for a run that does not finish.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> run = jv.simulate(scene, 10.0, start="jam", mode=1)
    >>> bool(run.settled), round(float(run.omega), 2)      # jammed just below the resonance at 28.1 rad/s
    (True, 27.41)

    Source: the antiphase paper, section 5.3; for the method of integration see `UnrolledDopri8`.
    """
    plan_from = partial(
        plan_run,
        scene := validate_scene(scene),
        until,
        spin_up=spin_up,
        save=save,
        samples=samples,
        window_periods=window_periods,
        estimate=estimate,
        solver=solver,
        steps=stepsize_controller,
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=progress_meter,
        throw=throw,
    )
    if isinstance(start, str) and start == "jam" and must_compile_jams(scene, mode):
        prepare_run(plan_from(start="rest", mode=None, separation=None))
    plan = plan_from(start=start, mode=mode, separation=separation)
    run = run_planned(plan, throw=throw)
    if not plan.is_known:
        return run
    is_settled = float(run.drift) < SETTLED_DRIFT
    # An unsettled run is tested for overlapping loads only; loads without a size cannot overlap.
    sized = [exciter for exciter in scene.exciters if getattr(exciter.loads, "ball_radius", None) is not None]
    return with_separation_status(run, is_settled=is_settled) if is_settled or sized else run


def run_planned(plan: RunPlan, *, throw: bool) -> Run:
    """Return the run of a plan, without a test for separation. **Raises** `ComputationError` if it fails and `throw` is
    True."""
    begun = time.perf_counter()
    if plan.accuracy is not None:
        run = _run_to_accuracy(plan, plan.accuracy)
    elif plan.is_estimated:
        run = _run_with_estimate(plan)
    else:
        run = _run(plan, plan.integration.control)
    if plan.is_known:
        jax.block_until_ready((run.steps, run.error))
        run = dataclasses.replace(run, seconds=on_device(np.asarray(time.perf_counter() - begun, run.seconds.dtype)))
    return outcome(run, plan.given_scene, plan.end, throw=throw, failures=_FAILURES, hint=partial(_hint, plan, run))


def _run(plan: RunPlan, control: Control, *, is_measured: bool = True) -> Run:
    """Return a run with the steps of `control`, in the segments of the plan; `is_measured`: True to measure its window."""
    if plan.segments > 1:
        return _run_in_segments(plan, control, is_measured=is_measured)
    return integrate(*_integration(plan, plan.end, plan.state, control, is_measured=is_measured))


def prepare_run(plan: RunPlan) -> None:
    """Compile the program of a run in a background thread while the values of its initial state are still computed."""
    call = _integration(plan, plan.end, plan.state, plan.integration.control, is_measured=True)
    in_background(partial(integrate.prepare, *call))


def _integration(
    plan: RunPlan, end: Array, state: State, control: Control, *, is_measured: bool
) -> tuple[Scene, Array, State, IntegrationPlan, np.ndarray | None]:
    """Return the arguments of `integrate` for one segment."""
    integration, measuring = plan.integration._replace(control=control), None
    if plan.is_known and plan.integration.adjoint is None:
        # One program serves runs with any limit of steps, measured or not.
        integration, measuring = _with_limit_as_number(integration), np.asarray(is_measured)
    return plan.scene, end, state, integration, measuring


def _with_limit_as_number(integration: IntegrationPlan) -> IntegrationPlan:
    """Return the plan with its limit of steps as an array argument of the program, if the control of the steps allows this."""
    control, max_steps = integration.control, integration.max_steps
    if not isinstance(control, StepControl) or (control.steps is not None and float(control.steps) > max_steps):
        return integration
    limit = None if control.tolerance is None else np.asarray(max_steps, np.int32)
    return integration._replace(control=StepControl(control.tolerance, control.steps, limit), max_steps=MAX_STEPS)


def _run_in_segments(plan: RunPlan, control: Control, *, is_measured: bool) -> Run:
    """Return the run of the last of several segments.

    The time of each segment begins at 0. All segments except the last have a whole number of turns of the rotor, and the
    angles at the beginning of a segment are within one turn.
    """
    number, end = plan.segments, float(plan.end)
    if isinstance(control, StepControl) and control.steps is not None:
        control = StepControl(steps=np.asarray(np.ceil(control.steps / number), control.steps.dtype))
    length, state, runs = whole_turns(plan.scene, end / number), plan.state, []
    for k in range(number):
        is_last = k == number - 1
        span = jnp.asarray(end - (number - 1) * length if is_last else length, plan.end.dtype)
        run = integrate(*_integration(plan, span, state, control, is_measured=is_measured and is_last))
        runs.append(run)
        if status_name(run.status) != "done":
            break
        state = last_state(plan.scene, run)
    return join_segments(runs, length * (len(runs) - 1))


def join_segments(runs: Sequence[Run], start: float = 0.0) -> Run:
    """Return the last of consecutive runs with the cost of all of them. `start`, s, is added to the times of its window."""

    def total(counts: list[Array]) -> Array:
        return on_device(np.sum([np.asarray(each) for each in counts], dtype=counts[0].dtype))

    last = runs[-1]
    return dataclasses.replace(
        last,
        **{name: total([getattr(run, name) for run in runs]) for name in ("steps", "rejected", "evaluations", "seconds")},
        window=dataclasses.replace(last.window, time=last.window.time + start),
        coincident=on_device(np.all([numpy_if_known(run.coincident) for run in runs])),
    )


_COARSE_TOLERANCE_RATIO = 100.0
"""Largest tolerance of the second run (for the error estimate), in units of that of the first run."""


def _coarser_control(control: StepControl) -> StepControl:
    """Return the control of the second run, with larger steps."""
    if control.steps is not None:
        return StepControl(steps=np.asarray(np.ceil(control.steps / 2.0), control.steps.dtype))
    assert control.tolerance is not None
    larger = np.minimum(_COARSE_TOLERANCE_RATIO * control.tolerance, np.sqrt(control.tolerance))
    return StepControl(tolerance=np.asarray(larger, control.tolerance.dtype))


def _run_with_estimate(plan: RunPlan) -> Run:
    """Return a run with its error, which a second run with larger steps estimates.

    Both runs are computed in parallel, except under a JAX transformation. A progress meter shows the run itself, which takes
    longer.
    """
    control = plan.integration.control
    assert isinstance(control, StepControl)
    coarser = _coarser_control(control)
    silent = dataclasses.replace(plan, integration=plan.integration._replace(progress_meter=None))
    runs = partial(_run, plan, control), partial(_run, silent, coarser, is_measured=False)
    if plan.is_known:
        fine, coarse = in_threads(lambda k: runs[k](), 2)
    else:
        fine, coarse = (run() for run in runs)
    return _compare_runs(plan, fine, coarse, control, coarser, coarse.evaluations)


_MAX_ACCURACY_RUNS = 6
"""Maximum number of runs to reach an `accuracy`."""


def _run_to_accuracy(plan: RunPlan, accuracy: float) -> Run:
    """Repeat a run with smaller and smaller tolerances, and return the first one whose estimated error is at most `accuracy`,
    or the last one with the status `not_accurate`."""
    control, dtype = plan.integration.control, plan.scene.top_speed.dtype
    assert isinstance(control, StepControl)
    floor, coarser = 10.0 * float(jnp.finfo(dtype).eps), _coarser_control(control)
    previous = run = _run(plan, coarser)
    for _ in range(_MAX_ACCURACY_RUNS - 1):
        latest = _run(plan, control)
        run = _compare_runs(plan, latest, previous, control, coarser, numpy_if_known(run.evaluations))
        if status_name(run.status) != "done" or float(run.error) <= accuracy:
            return run
        tolerance = float(cast(Array, control.tolerance))
        # With smaller steps, rounding errors alone would exceed the accuracy.
        radians = plan.integration.bounds[0] * latest.window.time[-1]
        if tolerance <= floor or float(estimated_error(jnp.zeros(()), 0.0, plan.scene, latest.steps, radians)) > accuracy:
            break
        # The tolerance is reduced more than in proportion, because the error may decrease more slowly than the tolerance.
        share = min(max(0.2 * (accuracy / float(run.error)) ** 1.2, 1e-5), 0.1) if np.isfinite(float(run.error)) else 1e-2
        previous, coarser = latest, control
        control = StepControl(tolerance=np.asarray(max(share * tolerance, floor), dtype))
    return eqx.tree_at(lambda r: r.status, run, RunStatus.not_accurate)


def _compare_runs(
    plan: RunPlan, fine: Run, coarse: Run, control: StepControl, coarser: StepControl, earlier_evaluations: Array | np.ndarray
) -> Run:
    """Return the run `fine` with its estimated error, and with the number of evaluations of all runs."""
    coarse_states, evaluation_counts = (coarse.window.state, coarse.status), (fine.evaluations, earlier_evaluations)
    solver, (fastest, _) = plan.integration.solver, plan.integration.bounds
    order = 8 if solver is None else solver.order(None) or 1
    error, evaluations = _estimate_error(
        plan.scene, fastest, fine.window, fine.steps, *coarse_states, control, coarser, evaluation_counts, order
    )
    return dataclasses.replace(fine, error=error, evaluations=evaluations)


def _error_share(fine: StepControl, coarse: StepControl, order: int) -> Array | np.ndarray:
    """Return the error of the finer of two runs of a smooth motion, as a share of the difference between both runs.

    With a method of order 8 the error falls in proportion to the tolerance and with the power 8 of the number of steps. The
    powers used here are 0.45 and 3, which makes the estimate conservative. With a method of an `order` p up to 3 and r times as
    many steps, the share is 1/(r^p - 1).
    """
    if fine.steps is not None and coarse.steps is not None:
        return 1.0 / ((fine.steps / coarse.steps) ** order - 1.0) if order <= 3 else (coarse.steps / fine.steps) ** 3
    assert fine.tolerance is not None and coarse.tolerance is not None
    return (fine.tolerance / coarse.tolerance) ** 0.45


@cached
def _estimate_error(
    scene: Scene,
    fastest: Array | np.ndarray,
    window: Trajectory,
    steps: Array,
    coarse_states: State,
    status: RunStatus,
    control: StepControl,
    coarser: StepControl,
    evaluations: tuple[Array, Array | np.ndarray],
    order: int,
) -> tuple[Array, Array]:
    """Return the estimated error of a run, and the sum of the `evaluations`.

    **Arguments**: `fastest`: see `frequency_bounds`; `window` and `steps` of the run; `coarse_states` of the window and
    `status` of a run with larger steps; `control` and `coarser`: controls of both runs; `order` of the method.
    """
    # The error is unknown if the second run failed, or if it has the same steps.
    is_known = status == RunStatus.done
    if control.steps is not None:
        is_known = is_known & (control.steps != coarser.steps)
    states = window.state
    coarse_states = with_nearest_turns(coarse_states, states) if angle_wrapping(scene, window.time.dtype)[0] else coarse_states
    difference = scaled_error(states, coarse_states, error_scale(states, natural_units(scene)))
    radians, ends_at_jumps = fastest * window.time[-1], control.steps is None
    error = estimated_error(
        difference, _error_share(control, coarser, order), scene, steps, radians, ends_at_jumps=ends_at_jumps
    )
    return jnp.where(is_known & jnp.isfinite(error), error, jnp.inf), evaluations[0] + evaluations[1]


def last_state(scene: Scene, run: Run) -> State:
    """Return the last state of a run, from which another run can continue. Angles are within one turn, because large angles
    would lose digits."""
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[-1], run.window.state)
    _, has_common_turns = angle_wrapping(scene, last.displacement.dtype)

    def within_one_turn(exciter_state: ExciterState) -> ExciterState:
        angle = tuple(
            x - 2.0 * np.pi * np.round((x[0] if has_common_turns else x) / (2.0 * np.pi)) for x in exciter_state.angle
        )
        return ExciterState(angle, exciter_state.rate, exciter_state.rotor, exciter_state.spin)

    last = State(last.displacement, last.velocity, exciters=tuple(map(within_one_turn, last.exciters)))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, last.displacement.dtype), last)


_FAILURES = ("max_steps_reached", "not_finite", "no_step", "not_accurate", "no_start")


def _hint(plan: RunPlan, run: Run, name: str) -> str:
    """Return text on the time of a failure and on a change that may help."""
    hint, stored = "", run.window if run.trajectory is None else run.trajectory
    times, finite = np.asarray(stored.time), np.all(np.isfinite(np.asarray(stored.state.displacement)), axis=1)
    if not bool(np.all(finite)) and bool(np.any(finite)):
        hint += f", after t = {times[finite][-1]:.6g} s"
    if name == "no_step":
        hint += "; give a smaller tolerance, or an explicit solver"
    if name == "max_steps_reached":
        hint += f" ({plan.integration.max_steps} steps); give a larger max_steps, a larger tolerance or a shorter run"
        hint += advice_on_stiffness(run.scene)
    if name == "not_accurate":
        hint += f" ({float(run.error):.1e}; requested {plan.accuracy:.1e}); allow a larger error, or give a shorter run"
    return hint
