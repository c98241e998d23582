"""Samples of a unit cube that can be had from any place on: the k-th is the same whoever asks for it, and in which order."""

from __future__ import annotations

import numpy as np

__all__ = ["SAMPLINGS", "samples"]

SAMPLINGS = ("low_discrepancy", "random")
"""How samples are drawn: spread evenly by a sequence of low discrepancy, or independent of each other."""


def samples(first: int, last: int, size: int, seed: int, sampling: str) -> np.ndarray:
    """The samples number `first` to `last` - 1 in the unit cube of `size` dimensions, (last - first, size), in [0, 1).

    "low_discrepancy" is the additive sequence x_k = frac(x_0 + k a) with a_j = g^-j, where g > 1 solves g^(size+1) = g + 1, and
    x_0 is random by `seed`; computed with whole numbers of 64 bits, so that the billionth sample has all its digits. "random"
    are the numbers of a counter-based generator (Philox) with the key `seed`.

    >>> samples(0, 4, 1, 0, "low_discrepancy").round(3).ravel().tolist()
    [0.012, 0.63, 0.248, 0.866]
    >>> bool((samples(2, 4, 3, 7, "random") == samples(0, 4, 3, 7, "random")[2:]).all())
    True

    Source: M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018; Salmon et al., Parallel random numbers:
    as easy as 1, 2, 3, 2011.
    """
    if sampling == "random":
        blocks = -(-size // 4)  # the generator makes four numbers at a time
        raw = np.random.Philox(key=seed, counter=first * blocks).random_raw((last - first) * blocks * 4)
        numbers = raw.reshape(last - first, 4 * blocks)[:, :size]
    else:
        root = 2.0
        for _ in range(64):
            root = (1.0 + root) ** (1.0 / (size + 1))
        steps = np.asarray([int(root ** -(j + 1.0) * 2.0**64) for j in range(size)], np.uint64)
        begin = np.random.Philox(key=seed).random_raw(size)
        with np.errstate(over="ignore"):
            numbers = begin + np.arange(first, last, dtype=np.uint64)[:, None] * steps
    return (numbers >> np.uint64(11)) * 2.0**-53
