"""Polishing, part by part: multipliers that are known, the nearest designs that keep what is held, starts, the last steps."""

import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FREE, SCENE, plain, point_of

from optimize import DesignSpace, hold, largest
from optimize.search import polish as polishing
from optimize.search.model import Step
from optimize.search.polish import _merit, _move, _Searches, draw_starts, optimality, polish, restore, violation
from optimize.search.problem import evaluate, find_speeds, problem_of

SUM = plain("sum", lambda x, y: x + y)
FIRST = plain("first", lambda x, y: x)
NEAR = plain("near", lambda x, y: (x - 6.0) ** 2 + (y - 5.0) ** 2 + 2.0)


@pytest.fixture(scope="module")
def held():
    """x + y = 7 and x at most 4, of x, y from 1 to 9."""
    return problem_of(DesignSpace(SCENE, FREE, [hold(SUM, 7.0)]), NEAR, [FIRST < 4.0], starts=2)


def at(problem, *xy):
    return evaluate(problem, (np.array(xy) - 1.0) / 8.0, ())


def xy(point):
    return 1.0 + 8.0 * point.z


def test_violation_is_the_largest_residual(held):
    values = np.array([[9.0, -0.3, 0.2], [9.0, 0.1, 0.2], [9.0, -0.1, -5.0], [np.nan, 0.0, 0.0]])
    point = point_of(np.full((4, 2), 0.5), values, np.ones((4, 3, 2)))
    np.testing.assert_array_equal(violation(held, point), [0.3, 0.2, 0.1, np.inf])
    # What a step is judged by: the objective in parts of its size, and the price of all that is off together.
    size, penalty = np.full(4, 3.0), np.full(4, 10.0)
    np.testing.assert_allclose(_merit(held, point, size, penalty), [3.0 + 5.0, 3.0 + 3.0, 3.0 + 1.0, np.inf], rtol=1e-14)
    one = point_of(np.full((1, 2), 0.5), np.array([[9.0, 1e-13, 0.0]]), np.ones((1, 3, 2)))
    np.testing.assert_array_equal(_merit(held, one, np.ones(1), np.array([1e9])), [9.0])  # rounding costs nothing


def test_restore_moves_to_the_nearest_feasible_design(held):
    start = at(held, (3.0, 2.0), (6.0, 4.0), (1.0, 7.0), (8.0, 1.0))
    # Across the line; to the corner; what is at its bound stays there; no step is longer than 0.3 of a range.
    np.testing.assert_allclose(xy(restore(held, start, 2)), [[4.0, 3.0], [4.0, 3.0], [1.0, 6.0], [4.0, 3.0]], atol=1e-9)
    np.testing.assert_allclose(xy(restore(held, start, 1)), [[4.0, 3.0], [4.0, 3.0], [1.0, 6.0], [5.6, 3.0]], atol=1e-9)
    room = at(held, (2.0, 4.0), (2.0, 4.0))
    wanted = np.array([[False], [True]])
    np.testing.assert_allclose(xy(restore(held, room, 1, wanted)), [[2.5, 4.5], [4.0, 3.0]], atol=1e-9)
    free = problem_of(DesignSpace(SCENE, FREE), NEAR, [], starts=2)
    assert restore(free, start, 2) is start


def test_restore_moves_designs_onto_their_kink():
    pieces = [plain(str(k), lambda x, y, k=k: (x - k) ** 2 + (y - 4.0) ** 2 + 1.0) for k in (3.0, 6.0)]
    problem = problem_of(DesignSpace(SCENE, FREE), largest(*pieces), [], starts=2)
    both = np.full((2, 2), 0.5)
    np.testing.assert_allclose(xy(restore(problem, at(problem, (3.5, 2.0), (5.5, 7.0)), 4, None, both))[:, 0], 4.5, atol=1e-9)
    np.testing.assert_allclose(xy(restore(problem, at(problem, (3.5, 2.0)), 2, None, np.array([[0.0, 1.0]]))), [[3.5, 2.0]])


SPACE = DesignSpace(SCENE, {**FREE, "machine.link_stiffness": (1e5, 4e5), "loads.drag": (1.0, 2.0)}, [hold(SUM, 7.0)])
MANY = problem_of(SPACE, NEAR, [FIRST < 4.0, FIRST < 5.0], starts=2)


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_multipliers_are_recovered_from_their_slopes(scale):
    """One held, two demands, a number at each kind of bound: the objective's slope is put together of known multipliers, and
    multipliers are ratios of slopes, whatever the size of these."""
    random = np.random.default_rng(0)
    rows = random.normal(size=(6, 3, 4))
    held, first, second = random.normal(size=6), random.uniform(1.0, 2.0, 6), random.uniform(1.0, 2.0, 6)
    bounds = np.zeros((6, 4))
    z = np.full((6, 4), 0.5)
    z[:, 1], bounds[:, 1] = 1.0, random.uniform(1.0, 2.0, 6)
    z[:3, 2], bounds[:3, 2] = 0.0, -random.uniform(1.0, 2.0, 3)
    second[:3] = 0.0  # a demand with room has no multiplier, whatever its slope
    values = np.stack([np.full(6, 3.0), np.zeros(6), np.zeros(6), np.where(second > 0.0, 0.0, -0.5)], axis=1)
    slope = -np.einsum("ms,smd->sd", np.stack([held, first, second]), rows) - bounds
    found = optimality(MANY, point_of(z, values, scale * np.concatenate([slope[:, None], rows], axis=1)))
    np.testing.assert_allclose(found.held[:, 0], held, rtol=1e-9)
    np.testing.assert_allclose(found.demands, np.stack([first, second], axis=1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.bounds / scale, bounds, atol=1e-9)
    assert np.all(found.kkt < 1e-9)


def test_kkt_residual_is_the_unbalanced_slope():
    """A demand that the objective leaves by itself, and bounds that it leaves, hold nothing back: the rest is the residual, in
    parts of the slope, or of the objective where this is larger, and no less than what is off."""
    none = np.zeros((1, 4))
    slope, row = np.array([[-3.0, 1.0, -2.0, 0.5]]), np.array([[-1.0, 0.0, 0.0, 0.0]])
    z = np.array([[0.5, 0.5, 0.0, 1.0]])
    point = point_of(z, np.array([[0.1, 0.0, 0.0, -9.0]]), np.stack([slope, none, row, none], axis=1))
    found = optimality(MANY, point)
    np.testing.assert_array_equal(found.demands, [[0.0, 0.0]])
    np.testing.assert_array_equal(found.bounds, none)
    np.testing.assert_allclose(found.kkt, [1.0], rtol=1e-12)
    large = point._replace(values=np.array([[-12.0, 0.0, 0.0, -9.0]]))
    np.testing.assert_allclose(optimality(MANY, large).kkt, [0.25], rtol=1e-12)
    off = point._replace(values=np.array([[0.1, 0.0, 7.0, -9.0]]))
    np.testing.assert_allclose(optimality(MANY, off).kkt, [7.0], rtol=1e-12)
    # At the bounds with nothing else to gain: what pushes against them.
    stopped = point._replace(slopes=np.stack([-slope * [[0, 0, 1, 1]], none, none, none], axis=1))
    np.testing.assert_allclose(optimality(MANY, stopped).bounds, [[0.0, 0.0, -2.0, 0.5]], rtol=1e-12)
    assert optimality(MANY, stopped).kkt[0] == 0.0
    # A number that a catalogue has fixed is at no bound.
    low, high = np.asarray(SPACE.low).copy(), np.asarray(SPACE.high)
    low[0] = high[0]
    fixed = problem_of(SPACE.within(low, high), NEAR, [FIRST < 4.0, FIRST < 5.0], starts=2)
    at_zero = stopped._replace(z=np.array([[0.0, 0.5, 0.0, 1.0]]), slopes=stopped.slopes + np.eye(4)[0])
    found = optimality(fixed, at_zero)
    np.testing.assert_allclose(found.bounds, [[0.0, 0.0, -2.0, 0.5]], rtol=1e-12)
    assert found.kkt[0] == 0.0


def test_at_a_kink_the_slopes_of_its_pieces_balance():
    pieces = [plain(str(k), lambda x, y, k=k: (x - k) ** 2 + (y - 4.0) ** 2) for k in (3.0, 6.0)]
    problem = problem_of(DesignSpace(SCENE, FREE), largest(*pieces), [], starts=2)
    found = optimality(problem, at(problem, (4.5, 4.0), (4.5, 6.0), (4.6, 4.0)))
    # 2.25 with slopes of 3 on both sides, 8 times so in parts of the range; off it the slope itself.
    np.testing.assert_allclose(found.kkt, [0.0, 32.0 / 32.0, 1.0], atol=1e-9)
    assert found.demands.shape == (3, 0) and found.held.shape == (3, 0)


def test_starts_are_random_designs_with_an_objective():
    problem = problem_of(DesignSpace(SCENE, FREE), plain("half", lambda x, y: jnp.where(x > 5.0, x * y, jnp.nan)), [], starts=8)
    found = draw_starts(problem, 8, 3, find_speeds)
    random = np.random.default_rng(3)
    drawn = np.concatenate([random.uniform(size=(8, 2)) for _ in range(found.drawn // 8)])
    there = drawn[drawn[:, 0] > 0.5]
    np.testing.assert_array_equal(found.point.z, there[:8])
    assert found.existing == len(there) >= 8 > np.sum(drawn[:-8, 0] > 0.5) and found.off_held is None
    nowhere = problem_of(DesignSpace(SCENE, FREE), plain("no", lambda x, y: x * jnp.nan), [], starts=4)
    assert draw_starts(nowhere, 4, 0, find_speeds, rounds=2) == (None, 8, 0, None)


def test_starts_are_moved_to_the_held_values():
    product = plain("product", lambda x, y: x * y)
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(product, 40.0)]), NEAR, [], starts=8)
    found = draw_starts(problem, 8, 0, find_speeds)
    np.testing.assert_allclose(np.prod(xy(found.point), axis=1), 40.0, rtol=1e-8)
    assert found.existing == found.drawn and len(found.point.z) == 8
    assert np.all((found.point.z >= 0.0) & (found.point.z <= 1.0))
    corner = problem_of(DesignSpace(SCENE, FREE, [hold(product, 80.9)]), NEAR, [], starts=8)  # of 81 at most
    there = draw_starts(corner, 8, 0, find_speeds)
    np.testing.assert_allclose(np.prod(xy(there.point), axis=1), 80.9, rtol=1e-8)
    # If no design has the value that is held, random designs are returned in `off_held`.
    far = problem_of(DesignSpace(SCENE, FREE, [hold(product, 500.0)]), NEAR, [], starts=8)
    none = draw_starts(far, 8, 0, find_speeds, rounds=2)
    assert none.point is None and none.drawn == none.existing == 16
    np.testing.assert_array_equal(none.off_held.z, np.random.default_rng(0).uniform(size=(8, 2)))


def test_polishing_reports_its_residual_and_ends_early(held):
    """(x - 6)^2 + (y - 5)^2 + 2 along x + y = 7: the least is 8 + 2 at (4, 3), where x is at its limit as well."""
    start = at(held, (2.0, 2.0), (6.0, 8.0), (1.5, 6.0), (9.0, 1.0))
    shares = []
    none = polish(held, start, 0, lambda share, point: shares.append(share))
    on = restore(held, start, 2)
    np.testing.assert_array_equal(none.point.z, on.z)
    np.testing.assert_array_equal(none.history[..., 0], on.values[None, :, 0])
    assert shares == []
    ended = polish(held, start, 4, lambda share, point: shares.append(share))
    np.testing.assert_allclose(xy(ended.point), [[4.0, 3.0]] * 4, atol=1e-8)
    assert np.all(ended.remaining_decrease < 1e-10) and np.all(ended.violation < 1e-10) and np.all(ended.optimality.kkt < 1e-8)
    np.testing.assert_allclose(shares[:4], [0.25, 0.5, 0.75, 1.0])


def test_remaining_decrease_is_that_of_the_better_model():
    """f = x^2 + y^2 + 2 about its least value, g.g/2 H = f - 2: of the model with f'' it is (f - 2)/f, of that with (f^2/2)''/f
    = f'' + g g/f less by 1 + 2 (f - 2)/f."""
    problem = problem_of(DesignSpace(SCENE, FREE), NEAR, [], starts=2)
    found = polish(problem, at(problem, (5.5, 4.5), (6.0, 5.5)), 0, lambda *_: None)
    f = np.array([2.5, 2.25])
    np.testing.assert_allclose(found.remaining_decrease, (f - 2.0) / f / (1.0 + 2.0 * (f - 2.0) / f), rtol=1e-5)


def test_polishing_follows_a_curved_valley():
    """Rosenbrock's, whose floor is y = 2 + (x - 5)^2/2: quadratic convergence at its end, downhill all the way."""
    valley = plain("valley", lambda x, y: 10.0 * (y - 2.0 - (x - 5.0) ** 2 / 2.0) ** 2 + (x - 4.0) ** 2 + 1.0)
    problem = problem_of(DesignSpace(SCENE, FREE), valley, [], starts=4)
    ended = polish(problem, at(problem, (8.0, 7.0), (2.0, 8.0), (6.0, 3.0), (5.0, 2.0)), 16, lambda *_: None)
    np.testing.assert_allclose(xy(ended.point), [[4.0, 2.5]] * 4, atol=1e-7)
    assert np.all(np.diff(ended.history[..., 0], axis=0) <= 0.0) and np.all(ended.remaining_decrease < 1e-13)


def test_constraint_with_a_large_multiplier_is_met(held):
    """A slope of 1e4 objectives against a demand: its price rises until the demand is kept."""
    steep = plain("steep", lambda x, y: 1.0 - 1e4 * (x - 4.0) + (y - 3.0) ** 2)
    problem = problem_of(DesignSpace(SCENE, FREE), steep, [FIRST < 4.0], starts=2)
    ended = polish(problem, at(problem, (4.0, 5.0), (3.9999, 2.0)), 12, lambda *_: None)
    np.testing.assert_allclose(xy(ended.point), [[4.0, 3.0]] * 2, atol=1e-5)
    np.testing.assert_allclose(ended.optimality.demands, 4e4, rtol=1e-8)  # of the relative excess, x/4 - 1
    assert np.all(ended.remaining_decrease < 1e-6)


def test_scale_of_a_zero_objective_follows_from_its_slope():
    nothing = plain("nothing", lambda x, y: (x - 6.0) ** 2 + (y - 5.0) ** 2 - 1.0)
    problem = problem_of(DesignSpace(SCENE, FREE), nothing, [], starts=2)
    start = at(problem, (7.0, 5.0))
    assert abs(start.values[0, 0]) < 1e-14
    ended = polish(problem, start, 6, lambda *_: None)
    np.testing.assert_allclose(xy(ended.point), [[6.0, 5.0]], atol=1e-7)


def test_step_with_decrease_below_rounding_is_accepted():
    """x^2 + y^2 along x + y = 7 at some 1e-8 from its least value: the fall is 1e-17 of it, the slope still shows the way."""
    squares = plain("squares", lambda x, y: x**2 + y**2)
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(SUM, 7.0)]), squares, [], starts=16)
    start = at(problem, *((3.5 + off, 3.5 - off) for off in 1e-9 * np.arange(3.0, 35.0, 2.0)))
    ended = polish(problem, start, 4, lambda *_: None)
    np.testing.assert_allclose(xy(ended.point), 3.5, rtol=1e-13)
    assert np.all(ended.violation < 1e-14)


def test_step_to_a_feasible_design_is_accepted(held, monkeypatch):
    """The objective rises from 2 to 10, and the penalty is too small for the violation to count."""
    here, feasible = at(held, (6.0, 5.0)), at(held, (4.0, 3.0))
    one, none = np.ones(1), np.zeros((1, 1))
    model = Step(np.full((1, 2), -0.25), none, none, np.ones((1, 1)))
    for start, trial, accepted in ((here, feasible, True), (feasible, here, False)):
        searches = _Searches(start, one, 1e-6 * one, 0.3 * one, np.zeros((1, 2)), none, none, one > 0.0, one > 0.0, one)
        if not accepted:
            searches.penalty = 1e3 * one
        monkeypatch.setattr(polishing, "_trial_point", lambda *_, trial=trial: trial)
        _move(held, searches, np.array([0]), start, [model], one < 0.0)
        np.testing.assert_allclose(xy(searches.point), [[4.0, 3.0]])
        assert searches.changed.tolist() == [accepted]


def test_trust_radius_doubles_after_full_steps():
    """Steps from x = 1.4 to 8.6, 0.9 of the range: 0.2, 0.4 and the rest; of steps of 0.2 it would be five."""
    bowl = plain("bowl", lambda x, y: (x - 8.6) ** 2 + (y - 5.0) ** 2 + 1.0)
    problem = problem_of(DesignSpace(SCENE, FREE), bowl, [], starts=2)
    ended = polish(problem, at(problem, (1.4, 5.0), (1.4, 5.0)), 3, lambda *_: None)
    np.testing.assert_allclose(ended.history[1:3, 0, 0], [1.0 + (8.0 * 0.7) ** 2, 1.0 + (8.0 * 0.3) ** 2], rtol=1e-6)
    np.testing.assert_allclose(xy(ended.point), [[8.6, 5.0]] * 2, atol=1e-7)
