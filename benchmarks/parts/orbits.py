"""Cost of exact jams: collocation without the carrier's unknowns, compared with other methods at the same accuracy.

    python benchmarks/engine.py --only orbits

The other methods are shooting with RK4, collocation of the whole state by jaxcont (if it is installed), and SciPy's solve_bvp.
Times of compilation are separate; the run time is the shortest of several runs. Ratios of times hardly depend on the computer.
The machine is the two-mass machine of the antiphase paper with eps = 0.05.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from parts.common import best, first, published, say

import jaxvib as jv
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_model
from jaxvib.numerics import radau
from jaxvib.numerics.fourier import grid_of
from jaxvib.steady.jams.folds import rotor_speed_at
from jaxvib.steady.orbits.solve import harmonics_of, periodic_motion
from jaxvib.steady.orbits.stability import floquet, steps_for

GROUP = "exact orbits, each"


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


@eqx.filter_jit
def collocation(scene: jv.Scene, omega: jax.Array, points: int, multipliers: bool):
    """Batches of 100 orbits: rotor speeds, and multipliers where asked."""
    model, grid = jammed_bodies(jammed_model(scene)), grid_of(points, True)

    def one(w):
        motion = periodic_motion(model, grid, "omega", w, rotor_speed_at(model.linear, w))
        return motion, harmonics_of(model, grid, motion)

    def batch(w):
        motion, harmonics = jax.vmap(one, out_axes=-1)(w)
        if not multipliers:
            return motion.rotor_speed, ()
        return motion.rotor_speed, floquet(
            model, grid, motion, harmonics, jnp.max(steps_for(model, w, motion.rotor_speed, implicit=False))
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


def with_jaxcont(scene: jv.Scene, omega: jax.Array, base: float, runs: int) -> None:
    """jaxcont's collocation of the whole state: a Newton solution at a rotor speed 0.1 % off the one it starts from."""
    try:
        from jaxcont.core.collocation import Collocation
        from jaxcont.problems.periodic import periodic_orbit_problem
        from jaxcont.solvers.implicit import differentiable_root
    except ImportError:
        print("  jaxcont is not installed: left out")
        return

    def field(u, n, _):
        return paper(u, n)

    for intervals, degree in ((10, 4), (12, 5)):
        errors, fastest, mesh = [], np.inf, Collocation(intervals, degree)
        residual: list[Callable] = []

        @jax.jit
        def solve(u, n, a, b, mesh=mesh, residual=residual):
            return differentiable_root(lambda x, p: residual[0](x, p, (a, b, field, mesh)), u, n, tol=1e-8, max_iter=8)

        for w in map(float, omega):
            orbit, times, states = trajectory(scene, w)
            n, period = orbit.rotor_speed, 2.0 * np.pi / w
            near = periodic_orbit_problem(field, jnp.asarray(states), jnp.asarray(times), period, 1.001 * n, mesh)
            residual.append(near.f)
            found = solve(near.u0, n, *near.args[:2])
            fastest = min(fastest, best(lambda near=near, n=n, solve=solve: solve(near.u0, n, *near.args[:2]), runs))
            # An error of Omega at a given rotor speed is one of the rotor speed at a given Omega.
            errors.append(abs(2.0 * np.pi / found[-1] / w - 1.0) * abs(orbit.slope) * w / n)
        say(GROUP, f"jaxcont, {intervals} intervals of degree {degree}", fastest, base, max(errors))


def with_solve_bvp(omega: jax.Array, base: float) -> None:
    """SciPy's solve_bvp on half a period, from the leading order."""
    from scipy.integrate import solve_bvp

    scene, eps = published(), 0.05
    for tol in (1e-6, 1e-9):
        errors, fastest = [], np.inf
        for w in map(float, omega):
            exact, times, states = trajectory(scene, w)
            half = slice(0, 1001, 25)
            y = states[half].T.copy()
            phi = np.unwrap(np.arctan2(y[5], y[4]))
            y = np.stack([*y[:4], phi, y[6]])
            pinned = phi[0]
            near = y * (1.0 + 1e-3)

            def field(t, y, p, eps=eps):
                full = np.stack([*y[:4], np.cos(y[4]), np.sin(y[4]), y[5]])
                rates = paper(full, p[0], eps, np)
                return np.stack([*rates[:4], y[5], rates[6]])

            def ends(a, b, p, pinned=pinned):
                return np.array([*(a[:4] + b[:4]), b[4] - a[4] - np.pi, b[5] - a[5], a[4] - pinned])

            found: Any = None

            def solve(half=half, near=near, field=field, ends=ends, times=times, exact=exact, tol=tol) -> None:
                nonlocal found
                guess = [1.001 * float(exact.rotor_speed)]
                found = solve_bvp(field, ends, times[half], near, p=guess, tol=tol, max_nodes=20000)

            fastest = min(fastest, first(solve))
            errors.append(abs(found.p[0] / float(exact.rotor_speed) - 1.0) if found.success else np.nan)
        say(GROUP, f"SciPy solve_bvp, tol {tol:.0e}", fastest, base, float(np.nanmax(errors)))


def orbits(quick: bool = False) -> None:
    count, runs = (200, 1) if quick else (2000, 5)
    scene = published()
    omega = jnp.linspace(0.3, 1.5, count)
    print(f"{GROUP}, {count} of them at given load speeds; error: of the rotor speed")
    exact = np.ravel(collocation(scene, omega, 24, False)[0])

    def error(speeds) -> float:
        return float(np.nanmax(np.abs(np.ravel(speeds) / exact - 1.0)))

    base = np.nan
    for points in (8, 6, 12):
        for multipliers in (False, True):

            def call(points: int = points, multipliers: bool = multipliers) -> Any:
                return collocation(scene, omega, points, multipliers)

            compiling, each = first(call), best(call, runs) / count
            base = each if np.isnan(base) else base
            name = f"jaxvib, {points} points" + (", multipliers" if multipliers else "")
            say(GROUP, name, each, base, error(call()[0]), compiling)

    def from_leading_order(w):
        light = jammed_model(scene)
        displacement = light.displacement(w)
        return jnp.concatenate([displacement.real, -w * displacement.imag, jnp.stack([w, rotor_speed_at(light, w)])])

    start = jax.vmap(from_leading_order)(omega)
    for steps in (32,) if quick else (32, 128):

        def shoot(steps: int = steps) -> Any:
            return shooting(scene, omega, steps, start)

        compiling, each, found = first(shoot), best(shoot, 2) / count, np.ravel(shoot())
        right = np.abs(found / exact - 1.0) < 1e-3
        note = f"error where it converged, on {np.mean(right):.1%}"
        say(
            GROUP,
            f"shooting, RK4, {2 * steps} steps a period",
            each,
            base,
            error(np.where(right, found, np.nan)),
            compiling,
            note,
        )

    by_differentiation(scene, quick)
    few = omega[:: max(1, count // 5)][1:]
    with_jaxcont(scene, few, base, runs)
    with_solve_bvp(few[:2] if quick else few, base)
    value_and_gradient(quick, runs)


def by_differentiation(scene: jv.Scene, quick: bool) -> None:
    """Multipliers alone, of 100 motions: `floquet`, whose linearized equations are written by hand, and the full equations
    differentiated along the same motions by Radau's method of order 11, both over half a period."""
    group, omega = "multipliers of an exact orbit", jnp.linspace(0.6, 0.9, 100)
    model, grid = jammed_bodies(jammed_model(scene)), grid_of(16, True)
    print(f"{group}; error: of the largest modulus, to many steps")

    @jax.jit
    def motions(w: jax.Array) -> Any:
        def one(w: jax.Array) -> Any:
            motion = periodic_motion(model, grid, "omega", w, rotor_speed_at(model.linear, w))
            return motion, harmonics_of(model, grid, motion)

        return jax.vmap(one, out_axes=-1)(w)

    motion, harmonics = motions(omega)
    k, j = np.asarray(grid.orders), np.asarray(grid.deviation_orders)

    def along(theta: jax.Array, q: jax.Array, psi: jax.Array) -> jax.Array:
        wave, lag = jnp.exp(1j * k * theta), jnp.exp(1j * j * theta)
        angle, rate = theta + (psi @ lag).real, 1.0 + (psi @ (1j * j * lag)).real
        return jnp.concatenate([(q @ wave).real, angle, (q @ (1j * k * wave)).real, rate])

    def differentiated(steps: int) -> Callable[[], Any]:
        def one(w: jax.Array, n: jax.Array, q: jax.Array, psi: jax.Array) -> jax.Array:
            field = jv.vector_field(eqx.tree_at(lambda s: s.drive.speed, scene, n))

            def acceleration(y: jax.Array) -> jax.Array:
                change = field(0.0, jv.State(y[:2], w * y[3:5], (y[2:3],), (w * y[5:6],)))
                return jnp.concatenate([change.velocity, change.rate[0]]) / w**2

            def step(flow: jax.Array, at: jax.Array) -> tuple[jax.Array, None]:
                points = (at + radau.NODES) * h
                slopes = jax.vmap(lambda t: jax.jacfwd(acceleration)(along(t, q, psi)))(points)
                return radau.transition(slopes, h) @ flow, None

            h = np.pi / steps
            return jax.lax.scan(step, jnp.eye(6), jnp.arange(steps) * 1.0)[0]

        call = jax.jit(jax.vmap(one, in_axes=(0, 0, -1, -1)))
        return lambda: call(motion.omega, motion.rotor_speed, harmonics.displacement, harmonics.deviation)

    def largest(flow: Any) -> np.ndarray:
        """Half a period turns the directions of the carrier: an orbit comes back to its mirror image."""
        mirrored = np.asarray(flow) * np.asarray([-1.0, -1.0, 1.0] * 2)[None, :, None]
        values = np.sort(np.abs(np.linalg.eigvals(mirrored)), axis=1)
        return values[:, -2]  # the one before the trivial 1, where the motion is stable

    @jax.jit
    def written(steps: jax.Array) -> jax.Array:
        return floquet(model, grid, motion, harmonics, steps).roots

    exact = largest(differentiated(128)())
    stable = exact < 1.0 - 1e-6
    base = None
    for steps in (8, 16) if quick else (8, 16, 32):
        for name, call, modulus in (
            ("floquet", lambda n=steps: written(jnp.asarray(n)), lambda x: np.max(np.abs(np.asarray(x)), axis=0)),
            ("full equations differentiated", differentiated(steps), largest),
        ):
            compiling, each = first(call), best(call, 5) / omega.size
            base = each if base is None else base
            off = float(np.max(np.abs(modulus(call()) / exact - 1.0)[stable]))
            say(group, f"{name}, {steps} steps", each, base, off, compiling)


def value_and_gradient(quick: bool, runs: int) -> None:
    """Value and gradient at a given rotor speed, with respect to every number of the machine."""
    group, base = "exact orbit and its gradient", None
    print(f"{group}; error: of the load speed, to 16 points")
    for platforms in (2,) if quick else (2, 20):
        for points in (8, 16):
            machine = chain(platforms)
            flat, restore = ravel_pytree(machine)
            modes = jv.jam_modes(machine)
            mode = next(k for k in modes.mode_numbers() if k % 2 == 1)
            near = float(modes.select(mode).omega)

            @jax.jit
            def call(x, restore=restore, near=near, points=points):
                return jax.value_and_grad(lambda v: jv.jam_orbit(restore(v), near=near, points=points).amplitude[0])(x)

            compiling = first(lambda call=call, x=flat: call(x))
            seconds = best(lambda call=call, x=flat: call(x), 40 * runs)
            base = seconds if base is None else base
            at, rough = (jv.jam_orbit(machine, near=near, points=p, throw=False) for p in (16, points))
            off = None if points == 16 else abs(float(rough.omega / at.omega) - 1.0)
            say(group, f"{platforms} platforms, {points} points", seconds, base, off, compiling)
