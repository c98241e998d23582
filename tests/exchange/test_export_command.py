"""The command `jaxvib export`."""

import json

import pytest
import scipy.io
from scenes import scene

import jaxvib as jv
from jaxvib.cli.app import run


@pytest.fixture
def machine(tmp_path):
    path = tmp_path / "machine.toml"
    path.write_text(jv.scene_to_toml(scene()))
    return path


def exported(capsys, *words):
    code = run(["export", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_units_are_exported(machine, tmp_path, capsys):
    code, document = exported(capsys, machine, "--to", "fmu", "--out", tmp_path / "m.fmu", "--fmi", "3.0", "--source-only")
    assert code == 0 and document["message"] == "source only: no binary was requested" and (tmp_path / "m.fmu").is_file()


def test_state_space_of_a_jam_is_exported(machine, tmp_path, capsys):
    code, document = exported(capsys, machine, "--to", "state-space", "--out", tmp_path / "m.mat", "--mode", "3")
    model = jv.state_space(scene(), jv.jam_modes(scene()).select(3))
    assert code == 0 and document["message"] == model.about
    assert scipy.io.loadmat(tmp_path / "m.mat")["A"].tobytes() == model.A.tobytes()


def test_universal_files_are_exported(machine, tmp_path, capsys):
    code, document = exported(capsys, machine, "--to", "uff", "--out", tmp_path / "m.unv", "--quantity", "acceleration")
    assert code == 0 and document["message"].startswith("2 frequency response functions")
    assert jv.read_uff(document["path"]).functions[0].quantity == "acceleration"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--to", "fmu", "--out", "/none/m.fmu"], "path is '/none/m.fmu', and its folder does not exist"),
        (["--to", "uff", "--out", "m.unv", "--fmi", "2.0"], "--fmi cannot be used with --to uff; leave it out"),
        (["--to", "fmu", "--out", "m.fmu", "--rotor-speed", "9"], "--rotor-speed cannot be used with --to fmu"),
        (["--to", "state-space", "--out", "m.mat", "--mode", "9"], "--mode is 9; "),
        (["--to", "state-space", "--out", "m.mat", "--rotor-speed", "3 kg"], "--rotor-speed is "),
    ],
)
def test_wrong_options_raise_clear_errors(words, says, machine, capsys):
    code, document = exported(capsys, machine, *words)
    assert code == 2 and document["error"]["message"].startswith(says)
