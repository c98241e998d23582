"""Time of a second call for machines of many platforms and rotors with many loads, and the error of the modal form.

    python benchmarks/trials/large_machines.py

Milliseconds of the processor, the least of several calls. The error is the largest relative difference of the amplitudes of all
jam modes from a dense solution at their load speeds.
"""

from __future__ import annotations

import pathlib
import sys
import time
from collections.abc import Callable

import jax
import numpy as np

import jaxvib as jv

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

from guard import chain, planar
from parts.common import machine_line


def seconds(function: Callable[[], object], repeats: int = 5) -> float:
    """Least time of the processor of a call, after a first one."""
    jax.block_until_ready(jax.tree.leaves(function()))
    found = []
    for _ in range(repeats):
        begun = time.process_time()
        jax.block_until_ready(jax.tree.leaves(function()))
        found.append(time.process_time() - begun)
    return min(found)


def error(scene: jv.Scene) -> float:
    """Largest relative difference of the amplitudes of the jam modes from a dense solution."""
    modes, carrier, loads = jv.jam_modes(scene), scene.machine.carrier(), scene.loads
    there = np.flatnonzero(np.isfinite(modes.omega))
    (row,) = np.asarray(scene.mount().rows[0])
    mass = np.asarray(carrier.mass) + float(loads.mass) * loads.count * np.outer(row, row)
    unbalance = float(loads.mass) * loads.count * float(loads.radius)
    worst = 0.0
    for k in there:
        w = float(modes.omega[k])
        stiffness = np.asarray(carrier.stiffness) - w**2 * mass + 1j * w * np.asarray(carrier.damping)
        exact = np.abs(np.linalg.solve(stiffness, unbalance * w**2 * row))
        worst = max(worst, float(np.max(np.abs(np.asarray(modes.amplitude[k]) - exact)) / np.max(exact)))
    return worst


def main() -> None:
    print(machine_line())
    print(f"{'platforms':>10s} {'jam_modes, ms':>15s} {'error':>10s}")
    for n in (2, 5, 10, 20, 50, 100, 200):
        scene = chain(n)
        print(f"{n:10d} {1e3 * seconds(lambda: jv.jam_modes(scene)):15.2f} {error(scene):10.1e}", flush=True)  # noqa: B023
    print(f"{'loads':>10s} {'phase_jams, ms':>15s}")
    for n in (3, 8, 12, 16):
        scene = planar(n)
        print(f"{n:10d} {1e3 * seconds(lambda: jv.phase_jams(scene)):15.1f}", flush=True)  # noqa: B023


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
