"""Exchanges of equal exciters that leave a machine unchanged, and regimes that differ only by them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_MAX_EXCHANGES = 5040
"""Largest number of exchanges that are found: 7!, the number for 7 equal masses. If a machine has more, some regimes may be
listed several times."""


class Exchange(NamedTuple):
    """Permutation of rotating masses, with shifts of their phases, that leaves the torque balance (`TorqueBalance`) unchanged.

    Mass i is replaced by mass `permutation[i]`, (count,); the `shift` (count,) of the phases is in rad.

    If alpha is a regime, alpha' with alpha'[permutation] = alpha + shift is also a regime.
    """

    permutation: np.ndarray
    shift: np.ndarray


def exchanges_of(influence: np.ndarray, features: np.ndarray) -> list[Exchange]:
    """Return at most `_MAX_EXCHANGES` exchanges of equal masses that leave the torque balance unchanged.

    An exchange satisfies, for the influence coefficients H at every speed,

        H[permutation_i, permutation_k] = exp(i (shift_i - shift_k)) H[i, k]

    Mirror images and rotations of a machine are such exchanges, and so is the identity.

    **Arguments**: `influence` H (speeds, count, count) at several speeds; `features` (count, m): numbers of each mass, such as
    its unbalance and its torque at several speeds, which are equal for masses that can be exchanged.
    """
    tolerance = 100.0 * np.finfo(influence.dtype).eps
    scale = np.maximum(np.max(np.abs(features), axis=0), np.finfo(float).tiny)
    same = np.all(np.abs(features[:, None] - features) <= tolerance * scale, axis=2)
    size = np.max(np.abs(influence), axis=(1, 2), keepdims=True)
    influence_tolerance = np.sqrt(tolerance)
    permutations = _permutations(np.abs(influence) / np.where(size > 0.0, size, 1.0), same, influence_tolerance)
    permuted = influence[:, permutations[:, :, None], permutations[:, None, :]].transpose(1, 0, 2, 3)
    exchanges = []
    for permutation, exchanged in zip(permutations, permuted, strict=True):
        shift = _shifts(influence, exchanged, influence_tolerance * size)
        expected = np.exp(1j * (shift[:, None] - shift[None, :])) * influence
        if np.all(np.abs(exchanged - expected) <= 4.0 * influence_tolerance * size):
            exchanges.append(Exchange(permutation, shift))
    return exchanges


def _permutations(size: np.ndarray, same: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the permutations (n, count) of masses that leave `size` |H| (speeds, count, count) unchanged, first the identity,
    built up mass by mass. `same` (count, count): True for masses with equal features."""
    permutations = np.zeros((1, 0), int)
    for i in range(len(same)):
        k = np.arange(len(same))[None, :, None]
        longer = np.concatenate(
            [permutations[:, None, :].repeat(len(same), axis=1), k.repeat(len(permutations), axis=0)], axis=2
        )
        alike = np.abs(size[:, k, longer] - size[:, None, None, i, : i + 1]) <= tolerance
        alike &= np.abs(size[:, longer, k] - size[:, None, None, : i + 1, i]) <= tolerance
        good = same[i] & np.all(alike, axis=(0, 3)) & np.all(longer[:, :, :-1] != k, axis=2)
        permutations = longer[good][:_MAX_EXCHANGES]
    return permutations


def _shifts(influence: np.ndarray, exchanged: np.ndarray, small: np.ndarray) -> np.ndarray:
    """Return the shifts of the phases (count,), rad: each shift follows from that of a coupled mass whose shift is known.

    `exchanged` is `influence` after a permutation of the masses; masses are coupled if a coefficient is larger than `small`.
    """
    count = influence.shape[1]
    coupled, best_speed = np.abs(influence) > small, np.argmax(np.abs(influence), axis=0)
    shift, known = np.zeros(count), np.zeros(count, dtype=bool)
    while not known.all():
        links = np.argwhere(np.any(coupled, axis=0) & known[:, None] & ~known[None, :])
        if links.size == 0:
            known[np.argmin(known)] = True
            continue
        i, k = links[0]
        at = best_speed[i, k], i, k
        shift[k] = shift[i] - np.angle(exchanged[at] / influence[at])
        known[k] = True
    return shift


def distinct_regimes(
    speed: np.ndarray, phases: np.ndarray, exchanges: list[Exchange], tolerance: tuple[float, float], known: int = 0
) -> np.ndarray:
    """Return indices of regimes (n,), in the order of decreasing speed, of which no two differ only by a common shift of
    phases, an exchange, or rounding.

    **Arguments**: `speed` (n,), `phases` (n, count); `tolerance` of speeds, relative, and of exp(i alpha); `known`: number of
    the first regimes that are already distinct, and are kept.
    """
    phasors = np.exp(1j * phases)
    permutations, shifts = (np.array(parts) for parts in zip(*exchanges, strict=True))
    inverses = np.argsort(permutations)
    distinct = list(range(known))
    order = np.concatenate([np.arange(known), known + np.argsort(-speed[known:], kind="stable")])
    for k in order[_without_copies(speed[order], phasors[order], tolerance)]:
        if k < known:
            continue
        # All exchanged forms of this regime, (exchanges, count).
        forms = np.take_along_axis(phasors[k] * np.exp(1j * shifts), inverses, axis=1)
        near = [i for i in distinct if abs(speed[i] - speed[k]) <= tolerance[0] * speed[i]]
        others = phasors[near]
        common = np.sum(others[:, None] * forms.conj()[None], axis=-1, keepdims=True)
        common = common / np.where(np.abs(common) > 0.0, np.abs(common), 1.0)
        if not np.any(np.max(np.abs(others[:, None] - common * forms[None]), axis=-1) < tolerance[1]):
            distinct.append(int(k))
    return np.asarray(sorted(distinct, key=lambda k: -speed[k]), dtype=int)


def _without_copies(speed: np.ndarray, phasors: np.ndarray, tolerance: tuple[float, float]) -> np.ndarray:
    """Return the ascending indices of regimes without those that agree with an earlier one in rounded speed and phasors: most
    of them, because most regimes are found from many starts. The slow search for exchanges follows."""
    relative = phasors * phasors[:, :1].conj() / (0.5 * tolerance[1])
    level = np.log(np.maximum(speed, np.finfo(speed.dtype).tiny)) / tolerance[0]
    cells = np.round(np.concatenate([level[:, None], relative.real, relative.imag], axis=1))
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])
