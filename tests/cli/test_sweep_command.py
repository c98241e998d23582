"""`jaxvib sweep`, `jaxvib show`, `jaxvib new sweep` as a user types them."""

import contextlib
import json
import math
import subprocess
import sys

import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.cli.output import Output
from jaxvib.cli.study import sweep as command
from jaxvib.sweeps.seals import seal_of
from jaxvib.sweeps.store import Store

STUDY = """
scene = "machine.toml"
chunk = 4
[axes]
"drive.speed" = { from = "200 rpm", to = "900 rpm", count = 5 }
"loads.drag" = [0.5, 1.0]
[[measure]]
function = "own_quantity:heaviness"
unit = "kg rad/s"
name = "heaviness"
"""

OWN = "def heaviness(scene):\n    return scene.machine.mass[0] * scene.drive.speed\n"


@pytest.fixture
def typed(type_, tmp_path, monkeypatch):
    """Runs a command line in a folder that holds machine.toml and study.toml; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_quantity", raising=False)
    jv.save_scene(scene("one_mass", speed=60.0), tmp_path / "machine.toml")
    (tmp_path / "own_quantity.py").write_text(OWN)
    (tmp_path / "study.toml").write_text(STUDY)
    return type_


def test_a_study_is_run_resumed_and_shown(typed, tmp_path):
    code, out, err = typed("sweep", "study.toml", "--out", "figures")
    assert code == 0 and "every case was computed: 10 cases in study.zarr" in out and "100 %" in out and err == ""
    assert (tmp_path / "figures" / "sweep.png").stat().st_size > 5_000
    data = jv.open_sweep("study.zarr").data
    assert data.heaviness.shape == (5, 2) and abs(float(data.heaviness[0, 0]) - 50.0 * 20.943951) < 1e-3
    code, out, _ = typed("sweep", "study.toml", "--json")
    document = json.loads(out)
    assert code == 0 and document["computed"] == 0 and document["counts"] == [{"status": "done", "cases": 10}]
    code, out, _ = typed("show", "study.zarr", "--out", "figures", "--no-theory")
    assert code == 0 and all((tmp_path / "figures" / f"{n}.png").exists() for n in ("map", "distribution", "tornado"))
    last = [" ".join(line.strip("│ ").replace("│", " ").split()) for line in out.splitlines() if line.startswith("│")][-1]
    assert "results of the cases" in out and last == "900 1 4712"  # 50 kg at 900 rpm
    code, out, _ = typed("show", "study.zarr", "--json")
    assert json.loads(out)["cases"] == 10


def test_a_missing_package_is_reported_before_slow_imports(typed):
    code = "import sys; sys.modules['zarr'] = None; from jaxvib.cli.app import run\n"
    code += "print(run(['sweep', 'study.toml']), 'jaxvib.sweeps' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "2 False\n" and "zarr is not installed; install it with: pip install" in ended.stderr


def test_a_store_without_a_computed_case_has_no_figures(typed, tmp_path):
    assert typed("sweep", "study.toml")[0] == 0
    store = Store(tmp_path / "study.zarr")
    for chunk in range(math.prod(store.tiles)):
        for file in (seal_of(store.path, chunk), *store._files(chunk).values()):
            file.unlink(missing_ok=True)
    code, out, err = typed("show", "study.zarr", "--out", "figures")
    assert code == 0 and "no case was computed" in err and "has not been computed yet" in out


def test_progress_of_a_sweep_counts_cases(typed, monkeypatch):
    lines = []
    monkeypatch.setattr(Output, "progress", lambda _: contextlib.nullcontext(lambda *line: lines.append(line)))
    typed("sweep", "study.toml")
    # Chunks of 4, 4 and 2 cases are computed in threads; any of them can end first.
    assert (lines[0][0][:15], lines[0][1]) in (("4 of 10 cases, ", 0.4), ("2 of 10 cases, ", 0.2))
    assert lines[-1][0].startswith("10 of 10 cases, ") and lines[-1][0].endswith(" left") and lines[-1][1] == 1.0


def test_a_commented_study_file_is_one(typed, tmp_path):
    code, out, _ = typed("new", "sweep")
    assert code == 0 and "[axes]" in out
    assert typed("new", "sweep", "--out", "fresh")[0] == 0
    assert (tmp_path / "fresh" / "study.toml").read_text() == out.rstrip() + "\n"


def test_an_interrupt_names_the_saved_chunks(typed, monkeypatch, tmp_path):
    reports = []

    def stop_once(now):
        reports.append(now)
        if len(reports) == 1:
            raise KeyboardInterrupt
        return ""

    monkeypatch.setattr(command, "_progress_text", stop_once)
    code, _, err = typed("sweep", "study.toml")
    assert code == 1 and "finished cases are saved in study.zarr; run the same command again to continue" in err
    code, out, _ = typed("show", "study.zarr", "--report", "report.html")
    assert "<title>show: study</title>" in (tmp_path / "report.html").read_text()
    left = 10 - reports[0].done  # 6 or 8: threads end their chunks of 4, 4 and 2 cases in any order
    assert (
        left in (6, 8)
        and code == 0
        and "some cases have not been computed yet" in out
        and f"{left} ({10 * left} %) missing" in out
    )
    assert f"{left} cases were computed in this call" in typed("sweep", "study.toml")[1]


@pytest.mark.parametrize(
    ("old", "new", "words", "says"),
    [
        ("[axes]", "[axis]", (), "axis is not part of a study file; did you mean 'axes'"),
        ("own_quantity:heaviness", "own_quantity:weight", (), "which cannot be imported"),
        ('function = "own_quantity:heaviness"', 'quantity = "run.regimes"', (), "did you mean 'run.regime'"),
        ('function = "own_quantity:heaviness"', 'quantity = "amplitudes"', (), "did you mean 'amplitude'"),
        ('"loads.drag" = [0.5, 1.0]', '"loads.drag" = [0.5, 0.5]', (), "has a value twice"),
        ("chunk = 4", "chunk = 4\n[run]\nuntill = 3.0", (), "run.untill is not a field here; did you mean 'until'"),
        ("chunk = 4", "chunk = 4\nsamples = -3", (), "samples is -3"),
        (
            "",
            "",
            ("--scheduler", "tcp://127.0.0.1:9", "--timeout", "0.5 s"),
            "no scheduler with workers answers there within 0.5 s",
        ),
        ("", "", ("--workers", "2", "--scheduler", "tcp://127.0.0.1:9"), "cannot be combined with workers"),
        ("", "", ("--store", "machine.toml"), "not the store of a sweep"),
    ],
)
def test_invalid_options_raise_clear_errors(typed, tmp_path, old, new, words, says):
    text = (tmp_path / "study.toml").read_text()
    (tmp_path / "study.toml").write_text(text.replace(old, new) if old else text)
    code, out, err = typed("sweep", "study.toml", *words)
    assert code == 2 and says in err and out == ""


def test_a_store_that_is_there_is_not_begun_anew(typed):
    assert typed("sweep", "study.toml")[0] == 0
    code, _, err = typed("sweep", "study.toml", "--no-resume")
    assert code == 2 and "exists already; give another folder with --store" in err
    code, _, err = typed("show", "machine.toml")
    assert code == 2 and "not the store of a sweep" in err
