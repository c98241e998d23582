"""The command lines of README, documentation, templates and help texts are ones that the command line takes, and run."""

import pathlib
import re
import shlex
import shutil
import tomllib

import click
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.app import app, run
from optimize import load_design

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


TEMPLATES = sorted(file for folder in ("jaxvib", "optimize", "examples") for file in (ROOT / folder).rglob("*.toml"))
SOURCES = sorted((ROOT / "jaxvib").rglob("*.py"))


def printed():
    """{command line: the file it is in first}, of blocks, and of code within sentences that has arguments."""
    found = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"^```.*?^```", text, flags=re.M | re.S) + re.findall(r"^    .+$", text, flags=re.M)
        lines = [line for block in blocks for line in re.findall(r"^\s*(?:\$ )?(jaxvib [^\n]+)$", block, flags=re.M)]
        spans = [" ".join(span.split()) for span in re.findall(r"`(jaxvib [a-z-]+ [^-`][^`]*)`", text)]
        for line in (*lines, *spans):
            command = re.sub(r"\s+#.*", "", line).strip()
            found.setdefault(command, page.stem)
    for file, pattern in (
        *((file, r"#.*?(jaxvib [a-z-]+ [^\n,;()]+)$") for file in TEMPLATES),
        *((file, r"`(jaxvib [a-z-]+ [^-`{][^`{]*)`") for file in SOURCES),
    ):
        for command in re.findall(pattern, file.read_text(encoding="utf-8"), flags=re.M):
            if " ... " not in command:
                found.setdefault(command.strip(), file.stem)
    return found


COMMANDS = printed()
CALLED = {"two-mass": "machine", "linear-screen": "screen", "sweep": "study", "measurement": "swing"}
FAST = ("new", "describe", "sketch", "modes", "whirl", "envelope")


def words_of(line):
    """The arguments of a command, and the file that its output goes to."""
    words = shlex.split(line)[1:]
    return (words[: words.index(">")], words[-1]) if ">" in words else (words, None)


def test_the_documentation_has_command_lines():
    assert len(COMMANDS) > 35 and {words_of(line)[0][0] for line in COMMANDS} == set(app.list_commands(None))
    in_files = {"jaxvib describe name_plate_motor", "jaxvib sweep study.toml", "jaxvib new identification > fit.toml"}
    assert in_files <= set(COMMANDS)


@pytest.mark.parametrize("line", COMMANDS)
def test_printed_options_are_those_of_the_command(line):
    (name, *arguments), _ = words_of(line)
    command = app.get_command(click.Context(app), name)
    command.make_context(name, arguments, parent=click.Context(app))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with what the documentation's commands refer to."""
    folder = tmp_path_factory.mktemp("commands")
    for name in ("two-mass", "rotor", "torus", "linear-screen", "design", "sweep", "measurement"):
        (folder / f"{CALLED.get(name, name)}.toml").write_text(template(name))
    page = (ROOT / "docs" / "data_sheets.md").read_text(encoding="utf-8")
    for name, text in re.findall(r"```toml\n# (\w+\.toml)\n(.*?)```", page, flags=re.S):
        (folder / name).write_text(text)
    shutil.copytree(ROOT / "examples", folder / "examples")
    designs = re.findall(r"```toml\n(scene = .*?)```", (ROOT / "docs" / "screens.md").read_text(encoding="utf-8"), flags=re.S)
    for name, text in zip(("screen-design", "feeder-design"), designs, strict=True):
        (folder / f"{name}.toml").write_text(text)
    return folder


def test_the_failed_motor_of_the_page_is_a_scene_file():
    page = (ROOT / "docs" / "screens.md").read_text(encoding="utf-8")
    (drive,) = re.findall(r"```toml\n(\[exciters.drive\].*?)```", page, flags=re.S)
    screen = template("linear-screen")
    motor = jv.scene_from_toml(screen[: screen.rindex("[exciters.drive]")] + drive).exciters[1].drive
    assert isinstance(motor, jv.SwitchedOff) and float(motor.at) == 12.0 and float(motor.motor.speed) > 100.0


def test_the_rotor_without_balls_of_the_page_is_a_scene_file():
    (exciter,) = re.findall(r"```toml\n(\[\[exciters\]\].*?)```", (ROOT / "docs" / "rotor.md").read_text("utf-8"), flags=re.S)
    balancer = template("ball-balancer")
    scene = jv.scene_from_toml(balancer[: balancer.index("[loads]")] + exciter)
    with_balls = jv.scene_from_toml(balancer)
    assert float(scene.exciters[0].unbalance) == float(with_balls.all_effects[0].moment) and scene.exciters[0].loads is None
    assert scene.exciters[0].drive == with_balls.drive


def test_the_design_file_of_the_page_is_read(tmp_path):
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    (tmp_path / "feeder.toml").write_text(template("feeder"))
    for name, first in (("design.toml", "scene = "), ("springs.csv", "spring;")):
        (text,) = re.findall(rf"```\w+\n({first}.*?)```", page, flags=re.S)
        (tmp_path / name).write_text(text)
    design = load_design(tmp_path / "design.toml")
    assert design.space.size == 2 and len(design.space.choices) == 1
    assert design.objective.name == "foundation_force" and len(design.subject_to) == 1


def template(name):
    with pytest.MonkeyPatch.context() as patch:
        said = []
        patch.setattr(click, "echo", lambda text="", **_: said.append(str(text)))
        assert run(["new", name]) == 0
    return "\n".join(said) + "\n"


def answered(line, folder, monkeypatch, capsys):
    words, target = words_of(line)
    monkeypatch.chdir(folder)
    code = run(words)
    out, err = capsys.readouterr()
    assert code == 0, err
    if target is not None:
        (folder / target).write_text(out)


@pytest.mark.parametrize("line", [line for line in COMMANDS if words_of(line)[0][0] in FAST])
def test_printed_command_runs(line, folder, monkeypatch, capsys):
    answered(line.replace('"10 min"', "2s"), folder, monkeypatch, capsys)


@pytest.mark.slow
def test_all_printed_commands_run_one_after_the_other(folder, monkeypatch, capsys):
    """The order is that of the documentation, since some commands read files that others wrote."""
    run_of = jv.simulate(jv.load_scene(folder / "machine.toml"), "6 s")
    for place in ("out", "out/simulate"):
        (folder / place).mkdir(parents=True, exist_ok=True)
        run_of.save(folder / place / "run.npz")
    record(folder / "swing.csv")
    record_run_up(folder / "run_up.csv")
    for line in COMMANDS:
        # explore serves until it is interrupted, see tests/explore/test_server.py; the fit of a machine needs its recordings,
        # see tests/cli/test_identify_machine.py
        if words_of(line)[0][0] != "explore" and words_of(line)[0][1:2] != ["fit.toml"]:
            answered(line, folder, monkeypatch, capsys)


def record(path):
    """The record of a swing with viscous friction only, in degrees."""
    t = np.linspace(0.0, 20.0, 2001)
    swing = np.stack([t, 10.0 * np.exp(-0.05 * t) * np.cos(6.0 * t)], axis=1)
    np.savetxt(path, swing, delimiter=",", header="time (s), angle (deg)", comments="")


def record_run_up(path):
    """The recording of a run-up: an acceleration and the level of a tachometer."""
    t = np.arange(0.0, 10.0, 2e-3)
    angle = 20.0 * t + 2.0 * t**2
    columns = np.stack([t, np.sin(angle), np.clip(50.0 * np.sin(angle), 0.0, 5.0)], axis=1)
    np.savetxt(path, columns, delimiter=",", header="time (s),frame (g),tacho (V)", comments="", fmt="%.9g")


def test_readme_activates_the_environment_before_jaxvib():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = [line.strip() for line in re.findall(r"^    (.+)$", text, flags=re.M)]
    first = next(k for k, line in enumerate(lines) if line.startswith("jaxvib "))
    assert lines[:first] == ["make demo", ". .venv/bin/activate"]


def test_the_demo_installs_no_packages_of_the_tests():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    needed = re.search(r"^demo: \$\(VENV\)/(.+)$", text, flags=re.M)[1]
    recipe = re.search(rf"^\$\(VENV\)/{needed}: pyproject.toml\n((?:\t.*\n)+)", text, flags=re.M)[1]
    assert "--editable .\n" in recipe and "[" not in recipe


def test_printed_installations_name_extras_of_this_project():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    found = set()
    for file in (*PAGES, *SOURCES):
        for requirement in re.findall(r"pip install ['\"]?([^\s'\"`]*\[[^\]]*\])", file.read_text(encoding="utf-8")):
            name, names = requirement[:-1].split("[")
            assert name == ".", f"{file.name}: {requirement}; jaxvib is installed from its sources"
            found |= set(names.split(",")) - {"{extra}"}
    assert {"explore", "sweep"} <= found <= set(extras)
