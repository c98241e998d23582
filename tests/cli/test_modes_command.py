"""The command `modes`."""

import html
import json
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scenes import scene

import jaxvib as jv
from jaxvib.cli.document import drag_notes
from jaxvib.cli.modes import _drag_lines, _fold_lines, _imbalance_lines
from jaxvib.machine.files import TEMPLATES
from jaxvib.steady.jams.phase_search import PhaseJams


def test_modes_json_has_the_promised_keys(typed):
    code, out, err = typed("modes", "machine.toml", "--json")
    document = json.loads(out)
    assert code == 0 and err.startswith("note: the acceleration is 10.1 g")
    tables = {"modes", "measures", "folds", "drag_limits"}
    assert set(document) == {"rotor_speed", "resonances", "judged", "balanced_motion_stable", "unresolved", *tables}
    assert set(document["drag_limits"][0]) == {"resonances", "drag", "factor", "omega"}
    keys = {"mode", "omega", "stable", "growth_of_free_loads", "status", "amplitude", "foundation_force"}
    assert set(document["modes"][0]) == keys
    assert document["judged"] == "for light loads, each of which is free to move separately"
    assert {m["mode"]: m["stable"] for m in document["modes"]} == {3: True, 4: False, 5: False}  # 5 is stable by slope only
    assert set(document["folds"][0]) == {"omega", "rotor_speed"}
    modes = jv.jam_modes(scene("two_mass", speed=150.0))
    assert [m["mode"] for m in document["modes"]] == modes.mode_numbers()
    for m in document["modes"]:
        np.testing.assert_allclose(m["amplitude"], modes.select(m["mode"]).amplitude, rtol=1e-12)


def test_modes_with_friction_are_stable_under_a_condition(typed, tmp_path):
    balls = jv.balls(count=3, mass=0.8, ball_radius=0.01, radius=0.12, drag=1.5)
    s = scene("two_mass", speed=150.0).replace(loads=balls, effects=(jv.RollingFriction(1e-6),))
    jv.save_scene(s, tmp_path / "friction.toml")
    out = typed("modes", "friction.toml")[1]
    assert "several motions are stable: mode 3 (if its loads stay together), mode 5 (if its loads stay together)" in out
    modes = jv.jam_modes(s)
    assert "yes, if they stay together" in modes.summary(s) and "several modes are stable" not in modes.summary(s)


def test_modes_writes_table_and_figure(typed, tmp_path):
    code, out, _ = typed("modes", "machine.toml", "--out", "figures")
    assert code == 0 and "mode" in out and "stable" in out and "wrote" in out
    assert " yes " in out and " no " in out and "no: the loads spread" in out and max(map(len, out.splitlines())) <= 110
    assert "several motions are stable: mode 3, balanced loads\n" in out and "machine.toml --until 100s --start spin_up" in out
    assert (tmp_path / "figures" / "branches.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "figures" / "modes.json").read_text())["rotor_speed"] == 150.0


def test_modes_say_why_balanced_loads_are_not_judged(typed, tmp_path):
    plain = scene("two_mass", speed=150.0)
    jv.save_scene(plain.replace(effects=(jv.Gravity(),)), tmp_path / "heavy.toml")
    why = "effects.gravity disturbs the balanced motion; leave it out, or simulate (--without gravity)"
    out = typed("modes", "heavy.toml")[1]
    assert f"balanced loads are not judged, and may be stable as well:\n  {why}\n" in out
    document = json.loads(typed("modes", "heavy.toml", "--json")[1])
    assert document["balanced_motion_stable"] is None and document["balanced_motion_not_judged"] == why
    assert "not judged" not in typed("modes", "heavy.toml", "--without", "gravity")[1]


def test_drag_limits_of_balls_at_any_phases_are_those_of_points():
    """Touching balls have the unbalance of a chain."""
    balls = jv.balls(count=3, mass=0.8, ball_radius=0.03, radius=0.12, drag=1.5)
    table = jv.Scene(jv.one_mass(mass=120.0, stiffness=5e4, damping=300.0), balls, jv.ConstantSpeed(60.0))
    touching, points = jv.drag_limits(table), jv.drag_limits(equal_points(table))
    chain = (1.0 + 2.0 * np.cos(2.0 * np.arcsin(0.03 / 0.12))) / 3.0
    np.testing.assert_allclose(touching.factor / points.factor, chain**2, rtol=1e-2)
    said = "loads count as points: touching balls jam only up to a smaller drag"
    assert _drag_lines(table, points, points=True)[-1] == said and said not in _drag_lines(table, touching)


def test_folds_far_above_the_rotor_speed_are_only_counted():
    folds = jv.jam_modes(scene("two_mass", speed=150.0)).folds
    speeds = np.sort(np.asarray(folds.rotor_speed)[np.asarray(folds.exists)])
    shown = np.flatnonzero(np.asarray(folds.exists)).tolist()
    far = _fold_lines(float(speeds[-1]) / 10.1, folds, shown)
    assert f"{float(speeds[0]) * 30.0 / np.pi:.5g}" in far[0] and f"{float(speeds[-1]) * 30.0 / np.pi:.5g}" not in far[0]
    assert far[1:] == ["folds above 10 times the rotor speed, not shown: 1"] and len(_fold_lines(150.0, folds, shown)) == 1


def test_a_drag_for_another_load_speed_has_a_note():
    tables = {"loads": {"drag": {"cause": "bearing", "load_speed": "600 rpm"}}}
    (note,) = drag_notes(tables, [10.0, 30.0])
    assert note.startswith(
        "loads.drag is for 600 rpm, and the nearest stable jam is at 286.48 rpm: repeat with load_speed = '286"
    )
    assert drag_notes(tables, [62.0, 30.0]) == drag_notes(tables, []) == []
    assert drag_notes({"loads": {"drag": 1.0}}, [30.0]) == []
    (of_roller,) = drag_notes({"loads": {"kind": "roller", "drag": {"cause": "oil"}}}, [])
    assert of_roller == "loads.drag is that of a sphere in oil; that of a roller depends on its length: measure it"
    (of_exciter,) = drag_notes({"exciters": [{"unbalance": 0.1}, tables]}, [10.0, 30.0])
    assert of_exciter == f"exciters[1].{note}"


WEAK_DRAG = """
machine = { kind = "one_mass", mass = 300.0, stiffness = 6e4, damping = 600.0 }
effects = { gravity = true }

[[exciters]]
drive = { kind = "constant_speed", speed = "1400 rpm" }
[exciters.loads]
kind = "pendulum"
count = 3
mass = 1.2
radius = 0.06
drag = { cause = "bearing", load_speed = "600 rpm", rotor_speed = "1400 rpm", mass = 1.2, friction = 0.005, diameter = "20 mm" }
"""


def test_notes_on_loads_are_in_reports(typed, tmp_path):
    (tmp_path / "weak.toml").write_text(WEAK_DRAG)
    code, _, err = typed("modes", "weak.toml", "--report", "r.html")
    report, notes = html.unescape((tmp_path / "r.html").read_text()), err.splitlines()
    assert code == 0 and len(notes) == 3 and notes[0].startswith("note: loads at rest swing and do not turn over:")
    assert "which averaging omits" in notes[1] and "exciters[0].loads.drag is for 600 rpm" in notes[2]
    assert all(report.count(each.removeprefix("note: ")) == 1 for each in notes)


def test_exact_jams_have_notes_on_loads_but_not_on_averaging(typed, tmp_path, monkeypatch):
    """The computation ends after the notes."""
    (tmp_path / "weak.toml").write_text(WEAK_DRAG)
    monkeypatch.setattr("jaxvib.steady.orbits.search.exact_mode_speeds", lambda *_: {})
    monkeypatch.setattr("jaxvib.jam_orbit", lambda *_, **__: SimpleNamespace(rotor_speed=146.6, omega=13.45, stable=True))
    monkeypatch.setattr("jaxvib.cli.modes.measures_of", lambda *_: None)

    def end(scene):
        raise jv.InputError("scene", "has notes")

    monkeypatch.setattr("jaxvib.cli.modes._balance_document", end)
    code, _, err = typed("modes", "weak.toml", "--exact")
    notes = err.splitlines()
    assert code == 2 and len(notes) == 3 and notes[0].startswith("note: loads at rest swing and do not turn over:")
    assert "exciters[0].loads.drag is for 600 rpm" in notes[1] and "has notes" in notes[2]


def equal_points(table):
    loads = table.loads
    points = jv.balls(count=loads.count, mass=loads.mass, radius=loads.radius, drag=loads.drag)
    return jv.Scene(table.machine, points, table.drive)


def test_modes_limit_the_drag_of_touching_balls(typed, tmp_path):
    (tmp_path / "rotor.toml").write_text(TEMPLATES["ball_balancer"])
    expected = jv.drag_limits(jv.load_scene(tmp_path / "rotor.toml"))
    document = json.loads(typed("modes", "rotor.toml", "--json")[1])
    np.testing.assert_allclose(document["drag_limits"][0]["drag"], expected.drag[0], rtol=1e-9)
    printed = typed("modes", "rotor.toml")[1]
    assert "loads count as points: touching" not in printed
    assert "greatest drag of touching balls; in the jams they count as points" in " ".join(printed.split())


def test_modes_say_that_touching_balls_lie_side_by_side(typed, tmp_path):
    balls = jv.balls(count=2, mass=0.8, ball_radius=0.03, radius=0.12, drag=0.5)
    table = jv.Scene(jv.one_mass(mass=120.0, stiffness=5e4, damping=100.0), balls, jv.ConstantSpeed(60.0))
    said = "balls lie side by side; their stability is that of points at one angle (phase_jams: points at any phases)"
    for machine, is_said in ((table, True), (equal_points(table), False)):
        jv.save_scene(machine, tmp_path / "table.toml")
        assert (said in typed("modes", "table.toml")[1]) == is_said


def test_modes_name_a_resonance_without_a_peak(typed, tmp_path):
    plain = scene("two_mass", speed=150.0)
    damped = eqx.tree_at(lambda s: s.machine.damping, plain, 30.0 * plain.machine.damping)
    jv.save_scene(damped, tmp_path / "damped.toml")
    said = "modes 1, 2 exist at no rotor speed: resonance 1 has no peak of its own"
    assert said in typed("modes", "damped.toml")[1] and said in jv.jam_modes(damped).summary()
    assert json.loads(typed("modes", "damped.toml", "--json")[1])["unresolved"] == [1, 2]
    assert "at no rotor speed" not in typed("modes", "machine.toml")[1] + jv.jam_modes(plain).summary()


def test_modes_of_a_rotor_are_its_jams_at_any_phases(typed, tmp_path, monkeypatch):
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    rotor = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    jv.save_scene(rotor, tmp_path / "rotor.toml")
    code, out, err = typed("modes", "rotor.toml", "--out", "o", "--json")
    document = json.loads(out)
    keys = {"rotor_speed", "judged", "balanced_motion_stable", "phase_jams", "drag_limits"}
    assert code == 0 and err == "" and set(document) == keys
    np.testing.assert_allclose([jam["omega"] for jam in document["phase_jams"]], [412.8, 199.4, 164.6], atol=0.05)
    assert [jam["pattern"] for jam in document["phase_jams"] if jam["stable"]] == ["together"]
    assert (tmp_path / "o" / "phases.png").stat().st_size > 10_000
    out = typed("modes", "rotor.toml")[1]
    assert "loads can stay jammed at 1572.1 rpm (all together)" in out
    assert "several motions are stable: the jam at 1572.1 rpm (all together), balanced loads" in out
    assert "│ 1904" in out and "images)" not in out
    monkeypatch.setattr(PhaseJams, "distinct", [np.array([0, 1]), np.array([2])])
    merged = typed("modes", "rotor.toml")[1]
    assert "│ 1904" not in merged and "│ 1572" in merged and merged.count("images)") == 1
    assert "jaxvib simulate rotor.toml --until 100s --start spin_up" in out
    assert "zero to peak, root sum square of both directions\n  (sqrt(2) times" in out
    code, _, err = typed("modes", "rotor.toml", "--tolerance", "stiffness=5%")
    assert code == 2 and "modes has no tolerances of this machine, which moves in two directions; leave it out" in err
    assert "jaxvib sweep" in err and "--exact" not in err and "--phases" not in err
    for option, other in (("--exact", "--phases"), ("--phases", "--exact")):
        err = typed("modes", "machine.toml", option, "--tolerance", "stiffness=5%")[2]
        assert f"leave out {option}, or leave out --tolerance" in err and other not in err
    (tmp_path / "stations.toml").write_text(TEMPLATES["rotor"])
    for words in (("modes", "--exact"), ("criterion",)):
        code, out, err = typed(words[0], "stations.toml", *words[1:])
        assert (code, out) == (2, "") and "machine.stations differ; this function needs loads that run at one point" in err
    one_plane = TEMPLATES["rotor"].replace("stations = [0.28, 0.25, -0.25, -0.28]", "stations = 0.1")
    (tmp_path / "one_plane.toml").write_text(one_plane)
    code, _, err = typed("modes", "one_plane.toml", "--exact")
    assert code == 2 and "machine.kind is 'rotor'; jam modes are not defined with gyroscopic coupling; use phase_jams" in err
    code, _, err = typed("whirl", "stations.toml", "--speed", "-5 rad/s")
    assert code == 2 and "--speed is -5 rad/s; it must be at least 0" in err


def test_modes_of_a_rotor_that_has_no_jams_say_so(typed, tmp_path):
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=0.0)
    rotor = jv.Scene(machine, jv.pendulums(count=1, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed("60 rpm"))
    jv.save_scene(rotor, tmp_path / "rotor.toml")
    assert typed("modes", "rotor.toml")[:2] == (0, "no jam at 60 rpm\n")
    damped = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=4.0), jv.ConstantSpeed(460.0))
    damped = eqx.tree_at(lambda s: s.machine.damping, damped, jnp.asarray([843.0]))
    jv.save_scene(damped, tmp_path / "damped.toml")
    assert "balanced loads are stable: the loads spread and balance the rotor" in typed("modes", "damped.toml")[1]


def test_exact_modes_json_has_the_promised_keys(typed):
    code, out, err = typed("modes", "machine.toml", "--exact", "--json")
    document = json.loads(out)
    assert code == 0 and err.startswith("note: the acceleration is 10 g")
    assert set(document) == {"rotor_speed", "resonances", "judged", "balanced_motion_stable", "modes", "special", "missing"}
    assert set(document["special"][0]) == {"omega", "rotor_speed", "kind"}
    assert {"fold"} <= {point["kind"] for point in document["special"]}
    jams = {each["mode"]: each for each in document["modes"]}
    measured = jv.vibration_measures(jv.load_scene("machine.toml"), jv.jam_orbit(jv.load_scene("machine.toml"), mode=3))
    np.testing.assert_allclose(jams[3]["measures"]["stroke"], measured.stroke, rtol=1e-9)
    assert {k for k, each in jams.items() if "measures" in each} == {k for k, each in jams.items() if each["stable"]}
    loads = [each["measures"]["foundation_load"][0] for each in jams.values() if "measures" in each]
    forces = [each["foundation_force"] for each in jams.values() if "measures" in each]
    np.testing.assert_allclose(loads, forces, rtol=1e-9)
    out = typed("modes", "machine.toml", "--exact", "--unit", "si")[1]
    assert " loss of symmetry " in out and " symmetry  " not in out.replace("loss of symmetry", "")
    assert "y1, m " in out and " m/s RMS" in out and " mm" not in out


def test_modes_note_that_an_imbalance_is_left_out(typed, tmp_path):
    plain = scene("two_mass", speed=150.0)
    shaken = jv.Scene(plain.machine, plain.loads, plain.drive, (jv.StaticImbalance("5 g m"),))
    jv.save_scene(shaken, tmp_path / "shaken.toml")
    said = "amplitudes and forces are those of the loads only:\n  the static imbalance adds a vibration at the rotor speed"
    assert said in typed("modes", "shaken.toml")[1]
    assert said not in typed("modes", "machine.toml")[1]
    assert said in typed("modes", "shaken.toml", "--phases")[1]
    text = TEMPLATES["rotor"].replace("# moment_imbalance", "moment_imbalance")
    assert "the static imbalance and moment imbalance add a vibration" in _imbalance_lines(jv.scene_from_toml(text))[1]
    code, _, err = typed("modes", "shaken.toml", "--exact")
    assert code == 2 and "effects.static_imbalance excites the machine at the rotor speed as well" in err
    assert typed("modes", "shaken.toml", "--exact", "--without", "static_imbalance")[0] == 0
    code, _, err = typed("modes", "shaken.toml", "--without", "stop")
    assert code == 2 and "--without is 'stop'; the scene's effects are: static_imbalance" in err


def test_modes_speed_option_replaces_the_scene_s(typed):
    _, out, _ = typed("modes", "machine.toml", "--json", "--speed", "600 rpm")
    np.testing.assert_allclose(json.loads(out)["rotor_speed"], 20 * np.pi, rtol=1e-15)
