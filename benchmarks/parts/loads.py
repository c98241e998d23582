"""Cost of 1, 10, 100 and 1000 loads: an evaluation of the vector field, and a time integration.

    python benchmarks/engine.py --only loads

The vector field is evaluated many times within one compiled loop, so that the time of calls into JAX has no influence. Each
evaluation uses the result of the previous one; the compiler can therefore omit none. The integration has equal steps, and each
load starts at another angle. Times of compilation are separate; the run time is the shortest of several runs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from parts.common import best, first, say
from parts.single import integrator

import jaxvib as jv


def scene(count: int) -> jv.Scene:
    """A two-mass machine with `count` balls of 2 kg together."""
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
    return jv.Scene(machine, jv.balls(count=count, mass=2.0 / count, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))


def evaluation(count: int, evaluations: int) -> tuple[float, float]:
    """Seconds that an evaluation of the vector field takes, seconds to compile."""
    s = scene(count)

    def loop(state: jv.State) -> jv.State:
        field = jv.vector_field(s)

        def step(_: int, y: jv.State) -> jv.State:
            return jax.tree.map(lambda leaf, rate: leaf + 1e-5 * rate, y, field(jnp.zeros(()), y))

        return jax.lax.fori_loop(0, evaluations, step, state)

    run, start = jax.jit(loop), apart(s)
    compiling = first(lambda: run(start))
    return best(lambda: run(start)) / evaluations, compiling


def integration(count: int, steps: int) -> tuple[float, float]:
    """Seconds that a step of a run takes, all of it counted, seconds to compile."""
    s = scene(count)
    run = integrator(s, apart(s))
    end = steps * 1e-3
    compiling = first(lambda: run(s, end, steps))
    return best(lambda: run(s, end, steps), 5) / steps, compiling


def apart(s: jv.Scene) -> jv.State:
    return jv.initial_state(s, "rest", angles=jnp.linspace(0.0, 6.0, s.loads.count))


def growth_with_loads(quick: bool = False) -> None:
    counts = (1, 10) if quick else (1, 10, 100, 1000)
    for group, cost, work in (
        ("vector field over loads", evaluation, lambda n: max(2000, 200_000 // n)),
        ("time integration over loads, a step", integration, lambda n: max(200, 20_000 // n)),
    ):
        print(group)
        base = before = None
        for count in counts:
            seconds, compiling = cost(count, work(count))
            base = seconds if base is None else base
            note = "" if before is None else f"{seconds / before[1] / (count / before[0]):.2f} of linear since the last"
            say(group, "1 load" if count == 1 else f"{count} loads", seconds, base, None, compiling, note, loads=count)
            before = (count, seconds)
