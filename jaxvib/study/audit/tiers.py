"""Comparison of tiers on a scene: values, errors, cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.results.status import status_name
from jaxvib.study.accuracy.cost import timed
from jaxvib.study.accuracy.exact_reference import SLOW_PERIODS, slow_period
from jaxvib.study.accuracy.tier import TIERS, JamValues, Tier
from jaxvib.study.audit.comparisons import JamComparison, MotionValues, RunComparison


class TierRow(NamedTuple):
    """One tier of an audit.

    **Attributes**

    - `tier`: its name; `applicable`: True if it can compute the audit's quantities for the scene
    - `amplitude`, `foundation_force`, `omega`: the error of this quantity relative to the best tier, not the quantity itself;
      for `amplitude` that of the coordinate with the largest error, in units of the largest amplitude; NaN if `applicable` is
      False
    - `seconds` of a computation, and additional seconds of the first one, `compile`; NaN without timings
    - `note`: its purpose, or the reason why it cannot compute the quantities
    """

    tier: str
    applicable: bool
    amplitude: float
    foundation_force: float
    omega: float
    seconds: float
    compile: float
    note: str

    def words(self) -> str:
        """Return the row as text."""
        if not self.applicable:
            return f"not applicable; {self.note}"
        off = max(abs(self.amplitude), abs(self.foundation_force), abs(self.omega))
        took = "" if math.isnan(self.seconds) else f", {self.seconds:.2g} s"
        return f"error {100.0 * off:.2g} %{took}; {self.note}"


def tier_rows(scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues, repeats: int) -> list[TierRow]:
    """Return a row for each of `TIERS`. `reference` contains the values of the best tier; no timings if `repeats` is 0."""
    return [_row(tier, scene, comparison, reference, repeats) for tier in TIERS]


def _row(tier: Tier, scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues, repeats: int) -> TierRow:
    nothing = (math.nan,) * 5
    refusal = tier.refusal(scene)
    if refusal is not None:
        return TierRow(tier.name, False, *nothing, note=refusal)
    call = _call(tier, scene, comparison, reference)
    if isinstance(call, str):
        return TierRow(tier.name, False, *nothing, note=call)
    try:
        found, seconds, compiling = timed(call, repeats) if repeats else (call(), math.nan, math.nan)
    except (InputError, ComputationError) as problem:
        return TierRow(tier.name, False, *nothing, note=str(problem))
    amplitude, size = np.abs(np.asarray(found.amplitude)), np.asarray(reference.amplitude)
    if not np.all(np.isfinite(amplitude)):
        status = getattr(found, "status", None)
        return TierRow(tier.name, False, *nothing, note="this motion does not exist" if status is None else status_name(status))
    note = tier.purpose
    if isinstance(comparison, JamComparison) and isinstance(found, MotionValues) and found.kind != "jammed":
        note = f"the run left the jam: {found.kind}"
    off = (amplitude - size) / np.max(size)
    return TierRow(
        tier.name,
        True,
        float(off[np.argmax(np.abs(off))]),
        float(found.foundation_force) / reference.foundation_force - 1.0,
        float(found.omega) / reference.omega - 1.0,
        seconds,
        compiling,
        note,
    )


def _call(
    tier: Tier, scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues
) -> Callable[[], JamValues | MotionValues] | str:
    """Return a function that evaluates the tier, or the reason why the tier cannot be evaluated."""
    without_integration = tier.name in ("leading order", "exact orbit")
    if isinstance(comparison, JamComparison):
        if not without_integration and "unstable" in reference.kind:
            return "the jam is unstable, and a run leaves it"
        until = 10.0 * SLOW_PERIODS * slow_period(scene)
        if tier.name == "full":
            return lambda: comparison.full(scene)
        return lambda: tier.jam(scene, comparison.mode, until)
    if without_integration:
        return "computes jams of this scene, not the motion that this run reaches"
    if tier.name == "full":
        return lambda: comparison.full(scene)
    start = comparison.state(scene)
    return lambda: envelope(scene, comparison.until, start=start, save="window", throw=False)
