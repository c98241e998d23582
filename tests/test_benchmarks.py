"""Benchmarks are run by hand: what they import of the packages must be there all the same."""

import ast
import importlib
import importlib.util
import os
import signal
import time
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def mutants(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS / "trials"))
    return importlib.import_module("mutants")


def own_file(importer: Path, module: str) -> Path | None:
    """Return the file of a module of the benchmarks, which is searched beside the importer and in their main folder."""
    files = [folder / f"{module.replace('.', '/')}.py" for folder in (importer.parent, BENCHMARKS)]
    return next((file for file in files if file.exists()), None)


def bound_names(item: ast.stmt) -> set[str]:
    """Return the names that a statement of a module binds."""
    if isinstance(item, (ast.FunctionDef, ast.ClassDef)):
        return {item.name}
    imported = {each.asname or each.name for each in ast.walk(item) if isinstance(each, ast.alias)}
    return imported | {each.id for each in ast.walk(item) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)}


@pytest.mark.parametrize("path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_imports_exists(path):
    """Only what belongs to the packages and to the benchmarks' own parts: what else they measure may not be installed."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ("jaxvib", "optimize"):
            module = importlib.import_module(node.module)
            for name in node.names:
                found = hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}")
                assert found, f"{path.name} imports {name.name} from {node.module}, which has none"
        source = own_file(path, node.module) if isinstance(node, ast.ImportFrom) and node.module else None
        if source is not None:
            own = {name for item in ast.parse(source.read_text()).body for name in bound_names(item)}
            assert {name.name for name in node.names} <= own, f"{path.name}, {node.module}"


def test_tests_of_a_mutant_end_at_their_wall_time(mutants, tmp_path):
    begun = time.monotonic()
    assert mutants.in_process(os.system, "sleep 100", log=tmp_path / "log", wall=3.0) == -signal.SIGKILL
    assert time.monotonic() - begun < 60.0
    assert mutants.in_process(os.system, "exit 0", log=tmp_path / "log", wall=60.0) == 0


def test_mutants_that_were_not_run_are_reported(mutants, capsys):
    drawn, fates = mutants.drawn(4, 0, ["jaxvib/units"]), {}

    def run(mutant, left):
        assert 0.0 < left <= 0.5
        time.sleep(0.3)
        fates[mutant.name] = {"fate": "survived" if fates else "killed", "seconds": 0.3}

    mutants.run_until(time.monotonic() + 0.5, drawn, run, 1)
    mutants.report(drawn, fates)
    assert list(fates) == [mutant.name for mutant in drawn[:2]]
    shown = capsys.readouterr().out.splitlines()
    assert f"  survived: {drawn[1].name}" in shown and "2 mutants, 1 killed; survivors:" in shown
    begin = shown.index("2 mutants were not run; the same call with more --minutes runs them:")
    assert shown[begin + 1 :] == [f"  {mutant.name}" for mutant in drawn[2:]]
