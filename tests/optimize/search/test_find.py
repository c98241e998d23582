"""Search from starts to the best designs: ranking, continuation, choice from catalogues."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FREE, SCENE, plain, point_of

from optimize import DesignSpace, expected, hold, jam_frequency, largest, support_frequency_squared, synthesize
from optimize.quantities.quantity import BuiltinQuantity
from optimize.search import find as find_module
from optimize.search.find import (
    Options,
    SearchResult,
    _best_distinct,
    _distance_to_catalogue,
    _distinct,
    _has_tolerances,
    _with_requested_modes,
    choose,
    find,
)
from optimize.search.polish import Optimality
from optimize.search.problem import evaluate, find_speeds, problem_of

BOUNDS = np.array([1e4, 1e4]), np.array([9e4, 9e4])
NEAR = plain("near", lambda x, y: (x - 6.0) ** 2 + (y - 5.0) ** 2 + 2.0)


def ended(values, violation, z=None):
    """Searches that ended with these objectives."""
    s = len(values)
    z = np.linspace(0.0, 1.0, 2 * s).reshape(s, 2) if z is None else np.asarray(z)
    none = Optimality(np.zeros((s, 0)), np.zeros((s, 0)), np.zeros((s, 2)), np.zeros(s))
    point = point_of(z, np.asarray(values)[:, None], np.zeros((s, 1, 2)))
    return SearchResult(point, np.zeros((1, s)), np.zeros(s), np.asarray(violation), none, s, s, False, BOUNDS)


def test_best_design_is_the_least_that_meets_all_demands():
    assert ended([3.0, 1.0, 2.0, 2.5], [0.0, 1.0, 9e-8, 0.0]).best == 2
    assert ended([3.0, 1.0, 2.0, 2.5], [2e-7, 0.4, 0.3, 5.0]).best == 0  # none keeps them: the one that nearly does


def test_best_distinct_designs_are_selected():
    z = [[0.5, 0.5], [0.505, 0.493], [0.2, 0.5], [0.5, 0.52], [0.9, 0.9], [0.1, 0.1]]
    found = ended([3.0, 2.0, 5.0, 4.0, np.nan, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], z)
    np.testing.assert_array_equal(_best_distinct(found), [z[1], z[3], z[2], z[5]])  # what keeps no demand comes last
    many = ended(np.arange(20.0), np.zeros(20))
    np.testing.assert_array_equal(_best_distinct(many), many.point.z[:7])
    assert _best_distinct(ended([np.nan], [np.inf])).shape == (0, 2)


def test_distance_of_a_parameter_from_its_catalogue():
    assert (
        _distance_to_catalogue((1.0, 2.0, 4.0), 2.5) == 0.25
        and _distance_to_catalogue((1.0, 2.0, 4.0), 3.5) == 0.125
        and _distance_to_catalogue((1.0, 2.0), 1.0) == 0.0
    )
    assert _distance_to_catalogue((0.0, 2.0), 0.0) == 0.0


def test_jam_with_another_mode_number_is_rejected():
    problem = problem_of(DesignSpace(SCENE, FREE), jam_frequency(mode=3), [], 2)
    z = np.array([[0.5, 0.5], [0.4, 0.3]])
    point = evaluate(problem, z, find_speeds(problem, z))
    np.testing.assert_array_equal(_with_requested_modes(problem, point).values, point.values)
    other = point._replace(speeds=(point.speeds[0] * np.array([1.0, 1.001]),))
    kept = _with_requested_modes(problem, other)
    np.testing.assert_array_equal(kept.values[:, 0], [point.values[0, 0], np.nan])
    np.testing.assert_array_equal(kept.slopes, point.slopes)


def test_fold_that_does_not_exist_rejects_no_design(monkeypatch):
    none = (np.array([np.inf]),)
    monkeypatch.setattr(find_module, "find_speeds", lambda *_: none)
    point = point_of(np.zeros((1, 2)), np.ones((1, 1)), np.ones((1, 1, 2)))._replace(speeds=none)
    assert _with_requested_modes(SimpleNamespace(keys=(((), ("above", 5)),)), point).values == 1.0


def test_tolerances_are_found_in_nested_quantities():
    space, off = DesignSpace(SCENE, FREE), {"machine.stiffness": 0.05}
    mean = expected(NEAR, off, samples=4)
    for objective, demands, counts in (
        (NEAR, [], False),
        (largest(NEAR, mean), [], True),
        (NEAR, [mean < 3.0], True),
        (NEAR, [plain("other", lambda x, y: x) < mean], True),
    ):
        assert _has_tolerances(problem_of(space, objective, demands)) == counts


OPTIONS = Options(starts=4, seed=0, iterations=25, rate=0.05, polishing=8)


def test_search_reports_progress_and_history():
    problem = problem_of(DesignSpace(SCENE, FREE), NEAR, [], 4)
    told = []
    found = find(problem, OPTIONS, lambda what, share: told.append((what, share)))
    assert told[0] == ("selecting initial designs", 0.0)
    shares = [share for _, share in told]
    assert shares == sorted(shares) and ("descending, best 2.063", 0.7) in told and told[-1] == ("polishing, best 2", 0.9)
    random = np.random.default_rng(0).uniform(size=(4, 2))
    starts = 1.0 + 8.0 * random
    np.testing.assert_allclose(found.history[0, :, 0], np.sum((starts - [6.0, 5.0]) ** 2, axis=1) + 2.0, rtol=1e-12)
    assert len(found.history) >= 1 + 25 + 2 and found.drawn == found.existing == 4 and not found.interrupted
    np.testing.assert_allclose(found.history[-1, :, 0], 2.0, rtol=1e-12)
    np.testing.assert_array_equal(found.bounds, BOUNDS)
    begun = find(problem, Options(4, 0, 25, 0.05, 8, begin=np.array([[0.1, 0.2], [0.3, 0.9]])), lambda *_: None)
    np.testing.assert_allclose(
        begun.history[0, :, 0], [(1.8 - 6.0) ** 2 + (2.6 - 5.0) ** 2 + 2.0, 2.6**2 + 3.2**2 + 2.0], rtol=1e-12
    )
    assert begun.drawn == begun.existing == 2
    nowhere = problem_of(DesignSpace(SCENE, FREE), plain("no", lambda x, y: x * np.nan), [], 4)
    assert find(nowhere, OPTIONS, lambda *_: None) is None


def test_searches_with_runs_descend_from_the_eight_best_starts():
    def near(evaluation, tier):
        return jnp.sum((evaluation.scene.machine.stiffness / 1e4 - jnp.array([6.0, 5.0])) ** 2) + 2.0

    timed = BuiltinQuantity("timed", "", near, tier="time", tiers=("time",))
    told = []
    problem = problem_of(DesignSpace(SCENE, FREE), timed, [], 20)
    found = find(problem, dataclasses.replace(OPTIONS, starts=20), lambda what, share: told.append((what, share)))
    assert found.drawn == found.existing == 20 and found.history.shape[1] == 8
    random = 1.0 + 8.0 * np.random.default_rng(0).uniform(size=(20, 2))
    best = np.sort(np.sum((random - [6.0, 5.0]) ** 2, axis=1))[:8] + 2.0
    np.testing.assert_allclose(found.history[0, :, 0], best, rtol=1e-12)
    np.testing.assert_allclose(found.point.values[:, 0], 2.0, rtol=1e-12)
    # 20 designs are drawn; 8 take 25 steps of descent and 8 steps of polishing with 6 designs each.
    np.testing.assert_allclose(told[1][1], 0.9 * 220.0 / 604.0, rtol=1e-12)


def test_designs_nearest_to_their_demands_are_selected_last():
    point = ended([3.0, 1.0, 2.0, 9.0], np.zeros(4)).point
    np.testing.assert_array_equal(_distinct(point, np.array([0.0, 0.5, 0.1, 9e-8])), [0, 3, 2, 1])


def test_costly_objectives_start_from_nominal_optima():
    problem = problem_of(DesignSpace(SCENE, FREE), expected(NEAR, {"machine.stiffness": 0.05}, samples=4), [], 4)
    told = []
    found = find(problem, OPTIONS, lambda what, share: told.append((what, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares) and {"selecting initial designs"} == {what for what, share in told if share in (0.0, 0.5)}
    assert found.drawn == found.existing == 4 and len(found.point.z) == 16  # the best one, and random ones beside it
    random = np.random.default_rng(0).uniform(size=(16, 2))
    begun = evaluate(problem, np.concatenate([[[0.625, 0.5]], random])[:16], ())
    np.testing.assert_allclose(found.history[0, :, 0], begun.values[:, 0], rtol=1e-6)
    np.testing.assert_allclose(found.point.z[found.best], [0.625, 0.5], atol=0.01)


CATALOGUE = [1e4, 1.5e4, 2.2e4, 3.3e4, 4.7e4, 6.8e4]


def bent(x, y):
    return (x * y - 6.0) ** 2 + (x - 2.0 * y) ** 2 + 1.0


def chosen(demands=(), catalogue=CATALOGUE, wish=bent, tell=lambda *_: None):
    space = DesignSpace(SCENE, {}, choices={"machine.stiffness": catalogue})
    problem = problem_of(space, plain("bent", wish), demands, 4)
    return problem, choose(problem, OPTIONS, tell)


def test_choices_from_catalogues_are_the_best_of_all():
    told = []
    problem, found = chosen(tell=lambda what, share: told.append((what, share)))
    choosing = [share for what, share in told if what.startswith("choosing")]
    assert choosing == sorted(choosing) and 0.5 < choosing[0] <= choosing[-1] < 0.9
    assert all(share <= 0.5 for what, share in told if not what.startswith("choosing"))
    tried = {pair: bent(*(np.array(pair) / 1e4)) for pair in itertools.product(CATALOGUE, CATALOGUE)}
    least = min(tried, key=tried.get)
    numbers = problem.space.within(*found.bounds).numbers(found.point.z[found.best])
    np.testing.assert_allclose(numbers, least, rtol=1e-9)
    np.testing.assert_allclose(found.point.values[found.best, 0], tried[least], rtol=1e-9)
    assert 2 <= found.nodes < 20 and found.drawn == found.existing == 4


def test_chosen_rows_of_a_catalogue_are_the_best_of_all():
    rows = [(1e4, 6.8e4), (1.5e4, 3.3e4), (2.2e4, 4.7e4), (3.3e4, 1.5e4), (4.7e4, 1e4), (6.8e4, 2.2e4)]
    first, second = (list(column) for column in zip(*rows[::-1], strict=True))
    space = DesignSpace(SCENE, {}, choices={"spring": {"machine.stiffness[0]": first, "machine.stiffness[1]": second}})
    problem = problem_of(space, plain("bent", bent), (), 4)
    found = choose(problem, OPTIONS, lambda *_: None)
    best = space.scene_of(space.within(*found.bounds).numbers(found.point.z[found.best]))
    least = min(rows, key=lambda row: bent(row[0] / 1e4, row[1] / 1e4))
    np.testing.assert_allclose(best.machine.stiffness, least, rtol=1e-9)
    np.testing.assert_allclose(found.point.values[found.best, 0], bent(least[0] / 1e4, least[1] / 1e4), rtol=1e-9)


def test_catalogue_that_meets_no_demand_gives_a_violation():
    first = plain("first", lambda x, y: x)
    problem, found = chosen([first > 1.6, first < 2.1])
    numbers = problem.space.within(*found.bounds).numbers(found.point.z[found.best])
    assert set(numbers.tolist()) <= set(CATALOGUE) and numbers[0] in (1.5e4, 2.2e4)
    assert found.violation[found.best] > 0.01 and not found.interrupted and found.nodes > 0 and found.drawn == 4


def test_optimum_in_the_catalogue_needs_no_branching():
    _, found = chosen(wish=lambda x, y: (x - 1.5) ** 2 + (y - 4.7) ** 2 + 1.0)
    assert found.nodes == 0


def interrupts(what_begins):
    """A function that interrupts a search at a step, and the number of steps that it is told afterwards."""
    after = []

    def tell(what, share):
        if after or what.startswith(what_begins):
            after.append(what)
        if len(after) == 1:
            raise KeyboardInterrupt

    return tell, after


@pytest.mark.parametrize(("tolerances", "polishing", "steps"), [(False, 8, 20), (False, 30, 30), (True, 8, 8)])
def test_second_search_starts_from_the_best_of_the_first(tolerances, polishing, steps, monkeypatch):
    asked, told = [], []
    results = {"simple": ended([3.0, 1.0, 2.0], np.zeros(3))._replace(drawn=40, existing=30), "small": ended([0.5], [0.0])}

    def search(problem, options, report):
        asked.append((problem, options))
        report("polishing", 0.5)
        return results[problem]

    problem = SimpleNamespace(simplified=lambda: "simple", space=SimpleNamespace(size=2))
    for name, part in (
        ("_search_from_starts", search),
        ("_in_small_batches", lambda *_: "small"),
        ("_has_tolerances", lambda _: tolerances),
    ):
        monkeypatch.setattr(find_module, name, part)
    found = find(problem, dataclasses.replace(OPTIONS, polishing=polishing), lambda what, share: told.append(share))
    (one, first), (other, second) = asked
    assert (one, other, told) == ("simple", "small", [0.25, 0.75]) and (first.iterations, first.polishing) == (25, polishing)
    assert (second.iterations, second.polishing) == (25 if tolerances else 0, steps)
    np.testing.assert_array_equal(second.begin[:3], _best_distinct(results["simple"]))
    assert len(second.begin) == (16 if tolerances else 3) and np.all((second.begin >= 0.0) & (second.begin <= 1.0))
    assert (found.drawn, found.existing, found.interrupted, len(found.point.z)) == (40, 30, False, 1)


@pytest.mark.parametrize("stage", ["descending", "polishing"])
def test_interrupt_of_the_first_stage_ends_without_polishing(stage, monkeypatch):
    steps = []
    polish = find_module.polish
    monkeypatch.setattr(find_module, "polish", lambda p, point, n, tell: steps.append(n) or polish(p, point, n, tell))
    costly = expected(NEAR, {"machine.stiffness": 0.05}, samples=4)
    tell, _ = interrupts(stage)
    found = find(problem_of(DesignSpace(SCENE, FREE), costly, [], 4), OPTIONS, tell)
    assert found.interrupted and steps == {"descending": [0, 0], "polishing": [8, 0, 0]}[stage] and found.drawn == 4
    assert len(found.point.z) == 1 and found.point.values[0, 0] < 20.0


def test_interrupted_search_of_a_demand_is_not_contradictory():
    space = DesignSpace(SCENE, FREE, [hold(support_frequency_squared(), 300.0)])
    best = synthesize(space, NEAR, starts=4, iterations=25, polishing=8, progress=interrupts("descending")[0])
    assert best.status_name == "interrupted" and best.unverified == "the search was interrupted" and best.run is None


@pytest.mark.parametrize("stage", ["descending", "choosing"])
def test_interrupted_choice_is_in_its_catalogue(stage):
    tell, after = interrupts(stage)
    problem, found = chosen(tell=tell)
    numbers = problem.space.within(*found.bounds).numbers(found.point.z[found.best])
    assert found.interrupted and set(np.round(numbers, 6)) <= set(CATALOGUE) and len(after) == 1


def test_choices_meet_demands_or_have_a_violation(monkeypatch):
    product = plain("product", lambda x, y: x * y)
    problem, found = chosen([product > 9.0])
    tried = {pair: bent(*(np.array(pair) / 1e4)) for pair in itertools.product(CATALOGUE, CATALOGUE) if np.prod(pair) > 9e8}
    numbers = problem.space.within(*found.bounds).numbers(found.point.z[found.best])
    np.testing.assert_allclose(numbers, min(tried, key=tried.get), rtol=1e-9)
    _, none = chosen([product > 8.9, product < 9.0], [1e4, 2e4, 7e4])  # machines between, but no choice
    assert none.violation[none.best] > 0.1
    monkeypatch.setattr(find_module, "_MAX_NODES", 0)
    _, limited = chosen()
    assert limited.violation[limited.best] == 0.0 and limited.remaining_decrease[limited.best] == np.inf
    assert {low for low, _ in zip(*limited.bounds, strict=True)} <= set(CATALOGUE)


@pytest.mark.parametrize("bounds", [((1e4, 4e4), (2e4, 4e4)), ((7e4, 7e4), (7e4, 9e4))])
def test_best_design_in_narrow_bounds_lies_on_a_bound(bounds):
    problem = problem_of(DesignSpace(SCENE, FREE), NEAR, [], 4)
    low, high = (np.array(each) for each in bounds)
    found = find_module._solve_in_bounds(problem, low, high, np.array([[3e4, 3e4], [8e4, 1e4]]), OPTIONS.polishing)
    numbers = problem.space.within(low, high).numbers(found.point.z)
    np.testing.assert_allclose(numbers, np.clip([[6e4, 5e4]] * 2, low, high), rtol=1e-9)
    np.testing.assert_array_equal(found.bounds, [low, high])


def test_designs_that_lose_their_mode_fall_back_to_the_start(monkeypatch):
    """A machine that has the mode is worth more than a better one without: the second of two ends without values."""
    problem = problem_of(DesignSpace(SCENE, FREE), NEAR, [plain("x", lambda x, y: x) < 4.0], 2)
    kept = find_module._with_requested_modes
    asked = []

    def lost(problem, point):
        asked.append(point)
        if len(asked) > 1:
            return kept(problem, point)
        return point._replace(values=np.where([[True], [False]], point.values, np.nan))

    monkeypatch.setattr(find_module, "_with_requested_modes", lost)
    begin = np.array([[0.1, 0.2], [0.5, 0.9]])  # x = 5 of 4 at most
    found = find(problem, Options(2, 0, 25, 0.05, 8, begin=begin), lambda *_: None)
    np.testing.assert_array_equal(found.point.z[1], begin[1])
    np.testing.assert_allclose(found.point.z[0], [0.375, 0.5], atol=1e-8)
    np.testing.assert_allclose(found.point.values[1], [1.0 + 3.2**2 + 2.0, 0.25], rtol=1e-12)
    np.testing.assert_allclose(found.violation, [0.0, 0.25], atol=1e-9)
    assert found.remaining_decrease[0] < 1e-9 and found.remaining_decrease[1] == np.inf and found.optimality.kkt.shape == (2,)
