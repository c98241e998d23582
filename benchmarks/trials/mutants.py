"""How much of a changed equation do the tests see?

    python benchmarks/trials/mutants.py --count 300 --out out/mutants
    python benchmarks/trials/mutants.py --count 100 --only optimize ode

A mutant is the package with one change in one line: a sign, a factor, an index, a comparison, a sine in place of a cosine, a
smaller in place of a larger. Mutants are drawn from `jaxvib/equations`, `steady`, `motion` and `ode` and from `optimize`, or
from `--only` some of these with their tests alone, from every file in proportion to the changes it allows and at least one, by
a seed and the file's name: a change of one file leaves the mutants of others as they were. Each is given to the tests that
reach its line, those of its own name first, then of its folder, then the shortest, up to `--seconds` of them by their usual
time; the first test that fails ends it. Which test reaches which line is measured once, each test file in a process of its own
(`coverage`).

A mutant is killed when a test fails, when the tests take three times their usual time and a minute, or when the process dies.
What survived is printed with its change, to be explained or killed by a new test. All that is known is kept in `--out`, so
that a second call goes on where the first was stopped; `--again` runs the survivors anew, after tests were added.
"""

from __future__ import annotations

import argparse
import ast
import collections
import concurrent.futures
import copy
import dataclasses
import json
import os
import pathlib
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDERS = ("jaxvib/equations", "jaxvib/steady", "jaxvib/motion", "jaxvib/ode", "optimize")
TESTS = tuple(folder.removeprefix("jaxvib/") for folder in FOLDERS)

OPERATORS: dict[type, type] = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.MatMult: ast.Mult}
COMPARISONS: dict[type, type] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
PAIRS = (("sin", "cos"), ("minimum", "maximum"), ("min", "max"), ("argmin", "argmax"), ("any", "all"), ("real", "imag"))
CALLS = {one: other for pair in PAIRS for one, other in (pair, pair[::-1])}

FACTORS = (1e-3, 1e3)
"""Smallest and largest factor that is doubled: smaller ones are tolerances, larger ones limits of effort."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change: `old`, the text from `start` to `end` (bytes of the file), becomes `new`."""

    file: str
    line: int
    kind: str
    start: int
    end: int
    old: str
    new: str

    @property
    def name(self) -> str:
        return f"{self.file}:{self.line}:{self.start} {self.kind}: {self.old} -> {self.new}"


# --- what can be changed ---


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """All changes that a file allows, outside docstrings, annotations, messages and what is run for type checkers only."""
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, kind, changed in _changes(ast.parse(text)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        old, new = text.encode()[start:end].decode(), ast.unparse(changed)
        yield Mutant(file, node.lineno, kind, start, end, old, new if isinstance(changed, ast.Constant) else f"({new})")


def _changes(node: ast.AST, place: str = "") -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """Changes of a node and of what is in it; `place` says what a number in it is: an index, a factor, or neither."""
    if isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)):
        return
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.BinOp) and not _is_text(node):
        other = OPERATORS.get(type(node.op))
        if isinstance(node.op, ast.Pow):
            yield node, "factor", ast.BinOp(node.left, ast.Mult(), node.right)
        elif other is not None:
            yield node, "sign" if isinstance(node.op, (ast.Add, ast.Sub)) else "factor", _with(node, op=other())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        yield node, "sign", node.operand
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node, "comparison", node.operand
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield node, "comparison", _with(node, ops=[COMPARISONS[type(node.ops[0])]()])
    elif isinstance(node, ast.BoolOp):
        yield node, "comparison", _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in CALLS:
            func = _with(node.func, **{"attr" if isinstance(node.func, ast.Attribute) else "id": CALLS[name]})
            yield node, "function", _with(node, func=func)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        if place == "index":  # one past the end of a JAX array is its last one
            yield node, place, ast.Constant(node.value - 1 if node.value > 0 else 1)
        elif place == "factor" and FACTORS[0] <= abs(node.value) <= FACTORS[1]:
            yield node, place, ast.Constant(2 * node.value)
    if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
        inner = [*node.body, *(node.args.defaults if isinstance(node, ast.FunctionDef) else ())]
        children = [one for one in inner if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))]
    elif isinstance(node, ast.AnnAssign):
        children = [node.value] if node.value is not None else []
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from _changes(child, _place(node, child))


def _place(node: ast.AST, child: ast.AST) -> str:
    """A number that stands alone is a limit, a count or a default, and no part of an equation: it is left alone."""
    if isinstance(node, ast.Subscript) and child is node.slice:
        return "index"
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div, ast.Pow)):
        return "factor"
    return "factor" if isinstance(node, (ast.List, ast.Tuple)) and isinstance(node.ctx, ast.Load) else ""


def _is_text(node: ast.BinOp) -> bool:
    if isinstance(node.left, (ast.List, ast.Tuple)) or isinstance(node.right, (ast.List, ast.Tuple)):
        return True
    parts = [part for side in (node.left, node.right) for part in ast.walk(side)]
    return any(
        isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str)) for part in parts
    )


def _with(node: ast.AST, **fields) -> ast.expr:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def drawn(count: int, seed: int, reached: dict[str, set[int]], only: Sequence[str]) -> tuple[list[Mutant], dict[str, int]]:
    """`count` mutants on lines that a test reaches, and how many changes there are on reached and on other lines."""
    folders = [folder for folder, name in zip(FOLDERS, TESTS, strict=True) if name in only]
    files = sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))
    possible, total = {}, collections.Counter()
    for path in files:
        file = str(path.relative_to(ROOT))
        found = list(mutants(file, path.read_text()))
        inside = [one for one in found if one.line in reached.get(file, ())]
        total["reached"] += len(inside)
        total["not reached"] += len(found) - len(inside)
        if inside:
            possible[file] = random.Random(f"{seed} {file}").sample(inside, len(inside))
    share = {file: max(1, round(count * len(found) / total["reached"])) for file, found in possible.items()}
    taken = [one for file, found in possible.items() for one in found[: share[file]]]
    random.Random(seed).shuffle(taken)
    return taken, dict(total)


# --- which test reaches which line ---


def reach(out: pathlib.Path, workers: int, only: Sequence[str]) -> dict[str, dict]:
    """For each test file its seconds and the lines it reaches in each file of the package."""
    kept = out / "reach.json"
    known = json.loads(kept.read_text()) if kept.exists() else {}
    tests = sorted(str(path.relative_to(ROOT)) for folder in only for path in (ROOT / "tests" / folder).rglob("test_*.py"))

    def one(test: str) -> None:
        data = out / f"{pathlib.Path(test).stem}.coverage"
        report = data.with_suffix(".json")
        environment = {**os.environ, "COVERAGE_FILE": str(data)}
        coverage = [sys.executable, "-m", "coverage"]
        command = [*coverage, "run", "--source=jaxvib,optimize", "-m", "pytest", "-p", "no:cacheprovider", test]
        began = time.perf_counter()
        result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        seconds = time.perf_counter() - began
        if result.returncode != 0:
            raise SystemExit(f"{test} fails without a change:\n{result.stdout[-3000:]}")
        command = [*coverage, "json", "-q", "-o", str(report)]
        subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
        files = json.loads(report.read_text())["files"]
        lines = {file: sorted(entry["executed_lines"]) for file, entry in files.items() if file.startswith(FOLDERS)}
        known[test] = {"seconds": seconds, "lines": {file: found for file, found in lines.items() if found}}
        kept.write_text(json.dumps(known))
        data.unlink()
        report.unlink()
        print(f"{len(known):3} of {len(tests)} {seconds:6.1f} s {test}", flush=True)

    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, [test for test in tests if test not in known]))
    return known


def tests_of(mutant: Mutant, known: dict[str, dict], seconds: float) -> tuple[list[str], float]:
    """The tests to run and their usual time: the file's own first, then its folder's, then the shortest, up to `seconds`."""
    place = pathlib.Path(mutant.file.removeprefix("jaxvib/"))
    folder = place.parent

    def order(test: str) -> tuple[bool, int, float]:
        own = pathlib.Path(test).parent.relative_to("tests")
        common = [one == other for one, other in zip(folder.parts, own.parts, strict=False)]
        return pathlib.Path(test).stem != f"test_{place.stem}", -sum(common), known[test]["seconds"]

    reaching = sorted((test for test, entry in known.items() if mutant.line in entry["lines"].get(mutant.file, ())), key=order)
    taken, usual = [], 0.0
    for test in reaching:
        if not taken or usual + known[test]["seconds"] <= seconds:
            taken.append(test)
            usual += known[test]["seconds"]
    if ">>>" in (ROOT / mutant.file).read_text():
        taken.insert(0, mutant.file)
    return taken, usual


# --- what the tests see ---


def tried(mutant: Mutant, copy_of: pathlib.Path, known: dict[str, dict], seconds: float) -> dict:
    """The mutant's fate: "killed", "slow" (too slow, killed), "died" (the process did), "survived"."""
    path = copy_of / mutant.file
    whole = path.read_bytes()
    taken, usual = tests_of(mutant, known, seconds)
    began = time.perf_counter()
    try:
        path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
        command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *taken]
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(copy_of)}
        result = subprocess.run(
            command, cwd=copy_of, env=environment, capture_output=True, text=True, timeout=3 * usual + 60, errors="replace"
        )
        fate = {0: "survived", 1: "killed", 2: "killed"}.get(result.returncode, "died")
        last = [line for line in result.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        by = last[0][:200] if last else ""
    except subprocess.TimeoutExpired:
        fate, by = "slow", ""
    finally:
        path.write_bytes(whole)
    return {"fate": fate, "by": by, "seconds": round(time.perf_counter() - began, 1), "tests": taken}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=300, help="mutants to draw (300)")
    parser.add_argument("--seed", type=int, default=0, help="which ones (0)")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time (2)")
    parser.add_argument("--seconds", type=float, default=180.0, help="tests a mutant is given, by their usual time (180)")
    parser.add_argument("--only", nargs="+", choices=TESTS, default=TESTS, help="folders to draw from (all)")
    parser.add_argument("--again", action="store_true", help="run the survivors anew")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/mutants"), help="folder of what is known")
    asked = parser.parse_args()
    out = asked.out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    known = reach(out, asked.workers, asked.only)
    reached = collections.defaultdict(set)
    for entry in known.values():
        for file, lines in entry["lines"].items():
            reached[file].update(lines)
    taken, total = drawn(asked.count, asked.seed, reached, asked.only)
    kept = out / "fates.json"
    fates = json.loads(kept.read_text()) if kept.exists() else {}
    if asked.again:
        fates = {name: fate for name, fate in fates.items() if fate["fate"] != "survived"}
    copies = [out / f"copy{k}" for k in range(asked.workers)]
    for place in copies:
        shutil.rmtree(place, ignore_errors=True)
        ignored = shutil.ignore_patterns(".git", ".venv*", "out", "__pycache__")
        shutil.copytree(ROOT, place, ignore=ignored)
    free = collections.deque(copies)

    def one(mutant: Mutant) -> None:
        place = free.popleft()
        fates[mutant.name] = tried(mutant, place, known, asked.seconds)
        free.append(place)
        kept.write_text(json.dumps(fates, indent=1))
        print(f"{len(fates):4} {fates[mutant.name]['fate']:9} {fates[mutant.name]['seconds']:6.1f} s {mutant.name}", flush=True)

    with concurrent.futures.ThreadPoolExecutor(asked.workers) as pool:
        list(pool.map(one, [mutant for mutant in taken if mutant.name not in fates]))
    report(taken, fates, total)


def report(taken: list[Mutant], fates: dict[str, dict], total: dict[str, int]) -> None:
    """Killed and survived, by folder and by kind of change, and every survivor."""
    print(f"\n{total['reached']} changes are possible on lines that tests reach, {total['not reached']} on others")
    for title, key in (
        ("folder", lambda one: next(f for f in FOLDERS if one.file.startswith(f))),
        ("kind", lambda one: one.kind),
    ):
        groups = collections.defaultdict(list)
        for mutant in taken:
            groups[key(mutant)].append(fates[mutant.name]["fate"] != "survived")
        print(f"\n{title:18} mutants killed")
        for name, killed in sorted(groups.items()):
            print(f"{name:18} {len(killed):7} {sum(killed):6} {100 * sum(killed) / len(killed):5.1f} %")
    alive = [mutant for mutant in taken if fates[mutant.name]["fate"] == "survived"]
    print(f"\n{len(taken)} mutants, {len(taken) - len(alive)} killed ({100 - 100 * len(alive) / len(taken):.1f} %); survivors:")
    for mutant in sorted(alive, key=lambda one: (one.file, one.line)):
        print(f"  {mutant.name}")


if __name__ == "__main__":
    main()
