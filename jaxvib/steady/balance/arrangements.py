"""Arrangements of the loads of one plane that cancel each other and an imbalance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxvib.errors import InputError
from jaxvib.steady.jams.patterns import is_same_pattern, is_same_set


class Arrangements(NamedTuple):
    """Arrangements of the loads of one plane: the name of their `BalanceStatus`, and fields as in `BalancedStates`."""

    status: str
    angles: np.ndarray
    dimension: int
    neutral: list[np.ndarray]
    names: tuple[str, ...]


def arrangements(loads: np.ndarray, imbalance: complex, touching: float, *, ordered: bool) -> Arrangements:
    """Return the arrangements of loads that cancel each other and an imbalance in their plane.

    **Arguments**: `loads` (N,): unbalances of the loads, kg m; `imbalance`: complex, kg m; `touching`: angle between two loads
    that touch each other, rad, 0 for loads without a size; `ordered`: True if the loads cannot pass each other; then only
    arrangements in which their angles ascend within a turn are returned.
    """
    n, free = loads.size, imbalance == 0.0
    sides = loads if free else np.append(loads, abs(imbalance))
    largest = sides.max()
    if largest == 0.0:
        raise InputError("loads", "have unbalances of 0 within rounding; check their masses and radii")
    rest = sides.sum() - largest
    rounding = 8.0 * n * np.finfo(sides.dtype).eps * largest
    if largest > rest + rounding:
        return Arrangements("alone" if sides.size == 1 else "outweighed", np.zeros((0, n)), 0, [], ())
    if largest > rest - rounding:
        # All loads are on one line, the largest opposite all others.
        directions = np.where(np.arange(sides.size) == np.argmax(sides), 0.0, np.pi)[None, :]
    else:
        directions = inscribed_polygon(sides) * np.array([[1.0], [-1.0]])
    fixed, at = (0, 0.0) if free else (n, np.angle(imbalance))
    angles = np.mod(directions - directions[:, fixed, None] + at, 2.0 * np.pi)[:, :n]
    turned = np.sort(angles, axis=1)
    # Loads with a size are equal. They are as far from each other in these arrangements as the balance allows.
    if np.min(np.diff(turned, append=turned[:, :1] + 2.0 * np.pi)) < touching * (1.0 - 1e-9):
        return Arrangements("no_room", np.zeros((0, n)), 0, [], ())
    if ordered:
        angles = angles[:, :1] + np.cumsum(np.mod(np.diff(angles, axis=1, prepend=angles[:, :1]), 2.0 * np.pi), axis=1)
        angles = angles[angles[:, -1] - angles[:, 0] < 2.0 * np.pi]
    neutral = [neutral_directions(loads, row, turns=free) for row in angles]
    turn = ("turn of all loads",) if free else ()
    names = (*turn, *(f"shape {k + 1}" for k in range(neutral[0].shape[1] - len(turn))))
    return Arrangements("unique" if sides.size <= 3 else "family", angles, max(n - 2, 1 if free else 0), neutral, names)


def inscribed_polygon(sides: np.ndarray) -> np.ndarray:
    """Return directions of the sides of the polygon inscribed in a circle, in the order of the loads, the first at 0."""
    largest = int(np.argmax(sides))
    low, high = 0.0, 1.0

    def centre_angles(x: float) -> np.ndarray:
        return 2.0 * np.arcsin(np.minimum(sides / sides[largest] * x, 1.0))

    # x = largest side / diameter. The centre is inside the polygon if the central angles of the sides at x = 1 add up to a full
    # turn or more. Otherwise it is outside, beyond the largest side, whose central angle is then the sum of the others.
    inside = centre_angles(1.0).sum() >= 2.0 * np.pi
    others = np.arange(sides.size) != largest

    def excess(x: float) -> float:
        turns = centre_angles(x)
        return turns.sum() - 2.0 * np.pi if inside else turns[largest] - turns[others].sum()

    if not inside:
        low = 1e-9  # at x = 0 all angles are 0, which is not the solution
    for _ in range(200):
        middle = (low + high) / 2.0
        if excess(middle) > 0.0:
            high = middle
        else:
            low = middle
    turns = centre_angles(high)
    if not inside:
        turns[largest] = 2.0 * np.pi - turns[largest]
    direction = np.cumsum(turns) - turns / 2.0
    return direction - direction[0]


def neutral_directions(sides: np.ndarray, angles: np.ndarray, *, turns: bool = True) -> np.ndarray:
    """Return orthonormal changes of the angles (N, d) that keep the vector sum of the `sides` (N,) to first order. If the loads
    may turn together (`turns`), this common rotation is the first change."""
    n = sides.size
    change = np.stack([-sides * np.sin(angles), sides * np.cos(angles)]) / sides.max()
    _, values, right = np.linalg.svd(change)
    others = right[int(np.sum(values > 1e-6)) :].T
    if not turns:
        return others
    common = np.full((n, 1), 1.0 / np.sqrt(n))
    basis, size, _ = np.linalg.svd(others - common @ (common.T @ others), full_matrices=False)
    return np.concatenate([common, basis[:, size > 0.5]], axis=1)


def distinct_arrangements(
    angles: np.ndarray, groups: list[np.ndarray], axis: float | None, *, can_turn: bool
) -> list[np.ndarray]:
    """Return the indices of arrangements (n, N) that are the same but for an exchange of equal loads or a reflection, in one
    array for each distinct arrangement.

    **Arguments**: `groups`: indices of equal loads; `axis`: angle of the axis of reflection, rad, None for none; `can_turn`:
    True if a common rotation of all loads does not change an arrangement.
    """

    def is_image(first: np.ndarray, second: np.ndarray) -> bool:
        images = [second] if axis is None else [second, 2.0 * axis - second]
        if can_turn:
            return any(is_same_pattern(first, each, groups) for each in images)
        return any(all(is_same_set(np.exp(1j * first[g]), np.exp(1j * each[g])) for g in groups) for each in images)

    found: list[list[int]] = []
    for k, row in enumerate(angles):
        same = next((indices for indices in found if is_image(angles[indices[0]], row)), None)
        if same is None:
            found.append([k])
        else:
            same.append(k)
    return [np.array(indices) for indices in found]
