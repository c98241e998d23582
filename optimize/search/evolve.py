"""CMA-ES: a search without derivatives, for objectives with many local minima."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from optimize.quantities.evaluation import mapped
from optimize.search.problem import Point, Problem, Speeds, evaluate, find_speeds

_VIOLATION_PENALTY = 10.0
"""Penalty of a demand or held quantity that is violated by 100 %, in units of the median objective of the first designs."""

_DESIGNS_PER_BATCH = 8
"""Number of designs in a batch. Populations are small, and usually only a few of their designs need a search on the whole
branch."""

_MAX_STORED_DESIGNS = 200
"""Number of the latest designs whose jams are stored."""

_POLISHED_DESIGNS = 8
"""Largest number of designs that are polished."""

_MIN_DESIGN_DISTANCE = 1e-2
"""Smallest distance between two polished designs: the largest difference of a free parameter, relative to its range."""

_MERIT_WITHOUT_OBJECTIVE = 1e12
"""Merit of a design for which a quantity does not exist."""


class Evolved(NamedTuple):
    """Result of an evolution.

    **Attributes**: `point`: the best distinct designs, None if the objective exists for no design; `history` (g, 1, 2): the
    objective and the largest violation of the best design of each generation; `drawn`: number of computed designs; `existing`:
    number of these for which the objective exists; `interrupted`: True if the user interrupted the search.
    """

    point: Point | None
    history: np.ndarray
    drawn: int
    existing: int
    interrupted: bool


def require_cma() -> None:
    """**Raises** `InputError` if the package cma is not installed."""
    if importlib.util.find_spec("cma") is None:
        raise InputError("searcher", "is 'cma', which needs the package cma; install it with: pip install '.[cma]'")


@cached
def _evaluate_designs(problem: Problem, z: Array, near: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
    return mapped(lambda x, w: problem.values(x, w), one_by_one=problem.forward_only)(z, near)


class PopulationValues:
    """Values of populations, without derivatives.

    The values (s, 1 + me + mi) of a population of s designs are the objective, the deviations of me held quantities and the
    excesses of mi demands. The jams of each design are followed from the nearest of the latest designs. If this fails, they
    are searched for on the whole branch.
    """

    def __init__(self, problem: Problem):
        self.problem = replace(problem, batch_size=_DESIGNS_PER_BATCH)
        self.latest: tuple[np.ndarray, ...] | None = None
        """Latest designs, and the load speeds of their jams and folds."""

    def of(self, z: np.ndarray) -> np.ndarray:
        """Return the values of the designs z (s, d), NaN if a quantity does not exist."""
        if self.latest is None:
            values, speeds = self._at(z, find_speeds(self.problem, z))
        else:
            designs, *near = self.latest
            nearest = np.argmin(np.sum((z[:, None] - designs[None]) ** 2, axis=2), axis=1)
            values, speeds = self._at(z, tuple(each[nearest] for each in near))
            missing = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
            if len(missing):
                values[missing], again = self._at(z[missing], find_speeds(self.problem, z[missing]))
                for all_speeds, new_speeds in zip(speeds, again, strict=True):
                    all_speeds[missing] = new_speeds
        good = np.all(np.isfinite(values), axis=1)
        if np.any(good):
            new = (z[good], *(each[good] for each in speeds))
            old = (each[:0] for each in new) if self.latest is None else self.latest
            self.latest = tuple(np.concatenate(pair)[-_MAX_STORED_DESIGNS:] for pair in zip(old, new, strict=True))
        return values

    def _at(self, z: np.ndarray, near: Speeds) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        values, speeds = in_chunks(self.problem.designs_per_call, lambda x, w: _evaluate_designs(self.problem, x, w), z, near)
        return np.array(values), tuple(np.array(each) for each in speeds)


def evolve(problem: Problem, evaluations: int, seed: int, report: Callable[[float, float], None]) -> Evolved:
    """Minimize by CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9, 2001; package cma).

    The search ends with the generation in which the number of computed designs reaches `evaluations`. After convergence the
    method is restarted with twice the population (Auger and Hansen, IEEE CEC 2005). The merit is the scaled objective plus
    penalties of violated demands and held quantities. `report` is called with the progress (0 to 1) and the best objective. An
    interrupt (KeyboardInterrupt) ends the search with its present result.

    **Returns** `Evolved`.
    """
    import cma  # an optional dependency

    populations = PopulationValues(problem)
    merits, designs, history = np.zeros(0), np.zeros((0, problem.space.size)), []
    size, drawn, existing, run, interrupted = np.nan, 0, 0, 0, False
    # The package fails for a single free parameter; therefore a second one without effect is added.
    dimension = max(problem.space.size, 2)
    population = 4 + int(3 * np.log(dimension))
    random = np.random.default_rng(seed)
    try:
        while drawn < evaluations:
            begin = random.uniform(size=dimension)
            options = {"bounds": [0, 1], "seed": 1 + seed + run, "verbose": -9, "popsize": population << run}
            strategy = cma.CMAEvolutionStrategy(begin, 0.3, options)
            while not strategy.stop() and drawn < evaluations:
                samples = np.clip(np.asarray(strategy.ask()), 0.0, 1.0)
                z = samples[:, : problem.space.size]
                values = populations.of(z)
                exists = np.all(np.isfinite(values), axis=1)
                drawn, existing = drawn + len(z), existing + int(np.sum(exists))
                if np.isnan(size) and np.any(exists):
                    size = max(float(np.median(np.abs(values[exists, 0]))), 1e-300)
                total_violation = np.sum(problem.violations(values), axis=1)
                merit = np.where(
                    exists, np.nan_to_num(values[:, 0] / size + _VIOLATION_PENALTY * total_violation), _MERIT_WITHOUT_OBJECTIVE
                )
                strategy.tell(list(samples), list(merit))
                merits, designs = _best(np.concatenate([merits, merit]), np.concatenate([designs, z]))
                least = np.argmin(merit)
                history.append((values[least, 0], np.max(problem.violations(values)[least], initial=0.0)))
                report(
                    drawn / evaluations, merits[0] * size if len(merits) and merits[0] < _MERIT_WITHOUT_OBJECTIVE else np.nan
                )
            run += 1
    except KeyboardInterrupt:
        interrupted = True
    designs = designs[merits < _MERIT_WITHOUT_OBJECTIVE]
    point = evaluate(problem, designs, find_speeds(problem, designs)) if len(designs) else None
    return Evolved(point, np.asarray(history).reshape(-1, 1, 2), drawn, existing, interrupted)


def _best(merits: np.ndarray, designs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the merits of the best distinct designs, and these designs."""
    indices: list[int] = []
    for k in np.argsort(merits, kind="stable"):
        if all(np.max(np.abs(designs[k] - designs[j])) > _MIN_DESIGN_DISTANCE for j in indices):
            indices.append(int(k))
        if len(indices) == _POLISHED_DESIGNS:
            break
    return merits[indices], designs[indices]
