"""Scans of many points with twice as many steps until their borders stay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

Scanned = TypeVar("Scanned")


class Refined(NamedTuple, Generic[Scanned]):
    """Results of the finest scans.

    **Attributes**: `results` of P points; `multiple` (P,): the number of steps of each result divided by that of the first
    scan; `last_change` (P, K): the change of the K borders of each result by the last doubling, infinite if only one of the two
    scans has the border, NaN without a doubling.
    """

    results: list[Scanned]
    multiple: np.ndarray
    last_change: np.ndarray


def refine(
    scan: Callable[[np.ndarray, int], list[Scanned]],
    borders: Callable[[Scanned], np.ndarray],
    points: int,
    tolerance: float,
    doublings: int,
) -> Refined[Scanned]:
    """Double the steps of each point until its borders change by less than the tolerance.

    **Arguments**: `scan(indices, multiple)` returns the results of points with `multiple` times the steps; `borders` returns
    the borders of a result, NaN for one that does not exist; `points`: their number P; `tolerance`: the largest allowed change
    of a border; `doublings`: the largest number of doublings.
    """
    multiple, unconverged = np.ones(points, dtype=int), np.arange(points)
    results = scan(unconverged, 1)
    last_change = np.full((points, *borders(results[0]).shape), np.nan)
    for k in range(1, doublings + 1):
        if unconverged.size == 0:
            break
        multiple[unconverged] = 2**k
        for i, finer in zip(unconverged, scan(unconverged, 2**k), strict=True):
            last_change[i] = _distance(borders(results[i]), borders(finer))
            results[i] = finer
        unconverged = unconverged[np.any(last_change[unconverged] > tolerance, axis=1)]
    return Refined(results, multiple, last_change)


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the absolute differences: 0 between two NaN, infinite between NaN and a number."""
    difference = np.abs(first - second)
    missing = np.isnan(first) != np.isnan(second)
    return np.where(missing, np.inf, np.where(np.isnan(difference), 0.0, difference))
