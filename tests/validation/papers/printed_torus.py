"""Equations of the published toroidal balancer as printed, and its tables."""

from __future__ import annotations

from typing import NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.state import State
from jaxvib.machine.effects.base import Gravity, StaticImbalance
from jaxvib.machine.effects.rolling import RollingFriction
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.rotor import PlanarRotor
from jaxvib.machine.torus import TorusBalls, require_torus_balls
from papers.machines import ECCENTRICITY

__all__ = ["TABLES", "PrintedTorus", "PublishedRow", "cosine_torus", "gap_torus", "printed_torus"]

_TURN_WIDTH, _CLIMB_WIDTH = 0.02, 0.1
"""Widths of the smoothed signs in the printed model: of psi', in units of w; of the velocity rho a' along the wall, of e w."""


class PublishedRow(NamedTuple):
    """Row of the paper's tables.

    **Attributes**: `damping` n, `stiffness` p, `friction` k (m); for each `gap` (R_1 - r)/e the lowest initial `speed`.
    """

    damping: float
    stiffness: float
    friction: float
    gap: tuple[float, ...]
    speed: tuple[float, ...]


TABLES = (
    PublishedRow(
        0.1,
        0.005,
        2e-5,
        (0.5, 1.1, 1.9, 2.7, 3.5, 4.3, 5.1, 5.7),
        (-0.857, -0.804, -0.776, -0.881, -0.880, -0.878, -0.881, -0.880),
    ),
    PublishedRow(
        0.1,
        0.005,
        4e-5,
        (0.5, 1.1, 1.9, 2.7, 3.5, 4.3, 5.1, 5.4),
        (-0.874, -0.876, -0.873, -0.890, -0.892, -0.900, -0.901, -1.0),
    ),
    PublishedRow(
        0.145,
        0.005,
        2e-5,
        (0.5, 1.1, 1.9, 2.7, 3.5, 4.3, 5.1, 5.7),
        (-0.861, -0.846, -0.824, -0.879, -0.884, -0.882, -0.881, -0.880),
    ),
    PublishedRow(
        0.145, 0.005, 4e-5, (0.5, 1.1, 1.9, 2.7, 3.5, 4.3, 4.9), (-0.880, -0.862, -0.850, -0.891, -0.913, -0.912, -1.0)
    ),
    PublishedRow(
        0.1,
        0.003,
        4e-5,
        (0.5, 1.1, 1.7, 2.3, 2.9, 3.5, 3.9, 4.6),
        (-0.888, -0.868, -0.892, -0.929, -0.927, -0.912, -0.920, -1.0),
    ),
    PublishedRow(
        0.1,
        0.010,
        4e-5,
        (0.5, 1.1, 1.9, 2.7, 3.5, 4.3, 5.1, 5.4),
        (-0.388, -0.428, -0.565, -0.639, -0.701, -0.750, -0.868, -0.977),
    ),
)
"""Tables 1 and 2 of the paper: four rows, and two."""


class PrintedTorus(eqx.Module):
    """The paper's equations (1)-(10), as far as they can be read, for a scene of `published_torus`.

        kappa B psi'' = x'' s - y'' c - 2 rho cos a a' f' - (k/r) N (R + R_1 sin a) B/R^2 sign(psi')
        kappa rho a'' = B f'^2 cos a - g sin a - cos a (x'' c + y'' s) - e w^2 M_r/M cos a (sin psi - cos psi)
                        - (k/r) N L/rho sign(a'),              N = g cos a + R f'^2 sin a + rho a'^2

    f = w t + psi. Differences from the projection of the forces in the paper's drawing: the rotor's unbalance enters the last
    equation with the sine of psi in place of its cosine, N (per mass) lacks the acceleration of the rotor, a ball's rolling
    adds inertia to second derivatives alone, and each coordinate has a friction of its own. The lever L of the friction up the
    tube is printed as R_1, although the contact force has the lever rho. R_1 is an error of physics, but no mere misprint: the
    paper's tables come out nearer with it than with rho (`papers.torus_tables`). For comparison with the paper only.

    With R_1 the smoothed friction of the smallest ball is stiff, up to 116 w: steps that do not resolve it hide every capture
    (`jaxvib.study.capture.capture`).

    **Attributes**: the scene's parts; `lever` L m; `sine` 1, or 0 for the unbalance with the correct cosine.
    """

    machine: PlanarRotor
    loads: TorusBalls
    speed: Array
    gravity: Array
    imbalance: Array
    friction: Array
    lever: Array
    sine: Array

    def __call__(self, t: Array, state: State) -> State:
        """The time derivative of `state` at time `t`."""
        loads, w = self.loads, self.speed
        m, r, gap, kappa = loads.mass, loads.radius, loads.gap, loads.inertia_factor()
        (f, a), (turn, climb) = state.angle, state.rate
        c, s, across, up = jnp.cos(f), jnp.sin(f), jnp.cos(a), jnp.sin(a)
        cos, sin = jnp.cos(w * t), jnp.sin(w * t)
        arm = r + gap * up
        whole = self.machine.mass + loads.count * m
        normal = jnp.maximum(self.gravity * across + r * turn**2 * up + gap * climb**2, 0.0)
        pressed = normal * self.friction / loads.ball_radius
        slow = pressed * (r + loads.tube * up) / r**2 * jnp.tanh((turn - w) / (_TURN_WIDTH * w))
        stop = pressed * self.lever / gap**2 * jnp.tanh(gap * climb / (_CLIMB_WIDTH * ECCENTRICITY * w))
        lead_sin, lead_cos = s * cos - c * sin, c * cos + s * sin
        wrong = self.sine * self.imbalance * w**2 / whole * across * (lead_sin - lead_cos) / gap
        free_turn = (-2.0 * gap * across * climb * turn / arm - slow) / kappa
        free_climb = ((arm * turn**2 * across - self.gravity * up) / gap - wrong - stop) / kappa
        # whole q'' = pull + sum of what the balls' own accelerations add, which hold q'' again
        pull_x = m * (arm * turn**2 * c + 2.0 * gap * across * climb * turn * s + gap * up * climb**2 * c)
        pull_y = m * (arm * turn**2 * s - 2.0 * gap * across * climb * turn * c + gap * up * climb**2 * s)
        pull_x = jnp.sum(pull_x + m * (arm * s * free_turn - gap * across * c * free_climb))
        pull_y = jnp.sum(pull_y - m * (arm * c * free_turn + gap * across * s * free_climb))
        (x, y), (vx, vy) = state.displacement, state.velocity
        pull_x = pull_x - self.machine.stiffness * x - self.machine.damping * vx + self.imbalance * w**2 * cos
        pull_y = pull_y - self.machine.stiffness * y - self.machine.damping * vy + self.imbalance * w**2 * sin
        xx = whole - jnp.sum(m / kappa * (s**2 + (across * c) ** 2))
        xy = jnp.sum(m / kappa * (1.0 - across**2) * s * c)
        yy = whole - jnp.sum(m / kappa * (c**2 + (across * s) ** 2))
        det = xx * yy - xy**2
        ax, ay = (yy * pull_x - xy * pull_y) / det, (xx * pull_y - xy * pull_x) / det
        turned = free_turn + (ax * s - ay * c) / (kappa * arm)
        climbed = free_climb - across * (ax * c + ay * s) / (kappa * gap)
        return State(state.velocity, jnp.stack([ax, ay]), state.rate, (turned, climbed))


def printed_torus(scene: Scene) -> PrintedTorus:
    """Return the paper's equations for a scene of `published_torus`, to the letter: the friction up the tube has the lever R_1.

    `ensemble` and `capture` take this function as their `equations`; see `PrintedTorus`.
    """
    gravity, imbalance, rolling = scene.all_effects
    assert isinstance(gravity, Gravity) and isinstance(imbalance, StaticImbalance) and isinstance(rolling, RollingFriction)
    machine, loads = cast(PlanarRotor, scene.machine), require_torus_balls(scene.loads, "the paper")
    one = jnp.ones_like(loads.gap)
    return PrintedTorus(machine, loads, scene.drive.speed, gravity.g, imbalance.moment, rolling.coefficient, loads.tube, one)


def gap_torus(scene: Scene) -> PrintedTorus:
    """Return `printed_torus` with the correct lever of the friction up the tube, the gap R_1 - r."""
    printed = printed_torus(scene)
    return eqx.tree_at(lambda p: p.lever, printed, printed.loads.gap)


def cosine_torus(scene: Scene) -> PrintedTorus:
    """Return `printed_torus` with the correct projection of the rotor's unbalance onto the tube, the cosine."""
    printed = printed_torus(scene)
    return eqx.tree_at(lambda p: p.sine, printed, jnp.zeros_like(printed.sine))
