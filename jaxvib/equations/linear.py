"""The carrier's answer to loads that turn at a given speed, all collected at one point."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Carrier
from jaxvib.machine.drive import IdealDrive
from jaxvib.machine.effects.base import Effect, Gravity, MomentImbalance, StaticImbalance
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import hermitian_modes, relative_to, root_or_zero, small_solve

__all__ = ["dynamic_stiffness", "loaded_mass", "natural_frequencies", "steady_displacement"]


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
    >>> print(abs(steady_displacement(scene, 100.0)[0]))      # 0.1 100^2 / (50 100^2 - 4e4)
    0.002173913...

    Source: Filimonikhin et al. 2022, section 4; the antiphase paper, equations (25)-(29).
    """
    carrier = scene.machine.carrier()
    if carrier.gyroscopic is not None and speed is None:
        problem = "jam modes are those of platforms; ask phase_jams, or jam_orbit near a load speed"
        raise InputError("machine.kind", f"is {scene.machine.kind!r}; {problem}")
    force = jammed_loads(scene).unbalance() * omega**2 * (carrier.port.T @ turning(carrier))
    return small_solve(dynamic_stiffness(scene, omega, speed), force)
