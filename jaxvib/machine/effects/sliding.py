"""Additional degrees of freedom at the contacts of rolling loads: drilling spin about the normal, and sliding."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect, Typical
from jaxvib.machine.effects.terms import DrillingSpinRelease, SlipRelease, Term
from jaxvib.machine.loads import Loads, ball_radius
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number


class FreeSpin(Effect):
    """Free drilling spin of balls in a torus, about the normal of their point of contact.

        J s' = J a' (w B - R f') / r,    Q = (2/5) m r s (B a', - rho sin a f'),    J = (2/5) m r^2

    - The symbols f, a, B, R, rho, r, w and n (the normal, from the tube's middle to the ball) are those of `TorusBalls`. Omega
      is the vector of the angular velocity of the ball
    - s, the spin of a ball about the normal relative to the wall, is an additional velocity of each ball
      (`State.spin.drilling`, default: 0 at the start); typical: up to the rotor speed, 140 rad/s
    - The forces Q act on the ball's two coordinates in addition to those of `TorusBalls`, where the contact keeps s = 0
    - A point contact exerts no moment about its normal. The ball's angular velocity about the normal therefore changes only
      with the direction of the normal, s' = Omega . n' + (w cos a)'
    - While f' is constant, s grows by (w B - R f')/r per radian of a, the angle up the wall. On a ball that left the equator
      with s = 0 the restoring torque per radian is then m rho (B + 2 rho/5) f'^2, almost that of a point mass (m rho B f'^2). A
      ball without free spin has m rho B (7/5 f'^2 - 2/5 w f'). Real contacts lie between the two

    The effect needs an ideal drive; the acceleration of the wall when w changes is neglected, as in `TorusBalls`.

    **Raises** nothing. A scene with this effect raises `InputError` for a motor, and for loads that are not coupled to this
    spin, for example loads on a plane track.

    >>> import jaxvib as jv
    >>> jv.FreeSpin().terms()
    (DrillingSpinRelease(),)

    Source: derived here from Newton's and Euler's equations of the ball.
    """

    kind: str = eqx.field(static=True)

    def __init__(self) -> None:
        self.kind = "free_spin"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Return the effect, which has no parameters."""
        return Typical(cls(), "no moment about the normal of a point contact")

    def terms(self) -> tuple[Term, ...]:
        """Return the degree of freedom of the spin."""
        return (DrillingSpinRelease(),)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads that are not coupled to their spin."""
        rest = loads.rest()
        if jax.eval_shape(loads.drilling_spin, rest, rest, jnp.zeros(())) is None:
            problem = f"needs balls in a torus; {loads.kind!r} have no drilling spin"
            raise InputError("effects.free_spin", problem)


class Sliding(Effect):
    """Sliding of rolling loads beyond Coulomb's limit of their contact.

        |F_t| <= mu |N|;    while it slides F_t = - mu |N| c/|c|,    (kappa - 1) m (c')_t = F_t - F_r

    - F_t is the force of the contact on the load along the track; the index t denotes the part tangential to the track
    - In a torus max(N, 0) replaces |N|: a ball that does not press on the wall has no friction
    - F_r is the force with which the load would roll at the actual acceleration of its centre
    - c is the velocity of the point of contact relative to the track along each coordinate of a load (`State.spin.slip`,
      default: 0 at the start; `with_spin(scene, state, "none")` for loads that do not rotate yet)
    - A sliding load moves like a mass without rotation. Friction accelerates its rotation until it rolls; a ball from rest then
      has 2/7 of the track's speed
    - Rolling is exact: below the limit there is no creep

    If |c| is below `width`, the force is

        F_t = F_0 - mu |N| c/width

    with F_0 the force of the contact in the motion in which the load rolls. If F_t exceeds the limit, its size is reduced to
    the limit and its direction is kept. The remaining slip then decays as exp(- kappa/(kappa-1) mu |N| t/(m width)). Steps must
    resolve this decay: about kappa/(kappa-1) mu R w^2/width steps per second. The moment of a `RollingFriction` acts on the
    rotation of a sliding load; its direction is still that against the motion of the centre.

    **Arguments** (SI, or strings with a unit)

    - `coefficient` mu, above 0; typical: about 0.1 for oiled steel on steel, 0.15 to 0.3 dry
    - `width`, m/s, positive; typical: 0.2 (the default). Half the width needs twice the steps

    **Raises** `InputError` for values that are not allowed. A scene raises it for loads without a ball radius, and for a motor.

    >>> import jaxvib as jv
    >>> float(jv.Sliding(0.1).coefficient)
    0.1

    Source: derived here from Coulomb's law.
    """

    coefficient: Array = eqx.field(metadata=unit("", low=0.0, open_low=True, words="coefficient of sliding friction"))
    width: Array = eqx.field(metadata=unit("m/s", low=0.0, open_low=True, words="smoothing width of sliding friction"))
    kind: str = eqx.field(static=True)

    def __init__(self, coefficient: Number, width: Number = 0.2):
        given = read_numbers(Sliding, "effects.sliding", coefficient=coefficient, width=width)
        self.coefficient, self.width = given.values()
        self.kind = "sliding"

    def fastest_rate(self, loads: Loads, speed: Array) -> Array:
        """Return kappa/(kappa - 1) mu R w^2 / width, the rate at which a slip decays, 1/s."""
        kappa = loads.inertia_factor()
        return kappa / (kappa - 1.0) * self.coefficient * loads.arm()[0] * speed**2 / self.width

    def terms(self) -> tuple[Term, ...]:
        """Return the degree of freedom of sliding, with mu and the width."""
        return (SlipRelease(self.coefficient, self.width),)

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Return sliding with the mu of oiled steel on steel."""
        return Typical(cls(0.1), "mu = 0.1, oiled steel on steel")

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads that do not roll."""
        ball_radius(loads, "effects.sliding")
