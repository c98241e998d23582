"""The design search against searches without gradients, on a chain of platforms with every spring free.

Asked is a small foundation force per amplitude of the chain's ends in its highest odd jam mode with springs that differ little
from those that are there: (force per amplitude / 1 N/mm)^2 + the mean of (ln k/k0)^2. All searches see the same objective
between the same bounds and follow the jam from a near design; designs without it count as infinitely bad.

What is compared is when each has first come within 1 % of the least value that any of them found: in seconds and in
evaluations, of a value with its gradient where gradients are used, of a value elsewhere. Programs are compiled before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.runtime.many import in_chunks
from optimize import DesignSpace, Quantity, force_per_amplitude
from optimize.search import descent, find, model, polish
from optimize.search.problem import Point, Problem, looked_up, problem_of

__all__ = ["SIZES", "chain", "gradient_cost", "race"]

SIZES = {3: 2, 10: 5, 30: 15, 100: 50}
"""Platforms by how many numbers are free: all springs, and from 10 on the loads' drag."""


class Course(NamedTuple):
    """How a search went: seconds and evaluations, and the least value by then."""

    seconds: list[float]
    evaluations: list[int]
    values: list[float]

    def reached(self, value: float) -> str:
        """When the search came to a value."""
        for s, n, v in zip(*self, strict=True):
            if v <= value:
                return f"{n} evaluations, {s:.1f} s"
        return f"not reached, {min(self.values):.4g} after {self.evaluations[-1]} evaluations, {self.seconds[-1]:.0f} s"


def chain(free: int) -> tuple[DesignSpace, Quantity]:
    """The space and the objective with so many free numbers."""
    n = SIZES[free]
    machine = jv.network(
        mass=[100.0] * n, stiffness=[2e4] * n, damping=[30.0] * n, links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[2e5] * (n - 1), link_damping=[30.0] * (n - 1), exciter=n,
    )  # fmt: skip
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.3, radius=0.1, drag=0.5), jv.ConstantSpeed(120.0))
    numbers = {"machine.stiffness": (5e3, 1e5), "machine.link_stiffness": (5e4, 5e5)}
    if free > 2 * n - 1:
        numbers["loads.drag"] = (0.3, 1.0)
    space = DesignSpace(scene, numbers)
    assert space.size == free
    mode = max(m for m in jv.jam_modes(scene).mode_numbers() if m % 2)
    there = jnp.concatenate([place.read(scene) for place in space.places])

    def change(s: jv.Scene) -> jax.Array:
        return jnp.mean(jnp.log(jnp.concatenate([place.read(s) for place in space.places]) / there) ** 2)

    return space, (force_per_amplitude(mode=mode, of=(1, n)) / "1 N/mm") ** 2 + Quantity("change of springs", "", change)


def gradient_cost(free: int, repeat: int = 200) -> tuple[float, float]:
    """Seconds of processor of one value, and of one with its gradient: one design, followed from the jam it is at."""
    space, wish = chain(free)
    problem = problem_of(space, wish, ())
    z = np.asarray(space.where(space.scene))
    near = tuple(jnp.asarray(w[0]) for w in looked_up(problem, z[None]))

    def value(x: jax.Array) -> jax.Array:
        return problem.values(x, near)[0][0]

    def timed(function: Callable[[jax.Array], object]) -> float:
        jax.block_until_ready(function(jnp.asarray(z)))
        least = np.inf
        for _ in range(5):
            begun = time.process_time()
            for _ in range(repeat):
                out = function(jnp.asarray(z))
            jax.block_until_ready(out)  # pyright: ignore
            least = min(least, (time.process_time() - begun) / repeat)
        return least

    return timed(jax.jit(value)), timed(jax.jit(jax.value_and_grad(value)))


def by_gradients(problem: Problem, starts: int, iterations: int, polishing: int, seed: int = 0) -> Course:
    """The search of `synthesize`, watched."""
    course, counted = Course([], [], []), [0]
    inner = model.evaluate

    def watched(problem: Problem, z: np.ndarray, near: tuple[np.ndarray, ...]) -> Point:
        counted[0] += len(z)
        return inner(problem, z, near)

    def told(_share: float, point: Point) -> None:
        counted[0] += descending[0] * starts * descent.STRETCH
        values = point.values[np.isfinite(point.values[:, 0]), 0]
        for row, new in zip(course, (time.perf_counter() - begun, counted[0], float(np.min(values))), strict=True):
            row.append(new)

    kept = [(module, module.evaluate) for module in (model, polish, find)]
    for module, _ in kept:
        module.evaluate = watched
    try:
        begun = time.perf_counter()
        drawn = polish.draw_starts(problem, starts, seed, looked_up)
        assert drawn.point is not None
        descending = [1]
        point = descent.descend(problem, drawn.point, iterations, 0.05, told).point
        descending[0] = 0
        best = np.argsort(point.values[:, 0])[: max(1, starts // 4)]
        polish.polish(problem, point.take(best), polishing, told)
    finally:
        for module, old in kept:
            module.evaluate = old
    return course


@eqx.filter_jit
def _one_by_one(problem: Problem, z: jax.Array, near: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    return jax.vmap(lambda x, w: problem.values(x, w))(z, near)


class Values:
    """Values of populations, their jams followed from the nearest of the last designs; looked up where that leads nowhere."""

    def __init__(self, problem: Problem):
        self.problem, self.begun, self.course = problem, time.perf_counter(), Course([], [], [])
        self.z, self.near = np.zeros((0, problem.space.size)), np.zeros(0)

    def of(self, z: np.ndarray) -> np.ndarray:
        """Those of the designs z (s, d), noted in the course."""
        z = np.clip(z, 0.0, 1.0)
        near = np.full(len(z), np.nan)
        if len(self.z):
            nearest = np.argmin(np.sum((z[:, None] - self.z[None, -200:]) ** 2, axis=2), axis=1)
            near = self.near[-200:][nearest]
        found, omega = self._at(z, near)
        lost = np.flatnonzero(~np.isfinite(found))
        if len(lost):
            found[lost], omega[lost] = self._at(z[lost], looked_up(self.problem, z[lost])[0])
        good = np.isfinite(found)
        self.z, self.near = np.concatenate([self.z, z[good]])[-200:], np.concatenate([self.near, omega[good]])[-200:]
        found = np.where(good, found, 1e12)
        self._note(found)
        return found

    def _at(self, z: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, (omega,) = in_chunks(self.problem.lanes, lambda x, w: _one_by_one(self.problem, x, (w,)), z, near)
        return np.array(found[:, 0]), np.array(omega)

    def _note(self, found: np.ndarray) -> None:
        evaluations, values = self.course.evaluations, self.course.values
        evaluations.append(sum(evaluations[-1:]) + len(found))
        self.course.seconds.append(time.perf_counter() - self.begun)
        values.append(min([float(found.min()), *values[-1:]]))


def by_differential_evolution(problem: Problem, seconds: float, seed: int = 0) -> Course:
    """SciPy's differential evolution, its population of 8 d evaluated at once."""
    from scipy.optimize import differential_evolution

    values = Values(problem)
    differential_evolution(
        lambda z: values.of(np.asarray(z.T)), [(0.0, 1.0)] * problem.space.size, vectorized=True,
        updating="deferred", maxiter=100_000, popsize=8, seed=seed, polish=False, tol=0.0,
        callback=lambda *_args, **_more: time.perf_counter() - values.begun > seconds,
    )  # fmt: skip
    return values.course


def by_evolution_strategy(problem: Problem, seconds: float, seed: int = 1) -> Course:
    """CMA-ES (package cma), begun anew with twice the population where it has settled."""
    import cma

    values, population = Values(problem), 4 + int(3 * np.log(problem.space.size))
    while time.perf_counter() - values.begun < seconds:
        random = np.random.default_rng(seed)
        es = cma.CMAEvolutionStrategy(
            random.uniform(size=problem.space.size), 0.3,
            {"bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": population},
        )  # fmt: skip
        while not es.stop() and time.perf_counter() - values.begun < seconds:
            z = es.ask()
            es.tell(z, list(values.of(np.asarray(z))))
        seed, population = seed + 1, 2 * population
    return values.course


def race(free: int, seconds: float) -> None:
    """Prints when each search came within 1 % of the least value found."""
    space, wish = chain(free)
    problem = problem_of(space, wish, ())
    settings = (16, 200, 10 if free <= 30 else 3)
    by_gradients(problem, *settings)
    Values(problem).of(np.full((1, free), 0.5))
    courses = {
        "gradients, 16 starts": by_gradients(problem, *settings),
        "CMA-ES": by_evolution_strategy(problem, seconds),
        "differential evolution": by_differential_evolution(problem, seconds),
    }
    least = min(course.values[-1] for course in courses.values())
    print(f"{free} free numbers, {SIZES[free]} platforms; least value {least:.6g}")
    for name, course in courses.items():
        print(f"  {name}: best {min(course.values):.6g}; within 1 %: {course.reached(1.01 * least)}", flush=True)
