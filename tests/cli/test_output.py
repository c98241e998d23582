"""Files that commands write."""

import contextlib
import errno
import time
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxvib as jv
from jaxvib.cli import output as output_module
from jaxvib.cli.app import run, table, tolerance_table
from jaxvib.cli.optimize import _few_machines_texts, _quantities_with_ranges, _with_time_left
from jaxvib.cli.output import Output
from jaxvib.runtime import stored
from jaxvib.runtime.programs import cached
from optimize import Design, DesignSpace, ToleranceRange, amplitude, foundation_force, worst


def full_disk(*arguments, **_):
    next(each for each in arguments if isinstance(each, Path)).write_bytes(b"half")
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("name", ["jam.json", "report.html", "figure.png"])
def test_a_full_disk_leaves_the_old_files_whole(tmp_path, monkeypatch, name):
    (tmp_path / name).write_bytes(b"old")
    monkeypatch.setattr(Path, "write_text", full_disk)
    monkeypatch.setattr(Figure, "savefig", full_disk)
    output = Output(True, None if name == "report.html" else tmp_path, tmp_path / name if name == "report.html" else None)
    with click.Context(click.Command("jam"), obj=["jam"]), pytest.raises(jv.InputError, match=r"No space left on device"):
        if name == "figure.png":
            output.figure(name, Figure)
        output.done({"a": 1.0}, lambda: "text", "jam")
    assert (tmp_path / name).read_bytes() == b"old" and [file.name for file in tmp_path.iterdir()] == [name]


def test_command_in_a_report_can_be_run_again(tmp_path):
    words = ["simulate", "my machine.toml", "--until", "0.5 min"]
    with click.Context(click.Command("simulate"), obj=words):
        Output(True, None, tmp_path / "report.html").done({"a": 1.0}, lambda: "text", "simulate")
    page = (tmp_path / "report.html").read_text()
    assert "jaxvib simulate &#x27;my machine.toml&#x27; --until &#x27;0.5 min&#x27;" in page


@pytest.mark.parametrize(("title", "heading"), [(None, "simulate"), ("Screen 7", "Screen 7")])
def test_a_report_has_the_requested_title(tmp_path, title, heading):
    with click.Context(click.Command("simulate")):
        output = Output(True, None, tmp_path / "report.html", title=title, author=title and "A. Author")
        output.done({"a": 1.0}, lambda: "text", "simulate")
    page = (tmp_path / "report.html").read_text()
    assert f"<h1>{heading}</h1>" in page and ("<p>A. Author</p>" in page) == (title is not None)
    assert "<code>jaxvib simulate</code>" in page


def test_a_report_has_no_control_characters(tmp_path, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    text = table("title", ["speed"], [["1"]])
    with click.Context(click.Command("simulate")):
        Output(True, None, tmp_path / "report.html").done({"a": 1.0}, lambda: text, "simulate")
    page = (tmp_path / "report.html").read_text()
    assert "\x1b" in text and "\x1b" not in page and "┃ speed ┃" in page


@pytest.mark.parametrize("is_terminal", [True, False])
def test_notes_fit_on_a_terminal(capsys, monkeypatch, is_terminal):
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    run(["describe", "nothing like it"])
    lines = capsys.readouterr().err.replace("\r\x1b[K", "").splitlines()
    assert lines[0].startswith("jaxvib: name is 'nothing like it'; allowed: machines,")
    assert (max(map(len, lines)) <= 80) == is_terminal == (len(lines) > 1)


@pytest.mark.parametrize("compiling", [True, False])
def test_the_progress_bar_shows_that_programs_are_compiled(capsys, monkeypatch, compiling):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "xterm")
    with stored._compilation() if compiling else contextlib.nullcontext(), Output(False, None).progress() as progress:
        progress("descending", 0.5)
    shown = capsys.readouterr().err
    assert "descending" in shown and ("compiling, once" in shown) == compiling and not stored.is_compiling()


def test_lines_of_progress_come_at_doubling_intervals(capsys, monkeypatch):
    now, output = [100.0], Output(False, None)

    def wait(seconds):
        now[0] += seconds
        output._step = "descending: 50%" if now[0] > 150.0 else ""
        return now[0] > 4000.0

    output._done = SimpleNamespace(wait=wait)
    monkeypatch.setattr("jaxvib.cli.output.time", SimpleNamespace(monotonic=lambda: now[0]))
    output._print_lines()
    lines, compiled = capsys.readouterr().err.splitlines(), "(new programs are compiled once, then stored)"
    assert lines[:3] == [f"computing, {x} s {compiled}" for x in (10, 20, 40)]
    minutes = (
        "1 min 20 s",
        "2 min 40 s",
        "5 min 20 s",
        "10 min 40 s",
        "20 min 40 s",
        "30 min 40 s",
        "40 min 40 s",
        "50 min 40 s",
    )
    assert lines[3:] == [*(f"descending: 50%, after {x}" for x in minutes), "descending: 50%, after 1 h 0 min"]


@pytest.mark.parametrize("step", ["", "descending: 50%"])
def test_lines_of_progress_state_that_programs_are_compiled(capsys, step):
    output, ends = Output(False, None), iter([False, True])
    output._step, output._done = step, SimpleNamespace(wait=lambda _: next(ends))
    with stored._compilation():
        output._print_lines()
    assert capsys.readouterr().err.startswith(f"{step}, compiling, once, after 0 s" if step else "compiling, 0 s (")


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_long_command_shows_its_progress(capsys, monkeypatch, is_terminal):
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal, raising=False)
    monkeypatch.setattr(output_module, "SECONDS_TO_FIRST_LINE", 0.01)
    seen, output = "", Output(False, None)
    with output.waiting(), output.progress() as progress:
        for _ in range(500):
            progress("{descending}", 0.5)
            seen += capsys.readouterr().err
            if "{descending}" in seen:
                break
            time.sleep(0.01)
    assert "{descending}" in seen and ("\x1b" in seen) == is_terminal == ("after" not in seen)


def test_programs_count_as_compiling_until_they_are_ready():
    seen = []

    @cached
    def twice(x):
        seen.append(stored.is_compiling())
        return 2.0 * x

    assert twice(np.ones(3)).tolist() == [2.0, 2.0, 2.0] and seen == [True] and not stored.is_compiling()


def test_time_left_of_a_search_follows_from_its_finished_share(monkeypatch):
    clock, lines = iter([100.0, 101.0, 110.0, 300.0]), []
    monkeypatch.setattr("jaxvib.cli.optimize.time", SimpleNamespace(monotonic=lambda: next(clock)))
    report = _with_time_left(lambda *line: lines.append(line))
    for share in (0.0, 0.2, 0.5):
        report("descending", share)
    names = ["descending", "descending, about 40 s left", "descending, about 3 min 20 s left"]
    assert lines == list(zip(names, (0.0, 0.2, 0.5), strict=True))


def test_title_of_a_narrow_table_stays_on_one_line():
    lines = table("whirl frequency = rotor speed", ["", "rpm"], [["forward", "1"]]).splitlines()
    assert lines[0] == "whirl frequency = rotor speed" and lines[1].startswith("┏") and len(lines[1]) < len(lines[0])


def test_ranges_of_a_maximized_quantity_are_positive():
    text = tolerance_table([ToleranceRange("negative stroke", "m", -0.034, -0.035, -0.033, -0.032, 1.0)], ["mass=1%"])
    row = next(line for line in text.splitlines() if "stroke" in line)
    assert [cell.strip() for cell in row.strip("│ ").split("│")] == ["stroke, mm", "34", "33", "35", "32", "100 %"]


@pytest.mark.parametrize(
    ("share", "says"), [(0.95, []), (0.603, ["only 60.3 % of these machines meet this demand: b at most 1 m"])]
)
def test_demands_that_few_machines_meet_are_named(share, says):
    ranges = [ToleranceRange(name, "m", 1.0, 1.0, 1.0, 1.0, x) for name, x in (("a", 0.1), ("b at most 1 m", share))]
    assert _few_machines_texts(ranges, [amplitude(mode=1) < 1.0]) == says


@pytest.mark.parametrize(("objective", "count"), [(foundation_force(mode=1), 1), (amplitude(mode=1), 2)])
def test_ranges_name_the_foundation_force_once(objective, count):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    space = DesignSpace(scene, free={"machine.stiffness": (1e4, 1e5)})
    for each in (objective, worst(objective, {"machine.mass": 0.1})):
        assert len(_quantities_with_ranges(Design(space, each, (), {}))) == count
