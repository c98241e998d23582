"""The balanced motion and its monodromy matrix over a turn of the rotor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.dynamics import State, vector_field
from jaxvib.equations.linear import circular_loads
from jaxvib.machine.drive import ConstantSpeed
from jaxvib.machine.scene import Scene

__all__ = ["at_constant_speed", "balanced_motion", "magnus", "monodromy"]


def balanced_motion(scene: Scene, angles: Array, turn: Array) -> State:
    """The balanced motion when the rotor has turned by `turn` rad."""
    rest = jnp.zeros_like(scene.machine.carrier().mass[0])
    return State(rest, rest, (turn + angles,), (jnp.full_like(angles, 1.0) * scene.drive.speed,))


def at_constant_speed(scene: Scene) -> Scene:
    """The scene with a rotor that is at its working speed from the start."""
    return Scene(scene.machine, scene.loads, ConstantSpeed(scene.drive.speed), scene.effects)


def monodromy(scene: Scene, angles: Array, steps: int) -> Array:
    """The monodromy matrix of the balanced motion over one turn of the rotor, (2 (nd + N), 2 (nd + N)).

        x' = A(n t) x,  x = (q / R, q' / (R n), dphi, dphi' / n),     monodromy = x(turn) for x(0) = 1

    **Arguments**: `angles` (N,) rad of the loads in the rotor's frame; `steps` of the Magnus method, static. `jit`, `vmap`
    and `grad` go through it; whoever calls it makes sure that the loads cancel each other and the rotor's imbalance.
    """
    scene = at_constant_speed(scene)
    field = vector_field(scene)
    speed = scene.drive.speed
    radius = jnp.mean(circular_loads(scene).radius)
    scale = (radius, radius * speed, jnp.ones_like(speed), speed)
    nd, n = field.stiffness.shape[0], angles.shape[0]
    sizes = jnp.concatenate([jnp.full((k,), 1.0) * v for k, v in zip((nd, nd, n, n), scale, strict=True)])

    def rate(turn: Array, x: Array) -> Array:
        base = balanced_motion(scene, angles, turn)
        e = x * sizes
        state = State(e[:nd], e[nd : 2 * nd], (base.azimuth + e[2 * nd : 2 * nd + n],), (base.azimuth_rate + e[2 * nd + n :],))
        change = field(turn / speed, state)
        return jnp.concatenate([change.displacement, change.velocity, change.azimuth, change.azimuth_rate]) / (sizes * speed)

    def generator(turn: Array) -> Array:
        return jax.jacfwd(lambda x: rate(turn, x))(jnp.zeros_like(sizes))

    h = 2.0 * jnp.pi / steps

    def step(flow: Array, k: Array) -> tuple[Array, None]:
        points = (k + 0.5 + jnp.sqrt(0.15) * jnp.asarray([-1.0, 0.0, 1.0])) * h
        a, b, c = jax.vmap(generator)(points)
        return magnus(a, b, c, h) @ flow, None

    return jax.lax.scan(step, jnp.eye(sizes.shape[0], dtype=sizes.dtype), jnp.arange(steps) * 1.0)[0]


def magnus(a: Array, b: Array, c: Array, h: float | Array) -> Array:
    """The flow of x' = A x over a step `h`, from A at its three Gauss points, by a Magnus method of order 6."""
    a1, a2, a3 = h * b, jnp.sqrt(15.0) / 3.0 * h * (c - a), 10.0 / 3.0 * h * (c - 2.0 * b + a)
    c1 = _commutator(a1, a2)
    c2 = -_commutator(a1, 2.0 * a3 + c1) / 60.0
    return _exponential(a1 + a3 / 12.0 + _commutator(-20.0 * a1 - a3 + c1, a2 + c2) / 240.0)


def _exponential(a: Array) -> Array:
    """exp(a) by Taylor's series of a/16 to the twelfth power, squared four times; written out, so that it batches."""
    eye = jnp.eye(a.shape[0], dtype=a.dtype)
    series = jax.lax.fori_loop(0, 12, lambda k, x: eye + (a / 16.0) @ x / (12.0 - k), eye)
    return jax.lax.fori_loop(0, 4, lambda _, x: x @ x, series)


def _commutator(x: Array, y: Array) -> Array:
    return x @ y - y @ x
