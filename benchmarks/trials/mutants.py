"""Share of changes in the packages that the tests see, folder by folder.

    python benchmarks/trials/mutants.py --count 30 --out out/mutants
    python benchmarks/trials/mutants.py --folder jaxvib/steady optimize/search --count 30 --seed 1

A mutant is the package with one change in one line:

- a sign, a factor, an index, a comparison, a sine in place of a cosine, a smaller in place of a larger
- a term of a sum, a branch of an `if` or a keyword argument of a call that is dropped
- two neighbouring arguments of a call that are swapped

Mutants are drawn from every folder of `jaxvib` and `optimize`, or from each `--folder`: `--count` in each, of all kinds alike,
in an order that follows from the seed and the change itself: a change of one file leaves the mutants of others as they were.
Each is given to the nearest `--files` test files, first the test file of its name, then those of its folder, then those that
name most of it; a third of them are those that consist most of calls of it, in any folder. The examples in its own file are run
as well. Of these the tests that reach its line run first; the first test that fails ends it. The lines that each test of a file
reaches are measured (`coverage`) when a mutant needs that file, once for an `--out`. Take a new `--out` for changed packages.

A mutant is killed when a test fails, when the tests take three times their usual time and a minute, or when the process dies.
Survivors, and mutants that no such test reaches, are printed with their changes, to be explained or killed by a new test.
All results are kept in `--out`, so that a second call goes on where the first was stopped; `--again` runs the survivors anew,
after tests were added.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import itertools
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

from changes import Mutant, folder_of, mutants
from coverage import Coverage, CoverageData

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = ("jaxvib", "optimize")
ALIVE = ("survived", "not reached")

PYTEST = ("-m", "pytest", "-p", "no:cacheprovider", "-p", "mutants")
"""The arguments of Python that run tests with this module as a plugin."""


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


# --- tests and the lines that they reach ---


def nearest(file: str, count: int) -> list[str]:
    """The test files nearest to a file of the packages, and the file itself if it has examples."""
    text, place = (ROOT / file).read_text(), _home(pathlib.Path(file.removeprefix("jaxvib/")))
    public = re.search(r"^__all__ = \[(.*?)\]", text, re.DOTALL | re.MULTILINE)
    words = re.findall(r"\w+", public[1]) if public else re.findall(r"^(?:def|class) ([a-zA-Z]\w*)", text, re.MULTILINE)
    names, calls = (re.compile(rf"\b({'|'.join(each)}){end}") for each, end in (([place[-1], *words], r"\b"), (words, r"\(")))

    def distance(path: pathlib.Path) -> tuple:
        own, test = _home(path.relative_to(ROOT / "tests")), path.read_text()
        common = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(place, own, strict=False)))
        same, named = own[-1] == place[-1], len(set(names.findall(test)))
        return not (same and common), common < len(own), common < len(place) - 1, -common - named, not same, len(test)

    def share(path: pathlib.Path) -> float:
        test = path.read_text()
        return -len(calls.findall(test)) / len(test)

    tests = sorted((ROOT / "tests").rglob("test_*.py"), key=distance)
    tests[count - count // 3 :] = sorted(tests[count - count // 3 :], key=share)
    first, *others = [str(path.relative_to(ROOT)) for path in tests[:count]]
    return [first, *[file] * (">>>" in text), *others]


def _home(path: pathlib.Path) -> tuple[str, ...]:
    """The folders and the name of a file, the same for `units/reading.py` and its tests `units/test_reading.py`."""
    name = path.stem.removeprefix("test_")
    return path.parent.parts if name == "__init__" and path.parent.parts else (*path.parent.parts, name)


class Reach:
    """The tests that reach each line of the packages, by test files, measured when they are asked for."""

    def __init__(self, out: pathlib.Path, measures: bool) -> None:
        self.measures, self.out = measures, out / "reach"
        self.out.mkdir(exist_ok=True)
        self.locks = collections.defaultdict(threading.Lock)

    def tests_of(self, mutant: Mutant, file: str) -> tuple[list[str], float]:
        """The tests of a file to run for a mutant, and their seconds; none if none reaches its line.

        Those that reach the line come before the others, which may use a program that the first ones traced.
        """
        with self.locks[file]:
            kept = self.out / f"{file.replace('/', '-')}.json"
            if not kept.exists():
                kept.write_text(json.dumps(self._measured(file)))
            entry = json.loads(kept.read_text())
        seconds, reaching = entry["seconds"], entry["lines"].get(mutant.file, {}).get(str(mutant.line))
        if reaching is None:
            return [], 0.0
        return sorted(seconds, key=lambda name: (name not in reaching, seconds[name])), sum(seconds.values())

    def _measured(self, file: str) -> dict[str, dict]:
        """The seconds of each test and the tests that reach each line; none of them for a line that runs at import."""
        data, home, seconds = (self.out / f"{file.replace('/', '-')}.{kind}" for kind in ("coverage", "cache", "seconds"))
        # No traced program is read from the disk: it executes none of the lines that it was traced from.
        environment = {"COVERAGE_FILE": str(data), "XDG_CACHE_HOME": str(home), **_plugin(ROOT, seconds=seconds)}
        command = [sys.executable, "-m", "coverage", "run", f"--source={','.join(PACKAGES)}", *PYTEST, file]
        began = time.perf_counter()
        result = subprocess.run(command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True)
        shutil.rmtree(home, ignore_errors=True)
        if result.returncode != 0 or not seconds.exists():
            if result.returncode != 5:  # 5: all of its tests are slow ones
                print(f"left out, as it fails without a change: {file}\n{result.stdout[-1000:]}", flush=True)
            return {"seconds": {}, "lines": {}}
        print(f"     measured  {time.perf_counter() - began:6.1f} s {file}", flush=True)
        found, lines = CoverageData(str(data)), {}
        found.read()
        for path in found.measured_files():
            at = {line: [name for name in names if name] for line, names in found.contexts_by_lineno(path).items()}
            lines[str(pathlib.Path(path).relative_to(ROOT))] = at
        data.unlink()
        return {"seconds": json.loads(seconds.read_text()), "lines": lines}


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


def fate_of(mutant: Mutant, copy_of: pathlib.Path, reach: Reach, files: int) -> dict:
    """The mutant's fate: "killed", "slow" (too slow, killed), "died" (the process did), "survived", "not reached"."""
    fate, by, began, chosen = "not reached", "", time.perf_counter(), nearest(mutant.file, files)
    if not reach.measures:
        fate, by = _run(mutant, copy_of, chosen, None, 100.0)
        chosen = []
    for file in chosen:
        tests, seconds = reach.tests_of(mutant, file)
        if tests != []:
            found, by = _run(mutant, copy_of, [file], tests, seconds)
            fate = fate if found == "not reached" else found
            if fate not in ALIVE:
                break
    return {"fate": fate, "by": by, "seconds": round(time.perf_counter() - began, 1)}


def _run(mutant: Mutant, copy_of: pathlib.Path, chosen: list[str], tests: list[str] | None, seconds: float) -> tuple[str, str]:
    """The mutant's fate by tests of files, and the line about the test that failed."""
    path = copy_of / mutant.file
    whole = path.read_bytes()
    home = str(copy_of.with_suffix(".cache"))  # a mutant's traced programs are of no use to others
    environment = {"XDG_CACHE_HOME": home, "PYTHONDONTWRITEBYTECODE": "1", **_plugin(copy_of, tests=tests)}
    try:
        path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
        result = subprocess.run(
            [sys.executable, *PYTEST, "-x", *chosen],
            cwd=copy_of,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=3 * seconds + 60,
            errors="replace",
        )
    except subprocess.TimeoutExpired:
        return "slow", ""
    finally:
        path.write_bytes(whole)
    failed = [line for line in result.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    # 5: all tests of the file are slow ones
    return {0: "survived", 1: "killed", 2: "killed", 5: "not reached"}.get(result.returncode, "died"), failed[0][
        :200
    ] if failed else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    below = sorted({str(parent) for file in sources() for parent in pathlib.Path(file).parents[:-1]})
    parser.add_argument(
        "--folder", nargs="+", choices=below, default=all_folders(), metavar="FOLDER", help="folders to draw from (all)"
    )
    parser.add_argument("--count", type=int, default=30, help="mutants of each folder (30)")
    parser.add_argument("--seed", type=int, default=0, help="order of the draw (0)")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time (2)")
    parser.add_argument("--files", type=int, default=5, help="test files that a mutant is given, beside its examples (5)")
    parser.add_argument("--whole-files", action="store_true", help="measure no lines: cheaper for one mutant in a file")
    parser.add_argument("--again", action="store_true", help="run the survivors anew")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/mutants"), help="folder of the results")
    asked = parser.parse_args()
    out = asked.out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    reach, taken = Reach(out, not asked.whole_files), drawn(asked.count, asked.seed, asked.folder)
    kept = out / "fates.json"
    fates = json.loads(kept.read_text()) if kept.exists() else {}
    if asked.again:
        fates = {name: fate for name, fate in fates.items() if fate["fate"] not in ALIVE}
    copies = [out / f"copy{k}" for k in range(asked.workers)]
    for place in copies:
        shutil.rmtree(place, ignore_errors=True)
        ignored = shutil.ignore_patterns(".git", ".venv*", "out", "__pycache__")
        shutil.copytree(ROOT, place, ignore=ignored)
    free = collections.deque(copies)

    def one(mutant: Mutant) -> None:
        place = free.popleft()
        fates[mutant.name] = fate_of(mutant, place, reach, asked.files)
        free.append(place)
        kept.write_text(json.dumps(fates, indent=1))
        print(
            f"{len(fates):4} {fates[mutant.name]['fate']:11} {fates[mutant.name]['seconds']:6.1f} s {mutant.name}", flush=True
        )

    with concurrent.futures.ThreadPoolExecutor(asked.workers) as pool:
        list(pool.map(one, [mutant for mutant in taken if mutant.name not in fates]))
    report(taken, fates)


def report(taken: list[Mutant], fates: dict[str, dict]) -> None:
    """Killed and survived, by folder and by kind of change, and every survivor."""
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


if __name__ == "__main__":
    main()
