"""Cost of the equations of motion, and of a step of averaged runs, with 1 to 64 exciters.

    python benchmarks/exciters/cost_by_count.py

Times are CPU times. The first call includes tracing and compilation.
"""

from __future__ import annotations

import os
import time

import jax
import jax.numpy as jnp

import jaxvib as jv
from jaxvib.runtime.operations import count_operations

os.environ["JAXVIB_AUTOMATIC"] = "off"  # no program comes from a cache
jv.prepare_cpu()

jax.config.update("jax_enable_x64", True)

COUNTS = (1, 2, 4, 8, 16, 32, 64)
REPEATS = 2000


def screen(count: int) -> jv.Scene:
    """Body of 2000 kg with motors in both directions."""
    springs = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
    body = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    motor = jv.DCMotor(100.0, stall_torque=300.0, inertia=0.5)
    places = [(-1.0 + 2.0 * (k + 0.5) / count, 0.1 * (k % 3)) for k in range(count)]
    exciters = [jv.Exciter(drive=motor, unbalance=1.5 / count, at=at, direction=(1, -1)[k % 2]) for k, at in enumerate(places)]
    return jv.Scene(body, exciters=exciters)


def row(count: int) -> tuple[int, int, float, float]:
    """Return the operations of the program, arithmetic operations of a call, seconds of the first and of a later call."""
    scene = screen(count)
    state = jv.initial_state(scene)

    def field(s: jv.State) -> jv.State:
        return jv.vector_field(scene)(jnp.zeros(()), s)

    @jax.jit
    def many(s: jv.State) -> jv.State:
        return jax.lax.fori_loop(0, REPEATS, lambda _, x: jax.tree.map(lambda a, b: a + 1e-9 * b, x, field(x)), s)

    analysis = jax.jit(field).lower(state).cost_analysis()
    assert analysis is not None
    flops = int(analysis["flops"])
    begun = time.process_time()
    jax.block_until_ready(many(state))
    first = time.process_time() - begun
    later = []
    for _ in range(5):
        begun = time.process_time()
        jax.block_until_ready(many(state))
        later.append((time.process_time() - begun) / REPEATS)
    return count_operations(field, state), flops, first, min(later)


def averaged_row(count: int) -> tuple[float, float]:
    """Return seconds of the first averaged run, and of a step of a later one."""
    scene, times = screen(count), []
    for _ in range(5):
        begun = time.process_time()
        run = jv.envelope(scene, 5.0, save="window", throw=False)
        jax.block_until_ready(run.omega)
        times.append(time.process_time() - begun)
    return times[0], min(times[1:]) / int(run.steps + run.rejected)


def main() -> None:
    first = None
    print("equations of motion")
    print("exciters  program operations  arithmetic operations  first call  later call (each relative to 1 exciter)")
    for count in COUNTS:
        found = row(count)
        first = found if first is None else first
        ratios = "  ".join(f"{a / b:8.2f}" for a, b in zip(found, first, strict=True))
        print(f"{count:8d}  {found[0]:6d} {found[1]:6d} {found[2]:7.2f} s {1e9 * found[3]:8.0f} ns   {ratios}")
    first = None
    print("averaged run, 5 s\nexciters  first call  step of a later call (each relative to 1 exciter)")
    for count in COUNTS:
        averaged = averaged_row(count)
        first = averaged if first is None else first
        ratios = "  ".join(f"{a / b:8.2f}" for a, b in zip(averaged, first, strict=True))
        print(f"{count:8d}  {averaged[0]:7.2f} s {1e6 * averaged[1]:8.1f} us   {ratios}")


if __name__ == "__main__":
    main()
