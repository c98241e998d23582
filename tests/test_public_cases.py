"""Public-style cases of `benchmarks/trials` against closed forms and SciPy."""

import pathlib
import subprocess
import sys

import pytest

SCRIPT = pathlib.Path(__file__).parents[1] / "benchmarks" / "trials" / "public" / "compare.py"


SLOW = {"jams": 15, "motion": 23, "exciters": 24}


@pytest.mark.parametrize(
    "kind, least",
    [("frequencies", 18), *(pytest.param(kind, least, marks=pytest.mark.slow) for kind, least in SLOW.items())],
)
def test_public_cases_agree_with_their_reference(kind, least):
    done = subprocess.run([sys.executable, SCRIPT, kind], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    count = int(done.stdout.splitlines()[-1].split()[0])
    assert count >= least
