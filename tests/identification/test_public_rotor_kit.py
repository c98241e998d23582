"""Run-up of a rotor kit through its first critical speed, published by others (tests/data/rk4_runup_1x.csv, CC BY 4.0).

M. Nouioua, rk4-rotor-unbalance-estimation. The file has the first order of the displacement over the speed, without times.
"""

import pathlib

import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxvib as jv

RECORD = pathlib.Path(__file__).parents[1] / "data" / "rk4_runup_1x.csv"


def first_order():
    """Return the speed, rad/s, and the complex amplitude of the first order, m."""
    rpm, mil, degrees = np.loadtxt(RECORD, delimiter=",", skiprows=4).T
    return rpm * 2.0 * np.pi / 60.0, 25.4e-6 * mil * np.exp(1j * np.deg2rad(degrees))


def steady(modes=1, constant=False):
    """Return natural frequency and damping ratio of the first mode, and the residual, m, of the fit of the steady response.

    `constant`: an amplitude that does not change, such as the runout of the shaft.
    """
    speed, z = first_order()

    def left(x):
        parts = [speed**2 / (w**2 - speed**2 + 2j * ratio * w * speed) for w, ratio in x.reshape(modes, 2)]
        columns = np.stack([*parts, *([np.ones_like(z)] if constant else [])], axis=1)
        columns /= np.linalg.norm(columns, axis=0)
        rest = z - columns @ np.linalg.lstsq(columns, z, rcond=None)[0]
        return np.concatenate([rest.real, rest.imag]) * 1e6

    found = least_squares(left, [172.0, 0.03, 175.0, 0.02][: 2 * modes], x_scale=[1.0, 0.01] * modes)
    return *found.x[:2], 1e-6 * np.sqrt(np.mean(found.fun**2))


def transient(turns):
    """Return the fit of one mode to the displacement over time, if each row of the file is after so many `turns`."""
    speed, z = first_order()
    period = 2.0 * np.pi * turns / speed
    middle, angle = np.cumsum(period) - 0.5 * period, 2.0 * np.pi * turns * (np.arange(speed.size) + 0.5)
    time = np.arange(middle[0], middle[-1], 2.5e-3)
    theta, shown = np.interp(time, middle, angle), np.interp(time, middle, z.real) + 1j * np.interp(time, middle, z.imag)
    channels = [jv.Channel("probe", "displacement", at=1), jv.Channel("rotor", "angle")]
    times, values = {"probe": time, "rotor": middle}, {"probe": (shown * np.exp(1j * theta)).real, "rotor": angle}
    run = jv.MeasuredRun.from_arrays(channels, times, values)
    motor = jv.DCMotor("6000 rpm", stall_torque=1.0, inertia=0.01)
    machine = jv.one_mass(mass=1.0, stiffness=170.0**2, damping=2.0 * 0.02 * 170.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=1e-6)])
    names = ["machine.stiffness", "machine.damping", "exciters[0].unbalance"]
    return jv.identify(scene, run, unknown=names, throw=False)


def test_steady_response_of_the_rotor_kit():
    frequency, ratio, residual = steady()
    assert frequency == pytest.approx(172.9, abs=0.1) and ratio == pytest.approx(0.0203, abs=2e-4)
    assert residual == pytest.approx(1.28e-6, rel=0.01)
    assert steady(constant=True)[2] == pytest.approx(1.07e-6, rel=0.01)
    assert steady(modes=2)[2] == pytest.approx(1.02e-6, rel=0.01)


@pytest.mark.slow
def test_rotor_kit_passes_its_critical_speed_too_fast_for_steady():
    """An independent integration of the complex amplitude by the midpoint rule, with equal weights of all rows, gives 169.9
    rad/s, 0.0188 and a residual of 0.99 um at two turns per row, and 166.1 rad/s and 1.32 um at one."""
    twice, once = transient(2), transient(1)
    assert twice.frequency[0].value == pytest.approx(169.9, rel=0.003)
    assert twice.damping_ratio[0].value == pytest.approx(0.0188, rel=0.06)
    assert twice.noise[0][0] == pytest.approx(0.99e-6, rel=0.05)
    assert once.frequency[0].value == pytest.approx(166.1, rel=0.003)
    assert once.noise[0][0] == pytest.approx(1.32e-6, rel=0.1)
    assert twice.status_name == once.status_name == "patterned"
