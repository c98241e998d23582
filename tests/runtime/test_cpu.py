"""The CPU's flags."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv


@pytest.mark.parametrize("name", ["arctan", "arctan2", "arcsin", "sin", "cosh", "exp", "log", "expm1", "log1p", "cbrt", "tanh"])
def test_functions_of_long_arrays_are_right_under_the_flags(name):
    """A code generator of XLA with vectors of 512 bits gave 0 for the arctangent of 64 numbers and more."""
    x = np.linspace(0.01, 0.99, 1000)
    given = (x, x[::-1]) if name == "arctan2" else (x,)
    found = jax.jit(getattr(jnp, name))(*given)
    np.testing.assert_allclose(found, getattr(np, name)(*given), rtol=1e-13)


def test_prepare_cpu_sets_flags_first_and_warns_if_late():
    code = """
import os, jaxvib as jv
os.environ["XLA_FLAGS"] = "--xla_cpu_prefer_vector_width=256"
flags = jv.prepare_cpu(3)
from jaxvib.runtime.compat import loops_need_a_flag
assert ("loop_byte_threshold=1000000000" in flags) == loops_need_a_flag()
assert flags.count("vector_width") == 1 and flags == jv.prepare_cpu(3)
import jax
assert len(jax.devices()) == 3
jax.numpy.zeros(1)
try:
    jv.prepare_cpu()
except jv.InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "prepare_cpu was called after JAX had begun to compute" in done.stdout
    with pytest.raises(jv.InputError, match="devices is 0"):
        jv.prepare_cpu(0)


def test_newer_jax_gets_no_flags_automatically():
    code = """
import os
os.environ.pop("XLA_FLAGS", None)
os.environ.pop("JAXVIB_AUTOMATIC", None)
from jaxvib.runtime import compat
compat._jaxlib_version = lambda: (0, 12)
import jaxvib as jv
jv.balls
assert "XLA_FLAGS" not in os.environ
assert "loop_byte_threshold" not in jv.prepare_cpu()
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_linear_algebra_uses_one_thread_unless_set():
    code = """
import os
os.environ.pop("OPENBLAS_NUM_THREADS", None)
import jaxvib as jv
jv.balls
assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
os.environ["OPENBLAS_NUM_THREADS"] = "2"
jv.prepare_cpu()
assert os.environ["OPENBLAS_NUM_THREADS"] == "2"
"""
    subprocess.run([sys.executable, "-c", code], check=True)
