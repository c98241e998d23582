"""Trial of Ctrl-C at random times of a command, which must end soon, with one line and without a crash.

    python benchmarks/trials/interrupts.py cost --count 60
    python benchmarks/trials/interrupts.py audit --count 40 --cold --within 60

The command runs undisturbed, then `--count` times with an interrupt between 0.2 s and its end; with `--within`, before this
time, without an undisturbed run. An interrupted sweep is continued by the next run. With `--cold`, each run has an empty cache
of programs, and therefore compiles in threads. An interrupted command prints the line "jaxvib: interrupted" and ends within
30 s with the exit code 1; a search may instead print its result so far, with the exit code 0. The exit code of the script is
the number of other outcomes, which are printed.
"""

from __future__ import annotations

import argparse
import functools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LONGEST_WAIT = 30.0
"""Longest time between an interrupt and the end of the command, s."""

ENTRY = "import faulthandler, jaxvib_command; faulthandler.enable(); jaxvib_command.main()"

WORDS = {
    "cost": ["cost", "machine.toml"],
    "audit": ["audit", "machine.toml"],
    "simulate": ["simulate", "machine.toml", "--until", "2000s"],
    "optimize": ["optimize", "design.toml"],
    "sweep": ["sweep", "study.toml", "--store", "study.zarr"],
}


def begun(words: list[str], folder: Path, cache: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    piped = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # a shell starts a background process with interrupts ignored
    return subprocess.Popen(
        [sys.executable, "-c", ENTRY, *words],
        cwd=folder,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        **piped,
    )


def outcome(words: list[str], folder: Path, cache: Path, moment: float) -> str:
    """Interrupt a run and return what it did."""
    process = begun(words, folder, cache)
    try:
        output, errors = process.communicate(timeout=moment)
        return f"ended before ({process.returncode})"
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    try:
        output, errors = process.communicate(timeout=LONGEST_WAIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return f"WRONG: went on for {LONGEST_WAIT:g} s"
    said = errors.strip().splitlines()
    if process.returncode == 1 and said[-1:] == ["jaxvib: interrupted"] and "Traceback" not in errors:
        return f"interrupted after {'less than 1' if time.monotonic() - sent < 1.0 else 'more than 1'} s"
    if process.returncode == 0 and "Traceback" not in errors and output:
        return "with a result"
    return f"WRONG: exit code {process.returncode}: {errors[-2000:]}"


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("command", choices=list(WORDS))
    options.add_argument("--count", type=int, default=60)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--cold", action="store_true", help="an empty cache of programs for each run")
    options.add_argument("--within", type=float, help="latest moment of an interrupt, s")
    given = options.parse_args()
    words, draw, counts = WORDS[given.command], random.Random(given.seed), {}
    with tempfile.TemporaryDirectory() as name:
        folder, caches = Path(name), (Path(name) / f"cache{k}" for k in range(given.count + 2))
        made = subprocess.run([sys.executable, "-c", ENTRY, "new", "two-mass"], capture_output=True, text=True, check=True)
        (folder / "machine.toml").write_text(made.stdout)
        for kind, file in (("design", "design.toml"), ("sweep", "study.toml")):
            made = subprocess.run([sys.executable, "-c", ENTRY, "new", kind], capture_output=True, text=True, check=True)
            (folder / file).write_text(made.stdout)
        cache, whole = next(caches), given.within
        # a finished sweep would have nothing to compute
        forget = functools.partial(shutil.rmtree, folder / "study.zarr", ignore_errors=True)
        for _ in range(0 if whole else 1 if given.cold else 2):  # the second run finds its programs
            forget()
            start = time.monotonic()
            done = begun(words, folder, cache)
            said = done.communicate()[1]
            assert done.returncode == 0, said
            whole = time.monotonic() - start
        forget()
        print(f"{given.command}: interrupts within {whole:.1f} s", flush=True)
        for k in range(given.count):
            moment = draw.uniform(0.2, whole)
            found = outcome(words, folder, next(caches) if given.cold else cache, moment)
            if not found.startswith("interrupted"):
                forget()
            counts[found[:40]] = counts.get(found[:40], 0) + 1
            if found.startswith("WRONG"):
                print(f"number {k}, interrupted after {moment:.2f} s: {found}", flush=True)
    print(f"{given.command}: {counts}")
    return sum(number for found, number in counts.items() if found.startswith("WRONG"))


if __name__ == "__main__":
    sys.exit(main())
