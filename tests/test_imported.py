"""Programs are stored for the sources that they were traced from: edits and replacements of code in a process."""

import contextlib
import functools
import importlib
import os
import pathlib
import shutil
import subprocess
import sys
from unittest import mock

import jax.numpy as jnp
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib import imported
from jaxvib.equations import linear
from jaxvib.machine import drive, loads
from jaxvib.machine.effects import registry
from jaxvib.runtime import cache, programs
from jaxvib.steady.jams import jam

ROOT = pathlib.Path(jv.__file__).parents[1]


@pytest.fixture
def folder(tmp_path):
    """Of a process that has asked nothing yet."""
    jam.jams_of.stored.ready.clear()
    cache.keep_programs(tmp_path)
    yield tmp_path
    cache.keep_programs(None)


def force():
    return float(jv.jam_modes(scene("two_mass", "balls")).foundation_force[2])


def stored_files(folder):
    return [path.name for path in folder.glob("jams_of-*")]


def doubled():
    plain = jam.peak_force
    return mock.patch.object(jam, "peak_force", lambda *args: 2.0 * plain(*args))


def test_a_replaced_function_is_neither_stored_nor_ignored(folder):
    with doubled():
        twice = force()
    assert not stored_files(folder)
    once = force()
    assert twice == 2.0 * once and len(stored_files(folder)) == 1
    with doubled():
        assert force() == twice
    assert force() == once
    jam.jams_of.stored.ready.clear()
    with doubled():  # what is on disk does not answer either
        assert force() == twice
    assert len(stored_files(folder)) == 1


def replaces(x):
    with mock.patch.object(jam, "JUDGED", "otherwise"):  # another thread could
        return x + 1.0


def test_what_was_replaced_while_tracing_is_not_stored(folder):
    assert float(programs.cached(replaces)(jnp.asarray(1.0))) == 2.0
    assert not list(folder.iterdir())


def changed(owner, name, value):
    @contextlib.contextmanager
    def change():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(owner, name, value, raising=False)
            yield

    return change


def another(self, *args):
    return NotImplemented


CHANGES = {
    "a function": changed(linear, "peak_force", another),
    "an imported function": changed(jam, "peak_force", another),
    "a constant": changed(jam, "JUDGED", "not at all"),
    "a class": changed(drive, "ConstantSpeed", type("ConstantSpeed", (), {})),
    "a method": changed(loads.Loads, "position", another),
    "an inherited method": changed(drive.RunUp, "rotor_acceleration", another),
    "a property": changed(jam.JamModes, "exists", property(another)),
    "the code of a function": changed(linear.peak_force, "__code__", another.__code__),
    "the code of a cached function": changed(jam.jams_of.__wrapped__, "__code__", (lambda scene: None).__code__),
    "the code of a property": changed(jam.JamModes.exists.fget, "__code__", (lambda self: None).__code__),
    "a default": changed(jam.jam_at, "__defaults__", (1.0, None)),
    "a name that hides one of Python's": changed(jam, "max", another),
    "an entry of a registry": functools.partial(mock.patch.dict, registry.EFFECTS, {"gravity": None}),
    "a function of JAX": changed(jnp, "sin", another),
    "a function within JAX": changed(jnp.linalg, "solve", another),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_kind_of_replacement_is_noticed(change):
    before = imported.code_state(look=True)
    assert before.is_on_disk
    with CHANGES[change]():
        within = imported.code_state(look=True)
        assert not within.is_on_disk and within.number > before.number
        assert imported.code_state(look=True) == within
    after = imported.code_state(look=True)
    assert after.is_on_disk and after.number > within.number


def test_a_replacement_that_came_and_went_counts_too():
    """What other functions traced meanwhile may be held by JAX."""
    before = imported.code_state(look=True)
    with mock.patch.object(jam, "peak_force"):
        pass
    assert imported.code_state().number > before.number and imported.code_state().is_on_disk


def test_a_new_name_is_no_replacement():
    before = imported.code_state(look=True)
    with mock.patch.object(jam, "of_a_test", 1.0, create=True):
        assert imported.code_state(look=True).is_on_disk
    assert before.is_on_disk


@pytest.fixture
def toy(tmp_path):
    """Writes and imports a module that the finder of jaxvib's modules finds, beside the package."""
    jv.__path__.append(str(tmp_path))
    noted = imported._Imports()

    def imported_as(text, seconds=None):
        path = tmp_path / "toy_of_a_test.py"
        path.write_text(text)
        if seconds is not None:
            os.utime(path, (seconds, seconds))
        sys.modules.pop("jaxvib.toy_of_a_test", None)
        importlib.invalidate_caches()
        return path, importlib.import_module("jaxvib.toy_of_a_test")

    with mock.patch.object(imported, "_imports", noted):
        yield imported_as, noted
    sys.modules.pop("jaxvib.toy_of_a_test", None)
    jv.__path__.remove(str(tmp_path))


def test_a_source_edited_after_its_import_is_noticed(toy):
    imported_as, noted = toy
    path, _ = imported_as("x = 1.0\n")
    assert noted.look({str(path): imported._stamp(path)}).is_on_disk
    path.write_text("x = 22.0\n")
    assert not noted.look({str(path): imported._stamp(path)}).is_on_disk
    assert not noted.look({}).is_on_disk


def test_a_module_imported_twice_is_in_doubt(toy):
    """Others hold what it defined before."""
    imported_as, noted = toy
    imported_as("x = 1.0\n")
    path, _ = imported_as("x = 22.0\n")
    assert not noted.look({str(path): imported._stamp(path)}).is_on_disk


def test_stale_bytecode_is_not_taken(toy):
    """Python takes it if the source was changed within a second and has the same size."""
    imported_as, noted = toy
    _, module = imported_as("x = 1.0\n", seconds=1e9)
    os.utime(module.__cached__, (1e9, 1e9))
    noted.definitions.clear()
    path, module = imported_as("x = 2.0\n", seconds=1e9 + 0.5)
    assert module.x == 2.0
    assert noted.look({str(path): imported._stamp(path)}).is_on_disk


CODE = """
import pathlib, sys
import jax

jax.config.update("jax_enable_x64", True)
import jaxvib as jv

jv.use_cache(sys.argv[1])
from jaxvib.equations import linear

if len(sys.argv) > 2:
    file = pathlib.Path(linear.__file__)
    file.write_text(file.read_text() + sys.argv[2])
machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=10.0)
balls = jv.balls(count=2, mass=0.5, radius=0.1, drag=0.1)
found = jv.jam_modes(jv.Scene(machine, balls, jv.ConstantSpeed(100.0))).foundation_force[0]
print(float(found), len(list(pathlib.Path(sys.argv[1], "programs").glob("jams_of-*"))))
"""

EDIT = """
_peak_force = peak_force


def peak_force(*args):
    return 2.0 * _peak_force(*args)
"""


def test_an_edit_before_the_first_question_reaches_the_next_process(tmp_path):
    """The first process computes with the code that it imported, which is no longer that of the sources."""
    for package in ("jaxvib", "optimize"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "home")}

    def ask(*edit):
        command = [sys.executable, "-c", CODE, str(tmp_path / "cache"), *edit]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        force, files = done.stdout.split()
        return float(force), int(files)

    once, files = ask(EDIT)
    assert files == 1  # with the key of the sources before the edit
    assert ask() == (2.0 * once, 2)
