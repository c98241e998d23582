"""Layout of platforms, springs and exciter in a picture, in which springs cross as few platforms as possible."""

from __future__ import annotations

from typing import NamedTuple


class Tie(NamedTuple):
    """Link between two platforms, or support of a platform.

    **Attributes**: `low` and `high`: numbers of the platforms at its ends, counted from the bottom, 0 for the foundation;
    `stiffness` N/m and `damping` N s/m. The exciter is represented by a tie from its platform to the same platform, without
    stiffness and damping.
    """

    low: int
    high: int
    stiffness: float = 0.0
    damping: float = 0.0

    @property
    def exciter(self) -> bool:
        """True if the tie represents the exciter."""
        return self.low == self.high


def order_of_ties(ties: list[Tie], levels: int) -> list[int]:
    """Return an order of the ties from left to right for which few ties cross other platforms and platforms are short.

    Pairs of ties are swapped until no swap is an improvement.

    >>> order_of_ties([Tie(0, 1), Tie(0, 2), Tie(1, 2)], 2)
    [0, 2, 1]
    """
    order = list(range(len(ties)))

    def cost(order: list[int]) -> float:
        place = {tie: x for x, tie in enumerate(order)}
        spans = []
        for level in range(1, levels + 1):
            own = [place[k] for k, tie in enumerate(ties) if level in (tie.low, tie.high)]
            spans.append((min(own), max(own)) if own else (0, 0))
        crossed = sum(
            spans[level - 1][0] < place[k] < spans[level - 1][1]
            for k, tie in enumerate(ties)
            for level in range(tie.low + 1, tie.high)
        )
        return 100.0 * crossed + sum(high - low for low, high in spans)

    best = cost(order)
    while True:
        swaps = [(i, j) for i in range(len(order)) for j in range(i)]
        candidates = []
        for i, j in swaps:
            other = order.copy()
            other[i], other[j] = other[j], other[i]
            candidates.append((cost(other), other))
        least, other = min(candidates, default=(best, order))
        if not least < best - 1e-12:
            return order
        best, order = least, other
