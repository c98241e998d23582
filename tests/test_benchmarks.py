"""Benchmarks are run by hand: what they import of the packages must be there all the same."""

import ast
import importlib
import importlib.util
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_imports_exists(path):
    """Only what belongs to the packages and to the benchmarks' own parts: what else they measure may not be installed."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ("jaxvib", "optimize"):
            module = importlib.import_module(node.module)
            for name in node.names:
                found = hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}")
                assert found, f"{path.name} imports {name.name} from {node.module}, which has none"
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("parts."):
            text = (BENCHMARKS / f"{node.module.replace('.', '/')}.py").read_text()
            body = ast.parse(text).body
            own = {item.name for item in body if isinstance(item, (ast.FunctionDef, ast.ClassDef))}
            own |= {item.target.id for item in body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)}
            own |= {t.id for item in body if isinstance(item, ast.Assign) for t in item.targets if isinstance(t, ast.Name)}
            assert {name.name for name in node.names} <= own, f"{path.name}, {node.module}"
