"""Time integration of a scene, through diffrax."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, Literal, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import State
from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.drive import ConstantSpeed
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.scaled_error import error_scale, scaled_error, turned
from jaxvib.motion.integrate import PER_TURN, StepControl, fastest_and_slowest, integrate, natural_units, wrap_angles
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.start import Start, brought_up, initial_state, require_numbers, whole_state
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.units import Number, count, number, traced

__all__ = ["enough_steps", "simulate"]

_MOST_STEPS = 2**31 - 1

_COARSER = 100.0
"""The run whose difference to the run itself is its error estimate makes steps to so many times the tolerance."""

_ATTEMPTS = 6
"""Runs that an `accuracy` may take before it is given up."""

_STRETCH = 2.0e4
"""Turns after which single precision no longer resolves time; longer runs are cut into stretches."""


def simulate(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    spin_up: Number | None = None,
    save: Literal["all", "window"] = "all",
    samples: int | None = None,
    turns: int = 20,
    tolerance: float | None = None,
    accuracy: float | None = None,
    steps: int | None = None,
    estimate: bool | None = None,
    solver: diffrax.AbstractSolver | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    progress: bool = False,
    throw: bool = True,
) -> Run:
    """Integrates the full equations of motion of `scene` from 0 to `until` and measures what comes out.

    **Arguments**

    - `until`: end time, s or text such as "20 s"
    - `start`: "rest", "jam" (near the jam mode with number `mode`), "spin_up" (at rest, the rotor's speed rising smoothly
      over the time `spin_up`, half of `until` unless said otherwise), or a `State`; see `initial_state`
    - `save`: "all" keeps `samples` evenly spaced states (unless said otherwise 16 or more for each turn of the rotor, but 2000
      under a JAX transformation and 262144 at most); "window" keeps no trajectory, only what is measured
    - `turns`: how many periods of the lowest natural frequency the measuring window at the end is long (at most half the run,
      and 256 turns of the rotor)
    - `tolerance`: error a step may make, relative, and absolute in natural units: the throw S/M of the loads for
      displacements, that times the rotor's speed for velocities, 1 rad for angles, whose error is never relative (1e-8 unless
      said otherwise, in single precision 1e-5)
    - `accuracy`: in place of a tolerance, the `error` the result may have; runs are repeated with smaller tolerances until
      their estimated error is below it, 6 of them at most, or the run fails as `not_accurate`
    - `steps`: in place of a tolerance, so many equal steps
    - `estimate`: whether the run's `error` is estimated, by a second run with larger steps (half as many evaluations again);
      unless said otherwise it is where numbers are known and tolerance or steps say how steps are chosen, and not under a JAX
      transformation
    - `solver`, `controller`, `adjoint`: diffrax's, passed through; unless said otherwise a PI controller to `tolerance`,
      reverse derivatives of the very steps that were taken (over checkpoints), and Dormand and Prince's method of order 8 as
      `UnrolledDopri8`, or where that takes too long to compile (large scenes, JAX transformations) as `LoopDopri8`.
      For forward derivatives give `diffrax.ForwardMode()`: up to about ten parameters they take less time than reverse ones
    - `max_steps`: the run fails after so many steps; unless said otherwise 500 for each turn of what moves fastest, under a JAX
      transformation of the scene 2^20. A reverse derivative keeps a time for each of them: say fewer for large batches
    - `progress`: shows a bar on the error stream
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
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {scene!r}; it must be a Scene, for example load_scene('machine.toml')")
    end = number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {save!r}; it must be 'all' or 'window'")
    samples = _enough_samples(scene, end) if samples is None else count(samples, "samples", low=2)
    count(turns, "turns")
    control = _control(end, tolerance, accuracy, steps, controller, estimate)
    scene = brought_up(scene, end, start, spin_up)
    given = isinstance(start, State)
    state = whole_state(scene, start, mode) if given else initial_state(scene, start, mode=mode, throw=throw)
    if max_steps is None:
        max_steps = enough_steps(scene, end)

    known = not any(traced(leaf) for leaf in jax.tree.leaves((scene, end, state)))
    if solver is None and not known and end.dtype.itemsize >= 8:
        # Derivatives may be asked for; those of the written-out step take several times as long to compile.
        solver = LoopDopri8(tangents=isinstance(adjoint, diffrax.ForwardMode))

    def run(control: StepControl) -> Run:
        chosen = control if controller is None else controller
        kept = samples if save == "all" else 0
        allowed = min(count(max_steps, "max_steps"), _MOST_STEPS)
        stretches = _stretches(scene, end, state, save)
        if stretches > 1:
            return _in_stretches(scene, end, stretches, state, solver, chosen, adjoint, turns, allowed)
        begun = time.perf_counter()
        found = integrate(scene, end, state, solver, chosen, adjoint, kept, turns, allowed, progress)
        if traced(found.steps):
            return found
        jax.block_until_ready(found.steps)
        return _with(found, seconds=time.perf_counter() - begun)

    if accuracy is not None:
        if not known:
            raise InputError("accuracy", "needs numbers to look at; under a JAX transformation give a tolerance")
        found = _to_accuracy(scene, run, control, accuracy)
    elif controller is not None or not (known if estimate is None else estimate):
        found = run(control)
    else:
        coarse, found = run(_coarser(control)), run(control)
        found = _compared(scene, found, coarse, control, _coarser(control), [coarse])
    if throw and not traced(found.steps):
        _raise_if_failed(found, max_steps, accuracy)
    return found


def _control(end: Array, tolerance: Any, accuracy: Any, steps: Any, controller: Any, estimate: bool | None) -> StepControl:
    """What was asked for, checked: at most one of the ways to choose steps, and none the dtype cannot deliver."""
    given = {"tolerance": tolerance, "accuracy": accuracy, "steps": steps, "controller": controller}
    named = [name for name, value in given.items() if value is not None]
    if len(named) > 1:
        raise InputError(named[1], f"is given together with {named[0]}; give one of them")
    if estimate and controller is not None:
        raise InputError("estimate", "is True together with a controller, whose steps nobody can make larger; give a tolerance")
    if estimate is False and accuracy is not None:
        raise InputError("estimate", "is False together with accuracy, which is reached by estimates; give a tolerance")
    precision = float(jnp.finfo(end.dtype).eps)
    for name, value, low in (("tolerance", tolerance, 10.0 * precision), ("accuracy", accuracy, 1e3 * precision)):
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value is not None and not (plain and low <= value < 1.0):
            raise InputError(
                name,
                f"is {value!r}; in {end.dtype} it must be at least {low:.1g} and less than 1"
                + ("" if plain else ", a number of Python's own such as 1e-6")
                + ("; for smaller ones switch JAX to float64" if precision > 1e-10 else ""),
            )
    if steps is not None:
        return StepControl(steps=jnp.asarray(count(steps, "steps"), end.dtype))
    if accuracy is not None:
        tolerance = max(1e-2 * accuracy, 10.0 * precision)
    if tolerance is None:
        tolerance = 1e-8 if precision < 1e-10 else 1e-5
    return StepControl(tolerance=jnp.asarray(tolerance, end.dtype))


def _coarser(control: StepControl) -> StepControl:
    if control.steps is not None:
        return StepControl(steps=jnp.ceil(control.steps / 2.0))
    assert control.tolerance is not None
    return StepControl(tolerance=jnp.minimum(_COARSER * control.tolerance, jnp.sqrt(control.tolerance)))


def _shrink(fine: StepControl, coarse: StepControl) -> Array:
    """What share of the difference between two runs is the error of the finer one: for a method of order 8 the error falls with
    the tolerance's power 8/9 and the steps' power 8; less is counted on, 0.6 and 3, so that the estimate errs upward."""
    if fine.steps is not None and coarse.steps is not None:
        return (coarse.steps / fine.steps) ** 3
    assert fine.tolerance is not None and coarse.tolerance is not None
    return (fine.tolerance / coarse.tolerance) ** 0.6


def _compared(scene: Scene, fine: Run, coarse: Run, control: StepControl, coarser: StepControl, before: list[Run]) -> Run:
    """The finer run with its estimated error, and what it and the runs `before` it cost."""
    # A run that is compared with itself, or with one that failed, has an error that nobody knows.
    known = coarse.status == RunStatus.done
    if control.steps is not None:
        known = known & (control.steps != coarser.steps)
    ours, theirs = fine.window.state, coarse.window.state
    theirs = turned(theirs, ours) if wrap_angles(scene, fine.error.dtype)[0] else theirs
    error = scaled_error(ours, theirs, error_scale(ours, natural_units(scene))) * _shrink(control, coarser)
    error = jnp.where(known & jnp.isfinite(error), error, jnp.inf)
    evaluations = sum((run.evaluations for run in before), fine.evaluations)
    return _with(fine, error=error, evaluations=evaluations, seconds=sum((run.seconds for run in before), fine.seconds))


def _to_accuracy(scene: Scene, run: Callable[[StepControl], Run], control: StepControl, accuracy: float) -> Run:
    """Runs with ever smaller tolerances until the estimated error is small enough."""
    floor = 10.0 * float(jnp.finfo(scene.drive.speed.dtype).eps)
    before, coarse = run(_coarser(control)), _coarser(control)
    found, tried = before, [before]
    for _ in range(_ATTEMPTS - 1):
        latest = run(control)
        found = _compared(scene, latest, before, control, coarse, tried)
        if not bool(found.status == RunStatus.done):
            return found
        tolerance = float(cast(Array, control.tolerance))
        if float(found.error) <= accuracy:
            return found
        if tolerance <= floor:
            break
        # A little more than what is missing, for the error shrinks a little slower than the tolerance.
        share = min(max(0.2 * (accuracy / float(found.error)) ** 1.2, 1e-5), 0.1) if np.isfinite(float(found.error)) else 1e-2
        before, coarse = latest, control
        tried.append(latest)
        control = StepControl(tolerance=jnp.asarray(max(share * tolerance, floor), found.error.dtype))
    return eqx.tree_at(lambda r: r.status, found, RunStatus.not_accurate)


def _with(run: Run, **values: Any) -> Run:
    return dataclasses.replace(run, **{name: jnp.asarray(value, getattr(run, name).dtype) for name, value in values.items()})


def _stretches(scene: Scene, end: Array, state: State, save: str) -> int:
    """Into how many stretches a run is cut: more than one in single precision, where time would lose its digits."""
    if state.displacement.dtype.itemsize >= 8 or save != "window" or not isinstance(scene.drive, ConstantSpeed):
        return 1
    if any(traced(leaf) for leaf in jax.tree.leaves((scene, end, state))):
        return 1
    return max(1, math.ceil(float(end * fastest_and_slowest(scene)[0]) / (2.0 * math.pi * _STRETCH)))


def _in_stretches(
    scene: Scene,
    end: Array,
    number: int,
    state: State,
    solver: Any,
    controller: Any,
    adjoint: Any,
    turns: int,
    max_steps: int,
) -> Run:
    """The run of the last of several stretches; each begins at time 0 after whole turns of the rotor, angles within one."""
    begun = time.perf_counter()
    if isinstance(controller, StepControl) and controller.steps is not None:
        controller = StepControl(steps=jnp.ceil(controller.steps / number))
    length = whole_turns(scene, float(end) / number)
    last = float(end) - (number - 1) * length
    taken, rejected, evaluations = 0, 0, 0
    found = None
    for k in range(number):
        span = jnp.asarray(length if k < number - 1 else last, end.dtype)
        found = integrate(scene, span, state, solver, controller, adjoint, 0, turns, max_steps, False)
        state = last_state(scene, found)
        taken, rejected = taken + int(found.steps), rejected + int(found.rejected)
        evaluations += int(found.evaluations)
        if not bool(found.status == RunStatus.done):
            break
    assert found is not None
    counts = [jnp.asarray(n, found.steps.dtype) for n in (taken, rejected, evaluations)]
    found = eqx.tree_at(lambda r: [r.steps, r.rejected, r.evaluations], found, counts)
    found = eqx.tree_at(lambda r: r.window.time, found, found.window.time + length * (number - 1))
    return _with(found, seconds=time.perf_counter() - begun)


def whole_turns(scene: Scene, stretch: float) -> float:
    """The longest time within `stretch`, s, after which a rotor of constant speed is where it was; a turn at least."""
    turn = 2.0 * math.pi / float(scene.drive.speed)
    return max(math.floor(stretch / turn), 1) * turn


def last_state(scene: Scene, run: Run) -> State:
    """Where a run under a constant speed ended, as a state to go on from: angles within a turn keep their digits."""
    last = jax.tree.map(lambda leaf: np.asarray(leaf[-1]), run.window.state)
    _, together = wrap_angles(scene, last.displacement.dtype)
    first = np.ravel(last.angle[0])[0]
    inside = tuple(x - 2.0 * np.pi * np.round((first if together else x) / (2.0 * np.pi)) for x in last.angle)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, last.displacement.dtype), eqx.tree_at(lambda y: y.angle, last, inside))


def _enough_samples(scene: Scene, end: Array) -> int:
    """So many that a picture shows the vibration and no beat of it with the samples; a power of 2: few compilations."""
    wanted = PER_TURN * end * scene.drive.speed / (2.0 * jnp.pi)
    return 2000 if traced(wanted) else 2 ** math.ceil(math.log2(max(min(2.0**18, float(wanted)), 2000.0)))


def enough_steps(scene: Scene, end: Array) -> int:
    """500 steps for each turn of what moves fastest, rounded up to a power of 2 so that few numbers need few compilations."""
    turns = end * fastest_and_slowest(scene)[0] / (2.0 * jnp.pi)
    if traced(turns):
        return 2**20
    steps = 4096 + 500 * float(turns)
    if not steps <= _MOST_STEPS:
        require_numbers(scene)
        raise InputError("until", f"is {float(end):g} s, {float(turns):.2g} turns of what moves fastest; run shorter stretches")
    return min(2 ** math.ceil(math.log2(steps)), _MOST_STEPS)


def _raise_if_failed(run: Run, max_steps: int, accuracy: float | None) -> None:
    if bool(run.status == RunStatus.done):
        return
    require_numbers(run.scene)
    names = ("max_steps_reached", "not_finite", "no_step", "no_start", "not_accurate")
    name = next(name for name in names if bool(run.status == getattr(RunStatus, name)))
    kept = run.window if run.trajectory is None else run.trajectory
    times, finite = np.asarray(kept.time), np.all(np.isfinite(np.asarray(kept.state.displacement)), axis=1)
    hint = run.message
    if not bool(np.all(finite)) and bool(np.any(finite)):
        hint += f", after t = {times[finite][-1]:.6g} s"
    if name == "no_step":
        hint += "; give a smaller tolerance, or an explicit solver"
    if name == "max_steps_reached":
        hint += f" ({max_steps} steps); give a larger max_steps, a larger tolerance or a shorter run"
    if name == "not_accurate":
        hint += f" ({float(run.error):.1e}, asked for {accuracy:.1e}); give a larger accuracy, or a shorter run"
    raise ComputationError(name, hint)
