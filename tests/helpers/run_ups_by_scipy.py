"""Run-ups of two masses with one unbalance, integrated by SciPy, with noise: records for identification."""

import numpy as np
from scipy.integrate import solve_ivp

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


def scene_of(numbers):
    """Return the scene with numbers as `TRUTH`, under a motor whose speed is not known."""
    mass, stiffness, damping = ([numbers[f"machine.{name}[{k}]"] for k in (0, 1)] for name in ("mass", "stiffness", "damping"))
    machine = jv.two_mass(
        mass=mass, stiffness=stiffness, damping=damping,
        link_stiffness=numbers["machine.link_stiffness[0]"], link_damping=numbers["machine.link_damping[0]"],
    )  # fmt: skip
    motor = jv.DCMotor("1500 rpm", stall_torque=5.0, inertia=0.1)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=numbers["exciters[0].unbalance"], at=2)])


def record(times, clean, noise, rng, gain_error=0.0, pulses=24, jitter=0.0, turning=ramp, change=None):
    """Return a run of two accelerometers with white `noise`, m/s^2, and a tachometer with `pulses` per turn."""
    channels = [jv.Channel(f"a{k + 1}", "acceleration", at=k + 1, gain_error=gain_error) for k in (0, 1)]
    fine = np.linspace(times[0], times[-1], 200001)
    angle = turning(fine)[0]
    numbers = np.arange(np.ceil(angle[0] * pulses / (2 * np.pi)), np.floor(angle[-1] * pulses / (2 * np.pi)) + 1)
    edges = np.interp(numbers * 2 * np.pi / pulses, angle, fine) + jitter * rng.normal(size=numbers.size)
    gains = 1.0 + gain_error * rng.normal(size=2)
    data = {f"a{k + 1}": gains[k] * clean[:, k] + noise * rng.normal(size=times.size) + 0.1 for k in (0, 1)}
    values = {**data, "tacho": numbers}
    clipped = {name: np.zeros(len(each), bool) for name, each in values.items()}
    channels = (*channels, jv.Channel("tacho", "pulses", per_turn=pulses))
    return jv.MeasuredRun(
        channels,
        {"a1": times, "a2": times, "tacho": edges},
        values,
        clipped,
        {name: parse_change(each, name) for name, each in (change or {}).items()},
        (),
        "run",
    )
