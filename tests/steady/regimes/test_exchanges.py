"""Exchanges of equal exciters: which masses count as equal."""

import numpy as np

from jaxvib.steady.regimes.symmetry import exchanges_of


def test_masses_that_differ_by_rounding_are_exchanged():
    influence = np.full((2, 3, 3), 0.1 + 0.02j) + np.diag([1.0, 1.0, 1.0])
    numbers = np.array([[0.4, 25.0], [0.4 * (1.0 + 4e-16), 25.0], [1e-9, 30.0]])
    orders = {tuple(map(int, each.permutation)) for each in exchanges_of(influence, numbers)}
    assert orders == {(0, 1, 2), (1, 0, 2)}


def test_masses_that_differ_by_more_than_rounding_stay():
    influence = np.full((2, 2, 2), 0.1 + 0.02j) + np.eye(2)
    numbers = np.array([[0.4, 25.0], [0.4 * (1.0 + 1e-9), 25.0]])
    assert [tuple(map(int, each.permutation)) for each in exchanges_of(influence, numbers)] == [(0, 1)]


def test_shifts_follow_couplings_that_some_speeds_lack():
    """At the first speed only masses 1 and 2 are coupled, at the second one only the others with mass 0."""
    influence = np.stack([np.eye(3, dtype=complex)] * 2)
    influence[0, 1, 2], influence[0, 2, 1] = 0.1j, 0.1j * np.exp(1.4j)
    influence[1, 0, 1:] = 0.2 * np.array([1.0, np.exp(-0.7j)])
    influence[1, 1:, 0] = (0.3 + 0.1j) * np.array([1.0, np.exp(0.7j)])
    found = {tuple(map(int, each.permutation)): each.shift for each in exchanges_of(influence, np.full((3, 2), 0.4))}
    np.testing.assert_allclose(np.exp(1j * (found[0, 2, 1] - found[0, 2, 1][0])), np.exp([0.0, 0.7j, -0.7j]), atol=1e-12)


def test_each_speed_has_its_own_size_of_influences():
    """Masses that are alike at one speed and differ at another one, where all influences are small, are not exchanged."""
    influence = np.full((2, 2, 2), 0.1 + 0.02j) + np.eye(2)
    influence[0] = 1e-9 * (influence[0] + np.diag([0.0, 0.5]))
    equal = np.full((2, 2), 0.4)
    assert [tuple(map(int, each.permutation)) for each in exchanges_of(influence, equal)] == [(0, 1)]
    influence[0, 1, 1] = influence[0, 0, 0]
    assert len(exchanges_of(influence, equal)) == 2
