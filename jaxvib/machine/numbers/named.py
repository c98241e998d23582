"""Parameters of a scene by name: "machine.stiffness[0]", "drive.inertia", "effects.stop[1].gap".

Every floating-point parameter of a scene has a name: its tables and its key in a scene file. Its unit, bounds and label are
defined in the package `numbers`.
"""

from __future__ import annotations

import collections
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import ELECTRICAL
from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.files import EFFECTS
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import PLAIN, NumberSpec, number_specs
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.structures.plane_body import Body, PlaneSupport
from jaxvib.units import Number, number

_Path = tuple[str | int, ...]
_SECTIONS: dict[str, type[eqx.Module]] = {
    "machine": Machine,
    "machine.supports": PlaneSupport,
    "machine.bodies": Body,
    "loads": Loads,
    "drive": Drive,
    "exciters": Exciter,
}


class NamedNumber(NamedTuple):
    """Parameter of a scene, or array of parameters with one unit.

    **Attributes**: `path` of attributes and indices from the scene to the array; `entry`: index of the parameter in the array,
    None for all entries; `size`: number of parameters; `spec`: specification of the field.
    """

    name: str
    path: _Path
    entry: int | None
    size: int
    spec: NumberSpec

    @property
    def unit(self) -> str:
        """Unit of the parameter, or of all entries."""
        return self.spec.units[self.entry if self.entry is not None and len(self.spec.units) > 1 else 0]

    @property
    def unit_of_tables(self) -> str:
        """Unit for `jaxvib.display.shown_unit`."""
        return ELECTRICAL if self.spec.electrical else self.unit

    @property
    def entries(self) -> set[tuple[_Path, int]]:
        """Path and index of each parameter. Two names with the same path and index mean the same parameter."""
        return {(self.path, k) for k in (range(self.size) if self.entry is None else (self.entry,))}

    @property
    def is_damping(self) -> bool:
        """True for the damping of a support or of a link."""
        return "damping" in str(self.path[-1])

    def leaf(self, scene: Scene) -> Array:
        """Return the array that contains the parameter."""
        part: Any = scene
        for step in self.path:
            part = part[step] if isinstance(step, int) else getattr(part, step)
        return part

    def read(self, scene: Scene) -> Array:
        """Return the values (size,), SI."""
        leaf = jnp.asarray(self.leaf(scene))
        return jnp.reshape(leaf if self.entry is None else _row_by_row(leaf)[self.entry], (-1,))

    def value(self, given: Number, field: str) -> float:
        """Return a user's value in SI. **Raises** `InputError` that names `field`, for a wrong unit or a value out of
        bounds."""
        return float(number(given, self.unit, field, **self.spec.bounds._asdict()))

    def single(self, scene: Scene) -> tuple[NamedNumber, ...]:
        """Return the entries of an array, each with its own name; for a single parameter, a tuple of only this parameter."""
        if self.entry is not None or not np.ndim(self.leaf(scene)):
            return (self,)
        return tuple(self._replace(name=f"{self.name}[{k}]", entry=k, size=1) for k in range(self.size))

    def keeps_zeros(self, scene: Scene) -> bool:
        """Return True for a whole array in which an entry 0 stands for a spring or a damper that the machine does not have."""
        return self.entry is None and self.spec.zero_is_absent and np.ndim(self.leaf(scene)) > 0

    def words(self, scene: Scene) -> list[str]:
        """Return the name of each parameter in text for users, such as "stiffness of support 2"."""
        which = self.path[1] if self.path[0] == "exciters" else 0
        exciter = scene.exciters[which if isinstance(which, int) else 0]
        load = "load" if exciter.loads is None else exciter.loads.kind.rpartition("_")[2]
        leaf, each = self.leaf(scene), self.spec.each
        words = self._numbered(scene, self.spec.words.format(load=load))
        if self.path[0] == "exciters" and len(scene.exciters) > 1:
            named = f"exciter {1 + int(self.path[1])}"
            found = self._words_of_entries(scene, words, leaf, load, each)
            return [word.replace("the exciter", named) if "the exciter" in word else f"{word} ({named})" for word in found]
        return self._words_of_entries(scene, words, leaf, load, each)

    def _words_of_entries(self, scene: Scene, words: str, leaf: Array, load: str, each: str) -> list[str]:
        which = range(self.size) if self.entry is None else (self.entry,)
        several = np.ndim(leaf) > 0
        if each == "load":
            return [f"{words} of {load} {k + 1}" if several else f"{words} of each {load}" for k in which]
        if each == "link":
            links = getattr(scene.machine, "links", ())
            return [f"{words} of link {'-'.join(map(str, links[k])) if k < len(links) else k + 1}" for k in which]
        if each:
            return [f"{words} of {each} {k + 1}" if np.size(leaf) > 1 else f"{words} of the {each}" for k in which]
        if np.shape(leaf) == (2,) and self.spec.unit == "m":
            return [f"{'xy'[k]} of the {words}" for k in which]
        if several and self._is_of_support:
            return [f"{words} {('across', 'along')[k]} its axis" for k in which]
        return [f"{words} {k + 1}" if several else words for k in which]

    @property
    def _is_of_support(self) -> bool:
        return self.path[:2] == ("machine", "supports")

    def _numbered(self, scene: Scene, words: str) -> str:
        """Return `words`, with the number of the support or of the body, or of the effect if the scene has several of its
        kind."""
        if self._is_of_support:
            return words.replace("the support", f"support {1 + int(self.path[2])}")
        if self.path[:2] == ("machine", "bodies"):
            return words.replace("the body", f"body {1 + int(self.path[2])}")
        if self.path[0] != "effects" or not isinstance(index := self.path[1], int):
            return words
        kinds = [effect.kind for effect in scene.effects]
        kind = kinds[index]
        if kinds.count(kind) == 1:
            return words
        called = kind.replace("_", " ")
        return words.replace(f"the {called}", f"{called} {kinds[:index].count(kind) + 1}")


def numbers_of(scene: Scene) -> dict[str, NamedNumber]:
    """Return all continuous parameters of a scene by name.

    An array whose entries have one unit has one name. If the entries have different units, each entry has its own name.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0), (jv.Gravity(),))
    >>> [(name, found.unit) for name, found in numbers_of(scene).items()][-2:]
    [('drive.speed', 'rad/s'), ('effects.gravity.g', 'm/s^2')]
    """
    found: dict[str, NamedNumber] = {}
    for prefix, path, part in _parts(scene):
        for steps, leaf in jax.tree_util.tree_leaves_with_path(part):
            if not _is_continuous(leaf) or not np.size(leaf) or (isinstance(part, Exciter) and len(steps) > 1):
                continue  # loads, drive and effects of an exciter are separate parts
            inner, spec = _steps(part, steps)
            name = _in_file(prefix + jax.tree_util.keystr(steps))
            whole = NamedNumber(name, (*path, *inner), None, np.size(leaf), spec)
            found |= {each.name: each for each in (whole.single(scene) if len(spec.units) > 1 else (whole,))}
    return found


def _in_file(name: str) -> str:
    """Return a name with the key of scene files in place of the field of the class, if they differ."""
    return re.sub(r"(?<=^exciters)(\[\d+\])\.position\b", r"\1.at", name)


def _short_name(scene: Scene, name: str) -> str:
    """Return the name of a parameter that is given by its field, or by its tables in a file with only one table in a list: one
    exciter, or one effect of a kind."""
    name = _in_file(name)
    if len(scene.exciters) == 1:
        name = re.sub(r"^exciters\[0\]\.(?=(loads|drive|effects)\.)", "", name)
    for kind in {effect.kind for effect in scene.effects if effect.repeatable}:
        if sum(effect.kind == kind for effect in scene.effects) == 1:
            name = name.replace(f"effects.{kind}.", f"effects.{kind}[0].")
    return name


def _is_continuous(value: object) -> bool:
    """Return True for a floating-point number or an array of such numbers, even if it is traced."""
    is_numeric = isinstance(value, (float, np.generic, np.ndarray, jax.Array))
    return is_numeric and jnp.issubdtype(jnp.result_type(value), jnp.floating)


def _parts(scene: Scene) -> Iterator[tuple[str, _Path, eqx.Module]]:
    """Yield the name, the path and the object of each part of a scene. Repeatable effects are numbered from 0."""
    yield "machine", ("machine",), scene.machine
    for k, exciter in enumerate(scene.exciters):
        place, path = scene.prefix_of(k), ("exciters", k)
        for section in ("loads", "drive"):
            if (part := getattr(exciter, section)) is not None:
                yield place + section, (*path, section), part
        yield f"exciters[{k}]", path, exciter
    counted: collections.Counter[str] = collections.Counter()
    for k, effect in enumerate(scene.effects):
        yield f"effects.{effect.kind}" + (f"[{counted[effect.kind]}]" if effect.repeatable else ""), ("effects", k), effect
        counted[effect.kind] += 1
    for k, exciter in enumerate(scene.exciters):
        for j, effect in enumerate(exciter.effects):
            yield f"{scene.prefix_of(k)}effects.{effect.kind}", ("exciters", k, "effects", j), effect


def _steps(part: eqx.Module, steps: Sequence[Any]) -> tuple[_Path, NumberSpec]:
    """Return the path within a part, and the spec of the field at its end."""
    inner: list[str | int] = []
    spec, owner = PLAIN, cast(Any, part)
    for step in steps:
        if isinstance(step, jax.tree_util.GetAttrKey):
            inner.append(step.name)
            spec = number_specs(type(owner)).get(step.name, PLAIN._replace(words=step.name.replace("_", " ")))
            owner = getattr(owner, step.name)
        else:
            inner.append(step.idx)
            owner = owner[step.idx]
    return tuple(inner), spec


def find_number(scene: Scene, name: str, field: str) -> NamedNumber:
    """Return the parameter, or the array of parameters, with the name `name`. **Raises** `InputError` that names `field`, if
    the scene has no such parameter."""
    named, field = numbers_of(scene), f"{field}.{name}"
    if not isinstance(name, str):
        raise InputError(field, f"is not the name of a parameter; {suggest_name(str(name), list(named))}")
    name = _short_name(scene, name)
    if name in named:
        return named[name]
    array, index = m.groups() if (m := re.fullmatch(r"(.+)\[(\d+)\]", name)) else (name, None)
    if array in named and index is not None:
        entries = named[array].single(scene)
        if entries[0].entry is None or int(index) >= len(entries):
            raise InputError(field, f"does not exist; {array} has {named[array].size} entries, counted from 0")
        return entries[int(index)]
    if entries := [each for each in named if each.startswith(f"{name}[")]:
        listed = ", ".join(entries[:4]) + (" ..." if len(entries) > 4 else "")
        raise InputError(field, f"has entries with names of their own; give one of them: {listed}")
    raise InputError(field, f"{_why_unnamed(scene, name)}; {suggest_name(name, list(named))}")


def _why_unnamed(scene: Scene, name: str) -> str:
    """Return the reason why `name` is not the name of a parameter."""
    part, _, last = name.rpartition(".")
    owner = next((each for prefix, _, each in _parts(scene) if prefix == part), None)
    if last not in getattr(type(owner), "__dataclass_fields__", ()):
        return "is not a parameter of this scene"
    value = getattr(owner, last)
    if value is None or np.size(value) == 0:
        return "is not set in this scene"
    return f"is {quoted(value)}, which is not a continuous number"


def _row_by_row(leaf: Array) -> Array:
    """Return the entries of a matrix row by row, as they are numbered, and other arrays unchanged."""
    return leaf if leaf.ndim < 2 else jnp.ravel(leaf)


def put_numbers(scene: Scene, parameters: Sequence[NamedNumber], values: Array | np.ndarray) -> Scene:
    """Return the scene with `values` (sum of the sizes,), SI, for the `parameters` in their order."""
    leaves: dict[_Path, Array] = {}
    start = 0
    for each in parameters:
        leaf, new = jnp.asarray(leaves.get(each.path, each.leaf(scene))), values[start : start + each.size]
        changed = new if each.entry is None else _row_by_row(leaf).at[each.entry].set(new[0])
        leaves[each.path] = jnp.reshape(changed, leaf.shape)
        start += each.size
    by_path = {each.path: each for each in parameters}
    return eqx.tree_at(lambda s: [each.leaf(s) for each in by_path.values()], scene, list(leaves.values()))


def present_numbers(scene: Scene, array: NamedNumber, field: str) -> tuple[NamedNumber, ...]:
    """Return the array, or only its entries other than 0 if it keeps its zeros: a spring or damper is added only if its entry
    is named. **Raises** `InputError` that names `field` if no entry is left."""
    values = np.asarray(array.leaf(scene))
    if not array.keeps_zeros(scene) or np.all(values != 0.0):
        return (array,)
    if not np.any(values):
        advice = f"name the entry to add, for example {array.name}[0]"
        raise InputError(f"{field}.{array.name}", f"is 0 in every entry, and zeros are not changed; {advice}")
    return tuple(each for each, value in zip(array.single(scene), values, strict=True) if value != 0.0)


def put_present(scene: Scene, array: NamedNumber, value: float | Array) -> Scene:
    """Return the scene with `value` in every entry of an array. Absent springs and dampers stay absent, see
    `present_numbers`."""
    old, new = array.read(scene), jnp.full(array.size, value)
    return put_numbers(scene, (array,), jnp.where(old != 0.0, new, old) if array.keeps_zeros(scene) else new)


def read_value(name: str, value: Number) -> float:
    """Return a value in SI for the parameter `name` of any scene. **Raises** `InputError` for a wrong name or value."""
    spec, index = spec_of(name), re.search(r"\[(\d+)\]$", str(name))
    entry = int(index[1]) if index else None
    if spec is None or (len(spec.units) > 1 and (entry or 0) >= len(spec.units)):
        raise InputError(
            str(name), "is not a parameter of a scene; give a name such as 'machine.stiffness[0]' or 'drive.speed'"
        )
    return NamedNumber(name, (), entry, 1, spec).value(value, name)


def spec_of(name: str) -> NumberSpec | None:
    """Return the specification of a parameter from its name alone; None if no kind of part has such a field. If several kinds
    have it, the specification of an array takes precedence."""
    part, _, last = re.sub(r"\[\d+\]", "", str(name)).rpartition(".")
    last = "position" if (part, last) == ("exciters", "at") else last
    part = re.sub(r"(\.(motor|reference))+$", "", part.removeprefix("exciters."))  # a drive within a drive
    if part.startswith("effects."):
        known = EFFECTS.get(part.removeprefix("effects."))
        kinds = [known] if known else [kind for kind in _subclasses(Effect) if kind not in EFFECTS.values()]
    else:
        kinds = [kind for name, of in _SECTIONS.items() if name == part for kind in (of, *_subclasses(of))]
    found = [specs[last] for kind in kinds if last in (specs := number_specs(kind))]
    return next((spec for spec in found if spec.each), next(iter(found), None))


def _subclasses(kind: type) -> list[type]:
    return [each for sub in kind.__subclasses__() for each in (sub, *_subclasses(sub))]
