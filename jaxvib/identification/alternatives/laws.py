"""Laws of friction that explain records better than those of the scene.

After a fit that is patterned, a law of friction that the scene lacks is added, and the fit is continued with its coefficient as
a further unknown. In a jam, the linear drag follows the rotor speed, whereas the speed of the loads hardly changes. Two laws
therefore differ from the linear drag and from each other: friction against the rotor pulls the loads forward by a nearly
constant torque, and the drag of the air at rest pulls them back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import quoted
from jaxvib.identification.alternatives.evidence import MIN_STANDARD_ERRORS, explains_better
from jaxvib.identification.alternatives.support_friction import likely_friction
from jaxvib.identification.checks import resembles
from jaxvib.identification.directions import information_of
from jaxvib.identification.fit import Fitted, fit_from
from jaxvib.identification.problem import MOTIONS, build_problem, is_nonlinear
from jaxvib.identification.records.decimation import MIN_SAMPLES
from jaxvib.identification.run import MeasuredRun
from jaxvib.identification.supports.start import with_first_states
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.effects.rolling import RollingFriction
from jaxvib.machine.effects.terms import ContactFriction, Coordinates, LoadResistance, Term
from jaxvib.machine.loads import CircularLoads, Loads
from jaxvib.machine.numbers import unit
from jaxvib.machine.scene import Scene
from jaxvib.units import Number

_MAX_EQUAL_RATIO = 1.01
"""Largest ratio of the residuals with two laws at which the records do not distinguish them."""

_TORQUE_SHARE = 0.02
"""First value of the torque of another law, relative to that of the drag."""

_RELATIVE_RADIUS = 0.1
"""Radius of a ball, or diameter of a bearing, relative to the radius of the circle, for loads that do not state this size.
Only the ratio of the coefficient to the radius, or the product of the coefficient and the diameter, has an influence."""


class AirDrag(Effect):
    """Drag of the air at rest on each load: torque -c |phi'| phi', c = `drag`, N m s^2."""

    drag: Array = eqx.field(metadata=unit("N m s^2", low=0.0, words="drag of the air"))
    kind: str = eqx.field(static=True, default="air_drag", kw_only=True)

    def terms(self) -> tuple[Term, ...]:
        """Return the torque of the drag."""
        return (LoadResistance(self.resistance, is_smooth=True),)

    def resistance(self, loads: Loads, u: Coordinates, rate: Coordinates) -> Coordinates:
        """Return -c |phi'| phi'."""
        return (-self.drag * jnp.abs(rate[0]) * rate[0],)


class _Law(NamedTuple):
    """Law of friction: its `words`; the `remedy`, which adds it to a scene; the `scene` with the law; `name` of its
    coefficient."""

    words: str
    remedy: str
    scene: Scene
    name: str


def law_notes(
    fitted: Fitted, scene: Scene, runs: Sequence[MeasuredRun], unknown: Sequence[str], known: Mapping[str, Number]
) -> list[str]:
    """Return a sentence about the law of friction with which the machine fits the records clearly better; an empty list without
    such a law.

    **Arguments**: `fitted`: a patterned fit; the fitted `scene`; the other arguments of `identify`.
    """
    names = [number.name for number in fitted.problem.unknowns.numbers]
    if not resembles(fitted) or any("drive." in name for name in names):
        return []
    better: list[tuple[_Law, float]] = []
    for law in (*_laws_of_loads(fitted, scene), *_laws_of_supports(fitted, scene, runs)):
        problem = build_problem(law.scene, runs, [*unknown, law.name], known)
        linear = fitted.linear if is_nonlinear(scene) else with_first_states(fitted.problem, fitted.x, fitted.linear)
        of_sensors = fitted.x[len(names) : fitted.x.size - fitted.problem.unknowns.errors]
        x = np.concatenate([np.zeros(len(problem.unknowns.numbers)), of_sensors])
        angles, load_spread = fitted.problem.angles, fitted.problem.load_spread
        after = fit_from(problem._replace(linear=linear, angles=angles, load_spread=load_spread), [x])
        residuals = _noise_ratio(fitted, after)
        if _is_clear(after, law.name, residuals):
            better.append((law, residuals))
    if not better:
        return []
    best = min(residuals for _, residuals in better)
    named = [law for law, residuals in better if residuals <= _MAX_EQUAL_RATIO * best]
    words, remedies = ", or with ".join(law.words for law in named), "; or ".join(law.remedy for law in named)
    return [f"the model fits clearly better with {words}: the residuals are {best:.2g} times those of this fit; {remedies}"]


def _noise_ratio(before: Fitted, after: Fitted) -> float:
    """Return the geometric mean over all channels of the ratios of the residuals of two fits."""
    pairs = zip(after.noise, before.noise, strict=True)
    return math.exp(float(np.mean(np.concatenate([np.log(new / old) for new, old in pairs]))))


def _is_clear(after: Fitted, name: str, residuals: float) -> bool:
    """Return True if the law with the coefficient `name` is needed: the coefficient is clearly above 0, and the fit with it is
    preferred."""
    if not resembles(after):
        return False
    information = information_of(after)
    k = information.names.index(name)
    is_positive = information.determined[k] and not information.vanished[k]
    if not is_positive or MIN_STANDARD_ERRORS * math.sqrt(information.covariance[k, k]) > 1.0:
        return False
    return explains_better(after, information, residuals)


def _laws_of_loads(fitted: Fitted, scene: Scene) -> Iterator[_Law]:
    """Yield the laws of friction that jammed loads of unknown linear drag lack."""
    exciter, names = scene.exciters[0], [number.name for number in fitted.problem.unknowns.numbers]
    loads = exciter.loads
    if not isinstance(loads, CircularLoads) or not any(name.startswith("loads.drag") for name in names):
        return
    speed, turn = np.median(np.abs(np.gradient(fitted.problem.angles[0], fitted.problem.times[0], axis=0)), axis=0)
    mass, radius, drag = (float(np.mean(np.asarray(each))) for each in (loads.mass, loads.radius, loads.drag))
    torque = _TORQUE_SHARE * drag * radius**2 * (speed - turn)
    lever, size = torque / (mass * radius * turn**2), _RELATIVE_RADIUS * radius
    terms = [type(term) for effect in exciter.effects for term in effect.terms()]
    if ContactFriction not in terms and loads.has_bearing:
        friction = DryFriction(2.0 * lever / size, diameter=size)
        yield _law_of_loads(scene, loads, friction, "coefficient", "dry friction in the bearings of the loads", _ADVICE)
    if ContactFriction not in terms and not loads.has_bearing:
        size = size if loads.ball_radius is None else float(loads.ball_radius)
        sized = eqx.tree_at(lambda loads: loads.ball_radius, loads, jnp.asarray(size), is_leaf=lambda x: x is None)
        friction, advice = RollingFriction(lever * size / radius), _ADVICE
        if loads.ball_radius is None:
            advice = f"give the loads a ball_radius, {advice}"
        yield _law_of_loads(scene, sized, friction, "coefficient", "rolling friction of the loads", advice)
    if LoadResistance not in terms:
        words, effect = (
            "a drag of the air, proportional to the squared speed of the loads",
            AirDrag(jnp.asarray(torque / turn**2)),
        )
        yield _law_of_loads(scene, loads, effect, "drag", words, "add an Effect with this torque to the scene")


_ADVICE = "add {effect} to the scene, and {name} to `unknown`"


def _law_of_loads(scene: Scene, loads: Loads, effect: Effect, coefficient: str, words: str, advice: str) -> _Law:
    """Return the law that an `effect` adds to the `loads`; its unknown is `coefficient`."""
    exciter, name = scene.exciters[0], f"effects.{effect.kind}.{coefficient}"
    with_law = exciter.with_parts(loads, exciter.drive, (*exciter.effects, effect))
    other = Scene(scene.machine, exciters=[with_law], effects=scene.effects)
    return _Law(words, advice.format(effect=type(effect).__name__, name=quoted(name)), other, name)


def _laws_of_supports(fitted: Fitted, scene: Scene, runs: Sequence[MeasuredRun]) -> Iterator[_Law]:
    """Yield dry friction at the support or link of a linear machine where it explains the most of the residuals.

    Long runs are left out: their rate is reduced for a linear machine, but not for one with friction.
    """
    samples = max(run.times[channel.name].size for run in runs for channel in run.of_kind(*MOTIONS))
    if is_nonlinear(scene) or len(scene.exciters) > 1 or samples >= MIN_SAMPLES:
        return
    friction = likely_friction(fitted, scene)
    if friction is not None:
        place = f"platform={friction.platform}" + ("" if friction.to is None else f", to={friction.to}")
        name = f"effects.{friction.kind}[0].force"
        advice = f"add FrictionSupport({float(friction.force):.2g}, {place}) to the scene, and {quoted(name)} to `unknown`"
        other = Scene(scene.machine, exciters=scene.exciters, effects=(*scene.effects, friction))
        yield _Law(f"dry friction at {place.replace('=', ' ')}", advice, other, name)
