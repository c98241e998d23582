"""A scene against the same one with an effect more or less."""

from __future__ import annotations

import inspect
import math
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.motion.integrate import StepControl, integrate
from jaxvib.motion.run import Run
from jaxvib.motion.start import initial_state
from jaxvib.runtime.cache import compiled_anew
from jaxvib.runtime.operations import operations
from jaxvib.study.accuracy.cost import timed
from jaxvib.study.audit.questions import JamQuestion, RunQuestion, Values, admitted
from jaxvib.study.audit.variants import Variant

__all__ = ["CHANGES", "EffectRow", "RepeatedQuestion", "effect_row", "field_operations", "relative_changes"]

CHANGES = ("amplitude", "foundation_force", "omega", "fold")
"""The quantities whose changes an audit tells, by their names in `EffectRow`."""

_TURNS, _TOLERANCE, _MOST_STEPS = 100, 1e-8, 2**24
"""Turns of the rotor of the run whose time is taken, its tolerance, and the most steps that it may make."""


class EffectRow(NamedTuple):
    """One effect of an audit.

    **Attributes**

    - `name` of the effect, `present`: True if the scene has it (it was taken out), False if not (it was put in), `tier` of the
      computation
    - changes by the effect, relative to the scene's own value: `amplitude` (of the coordinate that changes most, in units of
      the largest of its kind, and in a machine that hardly moves of a hundredth of the loads' unbalance radius),
      `foundation_force`, `omega` of the loads, `fold` (the rotor speed at which the jam ends); NaN if unknown
    - `uncertainty` of these changes
    - cost of the effect, with it less without: `operations` of the equations of motion; `seconds` of a run of 100 turns;
      `compile`, seconds of processor to trace and compile that run. NaN if no time was taken. Small differences of times are
      the clock's noise
    - `advice`: "needed", "perhaps needed", "negligible", "cannot tell"; `says`: the reason, with its numbers
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
    says: str

    @property
    def change(self) -> float:
        """The largest of the changes, relative, without its sign; NaN where none is known."""
        known = [abs(x) for x in (self.amplitude, self.foundation_force, self.omega, self.fold) if not math.isnan(x)]
        return max(known, default=math.nan)


class RepeatedQuestion:
    """A question and its answers, each computed once.

    **Arguments**: `question` a `JamQuestion` or `RunQuestion`; `repeats` of timings, 0 for none.
    """

    def __init__(self, question: JamQuestion | RunQuestion, repeats: int):
        self.question, self.repeats = question, repeats
        self._known: dict[tuple[int, bool], tuple[Scene, Values]] = {}
        self._times: dict[int, tuple[Scene, tuple[float, float]]] = {}

    def tier(self, *scenes: Scene) -> str:
        """The tier that answers for all these scenes."""
        return "exact orbit" if all(self.question.can(scene) for scene in scenes) else "full"

    def values(self, scene: Scene, tier: str) -> Values:
        """The scene's motion by a tier."""
        exact = tier == "exact orbit"
        if (id(scene), exact) not in self._known:  # kept with its scene, so that no other scene gets its place in memory
            self._known[id(scene), exact] = scene, (self.question.exact if exact else self.question.full)(scene)
        return self._known[id(scene), exact][1]

    def times(self, scene: Scene) -> tuple[float, float]:
        """Seconds of a run of 100 turns of the rotor, and what tracing and compiling it took; NaN where none are asked for."""
        if not self.repeats:
            return math.nan, math.nan
        if id(scene) not in self._times:
            self._times[id(scene)] = scene, _times(scene, self.question.state(scene), self.repeats)
        return self._times[id(scene)][1]


def _times(scene: Scene, start: State, repeats: int) -> tuple[float, float]:
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(start)):
        start = initial_state(scene)  # there is no such jam: a run takes its time all the same
    end = jnp.asarray(_TURNS * 2.0 * math.pi / float(scene.drive.speed))
    control = StepControl(jnp.asarray(_TOLERANCE, end.dtype), None, jnp.asarray(_MOST_STEPS, jnp.int32))
    arguments = (scene, end, start, control, jnp.asarray(20.0, end.dtype))

    @jax.jit
    def anew(scene: Scene, end: Array, start: State, control: StepControl, turns: Array) -> Run:
        run = inspect.unwrap(integrate)(scene, end, start, None, control, None, 0, turns, _MOST_STEPS, None)
        return eqx.filter(run, eqx.is_array)

    with compiled_anew():
        begun = time.process_time()  # which others that compute beside do not change
        program = anew.lower(*arguments).compile()
        compiling = time.process_time() - begun
    _, seconds, _ = timed(lambda: program(*arguments).omega, repeats)
    return seconds, compiling


def field_operations(scene: Scene) -> int:
    """Operations of the traced equations of motion of a scene, `vector_field(scene)(t, state)`.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> heavier = jv.Scene(scene.machine, scene.loads, scene.drive, (jv.Gravity(),))
    >>> field_operations(heavier) > field_operations(scene)
    True
    """
    state = eqx.filter_eval_shape(initial_state, scene)
    return operations(lambda s, t, y: vector_field(s)(t, y), scene, jnp.zeros(()), state)


def relative_changes(new: Values, old: Values, own: Values, units: tuple[str, ...]) -> dict[str, float]:
    """Changes from `old` to `new`, relative to the values `own`, by the names in `CHANGES`; see `EffectRow`."""
    moved, size = np.asarray(new.amplitude) - np.asarray(old.amplitude), own.magnified * np.asarray(own.amplitude)
    largest = {unit: max(x for x, u in zip(size, units, strict=True) if u == unit) for unit in units}
    shares = [float(d) / largest[u] if largest[u] > 0.0 else math.nan for d, u in zip(moved, units, strict=True)]
    known = [x for x in shares if not math.isnan(x)]
    found = {"amplitude": float(max(known, key=abs)) if known else math.nan}
    for name in CHANGES[1:]:
        before, after, scale = getattr(old, name), getattr(new, name), getattr(own, name)
        scale = own.magnified * scale if name == "foundation_force" else scale
        found[name] = (after - before) / abs(scale) if scale else math.nan
    return found


def _size(values: Values) -> float:
    size = values.magnified * max(values.amplitude)
    return size if size > 0.0 else math.nan


def effect_row(ask: RepeatedQuestion, scene: Scene, variant: Variant, accuracy: float) -> EffectRow:
    """The row of what `variant` has more or less than `scene`, judged at the relative `accuracy`."""
    tier = ask.tier(scene, variant.scene)
    own, other = ask.values(scene, tier), ask.values(variant.scene, tier)
    new, old = (own, other) if variant.present else (other, own)
    changes = relative_changes(new, old, own, scene.machine.structure().units)
    sizes = [(len(each.effects), len(admitted(each).effects)) for each in (scene, variant.scene)]
    if sizes[0][0] != sizes[1][0] and sizes[0][1] == sizes[1][1]:
        changes["fold"] = math.nan  # theories of jams leave the effect out of both
    # The other one's, too, relative to this scene's own motion.
    uncertainty = own.uncertainty + other.uncertainty * _size(other) / _size(own)
    sign = 1 if variant.present else -1
    cost = sign * (field_operations(scene) - field_operations(variant.scene))
    ours, theirs = ask.times(scene), ask.times(variant.scene)
    row = EffectRow(
        variant.name,
        variant.present,
        tier,
        **changes,
        uncertainty=uncertainty,
        operations=cost,
        seconds=sign * (ours[0] - theirs[0]),
        compile=sign * (ours[1] - theirs[1]),
        advice="",
        says=variant.says,
    )
    if isinstance(ask.question, JamQuestion) and tier == "full" and own.kind != "jammed":
        lost = f"a run from the jam came to another motion ({own.kind})"
        return row._replace(advice="cannot tell", says="; ".join(filter(None, [row.says, lost])))
    return row._replace(**_advice(row, new.kind, old.kind, accuracy))


def _advice(row: EffectRow, new: str, old: str, accuracy: float) -> dict[str, str]:
    """`advice` and `says` of a row, where the motion is `new` with the effect and `old` without it."""
    advice_if_needed = "needed" if row.present or row.says == "as given" else "perhaps needed"
    sentences = [row.says]
    if new != old:
        sentences.append(f"without it: {old}; with it: {new}")
    if new != old and "unsettled" not in (new, old):
        advice = advice_if_needed
    elif math.isnan(row.change) or math.isnan(row.uncertainty):
        advice = "cannot tell"
        sentences.append(f"no change is known: {new}")
    elif row.change - row.uncertainty > accuracy:
        advice = advice_if_needed
    elif row.change + row.uncertainty <= accuracy and new == old:
        advice = "negligible"
    else:
        advice = "cannot tell"
        sentences.append(f"the motion repeats to {row.uncertainty:.1e} only")
    return {"advice": advice, "says": "; ".join(filter(None, sentences))}
