"""Common parts of benchmarks: the computer, timing functions, and the rows of the table."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv

Row = dict[str, Any]

ROWS: list[Row] = []
"""All that was measured in this process, in order: group, name, seconds, ratio (to the group's base), error, compile, note."""

TOLERANCES = [10.0 ** (-k / 4) for k in range(16, 53)]


def published(speed: float = 5.1779, eps: float = 0.05, damping: float = 0.01) -> jv.Scene:
    """The two-mass machine of the antiphase paper with one load."""
    numbers = dict(natural=(1 / 3, 1 / 3), damping=(damping,) * 2, link_natural=2 / 3, link_damping=damping, rho=1.0, beta=1.0)
    return jv.Dimensionless("antiphase", **numbers, eps=eps, speed=speed).scene()


def thrown() -> jv.State:
    """Initial state of the runs of that machine."""
    return jv.State(jnp.asarray([-1.0, 1.0]), jnp.zeros(2), (jnp.zeros(1),), (jnp.ones(1),))


def flat(state: jv.State) -> np.ndarray:
    """A `State` as one vector: displacements, velocities, angles, speeds."""
    return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(state)])


def first(call: Callable[[], Any]) -> float:
    """Seconds of one call."""
    begun = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begun


def best(call: Callable[[], Any], runs: int = 7) -> float:
    """Seconds of the fastest of so many calls."""
    return min(first(call) for _ in range(runs))


def busy(call: Callable[[], Any], runs: int = 5) -> float:
    """CPU seconds that a call takes, the least of so many measurements; the first call is not counted.

    A measurement repeats the call for 50 ms: systems count a process's time in ticks that may be milliseconds long.
    """
    jax.block_until_ready(call())
    begun = time.perf_counter()
    jax.block_until_ready(call())
    repeats = max(1, int(0.05 / max(time.perf_counter() - begun, 1e-6)))
    found = []
    for _ in range(runs):
        begun = time.process_time()
        for _ in range(repeats):
            jax.block_until_ready(call())
        found.append((time.process_time() - begun) / repeats)
    return min(found)


def best_in_turn(calls: Sequence[Callable[[], Any]], rounds: int = 15) -> list[float]:
    """Seconds of the fastest call of each; they take turns, so that a slow moment of the machine is nobody's."""
    found = [np.inf] * len(calls)
    for _ in range(rounds):
        found = [min(seconds, best(call, 3)) for seconds, call in zip(found, calls, strict=True)]
    return found


def say(
    group: str,
    name: str,
    seconds: float,
    base: float | None = None,
    error: float | None = None,
    compiling: float | None = None,
    note: str = "",
    **more: Any,
) -> None:
    """Prints a row and keeps it; `base` is the seconds that count as 1 in its group."""
    ratio = None if base is None else seconds / base
    ROWS.append(dict(group=group, name=name, seconds=seconds, ratio=ratio, error=error, compile=compiling, note=note, **more))
    parts = [f"  {name:52s} {1e3 * seconds:12.5g} ms"]
    parts += [] if ratio is None else [f"x {ratio:9.3g}"]
    parts += [] if error is None else [f"error {error:.1e}"]
    parts += [] if compiling is None else [f"compile {compiling:.2f} s"]
    print("  ".join([*parts, note]).rstrip(), flush=True)


def reach(
    run: Callable[[float], np.ndarray], settings: Sequence[float], exact: np.ndarray, error: float
) -> tuple[float, float, float]:
    """The first setting that is exact enough (else the last), the error it has, and the seconds of the very first call."""
    compiling = first(lambda: run(settings[0]))
    found, setting = np.inf, settings[0]
    for setting in settings:
        found = float(np.max(np.abs(run(setting) - exact)))
        if found <= error:
            break
    return setting, found, compiling


def told(setting: float, found: float, error: float) -> str:
    """The setting in words; that it was not exact enough, where it was not."""
    return f"{setting:.4g}" + ("" if found <= error else ", does not reach the error")


def as_first_written(task: str, **given: Any) -> list[list[Any]]:
    """Rows [name, seconds, error, compile] of `first_written.py`, in a process of its own without any flags."""
    clean = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "EQX_ON_ERROR")}
    clean["JAXVIB_AUTOMATIC"] = "off"
    done = subprocess.run(
        [sys.executable, "-m", "parts.first_written"],
        cwd=Path(__file__).parents[1],
        input=json.dumps({"task": task, **given}),
        env=clean,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"first_written.py failed: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def cpu_name() -> str:
    """Name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Versions of everything that is measured, as far as it is installed."""
    found = {"python": platform.python_version()}
    for name in ("jaxvib", "jax", "diffrax", "numpy", "numba", "scipy", "jitcode", "scikit-sundae", "mujoco", "jaxcont"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine_line() -> str:
    """Machine, load and versions in a line."""
    named = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{cpu_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {named}"
