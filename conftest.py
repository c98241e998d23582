"""Float64, strict promotion of ranks: what a test relies on is said here, never by importing jaxvib."""

import contextlib
import gc
import hashlib
import importlib
import os
import pathlib
import shutil
import sys
import threading
import unittest.mock

import equinox as eqx
import jax
import matplotlib
import pytest

from jaxvib import code_changes
from jaxvib.runtime import startup
from jaxvib.runtime.cache import program_folder, set_program_folder
from jaxvib.runtime.cpu import prepare_cpu
from jaxvib.runtime.stored import _functions, _sources

# Modules, those of the tests too, are compiled to bytecode once, not in every worker and every process that a test starts.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
with pytest.MonkeyPatch.context() as environment:  # what it does is done here
    environment.setenv("JAXVIB_AUTOMATIC", "off")
    startup.start()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Workers share what they trace and compile, and so do clones: keys of programs hold the sources, the flags and the versions.
home = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "jaxvib" / "tests"
if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    jax.config.update("jax_compilation_cache_dir", str(home))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
PROGRAMS = home / "programs" / hashlib.sha256(_sources().encode()).hexdigest()[:16]
"""The traced programs of these sources; those of the last three others are kept beside them, 50 MB each."""
matplotlib.use("Agg")


def pytest_configure(config):
    """Prepare the compiler in each worker, which is a process of its own, with the flags that users get."""
    prepare_cpu()
    with contextlib.suppress(OSError):  # a home that cannot be written to, other tests that remove the same
        PROGRAMS.mkdir(parents=True, exist_ok=True)
        os.utime(PROGRAMS)
        folders = (place for place in PROGRAMS.parent.iterdir() if place.is_dir())
        for old in sorted(folders, key=lambda place: place.stat().st_mtime)[:-4]:
            shutil.rmtree(old)
    # JAX makes a context of MLIR, with all its dialects, for each program that it lowers: a sixth of the suite's time. One that
    # is in use, by a program within which another one is lowered, is left alone.
    with contextlib.suppress(ImportError, AttributeError):
        mlir = importlib.import_module("jax._src.interpreters.mlir")
        made, held, context = mlir.make_ir_context, threading.local(), mlir.ir.Context

        def make_ir_context():
            with contextlib.suppress(ValueError):  # there is none
                if context.current is not None:
                    return made()
            if not hasattr(held, "context"):
                held.context = made()
            return held.context

        mlir.make_ir_context = make_ir_context
    # Tracing makes millions of objects that stay: looking through all of them again and again took a sixth of the suite's time.
    gc.set_threshold(100_000, 50, 100)


@pytest.fixture(autouse=True, scope="module")
def _stored():
    """A worker keeps what a module compiled no longer than the module: hundreds of programs fill gigabytes, and what a test
    finds compiled depends on no other module."""
    set_program_folder(PROGRAMS)
    yield
    set_program_folder(None)
    for function in _functions:
        function.ready.clear()
    eqx.clear_caches()
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _stored_again():
    """Restore the folder of programs that a test changes."""
    folder = program_folder()
    yield
    set_program_folder(folder)


class _Patch(pytest.MonkeyPatch):
    """Patches of a test; from its first patch of the package on the test stores no program and finds none: their keys do not
    know of such changes. Another folder, another environment are none."""

    def setattr(self, *change, **how):
        self._unknown()
        super().setattr(*change, **how)

    def delattr(self, *change, **how):
        self._unknown()
        super().delattr(*change, **how)

    def setitem(self, *change):
        self._unknown()
        super().setitem(*change)

    def _unknown(self):
        if program_folder() == PROGRAMS:
            set_program_folder(None)


@pytest.fixture
def unwatched():
    """Store programs although the test replaces a part of the package: the test is about storing, not about physics."""
    with unittest.mock.patch.object(code_changes._code, "differences", list):
        yield


@pytest.fixture
def monkeypatch():
    patch = _Patch()
    yield patch
    patch.undo()
