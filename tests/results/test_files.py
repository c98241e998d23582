"""Saved results: files that hold something else, prepared or damaged ones, and what stays while a new one is written."""

import json
import os
import zipfile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutations import mutate_result, outcome, result_outcome, seeded, zip_bomb

import jaxvib as jv
from jaxvib.errors import legible, open_regular, read_text, written
from jaxvib.results import files
from jaxvib.results.files import _decoded, _digest, _encoded

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25),
    jv.ConstantSpeed("60 rad/s"),
)
LOST = "it is not a result written by save"


@pytest.fixture(scope="module")
def modes():
    return jv.jam_modes(SCENE)


def prepared(path, layout, **arrays):
    """A file with the right digest, as somebody writes it who means harm."""
    text = layout if isinstance(layout, str) else json.dumps(layout)
    np.savez(path, result=np.asarray(text), digest=np.asarray(_digest(text, arrays)), **arrays)
    return path


ODD = [
    [], {}, None, 3, "text", [[]], {"tuple": 3}, {"dict": [1]}, {"dict": [[[1], 2]]}, {"a": 1, "b": 2}, {"text": "x"},
    {"text": "x", "double": True}, {"complex": [1]}, {"complex": ["a", 1]}, {"status": 3, "names": "n"}, {"array": "array0"},
    {"array": ["a"], "kind": "jax"}, {"array": "gone", "kind": "jax"}, {"class": 5, "entries": []},
    {"class": "jaxvib.steady.jams.jam:JamModes", "fields": []}, {"class": "jaxvib.steady.jams.jam:JamModes", "fields": 3},
    {"class": "jaxvib.steady.jams.jam:JamModes", "entries": []}, {"class": "jaxvib.motion.run:Nothing", "fields": {}},
    {"tuple": [1, 2]}, {"list": [{"class": "jaxvib:__name__", "fields": {}}]},
    {"status": "jaxvib.motion.run:Run", "names": "x"},
    '{"tuple": [' * 50_000 + "1" + "]}" * 50_000, "1" * 5000, "{", "",
]  # fmt: skip


@pytest.mark.parametrize("layout", ODD, ids=lambda layout: str(layout)[:40])
def test_odd_layouts_are_refused(tmp_path, layout):
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(prepared(tmp_path / "odd.npz", layout, x=np.asarray("done")))


@pytest.mark.parametrize(
    "name",
    [
        "jaxvib.results.files:Path", "jaxvib.runtime.stored:Path", "jaxvib.cli.app:Output", "jaxvib.runtime.stored:np",
        "jaxvib.results.files:save", "os:mkdir", "jaxvib.motion.run:Status", "tempfile:TemporaryDirectory",
        "jaxvib.errors:InputError", "jaxvib.steady.jams.jam:JamModes.__init__", "jaxvib.machine.files:tomllib",
    ],
)  # fmt: skip
def test_only_results_and_named_tuples_are_made(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for layout in ({"class": name, "entries": ["made", False]}, {"class": name, "fields": {"path": "made"}}):
        path = prepared(tmp_path / "prepared.npz", {"class": "jaxvib.motion.run:Run", "fields": {"omega": layout}})
        with pytest.raises(jv.InputError, match=LOST):
            jv.load(path)
    assert [file.name for file in tmp_path.iterdir()] == ["prepared.npz"]


def test_no_module_of_others_is_imported(tmp_path, monkeypatch):
    (tmp_path / "harmful.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(prepared(tmp_path / "x.npz", {"class": "harmful:Run", "fields": {}}))


def test_no_constructor_is_called_that_a_file_names(modes, tmp_path, monkeypatch):
    path = modes.save(tmp_path / "modes")
    monkeypatch.setattr(type(modes), "__init__", lambda *_, **__: pytest.fail("called"))
    monkeypatch.setattr(jv.Scene, "__init__", jv.Scene.__init__)  # a scene is read as its file is
    assert type(jv.load(path)) is type(modes)


def test_texts_with_control_characters_are_refused(modes, tmp_path):
    arrays = {}
    layout = _encoded(modes, arrays)
    assert type(jv.load(prepared(tmp_path / "x.npz", layout, **arrays))) is type(modes)
    layout["fields"]["omega"] = {"list": ["a\x1b[31m"]}
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(prepared(tmp_path / "x.npz", layout, **arrays))


class Mine(NamedTuple):
    """Class of a user."""

    number: float


@pytest.mark.parametrize("value", ["a\u2028b", {"a\x07": 1.0}, np.asarray(["a", "b\x1b"]), (np.str_("a\u202eb"),)])
def test_save_refuses_texts_that_load_refuses(value):
    with pytest.raises(jv.InputError, match=r"result contains the control character .*, which cannot be saved; delete it"):
        _encoded(value, {})


def test_save_refuses_classes_that_load_refuses():
    with pytest.raises(jv.InputError, match="result contains an object of the class Mine, which cannot be saved; save the"):
        _encoded({"a": Mine(1.0)}, {})


@pytest.mark.parametrize(
    "value",
    [
        (1, 2.5, "a", None, True, -0.0, 3 + 4j),
        [1, [2, (3,)]],
        {"a": 1, "b": [3.0]},
        (np.float32(1.5), np.int64(3), np.bool_(True), np.str_("é"), np.arange(3, dtype=np.uint8), np.asarray(["ab", "c"])),
        (jnp.arange(3), jnp.ones(2, jnp.float32), jnp.asarray(1 + 2j), jnp.zeros((0, 3)), np.asfortranarray(np.ones((2, 3)))),
    ],
)
def test_values_keep_their_types_and_bits(value):
    arrays = {}
    again = _decoded(json.loads(json.dumps(_encoded(value, arrays))), arrays)
    ours, theirs = jax.tree.leaves(value), jax.tree.leaves(again)
    assert jax.tree.structure(value) == jax.tree.structure(again)
    for mine, its in zip(ours, theirs, strict=True):
        assert type(mine) is type(its) and getattr(mine, "dtype", 0) == getattr(its, "dtype", 0)
        assert np.asarray(mine).tobytes() == np.asarray(its).tobytes()


def test_keys_keep_their_types():
    value, arrays = {"a": 1, ("b", 2): [3.0], 4: None, None: 5}, {}
    assert _decoded(json.loads(json.dumps(_encoded(value, arrays))), arrays) == value


def test_what_no_file_can_hold_is_refused_before_writing(tmp_path, modes):
    for value in (np.asarray([None]), jnp.ones(2, jnp.bfloat16), object()):
        with pytest.raises(jv.InputError, match="which cannot be saved"):
            _encoded(value, {})


@pytest.mark.parametrize("path", [".", "..", "/", "folder/.."])
def test_paths_without_the_name_of_a_file_are_refused(modes, path):
    with pytest.raises(jv.InputError, match=r"^path is '.*', which is a folder; name a file in it$"):
        modes.save(path)


def test_a_changed_array_is_refused(modes, tmp_path):
    path = modes.save(tmp_path / "modes")
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = next(name for name, array in arrays.items() if array.dtype == float and array.size)
    np.savez(path, **{**arrays, name: arrays[name] + 1.0})
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(path)
    np.savez(path, **arrays)
    assert type(jv.load(path)) is type(modes)
    np.savez_compressed(path, **arrays)
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(path)


def test_one_compressed_entry_is_refused(modes, tmp_path):
    path = modes.save(tmp_path / "modes")
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    for packed in entries:
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in entries.items():
                archive.writestr(name, content, zipfile.ZIP_DEFLATED if name == packed else zipfile.ZIP_STORED)
        with pytest.raises(jv.InputError, match=LOST):
            jv.load(path)


def test_a_zip_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("unpacked"))
    path = tmp_path / "bomb.npz"
    zip_bomb(path, 1 << 28)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(jv.InputError, match=LOST):
        jv.load(path)


def test_headers_that_promise_more_than_there_is_are_refused(tmp_path):
    for shape, kind in (((1 << 40,), "<f8"), ((3,), "|O"), ((1 << 40,), "|V0"), ((-1,), "<f8"), ((2,), "<U1000000000")):
        path = tmp_path / "header.npz"
        with zipfile.ZipFile(path, "w") as archive, archive.open("result.npy", "w") as entry:
            np.lib.format.write_array_header_2_0(entry, {"descr": kind, "fortran_order": False, "shape": shape})
        with pytest.raises(jv.InputError, match=LOST):
            jv.load(path)


def test_a_pipe_into_which_something_writes_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    writer = os.open(tmp_path / "pipe", os.O_RDWR)
    try:
        with pytest.raises(OSError, match="a folder, a pipe or a device, not a file"):
            open_regular(tmp_path / "pipe")
    finally:
        os.close(writer)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)])
def test_pipes_folders_and_devices_are_refused_at_once(tmp_path, make):
    path = tmp_path / "x.npz"
    make(path)
    for ask in (jv.load, jv.load_scene, jv.open_sweep, lambda p: read_text(p, "a file")):
        assert outcome(lambda ask=ask: ask(path))[0] == "refused"


def test_texts_of_more_than_16_mb_are_refused(tmp_path):
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate((1 << 24) + 1)
    with pytest.raises(jv.InputError, match="is larger than 16 MB; give the path of a TOML file"):
        jv.load_scene(path)


def test_a_text_of_the_allowed_size_is_read_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("0123456789")
    assert read_text(path, "a file", max_bytes=10) == "0123456789"
    with pytest.raises(jv.InputError, match="is larger than 0 MB; give the path of a file"):
        read_text(path, "a file", max_bytes=9)


def test_control_characters_never_reach_a_message(tmp_path):
    path = tmp_path / "x.toml"
    for text in ('"a\\u001b[31m" = 1', 'machine = "\\u009b31m"', '[machine]\nkind = "\\u202e"'):
        path.write_text(text)
        with pytest.raises(jv.InputError, match="contains the control character") as caught:
            jv.load_scene(path)
        assert str(caught.value).isprintable()
    error = jv.InputError("a\x1b]0;x\x07" + "b" * 5000, "is \x9b31m\n\u202e " + "c" * 9999 + "; " + "d " * 5000)
    assert str(error).isprintable() and len(error.field) < 400 and len(str(error)) < 2500
    assert legible("50 µm, größer, 真") == "50 µm, größer, 真"


def test_a_failed_save_leaves_the_old_file_whole(modes, tmp_path, monkeypatch):
    path = tmp_path / "modes.npz"
    path.write_bytes(b"old")
    with path.open("rb") as old:  # a process that reads the old file meanwhile reads all of it
        modes.save(path)
        assert old.read() == b"old"
    before = path.read_bytes()

    def half(file, **arrays):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.np, "savez", half)
    with pytest.raises(jv.InputError, match="cannot be written"):
        modes.save(path)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["modes.npz"]


def test_links_are_written_through_and_devices_stay(tmp_path):
    (tmp_path / "old.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("old.txt")
    with written(tmp_path / "link.txt") as part:
        part.write_text("new")
    assert (tmp_path / "old.txt").read_text() == "new" and (tmp_path / "link.txt").is_symlink()
    with written(tmp_path / "link.txt") as part:
        assert (tmp_path / "old.txt").read_text() == "new"
        part.write_text("newer")
    with pytest.raises(jv.InputError, match="cannot be written"), written(tmp_path / "none" / "x.txt") as part:
        part.write_text("")
    os.mkfifo(tmp_path / "pipe")
    with written(tmp_path / "pipe") as part:
        assert part == tmp_path / "pipe"


def test_mutated_results_are_refused_or_what_was_saved(modes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kinds = []

    def alike(found):
        for mine, its in zip(jax.tree.leaves(found), jax.tree.leaves(modes), strict=True):
            assert np.asarray(mine).tobytes() == np.asarray(its).tobytes()

    for seed in range(150):
        path = modes.save(tmp_path / "modes")
        kind, said = result_outcome(path, mutate_result(path, seeded(seed)), alike)
        kinds.append(kind)
        assert kind in ("refused", "accepted"), (seed, said)
    assert kinds.count("refused") > 100
