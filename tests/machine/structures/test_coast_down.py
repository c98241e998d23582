"""Coast-down of an unbalance through a resonance, against SciPy."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxvib as jv
from optimize import peak_displacement, peak_force

M, C, K, S, J, BEARING = 200.0, 600.0, 8e5, 0.4, 0.2, 0.05
START = 100.0  # rad/s; the resonance is at 63 rad/s


def by_scipy(times):
    """Displacement of the platform, m, while the rotor runs down."""

    def rates(t, x):
        y, angle, v, w = x
        matrix = np.array([[M, S * np.cos(angle)], [S * np.cos(angle), J]])
        right = np.array([S * w**2 * np.sin(angle) - C * v - K * y, -BEARING * w])
        return np.concatenate([[v, w], np.linalg.solve(matrix, right)])

    run = scipy.integrate.solve_ivp(
        rates, (0.0, times[-1]), [0.0, 0.0, 0.0, START], method="DOP853", t_eval=times, rtol=1e-11, atol=1e-13
    )
    return run.y


def test_peak_of_a_coast_down_is_scipys():
    off = jv.SwitchedOff(jv.DCMotor(START, stall_torque=10.0, inertia=J), bearing=BEARING)
    machine = jv.one_mass(mass=M, stiffness=K, damping=C)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=off, unbalance=S)])
    rest = jv.initial_state(scene)
    start = eqx.tree_at(lambda s: s.exciters[0].rotor, rest, (jnp.asarray(0.0), jnp.asarray(START)))
    run = jv.simulate(scene, "4 s", start=start, samples=2000, stepsize_controller=jv.Tolerance(1e-11))
    y, _, v, w = by_scipy(np.asarray(run.trajectory.time))
    assert w[-1] < 0.7 * 63.0  # it passes the resonance
    found = np.asarray(run.trajectory.state.displacement[:, 0])
    np.testing.assert_allclose(found, y, atol=1e-6 * np.max(np.abs(y)))
    y, _, v, _ = by_scipy(np.linspace(0.0, 4.0, 100001))
    np.testing.assert_allclose(
        run.largest_displacement[0], np.max(np.abs(y)), rtol=1e-5
    )  # 50 stored states or more in a period
    np.testing.assert_allclose(run.largest_force, np.max(np.abs(K * y + C * v)), rtol=1e-5)


def test_peaks_of_start_and_stop_are_quantities_of_designs():
    stop = jv.SwitchedOff(jv.DCMotor(START, stall_torque=40.0, inertia=J), at="3 s", bearing=BEARING)
    scene = jv.Scene(jv.one_mass(mass=M, stiffness=K, damping=C), exciters=[jv.Exciter(drive=stop, unbalance=S)])
    run = jv.simulate(scene, "6 s", samples=20000)
    np.testing.assert_allclose(peak_displacement(until="6 s")(scene), run.largest_displacement[0], rtol=1e-3)
    np.testing.assert_allclose(peak_displacement(until="6 s", at=1)(scene), run.largest_displacement[0], rtol=1e-3)
    np.testing.assert_allclose(peak_force(until="6 s")(scene), run.largest_force, rtol=1e-3)
    with pytest.raises(jv.InputError, match="until is 0 s; it must be greater than 0"):
        peak_displacement(until=0.0)
    with pytest.raises(jv.InputError, match="at is"):
        peak_displacement(until=1.0, at=(1.0,))
