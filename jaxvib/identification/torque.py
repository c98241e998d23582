"""Torque balance of a motor whose rotor turns by a recorded angle.

The vibration a(t) at the rotor follows from the recorded angle and the parameters of the machine. It brakes the rotor, and the
predicted speed w and angle obey

    I w' = T(w) + c(t),      c = -Re[conj(i p) (a + i g)],      angle' = w

I is the moment of inertia of the rotor, T the torque of the motor, and c that of vibration and gravity. p(t), kg m, is the
unbalance times the unit vector in its direction, a the acceleration of the rotor's axis (horizontal + i up), both at the
recorded angle, and g gravity. The first angle and speed are unknowns, and the predicted angle is compared with the pulses (or
with samples of an angle or a speed). This comparison has three advantages:

- It needs no derivative of the record
- The errors of the pulses are independent except for a common delay
- The torque of the motor depends on the speed, which keeps the prediction near the record

The parameters of the motor, those of the machine and the motion at the first sample are fitted together, because the decrease
of the speed at a resonance is a measure of the torque of the vibration. T neglects the rotation of a housing that turns with
the machine.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.identification.angle import RecordedDrive, RotorAngle, RotorSamples, recorded_drive
from jaxvib.identification.directions import eliminate
from jaxvib.identification.fit import (
    Equations,
    Fitted,
    descend,
    differences_of,
    fit_from,
    known_cost,
    limited_step,
    linear_indices,
    positive_indices,
    prior_equations,
    run_equations,
    unknown_count,
)
from jaxvib.identification.problem import Problem, is_of_drive
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.response import Samples, Unknowns, model_readings
from jaxvib.machine.effects.base import total_gravity
from jaxvib.machine.scene import Scene
from jaxvib.numerics.noise import Noise, noise_of
from jaxvib.runtime.programs import cached

_AXES = tuple(
    Channel(f"acceleration of the rotor, {direction}", "acceleration", direction=direction, gain_error=0.0)
    for direction in ("across", "up")
)

MAX_MISFIT = 2.0
"""Deviation of a rotor from its torque balance, relative to that from a smooth curve, above which the balance does not describe
the rotor."""

_FINE_ANGLE = 0.2
"""Largest angle, rad, between the times at which the torque of the vibration is computed."""

_ANGLE_ACCURACY = 1e-5
"""Error of the predicted angle, rad. The noise of the rotor's angle in the fit is at least this error, even if the pulses
scatter less."""

_JOINT_PASSES = 2
"""Number of fits of vibrations and rotor together: with the scatter of the pulses, then with the noise of the first fit.
Before the first fit the deviations are mostly a drift of the prediction. A noise filter computed from them would remove this
drift, and with it the information on the motor."""


@cached
def _deviations(
    unknowns: Unknowns,
    samples: Samples,
    rotor: RotorSamples,
    scene: Scene,
    x: Array,
    motion_unknowns: Array,
    rotor_unknowns: Array,
) -> tuple[Array, Array]:
    """Return the deviations (n,) of the predicted angle or speed of the rotor from its samples, in units of their spread, and
    the derivatives of these deviations.

    **Arguments**: `samples` of the accelerations of the rotor; `x`: see `Unknowns`; `motion_unknowns`: state at the first
    sample and components of the unbalance; `rotor_unknowns`: first angle, first speed, common delay of the pulses in standard
    errors, offsets of the marks.
    """
    nonlinear_count = x.shape[0] - unknowns.errors
    delay_error = rotor.scatter if rotor.kind == "pulses" else 0.0

    def deviations(free: Array) -> Array:
        values, linear, first = jnp.split(free, [nonlinear_count, nonlinear_count + motion_unknowns.shape[0]])
        now = x.at[:nonlinear_count].set(values)
        at, angle, speed, _ = _predicted(unknowns, samples, scene, now, linear, first[:2])
        width = at[1] - at[0]
        time = rotor.time - delay_error * first[2]
        k = jnp.clip(jnp.floor((time - at[0]) / width).astype(int), 0, at.size - 2)
        u = (time - at[k]) / width
        rise, begin, end = angle[k + 1] - angle[k], speed[k] * width, speed[k + 1] * width
        quadratic, cubic = 3.0 * rise - 2.0 * begin - end, begin + end - 2.0 * rise
        if rotor.kind == "speed":
            predicted = (begin + u * (2.0 * quadratic + 3.0 * u * cubic)) / width
        else:
            offsets = jnp.concatenate([-jnp.sum(first[3:], keepdims=True), first[3:]])
            predicted = angle[k] + u * (begin + u * (quadratic + u * cubic)) + offsets[rotor.marks]
        return (predicted - rotor.value) / rotor.spread

    free = jnp.concatenate([x[:nonlinear_count], motion_unknowns, rotor_unknowns])
    return deviations(free), jax.jacfwd(deviations)(free)


@cached
def _predicted(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, motion_unknowns: Array, first: Array
) -> tuple[Array, Array, Array, Array]:
    """Return times (K,), s, and the predicted angles, speeds and accelerations (K,) of the rotor.

    **Arguments**: `first` (2,): angle and speed at the first sample; for the others see `_deviations`.
    """
    accelerations = model_readings(unknowns, samples, scene, x, jnp.concatenate([motion_unknowns, jnp.zeros(2)]))
    exciter = samples.scene(unknowns.scene(scene, x)).exciters[0]
    times = samples.begin + samples.step * jnp.arange(accelerations.shape[0])
    rotor_angle = jax.vmap(lambda t: samples.drives[0].rotor_angle(t, None))(jnp.minimum(times, samples.end))
    turn = 0.0 if samples.turn is None else x[unknowns.first.shape[0] + len(unknowns.gains) + samples.turn]
    quarter_turn = 1j * exciter.direction
    unbalance = (motion_unknowns[-2] + 1j * motion_unknowns[-1]) * jnp.exp(1j * turn + quarter_turn * rotor_angle)
    gravity = total_gravity((*scene.effects, *exciter.effects)).get(1, 0.0)
    braking = jnp.real(jnp.conj(quarter_turn * unbalance) * (accelerations[:, 0] + 1j * (accelerations[:, 1] + gravity)))

    def rates(t: Array, speed: Array, brake: Array) -> Array:
        motor = exciter.drive.torque_and_inertia(t, speed)
        assert motor is not None
        return (motor[0] - brake) / motor[1]

    width, jumps = 2.0 * samples.step, exciter.drive.jump_ts()

    def step(state: tuple[Array, Array], at: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (angle, speed), (t, brakes) = state, at
        cuts = [t, *jnp.sort(jnp.clip(jnp.stack(jumps), t, t + width)), t + width] if jumps else [t, t + width]

        def acceleration(at: Array, speed: Array) -> Array:
            u = (at - t) / width
            return rates(at, speed, jnp.stack([(1.0 - u) * (1.0 - 2.0 * u), 4.0 * u * (1.0 - u), u * (2.0 * u - 1.0)]) @ brakes)

        for begin, end in itertools.pairwise(cuts):
            state = _runge_kutta(acceleration, begin, end, *state)
        return state, (angle, speed, rates(t, speed, brakes[0]))

    triples = jnp.stack([braking[:-2:2], braking[1:-1:2], braking[2::2]], axis=1)
    _, motion = jax.lax.scan(step, (first[0], first[1]), (times[:-2:2], triples))
    return times[:-2:2], *motion


def _runge_kutta(
    acceleration: Callable[[Array, Array], Array], begin: Array, end: Array, angle: Array, speed: Array
) -> tuple[Array, Array]:
    """Return angle and speed at the time `end`. If the torque jumps at `end`, the torque before the jump is used."""
    h = end - begin
    k1 = acceleration(begin, speed)
    k2 = acceleration(begin + 0.5 * h, speed + 0.5 * h * k1)
    k3 = acceleration(begin + 0.5 * h, speed + 0.5 * h * k2)
    k4 = acceleration(end - 1e-6 * h, speed + h * k3)
    return angle + h * speed + h**2 / 6.0 * (k1 + k2 + k3), speed + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


class _Run(NamedTuple):
    """Run of a fit of vibrations and rotor.

    **Attributes**: `samples` with smaller steps; `rotor`: samples of the rotor; `indices` (f,) of the run's unknowns
    among all unknowns; `rotor_count`: number of unknowns of this run's rotor (first angle, first speed, delay, offsets of all
    marks but the first); `noise` of the rotor's samples.
    """

    samples: Samples
    rotor: RotorSamples
    indices: np.ndarray
    rotor_count: int
    noise: Noise


class _Trial(NamedTuple):
    """Values `y` of all unknowns (x, linear unknowns, unknowns of the rotors), with their cost and `equations`."""

    y: np.ndarray
    cost: float
    equations: Equations


def fit_with_torques(problem: Problem, starts: Sequence[np.ndarray]) -> Fitted:
    """Fit a problem from each of the `starts` (values of x), and return the fit with the lowest cost.

    If a parameter of a motor is unknown, the vibrations and the rotor speed are fitted together. The fit is then repeated
    with the predicted angle of the rotor, which contains its ripple within each turn.
    """
    fitted = fit_from(problem, starts)
    motor = [k for k, number in enumerate(problem.unknowns.numbers) if is_of_drive(number)]
    if not motor or not fitted.converged:
        return fitted
    fitted, drives = _with_torque_balance(fitted, motor)
    if not fitted.converged or max(fitted.misfits) > MAX_MISFIT:
        return fitted
    rotors = tuple((angle._replace(drive=drive),) for (angle,), drive in zip(problem.rotors, drives, strict=True))
    pairs = zip(problem.runs, rotors, strict=True)
    runs = tuple(dataclasses.replace(samples, drives=(angle.without_errors(),)) for samples, (angle,) in pairs)
    again = fit_from(problem._replace(rotors=rotors, runs=runs), [fitted.x[: problem.unknowns.count]])
    return _with_torque_balance(again, motor)[0] if again.converged else fitted


def _with_torque_balance(fitted: Fitted, motor: list[int]) -> tuple[Fitted, list[RecordedDrive]]:
    """Return the fit of vibrations and rotors together, and the drive that follows the predicted angle in each run.

    **Arguments**: `fitted` to the vibrations alone; indices of the parameters of the `motor` in x.
    """
    problem, p, size = fitted.problem, fitted.x.size, fitted.x.size + fitted.linear.size
    runs, of_rotors = _runs(fitted)
    y, all_indices = np.concatenate([fitted.x, fitted.linear, of_rotors]), np.arange(size + of_rotors.size)
    y = _minimum(problem, runs, y, np.concatenate([motor, all_indices[size:]]).astype(int))[0].y
    converged, information = False, np.zeros((size, size))
    for _ in range(_JOINT_PASSES):
        trial, converged = _minimum(problem, runs, y, all_indices)
        y, information = trial.y, eliminate(trial.equations[0], all_indices[:size])
        runs = [run._replace(noise=_noise(run, _deviations_of(problem, run, y)[0])) for run in runs]
    x, linear = y[:p], y[p:size]
    fitted = fitted._replace(
        x=x,
        linear=linear,
        information=information,
        prior=prior_equations(problem, x, linear)[0],
        differences=tuple(differences_of(problem, x, linear)),
        converged=converged,
        misfits=tuple(float(np.std(_deviations_of(problem, run, y)[0]) / run.rotor.scatter) for run in runs),
    )
    return fitted, [_predicted_drive(problem, run, rotors[0], y) for run, rotors in zip(runs, problem.rotors, strict=True)]


def _runs(fitted: Fitted) -> tuple[list[_Run], np.ndarray]:
    """Return the runs of a fit, and first values of the unknowns of the rotors."""
    problem, runs, first_values = fitted.problem, [], []
    nonlinear_count, size = fitted.x.size - problem.unknowns.errors, fitted.x.size + fitted.linear.size
    for samples, (angle,), of_run in zip(problem.runs, problem.rotors, linear_indices(problem), strict=True):
        drive, rotor = samples.drives[0], angle.samples
        assert isinstance(drive, RecordedDrive) and rotor is not None
        factor = max(1, math.ceil(float(samples.step) * float(drive.speed) / _FINE_ANGLE))
        segments, n, _ = samples.readings.shape
        empty = jnp.zeros((segments * factor, n, 2))
        fine = dataclasses.replace(
            samples, drives=(angle.without_errors(),), readings=empty, weights=empty, taps=jnp.ones((1, 2)),
            step=samples.step / factor, channels=_AXES, errors=(0, 0),
        )  # fmt: skip
        used = (rotor.time >= samples.begin) & (rotor.time <= samples.end)
        scatter = jnp.asarray(max(rotor.scatter, _ANGLE_ACCURACY / float(np.max(rotor.spread))))
        sampled = {name: jnp.asarray(getattr(rotor, name)[used]) for name in ("time", "value", "marks", "spread")}
        rotor = rotor._replace(**sampled, scatter=scatter)
        of_rotor = [drive.angle_at(samples.begin), drive.speed_at(samples.begin), *np.zeros(1 + int(np.max(rotor.marks)))]
        states = 2 * len(problem.scene.machine.structure().coordinates)
        linear = np.concatenate([of_run[:states], of_run[-2 - len(samples.channels) : -len(samples.channels)]])
        indices = np.concatenate(
            [np.arange(nonlinear_count), fitted.x.size + linear, size + len(first_values) + np.arange(len(of_rotor))]
        )
        runs.append(_Run(fine, rotor, indices, len(of_rotor), Noise(np.ones(1), float(scatter))))
        first_values += map(float, of_rotor)
    return runs, np.array(first_values)


def _parts(problem: Problem, run: _Run, y: np.ndarray) -> list[Array]:
    """Return x, the state at the first sample with the unbalance, and the unknowns of the run's rotor."""
    x, linear = y[: problem.unknowns.count], y[run.indices[problem.unknowns.count - problem.unknowns.errors :]]
    return [jnp.asarray(each) for each in (x, linear[: -run.rotor_count], linear[-run.rotor_count :])]


def _deviations_of(problem: Problem, run: _Run, y: np.ndarray) -> list[np.ndarray]:
    """Return the deviations (n,) of a run and their derivatives (n, f)."""
    found = _deviations(problem.unknowns, run.samples, run.rotor, problem.scene, *_parts(problem, run, y))
    return list(map(np.asarray, found))


def _predicted_drive(problem: Problem, run: _Run, rotor: RotorAngle, y: np.ndarray) -> RecordedDrive:
    """Return the drive that follows the predicted angle of a run, with the errors of the recorded angle."""
    x, motion_unknowns, of_rotor = _parts(problem, run, y)
    time, *found = map(np.asarray, _predicted(problem.unknowns, run.samples, problem.scene, x, motion_unknowns, of_rotor[:2]))
    return recorded_drive(time, [np.column_stack([each, rotor.spline(time, k)[:, 1:]]) for k, each in enumerate(found)])


def _noise(run: _Run, deviations: np.ndarray) -> Noise:
    """Return the noise of the samples of a rotor, at least the accuracy of the prediction."""
    noise = noise_of(deviations)
    return noise._replace(deviation=max(noise.deviation, _ANGLE_ACCURACY / float(np.max(run.rotor.spread))))


def _minimum(problem: Problem, runs: list[_Run], y: np.ndarray, free: np.ndarray) -> tuple[_Trial, bool]:
    """Return the minimum near `y` over the unknowns with the indices `free`, and True if it was reached."""

    def stepped(trial: _Trial, step: np.ndarray) -> _Trial:
        whole = np.zeros(y.size)
        whole[free] = step
        return _trial(problem, runs, trial.y + limited_step(problem, whole), free)

    positive = np.flatnonzero(np.isin(free, positive_indices(problem)))
    best, _, converged = descend(_trial(problem, runs, y, free), lambda trial: trial.equations, stepped, free.size, positive)
    return best, converged


def _trial(problem: Problem, runs: list[_Run], y: np.ndarray, free: np.ndarray) -> _Trial:
    """Return the cost of vibrations and rotors, and the equations of the unknowns `free`."""
    p, size = problem.unknowns.count, unknown_count(problem)
    x, linear = y[:p], y[p:size]
    total, prior = np.zeros((y.size + 1, y.size + 1)), np.zeros((y.size, y.size))
    indices = np.append(np.arange(size), y.size)
    total[np.ix_(indices, indices)] = np.sum(run_equations(problem, x, linear), axis=0)
    gradient = np.zeros(y.size)
    prior[:size, :size], gradient[:size] = prior_equations(problem, x, linear)
    cost = known_cost(problem, x, linear)
    for run in runs:
        deviations, slopes = _deviations_of(problem, run, y)
        taps, indices = run.noise.taps, np.append(run.indices, y.size)
        both = np.concatenate([slopes, -deviations[:, None]], axis=1) / run.noise.deviation
        white = np.stack([np.convolve(each, taps, mode="valid") for each in both.T], axis=1)
        total[np.ix_(indices, indices)] += white.T @ white
        # The common delay is known as 0 with the standard error 1.
        delay_indices = np.array([run.indices[2 - run.rotor_count], y.size])
        row = np.array([1.0, -y[delay_indices[0]]])
        total[np.ix_(delay_indices, delay_indices)] += np.outer(row, row)
    block = np.ix_(free, free)
    equations = total[:-1, :-1][block], prior[block], (total[:-1, -1] + gradient)[free]
    return _Trial(y, total[-1, -1] + cost, equations)
