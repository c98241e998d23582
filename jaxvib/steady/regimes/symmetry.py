"""Exchanges of equal exciters that leave a machine unchanged, and regimes that differ only by them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_MAX_EXCHANGES = 5040
"""Largest number of exchanges: all of 7 masses, 7!. If a machine has more, some regimes may be listed several times."""


class Exchange(NamedTuple):
    """Exchange of masses that leaves the balance unchanged: `order` (count,) and the shifts of phases (count,), rad.

    If alpha is a regime, alpha' with alpha'[order] = alpha + shift is also a regime.
    """

    order: np.ndarray
    shift: np.ndarray


def exchanges_of(influence: np.ndarray, numbers: np.ndarray) -> list[Exchange]:
    """Return all exchanges of equal masses that leave the balance unchanged.

    H[order_i, order_k] = exp(i (shift_i - shift_k)) H[i, k] at every speed. Mirror images and rotations of a machine are such
    exchanges.

    **Arguments**: `influence` H (speeds, count, count) at several speeds; `numbers` (count, m) of each mass, such as its
    unbalance and its torque at several speeds.
    """
    tolerance = 100.0 * np.finfo(influence.dtype).eps
    scale = np.maximum(np.max(np.abs(numbers), axis=0), np.finfo(float).tiny)
    same = np.all(np.abs(numbers[:, None] - numbers) <= tolerance * scale, axis=2)
    size = np.max(np.abs(influence), axis=(1, 2), keepdims=True)
    tolerance = np.sqrt(tolerance)
    orders = _orders(np.abs(influence) / np.where(size > 0.0, size, 1.0), same, tolerance)
    turned = influence[:, orders[:, :, None], orders[:, None, :]].transpose(1, 0, 2, 3)
    exchanges = []
    for order, exchanged in zip(orders, turned, strict=True):
        shift = _shifts(influence, exchanged, tolerance * size)
        expected = np.exp(1j * (shift[:, None] - shift[None, :])) * influence
        if np.all(np.abs(exchanged - expected) <= 4.0 * tolerance * size):
            exchanges.append(Exchange(order, shift))
    return exchanges


def _orders(size: np.ndarray, same: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the orders (n, count) of the masses that leave `size` |H| (speeds, count, count) unchanged, first the identity.

    `same` (count, count): True for masses with equal numbers. The orders are built up mass by mass; at most `_MAX_EXCHANGES` of
    them are continued.
    """
    orders = np.zeros((1, 0), int)
    for i in range(len(same)):
        k = np.arange(len(same))[None, :, None]
        others = np.concatenate([orders[:, None, :].repeat(len(same), axis=1), k.repeat(len(orders), axis=0)], axis=2)
        alike = np.abs(size[:, k, others] - size[:, None, None, i, : i + 1]) <= tolerance
        alike &= np.abs(size[:, others, k] - size[:, None, None, : i + 1, i]) <= tolerance
        good = same[i] & np.all(alike, axis=(0, 3)) & np.all(others[:, :, :-1] != k, axis=2)
        orders = others[good][:_MAX_EXCHANGES]
    return orders


def _shifts(influence: np.ndarray, turned: np.ndarray, small: np.ndarray) -> np.ndarray:
    """Return the shifts of the phases (count,), rad: each shift follows from that of a coupled mass whose shift is known."""
    count = influence.shape[1]
    coupled, place = np.abs(influence) > small, np.argmax(np.abs(influence), axis=0)
    shift, known = np.zeros(count), np.zeros(count, dtype=bool)
    while not known.all():
        links = np.argwhere(np.any(coupled, axis=0) & known[:, None] & ~known[None, :])
        if links.size == 0:
            known[np.argmin(known)] = True
            continue
        i, k = links[0]
        at = place[i, k], i, k
        shift[k] = shift[i] - np.angle(turned[at] / influence[at])
        known[k] = True
    return shift


def distinct_regimes(
    speed: np.ndarray, phases: np.ndarray, exchanges: list[Exchange], tolerance: tuple[float, float]
) -> np.ndarray:
    """Return indices of regimes (n,) of which no two differ only by a common shift of phases, an exchange, or rounding.

    **Arguments**: `speed` (n,), `phases` (n, count); `tolerance` of speeds, relative, and of exp(i alpha).
    """
    turn = np.exp(1j * phases)
    orders, shifts = (np.array(parts) for parts in zip(*exchanges, strict=True))
    places = np.argsort(orders)
    distinct: list[int] = []
    for k in np.argsort(-speed, kind="stable"):
        # All exchanged forms of this regime, (exchanges, count).
        forms = np.take_along_axis(turn[k] * np.exp(1j * shifts), places, axis=1)
        near = [i for i in distinct if abs(speed[i] - speed[k]) <= tolerance[0] * speed[i]]
        if not near:
            distinct.append(int(k))
            continue
        others = turn[near]
        common = np.sum(others[:, None] * forms.conj()[None], axis=-1, keepdims=True)
        common = common / np.where(np.abs(common) > 0.0, np.abs(common), 1.0)
        if not np.any(np.max(np.abs(others[:, None] - common * forms[None]), axis=-1) < tolerance[1]):
            distinct.append(int(k))
    return np.asarray(distinct, dtype=int)
