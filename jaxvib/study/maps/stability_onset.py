"""Stability over a design parameter: ranges of stable jams, and the value at which a bifurcation appears."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import make_scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.runtime.parallel import in_parallel
from jaxvib.steady.jams.branch_plot import KINDS, MARKS
from jaxvib.steady.orbits.diagram import ExactBranches, SpecialPoint, exact_branches
from jaxvib.units import number

_MIN_POINTS = 10
"""Smallest number of load speeds of a diagram. Between the speeds of fewer ones, several special points are overlooked."""


class StabilityMap(Result):
    """Exact jams over a design parameter x.

    **Attributes** (n values, P load speeds)

    - `value` (n,) of x
    - `omega` (n, P): load speeds, rad/s, NaN where no jam was found
    - `stable` (n, P): True if the jam is stable, including against separation of the loads
    - `special` (n,): the special points of each diagram
    """

    status = Computed.done

    value: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    omega: np.ndarray = eqx.field(metadata=in_unit("rad/s", "value", "point"))
    stable: np.ndarray = eqx.field(metadata=in_unit("", "value", "point"))
    special: tuple[tuple[SpecialPoint, ...], ...]

    @property
    def stable_share(self) -> np.ndarray:
        """Share of the range of load speeds in which the jams are stable, (n,)."""
        widths = np.diff(self.omega, axis=1)
        stable = (self.stable[:, 1:].astype(float) + self.stable[:, :-1]) / 2.0
        return np.nansum(stable * widths, axis=1) / (np.nanmax(self.omega) - np.nanmin(self.omega))

    def summary(self) -> str:
        """Return a line of text for each value: the stable share of the range, and the special points."""
        lines = []
        for x, share, points in zip(self.value, self.stable_share, self.special, strict=True):
            kinds = ", ".join(f"{KINDS[point.kind]} at {speed_text(point.omega, 6)}" for point in points)
            lines.append(f"{x:.6g}: {100.0 * share:.1f} % of the load speeds stable; {kinds or 'no special point'}")
        return "\n".join(lines)

    def plot(self, *, label: str = "x", unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot stable jams as shaded areas over the load speed in `unit` and x, hatched areas without a jam, and special points
        as marks; `label`: name of x.
        """
        marks: dict[str, list[tuple[float, float]]] = {}
        for x, points in zip(self.value, self.special, strict=True):
            for point in points:
                marks.setdefault(MARKS[point.kind], []).append((point.omega, float(x)))
        from jaxvib.draw.comparison import stability_chart  # slow import

        return stability_chart(
            self.value, self.omega, self.stable, {k: np.array(v) for k, v in marks.items()}, label=label, unit=unit, ax=ax
        )


@validated
def stability_map(
    make: Callable[[float], Scene], values: Sequence[float], *, omega: tuple[float, float], points: int = 300
) -> StabilityMap:
    """Map the stability of exact jams over a design parameter x, such as the mass of the loads.

    **Arguments**

    - `make`: a function that returns the scene for a value of x
    - `values` of x, ascending; typical: 5 to 20
    - `omega`: the lowest and the highest load speed, rad/s; typical: a range about one resonance
    - `points`: number of load speeds in each diagram, at least 10; typical: 60 to 300 (the default). The computing time is
      proportional to this number

    **Returns** `StabilityMap`. **Raises** `InputError` for an empty list of values, for values that do not ascend, and for too
    few points.

    >>> import jaxvib as jv
    >>> def machine(eps):
    ...     return jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                             rho=1.0, eps=eps, beta=1.0, speed=2.0).scene()
    >>> chart = stability_map(machine, [0.01, 0.05], omega=(0.36, 0.5), points=60)
    >>> [[p.kind for p in points] for points in chart.special]
    [['fold'], ['fold', 'torus']]

    Source: this package; the diagrams are those of `exact_branches`.
    """
    x = np.asarray(values, dtype=float)
    if x.ndim != 1 or x.size == 0 or not np.all(np.diff(x) > 0.0):
        raise InputError("values", f"are {quoted(values)}; give numbers in ascending order")
    _require_points(points)
    scenes = [make_scene(make, float(v)) for v in x]

    def diagram(k: int) -> ExactBranches:
        return exact_branches(scenes[k], points=points, least=omega[0], most=omega[1])

    diagram_of = dict(in_parallel(diagram, range(x.size)))
    diagrams = [diagram_of[k] for k in range(x.size)]
    return StabilityMap(
        x,
        np.stack([np.asarray(d.omega) for d in diagrams]),
        np.stack([np.asarray(d.stable) for d in diagrams]),
        tuple(d.special for d in diagrams),
    )


def _require_points(points: int) -> None:
    """**Raises** `InputError` for too few load speeds of a diagram."""
    if points < _MIN_POINTS:
        problem = f"is {points}; with so few load speeds, stability changes between them are overlooked"
        raise InputError("points", f"{problem}; give at least {_MIN_POINTS}")


@validated
def stability_onset(
    make: Callable[[float], Scene],
    kind: str,
    between: tuple[float, float],
    *,
    omega: tuple[float, float],
    points: int = 300,
    accuracy: float = 1e-3,
) -> float:
    """Return the x at which a special point of a given kind appears in the branch diagram of exact jams of the scene `make(x)`.

    The value is found by bisection in log x. If such a point appears at several x in the range, one of these x is found.

    Odd jam modes of light loads are stable on their whole range. This function finds, for example, the load mass above which a
    torus bifurcation ends the stable range before the fold, or above which the half-turn symmetry breaks.

    **Arguments**

    - `make`: a function that returns the scene for a value of x
    - `kind` of the special point, see `SpecialPoint`
    - `between`: two positive values of x; at the lower value the diagram has no such point, at the higher value it has one
    - `omega`: the lowest and the highest load speed of the search, rad/s
    - `points`: number of load speeds in each diagram, at least 10; typical: 60 to 300 (the default). The computing time is
      proportional to this number
    - `accuracy` of x, relative; at least 1e-12; typical: 0.1 to 1e-3 (the default). Each diagram halves the range

    **Returns** x, which is too large by at most `accuracy` (relative). **Raises** `InputError` for an unknown kind, if the
    diagram of the lower value of `between` has such a point, and if that of the higher value has none.

    >>> import jaxvib as jv
    >>> def machine(eps):
    ...     return jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                             rho=1.0, eps=eps, beta=1.0, speed=2.0).scene()
    >>> round(stability_onset(machine, "torus", (0.02, 0.05), omega=(0.36, 0.5), points=60, accuracy=0.5), 4)
    0.0398

    Source: this package; the diagrams are those of `exact_branches`.
    """

    def has_point(x: float) -> bool:
        diagram = exact_branches(make_scene(make, x), points=points, least=omega[0], most=omega[1])
        return any(point.kind == kind for point in diagram.special)

    number(accuracy, "", "accuracy", low=1e-12)
    _require_points(points)
    if kind not in KINDS:
        raise InputError("kind", f"is {quoted(kind)}; it must be one of {', '.join(KINDS)}")
    low, high = between
    if not 0.0 < low < high:
        raise InputError("between", f"is {quoted(between)}; it must be two positive values, the lower one first")
    for x, is_required in ((low, False), (high, True)):
        if has_point(x) != is_required:
            present, required = ("no", "one") if is_required else ("a", "none")
            raise InputError(
                "between",
                f"is {quoted(between)}; at {x:g} the diagram has {present} {kind} and must have {required}: "
                f"{'raise' if is_required else 'lower'} this value (stability_map shows the special points)",
            )
    while high / low > 1.0 + accuracy:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if has_point(middle) else (middle, high)
    return high
