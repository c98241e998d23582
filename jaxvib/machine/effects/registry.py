"""Registry of effects by their names in scene files and audits."""

from __future__ import annotations

from jaxvib.machine.effects.base import Effect, Gravity, MomentImbalance, StaticImbalance
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.effects.rolling import RollingFriction
from jaxvib.machine.effects.sliding import FreeSpin, Sliding
from jaxvib.machine.effects.supports import CubicSupport, FrictionSupport, Stop

EFFECTS: dict[str, type[Effect]] = {
    "gravity": Gravity,
    "static_imbalance": StaticImbalance,
    "moment_imbalance": MomentImbalance,
    "dry_friction": DryFriction,
    "rolling_friction": RollingFriction,
    "cubic_support": CubicSupport,
    "stop": Stop,
    "friction_support": FrictionSupport,
    "load_contact": LoadContact,
    "free_spin": FreeSpin,
    "sliding": Sliding,
}
"""Effects by their `kind`; each constructor takes the fields of the effect's table in a scene file."""
