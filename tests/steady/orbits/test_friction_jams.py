"""Exact jams under dry friction against the full equations, and the leading order that leads to them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gyroscopic_rotor import rotor
from periodic import integrate, monodromy, ordered
from scenes import assembled, jam_rotor_speed, machines

import jaxvib as jv
from jaxvib.machine.effects.base import has_half_turn_symmetry
from jaxvib.numerics.fourier import grid_of
from jaxvib.steady.balance.criterion import criterion_functional
from jaxvib.steady.orbits.solve import branch_tangent, periodic_motion


def dry(coefficient=0.1, **more):
    return jv.DryFriction(coefficient, diameter=0.02, **more)


class RollingFriction(jv.DryFriction):
    """The same law for loads that roll, from outside the package."""

    def validate(self, machine, loads):
        pass


def scene_of(loads, *effects, speed=50.0, machine=None):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0) if machine is None else machine
    return jv.Scene(machine, loads, jv.ConstantSpeed(speed), effects)


def alike(*effects, mass=1.0, drag=0.7):
    return scene_of(jv.pendulums(count=2, mass=mass, radius=0.1, drag=drag), *effects)


def different(*effects):
    loads = jv.pendulums(count=2, mass=[0.6, 0.9], radius=0.1, drag=[0.7, 1.1], inertia=[0.0, 1e-3])
    return scene_of(loads, *effects, machine=machines()["two_mass"])


def across_and_up():
    machine = jv.planar_rotor(mass=37.0, stiffness=7e5, damping=200.0)
    loads = jv.pendulums(count=2, mass=0.4, radius=0.08, drag=5.0, inertia=0.4 * 0.4 * 0.08**2)
    return scene_of(loads, dry(0.05), machine=machine)


def on_a_rotor(*effects):
    bare = rotor(0.093, (1.1e6, 0.8e6), mass=0.8)
    return jv.Scene(bare.machine, bare.loads, bare.drive, effects)


CASES = {
    "two loads, gravity": (lambda: alike(dry(), jv.Gravity()), 26.5, 33),
    "across and up": (across_and_up, 129.0, 16),
    "rotor": (lambda: on_a_rotor(RollingFriction(0.05, diameter=0.02)), 135.0, 12),
    "two loads": (lambda: alike(dry()), 26.5, 16),
    "loads that differ, gravity": (lambda: different(dry(), jv.Gravity()), 63.0, 33),
    "run-up": (lambda: alike(dry(reaction="run_up")), 26.5, 16),
    "steady": (lambda: alike(dry(reaction="steady")), 26.5, 16),
}
QUICK = ("two loads, gravity", "across and up")


@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES])
def test_orbits_with_friction_satisfy_the_full_equations(name):
    make, omega, points = CASES[name]
    orbit = jv.jam_orbit(make(), omega=omega, points=points)
    scene = eqx.tree_at(lambda s: s.drive.speed, make(), orbit.rotor_speed)
    assert bool(orbit.status == jv.OrbitStatus.found) and float(orbit.residual) < 1e-12
    assert np.max(np.abs(integrate(scene, orbit, 1)[-1])) < 1e-8 * max(1.0, float(orbit.multiplier))
    expected = [*orbit.multipliers, 1.0]
    if scene.loads.alike:
        expected = [*orbit.multipliers[:-2], *np.tile(orbit.multipliers[-2:], scene.loads.count - 1), 1.0]
    np.testing.assert_allclose(ordered(monodromy(scene, orbit)), ordered(expected), atol=1e-7)

    theta = 2.0 * jnp.pi * jnp.arange(256) / 256
    given, taken = jax.vmap(lambda x: jv.power(scene, 0.0, jv.State(*orbit.at(x))))(theta)
    np.testing.assert_allclose(orbit.power, np.mean(given), rtol=1e-9)
    np.testing.assert_allclose(orbit.power, np.mean(taken), rtol=1e-9)
    # The friction is no small part of it.
    without = eqx.tree_at(lambda s: next(e.coefficient for e in s.all_effects if e.kind == "dry_friction"), scene, 0.0)
    assert np.mean(jax.vmap(lambda x: jv.power(without, 0.0, jv.State(*orbit.at(x))))(theta)[0]) < 0.98 * np.mean(given)


def test_dry_friction_keeps_the_half_turn_and_gravity_does_not():
    assert has_half_turn_symmetry(alike(dry()).all_effects) and not has_half_turn_symmetry(
        alike(dry(), jv.Gravity()).all_effects
    )
    # On a whole period, where the symmetry is not put in, it comes out.
    model, grid = assembled(alike(dry())), grid_of(33, False)

    @eqx.filter_jit
    def solved(omega, rotor_speed):
        motion = periodic_motion(model, grid, "omega", omega, rotor_speed)
        return motion.deviation, branch_tangent(model, grid, motion).residual

    deviation, residual = solved(jnp.asarray(26.5), jnp.asarray(45.0))
    harmonics = np.fft.rfft(deviation[0])
    assert np.max(np.abs(harmonics[1::2])) < 1e-10 * np.max(np.abs(harmonics))
    assert float(residual) < 1e-12


def test_gradient_by_the_coefficient_by_differences():
    """Central differences of relative step 1e-4, noise floor 1e-8."""

    @eqx.filter_jit
    @jax.value_and_grad
    def f(coefficient):
        scene = alike(dry(coefficient), jv.Gravity())
        motion = periodic_motion(assembled(scene), grid_of(17, False), "omega", jnp.asarray(26.5), jnp.asarray(45.0))
        return motion.rotor_speed + 1e2 * motion.deviation[0, 1]

    x, h = jnp.asarray(0.1), 1e-5
    _, reverse = f(x)
    np.testing.assert_allclose((f(x + h)[0] - f(x - h)[0]) / (2.0 * h), reverse, rtol=1e-6)
    np.testing.assert_allclose(eqx.filter_jit(jax.jacfwd(lambda x: f(x)[0]))(x), reverse, rtol=1e-9)


def test_friction_of_loads_side_by_side_depends_on_their_place():
    """Each load for itself, at its own place on the arc; by differences of the sum."""
    loads = jv.balls(count=3, mass=0.5, radius=0.1, drag=0.7, ball_radius=0.02)
    scene = scene_of(loads, RollingFriction(0.1, diameter=0.02), jv.Gravity())
    phi, rate, a, n = jnp.asarray([[0.3]]), jnp.asarray([[20.0]]), jnp.asarray([[40.0]]), jnp.asarray(50.0)

    def by_hand(phi, rate, a):
        each = phi + np.asarray(loads.offsets())
        normal = 0.5 * (0.1 * rate**2 - np.sin(each) * (a + 9.81))
        drag = 0.7 * 0.01 * (50.0 - rate) - 0.5 * 9.81 * 0.1 * np.cos(each)
        return np.sum(drag + 0.1 * 0.01 * np.abs(normal))

    np.testing.assert_allclose(assembled(scene).torque(phi, rate, n, a)[0, 0], by_hand(0.3, 20.0, 40.0), rtol=1e-13)
    by_angle, by_rate, by_a = assembled(scene).torque_slopes(phi, rate, n, a)
    h = 1e-4
    for value, d in ((by_angle, (h, 0, 0)), (by_rate, (0, h, 0)), (by_a[0], (0, 0, h))):
        p, r, x = d
        differences = (by_hand(0.3 + p, 20.0 + r, 40.0 + x) - by_hand(0.3 - p, 20.0 - r, 40.0 - x)) / (2.0 * h)
        np.testing.assert_allclose(value[0, 0], differences, rtol=1e-7)


@pytest.mark.parametrize("reaction", ["exact", "steady", "run_up"])
def test_leading_order_is_the_balance_by_hand(reaction):
    """The vibration's torque is that of the branch without friction, which has its own tests."""
    omega = 26.5
    scene, bare = alike(dry(reaction=reaction)), alike()
    n = float(jam_rotor_speed(scene, omega))
    vibration = 2 * 0.7 * 0.01 * float(jam_rotor_speed(bare, omega) - omega)
    load = {"exact": omega**2, "steady": n**2, "run_up": abs(omega**2 - 2 * n * (n - omega))}[reaction]
    rub = 2 * 0.1 * 0.01 * 0.1 * load * np.tanh((n - omega) / 0.01)
    np.testing.assert_allclose(2 * 0.7 * 0.01 * (n - omega) + rub, vibration, rtol=1e-9)


@pytest.mark.slow
def test_exact_modes_with_friction_continue_light_modes():
    scene = alike(dry(1e-4), mass=1e-4, drag=1e-8)
    for k in (1, 2):
        np.testing.assert_allclose(jv.jam_orbit(scene, mode=k, points=8).omega, jv.jam_modes(scene).select(k).omega, rtol=1e-5)


def test_modes_of_light_loads_with_dry_friction():
    """Jams at one rotor speed: every mode is a root of the branch, and a fold its extremum."""
    scene = alike(dry(1e-4), mass=1e-4, drag=1e-8)
    modes, bare = jv.jam_modes(scene), alike(mass=1e-4, drag=1e-8)
    assert modes.mode_numbers() == [1, 2, 3]
    for k in (1, 2):
        mode = modes.select(k)
        np.testing.assert_allclose(jam_rotor_speed(scene, mode.omega), 50.0, rtol=1e-9)
        assert jam_rotor_speed(bare, mode.omega) > 50.1
    n = jax.vmap(lambda w: jam_rotor_speed(scene, w))(jnp.linspace(0.99, 1.01, 101) * modes.folds.omega[0])
    assert int(jnp.argmax(n)) == 50
    # Where friction holds what the vibration takes, loads turn with the rotor but for the creep of its smoothing.
    stuck = jam_rotor_speed(alike(dry(0.5)), 20.0)
    assert 0.0 < float(stuck - 20.0) < 0.01 < float(jam_rotor_speed(alike(), 20.0) - 20.0)


def test_theories_without_dry_friction_refuse_it():
    scene = alike(dry())
    for ask in (criterion_functional, lambda s, w: jv.phase_jams(s)):
        with pytest.raises(jv.InputError, match=r"effects\.dry_friction is not included in this function"):
            ask(scene, 20.0)


@pytest.mark.slow
def test_exact_branch_of_a_gyroscopic_rotor():
    """The fold between two forward resonances (127, 149 rad/s) is an extremum of the motions themselves."""
    scene = on_a_rotor()
    diagram = jv.branches(scene, exact=True, points=30, least=133.0, most=140.0, accuracy=1e-5)
    assert np.max(diagram.residual) < 1e-12 and np.max(diagram.error) < 1e-5
    (fold,) = (p for p in diagram.special if p.kind == "fold")
    grid = grid_of(16, True)
    at = fold.omega * (1.0 + jnp.asarray([-1e-3, -1e-6, 1e-6, 1e-3]))
    n = jax.vmap(lambda w: periodic_motion(assembled(scene), grid, "omega", w, jnp.asarray(fold.rotor_speed)).rotor_speed)(at)
    assert n[0] > n[1] and n[2] < n[3]
    np.testing.assert_allclose(n[1:3], fold.rotor_speed, rtol=1e-7)


def falling(coefficient):
    """Friction of run_up, whose radial load m R (Omega^2 - 2 n (n - Omega)) is negative at large slips."""
    loads = jv.pendulums(count=2, mass=0.5, radius=0.1, drag=0.3)
    machine = jv.two_mass(
        mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0
    )  # fmt: skip
    return scene_of(loads, jv.DryFriction(coefficient, diameter=0.012, reaction="run_up"), speed=90.0, machine=machine)


def test_a_resistance_that_falls_with_the_speed_is_a_status():
    """Drag 0.003 N m s per load against 4 n m R mu2 d/2 = 0.0054 N m s at 90 rad/s; mode 4 came as 70.031 for 70.058 rad/s."""
    modes = jv.jam_modes(falling(0.05))
    assert modes.mode_numbers() == [] and not np.any(np.isfinite(modes.omega)) and not np.any(modes.stable)
    assert "the resistance of the loads falls as the rotor speed rises" in modes.summary()
    with pytest.raises(jv.ComputationError, match="ambiguous: the resistance of the loads falls"):
        modes.select(4)
    with pytest.raises(jv.ComputationError, match="or this search does not find it: the resistance of the loads falls"):
        jv.jam_orbit(falling(0.05), mode=4)
    assert modes.select(4, throw=False).summary().startswith("mode 4: the resistance of the loads falls")


def test_jams_with_a_resistance_that_rises_are_found():
    modes = jv.jam_modes(falling(0.0015))
    assert modes.mode_numbers() == [1, 2, 3, 4, 5]
    for mode in (3, 4):
        assert abs(jam_rotor_speed(falling(0.0015), modes.select(mode).omega) / 90.0 - 1.0) < 0.02
