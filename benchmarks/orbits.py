"""What exact jams cost: collocation with the carrier eliminated against other ways to the same orbits, at the same accuracy.

    python benchmarks/orbits.py

Peers: shooting with RK4, jaxcont's collocation of the whole state (left out where it is not installed), SciPy's solve_bvp.
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
from jaxvib.steady.collocation import harmonics_of, periodic_motion  # noqa: E402
from jaxvib.steady.grid import grid_of  # noqa: E402
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


def paper(u: jax.Array, n: jax.Array, eps: float = 0.05, np=jnp) -> jax.Array:
    """The antiphase paper's equation (2) with one load: v1, v1', v2, v2', cos phi, sin phi, phi'; the circle attracts."""
    v1, w1, v2, w2, c, s, rate = u
    link = 0.02 * (w1 - w2) + 4 / 9 * (v1 - v2)
    right, pull = -0.02 * w2 - v2 / 9 + link + s * rate**2, eps * (n - rate)
    a2 = (right - c * pull) / (1.0 - eps * c * c)
    round_ = 1.0 - c * c - s * s
    turn = (c * round_ - s * rate, s * round_ + c * rate)
    return np.stack([w1, -0.02 * w1 - v1 / 9 - link, w2, a2, *turn, pull - eps * c * a2])


def trajectory(scene: jv.Scene, omega: float) -> tuple[jv.Orbit, np.ndarray, np.ndarray]:
    """An exact jam, a period of times and the state of `paper` there."""
    orbit = jv.jam_orbit(scene, omega=omega, points=24)
    theta = np.linspace(0.0, 2.0 * np.pi, 2001)
    q, velocity, (phi,), (rate,) = jax.vmap(orbit.at)(jnp.asarray(theta))
    length = 0.05 * scene.loads.inertia_factor() * scene.loads.radius
    v, w = q / length, velocity / length
    state = np.stack([v[:, 0], w[:, 0], v[:, 1], w[:, 1], np.cos(phi[:, 0]), np.sin(phi[:, 0]), rate[:, 0]], axis=1)
    return orbit, theta / omega, state


def with_jaxcont(scene: jv.Scene, omega: jax.Array, runs: int) -> None:
    """jaxcont's collocation of the whole state: a Newton solution at a rotor speed 0.1 % off the one it starts from."""
    try:
        from jaxcont.core.collocation import Collocation
        from jaxcont.problems.periodic import periodic_orbit_problem
        from jaxcont.solvers.implicit import differentiable_root
    except ImportError:
        print("jaxcont is not installed: left out")
        return

    def field(u, n, _):
        return paper(u, n)

    for intervals, degree in ((10, 4), (12, 5)):
        errors, best, mesh = [], np.inf, Collocation(intervals, degree)
        residual: list[Callable] = []

        @jax.jit
        def solve(u, n, a, b, mesh=mesh, residual=residual):
            return differentiable_root(lambda x, p: residual[0](x, p, (a, b, field, mesh)), u, n, tol=1e-8, max_iter=8)

        for w in map(float, omega):
            orbit, times, states = trajectory(scene, w)
            n, period = orbit.rotor_speed, 2.0 * np.pi / w
            near = periodic_orbit_problem(field, jnp.asarray(states), jnp.asarray(times), period, 1.001 * n, mesh)
            residual.append(near.f)
            for _ in range(runs + 1):
                begin = time.perf_counter()
                found = jax.block_until_ready(solve(near.u0, n, *near.args[:2]))
                best = min(best, time.perf_counter() - begin)
            # An error of Omega at a given rotor speed is one of the rotor speed at a given Omega.
            errors.append(abs(2.0 * np.pi / found[-1] / w - 1.0) * abs(orbit.slope) * w / n)
        name = f"jaxcont, {intervals} intervals of degree {degree}, one orbit"
        print(f"{name:58s} run {1e3 * best:9.3f} ms\n    error of n {max(errors):.1e}")


def with_solve_bvp(omega: jax.Array) -> None:
    """SciPy's solve_bvp on half a period, from the leading order."""
    from scipy.integrate import solve_bvp

    scene, eps = published(), 0.05
    for tol in (1e-6, 1e-9):
        errors, best = [], np.inf
        for w in map(float, omega):
            exact, times, states = trajectory(scene, w)
            half = slice(0, 1001, 25)
            y = states[half].T.copy()
            phi = np.unwrap(np.arctan2(y[5], y[4]))
            y = np.stack([*y[:4], phi, y[6]])
            first = phi[0]
            near = y * (1.0 + 1e-3)

            def field(t, y, p, eps=eps):
                full = np.stack([*y[:4], np.cos(y[4]), np.sin(y[4]), y[5]])
                rates = paper(full, p[0], eps, np)
                return np.stack([*rates[:4], y[5], rates[6]])

            def ends(a, b, p, first=first):
                return np.array([*(a[:4] + b[:4]), b[4] - a[4] - np.pi, b[5] - a[5], a[4] - first])

            begin = time.perf_counter()
            found = solve_bvp(field, ends, times[half], near, p=[1.001 * float(exact.rotor_speed)], tol=tol, max_nodes=20000)
            best = min(best, time.perf_counter() - begin)
            errors.append(abs(found.p[0] / float(exact.rotor_speed) - 1.0) if found.success else np.nan)
        name = f"SciPy solve_bvp, tol {tol:.0e}, one orbit"
        print(f"{name:58s} run {1e3 * best:9.3f} ms\n    error of n {np.nanmax(errors):.1e}")


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

    few = omega[:: max(1, options.orbits // 5)][1:]
    with_jaxcont(scene, few, options.runs)
    with_solve_bvp(few)

    for points in (8, 16):
        times = {}
        for platforms in (2, 20):
            machine = chain(platforms)
            flat, restore = ravel_pytree(machine)
            modes = jv.jam_modes(machine)
            mode = next(k for k in modes.mode_numbers() if k % 2 == 1)
            near = float(modes.select(mode).omega)

            @jax.jit
            def value_and_gradient(x, restore=restore, near=near, points=points):
                return jax.value_and_grad(lambda v: jv.jam_orbit(restore(v), near=near, points=points).amplitude[0])(x)

            text = f"value and gradient at a given n, {platforms} platforms, {points} points"
            _, times[platforms] = timed(text, lambda f=value_and_gradient, x=flat: f(x), 40 * options.runs)
            at = jv.jam_orbit(machine, near=near, points=16)
            rough = jv.jam_orbit(machine, near=near, points=points, throw=False)
            print(f"    error of Omega {abs(float(rough.omega / at.omega) - 1.0):.1e} (against 16 points)")
        print(f"    20 platforms take {times[20] / times[2]:.1f} times as long as 2")


if __name__ == "__main__":
    main()
