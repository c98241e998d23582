"""Model of a scene: its matrices and places, assembled once for each analysis and passed on."""

from __future__ import annotations

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.state import State
from jaxvib.machine.carrier import Carrier, Mount
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene


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
            force = force + term.force(rows @ displacement, rows @ velocity)
        return force

    def natural_force(self, unit: State) -> Array:
        """Return S n^2, N: the centrifugal force of the unbalance S at the rotor speed n.

        **Arguments**: `unit`: a state that contains the natural units of the scene, such as the unbalance radius.
        """
        speeds = [each.rate[0] for each in unit.exciters if each.rate] or [unit.velocity / unit.displacement]
        speed = functools.reduce(jnp.maximum, speeds)
        return jnp.mean(jnp.diagonal(self.carrier.mass)) * unit.displacement * speed**2


def assemble(scene: Scene) -> Model:
    """Return the model of a scene. The mass of its carrier includes the masses of unbalances, at the exciters' axes."""
    carrier, mounts = scene.machine.carrier(), tuple(scene.machine.mount(exciter.place) for exciter in scene.exciters)
    for exciter, mount in zip(scene.exciters, mounts, strict=True):
        if exciter.unbalance_mass is not None:
            rows = mount.rotor_rows()
            added = carrier.mass + exciter.unbalance_mass * rows.T @ rows
            carrier = dataclasses.replace(carrier, mass=added)
    return Model(scene, carrier, mounts, tuple(term.rows(scene.machine) for term in terms_of(scene.all_effects, SupportForce)))
