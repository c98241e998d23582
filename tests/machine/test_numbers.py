"""Numbers of scenes by name: where they stand, what a designer calls them, in which unit they are shown."""

import jax.numpy as jnp
import numpy as np
import pytest
from rotors import machine as rotor_machine
from scenes import scene

import jaxvib as jv
from jaxvib.machine.numbers.named import find_number, put_numbers, read_value
from jaxvib.units import shown_unit


@pytest.mark.parametrize(
    ("unit", "size", "shown", "factor"),
    [
        ("N/m", 1e3, "N/mm", 1e-3),
        ("N/m", 999.0, "N/m", 1.0),
        ("m", 0.5, "mm", 1e3),
        ("meter", 1e-5, "mm", 1e3),
        ("m", 9e-6, "um", 1e6),
        ("m", 1.0, "m", 1.0),
        ("m", 0.0, "m", 1.0),
        ("rad/s", 3.0, "rpm", 30.0 / np.pi),
        ("rad", 3.0, "deg", 180.0 / np.pi),
        ("kg", 0.5, "g", 1e3),
        ("kg", 1.0, "kg", 1.0),
        ("kg", 0.0, "kg", 1.0),
        ("N", 1e4, "kN", 1e-3),
        ("N", 9999.0, "N", 1.0),
        ("s", 0.5, "s", 1.0),
        ("", 1e9, "", 1.0),
    ],
)
def test_values_are_shown_in_units_that_a_designer_reads(unit, size, shown, factor):
    assert shown_unit(unit, size) == (shown, factor)


ONE, THREE = scene("one_mass", "rollers", effects=(jv.StaticImbalance(0.02),)), scene("three_mass", "pendulums")
ROTOR = jv.Scene(rotor_machine(0.1), jv.balls(count=2, mass=0.2, radius=0.08, drag=5.0), jv.ConstantSpeed(460.0))


@pytest.mark.parametrize(
    ("of", "name", "words"),
    [
        (ONE, "machine.stiffness", ["stiffness of the support"]),
        (ONE, "machine.mass", ["mass of the platform"]),
        (ONE, "loads.mass", ["mass of each roller"]),
        (ONE, "loads.radius", ["track radius of each roller"]),
        (ONE, "drive.speed", ["rotor speed"]),
        (ONE, "effects.static_imbalance.moment", ["imbalance of the rotor"]),
        (THREE, "machine.damping", [f"damping of support {k}" for k in (1, 2, 3)]),
        (THREE, "machine.mass[1]", ["mass of platform 2"]),
        (THREE, "machine.link_damping", ["damping of link 1-2", "damping of link 1-3", "damping of link 2-3"]),
        (THREE, "loads.drag[2]", ["drag of pendulum 3"]),
        (THREE, "loads.inertia", ["moment of inertia of each pendulum"]),
        (ROTOR, "machine.mass", ["mass of the rotor"]),
        (ROTOR, "machine.stiffness[1]", ["stiffness of support 2"]),
        (ROTOR, "loads.drag", ["drag of each ball"]),
    ],
)
def test_what_a_designer_calls_numbers(of, name, words):
    assert find_number(of, name, "free").words(of) == words


def test_numbers_are_read_and_put():
    whole, entry = find_number(THREE, "machine.stiffness", "free"), find_number(THREE, "machine.stiffness[1]", "free")
    assert (whole.size, entry.size, whole.unit) == (3, 1, "N/m")
    assert entry.entries < whole.entries and len(whole.entries) == 3
    np.testing.assert_array_equal(whole.read(THREE), THREE.machine.stiffness)
    np.testing.assert_array_equal(entry.read(THREE), THREE.machine.stiffness[1:2])
    np.testing.assert_array_equal(put_numbers(THREE, (entry,), jnp.array([7.0])).machine.stiffness, [1e4, 7.0, 3e3])
    both = put_numbers(THREE, (whole, entry), jnp.array([7.0, 8.0, 9.0, 5.0]))
    np.testing.assert_array_equal(both.machine.stiffness, [7.0, 5.0, 9.0])


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("machine.stiffness[3]", "does not exist; machine.stiffness has 3 entries, counted from 0"),
        ("drive.speed[0]", "does not exist; drive.speed has 1 entries"),
        ("machine.stifness", "is no number of this scene; did you mean 'machine.stiffness'"),
        ("machine.stiffness[-1]", "is no number of this scene"),
        ("machine.kind", "is 'three_mass', which is no continuous number"),
        ("loads.count", "is 4, which is no continuous number"),
        ("loads.ball_radius", "is not set in this scene; did you mean"),
        (3, "is no name of a number"),
    ],
)
def test_wrong_names_of_numbers_are_refused(name, says):
    with pytest.raises(jv.InputError) as error:
        find_number(THREE, name, "free")
    assert str(error.value).startswith(f"free.{name} {says}"), str(error.value)


def test_values_of_names_have_their_unit_and_range():
    assert read_value("machine.stiffness[1]", "2 N/mm") == 2e3
    assert read_value("drive.speed", "30 rpm") == pytest.approx(np.pi)
    assert read_value("effects.static_imbalance.moment", 0.5) == 0.5 and read_value("machine.damping", 0.0) == 0.0
    assert (
        read_value("machine.stiffness_terms[2]", "3 N m") == 3.0
        and read_value("effects.cubic_support[1].stiffness", -1.0) == -1.0
    )
    for name, value in (
        ("machine.mass", 0.0),
        ("machine.damping", -1.0),
        ("machine.nothing", 1.0),
        ("loads.mass", "1 m"),
        ("drive.breakdown_slip", 1.0),
        ("machine.stiffness_terms[3]", 1.0),
        ("effects.static_imbalance.gap", 1.0),
    ):
        with pytest.raises(jv.InputError):
            read_value(name, value)
