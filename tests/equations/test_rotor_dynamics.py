"""Rotors, motors and effects in the equations of motion, against independent derivations."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from lagrange import residual
from rotors import CASES, MASS, STATIONS, case, machine, pendulums, rotor_state
from scenes import rates_at

import jaxvib as jv


@pytest.mark.parametrize("name", CASES)
def test_equations_are_lagranges(name):
    s, t = case(name), jnp.asarray(0.7)
    left = eqx.filter_jit(lambda state: residual(s, t, state, jv.vector_field(s)(t, state)))
    for seed in range(2):
        np.testing.assert_allclose(left(rotor_state(s, seed)), 0.0, atol=2e-12)


def test_published_equations_of_the_rotor():
    """Equation (1) of the paper, written by hand with its own numbers, c2 and b2 as printed."""
    k1, k2, l1, l2, big, a_, c_, m, length, mu = 0.604e6, 0.555e6, 0.165, 0.155, 37.0, 0.479, 0.093, 0.05, 0.08, 1e-2
    c = (k1 + k2, k1 * l1 - k2 * l2, k1 * l1**2 + k2 * l2**2)
    b, accel, e, moment, gamma = (843.17, -0.47, 10.41), 230.0, 2.2e-4, 1e-3, 0.3
    s = jv.Scene(
        jv.rotor(
            mass=big,
            transverse_inertia=a_,
            polar_inertia=c_,
            stiffness=(k1, k2),
            damping=(0.0, 0.0),
            position=(l1, -l2),
            stations=STATIONS,
            damping_terms=b,
        ),
        jv.pendulums(count=4, mass=m, radius=length, drag=mu / length**2),
        jv.RunUp(460.0, accel),
        (jv.Gravity(), jv.StaticImbalance(big * e), jv.MomentImbalance((a_ - c_) * moment, angle=-gamma)),
    )
    state, t = rotor_state(s, 5), 1.1
    field = rates_at(s, jnp.asarray(t), state)
    (y, z, th, ps), (dy, dz, dth, dps), (ddy, ddz, ddth, ddps) = state.displacement, state.velocity, field.velocity
    f, df, ddf, st = state.angle[0], state.rate[0], field.rate[0], np.array(STATIONS)
    w, phi = accel * t, accel * t**2 / 2
    whole, tilted = big + 4 * m, a_ + m * np.sum(st**2)
    radial, along = df**2 * np.cos(f) + ddf * np.sin(f), df**2 * np.sin(f) - ddf * np.cos(f)
    force = m * length
    out = (a_ - c_) * moment
    sine, cosine = np.sin(phi), np.cos(phi)
    lean_sine, lean_cosine = np.sin(phi - gamma), np.cos(phi - gamma)
    rows = [
        [whole * ddy, b[0] * dy + b[1] * dth, c[0] * y + c[1] * th],
        [whole * ddz, b[0] * dz + b[1] * dps, c[0] * z + c[1] * ps],
        [tilted * ddth, c_ * w * dps, b[1] * dy + b[2] * dth, c[1] * y + c[2] * th],
        [tilted * ddps, -c_ * w * dth, b[1] * dz + b[2] * dps, c[1] * z + c[2] * ps],
    ]
    rows[0] += [-big * e * (w**2 * cosine + accel * sine), -force * np.sum(radial)]
    rows[1] += [-big * e * (w**2 * sine - accel * cosine), -force * np.sum(along)]
    rows[2] += [-out * (w**2 * lean_cosine + accel * lean_sine), -force * np.sum(st * radial)]
    rows[3] += [-out * (w**2 * lean_sine - accel * lean_cosine), -force * np.sum(st * along)]
    # The stations' sum is zero here, so that y and theta do not couple through the masses.
    for row in rows:
        assert abs(sum(row)) < 1e-11 * max(map(abs, row))
    swing = (
        m * length**2 * ddf,
        -force * np.sin(f) * (ddy + st * ddth) + force * np.cos(f) * (ddz + st * ddps),
        -mu * (w - df),
        force * 9.81 * np.cos(f),
    )
    np.testing.assert_allclose(sum(swing), 0.0, atol=1e-11 * np.max(np.abs(swing)))


def test_a_rotor_held_in_its_plane_is_the_planar_rotor():
    """Supports, loads and imbalance in the plane of the centre of mass: nothing tilts, y and z go as the planar rotor's."""
    flat = dict(stiffness=(6e5, 6e5), damping=(400.0, 400.0), position=(0.1, -0.1), stations=0.0)
    effects = (jv.Gravity(), jv.StaticImbalance(0.01))
    loads, drive = pendulums(count=2), jv.ConstantSpeed(300.0)
    whole = jv.Scene(machine(**flat), loads, drive, effects)
    plane = jv.Scene(jv.planar_rotor(mass=MASS, stiffness=1.2e6, damping=800.0), loads, drive, effects)
    state = rotor_state(plane, 1)
    padded = eqx.tree_at(
        lambda x: (x.displacement, x.velocity),
        state,
        (jnp.concatenate([state.displacement, jnp.zeros(2)]), jnp.concatenate([state.velocity, jnp.zeros(2)])),
    )
    t = jnp.asarray(0.3)
    a, b = rates_at(whole, t, padded), rates_at(plane, t, state)
    np.testing.assert_allclose(a.velocity[2:], 0.0, atol=1e-12)
    np.testing.assert_allclose(a.velocity[:2], b.velocity, rtol=1e-12)
    np.testing.assert_allclose(a.rate[0], b.rate[0], rtol=1e-12)
