"""Frequent design tasks, each in one call: a design space, an objective, and demands (constraints)."""

from __future__ import annotations

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.units import Number, count
from optimize.files import Design
from optimize.quantities.jams import amplitude, fold_margin, force_per_amplitude, jam_frequency
from optimize.quantities.machine import support_frequency_squared, total_mass
from optimize.quantities.quantity import Quantity
from optimize.result import Synthesis
from optimize.space import DesignSpace, hold
from optimize.synthesize import synthesize


def _platforms(scene: Scene, least: int) -> Platforms:
    if not isinstance(scene, Scene) or not isinstance(scene.machine, Platforms):
        raise InputError("scene", "needs a machine of platforms for this recipe")
    if scene.machine.mass.shape[0] < least:
        raise InputError("scene", f"has {scene.machine.mass.shape[0]} platforms; this recipe needs {least}")
    return scene.machine


def _springs(machine: Platforms, range_: float, kinds: tuple[str, ...]) -> dict[str, tuple[Number, Number]]:
    """Return the bounds k/`range_` and k*`range_` of the stiffness k of each spring of these kinds."""
    found: dict[str, tuple[Number, Number]] = {}
    for kind in kinds:
        for k, value in enumerate(np.asarray(getattr(machine, kind))):
            if value > 0.0:
                found[f"machine.{kind}[{k}]"] = (float(value / range_), float(value * range_))
    if not found:
        raise InputError("scene", "has no springs that can be changed")
    return found


def antiphase(scene: Scene, *, mode: int = 3, range_: float = 5.0) -> Design:
    """Return the design task for an antiphase machine of two masses: least foundation force per relative amplitude.

    The frequency of the jam and the stiffness budget of the supports (the sum of k_i/M_i over the platforms) keep their values.
    Each spring may be changed by a factor of up to `range_`.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine of fewer platforms.

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
    free = _springs(machine, range_, ("stiffness", "link_stiffness"))
    space = DesignSpace(scene, free, [hold(jam_frequency(mode=mode)), hold(support_frequency_squared())])
    return Design(space, force_per_amplitude(mode=mode))


def anti_resonance(scene: Scene, *, mode: int, range_: float = 5.0) -> Design:
    """Return the design task for an anti-resonance machine of three masses: least middle amplitude per outer amplitude.

    The springs of the links are free, and the frequency of the jam keeps its value. Without damping the middle platform (2) is
    at rest if k12/M1 = k23/M3 = w^2; the outer amplitude is the amplitude of the displacement of platform 1 relative to
    platform 3.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` for a machine of fewer platforms.

    Source: Filimonikhin et al., cited in the antiphase paper as [21].
    """
    machine = _platforms(scene, 3)
    free = _springs(machine, range_, ("link_stiffness",))
    space = DesignSpace(scene, free, [hold(jam_frequency(mode=mode))])
    ratio = amplitude(mode=mode, of=2) / amplitude(mode=mode, of=(1, 3))
    return Design(space, ratio.named("middle amplitude per outer amplitude"))


def retune(scene: Scene, objective: Quantity, *, range_: float = 3.0, starts: int = 16) -> list[tuple[str, Synthesis]]:
    """Find out which spring of an existing machine should be exchanged.

    For each spring, search for the best machine that differs in this spring only.

    **Arguments**: `objective`: the quantity to minimize; `range_`: the factor by which a spring may differ; `starts` of each
    search.

    **Returns** the springs' names with their results, the best first. **Raises** as `synthesize`.
    """
    machine = _platforms(scene, 1)
    free = _springs(machine, range_, ("stiffness", "link_stiffness"))
    found = []
    for name, bounds in free.items():
        best = synthesize(DesignSpace(scene, {name: bounds}), objective, starts=starts, verify=False)
        found.append((name, best))
    return sorted(found, key=lambda each: float(each[1].values.min()))


def lightest_exciter(scene: Scene, least: Number, *, mode: int, of: int | tuple[int, int] | None = None) -> Design:
    """Return the design task: the lightest loads that shake a platform by at least the amplitude `least` (m or text).

    The mass of the loads is free, from one tenth to ten times its value; the radius of the track keeps its value.

    **Returns** `Design`, not yet searched; `design.run()` searches.
    """
    machine = _platforms(scene, 1)
    del machine
    mass = np.asarray(scene.loads.mass)
    if mass.ndim:
        raise InputError("loads.mass", "differs from load to load; this recipe needs equal loads")
    space = DesignSpace(scene, {"loads.mass": (float(mass) / 10.0, float(mass) * 10.0)})
    return Design(space, total_mass(), subject_to=(amplitude(mode=mode, of=of) > least,))


def widest_range(scene: Scene, *, mode: int, keep: float = 0.9, of: int | tuple[int, int] | None = None) -> Design:
    """Return the design task: springs for which a jam mode exists over the widest range of rotor speeds.

    The range includes the present rotor speed. The objective is the distance of the rotor speed from the nearer fold, above or
    below. The amplitude must be at least `keep` times the present amplitude.

    **Returns** `Design`, not yet searched; `design.run()` searches. **Raises** `InputError` if `keep` is not between 0 and 1.
    """
    count(mode, "mode")
    if not 0.0 < keep <= 1.0:
        raise InputError("keep", f"is {quoted(keep)}; it must be greater than 0 and at most 1")
    machine = _platforms(scene, 1)
    space = DesignSpace(scene, _springs(machine, 3.0, ("stiffness", "link_stiffness")))
    amplitude_of_mode = amplitude(mode=mode, of=of)
    return Design(space, -fold_margin(mode=mode), subject_to=(amplitude_of_mode > keep * float(amplitude_of_mode(scene)),))
