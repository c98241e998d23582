"""Freedoms of a rolling ball: its spin about the normal of its contact, and sliding before it rolls."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect, Typical
from jaxvib.machine.effects.terms import DrillingSpinRelease, SlipRelease, Term
from jaxvib.machine.loads import Loads, own_radius
from jaxvib.units import Number, number

__all__ = ["FreeSpin", "Sliding"]


class FreeSpin(Effect):
    """Balls in a torus spin freely about the normal of their point of contact.

        J s' = J a' (w B - R f') / r,    Q = (2/5) m r s (B a', - rho sin a f'),    J = (2/5) m r^2

    s is a ball's spin about the normal relative to the wall, one more velocity of each ball (`State.spin.drilling`, 0 at the
    start unless given); the forces Q act on its two coordinates beside those of `TorusBalls`, whose s is held at 0 by the
    contact. No moment acts about the normal of a contact at a point, so that the ball's angular velocity there changes by the
    turning of the normal alone, s' = Omega . n' + (w cos a)'. While f' is constant, s grows by (w B - R f')/r for each radian
    up the wall: a ball that left the equator with s = 0 is drawn back to it as a point mass is, with m rho B f'^2 in place of
    m rho B (7/5 f'^2 - 2/5 w f') for each radian, kappa staying in its inertia. Real contacts lie between both.

    It goes with drives of given speed; the wall's acceleration, where w changes, is left out as by `TorusBalls`.

    **Raises** `InputError`, by the scene, for loads that nothing couples to such a spin, as on a plane track, and for a motor.

    >>> import jaxvib as jv
    >>> jv.FreeSpin().terms()
    (DrillingSpinRelease(),)

    Source: derived here from Newton's and Euler's equations of the ball; asked for by no paper.
    """

    kind: str = eqx.field(static=True)

    def __init__(self) -> None:
        self.kind = "free_spin"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """It has no number."""
        return Typical(cls(), "no moment about the normal of a contact at a point")

    def terms(self) -> tuple[Term, ...]:
        """Return the freedom to spin."""
        return (DrillingSpinRelease(),)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads that are not coupled to their spin."""
        rest = loads.rest()
        if jax.eval_shape(loads.drilling_spin, rest, rest, jnp.zeros(())) is None:
            problem = f"goes with balls in a torus; nothing couples {loads.kind!r} to a spin about the normal (drilling_spin)"
            raise InputError("effects.free_spin", problem)


class Sliding(Effect):
    """The contact of a rolling load holds up to Coulomb's limit; beyond it the load slides on its track.

        |F_t| <= mu max(N, 0);    while it slides F_t = - mu N c/|c|,    (kappa - 1) m (c')_t = F_t - what rolling would need

    c is the velocity of the point of contact relative to the track, along each coordinate of a load, further velocities of each
    load (`State.spin.slip`, 0 at the start unless given: `with_spin(scene, state, "still")` for loads that do not turn yet). A
    load that slides moves as a mass alone and is turned up by the friction until it rolls, a ball from rest at 2/7 of the
    track's speed. Rolling is exact: no slip creeps in below the limit. Where |c| is below `width` the force is the nearest to

        F_t = (what rolling needs) - mu N c/width

    that the limit allows, so that the rest of a slip dies out as exp(- kappa/(kappa-1) mu N t/(m width)); steps must resolve
    it, about kappa/(kappa-1) mu R w^2/width of them a second. `RollingFriction` goes on against the motion of the centre while
    a load slides.

    **Arguments**: `coefficient` mu (about 0.1 for oiled steel on steel), above 0; `width` m/s.

    **Raises** `InputError` for values that are not allowed, and, by the scene, for loads without an own radius and a motor.

    >>> import jaxvib as jv
    >>> float(jv.Sliding(0.1).coefficient)
    0.1

    Source: derived here; Coulomb's law. Asked for by no paper.
    """

    coefficient: Array
    width: Array
    kind: str = eqx.field(static=True)

    def __init__(self, coefficient: Number, width: Number = 0.2):
        self.coefficient = number(coefficient, "", "effects.sliding.coefficient", low=0.0, open_low=True)
        self.width = number(width, "m/s", "effects.sliding.width", low=0.0, open_low=True)
        self.kind = "sliding"

    def fastest_rate(self, loads: Loads, speed: Array) -> Array:
        """Return kappa/(kappa - 1) mu R w^2 / width, at which a slip dies out."""
        kappa = loads.inertia_factor()
        return kappa / (kappa - 1.0) * self.coefficient * loads.arm()[0] * speed**2 / self.width

    def terms(self) -> tuple[Term, ...]:
        """Return the freedom to slide, with mu and the width."""
        return (SlipRelease(self.coefficient, self.width),)

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Oiled steel on steel."""
        return Typical(cls(0.1), "mu = 0.1, oiled steel on steel")

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads that do not roll."""
        own_radius(loads, "effects.sliding")
