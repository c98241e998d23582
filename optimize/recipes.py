"""Frequent design tasks, each in one call: a design space, an objective, and demands (constraints)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.units import Number, count
from optimize.design import Design
from optimize.quantities.exciters import force_per_throw, motion_spread, roundness, throw_angle, throw_stroke
from optimize.quantities.jams import amplitude, fold_margin, force_per_amplitude, jam_frequency
from optimize.quantities.machine import support_frequency_squared, total_mass
from optimize.quantities.quantity import Quantity
from optimize.quantities.user_inputs import number_in
from optimize.result import Synthesis
from optimize.space import Bounds, DesignSpace, Source, hold
from optimize.synthesize import synthesize

__all__ = [
    "anti_resonance",
    "antiphase",
    "circular_screen",
    "feeder",
    "lightest_exciter",
    "linear_screen",
    "retune",
    "widest_range",
]

_STARTS = 32
"""Number of starts of designs of screens and feeders, which have few minima."""

_LEAST_ROUNDNESS = 0.9
"""Smallest allowed roundness of the motion of the middle of the deck of a circular screen."""


def _platforms(scene: Scene, least: int) -> Platforms:
    if not isinstance(scene, Scene) or not isinstance(scene.machine, Platforms):
        raise InputError("scene", "needs a machine of platforms for this recipe")
    if scene.machine.mass.shape[0] < least:
        count_text = "1 platform" if scene.machine.mass.shape[0] == 1 else f"{scene.machine.mass.shape[0]} platforms"
        raise InputError("scene", f"has {count_text}; this recipe needs at least {least}")
    return scene.machine


def _spring_bounds(machine: Platforms, range_: float, kinds: tuple[str, ...]) -> dict[str, tuple[Number, Number]]:
    """Return the bounds k/`range_` and k*`range_` of the stiffness k of each spring in the fields `kinds` of the machine."""
    bounds: dict[str, tuple[Number, Number]] = {}
    factor = _factor(range_)
    for kind in kinds:
        for k, value in enumerate(np.asarray(getattr(machine, kind)).tolist()):
            if value > 0.0:
                bounds[f"machine.{kind}[{k}]"] = (value / factor, value * factor)
    if not bounds:
        raise InputError("scene", "has no springs that can be changed")
    return bounds


def _positive(value: Number, unit: str, name: str) -> float:
    """Return a number in `unit`. **Raises** `InputError` if it is not greater than 0."""
    positive = number_in(value, unit, name)
    if not positive > 0.0:
        raise InputError(name, f"is {quoted(value)}; it must be greater than 0")
    return positive


def _stroke(stroke: Number | None) -> float | None:
    return None if stroke is None else _positive(stroke, "m", "stroke")


def _throw_angle(angle: Number) -> float:
    """Return the angle of throw, rad.

    **Raises** `InputError` for 0, and for a right angle or more. (A line has no direction: a larger angle describes the same
    line as that angle minus half a turn.)
    """
    radians = number_in(angle, "rad", "angle")
    if not 0.0 < abs(radians) < np.pi / 2.0:
        bounds = "between 0 and 90 deg, or between -90 deg and 0"
        raise InputError("angle", f"is {quoted(angle)}; it must be {bounds}; a number without a unit is in rad")
    return radians


def _factor(range_: Number) -> float:
    """Return the factor by which springs may differ. **Raises** `InputError` if it is not greater than 1."""
    factor = number_in(range_, "", "range_")
    if not factor > 1.0:
        raise InputError("range_", f"is {quoted(range_)}; it must be greater than 1, such as 1.5")
    return factor


def antiphase(scene: Scene, *, mode: int = 3, range_: float = 5.0) -> Design:
    """Return the design task for an antiphase machine of two masses: least foundation force divided by the amplitude of the
    relative motion of the platforms.

    The frequency of the jam and the sum of the squared support frequencies (k_i/M_i over the platforms) keep their values.

    **Arguments**: `scene`: platforms with loads; `mode`: number of the jam mode (default 3); `range_`: largest factor by which
    each spring may become stiffer or softer; typical: 2 to 10 (default 5).

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine with fewer than two
    platforms.

    >>> import jaxvib as jv
    >>> from optimize.recipes import antiphase
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> scene = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))
    >>> antiphase(scene).space.size
    3

    Source: the antiphase paper, section 5.1.
    """
    machine = _platforms(scene, 2)
    free = _spring_bounds(machine, range_, ("stiffness", "link_stiffness"))
    space = DesignSpace(scene, free, [hold(jam_frequency(mode=mode)), hold(support_frequency_squared())])
    return Design(space, force_per_amplitude(mode=mode))


def anti_resonance(scene: Scene, *, mode: int, range_: float = 5.0) -> Design:
    """Return the design task for an anti-resonance machine of three masses: least middle amplitude per outer amplitude.

    The springs of the links are free, and the frequency of the jam keeps its value. The outer amplitude is the amplitude of the
    displacement of platform 1 relative to platform 3. Without damping and without a link 1-3, the middle platform (2) is at
    rest in a natural mode of the frequency w if (k1 + k12)/M1 = (k3 + k23)/M3 = w^2. k1 and k3 are the stiffnesses of the
    supports.

    **Arguments**: `scene`: at least three platforms with loads; `mode`: number of the jam mode; `range_`: as for `antiphase`.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine with fewer than three
    platforms.

    Source: Filimonikhin et al., cited in the antiphase paper as [21].
    """
    machine = _platforms(scene, 3)
    free = _spring_bounds(machine, range_, ("link_stiffness",))
    space = DesignSpace(scene, free, [hold(jam_frequency(mode=mode))])
    ratio = amplitude(mode=mode, of=2) / amplitude(mode=mode, of=(1, 3))
    return Design(space, ratio.named("middle amplitude per outer amplitude"))


def retune(scene: Scene, objective: Quantity, *, range_: float = 3.0, starts: int = 16) -> list[tuple[str, Synthesis]]:
    """Determine which spring of an existing machine should be exchanged.

    For each spring, a search finds the best machine that differs in this spring only.

    **Arguments**: `scene`: platforms with loads; `objective`: the quantity to minimize; `range_`: largest factor by which a
    spring may become stiffer or softer; typical: 2 to 10 (default 3); `starts`: number of starts of each search; typical: 16
    (the default).

    **Returns** the springs' names with their results, the best first. **Raises** `InputError` for a machine without platforms,
    and the errors of `synthesize`.
    """
    machine = _platforms(scene, 1)
    free = _spring_bounds(machine, range_, ("stiffness", "link_stiffness"))
    results = []
    for name, bounds in free.items():
        best = synthesize(DesignSpace(scene, {name: bounds}), objective, starts=starts, verify=False)
        results.append((name, best))
    return sorted(results, key=lambda result: float(result[1].values.min()))


def lightest_exciter(scene: Scene, least: Number, *, mode: int, of: int | tuple[int, int] | None = None) -> Design:
    """Return the design task for the lightest loads that cause at least the amplitude `least` of a platform.

    The mass of the loads is free, from one tenth to ten times its value; the radius of the track keeps its value.

    **Arguments**: `scene`: platforms with equal loads; `least`: amplitude, m zero to peak or text, typical: 0.5 to 10 mm;
    `mode` and `of`: as for `amplitude`.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine without platforms,
    and for loads of different masses.
    """
    _platforms(scene, 1)
    mass = np.asarray(scene.loads.mass)
    if mass.ndim:
        raise InputError("loads.mass", "differs from load to load; this recipe needs equal loads")
    amplitude_of_mode = amplitude(mode=mode, of=of)
    amplitude_of_mode(scene)  # raises an error for a mode or a platform that the machine does not have
    space = DesignSpace(scene, {"loads.mass": (float(mass) / 10.0, float(mass) * 10.0)})
    _positive(least, "m", "least")
    return Design(space, total_mass(), subject_to=(amplitude_of_mode > least,))


def widest_range(scene: Scene, *, mode: int, keep: float = 0.9, of: int | tuple[int, int] | None = None) -> Design:
    """Return the design task for springs with which the rotor speed is farthest from the folds of a jam mode.

    The jam mode then exists over a wide range of rotor speeds on both sides of the present one. The distance of the rotor speed
    from the nearer fold, above or below, is maximized. The stiffness of each spring may be changed by a factor of up to 3.

    **Arguments**: `scene`: platforms with loads; `mode` and `of`: as for `amplitude`; `keep`: smallest allowed amplitude,
    relative to the present one; typical: 0.7 to 1 (default 0.9).

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` if `keep` is not greater than 0 and
    at most 1. A machine without platforms raises it too, and a jam mode that does not exist at the rotor speed of the scene.
    """
    count(mode, "mode")
    share = number_in(keep, "", "keep")
    if not 0.0 < share <= 1.0:
        raise InputError("keep", f"is {quoted(keep)}; it must be greater than 0 and at most 1")
    machine = _platforms(scene, 1)
    space = DesignSpace(scene, _spring_bounds(machine, 3.0, ("stiffness", "link_stiffness")))
    amplitude_of_mode = amplitude(mode=mode, of=of)
    present = float(amplitude_of_mode(scene))
    if not present > 0.0:
        raise InputError("mode", f"is {mode}; this jam mode does not exist at the rotor speed of the scene")
    return Design(space, -fold_margin(mode=mode), subject_to=(amplitude_of_mode > share * present,))


def linear_screen(
    scene: Scene,
    *,
    points: Sequence[Sequence[Number]],
    angle: Number = "45 deg",
    stroke: Number | None = None,
    reach: Number = 0.3,
) -> Design:
    """Return the design task for a linear screen: all points of the deck have the same motion, along a line of given angle.

    The objective is the spread of the motions over the deck (`motion_spread`). The motion of the mean of the `points` has the
    given throw angle and stroke. The positions of the exciters and their unbalances are free. The unbalances keep their ratios;
    they may change by a factor of up to 3.

    **Arguments**

    - `scene`: a body in a plane with at least two exciters; typical: two equal motors that turn in opposite directions
    - `points` of the deck, (x, y), m or text, from the centre of mass; typical: feed end and discharge end
    - `angle` of throw from the horizontal, rad or text; typical: "40 deg" to "50 deg" (default "45 deg"). For a deck that
      descends in the direction of x, give the throw angle relative to the deck minus the angle of descent
    - `stroke`, m peak to peak; typical: 6 to 12 mm; default: that of the scene
    - `reach`: distance by which each coordinate of an exciter may change, m; typical: 0.1 to 0.5 (default 0.3)

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine of another kind.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import SCREENS
    >>> from optimize.recipes import linear_screen
    >>> linear_screen(jv.scene_from_toml(SCREENS["linear_screen"]), points=[(-1.5, 0.1), (1.5, 0.1)]).space.size
    5
    """
    free, ties = _exciter_bounds(scene, 2, reach)
    middle = _middle(points)
    held = [hold(throw_angle(at=middle), _throw_angle(angle)), hold(throw_stroke(at=middle), _stroke(stroke))]
    return Design(DesignSpace(scene, free, held, ties=ties), motion_spread(points), {"starts": _STARTS})


def circular_screen(
    scene: Scene, *, points: Sequence[Sequence[Number]], stroke: Number | None = None, reach: Number = 0.3
) -> Design:
    """Return the design task for a circular screen: all points of the deck have the same motion, on a circle.

    The objective is the spread of the motions over the deck (`motion_spread`). The motion of the mean of the `points` has the
    given stroke, and its roundness must be at least 0.9. The free parameters are those of `linear_screen`.

    **Arguments**: `scene`: a body in a plane, typical: with one exciter; `points`, `stroke`, `reach` as for `linear_screen`.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine of another kind.
    """
    free, ties = _exciter_bounds(scene, 1, reach)
    middle = _middle(points)
    space = DesignSpace(scene, free, [hold(throw_stroke(at=middle), _stroke(stroke))], ties=ties)
    return Design(space, motion_spread(points), {"starts": _STARTS}, (roundness(at=middle) > _LEAST_ROUNDNESS,))


def feeder(
    scene: Scene,
    *,
    points: Sequence[Sequence[Number]],
    angle: Number = "25 deg",
    stroke: Number | None = None,
    reach: Number = 0.2,
    range_: float = 1.5,
    spread: float = 0.1,
) -> Design:
    """Return the design task for a feeder: least foundation force per amplitude of the trough, for a given throw angle and
    stroke.

    The motion of the mean of the `points` has the given throw angle and stroke. The free parameters are those of
    `linear_screen` and the stiffness of the supports.

    **Arguments**

    - `scene`, `points`, `stroke`, `reach` as for `linear_screen`
    - `angle` of throw from the horizontal, rad or text; typical: "20 deg" to "35 deg" (default "25 deg")
    - `range_`: factor by which the stiffness of a support may differ; typical: 1.2 to 2 (default 1.5)
    - `spread`: largest spread of the motions over the points (`motion_spread`); typical: 0.05 to 0.2 (default 0.1)

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine of another kind.
    """
    free, ties = _exciter_bounds(scene, 2, reach)
    factor, largest_spread = _factor(range_), _positive(spread, "", "spread")
    for k, support in enumerate(scene.machine.supports):  # pyright: ignore[reportAttributeAccessIssue]
        for j, value in enumerate(np.asarray(support.stiffness).tolist()):
            if value > 0.0:
                free[f"machine.supports[{k}].stiffness[{j}]"] = (value / factor, value * factor)
    middle = _middle(points)
    held = [hold(throw_angle(at=middle), _throw_angle(angle)), hold(throw_stroke(at=middle), _stroke(stroke))]
    space = DesignSpace(scene, free, held, ties=ties)
    return Design(space, force_per_throw(at=middle), {"starts": _STARTS}, (motion_spread(points) < largest_spread,))


def _exciter_bounds(scene: Scene, least: int, reach: Number) -> tuple[dict[str, Bounds], dict[str, Source]]:
    """Return bounds of the positions of all exciters and of the first unbalance, and ties of the other unbalances to it."""
    if not isinstance(scene, Scene) or scene.machine.places != "plane":
        raise InputError("scene", "needs a body in a plane for this recipe, for example plane_body(...)")
    if len(scene.exciters) < least:
        raise InputError("scene", f"has {len(scene.exciters)} exciter; this recipe needs at least {least}")
    free: dict[str, Bounds] = {}
    distance = _positive(reach, "m", "reach")
    for k, exciter in enumerate(scene.exciters):
        if exciter.unbalance is None or exciter.position is None:
            raise InputError(f"scene.exciters[{k}]", "needs an unbalance and a position `at` for this recipe")
        for j, value in enumerate(np.asarray(exciter.position).tolist()):
            free[f"exciters[{k}].at[{j}]"] = (value - distance, value + distance)
    first = float(np.asarray(scene.exciters[0].unbalance))
    free["exciters[0].unbalance"] = (first / 3.0, 3.0 * first)
    ties: dict[str, Source] = {
        f"exciters[{k}].unbalance": ("exciters[0].unbalance", "keep") for k in range(1, len(scene.exciters))
    }
    return free, ties


def _middle(points: Sequence[Sequence[Number]]) -> tuple[float, float]:
    """Return the mean (x, y), m, of the points of a deck."""
    is_list = isinstance(points, (list, tuple)) and len(points) > 1
    if not is_list or not all(isinstance(p, (list, tuple)) and len(p) == 2 for p in points):
        raise InputError("points", f"is {quoted(points)}; it must be a list of at least two points (x, y)")
    places = np.array([[number_in(v, "m", f"points[{k}]") for v in p] for k, p in enumerate(points)])
    if not np.any(np.ptp(places, axis=0)):
        raise InputError("points", f"is {quoted(points)}, one point several times; give at least two different points")
    x, y = np.mean(places, axis=0).tolist()
    return x, y
