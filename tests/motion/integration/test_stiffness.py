"""Loads that decay faster than anything moves: which steps are taken, and that they give what SciPy's implicit method gives."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hard_cases.reference_model import reference_model
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.integration.stiffness import equal_step_length, fastest_decay, is_unresolved
from jaxvib.ode.dopri8 import UnrolledDopri8

DRAGS = (300.0, 1e3, 1e5, 1e9)


def dragged(drag, damping=100.0, count=1, effects=()):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=damping)
    loads = jv.balls(count=count, mass=0.5, radius=0.1, drag=drag)
    return jv.Scene(machine, loads, jv.ConstantSpeed(60.0), effects)


def of_drag(drag):
    return eqx.tree_at(lambda s: s.loads.drag, dragged(1.0), drag)


def run_out(drag, until=5.0):
    """SciPy's run from rest, its last second."""
    p = reference_model(dragged(drag))
    start = np.array([0.0, 0.0, -np.pi / 2.0, 0.0])
    times = np.linspace(until - 1.0, until, 1001)
    run = solve_ivp(p.field, (0.0, until), start, "Radau", times, jac=p.slopes, rtol=1e-8, atol=1e-10)
    return run.y


@pytest.mark.parametrize(("drag", "damping", "count"), [(1.0, 0.0, 1), (1e4, 0.0, 3), (1.0, 1e6, 2)])
def test_fastest_decay_is_that_of_the_dense_damping_matrix(drag, damping, count):
    """The mount reduces the inertia of a load most if the load moves along it."""
    scene = dragged(drag, damping, count)
    p = reference_model(scene)
    along = [p.forces(0.0, np.r_[np.zeros(2), np.full(count, a), np.zeros(count)])[0] for a in np.linspace(0.0, np.pi, 9)]
    drags = np.diag([damping, *(p.drag * p.radius**2)])
    right = max(np.max(scipy.linalg.eigh(drags, mass, eigvals_only=True)) for mass in along)
    np.testing.assert_allclose(fastest_decay(scene), right, rtol=2e-2 if damping > 1e3 else 1e-9)


def test_steps_resolve_decay_or_are_implicit():
    assert equal_step_length(60.0, 20.0, 4.0) == (1.0 / 240.0, False)
    assert equal_step_length(60.0, 3000.0, 4.0) == (1e-3, False)
    assert equal_step_length(60.0, 6001.0, 4.0) == (1.0 / 1920.0, True)
    assert equal_step_length(60.0, 20.0, 4.0, 1e-3) == (1e-3, False) and equal_step_length(60.0, 4000.0, 4.0, 1e-3) == (
        1e-3,
        True,
    )


@pytest.mark.parametrize("decay", [5.0, 5.09, 5.2, 5.9])
def test_steps_are_unresolved_where_the_method_diverges(decay):
    """A step multiplies a decaying value by R = 1 + z b (1 - z A)^-1 e, with z = -decay times the length of the step."""
    tableau = diffrax.Dopri8.tableau
    weights = np.asarray(tableau.b_sol)
    stages = np.zeros((weights.size, weights.size))
    for i, row in enumerate(tableau.a_lower):
        stages[i + 1, : i + 1] = row
    factor = 1.0 - decay * weights @ np.linalg.solve(np.eye(weights.size) + decay * stages, np.ones(weights.size))
    assert bool(is_unresolved(decay, 1.0)) == (abs(factor) > 1.0)


KLOSS = {"speed": 50.0, "breakdown_torque": 120.0, "breakdown_slip": 0.05, "inertia": 0.02}
PROFILE = jv.SpeedProfile([0.0, 1.0, 3.0, 4.0], [0.0, 150.0, 150.0, 5.0])


def unbalanced(drive):
    """Machine with a resonance at 4 rad/s."""
    return jv.Scene(jv.one_mass(mass=200.0, stiffness=3200.0, damping=50.0), exciters=[jv.Exciter(drive=drive, unbalance=0.2)])


def test_fastest_rates_include_those_of_drives():
    control = jv.SpeedControl(PROFILE, gain=5.0, integral_gain=50.0, torque_limit=40.0, inertia=0.02)
    electrical = jv.DCMotorElectrical(48.0, 0.6, torque_constant=0.8, inertia=0.02, inductance=1e-3)
    for drive, decay, motion in (
        (jv.InductionMotor(**KLOSS), 2.0 * 120.0 / (0.05 * 50.0 * 0.02), 50.0),
        (PROFILE, 0.25, 150.0),
        (control, 125.0 + np.sqrt(125.0**2 - 50.0 / 0.02), 150.0),  # J s^2 + gain s + integral gain
        (jv.Converter(jv.DCMotor(60.0, 30.0, 0.01), PROFILE), 30.0 / 60.0 / 0.01, 150.0),
        (electrical, 300.0 + np.sqrt(300.0**2 - 0.64 / 2e-5), 60.0),  # L J s^2 + R J s + K^2
        (eqx.tree_at(lambda motor: motor.inertia, electrical, 0.002), 300.0, np.sqrt(0.64 / 2e-6 - 300.0**2)),
    ):
        np.testing.assert_allclose(fastest_decay(unbalanced(drive)), decay, rtol=1e-9)
        np.testing.assert_allclose(frequency_bounds(unbalanced(drive))[0], motion, rtol=1e-9)


@pytest.mark.parametrize("drive", [jv.InductionMotor(**KLOSS), PROFILE], ids=["motor", "profile"])
def test_equal_steps_resolve_drives(drive):
    """Steps of the last speed alone are unstable for the motor, and the rotor of the profile turns by 7 rad in each of them."""
    many = jv.ensemble(lambda _: unbalanced(drive), jnp.zeros(1), 5.0)
    run = jv.simulate(unbalanced(drive), 5.0, stepsize_controller=jv.Tolerance(1e-10), save="window", estimate=False)
    np.testing.assert_allclose(many.state.displacement[0], run.window.state.displacement[-1], atol=2e-6)


def test_runs_of_any_drag_agree_with_radau_of_scipy():
    many = jv.ensemble(of_drag, jnp.asarray(DRAGS), 5.0)
    assert bool(jnp.all(many.finite)) and float(jnp.max(many.error)) < 1e-6
    for drag, end in zip(DRAGS, np.asarray(many.state.displacement), strict=True):
        right = run_out(drag)
        size = np.max(np.abs(right[0]))
        run = jv.simulate(dragged(drag), 5.0, save="window")
        np.testing.assert_allclose(run.window.state.displacement[-1], right[0, -1:], atol=1e-5 * size)
        np.testing.assert_allclose(end, right[0, -1:], atol=1e-5 * size)


def test_a_locked_load_is_an_imbalance():
    """The load has 1e-9 kg and drag / mass of 1e9 1/s, on a rotor whose imbalance moves the machine."""
    machine = jv.one_mass(mass=70.0, stiffness=3e4, damping=580.0)
    loads = jv.pendulums(count=1, mass=1e-9, radius=1e-3, drag=1.0)
    run = jv.simulate(jv.Scene(machine, loads, jv.ConstantSpeed(13.0), (jv.StaticImbalance(2.66),)), 8.0, save="window")
    moved = 2.66 * 13.0**2 / abs(3e4 - 70.0 * 13.0**2 + 580.0j * 13.0)
    np.testing.assert_allclose(run.amplitude, moved, rtol=1e-6)


def test_a_run_out_of_steps_names_the_drag():
    for scene, name in (
        (dragged(1e6), "loads.drag makes speeds of loads decay"),
        (dragged(1.0, 1e8), "machine.damping makes vibrations"),
        (dragged(1.0, effects=(jv.FrictionSupport(1e6, 1e-4),)), "friction at a support .force/width. makes vibrations"),
    ):
        with pytest.raises(jv.ComputationError, match=f"max_steps_reached.*{name}"):
            jv.simulate(scene, 5.0, solver=UnrolledDopri8(), max_steps=1000, save="window")


def test_unresolved_runs_are_named(monkeypatch):
    """Explicit steps are given for unknown numbers."""
    from jaxvib.motion import plan

    monkeypatch.setattr(plan, "equal_step_length", lambda *_: (1.0, False))
    many = jv.ensemble(of_drag, jnp.asarray([1.0, 1e5]), 5.0, stepsize_controller=jv.EqualSteps(1200))
    assert [str(s) for s in np.asarray(many.resolved)] == ["True", "False"]
    assert "too long for contacts or for a fast decay due to drag" in many.summary()


def test_a_sweep_over_drag_is_answered(tmp_path):
    found = jv.sweep(
        dragged(300.0), {"loads.drag": [300.0, 1e5]}, measure=["run.amplitude"], until=5.0, store=tmp_path / "drag.zarr"
    )
    values = np.ravel(found.data["amplitude"].values)
    np.testing.assert_allclose(values, [1.33755e-3, 1.33741e-3], rtol=1e-4)
