"""What one evaluation of the vector field costs with 1, 10, 100, 1000 loads: it should grow no faster than their number.

    python benchmarks/loads.py

The field is evaluated many times inside one compiled loop, so that the cost of calling into JAX does not count; each
evaluation uses the last one's result, so that none is left out. Compile time is told apart; of 7 runs the fastest counts.
"""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp

import jaxvib as jv

jax.config.update("jax_enable_x64", True)

COUNTS = (1, 10, 100, 1000)
RUNS = 7


def scene(count: int) -> jv.Scene:
    """A two-mass machine with `count` balls of 2 kg together."""
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
    return jv.Scene(machine, jv.balls(count=count, mass=2.0 / count, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))


def cost(count: int, evaluations: int) -> tuple[float, float]:
    """Seconds to compile, and seconds an evaluation takes."""
    s = scene(count)
    start = jv.initial_state(s, "rest", angles=jnp.linspace(0.0, 6.0, count))

    def loop(state: jv.State) -> jv.State:
        field = jv.vector_field(s)

        def step(_: int, y: jv.State) -> jv.State:
            return jax.tree.map(lambda leaf, rate: leaf + 1e-5 * rate, y, field(jnp.zeros(()), y))

        return jax.lax.fori_loop(0, evaluations, step, state)

    begun = time.perf_counter()
    compiled = jax.jit(loop).lower(start).compile()
    compiling = time.perf_counter() - begun
    best = float("inf")
    for _ in range(RUNS):
        begun = time.perf_counter()
        jax.block_until_ready(compiled(start))
        best = min(best, time.perf_counter() - begun)
    return compiling, best / evaluations


def main() -> None:
    """Prints the table."""
    print(f"{'loads':>6} {'compile, s':>11} {'evaluation, us':>15} {'per load, us':>13} {'growth':>7} {'of linear':>10}")
    before = None
    for count in COUNTS:
        compiling, each = cost(count, max(2000, 200_000 // count))
        growth = "" if before is None else f"{each / before[1]:7.2f} {each / before[1] / (count / before[0]):10.2f}"
        print(f"{count:6d} {compiling:11.2f} {1e6 * each:15.3f} {1e6 * each / count:13.4f} {growth}")
        before = (count, each)


if __name__ == "__main__":
    main()
