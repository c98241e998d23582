"""Audit of a scene: changes and cost of each effect and each tier, and effects that it may lack."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np

from jaxvib.boundary import call_user, validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.study.accuracy.exact_reference import usual_mode
from jaxvib.study.audit.compared import CHANGES, EffectRow, RepeatedComparison, effect_row, field_operations
from jaxvib.study.audit.comparisons import MIN_AMPLITUDE_SHARE, JamComparison, RunComparison, without_excluded_effects
from jaxvib.study.audit.numbers import NumberRow, dimensionless_numbers
from jaxvib.study.audit.tiers import TierRow, tier_rows
from jaxvib.study.audit.variants import possible_variants, present_variants, require_absent
from jaxvib.units import Number, count, number

_TIER_STEPS = 1
"""Estimated time of the comparison of all tiers, in units of the time of one effect; `progress` reports shares."""


class AuditStatus(eqx.Enumeration):
    """Outcomes of an audit. The value of each member is the message shown to the user."""

    done = "the change by each effect was computed"
    unsettled = "the motion had not settled to the requested accuracy: smaller changes are not resolved; run longer"
    failed = "the motion of the scene itself could not be computed; a comparison is not possible"


class Audit(Result):
    """Changes and cost of each effect and each tier on a scene.

    Returned by `audit`.

    **Attributes**

    - `accuracy`: the requested relative accuracy
    - `motion`: description of the compared motion
    - `kind` of the motion of the scene as given, before any effect is removed or added; its `omega`, rad/s, `amplitude`
      (nd,), m (rad for tilts), and `foundation_force`, N; `fold`: the rotor speed at which the jam ends, rad/s
    - `operations` of its equations of motion, `seconds` of a run of 100 turns, and `compile`, the time of its compilation, s
      (NaN if times were not measured)
    - `effects`, `tiers` and `numbers`: lists of `EffectRow`, `TierRow`, `NumberRow`
    - `coordinates`: the names of the coordinates
    """

    status: AuditStatus
    accuracy: float = eqx.field(metadata=in_unit(""))
    motion: str
    kind: str
    omega: float = eqx.field(metadata=in_unit("rad/s"))
    amplitude: np.ndarray = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    foundation_force: float = eqx.field(metadata=in_unit("N"))
    fold: float = eqx.field(metadata=in_unit("rad/s"))
    operations: int = eqx.field(metadata=in_unit(""))
    seconds: float = eqx.field(metadata=in_unit("s"))
    compile: float = eqx.field(metadata=in_unit("s"))
    effects: list[EffectRow] = eqx.field(metadata=in_unit("", "effect", name="effect"))
    tiers: list[TierRow] = eqx.field(metadata=in_unit("", "tier", name="tier"))
    numbers: list[NumberRow] = eqx.field(metadata=in_unit("", "number", name="number"))
    coordinates: tuple[str, ...] = ()

    @validated
    def advised(self, advice: str) -> list[str]:
        """Return the names of the effects with the given `advice`, for example "needed" or "negligible"."""
        return [row.effect for row in self.effects if row.advice == advice]

    def summary(self) -> str:
        """Return the needed, negligible and missing effects of the scene as text."""
        lines = [f"{self.motion}: {self.kind}; {self.message}"]
        for row in self.effects:
            change = "change unknown" if math.isnan(row.change) else f"changes up to {100.0 * row.change:.3g} %"
            presence = "" if row.present else ", not in the scene"
            lines.append(f"  {row.effect}{presence}: {row.advice} ({change}, {row.operations:+d} operations)")
        for tier in self.tiers:
            lines.append(f"  {tier.tier}: {tier.words()}")
        for number_row in self.numbers:
            lines.append(f"  {number_row.name} = {number_row.value:.3g}: {number_row.advice}; {number_row.note}")
        return "\n".join(lines)

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the change by each effect, with the requested accuracy."""
        from jaxvib.draw.comparison import audit_chart  # slow import

        plain_names = dict(zip(CHANGES, ("amplitude", "foundation force", "load speed", "end of the jam"), strict=True))
        changes = {plain_names[name]: np.array([abs(getattr(row, name)) for row in self.effects]) for name in CHANGES}
        labels = [f"{row.effect.replace('_', ' ')}{'' if row.present else ' (added)'}: {row.advice}" for row in self.effects]
        uncertainty = np.array([row.uncertainty for row in self.effects])
        return audit_chart(labels, changes, uncertainty, self.accuracy, ax=ax)


@validated
def audit(
    scene: Scene,
    *,
    accuracy: float = 0.01,
    mode: int | None = None,
    until: Number | None = None,
    start: Literal["rest", "turning"] | State | None = None,
    possible: Sequence[Effect] | None = None,
    tiers: bool = True,
    repeats: int = 3,
    progress: Callable[[str, float], None] | None = None,
) -> Audit:
    """Compute by how much each effect and each tier changes the results of a scene, and the cost of each.

    The audit shows which effects of a scene are negligible, and which effects the scene lacks.

    - Each effect of the scene is removed. Each effect that the scene lacks and could have is added, with typical values
      (`Effect.typical`). The same quantities are compared with and without the effect
    - For a scene that jams at a constant rotor speed, the jam is compared. It is computed as an exact orbit or, if the theory
      of exact orbits does not support the scene, by integration of the full equations until the motion has settled. For other
      scenes, the end of a run is compared. Transients are not compared
    - The gyroscopic coupling of a rotor's tilts and the limited power of a motor are removed in the same way
    - Your own effects are audited in the same way as those of the package

    **Arguments**

    - `scene` to audit
    - `accuracy`: the relative change below which an effect is negligible; typical: 0.001 to 0.05 (default 0.01)
    - `mode`: the jam mode; default: the second-highest of the modes that are stable by slope, or the only one
    - `until`: the end of a run, s or text; default: 100 times the longest natural period of the carrier, plus twice the time of
      the last jump of the drive's acceleration
    - `start` of the run: "rest", "turning" (loads evenly spread, at the rotor speed) or a `State`. If it is given, a run is
      compared, and not a jam; default of the run: "turning" if the rotor speed is constant, otherwise "rest"
    - `possible`: effects to add, in place of the effects of the package; typical: 1 to 3 effects; `()` for none
    - `tiers`: True (the default) to compute every tier as well
    - `repeats`: number of timings of a run of 100 turns, of which the shortest is reported; typical: 3 (the default); 0 for no
      timings, which saves a compilation for each effect
    - `progress`: a function that is called with the name of each step and the finished share of all steps (0 to 1)

    **Returns** `Audit`. **Raises** `InputError` for an accuracy that is not between 0 and 1, and for a possible effect that the
    scene has already and can have only once. For a mode that does not exist, it raises `ComputationError` (status "absent").
    The errors of `jam_modes` and `simulate` are raised unchanged.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"), (jv.Gravity(),))
    >>> found = jv.audit(scene, mode=1, possible=(), tiers=False, repeats=0)
    >>> found.advised("needed"), found.advised("negligible")
    ([], ['gravity'])

    Source: this package.
    """
    if isinstance(accuracy, bool) or not isinstance(accuracy, (int, float)) or not 0.0 < accuracy < 1.0:
        raise InputError("accuracy", f"is {quoted(accuracy)}; it must be a number between 0 and 1, such as 0.01 for 1 %")
    scene = validate_scene(scene)
    require_absent(scene, possible or ())
    count(repeats, "repeats", low=0)
    end = None if until is None else float(number(until, "s", "until", low=0.0, open_low=True))

    def report(what: str, share: float) -> None:
        if progress is not None:
            call_user(progress, "progress", what, share)

    comparison, description = _comparison(scene, mode, end, start)
    repeated = RepeatedComparison(comparison, repeats)
    report("the scene", 0.0)
    values = repeated.values(scene, repeated.tier(scene))
    until = comparison.until if isinstance(comparison, RunComparison) else None
    # For a machine that hardly moves, the typical effects are chosen for amplitudes of the size of the unbalance radius S/M of
    # its loads.
    amplitude = [a * (values.magnified / MIN_AMPLITUDE_SHARE if values.magnified > 1.0 else 1.0) for a in values.amplitude]
    variants = [*present_variants(scene, until), *possible_variants(scene, amplitude, possible)]
    finite_status = "done" if values.uncertainty <= 0.5 * accuracy else "unsettled"
    status = finite_status if np.isfinite(values.omega) else "failed"
    seconds, compiling = repeated.times(scene)
    steps = 1 + len(variants) + (_TIER_STEPS if tiers else 0)
    effects = []
    for k, variant in enumerate(variants, 1):
        report(variant.name.replace("_", " "), k / steps)
        effects.append(effect_row(repeated, scene, variant, float(accuracy)))
    if tiers:
        report("tiers", 1.0 - _TIER_STEPS / steps)
    return Audit(
        status=member(AuditStatus, status),
        accuracy=float(accuracy),
        motion=description,
        kind=values.words,
        omega=values.omega,
        amplitude=np.asarray(values.amplitude),
        foundation_force=values.foundation_force,
        fold=values.fold,
        operations=field_operations(scene),
        seconds=seconds,
        compile=compiling,
        effects=effects,
        tiers=tier_rows(scene, comparison, values, repeats) if tiers else [],
        numbers=[_with_computed_advice(row, effects) for row in dimensionless_numbers(scene, values, accuracy)],
        coordinates=scene.machine.structure().coordinates,
    )


def _with_computed_advice(row: NumberRow, effects: Sequence[EffectRow]) -> NumberRow:
    """Return the row of a dimensionless number. If the audit has a clear advice on its effect, the row contains this advice."""
    for effect in effects:
        if effect.effect == row.name.partition(":")[0] and effect.advice != "cannot tell":
            return row._replace(advice=effect.advice, note=f"{row.note}; the advice is that of the computed effect")
    return row


def _comparison(
    scene: Scene, mode: int | None, until: float | None, start: Literal["rest", "turning"] | State | None
) -> tuple[JamComparison | RunComparison, str]:
    if not (start is None or isinstance(start, State) or start in ("rest", "turning")):
        raise InputError("start", f"is {quoted(start)}; it must be 'rest', 'turning' or a State")
    if mode is not None and start is not None:
        raise InputError("mode", f"is {quoted(mode)}, but start selects a run; leave one of them out")
    if start is None and (scene.drive.constant or mode is not None):
        try:
            chosen = usual_mode(without_excluded_effects(scene)) if mode is None else mode
            jammed = JamComparison(chosen)
            if mode is not None:
                jam_modes(without_excluded_effects(scene)).select(mode)  # raises an error if the mode does not exist
            return jammed, f"jam mode {chosen} at {speed_text(scene.drive.speed)}"
        except InputError:
            if mode is not None:
                raise
    _ = scene.loads  # raises an error for exciters without loads
    run = RunComparison.of_arguments(scene, until, start)
    names = {"rest": "from rest", "turning": "with turning loads"}
    name = "from a given state" if isinstance(run.start, State) else names[run.start]
    return run, f"the motion {run.until:.4g} s after a start {name}"
