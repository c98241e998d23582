"""Time to evaluate the criterion of auto-balancing for 100,000 random machines; times of compilation and run are separate.

    python benchmarks/criterion.py [count | --quick]

Each machine has random masses, stiffnesses and dampings, uniformly distributed from 0.3 to 3 times a value, and two loads, each
with 1 % of the mass of a platform for which this factor is 1. The criterion is evaluated without and with damping in one
`vmap`. The run time is the shortest of five runs. --quick evaluates 1000 machines, as a test of the program.
"""

from __future__ import annotations

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv

jv.prepare_cpu()

NAMES = ("mass", "stiffness", "damping", "link_stiffness", "link_damping")


def template(platforms: int) -> jv.Scene:
    ones = [1.0] * platforms
    if platforms == 1:
        machine = jv.one_mass(mass=1.0, stiffness=1.0, damping=1.0)
    elif platforms == 2:
        machine = jv.two_mass(mass=ones, stiffness=ones, damping=ones, link_stiffness=1.0, link_damping=1.0)
    else:
        machine = jv.three_mass(mass=ones, stiffness=ones, damping=ones, link_stiffness=ones, link_damping=ones)
    return jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))


def main(count: int) -> None:
    rng = np.random.default_rng(0)
    unit = {"mass": 50.0, "stiffness": 4e4, "damping": 40.0, "link_stiffness": 4e4, "link_damping": 40.0}
    print(f"{count} machines, {jax.devices()[0].device_kind}, float64")
    for platforms in (1, 2, 3):
        base = template(platforms)
        drawn = tuple(
            jnp.asarray(unit[name] * rng.uniform(0.3, 3.0, (count, *getattr(base.machine, name).shape))) for name in NAMES
        )

        def judged(values: tuple[jax.Array, ...], base: jv.Scene = base) -> tuple[jax.Array, jax.Array]:
            machine = eqx.tree_at(lambda m: tuple(getattr(m, name) for name in NAMES), base.machine, values)
            result = jv.criterion(eqx.tree_at(lambda s: s.machine, base, machine))
            return result.balancing, result.undamped_balancing

        start = time.perf_counter()
        compiled = jax.jit(jax.vmap(judged)).lower(drawn).compile()
        compile_time = time.perf_counter() - start
        times = []
        for _ in range(5):
            start = time.perf_counter()
            result = jax.block_until_ready(compiled(drawn))
            times.append(time.perf_counter() - start)
        merged = float(jnp.mean(jnp.any(jnp.isnan(result[0]), axis=(1, 2))))
        print(
            f"{platforms} platforms: compile {compile_time:.2f} s, run {min(times):.2f} s "
            f"({min(times) / count * 1e6:.1f} us a machine), {merged:.0%} with a pair of boundaries damped away"
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", nargs="?", type=float, default=1e5)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    main(1000 if given.quick else int(given.count))
