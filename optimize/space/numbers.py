"""The numbers of a scene by name: where they stand, their units, what a designer calls them."""

from __future__ import annotations

import dataclasses
import re
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.files import suggest_name
from jaxvib.machine.scene import Scene
from jaxvib.units import FIELD_UNITS, Number, number

__all__ = ["Place", "changed", "names_of", "places_of", "present_places", "set_present", "shown_unit", "value_of"]

_EFFECT_UNITS = {"static_imbalance.moment": "kg m", "moment_imbalance.moment": "kg m^2"}
"""Units of the numbers of effects that may be named."""

_POSITIVE = ("mass", "radius", "speed")
"""Numbers that no scene may have as 0."""


class Place(NamedTuple):
    """Where numbers stand in a scene: `path` of attributes and places in tuples, `entry` of an array, None for all of it;
    their `name`, `unit` and how many they are, `size`."""

    path: tuple[str | int, ...]
    entry: int | None
    name: str
    unit: str
    size: int

    def leaf(self, scene: Scene) -> Array:
        """The whole array."""
        found: Any = scene
        for step in self.path:
            found = found[step] if isinstance(step, int) else getattr(found, step)
        return found

    def read(self, scene: Scene) -> Array:
        """The numbers, (size,)."""
        leaf = self.leaf(scene)
        return jnp.reshape(leaf if self.entry is None else leaf[self.entry], (-1,))

    @property
    def entries(self) -> set[tuple[tuple[str | int, ...], int]]:
        """Each number, to be compared with those of other places."""
        return {(self.path, k) for k in (range(self.size) if self.entry is None else (self.entry,))}


def changed(scene: Scene, place: Place, values: Array) -> Scene:
    """The scene with these numbers (size,) in that place."""
    leaf = place.leaf(scene)
    new = jnp.reshape(values, jnp.shape(leaf)) if place.entry is None else leaf.at[place.entry].set(values[0])
    return eqx.tree_at(place.leaf, scene, new)


def present_places(scene: Scene, place: Place, field: str) -> tuple[Place, ...]:
    """The place itself; if it is an array with zeros, the places of the other entries: a spring or damper of 0 is one that the
    machine does not have, and it is added only if its entry is named.

    **Raises** `InputError`, of `field`, for an array that is 0 in every entry.
    """
    values = np.asarray(place.leaf(scene))
    if place.entry is not None or values.ndim == 0 or np.all(values != 0.0):
        return (place,)
    if not np.any(values):
        advice = f"name the entry that shall be added, for example {place.name}[0]"
        raise InputError(f"{field}.{place.name}", f"is 0 in every entry, and zeros stay as they are; {advice}")
    return tuple(Place(place.path, int(k), f"{place.name}[{k}]", place.unit, 1) for k in np.flatnonzero(values))


def set_present(scene: Scene, place: Place, value: float) -> Scene:
    """The scene with this value in that place; zeros of an array stay, see `present_places`."""
    now, new = place.read(scene), jnp.full(place.size, value)
    several = place.entry is None and jnp.ndim(place.leaf(scene)) > 0
    return changed(scene, place, jnp.where(now != 0.0, new, now) if several else new)


def _all(scene: Scene) -> dict[str, tuple[tuple[str | int, ...], str, Array]]:
    found = {}

    def add(name: str, path: tuple[str | int, ...], unit: str, value: object) -> None:
        if isinstance(value, jax.Array) and value.size:
            found[name] = (path, unit, value)

    for part in ("machine", "loads", "drive"):
        for field in dataclasses.fields(getattr(scene, part)):
            if field.name in FIELD_UNITS:
                add(
                    f"{part}.{field.name}",
                    (part, field.name),
                    FIELD_UNITS[field.name],
                    getattr(getattr(scene, part), field.name),
                )
    for k, effect in enumerate(scene.effects):
        for field in dataclasses.fields(effect):
            unit = _EFFECT_UNITS.get(f"{effect.kind}.{field.name}")
            if unit:
                add(f"effects.{effect.kind}.{field.name}", ("effects", k, field.name), unit, getattr(effect, field.name))
    return found


def places_of(scene: Scene, name: str, field: str) -> Place:
    """The place of the numbers that a name stands for: of a whole array, or of one entry ("machine.stiffness[0]").

    **Raises** `InputError`, of `field`, for a name that the scene does not have.
    """
    there = _all(scene)
    match = re.fullmatch(r"([a-z_.]+)(?:\[(\d+)\])?", name) if isinstance(name, str) else None
    if match is None or match[1] not in there:
        raise InputError(f"{field}.{name}", f"is no number of this scene; {suggest_name(str(name), list(there))}")
    path, unit, leaf = there[match[1]]
    index = None if match[2] is None else int(match[2])
    if index is not None and (leaf.ndim == 0 or index >= leaf.shape[0]):
        raise InputError(f"{field}.{name}", f"does not exist; {match[1]} has {leaf.size} entries, counted from 0")
    return Place(path, index, name, unit, 1 if index is not None else leaf.size)


def value_of(name: str, value: Number) -> float:
    """A value for the number of that name. **Raises** `InputError` for a wrong unit, and for one that no scene can have."""
    last = re.sub(r"\[\d+\]$", "", str(name)).rpartition(".")[2]
    unit = FIELD_UNITS.get(last) or next((u for k, u in _EFFECT_UNITS.items() if str(name).endswith(k)), None)
    if unit is None:
        raise InputError(str(name), f"is no number of a scene; {suggest_name(str(name), list(FIELD_UNITS))}")
    return float(number(value, unit, str(name), low=0.0, open_low=last in _POSITIVE))


def names_of(scene: Scene, place: Place) -> list[str]:
    """What a designer calls each number of a place."""
    *_, owner, last = ("scene", *(p for p in place.path if isinstance(p, str)))
    which = range(place.size) if place.entry is None else (place.entry,)
    several = np.ndim(place.leaf(scene)) > 0
    loads = {"ball": "ball", "roller": "roller", "pendulum": "pendulum"}.get(scene.loads.kind, "load")
    links = getattr(scene.machine, "links", ())
    said = []
    for k in which:
        if owner == "loads":
            what = {"drag": "drag", "radius": "track radius", "inertia": "moment of inertia"}.get(last, last)
            said.append(f"{what} of {loads} {k + 1}" if several else f"{what} of each {loads}" if last != "radius" else what)
        elif owner == "drive":
            said.append("rotor speed" if last == "speed" else f"{last} of the drive")
        elif owner == "effects":
            said.append("imbalance of the rotor")
        elif last.startswith("link_"):
            said.append(f"{last.removeprefix('link_')} of link {'-'.join(map(str, links[k])) if k < len(links) else k + 1}")
        elif last in ("stiffness", "damping"):
            said.append(f"{last} of support {k + 1}" if several and place.leaf(scene).size > 1 else f"{last} of the support")
        elif last == "mass":
            said.append(f"mass of platform {k + 1}" if several and place.leaf(scene).size > 1 else "mass of the platform")
        else:
            said.append(last.replace("_", " ") + (f" {k + 1}" if several else ""))
    return said


def shown_unit(unit: str, size: float) -> tuple[str, float]:
    """The unit that a designer reads values of about that size in, and by what SI values are multiplied."""
    if unit == "N/m" and size >= 1e3:
        return "N/mm", 1e-3
    if unit in ("m", "meter") and 0.0 < size < 1.0:
        return ("mm", 1e3) if size >= 1e-5 else ("um", 1e6)
    if unit == "rad/s":
        return "rpm", 30.0 / np.pi
    if unit == "rad":
        return "deg", 180.0 / np.pi
    if unit == "kg" and 0.0 < size < 1.0:
        return "g", 1e3
    if unit == "N" and size >= 1e4:
        return "kN", 1e-3
    return unit, 1.0
