"""Float64, strict promotion of ranks: what a test relies on is said here, never by importing jaxvib."""

import contextlib
import functools
import gc
import importlib
import os
import pathlib
import sys

import equinox as eqx
import jax
import matplotlib
import pytest

from jaxvib.runtime import startup
from jaxvib.runtime.cpu import prepare_cpu

# Modules, those of the tests too, are compiled to bytecode once, not in every worker and every process that a test starts.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Tests change parts of the package, which the key of a stored program does not know: every program is traced anew.
startup.start = lambda: None
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Workers share what they compile, and so do clones: JAX's key of a program holds the program, the flags and the versions.
if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(home) / "jaxvib" / "tests"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
matplotlib.use("Agg")


def pytest_configure(config):
    """Each worker is a process of its own. Most of the suite's time is the compiler's, and nearly all its programs are run a
    few times only: those are compiled without LLVM's optimizations, which takes half as long and changes a number in its last
    digits. The slow tests run for long, and get the programs that users get; XLA_FLAGS=--xla_backend_optimization_level=3 gives
    them to all."""
    if "--xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", "") and config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    prepare_cpu()
    # Each run-time check that is traced asks of every frame of the stack whether its file is one of some thirty.
    with contextlib.suppress(ImportError, AttributeError):  # a JAX that does it otherwise
        frames = importlib.import_module("jax._src.traceback_util")
        frames.include_filename = functools.cache(frames.include_filename)
    # Tracing makes millions of objects that stay: looking through all of them again and again took a sixth of the suite's time.
    gc.set_threshold(100_000, 50, 100)


@pytest.fixture(autouse=True, scope="module")
def _forget():
    """A worker keeps what a module compiled no longer than the module: hundreds of programs fill gigabytes, and what a test
    finds compiled depends on no other module."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
