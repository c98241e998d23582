"""Stores on disk: damage is found by reading once, computed again and counted; only one sweep writes."""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.sweeps import seals
from jaxvib.sweeps.study import study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity

SCENE = scene("one_mass", "balls", speed=60.0)


def heaviness(scene):
    return scene.loads.drag * scene.drive.speed**2


AXES = {"drive.speed": {"from": 10.0, "to": 90.0, "count": 9}, "loads.drag": [0.5, 1.5, 3.0, 5.0, 8.0]}
STUDY = study(SCENE, AXES, [Quantity("heaviness", "N m/s", heaviness)], chunk=10)
SAMPLED = study(
    SCENE,
    {"drive.speed": [40.0, 60.0], "loads.drag": {"from": 1.0, "to": 2.0}},
    [Quantity("heaviness", "N m/s", heaviness)],
    samples=12,
    chunk=4,
)


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    return [pathlib.Path(run_study(each, folder / f"{k}.zarr").store) for k, each in enumerate((STUDY, SAMPLED))]


@pytest.fixture
def copy(stores, tmp_path):
    """A copy of the first store."""
    return pathlib.Path(shutil.copytree(stores[0], tmp_path / "study.zarr"))


def contents(store):
    return {path.relative_to(store): path.read_bytes() for path in store.rglob("*") if path.is_file() and path.name != "lock"}


def flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)


def a_pipe(path):
    path.unlink()
    os.mkfifo(path)


HARMS = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "flipped": flipped,
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"0"),
    "a pipe": a_pipe,
    "a link to zeros": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("array", ["heaviness", "status"])
@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_chunk_is_counted_and_computed_again(stores, copy, array, harm):
    HARMS[harm](copy / array / "c" / "1" / "0")
    seen = jv.open_sweep(copy)
    if (array, harm) != ("status", "missing"):  # a chunk without statuses and with a seal is damaged too
        assert seen.damaged == 10
    assert seen.status_name == "incomplete" and seen.counts[0] == ("missing", 10) and "run the study again" in seen.summary()
    with pytest.raises(jv.InputError, match=r"1 of 5 chunks are damaged, the first of them chunk 1; run the study again"):
        _ = seen.data
    found = run_study(STUDY, copy)
    assert found.computed == 10 and found.damaged == seen.damaged and "computed again" in found.summary()
    assert contents(copy) == contents(stores[0]) and run_study(STUDY, copy).damaged == 0


def test_chunks_that_changed_places_are_damaged(stores, copy):
    """Each of the two is whole, so that no checksum of its own tells."""
    one, other = (copy / "heaviness" / "c" / str(k) / "0" for k in (0, 1))
    one_content, other_content = one.read_bytes(), other.read_bytes()
    one.write_bytes(other_content)
    other.write_bytes(one_content)
    assert jv.open_sweep(copy).damaged == 20 and run_study(STUDY, copy).damaged == 20
    assert contents(copy) == contents(stores[0])


def test_damaged_samples_are_written_again(stores, tmp_path):
    store = pathlib.Path(shutil.copytree(stores[1], tmp_path / "study.zarr"))
    flipped(store / "loads.drag" / "c" / "2")
    found = run_study(SAMPLED, store)
    assert found.damaged > 0 and contents(store) == contents(stores[1])


def test_figures_of_a_damaged_store_are_refused(copy):
    sweep = jv.open_sweep(copy)
    flipped(copy / "heaviness" / "c" / "1" / "0")
    with pytest.raises(jv.InputError, match="chunks are damaged"):
        sweep.plot()


def layout_without(store, text):
    path = store / seals.FOLDER / "layout"
    path.write_text(text)


@pytest.mark.parametrize(
    "harm",
    [
        lambda store: (store / "zarr.json").write_text("{"),
        lambda store: (store / "zarr.json").unlink(),
        lambda store: (store / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "group"})),
        lambda store: flipped(store / "heaviness" / "zarr.json"),
        lambda store: flipped(store / "drive.speed" / "c" / "0"),
        lambda store: a_pipe(store / "status" / "zarr.json"),
        lambda store: layout_without(store, ""),
        lambda store: layout_without(store, "[" * 100_000),
        lambda store: layout_without(store, '{"files": {"../x": ""}, "digest": ""}'),
        lambda store: shutil.rmtree(store / seals.FOLDER),
    ],
)
def test_damaged_metadata_are_refused(copy, harm):
    harm(copy)
    for ask in (lambda: run_study(STUDY, copy), lambda: jv.open_sweep(copy)):
        with pytest.raises(jv.InputError, match="not the store of a sweep, or is damaged"):
            ask()


def test_a_store_of_a_long_name_is_missing():
    with pytest.raises(jv.InputError, match="there is no such store"):
        jv.open_sweep("1" * 400)


def test_what_a_killed_write_left_is_computed_again(stores, copy):
    """Numbers without statuses are cut off before the end, statuses without a seal just before it."""
    (copy / seals.FOLDER / "1").unlink()
    (copy / seals.FOLDER / "2").unlink()
    (copy / "status" / "c" / "2" / "0").unlink()
    seen = jv.open_sweep(copy)
    assert seen.counts[0] == ("missing", 20)
    assert run_study(STUDY, copy).computed == 20 and contents(copy) == contents(stores[0])


def other_versions(store):
    text = (store / "zarr.json").read_text()
    (store / "zarr.json").write_text(text.replace(f'"jax": "{jax.__version__}"', '"jax": "0.1.0"'))
    shutil.rmtree(store / seals.FOLDER)
    seals.seal_layout(store)


def test_a_store_of_other_versions_is_refused(copy):
    other_versions(copy)
    with pytest.raises(jv.InputError, match=f"created with jax 0.1.0, and this is {jax.__version__}: digits may differ"):
        run_study(STUDY, copy)


HOLD = """
import fcntl, sys
with open(sys.argv[1]) as file:
    fcntl.flock(file, fcntl.LOCK_EX)
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_sweep_says_that_the_first_runs(copy):
    """The first is another process; killed, it no longer holds the store."""
    asked = [sys.executable, "-S", "-c", HOLD, str(copy / seals.FOLDER / "lock")]
    with subprocess.Popen(asked, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "held\n"
        with pytest.raises(jv.InputError, match="into which another sweep is writing; wait until that has ended"):
            run_study(STUDY, copy)
        assert jv.open_sweep(copy).status_name == "done"
        first.kill()
        first.wait()
        assert run_study(STUDY, copy).status_name == "done"


def test_of_two_threads_one_writes(tmp_path):
    store, said = tmp_path / "study.zarr", []

    def second(progress):
        if not said:
            thread = threading.Thread(target=lambda: said.append(refused(store)))
            thread.start()
            thread.join()

    assert run_study(STUDY, store, report=second).status_name == "done"
    assert len(said) == 1 and "another sweep is writing" in said[0]


def refused(store):
    try:
        run_study(STUDY, store)
    except jv.InputError as error:
        return str(error)
    return ""


def test_two_that_begin_at_once_make_one_store(stores, tmp_path, monkeypatch):
    """Between the look at the folder and the renaming another one has made it."""
    store, real = tmp_path / "study.zarr", os.rename

    def late(part, path):
        if not pathlib.Path(path).exists():
            shutil.copytree(stores[0], path)
        real(part, path)

    monkeypatch.setattr(os, "rename", late)
    assert run_study(STUDY, store).computed == 0 and [path.name for path in tmp_path.iterdir()] == ["study.zarr"]


@pytest.mark.parametrize("workers", [True, 0, -1, 2.5, "2", 10**400, 5000])
def test_workers_that_no_machine_has_are_refused(copy, workers):
    with pytest.raises(jv.InputError, match=r"^workers is "):
        run_study(STUDY, copy, workers=workers)


def test_values_of_a_finished_store_agree_with_its_scenes(stores):
    data = jv.open_sweep(stores[0]).data
    expected = data["loads.drag"].values * data["drive.speed"].values[:, None] ** 2
    np.testing.assert_allclose(data.heaviness.values, expected, rtol=1e-15)
