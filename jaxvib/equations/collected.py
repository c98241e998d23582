"""Collected loads as rigid bodies, and the torques on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import jammed_loads
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import total_gravity
from jaxvib.machine.scene import Scene

__all__ = [
    "Bodies",
    "Points",
    "bodies",
    "circle",
    "each_load",
    "has_half_turn",
    "light_friction",
    "load_torque",
    "rotor_torque",
    "torque_of_each",
    "torque_slopes",
]

Points = Array | np.ndarray


class Bodies(NamedTuple):
    """The loads as G bodies that do not change their shape: loads that are alike are one, each load for itself otherwise.

    **Attributes**: `unbalance` S (G,) kg m, `inertia` I = sum kappa m R^2 and `drag` sum b_W R^2 (G,) of each body; `offsets`
    (count,) rad: where each load is on its body, an angle ahead of the body's own.
    """

    unbalance: Array
    inertia: Array
    drag: Array
    offsets: Array


def bodies(scene: Scene) -> Bodies:
    """The collected loads of the scene as bodies. **Raises** `InputError` for a rotor out of balance."""
    loads = jammed_loads(scene)
    for effect in scene.effects:
        if effect.has_imbalance:
            raise InputError(
                f"effects.{effect.kind}", "shakes the machine at the rotor's own speed, so that no motion repeats; leave it out"
            )
    inertia = loads.inertia_factor() * loads.mass * loads.radius**2
    if loads.alike:
        n = loads.count
        return Bodies(loads.unbalance()[None], n * inertia[None], loads.drag_sum()[None], loads.offsets())
    each = [loads.mass * loads.radius, inertia, loads.drag * loads.radius**2]
    return Bodies(*(jnp.broadcast_to(x, (loads.count,)) for x in each), offsets=loads.offsets())


def has_half_turn(scene: Scene) -> bool:
    """Whether the equations stay the same under phi + pi, -q: effects on the loads (gravity) break it."""
    return all(effect.half_turn_symmetric for effect in scene.effects)


def each_load(scene: Scene, phi: Points, rate: Array) -> tuple[Array, Array]:
    """Angles and rates of bodies (G, M) as those of each load (count, M)."""
    shape = (scene.loads.count, phi.shape[1])
    return jnp.asarray(phi) + jammed_loads(scene).offsets()[:, None], jnp.broadcast_to(rate, shape)


def rotor_torque(scene: Scene, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
    """The rotor's torque on loads at angles `phi`, N m: viscous resistance and dry friction.

    `a` (np, ...): the port's acceleration, m/s^2.
    """
    loads, u, rates = scene.loads, (jnp.asarray(phi),), (rate,)
    at = dict(zip(scene.machine.structure().axes, a, strict=True))
    gravity = total_gravity(scene.effects)
    found = (effect.friction(loads, u, rates, speed, gravity) for effect in scene.effects)
    torque = loads.resistance(u, rates, speed)[0]
    return sum((friction.torque(at) for friction in found if friction is not None), torque)


def torque_of_each(scene: Scene, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
    """The torque of the rotor and of effects on loads at angles `phi`, N m; `a` as in `rotor_torque`."""
    # Side by side, loads in contact press on each other, which turns the group as a whole nowhere.
    acting = (effect for effect in scene.effects if not effect.couples_loads)
    forces = (effect.load_force(scene.loads, (jnp.asarray(phi),)) for effect in acting)
    return sum((force[0] for force in forces if force is not None), rotor_torque(scene, phi, rate, speed, a))


def load_torque(
    scene: Scene, phi: Points, rate: Array, speed: Array, a: Array, of_each: Callable[..., Array] = torque_of_each
) -> Array:
    """The torque on the bodies at angles `phi` (G, M), N m, the sum `of_each` over the loads of each, (G, M); `a` (np, M)."""
    loads = jammed_loads(scene)
    if not loads.alike:
        return jax.vmap(lambda p, r, x: of_each(scene, p, r, speed, x), in_axes=1, out_axes=1)(phi, rate, a)
    if loads.own_radius is None:
        return loads.count * of_each(scene, phi, rate, speed, a[:, None])
    return jnp.sum(of_each(scene, *each_load(scene, phi, rate), speed, a[:, None]), axis=0, keepdims=True)


def torque_slopes(scene: Scene, phi: Points, rate: Array, speed: Array, a: Array) -> tuple[Array, Array, Array]:
    """Derivatives of `load_torque` by angle and by rate of each body (G, M) and by the port's acceleration (np, G, M)."""
    angle = jnp.asarray(phi)
    by_angle = jax.jvp(lambda p: load_torque(scene, p, rate, speed, a), (angle,), (jnp.ones_like(angle),))[1]
    by_rate = jax.jvp(lambda r: load_torque(scene, angle, r, speed, a), (rate,), (jnp.ones_like(rate),))[1]
    axes = (jnp.zeros_like(a).at[k].set(1.0) for k in range(a.shape[0]))
    by_a = [jax.jvp(lambda x: load_torque(scene, angle, rate, speed, x), (a,), (axis,))[1] for axis in axes]
    return by_angle, by_rate, jnp.stack(by_a)


def light_friction(scene: Scene, omega: Array, speed: Array) -> Array:
    """Torque of dry friction on light loads that turn at `omega`, N m, all together: a carrier that hardly moves adds nothing
    to their radial load, and their weight, on the average of a turn, neither."""
    loads = jammed_loads(scene)
    phi, rate = (jnp.zeros((loads.count,)),), (jnp.full((loads.count,), omega),)
    found = (effect.friction(loads, phi, rate, speed, 0.0) for effect in scene.effects)
    return sum((jnp.sum(friction.torque({})) for friction in found if friction is not None), jnp.zeros_like(omega))


def circle(scene: Scene, phi: Points) -> tuple[Array, Array]:
    """e(phi) and de/dphi (np, ...): where a load on the unit circle is in the port's directions, and how it moves."""
    cos, sin = jnp.cos(phi), jnp.sin(phi)
    axes = scene.machine.structure().axes
    return jnp.stack([(cos, sin)[axis] for axis in axes]), jnp.stack([(-sin, cos)[axis] for axis in axes])
