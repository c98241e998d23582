"""Drag of loads against measured drag coefficients of spheres and against the effects that simulate friction."""

import numpy as np
import pytest

import jaxvib as jv

SPEEDS = dict(radius=0.12, load_speed=80.0, rotor_speed=150.0)


def coefficient(reynolds):
    """The drag coefficient of a sphere that `drag_of` uses, from its force."""
    slip, r, density = 0.12 * 70.0, 0.02, 900.0
    viscosity = 2.0 * density * r * slip / reynolds
    drag = float(jv.drag_of("oil", ball_radius=r, viscosity=viscosity, density=density, **SPEEDS))
    return drag / (0.5 * density * np.pi * r**2 * slip)


# Measured values, as in Morsi and Alexander 1972, J. Fluid Mech. 55, table 1.
MEASURED = {0.1: 240.0, 1.0: 26.5, 10.0: 4.1, 100.0: 1.07, 1000.0: 0.46, 1e4: 0.41, 5e4: 0.488}


@pytest.mark.parametrize("reynolds", MEASURED)
def test_drag_in_oil_is_that_of_measured_spheres(reynolds):
    assert coefficient(reynolds) == pytest.approx(MEASURED[reynolds], rel=0.07)


def test_a_slow_ball_in_thick_oil_has_the_drag_of_stokes():
    drag = jv.drag_of("oil", ball_radius=0.02, viscosity=1e4, density=900.0, **SPEEDS)
    assert float(drag) == pytest.approx(6.0 * np.pi * 1e4 * 0.02, rel=0.02)


@pytest.mark.parametrize("kinematic", ["100 mm^2/s", "100 cSt", "1e-4 m^2/s"])
def test_a_kinematic_viscosity_is_multiplied_by_the_density(kinematic):
    drag = jv.drag_of("oil", ball_radius=0.02, viscosity=kinematic, density="0.9 kg/l", **SPEEDS)
    assert float(drag) == pytest.approx(float(jv.drag_of("oil", ball_radius=0.02, viscosity=0.09, density=900.0, **SPEEDS)))


def test_rolling_drag_balances_the_rolling_moment():
    """Power: the moment f N turns with the slip speed of the ball's centre divided by its radius."""
    mass, lever, r = 0.5, 3e-5, 0.02
    drag = float(jv.drag_of("rolling", mass=mass, rolling_lever=lever, ball_radius=r, **SPEEDS))
    slip, press = 0.12 * 70.0, mass * 0.12 * 80.0**2
    assert drag * slip**2 == pytest.approx(lever * press * slip / r, rel=1e-12)


def test_bearing_drag_has_the_torque_of_the_effect():
    mass, friction, bore = 0.5, 0.0015, 0.012
    drag = float(jv.drag_of("bearing", mass=mass, friction=friction, diameter=bore, **SPEEDS))
    moment = 0.5 * friction * mass * 0.12 * 80.0**2 * bore
    assert drag * 0.12**2 * 70.0 == pytest.approx(moment, rel=1e-12)


@pytest.mark.parametrize(
    ("cause", "given", "words"),
    [
        ("water", {}, "cause is 'water'; allowed: oil, rolling, bearing"),
        (
            "oil",
            dict(ball_radius=0.02, viscosity="100 mm^2/s"),
            "density is missing; the drag by oil needs ball_radius, viscosity, density",
        ),
        ("oil", dict(ball_radius=0.02, viscosity=0.1, density=900.0, mass=1.0), "mass is not used for the drag by oil"),
        ("oil", dict(ball_radius=0.02, viscosity=1e-4, density=900.0), "Reynolds number of 3.02e"),
        ("oil", dict(ball_radius=34.0, viscosity=0.1, density=900.0), "ball_radius is 34 m; it must be less than the radius"),
        ("oil", dict(ball_radius=0.02, viscosity="100 mm/s", density=900.0), "viscosity is '100 mm/s', which is not in Pa s"),
        ("oil", dict(ball_radius=0.02, viscosity="-100 cSt", density=900.0), "not in Pa s"),
        ("rolling", dict(ball_radius=0.02, mass=1.0, rolling_lever=0.01), "at most a tenth of the ball_radius"),
        ("bearing", dict(mass=1.0, friction=0.0015, diameter=0.2), "at most the radius of 0.12 m"),
    ],
)
def test_values_outside_the_validity_are_refused(cause, given, words):
    with pytest.raises(jv.InputError, match=words):
        jv.drag_of(cause, **given, **SPEEDS)


def test_loads_that_turn_with_the_rotor_have_no_such_drag():
    with pytest.raises(jv.InputError, match=r"load_speed is 150 rad/s; it must be less than the rotor_speed of 150 rad/s"):
        jv.drag_of("bearing", mass=1.0, friction=0.0015, diameter=0.02, radius=0.12, load_speed=150.0, rotor_speed=150.0)
