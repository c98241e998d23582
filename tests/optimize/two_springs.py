"""Design problems in the two supports of a two-mass machine, with their optima known."""

import jax.numpy as jnp
from scenes import scene

from optimize import Quantity, total

SCENE = scene("two_mass", speed=120.0)
"""Stiffness (5e4, 3e4) N/m of the supports, 2e5 N/m of the link."""

FREE = {"machine.stiffness": (1e4, 9e4, "even")}
NEAREST = Quantity("distance", "N^2/m^2", lambda s: jnp.sum((s.machine.stiffness - jnp.array([6e4, 5e4])) ** 2))
FIRST = Quantity("first", "N/m", lambda s: s.machine.stiffness[0])
SUM = total("machine.stiffness")
