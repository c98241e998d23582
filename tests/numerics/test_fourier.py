"""Trigonometric interpolation on a period, against polynomials that it is exact for."""

import numpy as np
import pytest

from jaxvib.numerics.fourier import analyzed, deviation_analysis, deviation_synthesis, grid_of, resampling, synthesized


def polynomial(orders, derivative=0):
    """A real trigonometric polynomial of these orders, or a derivative of it, and its harmonics."""
    c = np.random.default_rng(0).normal(size=(orders.size, 2)) @ [1.0, 1j]
    c = np.where(orders == 0, c.real, c)
    return lambda theta: np.sum(((1j * orders) ** derivative * c * np.exp(1j * orders * theta[:, None])).real, axis=1), c


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("points", [8, 9])
def test_derivatives_of_a_polynomial_are_exact(points, symmetric):
    grid = grid_of(points, symmetric)
    orders = grid.deviation_orders[: len(grid.deviation_orders) - symmetric]  # the highest of half a period has no sine
    values = polynomial(orders)[0](grid.theta)
    np.testing.assert_allclose(grid.first @ values, polynomial(orders, 1)[0](grid.theta), atol=1e-11)
    np.testing.assert_allclose(grid.second @ values, polynomial(orders, 2)[0](grid.theta), atol=1e-10)


@pytest.mark.parametrize("symmetric", [False, True])
def test_harmonics_of_a_polynomial_are_exact(symmetric):
    grid = grid_of(9, symmetric)
    e, c = polynomial(grid.orders)
    np.testing.assert_allclose(analyzed(e(grid.theta), grid.analysis), c, atol=1e-13)
    np.testing.assert_allclose(synthesized(c, grid.synthesis), e(grid.theta), atol=1e-12)
    orders = grid.deviation_orders[: len(grid.deviation_orders) - symmetric]
    psi, d = polynomial(orders)
    np.testing.assert_allclose(analyzed(psi(grid.theta), deviation_analysis(grid))[: orders.size], d, atol=1e-13)
    padded = np.append(d, np.zeros(grid.deviation_orders.size - orders.size))
    np.testing.assert_allclose(synthesized(padded, deviation_synthesis(grid)), psi(grid.theta), atol=1e-12)


@pytest.mark.parametrize("symmetric", [False, True])
def test_waves_of_two_points_belong_to_their_distance(symmetric):
    grid = grid_of(7, symmetric)
    phase = grid.orders * (grid.theta[:, None] - grid.theta[None, :])[..., None]
    np.testing.assert_allclose(grid.cosine[grid.pairs], 2.0 / grid.theta.size * np.cos(phase), atol=1e-14)
    np.testing.assert_allclose(grid.sine[grid.pairs], 2.0 / grid.theta.size * np.sin(phase), atol=1e-14)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_polynomial_moves_to_other_points_unchanged(symmetric):
    grid = grid_of(9, symmetric)
    orders = grid.deviation_orders[: len(grid.deviation_orders) - symmetric]
    for other in (grid_of(15, symmetric), grid):
        psi, _ = polynomial(orders)
        np.testing.assert_allclose(psi(grid.theta) @ resampling(grid, other), psi(other.theta), atol=1e-12)
