"""The carrier's answer to loads that turn at a given speed, all collected at one point."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Carrier
from jaxvib.machine.contact import LoadContact
from jaxvib.machine.drive import IdealDrive
from jaxvib.machine.effects import Effect, Gravity, MomentImbalance, StaticImbalance
from jaxvib.machine.friction import DryFriction
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene

__all__ = ["dynamic_stiffness", "loaded_mass", "magnitude", "natural_frequencies", "steady_displacement"]


def loaded_mass(scene: Scene) -> Array:
    """M + sum_j m_j B_j^T B_j (nd, nd) kg: the carrier's mass matrix with the loads' masses at the port or their stations."""
    carrier = scene.machine.carrier()
    each = jnp.broadcast_to(scene.loads.mass, (scene.loads.count,))
    if carrier.stations is None:
        return carrier.mass + jnp.sum(each) * carrier.port.T @ carrier.port
    rows = jax.vmap(carrier.port_at)(carrier.stations)
    return carrier.mass + jnp.einsum("j,jka,jkb->ab", each, rows, rows)


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
    square, inverse = relative_to(loaded_mass(scene), scene.machine.carrier().stiffness)
    values, vectors = hermitian_modes(square)
    return root_or_zero(values), inverse.T @ vectors


def relative_to(metric: Array, matrix: Array) -> tuple[Array, Array]:
    """L^-1 A L^-T (nd, nd) and L^-1 of a positive definite metric L L^T; its eigenvalues solve A x = value L L^T x."""
    n = metric.shape[0]
    if n > 3:
        eye = jnp.eye(n, dtype=metric.dtype)
        inverse = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(metric), eye, lower=True)
    else:
        inverse = _small_factor_inverse(metric)
    return inverse @ matrix @ inverse.T, inverse


def _small_factor_inverse(metric: Array) -> Array:
    """L^-1 of L L^T up to 3 x 3, written out: see `_small_modes`."""
    n = metric.shape[0]
    zero = jnp.zeros_like(metric[0, 0])
    factor: list[list[Array]] = [[zero] * n for _ in range(n)]
    inverse: list[list[Array]] = [[zero] * n for _ in range(n)]
    for i in range(n):
        for j in range(i):
            factor[i][j] = (metric[i, j] - sum(factor[i][k] * factor[j][k] for k in range(j))) / factor[j][j]
        factor[i][i] = jnp.sqrt(metric[i, i] - sum(factor[i][k] ** 2 for k in range(i)))
        for j in range(i):
            inverse[i][j] = -sum(factor[i][k] * inverse[k][j] for k in range(j, i)) / factor[i][i]
        inverse[i][i] = 1.0 / factor[i][i]
    return jnp.stack([jnp.stack(row) for row in inverse])


def root_or_zero(values: Array) -> Array:
    """Roots of eigenvalues that are never negative; what rounding cannot tell from 0 is 0, and so is its derivative."""
    there = values > 4.0 * values.shape[0] * jnp.finfo(values.dtype).eps * jnp.max(values, initial=0.0)
    return jnp.where(there, jnp.sqrt(jnp.where(there, values, 1.0)), 0.0)


@jax.custom_jvp
def hermitian_modes(square: Array) -> tuple[Array, Array]:
    """Ascending eigenvalues (..., n) and eigenvectors (..., n, n) of Hermitian matrices.

    The vectors of equal eigenvalues, which are not unique, have derivative 0 among each other in place of NaN.
    """
    if square.shape[-1] > 3 or jnp.iscomplexobj(square):
        return jnp.linalg.eigh(square)
    return _small_modes(square)


def _small_modes(square: Array) -> tuple[Array, Array]:
    """Eigenvalues and vectors of real symmetric matrices up to 3 x 3 by Jacobi's rotations, written out.

    Not for speed alone: on two cores, library calls for large batches in one program can wait for each other for
    ever (jaxlib 0.10), and machines of up to three platforms are the ones that are judged by the hundred thousand.
    """
    n = square.shape[-1]
    entries = tuple(tuple(square[..., i, j] for j in range(n)) for i in range(n))
    axes = tuple(tuple(jnp.full_like(square[..., 0, 0], float(i == j)) for j in range(n)) for i in range(n))

    def sweep(_: int, state: tuple) -> tuple:
        a, v = ([list(row) for row in part] for part in state)
        for p in range(n - 1):
            for q in range(p + 1, n):
                off = a[p][q]
                ratio = (a[q][q] - a[p][p]) / (2.0 * jnp.where(off == 0.0, 1.0, off))
                tangent = jnp.where(ratio < 0.0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.sqrt(ratio**2 + 1.0))
                tangent = jnp.where(off == 0.0, 0.0, tangent)
                cosine = 1.0 / jnp.sqrt(tangent**2 + 1.0)
                sine = tangent * cosine
                a[p][p], a[q][q] = a[p][p] - tangent * off, a[q][q] + tangent * off
                a[p][q] = a[q][p] = jnp.zeros_like(off)
                for r in range(n):
                    if r not in (p, q):
                        a[r][p], a[r][q] = cosine * a[r][p] - sine * a[r][q], sine * a[r][p] + cosine * a[r][q]
                        a[p][r], a[q][r] = a[r][p], a[r][q]
                    v[r][p], v[r][q] = cosine * v[r][p] - sine * v[r][q], sine * v[r][p] + cosine * v[r][q]
        return tuple(tuple(row) for row in a), tuple(tuple(row) for row in v)

    a, v = jax.lax.fori_loop(0, (0, 0, 1, 6)[n], sweep, (entries, axes))
    values = jnp.stack([a[i][i] for i in range(n)], axis=-1)
    vectors = jnp.stack([jnp.stack(row, axis=-1) for row in v], axis=-2)
    order = jnp.argsort(values, axis=-1)
    return jnp.take_along_axis(values, order, -1), jnp.take_along_axis(vectors, order[..., None, :], -1)


@hermitian_modes.defjvp
def _hermitian_modes_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    values, vectors = hermitian_modes(*primals)
    change = (tangents[0] + tangents[0].conj().mT) / 2.0
    turned = vectors.conj().mT @ change @ vectors
    gap = values[..., None, :] - values[..., :, None]
    top = jnp.max(jnp.abs(values), axis=-1)[..., None, None]
    apart = jnp.abs(gap) > values.shape[-1] * jnp.finfo(values.dtype).eps * top
    mixing = jnp.where(apart, turned / jnp.where(apart, gap, 1.0), 0.0)
    return (values, vectors), (jnp.diagonal(turned, axis1=-2, axis2=-1).real, vectors @ mixing)


def circular_loads(scene: Scene) -> CircularLoads:
    """The scene's loads, where a formula holds for loads on a circle at one point of the machine only."""
    loads = turning_loads(scene)
    require_one_point(scene)
    return loads


def jammed_loads(scene: Scene) -> CircularLoads:
    """The same where a formula is that of jams: loads that slip on the rotor, with or without dry friction."""
    loads = turning_loads(scene, (*_EFFECTS, DryFriction))
    require_one_point(scene)
    return loads


def require_one_point(scene: Scene) -> None:
    """**Raises** `InputError` where loads have stations of their own along the machine's axis."""
    if scene.machine.structure().stations is not None:
        problem = (
            "differ; this holds for loads that run at one point of the machine: ask phase_jams for their jams, or simulate"
        )
        raise InputError("machine.stations", problem)


_EFFECTS = (Gravity, StaticImbalance, MomentImbalance, LoadContact)
"""Effects that change nothing in what loads do on the average of a turn, or that whoever asks deals with."""


def turning_loads(scene: Scene, effects: tuple[type[Effect], ...] = _EFFECTS) -> CircularLoads:
    """The scene's loads, where a formula holds for loads on circles that a drive of given speed turns."""
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {scene!r}; it must be a Scene, for example load_scene('machine.toml')")
    if not isinstance(scene.loads, CircularLoads):
        raise InputError("loads.kind", f"is {scene.loads.kind!r}; this holds for loads on a circle: ball, roller, pendulum")
    if not isinstance(scene.drive, IdealDrive):
        raise InputError(
            "drive.kind", f"is {scene.drive.kind!r}; this holds at a given rotor speed: use ConstantSpeed, or simulate"
        )
    for effect in scene.effects:
        if not isinstance(effect, effects):
            raise InputError(f"effects.{effect.kind}", "is not part of this theory; leave it out here, or simulate")
    return scene.loads


def turning(carrier: Carrier) -> Array:
    """e (np,): a point that turns at a speed w with unit radius moves by Re(e exp(i w t)) at the port."""
    return jnp.asarray([(1.0, -1.0j)[axis] for axis in carrier.axes])


def dynamic_stiffness(scene: Scene, omega: Array, speed: Array | None = None) -> Array:
    """K - w^2 (M + sum m_j B^T B) + i w (C + n G) (nd, nd) complex: force per displacement at frequency `omega` (scalar).

    n is the rotor's `speed`, rad/s; if None, loads and rotor turn together at w.
    """
    carrier = scene.machine.carrier()
    n = omega if speed is None else speed
    damping = carrier.damping if carrier.gyroscopic is None else carrier.damping + n * carrier.gyroscopic
    return carrier.stiffness - omega**2 * loaded_mass(scene) + 1j * omega * damping


def steady_displacement(scene: Scene, omega: Array, speed: Array | None = None) -> Array:
    """Complex amplitudes Y (nd,) m of the carrier under loads that turn together at `omega` (scalar, rad/s).

        (K - w^2 (M + sum m_j B^T B) + i w (C + n G)) Y = S w^2 B^T e,     q(t) = Re(Y exp(i w t)),    S = sum m_j R_j

    the angle of the loads being w t. It is the limit of light loads (eps -> 0) of a jam. The rotor's `speed` n, rad/s, is asked
    for where the carrier has a gyroscopic matrix G.

    **Returns** (nd,) complex. **Raises** `InputError` for a carrier with a gyroscopic matrix where no speed is given, loads at
    stations of their own, a motor in place of a given speed, and effects that this theory leaves out.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=0.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> print(abs(jv.steady_displacement(scene, 100.0)[0]))      # 0.1 100^2 / (50 100^2 - 4e4)
    0.002173913...

    Source: Filimonikhin et al. 2022, section 4; the antiphase paper, equations (25)-(29).
    """
    carrier = scene.machine.carrier()
    if carrier.gyroscopic is not None and speed is None:
        problem = "jam modes are those of platforms; ask phase_jams, or jam_orbit near a load speed"
        raise InputError("machine.kind", f"is {scene.machine.kind!r}; {problem}")
    force = jammed_loads(scene).unbalance() * omega**2 * (carrier.port.T @ turning(carrier))
    return small_solve(dynamic_stiffness(scene, omega, speed), force)


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
