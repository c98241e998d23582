"""Search of designs by gradients compared with searches without gradients, for a chain of platforms with all springs free.

The objective is a small foundation force per amplitude of the ends of the chain, in its highest odd jam mode, with springs that
differ little from the original ones: (force per amplitude / 1 N/mm)^2 + mean of (ln k/k0)^2. All searches have the same
objective and the same bounds, and follow the jam from a nearby design. A design without this jam has an infinite objective.

The result of a search is the effort until it is first within 1 % of the smallest value that any search found: the time, and the
number of evaluations (of the value with its gradient for searches with gradients, otherwise of the value). Programs are
compiled before.
"""

from __future__ import annotations

import contextlib
import time
import unittest.mock
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from optimize import DesignSpace, Quantity, force_per_amplitude
from optimize.search import descent, find, model, polish
from optimize.search.evolve import PopulationValues, evolve
from optimize.search.problem import Point, Problem, find_speeds, problem_of

__all__ = ["SIZES", "chain", "gradient_cost", "race"]

SIZES = {3: 2, 10: 5, 30: 15, 100: 50}
"""Platforms by how many numbers are free: all springs, and from 10 on the loads' drag."""


_LARGEST_POPULATION = 30
"""Free numbers up to which differential evolution takes part."""

Report = Callable[[float, Point], None]
"""Function that a search calls with the share of its steps and the present designs."""


class Course(NamedTuple):
    """Progress of a search: seconds and evaluations, and the least value by then."""

    seconds: list[float]
    evaluations: list[int]
    values: list[float]

    def reached(self, value: float) -> str:
        """Text of the time at which the search reached a value."""
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
    there = jnp.concatenate([place.read(scene) for place in space.free])

    def change(s: jv.Scene) -> jax.Array:
        return jnp.mean(jnp.log(jnp.concatenate([place.read(s) for place in space.free]) / there) ** 2)

    return space, (force_per_amplitude(mode=mode, of=(1, n)) / "1 N/mm") ** 2 + Quantity("change of springs", "", change)


def gradient_cost(free: int, repeat: int = 200) -> tuple[float, float]:
    """CPU seconds of one value, and of one with its gradient: one design, followed from the jam it is at."""
    space, wish = chain(free)
    problem = problem_of(space, wish, ())
    z = np.asarray(space.where(space.scene))
    near = tuple(jnp.asarray(w[0]) for w in find_speeds(problem, z[None]))

    def value(x: jax.Array) -> jax.Array:
        return problem.values(x, near)[0][0]

    def timed(function: Callable[[jax.Array], object]) -> float:
        jax.block_until_ready(function(jnp.asarray(z)))
        least = np.inf
        for _ in range(5):
            begun = time.process_time()
            for _ in range(repeat):
                out = function(jnp.asarray(z))
            jax.block_until_ready(out)
            least = min(least, (time.process_time() - begun) / repeat)
        return least

    return timed(jax.jit(value)), timed(jax.jit(jax.value_and_grad(value)))


def by_gradients(problem: Problem, polishing: int, seconds: float) -> Course:
    """The search of `synthesize`: from 16 starts, and anew from four times as many while there is time.

    It is repeated to count its evaluations, because programs of functions that are replaced are compiled anew.
    """
    course, begun, rounds = Course([], [], []), time.perf_counter(), 0

    def told(_share: float, point: Point) -> None:
        course.seconds.append(time.perf_counter() - begun)
        course.values.append(float(np.min(point.values[np.isfinite(point.values[:, 0]), 0])))

    while not rounds or course.seconds[-1] < seconds / 5.0:  # the next round takes four times as long
        search_once(problem, 16 * 4**rounds, polishing, told, told)
        rounds += 1
    course.evaluations.extend(evaluations_of(problem, polishing, rounds))
    return course


def search_once(problem: Problem, starts: int, polishing: int, descended: Report, polished: Report) -> None:
    """Descend from `starts` designs and polish a quarter of them."""
    drawn = polish.draw_starts(problem, starts, starts, find_speeds)
    assert drawn.point is not None
    point = descent.descend(problem, drawn.point, 200, 0.05, descended).point
    best = np.argsort(point.values[:, 0])[: starts // 4]
    polish.polish(problem, point.take(best), polishing, polished)


def evaluations_of(problem: Problem, polishing: int, rounds: int) -> list[int]:
    """Number of evaluations at each report of the search."""
    inner, counted = model.evaluate, [0]
    reports: list[int] = []

    def watched(problem: Problem, z: np.ndarray, near: tuple[np.ndarray, ...]) -> Point:
        counted[0] += len(z)
        return inner(problem, z, near)

    def descended(_share: float, point: Point) -> None:
        counted[0] += len(point.z) * descent.STEPS_PER_CALL
        reports.append(counted[0])

    with contextlib.ExitStack() as stack:
        for module in (model, polish, find):
            stack.enter_context(unittest.mock.patch.object(module, "evaluate", watched))
        for k in range(rounds):
            search_once(problem, 16 * 4**k, polishing, descended, lambda *_: reports.append(counted[0]))
    return reports


def by_differential_evolution(problem: Problem, seconds: float, seed: int = 0) -> Course:
    """SciPy's differential evolution, its population of 8 d evaluated at once."""
    from scipy.optimize import differential_evolution

    followed, course, begun = PopulationValues(problem), Course([], [], []), time.perf_counter()

    def values(z: np.ndarray) -> np.ndarray:
        found = followed.of(np.clip(z.T, 0.0, 1.0))[:, 0]
        found = np.where(np.isfinite(found), found, 1e12)
        course.seconds.append(time.perf_counter() - begun)
        course.evaluations.append(sum(course.evaluations[-1:]) + len(found))
        course.values.append(min([float(found.min()), *course.values[-1:]]))
        return found

    differential_evolution(
        values, [(0.0, 1.0)] * problem.space.size, vectorized=True,
        updating="deferred", maxiter=100_000, popsize=8, seed=seed, polish=False, tol=0.0,
        callback=lambda *_args, **_more: course.seconds[-1] > seconds,
    )  # fmt: skip
    return course


def by_evolution_strategy(problem: Problem, seconds: float, seed: int = 0) -> Course:
    """The search of `synthesize` by CMA-ES, without its polishing, until its time is over."""
    course, begun, most = Course([], [], []), time.perf_counter(), 10**9

    def told(share: float, least: float) -> None:
        now = time.perf_counter() - begun
        for row, new in zip(course, (now, round(share * most), least), strict=True):
            row.append(new)
        if now > seconds:
            raise KeyboardInterrupt

    evolve(problem, most, seed, told)
    return course


def race(free: int, seconds: float) -> None:
    """Prints when each search came within 1 % of the least value found."""
    space, wish = chain(free)
    problem = problem_of(space, wish, ())
    polishing = 10 if free <= 30 else 3
    by_gradients(problem, polishing, 0.0)
    PopulationValues(problem).of(np.full((1, free), 0.5))
    print(f"{free} free numbers, {SIZES[free]} platforms")
    courses: dict[str, Course] = {}
    for name, search in (
        ("gradients", lambda: by_gradients(problem, polishing, seconds)),
        ("CMA-ES", lambda: by_evolution_strategy(problem, seconds)),
        ("differential evolution", lambda: by_differential_evolution(problem, seconds)),
    ):
        # The first population for 50 platforms has 800 designs.
        if name == "differential evolution" and free > _LARGEST_POPULATION:
            continue
        courses[name] = course = search()
        print(f"  {name}: best {min(course.values):.6g} after {course.evaluations[-1]} evaluations", flush=True)
    least = min(min(course.values) for course in courses.values())
    for name, course in courses.items():
        print(f"  {name}, within 1 % of {least:.6g}: {course.reached(1.01 * least)}", flush=True)
