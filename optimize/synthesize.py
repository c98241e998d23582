"""Search for a machine in a design space, with verification by the exact motion and by time integration."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import call_user, validated
from jaxvib.display import speed_text
from jaxvib.equations.linear import jammed_loads, require_drag
from jaxvib.equations.state import State
from jaxvib.errors import ComputationError, InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import require_double, validate_scene
from jaxvib.motion.run import Run
from jaxvib.motion.settle import settle
from jaxvib.results.status import failure
from jaxvib.runtime.devices import on_device
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.steady.orbits.synchronous import synchronous_orbit
from jaxvib.steady.regimes.working import working_regime
from jaxvib.units import count
from optimize.quantities.evaluation import Evaluation
from optimize.quantities.exciters import RegimeQuantity, working_amplitude, working_speed
from optimize.quantities.jams import amplitude, force_per_amplitude, foundation_force, jam_frequency, resolve_pair
from optimize.quantities.quantity import Demand, Pair, Quantity, Tier, walk
from optimize.result import Limit, Outcome, Row, Synthesis, SynthesisStatus, amplitude_names
from optimize.search.find import Options, Searcher, SearchResult, choose, require_searcher
from optimize.search.problem import Problem, evaluate_quantities, problem_of, scenes_of
from optimize.search.sensitivity import influences_of, limits_of, machines_of, neighbours, unresolved_of
from optimize.search.suggestions import lines_to_free
from optimize.space import DesignSpace

_CONVERGED_DECREASE = 1e-6
"""Predicted relative decrease of the objective below which a design has converged."""

_SAME_DESIGN_DISTANCE = 1e-3
"""Distance of two designs, relative to the ranges of the free parameters, below which they count as the same machine."""

_INITIAL_SPREAD = 1e-3
"""Largest deviation of the start of a run from the exact motion: of the angles of loads, rad, or of displacements, relative."""

_SAME_MOTION = 1e-2
"""Difference of amplitudes, relative to the largest, below which a run has settled in the working regime."""

_MIN_SHOWN_SHORTFALL = 1e-3
"""Smallest relative violation of a demand for which parameters that would help are named."""

Progress = Callable[[str, float], None]

_SEARCH_SHARE = 0.43
"""Part of the total time that the search takes if a verification follows, measured for the antiphase machine."""


@validated
def synthesize(
    space: DesignSpace,
    objective: Quantity,
    *,
    subject_to: Demand | Sequence[Demand] = (),
    starts: int = 256,
    seed: int = 0,
    iterations: int = 100,
    polishing: int = 12,
    rate: float = 0.05,
    searcher: Searcher = "gradients",
    begin: Synthesis | None = None,
    verify: bool = True,
    throw: bool = True,
    progress: Progress | None = None,
) -> Synthesis:
    """Search a design space from many random starts at once for the least value of a quantity, subject to demands.

    - Starts are drawn uniformly within the bounds and changed until the held quantities have their values
    - Adam (optax) descends from all starts at once; its steps keep the held quantities, and an augmented Lagrangian includes
      the demands
    - Sequential quadratic programming with exact first derivatives refines the final design of each start
    - Values of catalogues are chosen by branch and bound; each allowed number of loads is tried
    - Jam modes are followed from one design to the next; at the end they are searched for again on the whole branch

    **Arguments**

    - `space`: a `DesignSpace`
    - `objective`: the `Quantity` to minimize, such as `force_per_amplitude(mode=3)`; `-quantity` maximizes
    - `subject_to`: demands such as `[amplitude(mode=3) > "2 mm", power(mode=3) < 500.0]`
    - `starts`: number of random starts; typical: 32 to 256 (the default). With more starts the lowest minimum is found with a
      higher probability. The computing time is proportional to this number. If a quantity is computed by time integration, the
      descent begins with the 8 best starts only
    - `seed` of these starts
    - `iterations` of the descent; typical: 50 to 200 (default 100)
    - `rate`: first step of the descent, relative to the range of a free parameter; typical: 0.01 to 0.1 (default 0.05)
    - `polishing`: steps of sequential quadratic programming; typical: 12 (the default)
    - `searcher`: method before the polishing: "gradients", Adam from the starts; or "cma", CMA-ES for objectives with many
      local minima (extra `cma`). CMA-ES uses no derivatives; it computes `starts` x `iterations` designs, and at most 8 of the
      best ones are polished
    - `begin`: a `Synthesis` of this space; its final designs replace the random starts
    - `verify`: True to compute the exact motion of the best design. If it is stable, the full equations are integrated until
      the motion has settled, and the quantities are measured. The run starts near the exact motion: loads deviate by up to
      1e-3 rad, for exciters with unbalances the displacements deviate by 0.1 %. `unverified` states why there is no such run
    - `throw`: True to raise `ComputationError` if no design meets all demands; False to return the design with the least
      violation, with the status "contradictory"
    - `progress`: a function that is called with the name of the present step and the finished share of the search (0 to 1)

    An interrupt (Ctrl-C) ends the search at once with its best design, which is then not polished and not verified.

    **Returns** `Synthesis`.

    **Raises** `InputError` for values that are not allowed, and `ComputationError` with one of two statuses:

    - "no_feasible_start": in every random design at least one of the needed quantities (the objective, held quantities,
      quantities of demands) does not exist; the message names the quantities that do not exist
    - "contradictory": no design meets all demands; the message states which demands are not met, and by how much, and has lines
      of a design file that free further parameters with large effects on them

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from optimize import DesignSpace, force_per_amplitude, hold, jam_frequency, support_frequency_squared, synthesize
    >>> form = jv.Dimensionless("antiphase", natural=(0.2, 0.4), damping=(1e-3, 1e-3), link_natural=2/3, link_damping=1e-3,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> space = DesignSpace(form.scene(), free={"machine.stiffness": (0.02, 0.3), "machine.link_stiffness": (0.2, 0.8)},
    ...                     hold=[hold(jam_frequency(mode=3), 1.0), hold(support_frequency_squared(), 2/9)])
    >>> best = synthesize(space, force_per_amplitude(mode=3), starts=8, verify=False)
    >>> best.same, [round(k, 2) for k in best.after.parameters["machine.stiffness"]]     # equal supports are best
    (8, [0.11, 0.11])

    Source: the antiphase paper, section 5.1, where the optimum is derived by algebra.
    """
    options = _options(starts, seed, iterations, polishing, rate, searcher)
    demands = _validate_demands(space, objective, subject_to)

    motion = _motion_of(space, objective, demands)
    report = partial(_report, progress, _SEARCH_SHARE if verify and motion is not None else 0.9)
    if begin is not None:
        options = dataclasses.replace(options, begin=_designs_to_continue(space, begin), starts=len(begin.designs))
    initial_space = space
    space, problem, result = _search(space, objective, demands, options, report)
    neighbour_scenes = scenes_of(problem, neighbours(problem, result))
    scene = validate_scene(on_device(jax.tree.map(lambda leaf: np.asarray(leaf)[0], neighbour_scenes)))
    status, why_unverified, searched = _describe_searches(result, space)
    named = _named_quantities(space, scene, objective, demands, motion)
    demand_sides = tuple(q for demand in demands for q in (demand.quantity, demand.limit))
    reports = _values_of_all((*(q for _, q in named), objective, *demand_sides), initial_space.scene, neighbour_scenes, problem)
    limits = limits_of(problem, demands, result, reports[1, len(named) + 1 :].reshape(-1, 2))
    if throw and status is SynthesisStatus.contradictory:
        raise _unmet(limits, space, scene, [*(held.quantity for held in space.held), *(demand.quantity for demand in demands)])
    report("integrating the best machine" if verify and motion is not None else "computing quantities", 0.9)
    verify = verify and not why_unverified
    run, unverified = (None, why_unverified) if why_unverified else _run(scene, motion, verify)
    report("computing the exact motion", 0.99)
    other_tiers = _other_tiers(scene, [q for _, q in named], verify, run, motion)
    n = len(_standard_rows(scene, motion, objective.of))
    before, after = (_outcome(space, s, reports[k, :n]) for k, s in enumerate((initial_space.scene, scene)))
    verified = None if run is None else _outcome_of_run(space, run, motion, objective.of)
    report("done", 1.0)
    return Synthesis(
        status=status,
        scene=scene,
        before=before,
        after=after,
        verified=verified,
        run=run,
        unverified=unverified,
        objective=objective.name,
        unit=objective.unit,
        table=_table(initial_space, scene, named, reports[:2, : len(named)], other_tiers),
        limits=limits,
        influences=influences_of(problem, demands, reports[1:, len(named) :]),
        unresolved=unresolved_of([q for _, q in named], reports[1:, : len(named)]),
        machines=machines_of(problem, result, _SAME_DESIGN_DISTANCE),
        **searched,
    )


def _report(progress: Progress | None, search_share: float, what: str, share: float) -> None:
    """Report the finished share of the whole time.

    **Arguments**: `search_share`: share of the search in the whole time; `what`: name of the present step; `share`: 0 to 0.9
    during the search, 0.9 to 1 after it.
    """
    if progress is not None:
        shown = share * search_share / 0.9 if share <= 0.9 else search_share + (share - 0.9) / 0.1 * (1.0 - search_share)
        call_user(progress, "progress", what, shown)


def _unmet(limits: Sequence[Limit], space: DesignSpace, scene: Scene, quantities: Sequence[Quantity]) -> ComputationError:
    """Return the error for a best design that does not meet all limits, the first of which are those of `quantities`."""
    unmet = "; ".join(f"{x.what}: {x.shortfall()}" for x in limits if x.violation)
    hint = f" (not met by the nearest machine: {unmet}); widen the bounds or relax a demand"
    wanted = [
        (quantity, limit.limit)
        for limit, quantity in zip(limits, quantities, strict=False)
        if _MIN_SHOWN_SHORTFALL < limit.violation < math.inf
    ]
    if lines := lines_to_free(space, scene, wanted):
        hint += "\n".join([", or free other parameters by lines of the design file, for example:", *lines])
    return failure(SynthesisStatus.contradictory, hint)


def _describe_searches(result: SearchResult, space: DesignSpace) -> tuple[SynthesisStatus, str, dict[str, Any]]:
    """Return the status of a search, the reason why its best machine is not verified ("" for none), and the fields of
    `Synthesis` that describe the searches."""
    best, z = result.best, result.designs(space)
    done = result.is_feasible & (result.remaining_decrease < _CONVERGED_DECREASE)
    if result.interrupted:
        status, why_unverified = SynthesisStatus.interrupted, "the search was interrupted"
    elif not result.is_feasible[best]:
        status, why_unverified = SynthesisStatus.contradictory, "the machine does not meet all demands"
    else:
        status, why_unverified = SynthesisStatus.done if done[best] else SynthesisStatus.not_converged, ""
    return (
        status,
        why_unverified,
        {
            "starts": len(z),
            "drawn": result.drawn,
            "converged": int(np.sum(done)),
            "same": int(np.sum(result.is_feasible & (np.max(np.abs(z - z[best]), axis=1) < _SAME_DESIGN_DISTANCE))),
            "designs": z,
            "values": result.feasible_values,
            "done": done,
            "history": result.history[..., 0],
            "history_violation": result.history[..., 1],
            "kkt": float(result.optimality.kkt[best]),
        },
    )


def _options(starts: int, seed: int, iterations: int, polishing: int, rate: float, searcher: Searcher) -> Options:
    count(starts, "starts")
    count(iterations, "iterations")
    count(polishing, "polishing", low=0)
    if not 0.0 < rate < 1.0:
        raise InputError("rate", f"is {quoted(rate)}; it must be greater than 0 and less than 1")
    count(seed, "seed", low=0)
    require_searcher(searcher)
    return Options(starts, seed, iterations, float(rate), polishing, searcher)


def _validate_demands(space: DesignSpace, objective: Quantity, subject_to: Demand | Sequence[Demand]) -> tuple[Demand, ...]:
    demands = (subject_to,) if isinstance(subject_to, Demand) else tuple(subject_to)
    for demand in demands:
        if not isinstance(demand, Demand):
            hint = "; for ==, use hold(quantity, value) in the DesignSpace" if isinstance(demand, bool) else ""
            raise InputError("subject_to", f"has {quoted(demand)}; write demands such as amplitude(mode=3) > '2 mm'{hint}")
    require_double(space.scene, "a search")
    resolve_pair(space.scene, objective.of)
    if space.scene.is_plain and not space.scene.drive.constant:
        raise InputError("drive", f"is {quoted(space.scene.drive.kind)}; a search needs a constant speed; use ConstantSpeed")
    return demands


def _designs_to_continue(space: DesignSpace, begin: Synthesis) -> np.ndarray:
    if not isinstance(begin, Synthesis):
        raise InputError("begin", f"is {quoted(begin)}; it must be the Synthesis of an earlier search of this space")
    if begin.designs.shape[1] != space.size:
        raise InputError("begin", f"has {begin.designs.shape[1]} free parameters; this space has {space.size}")
    return np.asarray(begin.designs)


def _search(
    space: DesignSpace, objective: Quantity, demands: tuple[Demand, ...], options: Options, report: Progress
) -> tuple[DesignSpace, Problem, SearchResult]:
    """Return the best result over all allowed numbers of loads."""
    best: tuple[DesignSpace, Problem, SearchResult] | None = None
    existing = drawn = 0
    for loads in space.counts or (None,):
        space_of_count = space if loads is None or loads == space.scene.loads.count else _with_loads(space, loads)
        problem = problem_of(space_of_count, objective, demands, options.starts)
        if problem.keys:
            require_drag(jammed_loads(space.scene))
        result = choose(problem, options, report)
        if result is None:
            continue
        existing, drawn = existing + result.existing, drawn + result.drawn
        if best is None or _rank(result) < _rank(best[2]):
            best = space_of_count, problem, result
        if result.interrupted:
            best = (*best[:2], best[2]._replace(interrupted=True))
            break
    if best is None:
        missing = _missing(space, objective, demands, options)
        raise ComputationError(
            "no_feasible_start",
            f"{missing} for any of the {options.starts} random designs within the bounds; widen the bounds or "
            "choose another mode",
        )
    return best[0], best[1], best[2]._replace(existing=existing, drawn=drawn)


def _missing(space: DesignSpace, objective: Quantity, demands: tuple[Demand, ...], options: Options) -> str:
    """Return the names of the quantities of a search that exist for no random design, as the beginning of a message."""
    sides = (q for demand in demands for q in (demand.quantity, demand.limit))
    quantities = tuple(dict.fromkeys((objective, *(held.quantity for held in space.held), *sides)))
    z = np.random.default_rng(options.seed).uniform(size=(options.starts, space.size))
    values = evaluate_quantities(quantities, scenes_of(problem_of(space, objective, (), options.starts), space.numbers(z)))
    absent = [q.words for q, exists in zip(quantities, np.any(np.isfinite(values), axis=0).tolist(), strict=True) if not exists]
    return f"{' or '.join(absent)}: does not exist" if absent else f"{', '.join(q.words for q in quantities)}: do not all exist"


def _rank(result: SearchResult) -> tuple[bool, float]:
    is_feasible = bool(result.is_feasible[result.best])
    return not is_feasible, float(result.point.values[result.best, 0] if is_feasible else result.violation[result.best])


def _with_loads(space: DesignSpace, loads: int) -> DesignSpace:
    """Return the design space with another number of loads. **Raises** `InputError` for loads with different parameters."""
    present = space.scene.loads
    if not getattr(present, "alike", False):
        raise InputError("choices.loads.count", "needs equal loads; give one mass, radius and drag for all")
    scene = eqx.tree_at(lambda s: s.loads, space.scene, dataclasses.replace(present, count=loads))
    return eqx.tree_at(lambda s: s.scene, space, validate_scene(scene))


_Motion = int | Literal["working"] | None
"""Motion of the machine on which the quantities of a search depend: a jam mode, or the working regime of exciters."""


def _motion_of(space: DesignSpace, objective: Quantity, demands: Sequence[Demand]) -> _Motion:
    """Return the jam mode of the first quantity that has one, in the order objective, demands, held quantities. Without a jam
    mode, return "working" if a quantity belongs to the working regime, otherwise None."""
    quantities = objective, *(d.quantity for d in demands), *(h.quantity for h in space.held)
    modes = [q.mode for q in quantities if q.mode is not None]
    is_working = any(isinstance(part, RegimeQuantity) for q in quantities for part in walk(q))
    return modes[0] if modes else "working" if is_working else None


def _run(scene: Scene, motion: _Motion, verify: bool) -> tuple[Run | None, str]:
    """Integrate the full equations until the motion has settled in a jam mode, or in the working regime.

    **Returns** the run and an empty text, or None and the reason why there is no run.
    """
    if motion is None:
        return None, "no quantity of the search belongs to a jam or a working regime, which the full equations could verify"
    if not verify:
        return None, "not requested"
    try:  # a failed verification must not lose the machine
        return _working_run(scene) if motion == "working" else _jam_run(scene, motion)
    except ComputationError as error:
        return None, str(error)


def _working_run(scene: Scene) -> tuple[Run | None, str]:
    try:
        orbit = synchronous_orbit(scene, working_regime(scene))
    except InputError as error:  # exact motions include fewer drives and effects
        return None, str(error)
    if not bool(orbit.stable):
        return None, f"the working regime is unstable: the largest multiplier of its motion is {float(orbit.multiplier):.4g}"
    start = orbit.at(0.0)
    run = settle(scene, start=eqx.tree_at(lambda s: s.displacement, start, (1.0 + _INITIAL_SPREAD) * start.displacement))
    if not np.allclose(run.amplitude, orbit.amplitude, rtol=0.0, atol=_SAME_MOTION * float(jnp.max(orbit.amplitude))):
        return None, f"the motion left the working regime and settled at {speed_text(run.omega, 6)}"
    return run, ""


def _jam_run(scene: Scene, mode: int) -> tuple[Run | None, str]:
    orbit = _exact_motion(scene, mode)
    if orbit is None:
        return settle(scene, mode=mode), ""
    if not bool(orbit.stable):
        return None, f"mode {mode} is unstable: the largest multiplier of its exact motion is {float(orbit.multiplier):.4g}"
    run = settle(scene, start=_deviating_start(orbit))
    if not abs(float(run.omega / orbit.omega) - 1.0) < _SAME_DESIGN_DISTANCE:
        return None, f"the motion left mode {mode} and settled at {speed_text(run.omega, 6)}"
    return run, ""


def _exact_motion(scene: Scene, mode: int) -> Orbit | None:
    """Return the exact motion of a jam mode; None if it does not exist, or if `jam_orbit` does not support the scene."""
    try:
        orbit = jam_orbit(scene, mode=mode, throw=False)
    except (InputError, ComputationError):
        return None
    return orbit if math.isfinite(float(orbit.multiplier)) else None


def _deviating_start(orbit: Orbit) -> State:
    """Return a state of the exact motion with slightly separated loads, so that the run leaves the motion if it is unstable.

    From a start on the leading-order motion, a machine with little damping would need thousands of periods to reach the exact
    one.
    """
    displacement, velocity, (angle,), rate = orbit.at(jnp.zeros(()))
    spread = _INITIAL_SPREAD * np.linspace(-1.0, 1.0, len(angle)) if len(angle) > 1 else np.zeros(1)
    return State(displacement, velocity, (angle + spread,), rate)


def _standard_rows(scene: Scene, motion: _Motion, of: Pair) -> list[tuple[str, Quantity]]:
    """Return names and quantities of the standard rows of the table, for a machine in a jam mode or in the working regime."""
    if motion is None:
        return []
    if motion == "working":
        amplitudes = [(name, working_amplitude(scene, k)) for k, name in enumerate(amplitude_names(scene))]
        return [("speed", working_speed()), *amplitudes, ("foundation force", foundation_force())]
    mode = motion
    rows = [("jam frequency", jam_frequency(mode=mode))]
    rows += [(name, amplitude(mode=mode, of=k + 1)) for k, name in enumerate(amplitude_names(scene))]
    rows += [("foundation force", foundation_force(mode=mode))]
    names = [scene.machine.structure().coordinates[number - 1] for number in np.ravel(resolve_pair(scene, of))]
    return [*rows, (f"force per amplitude of {' against '.join(names)}", force_per_amplitude(mode=mode, of=of))]


def _named_quantities(
    space: DesignSpace, scene: Scene, objective: Quantity, demands: Sequence[Demand], motion: _Motion
) -> list[tuple[str, Quantity]]:
    """Return the quantities of the table: the standard ones, then the objective, held quantities and demands."""
    standard = _standard_rows(scene, motion, objective.of)
    sought = objective.parts[0] if objective.name.startswith("negative ") and objective.parts else objective
    named = [sought, *(h.quantity for h in space.held), *(d.quantity for d in demands)]
    standard_quantities = {q for _, q in standard}
    return standard + [(q.words, q) for q in dict.fromkeys(named) if q not in standard_quantities]


def _values_of_all(quantities: tuple[Quantity, ...], initial: Scene, others: Scene, problem: Problem) -> np.ndarray:
    """Return the values (1 + s, q) of quantities of the initial scene and of s other scenes (arrays with a leading axis)."""
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[None], initial)
    if jax.tree.structure(first) == jax.tree.structure(others):
        return evaluate_quantities(quantities, jax.tree.map(lambda a, b: np.concatenate([a, b]), first, others), problem)
    return np.concatenate([evaluate_quantities(quantities, first), evaluate_quantities(quantities, others, problem)])


def _table(
    space: DesignSpace,
    scene: Scene,
    named: Sequence[tuple[str, Quantity]],
    values: np.ndarray,
    other: tuple[list[float], list[float]],
) -> tuple[Row, ...]:
    """Return the rows of free parameters, of further columns of catalogues, of tied parameters and of quantities, before and
    after the search."""
    table = []
    changed = [(number, "") for number in (*space.free, *(column.target for column in space.columns))]
    for number, mark in changed + [(tie.target, f" ({tie.mark})") for tie in space.ties]:
        start, end = (np.asarray(number.read(each)) for each in (space.scene, scene))
        is_new = number.spec.zero_is_absent & (start == 0.0) & (end != 0.0)
        for word, new, a, b in zip(number.words(space.scene), is_new, start, end, strict=True):
            what = f"{word}{' (new)' * bool(new)}{mark}"
            table.append(Row(what, number.unit_of_tables, float(a), float(b), math.nan, math.nan))
    if space.counts:
        counts = float(space.scene.loads.count), float(scene.loads.count)
        table.append(Row("number of loads", "", *counts, math.nan, math.nan))
    entries = zip(named, *values, *other, strict=True)
    return tuple(table + [Row(name, q.unit, float(b), float(a), e, t) for (name, q), b, a, e, t in entries])


class _SettledEvaluation(Evaluation):
    """Evaluation of a scene whose runs of jam modes have settled in their modes."""

    def jam_run(self, mode: int) -> Run:
        """Return the settled run of a jam mode. **Raises** `ComputationError` for an unstable mode."""
        if ("jam", mode) not in self._runs:
            run, reason = _jam_run(self.scene, mode)
            if run is None:
                raise ComputationError("unstable", reason)
            self.keep_run(mode, run)
        return super().jam_run(mode)


def _other_tiers(
    scene: Scene, quantities: Sequence[Quantity], verify: bool, run: Run | None, motion: _Motion
) -> tuple[list[float], list[float]]:
    """Return the values of the quantities by the exact motion and by settled runs; `run` is the settled run of `motion`. A
    value is NaN if the tier cannot compute the quantity, and a value by runs is NaN if its mode is unstable."""

    def value(quantity: Quantity, evaluation: Evaluation, tier: Tier) -> float:
        at_tier = quantity.at_tier(tier)
        if at_tier == quantity and tier not in {getattr(q, "tier", None) for q in walk(quantity)}:
            return math.nan
        if tier == "time" and any(getattr(q, "tier", tier) != tier or hasattr(q, "case") for q in walk(at_tier)):
            return math.nan
        try:
            return float(at_tier.read(evaluation))
        except (InputError, ComputationError):  # the method does not support this scene
            return math.nan

    evaluation = Evaluation(scene)
    exact = [value(q, evaluation, "exact") if verify else math.nan for q in quantities]
    if run is None or motion is None:
        return exact, [math.nan] * len(exact)
    measured = _SettledEvaluation(scene)
    measured.keep_run(motion, run)
    return exact, [value(q, measured, "time") for q in quantities]


def _outcome(space: DesignSpace, scene: Scene, values: np.ndarray) -> Outcome:
    nd = len(scene.machine.structure().coordinates)
    omega, *rest = [*values.tolist(), *[math.nan] * (3 + nd)][: 3 + nd]
    return Outcome(space.parameters(scene), math.isfinite(omega), omega, tuple(rest[:nd]), *rest[nd:])


def _outcome_of_run(space: DesignSpace, run: Run, motion: _Motion, of: Pair) -> Outcome:
    evaluation = Evaluation(run.scene)
    assert motion is not None
    evaluation.keep_run(motion, run)
    rows = _standard_rows(run.scene, motion, of)
    return _outcome(space, run.scene, np.array([float(q.at_tier("time").read(evaluation)) for _, q in rows]))
