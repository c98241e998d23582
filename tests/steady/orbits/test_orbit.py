"""Exact jams against the full equations, solved by other means."""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from periodic import integrate
from scenes import assembled, jam_rotor_speed, machines, published
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import jaxvib as jv
from jaxvib.numerics.fourier import grid_of
from jaxvib.steady.orbits.describe import Orbit, _peaks, half_range
from jaxvib.steady.orbits.solve import branch_tangent, periodic_motion


class Shaker(jv.Machine):
    """One platform that moves across and up, on unequal supports, the two directions coupled: a mount of two directions."""

    stiffness: jax.Array
    kind: str = eqx.field(static=True)

    def carrier(self):
        k, zero = self.stiffness, jnp.zeros((2, 2))
        damping = jnp.diag(jnp.asarray([30.0, 20.0]))
        return jv.Carrier(40.0 * jnp.eye(2), damping, k, k, zero + damping, ("x", "y"))

    def mount(self, at=None):
        return jv.Mount((jnp.eye(2),), axes=(0, 1))


def shaker():
    machine = Shaker(stiffness=jnp.asarray([[6e4, 5e3], [5e3, 4e4]]), kind="shaker")
    return jv.Scene(machine, jv.rollers(count=2, mass=2.0, radius=0.1, drag=0.9), jv.ConstantSpeed(60.0))


def heavy():
    loads = jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5)
    return jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(150.0), jv.Gravity())


def two_sizes():
    """Loads of different mass that obey the same equation, so that they stay together."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    return jv.Scene(machine, jv.balls(count=2, mass=[0.6, 1.2], radius=0.1, drag=[0.7, 1.4]), jv.ConstantSpeed(50.0))


SCENES = {
    "loads of two sizes": (two_sizes, {"omega": 27.0}),
    "published": (lambda: published(eps=0.05).scene(), {"mode": 3}),
    "gravity": (heavy, {"omega": 60.0}),
    "two directions": (shaker, {"omega": 29.0}),
    "three masses": (
        lambda: jv.Scene(
            machines()["three_mass"], jv.pendulums(count=2, mass=2.0, radius=0.1, drag=2.0), jv.ConstantSpeed(40.0)
        ),
        {"near": 25.0},
    ),
}


@functools.cache
def solved(name):
    make, question = SCENES[name]
    orbit = jv.jam_orbit(make(), **question)
    scene = eqx.tree_at(lambda s: s.drive.speed, make(), orbit.rotor_speed)
    return scene, orbit


@pytest.mark.parametrize("name", SCENES)
def test_orbit_is_a_motion_of_the_full_equations(name):
    scene, orbit = solved(name)
    assert bool(orbit.status == jv.OrbitStatus.found)
    assert float(orbit.residual) < 1e-12
    # Whatever the period starts with, rounding included, has grown by the largest multiplier at its end.
    assert np.max(np.abs(integrate(scene, orbit, 1)[-1])) < 1e-8 * max(1.0, float(orbit.multiplier))


@pytest.mark.parametrize("name", SCENES)
def test_amplitudes_force_and_power_are_those_of_the_motion(name):
    scene, orbit = solved(name)
    theta = jnp.linspace(0.0, 2.0 * jnp.pi, 4001)
    q, velocity, _, (rate,) = jax.vmap(orbit.at)(theta)
    carrier = scene.machine.carrier()
    np.testing.assert_allclose(orbit.amplitude, (q.max(0) - q.min(0)) / 2.0, rtol=2e-6)
    assert np.all(np.asarray(orbit.amplitude) >= np.asarray(q.max(0) - q.min(0)) / 2.0 * (1.0 - 1e-12))
    force = q @ carrier.foundation_stiffness.T + velocity @ carrier.foundation_damping.T
    np.testing.assert_allclose(orbit.foundation_force, np.linalg.norm((force.max(0) - force.min(0)) / 2.0), rtol=2e-6)

    # What the rotor gives is what the drag on the loads and the dampers take.
    slip = float(orbit.rotor_speed) - rate[:-1]
    drag = jnp.broadcast_to(scene.loads.drag * scene.loads.radius**2, slip.shape[1:])
    dampers = jnp.einsum("ti,ij,tj->t", velocity[:-1], carrier.damping, velocity[:-1])
    np.testing.assert_allclose(orbit.power, np.mean(slip**2 @ drag + dampers), rtol=1e-9)


def paper(t, y, n, eps):
    """The antiphase paper's equation (2), one load, by hand: v1, v1', v2, v2', phi, phi'."""
    v1, w1, v2, w2, phi, rate = y
    h, n2, n12 = 0.01, 1 / 9, 4 / 9
    link = 2 * h * (w1 - w2) + n12 * (v1 - v2)
    own1, own2 = -2 * h * w1 - n2 * v1 - link, -2 * h * w2 - n2 * v2 + link
    c, s = np.cos(phi), np.sin(phi)
    # v2'' + cos phi phi'' = own2 + sin phi phi'^2,  eps cos phi v2'' + phi'' = eps (n - phi')
    right, pull = own2 + s * rate**2, eps * (n - rate)
    a2 = (right - c * pull) / (1.0 - eps * c * c)
    return [w1, own1, w2, a2, rate, pull - eps * c * a2]


@pytest.mark.parametrize("omega, eps", [(0.97, 0.05), (0.34, 0.05), (1.03, 0.3)])
def test_shooting_on_the_papers_equations_agrees(omega, eps):
    form = published(eps=eps)
    orbit = jv.jam_orbit(form.scene(), omega=omega)
    q, velocity, _, (rate,) = orbit.at(0.0)
    period = 2.0 * np.pi / omega
    phi0 = float(orbit.at(0.0)[2][0][0])

    def miss(x):
        start = [x[0], x[1], x[2], x[3], phi0, x[4]]
        end = solve_ivp(paper, (0.0, period), start, "DOP853", args=(x[5], eps), rtol=1e-12, atol=1e-12).y[:, -1]
        return (end - start - [0, 0, 0, 0, 2.0 * np.pi, 0])[[0, 1, 2, 3, 4, 5]]

    v, w = np.asarray(q / form.length_units), np.asarray(velocity / form.length_units)
    near = np.array([v[0], w[0], v[1], w[1], rate[0], orbit.rotor_speed]) * (1.0 + 1e-4 * np.array([1, -1, 1, -1, 0.1, 1]))
    root = fsolve(miss, near, xtol=1e-13)
    np.testing.assert_allclose(root[5], orbit.rotor_speed, rtol=1e-8)
    np.testing.assert_allclose(root[[0, 2]], v, rtol=1e-6, atol=1e-8 * np.abs(v).max())


def test_stable_motion_stays_and_unstable_one_leaves():
    scene, orbit = solved("published")
    assert bool(orbit.stable)
    assert np.max(np.abs(integrate(scene, orbit, 100))) < 1e-8
    away = jv.jam_orbit(published(eps=0.05).scene(), mode=4)
    assert not bool(away.stable)
    assert np.max(np.abs(integrate(scene, away, 60))) > 0.1


@eqx.filter_jit
def many(scene, omega, points):
    model = assembled(scene)

    def one(w):
        motion = periodic_motion(model, grid_of(points, True), "omega", w, jam_rotor_speed(scene, w))
        branch = branch_tangent(model, grid_of(points, True), motion)
        return motion.rotor_speed, branch.residual, branch.speed_error

    return jax.vmap(one)(omega)


def test_all_points_of_the_published_diagram():
    omega = jnp.linspace(0.15, 2.0, 2000)
    for eps in (1e-6, 1e-3, 0.05, 0.3):
        _, residual, error = many(published(eps=eps).scene(), omega, 24)
        assert float(jnp.max(residual)) < 1e-12
        assert float(jnp.max(error)) < 1e-8


def test_error_falls_exponentially_and_is_known():
    scene, omega = published(eps=0.05).scene(), jnp.linspace(0.15, 2.0, 2000)
    best = many(scene, omega, 24)[0]
    errors = []
    for points in (4, 8):
        speed, _, known = many(scene, omega, points)
        errors.append(float(jnp.max(jnp.abs(speed / best - 1.0))))
        assert 0.3 < float(jnp.max(known)) / errors[-1] < 3.0
    assert errors[1] < 1e-8 < 1e-4 * errors[0]


def test_jams_are_found_from_distant_load_speeds():
    """Steps of Newton's method that lead away are shortened: from every load speed to one at which the rotor has its speed."""
    scene = published(eps=0.05, speed=3.0).scene()
    model, grid = assembled(scene), grid_of(16, True)

    def found(start):
        motion = periodic_motion(model, grid, "rotor_speed", scene.drive.speed, start)
        known = periodic_motion(model, grid, "omega", motion.omega, jam_rotor_speed(scene, motion.omega))
        return branch_tangent(model, grid, motion).residual, known.rotor_speed

    residual, speed = eqx.filter_jit(jax.vmap(found))(jnp.linspace(0.5, 2.0, 31))
    assert np.max(residual) < 1e-12
    np.testing.assert_allclose(speed, 3.0, rtol=1e-9)


def test_figure_of_convergence():
    found = jv.harmonic_convergence(published(eps=0.05).scene(), [0.34, 0.97], points=(4, 8))
    assert found.harmonics.tolist() == [3, 7] and np.all(found.error[1] < 1e-4 * found.error[0])
    assert [line.get_label() for line in found.plot().axes[0].lines[::2]] == ["3.247 rpm", "9.263 rpm", "estimate"]
    with pytest.raises(jv.InputError, match="ascending"):
        jv.harmonic_convergence(published().scene(), [0.9], points=(8, 4))
    for points in ((0, 4), (-4, 4)):
        with pytest.raises(jv.InputError, match=r"points\[0\] is .* at least 2"):
            jv.harmonic_convergence(published().scene(), [0.9], points=points)


def test_light_loads_jam_at_leading_order():
    scene = published(eps=1e-6).scene()
    orbit, jam = jv.jam_orbit(scene, mode=3), jv.jam_modes(scene).select(3)
    np.testing.assert_allclose([orbit.omega, orbit.slope], [jam.omega, jam.slope], rtol=1e-4)
    np.testing.assert_allclose(orbit.amplitude, jam.amplitude, rtol=1e-4)
    np.testing.assert_allclose(orbit.foundation_force, jam.foundation_force, rtol=1e-4)


def numbers_of(orbit):
    parts = (orbit.omega, orbit.slope, orbit.amplitude, orbit.foundation_force, orbit.power)
    parts += (orbit.deviation_harmonics[0, 1:3].real, orbit.displacement_harmonics[:, 0].imag)
    return jnp.concatenate([jnp.ravel(part) for part in parts])


@eqx.filter_jit
@jax.grad
def weighted_gradient(scene, near, weights):
    """Reverse-mode gradient of weighted numbers of a jam at the scene's rotor speed."""
    return jnp.vdot(weights, numbers_of(jv.jam_orbit(scene, near=near, points=16)))


def test_gradients_forward_reverse_and_by_differences():
    """Central differences of relative step 1e-4: truncation and rounding leave a noise floor below 1e-6."""
    scene = published(eps=0.05).scene()
    flat, restore = ravel_pytree(scene)
    rng = np.random.default_rng(0)
    along_x = jnp.asarray(flat * rng.normal(size=flat.shape))

    @eqx.filter_jit
    def f(x):
        return jax.jvp(lambda x: numbers_of(jv.jam_orbit(restore(x), near=0.97, points=16)), (x,), (along_x,))

    values, forward = f(flat)
    weights = jnp.asarray(rng.normal(size=values.shape)) / jnp.abs(values)
    assert np.all(np.isfinite(forward))
    h = 1e-4
    two = [(f(flat + s * h * along_x)[0] - f(flat - s * h * along_x)[0]) / (2.0 * s * h) for s in (1.0, 2.0)]
    differences = (4.0 * two[0] - two[1]) / 3.0
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-6 * float(jnp.max(jnp.abs(forward))))
    reverse = ravel_pytree(weighted_gradient(scene, 0.97, weights))[0]
    np.testing.assert_allclose(jnp.vdot(reverse, along_x), jnp.vdot(weights, forward), rtol=1e-9)


def test_second_derivatives_of_a_jam_can_be_traced():
    flat, restore = ravel_pytree(published(eps=0.05).scene())
    curvature = jax.hessian(lambda x: jv.jam_orbit(restore(x), near=0.97, points=16).multiplier)
    assert jax.eval_shape(curvature, flat).shape == (flat.size, flat.size)


def test_beyond_a_fold_the_status_says_so():
    scene = published(eps=0.05, speed=5.3).scene()
    with pytest.raises(jv.ComputationError, match="not_converged"):
        jv.jam_orbit(scene, near=1.002)
    orbit = jv.jam_orbit(scene, near=1.002, throw=False)
    assert bool(orbit.status == jv.OrbitStatus.not_converged)
    assert np.isnan(orbit.omega) and not bool(orbit.stable)


@pytest.mark.parametrize(
    "form, omega",
    [
        (published(eps=1e-3, damping=1e-6), 0.95),
        (published(eps=1e-6), 1.0),
        (published(eps=1e-3), 0.333333333333),
        (published(eps=1e-3, count=100), 0.9),
        (published(eps=1e-3, damping=1e-6), 0.333333333333),
    ],
    ids=["light damping", "at a resonance", "at a resonance to 12 digits", "100 loads", "undamped at a resonance"],
)
def test_limits_converge_or_say_why(form, omega):
    orbit = jv.jam_orbit(form.scene(), omega=omega, throw=False)
    if bool(orbit.status == jv.OrbitStatus.found):
        assert float(orbit.residual) < 1e-12
        scene = eqx.tree_at(lambda s: s.drive.speed, form.scene(), orbit.rotor_speed)
        assert np.max(np.abs(integrate(scene, orbit, 1)[-1])) < 1e-8 * max(1.0, float(orbit.multiplier))
    else:
        assert bool(orbit.status == jv.OrbitStatus.not_converged) or bool(orbit.status == jv.OrbitStatus.under_resolved)


def test_at_a_fold_the_status_says_so():
    omega, rotor_speed = 1.0022684475770662, 5.202824715161476  # as branches(exact=True) finds it
    scene = published(eps=0.05, speed=rotor_speed * (1.0 - 1e-13)).scene()
    orbit = jv.jam_orbit(scene, near=omega)
    assert bool(orbit.status == jv.OrbitStatus.at_fold)
    np.testing.assert_allclose(orbit.omega, omega, rtol=1e-7)
    # No number of points is accurate enough: 32 leave the least, 128 six hundred times as much.
    assert orbit.error < 1e-8 and orbit.harmonics < 2 * 64
    # A gradient there is huge, not infinite.
    of_omega = jnp.zeros(numbers_of(orbit).size).at[0].set(1.0)
    slopes = weighted_gradient(scene, omega, of_omega)
    assert all(np.all(np.isfinite(slope)) for slope in jax.tree.leaves(slopes)) and abs(float(slopes.drive.speed)) > 1e2


def test_derivatives_at_a_known_orbit_equal_those_of_the_search():
    """The gradient asked alone starts from the motion, that within jit from the equations; where there is none it is 0."""
    scene = published(eps=0.05).scene()

    def total(scene, mode):
        orbit = jv.jam_orbit(scene, mode=mode, points=16, throw=False)
        numbers = (orbit.omega, orbit.foundation_force, orbit.displacement_harmonics, orbit.slope)
        return sum(w * jnp.nansum(jnp.abs(x) ** 2) for w, x in zip((0.3, 0.7, -0.4, 2.0), numbers, strict=True))

    ours, theirs = jax.grad(total)(scene, 3), eqx.filter_jit(jax.grad(total))(scene, 3)
    for (path, a), b in zip(jax.tree.leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-12, err_msg=f"{path}")
    absent = jax.grad(total)(scene, 1)
    assert all(np.all(np.asarray(x) == 0.0) for x in jax.tree.leaves(absent))


def test_modes_that_the_leading_order_lacks_or_has_in_vain():
    """The exact fold of mode 3 is at a rotor speed of 5.2028 for eps = 0.05, at 5.0975 for 0.3; in leading order at 5.1829."""
    beyond = published(eps=0.05, speed=5.2028).scene()
    assert jv.jam_modes(beyond).mode_numbers() == [5]
    modes = [jv.jam_orbit(beyond, mode=k) for k in (3, 4, 5)]
    assert [bool(m.status == jv.OrbitStatus.found) for m in modes] == [True] * 3
    assert [float(m.slope) > 0.0 for m in modes] == [True, False, True]
    np.testing.assert_allclose([m.omega for m in modes], [1.00219515, 1.00234177, 5.09332167], rtol=1e-8)
    fold = 5.2028247151614755
    for side, status in ((-1.0, "found"), (1.0, "absent")):
        at = published(eps=0.05, speed=fold * (1.0 + side * 1e-8)).scene()
        assert [jv.jam_orbit(at, mode=k, throw=False).status_name for k in (3, 4)] == [status] * 2
    within = published(eps=0.3, speed=5.15).scene()
    assert jv.jam_modes(within).mode_numbers() == [3, 4, 5]
    for k in (3, 4):
        with pytest.raises(jv.ComputationError, match="absent"):
            jv.jam_orbit(within, mode=k)


def test_single_precision_answers_as_well_as_it_can():
    """After double precision in the same process: what JAX remembers of arrays must serve both."""
    exact = float(jv.jam_orbit(published(eps=0.05, speed=1.5).scene(), mode=3).omega)
    with jax.enable_x64(False):
        found = jv.jam_orbit(published(eps=0.05, speed=1.5).scene(), mode=3).omega
    assert found.dtype == jnp.float32 and 0.0 < abs(float(found) / exact - 1.0) < 1e-6


def test_wrong_questions_are_refused():
    scene = published().scene()
    with pytest.raises(jv.InputError, match="jam_orbit was called with none"):
        jv.jam_orbit(scene)
    with pytest.raises(jv.InputError, match="mode and omega"):
        jv.jam_orbit(scene, mode=3, omega=0.9)
    with pytest.raises(jv.InputError, match="accuracy"):
        jv.jam_orbit(scene, mode=3, accuracy=1e-15)
    with pytest.raises(jv.ComputationError, match=r"absent: .*speed \(jam mode 1, .* rpm\); existing modes: 3, 4, 5$"):
        jv.jam_orbit(scene, mode=1)
    with pytest.raises(jv.InputError, match=r"loads\.drag"):
        jv.jam_orbit(eqx.tree_at(lambda s: s.loads.drag, scene, 0.0), omega=0.9)


def test_tiers_differ_in_proportion_to_the_loads_mass():
    """Leading order means just that; where a tier has no answer it says why."""
    found = jv.compare_tiers(published().scene(), (0.1, 1.0, 1e3), mode=3)
    apart = np.abs(found.leading.omega / found.exact.omega - 1.0)
    np.testing.assert_allclose(apart[1] / apart[0], 10.0, rtol=0.05)
    for tier, word in ((found.leading, "mode"), (found.exact, "periodic motion")):
        assert word in tier.message[0] and "does not exist" in tier.message[2]
        assert np.isfinite(tier.amplitude[:2]).all() and np.isnan(tier.amplitude[2]).all()
    assert found.plot().axes[0].get_xlabel() == "mass of a load, kg"


def test_the_highest_of_several_peaks_is_that_between_samples():
    """Peaks of nearly one height: the highest is none of the 64 samples', and a search along a bend needs to know which."""
    random = np.random.default_rng(3)
    orders = np.arange(1, 16, 2)
    theta = np.linspace(0.0, 2.0 * np.pi, 200001)
    wave = np.exp(1j * orders[:, None] * theta)
    harmonics = (random.normal(size=(40, 8)) + 1j * random.normal(size=(40, 8))) * np.array([0.02, 1.0, 0.02, *[1e-3] * 5])
    dense = np.max((harmonics @ wave).real, axis=1)  # within 1e-9 between its samples
    np.testing.assert_allclose(half_range(orders, jnp.asarray(harmonics)), dense, rtol=3e-9)
    np.testing.assert_allclose(_peaks(orders, jnp.asarray(harmonics[0])).max(), dense[0], rtol=3e-9)
    width = 2.0 * np.pi / 16.0
    parts = width * np.arange(16)[:, None] + np.linspace(0.0, width, 12501)
    inside = np.exp(1j * orders[:, None, None] * parts)
    each = np.max(np.einsum("k,kpt->pt", harmonics[0], inside).real, axis=1)  # of each part of the period, its ends included
    np.testing.assert_allclose(_peaks(orders, jnp.asarray(harmonics[0])), each, atol=3e-9 * dense[0])


def test_peaks_are_found_from_samples_that_mislead():
    """The higher of two peaks had the lower of 64 samples beside it, and the best sample lay at an inflection: the two of 2000
    signals, whose harmonics fall as 1/k and 1/k^2, that came out 1e-3 too low."""
    random, orders = np.random.default_rng(0), np.arange(1, 16, 2)
    drawn = [random.normal(size=(2000, 8)) + 1j * random.normal(size=(2000, 8)) for _ in range(3)]
    harmonics = np.stack([drawn[1][1126] / orders, drawn[2][240] / orders**2])
    dense = np.max((harmonics @ np.exp(1j * orders[:, None] * np.linspace(0.0, 2.0 * np.pi, 200001))).real, axis=1)
    for one, highest in zip(harmonics, dense, strict=True):
        np.testing.assert_allclose(_peaks(orders, jnp.asarray(one)).max(), highest, rtol=3e-9)


def test_relative_amplitudes_count_coordinates_from_one():
    """Amplitudes 2 and 5 in antiphase: 7 apart; 0 is no coordinate, and not the last one; nor is a tilt a length."""
    harmonics = jnp.array([[2.0 + 0.0j], [-5.0 + 0.0j], [0.1 + 0.0j]])
    orbit = SimpleNamespace(orders=(1,), displacement_harmonics=harmonics, units=("m", "m", "rad"))
    np.testing.assert_allclose(Orbit.relative_amplitude(orbit, 1, 2), 7.0, rtol=1e-9)
    for i, j in ((0, 1), (1, 0), (-1, 1), (4, 1), (1, 4), (True, 2), (2, 3), (3, 1)):
        with pytest.raises(jv.InputError, match=r"whole number|numbered 1 to 3|give two displacements or two tilts"):
            Orbit.relative_amplitude(orbit, i, j)
