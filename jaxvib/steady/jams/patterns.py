"""Comparison of patterns of loads: sets of angles that are the same but for an exchange of equal loads."""

from __future__ import annotations

import numpy as np

SAME_PHASE_DIFFERENCE = 1e-5
"""Difference of phases, rad, below which they count as equal."""


def is_same_pattern(first: np.ndarray, second: np.ndarray, groups: list[np.ndarray]) -> bool:
    """Return True if two sets of phases differ only by a common rotation and by an exchange of equal loads."""

    def points(phase: np.ndarray, group: np.ndarray) -> np.ndarray:
        return np.exp(1j * phase[group])

    if np.max(np.abs(np.exp(1j * first) - np.exp(1j * second))) < SAME_PHASE_DIFFERENCE:  # the common case
        return True
    lead = points(first, groups[0])[0]
    for start in points(second, groups[0]):
        turned = [points(second, g) * lead / start for g in groups]
        if all(is_same_set(points(first, g), other) for g, other in zip(groups, turned, strict=True)):
            return True
    return False


def is_same_set(first: np.ndarray, second: np.ndarray) -> bool:
    """Return True if two sets of points are the same in some order."""
    left = list(second)
    for point in first:
        near = int(np.argmin([abs(point - other) for other in left]))
        if abs(point - left.pop(near)) > SAME_PHASE_DIFFERENCE:
            return False
    return True


def images_text(indices: np.ndarray) -> str:
    """Return " (2 mirror images)" for two states that differ only by a mirror image; "" for a single state."""
    return f" ({len(indices)} mirror images)" if len(indices) > 1 else ""
