"""Design problems in the two supports of a two-mass machine, with their optima known."""

import jax.numpy as jnp
import numpy as np
from scenes import scene

from optimize import Quantity, total
from optimize.search.problem import Point

SCENE = scene("two_mass", speed=120.0)
"""Stiffness (5e4, 3e4) N/m of the supports, 2e5 N/m of the link."""

FREE = {"machine.stiffness": (1e4, 9e4, "even")}
NEAREST = Quantity("distance", "N^2/m^2", lambda s: jnp.sum((s.machine.stiffness - jnp.array([6e4, 5e4])) ** 2))
FIRST = Quantity("first", "N/m", lambda s: s.machine.stiffness[0])
SUM = total("machine.stiffness")


def plain(name, function):
    """A quantity of the two stiffnesses x, y in 1e4 N/m."""
    return Quantity(name, "", lambda s: function(*(s.machine.stiffness / 1e4)))


def point_of(z, values, slopes, pieces=None, piece_gradients=None):
    """Designs with these values and derivatives, which follow no jams."""
    if pieces is None:
        pieces, piece_gradients = np.zeros((len(z), 0)), np.zeros((len(z), 0, z.shape[1]))
    return Point(z, values, slopes, (), (), pieces, piece_gradients)
