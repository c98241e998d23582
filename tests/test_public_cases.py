"""Public-style cases of `benchmarks/trials` against closed forms and SciPy."""

import pathlib
import subprocess
import sys

import pytest

SCRIPT = pathlib.Path(__file__).parents[1] / "benchmarks" / "trials" / "public" / "compare.py"


@pytest.mark.parametrize(
    "kind, least",
    [("frequencies", 17), pytest.param("jams", 15, marks=pytest.mark.slow), pytest.param("motion", 23, marks=pytest.mark.slow)],
)
def test_public_cases_agree_with_their_reference(kind, least):
    done = subprocess.run([sys.executable, SCRIPT, kind], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    count = int(done.stdout.splitlines()[-1].split()[0])
    assert count >= least
