"""Cases and tolerances against their definitions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene
from scipy.stats import norm

import jaxvib as jv
from optimize import DesignSpace, Quantity, amplitude, expected, jam_frequency, largest, quantile, total, under, worst
from optimize.quantities.evaluation import Evaluation
from optimize.search.problem import evaluate, find_speeds, problem_of

SCENE = scene("two_mass")
FIRST = Quantity("first", "N/m", lambda s: s.machine.stiffness[0])
BOTH = Quantity("both", "N^2/m^2", lambda s: s.machine.stiffness[0] * s.machine.link_stiffness[0])
OFF = {"machine.stiffness": 0.1, "machine.link_stiffness": 0.9}


def test_samples_fill_a_normal_distribution_evenly():
    """The k-th smallest of n samples has the share (k + 1/2)/n below it, two deviations at the tolerance, three at most."""
    case = expected(FIRST, OFF, samples=400, seed=3).case
    (place, first), (_, link) = case.factors(SCENE)
    assert place.name == "machine.stiffness" and first.shape == (400, 2) and link.shape == (400, 1)
    deviations = np.clip(norm.ppf((np.arange(400) + 0.5) / 400), -3.0, 3.0)
    for column, error in ((first[:, 0], 0.1), (first[:, 1], 0.1), (link[:, 0], 0.9)):
        np.testing.assert_allclose(np.sort(column), np.maximum(1.0 + error / 2.0 * deviations, 0.05), rtol=1e-12)
    assert abs(np.corrcoef(first.T)[0, 1]) < 0.2  # in an order of their own
    made = case.scenes(SCENE)
    np.testing.assert_allclose(made.machine.stiffness, first * np.asarray(SCENE.machine.stiffness), rtol=1e-14)
    np.testing.assert_allclose(made.machine.link_stiffness, link * 2e5, rtol=1e-14)
    np.testing.assert_array_equal(made.machine.mass[7], SCENE.machine.mass)
    assert np.min(expected(FIRST, {"machine.stiffness": 0.9}, samples=2).case.factors(SCENE)[0][1]) > 0.05


def test_statistics_are_those_of_the_samples():
    values = np.array(
        [float(BOTH(jax.tree.map(lambda a, k=k: a[k], expected(BOTH, OFF, samples=9).case.scenes(SCENE)))) for k in range(9)]
    )
    for quantity, awaited in (
        (expected(BOTH, OFF, samples=9), values.mean()),
        (worst(BOTH, OFF, samples=9), values.max()),
        (quantile(BOTH, 0.3, OFF, samples=9), np.quantile(values, 0.3)),
    ):
        np.testing.assert_allclose(quantity(SCENE), awaited, rtol=1e-12)
        np.testing.assert_allclose(quantity.pieces(Evaluation(SCENE), -1.0), [-awaited], rtol=1e-12)
        one = quantity.pieces(Evaluation(SCENE))
        np.testing.assert_allclose(one, values if quantity.statistic == "worst" else [awaited], rtol=1e-12)
    of_two = worst(largest(FIRST, 1.01 * FIRST), {"machine.stiffness": 0.1}, samples=3)
    assert of_two.pieces(Evaluation(SCENE)).shape == (6,) and of_two.simplified == largest(FIRST, 1.01 * FIRST)


def test_a_case_is_a_quantity_of_another_scene():
    heavy = under(FIRST, "stiff", {"machine.stiffness": "70 N/mm"})
    assert heavy.words == "first (stiff)" and float(heavy(SCENE)) == 7e4
    pieces = under(largest(FIRST, BOTH / "1 N/m"), "stiff", {"machine.stiffness[0]": 7e4}).pieces(Evaluation(SCENE))
    np.testing.assert_allclose(pieces, [7e4, 7e4 * 2e5])
    timed = under(jam_frequency(mode=3, tier="exact"), "x", {"drive.speed": 130.0})
    assert timed.simplified.parts == (jam_frequency(mode=3),) and timed.simplified.case == timed.case
    assert timed.simplified.at_tier("exact") == timed


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: under(FIRST, "x", [("drive.speed", 3.0)]), "must be a dictionary, for example"),
        (lambda: worst(FIRST, {}), "must be a dictionary such as"),
        (lambda: worst(FIRST, [0.1]), "must be a dictionary, for example"),
        (lambda: worst(FIRST, {"machine.stiffness": True}), "stiffness is True; it must be a number"),
        (lambda: worst(FIRST, {"machine.stiffness": "5 %"}), "must be a number"),
        (lambda: worst(FIRST, {"machine.stiffness": 0.0}), "must be between 0 and 1"),
        (lambda: worst(FIRST, {"machine.stiffness": 0.05}, samples=1), "samples is 1"),
        (lambda: quantile(FIRST, True, {"machine.stiffness": 0.05}), "level is True; it must be a number"),
        (lambda: quantile(FIRST, "half", {"machine.stiffness": 0.05}), "must be a number"),
        (lambda: quantile(FIRST, 0.0, {"machine.stiffness": 0.05}), "less than 1"),
    ],
)
def test_wrong_cases_raise_clear_errors(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()


def test_jams_are_followed_in_every_case():
    """A jam of the scene and those of the samples of a case: the same from known speeds as from whole branches."""
    frequency = jam_frequency(mode=3)
    spread = under(expected(frequency, {"machine.stiffness": 0.1}, samples=2), "heavy", {"machine.mass[0]": 150.0})
    space = DesignSpace(SCENE, {"machine.stiffness": (3e4, 9e4)})
    problem = problem_of(space, frequency, [spread < 200.0], 1)
    assert sorted(len(path) for path, _ in problem.keys) == [0, 2]
    z = np.array([[0.5, 0.3]])
    point = evaluate(problem, z, find_speeds(problem, z))

    def of(s):
        return float(jv.jam_modes(s).select(3).omega)

    here = space.at(jnp.asarray(z[0]))
    there = eqx.tree_at(lambda s: s.machine.mass, here, jnp.array([150.0, 95.0]))
    samples = spread.parts[0].case.scenes(there)
    mean = np.mean([of(jax.tree.map(lambda a, k=k: a[k], samples)) for k in range(2)])
    np.testing.assert_allclose(point.values[0], [of(here), mean / 200.0 - 1.0], rtol=1e-9)


def test_cases_add_no_springs():
    """The name of an array changes what the machine has; an entry is changed by its own name."""
    chain = scene("network")
    budget = Quantity("k", "N/m", lambda s: s.machine.stiffness @ jnp.array([1.0, 10.0, 100.0, 1e3, 1e4]))
    assert float(under(budget, "x", {"machine.stiffness": 2.0})(chain)) == 2.0 * 11001.0
    assert float(under(budget, "x", {"machine.stiffness": 2.0, "machine.stiffness[1]": 3.0})(chain)) == 2.0 * 11001.0 + 30.0
    assert float(under(Quantity("d", "", lambda s: s.loads.drag), "x", {"loads.drag": 7.0})(chain)) == 7.0


@pytest.mark.parametrize(
    "change", [lambda q: worst(q, {"machine.mass": 0.1}), lambda q: under(q, "loaded", {"machine.mass": 70.0})]
)
def test_statistics_have_the_mode_of_their_quantity(change):
    """The search verifies its best machine in this mode."""
    assert change(amplitude(mode=1)).mode == (-change(-amplitude(mode=1))).mode == 1
    assert change(total("machine.stiffness")).mode is None
