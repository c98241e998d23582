"""Run-ups of two masses with an unbalance on a nonlinear support, integrated by SciPy between contacts, as records."""

import functools

import numpy as np
from run_ups_by_scipy import TRUTH as MACHINE
from run_ups_by_scipy import ramp, record
from run_ups_by_scipy import scene_of as linear_scene_of
from scipy.integrate import solve_ivp

import jaxvib as jv
from repeated_records.linearized import estimator, used_samples

STOP = {"effects.stop[0].stiffness": 3e5, "effects.stop[0].gap": 1e-3, "effects.stop[0].damping": 100.0}
"""Stop on both sides of the second mass. Both resonances press against it."""

CUBIC = {"effects.cubic_support[0].stiffness": 2e9}
"""Cubic support under the second mass."""

FRICTION = {"effects.friction_support[0].force": 20.0, "effects.friction_support[0].width": 0.01}
"""Dry friction under the second mass, of which the width is known."""

TIMES = 0.016 * np.arange(1000)


def stop_switch(x, v, side, stiffness, gap, damping):
    """Return the smaller of penetration and force of a stop; the stop presses if it is positive."""
    depth = side * x - gap
    return min(depth, stiffness * depth + damping * side * v)


def motion(numbers, first=(0.0,) * 4, phase=0.4, times=TIMES, turning=ramp):
    """Return the accelerations (n, 2) of both masses of a run-up from the `first` state (x1, x2, v1, v2).

    Each change of a contact ends an integration, and the next one begins there.
    """
    numbers = dict(numbers)
    stop = tuple(numbers[name] for name in STOP) if next(iter(STOP)) in numbers else None
    cubic = numbers.get(next(iter(CUBIC)), 0.0)
    friction, width = (numbers.get(name, default) for name, default in zip(FRICTION, (0.0, 1.0), strict=True))
    m1, m2, k1, k2, c1, c2, k, c, s = (numbers[name] for name in MACHINE)

    def rates(t, y, side):
        x1, x2, v1, v2 = y
        theta, speed, change = turning(t)
        link = k * (x1 - x2) + c * (v1 - v2)
        force = (
            s * (speed**2 * np.sin(theta + phase) - change * np.cos(theta + phase)) - k2 * x2 - c2 * v2 - cubic * x2**3 + link
        ) - friction * np.tanh(v2 / width)
        if side:
            force -= side * (stop[0] * (side * x2 - stop[1]) + stop[2] * side * v2)
        return np.array([v1, v2, (-k1 * x1 - c1 * v1 - link) / m1, force / m2])

    def switch(side):
        return lambda t, y, _: stop_switch(y[1], y[3], side, *stop)

    t, y, side, found = times[0], np.array(first, float), 0, []
    if stop:
        side = next((each for each in (-1, 1) if stop_switch(y[1], y[3], each, *stop) > 0.0), 0)
    while t < times[-1]:
        events = [] if stop is None else [switch(side)] if side else [switch(1), switch(-1)]
        for event in events:
            event.terminal, event.direction = True, -1.0 if side else 1.0
        run = solve_ivp(
            rates, (t, times[-1]), y, "DOP853", args=(side,), events=events, dense_output=True, rtol=1e-10, atol=1e-13,
            max_step=0.02,
        )  # fmt: skip
        inside = times[(times >= t) & ((times < run.t[-1]) | (run.status == 0))]
        found += [rates(at, run.sol(at), side)[2:] for at in inside]
        if run.status == 1:
            side = 0 if side else (1 if len(run.t_events[0]) else -1)
        t, y = run.t[-1], run.y[:, -1]
    return np.array(found)


def estimator_of_supports(kind, names, times=TIMES):
    """Return the `estimator` of the relative errors of `names`; states, offsets and phase are free.

    The derivatives of the motion are differences of those by SciPy.
    """
    step, numbers, columns = 1e-4, truth(kind), []
    for name in names:
        high, low = (motion(numbers | {name: numbers[name] * (1.0 + sign * step)}, times=times) for sign in (1.0, -1.0))
        columns.append((high - low) / (2.0 * step))
    for unit in 1e-3 * np.eye(4):
        high, low = (motion(numbers, sign * step * unit, times=times) for sign in (1.0, -1.0))
        columns.append((high - low) / (2.0 * step))
    high, low = (motion(numbers, phase=0.4 + sign * step, times=times) for sign in (1.0, -1.0))
    columns += [(high - low) / (2.0 * step), *np.repeat(np.eye(2)[:, None], times.size, axis=1)]
    return estimator(np.stack(columns, axis=-1), used_samples(times, ramp), len(names))


@functools.cache
def clean_motion(kind):
    """Return the accelerations (n, 2) without noise."""
    return motion(truth(kind))


def truth(kind):
    """Return the numbers of a `kind` of support, "stop", "cubic" or "friction"."""
    return MACHINE | {"stop": STOP, "cubic": CUBIC, "friction": FRICTION}[kind]


def scene_of(numbers):
    """Return the scene with these numbers."""
    values = [numbers[name] for name in (*STOP, *CUBIC, *FRICTION) if name in numbers]
    effect = {3: jv.Stop, 1: jv.CubicSupport, 2: jv.FrictionSupport}[len(values)](*values, platform=2)
    scene = linear_scene_of(numbers)
    return jv.Scene(scene.machine, exciters=scene.exciters, effects=effect)


def support_record(kind, noise, rng, times=TIMES, clean=None, **options):
    """Return a record of both accelerometers and the tachometer; `clean` (n, 2): accelerations in place of those of `kind`."""
    return record(times, clean_motion(kind) if clean is None else clean, noise, rng, **options)
