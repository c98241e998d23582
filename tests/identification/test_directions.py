"""Information about the numbers of a fit, against inverses of matrices and closed forms."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.identification.directions import (
    Information,
    combined_information,
    covariance_of,
    directions_of,
    eliminate,
    elimination,
    free_unbalances,
    in_polar_unbalances,
    information_of,
)
from jaxvib.identification.problem import Known
from jaxvib.identification.response import Unknowns


def positive(size, seed=0):
    slopes = np.random.default_rng(seed).normal(size=(3 * size, size)) * 10.0 ** np.linspace(-2.0, 2.0, size)
    return slopes.T @ slopes


def test_elimination_is_the_schur_complement():
    matrix, own, free = positive(6), np.array([4, 1]), np.array([0, 2, 3])
    matrix[5] = matrix[:, 5] = 0.0  # an unknown without influence
    inner, coupling = matrix[np.ix_(free, free)], matrix[np.ix_(free, own)]
    np.testing.assert_allclose(
        eliminate(matrix, own), matrix[np.ix_(own, own)] - coupling.T @ np.linalg.inv(inner) @ coupling, rtol=1e-10
    )
    found = elimination(matrix, own)
    np.testing.assert_array_equal(found[own], np.eye(2))
    np.testing.assert_allclose(found[free], -np.linalg.inv(inner) @ coupling, rtol=1e-8)
    assert not np.any(found[5])
    np.testing.assert_array_equal(eliminate(matrix, np.arange(6)), matrix)


def test_free_unknowns_may_be_dependent():
    slopes = np.random.default_rng(1).normal(size=(20, 4))
    slopes[:, 3] = 2.0 * slopes[:, 2]
    found = eliminate(slopes.T @ slopes, np.array([0]))
    alone = slopes[:, :3].T @ slopes[:, :3]
    np.testing.assert_allclose(found, 1.0 / np.linalg.inv(alone)[:1, :1], rtol=1e-10)


def test_covariance_leaves_out_undetermined_directions():
    axes = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]).T
    found = covariance_of((axes * np.array([4.0, 0.25, 100.0])) @ axes.T)
    np.testing.assert_allclose(
        found.covariance, 0.25 * np.outer(axes[:, 0], axes[:, 0]) + 0.01 * np.diag([0, 0, 1]), atol=1e-12
    )
    np.testing.assert_allclose(np.abs(found.undetermined[:, 0]), np.abs(axes[:, 1]), atol=1e-12)
    np.testing.assert_allclose(found.errors, [2.0])
    assert found.determined.tolist() == [False, False, True]
    # An eigenvalue counts as at least the rounding error of the largest one.
    np.testing.assert_allclose(covariance_of(np.diag([0.0, 1e12])).errors, [10.0])
    assert covariance_of(np.zeros((0, 0))).errors.size == 0


def fit_like(matrix, prior, unbalances, gains=(), turns=0, marked=True):
    """Return a fit of a stiffness of 200 exp(x) N/m and a place of 3 + 0.5 x m."""
    unknowns = Unknowns(
        (SimpleNamespace(name="machine.stiffness"), SimpleNamespace(name="place")),
        jnp.array([200.0, 3.0]), jnp.array([200.0, 0.5]), jnp.array([True, False]), gains, turns,
    )  # fmt: skip
    x = np.concatenate([[0.1, -0.2], np.zeros(unknowns.count - 2)])
    linear = np.array([3.0, 4.0, -0.05, 0.12, 6.0, 8.0, 0.7])[: 2 * len(unbalances) + 1]
    problem = SimpleNamespace(unknowns=unknowns, unbalances=unbalances, marked=marked)
    return SimpleNamespace(problem=problem, x=x, linear=linear, information=matrix, prior=prior)


UNBALANCES = None, Known(0.13, 1e-5), Known(10.0, 0.5)
"""A free one, an exact one, and one with an error."""


def test_information_is_that_of_the_numbers_and_free_unbalances():
    matrix, prior = positive(11), np.diag(np.linspace(1.0, 2.0, 11))
    fit = fit_like(matrix, prior, UNBALANCES, ("frame",), turns=1)
    assert free_unbalances(fit.problem) == [0, 2]
    turn = np.eye(11)
    for k, (a, b) in enumerate(((3.0, 4.0), (-0.05, 0.12), (6.0, 8.0))):
        turn[4 + 2 * k : 6 + 2 * k, 4 + 2 * k : 6 + 2 * k] = [[a, -b], [b, a]]
    data, known, sizes = in_polar_unbalances(fit)
    np.testing.assert_allclose(data, turn.T @ matrix @ turn, rtol=1e-12)
    np.testing.assert_allclose(known, turn.T @ prior @ turn, rtol=1e-12)
    np.testing.assert_allclose(sizes, [5.0, 0.13, 10.0])
    found, own = information_of(fit), [0, 1, 4, 8]
    inverse = np.linalg.inv(data + known)
    np.testing.assert_allclose(found.covariance, inverse[np.ix_(own, own)], rtol=1e-6)
    assert found.names == ("machine.stiffness", "place", "exciters[0].unbalance", "exciters[2].unbalance")
    values = [200.0 * np.exp(0.1), 2.9, 5.0, 10.0]
    np.testing.assert_allclose(found.values, values)
    np.testing.assert_allclose(found.scale, [values[0], 0.5, 5.0, 10.0])
    assert found.logarithmic.tolist() == [True, False, True, True] and found.by_gain.shape == (4, 0)
    with_gain = [*own, 2]
    for is_marked, places in ((True, [*with_gain, 5]), (False, with_gain)):
        fit.problem.marked = is_marked
        whole = combined_information(fit)
        np.testing.assert_allclose(
            whole[: len(places), : len(places)], np.linalg.inv(inverse[np.ix_(places, places)]), rtol=1e-6
        )
        assert whole.shape == (6, 6) and (is_marked or (not np.any(whole[5]) and not np.any(whole[:, 5])))


def test_directions_that_only_the_gains_determine():
    """The readings determine x - y, and x + y + 2 g of two numbers and the gain g, which is known to 1 %."""
    slopes = 100.0 * np.array([[1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    fit = fit_like(slopes.T @ slopes, np.diag([0.0, 0.0, 1e4, 0.0]), (), ("frame",))
    found = information_of(fit)
    np.testing.assert_allclose(np.abs(found.by_gain[:, 0]), np.sqrt(0.5))
    assert found.by_gain[0, 0] * found.by_gain[1, 0] > 0.0
    error = np.sqrt(0.5 * (0.02**2 + 0.01**2))
    np.testing.assert_allclose(found.by_gain_errors, [error])
    np.testing.assert_allclose(
        found.covariance, 0.5 * error**2 + 0.5 * 0.5e-4 * np.array([[1.0, -1.0], [-1.0, 1.0]]), rtol=1e-9
    )
    assert found.undetermined.size == 0 and np.all(found.determined)
    (sentence,) = (each.sentence for each in directions_of(found)[1])
    assert sentence.startswith(
        "a change of machine.stiffness by +0.71, place by +0.71 (relative to one another) is known from the"
    )
    assert "gains of the sensors only, to 1.6 %, and an error of a gain leaves no trace in the residuals; calibrate" in sentence
    fit.prior = np.zeros((4, 4))
    unknown = information_of(fit)  # nothing determines the sum now
    assert unknown.by_gain.shape == (2, 0) and unknown.undetermined.shape == (2, 1)


@pytest.mark.parametrize(("error", "vanished"), [(0.9, False), (20.0, True), (2e3, False)])
def test_number_smaller_than_its_error_is_vanished(error, vanished):
    """The stiffness is less than its error; the other number, of either sign, has an undetermined direction of its own."""
    matrix = np.zeros((5, 5))
    matrix[:2, :2] = np.diag([error**-2, 1e-4])
    matrix[4, 4] = 1.0
    found = information_of(fit_like(matrix, np.zeros((5, 5)), (Known(5.0, 1e-9),)))
    assert found.vanished.tolist() == [vanished, False]
    assert found.determined.tolist() == [error < 1e3, False]
    if error < 1e3:
        np.testing.assert_allclose(found.covariance, np.diag([error**2, 0.0]), atol=1e-12)


def information(names, axes, errors):
    size, none = len(names), np.zeros(0)
    empty = np.zeros((size, 0))
    ones = np.ones(size)
    return Information(names, ones, ones, ones, np.eye(size), axes, np.array(errors), ones, ones < 0.0, empty, none)


def test_common_factor_is_one_sentence():
    """The factor of all numbers, with another direction that is at right angles to it."""
    names = ("machine.mass[0]", "machine.mass[1]", "machine.damping", "place")
    common, other = np.array([1.0, 1.0, 1.0, 0.0]) / np.sqrt(3.0), np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2.0)
    mixed = np.stack([0.6 * common + 0.8 * other, -0.8 * common + 0.6 * other], axis=1)
    lost, gains = directions_of(information(names, mixed, [3.0, 5.0]))
    assert gains == () and [each.names for each in lost] == [names, names]
    np.testing.assert_allclose(lost[0].weights, common, atol=1e-12)
    np.testing.assert_allclose(lost[0].error, np.hypot(0.6 * 3.0, 0.8 * 5.0))
    np.testing.assert_allclose(lost[1].weights, other, atol=1e-12)
    np.testing.assert_allclose(lost[1].error, np.hypot(0.8 * 3.0, 0.6 * 5.0))
    assert lost[0].sentence == (
        "multiplying all masses and dampings by one number changes no reading by more than its noise: "
        "give one of these parameters as known, or record a run with a known mass added"
    )
    assert lost[1].sentence == (
        "changing machine.mass[0] by +0.71, machine.mass[1] by -0.71 (relative to one another) changes no reading by more than "
        "its noise: give one of these parameters as known, add a sensor at another place, or record a run through "
        "all resonances"
    )


@pytest.mark.parametrize(
    ("names", "axis", "words"),
    [
        (("machine.stiffness", "place"), [0.9, 0.436], "changing machine.stiffness by +0.9, place by +0.44 ("),
        (("machine.stiffness", "place"), [0.99, 0.141], "changing machine.stiffness changes no reading"),
        (("place", "machine.stiffness"), [0.141, -0.99], "changing machine.stiffness changes no reading"),
        (("angle", "place"), [0.3, -0.954], "changing place by +0.95, angle by -0.3 ("),
        (("angle", "place"), [0.141, -0.99], "changing place changes no reading"),
    ],
)
def test_direction_in_words(names, axis, words):
    """A direction along one parameter names this parameter alone."""
    lost, _ = directions_of(information(names, np.array([axis]).T / np.linalg.norm(axis), [2.0]))
    assert lost[0].sentence.startswith(words) and lost[0].error == pytest.approx(2.0, rel=0.02)


def gain_sentence(*names):
    """Return the sentence about the common factor of the parameters, which only the gains determine, to 0.7 %."""
    size = len(names)
    axis = np.ones((size, 1)) / np.sqrt(size)
    found = information(names, np.zeros((size, 0)), [])._replace(by_gain=axis, by_gain_errors=np.array([0.007]))
    return directions_of(found)[1][0].sentence


def test_added_mass_is_no_remedy_for_unbalances_alone():
    """The readings remain the same if the unbalance is larger and the gain smaller, whatever mass is added."""
    assert gain_sentence("exciters[0].unbalance") == (
        "exciters[0].unbalance is known from the gains of the sensors only, to 0.7 %, and an error of a gain leaves no trace "
        "in the residuals; calibrate the sensors, or give it as known"
    )
    two = gain_sentence("exciters[0].unbalance", "exciters[1].unbalance")
    assert two.startswith("the common factor of all unbalances is known") and "added" not in two
    with_mass = gain_sentence("machine.mass", "exciters[0].unbalance")
    assert with_mass.startswith("the common factor of all masses and unbalances is known")
    assert with_mass.endswith("or record a run with a known mass added")
