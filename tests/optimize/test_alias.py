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


def test_type_checkers_see_every_name():
    """A user's own optimize.py hides the package from type checkers, but not its modules, which the stub therefore names."""
    names = set()
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            assert module.__name__.startswith("optimize.")
            for alias in node.names:
                assert alias.name == "*" or (alias.asname == alias.name and hasattr(module, alias.name))
                names |= {*module.__all__} if alias.name == "*" else {alias.name}
    assert names == {*optimize.__all__}
