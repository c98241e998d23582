"""Loads that touch each other on their track."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.loads import CircularLoads, Loads
from jaxvib.units import Number, number

__all__ = ["LoadContact"]


class LoadContact(Effect):
    """Neighbours on one track press against each other where they would overlap.

        force between centres = max(0, k (2 r - s) - c s'),    s = 2 R sin((phi_{j+1} - phi_j) / 2)

    r is the loads' `own_radius`. Loads on one track never pass each other: load j+1 follows load j, and load 1 follows the last
    one a turn later, so that N pairs are all there are. A state to start from has its angles in this order, less than a turn
    apart; the named ones lay loads that are together side by side.

    **Arguments**: `stiffness` k N/m; `damping` c N s/m.

    **Raises** `InputError` for values that are not allowed, and, by the scene, for loads without an own radius.

    >>> import jaxvib as jv
    >>> float(jv.LoadContact(stiffness=1e6).stiffness)
    1000000.0

    Source: asked for by Strautmanis et al. 2018; a linear spring and damper between the centres.
    """

    averages_out = True
    couples_loads = True

    stiffness: Array
    damping: Array
    kind: str = eqx.field(static=True)

    def __init__(self, stiffness: Number, damping: Number = 0.0):
        self.stiffness = number(stiffness, "N/m", "effects.load_contact.stiffness", low=0.0, open_low=True)
        self.damping = number(damping, "N s/m", "effects.load_contact.damping", low=0.0)
        self.kind = "load_contact"

    def check(self, machine: Machine, loads: Loads) -> None:
        """Loads on one circle that have a size."""
        if not isinstance(loads, CircularLoads) or loads.own_radius is None:
            raise InputError("effects.load_contact", "needs loads that have a size: give balls or rollers their own_radius")
        if machine.structure().stations is not None:
            raise InputError("effects.load_contact", "needs loads on one track; this machine has them at several stations")

    def check_start(self, loads: Loads, u: tuple[Array, ...]) -> None:
        """In the order of the track, less than a turn from the first to the last."""
        phi = np.asarray(u[0])
        wrong = ~np.all(np.diff(phi, axis=-1) > 0.0, axis=-1) | ~(phi[..., -1] - phi[..., 0] < 2.0 * np.pi)
        if np.any(wrong):
            which = np.round(phi[wrong][0] if phi.ndim > 1 else phi, 4).tolist()
            problem = "loads in contact never pass each other: each angle must be above the one before, all within one turn"
            raise InputError("start.angle", f"is {which} rad; {problem} (add 2 pi where a load is a turn behind, or sort them)")

    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array:
        """k (2 r - s)^2 / 2 of each pair that overlaps."""
        return 0.5 * self.stiffness * jnp.maximum(-_clearance(loads, u[0]), 0.0) ** 2

    def load_resistance(self, loads: Loads, u: tuple[Array, ...], rate: tuple[Array, ...]) -> tuple[Array, ...]:
        """-c s' of each pair that overlaps; a contact that would pull lets go."""
        clearance, back = jax.vjp(lambda phi: _clearance(loads, phi), u[0])
        _, parting = jax.jvp(lambda phi: _clearance(loads, phi), (u[0],), (rate[0],))
        force = jnp.where(clearance < 0.0, jnp.maximum(-self.damping * parting, self.stiffness * clearance), 0.0)
        return back(force)


def _clearance(loads: Loads, phi: Array) -> Array:
    """Distance between each load and the next, surface to surface, negative where they overlap."""
    assert isinstance(loads, CircularLoads) and loads.own_radius is not None
    ahead = jnp.concatenate([phi[1:], phi[:1] + 2.0 * jnp.pi])
    return 2.0 * loads.radius * jnp.sin(0.5 * jnp.clip(ahead - phi, -jnp.pi, jnp.pi)) - 2.0 * loads.own_radius
