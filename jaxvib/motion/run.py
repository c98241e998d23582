"""The result of a time integration."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, Onto, SpeedUnit, quantity_text
from jaxvib.equations.forces import normal_force
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import on_body, read_place
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import start_notes
from jaxvib.motion.analysis.beat import beat_period
from jaxvib.motion.analysis.caught import held_lines, held_rotors
from jaxvib.motion.analysis.creep import creep_text
from jaxvib.motion.analysis.measure import (
    STILL_SHARE,
    AbstractMeasured,
    Measured,
    Trajectory,
    duration_text,
    last_mean_speeds,
    turning_angles,
    turning_masses,
)
from jaxvib.motion.analysis.points import (
    ZERO_VIBRATION,
    PointMotion,
    absent_vibration,
    fit_harmonic,
    measures_text,
    motion_of_point,
    peak_time,
    peak_time_text,
    require_turns,
    require_vibration,
    samples_of,
    vibration_of,
)
from jaxvib.motion.analysis.regime import Regime, balancing_time_text, regime
from jaxvib.motion.analysis.separation import has_collision, has_overlap, would_separate
from jaxvib.motion.analysis.spectrum import Spectrum, spectrum_of
from jaxvib.motion.analysis.stays import Stay, find_stays
from jaxvib.motion.analysis.unsettled import balanced_text, coasting_text, last_turn_text
from jaxvib.numerics.extrema import sampled_maximum
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.results.status import member, status_name
from jaxvib.runtime.programs import cached
from jaxvib.steady.measures import VibrationMeasures
from jaxvib.steady.outcome import REFUSED
from jaxvib.steady.points import Harmonic, PathsOfPoints
from jaxvib.steady.vibration import Samples, Vibration
from jaxvib.units import Number
from jaxvib.units.known import when_known


@cached
def _detachment_times(scene: Scene, trajectory: Trajectory) -> Array:
    force = jax.vmap(lambda t, state: normal_force(scene, t, state))(trajectory.time, trajectory.state)
    first = jnp.min(jnp.where(force < 0.0, trajectory.time[:, None], jnp.inf), axis=0)
    return jnp.where(jnp.isfinite(first), first, jnp.nan)


_CONTACT = "add load_contact = { stiffness = 1e5, restitution = 0.6 } to [effects], or LoadContact(1e5, restitution=0.6)"


_MAX_CHANGES = 3
"""Largest number of times of changes of the drives between which the summary states the largest values separately."""

_LARGE_ERROR = 1.0
"""Error of the states above which the summary states that the phase is not determined."""


def _length(vectors: Array) -> np.ndarray:
    return np.linalg.norm(np.asarray(vectors), axis=-1)


class RunStatus(eqx.Enumeration):
    """Outcomes of a run. The value of each member is the message shown to the user."""

    done = "the run reached its end"
    max_steps_reached = "the run needs more steps than max_steps to reach its end"
    not_finite = "the motion grew without bounds"
    no_step = "a step of the method could not be computed: its implicit equations were not solved"
    not_accurate = "the run reached its end, but its estimated error is larger than the requested accuracy"
    no_start = "the initial state does not exist or is not finite"
    beating = "the motion is not periodic; it beats or wanders about constant mean values"
    creeping = (
        "the loads balance the rotor and creep from one balanced arrangement to the next; the "
        "remaining vibration changes slowly"
    )
    would_separate = (
        "loads of one track are at nearly one angle, and this motion is unstable: slightly separated loads move away from it "
        "(balls that cannot pass each other need ball_radius and load_contact)"
    )
    refused = REFUSED
    overlapping = f"loads are inside each other, because they pass through each other without load_contact; {_CONTACT}"


_SINGLE_PRECISION = '  in single precision (about 6 digits); for double precision: jax.config.update("jax_enable_x64", True)'
"""Line of the summary of a run in single precision."""

ENDS = ("done", "beating", "creeping", "would_separate", "overlapping")
"""Statuses of runs that reached their end, with the requested accuracy if there was one."""

SETTLED_DRIFT = 1e-3
"""Drift below which a motion counts as settled."""


class Run(AbstractMeasured, PathsOfPoints, Result):
    """Run of a scene: the quantities measured in its window (see `AbstractMeasured`), and the motion itself.

    `ellipse` and `deck` describe the motion of points by a harmonic with the frequency `omega`, fitted to the window by least
    squares.

    Returned by `simulate` and `settle`.

    **Attributes**

    - `status`: a `RunStatus`
    - `trajectory`: evenly spaced states over the whole run; None if only the window was requested
    - `window`: the densely sampled end of the run, over which quantities are measured
    - `steps`: number of accepted and rejected steps; `rejected`: number of rejected steps
    - `error`: estimated error; NaN if no estimate was requested, infinite if it cannot be estimated; typical: 1e-8 to 1e-5
    - `scene` of the run
    - `coincident`: True if several loads started at one angle and stayed at one angle. Loads with the same parameters stay at
      one angle even if this motion is unstable. If this motion settles, its stability is tested by the linearized equations. If
      slightly separated loads would leave it, the status is `would_separate`, and the run is not `settled`. Loads with a
      `ball_radius` that end inside each other have the status `overlapping`, which the effect `LoadContact` prevents
    - `engine` of the integration: "scalar" if the equations are computed on scalars, which is faster for small states,
      otherwise "array". Arrays are used for states of more than 32 entries, machines with 4 or more coordinates, exciters with
      4 or more loads, and very long equations
    - `evaluations` of the vector field (0 if the method does not count them), and `seconds` of the computation. Both include
      the run with larger steps for the error; `seconds` includes compilation if the program was new, and is NaN under a JAX
      transformation

    The `error` is the largest error of a state in the window: displacements relative to the largest displacement, velocities
    relative to the largest velocity (both at least to their natural unit, see `Tolerance`), angles in rad, speeds of loads
    relative to the rotor speed.

    - It is estimated as a fraction of the difference from a run with larger steps; rounding errors are added. It is twice this
      difference if an effect or a drive is not smooth, or if the acceleration of a drive jumps and the steps are equal
    - A motion whose phase is not determined has a large error, but its amplitudes may be exact
    """

    status: RunStatus
    trajectory: Trajectory | None = eqx.field(metadata=part())
    window: Trajectory = eqx.field(metadata=part(prefix="window_"))
    error: Array = eqx.field(metadata=in_unit(""))
    steps: Array = eqx.field(metadata=in_unit(""))
    rejected: Array = eqx.field(metadata=in_unit(""))
    evaluations: Array = eqx.field(metadata=in_unit(""))
    seconds: Array = eqx.field(metadata=in_unit("s"))
    scene: Scene = eqx.field(metadata=SCENE)
    coincident: Array | bool = eqx.field(default=False, metadata=in_unit(""))
    engine: Literal["scalar", "array"] = eqx.field(default="array", static=True)

    @property
    def settled(self) -> Array:
        """True if the drift is below 1e-3, slightly separated loads do not leave the motion, and no loads overlap."""
        is_real = (self.status != RunStatus.would_separate) & (self.status != RunStatus.overlapping)
        return (self.drift < SETTLED_DRIFT) & is_real

    @property
    def finished(self) -> Array:
        """True if the run reached its end, settled or not, with the requested accuracy."""
        return functools.reduce(operator.or_, (self.status == getattr(RunStatus, name) for name in ENDS))

    @property
    def largest_displacement(self) -> Array:
        """Largest displacement of each coordinate from static equilibrium during the run, (nd,), m (rad for tilts); NaN for a
        run that failed.

        A parabola estimates the maximum between the stored states. For a sinusoidal motion the estimate is too small by at most
        6e-4 of the amplitude with 16 states in a period, and by at most 9e-3 with 8.
        """
        return sampled_maximum(jnp.abs(self._stored.state.displacement), axis=-2)

    @property
    def largest_force(self) -> Array:
        """Largest magnitude of the force on the foundation during the run, N; NaN if the run failed.

        The maximum between the stored states is estimated as for `largest_displacement`. In two directions this is the largest
        length of the vector, not the root of the sum of both squared peaks, which is `foundation_force`.
        """
        square = jnp.sum(self._stored.foundation_force**2, axis=-1)
        zero = square == 0.0  # where the square root has no derivative
        return sampled_maximum(jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square))), axis=-1)

    @property
    def largest_displacement_time(self) -> Array:
        """Time of the stored state with the largest displacement of each coordinate, (nd,), s."""
        return peak_time(self._stored.time[..., None, :], jnp.swapaxes(jnp.abs(self._stored.state.displacement), -1, -2))

    @property
    def largest_force_time(self) -> Array:
        """Time of the stored state with the largest magnitude of the force on the foundation, s."""
        return peak_time(self._stored.time, jnp.sum(self._stored.foundation_force**2, axis=-1))

    def _require_end(self) -> None:
        """**Raises** `InputError` for a batch of runs, and for a run that failed: its window has no values."""
        self.require_single()
        if not self._has_end:
            raise InputError("run", f"has no values at its end: {self.message}; simulate with throw=True for advice")

    @property
    def _has_end(self) -> bool:
        """True if the states of the window are known; False for a run that failed."""
        return all(np.all(np.isfinite(np.asarray(values))) for values in (self.window.time, self.window.state.displacement))

    @property
    def _stored(self) -> Trajectory:
        """Stored states: the whole run, or the window if only the window was kept."""
        return self.window if self.trajectory is None else self.trajectory

    @property
    def _cost(self) -> str:
        counted = f"{int(self.evaluations)} evaluations" if self.evaluations else "computed"
        return f"{counted} in {float(self.seconds):.3g} s"

    def summary(self, measures: VibrationMeasures | None = None) -> str:
        """Return the outcome of the run as text; amplitudes zero to peak.

        **Arguments**: `measures` of the vibration that are shown; default: those of the centre of mass on a level deck.
        """
        self.require_single()
        if not self._has_end:
            return f"{self.message}: amplitudes, speeds and forces are unknown after {int(self.steps)} steps\n  {self._cost}"
        reason, rotors = self.no_vibration, [w[-1] for w in self.window.rotor_speeds]
        stuck = [] if np.max(np.abs(rotors)) > 1.0 else start_notes(self.scene)
        if not stuck and float(jnp.abs(self.omega)) < STILL_SHARE * float(self.scene.top_speed):
            angles = turning_angles(self.scene, lambda: self._stored.time, self._stored.state)[0]
            last_turn = last_turn_text(self.scene, np.asarray(self._stored.time), np.asarray(angles))
            stuck = [f"the {turning_masses(self.scene)} are almost at rest{last_turn}"]
        if (creep := creep_text(self.scene, self.window)) and not stuck:
            stuck = ["the loads creep, see below"]
        state = "settled" if bool(self.settled) else f"not settled: {stuck[0]}" if stuck else self._unsettled_text()
        state = "steady in the mean" if bool(self.status == RunStatus.beating) else state
        state = "balanced" if bool(self.status == RunStatus.creeping) else state
        unstable, first = bool(self.status == RunStatus.would_separate), []
        if unstable:
            state = "periodic only while the loads are at one angle"
        elif bool(self.status == RunStatus.overlapping):
            unstable, state = True, "a motion of loads that pass through each other"
        if unstable:
            first = [f"not settled: {self.message}"]
        end = RunStatus[RunStatus.done] if unstable else self.message
        one_angle = "  all loads stayed at their common initial angle: slightly separated loads may move differently"
        return "\n".join(
            [
                *first,
                f"{end}: {duration_text(self.scene, self.window.time[-1])}, {int(self.steps)} steps "
                f"({int(self.rejected)} rejected), {state} (drift {float(self.drift):.1e})",
                f"  {self._error_text(reason)}; {self._cost}",
                *([] if self.window.time.dtype.itemsize >= 8 else [_SINGLE_PRECISION]),
                *([] if self.settled else [self._window_text()]),
                f"  {self.speeds_text(self.scene, self.window.rotor_speeds, self._last_speeds)}",
                *(f"  {line}" for line in held_lines(self.caught_at, np.asarray(estimated_frequencies(self.scene)))),
                *([] if reason == ZERO_VIBRATION else [f"  {self.amplitude_text(self.scene)}"]),
                *(f"  {line}" for line in measures_text(self.scene, reason, self.vibration, measures)),
                *(f"  {part._on_the_way(when)}" for when, part in self.parts().items()),
                *(f"  {stay.summary()}" for stay in self.stays),
                *(f"  {line}" for line in self._regime_lines()),
                *([one_angle] if self.coincident and not (unstable or self.settled) else []),
                *([f"  {creep}"] if creep else []),
                *([] if unstable else self._pass_through_note()),
                *([] if self.settled else self._collision_note()),
                *self._detachment(),
            ]
        )

    @property
    def _last_speeds(self) -> Array:
        """Mean speeds of the turning masses at the end of the window, rad/s."""
        time = self.window.time
        return last_mean_speeds(time, *turning_angles(self.scene, lambda: time, self.window.state))

    def _error_text(self, no_vibration: str) -> str:
        if np.isnan(self.error):
            return "error not estimated"
        if self.error > _LARGE_ERROR:
            size = f"(estimated error of the states in the window {self.error:.1e})"
            return f"the phase of the motion is not determined {size}; small changes of the machine can change peaks on the way"
        states = "angles in the window" if no_vibration == ZERO_VIBRATION else "states in the window, phase included,"
        return f"estimated error of the {states} {float(self.error):.1e}"

    def _regime_lines(self) -> list[str]:
        if not self.scene.is_plain:
            return []
        named = self.regime
        time = balancing_time_text(self.scene, named, self.trajectory)
        return [named.summary(), *([time] if time else [])]

    def _unsettled_text(self) -> str:
        if self.scene.is_plain and (balanced := balanced_text(self.regime, self.window)):
            return balanced
        time = self.window.time
        _, speeds = turning_angles(self.scene, lambda: time, self.window.state)
        if coasting := coasting_text(self.scene, np.asarray(time), np.asarray(speeds)):
            return f"not settled: {coasting}"
        if np.any(self.caught_at):
            return "not settled: a resonance catches exciters, run longer to see whether they pass"
        period = beat_period(self.scene, self._stored)
        if period is None:
            return "not settled: run longer"
        reason = "the loads turn slower than the imbalance of the rotor"
        return f"not settled: the vibration beats with a period of {period:.4g} s and will not settle, because {reason}"

    def _window_text(self) -> str:
        start, end = (f"{float(self.window.time[k]):.4g}" for k in (0, -1))
        return f"  the following values are those from {start} to {end} s, while the motion still changes"

    def _pass_through_note(self) -> list[str]:
        if not has_overlap(self.scene, self._stored):
            return []
        return [f"  loads passed through each other on the way, which may change the result; {_CONTACT}"]

    def _collision_note(self) -> list[str]:
        if not has_collision(self.scene, self._stored):
            return []
        return ["  loads touch each other: derivatives of this run may be meaningless; test them by growth or check_gradients"]

    def parts(self) -> dict[str, Run]:
        """Return the parts of the run between the times at which its drives change suddenly, such as switch-offs.

        **Returns** parts by their times as text, such as " until 10 s" and " from 10 s"; the whole run with an empty text if
        there are none or more than three such times; nothing if the run kept only its window.
        """
        if self.trajectory is None:
            return {}
        time = np.asarray(self.trajectory.time)
        jumps = np.unique([float(t) for exciter in self.scene.exciters for t in exciter.drive.jump_ts()])
        jumps = jumps[(jumps > time[0]) & (jumps < time[-1])]
        if not 0 < len(jumps) <= _MAX_CHANGES:
            return {"": self}
        found = {}
        for low, high in itertools.pairwise([time[0], *jumps, time[-1]]):
            keep = np.flatnonzero((time >= low) & (time <= high))
            states = jax.tree.map(lambda values, keep=keep: values[keep], self.trajectory)
            first, last = low == time[0], high == time[-1]
            name = f" until {high:.4g} s" if first else f" from {low:.4g} s" if last else f" from {low:.4g} to {high:.4g} s"
            found[name] = eqx.tree_at(lambda run: run.trajectory, self, states)
        return found

    def _on_the_way(self, when: str) -> str:
        structure, window, stored = self.scene.machine.structure(), self.window, self._stored
        peaks, last = (
            [*np.max(np.abs(np.asarray(part.state.displacement)), axis=0), np.max(_length(part.foundation_force))]
            for part in (stored, window)
        )
        times = [*np.asarray(self.largest_displacement_time), self.largest_force_time]
        largest = zip(
            [*structure.coordinates, "magnitude of the foundation force"],
            [*np.asarray(self.largest_displacement), self.largest_force],
            [*structure.units, "N"],
            map(peak_time_text, peaks, last, times),
            strict=True,
        )
        *named, force = (f"{name} {quantity_text(x, unit, 4)}{time}" for name, x, unit, time in largest)
        start = "; the loads began side by side, another separation changes these values" if self._begins_side_by_side else ""
        return f"largest on the way{when}, zero to peak: {', '.join(named)}; {force}{start}"

    @property
    def _begins_side_by_side(self) -> bool:
        """True if loads with a size that are at rest at the beginning of the stored motion lie side by side."""
        first = jax.tree.map(lambda values: np.asarray(values)[0], self._stored.state.exciters)
        return any(
            exciter.loads is not None
            and getattr(exciter.loads, "ball_radius", None) is not None
            and np.size(own.angle[0]) > 1
            and not np.any(own.rate[0])
            and np.allclose(np.diff(own.angle[0]), np.diff(np.asarray(exciter.loads.offsets())), rtol=1e-6, atol=0.0)
            for exciter, own in zip(self.scene.exciters, first, strict=True)
        )

    def _detachment(self) -> list[str]:
        times = np.asarray(self.detached)
        if not np.any(np.isfinite(times)):
            return []
        load_times = ", ".join(f"{j + 1} at {t:.6g} s" for j, t in enumerate(times) if np.isfinite(t))
        return [f"  detached: loads lost contact with their track (load {load_times}); the equations keep them on the track"]

    @property
    def regime(self) -> Regime:
        """Kind of motion at the end of the run, see `Regime`."""
        self.require_single()
        return regime(self.scene, self.window)

    @property
    def caught_at(self) -> np.ndarray:
        """Number, from 1, of the resonance that catches each exciter without loads (exciter,) at the end of the run: the rotor
        stays near this resonance, slower than its motor. It is 0 for other exciters, and for a run that failed."""
        self.require_single()
        if not self._has_end:
            return np.zeros(len(self.scene.exciters), int)
        return held_rotors(self.scene, self.window.rotor_speeds, np.asarray(estimated_frequencies(self.scene)))

    @property
    def stays(self) -> list[Stay]:
        """Times during which loads or motors stayed at a resonance before they passed it, see `find_stays`; empty for a run
        that failed and for a run that kept only its window."""
        self.require_single()
        if self.trajectory is None or not self._has_end:
            return []
        time, state = self.trajectory.time, self.trajectory.state
        speeds = turning_angles(self.scene, lambda: time, state)[1]
        return find_stays(self.scene, np.asarray(time), np.asarray(speeds), self.trajectory.rotor_speeds)

    @property
    def detached(self) -> Array:
        """Time, s, at which each load (loads,) first lost contact with its track, according to the stored states.

        It is NaN for a load that never lost contact, and for loads that their track holds from both sides. The equations keep
        the load on its track; after this time the computed motion is therefore not that of a real load.
        """
        self.require_single()
        loads = [exciter.loads for exciter in self.scene.exciters if exciter.loads is not None]
        is_one_sided = np.repeat([one_kind.one_sided for one_kind in loads], [one_kind.count for one_kind in loads])
        if not np.any(is_one_sided):
            return jnp.asarray(np.full(is_one_sided.size, np.nan), self.window.time.dtype)
        times = _detachment_times(self.scene, self.window if self.trajectory is None else self.trajectory)
        return times if np.all(is_one_sided) else jnp.where(is_one_sided, times, np.nan)

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot time histories: platforms, speeds of loads and rotor, foundation force.

        The left column shows the whole run as bands between its peaks, or the window if the run has no trajectory. The right
        column shows the last three periods, with the phases.

        **Arguments**

        - `unit` of speeds, "rad/s", "rpm" or "Hz"
        - `ax`: axes to draw onto, one for each panel, by rows

        **Raises** `InputError` for a run that failed.
        """
        from jaxvib.draw.motion.histories import time_histories  # slow import

        self._require_end()
        structure = self.scene.machine.structure()
        history, end_history = map(_histories, (self.window if self.trajectory is None else self.trajectory, self.window))
        named = dict(names=structure.coordinates, units=structure.units, directions=structure.foundation_directions)
        return time_histories(history, end_history, **named, unit=unit, ax=ax)

    @validated
    def spectrum(self, parts: int = 1) -> Spectrum:
        """Return the spectrum of the window, or the spectra of `parts` segments of the whole run.

        **Arguments**: `parts`: number of segments; neighbouring segments overlap by one half; typical: 10 to 60 for a run-up.
        More segments give a better resolution in time and a poorer one in frequency.

        **Returns** `Spectrum`; for several segments its figure is a waterfall diagram, with resonances marked.

        **Raises** `InputError` for a run that failed, for more segments than the samples allow, and for several segments if the
        run kept only its window, or if it kept fewer than 3 states for each turn of the rotor.
        """
        self._require_end()
        return spectrum_of(self.scene, self.window, self.trajectory, parts)

    @validated
    def point(
        self, at: int | Number | Sequence[Number] | None = None, body: int = 0, *, part: Literal["window", "all"] = "window"
    ) -> PointMotion:
        """Return the motion of a point, see `PointMotion`.

        **Arguments**: `at` and `body` as in `ellipse`; typical: (1.2, 0.3); `part`: "window", the end of the run, or "all".

        **Returns** `PointMotion`. **Raises** `InputError` for a place that the machine does not have, for another `part`, and
        for "all" if the run kept only its window.
        """
        self.require_single()
        require_one_of(part, ("window", "all"), "part")
        trajectory = self.window if part == "window" else self.trajectory
        if trajectory is None:
            raise InputError("part", "is 'all', but the run kept only its window; simulate with save='all'")
        return motion_of_point(self.scene.machine, trajectory, on_body(read_place(at), self.scene.machine.require_body(body)))

    def harmonic(self) -> Harmonic:
        """Return the harmonic with the frequency `omega` that is fitted to the window, see `fit_harmonic`.

        **Raises** `InputError` if the exciters make fewer than 3 turns in the window, and for a batch of runs.
        """
        self.require_single()
        when_known(require_turns, self.window.time, self.omega)
        amplitude, rest = fit_harmonic(self.window.time, self.window.state.displacement, self.omega)
        return Harmonic(self.scene.machine, self.omega, amplitude, rest)

    def samples(self) -> Samples:
        """Return samples of the motion in the window. **Raises** `InputError` for a batch of runs."""
        self.require_single()
        return samples_of(self.scene, self.window)

    @property
    def no_vibration(self) -> str:
        """Reason for which the window has no vibration that can be measured; an empty text if it has one.

        The exciters must make 3 turns in the window, and at least half of the amplitude must be at their speed. Otherwise
        `vibration` raises an error, and the summary contains this reason in place of the measures.
        """
        self.require_single()
        return absent_vibration(self.scene, self.window.time, self, self.harmonic)

    def vibration(self) -> Vibration:
        """Return the vibration over the window, for `vibration_measures`: the fitted harmonic, measured amplitudes and force,
        mean torques and powers of the drives, and samples of the whole motion.

        **Raises** `InputError` with the text of `no_vibration`, unless this is empty.
        """
        when_known(lambda *_: require_vibration(self.no_vibration), self.window.time, self.omega, self.amplitude)
        measured = Measured(self.omega, self.load_speed, self.amplitude, self.foundation_force, self.drift)
        return vibration_of(self.scene, self.window, measured)

    @validated
    def plot_path(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the path of the axis of a rotor over the last three periods, mm; for loads at several stations, a path for each.

        **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for a machine that moves up and down only.
        """
        from jaxvib.draw.motion.histories import last_periods  # slow import
        from jaxvib.draw.motion.spectra import path_chart

        self._require_end()
        machine = self.scene.machine
        mount, kind = self.scene.mount(), machine.kind
        if mount.axes != (0, 1):
            raise InputError(
                "machine.kind", f"is {quoted(kind)}, which moves only up and down; a path needs a rotor such as rotor(...)"
            )
        displacement = np.asarray(self.window.state.displacement)
        displacement = displacement[last_periods(np.asarray(self.window.time), displacement)]
        named = {"axis of the loads": mount.rows[0]}
        if not mount.at_one_point:
            stations = sorted({float(s) for s in mount.distances(self.window.state.azimuth.shape[1])})
            named = {f"axis at {1e3 * s:+.4g} mm": machine.rows_at(jnp.asarray(s)) for s in stations}
        paths = {name: tuple((displacement @ np.asarray(rows).T).T) for name, rows in named.items()}
        return path_chart({name: (path[0], path[1]) for name, path in paths.items()}, ax=ax)


def _histories(trajectory: Trajectory) -> list[np.ndarray]:
    loads = [np.asarray(exciter_state.rate[0]) for exciter_state in trajectory.state.exciters if exciter_state.rate]
    rotors = np.stack([np.asarray(speed) for speed in trajectory.rotor_speeds], axis=1)
    speeds = np.concatenate(loads, axis=1) if loads else np.zeros((rotors.shape[0], 0))
    time, displacement, force = map(np.asarray, (trajectory.time, trajectory.state.displacement, trajectory.foundation_force))
    return [time, displacement, speeds, rotors, force]


def with_separation_status(run: Run, *, is_settled: bool = True) -> Run:
    """Return the run, with another status if its loads cannot move in this way.

    The status is `overlapping` if loads with a size are inside each other at the end, and `would_separate` if the run is
    settled and its loads stay at nearly one angle although this motion is unstable.
    """
    if status_name(run.status) not in ENDS:
        return run
    if has_overlap(run.scene, run.window if is_settled else jax.tree.map(lambda leaf: np.asarray(leaf)[-1:], run.window)):
        return dataclasses.replace(run, status=member(RunStatus, "overlapping"))
    if is_settled and would_separate(run.scene, run.window):
        return dataclasses.replace(run, status=member(RunStatus, "would_separate"))
    return run
