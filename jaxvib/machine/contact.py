"""Loads that touch each other on their track."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects import Effect
from jaxvib.machine.loads import CircularLoads, Loads
from jaxvib.machine.units import Number, number, traced

__all__ = ["LoadContact"]


class LoadContact(Effect):
    """Neighbours on one track press against each other where they would overlap.

        force between centres = max(0, k (d - s) - c s'),    s = 2 R sin((phi_{j+1} - phi_j) / 2)

    Loads on one track never pass each other: load j+1 follows load j, and load 1 follows the last one a turn later, so that
    N pairs are all there are. A state to start from has its angles in this order, less than a turn apart.

    **Arguments**: `diameter` d of the loads, m, the least distance of their centres; `stiffness` k N/m; `damping` c N s/m.

    **Raises** `InputError` for values that are not allowed, and, by the scene, for loads that do not fit on their track.

    >>> import jaxvib as jv
    >>> float(jv.LoadContact(diameter="30 mm", stiffness=1e6).diameter)
    0.03

    Source: asked for by Strautmanis et al. 2018; a linear spring and damper between the centres.
    """

    diameter: Array
    stiffness: Array
    damping: Array
    kind: str = eqx.field(static=True)

    def __init__(self, diameter: Number, stiffness: Number, damping: Number = 0.0):
        field = "effects.load_contact"
        self.diameter = number(diameter, "m", f"{field}.diameter", low=0.0, open_low=True)
        self.stiffness = number(stiffness, "N/m", f"{field}.stiffness", low=0.0, open_low=True)
        self.damping = number(damping, "N s/m", f"{field}.damping", low=0.0)
        self.kind = "load_contact"

    def check(self, machine: Machine, loads: Loads) -> None:
        """Loads on one circle, that have room on it."""
        if not isinstance(loads, CircularLoads):
            raise InputError("effects.load_contact", f"goes with loads on a circle, not with {loads.kind!r}")
        if traced(loads.radius) or traced(self.diameter):
            return
        radius = np.asarray(loads.radius)
        if np.ptp(radius) > 0.0:
            raise InputError("effects.load_contact", "needs loads on one track: give them one radius")
        if not 2.0 * float(np.max(radius)) >= float(self.diameter):
            raise InputError("effects.load_contact.diameter", f"is {float(self.diameter):g} m; it must fit in the track")
        most = int(np.floor(np.pi / np.arcsin(float(self.diameter) / (2.0 * float(np.max(radius)))) * (1.0 + 1e-12)))
        if loads.count > most:
            raise InputError(
                "effects.load_contact.diameter",
                f"is {float(self.diameter):g} m; at most {most} such loads fit on the track, the scene has {loads.count}",
            )

    def side_by_side(self, loads: Loads) -> Array:
        """Angles (count,) of loads that just touch, about their middle, rad."""
        assert isinstance(loads, CircularLoads)
        step = 2.0 * jnp.arcsin(0.5 * self.diameter / jnp.mean(loads.radius))
        return step * (jnp.arange(loads.count) - 0.5 * (loads.count - 1))

    def _distance(self, loads: Loads, phi: Array) -> Array:
        """Distance of the centres of each load and the next, negative where they have passed each other."""
        assert isinstance(loads, CircularLoads)
        ahead = jnp.concatenate([phi[1:], phi[:1] + 2.0 * jnp.pi])
        return 2.0 * loads.radius * jnp.sin(0.5 * jnp.clip(ahead - phi, -jnp.pi, jnp.pi))

    def load_potential(self, loads: Loads, u: tuple[Array, ...]) -> Array:
        """k (d - s)^2 / 2 of each pair that overlaps."""
        return 0.5 * self.stiffness * jnp.maximum(self.diameter - self._distance(loads, u[0]), 0.0) ** 2

    def load_resistance(self, loads: Loads, u: tuple[Array, ...], rate: tuple[Array, ...]) -> tuple[Array, ...]:
        """-c s' of each pair that overlaps; a contact that would pull lets go."""
        distance, back = jax.vjp(lambda phi: self._distance(loads, phi), u[0])
        _, parting = jax.jvp(lambda phi: self._distance(loads, phi), (u[0],), (rate[0],))
        overlap = self.diameter - distance
        force = jnp.where(overlap > 0.0, jnp.maximum(-self.damping * parting, -self.stiffness * overlap), 0.0)
        return back(force)
