"""Dry friction at supports and in links: its force, its places, and the energy that it dissipates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv

MACHINE = jv.two_mass(mass=(30.0, 20.0), stiffness=(4e4, 3e4), damping=(9.0, 8.0), link_stiffness=2e4, link_damping=5.0)
LOADS = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
STATE = jv.State(jnp.array([1e-3, -2e-3]), jnp.array([0.3, -0.02]), (jnp.array([0.2, 1.5]),), (jnp.array([50.0, 45.0]),))


def scene(*effects):
    return jv.Scene(MACHINE, LOADS, jv.ConstantSpeed(60.0), effects)


def test_friction_in_a_plane_opposes_the_velocity():
    (term,) = jv.FrictionSupport(20.0, width=0.1).terms()
    velocity = jnp.array([0.03, -0.04])
    expected = 20.0 * np.tanh(0.5) * np.array([0.6, -0.8])
    np.testing.assert_allclose(term.force(jnp.array([5.0, 7.0]), velocity), expected, rtol=1e-14)
    np.testing.assert_allclose(term.force(jnp.ones(1), velocity[1:]), [-20.0 * np.tanh(0.4)], rtol=1e-14)
    for size in (1, 2):  # at rest: no force, and the slope F/width in every direction
        zero = jnp.zeros(size)
        np.testing.assert_array_equal(term.force(zero, zero), zero)
        np.testing.assert_allclose(jax.jacobian(lambda v, zero=zero: term.force(zero, v))(zero), 200.0 * np.eye(size))


@pytest.mark.parametrize("to", [None, 1])
def test_friction_acts_on_foundation_or_other_platform(to):
    rough, plain = scene(jv.FrictionSupport(50.0, width=0.1, platform=2, to=to)), scene()
    force = 50.0 * np.tanh((-0.02 - (0.3 if to else 0.0)) / 0.1)
    added = jv.foundation_force(rough, STATE) - jv.foundation_force(plain, STATE)
    np.testing.assert_allclose(added, [0.0 if to else force], atol=1e-12)
    model, bare = (jv.state_space(each).C[-1] for each in (rough, plain))
    np.testing.assert_allclose(model - bare, [0.0, 0.0, 0.0, 0.0 if to else 500.0], atol=1e-12)


@pytest.mark.parametrize("to", [None, 1])
def test_power_of_friction_balances_the_energy(to):
    rough = scene(jv.FrictionSupport(50.0, width=0.1, platform=2, to=to))
    change = rates_at(rough, jnp.asarray(0.0), STATE)
    growth = jax.jvp(lambda y: jv.energy(rough, y), (STATE,), (change,))[1]
    supplied, lost = jv.power(rough, jnp.asarray(0.0), STATE)
    np.testing.assert_allclose(growth, supplied - lost, rtol=1e-11)
    v = -0.02 - (0.3 if to else 0.0)
    np.testing.assert_allclose(lost - jv.power(scene(), jnp.asarray(0.0), STATE)[1], 50.0 * np.tanh(v / 0.1) * v, rtol=1e-9)


def test_several_frictions_are_written_and_read():
    effects = jv.FrictionSupport("0.1 kN", platform=1), jv.FrictionSupport(40.0, width="2 mm/s", platform=2, to=1)
    text = jv.scene_to_toml(scene(*effects))
    assert jv.scene_to_toml(jv.scene_from_toml(text)) == text
    first, second = jv.scene_from_toml(text).all_effects
    assert (float(first.force), float(first.width), first.to) == (100.0, 0.01, None)
    assert (float(second.width), second.platform, second.to) == (2e-3, 2, 1)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"platform": 2, "to": 2}, r"friction_support\.to is 2, and the friction acts between two different platforms"),
        ({"to": 1}, r"friction_support\.to is 1, and the friction acts between two different platforms"),
        ({"to": 2, "position": 0.1}, r"friction_support\.to is 2, and the friction acts between two different platforms"),
        ({"to": True}, r"friction_support\.to is True; it must be a whole number, at least 1"),
        ({"to": 3}, r"friction_support\.to is 3; the machine has platforms 1 to 2"),
        ({"width": 0.0}, r"friction_support\.width is 0"),
        ({"force": -1.0}, r"friction_support\.force is -1"),
    ],
)
def test_wrong_friction_is_refused(given, says):
    with pytest.raises(jv.InputError, match=says):
        scene(jv.FrictionSupport(**{"force": 5.0} | given))


def test_friction_in_a_link_needs_platforms():
    rotor = jv.planar_rotor(mass=3.0, stiffness=1e5, damping=1.0)
    with pytest.raises(jv.InputError, match=r"friction_support\.to names a place on a machine of kind 'planar_rotor'"):
        jv.Scene(rotor, LOADS, jv.ConstantSpeed(60.0), jv.FrictionSupport(5.0, to=2))


def test_theories_refuse_friction_by_name():
    rough = scene(jv.FrictionSupport(5.0))
    for ask in (jv.jam_modes, jv.balanced_states, jv.criterion, lambda s: jv.envelope(s, 1.0)):
        with pytest.raises(jv.InputError, match=r"^effects\.friction_support .*leave it out here, or simulate"):
            ask(rough)
