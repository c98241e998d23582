"""Time integration until the motion has settled."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import speed_text
from jaxvib.equations.linear import linear_model, mean_speed
from jaxvib.equations.model import assemble
from jaxvib.equations.state import State
from jaxvib.errors import ComputationError
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.regime import Regime, RegimeName
from jaxvib.motion.analysis.separation import prepare_separation, would_separate
from jaxvib.motion.integrate import WINDOW_SAMPLES, frequency_bounds, whole_turns
from jaxvib.motion.plan import (
    EqualSteps,
    RunPlan,
    StepChoice,
    Tolerance,
    plan_segment,
    require_step_choice,
    with_settled_drives,
)
from jaxvib.motion.run import SETTLED_DRIFT, Run, RunStatus, with_separation_status
from jaxvib.motion.simulate import join_segments, last_state, prepare_run, run_planned
from jaxvib.motion.start import START_SEPARATION, Start, initial_state, must_compile_jams, start_state
from jaxvib.numerics.linalg import poles_of
from jaxvib.results.status import member, status_name
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.units import Number, count, number
from jaxvib.units.known import require_known

_MEAN_SEGMENTS = 32
"""Number of segments, of 100 slow periods each, that show whether a motion is steady in the mean. A slow period is a period of
the lowest natural frequency."""

_MAX_QUARTER_DIFFERENCE = 3.6
"""Range (largest minus smallest) of the means of the four quarters of these segments, in standard errors of one mean. For one
quantity and many segments, scatter alone exceeds it in about 5 % of cases (studentized range)."""

_MAX_DISTANCE_IN_DRIFTS = 10.0
"""Largest distance of a settled motion from its steady state, divided by the limit of the drift."""

_CREEP_SEGMENTS = 4
"""Number of segments that show whether loads creep."""

_MAX_CREEP_DIFFERENCE = 0.05
"""Largest relative difference between the angles by which loads creep in two of these segments."""

_MAX_UNBALANCE_CHANGE_RATIO = 0.01
"""Largest ratio of the change of the residual unbalance and the change of the angles, in rad, of loads that creep along
balanced arrangements. If a single load moves, the ratio is 1 divided by the number of loads."""

_DECREASE_SLOPE = -3.0
"""Slope of the logarithm of the drift, in standard errors, below which the drift is decreasing."""


@validated
def settle(
    scene: Scene,
    *,
    start: Start | State | None = None,
    mode: int | None = None,
    separation: Number | None = None,
    drift: float | None = None,
    periods: int = 100,
    segments: int = 200,
    stepsize_controller: StepChoice | None = None,
    throw: bool = True,
) -> Run:
    """Simulate one segment after another until amplitudes and speed no longer change, or change without a trend.

    Two kinds of motion never repeat themselves and count as settled too:

    - `beating`: a motion that never becomes periodic but is steady in the mean, for example the vibration of jammed loads that
      beats with that of an imbalance, which turns faster. The last 32 segments are considered (of 100 periods of the lowest
      natural frequency; more if segments are shorter). The motion is steady in the mean if the drift does not decrease, and if
      the means of amplitudes, force and speed over the four quarters of these segments differ by no more than the larger of
      two limits: the difference that their scatter explains, and half the drift
    - `creeping`: four loads or more, or three with an imbalance, can balance the rotor in infinitely many arrangements
      (`balanced_states`). Small disturbances such as gravity move the loads slowly from one to the next, for hours. The status
      is `creeping` if the loads balance the rotor, free vibrations of the carrier have decayed, and the loads creep evenly
      over four segments while the residual unbalance does not change

    **Arguments**

    - `scene` with a drive of constant speed
    - `start`, `mode`: as for `simulate`, except "spin_up"; default: near the jam mode `mode`; without a mode, at rest
    - `separation`: angle between neighbouring loads at a named start, rad; default: as for `simulate`, in a jam 1 degree
    - `drift`: drift below which a motion has settled, see `Measured`; typical: 1e-3 to 1e-8; default: 1e-6, in single precision
      1e-3. A drift given here must be reached; with the default, motions that beat or creep also count as settled. In addition,
      the estimated distance of the motion from its steady state must be below ten times this limit: with little damping a
      motion that is still far from its steady state changes only slowly. The distance is estimated from the slowest decay of
      the carrier, or from the decrease of the drift
    - `periods`: approximate length of a segment, in periods of the lowest natural frequency; typical: 100 (the default)
    - `segments`: largest number of segments; typical: 200 (the default); 1 to 3 suffice at damping ratios of 0.05 to 0.01
    - `stepsize_controller`: as for `simulate`, except `Accuracy`; default: `Tolerance(1e-9)`, in single precision 1e-5
    - `throw`: True to raise `ComputationError` if the motion has not settled after all segments; otherwise the `drift` of the
      last run shows this, or its status if the run failed

    A motion that is stable only as long as loads are coincident does not count as settled: if loads start at one angle
    (`separation=0`) and would separate after a small disturbance, the status is `would_separate` (see `Run`), `settled` is
    False, and no error is raised.

    **Returns** the `Run` of the last segment, without a trajectory and without an estimate of its error. Its times and its cost
    (`steps`, `rejected`, `evaluations`, `seconds`) include all segments.

    **Raises** `ComputationError` (status "not_settled", or "left_mode" if the loads settled in another mode than `mode`),
    `InputError` for a rotor whose speed changes; and the errors of `simulate`.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> bool(jv.settle(scene, mode=1).drift < 1e-6)
    True
    """
    plan = _plan_settle(scene, start, mode, separation, drift, periods, segments, stepsize_controller, throw=throw)
    run, earlier, is_final = _integrate_until_settled(plan, throw=throw)
    run = join_segments([run], earlier * float(plan.first.end))
    if throw and not is_final:
        raise ComputationError(
            "not_settled",
            f"after {segments} segments of {periods} periods of the lowest natural frequency the motion still changes "
            f"by {float(run.drift):.1e}; "
            "it may have no steady state at this speed; otherwise allow more segments or a larger drift",
        )
    if throw and mode is not None:
        _require_mode(scene, run, mode)
    return run


@dataclasses.dataclass(frozen=True)
class _SettlePlan:
    """Plan of a run in segments.

    **Attributes**: `first`: plan of the first segment; `segments`: their largest number; `drift`: the drift below which the
    motion has settled; `default_drift`: the default drift of the precision; `mean_segments`: the number of segments that
    show whether the motion is steady in the mean, None if the motion must reach the drift; `decay`: the slowest decay of the
    carrier without friction at supports, 1/s; `has_resistance`: True if effects at supports can damp the carrier.
    """

    first: RunPlan
    segments: int
    drift: float
    default_drift: float
    mean_segments: int | None
    decay: float
    has_resistance: bool


def _plan_settle(
    scene: Scene,
    start: Start | State | None,
    mode: int | None,
    separation: Number | None,
    drift: float | None,
    periods: int,
    segments: int,
    steps: StepChoice | None,
    *,
    throw: bool,
) -> _SettlePlan:
    """Validate the arguments of `settle` and choose its segments. **Raises** `InputError`."""
    require_known(scene, "scene", "settle", "use jam_orbit or simulate in it")
    scene = validate_scene(scene)
    scene = with_settled_drives(scene, start, "a motion settles at a constant rotor speed; use ConstantSpeed")
    count(periods, "periods")
    require_step_choice(steps, Tolerance, EqualSteps, diffrax.AbstractStepSizeController)
    double = scene.top_speed.dtype.itemsize >= 8
    default_drift = 1e-6 if double else 1e-3
    # Each segment is a whole number of turns, so that an imbalance continues at its angle.
    length = whole_turns(scene, 2.0 * math.pi * periods / float(frequency_bounds(scene)[1]))
    start = ("rest" if mode is None else "jam") if start is None else start
    is_jam = isinstance(start, str) and start == "jam"
    separation = START_SEPARATION if separation is None and is_jam else separation
    steps = Tolerance(1e-9 if double else 1e-5) if steps is None else steps
    if is_jam and must_compile_jams(scene, mode):
        rest = initial_state(scene)
        prepare_run(plan_segment(scene, length, rest, steps, throw=throw))
        prepare_separation(scene, rest, WINDOW_SAMPLES)
    state = start_state(scene, start, mode, separation, throw=throw)
    return _SettlePlan(
        first=plan_segment(scene, length, state, steps, throw=throw),
        segments=count(segments, "segments"),
        drift=default_drift if drift is None else float(number(drift, "", "drift", low=0.0, open_low=True)),
        default_drift=default_drift,
        mean_segments=4 * math.ceil(_MEAN_SEGMENTS * max(1.0, 100.0 / periods) / 4.0) if drift is None else None,
        decay=_slowest_decay(scene),
        has_resistance=any(term.resistance is not None for term in terms_of(scene.all_effects, SupportForce)),
    )


def _integrate_until_settled(plan: _SettlePlan, *, throw: bool) -> tuple[Run, int, bool]:
    """Return the run of the last segment, whose times begin at 0, the number of earlier segments, and False if an error must be
    raised: if the motion has not settled and has neither the status `would_separate` nor `overlapping`."""
    length, state = float(plan.first.end), plan.first.state
    joined, drifts, measured, regimes = [], [], [], []
    while True:
        segment = run_planned(dataclasses.replace(plan.first, state=state), throw=throw)
        joined = [run := join_segments([*joined, segment])]
        if status_name(run.status) != "done":
            return run, len(drifts), False
        drifts.append(float(run.drift))
        decay = plan.decay or (_slowest_decay(plan.first.scene, run.window) if plan.has_resistance else 0.0)
        if (
            drifts[-1] < plan.drift
            and _distance_from_steady_state(drifts, run, decay, length) < _MAX_DISTANCE_IN_DRIFTS * plan.drift
        ):
            final = _with_final_status(run, "done")
            # If the loads are not at exactly one angle and would separate, the run continues until they have left this motion.
            if bool(segment.coincident) or status_name(final.status) == "done" or not would_separate(run.scene, run.window):
                return final, len(drifts) - 1, True
        if plan.mean_segments is not None:
            force = float(np.nan_to_num(run.foundation_force))  # 0 if it is unknown
            lengths = plan.first.scene.machine.carrier().as_lengths(run.amplitude)
            measured.append([drifts[-1], float(run.omega), force, *np.asarray(lengths).tolist()])
            if len(measured) >= plan.mean_segments and _is_steady_in_the_mean(np.array(measured[-plan.mean_segments :])):
                return _with_final_status(run, "beating"), len(drifts) - 1, True
            is_plain = plan.first.scene.is_plain
            if is_plain and drifts[-1] < SETTLED_DRIFT and decay * length * len(measured) > -math.log(plan.default_drift):
                regimes.append(run.regime)
                if _is_creeping(regimes[-_CREEP_SEGMENTS:]):
                    return _with_final_status(run, "creeping"), len(drifts) - 1, True
        if len(drifts) == plan.segments:
            last = _with_final_status(run, "done") if drifts[-1] < SETTLED_DRIFT else run
            return last, len(drifts) - 1, status_name(last.status) in ("would_separate", "overlapping")
        state = last_state(plan.first.scene, run)


def _with_final_status(run: Run, name: str) -> Run:
    """Return the run with the status `name`, or with `overlapping` or `would_separate` if this applies."""
    return with_separation_status(dataclasses.replace(run, status=member(RunStatus, name)))


@cached
def _matrices(scene: Scene, window: Trajectory | None) -> tuple[Array, Array, Array]:
    """Return the matrices (nd, nd) of mass, damping and stiffness. The damping contains the gyroscopic terms and, with a
    `window`, the mean slopes of the resistances of supports in this window."""
    model = linear_model(scene)
    damping = model.damping(mean_speed(scene))
    for term, rows in zip(terms_of(scene.all_effects, SupportForce), assemble(scene).supports, strict=True):
        if window is not None and term.resistance is not None:
            motion = (each @ rows.T for each in (window.state.displacement, window.state.velocity))
            slopes = jax.vmap(jax.jacobian(term.resistance, argnums=1))(*motion)
            damping = damping + rows.T @ jnp.mean(slopes, axis=0) @ rows
    return model.mass, damping, model.carrier.stiffness


def _slowest_decay(scene: Scene, window: Trajectory | None = None) -> float:
    """Return the smallest decay rate of free vibrations of the carrier with its loads, 1/s; 0 if a vibration does not decay.

    With a `window`, it is that of a small vibration in addition to the motion in the window, with friction at supports.
    """
    poles = poles_of(*(np.asarray(matrix, float) for matrix in _matrices(scene, window)))
    slowest = float(np.min(-poles.real))
    return slowest if slowest > 1e-12 * float(np.max(np.abs(poles))) else 0.0


def _distance_from_steady_state(drifts: Sequence[float], run: Run, decay: float, segment: float) -> float:
    """Estimate the relative distance of a motion from its steady state from the drifts of its segments so far.

    A distance that decays at the rate a decreases by the fraction 1 - exp(-a T) during the time T between the two halves of the
    measuring window; this decrease is the drift. Free vibrations that beat with the jam make some drifts small by chance.
    Therefore the largest of the last three drifts is used; fewer suffice if the vibrations decay within a window. The rate a is
    the slowest `decay` of the carrier; if a vibration does not decay, it is the rate at which the drift decreases from one
    segment, of the length `segment`, to the next.
    """
    half, recent = 0.5 * float(np.ptp(np.asarray(run.window.time))), max(drifts[-3:])
    if decay == 0.0 and len(drifts) >= 6 and recent > 0.0:
        decay = max(math.log(max(drifts[-6:-3]) / recent) / (3.0 * segment), 0.0)
    fall = -math.expm1(-decay * half)
    if recent == 0.0:
        return 0.0
    return math.inf if fall == 0.0 or (fall < 0.5 and len(drifts) < 3) else recent / fall


def _is_steady_in_the_mean(measured: np.ndarray) -> bool:
    """Return True if measured values scatter about constant means, except for changes below half the drift; `measured` (4 n, 3
    + nd): for each segment the drift, the load speed, the force and the amplitudes as lengths (`Carrier.as_lengths`)."""
    drift, values = measured[:, 0], measured[:, 1:]
    place = np.arange(len(measured)) - (len(measured) - 1) / 2.0
    fall = place @ np.log(drift) / (place @ place)
    rest = np.log(drift) - np.mean(np.log(drift)) - fall * place
    if fall < _DECREASE_SLOPE * np.sqrt(rest @ rest / (len(measured) - 2) / (place @ place)):
        return False
    quarters = values.reshape(4, -1, values.shape[1])
    means = quarters.mean(axis=1)
    spread = means.max(axis=0) - means.min(axis=0)
    error = np.sqrt(quarters.var(axis=1, ddof=1).mean(axis=0) / quarters.shape[1])
    size = np.abs(means).mean(axis=0)
    size[2:] = size[2:].max()  # a drift is relative to the largest amplitude
    return bool(np.all(spread <= np.maximum(_MAX_QUARTER_DIFFERENCE * error, 0.5 * np.median(drift) * size)))


def _is_creeping(regimes: Sequence[Regime]) -> bool:
    """Return True if the loads balance the rotor in each segment, and creep evenly along balanced arrangements."""
    if len(regimes) < _CREEP_SEGMENTS or not all(bool(regime.name == RegimeName.balanced) for regime in regimes):
        return False
    phase = np.array([np.asarray(regime.phase) for regime in regimes])
    unbalance = np.array([float(regime.unbalance) for regime in regimes])
    steps = np.angle(np.exp(1j * np.diff(phase, axis=0)))
    size = float(np.max(np.abs(steps)))
    even = float(np.max(np.ptp(steps, axis=0))) < _MAX_CREEP_DIFFERENCE * size
    return even and float(np.ptp(unbalance)) < _MAX_UNBALANCE_CHANGE_RATIO * size


def _require_mode(scene: Scene, run: Run, mode: int) -> None:
    """Raise `ComputationError` if the load speed is not nearest to that of the jam mode in which the loads started."""
    modes = jam_modes(scene)
    speeds = np.asarray(modes.omega)
    speed_differences = {k: abs(float(speeds[modes.row(k)]) - float(run.omega)) for k in modes.mode_numbers()}
    speed_differences[0] = abs(float(scene.drive.speed) - float(run.omega))
    nearest = min(speed_differences, key=lambda k: speed_differences[k])
    if nearest != mode:
        reached = f"jam mode {nearest}" if nearest else "turning with the rotor"
        raise ComputationError(
            "left_mode",
            f"the motion left jam mode {mode} and settled at {speed_text(run.omega, 6)}, {reached}; mode {mode} is unstable",
        )
