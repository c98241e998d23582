"""Time and error for machines of many platforms and rotors with many loads.

    python benchmarks/trials/large_machines.py [2 5 10 20 50 100 200]

CPU time in ms: the least of several calls and, in brackets, the first call, which compiles. A step of `simulate`
follows from two runs of different length; the rest of a run is the time beyond its steps. The error is the largest relative
difference of the amplitudes of all jam modes from a solution with the full matrices.
"""

from __future__ import annotations

import os
import pathlib
import sys
from collections.abc import Callable

os.environ["JAXVIB_AUTOMATIC"] = "off"  # no program comes from a cache

import jaxvib as jv

jv.prepare_cpu()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

from guard import chain, planar  # noqa: E402
from parts.common import machine_line  # noqa: E402
from parts.sizes import seconds, step_and_rest  # noqa: E402

from jaxvib.steady.balance.speeds import characteristic_speeds  # noqa: E402


def jam_error(scene: jv.Scene) -> float:
    """Largest relative difference of the amplitudes of the jam modes from a solution with the full matrices."""
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


def gradient(scene: jv.Scene) -> Callable[[], jax.Array]:
    """Gradient of the sum of the foundation forces of all jam modes by the stiffness of every support."""

    @jax.jit
    @jax.grad
    def slope(stiffness: jax.Array) -> jax.Array:
        changed = eqx.tree_at(lambda s: s.machine.stiffness, scene, stiffness)
        return jnp.nansum(jv.jam_modes(changed).foundation_force)

    return lambda: slope(scene.machine.stiffness)


def main(sizes: list[int]) -> None:
    print(machine_line())
    heads = (
        "jam_modes (first)",
        "error",
        "gradient (first)",
        "exact orbit (first)",
        "speeds (first)",
        "step, us",
        "rest of a run",
    )
    print(f"{'platforms':>9s}  {', '.join(heads)}; speeds: the characteristic speeds of the criterion")
    for n in sizes:
        scene = chain(n)
        modes, slopes = seconds(lambda: jv.jam_modes(scene)), seconds(gradient(scene))  # noqa: B023
        first = int(np.flatnonzero(np.isfinite(jv.jam_modes(scene).omega))[0]) + 1
        orbit = seconds(lambda: jv.jam_orbit(scene, mode=first, throw=False))  # noqa: B023
        speeds = seconds(lambda: characteristic_speeds(scene))  # noqa: B023
        step, rest = step_and_rest(scene)
        cells = [f"{1e3 * later:9.2f} ({1e3 * before:6.0f})" for before, later in (modes, slopes, orbit, speeds)]
        cells.insert(1, f"{jam_error(scene):8.1e}")
        print(f"{n:9d}  {'  '.join(cells)}  {1e6 * step:8.2f}  {1e3 * rest:8.2f}", flush=True)
    print(f"{'loads':>9s}  phase_jams (first)")
    for n in (3, 8, 12, 16):
        scene = planar(n)
        before, later = seconds(lambda: jv.phase_jams(scene))  # noqa: B023
        print(f"{n:9d}  {1e3 * later:9.1f} ({1e3 * before:6.0f})", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main([int(n) for n in sys.argv[1:]] or [2, 5, 10, 20, 50, 100, 200])
