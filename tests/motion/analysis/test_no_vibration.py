"""Ends of runs that have no vibration at the speed of the exciters."""

import json
import re

import jax
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.app import run as run_command
from jaxvib.machine.files import SCREENS, TEMPLATES
from jaxvib.motion.analysis.measure import Measured, Trajectory
from jaxvib.motion.analysis.points import measures_text, vibration_of

AT = (1.5, 0.1)


def coasting(at="2 s", bearing=0.3, *, on=()):
    screen = jv.scene_from_toml(SCREENS["linear_screen"])
    off = [each.with_parts(None, jv.SwitchedOff(each.drive, at, bearing), each.effects) for each in screen.exciters]
    exciters = [screen.exciters[k] if k in on else each for k, each in enumerate(off)]
    return jv.Scene(screen.machine, exciters=exciters, effects=screen.effects)


@pytest.fixture(scope="module")
def stopped():
    return jv.simulate(coasting(), "60 s")


def test_the_summary_states_the_times_of_peaks(stopped):
    """Start and stop have lines of their own."""
    path = stopped.trajectory
    lines = [each for each in stopped.summary().splitlines() if "largest on the way" in each]
    for line, title, part in zip(lines, ("until 2 s", "from 2 s"), (path.time <= 2.0, path.time >= 2.0), strict=True):
        tilt, force = np.abs(path.state.displacement[part, 2]), np.linalg.norm(path.foundation_force[part], axis=-1)
        assert line.startswith(f"  largest on the way {title}, zero to peak: x ")
        assert f" at {float(path.time[part][np.argmax(tilt)]):.4g} s; magnitude of the foundation force" in line
        assert line.endswith(f"N at {float(path.time[part][np.argmax(force)]):.4g} s")


def test_a_screen_that_coasts_down_has_no_measures(stopped):
    assert "turns in the measured window, fewer than 3" in stopped.no_vibration
    text = stopped.summary()
    assert f"no vibration to measure: {stopped.no_vibration}" in text and "% reach the foundation" not in text
    assert "not settled: the exciters are almost at rest" in text and "largest on the way until 2 s, zero to peak: x" in text
    with pytest.raises(jv.InputError, match="run has no vibration to measure: the exciters make"):
        stopped.vibration()


def test_a_stopped_screen_states_the_end_of_its_last_turn(stopped):
    text = stopped.summary()
    fastest = max(float(np.max(np.abs(w))) for w in stopped.window.rotor_speeds if np.min(w) < 0.0 < np.max(w))
    assert f"; a rotor swings, at up to {30.0 / np.pi * fastest:.4g} rpm\n" in text
    ends = []
    for angle in stopped.trajectory.rotor_angles:
        ends.append(stopped.trajectory.time[np.flatnonzero(np.abs(angle - angle[-1]) > np.pi)[-1]])
    assert f"are almost at rest, and their last full turn ended at {float(max(ends)):.4g} s (drift" in text
    assert 3.0 < max(ends) < 8.0


def test_summaries_state_that_exciters_coast_down():
    run, averaged = jv.simulate(coasting(), "5 s"), jv.envelope(coasting(), "5 s", throw=False)
    speeds = np.mean([np.abs(each) for each in run.window.rotor_speeds], axis=0)
    first, second = (30.0 / np.pi * float(np.mean(half)) for half in np.split(speeds, 2))
    said = (
        f"coasting down, mean speed {first:.4g} rpm in the first and {second:.4g} rpm in the second half of the window (drift"
    )
    assert second < 0.6 * first and f"not settled: {said}" in run.summary()
    assert "not settled: coasting down, mean speed 5" in averaged.summary()
    assert "coasting" not in jv.simulate(coasting(at="6 s"), "5 s").summary()
    assert "not settled: exciter 1 coasts down, mean speed" in jv.simulate(coasting(on=[1]), "5 s").summary()


@pytest.mark.parametrize(("until", "says"), [(18.0, False), (21.0, True), (23.0, True)])
def test_loads_of_a_drive_that_stops_coast_down(until, says):
    profile = jv.SpeedProfile([0, 10, 20, 22], ["0 rpm", "600 rpm", "600 rpm", "0 rpm"])
    machine = jv.one_mass(mass=120.0, stiffness="50 N/mm", damping=40.0)
    scene = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), profile)
    text = jv.simulate(scene, until, estimate=False).summary()
    assert ("coasting down" in text) == says == ("run longer" not in text)


def test_a_balanced_rotor_has_its_time_and_no_amplitude():
    """The balls reach their places long before the vibration is zero within the tolerance of the run."""
    rotor = jv.Scene(
        jv.planar_rotor(mass=10.0, stiffness=4e4, damping="20 %"),
        jv.balls(count=2, mass=0.1, radius=0.1, drag=2.0),
        jv.ConstantSpeed("200 rad/s"),
        (jv.StaticImbalance(0.01),),
    )
    run = jv.simulate(rotor, 20.0)
    assert run.regime.label == "balanced" and run.no_vibration == "the amplitude is zero within the error of the run"
    text, path = run.summary(), run.trajectory
    assert "no vibration to measure: the amplitude is zero" in text and "amplitude, zero to peak" not in text
    assert "estimated error of the angles in the window" in text
    moments = 0.01 * np.sum(np.exp(1j * (path.state.azimuth - path.rotor_angle[:, None])), axis=1) + 0.01
    after = path.time[np.flatnonzero(np.abs(moments) >= 0.02 * 0.02)[-1] + 1]
    left = "0.4 g m, 2 % of that of all loads (the rotor alone has 0.01 kg m)"  # loads: 0.02 kg m
    assert f"  balanced from {float(after):.4g} s on: the remaining unbalance is below {left}" in text and 0.1 < after < 15.0


def test_a_balanced_motion_that_decays_needs_no_longer_run():
    scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    run = jv.simulate(scene, 30.0, estimate=False)
    first = run.summary().splitlines()[0]
    unbalance = abs(np.mean(np.exp(1j * np.asarray(run.window.state.azimuth)), axis=1))
    assert not run.settled and "not settled" not in first and "run longer" not in first
    left = f"{100.0 * float(run.regime.unbalance):.3g} % of that of all loads"
    assert "balanced: the remaining unbalance is " in first and f" m, {left}; the remaining vibration decays (drift" in first
    assert np.max(unbalance) < 1e-3
    assert "run longer" in jv.simulate(scene, 2.0, estimate=False).summary()


def test_an_averaged_balanced_motion_needs_no_longer_run():
    """The averaged run states the motion that the full equations have, and a jam has another text."""
    scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    run = jv.envelope(scene, 30.0)
    first, loads = run.summary().splitlines()[0], np.exp(1j * np.asarray(run.window.phase))
    share = np.max(np.abs(np.mean(loads, axis=1)))
    assert not run.settled and "not settled" not in first and share < 1e-3
    left = re.search(r"balanced: .* m, (\S+) % of that of all loads; the remaining vibration decays \(drift", first)
    assert float(left.group(1)) <= 100.0 * share
    assert "not settled: run longer (drift" in jv.envelope(scene, 2.0).summary()
    jammed = jv.Scene(scene.machine, jv.balls(count=1, mass=0.8, radius=0.12, drag=0.5), scene.drive)
    assert "not settled: run longer (drift" in jv.envelope(jammed, 8.0).summary()


def test_a_rotor_that_slows_down_has_no_measures():
    slowing = jv.simulate(coasting(), "8 s")
    assert "of the amplitude is at the mean speed of the exciters" in slowing.no_vibration
    with pytest.raises(jv.InputError, match="their speeds change or differ, the motion is a free vibration, or"):
        slowing.vibration()


def test_a_free_vibration_has_no_measures():
    machine = jv.one_mass(mass=200.0, stiffness=8e5, damping=60.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(300.0), unbalance=0.2)])
    early, late = jv.simulate(scene, "1 s"), jv.simulate(scene, "60 s")
    assert "free vibration" in early.no_vibration and late.no_vibration == ""
    forced = 0.2 * 300.0**2 / abs(8e5 - 200.0 * 300.0**2 + 60.0 * 300.0j)  # closed form
    assert forced < 0.5 * float(early.amplitude[0])
    np.testing.assert_allclose(abs(late.harmonic().amplitude), forced, rtol=1e-3)
    vibration = late.vibration()
    mixed = vibration._replace(amplitude=abs(vibration.displacement) / 0.8)
    assert "only" not in late.summary()
    assert measures_text(scene, "", lambda: mixed, None)[0].startswith("only 80 % of the amplitude is at the mean speed")


def test_the_force_of_loads_on_an_unbalanced_rotor_is_unknown():
    exciter = jv.Exciter(jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0), unbalance=0.2)
    scene, time = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), exciters=[exciter]), np.linspace(0.0, 1.0, 64)
    angle = 100.0 * time[:, None]
    state = jv.State(1e-3 * np.cos(angle), -0.1 * np.sin(angle), (angle,), (0.0 * angle + 100.0,))
    window = Trajectory(time, state, 40.0 * np.cos(angle), (angle[:, 0],), (angle[:, 0] * 0.0 + 100.0,))
    speed, amplitude, zero = np.asarray(100.0), np.asarray([1e-3]), np.asarray(0.0)
    with jax.disable_jit():
        found = vibration_of(scene, window, Measured(speed, speed[None], amplitude, zero, zero))
    np.testing.assert_allclose(abs(found.displacement), amplitude, rtol=1e-6)
    assert np.isnan(found.exciter_force)  # that of the loads alone is 10 times smaller


def test_sweeps_have_no_stroke_of_a_free_vibration(tmp_path):
    machine = jv.one_mass(mass=200.0, stiffness=8e5, damping=60.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(300.0), unbalance=0.2)])
    measures = ["run.stroke", "run.shaft_torque"]
    found = jv.sweep(scene, {"machine.damping[0]": [60.0, 8000.0]}, measures, tmp_path / "free.zarr", until=4.0).data
    forced = 0.4 * 300.0**2 / abs(8e5 - 200.0 * 300.0**2 + 8000.0 * 300.0j)  # closed form, peak to peak
    np.testing.assert_allclose(found["stroke"][:, 0], [np.nan, forced], rtol=1e-3)
    assert np.all(np.isfinite(found["shaft_torque"]))


def test_an_averaged_stop_has_no_measures():
    profile = jv.SpeedProfile([0, 10, 20, 22], ["0 rpm", "600 rpm", "600 rpm", "0 rpm"])
    machine = jv.one_mass(mass=120.0, stiffness="50 N/mm", damping=40.0)
    scene = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), profile)
    averaged = jv.envelope(scene, "60 s")
    assert averaged.no_vibration and averaged.no_vibration in averaged.summary()
    with pytest.raises(jv.InputError, match="run has no vibration"):
        averaged.vibration()


def test_peaks_of_a_deck_are_those_of_its_rigid_motion(stopped):
    x, y, turn = np.asarray(stopped.trajectory.state.displacement).T
    stored = np.max(np.hypot(x - AT[1] * turn, y + AT[0] * turn))
    assert 1.0 <= stopped.point(AT, part="all").largest_displacement / stored < 1.001  # larger between two stored states


def test_a_deck_without_vibration_has_a_note_and_its_peak(stopped, tmp_path, monkeypatch, capsys):
    path = tmp_path / "screen.toml"
    path.write_text(SCREENS["linear_screen"], encoding="utf-8")
    monkeypatch.setattr("jaxvib.simulate", lambda *a, **b: stopped)
    assert run_command(["simulate", str(path), "--until", "60s", "--deck", "1.5,0.1"]) == 0
    text, err = capsys.readouterr()
    peak = 1e3 * float(stopped.point(AT, part="all").largest_displacement)
    x, y, turn = np.asarray(stopped.trajectory.state.displacement).T
    time = float(stopped.trajectory.time[np.argmax(np.hypot(x - AT[1] * turn, y + AT[0] * turn))])
    assert f"largest on the way until 2 s, zero to peak: point (1.5, 0.1) m {peak:.4g} mm at {time:.4g} s\n" in text
    assert "note: --deck: no stroke, throw and conveying" in err
    given = ["--slope", "-5 deg", "--layer", "1 m,50 mm,1600"]
    assert run_command(["simulate", str(path), "--until", "60s", *given]) == 0
    assert "note: --slope, --layer: no stroke" in capsys.readouterr()[1]
    assert run_command(["simulate", str(path), "--until", "60s", "--deck", "1.5,0.1", "--json"]) == 0
    document = json.loads(capsys.readouterr()[0])
    assert document["no_vibration"] == stopped.no_vibration and "measures" not in document
    np.testing.assert_allclose(document["deck"][0]["largest_displacement"], peak / 1e3, rtol=1e-12)
    np.testing.assert_allclose(document["deck"][0]["largest_displacement_time"], time, rtol=1e-12)
    force = np.linalg.norm(stopped.trajectory.foundation_force, axis=-1)
    np.testing.assert_allclose(document["largest_force_time"], stopped.trajectory.time[np.argmax(force)])
    np.testing.assert_allclose(document["largest_displacement_time"][2], stopped.trajectory.time[np.argmax(abs(turn))])
    assert [each["part"] for each in document["parts"]] == ["until 2 s", "from 2 s"]
    late = stopped.trajectory.time[np.argmax(force * (stopped.trajectory.time >= 2.0))]
    np.testing.assert_allclose(
        [each["largest_force_time"] for each in document["parts"]], [document["largest_force_time"], late]
    )
