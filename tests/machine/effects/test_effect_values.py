"""Numbers of effects: units, bounds, labels; starts in contact, typical bearings, lengths of speeds."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.effects.friction import length
from jaxvib.machine.numbers import number_specs

POSITIVE, NOT_NEGATIVE = "greater than 0", "at least 0"
PARTS = {
    "gravity": (jv.Gravity, {"g": 9.81}, {"g": ("m/s^2", NOT_NEGATIVE, "acceleration of gravity", None)}),
    "static_imbalance": (
        jv.StaticImbalance,
        {"moment": 0.02, "angle": 0.3},
        {"moment": ("kg m", NOT_NEGATIVE, "imbalance of the rotor", None), "angle": ("rad", "", "angle of the imbalance", 1.0)},
    ),
    "moment_imbalance": (
        jv.MomentImbalance,
        {"moment": -4e-4, "angle": 0.3},
        {
            "moment": ("kg m^2", "", "moment imbalance of the rotor", 1e-4),
            "angle": ("rad", "", "angle of the moment imbalance", 1.0),
        },
    ),
    "load_contact": (
        jv.LoadContact,
        {"stiffness": 1e5, "damping": 3.0},
        {
            "stiffness": ("N/m", POSITIVE, "stiffness of contacts between loads", None),
            "damping": ("N s/m", NOT_NEGATIVE, "damping of contacts between loads", None),
            "restitution": ("", "greater than 0 and at most 1", "restitution of contacts between loads", None),
        },
    ),
    "dry_friction": (
        jv.DryFriction,
        {"coefficient": 0.002, "diameter": 0.01, "width": 0.03},
        {
            "coefficient": ("", NOT_NEGATIVE, "coefficient of dry friction", None),
            "diameter": ("m", NOT_NEGATIVE, "diameter of the bearings of the loads", None),
            "width": ("rad/s", POSITIVE, "smoothing width of dry friction", None),
        },
    ),
    "rolling_friction": (
        jv.RollingFriction,
        {"coefficient": 1e-5, "width": 0.03},
        {
            "coefficient": ("m", NOT_NEGATIVE, "lever of rolling friction", None),
            "width": ("m/s", POSITIVE, "smoothing width of rolling friction", None),
        },
    ),
    "sliding": (
        jv.Sliding,
        {"coefficient": 0.2, "width": 0.3},
        {
            "coefficient": ("", POSITIVE, "coefficient of sliding friction", None),
            "width": ("m/s", POSITIVE, "smoothing width of sliding friction", None),
        },
    ),
    "cubic_support": (
        jv.CubicSupport,
        {"stiffness": -1e9, "position": 0.2},
        {
            "stiffness": ("N/m^3", "", "stiffness of the cubic support", 1e9),
            "position": ("m", "", "position of the cubic support", 0.1),
        },
    ),
    "stop": (
        jv.Stop,
        {"stiffness": 1e6, "gap": 0.01, "damping": 5.0, "position": 0.2},
        {
            "stiffness": ("N/m", NOT_NEGATIVE, "stiffness of the stop", None),
            "gap": ("m", NOT_NEGATIVE, "gap of the stop", None),
            "damping": ("N s/m", NOT_NEGATIVE, "damping of the stop", None),
            "position": ("m", "", "position of the stop", 0.1),
        },
    ),
    "friction_support": (
        jv.FrictionSupport,
        {"force": 50.0, "width": 0.02, "position": 0.2},
        {
            "force": ("N", NOT_NEGATIVE, "friction force at the support", None),
            "width": ("m/s", POSITIVE, "smoothing width of support friction", None),
            "position": ("m", "", "position of the friction support", 0.1),
        },
    ),
}


@pytest.mark.parametrize("kind", PARTS)
def test_numbers_of_effects_have_units_bounds_and_labels(kind):
    part, given, expected = PARTS[kind]
    effect = part(**given)
    assert effect.kind == kind and {name: float(getattr(effect, name)) for name in given} == given
    found = {name: (s.unit, s.bounds.words, s.words, s.typical) for name, s in number_specs(part).items()}
    assert found == expected


@pytest.mark.parametrize("platform", [True, 0, -1, 1.0, "1"])
@pytest.mark.parametrize("kind", ["cubic_support", "stop", "friction_support"])
def test_platforms_of_supports_are_counted_from_one(kind, platform):
    part, given, _ = PARTS[kind]
    with pytest.raises(jv.InputError, match="platform"):
        part(**{name: value for name, value in given.items() if name != "position"}, platform=platform)
    with pytest.raises(jv.InputError, match="position"):
        part(**given, platform=1)


def test_balls_in_contact_start_in_their_order():
    balls = jv.balls(count=3, mass=0.1, radius=0.2, drag=0.5, ball_radius=0.01)
    contact = jv.LoadContact(1e5)
    turn = 2.0 * np.pi
    contact.validate_start(balls, (jnp.array([[0.1, 0.2, 0.3], [-1.0, 2.0, turn - 1.1]]),))
    for wrong in ((0.1, 0.3, 0.2), (0.3, 0.1, 0.5), (0.1, 0.2, turn + 0.1), (0.1, 0.1, 0.2)):
        says = re.escape(f"start.angle is {np.round(wrong, 4).tolist()} rad")
        for angles in (wrong, [[0.1, 0.2, 0.3], wrong, [0.5, 0.4, 0.3]]):
            with pytest.raises(jv.InputError, match=says):
                contact.validate_start(balls, (jnp.asarray(angles),))


def test_typical_bearing_has_a_fifth_of_the_largest_radius():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = jv.pendulums(count=2, mass=0.5, radius=[0.1, 0.25], drag=0.5)
    usual = jv.DryFriction.typical(machine, loads, jnp.asarray(60.0), jnp.zeros(1))
    assert float(usual.effect.diameter) == pytest.approx(0.05) and float(usual.effect.coefficient) == 0.0015
    assert usual.note.endswith("of 50 mm")


def test_length_of_no_speed_is_zero_with_its_slope():
    x, y = jnp.array([0.0, 3.0, -1e-9]), jnp.array([0.0, 4.0, 0.0])
    np.testing.assert_allclose(length((x, y)), [0.0, 5.0, 1e-9], rtol=1e-14)
    slopes = jax.grad(lambda x: jnp.sum(length((x, y))))(x)
    np.testing.assert_allclose(slopes, [0.0, 0.6, -1.0], rtol=1e-14)


def test_slip_decays_with_its_closed_form_rate():
    """kappa/(kappa - 1) = 7/2 of a ball."""
    loads = jv.balls(count=3, mass=0.1, radius=0.3, drag=0.5, ball_radius=0.01)
    rate = jv.Sliding(0.2, width=0.05).fastest_rate(loads, jnp.asarray(60.0))
    np.testing.assert_allclose(rate, 3.5 * 0.2 * 0.3 * 60.0**2 / 0.05, rtol=1e-12)
