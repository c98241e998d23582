"""Motions with dry friction at supports, against SciPy and closed forms of Coulomb friction."""

import math
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.motion.integration.stiffness import fastest_decay

M, K, SPEED, UNBALANCE = 50.0, 4e4, 40.0, 0.5
P = UNBALANCE * SPEED**2
NATURAL = math.sqrt(K / M)


def one_mass(*effects, damping=0.0, unbalance=UNBALANCE):
    machine = jv.one_mass(mass=M, stiffness=K, damping=damping)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(SPEED), unbalance=unbalance)], effects=effects)


def two_mass(first=60.0, second=45.0, width=0.02):
    """Two masses with friction under the first one and in the link."""
    machine = jv.two_mass(mass=(30.0, 20.0), stiffness=(4e4, 3e4), damping=(9.0, 8.0), link_stiffness=2e4, link_damping=5.0)
    effects = jv.FrictionSupport(first, width), jv.FrictionSupport(second, width, platform=1, to=2)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(SPEED), unbalance=UNBALANCE, at=1)
    return jv.Scene(machine, exciters=[exciter], effects=effects)


def state(q, v):
    return jv.State(jnp.atleast_1d(q), jnp.atleast_1d(v), exciters=[jv.ExciterState()])


def by_scipy(force, width, until):
    def rates(t, y):
        return [y[1], (P * np.sin(SPEED * t) - K * y[0] - force * np.tanh(y[1] / width)) / M]

    method, error = ("DOP853", 1e-10) if force / width / M < 2e3 else ("Radau", 1e-7)
    return solve_ivp(rates, (0.0, until), (0.0, 0.0), method, rtol=error, atol=1e-3 * error).y[:, -1]


def last(run):
    return np.concatenate([np.asarray(run.trajectory.state.displacement)[-1], np.asarray(run.trajectory.state.velocity)[-1]])


def test_two_masses_with_friction_move_as_in_scipy():
    def rates(t, y):
        (x1, x2), (v1, v2) = y[:2], y[2:]
        link = 2e4 * (x1 - x2) + 5.0 * (v1 - v2) + 45.0 * np.tanh((v1 - v2) / 0.02)
        first = P * np.sin(SPEED * t) - 4e4 * x1 - 9.0 * v1 - 60.0 * np.tanh(v1 / 0.02) - link
        return [v1, v2, first / 30.0, (link - 3e4 * x2 - 8.0 * v2) / 20.0]

    expected = solve_ivp(rates, (0.0, 2.0), np.zeros(4), "DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    run = jv.simulate(two_mass(), 2.0, samples=2)
    np.testing.assert_allclose(last(run), expected, atol=1e-6 * np.max(np.abs(expected)))


@pytest.mark.parametrize(("force", "width"), [(700.0, 0.01), (60.0, 1e-3), (700.0, 1e-3), (6000.0, 1e-3)])
def test_equal_steps_resolve_friction_within_their_error(force, width):
    """Decay rates F/(width M) of 1200 to 120,000 1/s; the larger ones need implicit steps. At 700 N the machine sticks and
    slips."""
    expected, scale = by_scipy(force, width, 1.0), P / K
    found = jv.ensemble(lambda x: one_mass(jv.FrictionSupport(x * force, width)), jnp.ones(2), 1.0)
    np.testing.assert_allclose(fastest_decay(one_mass(jv.FrictionSupport(force, width))), force / width / M, rtol=1e-12)
    error = abs(float(found.state.displacement[0, 0]) - expected[0]) / scale
    assert bool(found.resolved[0]) and error < 2e-3 and error < 2.0 * float(found.error[0])
    run = jv.simulate(one_mass(jv.FrictionSupport(force, width)), 1.0, samples=2)
    np.testing.assert_allclose(last(run)[0], expected[0], atol=1e-6 * scale)


@pytest.mark.parametrize("width", [1e-3, 0.05])
def test_free_vibration_decays_by_4_forces_per_stiffness(width):
    """The smooth sign dissipates less by the share (pi^2/24) (width/v)^2 at the velocity amplitude v."""
    force, amplitude, periods = 40.0, 0.05, 6
    run = jv.simulate(
        one_mass(jv.FrictionSupport(force, width), unbalance=1e-12), 2.0 * math.pi / NATURAL * periods,
        start=state(amplitude, 0.0), samples=periods + 1,
    )  # fmt: skip
    found = np.asarray(run.trajectory.state.displacement)[:, 0]
    mean = amplitude - 4.0 * force / K * (np.arange(periods) + 0.5)
    share = math.pi**2 / 24.0 * (width / (NATURAL * mean)) ** 2
    assert width < 0.01 or np.min(share) > 5e-4
    np.testing.assert_allclose(-np.diff(found) * K / (4.0 * force), 1.0 - share, atol=0.02 * np.max(share) + 1e-6)


@pytest.mark.parametrize("force", [0.2 * P, 0.5 * P])
def test_forced_vibration_is_that_of_den_hartog(force):
    """Amplitude of a mass on a spring with Coulomb friction that moves without stops; the error is of order width."""
    beta = SPEED / NATURAL
    v, u = 1.0 / (1.0 - beta**2), math.sin(math.pi / beta) / (beta * (1.0 + math.cos(math.pi / beta)))
    expected = P / K * math.sqrt(v**2 - (force / P * u) ** 2)
    wide, narrow = (jv.simulate(one_mass(jv.FrictionSupport(force, width)), 20.0).amplitude[0] for width in (2e-4, 1e-4))
    np.testing.assert_allclose(narrow, expected, rtol=2e-4)
    np.testing.assert_allclose(
        2.0 * narrow - wide, expected, rtol=2e-5
    )  # amplitudes are interpolated across the jump of the force


def test_large_friction_sticks_and_creeps():
    """Under a force f the machine creeps at the speed width artanh(f/F)."""
    width, force, f = 1e-3, 5e3, 400.0
    run = jv.simulate(one_mass(jv.FrictionSupport(force, width), unbalance=1e-12), 0.05, start=state(f / K, 0.0), samples=2)
    x, v = last(run)
    np.testing.assert_allclose(v, -width * np.arctanh(K * x / force), rtol=1e-3)
    assert 0.99 < K * x / f < 1.0


def test_no_friction_equals_a_scene_without_it():
    found = [jv.simulate(one_mass(*effects, damping=30.0), 3.0, samples=20) for effects in ([jv.FrictionSupport(0.0)], [])]
    first, second = (run.trajectory.state for run in found)
    np.testing.assert_array_equal(first.displacement, second.displacement)
    np.testing.assert_array_equal(first.velocity, second.velocity)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_of_runs_with_friction(mode):
    names = [f"effects.friction_support[{k}].{name}" for k in (0, 1) for name in ("force", "width")]
    adjoint = {"adjoint": diffrax.ForwardMode()} if mode == "forward" else {}

    def displacement(scene):
        steps, first = jv.Tolerance(1e-11), state(jnp.zeros(2), jnp.zeros(2))
        run = jv.simulate(
            scene, 0.5, start=first, samples=2, stepsize_controller=steps, estimate=False, max_steps=20000, **adjoint
        )  # fmt: skip
        return run.trajectory.state.displacement[-1, 1]

    check = jv.check_gradients(two_mass(), displacement, free=[*names, "machine.stiffness"], routes=[mode], tolerance=1e-5)
    assert check.require().left_out == ()


def test_single_precision_agrees_with_double():
    scene = two_mass()
    double = jv.simulate(scene, 1.0, samples=2)
    with jax.enable_x64(False):
        single = jv.simulate(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), scene), 1.0, samples=2)
        assert single.trajectory.state.displacement.dtype == jnp.float32
        found = last(single)
    np.testing.assert_allclose(found, last(double), atol=2e-4 * np.max(np.abs(last(double))))


def test_exact_periodic_motion_with_friction_is_that_of_a_run():
    rough, smooth = (one_mass(*effects, damping=150.0) for effects in ([jv.FrictionSupport(100.0, width=0.5)], []))
    settled = jv.settle(rough)
    orbit = jv.synchronous_orbit(rough, SimpleNamespace(speed=jnp.asarray(SPEED), phases=jnp.zeros(1)))
    np.testing.assert_allclose(orbit.amplitude, settled.amplitude, rtol=1e-5)
    assert float(orbit.amplitude[0]) < 0.98 * float(jv.settle(smooth).amplitude[0])


def test_growth_with_friction_is_regular():
    assert jv.growth(one_mass(jv.FrictionSupport(60.0), damping=60.0), 20.0).status_name == "regular"


def test_creeping_balls_are_not_advised_to_run_longer():
    """Two balls near their balanced places: exact rolling friction would hold the axis up to an amplitude of 0.31 mm."""
    machine = jv.planar_rotor(mass=48.0, stiffness=3e4, damping="8 %")
    loads = jv.balls(count=2, mass=0.111, radius=0.23, drag=0.3, ball_radius=0.015)
    scene = jv.Scene(machine, loads, jv.ConstantSpeed("1200 rpm"), (jv.RollingFriction(2e-5, width=0.1),))
    still, place = np.zeros(2), np.array([0.05, np.pi - 0.05])
    start = jv.State(still, still, (place,), (np.full(2, float(scene.drive.speed)),))
    text = jv.simulate(scene, 4.0, start=start, save="window").summary()
    assert "not settled: the loads creep, see below (drift" in text
    assert "  the loads creep: dry friction is smoothed over 4.2 rpm" in text
