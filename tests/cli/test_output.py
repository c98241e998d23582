"""Files that commands write."""

import errno
from pathlib import Path

import click
import pytest
from matplotlib.figure import Figure

import jaxvib as jv
from jaxvib.cli.output import Output


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
