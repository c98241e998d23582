"""Mutated study files and stores end in one sentence or in the right numbers."""

import pathlib
import shutil

import pytest
from file_texts import STUDY
from mutations import mutate_store, mutated_text, seeded, store_outcome, study_outcome
from scenes import scene

import jaxvib as jv
from jaxvib.sweeps.study import load_study, study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    jv.save_scene(scene("two_mass", speed=60.0), folder / "machine.toml")
    (folder / "study.toml").write_text(STUDY)
    return folder


def test_mutated_study_files_are_refused_or_another_study(folder):
    (folder / "study.toml").write_text(STUDY)
    original = load_study(folder / "study.toml")
    found = [study_outcome(folder, mutated_text(STUDY, seeded(seed)), original) for seed in range(150)]
    assert [(seed, each) for seed, each in enumerate(found) if each[0] not in ("refused", "accepted")] == []
    assert sum(kind == "refused" for kind, _ in found) > 50


def test_mutated_stores_are_repaired_or_refused(folder, tmp_path):
    (folder / "study.toml").write_text(STUDY)
    asked = load_study(folder / "study.toml")
    whole = pathlib.Path(run_study(asked, tmp_path / "whole.zarr").store)
    truth = jv.open_sweep(whole).data.load()
    kinds = []
    for seed in range(8):
        store = shutil.copytree(whole, tmp_path / f"{seed}.zarr")
        mutate_store(store, seeded(seed))
        kind, said = store_outcome(store, asked, truth)
        assert kind in ("refused", "accepted"), (seed, said)
        kinds.append(kind)
    assert set(kinds) == {"refused", "accepted"}


TABLES = [
    ('quantity = ["a"]', "quantity is"),
    ('quantity = "amplitude"\nmode = 1\nof = [2]', "of is"),
    ('quantity = "amplitude"\nmode = 1\nof = "x"', "of is"),
    ('quantity = "amplitude"\nmode = 1\nof = [[1], 2]', "of[0] is"),
    ('quantity = "phase"\nmode = 1\nof = [1, "x"]', "of[1] is"),
    ('quantity = "amplitude"\nmode = 1\nname = ["a"]', "name is"),
    ('quantity = "amplitude"\nmode = 1\ntier = ["exact"]', "tier"),
    ('quantity = "amplitude"\nmode = [1]', "mode is"),
    ('quantity = "spring_cost"\nprices = [[1, "a"], [2, 3]]', "prices"),
    ('quantity = "spring_cost"\nprices = [[1, []], [2, 3]]', "prices"),
    ('quantity = "spring_cost"\nprices = [[1, 1e400], [2, 3]]', "prices"),
    ('quantity = "spring_cost"\nprices = [1, 2]', "prices"),
    ('quantity = "total"\nfield = ["a"]', "field is"),
    ('quantity = "peak_force"\nuntil = [20]\nspin_up = 5.0', "until is"),
    ('quantity = "settling_time"\nuntil = 20.0\nspin_up = 5.0\nof = "x"', "of is"),
    ('quantity = "settling_time"\nuntil = 20.0\nspin_up = 5.0\nwithin = "x"', "within is"),
    ('quantity = "total_mass"\ntolerances = 3', "tolerances is"),
    ('quantity = "total_mass"\ntolerances = { "machine.mass" = "x" }', "tolerances.machine.mass is"),
    ('quantity = "total_mass"\ntolerances = { "machine.mass" = 0.1 }\nstatistic = ["worst"]', "statistic is"),
    ('quantity = "total_mass"\ntolerances = { "machine.mass" = 0.1 }\nsamples = 1000000000000', "samples is"),
    ("function = 3", "function is"),
    ('function = "os:getcwd"', "getcwd"),
    ('function = "sys:exit"', "function <built-in function exit>"),
    ('function = "operator:index"', "cannot be called"),
    ('function = "no_such_module:f"', "cannot be imported"),
    ('function = "math:sqrt"\nmode = 3', "mode is not a field here"),
]


@pytest.mark.parametrize(("table", "says"), TABLES, ids=[table for table, _ in TABLES])
def test_wrong_tables_of_measures_raise_clear_errors(folder, table, says):
    head = 'scene = "machine.toml"\n[axes]\n"drive.speed" = [20.0, 60.0]\n[[measure]]\n'
    (folder / "wrong.toml").write_text(head + table)
    with pytest.raises(jv.InputError) as caught:
        load_study(folder / "wrong.toml")
    assert says in str(caught.value) and str(caught.value).isprintable()


def heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed


@pytest.mark.parametrize(
    "name", ["..", ".", "zarr.json", "$x^{$", "a/b", "a\\b", "a\x1b[31m", "a\nb", "a\x00b", "x" * 201, "", " ", ".seals", "__x",
             "status", "error", "sample", "drive.speed", "\u202eab", "\ud800"],
)  # fmt: skip
def test_names_that_no_folder_should_have_are_refused(name):
    with pytest.raises(jv.InputError, match=r"^measure") as caught:
        study(scene(speed=60.0), {"drive.speed": [50.0, 60.0]}, {name: Quantity("heaviness", "", heaviness)})
    assert str(caught.value).isprintable()


def test_figures_escape_words_and_units(tmp_path):
    measure = {"(m)^2 in größe": Quantity("$x^{$ and $", "$y_{$", heaviness)}
    found = jv.sweep(scene(speed=60.0), {"drive.speed": [50.0, 60.0]}, measure, tmp_path / "s.zarr")
    found.plot().savefig(tmp_path / "figure.png")
    assert found.data["(m)^2 in größe"].shape == (2,)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"axes": {"drive.speed": {"from": 1.0, "to": 2.0, "count": 10**12}}}, "axes.drive.speed.count is"),
        ({"axes": {"drive.speed": {"from": 1.0, "to": 2.0, "count": 10**400}}}, "axes.drive.speed.count is"),
        ({"samples": 2 * 10**9}, "a study has 1e+09 at most"),
        ({"samples": 10**12}, "samples is 1000000000000"),
        ({"samples": 10, "seed": 10**400}, "seed"),
        ({"samples": 10, "seed": -1}, "seed is -1"),
    ],
)
def test_counts_that_no_machine_can_hold_are_refused(given, says):
    asked = {"axes": {"drive.speed": {"from": 50.0, "to": 60.0}}, "measure": [Quantity("heaviness", "", heaviness)], **given}
    with pytest.raises(jv.InputError) as caught:
        study(scene(speed=60.0), **asked)
    assert says in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("steps", 10**12), ("steps", 10**400), ("until", 1e300)])
def test_runs_without_end_are_refused(name, value):
    asked = {"until": 2.0, name: value}
    with pytest.raises(jv.InputError, match=f"^{name} "):
        study(scene(speed=60.0), {"drive.speed": [50.0, 60.0]}, ["run.mode"], **asked)
