"""What exact jams cost: collocation with the carrier eliminated against shooting with RK4, at the same accuracy.

    python benchmarks/orbits.py

Compile and run time apart, the best of several runs; ratios travel between machines, absolute times do not. The machine is
the two-mass one of the antiphase paper with eps = 0.05.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import equinox as eqx
import jax
from jax.flatten_util import ravel_pytree

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxvib as jv  # noqa: E402
from jaxvib.steady.collocation import grid_of, harmonics_of, periodic_motion  # noqa: E402
from jaxvib.steady.jam import jam_rotor_speed  # noqa: E402
from jaxvib.steady.stability import floquet, steps_for  # noqa: E402


def published(eps: float = 0.05, speed: float = 3.0) -> jv.Scene:
    numbers = dict(natural=(1 / 3, 1 / 3), damping=(0.01, 0.01), link_natural=2 / 3, link_damping=0.01, rho=1.0, beta=1.0)
    return jv.Dimensionless("antiphase", **numbers, eps=eps, speed=speed).scene()


def chain(platforms: int) -> jv.Scene:
    """A chain of platforms on supports, the exciter on the second."""
    links = [(k, k + 1) for k in range(1, platforms)]
    machine = jv.network(
        mass=[1.0] * platforms,
        stiffness=[1 / 9] * platforms,
        damping=[0.02] * platforms,
        links=links,
        link_stiffness=[4 / 9] * len(links),
        link_damping=[0.02] * len(links),
        exciter=min(2, platforms),
    )
    return jv.Scene(machine, jv.balls(count=1, mass=0.05, radius=1.0, drag=0.0025), jv.ConstantSpeed(1.0))


def timed(name: str, call: Callable, runs: int) -> tuple[object, float]:
    begin = time.perf_counter()
    result = jax.block_until_ready(call())
    first = time.perf_counter() - begin
    best = np.inf
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        best = min(best, time.perf_counter() - begin)
    print(f"{name:58s} compile {first - best:7.2f} s   run {1e3 * best:9.3f} ms")
    return result, best


@eqx.filter_jit
def collocation(scene: jv.Scene, omega: jax.Array, points: int, multipliers: bool):
    """Batches of 100 orbits: rotor speeds, and multipliers where asked."""
    grid = grid_of(points, True)

    def one(w):
        motion = periodic_motion(scene, grid, "omega", w, jam_rotor_speed(scene, w))
        return motion, harmonics_of(scene, grid, motion)

    def batch(w):
        motion, harmonics = jax.vmap(one, out_axes=-1)(w)
        if not multipliers:
            return motion.rotor_speed, ()
        return motion.rotor_speed, floquet(
            scene, grid, motion, harmonics, jnp.max(steps_for(scene, w, motion.rotor_speed))
        ).roots

    return jax.lax.map(batch, omega.reshape(-1, 100))


@eqx.filter_jit
def shooting(scene: jv.Scene, omega: jax.Array, steps: int, start: jax.Array):
    """Newton on the state at the start of a half-turn and the rotor speed, RK4, the Jacobian by forward mode."""

    def miss(x: jax.Array, w: jax.Array) -> jax.Array:
        at = eqx.tree_at(lambda s: s.drive.speed, scene, x[-1])
        field = jv.vector_field(at)
        state = jv.State(x[0:2], x[2:4], (jnp.zeros(1),), (x[4:5],))
        h = jnp.pi / w / steps

        def step(_, y):
            def moved(k, f):
                return jax.tree.map(lambda a, b: a + f * h * b, y, k)

            k1 = field(0.0, y)
            k2 = field(0.0, moved(k1, 0.5))
            k3 = field(0.0, moved(k2, 0.5))
            k4 = field(0.0, moved(k3, 1.0))
            return jax.tree.map(lambda a, p, q, r, s: a + h / 6.0 * (p + 2 * q + 2 * r + s), y, k1, k2, k3, k4)

        end = jax.lax.fori_loop(0, steps, step, state)
        back = jnp.concatenate([-end.displacement, -end.velocity, end.rate[0]]) - x[:5]
        return jnp.append(back, end.angle[0] - jnp.pi)

    def solve(w, x):
        def newton(_, x):
            return x - jnp.linalg.solve(jax.jacfwd(miss)(x, w), miss(x, w))

        return jax.lax.fori_loop(0, 6, newton, x)[-1]

    return jax.lax.map(lambda a: jax.vmap(solve)(*a), (omega.reshape(-1, 100), start.reshape(-1, 100, 6)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--orbits", type=int, default=2000, help="a multiple of 100")
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    scene = published()
    omega = jnp.linspace(0.3, 1.5, options.orbits)
    exact = np.ravel(collocation(scene, omega, 24, False)[0])

    def error(speeds) -> float:
        return float(np.nanmax(np.abs(np.ravel(speeds) / exact - 1.0)))

    name = f"{options.orbits} orbits, "
    for points in (6, 8, 12):
        result, alone = timed(f"{name}{points} points", lambda p=points: collocation(scene, omega, p, False), options.runs)
        whole = f"{name}{points} points, multipliers"
        _, both = timed(whole, lambda p=points: collocation(scene, omega, p, True), options.runs)
        each, with_all = 1e3 * alone / options.orbits, 1e3 * both / options.orbits
        print(f"    error of n {error(result[0]):.1e}; {each:.4f} ms an orbit, {with_all:.4f} with multipliers")

    def from_leading_order(w):
        displacement = jv.steady_displacement(scene, w)
        return jnp.concatenate([displacement.real, -w * displacement.imag, jnp.stack([w, jam_rotor_speed(scene, w)])])

    start = jax.vmap(from_leading_order)(omega)
    for steps in (32, 128):
        text = f"{name}shooting, RK4, {2 * steps} steps a period"
        result, _ = timed(text, lambda s=steps: shooting(scene, omega, s, start), 2)
        right = np.abs(np.ravel(result) / exact - 1.0) < 1e-3
        worst = error(np.where(right, np.ravel(result), np.nan))
        print(f"    error of n {worst:.1e} where it converged, on {np.mean(right):.1%}")

    times = {}
    for platforms in (2, 20):
        machine = chain(platforms)
        flat, restore = ravel_pytree(machine)
        near = float(jv.natural_frequencies(machine)[1]) * 0.97

        @jax.jit
        def value_and_gradient(x, restore=restore, near=near):
            return jax.value_and_grad(lambda v: jv.jam_orbit(restore(v), near=near, points=16).amplitude[0])(x)

        text = f"value and gradient at a given rotor speed, {platforms} platforms"
        _, times[platforms] = timed(text, lambda f=value_and_gradient, x=flat: f(x), 20 * options.runs)
    print(f"    20 platforms take {times[20] / times[2]:.1f} times as long as 2")


if __name__ == "__main__":
    main()
