"""Numbers with units."""

import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest

import jaxvib as jv
from jaxvib.units import _FACTORS, known_number, number, numbers, to_float


@pytest.mark.parametrize(
    ("given", "unit", "expected"),
    [
        ("1500 rpm", "rad/s", 50 * np.pi),
        ("25 Hz", "rad/s", 50 * np.pi),
        ("0.025 kHz", "rad/s", 50 * np.pi),
        ("157 rad/s", "rad/s", 157.0),
        ("9000 deg/s", "rad/s", 50 * np.pi),
        ("4.4e4 N/m", "N/m", 4.4e4),
        ("44 N/mm", "N/m", 4.4e4),
        ("44 kN/m", "N/m", 4.4e4),
        ("1.5 N s/m", "N s/m", 1.5),
        ("1.5 N*s/m", "N s/m", 1.5),
        ("1.5 kg/s", "N s/m", 1.5),
        ("800 g", "kg", 0.8),
        ("120 mm", "m", 0.12),
        ("2 min", "s", 120.0),
        ("5 kg cm^2", "kg m^2", 5e-4),
        ("4.4e4", "N/m", 4.4e4),
        (44, "N/m", 44.0),
        (np.float32(2.5), "kg", 2.5),
        (jnp.asarray(2.5), "kg", 2.5),
    ],
)
def test_numbers_come_in_any_unit(given, unit, expected):
    value = number(given, unit, "field")
    assert value.shape == () and value.dtype == jnp.float64
    np.testing.assert_allclose(value, expected, rtol=1e-14)


def test_a_number_goes_to_a_program_as_it_is_known():
    """What JAX does not hold is not moved to its device first, and has the precision that it would have there."""
    plain, given = known_number("2 ms", "s", "field"), jnp.asarray(2e-3)
    assert isinstance(plain, np.ndarray) and plain.shape == () and plain.dtype == np.float64 and plain == 2e-3
    assert isinstance(known_number(given, "s", "field"), jax.Array)
    with jax.enable_x64(False):
        assert known_number(2e-3, "s", "field").dtype == np.float32
        with pytest.raises(jv.InputError, match="field is inf s; a finite number is needed"):
            known_number(1e39, "s", "field")


@pytest.mark.parametrize(("unit", "text"), [(unit, text) for unit, known in _FACTORS.items() for text in known])
def test_units_known_by_heart_are_those_of_the_library(unit, text):
    """A quantity goes through the library, a text of a common unit does not."""
    np.testing.assert_allclose(
        to_float(f"3 {text}", unit, "field"),
        to_float(pint.get_application_registry().Quantity(3.0, text), unit, "field"),
        rtol=1e-15,
    )


def test_pint_quantities_come_in():
    units = pint.get_application_registry()
    np.testing.assert_allclose(number(units.Quantity(1500.0, "rpm"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(number(units.Quantity(25.0, "Hz"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(numbers(units.Quantity([1.0, 2.0], "N/mm"), "N/m", "field", 2), [1e3, 2e3])
    np.testing.assert_allclose(numbers([units.Quantity(1.0, "N/mm"), 5.0], "N/m", "field", 2), [1e3, 5.0])
    with pytest.raises(jv.InputError, match=r"^field is '3.0 kilogram', which is not in N/m"):
        number(units.Quantity(3.0, "kg"), "N/m", "field")


@pytest.mark.parametrize(
    "text", ["1,5 N/m", "1 500 N/m", "1500 N/m 2", "N/m", "(1500 N/m", "1500 (N/m", "1500/0 N/m", "1.5 N/m,", ""]
)
def test_text_that_only_looks_like_a_number_is_refused(text):
    with pytest.raises(jv.InputError, match=r"which is not in N/m; write for example '1.5 N/m'"):
        to_float(text, "N/m", "machine.stiffness")


def test_hertz_count_as_turns_in_every_power():
    np.testing.assert_allclose(to_float("20 Hz^2", "rad^2/s^2", "hold"), 20 * 4 * np.pi**2)
    assert to_float("20 Hz", "1/s", "rate") == 20.0
