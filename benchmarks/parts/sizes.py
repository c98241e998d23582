"""Cost by size of the machine, and time of first results: rows of the table of engine.py.

Called by engine.py. Times for platforms and equal loads are CPU times; times of first results are elapsed times in new
processes. `trials/large_machines.py` measures more sizes and compares with a dense solution.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from first_answers import time_call
from guard import chain, planar
from parts.common import say

import jaxvib as jv

FIRST_ANSWERS = ("jam_modes", "jam_orbit", "simulate, 5 s", "simulate, gradient reverse")


def seconds(function: Callable[[], Any], repeats: int = 5) -> tuple[float, float]:
    """CPU time of a first call, and the least of several later ones."""
    found = []
    for _ in range(repeats + 1):
        begun = time.process_time()
        jax.block_until_ready(jax.tree.leaves(function()))
        found.append(time.process_time() - begun)
    return found[0], min(found[1:])


def step_and_rest(scene: jv.Scene) -> tuple[float, float]:
    """Time of a step of `simulate`, and of a run without its steps."""
    times, steps = [], []
    for end in (2.0, 40.0):
        run = partial(jv.simulate, scene, end, save="window", estimate=False)
        times.append(seconds(run, 8)[1])
        done = run()
        steps.append(int(done.steps) + int(done.rejected))
    each = (times[1] - times[0]) / (steps[1] - steps[0])
    return each, times[0] - steps[0] * each


def platforms(quick: bool = False) -> None:
    """`jam_modes`, an exact orbit, a step of `simulate` and the rest of a run, for chains of platforms."""
    base: dict[str, float] = {}
    print("jam_modes, jam_orbit, a step of simulate and the rest of a run, over platforms")
    for count in (2, 5) if quick else (2, 5, 10, 20, 50, 200):
        scene = chain(count)
        found = {"jam_modes": seconds(lambda s=scene: jv.jam_modes(s))}
        mode = int(np.flatnonzero(np.isfinite(jv.jam_modes(scene).omega))[0]) + 1
        found["jam_orbit"] = seconds(lambda s=scene, m=mode: jv.jam_orbit(s, mode=m, throw=False))
        if count <= 50:
            step, rest = step_and_rest(scene)
            found |= {"a step of simulate": (np.nan, step), "simulate without its steps": (np.nan, rest)}
        for name, (compiling, later) in found.items():
            base.setdefault(name, later)
            known = None if np.isnan(compiling) else compiling
            say(f"{name}, over platforms", f"{name}, {count} platforms", later, base[name], None, known)


def equal_loads(quick: bool = False) -> None:
    """`phase_jams` of equal loads on a rotor in a plane."""
    print("phase_jams of equal loads")
    base = None
    for count in (3,) if quick else (3, 8, 12, 16):
        scene = planar(count)
        compiling, later = seconds(lambda s=scene: jv.phase_jams(s))
        base = later if base is None else base
        say("phase_jams of equal loads", f"{count} loads", later, base, None, compiling)


def first_answers(quick: bool = False) -> None:
    """First answers in new processes, with an empty cache and with a full one; ratios to `jam_modes` with an empty cache."""
    print("first answers")
    base = None
    for name in FIRST_ANSWERS[:1] if quick else FIRST_ANSWERS:
        with tempfile.TemporaryDirectory() as cache:
            for way in ("empty cache", "full cache"):
                first, again = time_call(name, cache)
                base = first if base is None else base
                say("first answers", f"{name}, {way}", first, base, None, None, f"again {1e3 * again:.3g} ms")
