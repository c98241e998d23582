"""The linear structure that carries the loads."""

from __future__ import annotations

import abc
import functools
from collections.abc import Hashable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

__all__ = ["Carrier", "Machine"]


class Carrier(eqx.Module):
    """A linear structure with a port through which the loads shake it.

        M q'' + (C + speed G) q' + K q = Q + B^T f,        force on the bed = T_K q + T_C q'

    The mass of the loads is not part of `mass`: each load brings its own through the port.

    **Attributes** (nd coordinates, np port directions, nb directions of the force on the bed)

    - `mass` M (nd, nd), kg or kg m^2; `damping` C (nd, nd), N s/m; `stiffness` K (nd, nd), N/m
    - `gyroscopic` G (nd, nd), kg m^2, times the rotor's speed; None where the structure has none
    - `port` B (np, nd): the port's displacement is B q
    - `axes`: which direction of a load's plane (0 across, 1 up) each row of B moves in
    - `bed_stiffness` T_K, `bed_damping` T_C (nb, nd): ties to the bed, N/m and N s/m
    - `coordinates`: a name for each coordinate; `coordinate_units`: the unit of each, "m" or "rad", None where all are "m"
    - `tilt` T (np, nd), 1/m times the unit of a displacement: how the structure's axis turns with q; None where it cannot.
      A point at the distance s along the axis from the port moves by (B + s T) q
    - `stations` s_j (count,) m: where along the axis, counted from the port, each load runs; None where all run at the port
    - `cg_offset` m: where along the axis, counted from the port, the rotor's own mass centre lies; None where it is the port

    Source: the general form of all five papers; for platforms Filimonikhin et al. 2022, equations (1)-(6), for stations
    Artyunin 2013, equation (1).
    """

    mass: Array
    damping: Array
    stiffness: Array
    gyroscopic: Array | None
    port: Array
    bed_stiffness: Array
    bed_damping: Array
    axes: tuple[int, ...] = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    tilt: Array | None = None
    stations: Array | None = None
    cg_offset: Array | None = None
    coordinate_units: tuple[str, ...] | None = eqx.field(static=True, default=None)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each coordinate, "m" or "rad".

        >>> import jaxvib as jv
        >>> jv.planar_rotor(mass=37.0, stiffness="1160 N/mm", damping=840.0).structure().units
        ('m', 'm')
        """
        return self.coordinate_units or ("m",) * len(self.coordinates)

    @property
    def bed_directions(self) -> tuple[str, ...]:
        """A name for each direction of the force on the bed: "up", or "across" and "up"."""
        return ("up",) if self.bed_stiffness.shape[0] == 1 else ("across", "up")

    def port_at(self, distance: Array | float) -> Array:
        """B + s T (np, nd): how a point at the `distance` s (m, along the axis from the port) moves with q."""
        return self.port if self.tilt is None else self.port + distance * self.tilt

    def point_rates(self, rate: Array) -> dict[int, Array]:
        """Velocities (accelerations) of the points that carry the loads where the coordinates' are `rate` (nd,), by axis;
        (count,) each where loads have stations."""
        port = self.port @ rate
        if self.stations is not None and self.tilt is not None:
            port = port[:, None] + (self.tilt @ rate)[:, None] * self.stations[None, :]
        return dict(zip(self.axes, port, strict=True))

    def bed_force(self, displacement: Array, velocity: Array) -> Array:
        """Force on the bed (nb,) N, T_K q + T_C q', also of complex amplitudes; without supports that are effects."""
        return self.bed_stiffness @ displacement + self.bed_damping @ velocity


class Machine(eqx.Module):
    """A machine in the designer's own numbers. A new kind of machine is a new subclass with its matrices."""

    kind: eqx.AbstractVar[str]

    @abc.abstractmethod
    def carrier(self) -> Carrier:
        """The machine as a linear structure, see `Carrier`."""

    def supports(self) -> list[tuple[float, float, float]] | None:
        """Where along a rotor's axis supports stand, for a drawing: distance from the mass centre m, stiffness N/m, damping
        N s/m; None where the matrices say all there is to draw."""
        return None

    def structure(self) -> Carrier:
        """The carrier's names, directions and shapes, without computing its numbers."""
        leaves, rest = jax.tree.flatten(self)
        return _structure(rest, tuple(map(_kind, leaves)), jnp.result_type(float))


def _kind(leaf: ArrayLike) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and dtype, which an array says without any rules of promotion."""
    known = leaf if isinstance(leaf, (jax.Array, np.ndarray)) else jnp.asarray(leaf)
    return known.shape, known.dtype


@functools.lru_cache(maxsize=128)
def _structure(rest: Hashable, kinds: tuple[tuple[tuple[int, ...], np.dtype], ...], precision: np.dtype) -> Carrier:
    """Traced once for all machines of a form, in the `precision` in force: a trace takes longer than many a run."""
    machine = jax.tree.unflatten(rest, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds])
    return eqx.filter_eval_shape(lambda machine: machine.carrier(), machine)
