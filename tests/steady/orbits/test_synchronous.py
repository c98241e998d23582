"""Exact synchronous motions against equations of motion by hand, integrated by SciPy, and against closed forms."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import jaxvib as jv
from jaxvib.numerics.fourier import grid_of
from jaxvib.results.status import status_names
from jaxvib.steady.orbits.limit import _find_fold, _Point
from jaxvib.steady.orbits.synchronous import plan_synchronous
from jaxvib.steady.orbits.whole import linear_start, periodic_scene
from jaxvib.units import Bounds

G = 9.81


def body(stiffness=(4e5, 7e5), damping=(2e3, 3e3), mass=2000.0, inertia=600.0, angle=0.0, places=((-1.0, -0.2), (1.1, -0.1))):
    supports = [jv.support(at=at, stiffness=stiffness, damping=damping, angle=angle) for at in places]
    return jv.plane_body(mass=mass, inertia=inertia, supports=supports)


def motor(speed=100.0, torque=300.0, inertia=0.5):
    return jv.DCMotor(speed, stall_torque=torque, inertia=inertia)


def symmetric(places, unbalance=1.5, damping=2e3, directions=None, drive=None, **body_numbers):
    """Equal supports in x and y without coupling, equal exciters."""
    stiffness, damping = (4e5, 4e5), (damping, damping)
    machine = body(stiffness, damping, places=((-1.0, 0.0), (1.0, 0.0)), **body_numbers)
    directions = [1] * len(places) if directions is None else directions
    drive = motor() if drive is None else drive
    pairs = zip(places, directions, strict=True)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=unbalance, at=p, direction=d) for p, d in pairs])


@pytest.fixture(scope="module")
def general():
    """Two different motors in opposite directions, inclined supports, gravity."""
    exciters = [
        jv.Exciter(drive=motor(), unbalance=1.5, at=(-0.3, 0.2)),
        jv.Exciter(
            drive=jv.InductionMotor(100.4, breakdown_torque=200.0, breakdown_slip=0.2, inertia=0.4), unbalance=1.2,
            at=(0.35, 0.25), direction=-1,
        ),
    ]  # fmt: skip
    return jv.Scene(body(angle=0.3), exciters=exciters, effects=jv.Gravity())


@pytest.fixture(scope="module")
def orbit(general):
    return jv.synchronous_orbit(general, phases=[0.0, 3.0])


def by_hand(t, y, scene=None):
    """Rate of (x, y, psi, th_1, th_2 and their rates) of the general scene, from the equations of motion on paper."""
    q, v = y[:3], y[5:8]
    mass, stiffness, damping = np.diag([2000.0, 2000.0, 600.0]), np.zeros((3, 3)), np.zeros((3, 3))
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    for a, b in ((-1.0, -0.2), (1.1, -0.1)):
        rows = turn @ np.array([[1.0, 0.0, -b], [0.0, 1.0, a]])
        stiffness += rows.T @ np.diag([4e5, 7e5]) @ rows
        damping += rows.T @ np.diag([2e3, 3e3]) @ rows
    matrix, force = np.zeros((5, 5)), np.zeros(5)
    matrix[:3, :3], force[:3] = mass, -stiffness @ q - damping @ v
    kloss = lambda w: 2.0 * 200.0 * (1.0 - w / 100.4) * 0.2 / ((1.0 - w / 100.4) ** 2 + 0.04)  # noqa: E731
    exciters = [
        (1.5, 0.5, (-0.3, 0.2), 1, lambda w: 300.0 * (1.0 - w / 100.0)),
        (1.2, 0.4, (0.35, 0.25), -1, kloss),
    ]
    for k, (s, inertia, (a, b), sigma, torque) in enumerate(exciters, 3):
        angle, rate = y[k], y[5 + k]
        rows = np.array([[1.0, 0.0, -b], [0.0, 1.0, a]])
        out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        own = sigma * torque(sigma * (rate - v[2]))
        matrix[:3, k] += s * rows.T @ along
        force[:3] += s * rate**2 * rows.T @ out
        force[2] -= own
        matrix[k, k], matrix[k, :3], force[k] = inertia, s * along @ rows, own - s * G * np.cos(angle)
    return np.concatenate([y[5:], np.linalg.solve(matrix, force)])


def flat(state):
    rotors = [own.rotor for own in state.exciters]
    return np.concatenate([state.displacement, [r[0] for r in rotors], state.velocity, [r[1] for r in rotors]])


def turned_once(orbit, begin):
    turn = 2.0 * np.pi / float(orbit.speed)
    return solve_ivp(by_hand, (0.0, turn), begin, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]


def test_state_returns_after_one_turn_by_scipy(orbit):
    assert orbit.status_name == "found" and orbit.error < 1e-9
    end = turned_once(orbit, flat(orbit.at(0.0)))
    assert np.max(np.abs(end - flat(orbit.at(2.0 * np.pi)))) < 1e-8
    assert np.max(np.abs(end - flat(orbit.at(0.0)) - 2.0 * np.pi * np.array([0, 0, 0, 1, -1] + 5 * [0]))) < 1e-8


def test_multipliers_equal_differences_of_runs_by_scipy(orbit):
    begin, columns = flat(orbit.at(0.0)), []
    for k, step in enumerate([1e-6] * 3 + [1e-5] * 2 + [1e-4] * 5):
        change = step * np.eye(10)[k]
        columns.append((turned_once(orbit, begin + change) - turned_once(orbit, begin - change)) / (2.0 * step))
    expected = np.linalg.eigvals(np.stack(columns, axis=1))
    expected = np.delete(expected, np.argmin(np.abs(expected - 1.0)))
    found = np.asarray(orbit.multipliers)
    assert abs(float(orbit.trivial) - 1.0) < 1e-9
    assert np.max([np.min(np.abs(found - e)) for e in expected]) < 1e-6
    assert np.max([np.min(np.abs(expected - e)) for e in found]) < 1e-6


def test_ellipse_of_a_point_is_that_of_the_path(orbit):
    theta = 2.0 * np.pi * np.arange(64) / 64.0
    q = np.asarray(jax.vmap(orbit.at)(theta).displacement)
    path = q[:, :2] + q[:, 2:] * np.array([[-0.5, 1.5]])
    first = 2.0 * np.mean(path * np.exp(-1j * theta)[:, None], axis=0)
    rest = path - path.mean(axis=0) - np.real(first * np.exp(1j * theta)[:, None])
    found = orbit.ellipse(at=(1.5, 0.5))
    assert float(found.semi_major**2 + found.semi_minor**2) == pytest.approx(np.sum(np.abs(first) ** 2), rel=1e-10)
    remainder = np.sqrt(np.mean(np.sum(rest**2, axis=1)) / (0.5 * np.sum(np.abs(first) ** 2)))
    assert float(found.remainder) == pytest.approx(remainder, rel=1e-8)


def test_mean_powers_of_motors_equal_the_dissipation(general, orbit):
    theta = 2.0 * np.pi * np.arange(64) / 64.0
    states = jax.vmap(orbit.at)(theta)
    supplied, lost = jax.vmap(lambda s: jv.power(general, 0.0, s))(states)
    assert float(jnp.sum(orbit.power)) == pytest.approx(float(jnp.mean(supplied)), rel=1e-10)
    assert float(jnp.mean(lost)) == pytest.approx(float(jnp.mean(supplied)), rel=1e-8)


def test_opposite_ideal_exciters_throw_along_a_straight_line():
    scene = symmetric([(0.0, 0.0)] * 2, directions=(1, -1), drive=jv.ConstantSpeed(100.0))
    orbit = jv.synchronous_orbit(scene)
    amplitude = 2.0 * 1.5 * 100.0**2 / abs(8e5 - 2000.0 * 100.0**2 + 4e5j)
    np.testing.assert_allclose(orbit.amplitude, [amplitude, 0.0, 0.0], rtol=1e-12, atol=1e-14)
    assert float(orbit.speed) == 100.0 and np.isnan(orbit.trivial) and bool(orbit.stable)
    assert float(jnp.sum(orbit.power)) == pytest.approx(0.5 * 4e3 * (amplitude * 100.0) ** 2, rel=1e-10)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("jammed", [False, True])
def test_start_includes_gyroscopic_forces_of_either_direction(way, jammed):
    machine = jv.from_matrices(
        20.0 * np.eye(2), 100.0 * np.eye(2), 1e5 * np.eye(2), gyroscopic=[[0.0, 4.0], [-4.0, 0.0]], places=[[0, 1]]
    )
    w, speed = 60.0, 90.0 if jammed else 60.0
    body = {"loads": jv.balls(count=1, mass=1e-5, radius=0.1, drag=1.0)} if jammed else {"unbalance": 1e-6}
    exciter = jv.Exciter(drive=jv.ConstantSpeed(speed), direction=way, **body)
    whole, grid = periodic_scene(jv.Scene(machine, exciters=[exciter]), jnp.zeros(1)), grid_of(17, False)
    start = linear_start(whole, grid, jnp.asarray(w))[:2] * whole.length
    expected = 1e-6 * w**2 / (1e5 - 20.0 * w**2 + 4.0 * w * speed + 100.0j * w)
    size = np.sqrt(2.0 * np.mean(np.asarray(start) ** 2, axis=1))
    np.testing.assert_allclose(size, abs(expected), rtol=1e-5)


def test_phase_of_opposite_motors_is_minus_the_sum_of_angles():
    # Soft supports: alpha_2 - alpha_1 = -(d_1 + d_2), a straight line at (d_1 + d_2)/2.
    length, polar = (0.5, 0.4), (0.4, 2.2)
    places = [(r * np.cos(d), r * np.sin(d)) for r, d in zip(length, polar, strict=True)]
    machine = body((40.0, 40.0), (2.0, 2.0), places=((-1.0, 0.0), (1.0, 0.0)))
    exciters = [jv.Exciter(drive=motor(), unbalance=0.2, at=p, direction=d) for p, d in zip(places, (1, -1), strict=True)]
    orbit = jv.synchronous_orbit(jv.Scene(machine, exciters=exciters), phases=[0.0, -2.4])
    assert float(orbit.phases[1] - orbit.phases[0]) == pytest.approx(-sum(polar), abs=2e-3)
    x, y = np.asarray(orbit.displacement_harmonics[:2, 1])
    assert abs((y / x).imag) < 2e-3 and np.arctan((y / x).real) == pytest.approx(sum(polar) / 2.0, abs=2e-3)


def test_one_jammed_exciter_equals_jam_orbit():
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("600 rpm"))
    jam = jv.jam_orbit(scene, mode=3)
    orbit = jv.synchronous_orbit(scene, speed=jam.omega, points=33)
    assert float(orbit.speed) == pytest.approx(float(jam.omega), rel=1e-11)
    assert float(orbit.power[0]) == pytest.approx(float(jam.power), rel=1e-8)
    np.testing.assert_allclose(orbit.amplitude, jam.amplitude, rtol=1e-9)
    assert float(orbit.foundation_force) == pytest.approx(float(jam.foundation_force), rel=1e-9)
    gaps = np.abs(np.asarray(orbit.multipliers)[:, None] - np.asarray(jam.multipliers)[None])
    assert np.max(np.min(gaps, axis=0)) < 1e-8 and bool(orbit.stable) == bool(jam.stable)


def test_motor_that_is_off_follows_the_other_one():
    scene = symmetric([(-1.1, 0.0), (1.1, 0.0)])
    off = jv.SwitchedOff(motor(), at=5.0, bearing=0.02)
    exciters = [scene.exciters[0], jv.Exciter(drive=off, unbalance=1.5, at=(1.1, 0.0))]
    orbit = jv.synchronous_orbit(jv.Scene(scene.machine, exciters=exciters), phases=[0.0, -0.2])
    assert bool(orbit.stable) and float(orbit.torque[1]) == pytest.approx(-0.02 * float(orbit.speed), rel=1e-6)
    assert float(orbit.torque[0]) > 0.02 * float(orbit.speed) and -np.pi / 2.0 < float(orbit.phases[1]) < 0.0


@pytest.mark.parametrize(("speed", "phase"), [(18.0, 0.0), (33.0, np.pi)])
def test_two_jammed_balancers_push_the_mode_together(speed, phase):
    # In step below the resonance of the translation (20 rad/s), against each other below that of the turn (36.5 rad/s).
    machine = body((4e5, 4e5), (2e3, 2e3), places=((-1.0, 0.0), (1.0, 0.0)))
    balls = jv.balls(count=1, mass=4.0, radius=0.2, drag=0.5)
    exciters = [jv.Exciter(balls, jv.ConstantSpeed(60.0), at=(x, 0.0)) for x in (-0.8, 0.8)]
    orbit = jv.synchronous_orbit(jv.Scene(machine, exciters=exciters), speed=speed, phases=[0.0, phase])
    assert float(orbit.phases[1]) == pytest.approx(phase, abs=1e-9)
    assert (15.0 < float(orbit.speed) < 20.0) if phase == 0.0 else (25.0 < float(orbit.speed) < 36.5)
    translation, turn = np.asarray(orbit.amplitude[0]), np.asarray(orbit.amplitude[2])
    assert (turn < 1e-9 < translation) if phase == 0.0 else (translation < 1e-9 < turn)


def averaged(unbalance):
    """Speed and phase of two opposite motors by the averaged equations, written anew."""
    # The slip of the motors relative to their housings also damps the turn of the body.
    stiffness, damping, mass = np.diag([8e5, 8e5, 8e5]), np.diag([4e3, 4e3, 4e3 + 6.0]), np.diag([2000.0, 2000.0, 600.0])
    places, directions, speeds = ((-0.5, 0.0), (0.9, 0.3)), (1, -1), (100.0, 100.02)

    def balance(unknown):
        speed, phases = unknown[0], np.array([0.0, unknown[1]])
        receptance = np.linalg.inv(stiffness - speed**2 * mass + 1j * speed * damping)
        e = [np.array([1.0, -1j * d]) @ [[1.0, 0.0, -b], [0.0, 1.0, a]] for (a, b), d in zip(places, directions, strict=True)]
        h = np.array([[e_i.conj() @ receptance @ e_k for e_k in e] for e_i in e])
        turned = np.exp(1j * (phases[None] - phases[:, None]))
        vibrational = speed**4 / 2.0 * unbalance**2 * np.sum((turned * h).imag, axis=1)
        return 300.0 * (1.0 - speed / np.array(speeds)) + vibrational

    return fsolve(balance, [100.0, np.pi - np.arctan2(0.3, 0.9)], xtol=1e-13)


def test_averaged_motion_differs_by_the_square_of_the_unbalance():
    machine, errors = body((4e5, 4e5), (2e3, 2e3), places=((-1.0, 0.0), (1.0, 0.0))), []
    for unbalance in (1.0, 2.0):
        numbers = zip((100.0, 100.02), ((-0.5, 0.0), (0.9, 0.3)), (1, -1), strict=True)
        exciters = [jv.Exciter(drive=motor(n), unbalance=unbalance, at=p, direction=d) for n, p, d in numbers]
        speed, phase = averaged(unbalance)
        orbit = jv.synchronous_orbit(jv.Scene(machine, exciters=exciters), speed=speed, phases=[0.0, phase])
        errors.append(abs(float(orbit.speed) - speed) / (100.01 - speed))
    assert errors[1] < 2.0**2 / (600.0 * 0.5)
    assert errors[1] / errors[0] == pytest.approx(4.0, rel=0.3)


def test_single_precision_finds_the_motion(general, orbit):
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), general)
    found = jv.synchronous_orbit(single, phases=jnp.asarray([0.0, 3.0], jnp.float32), speed=jnp.float32(100.0), throw=False)
    assert found.status_name in ("found", "under_resolved")
    assert float(found.speed) == pytest.approx(float(orbit.speed), rel=1e-5)


def with_numbers(scene, numbers):
    where = lambda s: (s.exciters[0].unbalance, s.exciters[1].drive.speed, s.machine.mass)  # noqa: E731
    return eqx.tree_at(where, scene, tuple(numbers))


def answers(numbers, scene, **options):
    orbit = jv.synchronous_orbit(with_numbers(scene, numbers), phases=[0.0, 3.0], points=17, throw=False, **options)
    return jnp.stack([orbit.speed, orbit.phases[1], orbit.torque[0], orbit.amplitude[0], orbit.foundation_force])


def test_gradients_equal_finite_differences(general):
    numbers = jnp.array([1.5, 100.4, 2000.0])
    forward, reverse = jax.jacfwd(answers)(numbers, general), jax.jacrev(answers)(numbers, general)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-12)
    for k, step in enumerate(1e-5 * numbers):
        change = step * jnp.eye(3)[k]
        slope = (answers(numbers + change, general) - answers(numbers - change, general)) / (2.0 * step)
        np.testing.assert_allclose(forward[:, k], slope, rtol=2e-6, atol=1e-9)


def test_batches_under_jit_equal_single_motions(general):
    many = jnp.array([[1.5, 100.4, 2000.0], [1.4, 103.0, 2100.0]])
    found = jax.jit(jax.vmap(lambda n: answers(n, general)))(many)
    np.testing.assert_allclose(found, jnp.stack([answers(n, general) for n in many]), rtol=1e-9)


def test_motion_without_damping_is_not_called_stable():
    scene = symmetric([(-0.3, 0.0), (0.3, 0.0)], directions=(1, -1), damping=0.0)
    orbit = jv.synchronous_orbit(scene, phases=[0.0, np.pi])
    assert orbit.status_name == "found" and abs(float(jnp.sum(orbit.power))) < 1e-9
    assert not bool(orbit.stable) and float(orbit.multiplier) > 1.0 - 1e-9


def test_stable_phase_of_two_motors_depends_on_their_distance():
    # Same rotation, both at the distance l from the centre: in phase is stable if M l^2 > 2 J, antiphase if M l^2 < 2 J.
    for distance, steady in ((0.4, np.pi), (1.1, 0.0)):
        scene = symmetric([(-distance, 0.0), (distance, 0.0)], unbalance=0.5)
        for phase in (0.0, np.pi):
            orbit = jv.synchronous_orbit(scene, phases=[0.0, phase])
            assert orbit.status_name == "found" and bool(orbit.stable) == (phase == steady)


def test_motors_that_cannot_synchronize_end_in_a_status(general):
    apart = with_numbers(general, (1.5, 200.0, 2000.0))
    with pytest.raises(jv.ComputationError, match="no periodic motion"):
        jv.synchronous_orbit(apart, phases=[0.0, 3.0])
    orbit = jv.synchronous_orbit(apart, phases=[0.0, 3.0], throw=False, points=17)
    assert orbit.status_name == "not_converged" and np.isnan(orbit.speed) and not bool(orbit.stable)
    with pytest.raises(jv.InputError, match=r"^regime\.speed is nan rad/s; a finite number is needed"):
        jv.synchronous_orbit(apart, orbit)


def test_ideal_drives_at_different_speeds_have_a_status():
    scene = symmetric([(0.0, 0.0)] * 2, directions=(1, -1), drive=jv.ConstantSpeed(100.0))
    scene = eqx.tree_at(lambda s: s.exciters[1].drive.speed, scene, 90.0)
    assert jv.synchronous_orbit(scene, throw=False).status_name == "different_speeds"


def test_stability_with_very_fast_vibrations_is_unresolved():
    machine = jv.one_mass(mass=50.0, stiffness=4e40, damping=30.0)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.05)
    found = jv.synchronous_orbit(jv.Scene(machine, exciters=[exciter]), points=9, throw=False)
    assert found.status_name == "unresolved" and np.isnan(found.multiplier) and "stability unknown" in found.summary()
    np.testing.assert_allclose(found.foundation_force, 0.05 * 60.0**2, rtol=1e-9)


def test_motion_without_a_correct_digit_is_not_found():
    """Rounding errors of the stiffness terms exceed the torques, so that any speed satisfies the equations at the points."""
    supports = [jv.support(at=(x, 0.0), stiffness=k, damping=(2e3, 2e3)) for x, k in ((-1.0, (4e5, 1e154)), (1.0, (4e5, 4e5)))]
    exciters = [jv.Exciter(drive=motor(), unbalance=1.5, at=(x, 0.0), direction=d) for x, d in ((-0.3, 1), (0.3, -1))]
    scene = jv.Scene(jv.plane_body(mass=2000.0, inertia=600.0, supports=supports), exciters=exciters)
    found = jv.synchronous_orbit(scene, phases=(0.0, 3.1), points=17, throw=False)
    assert found.status_name == "not_converged" and found.error > 1.0 and np.isnan(found.speed)


def test_wrong_input_ends_in_one_sentence(general):
    machine, loads = body(), jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    with pytest.raises(jv.InputError, match="speed is missing"):
        jv.synchronous_orbit(jv.Scene(machine, loads, jv.ConstantSpeed(60.0)))
    with pytest.raises(jv.InputError, match="loads do not turn at the rotor speed, as"):
        jv.synchronous_orbit(jv.Scene(machine, exciters=[jv.Exciter(loads, motor(), unbalance=1.0)]))
    with pytest.raises(jv.InputError, match="loads need a drive of prescribed speed"):
        jv.synchronous_orbit(jv.Scene(machine, exciters=[jv.Exciter(loads, motor())]))
    with pytest.raises(jv.InputError, match="phases has 3 values"):
        jv.synchronous_orbit(general, phases=[0.0, 1.0, 2.0])
    with pytest.raises(jv.InputError, match="regime is given together with speed"):
        jv.synchronous_orbit(general, jv.synchronous_orbit(general, phases=[0.0, 3.0]), speed=100.0)
    for regime, problem in (
        (1, "regime is 1; it must be an object with speed and phases"),
        (SimpleNamespace(speed=100.0, phases=None), "regime.phases is None, which is not a number"),
        (SimpleNamespace(speed=100.0, phases=[0.0, "a"]), r"regime.phases\[1\] is 'a', which is not in rad"),
        (SimpleNamespace(speed=None, phases=[0.0, 3.0]), "regime.speed is None, which is not a number"),
    ):
        with pytest.raises(jv.InputError, match=problem):
            jv.synchronous_orbit(general, regime)


def test_regimes_of_loads_start_from_their_angle():
    """Two loads of the first exciter have one angle in the orbit; the regime has a phase for each of them."""
    loads = jv.balls(count=2, mass=0.5, radius=0.2, drag=1.0)
    exciters = [jv.Exciter(loads, jv.ConstantSpeed(110.0), at=(-0.3, 0.0)), jv.Exciter(drive=motor(), unbalance=1.5)]
    scene = jv.Scene(body(), exciters=exciters)

    def started(phases, masses):
        regime = SimpleNamespace(speed=jnp.asarray(99.0), phases=jnp.array(phases), masses=jnp.array(masses))
        return plan_synchronous(scene, regime, speed=None, phases=None, accuracy=None, points=None).phases.tolist()

    assert started([0.1, 0.1 + 2.0 * np.pi, 0.7], [0, 1, 2]) == [0.1, 0.7]
    with pytest.raises(jv.InputError, match=r"regime\.phases of the loads of exciter 1 differ; this function is for loads"):
        started([0.1, 0.2, 0.7], [0, 1, 2])
    with pytest.raises(jv.InputError, match=r"regime\.masses are 2 of the scene's 3 rotating masses; give a regime of all"):
        started([0.1, 0.7], [0, 2])


def test_limit_of_synchronization_is_the_fold_of_the_motion(general, orbit):
    limit = jv.synchronization_limit(general, orbit, over="exciters[1].drive.speed")
    assert float(limit.value[0]) < 100.4 < float(limit.value[1])
    assert repr(limit).startswith("exciters[1].drive.speed from 98.69") and len(limit.plot().axes) == 1
    for end, outward in ((0, -1.0), (1, 1.0)):
        start = {"speed": limit.speed[end], "phases": limit.phases[end], "throw": False, "points": 17}
        names = []
        for share in (-1e-5, 1e-5):
            numbers = (1.5, float(limit.value[end]) * (1.0 + outward * share), 2000.0)
            names.append(jv.synchronous_orbit(with_numbers(general, numbers), **start).status_name)
        assert names == ["found", "not_converged"]


@pytest.mark.parametrize(("over", "start"), [("exciters[1].unbalance", 1.0), ("exciters[1].at[0]", 0.9)])
def test_limit_over_unbalance_and_place_is_the_closed_form(over, start):
    """Soft supports: W = w^2 S_1 S_2 l_1 l_2 / (2 J) is at least half the difference of the torques."""
    machine = body((40.0, 40.0), (2.0, 2.0), places=((-1.0, 0.0), (1.0, 0.0)))
    parts = ((100.0, 1.5, -0.5, 1), (99.0, 1.0, 0.9, -1))
    exciters = [jv.Exciter(drive=motor(n), unbalance=s, at=(x, 0.0), direction=way) for n, s, x, way in parts]
    scene = jv.Scene(machine, exciters=exciters)
    limit = jv.synchronization_limit(scene, jv.synchronous_orbit(scene, phases=[0.0, np.pi + 0.3]), over=over)
    w = 2.0 / (1.0 / 100.0 + 1.0 / 99.0)
    half = 300.0 * (w / 99.0 - w / 100.0) / 2.0
    assert list(status_names(limit.status)) == ["found", "not_found"] and np.isnan(limit.value[1])
    np.testing.assert_allclose(limit.value[0] / start, half / (w**2 * 1.5 * 0.5 * 0.9 / 1200.0), rtol=5e-3)
    np.testing.assert_allclose(limit.speed[0], w, rtol=1e-4)


def test_motion_near_a_fold_says_so(general, orbit):
    limit = jv.synchronization_limit(general, orbit, over="exciters[1].drive.speed")
    at_limit = with_numbers(general, (1.5, float(limit.value[1]) * (1.0 - 1e-14), 2000.0))
    found = jv.synchronous_orbit(at_limit, speed=limit.speed[1], phases=limit.phases[1], throw=False, points=17)
    assert found.status_name in ("at_fold", "under_resolved") and not bool(found.error < 1e-9)


def test_limit_over_the_speed_of_an_ideal_drive_is_its_fold():
    """The spin-up is over in a steady motion; the motor follows the ideal drive within the limits only."""

    def scene_at(speed, *more):
        drives = (jv.SpinUp(speed, duration="5 s"), motor(), *more)
        places, directions = ((-0.3, 0.0), (0.3, 0.0), (0.0, 0.1)), (1, -1, 1)
        parts = list(zip(drives, places, directions, strict=False))
        machine = body((4e5, 4e5), (2e3, 2e3), places=((-1.0, 0.0), (1.0, 0.0)))
        return jv.Scene(machine, exciters=[jv.Exciter(drive=d, unbalance=1.5, at=p, direction=way) for d, p, way in parts])

    over = "exciters[0].drive.speed"
    start = jv.synchronous_orbit(scene_at(100.0), phases=[0.0, 3.1], points=17)
    limit = jv.synchronization_limit(scene_at(100.0), start, over=over)
    np.testing.assert_allclose(limit.speed, limit.value, rtol=1e-12)
    assert 98.0 < limit.value[0] < 100.0 < limit.value[1] < 102.0
    for value, phases, outward in zip(limit.value, limit.phases, (-1e-5, 1e-5), strict=True):
        changed = [scene_at(float(value) * (1.0 + share)) for share in (-outward, outward)]
        found = [jv.synchronous_orbit(each, phases=phases, points=17, throw=False).status_name for each in changed]
        assert found == ["found", "not_converged"]
    with pytest.raises(jv.InputError, match="the speed of one of several ideal drives"):
        jv.synchronization_limit(scene_at(100.0, jv.ConstantSpeed(100.0)), start, over=over)


def test_limit_of_an_unstable_motion_and_without_effect_says_so():
    """Equal springs across at the height of the centre: neither of them changes the phases of the mirrored motion."""
    scene = symmetric([(-0.3, 0.0), (0.3, 0.0)], directions=(1, -1))
    over = "machine.supports[0].damping[0]"
    limit = jv.synchronization_limit(scene, jv.synchronous_orbit(scene, phases=[0.0, 0.0], points=17), over=over)
    assert list(status_names(limit.status)) == 2 * ["no_effect"] and np.all(np.isnan(limit.value)) and not limit.stable
    assert ", not stable)" in limit.summary() and "changes neither the phases nor the speed" in limit.summary()


def test_limits_are_allowed_values():
    """The parameter is cos(phase) - 0.5 along the branch: a fold at 0.5, and one at -1.5."""

    def at(_, along):
        numbers = (np.cos(along) - 0.5, 1.0, np.zeros(2), -np.sin(along), True, along)
        return _Point(*map(np.asarray, numbers))

    ends = [_find_fold(at, at(None, 1.0), towards, Bounds(0.0)) for towards in (-1.0, 1.0)]
    np.testing.assert_allclose(ends[0][0].value, 0.5, rtol=1e-12)
    assert ends[1][0] is None and 0.0 <= float(ends[1][1][-1].value) < 1e-3
    np.testing.assert_allclose(_find_fold(at, at(None, 1.0), 1.0, Bounds())[0].value, -1.5, rtol=1e-12)


def test_limit_needs_a_number_and_a_free_motion(general, orbit):
    with pytest.raises(jv.InputError, match="is not a parameter of this scene"):
        jv.synchronization_limit(general, orbit, over="exciters[1].drive.torque")
    with pytest.raises(jv.InputError, match="has no exciter whose speed or phase is free"):
        ideal = symmetric([(0.0, 0.0)] * 2, directions=(1, -1), drive=jv.ConstantSpeed(100.0))
        jv.synchronization_limit(ideal, jv.synchronous_orbit(ideal, points=17), over="exciters[1].unbalance")


def test_stroke_and_throw_number_are_those_of_the_whole_path(orbit):
    theta = 2.0 * np.pi * np.arange(4096) / 4096.0
    k = np.arange(orbit.displacement_harmonics.shape[1])
    rows = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, 1.5]])
    harmonics = rows @ np.asarray(orbit.displacement_harmonics)
    path, w = np.real(harmonics @ np.exp(1j * np.outer(k, theta))), float(orbit.speed)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 4001)
    widths = [np.ptp(np.cos(a) * path[0] + np.sin(a) * path[1]) for a in angle]
    found = orbit.ellipse(at=(1.5, 0.5), slope=-0.1)
    assert float(found.stroke) == pytest.approx(np.max(widths), rel=1e-6)
    assert abs(float(found.stroke) / (2.0 * float(found.semi_major)) - 1.0) > 1e-5  # the fundamental alone
    assert float(found.direction) == pytest.approx(angle[np.argmax(widths)], abs=2e-3)
    x, y = np.real(-((k * w) ** 2) * harmonics @ np.exp(1j * np.outer(k, theta))) / 9.80665
    assert float(found.acceleration) == pytest.approx(np.max(np.hypot(x, y)), rel=1e-6)
    throw = np.max(np.sin(-0.1) * x - np.cos(-0.1) * y) / np.cos(-0.1)
    assert float(found.throw_number) == pytest.approx(throw, rel=1e-6)
