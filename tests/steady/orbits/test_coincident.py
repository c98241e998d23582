"""Exact jams of loads that differ, that lie side by side, and on rotors, against the full equations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gyroscopic_rotor import rotor
from jax.flatten_util import ravel_pytree
from periodic import integrate, monodromy, ordered
from scenes import assembled, jam_rotor_speed, machines, scene
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.numerics.fourier import grid_of
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.orbits.describe import _least_contact_torque
from jaxvib.steady.orbits.solve import Harmonics, PeriodicSolution, periodic_motion


def different():
    loads = jv.balls(count=2, mass=[0.6, 1.2], radius=0.1, drag=[0.7, 1.5])
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), loads, jv.ConstantSpeed(50.0))


def different_with_gravity():
    loads = jv.pendulums(count=3, mass=[0.6, 0.9, 0.7], radius=0.1, drag=[0.7, 1.1, 0.6], inertia=[0.0, 1e-3, 5e-4])
    return jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(150.0), jv.Gravity())


CASES = {
    "loads that differ": (different, 27.0),
    "loads that differ, gravity": (different_with_gravity, 60.0),
    "gyroscopic": (lambda: rotor(0.093, (1.1e6, 0.8e6), mass=0.8), 135.0),
}


@pytest.mark.parametrize(
    "name", ["loads that differ", "gyroscopic", pytest.param("loads that differ, gravity", marks=pytest.mark.slow)]
)
def test_orbit_and_multipliers_are_those_of_the_full_equations(name):
    make, omega = CASES[name]
    scene = make()
    orbit = jv.jam_orbit(scene, omega=omega)
    assert bool(orbit.status == jv.OrbitStatus.found) and float(orbit.residual) < 1e-12
    scene = eqx.tree_at(lambda s: s.drive.speed, scene, orbit.rotor_speed)
    assert np.max(np.abs(integrate(scene, orbit, 1)[-1])) < 1e-8 * max(1.0, float(orbit.multiplier))
    expected = [*orbit.multipliers, 1.0]
    if scene.loads.alike:
        expected = [*orbit.multipliers[:-2], *np.tile(orbit.multipliers[-2:], scene.loads.count - 1), 1.0]
    np.testing.assert_allclose(ordered(monodromy(scene, orbit)), ordered(expected), atol=1e-7)


def test_gyroscopic_jam_at_a_given_rotor_speed():
    scene = CASES["gyroscopic"][0]()
    grid = grid_of(12, True)
    given = periodic_motion(
        assembled(scene), grid, "omega", jnp.asarray(135.0), light_rotor_speed(assembled(scene).linear, jnp.asarray(135.0))
    )
    again = periodic_motion(assembled(scene), grid, "rotor_speed", given.rotor_speed, jnp.asarray(135.2))
    np.testing.assert_allclose(again.omega, 135.0, rtol=1e-9)


def test_loads_that_differ_take_different_places():
    """The one with the greater drag per unbalance is ahead; loads of one kind named one by one jam as when they are shared."""
    scene = different()
    deviation = jv.jam_orbit(scene, omega=27.0).deviation_harmonics[:, 0].real
    ratio = scene.loads.drag * scene.loads.radius / scene.loads.mass
    assert (deviation[0] < deviation[1]) == (ratio[0] < ratio[1]) and abs(float(deviation[1] - deviation[0])) > 0.01
    machine = scene.machine
    shared, single = (jv.balls(count=2, mass=m, radius=0.1, drag=d) for m, d in ((0.6, 0.7), ([0.6] * 2, [0.7] * 2)))
    one, other = (jv.jam_orbit(jv.Scene(machine, x, scene.drive), omega=27.0) for x in (shared, single))
    np.testing.assert_allclose(one.rotor_speed, other.rotor_speed, rtol=1e-12)
    np.testing.assert_allclose(np.max(np.abs(one.multipliers)), np.max(np.abs(other.multipliers)), rtol=1e-7)


def test_gradient_with_gyroscopic_coupling_by_differences():
    """Central differences of relative step 1e-5, noise floor 1e-8."""
    flat, restore = ravel_pytree(rotor(0.093, (1.1e6, 0.8e6), mass=0.8))

    @eqx.filter_jit
    @jax.value_and_grad
    def f(x):
        motion = periodic_motion(assembled(restore(x)), grid_of(8, True), "omega", jnp.asarray(135.0), jnp.asarray(140.0))
        return motion.rotor_speed + motion.deviation[0, 1]

    direction = jnp.asarray(flat * np.random.default_rng(0).normal(size=flat.shape))
    forward = eqx.filter_jit(lambda x: jax.jvp(lambda x: f(x)[0], (x,), (direction,))[1])(flat)
    h = 1e-5
    np.testing.assert_allclose((f(flat + h * direction)[0] - f(flat - h * direction)[0]) / (2 * h), forward, rtol=1e-5)
    np.testing.assert_allclose(jnp.vdot(f(flat)[1], direction), forward, rtol=1e-9)


def side_by_side(ball_radius=0.02, effects=(), **more):
    numbers = dict(count=3, mass=0.5, radius=0.1, drag=0.7, ball_radius=ball_radius)
    loads = jv.balls(**{**numbers, **more})
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), loads, jv.ConstantSpeed(50.0), effects)


def test_loads_side_by_side_carry_less_unbalance():
    loads = side_by_side().loads
    ratio = 0.02 / 0.1
    np.testing.assert_allclose(loads.unbalance(), 0.5 * 0.1 * np.sin(3.0 * np.arcsin(ratio)) / ratio, rtol=1e-14)
    # Neighbours touch: their centres are two radii apart.
    places = 0.1 * np.exp(1j * np.asarray(loads.offsets()))
    np.testing.assert_allclose(np.abs(np.diff(places)), 2.0 * 0.02, rtol=1e-14)
    np.testing.assert_allclose(np.sum(0.5 * places), loads.unbalance(), rtol=1e-14)


def test_loads_side_by_side_follow_the_lagrangian_of_a_rigid_arc():
    """Euler and Lagrange by automatic differentiation, each ball for itself at its place on the arc; SciPy's DOP853."""
    scene = side_by_side(effects=(jv.Gravity(),))
    orbit = jv.jam_orbit(scene, omega=26.0)
    step = 2.0 * np.arcsin(0.02 / 0.1)
    places = np.array([-step, 0.0, step])
    n, g = float(orbit.rotor_speed), 9.81

    def lagrangian(x, v):
        up = v[0] + 0.1 * jnp.cos(x[1] + places) * v[1]
        across = -0.1 * jnp.sin(x[1] + places) * v[1]
        kinetic = 25.0 * v[0] ** 2 + jnp.sum(0.25 * (up**2 + across**2)) + 3 * 0.4 * 0.25 * (0.1 * v[1]) ** 2
        return kinetic - 2e4 * x[0] ** 2 - jnp.sum(0.5 * g * 0.1 * jnp.sin(x[1] + places))

    @eqx.filter_jit
    def field(y):
        x, v = y[:2], y[2:]
        mass = jax.hessian(lagrangian, 1)(x, v)
        mixed = jax.jacfwd(jax.grad(lagrangian, 1), 0)(x, v)
        force = jnp.stack([-60.0 * v[0], 3 * 0.7 * 0.1**2 * (n - v[1])])
        return jnp.concatenate([v, jnp.linalg.solve(mass, force + jax.grad(lagrangian)(x, v) - mixed @ v)])

    q, velocity, (phi,), (rate,) = orbit.at(0.0)
    np.testing.assert_allclose(phi - phi[1], places, atol=1e-14)
    start = np.array([q[0], phi[1], velocity[0], rate[1]])
    period = 2.0 * np.pi / 26.0
    run = solve_ivp(lambda t, y: np.asarray(field(y)), (0.0, period), start, "DOP853", rtol=1e-12, atol=1e-14)
    size = np.array([orbit.amplitude[0], 1.0, 26.0 * orbit.amplitude[0], 26.0])
    assert np.max(np.abs((run.y[:, -1] - start - [0.0, 2.0 * np.pi, 0.0, 0.0]) / size)) < 1e-9
    # Pressed together, they have no motion against each other: the multipliers are those of one body.
    assert bool(orbit.status == jv.OrbitStatus.found) and orbit.multipliers.shape == (3,)


def test_loads_side_by_side_in_leading_order_and_files():
    scene = side_by_side()
    light = jax.tree.map(lambda x: x, eqx.tree_at(lambda s: (s.loads.mass, s.loads.drag), scene, (5e-6, 7e-11)))
    np.testing.assert_allclose(jv.jam_orbit(light, omega=26.0).rotor_speed, jam_rotor_speed(light, 26.0), rtol=1e-5)
    text = jv.scene_to_toml(scene)
    assert "ball_radius = 0.02" in text and "ball_radius" not in jv.scene_to_toml(side_by_side(ball_radius=None))
    assert eqx.tree_equal(jv.scene_from_toml(text), scene)
    assert jv.jam_modes(scene).select(1).amplitude < jv.jam_modes(side_by_side(ball_radius=None)).select(1).amplitude


def test_loads_that_would_have_to_pull_are_not_stable():
    orbit = jv.jam_orbit(side_by_side(), omega=40.0)
    assert bool(orbit.status == jv.OrbitStatus.would_separate) and not bool(orbit.stable)


def test_contact_forces_are_those_that_trailing_loads_need():
    """A motion that is no balance: the mean over a period of m R cos(phi_j) y'' - b R^2 (n - phi_j'), summed up to each."""
    model, grid = assembled(side_by_side()), grid_of(33, False)
    deviation = lambda theta: 0.3 * np.sin(theta) + 0.1 * np.cos(2.0 * theta)  # noqa: E731
    orders, omega, speed = np.asarray(grid.orders), 40.0, 55.0
    answer = np.zeros((1, orders.size), complex)
    answer[0, [1, 2, 3]] = [20.0 + 70.0j, 30.0 - 5.0j, 4.0j]
    motion = PeriodicSolution(jnp.asarray(deviation(grid.theta))[None], jnp.asarray(omega), jnp.asarray(speed))
    found = _least_contact_torque(model, grid, motion, Harmonics(None, None, jnp.asarray(answer), None))
    theta = 2.0 * np.pi * np.arange(2000) / 2000.0
    acceleration = np.real(answer[0] @ np.exp(1j * orders[:, None] * theta))
    needed = []
    for place in np.asarray(model.offsets):
        phi, rate = theta + deviation(theta) + place, omega * (1.0 + 0.3 * np.cos(theta) - 0.2 * np.sin(2.0 * theta))
        needed.append(np.mean(0.5 * 0.1 * np.cos(phi) * acceleration - 0.7 * 0.1**2 * (speed - rate)))
    np.testing.assert_allclose(found, np.min(-np.cumsum(needed)[:-1]), rtol=1e-9)


def test_loads_side_by_side_need_room_and_one_size():
    with pytest.raises(jv.InputError, match=r"ball_radius is 0\.09 m; 3 side by side .* below 0\.0866025 m"):
        side_by_side(ball_radius=0.09)
    with pytest.raises(jv.InputError, match="needs equal loads"):
        side_by_side(mass=[0.5, 0.5, 0.6])
    with pytest.raises(jv.InputError, match=r"ball_radius"):
        side_by_side(ball_radius=-0.01)


def test_gyroscopic_modes_have_no_numbers():
    with pytest.raises(jv.InputError, match="give omega or near"):
        jv.jam_orbit(rotor(0.093), mode=1)


def test_a_rotor_out_of_balance_has_no_periodic_jam():
    s = scene("two_mass", effects=(jv.StaticImbalance(0.01),))
    with pytest.raises(jv.InputError, match=r"effects\.static_imbalance excites the machine at the rotor speed as well"):
        jv.jam_orbit(s, mode=1)


def test_bodies_of_single_loads_sum_to_the_common_body():
    """Drag, inertia and unbalance of three balls named one by one, against m R, 7/5 m R^2 and b R^2 of each."""
    machine, drive = machines()["one_mass"], jv.ConstantSpeed(50.0)
    mass, drag = np.array([0.6, 1.2, 0.9]), np.array([0.7, 1.5, 1.1])
    each = assembled(jv.Scene(machine, jv.balls(count=3, mass=mass, radius=0.1, drag=drag), drive))
    np.testing.assert_allclose(each.unbalance, mass * 0.1, rtol=1e-14)
    np.testing.assert_allclose(each.inertia, 1.4 * mass * 0.1**2, rtol=1e-14)
    np.testing.assert_allclose(each.drag, drag * 0.1**2, rtol=1e-14)
    shared = assembled(jv.Scene(machine, jv.balls(count=3, mass=0.6, radius=0.1, drag=0.7), drive))
    found = [float(x[0]) for x in (shared.unbalance, shared.inertia, shared.drag)]
    np.testing.assert_allclose(found, [3 * 0.6 * 0.1, 3 * 1.4 * 0.6 * 0.1**2, 3 * 0.7 * 0.1**2], rtol=1e-14)
