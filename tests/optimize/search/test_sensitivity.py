"""Sensitivities at the end of a search, from designs with known multipliers."""

import numpy as np
import pytest
from two_springs import FREE, SCENE, plain, point_of

from optimize import DesignSpace, hold, jam_frequency, peak_force
from optimize.result import Machine
from optimize.search.find import SearchResult
from optimize.search.polish import ACTIVE_DISTANCE, Optimality
from optimize.search.problem import problem_of
from optimize.search.sensitivity import influences_of, limits_of, machines_of, neighbours, unresolved_of

SUM, FIRST = plain("sum", lambda x, y: x + y), plain("first", lambda x, y: x)
WISH = plain("wish", lambda x, y: x * y)
BOUNDS = np.array([1e4, 1e4]), np.array([9e4, 9e4])


def ended(z, values, held=(), demands=(), bounds=(0.0, 0.0), violation=None, limits=BOUNDS):
    s = len(z)
    rows = [np.tile(np.asarray(each, float), (s, 1)) for each in (held, demands, bounds)]
    point = point_of(np.asarray(z), np.asarray(values), np.zeros((s, len(values[0]), 2)))
    violation = np.zeros(s) if violation is None else np.asarray(violation)
    return SearchResult(point, np.zeros((1, s)), np.zeros(s), violation, Optimality(*rows, np.zeros(s)), s, s, False, limits)


def test_limits_have_the_gain_from_their_change():
    """Objective 5. Held: 7, off by 1e-3, multiplier 2. Demands: at 4 of 4, multiplier 3; with room; broken."""
    demands = [FIRST < 4.0, FIRST < 8.0, SUM < 2.0]
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(SUM, 7.0)]), WISH, demands)
    found = ended([[0.5, 0.5]], [[-5.0, 1e-3, 0.0, -0.5, 2.5]], [2.0], [3.0, 9.0, 0.5])
    sides = np.array([[4.0, 4.0], [4.0, 8.0], [7.0, 2.0]])
    held, first, room, broken = limits_of(problem, demands, found, sides)
    assert held.what == "sum held at 7" and held.held and held.active and held.limit == 7.0
    np.testing.assert_allclose(
        [held.value, held.violation, held.multiplier, held.gain], [7.007, 1e-3, -2.0, -2.0 / 5.0], rtol=1e-12
    )
    falling = problem_of(DesignSpace(SCENE, FREE, [hold(SUM, -7.0)]), WISH, demands)  # an increase is a smaller modulus
    assert limits_of(falling, demands, found, sides)[0].multiplier == 2.0
    assert first.active and first.violation == 0.0 and first.what == "first at most 4"
    np.testing.assert_allclose([first.multiplier, first.gain], [-3.0, -3.0 / 5.0], rtol=1e-12)
    assert (first.value, first.limit, room.value, room.limit) == (4.0, 4.0, 4.0, 8.0)
    assert not room.active and room.multiplier == room.gain == room.violation == 0.0
    assert broken.active and broken.violation == 2.5
    kept = ended([[0.5, 0.5]], [[-5.0, 1e-8, 1e-8, -0.5, -2e-6]], [2.0], [3.0, 9.0, 0.5])
    kept = limits_of(problem, demands, kept, sides)
    assert kept[0].violation == kept[1].violation == 0.0 and kept[1].active and not kept[3].active


def test_gain_of_a_limit_that_is_a_quantity():
    """y at most x: the multiplier is in parts of the scale, 5 at the beginning; of the limit's 3 it is 3/5."""
    demand = plain("y", lambda x, y: y) < FIRST
    problem = problem_of(DesignSpace(SCENE, FREE), WISH, [demand])
    found = ended([[0.25, 0.25]], [[10.0, 0.0]], (), [2.0])
    (limit,) = limits_of(problem, [demand], found, np.array([[3.0, 3.0]]))
    np.testing.assert_allclose([limit.multiplier, limit.gain], [-2.0 * 3.0 / 5.0, -1.2 / 10.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("scale", "z", "dual", "what", "multiplier"),
    [
        # d f / d z = -dual; a bound moved by the whole of itself: z moves by k / (d k / d z).
        ("even", 1.0, 3.0, "stiffness of support 1 at most 90 N/mm", -3.0 * 9e4 / 8e4),
        ("even", 0.0, -3.0, "stiffness of support 1 at least 10 N/mm", -3.0 * 1e4 / 8e4),
        ("log", 1.0, 3.0, "stiffness of support 1 at most 90 N/mm", -3.0 / np.log(9.0)),
    ],
)
def test_active_bounds_are_listed(scale, z, dual, what, multiplier):
    problem = problem_of(DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4, scale)}), WISH, [])
    (limit,) = limits_of(problem, [], ended([[z, 0.5]], [[4.0]], bounds=[dual, 0.0]), np.zeros((0, 2)))
    assert limit.what == what and limit.active and limit.violation == 0.0
    np.testing.assert_allclose(limit.limit, 9e4 if z == 1.0 else 1e4)
    np.testing.assert_allclose([limit.multiplier, limit.gain], [multiplier, multiplier / 4.0], rtol=1e-12)
    near = ended([[abs(z - 0.5 * ACTIVE_DISTANCE), 0.5]], [[4.0]], bounds=[dual, 0.0])
    assert [limit.what for limit in limits_of(problem, [], near, np.zeros((0, 2)))] == [what]
    away = ended([[0.999, 0.5]], [[4.0]], bounds=[dual, 0.0])
    assert limits_of(problem, [], away, np.zeros((0, 2))) == ()
    fixed = np.array([9e4, 1e4]), np.array([9e4, 9e4])
    alone = problem_of(problem.space.within(*fixed), WISH, [])  # a number that cannot change is at no bound
    assert limits_of(alone, [], ended([[z, 0.5]], [[4.0]], bounds=[dual, 0.0], limits=fixed), np.zeros((0, 2))) == ()
    assert limits_of(problem, [], ended([[z, 0.5]], [[4.0]]), np.zeros((0, 2))) == ()


def test_gains_are_of_the_best_design():
    problem = problem_of(DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4, "even")}), WISH, [])
    found = ended([[0.5, 0.5], [1.0, 0.5]], [[4.0], [2.0]], bounds=[3.0, 0.0])
    (limit,) = limits_of(problem, [], found, np.zeros((0, 2)))
    np.testing.assert_allclose(limit.gain, -3.0 * 9.0 / 8.0 / 2.0, rtol=1e-12)
    near = neighbours(problem, found)
    near, tiny = near[:5], near[5:]
    np.testing.assert_allclose(near, [[9e4, 5e4], [8.91e4, 5e4], [9e4, 4.95e4], [9.09e4, 5e4], [9e4, 5.05e4]], rtol=1e-12)
    shares = tiny / near[0] - 1.0
    np.testing.assert_allclose(shares[:, 0], shares[:, 1], atol=1e-15)
    np.testing.assert_allclose(shares[:, 0], [-1e-6, -3e-7, 3e-7, 1e-6], atol=1e-15)


def test_influences_are_changes_of_the_objective():
    problem = problem_of(DesignSpace(SCENE, FREE), WISH, [])
    first, second = influences_of(problem, [], np.array([[-4.0, -3.0, -4.4, -5.0, -4.2, *[-4.0] * 4]]).T)
    assert first.what == "stiffness of support 1" and second.what == "stiffness of support 2"
    np.testing.assert_allclose([first.less, first.more, second.less, second.more], [25.0, -25.0, -10.0, -5.0])
    assert influences_of(problem, [], np.zeros((9, 1))) == ()


def test_influences_name_the_demands_that_a_change_breaks():
    demands = [WISH < 3.0, WISH > 1.0]
    problem = problem_of(DesignSpace(SCENE, FREE), WISH, demands)
    values = [[3.0, 1.5], [2.9, 1.5], [3.1, 0.9], [3.0, 1.5], [2.5, 0.5], *[[3.0, 1.5]] * 4]
    reports = np.array([[1.0, first, 3.0, second, 1.0] for first, second in values])
    first, second = influences_of(problem, demands, reports)
    most, least = (demand.words for demand in demands)
    assert first[3:] == ((), ()) and first.unmet_text() == ""
    assert second[3:] == ((most, least), (least,))
    assert second.unmet_text() == f" (1 % less does not meet {most}, {least}; 1 % more does not meet {least})"


@pytest.mark.parametrize(
    ("changes", "tiny", "is_unresolved"),
    [
        ([-0.3, 0.1, 0.4, np.nan], 0.2, True),  # chaotic
        ([-0.3, 0.1, 0.4, 0.0], 3e-3, False),
        ([-0.3, 0.1, 0.4, 0.0], 4e-5, False),  # smooth
        ([-4e-4, 0.0, 4e-4, 0.0], 1e-4, False),  # errors of integration
    ],
)
def test_unresolved_quantities_change_by_tiny_steps(changes, tiny, is_unresolved):
    """The quantity of the run is 2 N, those without a run change in the same way."""
    values = 2.0 + np.array([0.0, *changes, 0.0, tiny, 0.0, 0.0])[:, None] * np.ones(3)
    quantities = [peak_force(until="2 s"), FIRST, jam_frequency(mode=1)]
    found = unresolved_of(quantities, values)
    assert [each.what for each in found] == ["largest foundation force of a run from rest", "first"] * is_unresolved
    for each in found:
        np.testing.assert_allclose([each.tiny, each.large], [10.0, 20.0])


def test_machines_are_distinct_beyond_a_distance():
    problem = problem_of(DesignSpace(SCENE, FREE), WISH, [])
    z = [[0.5, 0.5], [0.25, 0.5], [0.5005, 0.4995], [0.25, 0.502], [0.9, 0.9], [0.1, 0.1]]
    found = ended(z, [[3.0], [2.0], [1.0], [4.0], [0.5], [np.nan]], violation=[0.0, 0.0, 0.0, 9e-8, 0.1, np.inf])
    best, second, third = machines_of(problem, found, 1e-3)
    assert isinstance(best, Machine) and (best.starts, best.value) == (2, 1.0)
    np.testing.assert_allclose(best.numbers, [1e4 + 8e4 * 0.5005, 1e4 + 8e4 * 0.4995])
    assert (second.starts, second.value, third.starts, third.value) == (1, 2.0, 1, 4.0)


def test_demand_on_a_missing_quantity_is_not_met():
    """NaN keeps no demand, and nothing that is held."""
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(SUM, 7.0)]), WISH, [FIRST < 4.0])
    found = ended([[0.5, 0.5]], [[np.nan, np.nan, np.nan]], [0.0], [0.0])
    held, first = limits_of(problem, [FIRST < 4.0], found, np.array([[np.nan, 4.0]]))
    assert held.violation == first.violation == np.inf
    assert first.shortfall() == held.shortfall() == "the nearest machine does not have this quantity"
