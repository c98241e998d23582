"""Exact jams under dry friction against the full equations, and the leading order that leads to them."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gyroscopic_rotor import rotor
from jax.flatten_util import ravel_pytree
from periodic import integrate, monodromy, ordered
from scenes import machines

import jaxvib as jv
from jaxvib.steady.bodies import has_half_turn, torque_slopes


def dry(coefficient=0.1, **more):
    return jv.DryFriction(coefficient, diameter=0.02, **more)


def alike(*effects, mass=1.0, **more):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    return jv.Scene(machine, jv.pendulums(count=2, mass=mass, radius=0.1, drag=0.7, **more), jv.ConstantSpeed(50.0), effects)


def different(*effects):
    loads = jv.pendulums(count=2, mass=[0.6, 0.9], radius=0.1, drag=[0.7, 1.1], inertia=[0.0, 1e-3])
    return jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(60.0), effects)


def side_by_side(*effects):
    loads = jv.balls(count=3, mass=0.5, radius=0.1, drag=0.7, own_radius=0.02)
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), loads, jv.ConstantSpeed(50.0), effects)


def on_a_rotor(*effects):
    return eqx.tree_at(lambda s: s.effects, rotor(0.093, (1.1e6, 0.8e6), mass=0.8), effects, is_leaf=lambda x: x == ())


CASES = {
    "two loads": (lambda: alike(dry()), 26.5),
    "two loads, gravity": (lambda: alike(dry(), jv.Gravity()), 26.5),
    "loads that differ, gravity": (lambda: different(dry(), jv.Gravity()), 45.0),
    "rotor": (lambda: on_a_rotor(dry(0.3)), 135.0),
    "run-up": (lambda: alike(dry(reaction="run_up")), 26.5),
}


@functools.cache
def solved(name):
    make, omega = CASES[name]
    orbit = jv.jam_orbit(make(), omega=omega)
    return eqx.tree_at(lambda s: s.drive.speed, make(), orbit.rotor_speed), orbit


@pytest.mark.parametrize("name", CASES)
def test_orbit_multipliers_and_power_are_those_of_the_full_equations(name):
    scene, orbit = solved(name)
    assert bool(orbit.status == jv.OrbitStatus.found) and float(orbit.residual) < 1e-12
    assert np.max(np.abs(integrate(scene, orbit, 1)[-1])) < 1e-8 * max(1.0, float(orbit.multiplier))
    expected = [*orbit.multipliers, 1.0]
    if scene.loads.alike:
        expected = [*orbit.multipliers[:-2], *np.tile(orbit.multipliers[-2:], scene.loads.count - 1), 1.0]
    np.testing.assert_allclose(ordered(monodromy(scene, orbit)), ordered(expected), atol=1e-7)

    theta = 2.0 * jnp.pi * jnp.arange(256) / 256
    given, taken = jax.vmap(lambda x: jv.power(scene, 0.0, jv.State(*orbit.at(x))))(theta)
    np.testing.assert_allclose(orbit.power, np.mean(given), rtol=1e-9)
    np.testing.assert_allclose(orbit.power, np.mean(taken), rtol=1e-9)
