"""Jammed loads as rigid bodies on the linear carrier, and torques on these bodies."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import JAM_TERMS, JammedModel, jammed_loads, require_terms
from jaxvib.machine.effects.base import Effect, has_half_turn_symmetry, has_term, terms_of, total_gravity
from jaxvib.machine.effects.terms import ContactFriction, LoadPotential, RotorImbalance
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene

PERIODIC_JAM_TERMS = tuple(kind for kind in JAM_TERMS if kind is not RotorImbalance)
"""Terms that exact jams include. `LoadInteraction` is not computed: forces between loads cancel in the torque on a body."""

Points = Array | np.ndarray


class JammedBodies(eqx.Module):
    """Scene whose loads are G rigid bodies. It is assembled once for each analysis and passed on.

    Loads that share each parameter (`CircularLoads.alike`) form one body: they are coincident or, if they have a `ball_radius`,
    side by side. Otherwise each load is a separate body with its own angle.

    **Attributes**

    - `linear`: carrier with its loads
    - `loads` and `effects` of the scene
    - `unbalance` S, kg m, `inertia` I = sum kappa m R^2 (kappa: inertia factor, 7/5 for balls) and `drag` sum b_W R^2 of each
      body, (G,)
    - `offsets` (count,) rad: angle of each load minus the angle of its body
    - `half_turn`: True if phi -> phi + pi, q -> -q leaves the equations unchanged, see `has_half_turn_symmetry` of effects

    In the methods, `rate` is the angular velocity of the bodies or loads and `speed` that of the rotor, rad/s; M is the number
    of samples and np the number of directions of the mount.
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
        """Return e(phi) and de/dphi (np, ...): a point of the unit circle in the mount's directions, and its derivative."""
        cos, sin = jnp.cos(phi), jnp.sin(phi)
        axes = self.linear.mount.axes
        return jnp.stack([(cos, sin)[axis] for axis in axes]), jnp.stack([(-sin, cos)[axis] for axis in axes])

    def each_load(self, phi: Points, rate: Array) -> tuple[Array, Array]:
        """Return the angles and rates of each load (count, M) from those of the bodies (G, M)."""
        return jnp.asarray(phi) + self.offsets[:, None], jnp.broadcast_to(rate, (self.loads.count, phi.shape[1]))

    def rotor_torque(self, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
        """Return the torque of viscous resistance and dry friction on loads at the angles `phi`, N m, under the acceleration
        `a` (np, ...) of the mount, m/s^2."""
        loads, u, rates = self.loads, (jnp.asarray(phi),), (rate,)
        at = dict(zip(self.linear.mount.axes, a, strict=True))
        gravity = total_gravity(self.effects)
        frictions = (term.friction(loads, u, rates, speed, gravity) for term in terms_of(self.effects, ContactFriction))
        torque = loads.resistance(u, rates, speed)[0]
        return sum((friction.torque(at) for friction in frictions), torque)

    def torque_of_each(self, phi: Points, rate: Array, speed: Array, a: Array) -> Array:
        """Return the torque of the rotor and of effects on loads at the angles `phi`, N m; `a` as in `rotor_torque`."""
        torque, u = self.rotor_torque(phi, rate, speed, a), (jnp.asarray(phi),)
        for term in terms_of(self.effects, LoadPotential):
            ((force,),) = term.forces(self.loads, u, (rate,))
            torque = torque + force
        return torque

    def torque(self, phi: Points, rate: Array, speed: Array, a: Array, of_each: Callable[..., Array] | None = None) -> Array:
        """Return the torque on the bodies (G, M), N m, without inertia torques: the sum of `of_each`, by default
        `torque_of_each`, over the loads of each body. `a` is (np, M)."""
        of_each = self.torque_of_each if of_each is None else of_each
        if not self.loads.alike:
            return jax.vmap(lambda p, r, x: of_each(p, r, speed, x), in_axes=1, out_axes=1)(phi, rate, a)
        if self.loads.ball_radius is None:
            return self.loads.count * of_each(phi, rate, speed, a[:, None])
        return jnp.sum(of_each(*self.each_load(phi, rate), speed, a[:, None]), axis=0, keepdims=True)

    def torque_slopes(self, phi: Points, rate: Array, speed: Array, a: Array) -> tuple[Array, Array, Array | None]:
        """Return the derivatives of `torque` with respect to angle and rate of each body (G, M) and to `a` (np, G, M), None
        without friction."""
        angle = jnp.asarray(phi)
        by_angle = jax.jvp(lambda p: self.torque(p, rate, speed, a), (angle,), (jnp.ones_like(angle),))[1]
        by_rate = jax.jvp(lambda r: self.torque(angle, r, speed, a), (rate,), (jnp.ones_like(rate),))[1]
        if not has_term(self.effects, ContactFriction):
            return by_angle, by_rate, None
        axes = (jnp.zeros_like(a).at[k].set(1.0) for k in range(a.shape[0]))
        by_a = [jax.jvp(lambda x: self.torque(angle, rate, speed, x), (a,), (axis,))[1] for axis in axes]
        return by_angle, by_rate, jnp.stack(by_a)


def jammed_bodies(linear: JammedModel) -> JammedBodies:
    """Return the jammed loads as bodies on their carrier. **Raises** `InputError` for an unbalanced rotor."""
    loads, effects = linear.loads, linear.scene.all_effects
    _require_balance(effects)
    inertia = loads.inertia_factor() * loads.mass * loads.radius**2
    if loads.alike:
        unbalance, whole, drag = linear.unbalance[None], loads.count * inertia[None], linear.drag[None]
    else:
        each = loads.mass * loads.radius, inertia, loads.drag * loads.radius**2
        unbalance, whole, drag = (jnp.broadcast_to(x, (loads.count,)) for x in each)
    return JammedBodies(linear, loads, effects, unbalance, whole, drag, loads.offsets(), has_half_turn_symmetry(effects))


def require_periodic_jams(scene: Scene) -> CircularLoads:
    """Return `jammed_loads` of a scene whose jams are periodic. **Raises** `InputError` also for an unbalanced rotor."""
    loads = jammed_loads(scene)
    _require_balance(scene.all_effects)
    return loads


def _require_balance(effects: tuple[Effect, ...]) -> None:
    problem = "excites|excite the machine at the rotor speed as well, so that no motion is periodic"
    require_terms(effects, PERIODIC_JAM_TERMS, problem, "or simulate")


def friction_on_light_loads(loads: CircularLoads, effects: tuple[Effect, ...], omega: Array, speed: Array) -> Array:
    """Return the torques of dry friction on light loads that turn at `omega` in a rotor of this `speed`, (count,) N m.

    The motion of the carrier is too small to change the normal force on the loads. The mean contribution of the weight over a
    turn is 0 if the normal force does not change its sign (R omega^2 > g); this is assumed at all speeds.
    """
    phi, rate = (jnp.zeros((loads.count,)),), (jnp.full((loads.count,), omega),)
    frictions = (term.friction(loads, phi, rate, speed, {}) for term in terms_of(effects, ContactFriction))
    return sum((friction.torque({}) for friction in frictions), jnp.zeros_like(omega))
