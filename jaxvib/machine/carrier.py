"""The linear structure that carries the loads."""

from __future__ import annotations

import abc

import equinox as eqx
from jax import Array

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
    - `coordinates`: a name for each coordinate

    Source: the general form of all five papers; for platforms Filimonikhin et al. 2022, equations (1)-(6).
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


class Machine(eqx.Module):
    """What is built, in the designer's own numbers. A new kind of machine is a new subclass with its matrices."""

    kind: eqx.AbstractVar[str]

    @abc.abstractmethod
    def carrier(self) -> Carrier:
        """The machine as a linear structure, see `Carrier`."""
