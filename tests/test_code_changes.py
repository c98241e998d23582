"""Programs are stored for the sources that they were traced from: edits and replacements of code in a process."""

import contextlib
import copyreg
import importlib
import inspect
import math
import os
import pathlib
import shutil
import subprocess
import sys
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib import code_changes
from jaxvib.equations import linear
from jaxvib.machine import loads
from jaxvib.machine.drives import drive
from jaxvib.numerics import fourier
from jaxvib.runtime import cache, programs, stored
from jaxvib.steady import jams
from jaxvib.steady.jams import jam
from optimize.search import find

ROOT = pathlib.Path(jv.__file__).parents[1]


@pytest.fixture
def folder(tmp_path):
    """Cache folder of a process that has not asked anything yet."""
    jam.jams_of.stored.ready.clear()
    cache.set_program_folder(tmp_path)
    yield tmp_path
    cache.set_program_folder(None)


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
    with mock.patch.object(jam, "STABILITY_CRITERION", "otherwise"):  # another thread could
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
    "a constant": changed(jam, "STABILITY_CRITERION", "not at all"),
    "a class": changed(drive, "ConstantSpeed", type("ConstantSpeed", (), {})),
    "a method": changed(loads.Loads, "position", another),
    "an inherited method": changed(drive.RunUp, "rotor_acceleration", another),
    "a property": changed(jam.JamModes, "exists", property(another)),
    "a name that hides one of Python's": changed(jam, "max", another),
    "a name that becomes another module": changed(jam, "jnp", math),
    "a submodule": changed(jams, "jam", math),
    "a function of the other package": changed(find, "descend", another),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_kind_of_replacement_is_noticed(change):
    before = code_changes.code_state(compare=True)
    assert before.is_on_disk
    with CHANGES[change]():
        within = code_changes.code_state(compare=True)
        assert not within.is_on_disk and within.number > before.number
        assert code_changes.code_state(compare=True) == within
    after = code_changes.code_state(compare=True)
    assert after.is_on_disk and after.number > within.number


def test_a_replacement_that_came_and_went_counts_too():
    """JAX may hold programs that other functions traced meanwhile."""
    before = code_changes.code_state(compare=True)
    with mock.patch.object(jam, "peak_force"):
        pass
    assert code_changes.code_state().number > before.number and code_changes.code_state().is_on_disk


@pytest.mark.parametrize(("owner", "name"), [(jam, "peak_force"), (jam.JamModes, "exists")])
def test_a_removed_definition_is_noticed(owner, name):
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(owner, name)
        assert not code_changes.code_state(compare=True).is_on_disk
    assert code_changes.code_state(compare=True).is_on_disk


def test_use_of_the_package_is_no_replacement():
    """Imports at first use, and attributes that Python adds to classes when they are asked for."""
    jv.simulate(scene("one_mass", "balls"), 0.01)
    for owner in list(code_changes._code.members):
        inspect.get_annotations(owner)
        inspect.getdoc(owner)
        with contextlib.suppress(ValueError, TypeError):  # the metaclass of Equinox has no signature of its own
            inspect.signature(owner)
        if not getattr(owner, "_is_protocol", False):  # it has no instances, and `isinstance` would require the new attribute
            copyreg._slotnames(owner)  # by copy and pickle
    assert code_changes.code_state(compare=True).is_on_disk


def test_caches_of_replaced_functions_are_emptied():
    plain = fourier.grid_of(38, symmetric=True).analysis
    with mock.patch.object(fourier, "_analysis", lambda *_: np.ones(1)):
        stored._current_code()
        assert fourier.grid_of(38, symmetric=True).analysis.shape == (1,)
    stored._current_code()
    np.testing.assert_array_equal(fourier.grid_of(38, symmetric=True).analysis, plain)


@pytest.fixture
def toy(tmp_path):
    """Write and import a module beside those of the package."""
    jv.__path__.append(str(tmp_path))
    path = tmp_path / "toy_module.py"

    def imported_as(text, seconds=None):
        path.write_text(text)
        if seconds is not None:
            os.utime(path, (seconds, seconds))
        sys.modules.pop("jaxvib.toy_module", None)
        importlib.invalidate_caches()
        code.stamps[str(path)] = code_changes._stamp(path)
        return path, importlib.import_module("jaxvib.toy_module")

    before, code = code_changes._code, code_changes._Code()
    vars(code_changes)["_code"] = code
    yield imported_as
    vars(code_changes)["_code"] = before
    sys.modules.pop("jaxvib.toy_module", None)
    vars(jv).pop("toy_module", None)
    jv.__path__.remove(str(tmp_path))


def test_an_edit_after_the_import_is_noticed(toy):
    path, _ = toy("x = 1.0\n")
    assert code_changes.code_state(compare=True).is_on_disk
    path.write_text("x = 22.0\n")
    assert not code_changes.code_state(compare=True).is_on_disk


def test_a_removed_source_is_noticed(toy):
    path, _ = toy("x = 1.0\n")
    path.unlink()
    assert not code_changes.code_state(compare=True).is_on_disk


def test_a_module_without_a_digested_source_is_in_doubt(toy):
    path, module = toy("x = 1.0\n")
    assert code_changes.code_state(compare=True).is_on_disk
    del code_changes._code.stamps[str(path)]
    code_changes.watch(module)
    assert not code_changes.code_state(compare=True).is_on_disk


def test_a_module_reloaded_is_in_doubt(toy):
    """Others hold what it defined before."""
    _, module = toy("x = 1.0\n")
    importlib.reload(module)
    assert not code_changes.code_state(compare=True).is_on_disk


def test_stale_bytecode_is_in_doubt(toy):
    """Python runs it if the source was changed within a second and has the same size."""
    _, module = toy("x = 1.0\n", seconds=1e9)
    os.utime(module.__cached__, (1e9, 1e9))
    assert code_changes.code_state(compare=True).is_on_disk
    _, module = toy("x = 2.0\n", seconds=1e9 + 0.5)
    assert module.x == 1.0 and not code_changes.code_state(compare=True).is_on_disk


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


def test_an_early_edit_reaches_the_next_process(tmp_path):
    """A process computes with the code that it imported, an edit after the import reaches later processes only."""
    for package in ("jaxvib", "optimize"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    source = tmp_path / "jaxvib" / "equations" / "linear.py"
    original = source.read_text()
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "home")}

    def ask(*edit):
        command = [sys.executable, "-c", CODE, str(tmp_path / "cache"), *edit]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        force, files = done.stdout.split()
        return float(force), int(files)

    once, files = ask(EDIT)
    assert files == 0
    assert ask() == (2.0 * once, 1)
    source.write_text(original)
    assert ask() == (once, 2)
    assert ask(EDIT) == (once, 2)  # the stored program of the original source is neither used nor replaced
    assert ask() == (2.0 * once, 2)
