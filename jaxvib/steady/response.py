"""The carrier's answer to loads that turn at a given speed, all collected at one point."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Carrier
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene

__all__ = ["loaded_mass", "magnitude", "natural_frequencies", "steady_displacement"]


def loaded_mass(scene: Scene) -> Array:
    """M + sum_j m_j B^T B (nd, nd) kg: the carrier's mass matrix with the loads' masses at the port."""
    carrier = scene.machine.carrier()
    mass = jnp.sum(jnp.broadcast_to(scene.loads.mass, (scene.loads.count,)))
    return carrier.mass + mass * carrier.port.T @ carrier.port


def natural_frequencies(scene: Scene) -> Array:
    """Undamped natural frequencies of the carrier with its loads, ascending, (nd,) rad/s.

        det(K - w^2 (M + sum_j m_j B^T B)) = 0

    Derivatives are finite for equal frequencies, and taken as 0 at frequency 0 (a carrier that is free to drift).

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> [round(float(w), 4) for w in jv.natural_frequencies(form.scene())]
    [0.3333, 1.0]

    Source: the antiphase paper, equations (19), (23).
    """
    return _modes(scene)[0]


def _modes(scene: Scene) -> tuple[Array, Array]:
    """Natural frequencies (nd,) and mass-normalised mode shapes (nd, nd), a column a mode."""
    factor = jnp.linalg.cholesky(loaded_mass(scene))
    half = jax.scipy.linalg.solve_triangular(factor, scene.machine.carrier().stiffness, lower=True)
    square, vectors = jnp.linalg.eigh(jax.scipy.linalg.solve_triangular(factor, half.T, lower=True))
    shapes = jax.scipy.linalg.solve_triangular(factor.T, vectors, lower=False)
    # What rounding leaves of a 0 is no frequency.
    moves = square > 4.0 * square.shape[0] * jnp.finfo(square.dtype).eps * jnp.max(square)
    return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0), shapes


def circular_loads(scene: Scene) -> CircularLoads:
    """The scene's loads, where a formula holds for loads on a circle only."""
    if not isinstance(scene.loads, CircularLoads):
        raise InputError("loads.kind", f"is {scene.loads.kind!r}; this holds for loads on a circle: ball, roller, pendulum")
    return scene.loads


def turning(carrier: Carrier) -> Array:
    """e (np,): a point that turns at a speed w with unit radius moves by Re(e exp(i w t)) at the port."""
    return jnp.asarray([(1.0, -1.0j)[axis] for axis in carrier.axes])


def steady_displacement(scene: Scene, omega: Array) -> Array:
    """Complex amplitudes Y (nd,) m of the carrier under loads that turn together at `omega` (scalar, rad/s).

        (K - w^2 (M + sum m_j B^T B) + i w C) Y = S w^2 B^T e,     q(t) = Re(Y exp(i w t)),    S = sum m_j R_j

    the angle of the loads being w t. It is the limit of light loads (eps -> 0) of a jam.

    Source: Filimonikhin et al. 2022, section 4; the antiphase paper, equations (25)-(29).
    """
    carrier = scene.machine.carrier()
    if carrier.gyroscopic is not None:
        raise InputError("machine.kind", f"is {scene.machine.kind!r}; leading-order jams hold for machines of platforms")
    stiffness = carrier.stiffness - omega**2 * loaded_mass(scene) + 1j * omega * carrier.damping
    force = circular_loads(scene).unbalance() * omega**2 * (carrier.port.T @ turning(carrier))
    return small_solve(stiffness, force)


def magnitude(value: Array) -> Array:
    """|value| of complex numbers, with derivative 0 in place of NaN where the value is exactly 0."""
    square = value.real**2 + value.imag**2
    zero = square == 0.0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def small_solve(a: Array, b: Array) -> Array:
    """x of a x = b; written out for 1, 2 and 3 equations (many times faster than a library call under `vmap`)."""
    n = b.shape[0]
    if n == 1:
        return b / a[0, 0]
    if n == 2:
        det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        return jnp.stack([a[1, 1] * b[0] - a[0, 1] * b[1], a[0, 0] * b[1] - a[1, 0] * b[0]]) / det
    if n == 3:
        rows = [[a[i, 0], a[i, 1], a[i, 2]] for i in range(3)]
        minors = [_cross(rows[1], rows[2]), _cross(rows[2], rows[0]), _cross(rows[0], rows[1])]
        det = sum(rows[0][k] * minors[0][k] for k in range(3))
        return jnp.stack([sum(minors[i][k] * b[i] for i in range(3)) for k in range(3)]) / det
    return jnp.linalg.solve(a, b)


def _cross(x: list[Array], y: list[Array]) -> list[Array]:
    return [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
