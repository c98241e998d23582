"""Resonances at which loads or motors stay before they pass them."""

import json

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.app import run as run_command
from jaxvib.motion.analysis.stays import find_stays

TIME = np.linspace(0.0, 20.0, 8001)
QUICK = dict(estimate=False, stepsize_controller=jv.Tolerance(1e-6))


def balls(drag, count=2):
    """Resonance at 28.0 rad/s, 267 rpm."""
    loads = jv.balls(count=count, mass=0.5, radius=0.1, drag=drag)
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), loads, jv.ConstantSpeed("60 rad/s"))


def screen(stall_torque):
    """Resonances at 14.1 rad/s, 135 rpm."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    return jv.Scene(body, exciters=[jv.Exciter(drive=jv.DCMotor(100.0, stall_torque, inertia=0.5), unbalance=0.4)])


def found(*speeds):
    rotor = np.full_like(TIME, 60.0)
    return find_stays(balls(1.0, len(speeds)), TIME, np.stack(speeds, axis=1), [rotor])


def held(start, end):
    """Speed that rises to 27 rad/s, stays there with a ripple from `start` to `end`, and rises to 60 rad/s."""
    points = [0.0, start, end, end + start, 20.0]
    return np.interp(TIME, points, [0.0, 27.0, 27.0, 60.0, 60.0]) + 4.0 * np.sin(54.0 * TIME)


def test_a_stay_is_found_at_its_times_and_speed():
    (stay,) = found(held(3.0, 9.0))
    np.testing.assert_allclose(
        [stay.start, stay.end, stay.speed, stay.resonance_speed], [3.0, 9.0, 27.0, 28.0], rtol=0.02, atol=0.2
    )
    assert (stay.masses, stay.resonance, stay.mode) == ("the load", 1, 1)


@pytest.mark.parametrize(
    "speed",
    [
        pytest.param(np.minimum(4.0 * TIME, 60.0), id="even"),
        pytest.param(60.0 * -np.expm1(-TIME / 3.0), id="exponential"),
        pytest.param(60.0 * -np.expm1(-TIME / 15.0), id="slow"),
        pytest.param(np.minimum(9.0 * TIME, 27.0), id="still jammed"),
        pytest.param(np.minimum(9.0 * TIME, 27.0) + 3.0 * np.sin(4.8 * TIME) * (TIME > 3.0), id="still jammed, swings"),
        pytest.param(60.0 * np.exp(-TIME / 5.0), id="coasting"),
        pytest.param(held(3.0, 4.5), id="short"),
    ],
)
def test_a_smooth_rise_or_a_motion_that_remains_is_no_stay(speed):
    assert found(speed) == []


def test_a_load_that_turns_with_its_rotor_does_not_stay():
    speed = held(3.0, 9.0)
    assert find_stays(balls(1.0, 1), TIME, speed[:, None], [speed]) == []


def test_loads_that_stay_at_one_time_are_one_stay():
    stays = found(held(3.0, 9.0), held(3.2, 9.1), np.minimum(20.0 * TIME, 60.0))
    assert [stay.masses for stay in stays] == ["loads 1, 2"]
    assert [stay.masses for stay in found(held(3.0, 9.0), held(3.2, 9.1))] == ["the loads"]


@pytest.mark.parametrize(("drag", "stays"), [(2.0, True), (6.0, False)])
def test_balls_of_small_drag_stay_in_a_jam_and_pass(drag, stays):
    run = jv.simulate(balls(drag), 40.0, start="spin_up", **QUICK)
    text = run.summary()
    assert run.regime.label == "balanced" and ("then passed" in text) == stays == bool(run.stays)
    if stays:
        (stay,) = run.stays
        assert "the loads stayed near 263.7 rpm from" in text and "(mode 1, resonance 1 at 267.4 rpm)" in text
        # While they stay, the balls fall behind the rotor by many turns.
        part = (np.asarray(run.trajectory.time) > stay.start) & (np.asarray(run.trajectory.time) < stay.end)
        angles = [np.asarray(x)[part] for x in (run.trajectory.rotor_angle, run.trajectory.state.azimuth[:, 0])]
        turns = [np.ptp(angle) / (2.0 * np.pi) for angle in angles]
        assert turns[1] > 10.0 and turns[0] > turns[1] + 10.0


@pytest.mark.parametrize(("torque", "stays"), [(0.9, 1), (2.0, 0)])
def test_a_weak_motor_stays_at_a_resonance_and_passes(torque, stays):
    full, averaged = jv.simulate(screen(torque), 60.0, **QUICK), jv.run_up(screen(torque), 60.0)
    assert averaged.status_name == "passed" and len(full.stays) == len(averaged.run.stays) == stays
    for stay, other in zip(full.stays, averaged.run.stays, strict=True):
        np.testing.assert_allclose([stay.speed, stay.start, stay.end], [other.speed, other.start, other.end], rtol=0.02)
        assert (stay.masses, stay.resonance, stay.mode) == ("the rotor", 1, 0)
        assert stay.summary() in full.summary() and other.summary() in averaged.summary()


def test_the_command_prints_stays(tmp_path, capsys):
    path = tmp_path / "machine.toml"
    jv.save_scene(balls(2.0), path)
    words = ["simulate", str(path), "--until", "40s", "--start", "spin_up", "--step-tolerance", "1e-6"]
    assert run_command(words) == 0
    assert "  the loads stayed near 263.7 rpm from" in capsys.readouterr().out
    assert run_command([*words, "--json"]) == 0
    (stay,) = json.loads(capsys.readouterr().out)["stays"]
    assert stay["masses"] == "the loads" and stay["mode"] == 1 and 4.0 < stay["end"] - stay["start"] < 6.0
    assert run_command([*words, "--window", "--json"]) == 0
    assert "stays" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("swing", [0.05, 0.10])
def test_a_stay_whose_speed_swings_is_found(swing):
    """Motors that a resonance holds together: their speeds swing at a rate below the lowest resonance."""
    is_held = (TIME > 3.0) & (TIME < 9.0)
    (stay,) = found(held(3.0, 9.0) + 27.0 * swing * np.sin(5.0 * (TIME - 3.0)) * is_held)
    np.testing.assert_allclose([stay.start, stay.end, stay.speed], [3.0, 9.0, 27.0], rtol=0.05, atol=0.8)
