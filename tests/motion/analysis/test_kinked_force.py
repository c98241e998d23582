"""Amplitudes of forces that jump: dry friction and stops at supports."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxvib as jv

MASS, STIFFNESS, UNBALANCE, SPEED, TURNS = 50.0, 4e4, 0.05, 25.0, 60


def scene(effect, stiffness=STIFFNESS, damping=50.0):
    motor = jv.Exciter(drive=jv.ConstantSpeed(SPEED), unbalance=UNBALANCE)
    machine = jv.one_mass(mass=MASS, stiffness=STIFFNESS, damping=damping)
    built = jv.Scene(machine, exciters=[motor], effects=[effect])
    return eqx.tree_at(lambda s: s.machine.stiffness, built, jnp.asarray([stiffness]))


def friction(v, y):
    return 20.0 * np.tanh(v / 1e-4)


def contact(v, y):
    return np.where(y < -1e-3, 1e8 * (y + 1e-3), 0.0)


@pytest.mark.parametrize(
    ("effect", "force", "rtol"),
    [(jv.FrictionSupport(20.0, width=1e-4), friction, 2e-6), (jv.Stop(1e8, gap=1e-3), contact, 2e-3)],
    ids=["friction", "stop"],
)
def test_force_equals_that_of_scipy(effect, force, rtol):
    """The polynomial through four samples overshoots; with it the forces are 40 % and 2 % too large. A contact has two
    samples."""
    period = 2.0 * np.pi / SPEED
    run = jv.simulate(scene(effect), TURNS * period, save="window", stepsize_controller=jv.Tolerance(1e-9))

    def field(t, state):
        y, v = state
        return v, (UNBALANCE * SPEED**2 * np.sin(SPEED * t) - STIFFNESS * y - 50.0 * v - force(v, y)) / MASS

    span = run.window.time[0], TURNS * period
    found = solve_ivp(field, (0.0, span[1]), (0.0, 0.0), method="LSODA", rtol=1e-10, atol=1e-13, dense_output=True)
    y, v = found.sol(np.linspace(*span, 400_001))
    total = STIFFNESS * y + 50.0 * v + force(v, y)
    np.testing.assert_allclose(run.foundation_force, np.ptp(total) / 2.0, rtol=rtol)
    np.testing.assert_allclose(run.amplitude[0], np.ptp(y) / 2.0, rtol=2e-4)


def test_window_resolves_stiff_stops():
    """A contact lasts 0.7 ms. In a run of 10 s, 4096 samples have a distance of 1.1 ms; they gave 41,600 N for 35,500 N."""
    motor = jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)
    machine = jv.one_mass(mass=MASS, stiffness=STIFFNESS, damping=300.0)

    def run(stiffness, window_periods=20):
        motion = jv.Scene(machine, exciters=[motor], effects=[jv.Stop(stiffness, gap=2e-3)])
        steps = jv.Tolerance(1e-10)
        return jv.simulate(motion, 4.0, save="window", stepsize_controller=steps, window_periods=window_periods)

    def force(y, v):
        return STIFFNESS * y + 300.0 * v + np.sign(y) * 1e9 * np.maximum(np.abs(y) - 2e-3, 0.0)

    def field(t, state):
        y, v = state
        return v, (0.1 * 60.0**2 * np.sin(60.0 * t) - force(y, v)) / MASS

    stiff = run(1e9)
    assert len(stiff.window.time) == 16384
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-14, "max_step": 2e-4, "dense_output": True}
    y, v = solve_ivp(field, (0.0, 4.0), (0.0, 0.0), **options).sol(np.linspace(stiff.window.time[0], 4.0, 400_001))
    np.testing.assert_allclose(stiff.foundation_force, np.ptp(force(y, v)) / 2.0, rtol=3e-4)
    with pytest.raises(jv.InputError, match=r"the window needs .* samples, more than 131072; give fewer window_periods"):
        run(1e12)
    assert run(1e12, window_periods=1).status_name == "done"


def test_derivative_of_force_is_its_difference():
    def force(stiffness):
        motion = scene(jv.Stop(1e6, gap=1e-3), stiffness)
        return jv.simulate(motion, 6.0, save="window", stepsize_controller=jv.Tolerance(1e-11)).foundation_force

    difference = (force(STIFFNESS + 1.0) - force(STIFFNESS - 1.0)) / 2.0
    np.testing.assert_allclose(jax.grad(force)(STIFFNESS), difference, rtol=1e-3)


def test_motion_held_by_friction_alone_settles():
    for width in (1e-2, 1e-3):
        run = jv.settle(scene(jv.FrictionSupport(20.0, width=width), damping=0.0))
        assert run.status_name == "done" and run.drift < 1e-6
    assert jv.settle(scene(jv.FrictionSupport(0.0), damping=0.0)).status_name == "beating"
