"""Variants of a scene with one effect added or removed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Carrier, Machine, Mount, Place
from jaxvib.machine.drives.drive import ConstantSpeed, SpinUp
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.files import EFFECTS
from jaxvib.machine.scene import Scene

_DROOP = 0.015
"""Relative decrease of the speed of an induction motor that has twice the required power: half of a usual rated slip of 3 %."""


class Variant(NamedTuple):
    """Variant of the audited scene with one effect added or removed.

    **Attributes**: `name` of the effect; `present`: True if the audited scene has the effect; `scene`: the variant; `note`: the
    values of an added effect or drive, or the drive of the comparison.
    """

    name: str
    present: bool
    scene: Scene
    note: str = ""


class WithoutGyroscopic(Machine):
    """Machine without the gyroscopic coupling of its coordinates."""

    machine: Machine
    kind: str = eqx.field(static=True)

    def __init__(self, machine: Machine):
        self.machine, self.kind = machine, str(machine.kind)

    def carrier(self) -> Carrier:
        """Return the carrier of the machine."""
        return self.machine.carrier()

    def mount(self, at: Place = None) -> Mount:
        """Return the mount of the machine without its gyroscopic matrix."""
        return eqx.tree_at(lambda mount: mount.gyroscopic, self.machine.mount(at), None)

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the rows of the machine."""
        return self.machine.rows_at(place, name)


def present_variants(scene: Scene, until: float | None) -> Iterator[Variant]:
    """Yield variants of the scene without one of its effects, without gyroscopic coupling, and with a drive of unlimited power.

    With unlimited power the rotor speed rises smoothly to the no-load speed of the motor during half the time `until`, s.
    """
    kinds = [effect.kind for effect in scene.all_effects]
    for k, effect in enumerate(scene.all_effects):
        number = f" {kinds[: k + 1].count(effect.kind)}" if kinds.count(effect.kind) > 1 else ""
        rest = (*scene.all_effects[:k], *scene.all_effects[k + 1 :])
        yield Variant(effect.kind + number, True, scene.replace(effects=rest))
    if scene.mounting.gyroscopic is not None:
        machine = WithoutGyroscopic(scene.machine)
        yield Variant("gyroscopic coupling", True, eqx.tree_at(lambda s: s.machine, scene, machine))
    if not scene.drive.ideal and until is not None:
        drive = SpinUp(scene.drive.speed, until / 2.0)
        yield Variant(
            "limited power", True, eqx.tree_at(lambda s: s.drive, scene, drive), "compared with a drive of unlimited power"
        )


def require_absent(scene: Scene, possible: Sequence[Effect]) -> None:
    """**Raises** `InputError` for a possible effect that the scene has already and of which it cannot have a second one."""
    present = {effect.kind for effect in scene.all_effects if not effect.repeatable}
    for k, effect in enumerate(possible):
        if effect.kind in present:
            problem = f"is {effect.kind}, which the scene has already; leave it out"
            raise InputError(f"possible[{k}]", f"{problem}, because an audit removes each effect of the scene")


def possible_variants(scene: Scene, amplitude: Sequence[float], given: Sequence[Effect] | None) -> Iterator[Variant]:
    """Yield variants of the scene with one effect that it lacks and could have.

    The effects are those of `given`; if it is None, those of the package with typical values (`Effect.typical`). For a scene
    with constant rotor speed, a last variant then has a speed that is lower by `_DROOP`, as with a motor.

    **Arguments**: `amplitude` (nd,): amplitudes of the coordinates, m or rad, for the typical values.
    """
    for effect in given or ():
        with_effect = scene.replace(effects=(*scene.all_effects, effect))
        yield Variant(effect.kind, False, with_effect, "as given")
    if given is not None:
        return
    present_kinds = {effect.kind for effect in scene.all_effects}
    for kind, effect in EFFECTS.items():
        if kind in present_kinds:
            continue
        with contextlib.suppress(InputError):  # this machine or these loads cannot have the effect
            typical = effect.typical(scene.machine, scene.loads, scene.drive.speed, jnp.asarray(amplitude))
            if typical is not None:
                with_effect = scene.replace(effects=(*scene.all_effects, typical.effect))
                yield Variant(kind, False, with_effect, typical.note)
    if scene.drive.constant:
        slower = ConstantSpeed(scene.drive.speed * (1.0 - _DROOP))
        note = f"a motor that loses {100.0 * _DROOP:g} % of its speed: induction_motor, dc_motor"
        yield Variant("weak drive", False, eqx.tree_at(lambda s: s.drive, scene, slower), note)
