"""The command that identifies a machine from recorded runs; the runs are integrated by SciPy."""

import json

import numpy as np
import pytest
from run_ups_by_scipy import DURATION, TRUTH, accelerations, ramp, scene_of

import jaxvib as jv

FIT = """
[machine]
file = "machine.toml"

[[run]]
file = "run_up.csv"
from = "0.5 s"

[[channel]]
name = "frame"
kind = "acceleration"
at = 1
gain_error = 0.0

[[channel]]
name = "deck"
kind = "acceleration"
at = 2
gain_error = 0.0

[[channel]]
name = "tacho"
kind = "pulses"

[identify]
unknown = ["machine.stiffness", "machine.damping[0]"]
known = { "exciters[0].unbalance" = 0.05 }
"""


@pytest.fixture(scope="module")
def recorded():
    """Times and readings of a run-up: accelerations, g, with noise, and the level of a tachometer, V."""
    times = np.arange(0.0, DURATION, 2e-3)
    readings = accelerations(times, [TRUTH])[0] / 9.80665
    noise = 1e-3 * np.std(readings) * np.random.default_rng(0).standard_normal(readings.shape)
    level = np.clip(50.0 * np.sin(ramp(times)[0]), 0.0, 5.0)
    return np.column_stack([times, readings + noise, level])


@pytest.fixture
def typed(type_, recorded, tmp_path, monkeypatch):
    """Runs a command line in a folder with an identification file, its scene and its recording."""
    monkeypatch.chdir(tmp_path)
    head = "time (s),frame (g),deck (g),tacho (V)"
    np.savetxt("run_up.csv", recorded, delimiter=",", header=head, comments="", fmt="%.9g")
    start = {**TRUTH, "machine.stiffness[0]": 5.2e4, "machine.stiffness[1]": 5.8e4, "machine.damping[0]": 200.0}
    jv.save_scene(scene_of(start), "machine.toml")
    (tmp_path / "fit.toml").write_text(FIT)
    return type_


def test_machine_is_identified_from_the_command_line(typed, tmp_path):
    code, out, err = typed("identify", "fit.toml", "--json", "--out", "o")
    document = json.loads(out)
    assert (code, err) == (0, "")
    assert document["names"] == ["machine.stiffness[0]", "machine.stiffness[1]", "machine.damping[0]"]
    for name, estimate in zip(document["names"], document["estimates"], strict=True):
        assert estimate["value"] == pytest.approx(TRUTH[name], rel=5e-3)
    found = jv.load_scene(tmp_path / "o" / "found.toml")
    np.testing.assert_allclose(found.machine.stiffness, [5e4, 6e4], rtol=5e-3)
    assert (tmp_path / "o" / "fit.png").stat().st_size > 10_000


def test_template_of_identification_is_complete(type_, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert type_("new", "identification", "--out", "o")[0] == 0
    text = (tmp_path / "o" / "identification.toml").read_text()
    for field in ("from", "until", "rate", "change", "unit", "direction", "gain_error", "delay", "high_pass", "range", "known"):
        assert f"# {field} = " in text


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[[run]]", "[run]", "run is {'file': 'run_up.csv', 'from': '0.5 s'}; write [[run]] for each run"),
        ("[[run]]", "[[runs]]", "runs is not part of an identification file; did you mean 'run'?"),
        ('from = "0.5 s"', 'form = "0.5 s"', "run[0].form is not a field here; did you mean 'from'?"),
        ('file = "run_up.csv"', 'file = "none.csv"', "run[0]: none.csv cannot be read"),
        ('file = "run_up.csv"', "", "run[0].file is missing; write the path of a recording"),
        ('file = "machine.toml"', "file = 3", "machine must be a table with the name of the scene file; write [machine]"),
        ('from = "0.5 s"', "change = 3", "run[0].change is 3; write { "),
        ('kind = "pulses"', 'sort = "pulses"', "channel[2].sort is not a field here; allowed: name, kind"),
        ("at = 2", "at = 0", "channel 'deck': at is 0; it must be the number of a platform"),
        ('name = "deck"', 'name = "desk"', "run_up.csv: channel 'desk' is not in the file; its channels are 'frame', 'deck'"),
        ("[identify]", "[identify]\nfree = 1", "identify.free is not a field here; allowed: unknown, known"),
        (
            '["machine.stiffness", "machine.damping[0]"]',
            '"machine.stiffness"',
            "identify.unknown is 'machine.stiffness'; write a",
        ),
    ],
)
def test_wrong_identification_files(typed, tmp_path, old, new, says):
    assert old in FIT
    (tmp_path / "fit.toml").write_text(FIT.replace(old, new, 1))
    code, out, err = typed("identify", "fit.toml")
    assert (code, out) == (2, "") and says in err and err.count("\n") == 1


def test_options_of_a_pendulum_are_refused_for_a_machine(typed):
    code, out, err = typed("identify", "fit.toml", "--mass", "3 kg")
    assert (code, out) == (2, "") and "--mass is for the swing of a pendulum; leave it out for a machine" in err


CANDIDATES = """
[[candidate]]
name = "again"
drive = { kind = "run_up", speed = "100 rad/s", acceleration = "8 rad/s^2" }
duration = "12 s"

[[candidate]]
name = "heavier"
drive = { kind = "speed_profile", times = [0.0, 12.0], speeds = [100.0, 0.0] }
duration = "12 s"
at = { frame = 2, deck = 1 }
change = { "machine.mass[0]" = "+10 kg" }

[limits]
speed = "100 rad/s"
acceleration = "12 rad/s^2"
"""


def test_numbers_in_tables_of_plans_are_not_broken():
    """Eight unknown parameters and a long name of a run; the table has 80 columns."""
    from jaxvib.cli.study.plan import _text
    from jaxvib.identification.further_runs.plan import RunPlan

    errors = np.array([[0.00012, 0.0071, 0.033, 0.25, 1.5, np.inf, 4.4e-4, 0.0005]])
    names = tuple(f"machine.link_stiffness[{k}]" for k in range(8))
    runs = ("20 kg on the table, optimized speed", *map(str, range(2, 6)))
    many, low, high = (np.tile(x, (5, 1)) for x in (errors, errors, errors))
    low[0, 1], high[0, :5] = 0.0012, [0.00012, 0.014, 0.039, 0.28, np.inf]
    plan = RunPlan(runs, names, many, low, high, errors[0], np.full(5, 0.5), np.full(5, 16.0 * np.log(2.0)), None)
    text = _text(plan)
    assert max(map(len, text.splitlines())) <= 80
    rows = [[each.strip() for each in line.split("│")][1:-1] for line in text.splitlines()]
    words = ["0.012", "0.71", "3.3", "25", "150", "-", "0.044", "0.05"]
    firsts = ["0.012", "0.12 to 1.4", "3.3", "25", "150 to -", "-", "0.044", "0.05"]
    for name, word, first in zip(names, words, firsts, strict=True):
        assert [name, word, first, word, word, word] in rows and [name, word, word] in rows
    assert any(row[1:] == ["30", "2", "11.1"] for row in rows)
    assert "repeat the plan" in text and "No candidate determines machine.link_stiffness[5]: add" in " ".join(text.split())
    sure = _text(RunPlan(runs, names, many, many, many, errors[0], np.full(5, 0.5), np.full(5, 2.0), None))
    assert "repeat the plan" not in sure and "range" not in sure


@pytest.mark.slow
def test_candidate_runs_are_ranked_from_the_command_line(typed, tmp_path):
    (tmp_path / "fit.toml").write_text(FIT + CANDIDATES)
    assert typed("identify", "fit.toml", "--out", "o")[0] == 0
    code, out, err = typed("plan", "fit.toml", "--fit", "o/fit.npz", "--json", "--out", "o")
    document = json.loads(out)
    assert (code, err) == (0, "")
    assert {"again", "heavier"} < set(document["candidates"]) and len(document["candidates"]) == 3
    assert document["benefit"] == sorted(document["benefit"], reverse=True) and document["minutes"] == [0.2] * 3
    assert len(document["profile"]["speeds"]) == 9 and max(document["profile"]["speeds"]) <= 100.0
    assert np.all(np.asarray(document["errors_low"]) <= document["errors_high"])
    assert len(document["errors"]) == 3 and all(0.0 < error < 0.05 for row in document["errors"] for error in row)
    assert (tmp_path / "o" / "plan.png").stat().st_size > 5_000
    code, out, _ = typed("plan", "fit.toml", "--fit", "o/fit.npz")
    assert code == 0 and "optimized speed" in out and "│ machine.stiffness[0] " in out


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (CANDIDATES, "", "candidate is missing; write [[candidate]] for each run"),
        ('name = "again"', "", "candidate[0].name is missing"),
        ('name = "again"', 'name = "again"\nspeed = 3', "candidate[0].speed is not a field here"),
        ("frame = 2", "frme = 2", "candidate[1].at.frme is not a channel; the channels are: frame, deck, tacho"),
        ('kind = "run_up"', 'kind = "ramp"', "candidate[0].drive.kind is 'ramp'"),
        ('kind = "run_up", speed = "100 rad/s", acceleration = "8 rad/s^2"', 'kind = "dc_motor", speed = 100.0, '
         "stall_torque = 5.0, inertia = 0.1", "candidate[0].drive is 'dc_motor', whose speed depends on the machine"),
        ('"12 s"', '"12 kg"', "candidate[0].duration"),
        ('[limits]\nspeed = "100 rad/s"', "[limits]", "limits.speed is missing"),
    ],
)  # fmt: skip
def test_wrong_candidates_raise_clear_errors(typed, tmp_path, old, new, says):
    (tmp_path / "fit.toml").write_text((FIT + CANDIDATES).replace(old, new, 1))
    code, out, err = typed("plan", "fit.toml")
    assert (code, out) == (2, "") and says in err and err.count("\n") == 1, err
