"""Float64, strict promotion of ranks: what a test relies on is said here, never by importing jaxvib."""

import pathlib

import jax
import matplotlib

from jaxvib.backend import prepare_cpu

# Each worker is a process of its own: what is set here is heard.
prepare_cpu()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Workers share what they compile, and a second run of the tests finds it.
jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(__file__).parent / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
matplotlib.use("Agg")
