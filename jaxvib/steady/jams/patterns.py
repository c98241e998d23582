"""Phase patterns of loads."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import Array


class PhasePattern(eqx.Enumeration):
    """Relative phases of loads that turn at one speed. The value of each member is the message shown to the user."""

    together = "all together"
    opposite = "in two opposite groups"
    spread = "spread around the circle, cancelling each other"
    other = "at other phases"


def phase_pattern(phase: Array) -> PhasePattern:
    """Return the pattern of phases (count,) rad, from their resultants |mean exp(i k phase)| for k = 1 and 2.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> bool(phase_pattern(jnp.array([0.0, 0.1, 3.1, 3.2])) == jv.PhasePattern.opposite)
    True
    """
    first, second = (jnp.abs(jnp.mean(jnp.exp(1j * k * phase))) for k in (1, 2))
    pattern = PhasePattern.where(first < 0.1, PhasePattern.spread, PhasePattern.other)
    pattern = PhasePattern.where((first < 0.25) & (second > 0.9), PhasePattern.opposite, pattern)
    return PhasePattern.where(first > 0.9, PhasePattern.together, pattern)
