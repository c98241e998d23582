"""Largest values of runs of a sweep on the way: start, passage through a resonance, stop."""

import numpy as np
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.motion.batch import BatchPlan
from jaxvib.sweeps.study import study
from optimize import peak_force

MASS, STIFFNESS, DAMPING, UNBALANCE = 49.0, 4e4, 60.0, 0.05
NAMES = ["run.peak_displacement", "run.peak_force"]


def passed(speed):
    """Peaks by SciPy of a table that an unbalance brings up to `speed` within 2 s, and stops within the next 2 s."""

    def motion(t):
        """Angle, speed and acceleration of a rotor that accelerates and decelerates evenly."""
        a = speed / 2.0
        if t < 2.0:
            return a * t**2 / 2.0, a * t, a
        s = 4.0 - t
        return 4.0 * a - a * s**2 / 2.0, a * s, -a

    def rates(t, y):
        angle, rate, acceleration = motion(t)
        force = UNBALANCE * (rate**2 * np.sin(angle) - acceleration * np.cos(angle))
        return [y[1], (force - STIFFNESS * y[0] - DAMPING * y[1]) / MASS]

    times = np.linspace(0.0, 4.0, 40001)
    parts = [solve_ivp(rates, (0.0, 2.0), [0.0, 0.0], "DOP853", times[:20001], rtol=1e-11, atol=1e-14)]
    parts.append(solve_ivp(rates, (2.0, 4.0), parts[0].y[:, -1], "DOP853", times[20000:], rtol=1e-11, atol=1e-14))
    y, v = np.concatenate([part.y for part in parts], axis=1)
    return np.max(np.abs(y)), np.max(np.abs(STIFFNESS * y + DAMPING * v))


def test_peaks_of_a_start_and_stop_are_scipys(tmp_path):
    table = jv.one_mass(mass=MASS, stiffness=STIFFNESS, damping=DAMPING)
    for speed in (25.0, 70.0):  # below the resonance at 28.6 rad/s and above
        drive = jv.SpeedProfile([0.0, 2.0, 4.0], [0.0, speed, 0.0])
        scene = jv.Scene(table, exciters=[jv.Exciter(unbalance=UNBALANCE, drive=drive)])
        axes = {"machine.damping[0]": [DAMPING, 3.0 * DAMPING]}
        found = jv.sweep(scene, axes, NAMES, tmp_path / f"{speed:g}.zarr", until=4.0).data
        displacement, force = passed(speed)
        np.testing.assert_allclose(found["peak_displacement"].values[0], [displacement], rtol=2e-5)
        np.testing.assert_allclose(found["peak_force"].values[0], force, rtol=2e-5)
        assert found["peak_displacement"].values[1, 0] < 0.95 * displacement


def test_peaks_of_a_body_are_those_of_simulate(tmp_path):
    springs = [jv.support(at=(x, 0.1 * x), stiffness=(1e5, 2e5), damping=(500.0, 500.0)) for x in (-1.0, 1.0)]
    body = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    parts = ((-0.9, 1, 100.0), (0.8, -1, 100.5))
    motors = [(x, way, jv.DCMotor(n, stall_torque=300.0, inertia=0.4)) for x, way, n in parts]
    scene = jv.Scene(body, exciters=[jv.Exciter(drive=m, unbalance=1.5, at=(x, 0.3), direction=w) for x, w, m in motors])
    found = jv.sweep(scene, {"machine.mass": [2000.0, 2100.0]}, NAMES, tmp_path / "s.zarr", until=4.0).data
    run = jv.simulate(scene, 4.0, samples=20000, estimate=False)
    np.testing.assert_allclose(found["peak_displacement"].values[0], run.largest_displacement, rtol=1e-4)
    np.testing.assert_allclose(found["peak_force"].values[0], run.largest_force, rtol=1e-4)
    np.testing.assert_allclose(peak_force(until=4.0)(scene), run.largest_force, rtol=1e-3)


def test_peaks_of_strong_drag_are_those_of_simulate(tmp_path):
    """Drag that needs implicit steps."""
    table = jv.one_mass(mass=MASS, stiffness=STIFFNESS, damping=DAMPING)
    scene = jv.Scene(table, jv.balls(count=1, mass=0.5, radius=0.1, drag=2e5), jv.SpinUp(70.0, duration=1.0))
    made = study(scene, {"loads.mass": [0.4, 0.5]}, NAMES, until=2.0)
    assert made.plan is not None and made.plan.implicit and made.plan.blocks
    found = jv.sweep(scene, {"loads.mass": [0.4, 0.5]}, NAMES, tmp_path / "s.zarr", until=2.0).data
    run = jv.simulate(scene, 2.0, samples=20000, estimate=False)
    np.testing.assert_allclose(found["peak_displacement"].values[1], run.largest_displacement, rtol=1e-3)
    np.testing.assert_allclose(found["peak_force"].values[1], run.largest_force, rtol=1e-3)


def test_a_plan_with_peaks_makes_at_least_as_many_steps():
    for each in (1, 2, 16, 17, 1000):
        plan = BatchPlan(until=10.0, window=2.0, samples=64, each=each, between=1)
        peaks = plan.with_peaks()
        assert plan.blocks == 0 and max(each, 3) <= peaks.each <= each + max(peaks.blocks, 2)
        assert peaks.each % peaks.blocks == 0 and 3 <= peaks.each // peaks.blocks <= 16
