"""Settings that jaxvib makes at the first question."""

import os
import subprocess
import sys

import pytest

from jaxvib.runtime.compat import loops_need_a_flag

FLAGS = ["flags"] if loops_need_a_flag() else ["no", "flags"]
"""Output of the question below about the flags, which are set automatically if this jaxlib needs them."""

QUESTION = """
import os, warnings
warnings.simplefilter("always")
import jax
{before}
import jaxvib as jv
assert "XLA_FLAGS" not in os.environ  # nothing is set by the import alone
jv.one_mass, jv.balls
print("flags" if "loop_byte_threshold" in os.environ.get("XLA_FLAGS", "") else "no flags", jax.config.jax_compilation_cache_dir)
"""


def asked(before="", **variables):
    unset = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "JAXVIB_AUTOMATIC")
    environment = {name: value for name, value in os.environ.items() if name not in unset} | variables
    command = [sys.executable, "-c", QUESTION.format(before=before)]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True)


def test_first_public_name_prepares_cpu_and_cache(tmp_path):
    done = asked(XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.split() == [*FLAGS, str(tmp_path / "jaxvib")] and not done.stderr
    assert (tmp_path / "jaxvib" / "programs").is_dir()


def test_one_setting_switches_both_off(tmp_path):
    done = asked(XDG_CACHE_HOME=str(tmp_path), JAXVIB_AUTOMATIC="off")
    assert done.stdout.split() == ["no", "flags", "None"] and not list(tmp_path.iterdir()) and not done.stderr


@pytest.mark.skipif(not loops_need_a_flag(), reason="nothing is too late if no flags are set")
def test_who_computed_before_is_warned_once(tmp_path):
    done = asked("jax.numpy.zeros(1)", XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.split()[:2] == ["no", "flags"]
    assert done.stderr.count("UserWarning: JAX began to compute before jaxvib") == 1 and "prepare_cpu" in done.stderr
    assert done.stderr.startswith("<string>:")  # the user's line


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a folder has one owner on POSIX only")
def test_a_folder_that_is_refused_stops_nobody(tmp_path):
    (tmp_path / "jaxvib").mkdir()
    (tmp_path / "jaxvib").chmod(0o777)
    done = asked(XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.split() == [*FLAGS, "None"] and "programs are not cached" in done.stderr


def run_clean(script, folder):
    """The process of a script without settings of the environment, in which a warning is an error."""
    unset = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "JAXVIB_AUTOMATIC")
    clean = {name: value for name, value in os.environ.items() if name not in unset} | {"XDG_CACHE_HOME": str(folder)}
    return subprocess.run([sys.executable, "-W", "error", "-c", script], env=clean, capture_output=True, text=True, timeout=300)


def test_a_design_file_prepares_the_process(tmp_path):
    script = (
        "import jax, optimize; assert jax.config.jax_compilation_cache_dir is None; "
        "optimize.load_design('examples/antiphase/design.toml'); assert jax.config.jax_compilation_cache_dir is not None"
    )
    done = run_clean(script, tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_part_of_a_users_file_prepares_the_process(tmp_path):
    script = (
        f"import sys; sys.path[:] = {sys.path!r}; from plugins.drive import Turbine; "
        "Turbine(160.0, stall_torque=3.0, inertia=0.02); import jaxvib; jaxvib.balls"
    )
    done = run_clean(script, tmp_path)
    assert done.returncode == 0, done.stderr
