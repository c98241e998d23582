"""Plans of runs: choices that depend on the values of a scene and are made on the host, before a program is traced.

The method and the static sizes (samples, steps, segments) depend on values that are known (not traced). Under a JAX
transformation, these values are unknown, and the sizes are fixed. The traced program does not test which values are known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.boundary import call_user, with_known_names
from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import allowed_unknowns, validate_scene
from jaxvib.motion.integrate import MIN_SAMPLES_PER_TURN, WINDOW_SAMPLES, IntegrationPlan, StepControl, frequency_bounds
from jaxvib.motion.integration.stiffness import (
    contact_rate,
    equal_step_length,
    fastest_decay,
    fastest_motion,
    sampling_rate,
    stiff_solver,
)
from jaxvib.motion.start import Start, initial_state, require_start, start_state, with_spin, with_spin_up_drive
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.runtime.devices import numpy_if_known
from jaxvib.runtime.programs import cached
from jaxvib.runtime.structure import Skeleton
from jaxvib.steady.outcome import unknown_is_positive
from jaxvib.units import Number, count, known_number, validate_tolerance
from jaxvib.units.known import is_known, when_known
from jaxvib.units.reading import require_real

Control = StepControl | diffrax.AbstractStepSizeController

MAX_STEPS = 2**31 - 1
"""Largest value of `max_steps`."""

_UNKNOWN_STEPS, _UNKNOWN_SAMPLES = 2**20, 2000
"""Maximum number of steps, and number of samples, of a run whose length or speeds are unknown."""

_FEW_SAMPLES, _MANY_SAMPLES = 2**14, 2**18
"""Default numbers of samples of short and of long runs."""

_MAX_WINDOW_SAMPLES = 2**17
"""Largest number of samples in the measuring window of a run with stops."""

_IMPLICIT_STEPS_FACTOR = 16.0
"""Factor by which the implicit method increases the default of `max_steps`."""

_SEGMENT_TURNS = 2.0e4
"""Number of turns of the fastest motion after which single precision no longer resolves time; longer runs are divided into
segments."""


@with_known_names
@dataclass(frozen=True)
class Tolerance:
    """Steps whose error is at most `tolerance`, both relative and absolute in natural units.

    Natural units are the unbalance radius S/M of the loads for displacements, S/M times the rotor speed for velocities, and
    1 rad for angles. The error of an angle is only absolute.

    **Arguments**: `tolerance`; typical: 1e-6 to 1e-10 in double precision, 1e-5 in single. For one hundredth of the tolerance,
    the methods of order 8 need about 1.8 times as many steps.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.Tolerance(1e-6)
    Tolerance(tolerance=1e-06)
    """

    tolerance: float

    def __post_init__(self) -> None:
        require_real(self.tolerance, "", "tolerance")


@with_known_names
@dataclass(frozen=True)
class Accuracy:
    """Steps with which the estimated error of the whole result is at most `error`. The run is repeated to find these steps.

    **Arguments**: `error`, relative; typical: 1e-3 to 1e-8. An error of 1e-8 needs about three times as many evaluations as an
    error of 1e-4.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.Accuracy(1e-4)
    Accuracy(error=0.0001)
    """

    error: float

    def __post_init__(self) -> None:
        require_real(self.error, "", "error")


@with_known_names
@dataclass(frozen=True)
class EqualSteps:
    """A number of steps of equal length.

    **Arguments**: `number` of steps; typical: 4 for each radian of the fastest motion, 25 for each turn. The computing time is
    proportional to this number.

    **Raises** `InputError` for a value that is not a real number.

    >>> import jaxvib as jv
    >>> jv.EqualSteps(2000)
    EqualSteps(number=2000)
    """

    number: int

    def __post_init__(self) -> None:
        require_real(self.number, "", "steps")


StepChoice = Tolerance | Accuracy | EqualSteps | diffrax.AbstractStepSizeController
"""Types of `stepsize_controller`."""


def require_step_choice(chosen: object, *kinds: type) -> None:
    """**Raises** `InputError` for a choice of steps of another type."""
    if chosen is not None and not isinstance(chosen, kinds):
        names = {diffrax.AbstractStepSizeController: "a step size controller of diffrax"}
        allowed = ", ".join(names.get(kind, f"{kind.__name__}(...)") for kind in kinds)
        raise InputError("stepsize_controller", f"is {quoted(chosen)}; it must be one of: {allowed}")


def require_error_estimate(solver: diffrax.AbstractSolver | None, control: object) -> None:
    """**Raises** `InputError` for a `solver` without an error estimate if the `control` of its steps needs one."""
    if isinstance(control, StepControl):
        is_fixed = control.tolerance is None
    else:
        is_fixed = isinstance(control, diffrax.AbstractStepSizeController)
        is_fixed = is_fixed and not isinstance(control, diffrax.AbstractAdaptiveStepSizeController)
    if solver is not None and not is_fixed and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        problem = f"is {type(solver).__name__}, which does not estimate the error of a step"
        raise InputError("solver", f"{problem}; give another solver such as diffrax.Dopri5(), or equal steps")


@dataclass(frozen=True)
class RunPlan:
    """Plan of a run.

    **Attributes**

    - `given_scene`: the scene of the call; `scene`: the scene of the run, with a spin-up drive for the start "spin_up"
    - `end`, s; `state` at the start
    - `integration`: the choices for one integration; `segments`: the number of consecutive integrations
    - `is_known`: True if scene, end and state have values
    - `is_estimated`: True if a second run with larger steps estimates the error; `accuracy`: the error that repeated runs must
      reach, or None
    """

    given_scene: Scene
    scene: Scene
    end: Array
    state: State
    integration: IntegrationPlan
    segments: int
    is_known: bool
    is_estimated: bool
    accuracy: float | None


def plan_run(
    scene: Scene,
    until: Number,
    *,
    start: Start | State,
    mode: int | None,
    separation: Number | None,
    spin_up: Number | None,
    save: Literal["all", "window"],
    samples: int | None,
    window_periods: int,
    estimate: bool | None,
    solver: diffrax.AbstractSolver | None,
    steps: StepChoice | None,
    adjoint: diffrax.AbstractAdjoint | None,
    max_steps: int | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
    throw: bool,
) -> RunPlan:
    """Validate the arguments of `simulate` and choose method, steps and sizes of its run. **Raises** `InputError`."""
    given_scene = validate_scene(scene)
    end = known_number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {quoted(save)}; it must be 'all' or 'window'")
    speed = given_scene.top_speed
    scene = with_spin_up_drive(given_scene, end, start, spin_up)
    state = start_state(scene, start, mode, separation, throw=throw)

    known = is_known(scene, end, state)
    fastest, slowest = map(numpy_if_known, frequency_bounds(scene))
    stiff = stiff_solver(scene, state, fastest) if solver is None and known else None
    control = _step_control(end, steps, estimate)
    require_error_estimate(solver, control)
    if samples is None:
        samples = _enough_samples(speed, end)
    else:
        samples = count(samples, "samples", low=2, each=_sample_size(given_scene))
    periods = np.asarray(count(window_periods, "window_periods"), end.dtype)
    is_estimated = isinstance(control, StepControl) and (known if estimate is None else estimate)
    if isinstance(steps, Accuracy) and not known:
        raise InputError("accuracy", "repeats the run and cannot be used inside jit, grad or vmap; use Tolerance(...)")
    if max_steps is None:
        max_steps = enough_steps((1.0 if stiff is None else _IMPLICIT_STEPS_FACTOR) * fastest, end, steps)
    if (solver := stiff if solver is None else solver) is None and not known and end.dtype.itemsize >= 8:
        solver = _solver_for_derivatives(adjoint)
    window_samples = _window_samples(scene, end, 2.0 * math.pi * periods / slowest) if known else WINDOW_SAMPLES
    saved_samples, step_limit = samples if save == "all" else 0, min(count(max_steps, "max_steps"), MAX_STEPS)
    integration = IntegrationPlan(
        solver, control, adjoint, saved_samples, periods, (fastest, slowest), step_limit, progress_meter, window_samples
    )
    return RunPlan(
        given_scene=given_scene,
        scene=scene,
        end=end,
        state=state,
        integration=integration,
        segments=_segments(scene, end, state, fastest) if known and save == "window" else 1,
        is_known=known,
        is_estimated=is_estimated,
        accuracy=steps.error if isinstance(steps, Accuracy) else None,
    )


def _window_samples(scene: Scene, end: Array | np.ndarray, length: Array | np.ndarray) -> int:
    """Return the number of samples, a power of 2 that resolves the forces of stops, in a measuring window of a `length`, s,
    that is at most half of the run until `end`, s. **Raises** `InputError` if a stop needs too many."""
    if not any(term.stiffness is not None for term in terms_of(scene.effects, SupportForce)):
        return WINDOW_SAMPLES
    needed = max(float(sampling_rate(scene)) * min(float(length), float(end) / 2.0), WINDOW_SAMPLES)
    if needed > _MAX_WINDOW_SAMPLES:
        problem = f"has such short contacts that the window needs {needed:.3g} samples, more than {_MAX_WINDOW_SAMPLES}"
        raise InputError("scene", f"{problem}; give fewer window_periods, or a stop with less stiffness and damping")
    return 2 ** math.ceil(math.log2(needed))


def _solver_for_derivatives(adjoint: diffrax.AbstractAdjoint | None) -> LoopDopri8:
    """Return the method of a run that the caller may differentiate: the method in a loop, because the compilation of a
    derivative of the unrolled step takes several times as long."""
    forward = isinstance(adjoint, diffrax.ForwardMode)
    return LoopDopri8(tangents=forward, reuse=forward or adjoint is None)


def _segments(scene: Scene, end: Array, state: State, fastest: Array | np.ndarray) -> int:
    """Return the number of consecutive integrations. It is above 1 for long runs in single precision, which cannot resolve a
    step at a late time."""
    if state.displacement.dtype.itemsize >= 8 or len(scene.exciters) != 1 or not scene.exciter.drive.constant:
        return 1
    return max(1, math.ceil(float(end * fastest) / (2.0 * math.pi * _SEGMENT_TURNS)))


def plan_segment(scene: Scene, length: float, state: State, steps: StepChoice, *, throw: bool) -> RunPlan:
    """Plan one of several consecutive runs, without a trajectory and an error estimate. **Raises** `InputError`."""
    return plan_run(
        scene, length, start=state, mode=None, separation=None, spin_up=None, save="window", samples=None, window_periods=20,
        estimate=False, solver=None, steps=steps, adjoint=None, max_steps=None, progress_meter=None, throw=throw,
    )  # fmt: skip


def enough_steps(fastest: Array | np.ndarray, end: Array, chosen: StepChoice | None = None) -> int:
    """Return a maximum number of steps: at least 4096 plus 500 for each turn of the `fastest` motion, rad/s, and at least the
    number of `chosen` equal steps. With powers of 2, few programs are compiled. **Raises** `InputError` for too many steps."""

    def count_steps(fastest: float, end: float) -> int:
        turns = end * fastest / (2.0 * math.pi)
        steps = 4096 + 500 * turns
        if not steps <= MAX_STEPS:
            raise InputError("until", f"is {end:g} s, {turns:.2g} turns of the fastest motion; run shorter segments")
        return min(2 ** math.ceil(math.log2(steps)), MAX_STEPS)

    steps = when_known(count_steps, fastest, end)
    equal = chosen.number + 1 if isinstance(chosen, EqualSteps) else 1  # rounding errors may add a step
    return max(_UNKNOWN_STEPS if steps is None else steps, 2 ** math.ceil(math.log2(equal)))


def _enough_samples(speed: Array, end: Array) -> int:
    """Return a number of samples that shows the vibration at a rotor `speed`, rad/s, in a figure without aliasing; one of two
    values, so that few programs are compiled."""

    def samples_of(end: float, speed: float) -> int:
        return _FEW_SAMPLES if MIN_SAMPLES_PER_TURN * end * speed / (2.0 * math.pi) <= _FEW_SAMPLES else _MANY_SAMPLES

    samples = when_known(samples_of, end, speed)
    return _UNKNOWN_SAMPLES if samples is None else samples


def _sample_size(scene: Scene) -> float:
    """Return the memory of a stored state with its forces, bytes; the computation needs three copies."""
    structure = scene.machine.structure()
    numbers = 2 * structure.mass.shape[0] + structure.foundation_stiffness.shape[0] + 1
    for exciter in scene.exciters:
        numbers += 4 if exciter.loads is None else 4 + 2 * len(exciter.loads.rest()) * exciter.loads.count
    return 3.0 * scene.top_speed.dtype.itemsize * numbers


def _step_control(end: Array, chosen: StepChoice | None, estimate: bool | None) -> Control:
    """Return the control of the steps. **Raises** `InputError` for a choice that the precision does not allow."""
    require_step_choice(chosen, Tolerance, Accuracy, EqualSteps, diffrax.AbstractStepSizeController)
    if isinstance(chosen, diffrax.AbstractStepSizeController):
        if estimate:
            problem = "is True together with a controller, whose steps cannot be enlarged; give a Tolerance"
            raise InputError("estimate", problem)
        return chosen
    if isinstance(chosen, EqualSteps):
        return StepControl(steps=np.asarray(count(chosen.number, "steps"), end.dtype))
    precision = float(jnp.finfo(end.dtype).eps)
    if isinstance(chosen, Accuracy):
        if estimate is False:
            raise InputError("estimate", "is False together with accuracy, which needs error estimates; give a Tolerance")
        accuracy = validate_tolerance(chosen.error, "accuracy", end.dtype, 1e3)
        return StepControl(tolerance=np.asarray(max(1e-2 * accuracy, 10.0 * precision), end.dtype))
    default = 1e-8 if precision < 1e-10 else 1e-5
    tolerance = default if chosen is None else validate_tolerance(chosen.tolerance, "tolerance", end.dtype, 10.0)
    return StepControl(tolerance=np.asarray(tolerance, end.dtype))


ENSEMBLE_PARTS = 4
"""Number of equal parts of a run of an ensemble; mean speeds are taken over the last part."""

_EXPLICIT_STEPS_PER_RADIAN, _MIN_STEPS = 4.0, 16
"""Default number of explicit steps of an ensemble for each radian of the fastest motion, and minimum of the default number."""


class EnsemblePlan(NamedTuple):
    """Plan of many runs that advance together.

    **Attributes**

    - `scenes` with a leading axis over the runs
    - `allowed`: True for each run whose values the constructors allow; `is_allowed`: True if this holds for all runs
    - `own`: arrays of scenes and states that differ between runs; `common`: arrays that all runs share; `is_shared`: True for
      each shared array, in the order of both; `form`: the structure of scene and state without these arrays
    - `end`, s
    - `each`: number of steps in each of the `ENSEMBLE_PARTS` of a run; `coarse`: that of a second run with larger steps;
      `is_compared`: True if there is a second run
    - `decay`: fastest decay rate of each scene, 1/s; `contact`: its fastest rate during contacts, rad/s, or None;
      `implicit`: True for implicit steps
    - `batch`: number of runs in a batch; `is_known`: True if all parameters have values
    """

    scenes: Scene
    allowed: Array
    is_allowed: bool
    own: list[Array]
    common: list[np.ndarray]
    is_shared: tuple[bool, ...]
    form: Skeleton
    end: Array
    each: int
    coarse: int
    is_compared: bool
    decay: Array
    contact: Array | None
    implicit: bool
    batch: int
    is_known: bool


def plan_ensemble(
    make: Callable[..., Scene | tuple[Scene, State]],
    values: PyTree[Array],
    until: Number,
    *,
    steps: EqualSteps | None,
    is_estimated: bool,
    batch: int,
) -> EnsemblePlan:
    """Validate the arguments of `ensemble`, make its scenes and choose method and steps. **Raises** `InputError`."""
    values = jax.tree.map(jnp.asarray, values)
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(values)}
    if len(sizes) != 1 or sizes & {(), (0,)}:
        raise InputError("values", f"has leading axes {sorted(sizes)}; all must be equal and at least 1")
    ((runs,),) = sizes
    known_end = known_number(until, "s", "until", low=0.0, open_low=True)
    end = jnp.asarray(known_end, dtype=float)
    batch = min(count(batch, "batch"), runs)
    scenes, states, allowed = _build_scenes(make, values)
    if (is_positive := unknown_is_positive(known_end)) is not None:
        allowed = allowed & is_positive
    require_start(scenes, states)
    known = is_known(scenes, states, end)
    require_step_choice(steps, EqualSteps)
    if steps is None and not known:
        raise InputError("stepsize_controller", "is missing; under a JAX transformation give EqualSteps(...)")
    fastest, decay, contact = _rates(scenes)
    number_of_steps, implicit = 0 if steps is None else count(steps.number, "steps"), False
    if known:
        # Refused runs do not influence the steps of other runs.
        rates = [float(np.max(np.where(allowed, x, 0.0))) for x in (np.maximum(fastest, _start_speed(states)), decay)]
        rates = rates if bool(np.any(allowed)) else [1.0, 0.0]
        step, implicit = equal_step_length(
            rates[0], rates[1], _EXPLICIT_STEPS_PER_RADIAN, float(end) / number_of_steps if number_of_steps else None
        )
        number_of_steps = number_of_steps or max(_MIN_STEPS, math.ceil(float(end) / step - 1e-9))
    steps_per_part = -(-number_of_steps // ENSEMBLE_PARTS)
    coarse = -(-steps_per_part // 2)

    leaves, structure = jax.tree.flatten((scenes, states))
    # A value that all runs share stays a scalar. At least one value must be an array, which defines the number of runs.
    is_shared = [known and bool(np.all(np.asarray(leaf) == np.asarray(leaf)[:1])) for leaf in leaves]
    is_shared[0] = is_shared[0] and not all(is_shared)
    return EnsemblePlan(
        scenes=scenes,
        allowed=allowed,
        is_allowed=bool(when_known(np.all, allowed)),
        own=[leaf for leaf, same in zip(leaves, is_shared, strict=True) if not same],
        common=[np.asarray(np.asarray(leaf)[0]) for leaf, same in zip(leaves, is_shared, strict=True) if same],
        is_shared=tuple(is_shared),
        form=Skeleton.of(leaves, structure),
        end=end,
        each=steps_per_part,
        coarse=coarse,
        is_compared=is_estimated and coarse < steps_per_part,  # a run of one step in each part has no coarser one
        decay=decay,
        contact=contact,
        implicit=implicit,
        batch=batch,
        is_known=known,
    )


@eqx.filter_jit
def _build_scenes(make: Callable[..., Scene | tuple[Scene, State]], values: PyTree[Array]) -> tuple[Scene, State, Array]:
    """Return the scenes, their initial states, and True for scenes with allowed values, with a leading axis over the runs."""

    def build_scene(value: PyTree[Array]) -> tuple[Scene, State, Array]:
        returned = call_user(make, "make", value)
        if isinstance(returned, Scene):
            returned = returned, initial_state(returned)
        scene, state = returned if isinstance(returned, tuple) and len(returned) == 2 else (None, None)
        if not isinstance(scene, Scene) or not isinstance(state, State):
            raise InputError("make", f"returns {quoted(returned)}; it must return a Scene, or a Scene and a State")
        scene = validate_scene(scene)
        allowed = allowed_unknowns(scene)
        return scene, with_spin(scene, state), jnp.asarray(True) if allowed is None else allowed

    return eqx.filter_vmap(build_scene)(values)


def _start_speed(states: State) -> np.ndarray:
    """Return the largest speed (runs,), rad/s, at which a load or the rotor of a motor starts."""
    speeds = [np.abs(exciter.rate[0]) for exciter in states.exciters if exciter.rate]
    speeds += [np.abs(exciter.rotor[1])[:, None] for exciter in states.exciters if exciter.rotor is not None]
    return np.max([np.max(np.where(np.isfinite(x), x, 0.0), axis=-1) for x in speeds] or [0.0], axis=0)


@cached
def _rates(scenes: Scene) -> tuple[Array, Array, Array | None]:
    """Return the fastest rates of the motion, rad/s, of the decay, 1/s, and of contacts, rad/s or None, of each scene."""
    return jax.vmap(lambda scene: (fastest_motion(scene), fastest_decay(scene), contact_rate(scene)))(scenes)


def with_settled_drives(scene: Scene, start: Start | State | None, problem: str) -> Scene:
    """Return the scene with motors switched off from the start if they are switched off during the run.

    **Raises** `InputError` with the `problem` for an ideal drive whose speed changes, for the motor of a single exciter with
    loads, and for the start "spin_up".
    """
    if isinstance(start, str) and start == "spin_up":
        raise InputError("start", f"is 'spin_up'; {problem} and start='rest', or simulate")
    for k, exciter in enumerate(scene.exciters):
        drive = exciter.drive
        if not drive.constant and (drive.ideal or scene.is_plain):
            raise InputError(f"{scene.prefix_of(k)}drive", f"is {quoted(drive.kind)}; {problem}")
        scene = scene if drive.constant else eqx.tree_at(lambda s, k=k: s.exciters[k].drive, scene, drive.settled())
    return scene
