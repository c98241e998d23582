"""Commands about motion and stability, listings of what scene files hold, curves as CSV."""

import csv
import dataclasses
import itertools
import json
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
from small_machine import small_run

import jaxvib as jv
import optimize
from jaxvib.cli import output as output_module
from jaxvib.cli.app import _MODULES, app, loaded_scene, run
from jaxvib.cli.commands import _is_long
from jaxvib.draw.motion.histories import _MIN_SAMPLES
from jaxvib.machine.files import EFFECTS, SCREENS, SECTIONS, TEMPLATES
from jaxvib.report.arguments import GROUPS, arguments_of
from jaxvib.study.accuracy.work_precision import QUANTITIES, SOLVERS
from jaxvib.sweeps.study import load_study
from optimize.files import TEMPLATES as DESIGNS

UNBALANCED = """
machine = { kind = "one_mass", mass = 200.0, stiffness = "800 N/mm", damping = 600.0 }

[[exciters]]
unbalance = "0.2 kg m"
drive = { kind = "dc_motor", speed = "1500 rpm", stall_torque = 12.0, inertia = 0.1 }
"""


def read(path):
    with path.open() as file:
        return list(csv.reader(file))


def test_a_run_as_csv_is_its_trajectory(typed, tmp_path, monkeypatch):
    kept = small_run()
    monkeypatch.setattr("jaxvib.simulate", lambda *a, **b: kept)
    code, _, err = typed("simulate", "machine.toml", "--until", "0.5s", "--csv", "run.csv", "--json")
    assert code == 0 and err == ""
    head, *rows = read(tmp_path / "run.csv")
    assert head[:3] == ["time (s)", "displacement y1 (mm)", "displacement y2 (mm)"] and "rotor speed (rpm)" in head
    numbers = np.array(rows, dtype=float)
    np.testing.assert_allclose(numbers[:, 0], kept.trajectory.time, rtol=1e-8)
    np.testing.assert_allclose(
        numbers[:, head.index("angle 2 (deg)")], np.degrees(kept.trajectory.state.angle[0][:, 1]), rtol=1e-8
    )
    code, _, err = typed("simulate", "machine.toml", "--until", "0.5s", "--csv", "run.csv", "--window")
    assert code == 2 and "--csv needs a trajectory, which --window does not save" in err
    assert typed("simulate", "machine.toml", "--until", "0.5s", "--csv", "new/run.csv")[0] == 0
    code, _, err = typed("simulate", "machine.toml", "--until", "0.5s", "--csv", "run.csv/run.csv")
    assert code == 2 and "--csv is 'run.csv', which cannot be created" in err
    with pytest.raises(jv.InputError, match=r"axis is 'point'; the axes of Run are: .*time"):
        jv.write_csv(kept, "point", tmp_path / "none.csv")


def test_long_runs_of_several_exciters_show_their_share(tmp_path):
    (tmp_path / "screen.toml").write_text(SCREENS["linear_screen"])
    screen = loaded_scene(tmp_path / "screen.toml")
    assert _is_long(screen, "10 h") and not _is_long(screen, "12 s")


def test_lines_of_progress_of_a_run_have_its_share(typed, monkeypatch):
    """A run whose meter shows 42 % waits until a line of progress has this share."""
    kept, lines = small_run(), []
    monkeypatch.setattr("jaxvib.cli.commands._MIN_ANGLE_OF_LONG_RUNS", 1.0)
    monkeypatch.setattr(output_module, "SECONDS_TO_FIRST_LINE", 0.01)
    monkeypatch.setattr(output_module.click, "echo", lambda text, **_: lines.append(text))

    def run(*_, progress_meter, **__):
        progress_meter.show(0.42)
        for _ in range(500):
            if lines and lines[-1].startswith("integrating: 42%, after"):
                break
            time.sleep(0.01)
        return kept

    monkeypatch.setattr("jaxvib.simulate", run)
    assert typed("simulate", "machine.toml", "--until", "0.5s")[0] == 0
    assert any(line.startswith("integrating: 42%, after") for line in lines)


def test_largest_displacements_need_a_trajectory(typed, monkeypatch):
    kept, documents = small_run(), []
    for saved in (kept, dataclasses.replace(kept, trajectory=None)):
        monkeypatch.setattr("jaxvib.simulate", lambda *_, saved=saved, **__: saved)
        documents.append(json.loads(typed("simulate", "machine.toml", "--until", "0.5s", "--json")[1]))
    whole, window = documents
    np.testing.assert_allclose(whole["largest_displacement"], np.max(np.abs(kept.trajectory.state.displacement), axis=0))
    assert "largest_displacement" not in window and window["amplitude"] == whole["amplitude"]


def test_an_envelope_as_csv_is_its_trajectory(typed, tmp_path):
    code, _, err = typed("envelope", "machine.toml", "--until", "1s", "--csv", "run_up.csv")
    assert code == 0, err
    head, *rows = read(tmp_path / "run_up.csv")
    kept = jv.envelope(jv.load_scene("machine.toml"), "1s", samples=len(read(tmp_path / "run_up.csv")) - 1).trajectory
    at = [head.index(name) for name in ("time (s)", "amplitude y2 (mm)", "rotor speed (rpm)")]
    numbers = np.array(rows, dtype=float)[:, at]
    np.testing.assert_allclose(
        numbers, np.stack([kept.time, 1e3 * kept.amplitude[:, 1], 30.0 / np.pi * kept.rotor_speed], axis=1), rtol=1e-8
    )


def test_branches_as_csv(typed, tmp_path):
    assert typed("modes", "machine.toml", "--csv", "branches.csv")[0] == 0
    head, *rows = read(tmp_path / "branches.csv")
    at = {name: k for k, name in enumerate(head)}
    numbers = [[float(row[at[name]]) for row in rows] for name in ("omega (rpm)", "rotor speed (rpm)")]
    branch = jv.branches(jv.load_scene("machine.toml"))
    points = [[f"{30.0 / np.pi * float(x):.9g}" for x in pair] for pair in zip(branch.omega, branch.rotor_speed, strict=True)]
    points = [point for k, point in enumerate(points) if k == 0 or point != points[k - 1]]
    np.testing.assert_allclose(np.transpose(numbers), np.array(points, dtype=float), rtol=1e-8)
    assert all(row != other for row, other in itertools.pairwise(rows))


def test_settle_shows_ranges_within_tolerances(typed, tmp_path):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    jv.save_scene(scene, tmp_path / "one.toml")
    words = ("settle", "one.toml", "--mode", "1", "--tolerance", "stiffness=5%")
    ranges = json.loads(typed(*words, "--json")[1])["tolerances"]
    expected = optimize.tolerance_ranges(scene, [optimize.jam_frequency(mode=1)], ["stiffness=5%"])[0]
    assert ranges[0] == pytest.approx(expected._asdict())
    shown = ["jam frequency", "stroke of platform 1", "force on support 1", "foundation force", "shaft torque"]
    assert [entry["words"] for entry in ranges] == [f"{name}, mode 1" for name in shown]
    assert "machines with stiffness=5%" in typed(*words)[1]
    assert "worst: the largest value (the smallest if" in typed(*words)[1]
    assert "--tolerance is 'stiffness'; write NAME=PERCENT" in typed(*words[:-1], "stiffness")[2]
    assert "material (mass on a platform)" in typed(*words[:-1], "load=0..20kg")[2]
    assert "repeat the option for each value: --tolerance ... --tolerance ..." in typed(*words, "damping=30%")[2]
    assert "repeat" not in typed("settle", "one.toml", "two.toml")[2]
    assert "--step-tolerance is -1" in typed(*words[:-2], "--step-tolerance", "-1")[2]


def test_settle_names_motors_that_are_switched_off(typed, tmp_path):
    off = jv.SwitchedOff(jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5), at="8 s", bearing=0.01)
    machine = jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0)
    jv.save_scene(jv.Scene(machine, exciters=[jv.Exciter(drive=off, unbalance=0.4)]), tmp_path / "off.toml")
    assert typed("settle", "off.toml")[1].startswith("exciter 1 is switched off at 8 s: steady motions are those after")


def test_settle_and_growth_pass_their_options(typed, tmp_path, monkeypatch):
    asked, kept = [], small_run()

    def noted(scene, *positional, **named):
        asked.append((*positional, named))
        return kept

    monkeypatch.setattr("jaxvib.settle", noted)
    words = ("settle", "machine.toml", "--mode", "3", "--step-tolerance", "1e-7", "--drift", "1e-5", "--segments", "9")
    code, out, _ = typed(*words, "--json", "--out", "o")
    assert code == 0 and json.loads(out)["omega"] == float(kept.omega) and (tmp_path / "o" / "run.npz").exists()
    (named,) = asked[0]
    assert (named["mode"], named["drift"], named["segments"], named["start"]) == (3, 1e-5, 9, None)
    assert named["stepsize_controller"] == jv.Tolerance(1e-7)
    assert "--tolerance is for jams; these loads are unsettled" in typed("settle", "machine.toml", "--tolerance", "mass=5%")[2]
    code, _, err = typed("growth", "machine.toml", "--until", "4s", "--segments", "5")
    assert code == 2 and "segments is 5; at least 8 are needed" in err
    for command in (("settle", "machine.toml"), ("growth", "machine.toml", "--until", "4s")):
        code, _, err = typed(*command, "--start", "spin_up")
        assert code == 2 and "'spin_up' is not one of 'rest', 'jam'" in err


@pytest.mark.parametrize("command", ["simulate", "settle", "envelope", "growth", "run-up-map"])
def test_loads_start_apart_as_typed_in_every_command(typed, monkeypatch, command):
    asked = []

    def noted(scene, *positional, **named):
        asked.append(named["separation"])
        raise jv.ComputationError("stopped", "no more is needed")

    monkeypatch.setattr(f"jaxvib.{command.replace('-', '_')}", noted)
    words = (command, "machine.toml", *(() if command == "settle" else ("--until", "1s")))
    assert typed(*words, "--separation", "3 deg")[0] == typed(*words)[0] == 1
    assert asked == ["3 deg", None]


def test_averaged_runs_have_enough_samples_for_bands(typed, monkeypatch):
    asked = []

    def noted(scene, *positional, **named):
        asked.append(named.get("samples", 256))
        raise jv.ComputationError("stopped", "no more is needed")

    monkeypatch.setattr("jaxvib.envelope", noted)
    assert typed("envelope", "machine.toml", "--until", "1s")[0] == 1 and asked[0] >= _MIN_SAMPLES


@pytest.mark.slow
def test_motion_commands_give_the_results_of_python(typed, tmp_path):
    loaded = jv.load_scene("machine.toml")
    mode = jv.jam_modes(loaded).mode_numbers()[0]
    code, out, _ = typed("settle", "machine.toml", "--mode", str(mode), "--json")
    document = json.loads(out)
    assert code == 0 and document["omega"] == float(jv.settle(loaded, mode=mode).omega) and document["settled"]
    code, out, _ = typed("envelope", "machine.toml", "--until", "20s", "--mode", str(mode), "--out", "o")
    assert code == 0 and "averaged: relative error" in out and (tmp_path / "o" / "envelope.npz").exists()
    assert abs(json.loads((tmp_path / "o" / "envelope.json").read_text())["omega"] / document["omega"] - 1.0) < 0.05
    code, out, _ = typed("growth", "machine.toml", "--until", "20s", "--mode", str(mode), "--json")
    assert code == 0 and json.loads(out)["status"] == "regular"
    words = ("run-up-map", "machine.toml", "--until", "0.5s", "--drag", "0.05", "--drag", "5 N s/m", "--step-tolerance", "1e-5")
    code, out, err = typed(*words, "--json")
    rows = json.loads(out)["map"]
    assert code == 0 and err == "" and [row["drag"] for row in rows] == [0.05, 5.0]
    assert all(abs(sum(row["shares"].values()) - 1.0) < 1e-12 for row in rows)


def test_numbers_that_stability_commands_vary_are_checked(typed):
    asked = ("--omega", "20 rad/s", "40 rad/s", "--points", "8")
    code, _, err = typed("stability-map", "machine.toml", "--vary", "loads.mas", "--value", "0.1", *asked)
    assert code == 2 and "--vary.loads.mas is not a parameter of this scene; did you mean 'loads.mass'?" in err
    code, _, err = typed("stability-map", "machine.toml", "--vary", "loads.mass", "--value", "2 m", *asked)
    assert code == 2 and "--value" in err and "not in kg" in err
    words = (
        "onset",
        "machine.toml",
        "--vary",
        "loads.mass",
        "--kind",
        "torus",
        "--between",
        "0.1",
        "0.2",
        "--omega",
        "40 rad/s",
        "20 rad/s",
    )
    code, _, err = typed(*words)
    assert code == 2 and "--omega is 40 to 20 rad/s; the second must be larger" in err


def test_the_map_is_that_of_the_function(monkeypatch, typed):
    """The scenes that the command makes, at the values that are named."""
    asked = []

    def noted(make, values, *, omega, points):
        asked.append(([float(make(v).loads.mass) for v in values], omega, points))
        raise jv.ComputationError("stopped", "no more is needed")

    monkeypatch.setattr("jaxvib.stability_map", noted)
    words = ("--value", "100 g", "--value", "0.2", "--omega", "120 rpm", "40 rad/s", "--points", "9")
    assert typed("stability-map", "machine.toml", "--vary", "loads.mass", *words)[0] == 1
    masses, omega, points = asked[0]
    np.testing.assert_allclose([*masses, *omega], [0.1, 0.2, 4.0 * np.pi, 40.0])
    assert points == 9


def test_drags_of_run_ups_are_checked(typed):
    code, _, err = typed("run-up-map", "machine.toml", "--until", "1s", "--drag", "5 kg")
    assert code == 2 and "--drag is '5 kg', which is not in N s/m" in err


@pytest.mark.parametrize(("group", "kind"), [(g, kind) for g, kinds in GROUPS.items() for kind in kinds])
def test_arguments_of_parts_are_listed_with_their_form_in_files(group, kind):
    """Numbers of templates with units say which unit an argument is read in; what a constructor needs has no default."""
    listed = {argument.name: argument for argument in arguments_of(GROUPS[group][kind])}
    units = {
        "mass": "kg",
        "stiffness": {"cubic_support": "N/m^3"}.get(kind, "N/m"),
        "speed": "rad/s",
        "gap": "m",
        "drag": "N s/m",
    }
    for name, unit in units.items():
        if name in listed:
            assert listed[name].unit == unit
    assert {"rotor": "N/m, N, N m"}.get(kind, "") == getattr(listed.get("stiffness_terms"), "unit", "")


def test_describe(typed):
    code, out, _ = typed("describe")
    assert code == 0 and "effects: gravity, static_imbalance" in out
    code, out, _ = typed("describe", "effects", "--json")
    listed = {part["kind"]: part for part in json.loads(out)["effects"]}
    assert code == 0 and set(listed) == set(EFFECTS)
    reaction = next(a for a in listed["dry_friction"]["arguments"] if a["name"] == "reaction")
    assert reaction["allowed"] == ["exact", "run_up", "steady"] and reaction["default"] == "exact" and not reaction["needed"]
    code, out, _ = typed("describe", "drives", "dc_motor")
    assert code == 0 and "stall_torque" in out and "N m" in out and "**Arguments**" in out
    assert typed("describe", "three-mass") == typed("describe", "three_mass")
    code, out, _ = typed("describe", "three_mass")
    assert code == 0 and "needed; at least 0\n      link stiffness (3,) of the links 1-2, 1-3, 2-3, N/m" in out
    assert max(map(len, typed("describe", "machines")[1].splitlines())) <= 80
    for word, parts in (
        ("bearing", ("name_plate_motor", "switched_off", "dry_friction")),
        ("motor", ("dc_motor", "belt_drive")),
    ):
        code, _, err = typed("describe", word)
        assert code == 2 and f"name is '{word}'; parts that mention it: " in err and all(part in err for part in parts)
    assert "'dc_moto'; did you mean 'dc_motor'? allowed: machines" in typed("describe", "dc_moto")[2]
    code, out, _ = typed("describe", "exciter")
    assert code == 0 and "unbalance: kg m; default none; greater than 0\n      unbalance S, kg m: static moment" in out
    assert typed("describe", "dc_motr")[2].startswith("jaxvib: name is 'dc_motr'; did you mean 'dc_motor'?")
    code, _, err = typed("describe", "drives", "dc_motr")
    assert code == 2 and "name is 'dc_motr'; did you mean 'dc_motor'?" in err
    assert set(SECTIONS["machine"]) == set(GROUPS["machines"])


def test_overview_has_the_summary_of_each_command():
    begun = time.process_time()
    assert run(["--help"]) == 0
    assert time.process_time() - begun < 0.3
    code = "import sys; sys.argv = ['jaxvib', '--help']; from jaxvib.cli import main\ntry: main()\n"
    code += "except SystemExit: print('jax' in sys.modules, 'numpy' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.endswith("False False\n")
    for name in _MODULES:
        command = app.get_command(None, name)
        begins = command.get_short_help_str(30).removesuffix("...").split()[:4]
        assert " ".join(begins) in " ".join(said.split())


def test_help_imports_nothing_slow_and_lists_the_choices():
    code = "import sys; from jaxvib.cli.app import _MODULES, run\n"
    code += "for name in _MODULES: assert run([name, '--help']) == 0\nprint('numpy' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.endswith("False\n")
    options = {
        (name, p.name): tuple(getattr(p.type, "choices", ())) for name in _MODULES for p in app.get_command(None, name).params
    }
    assert options["cost", "quantity"] == QUANTITIES and options["cost", "solvers"] == tuple(SOLVERS)
    machines = tuple(name.replace("_", "-") for name in (*TEMPLATES, *SCREENS))
    assert options["new", "kind"] == (*machines, *DESIGNS, "identification", "measurement", "sweep")


def test_response_of_several_exciters_lists_each_torque(typed, tmp_path):
    (tmp_path / "screen.toml").write_text(SCREENS["linear_screen"])
    document = json.loads(typed("response", "screen.toml", "--phases", "0 deg, -90 deg", "--json")[1])
    point = document["operating_points"][0]
    assert document["phases_from"] == "given" and point["stable"]
    np.testing.assert_allclose(sum(point["motor_torque"]), sum(point["torque"]), rtol=1e-8)
    out = typed("response", "screen.toml", "--phases", "0 deg, -90 deg")[1]
    assert "torques at the operating points" in out and "foundation force: zero to peak, root" in out
    code, _, err = typed("response", "screen.toml", "--phases", "0 deg")
    assert code == 2 and err.strip() == "jaxvib: --phases has 1 value; 2 are needed"


def test_regimes_list_motions_in_groups_if_not_all_synchronize(typed, tmp_path, monkeypatch):
    """Two motors of different speeds, and a motor whose partner is switched off; the search for groups is slow and tested
    elsewhere."""

    def partitions(scene):
        n = sum(not isinstance(each.drive, jv.SwitchedOff) for each in scene.exciters) - 1
        values, speeds = np.zeros((n, 2)), np.tile([100.0, 60.0], (n, 1))
        groups, stable = np.tile([0, 1], (n, 1)), np.ones(n, bool)
        found = jv.RegimeSearchStatus.done
        return jv.RegimePartitions(found, groups, speeds, values, values[:, 0] - 1.0, stable, values[:, 0] + 0.05, scene)

    monkeypatch.setattr(jv, "regime_partitions", partitions)
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    fast, slow = (jv.DCMotor(n, stall_torque=60.0, inertia=0.05) for n in (100.0, 60.0))
    for second, text, key in (
        (slow, "  1: 954.93 rpm; 2: 572.958 rpm; stable (-1 1/s), interaction 0.05\n", "speed"),
        (jv.SwitchedOff(slow, bearing=3.0), "exciter 1 alone: 952.701 rpm, stable, if", "without_switched_off"),
    ):
        pair = [jv.Exciter(drive=m, unbalance=0.4, at=(x, 0.0)) for m, x in ((fast, -0.3), (second, 0.3))]
        jv.save_scene(jv.Scene(screen, exciters=pair), tmp_path / "screen.toml")
        code, out, _ = typed("regimes", "screen.toml")
        assert code == 0 and "no regime" in out and text in out
        assert len(json.loads(typed("regimes", "screen.toml", "--json")[1])["groups"][key]) == 1
    assert "if exciter 2 (switched off) comes to rest" in out


def test_response_at_an_undamped_resonance_is_unbounded(typed, tmp_path):
    resonance = (800e3 / 200.0) ** 0.5
    drive = f'{{ kind = "constant_speed", speed = {resonance!r} }}'
    lines = [f"drive = {drive}" if line.startswith("drive") else line for line in UNBALANCED.splitlines()]
    (tmp_path / "table.toml").write_text("\n".join(lines).replace("damping = 600.0", "damping = 0.0"))
    out = typed("response", "table.toml", "--points", "100")[1]
    assert " unbounded " in out and " inf " in out


def test_tables_of_a_response_with_a_large_peak_are_in_mm(typed, tmp_path):
    (tmp_path / "table.toml").write_text(UNBALANCED.replace("damping = 600.0", "damping = 0.01"))
    out = typed("response", "table.toml", "--points", "300")[1]
    assert "y1, mm" in out and "y1, m " not in out


def test_response_lists_operating_points_peaks_and_folds(typed, tmp_path):
    (tmp_path / "table.toml").write_text(UNBALANCED)
    motor = jv.NamePlateMotor("7.5 kW", "1460 rpm", breakdown_ratio=2.8, inertia=1.3, starting_ratio=2.2)
    screen = jv.one_mass(mass="1200 kg", stiffness="600 N/mm", damping="3 %")
    jv.save_scene(jv.Scene(screen, exciters=[jv.Exciter(drive=motor, unbalance=12.0)]), tmp_path / "weak.toml")
    code, out, err = typed("response", "table.toml", "--points", "300", "--csv", "curve.csv")
    assert (code, err) == (0, "") and max(map(len, out.splitlines())) <= 80
    assert "zone" not in out and "jump to, rpm" in out
    assert ("run-up or simulate shows" in out) == (out.count("│    yes │") > 1)
    assert "run-up or simulate shows at which" in typed("response", "weak.toml", "--points", "300")[1]
    document = json.loads(typed("response", "table.toml", "--points", "300", "--json")[1])
    found = jv.response(jv.load_scene(tmp_path / "table.toml"), points=300)
    speeds = [each["speed"] for each in document["operating_points"]]
    np.testing.assert_allclose(speeds, found.operating.speed[np.asarray(found.operating.exists)], rtol=1e-12)
    head, *rows = read(tmp_path / "curve.csv")
    _, places = np.unique(found.speed, return_index=True)  # the first speed is that of two points
    torques = [float(row[head.index("torque (N m)")]) for row in rows]
    np.testing.assert_allclose(torques, found.torque[places, 0], rtol=1e-7)
    power = [each["measures"]["power"] for each in document["operating_points"] if each["stable"]]
    shown = [float(line.split()[8]) for line in out.splitlines() if line.startswith("  shaft: ")]
    np.testing.assert_allclose(np.ravel(power), shown, rtol=1e-3)
    assert typed("response", "machine.toml")[0] == 2
    chosen = ("--points", "300", "--speed", "960 rpm", "--speed", "145 rpm")
    assert "at the speeds of --speed" not in out and "at the speeds of --speed" in typed("response", "table.toml", *chosen)[1]
    document = json.loads(typed("response", "table.toml", *chosen, "--csv", "chosen.csv", "--json")[1])
    at_speeds = jv.response(jv.load_scene(tmp_path / "table.toml"), speeds=["960 rpm", "145 rpm"])
    forces = [each["foundation_force"] for each in document["speeds"]]
    np.testing.assert_allclose(forces, at_speeds.foundation_force, rtol=1e-12)
    assert [float(row[0]) for row in read(tmp_path / "chosen.csv")[1:]] == [960.0, 145.0]
    code, _, err = typed("response", "table.toml", "--deck", "1,0")
    assert code == 2 and "--deck is for bodies in a plane, not for a machine of kind 'one_mass'" in err


def test_options_change_scenes_of_several_exciters(tmp_path, capsys):
    path = tmp_path / "screen.toml"
    path.write_text(SCREENS["linear_screen"])
    scene = jv.load_scene(path)
    assert [effect.kind for effect in scene.all_effects] == ["gravity"]
    changed = loaded_scene(path, ["gravity"])
    assert changed.all_effects == () and [each.drive.kind for each in changed.exciters] == 2 * ["induction_motor"]
    slower = loaded_scene(path, speed="900 rpm")
    assert [float(each.drive.speed) for each in slower.exciters] == pytest.approx(2 * [30.0 * np.pi])
    assert [each.direction for each in slower.exciters] == [1, -1] and len(slower.effects) == 1
    ramps = [each.with_parts(None, jv.SpinUp(speed, "2 s")) for each, speed in zip(scene.exciters, (90.0, 95.0), strict=True)]
    jv.save_scene(jv.Scene(scene.machine, exciters=ramps), path)
    ends = loaded_scene(path, constant=True)
    assert [(each.drive.kind, float(each.drive.speed)) for each in ends.exciters] == [
        ("constant_speed", 90.0),
        ("constant_speed", 95.0),
    ]
    assert capsys.readouterr().err.count("the final speed of the drive (spin_up)") == 2


def test_help_of_run_up_maps_has_a_study_of_other_parameters(typed, tmp_path):
    drive = jv.DCMotor("1500 rpm", stall_torque=40.0, inertia=0.1)
    machine = jv.load_scene("machine.toml")
    jv.save_scene(jv.Scene(machine.machine, machine.loads, drive), tmp_path / "machine.toml")
    shown = typed("run-up-map", "--help")[1]
    begin, end = shown.index("scene ="), shown.index("Options:")
    (tmp_path / "study.toml").write_text(textwrap.dedent(" " * 4 + shown[begin:end]))
    assert load_study(tmp_path / "study.toml").grid.shape == (3, 8)


def test_run_up_command_gives_the_result_of_python(typed, tmp_path):
    (tmp_path / "table.toml").write_text(UNBALANCED)
    code, out, err = typed("run-up", "table.toml", "--until", "5s", "--out", "o", "--csv", "run_up.csv")
    found = jv.run_up(jv.load_scene("table.toml"), "5s")
    assert (code, err) == (0, "") and out.startswith(found.summary()) and (tmp_path / "o" / "run_up.png").exists()
    document = json.loads((tmp_path / "o" / "run_up.json").read_text())
    assert document["status"] == found.status_name and document["peak_force"] == float(found.peak_force)
    assert read(tmp_path / "run_up.csv")[0][:2] == ["time (s)", "real displacement y1 (mm)"]
    code, _, err = typed("run-up-map", "table.toml", "--until", "5s")
    assert code == 2 and "for motors with unbalances use `jaxvib run-up`" in err
    code, _, err = typed("run-up", "machine.toml", "--until", "5s")
    assert code == 2 and "for loads use run_up_map" in err


def test_a_motor_that_cannot_start_is_named(tmp_path, capsys):
    path = tmp_path / "screen.toml"
    path.write_text(SCREENS["linear_screen"].replace("breakdown_torque = 80.0", "breakdown_torque = 25.0", 1))
    loaded_scene(path)
    scene = jv.load_scene(path)
    weight = 0.7246113537767085 * 9.80665 * float(scene.exciters[0].unbalance)
    start = float(scene.exciters[0].drive.torque(0.0))
    note = f"note: the motor of exciter 1 cannot start: the weight of its unbalance needs {weight:.3g} N m"
    assert capsys.readouterr().err == f"{note}, its starting torque is {start:.3g} N m\n" and start < weight
    loaded_scene(path, ["gravity"])
    assert capsys.readouterr().err == ""


def test_steady_motions_name_motors_that_are_switched_off(typed, tmp_path):
    motor = jv.DCMotor(100.0, stall_torque=40.0, inertia=0.5)
    exciter = jv.Exciter(drive=jv.SwitchedOff(motor, at="8 s", bearing=0.01), unbalance=0.4)
    table = jv.one_mass(mass=300.0, stiffness=3e5, damping=600.0)
    jv.save_scene(jv.Scene(table, exciters=[exciter]), tmp_path / "table.toml")
    sentence = "exciter 1 is switched off at 8 s: steady motions are those after this time; leave switched_off out"
    out = typed("regimes", "table.toml")[1]
    assert out.startswith("no regime") and sentence in out and "resonances: 301.98 rpm" in out
    assert sentence in typed("response", "table.toml", "--points", "200")[1]


def test_regimes_lists_speeds_and_phases_of_exciters(typed, tmp_path):
    springs = [jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    motor = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
    ends = ((-0.6, 1), (0.6, -1))
    exciters = [jv.Exciter(drive=motor, unbalance=0.4, at=(x, 0.0), direction=way) for x, way in ends]
    screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    jv.save_scene(jv.Scene(screen, exciters=exciters), tmp_path / "screen.toml")
    code, out, _ = typed("regimes", "screen.toml", "--json", "--out", "o")
    document = json.loads(out)
    regimes = document["regimes"]
    # Springs of 6 N/mm below the centre of mass of 300 kg and 75 kg m^2, 0.6 m from it.
    np.testing.assert_allclose(document["natural_frequencies"], np.sqrt([20.0, 20.0, 28.8]), rtol=1e-9)
    assert code == 0 and [regime["stable"] for regime in regimes] == [True, False]
    np.testing.assert_allclose(np.abs([regime["phases"][1] for regime in regimes]), [np.pi, 0.0], atol=1e-9)
    assert (tmp_path / "o" / "regimes.png").stat().st_size > 10_000
    layer = ("--layer", "1.5 m, 55 mm, 1600 kg/m3")
    out = typed("regimes", "screen.toml", "--deck", "0.4, 0.1", "--slope", "-5 deg", *layer)[1]
    assert out.count(" t/h") == out.count("conveys ")
    code, _, err = typed("regimes", "screen.toml", "--layer", "0.8, 150, 1600")
    assert code == 2 and "--layer has the height 150 m; numbers without a unit are metres; write for example '1.5 m" in err
    assert "954.887" in out and "point (0.4, 0.1) m: stroke" in out and max(map(len, out.splitlines())) <= 80
    assert "rotation: exciter 1 anticlockwise, exciter 2 clockwise" in out and "margin: factor" in out
    assert "resonances: 42.706, 42.706, 51.247 rpm" in out and "stable, above all resonances:" in out
    code, _, err = typed("regimes", "screen.toml", "--slope", "10")
    assert code == 2 and "--slope is 10 rad (573 degrees), which is not a slope of a deck; write degrees as '10 deg'" in err
    assert (
        "--deck is '0.4'; give X,Y from the centre of mass, m, such as" in typed("regimes", "screen.toml", "--deck", "0.4")[2]
    )
    code, _, err = typed("regimes", "screen.toml", "--deck", "400,100")
    assert (
        code == 2 and "(400, 100) m, more than 20 times as far from the centre of mass as any support or exciter (0.6 m)" in err
    )
    assert "numbers without a unit are metres; for millimetres write '400 mm,100 mm'" in err
    shown = float(out.split("throw number ")[1].split(",")[0])
    scene = jv.load_scene(tmp_path / "screen.toml")
    np.testing.assert_allclose(shown, jv.working_regime(scene).ellipse((0.4, 0.1), slope="-5 deg").throw_number, rtol=5e-3)
    deck = ("--deck", "0.4,0.1", "--slope", "-5 deg")
    out = typed("regimes", "screen.toml", "--tolerance", "stiffness=5%", *deck)[1]
    assert "leading order" in out and "light loads" not in out  # the exciters have no loads
    out = typed("regimes", "screen.toml", "--tolerance", "stiffness=5%", *deck, "--json")[1]
    speed, *others = json.loads(out)["tolerances"]
    assert [each["words"].partition(" at ")[0] for each in others[:3]] == ["stroke", "throw angle", "throw number"]
    np.testing.assert_allclose(others[2]["design"], shown, rtol=5e-3)
    assert speed["share"] == 1.0 and speed["low"] <= speed["high"] and speed["design"] == pytest.approx(regimes[0]["speed"])
    out = typed("regimes", "screen.toml", "--deck", "-0.4, 0.1", "--deck", "0.4,10 cm", "--json")[1]
    measures = json.loads(out)["regimes"][0]["measures"]
    deck = jv.working_regime(scene).deck([(-0.4, 0.1), (0.4, 0.1)]).ellipses
    np.testing.assert_allclose(measures["point"], [[-0.4, 0.1], [0.4, 0.1]], rtol=1e-12)
    np.testing.assert_allclose(measures["point_stroke"], 2.0 * deck.semi_major, rtol=1e-6)
    np.testing.assert_allclose(measures["point_acceleration"], deck.acceleration, rtol=1e-6)
