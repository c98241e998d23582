"""Capture thresholds over a parameter of the machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn
from jaxvib.equations.dynamics import vector_field
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import make_scene
from jaxvib.motion.ensemble import Equations
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.study.capture.capture import Capture, Rotation, capture
from jaxvib.units import Number


class ThresholdCurve(Result):
    """Threshold of capture over a parameter of the scene.

    Returned by `threshold_curve`.

    **Attributes** (V values)

    - `value` (V,) of the parameter
    - `threshold` and `uncertainty` (V,): see `Capture`; the threshold is -1 if every start was captured, and NaN if not every
      start at the highest speed was captured
    - `least` (V,): the lowest speed at which a start was captured, NaN if there is none. If it is below the threshold, both
      captures and failures occur between this speed and the threshold
    - `last_change` (V,): change of the threshold by the last doubling of the steps
    - `converged` (V,): False if this change was larger than the `resolution` or, if no `resolution` was given, larger than the
      distance between neighbouring speeds
    - `turns`: number of turns of the rotor in each run
    """

    status = Computed.done

    value: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    threshold: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    uncertainty: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    least: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    last_change: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    converged: np.ndarray = eqx.field(metadata=in_unit("", "value"))
    turns: Array = eqx.field(metadata=in_unit(""))

    def summary(self) -> str:
        """Return a line of text for each value."""
        lines = [
            f"captured in {int(self.turns)} turns: threshold of the initial speed, and the lowest captured "
            "initial speed, relative to the rotor speed"
        ]
        for row in zip(self.value, self.threshold, self.uncertainty, self.least, self.converged, strict=True):
            value, threshold, uncertainty, least, converged = map(float, row)
            threshold_text = "no threshold" if np.isnan(threshold) else f"{threshold:.4f} +- {uncertainty:.1e}"
            threshold_text += "" if converged else " (not converged)"
            lines.append(f"  {value:10.6g}  {threshold_text}" + ("" if np.isnan(least) else f"; lowest {least:.4f}"))
        return "\n".join(lines)

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot thresholds with their uncertainty, and the lowest captured speeds, over the values."""
        from jaxvib.draw.capture import curve_chart  # slow import

        return curve_chart(self.value, self.threshold, self.uncertainty, self.least, ax=ax)


@validated
def threshold_curve(
    make: Callable[[float], Scene],
    values: Sequence[float] | np.ndarray,
    speeds: Sequence[float] | np.ndarray | None = None,
    *,
    turns: int = 2000,
    starts: int = 1,
    spread: Number = 1e-3,
    seed: int = 0,
    resolution: float | None = None,
    rotation: Rotation = "rolling",
    equations: Equations = vector_field,
) -> ThresholdCurve:
    """Compute the capture thresholds of scenes that differ in one parameter, by `capture`.

    **Arguments**

    - `make`: a function that returns the scene for a value of the parameter
    - `values` (V,) of the parameter; typical: 5 to 20
    - `speeds`, `turns`, `starts`, `spread`, `seed`, `resolution`, `rotation`, `equations`: as for `capture`

    **Returns** `ThresholdCurve`. **Raises** `InputError` for an empty list of values, and the errors of `capture`.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["torus"])
    >>> def at_speed(speed):
    ...     return scene.replace(drive=jv.ConstantSpeed(speed))
    >>> curve = jv.threshold_curve(at_speed, [140.0], [-1.0, -0.2], turns=60)
    >>> curve.threshold.tolist()
    [-0.6]

    Source: see `capture`.
    """
    numbers = np.asarray(values, dtype=float)
    if numbers.ndim != 1 or numbers.size == 0 or not np.all(np.isfinite(numbers)):
        raise InputError("values", f"is {quoted(values)}; it must be a list of at least one finite number")
    captures = [
        capture(
            make_scene(make, float(value)),
            speeds,
            turns=turns,
            starts=starts,
            spread=spread,
            seed=seed,
            resolution=resolution,
            rotation=rotation,
            equations=equations,
        )
        for value in numbers
    ]
    return ThresholdCurve(
        value=numbers,
        threshold=np.array([result.border for result in captures]),
        uncertainty=np.array([_uncertainty(result) for result in captures]),
        least=np.array([_lowest_captured_speed(result) for result in captures]),
        last_change=np.array([float(result.last_change) for result in captures]),
        converged=np.array([result.status_name != "not_converged" for result in captures]),
        turns=jnp.asarray(turns),
    )


def _uncertainty(result: Capture) -> float:
    """Return the uncertainty of the threshold, which is the `last_change` alone if every start was captured."""
    if result.border == -1.0:
        return 0.0 if np.isnan(result.last_change) else float(result.last_change)
    return float(result.uncertainty)


def _lowest_captured_speed(result: Capture) -> float:
    captured = np.flatnonzero(np.any(result.captured, axis=1))
    return float(result.speed[captured[0]]) if captured.size else float("nan")
