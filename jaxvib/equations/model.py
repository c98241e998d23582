"""Model of a scene: its matrices, mounts and places of supports. Each analysis assembles the model once and passes it on."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.state import State
from jaxvib.machine.carrier import Carrier, Mount
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.runtime.structure import leaf_key

_MIN_GROUP_SIZE = 8
"""Smallest number of parts of equal structure that are computed as one group."""

Part = TypeVar("Part")
T = TypeVar("T")


class Group(eqx.Module, Generic[Part]):
    """Parts of one or several exciters, whose numbers are the `members`. Parts of several exciters have equal structure and are
    stored as one `part`, whose arrays have a leading axis over the exciters."""

    part: Part
    members: tuple[int, ...] = eqx.field(static=True)

    def each(self, function: Callable[..., T], *values: object) -> T:
        """Return function(part, *values); for several members, arguments and result have a leading axis over them."""
        return (function if len(self.members) == 1 else eqx.filter_vmap(function))(self.part, *values)


def grouped(parts: Sequence[Part], kinds: Sequence[Hashable] | None = None) -> tuple[Group[Part], ...]:
    """Return parts in groups of equal structure, and of equal `kinds` if these are given. The parts of a group with fewer than
    `_MIN_GROUP_SIZE` members are returned as separate groups of one part."""
    alike: dict[Hashable, list[int]] = {}
    for k, part in enumerate(parts):
        leaves, structure = jax.tree.flatten(part)
        alike.setdefault((structure, kinds and kinds[k], *map(leaf_key, leaves)), []).append(k)
    groups = [group for same in alike.values() for group in ([same] if len(same) >= _MIN_GROUP_SIZE else [[k] for k in same])]
    return tuple(Group(stack_members(members, parts), tuple(members)) for members in sorted(groups))


def stack_members(members: Sequence[int], trees: Sequence[T]) -> T:
    """Return the trees of the `members` as one tree, with a leading axis over the members if there are several."""
    if len(members) == 1:
        return trees[members[0]]
    return jax.tree.map(lambda *x: jnp.stack(x), *(trees[k] for k in members))


def ungroup(groups: Iterable[Group], trees: Iterable[T]) -> list[T]:
    """Return the trees of all exciters in the order of the exciters, from the trees of their groups."""
    of_exciter: dict[int, T] = {}
    for group, tree in zip(groups, trees, strict=True):
        for i, k in enumerate(group.members):
            of_exciter[k] = tree if len(group.members) == 1 else jax.tree.map(lambda x, i=i: x[i], tree)
    return [of_exciter[k] for k in range(len(of_exciter))]


class Model(eqx.Module):
    """Scene with its matrices.

    **Attributes**

    - `scene`, and its `carrier`, see `Carrier`
    - `mounts`: the mounts of its exciters, see `Mount`; `mount`: the mount of the only exciter
    - `supports`: rows (k, nd) of the place of each `SupportForce` of the scene's effects
    """

    scene: Scene
    carrier: Carrier
    mounts: tuple[Mount, ...]
    supports: tuple[Array, ...]

    @property
    def mount(self) -> Mount:
        """Mount of the only exciter. **Raises** `InputError` if the scene has several."""
        _, mount = self.scene.exciter, self.mounts[0]
        return mount

    def foundation_force(self, displacement: Array, velocity: Array) -> Array:
        """Return the force of all supports on the foundation, gravity excluded, N, one entry for each direction."""
        force = self.carrier.foundation_force(displacement, velocity)
        for term, rows in zip(terms_of(self.scene.all_effects, SupportForce), self.supports, strict=True):
            if not term.is_link:
                force = force + term.force(rows @ displacement, rows @ velocity)
        return force

    @property
    def has_kinked_force(self) -> bool:
        """True if the force on the foundation is not a smooth function of the motion, because of a stop or dry friction."""
        terms = terms_of(self.scene.all_effects, SupportForce)
        return any(not (term.is_smooth or term.is_link) for term in terms)

    def known_force(self, force: Array) -> Array:
        """Return a force on the foundation, or NaN for a machine whose foundation is unknown (`Machine.has_foundation`)."""
        return force if self.scene.machine.has_foundation else jnp.full_like(force, jnp.nan)

    def vibration_force(self, displacement: Array, omega: Array) -> Array:
        """Return the complex amplitudes of the force of the carrier's supports, without effects, on the foundation, N; NaN if
        the foundation is unknown.

        **Arguments**: `displacement` (nd,) or (nd, K): complex amplitudes of the coordinates; `omega`: their frequency, or one
        for each column, rad/s.
        """
        return self.known_force(self.carrier.foundation_force(displacement, 1j * omega * displacement))

    def natural_force(self, unit: State) -> Array:
        """Return S n^2, N: the centrifugal force of the unbalance S at the rotor speed n.

        **Arguments**: `unit`: the natural units of the scene's state, computed by `natural_units`.
        """
        speeds = [each.rate[0] for each in unit.exciters if each.rate] or [unit.velocity / unit.displacement]
        speed = functools.reduce(jnp.maximum, speeds)
        return jnp.mean(jnp.diagonal(self.carrier.mass)) * unit.displacement * speed**2


def assemble(scene: Scene) -> Model:
    """Return the model of a scene. The mass of its carrier includes the masses of unbalances, at the exciters' axes."""
    carrier, mounts = scene.machine.carrier(), tuple(scene.machine.mount(exciter.place) for exciter in scene.exciters)
    for exciter, mount in zip(scene.exciters, mounts, strict=True):
        if exciter.unbalance_mass is not None:
            rows = mount.rows[0]
            added = carrier.mass + exciter.unbalance_mass * rows.T @ rows
            carrier = dataclasses.replace(carrier, mass=added)
    return Model(scene, carrier, mounts, tuple(term.rows(scene.machine) for term in terms_of(scene.all_effects, SupportForce)))
