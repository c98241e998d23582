"""Comparison of a scene with a variant that has one effect more or less."""

from __future__ import annotations

import inspect
import math
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.motion.integrate import IntegrationPlan, StepControl, frequency_bounds, integrate
from jaxvib.motion.run import Run
from jaxvib.motion.start import initial_state
from jaxvib.runtime.cache import compiled_anew
from jaxvib.runtime.operations import count_operations
from jaxvib.study.accuracy.cost import largest_by_unit, timed
from jaxvib.study.audit.comparisons import JamComparison, MotionValues, RunComparison, without_excluded_effects
from jaxvib.study.audit.variants import Variant

CHANGES = ("amplitude", "foundation_force", "omega", "fold")
"""Compared quantities, by their names in `EffectRow`."""

_TURNS, _TOLERANCE, _MAX_STEPS = 100, 1e-8, 2**24
"""Length of the timed run in turns of the rotor, its tolerance, and its maximum number of steps."""


class EffectRow(NamedTuple):
    """Changes by one effect of an audit, and its cost.

    **Attributes**

    - `effect`: its name; `present`: True if the scene has the effect, which was removed, False if the effect was added; `tier`
      of the computation
    - changes caused by the effect, relative to the value for the scene, NaN if unknown: `amplitude`, `foundation_force`,
      `omega` of the loads, `fold` (the rotor speed at which the jam ends). `amplitude` is that of the coordinate with the
      largest change. Its change is relative to the largest amplitude with the same unit or, if the machine hardly moves, to a
      hundredth of the unbalance radius of the loads
    - `uncertainty` of these changes
    - cost of the effect (value with the effect minus value without it): `operations` of the equations of motion; `seconds` of a
      run of 100 turns; `compile`: CPU time to trace and compile that run, s; NaN without timings. Small differences of
      times are timing noise
    - `advice`: "needed", "perhaps needed", "negligible" or "cannot tell"; `note`: the reason
    """

    effect: str
    present: bool
    tier: str
    amplitude: float
    foundation_force: float
    omega: float
    fold: float
    uncertainty: float
    operations: int
    seconds: float
    compile: float
    advice: str
    note: str

    @property
    def change(self) -> float:
        """Largest modulus of the relative changes; NaN if all changes are NaN."""
        known_changes = [abs(x) for x in (self.amplitude, self.foundation_force, self.omega, self.fold) if not math.isnan(x)]
        return max(known_changes, default=math.nan)


class RepeatedComparison:
    """Comparison of several scenes that computes the values and times of each scene once.

    **Arguments**: `comparison`: a `JamComparison` or `RunComparison`; `repeats`: number of timings, 0 for none.
    """

    def __init__(self, comparison: JamComparison | RunComparison, repeats: int):
        self.comparison, self.repeats = comparison, repeats
        self._values: dict[tuple[int, bool], tuple[Scene, MotionValues]] = {}
        self._times: dict[int, tuple[Scene, tuple[float, float]]] = {}

    def tier(self, *scenes: Scene) -> str:
        """Return the name of the tier that computes the motion of all these scenes."""
        return "exact orbit" if all(self.comparison.has_exact_orbit(scene) for scene in scenes) else "full"

    def values(self, scene: Scene, tier: str) -> MotionValues:
        """Return the values of the motion of a scene by a tier."""
        exact = tier == "exact orbit"
        if (id(scene), exact) not in self._values:  # the scene is stored too; its id cannot then be used again
            self._values[id(scene), exact] = scene, (self.comparison.exact if exact else self.comparison.full)(scene)
        return self._values[id(scene), exact][1]

    def times(self, scene: Scene) -> tuple[float, float]:
        """Return the times, s, of a run of 100 turns of the rotor, and of tracing and compiling it; NaN without timings."""
        if not self.repeats:
            return math.nan, math.nan
        if id(scene) not in self._times:
            self._times[id(scene)] = scene, _times(scene, self.comparison.state(scene), self.repeats)
        return self._times[id(scene)][1]


def _times(scene: Scene, start: State, repeats: int) -> tuple[float, float]:
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(start)):
        start = initial_state(scene)  # if the jam does not exist, a run from another state takes the same time
    end = jnp.asarray(_TURNS * 2.0 * math.pi / float(scene.drive.speed))
    control = StepControl(jnp.asarray(_TOLERANCE, end.dtype), None, jnp.asarray(_MAX_STEPS, jnp.int32))
    plan = IntegrationPlan(None, control, None, 0, jnp.asarray(20.0, end.dtype), frequency_bounds(scene), _MAX_STEPS)
    numbers, choices = eqx.partition((scene, end, start, plan), eqx.is_array)

    @jax.jit
    def program_of_run(numbers: PyTree) -> Run:
        return eqx.filter(inspect.unwrap(integrate)(*eqx.combine(numbers, choices)), eqx.is_array)

    with compiled_anew():
        begun = time.process_time()  # CPU time, because other processes hardly influence it
        program = program_of_run.lower(numbers).compile()
        compiling = time.process_time() - begun
    _, seconds, _ = timed(lambda: program(numbers).omega, repeats)
    return seconds, compiling


def field_operations(scene: Scene) -> int:
    """Return the number of operations of the traced equations of motion of a scene, `vector_field(scene)(t, state)`.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> heavier = scene.replace(effects=(jv.Gravity(),))
    >>> field_operations(heavier) > field_operations(scene)
    True
    """
    state = eqx.filter_eval_shape(initial_state, scene)
    return count_operations(lambda s, t, y: vector_field(s)(t, y), scene, jnp.zeros(()), state)


def relative_changes(new: MotionValues, old: MotionValues, own: MotionValues, units: tuple[str, ...]) -> dict[str, float]:
    """Return the changes from `old` to `new`, relative to the values `own` of the audited scene, by the names in `CHANGES`.

    **Arguments**: `units` (nd,): unit of each coordinate.
    """
    differences, size = np.asarray(new.amplitude) - np.asarray(old.amplitude), own.magnified * np.asarray(own.amplitude)
    largest = largest_by_unit(size, units)
    known_shares = [float(d / x) for d, x in zip(differences, largest, strict=True) if x > 0.0 and not math.isnan(d)]
    changes = {"amplitude": float(max(known_shares, key=abs)) if known_shares else math.nan}
    for name in CHANGES[1:]:
        before, after, scale = getattr(old, name), getattr(new, name), getattr(own, name)
        scale = own.magnified * scale if name == "foundation_force" else scale
        changes[name] = (after - before) / abs(scale) if scale else math.nan
    return changes


def _size(values: MotionValues) -> float:
    size = values.magnified * max(values.amplitude)
    return size if size > 0.0 else math.nan


def effect_row(repeated: RepeatedComparison, scene: Scene, variant: Variant, accuracy: float) -> EffectRow:
    """Return the row of the effect by which `variant` differs from `scene`. The advice is for the relative `accuracy`."""
    tier = repeated.tier(scene, variant.scene)
    own, other = repeated.values(scene, tier), repeated.values(variant.scene, tier)
    new, old = (own, other) if variant.present else (other, own)
    changes = relative_changes(new, old, own, scene.machine.structure().units)
    sizes = [(len(varied.all_effects), len(without_excluded_effects(varied).all_effects)) for varied in (scene, variant.scene)]
    if sizes[0][0] != sizes[1][0] and sizes[0][1] == sizes[1][1]:
        changes["fold"] = math.nan  # folds are computed without this effect; therefore both folds are equal
    # The uncertainties of both motions, relative to the motion of this scene.
    uncertainty = own.uncertainty + other.uncertainty * _size(other) / _size(own)
    sign = 1 if variant.present else -1
    cost = sign * (field_operations(scene) - field_operations(variant.scene))
    own_times, other_times = repeated.times(scene), repeated.times(variant.scene)
    row = EffectRow(
        variant.name,
        variant.present,
        tier,
        **changes,
        uncertainty=uncertainty,
        operations=cost,
        seconds=sign * (own_times[0] - other_times[0]),
        compile=sign * (own_times[1] - other_times[1]),
        advice="",
        note=variant.note,
    )
    if isinstance(repeated.comparison, JamComparison) and tier == "full" and own.kind != "jammed":
        lost = f"a run from the jam reached another motion ({own.kind})"
        return row._replace(advice="cannot tell", note="; ".join(filter(None, [row.note, lost])))
    return row._replace(**_advice(row, new.kind, old.kind, accuracy))


def _advice(row: EffectRow, new: str, old: str, accuracy: float) -> dict[str, str]:
    """Return `advice` and `note` of a row, for a motion that is `new` with the effect and `old` without it."""
    advice_if_needed = "needed" if row.present or row.note == "as given" else "perhaps needed"
    sentences = [row.note]
    if new != old:
        sentences.append(f"without it: {old}; with it: {new}")
    if new != old and "unsettled" not in (new, old):
        advice = advice_if_needed
    elif math.isnan(row.change) or math.isnan(row.uncertainty):
        advice = "cannot tell"
        sentences.append(f"change unknown: {new}")
    elif row.change - row.uncertainty > accuracy:
        advice = advice_if_needed
    elif row.change + row.uncertainty <= accuracy and new == old:
        advice = "negligible"
    else:
        advice = "cannot tell"
        sentences.append(f"the motion is periodic only to {row.uncertainty:.1e}")
    return {"advice": advice, "note": "; ".join(filter(None, sentences))}
