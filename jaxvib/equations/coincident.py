"""Coincident loads as rigid bodies on the linear carrier, and the torques on them."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import JAM_TERMS, JammedModel, jammed_loads, require_terms
from jaxvib.machine.effects.base import Effect, has_half_turn, has_term, terms_of, total_gravity
from jaxvib.machine.effects.terms import ContactFriction, LoadPotential, RotorImbalance
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene

__all__ = ["COINCIDENT_TERMS", "CoincidentModel", "Points", "coincident_model", "light_friction", "require_coincident"]

COINCIDENT_TERMS = tuple(kind for kind in JAM_TERMS if kind is not RotorImbalance)
"""Terms that exact jams include. Forces between loads cancel in the torque on loads that lie together."""

Points = Array | np.ndarray


class CoincidentModel(eqx.Module):
    """A scene whose loads are G bodies that do not change their shape, assembled once a question and handed on.

    Loads that are alike are one body, loads that differ a body each.

    **Attributes**: `linear` the carrier with its loads; `loads`, `effects` of the scene; `unbalance` S (G,) kg m, `inertia`
    I = sum kappa m R^2 and `drag` sum b_W R^2 (G,) of each body; `offsets` (count,) rad: where each load is on its body, an
    angle ahead of the body's own; `half_turn` see `has_half_turn` of effects.
    """

    linear: JammedModel
    loads: CircularLoads
    effects: tuple[Effect, ...]
    unbalance: Array
    inertia: Array
    drag: Array
    offsets: Array
    half_turn: bool = eqx.field(static=True)

    def circle(self, phi: Points) -> tuple[Array, Array]:
        """e(phi) and de/dphi (np, ...): where a load on the unit circle is in the port's directions, and how it moves."""
        cos, sin = jnp.cos(phi), jnp.sin(phi)
        axes = self.linear.mount.axes
        return jnp.stack([(cos, sin)[axis] for axis in axes]), jnp.stack([(-sin, cos)[axis] for axis in axes])

    def each_load(self, phi: Points, rate: Array) -> tuple[Array, Array]:
        """Angles and rates of bodies (G, M) as those of each load (count, M)."""
        return jnp.asarray(phi) + self.offsets[:, None], jnp.broadcast_to(rate, (self.loads.count, phi.shape[1]))

    def rotor_torque(self, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
        """The rotor's torque on loads at angles `phi`, N m: viscous resistance and dry friction.

        `a` (np, ...): the port's acceleration, m/s^2.
        """
        loads, u, rates = self.loads, (jnp.asarray(phi),), (rate,)
        at = dict(zip(self.linear.mount.axes, a, strict=True))
        gravity = total_gravity(self.effects)
        found = (term.friction(loads, u, rates, speed, gravity) for term in terms_of(self.effects, ContactFriction))
        torque = loads.resistance(u, rates, speed)[0]
        return sum((friction.torque(at) for friction in found), torque)

    def torque_of_each(self, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
        """The torque of the rotor and of effects on loads at angles `phi`, N m; `a` as in `rotor_torque`."""
        torque, u = self.rotor_torque(phi, rate, speed, a), (jnp.asarray(phi),)
        for term in terms_of(self.effects, LoadPotential):
            ((force,),) = term.forces(self.loads, u, (rate,))
            torque = torque + force
        return torque

    def torque(self, phi: Points, rate: Array, speed: Array, a: Array, of_each: Callable[..., Array] | None = None) -> Array:
        """The torque on the bodies at angles `phi` (G, M), N m, the sum `of_each` (`torque_of_each`) over the loads of each,
        (G, M); `a` (np, M)."""
        of_each = self.torque_of_each if of_each is None else of_each
        if not self.loads.alike:
            return jax.vmap(lambda p, r, x: of_each(p, r, speed, x), in_axes=1, out_axes=1)(phi, rate, a)
        if self.loads.ball_radius is None:
            return self.loads.count * of_each(phi, rate, speed, a[:, None])
        return jnp.sum(of_each(*self.each_load(phi, rate), speed, a[:, None]), axis=0, keepdims=True)

    def torque_slopes(self, phi: Points, rate: Array, speed: Array, a: Array) -> tuple[Array, Array, Array | None]:
        """Derivatives of `torque` by angle and by rate of each body (G, M) and by the port's acceleration (np, G, M), None
        without friction, which alone feels it."""
        angle = jnp.asarray(phi)
        by_angle = jax.jvp(lambda p: self.torque(p, rate, speed, a), (angle,), (jnp.ones_like(angle),))[1]
        by_rate = jax.jvp(lambda r: self.torque(angle, r, speed, a), (rate,), (jnp.ones_like(rate),))[1]
        if not has_term(self.effects, ContactFriction):
            return by_angle, by_rate, None
        axes = (jnp.zeros_like(a).at[k].set(1.0) for k in range(a.shape[0]))
        by_a = [jax.jvp(lambda x: self.torque(angle, rate, speed, x), (a,), (axis,))[1] for axis in axes]
        return by_angle, by_rate, jnp.stack(by_a)


def coincident_model(linear: JammedModel) -> CoincidentModel:
    """The coincident loads as bodies on their carrier. **Raises** `InputError` for a rotor out of balance."""
    loads, effects = linear.loads, linear.scene.all_effects
    _require_balance(effects)
    inertia = loads.inertia_factor() * loads.mass * loads.radius**2
    if loads.alike:
        unbalance, whole, drag = linear.unbalance[None], loads.count * inertia[None], linear.drag[None]
    else:
        each = loads.mass * loads.radius, inertia, loads.drag * loads.radius**2
        unbalance, whole, drag = (jnp.broadcast_to(x, (loads.count,)) for x in each)
    return CoincidentModel(linear, loads, effects, unbalance, whole, drag, loads.offsets(), has_half_turn(effects))


def require_coincident(scene: Scene) -> CircularLoads:
    """The loads of a scene whose jams repeat. **Raises** `InputError` for a rotor out of balance, and as `jammed_loads`."""
    loads = jammed_loads(scene)
    _require_balance(scene.all_effects)
    return loads


def _require_balance(effects: tuple[Effect, ...]) -> None:
    problem = "shakes|shake the machine at the rotor's own speed, so that no motion repeats"
    require_terms(effects, COINCIDENT_TERMS, problem, "or simulate")


def light_friction(loads: CircularLoads, effects: tuple[Effect, ...], omega: Array, speed: Array) -> Array:
    """Torque of dry friction on light loads that turn at `omega`, N m, all together: a carrier that hardly moves adds nothing
    to their radial load, and their weight, on the average of a turn, neither."""
    phi, rate = (jnp.zeros((loads.count,)),), (jnp.full((loads.count,), omega),)
    found = (term.friction(loads, phi, rate, speed, {}) for term in terms_of(effects, ContactFriction))
    return sum((jnp.sum(friction.torque({})) for friction in found), jnp.zeros_like(omega))
