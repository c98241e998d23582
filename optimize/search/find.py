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
from optimize.search.polish import MAX_VIOLATION, Optimality, Polished, draw_starts, optimality, polish, progress_at, violation
from optimize.search.problem import Point, Problem, evaluate, find_speeds
from optimize.space import Choice, DesignSpace

_MAX_NODES = 400
"""Maximum number of bounded problems that a branch-and-bound search solves."""

_STARTS_PER_BOUND = 8
"""Number of initial designs of each bounded problem."""

_STARTS_WITH_RUNS = 8
"""Number of initial designs from which a search descends if its quantities are computed by time integration."""

Progress = Callable[[str, float], None]

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


class SearchResult(NamedTuple):
    """Results of searches.

    **Attributes**: those of `Polished`; `drawn`: number of random designs; `existing`: number of these for which the objective
    exists (in a search from given designs, `drawn` is the number of given designs); `interrupted`: True if the user interrupted
    the search; `bounds`: lower and upper bounds (d,) of the d free parameters within which the best design was searched for,
    SI; `nodes`: number of bounded problems that branch and bound solved.
    """

    point: Point
    history: np.ndarray
    remaining_decrease: np.ndarray
    violation: np.ndarray
    optimality: Optimality
    drawn: int
    existing: int
    interrupted: bool
    bounds: tuple[np.ndarray, np.ndarray]
    nodes: int = 0

    @property
    def best(self) -> int:
        """Index of the design with the least objective among the designs that meet all demands. If no design meets them, index
        of the design with the least violation."""
        return int(np.argmin(self.feasible_values if np.any(self.is_feasible) else self.violation))

    @property
    def is_feasible(self) -> np.ndarray:
        """True (s,) for designs that meet all demands."""
        return self.violation < MAX_VIOLATION

    @property
    def feasible_values(self) -> np.ndarray:
        """Objective (s,) of each design, infinite for designs that do not meet all demands."""
        return np.where(self.is_feasible, self.point.values[:, 0], np.inf)

    def designs(self, space: DesignSpace) -> np.ndarray:
        """Return the final designs (s, d) in [0, 1], relative to the bounds of `space`, not to the `bounds` of a branch."""
        if not space.choices:
            return self.point.z
        return np.asarray(space.shares(space.within(*self.bounds).numbers(self.point.z)))


def require_searcher(searcher: object) -> None:
    """**Raises** `InputError` for a name that is not a `Searcher`, or if the package that it needs is not installed."""
    if searcher not in get_args(Searcher):
        raise InputError("searcher", f"is {quoted(searcher)}; it must be one of: {', '.join(map(repr, get_args(Searcher)))}")
    if searcher == "cma":
        require_cma()


def find(problem: Problem, options: Options, report: Progress) -> SearchResult | None:
    """Search from random starts.

    If quantities are expensive (exact motions, integrations, tolerances), a first search uses leading order without tolerances.
    A second search starts from the best distinct designs of the first search, and, if there are tolerances, also from random
    designs.

    **Returns** None if the objective does not exist for any design.
    """
    simplified = None if options.begin is not None else problem.simplified()
    if simplified is None:
        return _search_from_starts(problem, options, report)
    first = _search_from_starts(simplified, options, lambda what, share: report(what, 0.5 * share))
    if first is None:
        return _search_from_starts(problem, options, report)
    if first.interrupted:
        begin, options = _best_distinct(first)[:1], replace(options, iterations=0, polishing=0)
    elif _has_tolerances(problem):
        random = np.random.default_rng(options.seed).uniform(size=(2 * _STARTS_PER_BOUND, problem.space.size))
        begin = np.concatenate([_best_distinct(first), random])[: 2 * _STARTS_PER_BOUND]
    else:  # the best machines are near those of the first search
        begin, options = _best_distinct(first), replace(options, iterations=0, polishing=max(options.polishing, 20))
    in_small_batches = _in_small_batches(problem, problem.space)
    if len(begin) == 0:
        begin = first.point.z[:_STARTS_PER_BOUND]
    result = _search_from_starts(
        in_small_batches, replace(options, begin=begin), lambda what, share: report(what, 0.5 + 0.5 * share)
    )
    if result is None:
        return None
    interrupted = first.interrupted or result.interrupted
    return result._replace(drawn=first.drawn, existing=first.existing, interrupted=interrupted)


def _in_small_batches(problem: Problem, space: DesignSpace) -> Problem:
    """Return the problem for the design space `space`, with small batches, because few designs are evaluated."""
    return replace(problem, space=space, batch_size=_STARTS_PER_BOUND)


def _has_tolerances(problem: Problem) -> bool:
    """Return True if a quantity is a statistic over tolerances (`Robust`)."""
    quantities = [problem.objective, *(q for d in problem.demands for q in (d.quantity, d.limit))]
    return any(isinstance(part, Robust) for q in quantities for part in walk(q))


def _search_from_starts(problem: Problem, options: Options, report: Progress) -> SearchResult | None:
    """Search from random starts, or from the designs `begin`.

    **Returns** None if the objective does not exist for any design. An interrupt (KeyboardInterrupt) ends the search with its
    present result.
    """
    report("selecting initial designs", 0.0)
    begin, history, interrupted = options.begin, [], False
    if begin is None and options.searcher == "cma":
        evolved = evolve(
            problem,
            options.starts * options.iterations,
            options.seed,
            lambda share, least: report(f"evolving, best {least:.4g}", 0.05 + 0.65 * share),
        )
        point, drawn, existing, interrupted = evolved.point, evolved.drawn, evolved.existing, evolved.interrupted
        history.append(evolved.history)
        # Designs of an evolution are polished without a descent.
        options = replace(options, iterations=0, polishing=0 if interrupted else options.polishing)
    elif begin is not None:
        point = evaluate(problem, begin, find_speeds(problem, begin))
        point = point.take(np.flatnonzero(point.exists()))
        drawn, existing = len(begin), len(point.z)
    else:
        starts = draw_starts(problem, options.starts, options.seed, find_speeds)
        point = starts.point if starts.point is not None else starts.off_held
        drawn, existing = starts.drawn, starts.existing
        if point is not None and problem.forward_only:
            point = point.take(_distinct(point, violation(problem, point))[:_STARTS_WITH_RUNS])
    if point is None or len(point.z) == 0:
        return None
    history.append(progress_at(problem, point)[None])
    initial = last = point

    def progress_of(what: str, low: float, high: float) -> Callable[[float, Point], None]:
        def report_point(share: float, now: Point) -> None:
            nonlocal last
            last = now
            values = now.values[np.isfinite(now.values[:, 0]), 0]
            report(f"{what}, best {np.min(values):.4g}" if len(values) else what, low + (high - low) * share)

        return report_point

    selected, descent_end = _shares_of_phases(problem, options, drawn, len(point.z))
    try:
        if options.iterations:
            progress = progress_of("descending", selected, descent_end)
            descended = descend(problem, point, options.iterations, options.rate, progress)
            history.append(descended.history)
            point = descended.point
        polished = polish(problem, point, options.polishing, progress_of("polishing", descent_end, 0.9))
    except KeyboardInterrupt:
        interrupted = True
        polished = polish(problem, last, 0, lambda *_: None)
    history.append(polished.history)
    polished = _restore_modes(problem, polished, initial)
    bounds = np.asarray(problem.space.low), np.asarray(problem.space.high)
    # The history of an evolution has one column; that of the polishing has one column for each start.
    width = max(part.shape[1] for part in history)
    joined = np.concatenate([np.broadcast_to(part, (len(part), width, 2)) for part in history])
    return SearchResult(*polished._replace(history=joined), drawn, existing, interrupted, bounds)


def _shares_of_phases(problem: Problem, options: Options, drawn: int, begun: int) -> tuple[float, float]:
    """Return the shares of a search that are finished when its `begun` initial designs are selected, and after their descent.

    The time of a search with time integrations is proportional to the number of computed designs.
    """
    if not problem.forward_only:
        return 0.55, 0.7
    per_step = 2 * problem.space.size + 2  # second derivatives, and two trials
    counts = np.cumsum([drawn, begun * options.iterations, begun * options.polishing * per_step])
    selected, descent_end, _ = 0.9 * counts / counts[-1]
    return float(selected), float(descent_end)


def _restore_modes(problem: Problem, polished: Polished, initial: Point) -> Polished:
    """Return the results; a final design whose jam is no longer the requested mode is replaced by the initial design."""
    # The jam that was followed may have another mode number now, which can be determined only from the whole branch.
    point = _with_requested_modes(problem, polished.point)
    lost = ~point.exists()
    if not np.any(lost):
        return polished._replace(point=point)
    # A design with the requested jam is preferred to a better design without it.
    point = _with_requested_modes(problem, initial).where(lost, point)
    remaining_decrease = np.where(lost, np.inf, polished.remaining_decrease)
    return Polished(point, polished.history, remaining_decrease, violation(problem, point), optimality(problem, point))


def _with_requested_modes(problem: Problem, point: Point) -> Point:
    """Return the designs; the values of a design are NaN if the mode number of one of its jams is not the requested one."""
    if not problem.keys:
        return point
    same = np.ones(len(point.z), bool)
    for key, followed, on_branch in zip(problem.keys, point.speeds, find_speeds(problem, point.z), strict=True):
        with np.errstate(invalid="ignore"):  # a fold that does not exist is infinite
            near = np.abs(followed / on_branch - 1.0) < 1e-6
        is_same_jam = near if key[1][0] == "jam" else near | ~np.isfinite(on_branch)
        same &= np.all(is_same_jam.reshape(len(same), -1), axis=1)
    return point._replace(values=np.where(same[:, None], point.values, np.nan))


def choose(problem: Problem, options: Options, report: Progress) -> SearchResult | None:
    """Find the best design with catalogue values, by branch and bound on the continuous search.

    In each bounded problem the parameters vary continuously between two values of their catalogues. The problem with the best
    design is divided next. The search ends when the best design of such a problem has catalogue values only. Since each search
    is local, the global optimum is not guaranteed. An interrupt (KeyboardInterrupt) ends the search with the design of the
    nearest catalogue values.

    **Returns** the best design with catalogue values; a design with a violation if no such design meets all demands; a design
    marked as not converged if the maximum number of nodes was reached; None if the objective does not exist.
    """
    root = find(problem, options, lambda what, share: report(what, 0.5 * share))
    choices = problem.space.choices
    if root is None or not choices:
        return root
    if root.interrupted:
        return _interrupted(problem, root)
    if root.violation[root.best] > MAX_VIOLATION:
        return root
    order = itertools.count()
    queue = [(float(root.point.values[root.best, 0]), next(order), root, problem.space.numbers(_best_distinct(root)))]
    nodes, nearest = 0, root
    try:
        while queue and nodes < _MAX_NODES:
            _, _, node, initial = heapq.heappop(queue)
            numbers = problem.space.within(*node.bounds).numbers(node.point.z[node.best])
            distances = [_distance_to_catalogue(choice.values, numbers[choice.entry]) for choice in choices]
            if max(distances) < 1e-9:
                # The objective of every other node is at least as large.
                return node._replace(drawn=root.drawn, existing=root.existing, interrupted=False, nodes=nodes)
            for low, high in _split_bounds(node, choices[int(np.argmax(distances))], numbers):
                nodes += 1
                starts = np.concatenate([numbers[None], initial])[:_STARTS_PER_BOUND]
                child = _solve_in_bounds(problem, low, high, starts, max(options.polishing, 20))
                if child is None:
                    continue
                if child.violation[child.best] > MAX_VIOLATION:
                    if nearest is root or child.violation[child.best] < nearest.violation[nearest.best]:
                        nearest = child
                    continue
                value = float(child.point.values[child.best, 0])
                report("choosing", 0.5 + 0.4 * nodes / (nodes + 20.0))
                heapq.heappush(queue, (value, next(order), child, initial))
        result = _nearest_choice(problem, queue[0][2] if queue else nearest)
        if result is None:
            return None
        remaining = np.full_like(result.remaining_decrease, np.inf) if queue else result.remaining_decrease
        return result._replace(drawn=root.drawn, existing=root.existing, nodes=nodes, remaining_decrease=remaining)
    except KeyboardInterrupt:
        return _interrupted(problem, root)._replace(nodes=nodes)


def _split_bounds(node: SearchResult, choice: Choice, numbers: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the two parts of the bounds of a node.

    The catalogue of `choice` is divided into the values up to the present value of this parameter, and the values above it.
    `numbers` (d,) are the present free parameters, SI.
    """
    allowed = [v for v in choice.values if node.bounds[0][choice.entry] <= v <= node.bounds[1][choice.entry]]
    x = numbers[choice.entry]
    for part in ([v for v in allowed if v <= x], [v for v in allowed if v > x]):
        if part:
            low, high = (b.copy() for b in node.bounds)
            low[choice.entry], high[choice.entry] = part[0], part[-1]
            yield low, high


def _interrupted(problem: Problem, root: SearchResult) -> SearchResult:
    """Return the design with the catalogue values nearest to the best design of an interrupted search.

    **Raises** `KeyboardInterrupt` if the objective does not exist for this design.
    """
    result = _nearest_choice(problem, root)
    if result is None:
        raise KeyboardInterrupt
    return result._replace(drawn=root.drawn, existing=root.existing, interrupted=True)


def _nearest_choice(problem: Problem, node: SearchResult) -> SearchResult | None:
    """Return the best design of a node with each chosen parameter rounded to the nearest value of its catalogue, or None if the
    objective does not exist there."""
    numbers = problem.space.within(*node.bounds).numbers(node.point.z[node.best])
    low, high = (b.copy() for b in node.bounds)
    for choice in problem.space.choices:
        low[choice.entry] = high[choice.entry] = min(choice.values, key=lambda v: abs(v - numbers[choice.entry]))
    return _solve_in_bounds(problem, low, high, numbers[None], 0)


def _distance_to_catalogue(values: tuple[float, ...], x: float) -> float:
    """Return the relative distance of a parameter from the nearest value of its catalogue."""
    nearest = min(values, key=lambda v: abs(v - x))
    return abs(x - nearest) / max(abs(nearest), 1e-300)


def _best_distinct(result: SearchResult) -> np.ndarray:
    """Return the best distinct designs, (at most 7, d)."""
    return result.point.z[_distinct(result.point, result.violation)[: _STARTS_PER_BOUND - 1]]


def _distinct(point: Point, violations: np.ndarray) -> np.ndarray:
    """Return the indices of the distinct designs that exist: those that meet all demands by their objective, then the others by
    their `violations` (s,)."""
    distinct: list[int] = []
    for k in np.lexsort((point.values[:, 0], np.where(violations < MAX_VIOLATION, 0.0, violations))):
        if np.isfinite(point.values[k, 0]) and all(np.max(np.abs(point.z[k] - point.z[j])) > 1e-2 for j in distinct):
            distinct.append(int(k))
    return np.asarray(distinct, int)


def _solve_in_bounds(
    problem: Problem, low: np.ndarray, high: np.ndarray, numbers: np.ndarray, polishing: int
) -> SearchResult | None:
    """Polish the designs with the free parameters `numbers` (s, d), SI, in `polishing` steps within the bounds `low` and
    `high`."""
    space = problem.space.within(low, high)
    in_small_batches = _in_small_batches(problem, space)
    z = np.asarray(space.shares(np.clip(numbers, low, high)))
    point = evaluate(in_small_batches, z, find_speeds(in_small_batches, z))
    point = point.take(np.flatnonzero(point.exists()))
    if not len(point.z):
        return None
    polished: Polished = polish(in_small_batches, point, polishing, lambda *_: None)
    final = _with_requested_modes(in_small_batches, polished.point)
    violations = np.where(final.exists(), polished.violation, np.inf)
    if not np.any(np.isfinite(violations)):
        return None
    return SearchResult(
        final, polished.history, polished.remaining_decrease, violations, polished.optimality, 0, 0, False, (low, high)
    )
