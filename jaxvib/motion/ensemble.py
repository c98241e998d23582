"""Many runs at once, on every core or accelerator."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.boundary import call_user, validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text
from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import ExciterState, State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import total_gravity
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import axis_labels
from jaxvib.motion.analysis.ensemble_regimes import (
    MAX_RELATIVE_ROTATION,
    EnsembleRegimes,
    RotatingMasses,
    regimes_of_runs,
    rotating_masses,
)
from jaxvib.motion.analysis.measure import turning_angles, turning_directions
from jaxvib.motion.analysis.scaled_error import error_scale, estimated_error, natural_units, scaled_error
from jaxvib.motion.batch import advance, batch_size, divide_run, pack_batch
from jaxvib.motion.integrate import is_finite, is_unbounded
from jaxvib.motion.integration.stiffness import is_unresolved, resolves_contact
from jaxvib.motion.integration.system import with_first_derivatives
from jaxvib.motion.plan import ENSEMBLE_PARTS, EnsemblePlan, EqualSteps, plan_ensemble
from jaxvib.ode.replay import forward_only
from jaxvib.ode.types import Y
from jaxvib.results.estimate import Share, estimate_share
from jaxvib.results.fields import in_unit, names_along, part
from jaxvib.results.result import Result
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.runtime.structure import Skeleton
from jaxvib.steady.outcome import REFUSED, without_numbers
from jaxvib.units import Number

_EQUAL_SPEEDS, _SPEED_GAP, _MAX_SHOWN_GROUPS = 0.01, 0.03, 6
"""Largest difference of the mean speeds of the masses of a run that count as equal, and smallest gap between two groups of
runs, both relative to the largest speed; largest number of groups in the summary."""

_Ends: TypeAlias = tuple[State, Array, Array, Array, Array, Array]
"""Results of `_run`, for one run or for many."""

Equations = Callable[[Scene], Callable[[Array, State], State]]


def field_of(equations: Equations, scene: Scene) -> Callable[[Array, State], State]:
    """Return the equations of motion of a scene. **Raises** `InputError` for a function that does not return a function."""
    field: Callable[[Array, State], State] = call_user(equations, "equations", scene)
    if callable(field):
        return field
    raise InputError("equations", f"returns {quoted(field)}; it must return a function of a time and a State")


class EnsembleStatus(eqx.Enumeration):
    """Outcomes of a run of an ensemble. The value of each member is the message shown to the user."""

    done = "the run reached its end"
    detached = "the run reached its end, but a load lost contact with its track; the equations keep it on the track"
    not_finite = "the motion grew without bounds"
    refused = REFUSED
    not_resolved = (
        "the steps are too long for contacts or for a fast decay due to drag of the loads, damping or a motor: use more steps"
    )


class Ensemble(Result):
    """Final states of many runs, and quantities measured at their ends.

    Returned by `ensemble`.

    **Attributes** (B runs)

    - `state`: final `State` of each run, with arrays that have a leading axis over the runs; in single precision angles are
      within one turn, unless the steps are implicit
    - `load_speed` (B, count), rad/s: the mean speed of each load, or of the rotor of an exciter without loads, over the last
      quarter of the run
    - `relative_rotation` (B,), rad: largest difference between the angles through which two masses turn, each in its
      direction, in the last quarter of the run. A mass is a load, or the rotor of an exciter without loads. The difference is 0
      for a scene with one exciter
    - `masses`: for several exciters, the `RotatingMasses` of each run: angle turned in the last quarter, phase at the end, and
      the resonance that catches the mass; `regimes` names the motions that follow from them. None for one exciter
    - `speed_group` (B,): groups of runs by the speed of their masses, from 1, ascending; 0 for a run whose masses turn at
      different speeds, or whose motion did not stay finite
    - `error` (B,): estimated error of the final state, relative to the scales that `Run` describes; the largest displacement
      and the largest velocity are taken from the final state. Typical: below 1e-6 with the default steps. NaN if no estimate
      was requested or the motion did not stay finite; infinite for 4 steps or fewer, because a run with larger steps does not
      exist
    - `allowed` (B,): False if `make` returned a scene with a value that its constructor does not allow
    - `finite` (B,): True if the motion stayed finite (with contacts: and did not grow by the factor 1e8)
    - `resolved` (B,): False if explicit steps are too long for the fastest decay, which is possible under a JAX transformation,
      or if steps are too long for contacts with a `Stop` or between loads (3 steps per contact or fewer, or 4 per decay time of
      its damper)
    - `detached` (B, count): True if, at any stage of any step, the track would have had to pull the load although it can only
      push
    - `steps` of each run
    - `seconds` for all runs together, including compilation if a program was new; NaN under a JAX transformation
    - `coordinates`, `units`: names of the coordinates, and their units; `loads`: names of the loads, "2.1" for the first load
      of exciter 2, and "2" for its rotor if it has no loads
    """

    state: State = eqx.field(metadata=part("run"))
    load_speed: Array = eqx.field(metadata=in_unit("rad/s", "run", "load"))
    relative_rotation: Array = eqx.field(metadata=in_unit("rad", "run"))
    error: Array = eqx.field(metadata=in_unit("", "run"))
    allowed: Array = eqx.field(metadata=in_unit("", "run"))
    finite: Array = eqx.field(metadata=in_unit("", "run"))
    resolved: Array = eqx.field(metadata=in_unit("", "run"))
    detached: Array = eqx.field(metadata=in_unit("", "run", "load"))
    steps: Array = eqx.field(metadata=in_unit(""))
    seconds: Array = eqx.field(metadata=in_unit("s"))
    masses: RotatingMasses | None = eqx.field(default=None, metadata=part("run"))
    coordinates: tuple[str, ...] = eqx.field(default=(), static=True, metadata=names_along("coordinate"))
    units: tuple[str, ...] = eqx.field(default=(), static=True, metadata=names_along("unit"))
    loads: tuple[str, ...] = eqx.field(default=(), static=True, metadata=names_along("load"))

    @property
    def status(self) -> EnsembleStatus:
        """Outcome of each run, an `EnsembleStatus` for each."""

        def status_of_run(allowed: Array, finite: Array, detached: Array, resolved: Array) -> EnsembleStatus:
            ended = EnsembleStatus.where(jnp.any(detached), EnsembleStatus.detached, EnsembleStatus.done)
            ended = EnsembleStatus.where(finite, ended, EnsembleStatus.not_finite)
            return EnsembleStatus.where(
                allowed, EnsembleStatus.where(resolved, ended, EnsembleStatus.not_resolved), EnsembleStatus.refused
            )

        return jax.vmap(status_of_run)(self.allowed, self.finite, self.detached, self.resolved)

    @property
    def synchronous(self) -> Array:
        """True for runs (B,) whose exciters turn at one speed: the motion stayed finite and `relative_rotation` is below
        0.5 rad."""
        return self.finite & (self.relative_rotation < MAX_RELATIVE_ROTATION)

    @property
    def synchronous_share(self) -> Share:
        """Share of `synchronous` runs, with its confidence interval of 95 %."""
        return estimate_share(self.synchronous)

    @property
    def regimes(self) -> EnsembleRegimes:
        """Regimes of the runs of a machine with several exciters, with their shares, see `EnsembleRegimes`.

        **Raises** `InputError` for one exciter.
        """
        if self.masses is None:
            problem = "has runs of a machine with one exciter; regimes are those of several exciters"
            raise InputError("ensemble", f"{problem}; for one exciter use speed_group, and regime of single runs")
        return regimes_of_runs(self.masses, np.asarray(self.load_speed), np.asarray(self.finite))

    @property
    def speed_group(self) -> np.ndarray:
        """Numbers (B,) of groups of runs in which all masses turn at about one speed, from 1 in the order of the speeds.

        Speeds of two groups differ by at least 3 % of the largest speed. Runs with loads that are caught at a resonance, that
        turn with the rotor, or that swing (speed 0), are thus in different groups. The number is 0 if the masses of a run turn
        at different speeds, or if its motion did not stay finite.
        """
        speeds = np.abs(np.asarray(self.load_speed))
        largest = np.max(speeds[np.asarray(self.finite)], initial=0.0)
        has_one_speed = np.asarray(self.finite) & (np.ptp(speeds, axis=1) <= _EQUAL_SPEEDS * largest)
        mean = np.mean(speeds, axis=1)
        order = np.flatnonzero(has_one_speed)[np.argsort(mean[has_one_speed], kind="stable")]
        groups = np.zeros(mean.shape, int)
        groups[order] = 1 + np.cumsum(np.diff(mean[order], prepend=mean[order[:1]]) > _SPEED_GAP * largest)
        return groups

    def _group_lines(self) -> list[str]:
        """Return a line of text for each of the first groups of `speed_group`, none if all runs are in one."""
        groups, speeds = self.speed_group, np.mean(np.abs(np.asarray(self.load_speed)), axis=1)
        if np.min(groups) == np.max(groups):
            return []
        lines = []
        for k in range(1, int(np.max(groups)) + 1)[:_MAX_SHOWN_GROUPS]:
            low, high = np.min(speeds[groups == k]), np.max(speeds[groups == k])
            text = speed_text([low] if np.isclose(low, high, rtol=1e-4) else [low, high], 5, " .. ")
            lines.append(f"  {np.count_nonzero(groups == k)} of {groups.size} runs: all masses turn at {text}")
        others = np.count_nonzero((groups == 0) & np.asarray(self.finite))
        return lines + [f"  {others} of {groups.size} runs: masses turn at different speeds"] * bool(others)

    def summary(self) -> str:
        """Return the outcomes, the load speeds, the groups of runs by speed, the share of synchronous runs and the errors as
        text."""
        finite = np.asarray(self.finite)
        head = f"{self.message}; {int(self.steps)} steps each, {float(self.seconds):.3g} s in all"
        if not np.any(finite):
            return head
        speeds, error = np.asarray(self.load_speed)[finite], np.asarray(self.error)[finite]
        worst = "error not estimated" if np.all(np.isnan(error)) else f"error of the end states up to {np.nanmax(error):.1e}"
        turning = "loads" if self.masses is None else "masses"
        lines = [head, f"  {turning} turn at {speed_text([np.min(speeds), np.max(speeds)], 6, ' .. ')}; {worst}"]
        if self.masses is None:
            return "\n".join(lines + self._group_lines())
        shown = self.regimes.summary().splitlines()
        lines += [f"  {line}" for line in shown[:_MAX_SHOWN_GROUPS]]
        if len(shown) > _MAX_SHOWN_GROUPS:
            lines.append(f"  {len(shown) - _MAX_SHOWN_GROUPS} more regimes in regimes.summary()")
        lines.append(f"  all masses of a run turn at one speed: {self.synchronous_share.text}")
        return "\n".join(lines)

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the mean speed of each load in `unit` over the runs."""
        from jaxvib.display import speed_unit
        from jaxvib.draw.results import points_chart  # slow import

        unit, scale = speed_unit(unit)
        speeds = scale * np.asarray(self.load_speed)
        return points_chart(speeds, x_label="run", y_label=f"load speed, {unit}", ax=ax)


@validated
def ensemble(
    make: Callable[..., Scene | tuple[Scene, State]],
    values: PyTree[Array],
    until: Number,
    *,
    stepsize_controller: EqualSteps | None = None,
    estimate: bool = True,
    batch: int | None = None,
    equations: Equations = vector_field,
) -> Ensemble:
    """Integrate many scenes, or one scene from many starts, from 0 to `until` with equal steps.

    - The runs of a batch advance together; each entry of the state is one contiguous array over the batch. Batches are
      distributed over all cores or accelerators; under a JAX transformation they are computed one after the other
    - Because all runs have equal steps, no run waits for another. Near the boundary between two outcomes, the outcome does not
      depend on an automatic choice of steps
    - Compiled programs are used again for other values and other numbers of runs above `batch`, if `make` is the same function
      object and the same parameters are shared by all runs. A lambda in the call is a new function in each call
    - In single precision explicit steps keep angles within one turn; therefore long runs keep their phase

    **Arguments**

    - `make`: a function of one entry of `values` that returns the `Scene` of a run, which starts at rest, or a tuple of the
      scene and its initial `State`. `make` is compiled as by `jax.jit`: later changes of variables to which it refers have no
      effect
    - `values`: an array with a leading axis over the runs, or a tree of such arrays; typical: 64 to 100,000 runs
    - `until`: end time of all runs, s or text; typical: 5 to 60
    - `stepsize_controller`: `EqualSteps(n)`, the number of steps of each run, rounded up to a multiple of 4. The default is 4
      for each radian of the fastest motion, or more to resolve a faster decay, by the drag of the loads, the damping of the
      carrier, friction at a support or a motor. If a decay is at least 100 times as fast as the motion, all runs take implicit
      steps, 32 for each radian. If n explicit steps would not resolve the decay, the n steps are implicit too (not under a JAX
      transformation). The time is proportional to n
    - `estimate`: True to estimate errors by a second run with half as many steps, which takes half the time of the first. The
      estimate requires more than 4 steps
    - `batch`: number of runs that advance together; typical: the default, 64 on a CPU and 262,144 on an accelerator. The
      memory is proportional to it
    - `equations`: a function of a scene that returns its equations of motion, as `vector_field` (the default) does; with
      another function, for example, the equations of a paper can be compared with those of the scene

    **Returns** `Ensemble`. Derivatives exist in forward mode only; those with respect to the times of jumps of a drive are 0,
    because steps do not end there.

    **Raises** `InputError` for values that are not allowed, or leading axes that differ.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import equinox as eqx, jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> speeds = jnp.linspace(40.0, 80.0, 5)
    >>> many = jv.ensemble(lambda n: eqx.tree_at(lambda s: s.drive.speed, scene, n), speeds, 5.0)
    >>> many.state.displacement.shape, bool(many.finite.all()), bool(many.error.max() < 1e-6)
    ((5, 1), True, True)
    """
    begun = time.perf_counter()
    plan = plan_ensemble(
        make, values, until, steps=stepsize_controller, is_estimated=estimate, batch=batch_size() if batch is None else batch
    )

    def run_batch(own: list[Array], common: list[Array], end: Array, counts: Array) -> _Ends:
        return _run_batch(own, common, end, counts, plan.is_shared, plan.form, equations, plan.implicit)

    counts = np.asarray([plan.each, plan.coarse] if plan.is_compared else [plan.each], plan.end.dtype)
    ends = in_chunks(plan.batch, run_batch, plan.own, shared=(plan.common, plan.end, counts))
    last, load_speed, difference, finite, detached, step_counts = ends
    error = np.full(plan.allowed.shape, np.inf if estimate else np.nan, plan.end.dtype)
    if plan.is_compared:
        # The error is the part (coarse/each)^3 of the difference, as for a method of order 3. This is conservative, because the
        # method has order 8.
        error = estimated_error(difference, (plan.coarse / plan.each) ** 3, plan.scenes, ends_at_jumps=False)
    unknown = np.asarray(np.nan, plan.end.dtype)
    resolved = _resolved(plan)
    if not plan.is_allowed:
        numbers = last, load_speed, error, finite, resolved, detached
        last, load_speed, error, finite, resolved, detached = jax.vmap(without_numbers)(plan.allowed, numbers)
    relative_rotation, masses = np.zeros(plan.allowed.shape, plan.end.dtype), None
    if len(plan.scenes.exciters) > 1:
        masses = rotating_masses(plan.scenes, last, load_speed, plan.end, plan.end / ENSEMBLE_PARTS)
        relative_rotation = jnp.max(masses.rotation, axis=1) - jnp.min(masses.rotation, axis=1)
    labels = axis_labels(plan.scenes)
    values = last, load_speed, relative_rotation, error, plan.allowed, finite, resolved, detached, step_counts[0], unknown
    result = Ensemble(
        *on_device((*values, masses)),
        coordinates=labels["coordinate"],
        units=labels["unit"],
        loads=labels["load"],
    )
    if not plan.is_known:
        return forward_only(result, "ensemble", "supports forward derivatives only; use jax.jacfwd or jax.jvp")
    jax.block_until_ready(result)
    return dataclasses.replace(result, seconds=on_device(np.asarray(time.perf_counter() - begun, plan.end.dtype)))


def _resolved(plan: EnsemblePlan) -> Array | np.ndarray:
    """Return True for each run whose steps resolve decay and contacts."""
    step = plan.end / (ENSEMBLE_PARTS * plan.each)
    resolved = plan.implicit | ~is_unresolved(plan.decay, step)
    return resolved if plan.contact is None else resolved & resolves_contact(plan.contact, step)


@cached
def _run_batch(
    own: list[Array],
    common: list[Array],
    end: Array,
    counts: Array,
    is_shared_array: tuple[bool, ...],
    form: Skeleton,
    equations: Equations,
    implicit: bool,
) -> _Ends:
    """Integrate a batch of runs; arrays in `own` have a leading axis over the runs, arrays in `common` belong to all runs."""

    def run_of_batch(own: list[Array]) -> _Ends:
        own_arrays, common_arrays = iter(own), iter(common)
        scene, state = form.filled(next(common_arrays) if shared else next(own_arrays) for shared in is_shared_array)
        return _run(scene, state, end, counts, equations, implicit)

    return jax.vmap(run_of_batch)(own)


def _run(scene: Scene, state: State, end: Array, counts: Array, equations: Equations, implicit: bool) -> _Ends:
    """Integrate a run with equal steps in `ENSEMBLE_PARTS` parts, once for each entry of `counts` (steps in a part).

    **Returns** for the first entry: the final state; the mean load speeds over the last part; the difference between its final
    state and the final state for the last entry of `counts`; True if the motion stayed finite; True for loads that lost contact
    with their track; and the number of steps.
    """
    scene, (state, end) = with_first_derivatives(scene, (state, end))
    has_one_sided_loads = any(exciter.loads is not None and exciter.loads.one_sided for exciter in scene.exciters)
    field, start = field_of(equations, scene), state
    if has_one_sided_loads:
        missing_forces = _concatenate(list(map(_no_force, state.exciters)))
        field, start = _FieldWithDetachment(field, scene), _StateWithDetachment(state, missing_forces)
    motion = pack_batch(scene, field, start, implicit=implicit)
    length = end / ENSEMBLE_PARTS

    def part(packed: Y, at: tuple[Array, Array], step: Array) -> tuple[Y, tuple[Y, Array]]:
        packed, step_counts = advance(motion, packed, *at, step, implicit=implicit)
        return packed, (packed, step_counts)

    def integrate_parts(steps: Array) -> tuple[Y, Array]:
        packed, begins, lengths = divide_run(
            motion, motion.pack(start), length, length / steps, ENSEMBLE_PARTS, implicit=implicit
        )
        _, (packed_parts, step_counts) = jax.lax.scan(
            lambda packed, at: part(packed, at, length / steps), packed, (begins, lengths)
        )
        return jax.tree.map(lambda leaf: leaf[-2:], packed_parts), jnp.sum(step_counts)

    packed_parts, step_counts = jax.lax.map(integrate_parts, counts)
    # `unpack` subtracts the whole turns of its first state from wrapped angles. Therefore states that are compared are unpacked
    # in one call.
    ends = motion.unpack(jax.tree.map(lambda leaf: leaf[:, -1], packed_parts))
    pair = motion.unpack(jax.tree.map(lambda leaf: leaf[0], packed_parts))
    last, coarse = (jax.tree.map(lambda leaf, k=k: leaf[k], ends) for k in (0, -1))
    is_watched = isinstance(last, _StateWithDetachment)
    detached = last.missing != 0.0 if is_watched else jnp.zeros(turning_directions(scene).shape, dtype=bool)
    last, coarse = (State(either.displacement, either.velocity, exciters=either.exciters) for either in (last, coarse))
    angle, _ = turning_angles(scene, lambda: length * jnp.arange(ENSEMBLE_PARTS - 1, ENSEMBLE_PARTS + 1), pair)
    finite, unit = is_finite(last), natural_units(scene)
    if motion.has_contacts:  # the damper of a contact that is not resolved can amplify a motion that then stays finite
        finite = finite & ~is_unbounded(unit, state, last)
    difference = scaled_error(last, coarse, error_scale(last, unit))
    # The error of a run is unknown (infinite) if the coarser run did not stay finite.
    difference = jnp.where(finite & ~is_finite(coarse), jnp.inf, difference)
    return last, (angle[1] - angle[0]) / length, difference, finite, detached, step_counts[0]


class _StateWithDetachment(State):
    """State with the time integral `missing` (loads,), N s, of the force max(-N, 0) with which each track would have to pull
    its load: exactly 0 if the normal force N was never negative, for any weights of the stages of the method."""

    missing: Array

    def __init__(self, state: State, missing: Array):
        super().__init__(state.displacement, state.velocity, exciters=state.exciters)
        self.missing = missing


class _FieldWithDetachment(eqx.Module):
    """Equations of motion extended by missing' = max(-N, 0)."""

    equations: Callable[[Array, State], State]
    scene: Scene

    def __call__(self, t: Array, state: State) -> _StateWithDetachment:
        plain = State(state.displacement, state.velocity, exciters=state.exciters)
        scene, change, missing_forces = self.scene, self.equations(t, plain), []
        for exciter, exciter_state in zip(scene.exciters, state.exciters, strict=True):
            if exciter.loads is None or not exciter.loads.one_sided:
                missing_forces.append(_no_force(exciter_state))
                continue
            normal_force = exciter.loads.normal_force(exciter_state.angle, exciter_state.rate, total_gravity(scene.effects))
            assert normal_force is not None
            force = normal_force.at(scene.machine.mount(exciter.place).load_rates(change.velocity))
            missing_forces.append(jnp.maximum(-force, 0.0))
        return _StateWithDetachment(change, _concatenate(missing_forces))


def _no_force(state: ExciterState) -> Array:
    return jnp.zeros_like(state.angle[0]) if state.angle else jnp.zeros(1)


def _concatenate(arrays: list[Array]) -> Array:
    return arrays[0] if len(arrays) == 1 else jnp.concatenate(arrays)
