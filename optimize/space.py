"""The design space: free numbers of a scene, their bounds, and quantities that are held."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.files import closest
from jaxvib.machine.scene import Scene
from jaxvib.steady.jams.jam import JamModes
from jaxvib.units import FIELD_UNITS, Number, number
from optimize.quantities import Quantity

__all__ = ["DesignSpace", "Held", "hold"]


class Held(eqx.Module):
    """A quantity that keeps its value during the search; made by `hold`."""

    quantity: Quantity = eqx.field(static=True)
    value: float | None = eqx.field(static=True)


def hold(quantity: Quantity, value: Number | None = None) -> Held:
    """Holds a quantity at a value, or, without one, at what it is in the scene the search begins with.

    **Arguments**: `quantity` such as `jam_frequency(mode=3)`; `value` in its unit, or text.

    **Returns** `Held`. **Raises** `InputError` for a wrong unit, or a value of 0 (what is held is compared relative to it).

    >>> from optimize import hold, jam_frequency
    >>> hold(jam_frequency(mode=3), "600 rpm").quantity.name
    'jam_frequency'
    """
    if not isinstance(quantity, Quantity):
        raise InputError("hold", f"is {quantity!r}; it must be a Quantity, for example jam_frequency(mode=3)")
    if value is None:
        return Held(quantity, None)
    held = float(number(value, quantity.unit, f"hold.{quantity.name}"))
    if held == 0.0:
        raise InputError(f"hold.{quantity.name}", "is 0; a quantity can be held at a value other than 0 only")
    return Held(quantity, held)


class _Free(eqx.Module):
    path: tuple[str, ...] = eqx.field(static=True)
    index: int | None = eqx.field(static=True)
    low: float = eqx.field(static=True)
    high: float = eqx.field(static=True)
    log: bool = eqx.field(static=True)
    size: int = eqx.field(static=True)
    name: str = eqx.field(static=True)


class DesignSpace(eqx.Module):
    """The numbers of a scene that may change, between bounds, and quantities that must keep their value.

    **Arguments**

    - `scene`: the design the search begins with
    - `free`: name to (low, high), SI or text with units; a name such as "machine.stiffness" frees every entry of an array
      (each within the bounds), "machine.stiffness[0]" one of them, "loads.drag" the one number all loads share
    - `hold`: quantities that keep their value, made by `optimize.hold`

    Inside, a design is a vector z in [0, 1]^d; ranges over a factor of 10 or more are divided by ratio, others evenly.

    **Raises** `InputError` for a name the scene does not have, bounds the wrong way round, or more held quantities than
    free numbers.

    >>> import jaxvib as jv
    >>> from optimize import DesignSpace
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> scene = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))
    >>> space = DesignSpace(scene, free={"machine.stiffness": (1e4, 2e5), "machine.link_stiffness": ("50 N/mm", 5e5)})
    >>> space.size
    3
    """

    scene: Scene
    free: tuple[_Free, ...]
    held: tuple[Held, ...]

    def __init__(self, scene: Scene, free: Mapping[str, tuple[Number, Number]], hold: Sequence[Held] = ()):
        if not free:
            raise InputError("free", "is empty; name at least one number that may change, such as machine.stiffness")
        self.scene = scene
        self.free = tuple(_freed(scene, name, bounds) for name, bounds in free.items())
        taken: set[tuple[tuple[str, ...], int]] = set()
        for f in self.free:
            entries = {(f.path, k) for k in (range(f.size) if f.index is None else (f.index,))}
            if entries & taken:
                raise InputError(f"free.{f.name}", "frees a number that is free already; name each one once")
            taken |= entries
        for held in hold:
            if not isinstance(held, Held):
                raise InputError("hold", f"has {held!r}; wrap quantities in optimize.hold(...)")
        self.held = tuple(_with_value(held, scene) for held in hold)
        if len(self.held) >= self.size:
            raise InputError(
                "hold", f"holds {len(self.held)} quantities with {self.size} free numbers; more must be free than held"
            )

    @property
    def size(self) -> int:
        """How many numbers are free."""
        return sum(f.size for f in self.free)

    def at(self, z: Array) -> Scene:
        """The scene of the design z (d,) in [0, 1]."""
        scene, start = self.scene, 0
        for f in self.free:
            part = z[start : start + f.size]
            start += f.size
            value = f.low * (f.high / f.low) ** part if f.log else f.low + (f.high - f.low) * part
            leaf = _leaf(scene, f.path)
            new = jnp.reshape(value, leaf.shape) if f.index is None else leaf.at[f.index].set(value[0])
            scene = eqx.tree_at(lambda s, path=f.path: _leaf(s, path), scene, new)
        return scene

    def where(self, scene: Scene) -> Array:
        """The design z (d,) of a scene, moved into the bounds where it lies outside."""
        parts = []
        for f in self.free:
            leaf = _leaf(scene, f.path)
            value = jnp.reshape(leaf if f.index is None else leaf[f.index], (-1,))
            value = jnp.clip(value, f.low, f.high)
            share = jnp.log(value / f.low) / jnp.log(f.high / f.low) if f.log else (value - f.low) / (f.high - f.low)
            parts.append(share)
        return jnp.concatenate(parts)

    def parameters(self, scene: Scene) -> dict[str, float | list[float]]:
        """The free numbers of a scene by name, in SI."""
        values = {}
        for f in self.free:
            leaf = _leaf(scene, f.path)
            values[f.name] = (leaf if f.index is None else leaf[f.index]).tolist()
        return values

    def residuals(self, scene: Scene, modes: JamModes) -> Array:
        """By how much each held quantity is off, relative to the value it is held at (m,)."""
        off = [held.quantity(scene, modes) / held.value - 1.0 for held in self.held if held.value is not None]
        return jnp.stack(off) if off else jnp.zeros((0,))


def _leaf(scene: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        scene = getattr(scene, name)
    return scene


def _numbers_of(scene: Scene) -> dict[str, Array]:
    found = {}
    for part in ("machine", "loads", "drive"):
        fields = getattr(scene, part)
        for name in type(fields).__dataclass_fields__:
            if isinstance(getattr(fields, name), jax.Array) and name in FIELD_UNITS and getattr(fields, name).size:
                found[f"{part}.{name}"] = getattr(fields, name)
    return found


def _freed(scene: Scene, name: str, bounds: tuple[Number, Number]) -> _Free:
    if isinstance(bounds, Mapping):
        raise InputError(
            f"free.{name}", f'is a table; write the whole name in quotes, for example "{name}.{next(iter(bounds), "")}"'
        )
    match = re.fullmatch(r"([a-z_.]+)(?:\[(\d+)\])?", name)
    there = _numbers_of(scene)
    if match is None or match[1] not in there:
        raise InputError(f"free.{name}", f"is no number of this scene; {closest(name, list(there))}")
    leaf = there[match[1]]
    index = None if match[2] is None else int(match[2])
    if index is not None and (leaf.ndim == 0 or index >= leaf.shape[0]):
        raise InputError(f"free.{name}", f"does not exist; {match[1]} has {leaf.size} entries, counted from 0")
    if not isinstance(bounds, (list, tuple)) or len(bounds) != 2:
        raise InputError(f"free.{name}", f"is {bounds!r}; give the bounds as (low, high)")
    path = tuple(match[1].split("."))
    low, high = (float(number(b, FIELD_UNITS[path[-1]], f"free.{name}", low=0.0)) for b in bounds)
    if not low < high:
        raise InputError(f"free.{name}", f"has bounds {low:g} and {high:g}; the first must be less than the second")
    size = 1 if index is not None else leaf.size
    return _Free(path, index, low, high, low > 0.0 and high / low >= 10.0, size, name)


def _with_value(held: Held, scene: Scene) -> Held:
    if held.value is not None:
        return held
    value = float(held.quantity(scene))
    if not (jnp.isfinite(value) and value != 0.0):
        raise InputError(
            f"hold.{held.quantity.name}",
            f"is {value} in the scene the search begins with; give the value it shall be held at",
        )
    return Held(held.quantity, value)
