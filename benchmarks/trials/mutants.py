"""Share of changes in the packages that the tests see, folder by folder.

    python benchmarks/trials/mutants.py --count 30 --out out/mutants
    python benchmarks/trials/mutants.py --folder jaxvib/steady optimize/search --count 30 --seed 1

A mutant is the package with one change in one line:

- a sign, a factor, an index, a comparison, a sine in place of a cosine, a smaller in place of a larger
- a term of a sum, a branch of an `if` or a keyword argument of a call that is dropped
- two neighbouring arguments of a call that are swapped

Mutants are drawn from every folder of `jaxvib` and `optimize`, or from each `--folder`: `--count` in each, of all kinds alike,
in an order that follows from the seed and the change itself: a change of one file leaves the mutants of others as they were.
Each is given to the tests that reach its line, those of the file of its own name first, then of its folder, then the shortest,
up to `--seconds` of them by their usual time; the first test that fails ends it. The lines that each test reaches are measured
once for an `--out`, a process for each test file (`coverage`), which traces every program anew; with `--folder` only the test
files of these folders are measured, unless `--all-tests` is given. Take a new `--out` for changed packages.

A mutant is killed when a test fails, when the tests take three times their usual time and a minute, or when the process dies.
Survivors are printed with their changes, to be explained or killed by a new test. All results are kept in `--out`, so that a
second call goes on where the first was stopped; `--again` runs the survivors anew, after tests were added.
"""

from __future__ import annotations

import argparse
import ast
import collections
import concurrent.futures
import copy
import dataclasses
import hashlib
import itertools
import json
import os
import pathlib
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence

from coverage import Coverage, CoverageData

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = ("jaxvib", "optimize")

PYTEST = ("-m", "pytest", "-p", "no:cacheprovider", "-p", "mutants")
"""The arguments of Python that run tests with this module as a plugin."""

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

SYMMETRIC = {"minimum", "maximum", "min", "max", "hypot", "logical_and", "logical_or", "isclose", "union", "intersection"}
"""Functions whose arguments may be swapped."""

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

    @property
    def folder(self) -> str:
        """The package's folder that the file is in, or the package itself."""
        return folder_of(self.file)

    def rank(self, seed: int) -> str:
        """A random text that follows from the seed and the change, but not from its place in the file."""
        return hashlib.sha256(f"{seed} {self.file} {self.kind} {self.old} {self.new}".encode()).hexdigest()


# --- possible changes ---


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """All changes that a file allows, outside docstrings, annotations, messages and code for type checkers."""
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, kind, changed in _changes(ast.parse(text)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        old, new = text.encode()[start:end].decode(), ast.unparse(changed)
        yield Mutant(file, node.lineno, kind, start, end, old, new if isinstance(changed, ast.Constant) else f"({new})")


def _changes(node: ast.AST, place: str = "") -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """Changes of a node and of its parts; `place` tells whether a number in it is an index, a factor, or neither."""
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
        if isinstance(node.op, (ast.Add, ast.Sub)):
            yield node, "term", node.left
            yield node, "term", node.right if isinstance(node.op, ast.Add) else ast.UnaryOp(ast.USub(), node.right)
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
        yield from _calls(node, name)
    elif isinstance(node, ast.If):
        yield node.test, "branch", ast.Constant(False)
        if node.orelse:
            yield node.test, "branch", ast.Constant(True)
    elif isinstance(node, ast.IfExp):
        yield node, "branch", node.body
        yield node, "branch", node.orelse
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


def _calls(node: ast.Call, name: str) -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """The call with two neighbouring arguments swapped, and without each of its keyword arguments."""
    plain = not any(isinstance(argument, ast.Starred) for argument in node.args) and name not in SYMMETRIC
    for i, pair in enumerate(itertools.pairwise(node.args) if plain else ()):
        if ast.dump(pair[0]) != ast.dump(pair[1]):
            yield node, "argument", _with(node, args=[*node.args[:i], *pair[::-1], *node.args[i + 2 :]])
    for keyword in node.keywords:
        if keyword.arg is not None:
            yield node, "keyword", _with(node, keywords=[one for one in node.keywords if one is not keyword])


def _place(node: ast.AST, child: ast.AST) -> str:
    """ "index", "factor" or "": a number that stands alone is a limit, a count or a default and stays as it is."""
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


def drawn(
    count: int, seed: int, reached: dict[str, set[int]], folders: Sequence[str]
) -> tuple[list[Mutant], collections.Counter]:
    """`count` mutants of each folder on lines that a test reaches, and the number of changes on reached and on other lines."""
    possible, total = collections.defaultdict(list), collections.Counter()
    for file in sources():
        for one in mutants(file, (ROOT / file).read_text()):
            if one.folder in folders:
                inside = one.line in reached.get(file, ())
                total["reached" if inside else "not reached"] += 1
                if inside:
                    possible[one.folder, one.kind].append(one)
    taken = []
    for folder in folders:
        kinds = [sorted(found, key=lambda one: one.rank(seed)) for (place, _), found in possible.items() if place == folder]
        mixed = [one for row in itertools.zip_longest(*kinds) for one in row if one is not None]
        taken += mixed[:count]
    return sorted(taken, key=lambda one: one.rank(seed)), total


def sources() -> list[str]:
    """All files of the packages, relative to the root."""
    return sorted(str(path.relative_to(ROOT)) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def all_folders() -> list[str]:
    """All folders that mutants are counted by, see `Mutant.folder`."""
    return sorted({folder_of(file) for file in sources()})


def folder_of(file: str) -> str:
    """The folder that a file's mutants are counted in."""
    return "/".join(pathlib.Path(file).parent.parts[:2])


# --- tests and the lines that they reach ---


def test_files(folders: Sequence[str], everything: bool) -> list[str]:
    """The test files of folders and their own files with examples; or all.

    Test files of a folder lie in the test folder of the same name, or their own name begins with the folder's.
    """
    files = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("test_*.py"))
    examples = [file for file in sources() if ">>>" in (ROOT / file).read_text()]
    names = {folder.split("/")[0 if folder.startswith("optimize") else -1] for folder in folders}
    top = [path.stem for package in PACKAGES if package in folders for path in (ROOT / package).glob("*.py")]

    def own(file: str) -> bool:
        folder, stem = file.split("/")[1], pathlib.Path(file).stem.removeprefix("test_")
        return folder in names or stem in names or stem in top

    own_examples = [file for file in examples if everything or folder_of(file) in folders]
    return [file for file in files if everything or own(file)] + own_examples


def reach(out: pathlib.Path, workers: int, tests: Sequence[str]) -> dict[str, dict]:
    """For each test file the seconds of each test, and the tests that reach each line of the packages.

    Tests are numbered; no number means that the line runs at import, for all of them.
    """
    folder = out / "reach"
    folder.mkdir(exist_ok=True)

    def kept(test: str) -> pathlib.Path:
        return folder / f"{test.replace('/', '-')}.json"

    def one(test: str) -> None:
        data, home = kept(test).with_suffix(".coverage"), kept(test).with_suffix(".cache")
        # No traced program is read from the disk: it executes none of the lines that it was traced from.
        environment = {
            **os.environ,
            "COVERAGE_FILE": str(data),
            "XDG_CACHE_HOME": str(home),
            **_plugin(ROOT, seconds=kept(test)),
        }
        coverage = [sys.executable, "-m", "coverage", "run", f"--source={','.join(PACKAGES)}"]
        began = time.perf_counter()
        result = subprocess.run([*coverage, *PYTEST, test], cwd=ROOT, env=environment, capture_output=True, text=True)
        taken = time.perf_counter() - began
        shutil.rmtree(home, ignore_errors=True)
        if result.returncode not in (0, 5):  # 5: all of its tests are slow ones
            print(f"left out, as it fails without a change: {test}\n{result.stdout[-1000:]}", flush=True)
            return
        seconds = json.loads(kept(test).read_text()) if kept(test).exists() else {}
        numbers = {name: k for k, name in enumerate(seconds)}
        found, lines = CoverageData(str(data)), {}
        found.read()
        for file in found.measured_files():
            at = {line: [numbers[name] for name in names if name] for line, names in found.contexts_by_lineno(file).items()}
            lines[str(pathlib.Path(file).relative_to(ROOT))] = at
        kept(test).write_text(json.dumps({"tests": seconds, "lines": lines}))
        data.unlink()
        print(f"{taken:6.1f} s, {len(seconds):4} tests: {test}", flush=True)

    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, [test for test in tests if not kept(test).exists()]))
    return {test: json.loads(kept(test).read_text()) for test in tests if kept(test).exists()}


def tests_of(mutant: Mutant, known: dict[str, dict], seconds: float) -> tuple[list[str], float]:
    """The tests to run and their usual time: of the file's own name first, then of its folder, then the shortest.

    The tests that reach the line come before the others of their files, which may use a program that the first ones traced.
    """
    place = pathlib.Path(mutant.file.removeprefix("jaxvib/"))

    def order(file: str) -> tuple[bool, int, float]:
        own = pathlib.Path(file).parent.parts[1:]
        common = [one == other for one, other in zip(place.parent.parts, own, strict=False)]
        return (
            pathlib.Path(file).stem not in (f"test_{place.stem}", place.stem),
            -sum(common),
            sum(known[file]["tests"].values()),
        )

    ordered, others = [], []
    for file in sorted((file for file in known if reaches(known[file], mutant)), key=order):
        numbers = known[file]["lines"][mutant.file][str(mutant.line)]
        names = list(known[file]["tests"])
        own = [names[k] for k in numbers] or names
        ordered += sorted(own, key=known[file]["tests"].__getitem__)
        others += sorted(set(names) - set(own), key=known[file]["tests"].__getitem__)
    usual = {name: lasts for entry in known.values() for name, lasts in entry["tests"].items()}
    taken, total = [], 0.0
    for name in ordered + others:
        if not taken or total + usual[name] <= seconds:
            taken.append(name)
            total += usual[name]
    return taken, total


def reaches(entry: dict, mutant: Mutant) -> bool:
    """True if a test of the file reaches the mutant's line."""
    return bool(entry["tests"]) and str(mutant.line) in entry["lines"].get(mutant.file, ())


# --- this module as a plugin of pytest ---


def _plugin(root: pathlib.Path, **settings: object) -> dict[str, str]:
    return {"PYTHONPATH": f"{root}:{root / 'benchmarks' / 'trials'}", "MUTANTS": json.dumps(settings, default=str)}


def _setting(name: str):
    return json.loads(os.environ.get("MUTANTS", "{}")).get(name)


def pytest_collection_modifyitems(items: list) -> None:
    """Keep the chosen tests in their order."""
    if (chosen := _setting("tests")) is not None:
        by_name = {item.nodeid: item for item in items}
        items[:] = [by_name[name] for name in chosen if name in by_name]


def pytest_runtest_logstart(nodeid: str) -> None:
    """Have coverage note which test runs a line."""
    if _setting("seconds") is not None and (running := Coverage.current()) is not None:
        running.switch_context(nodeid)


def pytest_runtest_logreport(report) -> None:
    """Add the time of a test's setup, call or end."""
    _seconds[report.nodeid] += report.duration


def pytest_sessionfinish() -> None:
    """Write the seconds of each test."""
    if (file := _setting("seconds")) is not None:
        pathlib.Path(file).write_text(json.dumps(_seconds))


_seconds: collections.Counter = collections.Counter()

# --- fates ---


def fate_of(mutant: Mutant, copy_of: pathlib.Path, known: dict[str, dict], seconds: float) -> dict:
    """The mutant's fate: "killed", "slow" (too slow, killed), "died" (the process did), "survived"."""
    path = copy_of / mutant.file
    whole = path.read_bytes()
    taken, usual = tests_of(mutant, known, seconds)
    files = list(dict.fromkeys(name.split("::")[0] for name in taken))
    began = time.perf_counter()
    try:
        path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
        home = str(copy_of.with_suffix(".cache"))  # a mutant's traced programs are of no use to others
        environment = {**os.environ, "XDG_CACHE_HOME": home, **_plugin(copy_of, tests=taken)}
        result = subprocess.run(
            [sys.executable, *PYTEST, "-x", *files],
            cwd=copy_of,
            env={**environment, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            timeout=3 * usual + 60,
            errors="replace",
        )
        fate = {0: "survived", 1: "killed", 2: "killed"}.get(result.returncode, "died")
        last = [line for line in result.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        by = last[0][:200] if last else ""
    except subprocess.TimeoutExpired:
        fate, by = "slow", ""
    finally:
        path.write_bytes(whole)
    return {"fate": fate, "by": by, "seconds": round(time.perf_counter() - began, 1), "tests": len(taken)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", nargs="+", choices=all_folders(), default=all_folders(), help="folders to draw from (all)")
    parser.add_argument("--count", type=int, default=30, help="mutants of each folder (30)")
    parser.add_argument("--seed", type=int, default=0, help="order of the draw (0)")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time (2)")
    parser.add_argument("--seconds", type=float, default=180.0, help="tests a mutant is given, by their usual time (180)")
    parser.add_argument("--all-tests", action="store_true", help="measure all test files, not only those of the folders")
    parser.add_argument("--again", action="store_true", help="run the survivors anew")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/mutants"), help="folder of the results")
    asked = parser.parse_args()
    out = asked.out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    everything = asked.all_tests or asked.folder == all_folders()
    known = reach(out, asked.workers, test_files(asked.folder, everything))
    reached = collections.defaultdict(set)
    for entry in known.values():
        for file, lines in entry["lines"].items():
            reached[file].update(map(int, lines if entry["tests"] else ()))
    taken, total = drawn(asked.count, asked.seed, reached, asked.folder)
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
        fates[mutant.name] = fate_of(mutant, place, known, asked.seconds)
        free.append(place)
        kept.write_text(json.dumps(fates, indent=1))
        print(f"{len(fates):4} {fates[mutant.name]['fate']:9} {fates[mutant.name]['seconds']:6.1f} s {mutant.name}", flush=True)

    with concurrent.futures.ThreadPoolExecutor(asked.workers) as pool:
        list(pool.map(one, [mutant for mutant in taken if mutant.name not in fates]))
    report(taken, fates, total)


def report(taken: list[Mutant], fates: dict[str, dict], total: collections.Counter) -> None:
    """Killed and survived, by folder and by kind of change, and every survivor."""
    print(f"\n{total['reached']} changes are possible on lines that tests reach, {total['not reached']} on others")
    for title, key in (
        ("folder", lambda one: one.folder),
        ("kind", lambda one: one.kind),
    ):
        groups = collections.defaultdict(list)
        for mutant in taken:
            groups[key(mutant)].append(fates[mutant.name]["fate"] != "survived")
        print(f"\n{title:18} mutants killed")
        for name, killed in sorted(groups.items()):
            print(f"{name:18} {len(killed):7} {sum(killed):6} {100 * sum(killed) / len(killed):5.1f} %")
    alive = [mutant for mutant in taken if fates[mutant.name]["fate"] == "survived"]
    print(f"\n{len(taken)} mutants, {len(taken) - len(alive)} killed; survivors:")
    for mutant in sorted(alive, key=lambda one: (one.file, one.line)):
        print(f"  {mutant.name}")


if __name__ == "__main__":
    main()
