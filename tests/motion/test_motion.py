"""PackedSystem in time against independent engines, energy, leading order; and what a run can do."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scenes import published, scene
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxvib as jv
from jaxvib.motion.analysis.measure import measure

GRAVITY = 9.81


def small_machine(effects=(), drive=None):
    """A machine whose motion is of order 1 in 20 s: three different pendulums shake two platforms hard."""
    machine = jv.two_mass(mass=(2.0, 1.5), stiffness=(3.0, 2.0), damping=(0.1, 0.05), link_stiffness=4.0, link_damping=0.2)
    pendulums = jv.pendulums(count=3, mass=[0.1, 0.12, 0.15], radius=0.5, drag=[0.2, 0.25, 0.3], inertia=[0.001, 0.002, 0.003])
    return jv.Scene(machine, pendulums, drive or jv.ConstantSpeed(3.0), effects)


def small_start():
    return jv.State(
        jnp.asarray([0.05, -0.03]), jnp.asarray([0.1, 0.2]), (jnp.asarray([0.3, -1.0, 2.0]),), (jnp.asarray([1.0, 0.5, -0.5]),)
    )


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
    run = jv.simulate(s, 20.0, start=start, samples=21, tolerance=1e-11)
    y = run.trajectory.state
    ours = np.concatenate([y.displacement, y.angle[0], y.velocity, y.rate[0]], axis=1)[1:]
    np.testing.assert_allclose(ours, states, atol=1e-6)
    assert np.ptp(ours[:, 1]) > 0.1 and np.ptp(ours[:, 2]) > (0.5 if gravity else 10.0)


def test_smaller_tolerance_means_smaller_error():
    """SciPy's DOP853 of the same vector field as a second integrator; the error follows the tolerance."""
    s, start = small_machine(), small_start()
    flat, unflat = ravel_pytree(start)
    field = jv.vector_field(s)
    right = jax.jit(lambda t, y: ravel_pytree(field(t, unflat(y)))[0])
    exact = solve_ivp(lambda t, y: np.asarray(right(t, y)), (0.0, 20.0), flat, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    error = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        run = jv.simulate(s, 20.0, start=start, samples=2, tolerance=tolerance)
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
        run = jv.simulate(s, 3000.0, start="jam", mode=3, save="window", turns=4, max_steps=2**15, throw=False)
        return jnp.append(run.amplitude / jam.amplitude, run.omega / jam.omega) - 1.0, run.settled

    error, settled = jax.jit(jax.vmap(difference))(jnp.asarray([8e-3, 4e-3, 2e-3]))
    assert bool(settled.all())
    assert float(jnp.abs(error[0]).max()) < 1e-3
    # The first platform's difference is small and still feels the next order.
    np.testing.assert_allclose(error[:-1] / error[1:], jnp.asarray([[2.15, 2.0, 2.0]] * 2), rtol=0.05)


def test_measure_reads_a_known_motion():
    """Samples miss the extrema and the whole turns: both are read off between them."""
    s = scene("two_mass", "balls")
    w, n = 7.0, 3
    a, c = jnp.asarray([2e-3, 5e-3]), jnp.asarray([0.3, 1.1])
    t = jnp.linspace(1.0, 6.0, 301)
    angle, phase = w * t[:, None], c[None, :]
    states = jv.State(
        a[None, :] * jnp.cos(angle + phase) + 0.7,
        -w * a[None, :] * jnp.sin(angle + phase),
        (jnp.broadcast_to(angle, (301, n)) + jnp.asarray([0.0, 0.4, 2.0])[None, :],),
        (jnp.full((301, n), w),),
    )

    def field(_, y):
        return jv.State(y.velocity, -(w**2) * (y.displacement - 0.7), y.rate, (jnp.zeros(n),))

    measured = measure(s, field, t, states)
    force = np.abs(np.sum((np.asarray(s.machine.stiffness) + 1j * w * np.asarray(s.machine.damping)) * a * np.exp(1j * c)))
    np.testing.assert_allclose(measured.amplitude, a, rtol=1e-6)
    np.testing.assert_allclose(measured.foundation_force, force, rtol=1e-6)
    np.testing.assert_allclose(measured.omega, w, rtol=1e-9)
    np.testing.assert_allclose(measured.load_speed, w, rtol=1e-9)
    assert bool(measured.settled)


def test_derivatives_of_an_amplitude_move_its_extrema_along():
    """x = cos wt + p cos(2wt + 0.3): slope and curvature in p of half of peak to peak, against extrema found by bisection."""
    s, w = scene("one_mass", "balls"), 7.0
    t = jnp.linspace(0.0, 4.0, 512)

    def moving(p, t):
        return jnp.cos(w * t) + p * jnp.cos(2.0 * w * t + 0.3)

    def amplitude(p):
        rate, bend = jax.grad(moving, 1), jax.grad(jax.grad(moving, 1), 1)
        at = lambda f: jax.vmap(f, in_axes=(None, 0))(p, t)[:, None]  # noqa: E731
        states = jv.State(at(moving), at(rate), (jnp.zeros((512, 3)),), (jnp.full((512, 3), w),))

        def field(p, t, y):
            return jv.State(y.velocity, bend(p, t)[None], y.rate, (jnp.zeros(3),))

        return measure(s, jax.tree_util.Partial(field, p), t, states).amplitude[0]

    def exactly(p):
        ends = []
        for low, high in ((-0.2, 0.2), (np.pi - 0.9, np.pi + 0.9)):
            slope = lambda u: -np.sin(u) - 2.0 * p * np.sin(2.0 * u + 0.3)  # noqa: E731
            u = brentq(slope, low, high, xtol=1e-15, rtol=1e-15)
            ends.append((u, np.cos(u) + p * np.cos(2.0 * u + 0.3)))
        value = (ends[0][1] - ends[1][1]) / 2.0
        # By the implicit function theorem: dV/dp is that at a fixed place, d2V/dp2 = -(d2x/dp du)^2/(d2x/du2).
        first = [np.cos(2.0 * u + 0.3) for u, _ in ends]
        second = [-((-2.0 * np.sin(2.0 * u + 0.3)) ** 2) / (-np.cos(u) - 4.0 * p * np.cos(2.0 * u + 0.3)) for u, _ in ends]
        return value, (first[0] - first[1]) / 2.0, (second[0] - second[1]) / 2.0

    p = 0.12
    value, slope, curvature = exactly(p)
    np.testing.assert_allclose(amplitude(p), value, rtol=1e-7)
    for way in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(way(amplitude))(p), slope, rtol=1e-5)
        np.testing.assert_allclose(jax.jit(jax.jacfwd(way(amplitude)))(p), curvature, rtol=1e-3)


def test_a_growing_motion_is_not_settled():
    run = jv.simulate(small_machine(), 5.0, start=small_start())
    assert not bool(run.settled) and "not settled" in run.summary()


def test_a_long_run_keeps_its_phase():
    """Angles grow to a thousand turns; were their tolerance relative, so would their error."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    free = jv.Scene(machine, jv.pendulums(count=1, mass=1e-9, radius=0.1, drag=1e-9), jv.ConstantSpeed(100.0))
    start = eqx.tree_at(lambda y: (y.angle, y.rate), jv.initial_state(free), ((jnp.zeros(1),), (jnp.full(1, 100.0),)))
    run = jv.simulate(free, 63.0, start=start, samples=2, tolerance=1e-7)
    assert abs(float(run.trajectory.state.angle[0][-1, 0]) - 6300.0) < 1e-5


# The run as an object


@pytest.fixture(scope="module")
def run():
    return jv.simulate(small_machine((jv.Gravity(),)), 20.0, start=small_start(), samples=101)


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype


def test_a_saved_run_is_read_back_bit_for_bit(run, tmp_path):
    again = jv.Run.load(run.save(tmp_path / "run"))
    same(again, run)
    assert again.summary() == run.summary()
    short = jv.simulate(small_machine(), 2.0, start=small_start(), save="window")
    back = jv.Run.load(short.save(tmp_path / "short.npz"))
    assert back.trajectory is None
    same(back, short)


def test_reading_what_is_no_run_is_an_input_error(tmp_path):
    with pytest.raises(jv.InputError, match="there is no such file"):
        jv.Run.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no run")
    np.savez(tmp_path / "other.npz", x=np.zeros(2))
    for name in ("text.npz", "other.npz"):
        with pytest.raises(jv.InputError, match=r"it is no run written by Run\.save"):
            jv.Run.load(tmp_path / name)


def test_to_xarray_has_names_and_units(run):
    data = run.to_xarray()
    assert dict(data.sizes) == {"time": 101, "coordinate": 2, "load": 3, "direction": 1}
    assert data["displacement"].attrs["units"] == "m" and data["time"].attrs["units"] == "s"
    np.testing.assert_array_equal(data["displacement"].sel(coordinate="y2"), run.trajectory.state.displacement[:, 1])
    assert data.attrs["status"] == "the run reached its end"


def test_summary_and_plot_show_the_run(run):
    assert run.summary().startswith("the run reached its end: 20 s") and "zero to peak: y1" in run.summary()
    assert len(run.plot().axes) == 3


def test_window_alone_measures_the_same(run):
    window = jv.simulate(small_machine((jv.Gravity(),)), 20.0, start=small_start(), save="window")
    assert window.trajectory is None and len(window.plot().axes) == 3
    np.testing.assert_allclose(window.amplitude, run.amplitude, rtol=1e-12)
    np.testing.assert_allclose(window.omega, run.omega, rtol=1e-12)
    np.testing.assert_allclose(window.foundation_force, run.foundation_force, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (dict(until=-1.0), "until is -1 s; it must be greater than 0"),
        (dict(until="3 kg"), "until is '3 kg', which is not in s"),
        (dict(start="warm"), "start is 'warm'; it must be 'rest', 'jam' or 'spin_up'"),
        (dict(start="jam"), "mode is missing"),
        (dict(start="jam", mode=9), "mode is 9; this machine's jam modes are numbered 1 to 5"),
        (dict(mode=3), "mode is 3, which goes with start='jam' only"),
        (dict(tolerance=1e-17), "tolerance is 1e-17; in float64 it must be at least 2e-15 and less than 1"),
        (dict(tolerance=2.0), "tolerance is 2.0; in float64"),
        (dict(spin_up=3.0), "spin_up goes with start='spin_up' only"),
        (dict(start="spin_up", spin_up=-3.0), "drive.duration is -3 s; it must be greater than 0"),
        (dict(save="none"), "save is 'none'; it must be 'all' or 'window'"),
        (dict(samples=1), "samples is 1; it must be a whole number, at least 2"),
        (dict(turns=0), "turns is 0"),
        (dict(max_steps=0), "max_steps is 0"),
    ],
)
def test_wrong_arguments_are_one_sentence(arguments, sentence):
    with pytest.raises(jv.InputError) as error:
        jv.simulate(published().scene(), **{"until": 10.0, **arguments})
    assert str(error.value).startswith(sentence)


def test_a_mode_that_is_not_there_is_no_start():
    with pytest.raises(jv.ComputationError, match="jam mode 1 does not exist at rotor speed 3 rad/s; there: 3, 4, 5"):
        jv.simulate(published().scene(), 10.0, start="jam", mode=1)


def test_spin_up_of_a_drive_that_spins_up_is_refused():
    with pytest.raises(jv.InputError, match="the drive is 'spin_up' already"):
        jv.simulate(small_machine(drive=jv.SpinUp(3.0, 2.0)), 5.0, start="spin_up")


def test_spin_up_starts_at_rest_and_ends_at_speed():
    run = jv.simulate(small_machine(), 10.0, start="spin_up", spin_up=4.0, samples=11)
    np.testing.assert_allclose(run.trajectory.rotor_speed[jnp.asarray([0, 2, 4, 10])], [0.0, 1.5, 3.0, 3.0], atol=1e-12)
    assert float(jnp.max(jnp.abs(run.trajectory.state.rate[0][0]))) == 0.0


def test_what_float32_cannot_deliver_is_refused():
    with jax.enable_x64(False), pytest.raises(jv.InputError, match=r"in float32 .* switch JAX to float64"):
        jv.simulate(published().scene(), 10.0, tolerance=1e-8)


def test_batch_over_rotor_speeds_is_a_loop():
    s, speeds = small_machine(), jnp.asarray([2.0, 3.0, 5.0])

    def one(n):
        moved = eqx.tree_at(lambda x: x.drive.speed, s, n)
        run = jv.simulate(moved, 5.0, start=small_start(), save="window", max_steps=4096)
        return run.amplitude, run.omega, run.steps

    batch = jax.jit(jax.vmap(one))(speeds)
    for k, n in enumerate(speeds):
        for a, b in zip(batch, one(n), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-8)


def test_a_start_given_whole_takes_no_mode():
    s = published(eps=1e-3).scene()
    with pytest.raises(jv.InputError, match="leave it out"):
        jv.simulate(s, 1.0, start=jv.initial_state(s), mode=3)


def test_a_soft_mount_under_a_fast_rotor_is_measured_without_aliasing():
    """20 periods of the lowest frequency are thousands of turns of the rotor: the window has to be shorter than that."""
    machine = jv.two_mass(
        mass=(400.0, 40.0), stiffness=(300.0, 0.0), damping=(10.0, 0.0), link_stiffness=4e5, link_damping=50.0
    )
    s = jv.Scene(machine, jv.balls(count=1, mass=0.2, radius=0.05, drag=3.0), jv.ConstantSpeed("3000 rpm"))
    run = jv.simulate(s, 40.0, start="jam", mode=5, save="window", tolerance=1e-7)
    jam = jv.jam_modes(s).select(5)
    np.testing.assert_allclose(run.amplitude[1], jam.amplitude[1], rtol=2e-2)
    np.testing.assert_allclose(run.omega, jam.omega, rtol=1e-4)


def test_platforms_of_a_jam_start_with_the_loads_angle():
    s = published(eps=1e-3).scene()
    turned, plain = (jv.initial_state(s, "jam", mode=3, angles=a) for a in (2.0 * np.pi, 0.0))
    np.testing.assert_allclose(turned.displacement, plain.displacement, rtol=1e-10)
    quarter = jv.initial_state(s, "jam", mode=3, angles=np.pi / 2)
    np.testing.assert_allclose(quarter.displacement, plain.velocity / jv.jam_modes(s).select(3).omega, rtol=1e-10)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(start="spin_up", spin_up=5.0), "longer than the run"),
        (dict(tolerance="small"), "tolerance is 'small'"),
        (dict(until=1e308), "run shorter stretches"),
    ],
)
def test_runs_that_cannot_be_are_refused(change, says):
    with pytest.raises(jv.InputError, match=says):
        jv.simulate(published().scene(), **{"until": 1.0, **change})


def test_a_state_of_another_machine_is_refused():
    state = jv.initial_state(scene("one_mass", "rollers"))
    with pytest.raises(jv.InputError, match=r"start.displacement has shape \(1,\); this scene needs \(2,\)"):
        jv.simulate(published().scene(), 1.0, start=state)
    with pytest.raises(jv.InputError, match=r"goes with|drive is 'spin_up'|starts at another speed"):
        jv.initial_state(eqx.tree_at(lambda s: s.drive, published().scene(), jv.SpinUp(3.0, 1.0)), "jam", mode=3)
