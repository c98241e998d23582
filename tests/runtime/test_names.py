"""Names that are imported when they are asked for."""

import ast
import pathlib
import subprocess
import sys

import pytest

import jaxvib as jv


def test_names_load_little():
    """The package alone needs nothing; a jam mode needs neither figures nor the time integrator. A user who draws nothing does
    not wait for matplotlib: only the names that draw load it."""
    names = sorted(set(jv.__all__) - {"animate", "sketch"})
    code = f"""
import sys, jaxvib
assert not {{"jax", "matplotlib", "diffrax", "pint"}} & set(sys.modules)
jaxvib.jam_modes
assert "jax" in sys.modules and not {{"matplotlib", "diffrax", "pint", "rich", "optax"}} & set(sys.modules)
[getattr(jaxvib, name) for name in {names}]
assert "matplotlib" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there():
    """The stub is the one list of names: each is found, and a type checker sees it as one that the package exports."""
    stub = ast.parse(pathlib.Path(jv.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imported = [alias for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert all(alias.name == alias.asname for alias in imported)
    assert sorted(alias.name for alias in imported) == jv.__all__ and set(jv.__all__) <= set(dir(jv))
    assert all(getattr(jv, name).__name__ for name in jv.__all__ if callable(getattr(jv, name)))
    with pytest.raises(AttributeError, match="no attribute 'jam_mode'"):
        _ = jv.jam_mode
