"""Run-up of motors from rest: resonances that catch exciters, peaks on the way, and the weakest motors that still pass."""

from __future__ import annotations

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit, quantity_text, speed_text
from jaxvib.equations.linear import natural_frequencies
from jaxvib.equations.model import assemble
from jaxvib.errors import InputError
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.drives.drive import Motor, MotorWrapper
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import lifting_torques, start_notes, validate_scene, weight_accelerations
from jaxvib.motion.analysis.caught import caught_rotors, caught_text
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.envelope.result import Envelope, plot_histories
from jaxvib.motion.start import initial_state
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.results.status import member, status_name
from jaxvib.steady.outcome import REFUSED
from jaxvib.units import Number, number

_SAMPLES = 4096
"""Number of stored times of a run-up, from which peaks are read."""

_START_ANGLES = 8
"""Number of initial angles, and of runs, for each motor of `_varied_motors`."""

_LIFTING_SHARE = 0.02
"""Relative difference below which the least torque counts as equal to the torque that lifts an unbalance; the least torque
has an error of 1 %."""

_MIN_SHOWN_VARIATION = 0.01
"""Smallest variation of the speed by the weight that the text of a run-up states."""

_LARGEST_FACTOR, _BISECTIONS = 64.0, 10
"""Largest factor of the torques in the search for the weakest motors, and largest number of its bisections."""


class MotorRunUpStatus(eqx.Enumeration):
    """Outcomes of a run-up. The value of each member is the message shown to the user."""

    passed = "all exciters pass all resonances below their working speeds"
    caught = "a resonance catches an exciter"
    not_turning = "an exciter does not turn: its motor cannot lift its unbalance against gravity, or turns it too slowly"
    not_finished = "the averaged run did not reach its end"
    refused = REFUSED


class MotorRunUp(Result):
    """Run-up of motors from rest.

    Returned by `run_up`.

    **Attributes**

    - `status`: a `MotorRunUpStatus`
    - `resonances` (nd,), rad/s: natural frequencies, ascending
    - `speed` (exciter,), rad/s: mean speed at the end, in the direction of rotation
    - `caught_at` (exciter,): number, from 1, of the lowest resonance that the exciter does not pass; 0 if it passes all
      resonances below 0.95 of the no-load speed of its motor
    - `peak_amplitude` (nd,), m, zero to peak, and `peak_force`, N: largest amplitudes and largest magnitude of the foundation
      force on the way, of all initial angles between the exciters that were computed
    - `least_torque`: the smallest factor by which the torques of all motors can be multiplied such that all exciters still pass
      their resonances; 1/64 if this factor is still sufficient; NaN if it was not requested, or if even motors 64 times as
      strong do not pass
    - `speed_variation`: share by which the weight of the unbalances changes the speed within a turn; 0 without gravity
    - `run`: the averaged motion, an `Envelope`
    - `scene`
    """

    status: MotorRunUpStatus
    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    speed: Array = eqx.field(metadata=in_unit("rad/s", "exciter"))
    caught_at: Array = eqx.field(metadata=in_unit("", "exciter"))
    peak_amplitude: Array = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    peak_force: Array = eqx.field(metadata=in_unit("N"))
    least_torque: Array = eqx.field(metadata=in_unit(""))
    run: Envelope = eqx.field(metadata=part(prefix="run_"))
    scene: Scene = eqx.field(metadata=SCENE)

    @property
    def speed_variation(self) -> float:
        """Share by which the weight of the unbalances, which averaging omits, raises and lowers the speed within a turn.

        It is the largest S g / (I w^2) of all motors, with the unbalance S, the inertia I and the lowest natural frequency w; 0
        without gravity. The peaks can change by more, see `run_up`.
        """
        resonances = np.asarray(self.resonances)
        lowest = np.min(resonances[resonances > 0.0], initial=np.inf)
        return float(max(weight_accelerations(self.scene).values(), default=0.0) / lowest**2)

    def summary(self) -> str:
        """Return the outcome as text: a line for each exciter, the peaks and the weakest motors."""
        lines = [self.message, *(f"  {note}" for note in start_notes(self.scene))]
        if self.status_name == "not_turning":
            lines.append("without gravity (exciters that are turning already):")
        for k, (speed, caught) in enumerate(zip(np.asarray(self.speed), np.asarray(self.caught_at).tolist(), strict=True), 1):
            at = f", {caught_text(caught, np.asarray(self.resonances))}" if caught else ""
            lines.append(f"  exciter {k}: {speed_text(speed)}{at}")
        lines += [f"  {stay.summary()}" for stay in self.run.stays]
        structure = self.scene.machine.structure()
        named = zip(structure.coordinates, self.peak_amplitude, structure.units, strict=True)
        peaks = ", ".join(f"{name} {quantity_text(a, unit, 4)}" for name, a, unit in named)
        of = " (largest of several initial angles; the figure shows one run)" if _varied_motors(self.scene) else ""
        force = quantity_text(self.peak_force, "N", 4)
        lines += [f"  peaks on the way{of}:", f"    {peaks}; magnitude of the foundation force {force}"]
        weight = self.speed_variation > _MIN_SHOWN_VARIATION
        if weight:
            share = f"by about {100.0 * self.speed_variation:.2g} % within a turn at the lowest resonance"
            lines.append(f"    averaging omits the weight of the unbalances, which changes speeds {share};")
            lines.append("    peaks can change by more: simulate from rest includes the weight")
        if np.isfinite(self.least_torque):
            lines.append(f"  all pass with torques of at least {float(self.least_torque):.3g} times those of the motors")
            omitted = " without the weight, which changes this factor" if weight else ""
            lines.append(f"  (by the averaged equations{omitted}; test weaker motors with simulate)")
            lifting = _lifting_factor(self.scene)
            if abs(float(self.least_torque) - lifting) < _LIFTING_SHARE * lifting:
                lines.append(f"  (with {lifting:.3g} times its torque a motor just lifts its unbalance)")
        return "\n".join(lines)

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot the histories of the run-up with the natural frequencies. **Arguments**: `unit` and `ax` as in `Run.plot`."""
        return plot_histories(self.run, resonances=self.resonances.tolist(), unit=unit, ax=ax)


def _lifting_factor(scene: Scene) -> float:
    """Return the factor of the torques of all motors with which each motor just lifts its unbalance; 0 without gravity."""
    return max((float(weight / start) for weight, start in filter(None, lifting_torques(scene))), default=0.0)


class _Scaled(MotorWrapper):
    """Motor whose torque is that of another motor multiplied by a factor."""

    motor: Motor
    factor: Array
    kind: str = eqx.field(static=True)

    def __init__(self, motor: Motor, factor: Array):
        self.motor, self.factor, self.kind = motor, factor, "scaled"

    def torque(self, speed: Array) -> Array:
        return self.factor * self.motor.torque(speed)

    def torque_at(self, t: Array, speed: Array, states: tuple[Array, ...] = ()) -> Array:
        return self.factor * self.motor.torque_at(t, speed, states)


@validated
def run_up(scene: Scene, until: Number, *, least: bool = False) -> MotorRunUp:
    """Compute the run-up of the motors of a scene from rest by averaged equations, and the resonances that catch exciters.

    An exciter has passed a natural frequency if its speed at the end is at least 5 % higher. An exciter is caught by the lowest
    natural frequency that it has not passed, if this frequency is below 0.95 of the no-load speed of its motor.

    **Arguments**

    - `scene` as for `envelope`, with at least one motor
    - `until`, s or text: end of the run; an exciter that has not passed by then is regarded as caught; typical: 5 to 60
    - `least`: True to search for `least_torque` between 1/64 and 64 times the torque, to 1 %, in up to 13 more runs. The search
      assumes that a motor that passes also passes with more torque

    The peaks of several exciters depend on the angles between them when they reach the resonance. The starting angles and the
    weight of the unbalances, which averaging omits, determine these angles. Peaks are therefore the largest ones of several
    runs from different initial angles: 8 runs for each motor after the first one, or for each motor if another exciter has an
    ideal drive. The peaks of a single run can be half as large. Compared with the full equations from the same angles without
    gravity, the peaks have errors of 2 % for a screen that passes its resonances within two turns.

    With gravity, the weight of an unbalance S acts on its rotor with the torque S g cos theta. The speed of the rotor therefore
    changes within each turn by a share of about S g / (I w^2) (I: inertia of the rotor, w: a natural frequency;
    `speed_variation`). This change excites the resonance w already at the speed w/2. When the rotor reaches w, a part of this
    vibration has not decayed yet. It raises or lowers the peak, depending on the initial angle. The change of the peak is about
    this share if the motor is much stronger than `least_torque`, and larger for weaker motors: from -27 % to +62 % for a screen
    with a variation of 18 % and a least torque of 0.95. From rest, this screen also passes with 0.8 times its torque. Use
    `simulate` from rest for peaks, and for motors near the least torque.

    **Returns** `MotorRunUp`. The averaged equations are accurate for light unbalances; near the boundary between passing a
    resonance and being caught use `simulate`. The torque of a motor with currents is its steady torque here. This changes
    neither the speed at which a resonance holds the motor nor the fold at which the resonance releases it. It can change the
    outcome of a run-up if the time constant of the currents (L/R of a DC motor) is longer than the decay time of the vibration:
    the motor may then pass a resonance that catches it in the averaged equations. Use `simulate` for such motors.

    **Raises** `InputError` for a scene without a motor, for a motor that is switched off before the end, and for the reasons of
    `envelope`. A run that fails has a status.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    >>> screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    >>> weak = jv.DCMotor(100.0, stall_torque=0.6, inertia=0.5)
    >>> found = jv.run_up(jv.Scene(screen, exciters=[jv.Exciter(drive=weak, unbalance=0.4)]), "90 s")
    >>> found.status_name, found.caught_at.tolist(), round(float(found.resonances[0]), 1), round(float(found.speed[0]))
    ('caught', [1], 14.1, 14)

    Source: I. I. Blekhman, Vibrational Mechanics, 2000; the criterion for being caught is derived here.
    """
    scene = validate_scene(scene)
    if all(exciter.drive.ideal for exciter in scene.exciters):
        raise InputError(
            "scene",
            "has no motor; a run-up needs a drive of limited power, for example InductionMotor(...); for loads use run_up_map",
        )
    end = number(until, "s", "until", low=0.0, open_low=True)
    _require_switched_on(scene, end)
    resonances = np.sort(np.asarray(natural_frequencies(scene)))
    run, *others = _runs(scene, end)
    speed, caught, status = _judgement(scene, run, resonances)
    amplitude, force = map(np.array, zip(*map(_peaks, (run, *others)), strict=True))
    factor = _least_torque(scene, end, resonances, passed=status == "passed") if least else np.nan
    return MotorRunUp(
        status=member(MotorRunUpStatus, status),
        resonances=jnp.asarray(resonances),
        speed=jnp.asarray(speed),
        caught_at=jnp.asarray(caught),
        peak_amplitude=jnp.asarray(np.fmax.reduce(amplitude)),
        peak_force=jnp.asarray(np.fmax.reduce(force)),
        least_torque=jnp.asarray(factor, resonances.dtype),
        run=run,
        scene=scene,
    )


def _require_switched_on(scene: Scene, end: Array) -> None:
    """**Raises** `InputError` for a motor that is switched off before the end of the run: its speed does not show
    whether a resonance catches it."""
    for k, exciter in enumerate(scene.exciters):
        if isinstance(off := exciter.drive, SwitchedOff) and float(off.at) < float(end):
            problem = f"switches the motor off at {float(off.at):g} s, before the end of the run-up at {float(end):g} s"
            advice = "give the motor itself for a run-up, or use simulate or envelope for a machine that stops"
            raise InputError(f"{scene.prefix_of(k)}drive", f"{problem}; {advice}")


def _runs(scene: Scene, end: Array) -> list[Envelope]:
    """Return the run from rest, and the runs with other initial angles of the motors of `_varied_motors`."""
    runs = [envelope(scene, end, samples=_SAMPLES, throw=False)]
    varied = _varied_motors(scene)
    rest, count = initial_state(scene), _START_ANGLES * len(varied)
    for k in range(1, count):
        angles = [jnp.asarray(2.0 * np.pi * k * (2 * j + 1) / count, end.dtype) for j in range(len(varied))]
        start = eqx.tree_at(lambda s: [cast(tuple, s.exciters[j].rotor)[0] for j in varied], rest, angles)
        runs.append(envelope(scene, end, start=start, samples=_SAMPLES, throw=False))
    return runs


def _varied_motors(scene: Scene) -> list[int]:
    """Return the numbers of the motors whose initial angles are varied. If all rotating masses belong to motors, the first
    motor is not varied, because only differences of the angles matter."""
    masses = [k for k, each in enumerate(scene.exciters) if each.unbalance is not None or each.loads is not None]
    motors = [k for k in masses if not scene.exciters[k].drive.ideal]
    return motors if len(motors) < len(masses) else motors[1:]


def _peaks(run: Envelope) -> tuple[np.ndarray, float]:
    """Return the largest amplitudes of a run, and the largest magnitude of the force on the foundation, N.

    The largest magnitude of the vector Re(F exp(i theta)) within a turn is sqrt((sum |F_k|^2 + |sum F_k^2|)/2).
    """
    trajectory, model = run.trajectory, assemble(run.scene)
    assert trajectory is not None
    each = model.carrier.foundation_force(trajectory.displacement.T, trajectory.velocity.T)
    force = np.asarray(model.known_force(each))
    square = (np.sum(np.abs(force) ** 2, axis=0) + np.abs(np.sum(force**2, axis=0))) / 2.0
    return np.max(np.asarray(trajectory.amplitude), axis=0), float(np.sqrt(np.max(square)))


def _judgement(scene: Scene, run: Envelope, resonances: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the speed of each exciter, the number of the resonance that catches it, and the name of the status."""
    directions = np.array([exciter.direction for exciter in scene.exciters])
    speed = directions * np.array([float(np.mean(np.asarray(n))) for n in run.window.rotor_speeds])
    caught = caught_rotors(scene, speed, resonances)
    name = status_name(run.status)
    if name == "not_turning":
        return speed, caught, "not_turning"
    if name not in ("done", "unstable", "would_separate"):
        return speed, caught, "not_finished"
    return speed, caught, "caught" if np.any(caught) else "passed"


def _least_torque(scene: Scene, end: Array, resonances: np.ndarray, *, passed: bool) -> float:
    """Return the smallest factor of all torques with which all exciters pass, by bisection of its logarithm."""
    motors = [k for k, exciter in enumerate(scene.exciters) if not exciter.drive.ideal]

    def passes(factor: float) -> bool:
        drives = [_Scaled(cast(Motor, scene.exciters[k].drive), jnp.asarray(factor, resonances.dtype)) for k in motors]
        scaled = eqx.tree_at(lambda s: [s.exciters[k].drive for k in motors], scene, drives)
        return _judgement(scaled, envelope(scaled, end, save="window", throw=False), resonances)[2] == "passed"

    step = 0.5 if passed else 2.0
    last, new = 1.0, step
    while passes(new) == passed:
        last, new = new, new * step
        if not 1.0 / _LARGEST_FACTOR <= new <= _LARGEST_FACTOR:
            return last if passed else np.nan
    low, high = min(last, new), max(last, new)
    for _ in range(_BISECTIONS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if passes(middle) else (middle, high)
        if high / low < 1.01:
            break
    return high
