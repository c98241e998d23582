"""Search for the best designs from random starts: continuous search, and catalogues by branch and bound."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from jaxvib.errors import InputError, quoted
from optimize.quantities.cases import Robust
from optimize.quantities.quantity import walk
from optimize.search.descent import descend
from optimize.search.evolve import evolve, require_cma
from optimize.search.polish import FEASIBILITY_TOLERANCE, Optimality, Polished, draw_starts, optimality, polish, violation
from optimize.search.problem import Point, Problem, evaluate, find_speeds
from optimize.space import Choice, DesignSpace

_NODES = 400
"""Maximum number of bounds in a branch-and-bound search."""

_STARTS_PER_BOUND = 8
"""Number of initial designs for each bound of a catalogue."""

Tell = Callable[[str, float], None]

Searcher = Literal["gradients", "cma"]
"""Method of the first phase, before polishing: Adam from many starts, or CMA-ES."""


@dataclass(frozen=True)
class Options:
    """Options of a search, see `synthesize`."""

    starts: int
    seed: int
    iterations: int
    rate: float
    polishing: int
    searcher: Searcher = "gradients"
    begin: np.ndarray | None = None


class Found(NamedTuple):
    """Results of searches, see `Polished`; `drawn` designs, of which `existing` had the objective; `interrupted`; the final
    bounds (d,), SI; the number of `nodes` of a choice from catalogues."""

    point: Point
    history: np.ndarray
    left: np.ndarray
    violation: np.ndarray
    optimality: Optimality
    drawn: int
    existing: int
    interrupted: bool
    bounds: tuple[np.ndarray, np.ndarray]
    nodes: int = 0

    @property
    def best(self) -> int:
        """Index of the best design: least objective of the designs that meet all demands, otherwise least violation."""
        kept = self.violation < 10.0 * FEASIBILITY_TOLERANCE
        if np.any(kept):
            return int(np.argmin(np.where(kept, self.point.values[:, 0], np.inf)))
        return int(np.argmin(self.violation))


def require_searcher(searcher: object) -> None:
    """**Raises** `InputError` for a name that is no `Searcher`, or for a package that is not installed."""
    if searcher not in get_args(Searcher):
        raise InputError("searcher", f"is {quoted(searcher)}; it must be one of: {', '.join(map(repr, get_args(Searcher)))}")
    if searcher == "cma":
        require_cma()


def find(problem: Problem, options: Options, tell: Tell) -> Found | None:
    """Search from random starts.

    If quantities are expensive (exact motions, integrations, tolerances), a first search is to leading order and without
    tolerances; a second one starts from the best distinct machines of the first and some random ones.
    """
    easy = None if options.begin is not None else problem.easy()
    if easy is None:
        return _find(problem, options, tell)
    first = _find(easy, options, lambda what, share: tell(what, 0.5 * share))
    if first is None:
        return _find(problem, options, tell)
    if first.interrupted:
        begin, options = _few(first)[:1], replace(options, iterations=0, polishing=0)
    elif _spread(problem):
        random = np.random.default_rng(options.seed).uniform(size=(2 * _STARTS_PER_BOUND, problem.space.size))
        begin = np.concatenate([_few(first), random])[: 2 * _STARTS_PER_BOUND]
    else:  # the best machines are near those of the first search
        begin, options = _few(first), replace(options, iterations=0, polishing=max(options.polishing, 20))
    narrow = _with_lanes(problem, problem.space)
    if len(begin) == 0:
        begin = first.point.z[:_STARTS_PER_BOUND]
    found = _find(narrow, replace(options, begin=begin), lambda what, share: tell(what, 0.5 + 0.5 * share))
    if found is None:
        return None
    interrupted = first.interrupted or found.interrupted
    return found._replace(drawn=first.drawn, existing=first.existing, interrupted=interrupted)


def _with_lanes(problem: Problem, space: DesignSpace) -> Problem:
    """Return the problem in another space, in small batches for few designs."""
    return replace(problem, space=space, lanes=_STARTS_PER_BOUND)


def _spread(problem: Problem) -> bool:
    """Return True if a quantity is taken over tolerances."""
    every = [problem.objective, *(q for d in problem.demands for q in (d.quantity, d.limit))]
    return any(isinstance(part, Robust) for q in every for part in walk(q))


def _find(problem: Problem, options: Options, tell: Tell) -> Found | None:
    """Search from random starts, or from the designs `begin`; None if no design has the objective. An interrupt
    (KeyboardInterrupt) ends the search with its present result."""
    tell("drawing starts", 0.0)
    begin, history, interrupted = options.begin, [], False
    if begin is None and options.searcher == "cma":
        evolved = evolve(
            problem,
            options.starts * options.iterations,
            options.seed,
            lambda share, least: tell(f"evolving, best {least:.4g}", 0.05 + 0.45 * share),
        )
        point, drawn, existing, interrupted = evolved.point, evolved.drawn, evolved.existing, evolved.interrupted
        history.append(evolved.history)
        # Its designs are polished without a descent.
        options = replace(options, iterations=0, polishing=0 if interrupted else options.polishing)
    elif begin is not None:
        point = evaluate(problem, begin, find_speeds(problem, begin))
        point = point.take(np.flatnonzero(point.exists()))
        drawn = existing = len(begin)
    else:
        starts = draw_starts(problem, options.starts, options.seed, find_speeds)
        point = starts.point if starts.point is not None else starts.nearest
        drawn, existing = starts.drawn, starts.existing
    if point is None or len(point.z) == 0:
        return None
    history.append(point.values[None, :, 0])
    begun = last = point

    def progress_of(what: str, low: float, high: float) -> Callable[[float, Point], None]:
        def tell_of(share: float, now: Point) -> None:
            nonlocal last
            last = now
            values = now.values[np.isfinite(now.values[:, 0]), 0]
            tell(f"{what}, best {np.min(values):.4g}" if len(values) else what, low + (high - low) * share)

        return tell_of

    try:
        if options.iterations:
            descended = descend(problem, point, options.iterations, options.rate, progress_of("descending", 0.1, 0.5))
            history.append(descended.history)
            point = descended.point
        ended = polish(problem, point, options.polishing, progress_of("polishing", 0.5, 0.9))
    except KeyboardInterrupt:
        interrupted = True
        ended = polish(problem, last, 0, lambda *_: None)
    history.append(ended.history)
    # Followed jams may have exchanged their mode numbers, which only the whole branch shows.
    point, broken, left, optimal = _of_their_mode(problem, ended.point), ended.violation, ended.left, ended.optimality
    lost = ~point.exists()
    if np.any(lost):  # prefer a machine with the mode to a better one that has lost it
        point = _of_their_mode(problem, begun).where(lost, point)
        broken, left, optimal = violation(problem, point), np.where(lost, np.inf, left), optimality(problem, point)
    bounds = np.asarray(problem.space.low), np.asarray(problem.space.high)
    # The history of an evolution has one value for each generation, followed by those of the polished starts.
    wide = max(part.shape[1] for part in history)
    whole = np.concatenate([np.broadcast_to(part, (len(part), wide)) for part in history])
    return Found(point, whole, left, broken, optimal, drawn, existing, interrupted, bounds)


def _of_their_mode(problem: Problem, point: Point) -> Point:
    """Return the designs, without values if the mode number of a jam is not the requested one."""
    if not problem.keys:
        return point
    same = np.ones(len(point.z), bool)
    for key, ours, whole in zip(problem.keys, point.known, find_speeds(problem, point.z), strict=True):
        near = np.abs(ours / whole - 1.0) < 1e-6
        there = near if key[1][0] == "jam" else near | ~np.isfinite(whole)
        same &= np.all(there.reshape(len(same), -1), axis=1)
    return point._replace(values=np.where(same[:, None], point.values, np.nan))


def choose(problem: Problem, options: Options, tell: Tell) -> Found | None:
    """Find the best design whose numbers are in their catalogues by branch and bound on the continuous search.

    A bound is the best design with numbers free between two values of the catalogue. If it is not better than the best known
    choice, all choices between these values are skipped. Since each search is local, the global optimum is not guaranteed.
    An interrupt (KeyboardInterrupt) ends the search with its best choice.
    """
    root = find(problem, options, lambda what, share: tell(what, 0.5 * share))
    choices = problem.space.choices
    if root is None or not choices:
        return root
    if root.interrupted:
        return _nearest_choice(problem, root)
    if root.violation[root.best] > 10.0 * FEASIBILITY_TOLERANCE:
        return root
    best: tuple[float, Found] | None = None
    order = itertools.count()
    queue = [(float(root.point.values[root.best, 0]), next(order), root, problem.space.numbers(_few(root)))]
    nodes, interrupted = 0, False
    try:
        while queue and nodes < _NODES:
            bound, _, node, begun = heapq.heappop(queue)
            if best is not None and bound >= best[0] - 1e-9 * abs(best[0]):
                break
            where = problem.space.within(*node.bounds).numbers(node.point.z[node.best])
            off = [_away(choice.values, where[choice.start]) for choice in choices]
            if max(off) < 1e-9:
                best = (bound, node)
                continue
            for low, high in _halves(node, choices[int(np.argmax(off))], where):
                nodes += 1
                starts = np.concatenate([where[None], begun])[:_STARTS_PER_BOUND]
                child = _solve_in_bounds(problem, low, high, starts, max(options.polishing, 20))
                if child is None or child.violation[child.best] > 10.0 * FEASIBILITY_TOLERANCE:
                    continue
                value = float(child.point.values[child.best, 0])
                if best is None or value < best[0]:
                    tell(f"choosing, best {best[0]:.4g}" if best else "choosing", 0.5 + 0.4 * nodes / (nodes + 20.0))
                    heapq.heappush(queue, (value, next(order), child, begun))
    except KeyboardInterrupt:
        interrupted = True
        if best is None:
            return _nearest_choice(problem, root)._replace(nodes=nodes)
    if best is None:
        return None
    return best[1]._replace(drawn=root.drawn, existing=root.existing, interrupted=interrupted, nodes=nodes)


def _halves(node: Found, choice: Choice, where: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the bounds of a node with the catalogue of `choice` below and above its value in the design `where`."""
    allowed = [v for v in choice.values if node.bounds[0][choice.start] <= v <= node.bounds[1][choice.start]]
    x = where[choice.start]
    for part in ([v for v in allowed if v <= x], [v for v in allowed if v > x]):
        if part:
            low, high = (b.copy() for b in node.bounds)
            low[choice.start], high[choice.start] = part[0], part[-1]
            yield low, high


def _nearest_choice(problem: Problem, root: Found) -> Found:
    """Return the best design of an interrupted search with each number at the nearest value of its catalogue.

    **Raises** `KeyboardInterrupt` if that design does not have the objective.
    """
    where = problem.space.within(*root.bounds).numbers(root.point.z[root.best])
    low, high = (b.copy() for b in root.bounds)
    for choice in problem.space.choices:
        low[choice.start] = high[choice.start] = min(choice.values, key=lambda v: abs(v - where[choice.start]))
    found = _solve_in_bounds(problem, low, high, where[None], 0)
    if found is None:
        raise KeyboardInterrupt
    return found._replace(drawn=root.drawn, existing=root.existing, interrupted=True)


def _away(values: tuple[float, ...], x: float) -> float:
    """Return the relative distance of a number from the nearest value of its catalogue."""
    nearest = min(values, key=lambda v: abs(v - x))
    return abs(x - nearest) / max(abs(nearest), 1e-300)


def _few(found: Found) -> np.ndarray:
    """Return the best distinct designs, (at most 7, d)."""
    order = np.argsort(np.where(found.violation < 10.0 * FEASIBILITY_TOLERANCE, found.point.values[:, 0], np.inf))
    kept: list[np.ndarray] = []
    for k in order:
        z = found.point.z[k]
        if np.isfinite(found.point.values[k, 0]) and all(np.max(np.abs(z - other)) > 1e-2 for other in kept):
            kept.append(z)
    return np.reshape(kept[: _STARTS_PER_BOUND - 1], (-1, found.point.z.shape[1]))


def _solve_in_bounds(problem: Problem, low: np.ndarray, high: np.ndarray, numbers: np.ndarray, polishing: int) -> Found | None:
    """Solve the problem with narrower bounds by `polishing` steps from the designs with these `numbers`."""
    space = problem.space.within(low, high)
    narrow = _with_lanes(problem, space)
    z = np.asarray(space.shares(np.clip(numbers, low, high)))
    point = evaluate(narrow, z, find_speeds(narrow, z))
    point = point.take(np.flatnonzero(point.exists()))
    if not len(point.z):
        return None
    ended: Polished = polish(narrow, point, polishing, lambda *_: None)
    kept = _of_their_mode(narrow, ended.point)
    broken = np.where(kept.exists(), ended.violation, np.inf)
    if not np.any(np.isfinite(broken)):
        return None
    return Found(kept, ended.history, ended.left, broken, ended.optimality, 0, 0, False, (low, high))
