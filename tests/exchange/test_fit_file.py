"""Arguments of a fit and of a plan from the tables of an identification file."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.exchange.recordings.fit_file import fit_from_tables

T = 0.005 * np.arange(400)


def tables(folder, **changes):
    """Return the tables of a file with one run, at 200 Hz, and one candidate without a rate."""
    drive = jv.ConstantSpeed(30.0)
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    jv.save_scene(jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)]), folder / "machine.toml")
    np.savetxt(
        folder / "run.csv", np.stack([T, np.sin(9.0 * T)], axis=1), delimiter=",", header="t,frame", comments="", fmt="%.6f"
    )
    candidate = {"name": "next", "drive": {"kind": "constant_speed", "speed": 20.0}, "duration": "3 s", "noise": {"deck": 0.1}}
    candidate |= {"at": {"frame": 1}, "change": {"machine.mass": "+1 kg"}}
    candidate["channel"] = [{"name": "deck", "kind": "velocity", "at": 1}]
    found = {
        "machine": {"file": "machine.toml"},
        "run": [{"file": "run.csv", "from": "0.5 s", "change": {"machine.mass": "+2 kg"}}],
        "channel": [{"name": "frame", "kind": "velocity"}],
        "identify": {"unknown": ["machine.stiffness"], "known": {"machine.damping": "60 N s/m"}},
        "candidate": [candidate],
        "limits": {"speed": 40.0, "acceleration": 3.0},
    }
    return found | changes


def test_tables_become_arguments(tmp_path):
    found = fit_from_tables(tables(tmp_path), tmp_path)
    assert found.scene_file == tmp_path / "machine.toml" and float(found.scene.machine.mass[0]) == 50.0
    assert found.unknown == ("machine.stiffness",) and found.known == {"machine.damping": "60 N s/m"}
    assert found.limits == {"speed": 40.0, "acceleration": 3.0}
    (run,), (planned,) = found.runs, found.candidates
    assert run.times["frame"][0] == pytest.approx(0.5) and run.change["machine.mass"].amount == "2 kg"
    assert (planned.name, planned.duration, planned.noise) == ("next", 3.0, {"deck": 0.1})
    assert planned.rate == pytest.approx(200.0) and planned.change == {"machine.mass": "+1 kg"}
    assert [(each.name, each.at) for each in planned.channels] == [("frame", 1), ("deck", 1)]
    assert float(planned.drive.speed) == 20.0


def test_rate_of_a_candidate_and_files_without_one(tmp_path):
    given = tables(tmp_path)
    given["candidate"][0]["rate"] = "50 Hz"
    assert fit_from_tables(given, tmp_path).candidates[0].rate == 50.0
    del given["candidate"], given["limits"]
    found = fit_from_tables(given, tmp_path)
    assert found.candidates == () and found.limits is None


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("speed", 3.0, r"candidate\[0\]\.speed is not a field here"),
        ("name", None, r"candidate\[0\]\.name is missing; a candidate needs a name, a drive and a duration"),
        ("at", {"desk": 1}, r"candidate\[0\]\.at\.desk is not a channel; the channels are: frame"),
        ("at", 1, r"candidate\[0\]\.at is 1; write the places of channels"),
        ("duration", "-3 s", r"candidate\[0\]\.duration"),
    ],
)
def test_wrong_candidates_raise_clear_errors(tmp_path, field, value, says):
    given = tables(tmp_path)
    given["candidate"][0] |= {field: value}
    if value is None:
        del given["candidate"][0][field]
    with pytest.raises(jv.InputError, match=f"^{says}"):
        fit_from_tables(given, tmp_path)
