"""Runs of several exciters against equations written by hand and integrated by SciPy."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxvib as jv

M, K, C, G, END = 80.0, 4e4, 300.0, 9.81, 2.0
UNBALANCE, INERTIA, STALL, NO_LOAD = (0.3, 0.2), (0.06, 0.05), (9.0, 7.0), (100.0, 90.0)
DIRECTION = (1, -1)


def motor(k, stall=None):
    drive = jv.DCMotor(NO_LOAD[k], stall_torque=STALL[k] if stall is None else stall, inertia=INERTIA[k])
    return jv.Exciter(drive=drive, unbalance=UNBALANCE[k], direction=DIRECTION[k])


MACHINE = jv.one_mass(mass=M, stiffness=K, damping=C)
SCENE = jv.Scene(MACHINE, exciters=[motor(0), motor(1)], effects=jv.Gravity())


def by_hand(stall=STALL, end=END):
    """States (y, theta_1, theta_2, and their rates) at the end; both unbalances hang at the start."""

    def rates(_, x):
        y, v = x[0], x[3]
        theta, turn = x[1:3], x[4:6]
        mass, force = np.diag([M, *INERTIA]), np.array([-K * y - C * v, 0.0, 0.0])
        for k in range(2):
            s, c = np.sin(theta[k]), np.cos(theta[k])
            mass[0, 1 + k] = mass[1 + k, 0] = UNBALANCE[k] * c
            force[0] += UNBALANCE[k] * turn[k] ** 2 * s
            torque = DIRECTION[k] * stall[k] * (1.0 - DIRECTION[k] * turn[k] / NO_LOAD[k])
            force[1 + k] += torque - UNBALANCE[k] * G * c
        return np.concatenate([x[3:], np.linalg.solve(mass, force)])

    return solve_ivp(
        rates, (0.0, end), [0.0, -0.5 * np.pi, -0.5 * np.pi, 0.0, 0.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]


def flat(state, at=()):
    rotors = np.array([[np.asarray(x)[at] for x in own.rotor] for own in state.exciters])
    return np.array([state.displacement[at][0], *rotors[:, 0], state.velocity[at][0], *rotors[:, 1]])


def test_a_run_of_two_motors_obeys_the_equations_by_hand():
    run = jv.simulate(SCENE, END, save="window")
    np.testing.assert_allclose(flat(run.window.state, -1), by_hand(), rtol=1e-6, atol=1e-6)
    assert float(run.error) < 1e-6
    np.testing.assert_allclose(run.omega, np.mean(np.asarray(run.load_speed) * DIRECTION), rtol=1e-14)
    turned = [np.ptp(angle) / (run.window.time[-1] - run.window.time[0]) for angle in run.window.rotor_angles]
    np.testing.assert_allclose(np.abs(run.load_speed), turned, rtol=0.05)
    speeds = ", ".join(f"{float(speed) * 30.0 / np.pi:.6g}" for speed in run.load_speed)
    means = f"; means of the window, in which the speeds change: {speeds} rpm\n"
    assert means in run.summary() and "  at the end, exciters turn at " in run.summary() and "rotor" not in run.summary()
    at_end = re.search(r"each: (.*), (.*) rpm; negative", run.summary()).groups()
    last = [float(np.mean(speed[-205:])) * 30.0 / np.pi for speed in run.window.rotor_speeds]
    np.testing.assert_allclose([float(each) for each in at_end], last, rtol=0.02)
    assert run.load_speed[0] > 0.0 > run.load_speed[1]
    stopped = dataclasses.replace(run, load_speed=jnp.asarray([100.0, -0.01]))  # the mean speed has no meaning
    assert stopped.speeds_text(SCENE, run.window.rotor_speeds) == "exciters turn at 954.93, -0.095493 rpm; negative: clockwise"
    varying = dataclasses.replace(stopped, drift=jnp.asarray(1e-6))  # settled
    speeds = [np.array([98.0, 102.0, 100.0]), np.full(3, 50.0)]
    assert varying.speeds_text(SCENE, speeds).endswith("; negative: clockwise; rotor speeds vary by ±19.1 rpm")
    assert varying.speeds_text(SCENE, [0.25 * each + 75.0 for each in speeds]).endswith("; negative: clockwise")


def test_ensembles_of_two_motors_obey_the_equations_by_hand():
    stalls = jnp.asarray([5.0, 9.0, 14.0])
    many = jv.ensemble(
        lambda stall: jv.Scene(MACHINE, exciters=[motor(0, stall), motor(1)], effects=jv.Gravity()),
        stalls,
        END,
        stepsize_controller=jv.EqualSteps(800),
    )
    for k, stall in enumerate(stalls):
        end = jax.tree.map(lambda leaf, k=k: leaf[k], many.state)
        np.testing.assert_allclose(flat(end), by_hand((float(stall), STALL[1])), rtol=1e-6, atol=1e-6)
    assert many.load_speed.shape == (3, 2) and not bool(jnp.any(many.detached))


SPRINGS = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
SCREEN = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)
PLANAR = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
ROLLS = {"rolling": (jv.RollingFriction(3e-5),), "sliding": (jv.RollingFriction(3e-5), jv.FreeSpin(), jv.Sliding(0.2))}


def eight(kind):
    """Eight motors of both directions on a body in a plane, or eight pairs of balls in a torus under ideal drives."""
    if kind == "motors":
        drives = [jv.DCMotor(100.0 + k, stall_torque=60.0 + k, inertia=0.2) for k in range(8)]
        parts = [jv.Exciter(drive=d, unbalance=0.3, at=(0.2 * k, 0.1), direction=(1, -1)[k % 2]) for k, d in enumerate(drives)]
        return jv.Scene(SCREEN, exciters=parts, effects=jv.Gravity())
    balls = [jv.torus_balls(count=2, mass=0.1 + 0.01 * k, radius=0.2, tube=0.015, ball_radius=0.0145) for k in range(8)]
    parts = [jv.Exciter(each, jv.ConstantSpeed(60.0 + k), effects=ROLLS[kind]) for k, each in enumerate(balls)]
    return jv.Scene(PLANAR, exciters=parts, effects=jv.Gravity(along="axis"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["motors", *ROLLS])
def test_reverse_derivatives_of_eight_exciters_equal_differences(kind):
    scene = eight(kind)
    where = (lambda s: s.machine.mass) if kind == "motors" else (lambda s: s.machine.damping)

    def outcome(factor):
        changed = eqx.tree_at(where, scene, factor * where(scene))
        run = jv.simulate(changed, 0.05, stepsize_controller=jv.EqualSteps(100), save="window")
        return jnp.sum(run.window.state.velocity**2)

    value, slope = jax.jit(jax.value_and_grad(outcome))(1.0)
    step, program = 1e-4, jax.jit(outcome)
    around = [float(program(1.0 + k * step)) for k in (-2, -1, 1, 2)]
    difference = np.dot([1.0, -8.0, 8.0, -1.0], around) / (12.0 * step)
    assert abs(slope) > 1e-6 * value
    np.testing.assert_allclose(slope, difference, rtol=1e-7)


def test_share_that_synchronizes_jumps_at_the_closed_form():
    """Opposite motors on soft supports: up to a half difference of their torques of W = w^2 S^2 l_1 l_2 / (2 J)."""
    springs = [jv.support(at=(x, 0.0), stiffness=(1e4, 1e4), damping=(500.0, 500.0)) for x in (-1.0, 1.0)]
    body, speed, slope = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs), 100.0, 3.0

    def screen(difference):
        parts = ((-0.9, 1, speed + difference / 2.0), (0.8, -1, speed - difference / 2.0))
        motors = [(x, way, jv.DCMotor(n, stall_torque=slope * n, inertia=0.2)) for x, way, n in parts]
        return jv.Scene(body, exciters=[jv.Exciter(drive=m, unbalance=1.5, at=(x, 0.0), direction=w) for x, w, m in motors])

    limit = 2.0 * (speed**2 * 1.5**2 * 0.9 * 0.8 / (2.0 * 600.0)) / slope
    many = jv.ensemble(screen, limit * jnp.asarray([0.3, 0.6, 0.9, 0.95, 1.05, 1.1, 1.3, 1.6]), 10.0, estimate=False)
    assert many.synchronous.tolist() == [True] * 4 + [False] * 4
    turned = 2.5 * (many.load_speed[:, 0] + many.load_speed[:, 1])  # the second motor turns clockwise
    np.testing.assert_allclose(many.relative_rotation, np.abs(turned), atol=1e-9)
    # Wilson's interval of 4 of 8 cases.
    half = 1.959964 * np.sqrt(0.25 / 8.0 + 1.959964**2 / (4.0 * 64.0)) / (1.0 + 1.959964**2 / 8.0)
    np.testing.assert_allclose(many.synchronous_share, (0.5, 0.5 - half, 0.5 + half, 4, 8), rtol=1e-9)
    assert "all masses of a run turn at one speed: 4 of 8 runs, 50 % (95 % interval: 21.5 to 78.5 %)" in many.summary()


def test_saved_runs_of_several_exciters_are_read_back(tmp_path):
    run = jv.simulate(SCENE, 0.5, samples=16, estimate=False)
    again = jv.load(run.save(tmp_path / "run"))
    jax.tree.map(np.testing.assert_array_equal, again.trajectory, run.trajectory)
    data = run.to_xarray()
    assert {"displacement", "rotor_angle_1", "rotor_speed_2", "load_speed"} < set(data)
    assert data["load"].values.tolist() == ["1", "2"]


@pytest.mark.parametrize("start", ["rest", "spin_up"])
def test_named_starts_hold_for_every_exciter(start):
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    exciters = [jv.Exciter(loads, jv.ConstantSpeed(40.0)), jv.Exciter(loads, jv.ConstantSpeed(30.0), direction=-1)]
    run = jv.simulate(jv.Scene(MACHINE, exciters=exciters), 1.0, start=start, samples=4, estimate=False)
    begin = [own.angle[0][0] for own in run.trajectory.state.exciters]
    np.testing.assert_allclose(begin, [loads.rest()[0] + np.radians([-0.5, 0.5])] * 2)
    speeds = [float(speed[0]) for speed in run.trajectory.rotor_speeds]
    assert speeds == ([40.0, -30.0] if start == "rest" else [0.0, 0.0])
    np.testing.assert_allclose([speed[-1] for speed in run.trajectory.rotor_speeds], [40.0, -30.0])


def test_two_half_motors_settle_as_one():
    """Below the resonance they stay in step: S Omega^2 / |D| and, to leading order, L(Omega) = c S^2 Omega^5 / (2 |D|^2)."""
    machine, total, top, stall = jv.one_mass(mass=100.0, stiffness=4e5, damping=2000.0), 0.2, 40.0, 10.0

    def half(share):
        drive = jv.DCMotor(top, stall_torque=stall * share, inertia=0.5 * share)
        return jv.Exciter(drive=drive, unbalance=total * share)

    one, two = (jv.settle(jv.Scene(machine, exciters=each), drift=1e-6) for each in ([half(1.0)], [half(0.5)] * 2))
    np.testing.assert_allclose([two.omega, two.amplitude[0]], [one.omega, one.amplitude[0]], rtol=1e-6)
    omega = float(one.omega)
    size = abs(4e5 - 100.0 * omega**2 + 2000.0j * omega)
    np.testing.assert_allclose(one.amplitude[0], total * omega**2 / size, rtol=5e-3)
    np.testing.assert_allclose(stall * (1.0 - omega / top), 2000.0 * total**2 * omega**5 / (2.0 * size**2), rtol=5e-3)


def test_settle_refuses_unbalances_at_different_speeds():
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(speed), unbalance=0.1) for speed in (40.0, 30.0)]
    with pytest.raises(jv.InputError, match=r"exciters have unbalances or supplies at \[30.0, 40.0\] rad/s"):
        jv.settle(jv.Scene(MACHINE, exciters=exciters))
