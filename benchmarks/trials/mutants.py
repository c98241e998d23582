"""Share of changes in the source code that the tests detect, for each folder.

    python benchmarks/trials/mutants.py --count 30 --out out/mutants
    python benchmarks/trials/mutants.py --folder jaxvib/steady optimize/search --count 30 --seed 1

A mutant is the package with one change in one line:

- another sign, factor, index or comparison; a sine in place of a cosine; a minimum in place of a maximum
- without a term of a sum, a branch of an `if` or a keyword argument of a call
- with two neighbouring arguments of a call swapped

Mutants are chosen at random from every folder of `jaxvib` and `optimize`, or from each `--folder`: `--count` in each, with
equal numbers of all kinds. Their order depends only on the seed and on the change itself; a change of one file therefore does
not change the mutants of other files.

A mutant is tested by the examples of its own file and by the `--tests` tests that most probably detect it: first those in the
test file of its name, then those whose text names the changed function or class, then those that name a public part of its
module. Of two equal tests the shorter one comes first. The first failing test ends the mutant. Because only some tests are
used, the shares are lower bounds of those of the whole test suite.

A mutant is killed if a test fails or if the process crashes. The following mutants are printed with their changes, to be
explained or killed by a new test: survivors, mutants whose tests did not end within `--seconds` of CPU time or `--wall`
seconds, and mutants without a test. After `--minutes` no further mutant is started, and running tests are ended; mutants that
were not run are printed. All results are stored in `--out`; another call of the program continues from there. `--again` repeats
the survivors after tests were added. Processes are forked from a process that has imported the libraries, but no module of the
packages.
"""

from __future__ import annotations

import argparse
import ast
import collections
import concurrent.futures
import functools
import itertools
import json
import math
import multiprocessing
import os
import pathlib
import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence

import pytest
from changes import Mutant, folder_of, mutants

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = ("jaxvib", "optimize")
ALIVE = ("survived", "slow", "without tests")

LIBRARIES = ["jax", "diffrax", "equinox", "optimistix", "optax", "pytest", "pint", "click", "rich"]
LIBRARIES += ["scipy.integrate", "scipy.optimize", "scipy.linalg", "scipy.signal", "matplotlib.pyplot"]
"""Modules that each process finds imported; none of them starts a backend of JAX."""


def drawn(count: int, seed: int, folders: Sequence[str]) -> list[Mutant]:
    """`count` mutants of each folder, of all kinds alike."""
    counted, taken = all_folders(), {}
    for folder in folders:
        possible = collections.defaultdict(list)
        for file in sources():
            # A folder below those that mutants are counted by holds all files below it.
            if folder_of(file) == folder or (folder not in counted and file.startswith(f"{folder}/")):
                for one in mutants(file, (ROOT / file).read_text()):
                    possible[one.kind].append(one)
        kinds = [sorted(found, key=lambda one: one.rank(seed)) for found in possible.values()]
        mixed = [one for row in itertools.zip_longest(*kinds) for one in row if one is not None]
        taken |= {one.name: one for one in mixed[:count]}
    return sorted(taken.values(), key=lambda one: one.file)


def sources() -> list[str]:
    """All files of the packages, relative to the root."""
    return sorted(str(path.relative_to(ROOT)) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def all_folders() -> list[str]:
    """All folders that mutants are counted by, see `Mutant.folder`."""
    return sorted({folder_of(file) for file in sources()})


# --- tests that may see a mutant ---


@functools.cache
def _test_files() -> list[tuple[str, list[tuple[str, str]]]]:
    """All test files with their tests: the names and the texts."""
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text()
        nodes = [node for node in ast.parse(text).body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
        named = [(node.name, ast.get_source_segment(text, node)) for node in nodes if node.name.lower().startswith("test")]
        found.append((str(path.relative_to(ROOT)), named))
    return found


def likely_tests(mutant: Mutant, count: int) -> list[str]:
    """The tests that are most likely to see a mutant, and its own file if it has examples."""
    text = (ROOT / mutant.file).read_text()
    place = _home(pathlib.Path(mutant.file.removeprefix("jaxvib/")))
    enclosing, public = [_word(names) for names in _names(ast.parse(text), mutant.line)]
    ranked = []
    for file, tests in _test_files():
        own = _home(pathlib.Path(file).relative_to("tests"))
        common = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(place, own, strict=False)))
        near = 5 * (own[-1] == place[-1] and common > 0) + common / len(place)
        for name, test in tests:
            score = near + 4 * bool(enclosing.search(f"{name} {test}")) + 2 * bool(public.search(test))
            ranked.append((-score, len(test), f"{file}::{name}"))
    chosen = [name for *_, name in sorted(ranked)[:count]]
    return [*chosen[: count // 2], *[mutant.file] * (">>>" in text), *chosen[count // 2 :]]


def _names(tree: ast.Module, line: int) -> tuple[list[str], list[str]]:
    """The names of the functions and classes that hold a line, and of the public parts of a module."""
    defined = [node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    holding = [node.name for node in defined if node.lineno <= line <= node.end_lineno and not node.name.startswith("__")]
    return holding, [node.name for node in defined if node in tree.body and not node.name.startswith("_")]


def _word(names: Sequence[str]) -> re.Pattern:
    """A pattern that finds any of the names, which are written without their first underscores."""
    return re.compile(rf"\b_*({'|'.join(name.lstrip('_') for name in names)})\b" if names else r"(?!)")


def _home(path: pathlib.Path) -> tuple[str, ...]:
    """The folders and the name of a file, the same for `units/reading.py` and its tests `units/test_reading.py`."""
    name = path.stem.removeprefix("test_")
    return path.parent.parts if name == "__init__" and path.parent.parts else (*path.parent.parts, name)


# --- processes that run tests ---

_processes = multiprocessing.get_context("forkserver")


def in_process(work, *arguments, log: pathlib.Path, wall: float) -> int:
    """The exit code of a function in a forked process whose output goes to a file; after `wall` seconds, the process and those
    that it started are ended, and the code is that of the signal."""
    process = _processes.Process(target=_logged, args=(work, str(log), *arguments))
    process.start()
    process.join(wall)
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)
        process.join()
    return process.exitcode


def _logged(work, log: str, *arguments) -> None:
    os.setsid()
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(output, stream)
    code = int(work(*arguments))
    sys.stdout.flush()
    os._exit(code)  # threads that compile for later are of no use


def _pytest(root: pathlib.Path, files: Sequence[str], plugin: object, *options: str) -> int:
    os.chdir(root)
    os.environ["PYTHONPATH"] = str(root)
    sys.path.insert(0, str(root))
    # The libraries are imported before pytest can rewrite their assertions.
    quiet = ["-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return pytest.main([*quiet, *options, *files], plugins=[plugin])


class _Chosen:
    """Keeps the chosen tests, in their order, and writes which one failed."""

    def __init__(self, tests: Sequence[str], failed: str) -> None:
        self.tests, self.failed = tests, failed

    def pytest_collection_modifyitems(self, items: list) -> None:
        by_name = collections.defaultdict(list)
        for item in items:
            by_name[item.nodeid.split("[")[0]].append(item)
            by_name["::".join(item.nodeid.split("::")[:2])].append(item)
            by_name[item.nodeid.split("::")[0]].append(item)
        items[:] = dict.fromkeys(item for name in self.tests for item in by_name[name])

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed:
            pathlib.Path(self.failed).write_text(report.nodeid)


def _run_tests(place: str, tests: Sequence[str], seconds: int, failed: str) -> int:
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    files = list(dict.fromkeys(name.split("::")[0] for name in tests))
    return _pytest(pathlib.Path(place), files, _Chosen(tests, failed), "-x")


# --- fates ---


def fate_of(mutant: Mutant, copy_of: pathlib.Path, tests: Sequence[str], seconds: int, wall: float) -> dict:
    """The mutant's fate: "killed", "died" (the process did), "survived", "slow" (no answer) or "without tests"."""
    began, path = time.perf_counter(), copy_of / mutant.file
    log, failed = copy_of.with_suffix(".log"), copy_of.with_suffix(".failed")
    failed.unlink(missing_ok=True)
    whole = path.read_bytes()
    path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
    try:
        code = in_process(_run_tests, str(copy_of), tests, seconds, str(failed), log=log, wall=wall)
    finally:
        path.write_bytes(whole)
    # 2 and 4: the tests cannot be collected, 5: all of them are slow ones
    fates = {0: "survived", 1: "killed", 2: "killed", 4: "killed", 5: "without tests", -9: "slow", -24: "slow"}
    by = failed.read_text() if failed.exists() else ""
    return {"fate": fates.get(code, "died"), "by": by, "seconds": round(time.perf_counter() - began, 1)}


def run_until(end: float, mutants: Sequence[Mutant], run: Callable[[Mutant, float], dict], workers: int) -> None:
    """Call `run` with each mutant and the seconds that are left until `end`, a time of `time.monotonic`; none after `end`."""

    def one(mutant: Mutant) -> None:
        if (left := end - time.monotonic()) > 0.0:
            run(mutant, left)

    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, mutants))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    below = sorted({str(parent) for file in sources() for parent in pathlib.Path(file).parents[:-1]})
    parser.add_argument(
        "--folder", nargs="+", choices=below, default=all_folders(), metavar="FOLDER", help="folders to draw from (all)"
    )
    parser.add_argument("--count", type=int, default=30, help="mutants of each folder (30)")
    parser.add_argument("--seed", type=int, default=0, help="order of the draw (0)")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time (2)")
    parser.add_argument("--tests", type=int, default=20, help="tests that a mutant is given, beside its examples (20)")
    parser.add_argument("--seconds", type=int, default=240, help="CPU time of a mutant's tests (240)")
    parser.add_argument("--wall", type=float, default=1200.0, help="time of a mutant's tests, s (1200)")
    parser.add_argument("--minutes", type=float, default=math.inf, help="time of the whole call (no limit)")
    parser.add_argument("--again", action="store_true", help="run the survivors anew")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/mutants"), help="folder of the results")
    asked = parser.parse_args()
    end = time.monotonic() + 60.0 * asked.minutes
    out = asked.out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    _processes.set_forkserver_preload(LIBRARIES)
    taken, kept = drawn(asked.count, asked.seed, asked.folder), out / "fates.json"
    fates = json.loads(kept.read_text()) if kept.exists() else {}
    if asked.again:
        fates = {name: fate for name, fate in fates.items() if fate["fate"] not in ALIVE}
    copies = [out / f"copy{k}" for k in range(asked.workers)]
    for place in copies:
        shutil.rmtree(place, ignore_errors=True)
        ignored = shutil.ignore_patterns(".git", ".venv*", "out", "__pycache__")
        shutil.copytree(ROOT, place, ignore=ignored)
    free = collections.deque(copies)

    def run(mutant: Mutant, left: float) -> None:
        place = free.popleft()
        fate = fate_of(mutant, place, likely_tests(mutant, asked.tests), asked.seconds, min(asked.wall, left))
        free.append(place)
        if time.monotonic() >= end and fate["fate"] in ALIVE:  # its tests may have been ended early
            return
        fates[mutant.name] = fate
        kept.write_text(json.dumps(fates, indent=1))
        print(
            f"{len(fates):4} {fates[mutant.name]['fate']:11} {fates[mutant.name]['seconds']:6.1f} s {mutant.name}", flush=True
        )

    run_until(end, [mutant for mutant in taken if mutant.name not in fates], run, asked.workers)
    report(taken, fates)


def report(taken: list[Mutant], fates: dict[str, dict]) -> None:
    """Killed and survived, by folder and by kind of change, every survivor, and every mutant that was not run."""
    waiting, taken = [one for one in taken if one.name not in fates], [one for one in taken if one.name in fates]
    for title, key in (
        ("folder", lambda one: one.folder),
        ("kind", lambda one: one.kind),
    ):
        groups = collections.defaultdict(list)
        for mutant in taken:
            groups[key(mutant)].append(fates[mutant.name]["fate"] not in ALIVE)
        print(f"\n{title:18} mutants killed")
        for name, killed in sorted(groups.items()):
            print(f"{name:18} {len(killed):7} {sum(killed):6} {100 * sum(killed) / len(killed):5.1f} %")
    alive = [mutant for mutant in taken if fates[mutant.name]["fate"] in ALIVE]
    print(f"\n{len(taken)} mutants, {len(taken) - len(alive)} killed; survivors:")
    for mutant in sorted(alive, key=lambda one: (one.file, one.line)):
        print(f"  {fates[mutant.name]['fate']}: {mutant.name}")
    if waiting:
        print(f"\n{len(waiting)} mutants were not run; the same call with more --minutes runs them:")
        for mutant in waiting:
            print(f"  {mutant.name}")


if __name__ == "__main__":
    main()
