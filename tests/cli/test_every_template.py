"""Every command with every template: a result, or a refusal that names its reason."""

import pytest

from jaxvib.cli.app import _MODULES, run
from jaxvib.machine.files import SCREENS, TEMPLATES

BAND = ("--omega", "20 rad/s", "60 rad/s")
OPTIONS = {
    "sketch": (),
    "modes": (),
    "criterion": (),
    "balance": (),
    "whirl": (),
    "response": (),
    "regimes": (),
    "stability-map": ("--vary", "loads.mass", "--value", "0.1 kg", *BAND),
    "onset": ("--vary", "loads.mass", "--kind", "torus", "--between", "30 g", "100 g", *BAND),
    "simulate": ("--until", "0.2s"),
    "settle": ("--segments", "1"),
    "envelope": ("--until", "0.5s"),
    "run-up": ("--until", "0.5s"),
    "run-up-map": ("--until", "0.2s", "--drag", "0.5", "--starts", "2"),
    "growth": ("--until", "0.5s", "--segments", "8"),
    "capture": ("--resolution", "0.5", "--turns", "20"),
    "animate": ("--until", "0.1s", "--seconds", "0.3", "--format", "gif"),
    "cost": ("--until", "0.1s", "--repeats", "1"),
    "audit": ("--repeats", "1", "--no-tiers"),
    "export": ("--to", "state-space", "--out", "machine.mat"),
}
"""Shortest sensible options of each command that takes a scene file."""

OTHER = {"new", "describe", "explore", "optimize", "sweep", "show", "record", "identify", "plan"}
"""Commands without a scene file, and the page of sliders, which does not end."""


def test_every_command_with_a_scene_is_listed():
    assert set(OPTIONS) | OTHER == set(_MODULES) and not set(OPTIONS) & OTHER


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*TEMPLATES, *SCREENS])
@pytest.mark.parametrize("command", OPTIONS)
def test_commands_compute_templates_or_refuse_by_name(command, kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = ({**TEMPLATES, **SCREENS})[kind]
    (tmp_path / "machine.toml").write_text(text, encoding="utf-8")
    code = run([command, "machine.toml", *OPTIONS[command]])
    out, err = capsys.readouterr()
    assert "No such option" not in err and "Missing" not in err
    assert out if code == 0 else code in (1, 2) and "jaxvib: " in err
