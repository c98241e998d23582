"""Commands as a user types them."""

import math

import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.cli import output
from jaxvib.cli.app import run


@pytest.fixture
def type_(capsys, monkeypatch):
    """Runs a command line without lines of progress; gives exit code, stdout, stderr."""
    monkeypatch.setattr(output, "SECONDS_TO_FIRST_LINE", math.inf)

    def typed(*words):
        code = run(list(words))
        out, err = capsys.readouterr()
        return code, out, err

    return typed


@pytest.fixture
def typed(type_, tmp_path, monkeypatch):
    """Runs a command line in an empty folder that holds machine.toml; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    jv.save_scene(scene("two_mass", speed=150.0), tmp_path / "machine.toml")
    return type_
