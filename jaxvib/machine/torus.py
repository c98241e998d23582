"""Balls in a torus: loads that run around the rotor's axis and up and down the wall of their tube."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.boundary import with_known_names
from jaxvib.errors import InputError, quoted
from jaxvib.machine.loads import BALL_RADIUS, DRAG, MASS, DrillingSpin, Loads, NormalForce, require_side_by_side, side_by_side
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number
from jaxvib.units import count as whole
from jaxvib.units.known import when_known

_ROLLING = 0.4
"""kappa - 1 of a solid ball: its moment of inertia is 2/5 m r^2."""


class TorusBalls(Loads):
    """Balls on the inner wall of a tube bent to a ring, u = (f, a).

        p = (B cos f, B sin f, -rho cos a),    B = R + rho sin a,    rho = R_1 - r

    f is the angle about the rotor's axis. a is the angle in the cross-section of the tube: 0 at the smallest axial coordinate
    (the bottom of a level tube), pi/2 at the outer equator. n is the direction from the tube's middle to the ball, and
    kappa = 7/5. F_f and F_a are the other forces along f and a, such as drag and gravity:

        kappa m (B f'' + 2 rho cos a a' f') = (2/5) m w rho cos a a' + F_f
        kappa m (rho a'' - B f'^2 cos a)    = - (2/5) m w B cos a f' + F_a
        N = m (B f'^2 sin a + rho a'^2 - n . (acceleration of the mount + g e))

    - w is the rotor speed, g the acceleration of gravity, and e the unit vector against gravity
    - A ball rolls without sliding and without drilling spin. Its rotation adds the inertia (kappa - 1) m and the terms with w,
      which do no work. On a ball that turns with the tube (f' = w) the centrifugal force is that of its mass alone: in the
      second equation the term with w then cancels the part of the inertia of rotation, (2/5) m B f'^2 cos a
    - The acceleration of the wall when w changes is neglected, as in the gyroscopic matrix of a rotor
    - A ball on the equator moves like a ball in a plane track of radius R + rho

    **Attributes** (scalar, or (count,) for `mass` and `drag`); typical values: see `torus_balls`

    - `mass` m, kg
    - `radius` R of the tube's middle line, m
    - `tube` R_1: radius of its cross-section, m
    - `ball_radius` r of a ball, m
    - `drag` b_W: viscous resistance of a ball against the wall on which it rolls, N s/m
    - `count` N of balls
    - `kind`: "torus_ball"

    Source: Strautmanis et al. 2018; the ball's own rotation is derived here from Newton's and Euler's equations.
    """

    one_sided = True

    mass: Array = eqx.field(metadata=MASS)
    radius: Array = eqx.field(metadata=unit("m", low=0.0, open_low=True, words="radius of the torus"))
    tube: Array = eqx.field(metadata=unit("m", low=0.0, open_low=True, words="radius of the tube"))
    ball_radius: Array = eqx.field(metadata=BALL_RADIUS)
    drag: Array = eqx.field(metadata=DRAG)
    count: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    @property
    def gap(self) -> Array:
        """Radius rho = R_1 - r, m, of the circle in the cross-section on which the ball's centre runs."""
        return self.tube - self.ball_radius

    def _arm(self, a: Array) -> Array:
        return self.radius + self.gap * jnp.sin(a)

    def position(self, *u: Array) -> tuple[Array, Array, Array]:
        """Return (B cos f, B sin f, -rho cos a)."""
        f, a = u
        return self._arm(a) * jnp.cos(f), self._arm(a) * jnp.sin(f), -self.gap * jnp.cos(a)

    def rest(self) -> tuple[Array, Array]:
        """Return the point of the outer equator at f = -pi/2, the lowest point of a torus with a horizontal axis."""
        quarter = jnp.full((self.count,), 0.5 * jnp.pi, dtype=jnp.result_type(self.radius))
        return -quarter, quarter

    def offsets(self) -> Array:
        """Return the angles of balls side by side on the outer equator, 2 arcsin(r/(R + rho)) apart."""
        return side_by_side(self.count, self.ball_radius / (self.radius + self.gap))

    def inertia_factor(self) -> Array:
        """Return 7/5."""
        return jnp.asarray(1.0 + _ROLLING, dtype=self.mass.dtype)

    def resistance(self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array) -> tuple[Array, ...]:
        """Return - b_W (B^2 (f' - w), rho^2 a')."""
        return self.drag * self._arm(u[1]) ** 2 * (speed - rate[0]), -self.drag * self.gap**2 * rate[1]

    def spin_force(self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array) -> tuple[Array, Array]:
        """Return (2/5) m w B rho cos a (a', -f')."""
        turn = _ROLLING * self.mass * speed * self._arm(u[1]) * self.gap * jnp.cos(u[1])
        return turn * rate[1], -turn * rate[0]

    def drilling_spin(
        self, u: tuple[Array, ...], rate: tuple[Array, ...], speed: Array, slip: tuple[Array, ...] | None = None
    ) -> DrillingSpin:
        """Return s' = (a' (w B - R f') + c_f a' - c_a f' sin a)/r and the forces (2/5) m r s (B a', - rho sin a f'), with the
        slips c_f and c_a along the coordinates, 0 for a rolling ball. A ball that does not rotate in space has s = w cos a."""
        (_, a), (turn, climb), m, r = u, rate, self.mass, self.ball_radius
        arm, up = self._arm(a), jnp.sin(a)
        lever = _ROLLING * m * r
        change = climb * (speed * arm - self.radius * turn)
        if slip is not None:
            change = change + slip[0] * climb - slip[1] * turn * up
        return DrillingSpin(change / r, (lever * arm * climb, -lever * self.gap * up * turn), lever * r, speed * jnp.cos(a))

    def normal_force(self, u: tuple[Array, ...], rate: tuple[Array, ...], g: Mapping[int, Array | float]) -> NormalForce:
        """Return N against the wall of the tube."""
        (f, a), m = u, self.mass
        normal = (jnp.sin(a) * jnp.cos(f), jnp.sin(a) * jnp.sin(f), -jnp.cos(a))
        centrifugal = self._arm(a) * rate[0] ** 2 * jnp.sin(a) + self.gap * rate[1] ** 2
        return NormalForce(m * (centrifugal - sum(normal[axis] * x for axis, x in g.items())), (-m * normal[0], -m * normal[1]))

    def natural_frequency(self, speed: Array) -> Array:
        """Return w sqrt((R + rho) / (kappa rho)), rad/s, of the oscillation of turning balls about the outer equator."""
        return speed * jnp.sqrt((self.radius + self.gap) / (self.inertia_factor() * self.gap))


def require_torus_balls(loads: Loads, caller: str) -> TorusBalls:
    """Return the loads if they are balls in a torus. **Raises** `InputError` for others, which names the `caller`."""
    if not isinstance(loads, TorusBalls):
        advice = f"{caller} needs balls in a torus: torus_balls(...), in a file as `jaxvib new torus` prints it"
        raise InputError("loads.kind", f"is {quoted(loads.kind)}; {advice}")
    return loads


@with_known_names
def torus_balls(
    *,
    count: int,
    mass: Number | Sequence[Number],
    radius: Number,
    tube: Number,
    ball_radius: Number,
    drag: Number | Sequence[Number] = 0.0,
) -> TorusBalls:
    """Return balls that roll in a tube bent to a ring around the rotor's axis, kappa = 7/5.

    Their first coordinate is the angle about the axis. The second is the angle in the cross-section of the tube. `TorusBalls`
    has the equations. Dry friction is the effect `RollingFriction`, gravity along a vertical axis is `Gravity(along="axis")`.

    **Arguments** (SI, or strings with a unit)

    - `count` N: number of balls, at least 1; typical: 2
    - `mass` m of a ball, kg, one number or N; typical: 0.03 to 0.1, steel balls of 10 to 15 mm radius
    - `radius` R of the tube's middle line, m; typical: 0.2
    - `tube`: radius of the tube's cross-section, m; typical: 0.015
    - `ball_radius` r of a ball, m, less than `tube`; typical: 0.01 to 0.0145. The difference is the gap, in which the ball
      moves up and down the wall
    - `drag`: viscous resistance against the wall at the ball's centre, N s/m, one number or N; typical: 0 (the default) in air,
      0.5 to 5 in oil

    **Returns** `TorusBalls`.

    **Raises** `InputError` for

    - wrong units, a negative `drag`, and other values that are not positive
    - a ball that fills its tube or is larger
    - a `tube` that is not less than the `radius` of the ring
    - balls that have no room side by side on the outer equator

    >>> import jaxvib as jv
    >>> loads = jv.torus_balls(count=2, mass="64 g", radius="200 mm", tube="15 mm", ball_radius="12.5 mm")
    >>> round(float(loads.gap), 6)
    0.0025

    Source: Strautmanis et al. 2018.
    """
    n = whole(count, "loads.count")
    read = partial(read_numbers, TorusBalls, "loads", n)
    sizes = read(radius=radius, tube=tube, ball_radius=ball_radius)
    when_known(partial(_require_room, n), *sizes.values())
    return TorusBalls(**sizes, **read(mass=mass, drag=drag), count=n, kind="torus_ball")


def _require_room(count: int, radius: float, tube: float, ball_radius: float) -> None:
    if not tube < radius:
        raise InputError("loads.tube", f"is {tube:.6g} m; it must be less than the ring's radius, {radius:.6g} m")
    if not ball_radius < tube:
        problem = "leaves no gap in the tube" if ball_radius == tube else "is larger than the tube"
        hint = "give a smaller one, or use balls(...) for balls that only run around the axis"
        raise InputError("loads.ball_radius", f"is {ball_radius:.6g} m, which {problem} of {tube:.6g} m radius; {hint}")
    require_side_by_side(count, radius + tube - ball_radius, ball_radius)
