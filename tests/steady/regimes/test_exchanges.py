"""Exchanges of equal exciters: which masses count as equal."""

import numpy as np

from jaxvib.steady.regimes.symmetry import exchanges_of


def test_masses_that_differ_by_rounding_are_exchanged():
    influence = np.full((2, 3, 3), 0.1 + 0.02j) + np.diag([1.0, 1.0, 1.0])
    numbers = np.array([[0.4, 25.0], [0.4 * (1.0 + 4e-16), 25.0], [1e-9, 30.0]])
    orders = {tuple(map(int, each.order)) for each in exchanges_of(influence, numbers)}
    assert orders == {(0, 1, 2), (1, 0, 2)}


def test_masses_that_differ_by_more_than_rounding_stay():
    influence = np.full((2, 2, 2), 0.1 + 0.02j) + np.eye(2)
    numbers = np.array([[0.4, 25.0], [0.4 * (1.0 + 1e-9), 25.0]])
    assert [tuple(map(int, each.order)) for each in exchanges_of(influence, numbers)] == [(0, 1)]
