"""Captures of balls in a torus: time of 1000 starts of 2000 turns relative to a native loop; tables of the paper.

    pip install numba
    python benchmarks/torus.py [--starts 1000] [--turns 2000] [--share 8] [--tables derived printed "gap lever" contact]

The native loop (parts/native_torus.py) and the engine take the same steps from the same starts; the difference of their results
after three turns is printed. Times are CPU times of the whole process, because other programs may be running; the elapsed time
is this time divided by the number of cores. The ratio is measured with the number of turns divided by --share. --tables prints
the tables of the paper for the given models. Their numbers of steps are doubled at most --doublings times, which takes about
ten minutes of CPU time for each table.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any

import jaxvib as jv

jv.prepare_cpu()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from machines import CONTACT, MODELS, published_tables, published_torus  # noqa: E402
from parts import native_torus  # noqa: E402
from parts.common import machine_line  # noqa: E402

from jaxvib.study.capture.capture import DOUBLINGS, moving_state  # noqa: E402

SCENE = published_torus(2.5)
TOUCHING = jv.Scene(SCENE.machine, SCENE.loads, SCENE.drive, (*SCENE.all_effects, CONTACT))


def free(speed: jax.Array) -> tuple[jv.Scene, jv.State]:
    return SCENE, moving_state(SCENE, speed)


def touching(speed: jax.Array) -> tuple[jv.Scene, jv.State]:
    return TOUCHING, moving_state(TOUCHING, speed)


def spent(call: Callable[[], Any], rounds: int = 2) -> float:
    """Return the CPU time, s: the shortest of `rounds` calls after a call that compiles."""
    jax.block_until_ready(call())
    found = []
    for _ in range(rounds):
        begun = time.process_time()
        jax.block_until_ready(call())
        found.append(time.process_time() - begun)
    return min(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=2000)
    parser.add_argument("--share", type=int, default=8, help="the ratio is measured with the turns divided by this number")
    parser.add_argument("--tables", nargs="*", choices=list(MODELS), default=[])
    parser.add_argument(
        "--doublings", type=int, default=DOUBLINGS, help="largest number of doublings of the steps for the tables"
    )
    options = parser.parse_args()
    print(machine_line())
    speeds = np.linspace(-1.0, -0.1, options.starts // 64 * 64)
    omega = float(SCENE.drive.speed)
    end = 2.0 * np.pi * options.turns / omega / options.share
    own = SCENE.loads.natural_frequency(SCENE.drive.speed)
    assert own is not None
    steps = jv.EqualSteps(4 * math.ceil(end * float(own) / 4))
    values = jnp.asarray(speeds)
    starts = np.stack([native_torus.flat(moving_state(SCENE, speed)) for speed in speeds])
    numbers, loop = native_torus.numbers(SCENE), native_torus.simd_ensemble()

    def ours(make: Callable[..., Any], until: float, steps: jv.EqualSteps) -> jv.Ensemble:
        return jv.ensemble(make, values, until, stepsize_controller=steps, estimate=False)

    # Results are compared after three turns, before chaos separates them, for runs whose balls never leave the wall.
    early = 3.0 * 2.0 * np.pi / omega
    one, other = ours(free, early, jv.EqualSteps(400)), loop(starts, numbers, early, 400)
    pressing = ~np.any(one.detached, axis=1)
    apart = np.max(np.abs(np.asarray(one.state.angle[0]) - other[:, 2:4])[pressing])
    print(
        f"after three turns {np.sum(pressing)} of {speeds.size} runs have not left their wall; they are {apart:.1e} rad apart"
    )
    base = spent(lambda: loop(starts, numbers, end, steps.number))
    for name, make in (("free", free), ("touching", touching)):
        seconds = spent(lambda make=make: ours(make, end, steps).state)
        whole = seconds * options.share
        print(
            f"{name:9s} {seconds / base:6.2f} times the native loop (free); {speeds.size} starts of {options.turns} turns: "
            f"{whole:.0f} s of CPU time"
        )
    if options.tables:
        print(published_tables(options.tables, doublings=options.doublings).summary())


if __name__ == "__main__":
    main()
