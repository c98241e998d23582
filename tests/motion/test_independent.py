"""Motion in time against independent engines, the energy balance and leading order."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scenes import published
from scipy.integrate import solve_ivp
from small_machine import GRAVITY, small_machine, small_run, small_start

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.ode.control import PIController


def mujoco_model(s, gravity):
    """The small machine in MuJoCo's own words: slides, a tendon for the link, hinges that turn x toward z."""
    m, load = s.machine, s.loads
    given = (load.mass, load.radius, load.inertia, load.drag)
    mass, radius, inertia, drag = (np.broadcast_to(np.asarray(x), (3,)) for x in given)
    bobs = "".join(
        f"""<body><joint name="phi{k}" type="hinge" axis="0 -1 0" damping="{drag[k] * radius[k] ** 2:.17g}"/>
        <inertial pos="{radius[k]:.17g} 0 0" mass="{mass[k]:.17g}" diaginertia="0.01 {inertia[k]:.17g} 0.01"/></body>"""
        for k in range(3)
    )
    platforms = "".join(
        f"""<body><joint name="y{k}" type="slide" axis="0 0 1"
        stiffness="{m.stiffness[k]:.17g}" damping="{m.damping[k]:.17g}"/>
        <inertial pos="0 0 0" mass="{m.mass[k]:.17g}" diaginertia="1 1 1"/>{bobs if k else ""}</body>"""
        for k in range(2)
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler boundmass="0" boundinertia="0" balanceinertia="true"/>
        <option timestep="0.001" integrator="RK4" gravity="0 0 {-gravity}"/><worldbody>{platforms}</worldbody>
        <tendon><fixed stiffness="{m.link_stiffness[0]:.17g}" damping="{m.link_damping[0]:.17g}" springlength="0 0">
        <joint joint="y0" coef="1"/><joint joint="y1" coef="-1"/></fixed></tendon></mujoco>"""
    )


@pytest.mark.parametrize("gravity", [0.0, GRAVITY])
def test_motion_is_mujocos(gravity):
    """An engine that knows rigid bodies, not this machine: three loads, two platforms, 20 s, every state to 1e-6."""
    s = small_machine((jv.Gravity(gravity),) if gravity else ())
    model, start = mujoco_model(s, gravity), small_start()
    data = mujoco.MjData(model)
    carried = np.asarray(s.machine.mass) + np.array([0.0, np.sum(np.asarray(s.loads.mass))])
    # MuJoCo counts from unloaded springs, jaxvib from static equilibrium.
    sag = np.linalg.solve(np.asarray(s.machine.carrier().stiffness), -gravity * carried)
    data.qpos[:] = np.concatenate([start.displacement + sag, start.angle[0]])
    data.qvel[:] = np.concatenate([start.velocity, start.rate[0]])
    data.qfrc_applied[2:] = np.asarray(s.loads.drag * s.loads.radius**2) * 3.0
    states = []
    for _ in range(20):
        mujoco.mj_step(model, data, nstep=1000)
        states.append(np.concatenate([data.qpos[:2] - sag, data.qpos[2:], data.qvel]))
    run = small_run(s.all_effects, stepsize_controller=jv.Tolerance(1e-11))
    y = run.trajectory.state
    ours = np.concatenate([y.displacement, y.angle[0], y.velocity, y.rate[0]], axis=1)[1:]
    np.testing.assert_allclose(ours, states, atol=1e-6)
    assert np.ptp(ours[:, 1]) > 0.1 and np.ptp(ours[:, 2]) > (0.5 if gravity else 10.0)


def test_mujoco_agrees_on_a_planar_rotor_with_loads():
    """Two pendulums on a body with springs across and up, under gravity, driven by their drag alone, 0.3 s by MuJoCo's RK4."""
    stiffness, damping, drag, speed, step, n = 4e4, 30.0, 0.8, 60.0, 1e-5, 30000
    bodies = "".join(
        f"""<body name="b{j}"><joint name="f{j}" type="hinge" axis="0 -1 0"/>
        <inertial pos="0.08 0 0" mass="0.4" diaginertia="2e-5 2e-5 2e-5"/></body>"""
        for j in range(2)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 0"/>
        <compiler autolimits="false"/><worldbody><body name="rotor">
        <joint name="y" type="slide" axis="1 0 0" stiffness="{stiffness}" damping="{damping}"/>
        <joint name="z" type="slide" axis="0 0 1" stiffness="{stiffness}" damping="{damping}"/>
        <inertial pos="0 0 0" mass="20" diaginertia="1 1 1"/>{bodies}</body></worldbody></mujoco>"""
    )
    s = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=stiffness, damping=damping),
        jv.pendulums(count=2, mass=0.4, radius=0.08, drag=drag, inertia=2e-5),
        jv.ConstantSpeed(speed),
        (jv.Gravity(),),
    )
    data = mujoco.MjData(model)
    start = np.array([1e-3, -2e-3, 0.3, 1.9])
    data.qpos[:] = start

    def drive(model, data):
        data.qfrc_applied[2:] = drag * 0.08**2 * (speed - data.qvel[2:]) - 0.4 * 9.81 * 0.08 * np.cos(data.qpos[2:])

    mujoco.set_mjcb_passive(None)
    mujoco.set_mjcb_control(drive)
    try:
        for _ in range(n):
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    state = jv.State(jnp.asarray(start[:2]), jnp.zeros(2), (jnp.asarray(start[2:]),), (jnp.zeros(2),))
    run = jv.simulate(s, step * n, start=state, stepsize_controller=jv.Tolerance(1e-11), samples=2)
    end = run.trajectory.state
    np.testing.assert_allclose(end.displacement[-1], data.qpos[:2], atol=1e-8)
    np.testing.assert_allclose(end.angle[0][-1], data.qpos[2:], atol=1e-6)


def test_smaller_tolerance_means_smaller_error():
    """SciPy's DOP853 of the same vector field as a second integrator; the error follows the tolerance."""
    s, start = small_machine(), small_start()
    flat, unflat = ravel_pytree(start)
    field = jv.vector_field(s)
    right = jax.jit(lambda t, y: ravel_pytree(field(t, unflat(y)))[0])
    exact = solve_ivp(lambda t, y: np.asarray(right(t, y)), (0.0, 20.0), flat, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    error = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        run = small_run(stepsize_controller=jv.Tolerance(tolerance))
        last = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
        error.append(np.max(np.abs(ravel_pytree(last)[0] - exact)))
    assert all(b < 0.1 * a for a, b in itertools.pairwise(error)), error
    assert error[-1] < 1e-8


@pytest.mark.parametrize("case", ["plain", "gravity", "spin_up"])
def test_energy_is_what_the_rotor_gives_less_what_is_dissipated(case):
    drive = jv.SpinUp(3.0, duration=8.0) if case == "spin_up" else None
    s = small_machine((jv.Gravity(GRAVITY),) if case == "gravity" else (), drive)
    field = jv.vector_field(s)

    def with_work(t, y, args):
        state, _, _ = y
        given, lost = jv.power(s, t, state)
        return field(t, state), given, lost

    start, zero = small_start(), jnp.zeros(())
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(with_work),
        diffrax.Tsit5(),
        0.0,
        20.0,
        0.01,
        (start, zero, zero),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
        max_steps=100_000,
    )
    end, given, lost = jax.tree.map(lambda leaf: leaf[-1], solution.ys)
    change = jv.energy(s, end) - jv.energy(s, start)
    assert float(given) > 0.5 and float(lost) > 0.1
    np.testing.assert_allclose(given - lost, change, atol=1e-8 * float(given))


def test_jam_in_time_nears_leading_order_as_loads_get_light():
    """Half the loads' share of the mass, half the difference."""

    def difference(eps):
        s = published(speed=1.5, damping=0.05, eps=eps).scene()
        jam = jv.jam_modes(s).select(3, throw=False)
        run = jv.simulate(s, 3000.0, start="jam", mode=3, save="window", window_periods=4, max_steps=2**15, throw=False)
        return jnp.append(run.amplitude / jam.amplitude, run.omega / jam.omega) - 1.0, run.settled

    error, settled = eqx.filter_jit(jax.vmap(difference))(jnp.asarray([8e-3, 4e-3, 2e-3]))
    assert bool(settled.all())
    assert float(jnp.abs(error[0]).max()) < 1e-3
    # The first platform's difference is small and still feels the next order.
    np.testing.assert_allclose(error[:-1] / error[1:], jnp.asarray([[2.15, 2.0, 2.0]] * 2), rtol=0.05)


def test_soft_mount_under_a_fast_rotor_has_no_aliasing():
    """20 periods of the lowest frequency are thousands of turns of the rotor: the window has to be shorter than that."""
    machine = jv.two_mass(
        mass=(400.0, 40.0), stiffness=(300.0, 0.0), damping=(10.0, 0.0), link_stiffness=4e5, link_damping=50.0
    )
    s = jv.Scene(machine, jv.balls(count=1, mass=0.2, radius=0.05, drag=3.0), jv.ConstantSpeed("3000 rpm"))
    run = jv.simulate(s, 40.0, start="jam", mode=5, save="window", stepsize_controller=jv.Tolerance(1e-7))
    jam = jv.jam_modes(s).select(5)
    np.testing.assert_allclose(run.amplitude[1], jam.amplitude[1], rtol=2e-2)
    np.testing.assert_allclose(run.omega, jam.omega, rtol=1e-4)


def test_loads_in_contact_keep_their_order_and_their_distance():
    """Four balls, pressed together at rest, spun up: they touch, never pass, and overlap by no more than the spring allows."""
    diameter, stiffness = 0.03, 2e5
    s = jv.Scene(
        jv.planar_rotor(mass=5.0, stiffness=2e4, damping=40.0),
        jv.balls(count=4, mass=0.1, radius=0.1, drag=0.3, ball_radius=0.5 * diameter),
        jv.ConstantSpeed(60.0),
        (jv.Gravity(), jv.LoadContact(stiffness=stiffness, damping=30.0)),
    )
    start = jv.initial_state(s)
    step = 2.0 * np.arcsin(diameter / 0.2)
    np.testing.assert_allclose(np.diff(start.angle[0]), step, rtol=1e-12)
    run = jv.simulate(s, 3.0, start=start, stepsize_controller=jv.Tolerance(1e-7))
    angle = np.asarray(run.trajectory.state.angle[0])
    gaps = np.diff(np.concatenate([angle, angle[:, :1] + 2.0 * np.pi], axis=1), axis=1)
    assert np.all(gaps > 0.9 * step)
    assert np.any(gaps[:, :3] < step)


@pytest.mark.slow
def test_the_energy_balance_closes_over_ten_thousand_turns():
    """Energy from the rotor less losses is the stored energy: to 10 tolerances of that, and 0.1 of what it gave."""
    s, tolerance = published(speed=3.0, eps=0.05).scene(), jnp.asarray(1e-8)
    field, unit, start = jv.vector_field(s), natural_units(s), jv.initial_state(s)

    def with_work(t, y, args):
        return (field(t, y[0]), *jv.power(s, t, y[0]))

    def spread(length, speed, angle, rate):
        return jax.tree.map(lambda x, v: jnp.full_like(x, v), start, jv.State(length, speed, (angle,), (rate,)))

    # The work has no error of its own that would shorten a step.
    units = (spread(unit.displacement, unit.velocity, 1.0, unit.rate[0]), jnp.asarray(jnp.inf), jnp.asarray(jnp.inf))
    relative = (spread(1.0, 1.0, 0.0, 1.0), jnp.zeros(()), jnp.zeros(()))
    until = 1e4 * 2.0 * np.pi / 3.0
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(with_work),
        diffrax.Dopri8(),
        0.0,
        until,
        0.01,
        (start, jnp.zeros(()), jnp.zeros(())),
        stepsize_controller=PIController(tolerance, units, relative),
        max_steps=2**20,
        adjoint=diffrax.ForwardMode(),
    )
    end, given, lost = jax.tree.map(lambda leaf: leaf[-1], found.ys)
    left = abs(float(jv.energy(s, end) - jv.energy(s, start) - (given - lost)))
    assert left < 10.0 * float(tolerance) * float(jv.energy(s, end))
    assert left < 0.1 * float(tolerance) * float(given)


def test_motion_of_a_chain_of_platforms_is_scipys():
    """Twelve platforms, whose matrices are multiplied as a product, by a method and equations of its own."""
    n, mass, stiffness, damping = 12, 100.0, 2e5, 30.0
    machine = jv.network(
        mass=[mass] * n, stiffness=[2e4] * n, damping=[damping] * n, links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[stiffness] * (n - 1), link_damping=[damping] * (n - 1), exciter=n,
    )  # fmt: skip
    m, radius, drag, speed = 3.0, 0.1, 0.5, 60.0
    scene = jv.Scene(machine, jv.balls(count=1, mass=m, radius=radius, drag=drag), jv.ConstantSpeed(speed))
    start = jv.initial_state(scene)
    run = jv.simulate(scene, 1.0, start=start, save="window", estimate=False, stepsize_controller=jv.Tolerance(1e-10))
    joined = np.diff(np.eye(n), axis=0)
    matrix = joined.T @ joined
    inertia = 1.4 * m * radius**2

    def rates(_, y):
        q, v, angle, rate = y[:n], y[n : 2 * n], y[2 * n], y[2 * n + 1]
        left = np.diag(np.append(np.full(n, mass), inertia))
        left[n - 1, n - 1] += m
        left[n - 1, n] = left[n, n - 1] = m * radius * np.cos(angle)
        right = np.append(-(2e4 * q + stiffness * matrix @ q) - damping * (v + matrix @ v), drag * radius**2 * (speed - rate))
        right[n - 1] += m * radius * np.sin(angle) * rate**2
        change = np.linalg.solve(left, right)
        return np.concatenate([v, change[:n], [rate, change[n]]])

    exact = solve_ivp(rates, (0.0, 1.0), ravel_pytree(start)[0], method="DOP853", rtol=1e-11, atol=1e-14).y[:, -1]
    state = run.window.state
    scale = np.max(np.abs(exact[:n]))
    np.testing.assert_allclose(state.displacement[-1], exact[:n], rtol=0.0, atol=1e-7 * scale)
    np.testing.assert_allclose(state.angle[0][-1], exact[2 * n : 2 * n + 1], rtol=0.0, atol=1e-7)
