"""Texts about loads that creep because their dry friction is smoothed."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.creep import creep_text
from jaxvib.motion.analysis.measure import Trajectory

SPEED, TIMES = 100.0, 5


def segment(slips):
    """Segment of a run whose two loads turn slower than the rotor by the largest `slips`, rad/s, at one time."""
    rate = np.full((TIMES, 2), SPEED)
    rate[2] -= slips
    still, time = jnp.zeros((TIMES, 2)), jnp.linspace(0.0, 1.0, TIMES)
    state = jv.State(still, still, (still,), (jnp.asarray(rate),))
    return Trajectory(time, state, still, (SPEED * time,), (jnp.full(TIMES, SPEED),))


def scene(*effects, kind=jv.balls):
    radius = {} if kind is jv.pendulums else {"ball_radius": 0.01}
    loads = kind(count=2, mass=0.1, radius=0.2, drag=0.3, **radius)
    return jv.Scene(jv.planar_rotor(mass=20.0, stiffness=3e4, damping=9.0), loads, jv.ConstantSpeed(SPEED), effects)


@pytest.mark.parametrize(
    ("slips", "beginning"),
    [
        (
            (0.01, 0.05),
            "the loads creep: dry friction is smoothed over 0.48 rpm, and the speed relative to the rotor ",
        ),
        ((0.01, 0.2), "load 1 creeps: "),
        ((-0.2, -0.09), "load 2 creeps: "),
    ],
)
def test_creep_is_slower_than_twice_the_smoothed_range(slips, beginning):
    """Rolling friction with the width 0.01 m/s on a circle of 0.2 m is smoothed over 0.05 rad/s, or 0.48 rpm."""
    assert creep_text(scene(jv.RollingFriction(2e-5, width=0.01)), segment(slips)).startswith(beginning)


def test_creep_states_its_largest_speed():
    text = creep_text(scene(jv.RollingFriction(2e-5, width=0.01)), segment((0.01, 0.05)))
    assert " is at most 0.48 rpm; exact friction would stop this motion" in text


def test_creep_of_pendulums_is_relative_to_their_width():
    rotor = scene(jv.DryFriction(0.002, diameter=0.02, width=0.3), kind=jv.pendulums)
    assert creep_text(rotor, segment((0.5, 0.1))).startswith("the loads creep: dry friction is smoothed over 2.9 rpm")
    assert creep_text(rotor, segment((0.7, 0.7))) == ""


@pytest.mark.parametrize("effects", [(), (jv.StaticImbalance(1e-3),)])
def test_loads_without_dry_friction_do_not_creep(effects):
    assert creep_text(scene(*effects), segment((0.0, 0.0))) == ""
