"""From which value on a design number brings a bifurcation with it."""

from __future__ import annotations

from collections.abc import Callable

from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.steady.diagram import exact_branches

__all__ = ["onset"]


def onset(
    make: Callable[[float], Scene],
    kind: str,
    between: tuple[float, float],
    *,
    omega: tuple[float, float],
    points: int = 300,
    accuracy: float = 1e-3,
) -> float:
    """The smallest value x at which the exact diagram of `make(x)` has a special point of the kind, by halving in log x.

    "Odd jam modes are stable on their whole range" is true of light loads; this finds the load mass from which on a torus
    bifurcation replaces a fold, or the half-turn symmetry breaks.

    **Arguments**: `make` the scene at x; `kind` as in `SpecialPoint`; `between` two positive values, without such a point and
    with one; `omega` the range of load speeds that it is looked for in, rad/s; `points` of each diagram; `accuracy` of x,
    relative.

    **Returns** x. **Raises** `InputError` where the ends do not differ.
    """

    def there(x: float) -> bool:
        diagram = exact_branches(make(x), points=points, least=omega[0], most=omega[1])
        return any(point.kind == kind for point in diagram.special)

    low, high = between
    if not 0.0 < low < high or there(low) or not there(high):
        raise InputError("between", f"is {between!r}; there must be no {kind} at the lower value and one at the upper value")
    while high / low > 1.0 + accuracy:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if there(middle) else (middle, high)
    return high
