"""Balanced motion and its monodromy matrix over a turn of the rotor."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.linear import linear_model, turning_loads
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.numerics import radau
from jaxvib.numerics.linalg import eigenvalues
from jaxvib.runtime.devices import float_dtype
from jaxvib.runtime.programs import cached
from jaxvib.units import count

BATCH = 16
"""Number of rotor speeds in a batch of monodromy matrices."""

_MIN_DECAY_EXPONENT = 40.0
"""Exponent of the decay over a turn, exp(-40), above which a vibration is smaller than the rounding errors of multipliers."""

_MIN_STEPS, _MAX_STEPS = 16, 2**17
"""Limits of the number of steps in a turn. A rotor that needs more steps is allowed only if the carrier comes to rest within a
turn."""


def balanced_motion(scene: Scene, angles: Array, turn: Array) -> State:
    """Return the state of the balanced motion after the rotor has turned by `turn` rad."""
    rest = jnp.zeros(len(scene.machine.structure().coordinates), angles.dtype)
    return State(rest, rest, (turn + angles,), (jnp.full_like(angles, 1.0) * scene.drive.speed,))


def at_constant_speed(scene: Scene) -> Scene:
    """Return the scene with all drives in their final state: ideal drives turn at their working speed from the start, and
    motors that are switched off during a run are off from the start."""
    drives = [exciter.drive.settled() for exciter in scene.exciters]
    return eqx.tree_at(lambda s: [exciter.drive for exciter in s.exciters], scene, drives)


def _steps_for(scene: Scene) -> Array:
    """Return the number of steps with which `monodromy` resolves a turn and the carrier's oscillation in it."""
    linear, speed = linear_model(scene), scene.drive.speed
    fastest = jnp.max(linear.modes()[0])
    if linear.mount.gyroscopic is not None:
        half = jnp.linalg.inv(jnp.linalg.cholesky(linear.mass))
        fastest = fastest + speed * jnp.linalg.norm(half @ linear.mount.gyroscopic @ half.T)
    return jnp.clip(radau.steps_for(2.0 * jnp.pi * (fastest / speed + 2.0)), _MIN_STEPS, _MAX_STEPS)


def monodromy(scene: Scene, angles: Array, steps: int | Array) -> Array:
    """Return the monodromy matrix of the balanced motion over one turn of the rotor, (2 (nd + N), 2 (nd + N)).

        x'' = P(n t) x + Q(n t) x',  x = (q / R, dphi),     (x, x' / n)(turn) = monodromy (x, x' / n)(0)

    q are the coordinates of the machine and dphi the deviations of the load angles; R is the mean radius of the loads, and n
    the rotor speed. P and Q are the coefficients of the linearized equations.

    **Arguments**: `angles` (N,) rad of the loads in the rotor's frame, at which they cancel each other and the imbalance of the
    rotor; `steps` of `radau.transition`, a Python number (then reverse derivatives exist) or a scalar array.
    """
    scene = at_constant_speed(scene)
    field = vector_field(scene)
    speed = scene.drive.speed
    radius = jnp.mean(turning_loads(scene).radius)
    nd, n = field.stiffness_per_mass.shape[0], angles.shape[0]
    sizes = jnp.concatenate([jnp.full((nd,), 1.0) * radius, jnp.ones(n)])

    def acceleration(turn: Array, x: Array) -> Array:
        base = balanced_motion(scene, angles, turn)
        (q, dphi), (v, drate) = ((part[:nd], part[nd:]) for part in (x[: nd + n] * sizes, x[nd + n :] * sizes * speed))
        change = field(turn / speed, State(q, v, (base.azimuth + dphi,), (base.azimuth_rate + drate,)))
        return jnp.concatenate([change.velocity, change.azimuth_rate]) / (sizes * speed**2)

    still = jnp.zeros(2 * (nd + n), sizes.dtype)
    return radau.flow(lambda turn: jax.jacfwd(lambda x: acceleration(turn, x))(still), nd + n, 2.0 * np.pi, steps, sizes.dtype)


@cached
def monodromies(scene: Scene, angles: Any, speeds: Any, steps: int | None) -> Array:
    """Return monodromy matrices at rotor speeds (S,), S a multiple of `BATCH`: (S, 2 (nd + N), 2 (nd + N))."""

    def flow(speed: Array) -> Array:
        scene_at_speed = eqx.tree_at(lambda s: s.drive.speed, scene, speed)
        return monodromy(scene_at_speed, angles, _steps_for(scene_at_speed) if steps is None else steps)

    return jax.lax.map(flow, speeds, batch_size=BATCH)


@cached
def fine_and_coarse(scene: Scene, angles: Any, steps: int | None) -> tuple[Array, Array]:
    """Return the monodromy matrix at the rotor speed of the scene, and the same with half as many steps."""
    fine = _steps_for(scene) if steps is None else steps
    return monodromy(scene, angles, fine), monodromy(scene, angles, fine // 2)


def validate_steps(scene: Scene, speeds: ArrayLike, steps: int | None) -> int | None:
    """Return the validated number of `steps`; None if it is chosen for each speed.

    **Raises** `InputError` for an invalid number of steps, for speeds that are not positive, and for a rotor that is too slow:
    a vibration of the carrier then lasts longer than a turn, and the allowed number of steps does not resolve it.
    """
    values, limit = np.asarray(speeds), 0.1 * float(np.finfo(float_dtype()).max) ** 0.5
    wrong = values[~((values > 0.0) & (values < limit))]
    if wrong.size:
        raise InputError("speeds", f"contain {wrong[0]:g} rad/s; they must be greater than 0 and below {limit:.1e}")
    if steps is not None:
        return count(steps, "steps", low=2, each=64.0)
    slowest = float(np.min(np.asarray(speeds), initial=np.inf))
    # An array, because a Python number would be a constant of the program, which would then be compiled for each speed.
    speed = np.asarray(slowest, float_dtype())
    decay, needed_steps = (
        float(x) for x in _slowest_decay(eqx.tree_at(lambda s: s.drive.speed, at_constant_speed(scene), speed))
    )
    if needed_steps >= _MAX_STEPS and decay * 2.0 * np.pi / slowest < _MIN_DECAY_EXPONENT:
        problem = (
            f"is {slowest:g} rad/s, at which a turn takes more than {_MAX_STEPS} steps, and the carrier still vibrates at its "
            f"end (it decays at {max(decay, 0.0):.2g} 1/s); use a higher speed, or give machine.damping"
        )
        raise InputError("drive.speed", problem)
    return None


@cached
def _slowest_decay(scene: Scene) -> tuple[Array, Array]:
    """Return the slowest decay of vibrations of the carrier, 1/s, at the scene's rotor speed, and the number of steps in a
    turn."""
    model = linear_model(scene)
    nd = model.mass.shape[0]
    solved = jnp.linalg.solve(
        model.mass, jnp.concatenate([-model.carrier.stiffness, -model.damping(scene.drive.speed)], axis=1)
    )
    first = jnp.concatenate([jnp.zeros((nd, nd)), jnp.eye(nd)], axis=1)
    return -jnp.max(eigenvalues(jnp.concatenate([first, solved])).real), _steps_for(scene)
