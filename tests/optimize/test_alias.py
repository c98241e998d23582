"""The alias `jaxvib.optimize`."""

import subprocess
import sys

SCRIPT = """
from jaxvib.optimize import DesignSpace
import optimize
assert optimize.DesignSpace is DesignSpace
"""


def test_alias_is_not_hidden_by_a_users_module(tmp_path):
    (tmp_path / "optimize.py").write_text("own = True\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, check=True, timeout=120)
    clash = [sys.executable, "-c", "import optimize; from jaxvib.optimize import DesignSpace"]
    done = subprocess.run(clash, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "not the package of jaxvib; import jaxvib.optimize before it" in done.stderr
