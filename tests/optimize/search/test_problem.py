"""A search as numbers: values, derivatives by either route, scales, what comes first, points and what is followed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene
from two_springs import FREE, NEAREST, SCENE, plain, point_of

import jaxvib as jv
from jaxvib.steady.jams.jam import jam_modes
from optimize import DesignSpace, Quantity, amplitude, expected, foundation_force, hold, jam_frequency, largest, total
from optimize.quantities.quantity import BuiltinQuantity
from optimize.search.evolve import PopulationValues
from optimize.search.problem import (
    Point,
    derive,
    evaluate,
    evaluate_quantities,
    find_speeds,
    find_targets,
    problem_of,
    scenes_of,
)

SUM, FIRST = plain("sum", lambda x, y: x + y), plain("first", lambda x, y: x)


def scene_of(batch, k):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[k]), batch)


def test_values_are_objective_held_quantities_and_demands():
    """Objective 5 - x y; x + y = 7; x at most 4, in parts of 4; y at most x, in parts of the larger at the beginning, 5."""
    space = DesignSpace(SCENE, FREE, [hold(SUM, 7.0)])
    problem = problem_of(space, plain("o", lambda x, y: 5.0 - x * y), [FIRST < 4.0, plain("y", lambda x, y: y) < FIRST], 2)
    assert problem.equalities == 1 and problem.batch_size == 2 and problem.keys == ()
    np.testing.assert_allclose(problem.scales, [4.0, 5.0])
    point = evaluate(problem, np.array([[0.25, 0.5], [0.75, 0.125]]), ())  # (3, 5) and (7, 2)
    np.testing.assert_allclose(
        point.values, [[-10.0, 8.0 / 7.0 - 1.0, -0.25, 0.4], [-9.0, 9.0 / 7.0 - 1.0, 0.75, -1.0]], atol=1e-12
    )
    slopes = [[[-y, -x], [1 / 7, 1 / 7], [0.25, 0.0], [-0.2, 0.2]] for x, y in ((3.0, 5.0), (7.0, 2.0))]
    np.testing.assert_allclose(point.slopes, 8.0 * np.array(slopes), atol=1e-12)
    assert point.pieces.shape == (2, 0) and point.piece_gradients.shape == (2, 0, 2)
    with pytest.raises(ValueError, match="no designs"):
        evaluate(problem, np.zeros((0, 2)), ())


def test_pieces_follow_the_values():
    problem = problem_of(DesignSpace(SCENE, FREE), largest(FIRST, 2.0 * SUM - 9.0), [FIRST < 4.0], 1)
    point = evaluate(problem, np.array([[0.25, 0.5]]), ())
    np.testing.assert_allclose(point.values, [[7.0, -0.25]])
    np.testing.assert_allclose(point.pieces, [[3.0, 7.0]])
    np.testing.assert_allclose(point.piece_gradients, 8.0 * np.array([[[1.0, 0.0], [2.0, 2.0]]]))


def test_scale_of_a_demand_is_its_limit_or_first_value():
    """Limits of 0 have none; x - 5 is 0 at the beginning, up to rounding, and counts as it is; a small value is no rounding."""
    off, rounded = plain("off", lambda x, y: x - 5.0), plain("rounded", lambda x, y: x - 5.0 + 3e-16)
    small = plain("small", lambda x, y: x - 5.0 + 1e-8)
    nowhere = plain("nowhere", lambda x, y: x * jnp.nan)
    demands = [FIRST < -4.0, SUM < 0.0, off < 0.0, rounded < 0.0, small < 0.0, nowhere < 0.0, off < -2.0 * SUM]
    problem = problem_of(DesignSpace(SCENE, FREE), NEAREST, demands)
    np.testing.assert_allclose(problem.scales, [4.0, 8.0, 1.0, 1.0, 1e-8, 1.0, 16.0], rtol=1e-6)
    np.testing.assert_array_equal(problem.constants, [-4.0, *[0.0] * 6])


@pytest.mark.parametrize(("starts", "lanes"), [(1, 1), (2, 2), (3, 4), (33, 64), (1000, 64)])
def test_batch_size_is_a_power_of_two(starts, lanes):
    assert problem_of(DesignSpace(SCENE, FREE), NEAREST, [], starts).batch_size == lanes


def test_all_derivative_modes_agree_with_derivatives_by_hand():
    """Reverse mode for one number that depends on six; forward mode for as many numbers as values."""
    machine = scene("three_mass")
    free = {"machine.stiffness": (1e3, 9e4), "machine.link_stiffness": (1e3, 9e4)}
    weights = jnp.arange(1.0, 7.0) * 1e-8

    def springs(s):
        return jnp.concatenate([s.machine.stiffness, s.machine.link_stiffness])

    wish = Quantity("squares", "", lambda s: jnp.sum(weights * springs(s) ** 2))
    for hold_ in ([], [hold(total("machine.stiffness"))]):
        space = DesignSpace(machine, free, hold_)
        problem = problem_of(space, wish, [], 1)
        z = jnp.linspace(0.2, 0.7, 6)
        values, slopes, found, speed_slopes = derive(problem, z, ())
        k = springs(space.at(z))
        np.testing.assert_allclose(values[0], jnp.sum(weights * k**2), rtol=1e-12)
        np.testing.assert_allclose(slopes[0], 2.0 * weights * k**2 * np.log(90.0), rtol=1e-10)  # k = low 90^z
        assert found == speed_slopes == ()


def test_followed_speeds_and_their_derivatives():
    """The speed of a jam and its derivative by each number: central differences with steps of 1e-5, rounding 1e-10."""
    problem = problem_of(DesignSpace(SCENE, FREE), jam_frequency(mode=3), [], 4)
    assert [asked for _, asked in problem.keys] == [("jam", 3)]
    z = np.array([[0.4, 0.3], [0.5, 0.6]])
    near = find_speeds(problem, z)
    omega = [float(jam_modes(problem.space.at(jnp.asarray(each))).select(3).omega) for each in z]
    np.testing.assert_allclose(near[0], omega, rtol=1e-10)
    point = evaluate(problem, z, near)
    np.testing.assert_allclose(point.speeds[0], omega, rtol=1e-10)
    np.testing.assert_allclose(point.values[:, 0], omega, rtol=1e-10)
    np.testing.assert_allclose(point.speed_slopes[0], point.slopes[:, 0], rtol=1e-10)
    moved = [evaluate(problem, z + step * np.array([0.0, 1.0]), near).values[:, 0] for step in (1e-5, -1e-5)]
    np.testing.assert_allclose(point.speed_slopes[0][:, 1], (moved[0] - moved[1]) / 2e-5, rtol=1e-5)
    ahead = point.extrapolate_speeds(z + 1e-3)
    np.testing.assert_allclose(ahead[0], omega + 1e-3 * point.slopes[:, 0].sum(axis=1), rtol=1e-12)


def test_extrapolation_beyond_a_fifth_is_rejected():
    z = np.zeros((4, 2))
    known = np.array([10.0, 10.0, 10.0, np.nan])
    speed_slopes = np.array([[1.0, 0.5], [30.0, 0.0], [-30.0, np.inf], [1.0, 1.0]])
    point = Point(
        z,
        z,
        z,
        (known, np.stack([known, 2.0 * known], axis=1)),
        (speed_slopes, np.stack([speed_slopes, -speed_slopes], axis=1)),
        z,
        z,
    )
    one, two = point.extrapolate_speeds(np.full((4, 2), 0.1))
    np.testing.assert_allclose(one, [10.15, 10.0, 10.0, np.nan])
    np.testing.assert_allclose(two, [[10.15, 19.85], [10.0, 17.0], [10.0, 20.0], [np.nan, np.nan]])


def test_a_fold_that_does_not_exist_stays_infinite():
    z = np.zeros((2, 2))
    point = Point(z, z, z, (np.array([np.inf, -np.inf]),), (np.zeros((2, 2)),), z, z)
    np.testing.assert_array_equal(point.extrapolate_speeds(z + 0.1)[0], [np.inf, -np.inf])


def test_points_are_combined_by_design():
    values, slopes = np.arange(6.0).reshape(3, 2), np.arange(12.0).reshape(3, 2, 2)
    point = point_of(np.zeros((3, 2)), values.copy(), slopes.copy())
    other = point_of(np.ones((3, 2)), -values, -slopes)
    mixed = point.where(np.array([True, False, True]), other)
    np.testing.assert_array_equal(mixed.z[:, 0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(mixed.slopes[:, 1, 1], [3.0, -7.0, 11.0])
    np.testing.assert_array_equal(point.take(np.array([2, 0])).values, values[[2, 0]])
    put = point.put(np.array([1]), other.take(np.array([2])))
    np.testing.assert_array_equal(put.values, [[0.0, 1.0], [-4.0, -5.0], [4.0, 5.0]])
    np.testing.assert_array_equal(point.values, values)
    point.values[0, 1], point.slopes[2, 0, 1] = np.nan, np.inf
    np.testing.assert_array_equal(point.exists(), [False, True, False])


def asking(name, tier, tiers):
    return BuiltinQuantity(
        name, "", lambda evaluation, tier: jnp.sum(evaluation.scene.machine.stiffness) / 1e4, tier=tier, tiers=tiers
    )


EXACT = asking("exact", "exact", ("leading", "exact"))
LEADING = EXACT.at_tier("leading")
TIMED = asking("timed", "time", ("time",))


def test_first_search_uses_leading_order_and_no_tolerances():
    force, off = foundation_force(mode=3), {"machine.stiffness": 0.05}
    demands = [TIMED < 3.0, EXACT < 5.0, FIRST < 4.0]
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(EXACT, 7.0)]), expected(force, off, samples=4), demands, 8)
    first = problem.simplified()
    assert first.objective == force and first.batch_size == problem.batch_size == 8
    assert [(held.quantity, float(held.value)) for held in first.space.held] == [(LEADING, 7.0)]
    assert [d.quantity for d in first.demands] == [LEADING, FIRST]  # what is had in time alone is left out
    np.testing.assert_array_equal(first.constants, [5.0, 4.0])
    np.testing.assert_array_equal(first.scales, [5.0, 4.0])
    assert len(problem.keys) == len(first.keys) == 1 and first.simplified() is None
    assert problem.forward_only and not first.forward_only
    tolerant = problem_of(DesignSpace(SCENE, FREE), largest(FIRST, 2.0 * expected(FIRST, off, samples=4)), [])
    assert tolerant.parts == tolerant.simplified().parts == 2


@pytest.mark.parametrize(
    ("objective", "held", "demands", "first"),
    [
        (SUM, [], [FIRST < 4.0], False),  # this is it
        (EXACT, [], [], True),
        (SUM, [], [EXACT < 5.0], True),
        (SUM, [], [FIRST < EXACT], True),
        (SUM, [EXACT], [], True),
        (TIMED, [], [EXACT < 5.0], False),  # nothing else in its place
        (EXACT, [TIMED], [], False),
    ],
)
def test_expensive_searches_begin_with_a_simplified_one(objective, held, demands, first):
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(each, 3.0) for each in held]), objective, demands)
    assert (problem.simplified() is not None) == first
    assert problem.forward_only == (objective is TIMED or TIMED in held)
    assert problem.designs_per_call == (1 if problem.forward_only else problem.batch_size)


@pytest.mark.parametrize("tier", ["time", "leading"])
def test_runs_are_never_computed_in_a_batch(tier):
    """A run in a batch would take the steps of the slowest one, also when it is a sample of a tolerance."""
    batches = []

    @jax.custom_batching.custom_vmap
    def first(x):
        return x[0]

    @first.def_vmap
    def _(size, _, x):
        batches.append(size)
        return x[:, 0], True

    one = BuiltinQuantity(
        "one", "", lambda evaluation, tier: first(evaluation.scene.machine.stiffness), tier=tier, tiers=(tier,)
    )
    z = np.array([[0.25, 0.5], [0.75, 0.125], [0.5, 0.5]])
    problem = problem_of(DesignSpace(SCENE, FREE), SUM, [], 4)
    values = evaluate_quantities(
        [one, expected(one, {"machine.stiffness": 1e-6}, samples=4)], scenes_of(problem, 1e4 + 8e4 * z)
    )
    np.testing.assert_allclose(values, np.repeat(1e4 + 8e4 * z[:, :1], 2, axis=1), rtol=1e-5)
    evolved = PopulationValues(problem_of(DesignSpace(SCENE, FREE), one, [], 4)).of(z)
    np.testing.assert_allclose(evolved, values[:, :1], rtol=1e-5)
    assert bool(batches) == (tier == "leading")


def test_evaluated_quantities_are_those_of_each_scene():
    batch = scenes_of(problem_of(DesignSpace(SCENE, FREE), NEAREST, [], 4), np.array([[3e4, 4e4], [5e4, 6e4], [7e4, 8e4]]))
    np.testing.assert_array_equal(batch.machine.stiffness, [[3e4, 4e4], [5e4, 6e4], [7e4, 8e4]])
    frequency = jam_frequency(mode=3)
    told = evaluate_quantities([SUM, frequency], batch)
    np.testing.assert_allclose(told[:, 0], [7.0, 11.0, 15.0])
    each = [jam_modes(scene_of(batch, k)).select(3).omega for k in range(3)]
    np.testing.assert_allclose(told[:, 1], each, rtol=1e-10)
    searched = problem_of(DesignSpace(SCENE, FREE), foundation_force(mode=3) / "1 N", [amplitude(mode=4) > "1 mm"], 4)
    np.testing.assert_allclose(evaluate_quantities([SUM, frequency], batch, searched), told, rtol=1e-12)
    other = problem_of(DesignSpace(SCENE, FREE), NEAREST, [], 4)
    np.testing.assert_allclose(evaluate_quantities([SUM, frequency], batch, other), told, rtol=1e-12)
    assert evaluate_quantities([], batch).shape == (3, 0)
    assert find_targets([SUM, frequency, foundation_force(mode=3)], SCENE)[0] == (((), ("jam", 3)),)


def test_change_of_a_captured_value_changes_a_search():
    def value():
        problem = problem_of(DesignSpace(SCENE, FREE), cost, [cost < 1.0], 1)
        point = evaluate(problem, np.array([[0.25, 0.5]]), ())
        return [*point.values[0], *evaluate_quantities([cost], scenes_of(problem, np.array([[3e4, 5e4]])))[0]]

    price = [1.0]
    cost = Quantity("cost", "", lambda s: price[0] * s.machine.stiffness[0] / 1e4)
    np.testing.assert_allclose(value(), [3.0, 2.0, 3.0])
    price[0] = 2.0
    np.testing.assert_allclose(value(), [6.0, 5.0, 6.0])


def test_modes_of_cases_are_looked_up_in_their_scenes():
    wish = expected(jam_frequency(mode=3), {"machine.stiffness": 0.05}, samples=4)
    problem = problem_of(DesignSpace(SCENE, FREE), wish, [jam_frequency(mode=3) < "120 rad/s"], 1)
    z = np.array([[0.5, 0.25]])
    found = dict(zip((len(path) for path, _ in problem.keys), find_speeds(problem, z), strict=True))
    at = problem.space.at(jnp.asarray(z[0]))
    np.testing.assert_allclose(found[0], [float(jv.jam_modes(at).select(3).omega)], rtol=1e-10)
    several = wish.case.scenes(at)
    each = [jam_modes(scene_of(several, k)).select(3).omega for k in range(4)]
    np.testing.assert_allclose(found[1], [each], rtol=1e-10)
