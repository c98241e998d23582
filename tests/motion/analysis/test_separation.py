"""Loads that start apart, and motions that only loads at exactly one angle keep."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.motion.analysis.separation import (
    has_overlap,
    nearly_coincident_pairs,
    separation_rate,
    smallest_distance,
    would_separate,
)
from optimize.quantities.evaluation import Evaluation


def three_balls(**given):
    """A ball balancer: 25 kg on 500 N/mm, an imbalance of 6 g m, three balls of 4 g m each."""
    machine = jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0)
    loads = jv.balls(count=3, mass=0.04, radius=0.1, drag=2.0, **given)
    return jv.Scene(machine, loads, jv.RunUp(100.0 * np.pi, 100.0), (jv.Gravity(), jv.StaticImbalance(moment=6e-3)))


def two_balls(drag, speed, mass=0.5):
    """A scene whose upper jam is stable by slope; two balls in it separate, and balance the rotor."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    return jv.Scene(machine, jv.balls(count=2, mass=mass, radius=0.1, drag=drag), jv.ConstantSpeed(speed))


def test_three_balls_balance_a_rotor_unless_at_one_angle():
    s = three_balls()
    separated, one_angle = (jv.simulate(s, 10.0, separation=a, save="window", estimate=False) for a in (None, 0.0))
    assert separated.regime.label == "balanced" and float(separated.foundation_force) < 1.0
    assert one_angle.status_name == "would_separate" and not bool(one_angle.settled) and bool(one_angle.finished)
    assert one_angle.summary().startswith("not settled: loads of one track are at nearly one angle, and")
    assert "need ball_radius and load_contact" in one_angle.message
    np.testing.assert_allclose(one_angle.foundation_force, 215.5, rtol=1e-3)


def test_sized_loads_inside_each_other_need_contact():
    """The same loads as a point, and in contact."""
    s = three_balls(ball_radius=0.011)
    run = jv.simulate(s, 10.0, separation=0.0, estimate=False)
    assert run.status_name == "overlapping" and not bool(run.settled) and bool(run.finished)
    assert run.summary().startswith("not settled: loads are inside each other, because they pass through each other")
    assert "add load_contact = { stiffness = 1e5, restitution = 0.6 } to [effects]" in run.message
    assert "on the way" not in "".join(line for line in run.summary().splitlines() if "passed through" in line)
    assert bool(jv.settle(at_speed(s), separation=0.0).status == jv.RunStatus.overlapping)


def test_unsettled_runs_that_end_inside_each_other_say_so():
    """The loads start in contact, gather while the rotor runs up, and still move to balance it after 10 s."""
    run = jv.simulate(three_balls(ball_radius=0.011), 10.0, save="window", estimate=False)
    assert float(run.drift) > 0.1 and run.status_name == "overlapping" and bool(run.finished) and not bool(run.settled)
    assert run.summary().startswith("not settled: loads are inside each other") and "run longer" not in run.summary()


def test_loads_that_passed_each_other_are_in_the_summary():
    angle = np.zeros((3, 3)) + np.array([[0.0, 1.0, 2.0], [0.0, 2.0, 1.9], [2.0 * np.pi, 2.0, 1.0]])
    s = three_balls(ball_radius=0.011)
    run = jv.simulate(s, 0.2, separation=1.0, estimate=False, samples=3)
    assert run.status_name == "done" and "passed through" not in run.summary()
    crossed = eqx.tree_at(lambda r: r.trajectory.state.angle[0], run, jnp.asarray(angle))
    np.testing.assert_allclose(smallest_distance(s, crossed.trajectory), 0.2 * np.sin(0.05) / 0.022, rtol=1e-9)
    assert "loads passed through each other on the way" in crossed.summary() and "load_contact" in crossed.summary()
    touching = s.replace(effects=(*s.all_effects, jv.LoadContact(1e5)))
    assert not has_overlap(touching, crossed.trajectory) and not has_overlap(three_balls(), crossed.trajectory)


def test_summary_warns_of_derivatives_after_collisions():
    s = three_balls(ball_radius=0.011)
    touching = s.replace(effects=(*s.all_effects, jv.LoadContact(1e5)))
    apart = dataclasses.replace(jv.simulate(s, 0.2, separation=1.0, estimate=False, samples=3), scene=touching)
    together = eqx.tree_at(lambda r: r.trajectory.state.angle[0], apart, jnp.asarray(np.tile([0.0, 0.2, 1.0], (3, 1))))
    words = "derivatives of this run may be meaningless; test them by growth or check_gradients"
    assert words in together.summary() and words not in apart.summary()
    assert words not in dataclasses.replace(together, scene=s).summary()
    assert words not in dataclasses.replace(together, drift=jnp.zeros(())).summary()


def at_speed(s):
    return s.replace(drive=jv.ConstantSpeed(s.drive.speed))


def two_planes(stations=(0.15, 0.15, -0.15, -0.15)):
    """A balancer with two balls in each of two planes, above its critical speeds."""
    machine = jv.rotor(
        mass=9.5,
        transverse_inertia=0.5,
        polar_inertia=0.15,
        stiffness=(9e3, 9e3),
        damping=(40.0, 40.0),
        position=(0.2, -0.2),
        stations=stations,
    )
    loads = jv.balls(count=4, mass=0.1, radius=0.26, drag=1.0)
    return jv.Scene(machine, loads, jv.ConstantSpeed(120.0), (jv.StaticImbalance(moment=0.02),))


def test_coincident_loads_are_found_at_each_station():
    s = two_planes()
    run = jv.simulate(s, 1.0, start=turning(s, [0.0, 0.0, 2.0, 2.0]), save="window", estimate=False)
    assert bool(run.coincident) and would_separate(s, run.window)
    assert sorted(nearly_coincident_pairs(s, 0, np.asarray(run.window.state.angle[0]))) == [(0, 1), (2, 3)]
    other = jv.simulate(s, 1.0, start=turning(s, [0.0, 2.0, 0.0, 2.0]), save="window", estimate=False)
    assert not bool(other.coincident) and not would_separate(s, other.window)


def turning(s, angles):
    zero = jnp.zeros(s.machine.structure().mass.shape[0])
    return jv.State(zero, zero, (jnp.asarray(angles),), (jnp.full(len(angles), s.drive.speed),))


@pytest.mark.parametrize(
    ("angle", "pairs"),
    [
        ([0.0, 0.1, -0.05], [(0, 1)]),
        ([0.0, 2.0 * np.pi + 0.1, -0.05], [(0, 1)]),
        ([0.0, 2.0 * np.pi + 1e-4, 1.0], [(0, 1)]),
        ([1.0, -1e-4, 2.0 * np.pi], [(1, 2)]),
        ([0.0, 0.01, 1.0], []),
    ],
)
def test_groups_of_loads_are_found_modulo_turns(angle, pairs):
    assert nearly_coincident_pairs(three_balls(), 0, np.asarray([angle, angle])) == pairs


def test_some_of_the_loads_at_one_angle_would_separate():
    """Three of five equal loads as a point, which the two others cannot balance."""
    machine = jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0)
    s = jv.Scene(machine, jv.balls(count=5, mass=0.04, radius=0.1, drag=2.0), jv.ConstantSpeed(300.0))
    run = jv.simulate(s, 3.0, start=turning(s, [0.0, 0.0, 0.0, 3.0, 3.3]), save="window", estimate=False)
    assert run.status_name == "would_separate" and not bool(run.coincident)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (dict(), np.deg2rad([-1.0, 0.0, 1.0])),
        (dict(separation="3 deg"), np.deg2rad([-3.0, 0.0, 3.0])),
        (dict(separation=0.0), [0.0, 0.0, 0.0]),
        (dict(angles=0.5 - np.pi / 2), 0.5 + np.deg2rad([-1.0, 0.0, 1.0])),
        (dict(angles=[0.0, 0.0, 0.0]), [np.pi / 2] * 3),
    ],
)
def test_loads_start_one_degree_apart_at_rest(given, expected):
    for start in ("rest", "spin_up"):
        np.testing.assert_allclose(jv.initial_state(scene(), start, **given).azimuth + np.pi / 2, expected, atol=1e-12)


@pytest.mark.parametrize(("given", "says"), [({}, True), ({"separation": "60 deg"}, False), ({"save": "window"}, False)])
def test_summaries_state_that_loads_begin_side_by_side(given, says):
    run = jv.simulate(three_balls(ball_radius=0.011), 2.0, estimate=False, **given)
    assert ("; the loads began side by side, another separation changes these values" in run.summary()) == says


def test_loads_of_known_size_start_side_by_side():
    angle = np.asarray(jv.initial_state(three_balls(ball_radius=0.011)).azimuth)
    np.testing.assert_allclose(np.diff(angle), 2.0 * np.arcsin(0.11), rtol=1e-12)
    np.testing.assert_allclose(np.mean(angle), -np.pi / 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("separation", "degrees"), [("90 deg", 90.0), ("1 deg", 2.0 * np.rad2deg(np.arcsin(0.11))), (0.0, None)]
)
def test_touching_loads_start_at_the_given_angle(separation, degrees):
    s = three_balls(ball_radius=0.011)
    s = jv.Scene(s.machine, s.loads, s.drive, (*s.effects, jv.LoadContact(1e6)))
    angle = np.asarray(jv.initial_state(s, separation=separation).azimuth)
    np.testing.assert_allclose(np.rad2deg(np.diff(angle)), degrees or 2.0 * np.rad2deg(np.arcsin(0.11)), rtol=1e-12)


def test_no_two_of_many_loads_start_at_one_angle():
    loads = jv.balls(count=720, mass=0.001, radius=0.1, drag=0.1)
    s = jv.Scene(jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0), loads, jv.ConstantSpeed(60.0))
    turned = np.sort(np.mod(np.asarray(jv.initial_state(s).azimuth), 2.0 * np.pi))
    assert np.min(np.diff(turned)) > 1e-3


def test_a_jam_starts_at_one_angle():
    assert np.ptp(jv.initial_state(two_balls(0.5, 60.0), "jam", mode=1).azimuth) == 0.0


@pytest.mark.parametrize(("drag", "speed", "mode", "separates"), [(5.0, 100.0, 3, True), (0.5, 60.0, 1, False)])
def test_separation_grows_by_the_exact_multipliers(drag, speed, mode, separates):
    s = two_balls(drag, speed)
    orbit = jv.jam_orbit(s, mode=mode)
    rates = np.log(np.abs(np.asarray(orbit.multipliers))) * float(orbit.omega) / (2.0 * np.pi)
    run = jv.simulate(s, 20.0, start="jam", mode=mode, save="window", estimate=False)
    assert bool(run.coincident) and float(run.drift) < 1e-3 and bool(orbit.stable) != separates
    assert run.status_name == ("would_separate" if separates else "done") and bool(run.settled) != separates
    np.testing.assert_allclose(
        separation_rate(s, run.window), np.max(rates) if separates else -0.5 / (2 * 1.4 * 0.5), rtol=1e-3
    )


def test_unequal_loads_are_judged_by_the_whole_state():
    """Loads of unequal mass obey the same equation; rounding errors separate them only after some seconds."""
    s, mass = two_balls(5.0, 100.0), jnp.asarray([0.4, 0.6])
    unequal = eqx.tree_at(lambda x: (x.loads.mass, x.loads.drag), s, (mass, 10.0 * mass))
    run = jv.simulate(unequal, 4.0, start="jam", mode=3, save="window", estimate=False)
    assert would_separate(unequal, run.window)
    equal = jv.simulate(s, 4.0, start="jam", mode=3, save="window", estimate=False)
    np.testing.assert_allclose(separation_rate(unequal, run.window), separation_rate(s, equal.window), rtol=1e-3)


def test_settle_never_calls_an_unstable_common_angle_settled():
    s = two_balls(5.0, 100.0)
    one_angle = jv.settle(s, separation=0.0)
    assert one_angle.status_name == "would_separate" and not bool(one_angle.settled)
    assert one_angle.summary().startswith("not settled: ")
    free = jv.settle(s, drift=1e-3)
    assert free.regime.label == "balanced" and float(free.foundation_force) < 0.1 * float(one_angle.foundation_force)


def test_every_start_from_rest_is_apart(monkeypatch):
    """Ensembles, run-ups and quantities of run-ups begin as `initial_state` places the loads."""
    s = scene("two_mass", "balls", speed=150.0)
    expected = np.deg2rad([1.0, 1.0])
    found = jv.ensemble(lambda speed: eqx.tree_at(lambda x: x.drive.speed, s, speed), jnp.asarray([50.0, 60.0]), 1e-6)
    np.testing.assert_allclose(np.diff(found.state.azimuth), [expected, expected], rtol=1e-6)
    np.testing.assert_allclose(np.diff(jv.run_up_map(s, 0.1).angle), [expected], rtol=1e-12)
    run = Evaluation(s).start_up(0.1, 0.05)
    np.testing.assert_allclose(np.diff(run.trajectory.state.azimuth[0]), expected, rtol=1e-12)
