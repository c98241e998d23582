"""The alias `jaxvib.optimize`."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import jaxvib
import optimize

STUB = Path(jaxvib.__file__).parent / "optimize.pyi"

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
    assert done.returncode == 1 and "not the package of jaxvib; rename that module" in done.stderr


def test_type_checkers_see_every_quantity():
    """mypy reads only the literal list `__all__` of the package; the stub names the modules of the others."""
    stub, package = (ast.parse(path.read_text(encoding="utf-8")).body for path in (STUB, Path(optimize.__file__)))
    modules = {str(node.module) for node in stub if isinstance(node, ast.ImportFrom)} - {"optimize"}
    names = ast.literal_eval(next(node.value for node in package if isinstance(node, ast.Assign)))
    assert {*names, *(name for module in modules for name in importlib.import_module(module).__all__)} == {*optimize.__all__}
