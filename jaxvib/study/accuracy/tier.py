"""Tiers: methods to compute the jam of a scene, each with a test for the scenes that it supports."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from jax import Array

from jaxvib.equations.averaged import averaged_loads
from jaxvib.equations.coincident import require_coincident
from jaxvib.equations.linear import jammed_loads
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.settle import settle
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.orbits.jam_orbit import jam_orbit


class JamValues(Protocol):
    """Common quantities of the results of all tiers."""

    @property
    def omega(self) -> Array:
        """Speed of the loads, rad/s."""
        ...

    @property
    def amplitude(self) -> Array:
        """Amplitudes (nd,) m (rad for tilts), zero to peak."""
        ...

    @property
    def foundation_force(self) -> Array:
        """Amplitude of the foundation force, N, zero to peak."""
        ...


class Tier(NamedTuple):
    """Method to compute a jam.

    **Attributes**: `name`; `purpose`: text; `require(scene)` raises `InputError` if the tier does not support the scene, and
    names the property that a part of the scene lacks; `jam(scene, mode, until)` returns the result for a jam mode, integrated
    to the time `until`, s, if the tier integrates in time.
    """

    name: str
    purpose: str
    require: Callable[[Scene], object]
    jam: Callable[[Scene, int, float], JamValues]

    def refusal(self, scene: Scene) -> str | None:
        """Return a sentence with the reason why the tier does not support the scene, or None if it does.

        >>> import jaxvib as jv
        >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.DCMotor("60 rad/s", 20.0, 0.1))
        >>> [tier.name for tier in TIERS if tier.refusal(scene) is None]
        ['full']
        """
        try:
            self.require(scene)
        except InputError as problem:
            return str(problem)
        return None


TIERS = (
    Tier(
        "leading order",
        "all jams of light loads, folds; no harmonics, no transients",
        jammed_loads,
        lambda scene, mode, until: jam_modes(scene).select(mode, throw=False),
    ),
    Tier(
        "exact orbit",
        "the periodic motion of a jam with all harmonics, its stability; no transients",
        require_coincident,
        lambda scene, mode, until: jam_orbit(scene, mode=mode, throw=False),
    ),
    Tier(
        "envelope",
        "run-ups and jams of light loads; no harmonics",
        averaged_loads,
        lambda scene, mode, until: envelope(scene, until, start="jam", mode=mode, save="window", throw=False),
    ),
    Tier(
        "full",
        "every motion in time of every scene; no unstable jams",
        lambda scene: None,
        lambda scene, mode, until: settle(scene, mode=mode, throw=False),
    ),
)
"""Tiers in order of cost; the last one supports every scene."""
