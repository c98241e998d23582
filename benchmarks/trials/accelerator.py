"""Times of large batches on an accelerator, relative to two cores of the same computer, without compilation.

    python benchmarks/trials/accelerator.py [--quick] [--out FOLDER]

The batches are 1e6 runs with full equations (`ensemble`, 200 s each), a sweep of 65,536 runs with its store, 1e6 leading-order
designs with gradient, 1e5 exact orbits, and 1e4 exact orbits with their multipliers. A process on two cores computes every
hundredth run and every tenth orbit; its time is scaled to the whole batch. The difference is the largest difference between the
results of both, relative to the largest result. --quick computes a thousandth of each batch, as a test of the program. If JAX
finds no accelerator, both columns are of the CPU.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv

sys.path.insert(0, str(Path(__file__).parents[1]))

from parts.common import best, cpu_name, first, published, thrown, versions

from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.folds import rotor_speed_at

jv.prepare_cpu()
jax.config.update("jax_enable_x64", True)

Call = Callable[[], Any]


def runs(values: np.ndarray, _batch: int) -> Call:
    """Return a call that integrates runs of 200 s; the rotor speeds are `values` between 0 and 1, scaled."""
    scene, start, steps = published(), thrown(), jv.EqualSteps(1400)

    def make(n: jax.Array) -> tuple[jv.Scene, jv.State]:
        return eqx.tree_at(lambda s: s.drive.speed, scene, n), start

    speeds = jnp.asarray(3.0 + 3.0 * values)
    return lambda: jv.ensemble(make, speeds, 200.0, stepsize_controller=steps, estimate=False).load_speed


def sweep(values: np.ndarray, _batch: int) -> Call:
    """Return a call that computes a sweep of runs from rest, with its store."""
    axes: Any = {"drive.speed": {"from": 3.0, "to": 6.0, "count": len(values)}}
    measures = ["run.load_speed", "run.amplitude", "run.foundation_force"]

    def call() -> Any:
        with tempfile.TemporaryDirectory() as folder:
            done = jv.sweep(published(), axes, measures, f"{folder}/study.zarr", until=200.0, steps=1400, chunk=65_536)
            return [jnp.asarray(done.data[name.removeprefix("run.")].values) for name in measures]

    return call


def designs(values: np.ndarray, batch: int) -> Call:
    """Return a call that computes the rotor speed of a jam and its gradient by two stiffnesses."""
    scene = published()

    def speed(k: jax.Array) -> jax.Array:
        return rotor_speed_at(jammed_model(eqx.tree_at(lambda s: s.machine.stiffness, scene, k)), jnp.asarray(0.9))

    stiffness = jnp.asarray(np.stack([0.05 + 0.15 * values, 0.2 - 0.1 * values], axis=1))
    call = jax.jit(lambda k: jax.lax.map(jax.value_and_grad(speed), k, batch_size=min(batch, len(values))))
    return lambda: call(stiffness)


def orbits(values: np.ndarray, batch: int, *, multipliers: bool = False) -> Call:
    """Return a call that computes exact orbits at given load speeds."""
    scene = published()

    def one(w: jax.Array) -> tuple[jax.Array, ...]:
        orbit = jv.jam_orbit(scene, omega=w, points=8)
        return (orbit.rotor_speed, orbit.multiplier) if multipliers else (orbit.rotor_speed,)

    omega = jnp.asarray(0.6 + 0.3 * values)
    call = jax.jit(lambda w: jax.lax.map(one, w, batch_size=min(batch, len(values))))
    return lambda: call(omega)


WORK: dict[str, tuple[Callable[..., Call], int, int, int, int]] = {
    "runs of 200 s": (runs, 1_000_000, 100, 0, 0),
    "cases of a sweep of runs": (sweep, 65_536, 1, 0, 0),
    "leading-order designs with gradient": (designs, 1_000_000, 1, 1000, 250_000),
    "exact orbits": (orbits, 100_000, 10, 100, 100_000),
    "exact orbits with multipliers": (
        lambda values, batch: orbits(values, batch, multipliers=True),
        10_000,
        10,
        100,
        10_000,
    ),
}
"""Work: function, number, part that the CPU computes (1/part), batch on the CPU and on an accelerator."""


def measured(scale: int, shared: bool) -> list[dict[str, Any]]:
    """Return the times and results of all work divided by `scale`; `shared`: only the part that both compute."""
    found = []
    for name, (make, number, part, small, large) in WORK.items():
        number, part = number // scale, part if number // scale > 100 * part else 1
        values = np.linspace(0.0, 1.0, number)[:: part if shared else 1]
        call = make(values, large if jax.devices()[0].platform != "cpu" else small)
        compiling, seconds = first(call), best(call, 3)
        results = [np.asarray(leaf).reshape(len(values), -1) for leaf in jax.tree.leaves(call())]
        both = np.concatenate(results, axis=1)[:: 1 if shared else part]
        found.append(dict(name=name, number=number, seconds=seconds * number / len(values), compiling=compiling))
        found[-1]["results"] = both[:: max(1, len(both) // 200)].tolist()
        print(f"  {name:38s} {number:8d} in {found[-1]['seconds']:10.4g} s, first call {compiling:6.1f} s", flush=True)
    return found


def on_two_cores(scale: int) -> list[dict[str, Any]]:
    """Return `measured` of a process on two cores of the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "found.json"
        own = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
        command = [sys.executable, __file__, "--cores", str(place), "--scale", str(scale)]
        subprocess.run(command, check=True, env={**os.environ, **own})
        return json.loads(place.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a thousandth of the work, to see that it runs")
    parser.add_argument("--out", type=Path, help="folder for accelerator.json and the table")
    parser.add_argument("--cores", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--scale", type=int, default=1, help=argparse.SUPPRESS)
    options = parser.parse_args()
    scale = 1000 if options.quick else options.scale
    if options.cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
        options.cores.write_text(json.dumps(measured(scale, True)))
        return
    device = jax.devices()[0].device_kind
    print(f"{device}; {cpu_name()}; {versions()}")
    large = measured(scale, False)
    print("two cores of the CPU, scaled up:")
    small = on_two_cores(scale)
    lines = [f"| work | {device} | two cores | ratio | difference |", "|---|---|---|---|---|"]
    for a, b in zip(large, small, strict=True):
        x, y = np.asarray(a["results"]), np.asarray(b["results"])
        off = float(np.nanmax(np.abs(x - y)) / np.nanmax(np.abs(y)))
        times = f"{a['seconds']:.3g} s | {b['seconds']:.3g} s | {b['seconds'] / a['seconds']:.3g} | {off:.0e}"
        lines.append(f"| {a['number']} {a['name']} | {times} |")
    print("\n" + "\n".join(lines))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "accelerator.json").write_text(json.dumps(dict(device=device, accelerator=large, cores=small)))
        (options.out / "accelerator.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
