"""Rolling friction of balls and rollers on their track."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import require_one_of
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect, Typical
from jaxvib.machine.effects.friction import length, sliding_share, sliding_sign
from jaxvib.machine.effects.terms import ContactFriction, Coordinates, Friction, Term
from jaxvib.machine.loads import Loads, ball_radius
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number

Direction = Literal["along", "each"]


class RollingFriction(Effect):
    """Coulomb's rolling friction: a moment k N at the contact against the rolling of a load on the rotor's wall.

        Q_u = - (k/r) |N| J^T d,    v = J (u' - (w, 0, ...)),    d = v tanh(|v|/width)/|v|

    - Q_u are the generalized forces on the coordinates u of a load, whose centre is at p(u), and J = dp/du. v is the velocity
      of the load's centre along the wall relative to the rotor, which turns at w
    - N is the normal force (`Loads.normal_force`), solved together with the accelerations; r is the radius of the load
    - In a torus max(N, 0) replaces |N|: a ball that does not press on the wall has no friction. The track of loads on a circle
      can also pull, and then has the same friction
    - With the exact sign, a load does not move if the force on it is the fraction s < 1 of the largest friction. With the
      smooth sign it creeps at the speed width artanh(s), which tends to 0 with the width
    - The equations contain N times its sign in place of |N|; this sign is computed from the accelerations without this friction

    **Arguments** (SI, or strings with a unit)

    - `coefficient` k, m, at least 0; typical: about 2e-5 to 4e-5 for steel balls on steel, 0 for none
    - `direction`: "along" the rolling (the default), or "each": for each coordinate separately, d_i = tanh(v_i/width), as
      printed in the source; motion around the axis then does not reduce the friction against motion in the cross-section
    - `width`, m/s: range of speeds v over which the sign is smoothed; typical: 0.01 (the default) to 0.1; 1e-4 to 1e-3 for
      balls that stick near the balanced motion. A smaller width is more exact and needs more steps

    **Raises** `InputError` for values that are not allowed. A scene raises it for loads without a ball radius.

    >>> import jaxvib as jv
    >>> jv.RollingFriction("0.04 mm").direction
    'along'

    Source: Strautmanis et al. 2018, equations (6)-(10), with the normal force and the levers derived again.
    """

    coefficient: Array = eqx.field(metadata=unit("m", low=0.0, words="lever of rolling friction"))
    direction: str = eqx.field(static=True)
    width: Array = eqx.field(metadata=unit("m/s", low=0.0, open_low=True, words="smoothing width of rolling friction"))
    kind: str = eqx.field(static=True)

    def __init__(self, coefficient: Number, direction: Direction = "along", width: Number = 0.01):
        given = read_numbers(RollingFriction, "effects.rolling_friction", coefficient=coefficient, width=width)
        self.coefficient, self.width = given.values()
        require_one_of(direction, get_args(Direction), "effects.rolling_friction.direction")
        self.direction = direction
        self.kind = "rolling_friction"

    @classmethod
    def typical(cls, machine: Machine, loads: Loads, speed: Array, amplitude: Array) -> Typical:
        """Return the friction with k of steel on steel."""
        return Typical(cls(3e-5), "k = 0.03 mm, steel on steel")

    def terms(self) -> tuple[Term, ...]:
        """Return the friction. Without gravity, the half turn phi -> phi + pi, q -> -q does not change the normal force."""
        return (ContactFriction(self.friction, is_half_turn_symmetric=True, smoothing=lambda loads: self.width / loads.radius),)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for loads that do not roll on a track."""
        ball_radius(loads, "effects.rolling_friction")

    def friction(self, loads: Loads, u: Coordinates, rate: Coordinates, speed: Array, g: Mapping[int, Array]) -> Friction:
        """Return the friction with the levers -(k/r) J^T d and the normal force N.

        **Arguments**: `loads` at `u` with rates `rate`; rotor `speed`, rad/s; gravity `g` by axis, m/s^2.
        """
        normal_force = loads.normal_force(u, rate, g)
        assert normal_force is not None
        slip = (rate[0] - speed, *rate[1:])
        scale = self.coefficient / ball_radius(loads)
        if self.direction == "each":
            levers = [self._lever(loads, u, i, x) for i, x in enumerate(slip)]
        else:
            v = jax.jvp(loads.position, u, slip)[1]
            share = sliding_share(length(v), self.width)
            levers = jax.vjp(loads.position, *u)[1](tuple(share * x for x in v))
        first, *others = (-scale * lever for lever in levers)
        return Friction(first, *normal_force, tuple(others), loads.one_sided)

    def _lever(self, loads: Loads, u: tuple[Array, ...], i: int, slip: Array) -> Array:
        """Return |dp/du_i| tanh(|dp/du_i| slip / width)."""
        direction = tuple(jnp.ones_like(x) if k == i else jnp.zeros_like(x) for k, x in enumerate(u))
        size = length(jax.jvp(loads.position, u, direction)[1])
        return size * sliding_sign(size * slip, self.width)
