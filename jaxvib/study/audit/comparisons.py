"""Motions by which an audit compares two scenes: a jam, or the end of a run."""

from __future__ import annotations

import contextlib
import math
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.equations.jammed_bodies import PERIODIC_JAM_TERMS, require_periodic_jams
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis import measure
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.analysis.separation import smallest_distance
from jaxvib.motion.run import Run
from jaxvib.motion.settle import settle
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import START_SEPARATION, initial_state, with_spin
from jaxvib.results.status import status_name
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.orbits.describe import OrbitStatus
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.steady.orbits.search import branch_at
from jaxvib.study.accuracy.exact_reference import WINDOW_PERIODS, slow_period

_MIN_UNCERTAINTY = 1e-9
"""Lower bound of the relative uncertainty of the values of a motion."""

_WINDOW_PERIODS = 100
"""Length of the measuring window at the end of a run, in periods of the lowest natural frequency. It must include the beat of
an imbalance with jammed loads."""

MIN_AMPLITUDE_SHARE = 0.01
"""Smallest scale of amplitudes, in units of the unbalance radius S/M of the loads. It is used for machines that hardly move,
such as a balanced rotor."""

_GRID_SPEEDS = 100
"""Number of load speeds in the grid with which an exact fold is bracketed."""


class MotionValues(NamedTuple):
    """Compared values of a motion.

    **Attributes**

    - `kind`: name of the kind of motion; `remark` on the computation, "" for none
    - `omega` of the loads, rad/s; `amplitude` of each coordinate, m (rad for tilts); `foundation_force` N
    - `fold`: the rotor speed (rad/s) at which the jam ends, NaN if there is none or if it was not computed
    - `uncertainty`: relative uncertainty of these values
    - `closest`: smallest distance of two loads of a run in units of their diameter, infinite for loads without a size; NaN for
      an exact orbit, for which it is not computed
    - `magnified`: relative changes of amplitudes and force refer to these values times this factor. It is above 1 if the
      machine is almost at rest, see `MIN_AMPLITUDE_SHARE`
    """

    kind: str
    omega: float
    amplitude: tuple[float, ...]
    foundation_force: float
    fold: float
    uncertainty: float
    closest: float = math.nan
    magnified: float = 1.0
    remark: str = ""

    @property
    def words(self) -> str:
        """Kind of motion with the remark."""
        return f"{self.kind} ({self.remark})" if self.remark else self.kind


class JamComparison(NamedTuple):
    """Comparison of the jam `mode`, by its exact orbit. If exact orbits of the scene cannot be computed, a run that starts near
    the jam is used."""

    mode: int

    def has_exact_orbit(self, scene: Scene) -> bool:
        """Return True if the theory of exact orbits includes the scene."""
        try:
            require_periodic_jams(scene)
        except InputError:
            return False
        return True

    def exact(self, scene: Scene) -> MotionValues:
        """Return the values of the exact orbit; NaN and a kind "no jam mode" if the jam does not exist."""
        orbit = jam_orbit(scene, mode=self.mode, throw=False)
        exists = bool(np.isfinite(orbit.omega))
        kind = f"jam mode {self.mode}, {orbit.judgement}" if exists else f"no jam mode {self.mode}"
        # If the loads would separate, the machine does not have this motion; other statuses concern the computation only.
        if exists and bool(orbit.status == OrbitStatus.would_separate):
            kind = f"{kind}, but the loads separate"
        computed = not exists or bool(orbit.status == OrbitStatus.would_separate) or bool(orbit.status == OrbitStatus.found)
        return MotionValues(
            kind,
            float(orbit.omega),
            tuple(np.abs(np.asarray(orbit.amplitude)).tolist()),
            float(orbit.foundation_force),
            fold_speed(without_excluded_effects(scene), float(orbit.omega)),
            max(float(orbit.error), _MIN_UNCERTAINTY) if exists else math.nan,
            remark="" if computed else status_name(orbit.status),
        )

    def state(self, scene: Scene) -> State:
        """Return a state on the exact jam with slightly separated loads; NaN if the jam does not exist.

        Effects that theories of jams exclude are omitted.
        """
        n = scene.loads.count
        orbit = jam_orbit(without_excluded_effects(scene), mode=self.mode, throw=False)
        displacement, velocity, (angle,), rate = orbit.at(jnp.zeros(()))
        spread = START_SEPARATION * jnp.asarray(np.arange(n) - 0.5 * (n - 1))
        return with_spin(scene, State(displacement, velocity, (angle + spread,), rate))

    def full(self, scene: Scene) -> MotionValues:
        """Return the values of a run with the full equations that starts near the exact jam and ends when it has settled."""
        run = settle(scene, start=self.state(scene), throw=False)
        return _values_of_run(scene, run, fold_speed(without_excluded_effects(scene), float(run.omega)))


class RunComparison(NamedTuple):
    """Comparison of the end of a run from 0 to `until`, s.

    `start` is "rest", "turning" (evenly spread loads at the rotor speed), or a state.
    """

    until: float
    start: Literal["rest", "turning"] | State

    def state(self, scene: Scene) -> State:
        """Return the initial state of `scene`, completed by `with_spin`."""
        if isinstance(self.start, State):
            with contextlib.suppress(InputError):
                return with_spin(scene, self.start)
            # The state belongs to the other scene, and the effects of this scene do not allow its spin: replace the spin.
            start = self.start
            return with_spin(scene, State(start.displacement, start.velocity, start.angle, start.rate, start.rotor))
        if self.start == "turning":
            return turning_state(scene)
        return initial_state(scene, "rest")

    def has_exact_orbit(self, scene: Scene) -> bool:
        """Return False, because the motion of a run is not an exact orbit."""
        return False

    def exact(self, scene: Scene) -> MotionValues:
        """Raise `NotImplementedError`; `has_exact_orbit` is False."""
        raise NotImplementedError

    def full(self, scene: Scene) -> MotionValues:
        """Return the values at the end of a run with the full equations."""
        start = self.state(scene)
        run = simulate(
            scene, self.until, start=start, save="window", window_periods=_WINDOW_PERIODS, estimate=False, throw=False
        )
        return _values_of_run(scene, run, math.nan)

    @classmethod
    def of_arguments(cls, scene: Scene, until: float | None, start: Literal["rest", "turning"] | State | None) -> RunComparison:
        """Return a comparison by a run.

        By default the run ends at 100 periods of the lowest natural frequency plus twice the time of the last jump of the
        drive's acceleration. It starts with "turning" if the rotor speed is constant, otherwise from "rest".
        """
        if start is None:
            start = "turning" if scene.drive.constant else "rest"
        elif isinstance(start, State):
            start = with_spin(scene, start)  # raises an error for a wrong spin, which `state` would replace
        if until is None:
            jumps = [float(t) for t in scene.drive.jump_ts()]
            until = 2.0 * max(jumps, default=0.0) + 5.0 * WINDOW_PERIODS * slow_period(scene)
        return cls(until, start)


def without_excluded_effects(scene: Scene) -> Scene:
    """Return the scene without effects that theories of jams exclude, such as an imbalance, which turns with the rotor."""
    supported = tuple(e for e in scene.all_effects if all(isinstance(term, PERIODIC_JAM_TERMS) for term in e.terms()))
    return scene if len(supported) == len(scene.all_effects) else scene.replace(effects=supported)


def turning_state(scene: Scene) -> State:
    """Return the state with the carrier at rest and evenly spread loads at the rotor speed."""
    first, *others = scene.loads.rest()
    n, still = scene.loads.count, jnp.zeros(scene.machine.structure().mass.shape[:1])
    zero = jnp.zeros((n,))
    rotor = None if scene.drive.ideal else (jnp.zeros(()), scene.drive.speed)
    spread = first + 2.0 * jnp.pi / n * jnp.arange(n)
    rate = (zero + scene.drive.speed, *(zero for _ in others))
    return with_spin(scene, State(still, still, (spread, *others), rate, rotor))


def total_drag_torque(scene: Scene, omega: float) -> float:
    """Return the torque, N m, by which drag drives all loads together, for loads with the speed `omega`, rad/s."""
    n = scene.loads.count
    u = scene.loads.rest()
    rate = (jnp.full((n,), omega), *(jnp.zeros((n,)) for _ in u[1:]))
    torque = scene.loads.resistance(u, rate, scene.drive.speed)[0]
    return float(jnp.sum(jnp.broadcast_to(torque, (n,))))


def fold_speed(scene: Scene, omega: float) -> float:
    """Return the rotor speed, rad/s, of the fold at which the exact jam with load speed `omega` ends.

    This is the next fold at higher load speeds or, if there is none, the next fold at lower load speeds. It is NaN if there is
    no fold, or if theories of jams do not support the scene.
    """
    try:
        folds = jam_modes(scene).folds
    except InputError:
        return math.nan
    speeds = np.asarray(folds.omega)[np.asarray(folds.exists)]  # for light loads
    above, below = speeds[speeds > omega], speeds[speeds < omega]
    if not speeds.size or not np.isfinite(omega):
        return math.nan
    near = float(above[0]) if above.size else float(below[-1])
    low, high, rotor_speed = 0.97 * near, 1.03 * near, math.nan
    for _ in range(2):
        grid = np.linspace(low, high, _GRID_SPEEDS)
        speed, slope = (np.ravel(x) for x in branch_at(scene, jnp.asarray(grid)[None]))
        changes = np.flatnonzero((slope[1:] > 0.0) != (slope[:-1] > 0.0))
        changes = changes[np.isfinite(slope[changes]) & np.isfinite(slope[changes + 1])]
        if not changes.size:
            return math.nan
        k = int(changes[np.argmin(np.abs(grid[changes] - near))])
        low, high = float(grid[k]), float(grid[k + 1])
        rotor_speed = float(speed[k] if abs(slope[k]) < abs(slope[k + 1]) else speed[k + 1])
    return rotor_speed


def _values_of_run(scene: Scene, run: Run, fold: float) -> MotionValues:
    has_finished = bool(run.finished)
    kind = status_name(run.regime.name) if has_finished else f"failed: {status_name(run.status)}"
    drift, amplitude = float(run.drift), np.asarray(run.amplitude)
    largest_displacement = max(a for a, unit in zip(amplitude, scene.machine.structure().units, strict=True) if unit == "m")
    unit = float(natural_units(scene).displacement)
    magnified = max(1.0, MIN_AMPLITUDE_SHARE * unit / largest_displacement) if largest_displacement > 0.0 else 1.0
    # The drift of a run is relative to another scale, which includes rotations and has the lower limit `MIN_CHANGE_SCALE`.
    largest_length = float(np.max(np.asarray(scene.machine.carrier().as_lengths(run.amplitude))))
    drift *= max(largest_length, measure.MIN_CHANGE_SCALE * unit) / max(largest_displacement, MIN_AMPLITUDE_SHARE * unit)
    return MotionValues(
        kind,
        float(run.omega),
        tuple(amplitude.tolist()),
        float(run.foundation_force),
        fold,
        max(drift, _MIN_UNCERTAINTY) if np.isfinite(drift) else math.nan,
        smallest_distance(scene, run.window),
        magnified,
    )
