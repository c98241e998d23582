"""Motions of exciters in groups of different speeds: closed forms, run-ups, simulation, exchanges, bad input."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxvib as jv
from jaxvib.steady.regimes.partitions import _distinct_motions, _motion, _Rows
from jaxvib.steady.regimes.symmetry import Exchange
from jaxvib.steady.regimes.synchronous import RegimeStatus

MASS, INERTIA = 300.0, 75.0


def body(across=6e4, up=6e4, damping=600.0):
    springs = [jv.support(at=(x, 0.0), stiffness=(across / 2, up / 2), damping=(damping / 2,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def motor(speed, torque, inertia=0.05):
    return jv.DCMotor(speed, stall_torque=torque, inertia=inertia)


def scene_of(drives, places, ways, unbalances=0.4, machine=None):
    unbalances = np.broadcast_to(unbalances, len(drives))
    parts = zip(drives, unbalances, places, ways, strict=True)
    exciters = [jv.Exciter(drive=d, unbalance=float(s), at=at, direction=way) for d, s, at, way in parts]
    return jv.Scene(machine or body(), exciters=exciters)


def speeds_alone(unbalance, speed, torque):
    """Speeds at which one exciter at the centre turns, and True for stable ones: sign changes of its torque balance."""

    def balance(w):
        return torque * (1.0 - w / speed) - 600.0 * unbalance**2 * w**5 / ((6e4 - MASS * w**2) ** 2 + (600.0 * w) ** 2)

    grid = np.linspace(1.0, speed, 20001)
    values = balance(grid)
    at = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    return [(brentq(balance, grid[k], grid[k + 1], xtol=1e-12), values[k] > 0.0) for k in at]


def test_gyroscopic_matrix_includes_rotors_of_other_groups():
    machine = jv.from_matrices(
        20.0 * np.eye(2), 100.0 * np.eye(2), 1e5 * np.eye(2), gyroscopic=[[0.0, 4.0], [-4.0, 0.0]], places=[[0, 1]]
    )
    slow = jv.Exciter(drive=motor(60.0, 1.0, 0.01), unbalance=0.02)
    for way in (1, -1):
        fast = jv.Exciter(drive=jv.ConstantSpeed(300.0), unbalance=1e-4, direction=way)
        scene = jv.Scene(machine, exciters=[slow, fast])
        regimes = jv.synchronous_regimes(scene, masses=[0])
        run = jv.settle(scene)
        np.testing.assert_allclose(regimes.speed, run.load_speed[:1], rtol=1e-5)
        np.testing.assert_allclose(regimes.amplitude[0], run.amplitude, rtol=1e-2)  # the fast rotor adds 0.4 %
        assert jv.regime_partitions(scene).interaction[0] < 1e-3


@pytest.mark.slow
def test_partitions_of_two_are_all_pairs_of_single_speeds():
    numbers = [(0.4, 100.0, 0.6), (0.3, 60.0, 0.4)]
    drives = [motor(speed, torque, 0.5) for _, speed, torque in numbers]
    scene = scene_of(drives, [(0.0, 0.0)] * 2, (1, -1), [s for s, _, _ in numbers])
    found = jv.regime_partitions(scene, stable=False)
    apart = np.sort_complex(found.speed[np.max(found.group, axis=1) == 1] @ np.array([1.0, 1j]))
    alone = [speeds_alone(*each) for each in numbers]
    assert [len(each) for each in alone] == [3, 3]
    pairs = np.sort_complex(np.array([a + 1j * b for a, _ in alone[0] for b, _ in alone[1]]))
    np.testing.assert_allclose(apart, pairs, atol=1e-6)  # opposite exciters at the centre do not act on each other
    stable = np.sort_complex(np.array([a + 1j * b for a, s in alone[0] for b, t in alone[1] if s and t]))
    good = jv.regime_partitions(scene)
    np.testing.assert_allclose(np.sort_complex(good.speed @ np.array([1.0, 1j])), stable, atol=1e-6)
    np.testing.assert_allclose(good.interaction, 0.0, atol=1e-12)


@pytest.mark.slow
def test_run_up_and_simulation_end_in_one_of_the_partitions():
    """Two motors synchronize, the third is too slow to follow them."""
    drives = [motor(100.0, 60.0), motor(99.5, 60.0), motor(70.0, 30.0)]
    scene = scene_of(drives, [(-0.5, 0.3), (0.4, 0.1), (0.1, -0.4)], (1, -1, 1))
    found = jv.regime_partitions(scene)
    runs = [tier(scene, 30.0, save="window") for tier in (jv.envelope, jv.simulate)]
    for run in runs:
        speed = np.abs(np.asarray(run.load_speed))
        row = np.argmin(np.max(np.abs(found.speed - speed), axis=1))
        assert found.group[row].tolist() == [0, 0, 1] and found.interaction[row] < 0.2
        away = np.max(np.abs(found.speed[row] - speed))
        assert away < found.interaction[row] * np.ptp(speed) and away < 4e-3 * np.max(speed)
        np.testing.assert_allclose(speed[0], speed[1], rtol=1e-4)
    regimes = found.select(int(row))
    assert [regime.speed.shape for regime in regimes] == [(), ()] and regimes[0].phases.shape == (2,)
    assert all(bool(regime.stable) for regime in regimes)


def test_caught_and_passed_equal_exciters_are_listed_once():
    drives = [motor(100.0, 0.6, 0.5)] * 2
    found = jv.regime_partitions(scene_of(drives, [(-0.3, 0.0), (0.3, 0.0)], (1, 1)))
    apart = found.speed[np.max(found.group, axis=1) == 1]
    assert len(apart) == 1 and np.min(apart) < 14.2 < 75.0 < np.max(apart)


@pytest.mark.slow
def test_load_that_jams_leaves_the_others_at_the_rotor_speed():
    loads = jv.balls(count=2, mass=1.0, radius=0.2, drag=0.1)
    scene = jv.Scene(body(damping=200.0), exciters=[jv.Exciter(loads, jv.ConstantSpeed(60.0))])
    found = jv.regime_partitions(scene)
    apart = found.speed[np.max(found.group, axis=1) == 1]
    assert len(apart) == 1 and np.min(apart) < 14.2 < 57.0 < np.max(apart) < 60.0
    assert "stable" in found.summary() and len(found.plot().axes) == 1


def test_groups_that_do_not_exist_are_refused():
    scene = scene_of([motor(100.0, 60.0)] * 2, [(-0.3, 0.0), (0.3, 0.0)], (1, 1))
    for wrong, says in (([], "give different numbers of rotating masses, 0 to 1"), ([0, 0], "give diff"), ([2], "give diff")):
        with pytest.raises(jv.InputError, match=says):
            jv.synchronous_regimes(scene, masses=wrong)
    many = scene_of([motor(100.0, 60.0)] * 7, [(0.0, 0.0)] * 7, (1,) * 7)
    with pytest.raises(jv.InputError, match="at most 6 are possible"):
        jv.regime_partitions(many)


def test_group_of_one_mass_is_a_scene_of_its_own():
    scene = scene_of([motor(100.0, 60.0), motor(99.5, 60.0)], [(-0.3, 0.0), (0.3, 0.1)], (1, -1))
    alone = jv.synchronous_regimes(scene, masses=[1], near=(99.0, np.zeros(1)))
    single = jv.synchronous_regimes(scene_of([motor(99.5, 60.0)], [(0.3, 0.1)], (-1,)), near=(99.0, np.zeros(1)))
    assert alone.can_start.shape == (1,)
    np.testing.assert_allclose(alone.speed, single.speed, rtol=1e-12)
    np.testing.assert_allclose(alone.growth, single.growth, rtol=1e-6)
    np.testing.assert_allclose(alone.power, single.power, rtol=1e-9)
    assert alone.masses.tolist() == [1] and "2" in {text.get_text() for text in alone.plot().axes[0].texts}
    assert alone.plot().axes[0].get_title().endswith("resultant 1")
    plt.close("all")
    with pytest.raises(jv.InputError, match=f"masses has 1 of the scene's {len(scene.exciters)} rotating masses"):
        alone.vibration()


def test_a_motion_is_stable_if_all_its_groups_are():
    """Groups (0, 2) and (1,) with the growth rates -2 and 3 1/s."""

    def regime(masses, growth, stable):
        numbers = np.arange(1.0, masses + 1.0)
        status = RegimeStatus.found if stable else jv.RegimeStatus.degenerate
        return SimpleNamespace(
            speed=10.0 * masses, phases=numbers, torque=-numbers, growth=growth, stable=stable, status=status
        )

    group, speed, phases, torque, family, growth, stable = _motion(
        [((0, 2), regime(2, -2.0, True)), ((1,), regime(1, 3.0, False))], 3
    )
    assert list(group) == [0, 1, 0] and list(speed) == [20.0, 10.0, 20.0] and (growth, stable) == (3.0, False)
    assert list(family) == [False, True, False] and list(phases) == [1.0, 1.0, 2.0] and list(torque) == [-1.0, -1.0, -2.0]


def distinct(speed, torque, exchanges, phases=None, group=None, family=False):
    """Return `_distinct_motions` for motions of two masses in groups of their own if no `group` is given."""
    n, masses = np.shape(speed)
    rows = [
        np.arange(masses) if group is None else group,
        speed,
        np.zeros(masses) if phases is None else phases,
        torque,
        family,
    ]
    rows = [np.broadcast_to(each, (n, masses)) for each in rows]
    return _distinct_motions(_Rows(*rows, np.zeros(n), np.ones(n, bool)), exchanges).tolist()


SAME, SWAP = (Exchange(np.array(order), np.zeros(2)) for order in ([0, 1], [1, 0]))


def test_motions_that_differ_by_an_exchange_are_one():
    speed, torque = np.array([[90.0, 60.0], [60.0, 90.0], [90.0, 60.0], [90.0, 60.1]]), np.array(
        [[5.0, 3.0], [3.0, 5.0], [5.0, 2.9], [5.0, 3.0]]
    )  # fmt: skip
    assert distinct(speed, torque, [SAME, SWAP]) == [0, 2, 3]
    assert distinct(speed, torque, [SAME]) == [0, 1, 2, 3]
    close = np.array([[90.0, 60.0], [90.0 + 8e-4, 60.0], [90.0 + 1e-3, 60.0]])
    assert distinct(close, torque[[0, 0, 0]], [SAME]) == [0, 2]
    assert distinct(np.zeros((0, 2)), np.zeros((0, 2)), [SAME]) == []


def test_motions_of_other_phases_are_different():
    """Without damping the speeds and torques of regimes in phase and in antiphase are equal."""
    speed, torque = np.full((4, 2), 90.0), np.zeros((4, 2))
    phases = np.array([[0.0, 0.0], [0.0, np.pi], [0.5, 0.5], [0.3, 0.3 - np.pi]])
    assert distinct(speed, torque, [SAME, SWAP], phases, group=[0, 0]) == [0, 1]
    assert distinct(speed, torque, [SAME, SWAP], phases) == [0]  # phases of two groups have no relation
    assert distinct(speed, torque, [SAME, SWAP], phases, group=[0, 0], family=True) == [0]
    # A mirror with a shift: alpha' = (alpha_2 + 1, alpha_1), of which 0, 0.4 gives 1.4, 0.
    mirror = Exchange(np.array([1, 0]), np.array([0.0, 1.0]))
    phases = np.array([[0.0, 0.4], [1.4, 0.0], [0.0, -0.4], [0.0, -0.6]])
    assert distinct(speed, torque, [SAME, mirror], phases, group=[0, 0]) == [0, 2]
