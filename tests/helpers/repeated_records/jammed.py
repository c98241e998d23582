"""Two masses with an unbalance and two balls that are jammed at the second resonance, integrated by SciPy, as records."""

import functools

import numpy as np
from run_ups_by_scipy import TRUTH as MACHINE
from run_ups_by_scipy import record
from run_ups_by_scipy import scene_of as scene_with
from scipy.integrate import solve_ivp

import jaxvib as jv
from repeated_records.linearized import estimator, used_samples

TRUTH = MACHINE | {"loads.mass": 0.8, "loads.drag": 1.5}
"""Numbers of the machine, and of each of two balls on a track of 0.12 m."""

RADIUS, PHASE = 0.12, 0.4
TIMES = 0.016 * np.arange(1000)
STATES = 6
"""Number of states: displacements and velocities of both masses, angle and speed of the balls, which are together."""


def turning(t):
    """Return angle, speed and acceleration of a rotor that turns faster than the second resonance, 64 rad/s."""
    return 90.0 * t + t**2, 90.0 + 2.0 * t, 2.0


def _rates(t, y, numbers, phase, lever=0.0, air=0.0):
    """Return the rates of states (6, cases); for `lever` and `air` see `accelerations`."""
    m1, m2, k1, k2, c1, c2, k, c, s, m, drag = np.array([list(each.values()) for each in numbers]).T
    x1, x2, v1, v2, angle, rate = y
    theta, speed, change = turning(t)
    inertia, moment = 1.4 * m * RADIUS**2, m * RADIUS
    link, pull = k * (x1 - x2) + c * (v1 - v2), drag * RADIUS**2 * (speed - rate)
    pull = pull + lever * moment * rate**2 - air * np.abs(rate) * rate  # without the part of the normal force by a2
    coupling = moment * np.cos(angle) + lever * m * np.sin(angle)
    # (m2 + 2 m) a2 + 2 moment cos turn = force,  inertia turn + coupling a2 = pull
    force = s * (speed**2 * np.sin(theta + phase) - change * np.cos(theta + phase)) - k2 * x2 - c2 * v2 + link
    force = force + 2.0 * moment * (rate**2 * np.sin(angle) - pull / inertia * np.cos(angle))
    a2 = force / (m2 + 2.0 * m - 2.0 * moment * np.cos(angle) * coupling / inertia)
    return np.stack([v1, v2, (-k1 * x1 - c1 * v1 - link) / m1, a2, rate, (pull - coupling * a2) / inertia])


def first_state(impact=0.1):
    """Return the state at the start of the record: a steady vibration of both masses by the balls, and an impact on both, which
    changes their velocities by `impact`."""
    m1, m2, k1, k2, c1, c2, k, c, _, m, _ = TRUTH.values()
    w, angle = 62.1, 0.3
    mass, stiffness, damping = np.diag([m1, m2 + 2.0 * m]), [[k1 + k, -k], [-k, k2 + k]], [[c1 + c, -c], [-c, c2 + c]]
    steady = np.linalg.solve(stiffness - w**2 * mass + 1j * w * np.array(damping), [0.0, 2.0 * m * RADIUS * w**2])
    steady = steady * np.exp(1j * angle)
    return np.array([*steady.imag, *(w * steady.real + impact), angle, w])


def accelerations(numbers, starts, phases, lever=0.0, air=0.0):
    """Return the accelerations (cases, n, 2) of both masses for a list of numbers, first states and phases of the unbalance.

    **Arguments**: `lever` of rolling friction of each ball, m: its torque is the lever times the normal force; `air`: drag of
    the air on each ball, N m s^2: its torque is -air times the squared speed of the ball.
    """
    size, phases = len(numbers), np.array(phases)

    def rates(t, y):
        return _rates(t, y.reshape(STATES, size), numbers, phases, lever, air).ravel()

    first = np.stack(starts, axis=1).ravel()
    run = solve_ivp(rates, (TIMES[0], TIMES[-1]), first, "DOP853", t_eval=TIMES, rtol=1e-10, atol=1e-12)
    slopes = np.stack([rates(t, y) for t, y in zip(run.t, run.y.T, strict=True)], axis=1)
    return np.moveaxis(slopes.reshape(STATES, size, -1)[2:4], 0, -1)


@functools.cache
def clean(impact=0.1, added=0.0, drag=1.5, lever=0.0, air=0.0):
    """Return the accelerations (n, 2) without noise; `added`: mass on the first platform, kg; `drag` of the balls; for `lever`
    and `air` see `accelerations`."""
    numbers = TRUTH | {"machine.mass[0]": TRUTH["machine.mass[0]"] + added, "loads.drag": drag}
    return accelerations([numbers], [first_state(impact)], [PHASE], lever, air)[0]


def _slopes(names, impact):
    """Return the derivatives (n, 2, unknowns) of the readings with respect to the logarithms of `names`, the states at the
    start, the phase of the unbalance and the offsets."""
    step, numbers, starts, phases = 1e-5, [], [], []
    for sign in (1.0, -1.0):
        for name in names:
            numbers.append(TRUTH | {name: TRUTH[name] * (1.0 + sign * step)})
            starts.append(first_state(impact))
            phases.append(PHASE)
        for k in range(STATES):
            numbers.append(TRUTH)
            starts.append(first_state(impact) + sign * step * np.eye(STATES)[k])
            phases.append(PHASE)
        numbers.append(TRUTH)
        starts.append(first_state(impact))
        phases.append(PHASE + sign * step)
    high, low = np.split(accelerations(numbers, starts, phases), 2)
    columns = [*((high - low) / (2.0 * step)), *np.repeat(np.eye(2)[:, None], TIMES.size, axis=1)]
    return np.stack(columns, axis=-1)


def estimator_of_loads(names, impact=0.1):
    """Return the `estimator` of the relative errors of `names`; states, offsets and phase are free."""
    return estimator(_slopes(names, impact), used_samples(TIMES, turning), len(names))


def bound(names, noise, impact=0.1, color=0.0, outliers=0.0):
    """Return the Cramer-Rao bound of the relative standard errors of `names`; states, offsets and phase are free.

    The noise is that of `record`, and the places of the outliers are known.
    """
    slopes = _slopes(names, impact)[used_samples(TIMES, turning)]
    slopes[1:] -= color * slopes[:-1]
    slopes[0] *= np.sqrt(1.0 - color**2)
    slopes = slopes.reshape(-1, slopes.shape[2]) * np.sqrt((1.0 - outliers) / (1.0 - color**2)) / noise
    scale = np.linalg.norm(slopes, axis=0)
    covariance = np.linalg.inv((slopes / scale).T @ (slopes / scale)) / np.outer(scale, scale)
    return np.sqrt(np.diagonal(covariance)[: len(names)])


def scene_of(numbers):
    """Return the scene with numbers as `TRUTH`, under a motor whose speed is not known."""
    return scene_with(numbers, jv.balls(count=2, mass=numbers["loads.mass"], radius=RADIUS, drag=numbers["loads.drag"]))


def jammed_record(noise, rng, impact=0.1, added=0.0, drag=1.5, lever=0.0, air=0.0, **options):
    """Return a record of both accelerometers and the tachometer; for `added`, `drag`, `lever` and `air` see `clean`."""
    return record(TIMES, clean(impact, added, drag, lever, air), noise, rng, turning=turning, **options)
