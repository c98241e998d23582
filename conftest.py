"""Float64, strict promotion of ranks: what a test relies on is said here, never by importing jaxvib."""

import pathlib

import equinox as eqx
import jax
import matplotlib
import pytest

from jaxvib.backend import prepare_cpu

# Each worker is a process of its own: what is set here is heard.
prepare_cpu()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Workers share what they compile, and a second run of the tests finds it.
jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(__file__).parent / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
matplotlib.use("Agg")


@pytest.fixture(autouse=True, scope="module")
def _forget():
    """A worker keeps what a module compiled no longer than the module: hundreds of programs fill gigabytes."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
