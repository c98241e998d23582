"""Balls in a torus: their equations against other derivations, friction, limits, and what is said about wrong numbers."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from torus import (
    MASS,
    OWN,
    RADIUS,
    SPEED,
    balls,
    lagrangian_accelerations,
    published,
    rolling_ball_accelerations,
    scene,
    some_state,
)

import jaxvib as jv
from jaxvib.machine.torus import TorusBalls
from jaxvib.results.status import status_names

HEAVY = jv.planar_rotor(mass=1e12, stiffness=0.0, damping=0.0)

evaluate = eqx.filter_jit(lambda s, t, state: jv.vector_field(s)(t, state))


@pytest.mark.parametrize("direction", ["none", "along", "each"])
def test_equations_are_lagranges(direction):
    effects = published(direction=direction) if direction != "none" else ()
    s = scene(effects, drag=0.3)
    friction, gravity = ((4e-5, direction, 0.01), 9.81) if effects else (0.0, 0.0)
    expected = eqx.filter_jit(lambda t, state: lagrangian_accelerations(s, t, state, friction, gravity))
    for seed in range(4):
        state, t = some_state(seed), jnp.asarray(0.3)
        field, right = evaluate(s, t, state), expected(t, state)
        for found, part in ((field.velocity, right[:2]), (field.rate[0], right[2:4]), (field.rate[1], right[4:])):
            np.testing.assert_allclose(found, part, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(part))))


def test_a_balls_own_rotation_is_that_of_newton_and_euler():
    """Against the ball's three-dimensional motion, on a rotor so heavy that it does not move aside."""
    machine = jv.planar_rotor(mass=1e12, stiffness=0.0, damping=0.0)
    s = jv.Scene(machine, balls(1), jv.ConstantSpeed(SPEED), (jv.Gravity(along="axis"),))
    expected = eqx.filter_jit(functools.partial(rolling_ball_accelerations, 0.0025, OWN, SPEED, 9.81))
    for seed in range(4):
        state = some_state(seed, count=1)
        state = jv.State(jnp.zeros(2), jnp.zeros(2), state.angle, state.rate)
        field = evaluate(s, jnp.asarray(0.0), state)
        (f, a), rates = (x[0] for x in state.angle), tuple(x[0] for x in state.rate)
        turned, pressed = expected(f, a, rates)
        np.testing.assert_allclose([field.rate[0][0], field.rate[1][0]], turned, rtol=1e-11)
        np.testing.assert_allclose(jv.normal_force(s, 0.0, state)[0], pressed, rtol=1e-11)


@pytest.mark.parametrize("direction", ["along", "each"])
def test_power_balances_the_energy(direction):
    s = scene(published(1e-4, direction), drag=0.2)

    @eqx.filter_jit
    def growth(t, state):
        change = jv.vector_field(s)(t, state)
        rate = jax.jvp(lambda t, y: jv.energy(s, y, t), (t, state), (jnp.ones_like(t), change))[1]
        return rate, *jv.power(s, t, state)

    for seed in range(3):
        rate, supplied, lost = growth(jnp.asarray(0.7), some_state(seed))
        assert float(lost) > 0.0
        np.testing.assert_allclose(rate, supplied - lost, rtol=1e-10, atol=1e-9 * float(lost))


def test_energy_only_falls_with_friction_and_no_drive():
    """The rotor stands still: nothing puts energy in, friction and the damper take it out."""
    s = scene((jv.Gravity(along="axis"), jv.RollingFriction(4e-5)), speed=1e-9)
    start = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.asarray([0.0, 1.0]), jnp.zeros(2)), (jnp.full(2, 60.0), jnp.ones(2)))
    run = jv.simulate(s, 1.0, start=start, samples=400, stepsize_controller=jv.EqualSteps(4000), estimate=False)
    held = np.asarray(jax.vmap(lambda state: jv.energy(s, state))(run.trajectory.state))
    assert np.all(np.diff(held) < 0.0) and held[-1] < 0.97 * held[0]
    bare = jv.Scene(jv.planar_rotor(mass=6.87, stiffness=1372.0, damping=0.0), s.loads, s.drive, s.all_effects[:1])
    run = jv.simulate(bare, 1.0, start=start, samples=400, stepsize_controller=jv.EqualSteps(4000), estimate=False)
    held = np.asarray(jax.vmap(lambda state: jv.energy(bare, state))(run.trajectory.state))
    np.testing.assert_allclose(held, held[0], rtol=1e-9)


def test_a_ball_on_the_outer_equator_is_one_of_the_plane_track():
    friction = (jv.StaticImbalance(6.87e-3), jv.RollingFriction(4e-5))
    torus = scene(friction, drag=0.3)
    plane = jv.balls(count=2, mass=MASS, radius=torus.loads.radius + torus.loads.gap, drag=0.3, ball_radius=OWN)
    plane = jv.Scene(torus.machine, plane, torus.drive, friction)
    state, quarter = some_state(), jnp.full(2, 0.5 * jnp.pi)
    there = jv.State(state.displacement, state.velocity, (state.angle[0], quarter), (state.rate[0], jnp.zeros(2)))
    flat = jv.State(state.displacement, state.velocity, state.angle[:1], state.rate[:1])
    found, expected = (evaluate(s, jnp.asarray(0.2), y) for s, y in ((torus, there), (plane, flat)))
    np.testing.assert_allclose(found.velocity, expected.velocity, rtol=1e-12)
    np.testing.assert_allclose(found.rate[0], expected.rate[0], rtol=1e-12)
    np.testing.assert_allclose(found.rate[1], 0.0, atol=1e-9)
    forces = [jv.normal_force(s, 0.2, y) for s, y in ((torus, there), (plane, flat))]
    np.testing.assert_allclose(*forces, rtol=1e-12)


def test_a_run_says_when_balls_leave_their_wall():
    s = scene((jv.Gravity(along="axis"), jv.RollingFriction(4e-5)))
    inner = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.asarray([0.0, 3.0]), jnp.asarray([0.0, -1.0])), (jnp.full(2, 130.0),) * 2)
    run = jv.simulate(s, 0.02, start=inner, samples=50, estimate=False)
    assert np.isfinite(run.detached[1]) and float(jv.normal_force(s, 0.0, inner)[1]) < 0.0
    assert "detached: loads lost contact" in run.summary()
    on = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.asarray([0.0, 3.0]), jnp.ones(2)), (jnp.full(2, 130.0), jnp.zeros(2)))
    run = jv.simulate(s, 0.02, start=on, samples=50, estimate=False)
    assert np.all(np.isnan(run.detached)) and "detached" not in run.summary()
    # Without pressing there is no friction, and the rest of the motion is that without it.
    bare = jv.Scene(s.machine, s.loads, s.drive, s.all_effects[:1])
    with_, without = (evaluate(each, jnp.asarray(0.0), inner) for each in (s, bare))
    np.testing.assert_allclose(with_.rate[1][1], without.rate[1][1], rtol=1e-3)


def test_ensemble_names_runs_in_which_balls_leave_the_wall():
    s = scene((jv.Gravity(along="axis"), jv.RollingFriction(4e-5)))

    def make(a):
        place = (jnp.asarray([0.0, 3.0]), jnp.stack([jnp.zeros_like(a), a]))
        return s, jv.State(jnp.zeros(2), jnp.zeros(2), place, (jnp.full(2, 130.0), jnp.zeros(2)))

    steps = jv.EqualSteps(64)
    many = jv.ensemble(make, jnp.asarray([-1.0, 1.0, jnp.nan]), 0.02, stepsize_controller=steps, estimate=False)
    np.testing.assert_array_equal(many.detached[:2], [[False, True], [False, False]])
    assert [str(name) for name in status_names(many.status)] == ["detached", "done", "not_finite"]
    assert "the equations keep it on the track" in many.summary()


def test_frequency_about_the_equator_is_the_resolved_one():
    s = jv.Scene(jv.planar_rotor(mass=1e12, stiffness=0.0, damping=0.0), balls(1), jv.ConstantSpeed(SPEED))
    a = jnp.asarray([0.5 * jnp.pi + 1e-5])
    turning = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1), a), (jnp.full(1, SPEED), jnp.zeros(1)))
    stiffness = -evaluate(s, jnp.asarray(0.0), turning).rate[1][0] / 1e-5
    np.testing.assert_allclose(jnp.sqrt(stiffness), s.loads.natural_frequency(s.drive.speed), rtol=1e-6)


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: balls(ball_radius=0.02), "loads.ball_radius is 0.02 m, which is larger than the tube of 0.015 m"),
        (lambda: balls(ball_radius=0.015), r"which leaves no gap in the tube of 0.015 m radius.*balls\(\.\.\.\)"),
        (lambda: balls(tube=0.25), "loads.tube is 0.25 m; it must be less than the ring's radius"),
        (lambda: balls(51), "loads.ball_radius is 0.0125 m; 51 side by side on a circle of 0.2025 m need a ball_radius below"),
        (lambda: balls(mass=0.0), "loads.mass is 0 kg; it must be greater than 0"),
        (lambda: balls(radius="3 kg"), "loads.radius is '3 kg', which is not in m"),
        (lambda: jv.RollingFriction(-1e-5), "effects.rolling_friction.coefficient is -1e-05 m; it must be at least 0"),
        (lambda: jv.RollingFriction(1e-5, "both"), "rolling_friction.direction is 'both'; allowed: along, each"),
        (lambda: jv.RollingFriction(1e-5, width=0.0), "rolling_friction.width is 0 m/s; it must be greater than 0"),
        (lambda: jv.Gravity(along="down"), "effects.gravity.along is 'down'; allowed: up, axis"),
        (
            lambda: jv.Scene(
                scene().machine,
                jv.pendulums(count=1, mass=1.0, radius=0.1, drag=0.0),
                scene().drive,
                (jv.RollingFriction(1e-5),),
            ),
            "rolling_friction needs loads that roll and have a ball_radius",
        ),
        (
            lambda: jv.Scene(
                scene().machine, jv.balls(count=1, mass=1.0, radius=0.1, drag=0.0), scene().drive, (jv.Gravity(along="axis"),)
            ),
            "effects.gravity.along is 'axis'; it needs loads that move along the rotor's axis",
        ),
    ],
)
def test_wrong_numbers_are_named(build, says):
    with pytest.raises(jv.InputError, match=says):
        build()


def test_zero_friction_equals_no_friction():
    state = some_state()
    zero, bare = (
        evaluate(scene(effects), jnp.asarray(0.0), state)
        for effects in ((jv.Gravity(along="axis"), jv.RollingFriction(0.0)), (jv.Gravity(along="axis"),))
    )
    np.testing.assert_allclose(zero.rate[1], bare.rate[1], rtol=1e-13)
    assert np.all(np.isfinite(zero.rate[0]))
    slope = jax.grad(lambda k: jv.vector_field(scene((jv.RollingFriction(k),)))(0.0, state).rate[0][0])(0.0)
    assert np.isfinite(slope) and float(slope) != 0.0


def test_rolling_friction_has_its_slope_at_no_slip():
    """Without slip the levers are 0; their derivatives are those at a slip of 1e-4 widths."""
    loads, friction = balls(2), jv.RollingFriction(1e-4, width=0.1)
    u, speed = (jnp.asarray([0.1, 2.0]), jnp.asarray([1.0, 0.5])), jnp.asarray(30.0)

    def levers(slip):
        found = friction.friction(loads, u, (speed + slip[0] * jnp.ones(2), slip[1] * jnp.ones(2)), speed, {})
        return jnp.concatenate([found.lever, *found.others])

    slopes = jax.jit(jax.jacfwd(levers))
    np.testing.assert_allclose(levers(jnp.zeros(2)), 0.0)
    np.testing.assert_allclose(slopes(jnp.zeros(2)), slopes(jnp.full(2, 1e-5 / RADIUS)), rtol=1e-6, atol=1e-13)
    assert np.all(np.diagonal(np.asarray(slopes(jnp.zeros(2)))[::2]) < 0.0)


def test_balls_side_by_side_on_the_outer_equator_touch():
    loads = jv.torus_balls(count=3, mass=0.05, radius=0.1, tube=0.05, ball_radius=0.02)
    x, y, _ = loads.position(loads.offsets(), jnp.full(3, 0.5 * jnp.pi))
    np.testing.assert_allclose(np.hypot(np.diff(x), np.diff(y)), 2.0 * 0.02, rtol=1e-12)


@pytest.mark.parametrize("along", ["axis", "up"])
def test_rolling_friction_holds_a_ball_on_a_slope(along):
    """Up the wall of a tube that lies level, and along the outer equator of a ring that stands upright."""
    share, width = 0.05, 1e-4
    friction = jv.RollingFriction(share * OWN, width=width)
    s = jv.Scene(HEAVY, balls(1), jv.ConstantSpeed(1e-9), (jv.Gravity(along=along), friction))
    i, arm = (1, 0.0025) if along == "axis" else (0, RADIUS + 0.0025)

    def climbs(slope, rate):
        """The acceleration up the slope, in the ball's, at a speed in widths."""
        u = (0.0, slope) if i == 1 else (slope - 0.5 * jnp.pi, 0.5 * jnp.pi)
        rates = [0.0, 0.0]
        rates[i] = rate * width / arm
        pairs = (tuple(jnp.asarray([x]) for x in pair) for pair in (u, rates))
        return float(evaluate(s, 0.0, jv.State(jnp.zeros(2), jnp.zeros(2), *pairs)).rate[i][0]) * 1.4 * arm / 9.81

    gentle, steep = 0.6 * share, 2.0 * share
    close = dict(rtol=3e-3, atol=3e-3 * gentle)
    # It sticks: from rest it falls, until it creeps, and faster than that it is stopped; a steeper wall it rolls down.
    np.testing.assert_allclose(climbs(gentle, 0.0), -np.sin(gentle), **close)
    np.testing.assert_allclose(climbs(gentle, -np.arctanh(np.tan(gentle) / share)), 0.0, **close)
    for sign in (1.0, -1.0):
        held = -np.sin(gentle) - sign * share * np.cos(gentle)
        np.testing.assert_allclose(climbs(gentle, sign * 20.0), held, **close)
    assert climbs(gentle, -20.0) > 0.0 > climbs(steep, -20.0)
    np.testing.assert_allclose(climbs(steep, -20.0), share * np.cos(steep) - np.sin(steep), **close)


def mujoco_torus(s, step=1e-5):
    """A sprung rotor in MuJoCo's words, and on it masses on two hinges: about the axis, and about the tube's middle line."""
    m, loads = s.machine, s.loads
    bodies = "".join(
        f"""<body><joint name="f{j}" type="hinge" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="1e-14" diaginertia="1e-14 1e-14 1e-14"/>
        <body pos="{loads.radius:.17g} 0 0"><joint name="a{j}" type="hinge" axis="0 -1 0"/>
        <inertial pos="0 0 {-loads.gap:.17g}" mass="{loads.mass:.17g}" diaginertia="1e-14 1e-14 1e-14"/></body></body>"""
        for j in range(2)
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 -9.81"/><compiler autolimits="false"/>
        <worldbody><body><joint name="x" type="slide" axis="1 0 0" stiffness="{m.stiffness:.17g}" damping="{m.damping:.17g}"/>
        <joint name="y" type="slide" axis="0 1 0" stiffness="{m.stiffness:.17g}" damping="{m.damping:.17g}"/>
        <inertial pos="0 0 0" mass="{m.mass:.17g}" diaginertia="1 1 1"/>{bodies}</body></worldbody></mujoco>"""
    )


class Sliding(TorusBalls):
    """Balls that slide without friction and do not turn: all that MuJoCo's hinges can say."""

    def inertia_factor(self):
        return jnp.asarray(1.0)

    def spin_force(self, u, rate, speed):
        return None


def wide_scene(kind=TorusBalls):
    """A wide tube and heavy balls, so that everything acts on everything."""
    loads = jv.torus_balls(count=2, mass=0.5, radius=0.3, tube=0.15, ball_radius=0.05)
    loads = kind(**{field.name: getattr(loads, field.name) for field in dataclasses.fields(loads)})
    machine = jv.planar_rotor(mass=4.0, stiffness=6e3, damping=20.0)
    return jv.Scene(machine, loads, jv.ConstantSpeed(30.0), (jv.Gravity(along="axis"),))


def test_balls_that_slide_move_as_in_mujoco():
    s, n, step = wide_scene(Sliding), 20000, 1e-5
    model = mujoco_torus(s, step)
    data = mujoco.MjData(model)
    # MuJoCo's order: x, y, then f and a of each ball.
    data.qpos[:] = [2e-3, -1e-3, 0.2, 0.4, 2.9, -1.1]
    data.qvel[:] = [0.1, 0.0, 25.0, 3.0, 31.0, -8.0]
    f, a = np.array([2, 4]), np.array([3, 5])
    state = jv.State(*(jnp.asarray(x[:2]) for x in (data.qpos, data.qvel)), *((x[f], x[a]) for x in (data.qpos, data.qvel)))
    state = jax.tree.map(jnp.array, state)
    mujoco.mj_step(model, data, nstep=n)
    run = jv.simulate(s, step * n, start=state, stepsize_controller=jv.Tolerance(1e-11), samples=2, estimate=False)
    end = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
    np.testing.assert_allclose(end.displacement, data.qpos[:2], atol=1e-8)
    np.testing.assert_allclose(end.angle, [data.qpos[f], data.qpos[a]], atol=1e-6)
    np.testing.assert_allclose(end.rate, [data.qvel[f], data.qvel[a]], atol=1e-4)
    assert np.ptp(run.trajectory.state.angle[1]) > 1.0


def test_rolling_balls_agree_with_mujoco_and_their_rotation():
    """MuJoCo's mass matrix and forces of the masses, and of a rolling ball (2/5) m (B^2 f' (f' - w) + rho^2 a'^2)/2."""
    s = wide_scene()
    model = mujoco_torus(s)
    data, loads, w = mujoco.MjData(model), s.loads, float(s.drive.speed)
    extra, radius, gap = 0.4 * float(loads.mass), float(loads.radius), float(loads.gap)
    for seed in range(3):
        state = some_state(seed)
        (f, a), (df, da) = np.asarray(state.angle), np.asarray(state.rate)
        for place, carried, pair in ((data.qpos, state.displacement, (f, a)), (data.qvel, state.velocity, (df, da))):
            place[:] = [*carried, *np.stack(pair, axis=1).ravel()]
        mujoco.mj_forward(model, data)
        mass = np.zeros((6, 6))
        for k, unit in enumerate(np.eye(6)):
            mujoco.mj_mulM(model, data, mass[k], unit)
        force = data.qfrc_passive - data.qfrc_bias
        arm, bend = radius + gap * np.sin(a), gap * np.cos(a)
        mass += np.diag([0.0, 0.0, *extra * np.stack([arm**2, np.full(2, gap**2)], axis=1).ravel()])
        turn = -2.0 * extra * arm * bend * da * df + extra * arm * bend * w * da
        climb = extra * arm * bend * df * (df - w)
        force[2:] += np.stack([turn, climb], axis=1).ravel()
        expected = np.linalg.solve(mass, force)
        found = evaluate(s, jnp.asarray(0.0), state)
        np.testing.assert_allclose(found.velocity, expected[:2], rtol=1e-9)
        np.testing.assert_allclose(np.stack(found.rate, axis=1).ravel(), expected[2:], rtol=1e-9, atol=1e-6)
