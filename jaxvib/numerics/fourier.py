"""Points on a period and trigonometric interpolation between them."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class Grid(NamedTuple):
    """Points on a period of theta = Omega t and the matrices of trigonometric interpolation between them.

    With the half-turn symmetry psi(theta + pi) = psi(theta), e(theta + pi) = -e(theta), half a period is sufficient: the
    deviation psi of the load angle from Omega t has even harmonics only, and the position e = exp(i phi) of the loads on the
    unit circle has odd ones.

    **Attributes** (M points)

    - `symmetric`: True if the grid covers half a period
    - `theta` (M,): points, rad
    - `first`, `second` (M, M): matrices of the derivatives d/dtheta and d^2/dtheta^2 of psi
    - `deviation_orders` (J,) and `orders` (K,): harmonics of psi and of e
    - `deviation_weights` (J,): harmonic k of psi is weight / M sum_l psi_l exp(-i k theta_l); for e all weights are 2
    - `cosine`, `sine` (2M - 1, K): 2 / M times cos and sin of k times the angle between two points
    - `pairs` (M, M): index of the angle between two points in `cosine` and `sine`
    - `analysis` (M, 2K): matrix from the values e_l to the real parts of the harmonics e_k followed by their imaginary parts;
      `synthesis` (2K, M): matrix of the inverse map; see `analyzed` and `synthesized`
    """

    symmetric: bool
    theta: np.ndarray
    first: np.ndarray
    second: np.ndarray
    deviation_orders: np.ndarray
    deviation_weights: np.ndarray
    orders: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    pairs: np.ndarray
    analysis: np.ndarray
    synthesis: np.ndarray


def grid_of(points: int, symmetric: bool) -> Grid:
    """Return the grid of `points` points, on half a period if `symmetric` is True, otherwise on a period.

    `points` is rounded up: to an even number for half a period, to an odd number for a period. The grid then represents both
    the cosine and the sine of the highest harmonic of e. Each precision has its own grid, because JAX caches an array with
    the precision of its first use.
    """
    return _grid_of(points, symmetric, jnp.result_type(float).itemsize == 8)


@functools.lru_cache(maxsize=64)
def _grid_of(points: int, symmetric: bool, double: bool) -> Grid:
    m = points + points % 2 if symmetric else points + 1 - points % 2
    turn = np.pi if symmetric else 2.0 * np.pi
    theta = turn * np.arange(m) / m
    if symmetric:
        deviation_orders, orders = np.arange(0, m + 1, 2), np.arange(1, m, 2)
        weights = np.where((deviation_orders == 0) | (deviation_orders == m), 1.0, 2.0)
    else:
        deviation_orders, orders = np.arange(0, (m + 1) // 2), np.arange(1, (m + 1) // 2)
        weights = np.where(deviation_orders == 0, 1.0, 2.0)
    difference = theta[:, None] - theta[None, :]
    phase = deviation_orders[:, None, None] * difference
    first = np.tensordot(weights * -deviation_orders, np.sin(phase), 1) / m
    second = np.tensordot(weights * -(deviation_orders**2), np.cos(phase), 1) / m
    distance = orders * (turn / m * np.arange(1 - m, m))[:, None]
    index = np.arange(m)
    return Grid(
        symmetric, theta, first, second, deviation_orders, weights, orders,
        2.0 / m * np.cos(distance), 2.0 / m * np.sin(distance), index[:, None] - index[None, :] + m - 1,
        2.0 / m * _analysis(orders, theta), _synthesis(orders, theta),
    )  # fmt: skip


def _analysis(orders: np.ndarray, theta: np.ndarray) -> np.ndarray:
    wave = orders * theta[:, None]
    return np.concatenate([np.cos(wave), -np.sin(wave)], 1)


def _synthesis(orders: np.ndarray, theta: np.ndarray) -> np.ndarray:
    return _analysis(orders, theta).T


def analyzed(values: Array, matrix: np.ndarray) -> Array:
    """Return the complex harmonics (..., K) of real values (..., M) at the points by the `matrix` (M, 2K) `Grid.analysis` or
    `deviation_analysis`. A product of real matrices needs half of the operations of a complex product."""
    return jax.lax.complex(*jnp.split(values @ matrix, 2, -1))


def synthesized(harmonics: Array, matrix: np.ndarray) -> Array:
    """Return the values (..., M) at the points from harmonics c (..., K): Re sum_k c_k exp(i k theta_l), by the `matrix`
    (2K, M) `Grid.synthesis` or `deviation_synthesis`."""
    return jnp.concatenate([harmonics.real, harmonics.imag], -1) @ matrix


def deviation_analysis(grid: Grid) -> np.ndarray:
    """Return the matrix (M, 2J) from values of psi to the real, then the imaginary parts of its harmonics, see `analyzed`."""
    return _analysis(grid.deviation_orders, grid.theta) * np.tile(grid.deviation_weights, 2) / grid.theta.size


def resampling(grid: Grid, to: Grid) -> np.ndarray:
    """Return the matrix (M, M') from values of psi on `grid` to those on the grid `to`, by the harmonics that both grids
    have."""
    orders = min(grid.deviation_orders.size, to.deviation_orders.size)
    is_common = np.tile(np.arange(grid.deviation_orders.size) < orders, 2)
    return deviation_analysis(grid)[:, is_common] @ _synthesis(grid.deviation_orders[:orders], to.theta)


def deviation_synthesis(grid: Grid) -> np.ndarray:
    """Return the matrix (2J, M) from the harmonics of psi to its values at the points, see `synthesized`."""
    return _synthesis(grid.deviation_orders, grid.theta)
