"""Result of an averaged run: motion, measured quantities and status."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit
from jaxvib.equations.linear import linear_model, peak_force
from jaxvib.equations.state import State
from jaxvib.equations.torque_balance import mass_owners, resultant_of
from jaxvib.machine.drives.drive import Motor
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction, RotorImbalance
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.motion.analysis.measure import AbstractMeasured, Trajectory, duration_text, last_samples, only_exciter_value
from jaxvib.motion.analysis.points import absent_vibration, measures_text, require_vibration
from jaxvib.motion.analysis.regime import regime
from jaxvib.motion.analysis.stays import Stay, find_stays
from jaxvib.motion.analysis.unsettled import balanced_text, coasting_text
from jaxvib.motion.run import SETTLED_DRIFT
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.results.status import status_name
from jaxvib.steady.measures import VibrationMeasures
from jaxvib.steady.outcome import REFUSED
from jaxvib.steady.points import Harmonic, PathsOfPoints
from jaxvib.steady.vibration import Vibration
from jaxvib.units.known import when_known


class EnvelopeStatus(eqx.Enumeration):
    """Outcomes of an averaged run. The value of each member is the message shown to the user."""

    done = "the averaged run reached its end"
    max_steps_reached = "the averaged run needs more steps than max_steps to reach its end"
    not_finite = "the motion grew without bounds"
    no_step = "a step of the method could not be computed: its implicit equations were not solved"
    no_start = "the initial state does not exist or is not finite"
    unstable = "the exciters turn at one speed, but this motion is unstable: even the smallest disturbance ends it"
    would_separate = (
        "loads of one track are at nearly one angle, and this motion is unstable: slightly separated loads move away from it "
        "(averaging omits the contact of balls that cannot pass each other: use simulate with ball_radius and load_contact)"
    )
    refused = REFUSED
    not_turning = (
        "gravity does not average out: a load or an unbalance turns too slowly, or its drag or motor cannot lift it "
        "against gravity"
    )


class Envelopes(Readable):
    """Averaged motion at some times; the rotor of an exciter without loads counts as one load.

    **Attributes** (nt times, nd coordinates, nb directions of the force)

    - `time` (nt,), s
    - `displacement` (nt, nd), m, and `velocity` (nt, nd), m/s: complex amplitudes Y and V of q = Re(Y exp(i theta)) and
      q' = Re(V exp(i theta)), with the mean angle theta of the loads. If exciters turn at different speeds, the amplitudes
      change periodically (beats)
    - `amplitude` (nt, nd), m, and `foundation_force` (nt, nb), N, zero to peak
    - `omega` (nt,): mean load speed, each load positive in the direction of its exciter, and `load_speed` (nt, count) of
      each load, positive anticlockwise, rad/s
    - `phase` (nt, count) of each load relative to the mean angle, rad, in its direction of rotation
    - `rotor_speeds`: an array (nt,) for each exciter, anticlockwise, rad/s; `rotor_speed` is that of the only one
    - `ripple` (nt, count), rad, see `Envelope`
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "time", "coordinate"))
    velocity: Array = eqx.field(metadata=in_unit("m/s or rad/s", "time", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "time", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "time", "direction"))
    omega: Array = eqx.field(metadata=in_unit("rad/s", "time"))
    load_speed: Array = eqx.field(metadata=in_unit("rad/s", "time", "load"))
    phase: Array = eqx.field(metadata=in_unit("rad", "time", "load"))
    rotor_speeds: tuple[Array, ...] = eqx.field(metadata=in_unit("rad/s", "time", name="rotor_speed"))
    ripple: Array = eqx.field(metadata=in_unit("rad", "time", "load"))

    @property
    def rotor_speed(self) -> Array:
        """Speed of the rotor of a scene with one exciter, rad/s. **Raises** `InputError` for several."""
        return only_exciter_value(self.rotor_speeds, "rotor_speeds")


_OFFSET = "no spring returns the machine to its place: amplitudes include its displacement from the start"
"""Sentence of the summary, for machines that can move without the force of a spring."""


def _moves_without_spring(scene: Scene) -> bool:
    eigenvalues = np.linalg.eigvalsh(np.asarray(scene.machine.carrier().stiffness))
    return bool(eigenvalues[0] <= np.finfo(eigenvalues.dtype).eps ** 0.75 * max(eigenvalues[-1], 0.0))


class Envelope(AbstractMeasured, PathsOfPoints, Result):
    """Averaged run of a scene: the quantities of `AbstractMeasured` over the last turns, and the averaged motion.

    Returned by `envelope`. `ellipse` and `deck` describe the motion of points by the mean of the amplitudes over the window.

    The amplitude is the largest |q|. If a machine can move without the force of a spring, the displacement from the start
    remains and is included in the amplitude, whereas the amplitude of `simulate` is half of the range of q.

    **Attributes**: those of `AbstractMeasured`, and

    - `status`: an `EnvelopeStatus`
    - `ripple` (count,), rad: amplitude of the oscillation of each load's angle that averaging omits, the largest in the window.
      The ripple estimates the relative error of amplitudes and speeds; typical: 1e-3 to 0.1
    - `trajectory` and `window`: `Envelopes`; `trajectory` is None if only the window was requested
    - `steps`: number of accepted and rejected steps; `rejected`: number of rejected steps
    - `scene`
    """

    ripple: Array = eqx.field(metadata=in_unit("rad", "load"))
    status: EnvelopeStatus
    trajectory: Envelopes | None = eqx.field(metadata=part(prefix="trajectory_"))
    window: Envelopes = eqx.field(metadata=part(prefix="window_"))
    steps: Array = eqx.field(metadata=in_unit(""))
    rejected: Array = eqx.field(metadata=in_unit(""))
    scene: Scene = eqx.field(metadata=SCENE)

    @property
    def settled(self) -> Array:
        """True if the drift is below 1e-3, and slightly disturbed loads do not leave the motion."""
        is_stable = (self.status != EnvelopeStatus.would_separate) & (self.status != EnvelopeStatus.unstable)
        return (self.drift < SETTLED_DRIFT) & is_stable

    def harmonic(self) -> Harmonic:
        """Return the mean vibration of the coordinates over the window, at the mean load speed.

        **Raises** `InputError` for a batch of runs.
        """
        self.require_single()
        mean = jnp.mean(self.window.displacement, axis=0)
        deviation = self.window.displacement - mean[None]
        rest = 0.5 * (deviation.T @ jnp.conj(deviation)).real / deviation.shape[0]
        return Harmonic(self.scene.machine, jnp.mean(self.window.omega), mean, rest)

    @property
    def no_vibration(self) -> str:
        """Reason for which the window has no vibration that can be measured, see `Run.no_vibration`."""
        self.require_single()
        return absent_vibration(self.scene, self.window.time, self, self.harmonic)

    def vibration(self) -> Vibration:
        """Return the mean vibration over the window, for `vibration_measures`.

        The torque of a motor is its torque at the averaged speed. The torque of an ideal drive is that of the drag of its
        loads, NaN for loads with dry friction and for unbalances.

        **Raises** `InputError` with the text of `no_vibration`, unless this is empty.
        """
        when_known(lambda *_: require_vibration(self.no_vibration), self.window, self.amplitude)
        scene, window = self.scene, self.window
        turn = jnp.mean(jnp.exp(1j * window.phase), axis=0)
        force = peak_force(self.omega**2 * resultant_of(linear_model(scene), turn))
        load_speeds = jnp.split(window.load_speed, np.cumsum(np.bincount(mass_owners(scene)))[:-1], axis=1)
        rates = zip(scene.exciters, window.rotor_speeds, load_speeds, strict=True)
        torques = [_torque_of(each, window.time, speed, rate) for each, speed, rate in rates]
        powers = [
            jnp.mean(each.direction * n * torque)
            for each, n, torque in zip(scene.exciters, window.rotor_speeds, torques, strict=True)
        ]
        return Vibration(
            speed=self.omega,
            displacement=jnp.mean(window.displacement, axis=0),
            amplitude=self.amplitude,
            foundation_force=self.foundation_force,
            exciter_force=jnp.where(has_term(scene.all_effects, RotorImbalance), jnp.nan, force),
            torque=jnp.stack([jnp.mean(torque) for torque in torques]),
            power=jnp.stack(powers),
        )

    @property
    def stays(self) -> list[Stay]:
        """Times during which loads or motors stayed at a resonance before they passed it, see `Run.stays`."""
        self.require_single()
        if (run := self.trajectory) is None or not np.all(np.isfinite(self.amplitude)):
            return []
        return find_stays(self.scene, np.asarray(run.time), np.asarray(run.load_speed), run.rotor_speeds)

    def summary(self, measures: VibrationMeasures | None = None) -> str:
        """Return the outcome of the run as text; amplitudes zero to peak.

        **Arguments**: `measures` of the vibration that are shown; default: those of the centre of mass on a level deck.
        """
        self.require_single()
        moves = bool(np.all(np.isfinite(self.amplitude)))
        measured = measures_text(self.scene, self.no_vibration, self.vibration, measures) if moves else []
        last_speed = jnp.mean(self.window.load_speed[last_samples(len(self.window.time))], axis=0)
        named, first = status_name(self.status), []
        end, state = self.message, "settled" if bool(self.settled) else self._unsettled_text()
        if named in ("would_separate", "unstable"):
            first, end = [f"not settled: {self.message}"], EnvelopeStatus[EnvelopeStatus.done]
            state = f"periodic only {'while the loads are at one angle' if named == 'would_separate' else 'until disturbed'}"
        return "\n".join(
            [
                *first,
                f"{end}: {duration_text(self.scene, self.window.time[-1])}, {int(self.steps)} steps "
                f"({int(self.rejected)} rejected), {state} (drift {float(self.drift):.1e})",
                f"  {self.speeds_text(self.scene, self.window.rotor_speeds, last_speed)}",
                f"  {self.amplitude_text(self.scene)}",
                *([f"  {_OFFSET}"] if moves and _moves_without_spring(self.scene) else []),
                *(f"  {line}" for line in measured),
                *(f"  {stay.summary()}" for stay in self.stays),
                f"  averaged: relative error of the order of {float(jnp.max(self.ripple)):.1e}",
            ]
        )

    def _unsettled_text(self) -> str:
        """Return the state of a motion that is not settled."""
        time, speeds = np.asarray(self.window.time), np.asarray(self.window.load_speed)
        if not np.all(np.isfinite(speeds)):
            return "not settled: run longer"
        if self.scene.is_plain:
            motion = _motion_of(self.window)
            if balanced := balanced_text(regime(self.scene, motion), motion):
                return balanced
        return f"not settled: {coasting_text(self.scene, time, speeds) or 'run longer'}"

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot amplitudes, load and rotor speeds, and the amplitude of the foundation force over time.

        **Arguments**: `unit` and `ax`, as in `Run.plot`.
        """
        self.require_single()
        return plot_histories(self, unit=unit, ax=ax)


def _motion_of(window: Envelopes) -> Trajectory:
    """Return the motion of a scene with one exciter that has the averaged values, with all angles from the start of the window.

    The angle of the rotor has an unknown constant. It has no effect on the regime, because the averaged equations do not apply
    to rotors that have loads and an imbalance.
    """

    def angle(rate: Array) -> Array:
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum((rate[1:] + rate[:-1]) / 2.0 * jnp.diff(window.time))])

    mean, rotors = angle(window.omega), window.rotor_speeds
    turn = jnp.exp(1j * mean)[:, None]
    state = State(
        displacement=(window.displacement * turn).real,
        velocity=(window.velocity * turn).real,
        angle=(mean[:, None] + window.phase,),
        rate=(window.load_speed,),
    )
    return Trajectory(window.time, state, window.foundation_force, tuple(map(angle, rotors)), rotors)


def _torque_of(exciter: Exciter, time: Array, speed: Array, load_speed: Array) -> Array:
    """Return the torque of a drive, N m, in its direction, over the times (nt,)."""
    n, rates, loads = exciter.direction * speed, exciter.direction * load_speed, exciter.loads
    if isinstance(exciter.drive, Motor):
        return jax.vmap(exciter.drive.torque_at)(time, n)
    if loads is None or has_term(exciter.effects, ContactFriction) or not isinstance(loads, CircularLoads):
        return jnp.full_like(n, jnp.nan)
    return jnp.sum(loads.drag * loads.radius**2 * (n[:, None] - rates), axis=1)


def plot_histories(run: Envelope, *, resonances: Sequence[float] = (), unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
    """Plot an averaged run, with natural frequencies `resonances`, rad/s, as lines in the panel of the speeds."""
    from jaxvib.draw.motion.histories import amplitude_histories  # slow import

    stored, structure = run.window if run.trajectory is None else run.trajectory, run.scene.machine.structure()
    is_load = np.array([e.loads is not None for e in run.scene.exciters])[mass_owners(run.scene)]
    return amplitude_histories(
        np.asarray(stored.time),
        np.asarray(stored.amplitude),
        np.asarray(stored.load_speed)[:, is_load],
        np.asarray(stored.foundation_force),
        np.stack([np.asarray(speed) for speed in stored.rotor_speeds], axis=1),
        names=structure.coordinates,
        units=structure.units,
        directions=structure.foundation_directions,
        resonances=resonances,
        unit=unit,
        ax=ax,
    )
