"""The processor's flags."""

import subprocess
import sys

import pytest

import jaxvib as jv


def test_prepare_cpu_sets_flags_before_anything_else_and_says_when_it_is_late():
    code = """
import os, jaxvib as jv
os.environ["XLA_FLAGS"] = "--xla_cpu_prefer_vector_width=256"
flags = jv.prepare_cpu(3)
assert "loop_byte_threshold=1000000000" in flags and flags.count("vector_width") == 1 and flags == jv.prepare_cpu(3)
import jax
assert len(jax.devices()) == 3
jax.numpy.zeros(1)
try:
    jv.prepare_cpu()
except jv.InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "prepare_cpu comes too late" in done.stdout
    with pytest.raises(jv.InputError, match="devices is 0"):
        jv.prepare_cpu(0)
