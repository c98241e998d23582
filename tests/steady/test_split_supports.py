"""Rotors whose supports differ across and up: against NumPy and SciPy in the fixed frame, and time integration."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import jaxvib as jv
from jaxvib.motion.analysis import regime

K, UP, B, BUP = (6.0e5, 5.0e5), (9.0e5, 8.0e5), (440.0, 400.0), (300.0, 350.0)
L, MASS, ACROSS, ALONG = (0.165, -0.155), 37.0, 0.479, 0.2


def rotor(**parts):
    given = dict(
        mass=MASS, transverse_inertia=ACROSS, polar_inertia=ALONG, position=L,
        stiffness=K, damping=B, stiffness_up=UP, damping_up=BUP,
    )  # fmt: skip
    return jv.rotor(**(given | parts))


def matrices():
    """Mass, damping, stiffness and gyroscopic matrices of (y, z, theta, psi), from each support's own point."""
    stiffness, damping = np.zeros((4, 4)), np.zeros((4, 4))
    for place, k, up, b, bup in zip(L, K, UP, B, BUP, strict=True):
        across, high = np.array([1.0, 0.0, place, 0.0]), np.array([0.0, 1.0, 0.0, place])
        stiffness += k * np.outer(across, across) + up * np.outer(high, high)
        damping += b * np.outer(across, across) + bup * np.outer(high, high)
    skew = np.zeros((4, 4))
    skew[2, 3], skew[3, 2] = ALONG, -ALONG
    return np.diag([MASS, MASS, ACROSS, ACROSS]), damping, stiffness, skew


def scene(machine, drive=None, effects=(), drag=1.0):
    drive = jv.ConstantSpeed(450.0) if drive is None else drive
    return jv.Scene(machine, jv.balls(count=2, mass=0.05, radius=0.08, drag=drag), drive, effects)


def planar(**parts):
    return jv.planar_rotor(**(dict(mass=20.0, stiffness=4e4, damping=60.0, stiffness_up=9e4, damping_up=80.0) | parts))


def test_matrices_are_those_of_each_support():
    _, c, k, _ = matrices()
    carrier = rotor().carrier()
    np.testing.assert_allclose(carrier.stiffness, k, rtol=1e-14, atol=1e-9)
    np.testing.assert_allclose(carrier.damping, c, rtol=1e-14, atol=1e-12)
    np.testing.assert_allclose(carrier.foundation_stiffness, k[:2], rtol=1e-14, atol=1e-9)
    np.testing.assert_allclose(carrier.foundation_damping, c[:2], rtol=1e-14, atol=1e-12)
    equal, plain = (rotor(stiffness_up=up).carrier().stiffness for up in (K, None))
    np.testing.assert_array_equal(equal, plain)


@pytest.mark.parametrize("up", [9e4, 4e4])
def test_whirls_with_a_forward_part_are_excited(up):
    """M = m 1, K = diag(k, up), G = g (0 1; -1 0): (k - m w^2) y + i w n g z = 0, so that z = i (k - m w^2)/(w n g) y."""
    mass, g, n = 20.0, 4.0, 100.0
    skew = g * np.array([[0.0, 1.0], [-1.0, 0.0]])
    machine = jv.from_matrices(mass * np.eye(2), np.zeros((2, 2)), np.diag([4e4, up]), skew, places=[[0, 1]])
    whirls = jv.whirl(scene(machine), n, loads="none")
    values = np.roots([mass**2, 0.0, -mass * (4e4 + up) - (n * g) ** 2, 0.0, 4e4 * up])
    w = np.sort(values[values > 0.0])
    ratio = (4e4 - mass * w**2) / (w * n * g)
    np.testing.assert_allclose(whirls.speed[0], w, rtol=1e-9)
    exact = (np.abs(1.0 - ratio) - np.abs(1.0 + ratio)) / (np.abs(1.0 - ratio) + np.abs(1.0 + ratio))
    np.testing.assert_allclose(whirls.directivity[0], exact, atol=1e-6)
    np.testing.assert_array_equal(whirls.forward[0], exact > 0.0)
    natural = regime.excited_frequencies(scene(machine), jnp.asarray(n))
    assert np.isfinite(natural).tolist() == [True, up != 4e4]


def test_critical_speeds_split_as_by_numpy():
    m, _, k, g = matrices()
    exact = np.sqrt(1.0 / scipy.linalg.eigh(m - 1j * g, k, eigvals_only=True)[::-1])
    found = jv.critical_speeds(scene(rotor()), loads="none")
    np.testing.assert_allclose(found.speed, exact, rtol=1e-11)
    equal = jv.critical_speeds(scene(rotor(stiffness_up=K, damping_up=B)), loads="none").speed
    assert found.speed[1] - found.speed[0] > 5.0 * (equal[1] - equal[0])


@pytest.mark.parametrize("speed", [0.0, 200.0, 500.0])
def test_whirl_is_the_fixed_frame_eigenproblem(speed):
    m, c, k, g = matrices()
    first = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.linalg.solve(m, k), -np.linalg.solve(m, c + speed * g)]])
    values = np.linalg.eigvals(first)
    values = values[values.imag > 0.0]
    values = values[np.argsort(values.imag)]
    found = jv.whirl(scene(rotor()), [speed], loads="none")
    np.testing.assert_allclose(found.speed[0], values.imag, rtol=1e-10)
    np.testing.assert_allclose(found.decay[0], -values.real, rtol=1e-8)


def test_a_rotor_without_tilt_moves_on_straight_lines():
    found = jv.critical_speeds(scene(planar()), loads="none")
    np.testing.assert_allclose(found.speed, np.sqrt(np.array([4e4, 9e4]) / 20.0), rtol=1e-12)
    equal = dict(stiffness_up=None, damping_up=None)
    words = ["straight at 0 deg", "straight at 90 deg"]
    assert found.sense.tolist() == words and not np.any(found.forward)
    np.testing.assert_allclose(found.angle, [0.0, np.pi / 2.0], atol=1e-7)
    assert jv.critical_speeds(scene(planar(**equal))).sense.tolist() == ["backward", "forward"]
    assert found.summary().count("straight") == 2 and jv.whirl(scene(planar()), [10.0]).sense.tolist() == [words]
    stiff_x = jv.whirl(scene(planar(stiffness_up=1e4)), [10.0])
    assert stiff_x.sense.tolist() == [words[::-1]] and np.all(np.isnan(jv.whirl(scene(planar(**equal)), [10.0]).angle))


@pytest.mark.parametrize("direction", [1, -1])
def test_straight_motions_have_the_angles_of_inclined_springs(direction):
    """Springs of 4e4 N/m along a line at 30 degrees, and of 9e4 N/m across it: the axis moves along one of the two lines."""
    along, across = np.array([np.sqrt(3.0), 1.0]) / 2.0, np.array([-1.0, np.sqrt(3.0)]) / 2.0
    stiffness = 4e4 * np.outer(along, along) + 9e4 * np.outer(across, across)
    machine = jv.from_matrices(20.0 * np.eye(2), 60.0 * np.eye(2), stiffness, places=[[[1.0, 0.0], [0.0, 1.0]]])
    exciter = jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=1e-3, direction=direction)
    found = jv.whirl(jv.Scene(machine, exciters=[exciter]), [10.0])
    np.testing.assert_allclose(np.degrees(found.angle), [[30.0, 120.0]], atol=1e-4)
    np.testing.assert_allclose(np.degrees(found.critical.angle), [30.0, 120.0], atol=1e-4)
    assert found.sense.tolist() == [["straight at 30 deg", "straight at 120 deg"]]


def test_an_unbalance_whirls_backward_between_split_speeds():
    exciter = jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=1e-3)
    speeds = np.array([30.0, 50.0, 60.0, 90.0])  # criticals at 44.7 and 67.1 rad/s
    y, z = jv.response(jv.Scene(planar(), exciters=[exciter]), speeds).displacement.T
    np.testing.assert_allclose(y, 1e-3 * speeds**2 / (4e4 - 20.0 * speeds**2 + 60j * speeds), rtol=1e-11)
    np.testing.assert_allclose(z, -1e-3j * speeds**2 / (9e4 - 20.0 * speeds**2 + 80j * speeds), rtol=1e-11)
    assert np.sign(np.imag(y * np.conj(z))).tolist() == [1.0, -1.0, -1.0, 1.0]


def test_the_criterion_ends_at_the_split_speeds():
    found = jv.criterion(scene(planar())).speeds
    mass = 20.0 + 0.1
    np.testing.assert_allclose(found.resonances, np.sqrt(np.array([4e4, 9e4]) / mass), rtol=1e-9)
    np.testing.assert_allclose(found.additional, [np.sqrt(6.5e4 / mass)], rtol=1e-9)


def balanced_growth_by_scipy(speed, angles=(0.0, np.pi)):
    """Growth rate of disturbances of the balanced motion, by variational equations in the fixed frame over a turn."""
    m, r, kappa, drag, mass = 0.05, 0.08, 1.4, 1.0, 20.0
    k, b = np.array([4e4, 9e4]), np.array([60.0, 80.0])

    def acceleration(t, x):
        q, p, v, w = x[:2], x[2:4], x[4:6], x[6:]
        normal, along = np.stack([np.cos(p), np.sin(p)]), np.stack([-np.sin(p), np.cos(p)])
        matrix, right = np.zeros((4, 4)), np.zeros(4)
        matrix[:2, :2] = (mass + 2.0 * m) * np.eye(2)
        matrix[:2, 2:], matrix[2:, :2] = m * r * along, m * r * along.T
        matrix[2:, 2:] = kappa * m * r**2 * np.eye(2)
        right[:2] = -k * q - b * v + m * r * normal @ w**2
        right[2:] = drag * r**2 * (speed - w)
        return np.concatenate([v, w, np.linalg.solve(matrix, right)])

    def change(column, size=1e-5):
        ends = []
        for sign in (1.0, -1.0):
            start = np.concatenate([np.zeros(2), angles, np.zeros(2), [speed, speed]])
            start[column] += sign * size
            turn = 0.0, 2.0 * np.pi / speed
            run = scipy.integrate.solve_ivp(acceleration, turn, start, method="DOP853", rtol=1e-12, atol=1e-14)
            ends.append(run.y[:, -1])
        return (ends[0] - ends[1]) / (2.0 * size)

    values = np.linalg.eigvals(np.stack([change(k) for k in range(8)], axis=1))
    others = np.delete(values, np.argmin(np.abs(values - 1.0)))
    return np.log(np.max(np.abs(others))) * speed / (2.0 * np.pi)


@pytest.mark.parametrize("speed", [40.0, 55.0, 62.0, 120.0])
def test_stability_of_balancing_is_scipys(speed):
    found = jv.balanced_states(scene(planar(), jv.ConstantSpeed(speed))).stability()
    exact = balanced_growth_by_scipy(speed)
    np.testing.assert_allclose(found.growth, exact, rtol=1e-4, atol=1e-5)
    assert found.is_decided and found.stable == (exact < 0.0)
    assert bool(jv.criterion(scene(planar())).balances(speed)) == found.stable


def test_a_jam_on_split_supports_is_the_simulated_one():
    jammed = scene(planar(), jv.ConstantSpeed(54.0), drag=0.3)
    orbit = jv.jam_orbit(jammed, mode=1)
    run = jv.simulate(jammed, "30 s", start="jam", mode=1, separation=0.0, save="window")
    np.testing.assert_allclose(run.omega, orbit.omega, rtol=1e-5)
    np.testing.assert_allclose(run.amplitude, orbit.amplitude, rtol=1e-3)
    averaged = jv.envelope(jammed, "30 s", start="jam", mode=1, separation=0.0, save="window")
    np.testing.assert_allclose(averaged.amplitude, orbit.amplitude, rtol=2e-2)  # first order in the mass of the loads


def test_split_supports_are_kept_in_scene_files():
    for machine in (rotor(), planar()):
        again = jv.scene_from_toml(jv.scene_to_toml(scene(machine))).machine
        np.testing.assert_array_equal(again.carrier().stiffness, machine.carrier().stiffness)
        np.testing.assert_array_equal(again.carrier().damping, machine.carrier().damping)


def test_terms_together_with_values_up_are_refused():
    with pytest.raises(jv.InputError, match=r"machine\.stiffness_up is given together with stiffness_terms"):
        rotor(stiffness_terms=(1e6, 0.0, 3e4))
