"""Capture of balls as a function of their initial speed: captured fractions and the threshold."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn
from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import SlipRelease
from jaxvib.machine.scene import Scene
from jaxvib.machine.torus import require_torus_balls
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.ensemble import Equations, ensemble, field_of
from jaxvib.motion.integrate import effects_rate
from jaxvib.motion.plan import EqualSteps
from jaxvib.motion.run import Run
from jaxvib.motion.start import Rotation, with_spin
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.units import Number, count, number, random_numbers

MAX_CAPTURED_LAG = 3e-3
"""Relative difference of the load speed and the rotor speed below which a load counts as turning with the rotor."""

_SCAN_SPEEDS = 32
"""Number of initial speeds of a scan for the threshold."""

DOUBLINGS = 2
"""Default of the largest number of doublings of the steps."""


class CaptureStatus(eqx.Enumeration):
    """Outcomes of a search for a threshold. The value of each member is the message shown to the user."""

    found = "every start above the threshold was captured"
    all_captured = "every start was captured: the threshold is below the computed speeds"
    none_captured = "not every start at the highest speed was captured: the threshold is above the computed speeds"
    not_converged = (
        "the last doubling of the steps changed the threshold by more than its resolution, by default the spacing of speeds"
    )


class Capture(Result):
    """Captures as a function of the initial speed of the loads relative to the rotor.

    Returned by `capture`.

    **Attributes** (S speeds, each with `starts` initial positions)

    - `status`: a `CaptureStatus`
    - `speed` (S,), ascending: (load speed - rotor speed)/(rotor speed), -1 for loads at rest in space, 0 for loads that turn
      with the rotor
    - `captured` (S, starts): True if all loads turned with the rotor at the end of the run
    - `finite` (S, starts): True if the motion stayed finite
    - `detached` (S, starts): True if a load lost contact with its wall at some time; the equations keep it on the wall
    - `threshold`: midpoint between v and the next lower computed speed. v is the lowest speed such that every start at v and at
      all higher speeds was captured
    - `uncertainty` of the threshold; NaN if there is no threshold. It is the largest of three numbers: half the distance
      between v and the next lower speed; half the distance from the threshold to the highest speed below it at which at least
      half of the starts fail; `last_change`
    - `last_change`: change of the threshold by the last doubling of the steps, NaN without a doubling. A threshold below the
      computed speeds counts as -1. The change is infinite if the threshold is above the computed speeds in one of the two
      scans, and 0 if it is above them in both
    - `steps`, and `turns` of the rotor, of each run

    Below the threshold outcomes may be chaotic, with single captures among failures; `fraction` gives their share.
    """

    speed: np.ndarray = eqx.field(metadata=in_unit("", "speed"))
    captured: np.ndarray = eqx.field(metadata=in_unit("", "speed", "start"))
    finite: np.ndarray = eqx.field(metadata=in_unit("", "speed", "start"))
    detached: np.ndarray = eqx.field(metadata=in_unit("", "speed", "start"))
    threshold: Array = eqx.field(metadata=in_unit(""))
    uncertainty: Array = eqx.field(metadata=in_unit(""))
    last_change: Array = eqx.field(metadata=in_unit(""))
    steps: Array = eqx.field(metadata=in_unit(""))
    turns: Array = eqx.field(metadata=in_unit(""))
    status: CaptureStatus

    @property
    def fraction(self) -> np.ndarray:
        """Share (S,) of starts that are captured, for each speed."""
        return np.mean(self.captured, axis=1)

    @property
    def border(self) -> float:
        """Threshold, or -1 if every start was captured."""
        return -1.0 if np.all(self.captured) else float(self.threshold)

    @property
    def standard_error(self) -> np.ndarray:
        """Standard error (S,) of the fraction, by Agresti and Coull; it is not 0 even if all starts, or none, were captured."""
        n = self.captured.shape[1]
        share = (np.sum(self.captured, axis=1) + 2.0) / (n + 4.0)
        return np.sqrt(share * (1.0 - share) / (n + 4.0))

    def summary(self) -> str:
        """Return the threshold with its uncertainty, and the share of captures below it, as text."""
        n = self.captured.shape[1]
        starts = "1 start" if n == 1 else f"{n} starts"
        head = f"{self.message} ({self.speed.size} speeds, {starts} each, {int(self.turns)} turns)"
        doubled = (
            ""
            if np.isnan(self.last_change)
            else f"; the last doubling of the steps changed the threshold by {float(self.last_change):.1e}"
        )
        head += f"\n  {int(self.steps) / int(self.turns):.4g} steps a turn{doubled}"
        if np.any(self.detached):
            share = 100.0 * np.mean(self.detached)
            sentence = "a ball lost contact with its wall; the equations keep it on the wall"
            head += f"\n  detached: in {share:.3g} % of the runs {sentence}"
        if np.isnan(self.threshold):
            return head
        below = self.fraction[self.speed < float(self.threshold)]
        threshold_text = f"threshold {float(self.threshold):.4f} +- {float(self.uncertainty):.1e} of the rotor speed"
        captures_below = f"; below it {100.0 * np.mean(below):.3g} % are also captured" if np.any(below > 0.0) else ""
        return f"{head}\n  {threshold_text}{captures_below}"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the share of captured starts over the initial speed, and the threshold."""
        from jaxvib.draw.capture import threshold_chart  # slow import

        error = None if self.captured.shape[1] == 1 else self.standard_error
        return threshold_chart(self.speed, self.fraction, error, float(self.threshold), ax=ax)


def moving_state(scene: Scene, speed: Number, shift: Array | float = 0.0) -> State:
    """Return the state with the carrier at rest, and the loads side by side at the bottom of the tube with a common speed.

    **Arguments**: `speed`: (load speed - rotor speed)/(rotor speed), -1 for loads at rest in space; `shift`, rad, of the loads
    along the ring, a scalar or (count,). The angle between neighbouring loads is 2 atan(r/R), as printed in the source of
    `capture`; the angle between balls that touch is 2 asin(r/R).

    **Returns** `State`. **Raises** `InputError` for loads that are not in a torus.

    >>> from jaxvib.machine.files import TEMPLATES, scene_from_toml
    >>> state = moving_state(scene_from_toml(TEMPLATES["torus"]), -0.5)
    >>> [round(float(x), 4) for x in (state.angle[0][1], state.rate[0][0])]
    [0.1248, 70.0]
    """
    loads = require_torus_balls(scene.loads, "moving_state")
    beside = 2.0 * jnp.arctan2(loads.ball_radius, loads.radius)
    zero = jnp.zeros((loads.count,))
    still = jnp.zeros(scene.machine.structure().mass.shape[:1])
    load_speed = scene.drive.speed * (1.0 + jnp.asarray(speed))
    return State(still, still, (jnp.arange(loads.count) * beside + shift, zero), (load_speed + zero, zero))


@validated
def capture(
    scene: Scene,
    speeds: Sequence[float] | np.ndarray | None = None,
    *,
    turns: int = 2000,
    starts: int = 1,
    spread: Number = 1e-3,
    seed: int = 0,
    resolution: float | None = None,
    rotation: Rotation = "rolling",
    stepsize_controller: EqualSteps | None = None,
    doublings: int = DOUBLINGS,
    equations: Equations = vector_field,
) -> Capture:
    """Find the initial speeds from which the balls of a torus reach the rotor speed, and the threshold of these speeds.

    - For each speed, runs start from `starts` positions of the loads along the ring. Each run is integrated to its end, because
      a capture may occur late
    - With a `resolution`, the interval between the two computed speeds around the threshold is divided by further speeds until
      it is small enough. The range above the first threshold is not refined: failures in an interval that is narrower than the
      spacing of the `speeds` may remain undetected
    - The scan is repeated with twice as many steps until the threshold changes by no more than the resolution (without a
      resolution: the spacing of the `speeds`)

    **Arguments**

    - `scene` with `torus_balls` and a drive of constant speed
    - `speeds`: initial speeds relative to the rotor, in units of the rotor speed, ascending, from -1 (at rest in space) to 0;
      typical: 32 speeds (the default)
    - `turns`: length of each run in turns of the rotor; typical: 1000 to 3000 (default 2000). A capture that needs more turns
      counts as a failure. The computing time is proportional to `turns`
    - `starts` for each speed; typical: 1 (the default) to 32. In all starts except the first, each load is shifted along the
      ring by its own random angle of up to `spread`
    - `spread`, rad; typical: 1e-3 (the default)
    - `seed` of these angles
    - `resolution` of the threshold, relative to the rotor speed; typical: 1e-2 to 1e-4. Each refinement is another scan
    - `rotation`: "rolling", for balls that roll from the start, or "none", for balls that do not rotate at the start and
      therefore slide until they roll; "none" needs the effect `Sliding`
    - `stepsize_controller`: `EqualSteps(n)` for the whole run, without doubling. By default the first scan has the largest of
      three numbers of steps; typical: 200 for each turn. The first number is 1 for each radian of the fastest vibration. The
      second is 2 for each radian of the motion in a contact between balls or at the end of a slip. The third is 1 for every
      three time constants of the fastest decay
    - `doublings`: largest number of times that the default steps are doubled; typical: 2 (the default); 0 for a single scan.
      With one doubling the work is three times that of a single scan
    - `equations`: as for `ensemble`

    **Returns** `Capture`. **Raises** `InputError` for loads that are not in a torus, a drive whose speed is not constant, and
    values that are not allowed.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> found = jv.capture(jv.scene_from_toml(TEMPLATES["torus"]), [-1.0, -0.2], turns=60)
    >>> found.fraction.tolist(), found.status_name
    ([0.0, 1.0], 'found')

    Source: Strautmanis et al. 2018, section 3, with one start for each speed.
    """
    scene = _scene_for_capture(scene, rotation)
    if resolution is not None and not 0.0 < resolution < 1.0:
        raise InputError("resolution", f"is {quoted(resolution)}; it must be between 0 and 1, such as 1e-3")
    first_speeds = _ascending(speeds)
    end = 2.0 * np.pi * count(turns, "turns") / float(scene.drive.speed)
    width = float(number(spread, "rad", "spread", low=0.0))
    shifts = random_numbers(seed).uniform(-width, width, (count(starts, "starts"), scene.loads.count))
    shifts[0] = 0.0
    controller, largest_doublings = stepsize_controller, count(doublings, "doublings", low=0)
    first = controller.number if controller is not None else max(16, math.ceil(end * steps_per_second(scene, equations)))

    def outcomes(initial_speeds: np.ndarray, steps: int) -> list[np.ndarray]:
        """Return three Boolean arrays (speeds, starts): True for runs that are captured, stay finite, or lose contact with the
        wall."""
        cases = (scene, np.repeat(initial_speeds, starts), np.tile(shifts, (initial_speeds.size, 1)))
        shared = eqx.filter_vmap(lambda _: cases[0])(jnp.arange(cases[1].size))
        values = (shared, jnp.asarray(cases[1]), jnp.asarray(cases[2]))
        start_of = _rolling_start if rotation == "rolling" else _sliding_start
        runs = ensemble(start_of, values, end, stepsize_controller=EqualSteps(steps), estimate=False, equations=equations)
        lag = np.abs(np.asarray(runs.load_speed) / float(scene.drive.speed) - 1.0)
        finite = np.asarray(runs.finite)
        flags = (np.all(lag < MAX_CAPTURED_LAG, axis=1) & finite, finite, np.any(runs.detached, axis=1))
        return [flag.reshape(initial_speeds.size, starts) for flag in flags]

    def scan(multiple: int) -> Capture:
        speed, steps = first_speeds, first * multiple
        flags = outcomes(speed, steps)
        while resolution is not None:
            index = _threshold_index(flags[0])
            if index in (0, speed.size) or speed[index] - speed[index - 1] <= resolution:
                break
            finer = np.linspace(speed[index - 1], speed[index], max(4, _SCAN_SPEEDS // starts) + 2)[1:-1]
            order = np.argsort(np.concatenate([speed, finer]))
            speed = np.concatenate([speed, finer])[order]
            flags = [np.concatenate(pair)[order] for pair in zip(flags, outcomes(finer, steps), strict=True)]
        captured, finite, detached = flags
        return _summarize_captures(speed, captured, finite, detached, turns, steps)

    # A threshold close to one of the speeds may be in the interval below or above it, depending on the steps.
    tolerance = 1.001 * max(np.max(np.diff(first_speeds), initial=0.0) if resolution is None else resolution, 1e-12)
    result, last_change = _with_finer_steps(scan, largest_doublings if controller is None else 0, tolerance)
    uncertainty = jnp.fmax(result.uncertainty, last_change) if np.isfinite(result.threshold) else result.uncertainty
    status = CaptureStatus.not_converged if last_change > tolerance else result.status
    return dataclasses.replace(result, last_change=jnp.asarray(last_change), uncertainty=uncertainty, status=status)


def _scene_for_capture(scene: Scene, rotation: Rotation) -> Scene:
    """Return the valid scene. **Raises** `InputError` if its drive, loads or effects do not allow the search."""
    scene = validate_scene(scene)
    require_torus_balls(scene.loads, "capture")
    if not scene.drive.constant:
        raise InputError("drive.kind", f"is {quoted(scene.drive.kind)}; capture needs a prescribed speed; use ConstantSpeed")
    if rotation not in get_args(Rotation):
        raise InputError("rotation", f"is {quoted(rotation)}; it must be 'rolling' or 'none'")
    if rotation == "none" and not has_term(scene.all_effects, SlipRelease):
        problem = "is 'none', but the scene's balls roll from the start; add the effect Sliding (term SlipRelease)"
        raise InputError("rotation", problem)
    return scene


def _ascending(speeds: Sequence[float] | np.ndarray | None) -> np.ndarray:
    """Return the initial speeds of a scan, relative to the rotor; by default evenly spaced ones."""
    if speeds is None:
        return np.linspace(-1.0, 0.0, _SCAN_SPEEDS + 1)[:-1]
    ascending = np.asarray(speeds, dtype=float)
    is_list = ascending.ndim == 1 and ascending.size > 0 and np.all(np.isfinite(ascending))
    if not is_list or np.any(np.diff(ascending) <= 0.0) or ascending[0] < -1.0 or ascending[-1] > 0.0:
        raise InputError("speeds", f"is {quoted(speeds)}; ascending numbers from -1 to 0 are needed")
    return ascending


def _rolling_start(value: tuple[Scene, Array, Array]) -> tuple[Scene, State]:
    scene, speed, shift = value
    return scene, moving_state(scene, speed, shift)


def _sliding_start(value: tuple[Scene, Array, Array]) -> tuple[Scene, State]:
    scene, state = _rolling_start(value)
    return scene, with_spin(scene, state, "none")


def _threshold_index(captured: np.ndarray) -> int:
    """Return the index of v, see `threshold` of `Capture`, or the number of speeds if there is none."""
    failing = np.flatnonzero(~np.all(captured, axis=1))
    return 0 if failing.size == 0 else int(failing[-1]) + 1


def _with_finer_steps(scan: Callable[[int], Capture], doublings: int, tolerance: float) -> tuple[Capture, float]:
    """Double the steps until the threshold changes by at most the tolerance; return the last result and the last change."""
    result, change = scan(1), math.nan
    for doubling in range(1, doublings + 1):
        coarser, result = result, scan(2**doubling)
        change = _change(coarser.border, result.border)
        if change <= tolerance:
            break
    return result, change


def _change(first: float, second: float) -> float:
    """Return the absolute difference of two thresholds: 0 between two NaN, infinite between NaN and a number."""
    if math.isnan(first) or math.isnan(second):
        return 0.0 if math.isnan(first) and math.isnan(second) else math.inf
    return abs(first - second)


def _summarize_captures(
    speed: np.ndarray, captured: np.ndarray, finite: np.ndarray, detached: np.ndarray, turns: int, steps: int
) -> Capture:
    index = _threshold_index(captured)
    threshold, uncertainty, status = math.nan, math.nan, CaptureStatus.found
    if index == 0:
        status = CaptureStatus.all_captured
    elif index == speed.size:
        status = CaptureStatus.none_captured
    else:
        threshold = 0.5 * (speed[index - 1] + speed[index])
        half = np.flatnonzero(np.mean(captured[:index], axis=1) <= 0.5)
        below = speed[half[-1]] if half.size else speed[0]
        uncertainty = max(0.5 * (speed[index] - speed[index - 1]), 0.5 * (threshold - below))
    return Capture(
        speed=speed,
        captured=captured,
        finite=finite,
        detached=detached,
        threshold=jnp.asarray(threshold),
        uncertainty=jnp.asarray(uncertainty),
        last_change=jnp.asarray(math.nan),
        steps=jnp.asarray(steps),
        turns=jnp.asarray(turns),
        status=status,
    )


def capture_time(run: Run, within: float = 0.05) -> Array:
    """Return the time, s, after which all load speeds stay within a band around the rotor speed.

    This is the last time in the trajectory at which the speed of a load differs from the rotor speed by more than `within`
    times the rotor speed. It is interpolated linearly between the stored states. Forward and reverse derivatives exist. They
    describe the entry of one load into the band. If a parameter changes so much that another entry becomes the last one, the
    time jumps; the derivatives do not show this jump.

    **Arguments**: `run` with a trajectory; `within`: half the width of the band, relative to the rotor speed; typical: 0.01 to
    0.1 (default 0.05).

    **Returns** a scalar: 0 if all loads are within the band from the beginning, infinite if a load is outside at the end.
    **Raises** `InputError` for a run without a trajectory.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.study.capture.capture import capture_time, moving_state
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["torus"])
    >>> run = jv.simulate(scene, 2.0, start=moving_state(scene, -0.1), samples=2000, estimate=False)
    >>> bool(0.0 < capture_time(run) < 2.0)
    True
    """
    if run.trajectory is None:
        raise InputError("run", "saved only its window; run simulate with save='all'")
    times, speed = run.trajectory.time, run.trajectory.rotor_speed[:, None]
    excess = jnp.abs(run.trajectory.state.azimuth_rate - speed) - within * jnp.abs(speed)

    def last_entry(excess: Array) -> Array:
        is_outside = excess > 0.0
        k = jnp.max(jnp.where(is_outside, jnp.arange(times.size), -1))
        i = jnp.clip(k, 0, times.size - 2)
        drop = excess[i] - excess[i + 1]
        crossing = times[i] + (times[i + 1] - times[i]) * excess[i] / jnp.where(drop > 0.0, drop, 1.0)
        return jnp.where(k < 0, 0.0, jnp.where(k == times.size - 1, jnp.inf, crossing))

    entry_times = jnp.stack([last_entry(excess[:, j]) for j in range(excess.shape[1])])
    return jnp.max(entry_times)


_STEPS_PER_RADIAN = 1.0
"""Number of steps per radian of the fastest oscillation, which is that of balls across their tube. The errors are far below the
statistical error of captured fractions."""

_STEPS_PER_ADDED_RADIAN = 2.0
"""Number of steps per radian of contacts between balls and of sliding (`Effect.fastest_rate`): about six steps in a collision
in the first scan."""

_DECAY_PER_STEP = 3.0
"""Largest product of decay rate and step. The method of order 8 is stable up to 5.2; the margin is needed because normal forces
can be larger than on the equator of the tube, where the rate is computed."""


def steps_per_second(scene: Scene, equations: Equations = vector_field) -> float:
    """Return the number of equal steps per second that resolve the motion of balls in a torus at a constant rotor speed.

    Rates of oscillation and decay are the eigenvalues of the `equations`, linearized about balls on the equator that turn with
    the rotor. In this state friction overdamps the balls, but it saturates at larger speeds; therefore the natural frequency
    without friction is resolved too. Contacts and sliding do not act in this state; `Effect.fastest_rate` gives their rates.
    """
    values = np.linalg.eigvals(np.asarray(_jacobian(scene, equations)))
    natural = scene.loads.natural_frequency(scene.drive.speed)
    oscillation = max(np.max(np.abs(values.imag)), float(scene.drive.speed if natural is None else jnp.max(natural)))
    decay, contact_rate = np.max(-values.real, initial=0.0), float(effects_rate(scene))
    return float(max(_STEPS_PER_RADIAN * oscillation, decay / _DECAY_PER_STEP, _STEPS_PER_ADDED_RADIAN * contact_rate))


@cached
def _jacobian(scene: Scene, equations: Equations) -> Array:
    around, across = scene.loads.rest()
    zero, still = jnp.zeros_like(around), jnp.zeros(scene.machine.structure().mass.shape[:1], around.dtype)
    angle, rate = (around + scene.loads.offsets(), across), (zero + scene.drive.speed, zero)
    flat, unravel = ravel_pytree(with_spin(scene, State(still, still, angle, rate)))
    field = field_of(equations, scene)

    def rates(flat: Array) -> Array:
        return ravel_pytree(field(jnp.zeros((), flat.dtype), unravel(flat)))[0]

    return jax.jacfwd(rates)(flat)
