"""Comparison of tiers on a scene: values, errors, cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxvib.equations.averaged import averaged_loads
from jaxvib.equations.jammed_bodies import require_periodic_jams
from jaxvib.equations.linear import jammed_loads
from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.envelope.result import Envelope
from jaxvib.results.status import status_name
from jaxvib.steady.jams.jam import Jam, jam_modes
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.study.accuracy.cost import largest_by_unit, timed
from jaxvib.study.accuracy.exact_reference import WINDOW_PERIODS, slow_period
from jaxvib.study.audit.comparisons import JamComparison, MotionValues, RunComparison


class TierRow(NamedTuple):
    """Errors of one tier of an audit, and its computing time.

    **Attributes**

    - `tier`: its name; `applicable`: True if it can compute the quantities of the audit for the scene
    - `amplitude`, `foundation_force`, `omega`: relative errors, compared with the best tier. They are NaN if `applicable` is
      False. An error is also NaN if only the best tier has the value 0, or if all of its amplitudes are 0.
      `amplitude` is the error of the coordinate with the largest error, divided by the largest amplitude in the same unit
    - `seconds` of a computation; `compile`: additional seconds of the first computation; NaN without timings
    - `note`: purpose of the tier, the reason why it cannot compute the quantities, or the motion that the run reached after it
      left the jam
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
        largest_error = max((abs(x) for x in self[2:5] if not math.isnan(x)), default=math.nan)
        time_text = "" if math.isnan(self.seconds) else f", {self.seconds:.2g} s"
        return f"error {100.0 * largest_error:.2g} %{time_text}; {self.note}"


def tier_rows(scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues, repeats: int) -> list[TierRow]:
    """Return a row for each of `TIERS`.

    **Arguments**: `reference`: values of the best tier; `repeats`: number of timings, 0 for none.
    """
    return [_row(tier, scene, comparison, reference, repeats) for tier in TIERS]


def _row(tier: Tier, scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues, repeats: int) -> TierRow:
    def not_applicable(note: str) -> TierRow:
        return TierRow(tier.name, False, *(math.nan,) * 5, note=note)

    refusal = tier.refusal(scene)
    if refusal is not None:
        return not_applicable(refusal)
    call = _call(tier, scene, comparison, reference)
    if isinstance(call, str):
        return not_applicable(call)
    try:
        result, seconds, compiling = timed(call, repeats) if repeats else (call(), math.nan, math.nan)
    except (InputError, ComputationError) as problem:
        return not_applicable(str(problem))
    amplitude, size = np.abs(np.asarray(result.amplitude)), np.asarray(reference.amplitude)
    if not np.all(np.isfinite(amplitude)):
        status = getattr(result, "status", None)
        return not_applicable("this motion does not exist" if status is None else status_name(status))
    note = tier.purpose
    if isinstance(comparison, JamComparison) and isinstance(result, MotionValues) and result.kind != "jammed":
        note = f"the run left the jam: {result.kind}"
    largest = largest_by_unit(size, scene.machine.structure().units)
    errors = (amplitude - size)[largest > 0.0] / largest[largest > 0.0]
    return TierRow(
        tier.name,
        True,
        float(max(errors, key=abs, default=math.nan)),
        _relative_error(float(result.foundation_force), reference.foundation_force),
        _relative_error(float(result.omega), reference.omega),
        seconds,
        compiling,
        note,
    )


def _relative_error(value: float, reference: float) -> float:
    """Return the relative error of a value; NaN if only the reference is 0, such as the force on a missing foundation."""
    return 0.0 if value == reference else value / reference - 1.0 if reference else math.nan


def _call(
    tier: Tier, scene: Scene, comparison: JamComparison | RunComparison, reference: MotionValues
) -> Callable[[], Jam | Orbit | Envelope | MotionValues] | str:
    """Return a function that evaluates the tier, or the reason why the tier cannot be evaluated."""
    without_integration = tier.name in ("leading order", "exact orbit")
    if isinstance(comparison, JamComparison):
        if not without_integration and "unstable" in reference.kind:
            return "the jam is unstable, and a run leaves it"
        until = 10.0 * WINDOW_PERIODS * slow_period(scene)
        jam = tier.jam
        return (lambda: comparison.full(scene)) if jam is None else lambda: jam(scene, comparison.mode, until)
    if without_integration:
        return "computes jams of this scene, not the motion that this run reaches"
    if tier.name == "full":
        return lambda: comparison.full(scene)
    start = comparison.state(scene)
    return lambda: envelope(scene, comparison.until, start=start, save="window", throw=False)


class Tier(NamedTuple):
    """Method to compute a jam.

    **Attributes**

    - `name`; `purpose`: text
    - `require(scene)` raises `InputError` if the tier does not support the scene; the message names the part and the reason
    - `jam(scene, mode, until)` returns the result for the jam mode with number `mode`. Only the averaged equations use `until`,
      s: they are integrated up to this time. `jam` is None for the full equations, which start from the state of the comparison
    """

    name: str
    purpose: str
    require: Callable[[Scene], object]
    jam: Callable[[Scene, int, float], Jam | Orbit | Envelope] | None

    def refusal(self, scene: Scene) -> str | None:
        """Return a sentence with the reason why the tier does not support the scene; None if the tier supports it.

        >>> import jaxvib as jv
        >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.DCMotor("60 rad/s", 20.0, 0.1))
        >>> [tier.name for tier in TIERS if tier.refusal(scene) is None]
        ['full']
        """
        try:
            self.require(scene)
        except InputError as problem:
            return str(problem)
        return None


TIERS = (
    Tier(
        "leading order",
        "all jams of light loads, folds; no harmonics, no transients",
        jammed_loads,
        lambda scene, mode, until: jam_modes(scene).select(mode, throw=False),
    ),
    Tier(
        "exact orbit",
        "the periodic motion of a jam with all harmonics, its stability; no transients",
        require_periodic_jams,
        lambda scene, mode, until: jam_orbit(scene, mode=mode, throw=False),
    ),
    Tier(
        "envelope",
        "run-ups and jams of light loads; no harmonics",
        averaged_loads,
        lambda scene, mode, until: envelope(scene, until, start="jam", mode=mode, save="window", throw=False),
    ),
    Tier(
        "full",
        "every motion in time of every scene; no unstable jams",
        lambda scene: None,
        None,
    ),
)
"""Tiers in the order of their computing time; the last tier supports every scene."""
