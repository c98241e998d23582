"""Balls that meet: the energy that restitution leaves, and that they do not pass through each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at
from torus import OWN, RADIUS, balls

import jaxvib as jv
from jaxvib.machine.effects.contact import Tracks, _clearances, damping_ratio
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.study.capture.capture import steps_per_second

HEAVY = jv.planar_rotor(mass=1e12, stiffness=0.0, damping=0.0)


def plane(restitution, stiffness=1e5):
    loads = jv.balls(count=2, mass=0.1, radius=0.2, drag=0.0, ball_radius=0.01)
    return jv.Scene(HEAVY, loads, jv.ConstantSpeed(1.0), (jv.LoadContact(stiffness, restitution=restitution),))


def on_equator(restitution, count=2):
    return jv.Scene(HEAVY, balls(count), jv.ConstantSpeed(1e-9), (jv.LoadContact(1e5, restitution=restitution),))


def after(s, rates, until, spacing=0.2):
    """Speeds of the loads at the end, and the least distance that two of them come to, in their diameters."""
    angle = jnp.arange(len(rates)) * spacing
    others = s.loads.rest()[1:]
    zero = jnp.zeros(2)
    start = jv.State(zero, zero, (angle, *others), (jnp.asarray(rates), *(jnp.zeros_like(x) for x in others)))
    run = jv.simulate(s, until, start=start, samples=800, stepsize_controller=jv.EqualSteps(8000), estimate=False)
    place = np.stack(jax.vmap(s.loads.position)(*run.trajectory.state.angle))
    n = len(rates)
    apart = [np.linalg.norm(place[:, :, i] - place[:, :, j], axis=0).min() for i in range(n) for j in range(i)]
    return np.asarray(run.trajectory.state.rate[0]), min(apart) / (2.0 * float(s.loads.ball_radius))


@pytest.mark.parametrize("make", [plane, on_equator])
@pytest.mark.parametrize("restitution", [1.0, 0.6, 0.2])
def test_balls_separate_with_the_coefficient_of_restitution(make, restitution):
    rates, least = after(make(restitution), [2.0, -1.0], 0.1)
    # The force of the damper begins with a jump, within a step: up to 1 % of the speed.
    np.testing.assert_allclose(rates[-1, 1] - rates[-1, 0], 3.0 * restitution, rtol=0.02, atol=2e-3)
    np.testing.assert_allclose(np.sum(rates[-1]), 1.0, rtol=1e-9)  # and keep their common one
    assert 0.9 < least < 1.0


HEAVY_ROTOR = dict(mass=1e12, transverse_inertia=1e12, polar_inertia=1e11, stiffness=(1.0, 1.0), damping=(0.0, 0.0))


def test_only_loads_at_one_station_touch():
    """Two planes of two balls each, against two machines with one plane each."""
    angle, rate = np.array([0.0, 0.05, 0.09, 0.13]), np.array([1.0, 3.0, -2.0, 2.0])
    zero = jnp.zeros(4)
    machine = jv.rotor(**HEAVY_ROTOR, position=(0.2, -0.2), stations=[0.15, -0.15, 0.15, -0.15])
    loads = jv.balls(count=4, mass=0.1, radius=0.2, drag=0.0, ball_radius=0.01)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(1.0), (jv.LoadContact(1e5, restitution=0.5),))
    state = jv.State(zero, zero, (jnp.asarray(angle),), (jnp.asarray(rate),))
    found = rates_at(s, 0.0, state).azimuth_rate
    for own in ([0, 2], [1, 3]):
        alone = jv.State(zero[:2], zero[:2], (jnp.asarray(angle[own]),), (jnp.asarray(rate[own]),))
        expected = rates_at(plane(0.5), 0.0, alone).azimuth_rate
        assert np.min(np.abs(expected)) > 10.0
        np.testing.assert_allclose(found[np.array(own)], expected, rtol=1e-9)
    pressed = [2.0 * 0.01 - 2.0 * 0.2 * np.sin(0.5 * (angle[j + 2] - angle[j])) for j in (0, 1)]
    still = jv.State(zero, zero, (jnp.asarray(angle),), (zero,))
    np.testing.assert_allclose(jv.energy(s, still, 0.0), 0.5e5 * np.sum(np.square(pressed)), rtol=1e-9)
    assert jv.initial_state(s, angles=[0.0, 0.0, 1.0, 2.0]).azimuth.shape == (4,)
    with pytest.raises(jv.InputError, match=r"start\.angle is \[2\.0, 1\.0\] rad; loads in contact cannot pass each other"):
        jv.initial_state(s, angles=[0.0, 2.0, 1.0, 1.0])


def test_balls_of_a_torus_at_other_stations_do_not_touch():
    u = tuple(jnp.asarray(x) for x in ([0.0, 0.01, 0.05], [0.0, 0.0, 0.0]))
    loads = balls(3)
    gaps = [np.concatenate(_clearances(loads, u, tracks)) for tracks in (None, Tracks.of(jnp.asarray([0.1, -0.1, 0.1])))]
    assert np.all(gaps[0] < 0.0)
    assert np.isinf(gaps[1]).tolist() == [True, True, False] and gaps[1][2] == gaps[0][2]


def test_three_balls_in_a_torus_meet_in_any_pair_and_do_not_pass():
    rates, least = after(on_equator(0.8, count=3), [3.0, 0.0, -2.0], 0.4)
    assert 0.9 < least < 1.0
    assert rates[-1, 0] < rates[-1, 1] < rates[-1, 2]
    energy = np.sum(rates**2, axis=1)
    assert energy[-1] < 0.9 * energy[0]


def test_contact_damping_follows_from_the_restitution():
    """Against the contact integrated as such: x'' + 2 zeta x' + x = 0 until the force is none."""
    for restitution in (0.9, 0.5, 0.2, 0.05):
        zeta = float(damping_ratio(jnp.asarray(restitution)))
        x, v, h = 0.0, 1.0, 1e-4

        def force(x, v, zeta=zeta):
            return -x - 2.0 * zeta * v

        while True:  # by Runge and Kutta's method
            k1, l1 = v, force(x, v)
            k2, l2 = v + h / 2 * l1, force(x + h / 2 * k1, v + h / 2 * l1)
            k3, l3 = v + h / 2 * l2, force(x + h / 2 * k2, v + h / 2 * l2)
            k4, l4 = v + h * l3, force(x + h * k3, v + h * l3)
            x, v = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + h / 6 * (l1 + 2 * l2 + 2 * l3 + l4)
            if v < 0.0 and force(x, v) >= 0.0:
                break
        np.testing.assert_allclose(-v, restitution, rtol=1e-3)
    slope, step = jax.grad(damping_ratio)(0.4), 1e-6
    np.testing.assert_allclose(slope, (damping_ratio(0.4 + step) - damping_ratio(0.4 - step)) / (2.0 * step), rtol=1e-7)


@pytest.mark.parametrize("zeta", [0.9991, 0.9995, 1.0, 1.0005, 1.0009])
def test_damping_ratio_is_accurate_near_critical_damping(zeta):
    """Against x(t) = sin(w t) exp(-zeta t)/w with w^2 = 1 - zeta^2: the contact ends when -x - 2 zeta x' = 0, -x' is then e."""
    duration = 2.0 if zeta == 1.0 else abs(2.0 * np.arccos(complex(zeta)) / np.sqrt(complex(1.0 - zeta**2)))
    restitution = np.exp(-zeta * duration)
    np.testing.assert_allclose(damping_ratio(jnp.asarray(restitution)), zeta, rtol=1e-11)


@pytest.mark.parametrize("effect", [jv.LoadContact(stiffness=1e5), jv.RollingFriction(coefficient=1e-4)])
def test_loads_without_a_ball_radius_are_refused(effect):
    pendulums = jv.pendulums(count=2, mass=0.1, radius=0.1, drag=0.1)
    with pytest.raises(jv.InputError, match=r"needs loads that roll .* a ball_radius, and these .* have none"):
        jv.Scene(jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0), pendulums, jv.ConstantSpeed(60.0), effects=(effect,))


def test_restitution_is_read_from_files_and_checked():
    s = plane(0.7)
    again = jv.scene_from_toml(jv.scene_to_toml(s))
    assert float(again.all_effects[0].restitution) == 0.7 and RADIUS > OWN
    for arguments, says in (
        (dict(restitution=1.2), "restitution is 1.2; it must be greater than 0 and at most 1"),
        (dict(restitution=0.0), "restitution is 0; it must be greater than 0"),
        (dict(restitution=0.5, damping=3.0), "excludes damping, which it determines"),
    ):
        with pytest.raises(jv.InputError, match=says):
            jv.LoadContact(1e5, **arguments)
    uneven = jv.torus_balls(count=2, mass=[0.06, 0.07], radius=0.2, tube=0.015, ball_radius=0.0125)
    with pytest.raises(jv.InputError, match="needs loads of equal mass"):
        jv.Scene(HEAVY, uneven, jv.ConstantSpeed(1.0), (jv.LoadContact(1e5, restitution=0.5),))


def test_compiled_run_ups_build_a_restitution_anew():
    again = jax.jit(lambda damping, e: jv.LoadContact(1e5, damping, e).restitution)(0.0, 0.7)
    assert float(again) == pytest.approx(0.7)
    found = jv.run_up_map(plane(0.7), 0.1, angles=[[0.0, 1.0]], stepsize_controller=jv.EqualSteps(200))
    assert bool(np.all(found.finished))


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_energy_counts_each_overlapping_pair_once(count):
    loads = balls(count)
    u = (jnp.arange(count) ** 1.2 * 0.9 * OWN / RADIUS, *loads.rest()[1:])
    place = np.stack(loads.position(*u))
    pairs = [(i, k) for k in range(count) for i in range(k)]
    overlaps = np.array([max(2.0 * OWN - np.linalg.norm(place[:, i] - place[:, k]), 0.0) for i, k in pairs])
    assert np.sum(overlaps > 0.0) >= count - 1
    np.testing.assert_allclose(jnp.sum(jv.LoadContact(1e5).energy(loads, u)), 0.5e5 * np.sum(overlaps**2), rtol=1e-9)


def test_overlapping_balls_are_refused_named_starts_avoid_them():
    s, zero = on_equator(0.5, count=3), jnp.zeros(2)

    def start(*f, a=0.5 * jnp.pi):
        return jv.State(zero, zero, (jnp.asarray(f), a + jnp.zeros(3)), (jnp.zeros(3), jnp.zeros(3)))

    says = r"start.angle puts loads 1 and 3 inside each other, 0 m apart; start them 0.025 m apart, their diameter"
    with pytest.raises(jv.InputError, match=says):
        jv.simulate(s, 0.1, start=start(0.0, 1.0, 2.0 * jnp.pi))
    with pytest.raises(jv.InputError, match=r"inside each other, 0\.022"):  # in one of several runs
        steps = jv.EqualSteps(8)
        jv.ensemble(lambda f: (s, start(0.0, 1.0, f)), jnp.asarray([2.0, 1.11]), 0.1, stepsize_controller=steps)
    for kind in (s, on_equator(0.5, count=2)):
        place = np.stack(kind.loads.position(*jv.initial_state(kind).angle))
        np.testing.assert_allclose(np.linalg.norm(np.diff(place, axis=1), axis=0), 2.0 * OWN, rtol=1e-12)
    # Across the tube they have their room as well.
    jv.initial_state(s, angles=[0.0, 0.2, 0.4])


def test_steps_of_captures_and_ensembles_resolve_a_contact():
    """Ten steps of what takes pi sqrt(mu/k), by ensembles; six by captures."""
    s = on_equator(0.5)
    bare = jv.Scene(s.machine, s.loads, jv.ConstantSpeed(140.0))
    touching = jv.Scene(s.machine, s.loads, jv.ConstantSpeed(140.0), s.all_effects)
    swing = np.sqrt(1e5 / (0.7 * float(s.loads.mass) / (1.0 - (OWN / 0.2025) ** 2)))
    np.testing.assert_allclose(frequency_bounds(touching)[0], swing, rtol=1e-12)
    np.testing.assert_allclose(steps_per_second(touching), 2.0 * swing, rtol=1e-12)
    assert steps_per_second(bare) == float(bare.loads.natural_frequency(140.0)) < swing


def test_touching_jammed_balls_have_the_unbalance_of_their_arc():
    """Three balls near the outer equator of a torus, a little apart, jammed below the resonance of a rotor that whirls.

    S = m R sin(N arcsin(r/R)) / (r/R); the rotor's amplitude is S Omega^2 / |c - (M + N m) Omega^2 + i b Omega|.
    """
    own, middle, gap, mass = 0.02, 0.1, 0.005, 0.1
    machine, drive, arm = jv.planar_rotor(mass=10.0, stiffness=4e4, damping=60.0), jv.ConstantSpeed(150.0), middle + gap
    loads = jv.torus_balls(count=3, mass=mass, radius=middle, tube=own + gap, ball_radius=own, drag=0.4)
    plane = jv.balls(count=3, mass=mass, radius=arm, drag=0.4, ball_radius=own)
    jam = jv.initial_state(jv.Scene(machine, plane, drive), "jam", mode=1)
    place = (jam.angle[0] + 1.1 * plane.offsets(), 0.5 * jnp.pi + jnp.asarray([0.05, -0.05, 0.02]))
    start = jv.State(jam.displacement, jam.velocity, place, (*jam.rate, jnp.zeros(3)))
    s = jv.Scene(machine, loads, drive, (jv.LoadContact(1e6, restitution=0.3),))
    run = jv.simulate(s, 6.0, start=start, save="window", stepsize_controller=jv.EqualSteps(36000), estimate=False)
    angle, omega = np.asarray(run.window.state.angle[0]), float(run.omega)
    assert 50.0 < omega < 62.0 and np.ptp(run.load_speed) < 1e-3 * omega
    # A contact gives way by the force in it over its stiffness, 1e-5 m.
    np.testing.assert_allclose(np.diff(angle, axis=1), 2.0 * np.arcsin(own / arm), rtol=2e-3)
    pressed = mass * arm * np.sin(3.0 * np.arcsin(own / arm)) / (own / arm)
    np.testing.assert_allclose(np.abs(mass * arm * np.sum(np.exp(1j * angle), axis=1)), pressed, rtol=1e-3)
    assert pressed < 0.96 * 3.0 * mass * arm
    receptance = 1.0 / abs(4e4 - 10.3 * omega**2 + 60j * omega)
    np.testing.assert_allclose(run.amplitude, pressed * omega**2 * receptance, rtol=2e-3)
