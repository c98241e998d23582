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
import collections
import concurrent.futures
import itertools
import json
import os
import pathlib
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence

from changes import Mutant, folder_of, mutants
from coverage import Coverage, CoverageData

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = ("jaxvib", "optimize")

PYTEST = ("-m", "pytest", "-p", "no:cacheprovider", "-p", "mutants")
"""The arguments of Python that run tests with this module as a plugin."""


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
