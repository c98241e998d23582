"""Compiled time integration of the full equations of motion, as used by `simulate`."""

from __future__ import annotations

import dataclasses
import functools
import math
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import Dynamics, dynamics_of
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.equations.model import Model, assemble
from jaxvib.equations.state import ExciterState, Spin, State
from jaxvib.errors import InputError
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import LoadInteraction, RotorImbalance, Term
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import measure, trajectory, unmeasured
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.integration.contacts import Contacts, ContactSolver
from jaxvib.motion.integration.system import PackedSystem, with_first_derivatives
from jaxvib.motion.run import Run, RunStatus
from jaxvib.numerics.linalg import eigenvalues_in_turn
from jaxvib.ode.control import PIController
from jaxvib.ode.replay import solve
from jaxvib.runtime.programs import cached

WINDOW_SAMPLES = 4096
"""Number of samples in the measuring window, if no stop needs more."""

MIN_SAMPLES_PER_TURN = 16
"""Smallest number of samples in a turn of the rotor; a vibration with the period of a turn is then interpolated with
a relative error of 4e-9, see `jaxvib.numerics.extrema.locate_extrema`."""

_MOTOR_SPEEDS = 33
"""Number of speeds from 0 to the largest one at which the rates of a motor are computed."""

_UNBOUNDED_FACTOR = 1e8
"""Displacement or velocity, in units of its initial value or of its natural unit, beyond which a motion counts as unbounded."""


class StepControl(eqx.Module):
    """Choice of steps (scalars): a `tolerance` with at most `max_steps`, or a number of equal `steps`."""

    tolerance: Array | np.ndarray | None = None
    steps: Array | np.ndarray | None = None
    max_steps: Array | np.ndarray | None = None


def repeat_per_coordinate(unit: State, state: State) -> State:
    """Return the natural units of a state, with one unit for each coordinate of the loads."""

    def repeated(unit: ExciterState, exciter_state: ExciterState) -> ExciterState:
        number, spin = len(exciter_state.angle), unit.spin
        spin = spin if spin is None or spin.slip is None else Spin(spin.drilling, spin.slip * number)
        return ExciterState(unit.angle * number, unit.rate * number, unit.rotor, spin)

    return State(unit.displacement, unit.velocity, exciters=tuple(map(repeated, unit.exciters, state.exciters)))


def _controller(motion: PackedSystem, state: State, natural: State, control: StepControl) -> diffrax.AbstractStepSizeController:
    if control.steps is not None:
        return diffrax.ConstantStepSize()
    assert control.tolerance is not None
    # The error of an angle is absolute: an error relative to the growing angle would let a long run lose its phase.
    ones, zero, dtype = jnp.ones(()), jnp.zeros(()), state.displacement.dtype

    def relative_of(exciter_state: ExciterState) -> ExciterState:
        rotor, spin = (
            None if exciter_state.rotor is None else (zero, *(ones for _ in exciter_state.rotor[1:])),
            jax.tree.map(jnp.ones_like, exciter_state.spin),
        )
        return ExciterState((zero,) * len(exciter_state.angle), (ones,) * len(exciter_state.rate), rotor, spin)

    relative = State(ones, ones, exciters=tuple(map(relative_of, state.exciters)))
    unit = repeat_per_coordinate(natural, state)

    def spread(tree: State) -> State:
        return jax.tree.map(lambda value, leaf: jnp.broadcast_to(jnp.asarray(value, dtype), leaf.shape), tree, state)

    tolerance = jnp.asarray(control.tolerance, dtype)
    units = motion.pack(spread(unit))
    if motion.wrapped:  # the count of turns has no error, so its unit has no effect
        units = (units[0], jax.tree.map(jnp.ones_like, units[1]))
    return PIController(tolerance=tolerance, unit=units, relative=motion.pack(spread(relative)), max_steps=control.max_steps)  # pyright: ignore[reportCallIssue]


def with_jump_times(scene: Scene, controller: Any) -> diffrax.AbstractStepSizeController:
    """Return a controller whose steps end at the jumps of the drives' accelerations; a controller of given steps is
    unchanged."""
    jump_ts = [t for exciter in scene.exciters for t in exciter.drive.jump_ts()]
    if not jump_ts or not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return controller
    return diffrax.ClipStepSizeController(controller, jump_ts=jnp.stack(jump_ts))


def effects_rate(scene: Scene, *kinds: type[Term]) -> Array:
    """Return the fastest rate that effects, with terms of certain `kinds` if given, add to the motion of loads, see
    `Effect.fastest_rate`; 0 without such effects."""
    all_rates, zero = [], jnp.zeros_like(scene.exciters[0].drive.speed)
    for exciter in scene.exciters:
        if exciter.loads is not None:
            effects = [e for e in (*scene.effects, *exciter.effects) if not kinds or has_term([e], *kinds)]
            rates = [effect.fastest_rate(exciter.loads, exciter.drive.speed) for effect in effects]
            all_rates += [jnp.max(rate) for rate in rates if rate is not None]
    return functools.reduce(jnp.maximum, all_rates, zero)


def motor_poles(drive: Drive) -> Array:
    """Return the poles of a motor whose rotor is free, complex, 1/s, at several speeds: eigenvalues of the linearized equations
    of the speed and of the states of the motor."""
    drive, zero = drive.at_working_speed(), jnp.zeros_like(drive.speed)
    states = tuple(zero for _ in drive.state_units())

    def rates(x: Array) -> Array:
        motor = drive.torque_and_inertia(zero, x[0], tuple(x[1:]))
        assert motor is not None
        return jnp.stack([motor[0] / motor[1], *(drive.state_rates(zero, x[0], tuple(x[1:])) if states else ())])

    speeds = jnp.append(drive.largest_speed * jnp.linspace(0.0, 1.0, _MOTOR_SPEEDS, dtype=zero.dtype), drive.speed)
    slopes = jax.vmap(lambda speed: jax.jacfwd(rates)(jnp.stack([speed, *states])))(speeds)
    return jnp.ravel(jax.vmap(eigenvalues_in_turn)(slopes) if states else slopes + 0j)


@cached
def frequency_bounds(scene: Scene) -> tuple[Array, Array]:
    """Return the fastest and the slowest frequency of the motion of a scene, rad/s.

    The fastest is the largest of these: the natural frequencies of the carrier, that of the loads if they have one, the rates
    of effects, the speeds of the drives during a run, and the frequencies of motors (see `motor_poles`). The slowest is the
    lowest natural frequency of the carrier, in which the working speed replaces a frequency of 0 (a free carrier).
    """
    scene = jax.lax.stop_gradient(scene)
    frequencies, speed = estimated_frequencies(scene), scene.top_speed
    largest = functools.reduce(jnp.maximum, (exciter.drive.largest_speed for exciter in scene.exciters))
    fastest = jnp.maximum(largest, jnp.max(frequencies))
    for exciter in scene.exciters:
        if exciter.drive.state_units():
            fastest = jnp.maximum(fastest, jnp.max(jnp.abs(motor_poles(exciter.drive).imag)))
        natural_frequency = None if exciter.loads is None else exciter.loads.natural_frequency(exciter.drive.speed)
        fastest = fastest if natural_frequency is None else jnp.maximum(fastest, jnp.max(natural_frequency))
    fastest = jnp.maximum(fastest, effects_rate(scene))
    return fastest, jnp.min(jnp.where(frequencies > 0.0, frequencies, speed))


def angle_wrapping(scene: Scene, dtype: np.dtype) -> tuple[bool, bool]:
    """Return two flags. The first is True if the integration keeps angles within one turn (single precision), the second if it
    then subtracts the same number of turns from the angles of all loads of an exciter (loads in contact)."""
    return dtype.itemsize < 8, has_term(scene.all_effects, LoadInteraction)


class IntegrationPlan(NamedTuple):
    """Choices for one time integration: method, steps, and stored states.

    **Attributes**: `solver` of diffrax, None for the method of order 8 in its fastest form; `control` of the steps; `adjoint`
    of diffrax, None for that of `jaxvib.ode.replay`; number of stored `samples` of the whole run, 0 for none; length of the
    measuring window in `periods` of the slowest motion; `bounds`, see `frequency_bounds`; `max_steps`; `progress_meter` of
    diffrax; `window_samples`: number of samples in the measuring window.
    """

    solver: diffrax.AbstractSolver | None
    control: diffrax.AbstractStepSizeController | StepControl
    adjoint: diffrax.AbstractAdjoint | None
    samples: int
    periods: Array | np.ndarray
    bounds: tuple[Array | np.ndarray, Array | np.ndarray]
    max_steps: int
    progress_meter: diffrax.AbstractProgressMeter | None = None
    window_samples: int = WINDOW_SAMPLES


@cached
def integrate(
    scene: Scene, end: Array, state: State, plan: IntegrationPlan, is_measured: Array | np.ndarray | None = None
) -> Run:
    """Integrate the full equations of motion from 0 to `end` by a plan.

    `is_measured`: True to measure the window at the end; False to leave the measured quantities NaN; None to measure it
    without a branch in the program.
    """
    scene, (end, state) = with_first_derivatives(scene, (end, state))
    # An initial state that does not exist (a jam mode that is absent in one run of a batch) must not slow down the other runs.
    exists = is_finite(state)
    state = jax.tree.map(lambda leaf: jnp.where(exists, leaf, 0.0), state)
    unit = natural_units(scene)
    saves = _saves(scene, end, plan)
    model = assemble(scene)
    field = dynamics_of(model)
    motion, solver = _system_and_method(scene, field, state, plan)
    first_step, controller = _steps(motion, state, unit, plan, end)
    solution = solve(
        motion.term,
        solver,
        end=end,
        first_step=first_step,
        y0=motion.pack(state),
        args=motion.args,
        saveat=diffrax.SaveAt(subs=saves),
        controller=with_jump_times(scene, controller),
        adjoint=plan.adjoint,
        max_steps=plan.max_steps,
        progress=plan.progress_meter,
    )
    assert solution.ts is not None and solution.ys is not None
    where_start_exists = partial(jax.tree.map, lambda value: jnp.where(exists, value, jnp.nan))
    times, states = where_start_exists((solution.ts[0], motion.unpack(solution.ys[0])))
    window = trajectory(model, times, states)
    whole_run = trajectory(model, solution.ts[2], motion.unpack(solution.ys[2])) if plan.samples else None
    measured = partial(measure, model, field, times, states, unit)
    # The second run, with larger steps, only estimates the error. It needs the states of its window, but no measurement.
    numbers = measured() if is_measured is None else jax.lax.cond(is_measured, measured, partial(unmeasured, model, states))
    # The speeds of ideal drives are not in the states.
    numbers, whole_run, speeds = where_start_exists((numbers, whole_run, window.rotor_speeds))
    window = dataclasses.replace(window, rotor_speeds=speeds)
    last = jax.tree.map(lambda leaf: leaf[-1], motion.unpack(solution.ys[1]))
    # A run that did not reach its end has no window; its last state shows whether it diverged.
    has_ended = solution.result == diffrax.RESULTS.successful
    is_bounded = jnp.where(has_ended, is_finite(states), ~is_unbounded(unit, state, last))
    steps = solution.stats["num_steps"]
    not_computed = jnp.full_like(end, jnp.nan)
    return Run(
        status=RunStatus.where(exists, _status(solution.result, is_bounded), RunStatus.no_start),
        trajectory=whole_run,
        window=window,
        **{name: getattr(numbers, name) for name in type(numbers).__dataclass_fields__},
        error=not_computed,
        steps=steps,
        rejected=solution.stats["num_rejected_steps"],
        evaluations=steps * _stages(solver),
        seconds=not_computed,
        scene=scene,
        coincident=_stay_coincident(model, state, states),
        engine="scalar" if motion.is_scalarized else "array",
    )


def _system_and_method(
    scene: Scene, field: Dynamics, state: State, plan: IntegrationPlan
) -> tuple[PackedSystem, diffrax.AbstractSolver]:
    wrapped, has_common_turns = angle_wrapping(scene, state.displacement.dtype)
    motion = PackedSystem(
        field,
        state,
        wrapped=wrapped and plan.solver is None,
        has_common_turns=has_common_turns,
        contacts=Contacts.of(scene),
        solver=plan.solver,
    )
    solver = motion.method(plan.adjoint) if plan.solver is None else plan.solver
    return motion, ContactSolver(solver, motion) if motion.has_contacts else solver


def _saves(scene: Scene, end: Array, plan: IntegrationPlan) -> list[diffrax.SubSaveAt]:
    """Return the times of stored states: the measuring window, the end, and evenly spaced times over the whole run."""
    longest = 2.0 * jnp.pi * WINDOW_SAMPLES / (MIN_SAMPLES_PER_TURN * jax.lax.stop_gradient(scene.top_speed))
    window = jnp.minimum(jnp.minimum(2.0 * jnp.pi * plan.periods / plan.bounds[1], longest), end / 2.0)
    saves = [diffrax.SubSaveAt(ts=jnp.linspace(end - window, end, plan.window_samples)), diffrax.SubSaveAt(t1=True)]
    if plan.samples:
        saves.append(diffrax.SubSaveAt(ts=jnp.linspace(0.0, end, plan.samples)))
    return saves


def _steps(
    motion: PackedSystem, state: State, unit: State, plan: IntegrationPlan, end: Array
) -> tuple[Array | None, diffrax.AbstractStepSizeController]:
    """Return the length of the first step, s, and the controller of the further steps."""
    control, fastest = plan.control, jnp.asarray(plan.bounds[0])
    if isinstance(control, StepControl):
        first = 0.05 / fastest
        if control.steps is not None:
            first = end / jnp.asarray(control.steps)
        if control.tolerance is not None:
            # The first step is proportional to the power 1/9 of the tolerance, the further steps to about its power 1/8.
            # Different tolerances therefore give different steps from the beginning.
            first = 0.4 * jnp.asarray(control.tolerance) ** (1.0 / 9.0) / fastest
        return first, _controller(motion, state, unit, control)
    return None if isinstance(control, diffrax.StepTo) else 0.05 / fastest, control


def _stay_coincident(model: Model, start: State, states: State) -> Array:
    """Return True if several loads of a track have one angle at the `start` and in all `states`."""
    stations = [
        None if mount.at_one_point else mount.distances(exciter.loads.count)
        for mount, exciter in zip(model.mounts, model.scene.exciters, strict=True)
        if exciter.loads is not None
    ]
    first, later = (
        [exciter_state.angle[0] for exciter_state in either.exciters if exciter_state.angle] for either in (start, states)
    )
    return _is_coincident([angle[None] for angle in first], stations) & _is_coincident(later, stations)


def _is_coincident(angles: list[Array], stations: list[Array | None]) -> Array:
    """Return True if several loads of a track have the same angle at all times (..., count), except for rounding errors."""

    def has_one_angle(angle: Array, stations: Array | None) -> Array:
        limit = jnp.finfo(angle.dtype).eps ** 0.4
        if stations is None:
            return (angle.shape[1] > 1) & (jnp.max(jnp.max(angle, axis=1) - jnp.min(angle, axis=1)) < limit)
        is_same_station = stations[:, None] == stations[None, :]
        spread = jnp.max(jnp.abs(angle[:, :, None] - angle[:, None, :]), axis=0)
        return jnp.any((jnp.sum(is_same_station, axis=1) > 1) & jnp.all(~is_same_station | (spread < limit), axis=1))

    has_coincident = list(map(has_one_angle, angles, stations))
    return functools.reduce(jnp.logical_or, has_coincident) if has_coincident else jnp.zeros((), bool)


def is_unbounded(unit: State, first: State, last: State) -> Array:
    """Return True if the displacement or velocity of the carrier exceeds its initial value and its natural unit by the factor
    `_UNBOUNDED_FACTOR`, or if the last state is not finite."""
    pairs = ((first.displacement, last.displacement, unit.displacement), (first.velocity, last.velocity, unit.velocity))
    beyond = [
        jnp.max(jnp.abs(b)) > _UNBOUNDED_FACTOR * jnp.maximum(jnp.max(jnp.abs(a)), natural_unit) for a, b, natural_unit in pairs
    ]
    return beyond[0] | beyond[1] | ~is_finite(last)


def _status(result: diffrax.RESULTS, is_bounded: Array) -> RunStatus:
    ended_status = RunStatus.where(is_bounded, RunStatus.done, RunStatus.not_finite)
    # A step that is rejected until its length is zero contains numbers that are not finite.
    failed_status = RunStatus.where(result == diffrax.RESULTS.dt_min_reached, RunStatus.not_finite, RunStatus.no_step)
    failed_status = RunStatus.where(result == diffrax.RESULTS.max_steps_reached, RunStatus.max_steps_reached, failed_status)
    failed_status = RunStatus.where(is_bounded, failed_status, RunStatus.not_finite)
    return RunStatus.where(result == diffrax.RESULTS.successful, ended_status, failed_status)


def _stages(solver: diffrax.AbstractSolver) -> int:
    """Return the number of evaluations of the vector field in a step; 0 if the method has no tableau."""
    tableau = getattr(solver, "tableau", None)
    return 0 if tableau is None else tableau.num_stages - tableau.fsal


def is_finite(state: object) -> Array:
    """Return True if every number of a state, or of another tree, is finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]))


_MAX_TURNS = 1e15
"""Largest number of turns that double precision resolves."""


def whole_turns(scene: Scene, segment: float) -> float:
    """Return the longest time within `segment`, s, that is a whole number of turns of all rotors, but at least one turn.

    The rotors of motors are ignored, because their angles are part of the state; a period of their supply counts as a turn. If
    there are several rotors, only those with an unbalance or an imbalance are considered. **Raises** `InputError` if the speeds
    of these rotors and the frequencies of supplies are not all equal.
    """
    is_single = len(scene.exciters) == 1
    counted = [
        e
        for e in scene.exciters
        if e.drive.ideal and (is_single or e.carries != ("loads",) or has_term(e.effects, RotorImbalance))
    ]
    supplies = [frequency for e in scene.exciters if (frequency := e.drive.supply_frequency()) is not None]
    speeds = sorted({float(w) for w in (*(exciter.drive.speed for exciter in counted), *supplies)})
    if not speeds:
        return segment
    if len(speeds) > 1:
        problem = f"have unbalances or supplies at {speeds} rad/s; these must be equal; use simulate, or other motors"
        raise InputError("exciters", problem)
    turn = 2.0 * math.pi / speeds[0]
    turns = segment / turn
    if turns > _MAX_TURNS:
        raise InputError(
            "until", f"gives segments of {turns:.3g} turns of the rotor; they must be shorter than {_MAX_TURNS:.0e}"
        )
    return max(math.floor(turns), 1) * turn
