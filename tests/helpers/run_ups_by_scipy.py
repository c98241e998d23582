"""Run-ups of two masses with one unbalance, integrated by SciPy, with noise: records for identification."""

import functools

import equinox as eqx
import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import jaxvib as jv
from jaxvib.identification.run import parse_change

TRUTH = {
    "machine.mass[0]": 120.0,
    "machine.mass[1]": 95.0,
    "machine.stiffness[0]": 5e4,
    "machine.stiffness[1]": 6e4,
    "machine.damping[0]": 160.0,
    "machine.damping[1]": 120.0,
    "machine.link_stiffness[0]": 2e5,
    "machine.link_damping[0]": 130.0,
    "exciters[0].unbalance": 0.05,
}
"""Numbers of the machine. The undamped natural frequencies are about 22 and 64 rad/s."""

DURATION, TOP = 16.0, 100.0
"""Duration of the run-up, s, and the speed at its end, rad/s."""


def ramp(t):
    """Return angle, speed and acceleration of a rotor that speeds up smoothly from rest to TOP."""
    x = t / DURATION
    return (
        TOP * DURATION * (x**2 - x**4 / 4.0) * 2.0 / 3.0,
        TOP * (2.0 * x - x**3) * 2.0 / 3.0,
        TOP / DURATION * (2.0 - 3.0 * x**2) * 2.0 / 3.0,
    )


def ending_ramp(t):
    """Return angle, speed and acceleration of a rotor that speeds up at a constant rate to 90 rad/s within 7.5 s, and stays
    there."""
    rising, rate = np.minimum(t, 7.5), 12.0
    return rate * rising * (t - 0.5 * rising), rate * rising, np.where(np.asarray(t) < 7.5, rate, 0.0)


class Ramp(jv.IdealDrive):
    """`ramp` as a prescribed drive."""

    speed: jax.Array
    kind: str = eqx.field(static=True, default="ramp", kw_only=True)

    def angle_at(self, t):
        return ramp(t)[0]

    def speed_at(self, t):
        return ramp(t)[1]

    def acceleration_at(self, t):
        return ramp(t)[2]


def accelerations(times, cases, phase=0.4, turning=ramp):
    """Return the accelerations (cases, n, 2) of both masses, for a list of numbers as `TRUTH`.

    The machine starts at rest. `phase`: angle of the unbalance ahead of the mark, rad.
    """
    m1, m2, k1, k2, c1, c2, k, c, s = np.array([list(case.values()) for case in cases]).T

    def rates(t, y):
        x1, x2, v1, v2 = y.reshape(4, -1)
        theta, speed, change = turning(t)
        force = s * (speed**2 * np.sin(theta + phase) - change * np.cos(theta + phase))
        link = k * (x1 - x2) + c * (v1 - v2)
        return np.concatenate([v1, v2, (-k1 * x1 - c1 * v1 - link) / m1, (force - k2 * x2 - c2 * v2 + link) / m2])

    run = solve_ivp(rates, (times[0], times[-1]), np.zeros(4 * len(cases)), "DOP853", t_eval=times, rtol=1e-9, atol=1e-12)
    slopes = np.stack([rates(t, y) for t, y in zip(run.t, run.y.T, strict=True)], axis=1)
    return np.moveaxis(slopes.reshape(4, len(cases), -1)[2:], 0, -1)


def line_torque(t, speed):
    """Return the torque of a motor, a straight line over the speed, N m."""
    return 1.6 * (1.0 - speed / 120.0)


def motor_run_up(times, case, torque=line_torque, inertia=0.1, phase=0.4):
    """Return accelerations (n, 2) of both masses, and the angle, speed and acceleration of the rotor as a function of time.

    The rotor is driven by `torque`, a function of time and speed; its speed dips at the resonances.
    """
    m1, m2, k1, k2, c1, c2, k, c, s = dict(case).values()

    def rates(t, y):
        x1, x2, theta, v1, v2, speed = y
        link = k * (x1 - x2) + c * (v1 - v2)
        cos, sin = s * np.cos(theta + phase), s * np.sin(theta + phase)
        # m2 a + cos theta'' = sin speed^2 - supports;  cos a + inertia theta'' = torque
        right = speed**2 * sin - k2 * x2 - c2 * v2 + link, torque(t, speed)
        change = (m2 * right[1] - cos * right[0]) / (m2 * inertia - cos**2)
        return np.array([v1, v2, speed, (-k1 * x1 - c1 * v1 - link) / m1, (right[0] - cos * change) / m2, change])

    span = times[0], times[-1]
    run = solve_ivp(rates, span, np.zeros(6), "DOP853", dense_output=True, rtol=1e-10, atol=1e-12, max_step=0.05)
    times = np.asarray(times)
    slopes = np.array([rates(t, y) for t, y in zip(times, run.sol(times).T, strict=True)])

    def turning(t):
        states = run.sol(t)
        change = (
            rates(t, states)[5] if np.ndim(t) == 0 else np.array([rates(*each)[5] for each in zip(t, states.T, strict=True)])
        )
        return states[2], states[5], change

    return slopes[:, 3:5], turning


def free_motions(times, case):
    """Return the accelerations (n, 2) of free motions from each unit state."""
    m1, m2, k1, k2, c1, c2, k, c, _ = case.values()
    flow = np.zeros((4, 4))
    flow[:2, 2:] = np.eye(2)
    flow[2:] = -np.array([[k1 + k, -k, c1 + c, -c], [-k, k2 + k, -c, c2 + c]]) / np.array([[m1], [m2]])
    poles, shapes = np.linalg.eig(flow)
    free = np.einsum("ij,tj,jk->tik", shapes, np.exp(times[:, None] * poles), np.linalg.inv(shapes))
    return list(np.einsum("ai,tik->kta", flow[2:], free).real)


def bound(times, names, noise, color=0.0, gain_error=0.0, turning=ramp, phase=0.4, pulse_error=0.0, pulses=1):
    """Return the Cramer-Rao bound of the relative standard errors of numbers `names`.

    The derivatives are differences of SciPy's run-ups. The states at the first sample, the offsets and the phase of the
    unbalance are free. The noise is that of `record`. `pulse_error`, s: standard error of the time of each of `pulses` per
    turn, and of a common delay of all pulses; the angle is then a polynomial of degree 5, see `pulse_rows`.
    """
    step = 1e-4
    cases = [TRUTH | {name: TRUTH[name] * (1.0 + s * step)} for name in names for s in (1.0, -1.0)]
    both = accelerations(times, cases, phase, turning).reshape(len(names), 2, times.size, 2)
    columns = [(high - low) / (2.0 * step) for high, low in both]
    turned = accelerations(times, [TRUTH], phase + step, turning) - accelerations(times, [TRUTH], phase - step, turning)
    columns.append(turned[0] / (2.0 * step))
    columns += free_motions(times, TRUTH)
    columns += [np.tile([1.0, 0.0], (times.size, 1)), np.tile([0.0, 1.0], (times.size, 1))]
    readings = accelerations(times, [TRUTH], phase, turning)[0]
    columns += [readings * each for each in np.eye(2)] if gain_error else []
    errors = [gain_error] * 2 if gain_error else []
    if pulse_error:
        columns += [*by_angle(times, turning, phase), np.zeros((times.size, 2))]
    slopes = np.stack(columns, axis=-1)
    slopes[1:] -= color * slopes[:-1]
    slopes[0] *= np.sqrt(1.0 - color**2)
    slopes = slopes.reshape(-1, slopes.shape[-1]) / (noise * np.sqrt(1.0 - color**2))
    information = slopes.T @ slopes
    first = len(columns) - (DEGREE + 2) * bool(pulse_error)
    for k, error in enumerate(reversed(errors)):
        information[first - 1 - k, first - 1 - k] += 1.0 / error**2
    if pulse_error:
        rows = pulse_rows(turning, float(times[-1]), pulses) / pulse_error
        information[first:, first:] += rows.T @ rows
        information[-1, -1] += 1.0 / pulse_error**2
    return np.sqrt(np.diagonal(np.linalg.inv(information))[: len(names)])


DEGREE = 5
"""Degree of the polynomial of the angle, whose coefficients pulses determine."""


def polynomials(t, end):
    """Return the Legendre polynomials of the time until `end`, and their first and second derivatives (3, ..., DEGREE + 1)."""
    legendre, scale = np.polynomial.legendre, 2.0 / end
    place = 2.0 * np.asarray(t) / end - 1.0
    return np.stack([legendre.legval(place, legendre.legder(np.eye(DEGREE + 1), k)).T * scale**k for k in range(3)])


def by_angle(times, turning, phase):
    """Return the derivatives (n, 2) of the accelerations by each coefficient of a polynomial that is added to the angle."""
    step, end = 1e-4, float(times[-1])
    signs = step * np.repeat([1.0, -1.0], DEGREE + 1)

    def moved(t):
        return tuple(each + signs * np.tile(change, 2) for each, change in zip(turning(t), polynomials(t, end), strict=True))

    both = accelerations(times, [TRUTH] * signs.size, phase, moved)
    return list((both[: DEGREE + 1] - both[DEGREE + 1 :]) / (2.0 * step))


def pulse_rows(turning, end, pulses):
    """Return the rows (pulses, DEGREE + 2) of the errors of the times of pulses, by the polynomial and a common delay.

    A pulse at the speed w reads the angle with the error w (delay + its own error).
    """
    _, edges = pulse_times(turning, end, pulses)
    speed = turning(edges)[1]
    return np.column_stack([polynomials(edges, end)[0] / speed[:, None], np.ones(edges.size)])


def noise_like(size, noise, rng, color=0.0, outliers=0.0):
    """Return noise of a standard deviation with the correlation `color` of neighbours, and a share of `outliers`.

    The outliers are normal with twenty times the standard deviation.
    """
    found = rng.normal(size=size)
    if color:
        found = np.asarray(lfilter([np.sqrt(1.0 - color**2)], [1.0, -color], np.concatenate([rng.normal(size=200), found])))[
            200:
        ]
    return noise * (found + 20.0 * rng.normal(size=size) * (rng.random(size) < outliers))


def scene_of(numbers, loads=None):
    """Return the scene with numbers as `TRUTH`, and possibly loads, under a motor whose speed is not known."""
    mass, stiffness, damping = ([numbers[f"machine.{name}[{k}]"] for k in (0, 1)] for name in ("mass", "stiffness", "damping"))
    machine = jv.two_mass(
        mass=mass, stiffness=stiffness, damping=damping,
        link_stiffness=numbers["machine.link_stiffness[0]"], link_damping=numbers["machine.link_damping[0]"],
    )  # fmt: skip
    motor = jv.DCMotor("1500 rpm", stall_torque=5.0, inertia=0.1)
    return jv.Scene(machine, exciters=[jv.Exciter(loads, motor, unbalance=numbers["exciters[0].unbalance"], at=2)])


@functools.cache
def pulse_times(turning, end, pulses):
    """Return the numbers and the times of the pulses until the time `end` of a rotor that starts at the angle 0."""
    fine = np.linspace(0.0, end, 20001)
    angle = turning(fine)[0]
    numbers = np.arange(1.0, np.floor(angle[-1] * pulses / (2.0 * np.pi)) + 1.0)
    edges = np.interp(numbers * 2.0 * np.pi / pulses, angle, fine)
    for _ in range(3):
        theta, speed = turning(edges)[:2]
        edges = edges - (theta - numbers * 2.0 * np.pi / pulses) / speed
    return numbers, edges


def record(
    times, clean, noise, rng, gain_error=0.0, pulses=24, resolution=0.0, turning=ramp, change=None, color=0.0, outliers=0.0,
    full_scale=None,
):  # fmt: skip
    """Return a run of two accelerometers with noise, m/s^2, see `noise_like`, and a tachometer with `pulses` per turn.

    `gain_error`: gains are drawn with this relative error. `resolution`, s: the times of the pulses are rounded to multiples of
    it. Readings beyond `full_scale` are clipped.
    """
    channels = [jv.Channel(f"a{k + 1}", "acceleration", at=k + 1, gain_error=gain_error) for k in (0, 1)]
    numbers, edges = pulse_times(turning, float(times[-1]), pulses)
    if resolution:
        edges = resolution * np.round(edges / resolution + rng.random() - 0.5)
    gains = 1.0 + gain_error * rng.normal(size=2)
    readings = [gains[k] * clean[:, k] + noise_like(times.size, noise, rng, color, outliers) + 0.1 for k in (0, 1)]
    most = np.inf if full_scale is None else full_scale
    data = {f"a{k + 1}": np.clip(each, -most, most) for k, each in enumerate(readings)}
    clipped = {name: np.abs(each) >= most for name, each in data.items()}
    channels = (*channels, jv.Channel("tacho", "pulses", per_turn=pulses))
    return jv.MeasuredRun(
        channels,
        {"a1": times, "a2": times, "tacho": edges},
        {**data, "tacho": numbers},
        {**clipped, "tacho": np.zeros(numbers.size, bool)},
        {name: parse_change(each, name) for name, each in (change or {}).items()},
        (),
        "run",
    )
