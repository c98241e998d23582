"""Terms that effects add to the equations of a scene. Each analysis states the types of terms that it includes.

Terms are created during a computation and contain functions (methods of their effect) or numbers. Energies are in J, forces in
N; the generalized force of a load's angle is a torque in N m. A load's coordinates `u` and their rates are tuples of (count,)
arrays. The types of terms are final; a new effect combines existing ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.machine.carrier import Machine
from jaxvib.machine.loads import CircularLoads, Loads, NormalForce

Coordinates: TypeAlias = tuple[Array, ...]
"""Arrays (count,), one for each coordinate of a load."""

Energy: TypeAlias = Callable[[Loads, Coordinates], Array]
"""Function of the loads and their coordinates that returns energies, (count,) J."""

Resistance: TypeAlias = Callable[[Loads, Coordinates, Coordinates], Coordinates]
"""Function of the loads, their coordinates and the rates of these that returns generalized forces."""


@final
@dataclass(frozen=True)
class GravityField:
    """Uniform gravity, which changes the normal forces of loads and exerts torques on unbalances and static imbalances. Its
    force on the loads themselves is a `LoadPotential`.

    **Attributes**: `axis` of a load's position against which gravity acts (0 horizontal, 1 up, 2 along the rotor's axis); `g`,
    m/s^2.
    """

    axis: int
    g: Array
    is_smooth: ClassVar[bool] = True


@final
@dataclass(frozen=True)
class LoadPotential:
    """Potential energy of each load: a single-valued function of its position, whose mean torque over a turn is therefore 0.

    **Attributes**: `energy` of loads at `u`, (count,) J; `is_smooth`: True if the force has all derivatives.
    """

    energy: Energy
    is_smooth: bool = False

    def forces(self, loads: Loads, u: Coordinates, rate: Coordinates) -> list[Coordinates]:
        """Return the generalized forces on each load."""
        return [_potential_force(self.energy, loads, u)]


@final
@dataclass(frozen=True)
class LoadResistance:
    """Force on each load that dissipates energy of its motion, such as air drag.

    **Attributes**

    - `resistance`: function of the loads, `u` and the rates of `u`; it returns the generalized force on each coordinate
    - `is_smooth`: True if the force has all derivatives
    """

    resistance: Resistance
    is_smooth: bool = False

    def forces(self, loads: Loads, u: Coordinates, rate: Coordinates) -> list[Coordinates]:
        """Return the generalized forces on each load."""
        return [self.resistance(loads, u, rate)]


@final
@dataclass(frozen=True)
class LoadInteraction:
    """Forces between loads. Their sum is zero, so that they exert no torque on all loads together. With these forces the loads
    are not exchangeable: their order on the track matters.

    **Attributes**

    - `energy` of the pairs, J, (count,)
    - `resistance`: generalized forces that dissipate energy of the relative motion, or None
    - `penetration`: function of the loads and `u` that returns the penetrations of the pairs, m, negative without contact, if
      the forces jump when a contact begins; otherwise None
    - `validate_start`: function of the loads, of `u` (..., count), and of the stations (count,) of the loads, m (None for a
      single track). It raises `InputError` if the loads cannot start there. None: every start is allowed
    """

    energy: Energy
    resistance: Resistance | None = None
    penetration: Callable[[Loads, Coordinates], Array] | None = None
    validate_start: Callable[[Loads, Coordinates, np.ndarray | None], None] | None = None
    is_smooth: ClassVar[bool] = False

    def forces(self, loads: Loads, u: Coordinates, rate: Coordinates) -> list[Coordinates]:
        """Return the generalized forces on each load: those of the potential, and those of the resistance."""
        force = _potential_force(self.energy, loads, u)
        return [force] if self.resistance is None else [force, self.resistance(loads, u, rate)]


def _potential_force(energy: Energy, loads: Loads, u: Coordinates) -> Coordinates:
    value, back = jax.vjp(lambda *v: energy(loads, v), *u)
    return tuple(-slope for slope in back(jnp.ones_like(value)))


class Imbalance(NamedTuple):
    """Imbalance of a rotor at one angle: `static` (horizontal, up) kg m, `moment` about the tilts kg m^2."""

    static: tuple[Array, Array]
    moment: tuple[Array, Array]


@final
@dataclass(frozen=True)
class RotorImbalance:
    """Imbalance of the rotor: a vector of length `amount` that turns with the rotor, `phase` ahead of its angle.

    **Attributes**: `amount`, kg m of a static imbalance, kg m^2 of a moment imbalance (`about_tilts`); `phase` rad.
    """

    amount: Array
    phase: Array
    about_tilts: bool = False
    is_smooth: ClassVar[bool] = True

    def at(self, angle: Array) -> Imbalance:
        """Return the imbalance at the rotor's `angle`, rad."""
        zero = jnp.zeros_like(self.amount)
        turned = angle + self.phase
        vector = (self.amount * jnp.cos(turned), self.amount * jnp.sin(turned))
        return Imbalance((zero, zero), vector) if self.about_tilts else Imbalance(vector, (zero, zero))


class Friction(NamedTuple):
    """Friction torque `lever` |N| on each load.

    N = `static_normal_force` + `normal_force_per_acceleration` . a is the normal force, a the acceleration of the point that
    carries the load.

    - `lever` (count,) m, with the sign of the torque on the load
    - `static_normal_force`: N at a = 0, (count,) N
    - `normal_force_per_acceleration`: two (count,) arrays (horizontal, up) in kg, or None if N does not depend on accelerations
    - `others`: levers of a load's further coordinates, if friction acts on them
    - `one_sided`: if True, the friction is 0 while N is negative
    """

    lever: Array
    static_normal_force: Array
    normal_force_per_acceleration: tuple[Array, Array] | None
    others: tuple[Array, ...] = ()
    one_sided: bool = False

    def torque(self, a: Mapping[int, Array]) -> Array:
        """Return the torque on each load if the points that carry them have the acceleration `a`, by axis, m/s^2."""
        return self.forces(a)[0]

    def forces(self, a: Mapping[int, Array]) -> tuple[Array, ...]:
        """Return the torque of the friction, and its generalized forces on the further coordinates of a load."""
        normal_force = self._normal_force(a)
        size = jnp.maximum(normal_force, 0.0) if self.one_sided else jnp.abs(normal_force)
        return tuple(lever * size for lever in (self.lever, *self.others))

    def signed(self, a: Mapping[int, Array]) -> Friction:
        """Return friction that is linear in the accelerations: N keeps the sign that it has at `a`.

        If `one_sided` is True, the friction of a load with a negative N is 0.
        """
        sign = jnp.where(self._normal_force(a) < 0.0, 0.0 if self.one_sided else -1.0, 1.0)
        return self._replace(lever=self.lever * sign, others=tuple(lever * sign for lever in self.others))

    def linear(self, a: Mapping[int, Array]) -> tuple[Array, ...]:
        """Return the `forces` of a friction returned by `signed`."""
        normal_force = self._normal_force(a)
        return tuple(lever * normal_force for lever in (self.lever, *self.others))

    def _normal_force(self, a: Mapping[int, Array]) -> Array:
        if self.normal_force_per_acceleration is None:
            return self.static_normal_force
        return NormalForce(self.static_normal_force, self.normal_force_per_acceleration).at(a)


@final
@dataclass(frozen=True)
class ContactFriction:
    """Friction of each load against the rotor, or another torque of the rotor on each load.

    **Attributes**

    - `friction`: function of the loads, `u`, the rates of `u`, the rotor speed, and gravity by axis; it returns `Friction`
    - `is_half_turn_symmetric`: True if phi -> phi + pi, q -> -q leaves the equations with the friction unchanged
    - `smoothing`: function of loads on a circle that returns the rate relative to the rotor, rad/s, over which the sign of the
      friction is smoothed; None if the sign is exact or the rate is unknown
    """

    friction: Callable[[Loads, Coordinates, Coordinates, Array, Mapping[int, Array]], Friction]
    is_half_turn_symmetric: bool = False
    smoothing: Callable[[CircularLoads], Array] | None = None
    is_smooth: ClassVar[bool] = False


@final
@dataclass(frozen=True)
class DrillingSpinRelease:
    """Additional degree of freedom: spin of rolling loads about the normal of their contact (`Loads.drilling_spin`,
    `Spin.drilling`)."""

    is_smooth: ClassVar[bool] = True


@final
@dataclass(frozen=True)
class SlipRelease:
    """Additional degree of freedom: sliding of rolling loads (`Spin.slip`).

    The contact transmits a force along the track of at most `coefficient` times N. Below the slip `width`, m/s, the friction is
    proportional to the slip, which then decays to zero (rolling).
    """

    coefficient: Array
    width: Array
    is_smooth: ClassVar[bool] = False


@final
@dataclass(frozen=True)
class SupportForce:
    """Nonlinear support of a machine.

    **Attributes**

    - `rows`: function of the machine that returns a matrix (k, nd); rows q are the k displacements x of the supported point,
      see `Machine.rows_at`
    - `energy`, J: function of x that returns a scalar, of shape (); 0 without a spring
    - `resistance`: function of x and its rate that returns the dissipative force on the foundation, (k,) N; or None
    - `is_smooth`: True if the force has all derivatives
    - `stiffness`: largest stiffness of the support, N/m, whose vibration equal steps must resolve; None if the stiffness is
      unbounded or 0
    - `damping`, N s/m: largest slope of the resistance over the velocity, for a resistance that acts at every displacement;
      explicit steps must resolve the decay that it causes. None for a contact, and without a resistance
    - `contact_damping`: damping of a contact, N s/m, whose decay equal steps must resolve; None without a damper
    - `penetration`: function of x that returns the penetration, m, negative without contact, and its direction (k,), if the
      force jumps when a contact begins; otherwise None
    - `is_link`: True if the force acts between two points of the machine, False if it acts on the foundation
    """

    rows: Callable[[Machine], Array]
    energy: Callable[[Array], Array]
    resistance: Callable[[Array, Array], Array] | None = None
    is_smooth: bool = False
    stiffness: Array | None = None
    damping: Array | None = None
    contact_damping: Array | None = None
    penetration: Callable[[Array], tuple[Array, Array]] | None = None
    is_link: bool = False

    def force(self, displacement: Array, velocity: Array) -> Array:
        """Return the force on the foundation or on the second point, (k,) N. The carrier has the opposite force."""
        force = jax.grad(self.energy)(displacement)
        return force if self.resistance is None else force + self.resistance(displacement, velocity)


Term: TypeAlias = (
    GravityField
    | LoadPotential
    | LoadResistance
    | LoadInteraction
    | RotorImbalance
    | ContactFriction
    | DrillingSpinRelease
    | SlipRelease
    | SupportForce
)
