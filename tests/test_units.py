"""Numbers with units."""

import datetime
import re

import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest

import jaxvib as jv
from jaxvib.display import quantity_text, shown_unit
from jaxvib.machine.files import TEMPLATES
from jaxvib.show.wheel import value_text
from jaxvib.units import Bounds, count, known_number, number, numbers
from jaxvib.units.columns import unit_factor
from jaxvib.units.reading import _FACTORS, in_own_unit, to_float, unit_ratio


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
        ("1500 min^-1", "rad/s", 50 * np.pi),
        ("1500 1/min", "rad/s", 50 * np.pi),
        ("1500 min-1", "rad/s", 50 * np.pi),
        ("1500 r/min", "rad/s", 50 * np.pi),
        ("1500 U/min", "rad/s", 50 * np.pi),
        ("1500 rev/min", "rad/s", 50 * np.pi),
        ("1500 RPM", "rad/s", 50 * np.pi),
        ("25 cps", "rad/s", 50 * np.pi),
        ("25 rps", "rad/s", 50 * np.pi),
        ("25hz", "rad/s", 50 * np.pi),
        ("60 Kg", "kg", 60.0),
        ("600 rpm", "Hz", 10.0),
        ("600 1/min", "1/s", 10.0),
        ("3 m rad^2/s^2", "m/s^2", 3.0),
        ("40 Ns/m", "N s/m", 40.0),
        ("2 kNm", "N m", 2e3),
        ("42 kgcm", "kg m", 0.42),
        ("300 kgcm2", "kg m^2", 0.03),
        ("250 gcm2", "kg m^2", 2.5e-5),
        ("40 gmm", "kg m", 4e-5),
        ("80 mNm/A", "N m/A", 0.08),
        ("100 mPas", "Pa s", 0.1),
        ("9.81 m/s2", "m/s^2", 9.81),
        ("2 PS", "W", 1470.9975),
        ("5 kgm^2", "kg m^2", 5.0),
        ("5 %", "", 0.05),
        ("72 gm", "kg m", 0.072),
        ("2 oz-in", "kg m", 2.0 * 0.028349523125 * 0.0254),
        ("10 kg-m²", "kg m^2", 10.0),
        ("30 N-s/m", "N s/m", 30.0),
        ("10 lbf-ft", "N m", 10.0 * 4.4482216152605 * 0.3048),
        ("3 kp/mm", "N/m", 3.0 * 9806.65),
        ("150 ppi", "N/m", 150.0 * 4.4482216152605 / 0.0254),
        ("10 lbm", "kg", 4.5359237),
        ("3.5 KG", "kg", 3.5),
        ("10 mils", "m", 2.54e-4),
        ("0.3 ips", "m/s", 7.62e-3),
        ("1500 u/min", "rad/s", 50 * np.pi),
        ("1500 CPM", "rad/s", 50 * np.pi),
        ("25 Hertz", "rad/s", 50 * np.pi),
        ("1500/min", "rad/s", 50 * np.pi),
        ("1500 / min", "rad/s", 50 * np.pi),
        ("\u22125 kg", "kg", -5.0),
        ("\u22125", "kg", -5.0),
        ("5e\u22123 m", "m", 5e-3),
        ("1 234 kg", "kg", 1234.0),
        ("1\u00a0234\u00a0567.5\u00a0kg", "kg", 1234567.5),
        ("12\u2009345", "N", 12345.0),
        ("4 x 1 250 N/mm", "N/m", 5e6),
        ("1\u202f500 rpm", "rad/s", 50 * np.pi),
        ("2 g", "m/s^2", 2 * 9.80665),
        ("2 g", "kg", 0.002),
        ("5 Newton", "N", 5.0),
        ("5 Newton meter", "N m", 5.0),
        ("10 ftlbf", "N m", 10.0 * 4.4482216152605 * 0.3048),
        ("5.5 KW", "W", 5500.0),
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


@pytest.mark.parametrize(
    ("given", "unit", "says"),
    [
        (1j, "", "which is not a number; write a plain number"),
        (1j, "kg", "which is not a number; write a number in kg"),
        ([1.0, 2.0], "", "field is a list of 2 values; one plain number is needed"),
        (np.ones(2), "m", r"field has shape \(2,\); one number in m is needed"),
    ],
)
def test_messages_name_the_unit_if_there_is_one(given, unit, says):
    with pytest.raises(jv.InputError, match=says):
        number(given, unit, "field")


def test_a_number_goes_to_a_program_as_it_is_known():
    """A number that JAX does not hold is not moved to its device first, and has the precision that it would have there."""
    plain, given = known_number("2 ms", "s", "field"), jnp.asarray(2e-3)
    assert isinstance(plain, np.ndarray) and plain.shape == () and plain.dtype == np.float64 and plain == 2e-3
    assert isinstance(known_number(given, "s", "field"), jax.Array)
    with jax.enable_x64(False):
        assert known_number(2e-3, "s", "field").dtype == np.float32
        with pytest.raises(jv.InputError, match="field is inf s; a finite number is needed"):
            known_number(1e39, "s", "field")
    with pytest.raises(jv.InputError, match="field is -1 s; it must be at least 0"):
        known_number(-1.0, "s", "field", low=0.0)
    with pytest.raises(jv.InputError, match="field is 0 s; it must be greater than 0"):
        known_number(0.0, "s", "field", low=0.0, open_low=True)


@pytest.mark.parametrize(("unit", "text"), [(unit, text) for unit, known in _FACTORS.items() for text in known])
def test_units_known_by_heart_are_those_of_the_library(unit, text):
    """A quantity goes through the library, a text of a common unit does not."""
    np.testing.assert_allclose(
        to_float(f"3 {text}", unit, "field"),
        to_float(pint.get_application_registry().Quantity(3.0, text), unit, "field"),
        rtol=1e-15,
    )


@pytest.mark.parametrize(
    ("si", "spellings", "unit", "multiple"),
    [
        ("s", "sec с", "s", 1.0),
        ("s", "msec мс", "ms", 1.0),
        ("s", "usec µs μs", "us", 1.0),
        ("s", "minutes", "min", 1.0),
        ("rad", "rads рад", "rad", 1.0),
        ("rad", "mrad", "rad", 1e-3),
        ("rad", "DEG ° град", "deg", 1.0),
        ("rad", "mdeg", "deg", 1e-3),
        ("rad", "gon gradians", "turn", 1.0 / 400.0),
        ("rad", "rev turns revolution", "turn", 1.0),
        ("m/s^2", "m/s² mps2", "m/s^2", 1.0),
        ("m/s^2", "mm/s2", "mm/s^2", 1.0),
        ("m/s^2", "G gn", "standard_gravity", 1.0),
        ("m/s^2", "mg", "standard_gravity", 1e-3),
        ("m/s", "mm/s", "mm/s", 1.0),
        ("m/s", "ips", "inch/s", 1.0),
        ("m", "mm", "mm", 1.0),
        ("m", "micron µm um", "um", 1.0),
        ("m", "mils", "inch", 1e-3),
        ("N", "kN", "kN", 1.0),
        ("N", "lbf", "force_pound", 1.0),
        ("rad/s", "rad/s rads", "rad/s", 1.0),
        ("rad/s", "rpm 1/min U/min min^-1", "turn/min", 1.0),
        ("rad/s", "Hz rps", "turn/s", 1.0),
        ("rad/s", "deg/s", "deg/s", 1.0),
        ("N m", "Nm N·m", "N*m", 1.0),
        ("N m", "kNm", "kN*m", 1.0),
        ("A", "mA", "mA", 1.0),
        ("Hz", "Hz Sa/s", "Hz", 1.0),
        ("Hz", "kHz kS/s", "kHz", 1.0),
    ],
)
def test_units_of_columns_are_those_of_the_library(si, spellings, unit, multiple):
    expected = multiple * pint.get_application_registry().Quantity(1.0, unit).m_as(si)
    for spelling in spellings.split():
        assert unit_factor(spelling, si) == pytest.approx(expected, rel=1e-14)


def test_pint_quantities_come_in():
    units = pint.get_application_registry()
    np.testing.assert_allclose(number(units.Quantity(1500.0, "rpm"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(number(units.Quantity(25.0, "Hz"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(number(units.Quantity(1500.0, "1/min"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(numbers(units.Quantity([1.0, 2.0], "N/mm"), "N/m", "field", 2), [1e3, 2e3])
    np.testing.assert_allclose(numbers([units.Quantity(1.0, "N/mm"), 5.0], "N/m", "field", 2), [1e3, 5.0])
    with pytest.raises(jv.InputError, match=r"^field is '3.0 kilogram', which is not in N/m"):
        number(units.Quantity(3.0, "kg"), "N/m", "field")


@pytest.mark.parametrize(
    "text", ["1 50 N/m", "15 00 N/m", "1500 N/m 2", "N/m", "(1500 N/m", "1500 (N/m", "1500/0 N/m", "1.5 N/m,", ""]
)
def test_text_that_only_looks_like_a_number_is_refused(text):
    with pytest.raises(jv.InputError, match=r"which is not in N/m; write for example '1.5 N/m'"):
        to_float(text, "N/m", "machine.stiffness")


@pytest.mark.parametrize("text", ["1_000", "1_000 N/m"])
def test_underscores_in_numbers_are_refused(text):
    with pytest.raises(jv.InputError, match=f"^stiffness is '{text}', which is not in N/m; write"):
        number(text, "N/m", "stiffness")


@pytest.mark.parametrize("text", ["30 Grad", "30 grad", "5 grad/s"])
def test_grad_is_refused_because_it_is_ambiguous(text):
    for read in (lambda: number(text, "rad", "angle"), lambda: in_own_unit(text, "angle")):
        with pytest.raises(jv.InputError, match=f"^angle is '{text}', which can mean degrees or gon; write deg or gon"):
            read()
    unit = text.split()[1]
    assert unit_factor(unit, "rad") is None and unit_factor(unit, "rad/s") is None
    assert float(number("30 gon", "rad", "angle")) == pytest.approx(0.15 * np.pi)


@pytest.mark.parametrize(
    ("text", "meanings"),
    [("2 tons", "1000 kg or 907 kg; write t"), ("1.5ton", "1000 kg or"), ("800 gr", "grams or grains; write g")],
)
def test_masses_with_several_meanings_are_refused(text, meanings):
    with pytest.raises(jv.InputError, match=f"^mass is '{text}', which can mean {meanings}"):
        number(text, "kg", "mass")
    assert float(number("1.5 metric_ton", "kg", "mass")) == 1500.0


@pytest.mark.parametrize(
    ("text", "unit", "advice"),
    [
        ("150 lb/in", "N/m", "a pound is a mass; for the force write '150 lbf/in', or N"),
        ("10 ft-lb", "N m", "a pound is a mass; for the force write '10 ft-lbf', or N"),
        ("10 ftlb", "N m", "a pound is a mass; for the force write '10 ft lbf', or N"),
        ("10 kgcm", "N m", "a kilogram is a mass; for the force write '10 kgf cm', or N"),
        ("10 oz in", "N m", "an ounce is a mass; for the force write '10 ozf in', or N"),
        ("3 kg/mm", "N/m", "a kilogram is a mass; for the force write '3 kgf/mm', or N"),
        ("10 lbs", "N", "a pound is a mass; for the force write '10 lbf', or N"),
    ],
)
def test_a_mass_in_place_of_a_force_is_refused(text, unit, advice):
    with pytest.raises(jv.InputError, match=re.escape(f"field is '{text}'; {advice}")):
        to_float(text, unit, "field")


@pytest.mark.parametrize("text", ["25 s^-1", "25 1/s", "25 /s", "25 Bq", "25 count/s"])
def test_a_speed_must_say_what_it_counts(text):
    """Revolutions and radians per second differ by 2 pi, and 1/s is neither."""
    with pytest.raises(jv.InputError, match=r"write (for example )?'1500 rpm', '157.1 rad/s' or '25 Hz'"):
        to_float(text, "rad/s", "drive.speed")
    with pytest.raises(jv.InputError, match="which is not in rad; write for example"):
        to_float("5 percent", "rad", "separation")


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("1,5 N/m", "write '1.5 N/m'"),
        ("600,0", "write '600.0'"),
        ("1,500 N/m", "write '1.500 N/m' if it is a decimal comma, otherwise '1500 N/m'"),
    ],
)
def test_a_decimal_comma_has_its_own_message(text, advice):
    with pytest.raises(jv.InputError, match=f"'{text}', with a comma; {re.escape(advice)}$"):
        to_float(text, "N/m", "machine.stiffness")


@pytest.mark.parametrize(
    ("text", "unit", "advice"),
    [
        ("1.234,5 kg", "kg", "1234.5 kg"),
        ("1,234.5 kg", "kg", "1234.5 kg"),
        ("1.234.567 kg", "kg", "1234567 kg"),
        ("1'450 rpm", "rad/s", "1450 rpm"),
        ('1.234"', "m", "1.234 in"),
        ("1.234,567'", "m", "1234.567 ft"),
        ("1/2 in", "m", "0.5 in"),
        ("1 1/2 in", "m", "1.5 in"),
        ('3/4"', "m", "0.75 in"),
        ("10″", "m", "10 in"),
        ("5'", "m", "5 ft"),
    ],
)
def test_shorthand_is_refused_with_the_right_text(text, unit, advice):
    with pytest.raises(jv.InputError, match=f"field is [\"']{re.escape(text)}[\"']; write '{re.escape(advice)}'$"):
        number(text, unit, "field")
    assert float(number(advice, unit, "field")) > 0.0


def test_long_texts_are_refused_at_once():
    for text in ("1" * 10**6 + " kg", "1 " * 10**6, "1 234" * 10**6, "1'234" * 10**6):
        with pytest.raises(jv.InputError, match="which is not in kg"):
            to_float(text, "kg", "mass")


def test_gravities_are_read_beside_an_acceleration():
    assert in_own_unit("2 g", "limit", "m/s^2") == (2 * 9.80665, "m/s^2")
    assert in_own_unit("2 g", "limit") == (0.002, "kilogram")


@pytest.mark.parametrize("text", ["4 x 55 N/mm", "4*55 N/mm", "4 × 55 N/mm"])
def test_equal_springs_side_by_side_add(text):
    assert to_float(text, "N/m", "machine.stiffness") == 220e3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("25 mm under 650 kg", 650.0 * 9.80665 / 0.025),
        ("2.5 cm under 1.2 kN", 1200.0 / 0.025),
        ("1e-2 m  under 3 kgf", 300.0 * 9.80665),
    ],
)
def test_a_stiffness_may_be_a_deflection_under_a_load(text, expected):
    assert to_float(text, "N/m", "machine.stiffness") == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("25 mm", "'25 mm', a deflection; write '25 mm under 650 kg' with the mass (or force) that this spring carries"),
        ("25 mm under 650", "'25 mm under 650', which needs a positive deflection and a positive mass or force, with units"),
        ("25 under 650 kg", "'25 under 650 kg', which needs a positive deflection"),
        ("0 mm under 650 kg", "'0 mm under 650 kg', which needs a positive deflection"),
        ("25 mm under -3 N", "'25 mm under -3 N', which needs a positive deflection"),
        ("4 x 25 mm under 650 kg", "write '25 mm under 650 kg' with the load of all together"),
        ("2,5 mm under 650 kg", "'2,5 mm', with a comma; write '2.5 mm'"),
        ("25 mm under 650 s", "'650 s', which is not in N"),
    ],
)
def test_a_deflection_without_a_load_is_refused(text, advice):
    with pytest.raises(jv.InputError, match=re.escape(advice)):
        to_float(text, "N/m", "machine.stiffness")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.3 kg x 0.24 m", 0.072),
        ("300 g*24 cm", 0.072),
        ("240 mm × 0.3 kg", 0.072),
        ("3 kg x .24 m", 0.72),
        ("2 x 0.3 kg x 0.24 m", 0.144),
        ("2 x 36 g m", 0.072),
    ],
)
def test_an_unbalance_may_be_a_mass_times_a_radius(text, expected):
    assert to_float(text, "kg m", "unbalance") == pytest.approx(expected, rel=1e-14)
    assert float(jv.StaticImbalance(text).moment) == pytest.approx(expected, rel=1e-14)
    assert float(jv.Exciter(drive=jv.ConstantSpeed("10 Hz"), unbalance=text).unbalance) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    "text", ["0.3 kg x 0.24", "0.3 x 0.24 m", "0.3 kg x 2 kg", "0.3 kg x 2 s", "-1 kg x -1 m", "1 kg x 1 m x 1 m"]
)
def test_a_product_that_is_no_unbalance_is_refused(text):
    with pytest.raises(jv.InputError, match=re.escape(f"moment is '{text}'; a product needs a mass and a radius with units")):
        jv.StaticImbalance(text)


@pytest.mark.parametrize(
    "value",
    [
        True,
        np.True_,
        jnp.asarray(True),
        1j,
        np.asarray([1.0 + 0.0j]),
        jnp.asarray(1.0 + 0.0j),
        np.ma.masked,
        np.ma.array([1.0], mask=[True]),
        datetime.date(2020, 1, 1),
        np.datetime64("2020-01-01"),
        np.timedelta64(3, "s"),
        b"12",
        None,
        [[1.0]],
        {1.0},
        np.asarray(["12"]),
        np.asarray([None], dtype=object),
        10**400,
        10**5000,
        "1" * 400,
        object(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_no_finite_real_number_is_refused(value):
    with pytest.raises(jv.InputError, match=r"^mass(\[0\])? (is|has) .{1,90}; "):
        number(value, "kg", "mass")
    with pytest.raises(jv.InputError, match=r"^mass(\[0\])? (is|has) .{1,90}; "):
        numbers([value], "kg", "mass", 1)


@pytest.mark.parametrize("value", [True, np.True_, 1.0, "3", None, 0, 10**12, 10**400, -(10**5000), [2]], ids=type)
def test_a_count_is_a_whole_number_that_an_array_can_have(value):
    with pytest.raises(jv.InputError, match=r"^samples is .{1,90}; it must be a whole number"):
        count(value, "samples")


def test_a_count_ends_where_indices_and_memory_end():
    assert count(2**31 - 1, "samples") == 2**31 - 1
    with pytest.raises(jv.InputError, match=r"is 2147483648; it must be a whole number from 1 to 2147483647"):
        count(2**31, "samples")
    with pytest.raises(jv.InputError, match=r"needs 1\.86e\+06 GiB, more than half of the computer's memory; at most \d+ fit"):
        count(2 * 10**9, "samples", each=10**6)
    with pytest.raises(jv.InputError, match=r"it must be a whole number from 1 to 2147483647"):
        count(10**20, "samples", each=10**6)


def test_bounds_without_ends_allow_every_finite_number():
    assert Bounds().words == "" and Bounds().allow(np.asarray([-1e300, 1e300, np.inf, -np.inf, np.nan])).tolist() == [
        1,
        1,
        0,
        0,
        0,
    ]


def test_an_angle_keeps_digits_within_a_turn():
    assert number(1e15, "rad", "separation") == 1e15 and number(1e16, "m", "radius") == 1e16
    with pytest.raises(jv.InputError, match=r"^separation is 1e\+16 rad; it must be below 4\.5e\+15 rad"):
        number(1e16, "rad", "separation")


def test_unknown_and_known_numbers_may_stand_in_one_list():
    """The known ones are checked, also while a program is built."""
    listed = jax.jit(lambda x: numbers([x, 2.0], "kg", "mass", 2, low=0.0))(1.0)
    assert listed.dtype == jnp.float64 and listed.tolist() == [1.0, 2.0]
    with pytest.raises(jv.InputError, match=r"^mass\[1\] is -1 kg; it must be at least 0"):
        jax.jit(lambda x: numbers([x, -1.0], "kg", "mass", 2, low=0.0))(1.0)
    with pytest.raises(jv.InputError, match=r"^mass\[1\] is .* too large; give a number below 1e308"):
        numbers([jnp.asarray(1.0), 10**400], "kg", "mass", 2)
    assert numbers([jnp.asarray(1), 10**20], "kg", "mass", 2).tolist() == [1.0, 1e20]


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_an_array_of_numbers_has_one_axis(array):
    assert (
        numbers(array([-1.0, 0.0]), "m", "x", 2).tolist() == numbers(array([-1.0, 0.0]), "m", "x", None).tolist() == [-1.0, 0.0]
    )
    with pytest.raises(jv.InputError, match=r"^x has shape \(3,\); \(2,\) is needed"):
        numbers(array([1.0, 2.0, 3.0]), "m", "x", 2)
    with pytest.raises(jv.InputError, match=r"^x has shape \(2, 2\); a list is needed"):
        numbers(array([[1.0, 2.0], [3.0, 4.0]]), "m", "x", None)


def test_numbers_have_the_precision_of_programs():
    for given in (3, np.int32(3), np.float32(3.0), jnp.asarray(3), jnp.asarray(3.0, dtype=jnp.float32)):
        assert number(given, "kg", "mass").dtype == numbers([given], "kg", "mass", 1).dtype == jnp.float64


def test_units_compare_as_what_they_count():
    """A frequency in hertz is 2 pi times itself in rad/s; radians have no dimension beside lengths."""
    assert unit_ratio("Hz", "rad/s") == pytest.approx(2.0 * np.pi, rel=1e-15)
    assert unit_ratio("rad/s", "Hz") == pytest.approx(0.5 / np.pi, rel=1e-15)
    assert unit_ratio("rps", "Hz") == pytest.approx(1.0) and unit_ratio("m rad/s", "m/s") == 1.0
    assert unit_ratio("1/s", "rad/s") is None and unit_ratio("nonsense", "m") is None


def test_a_text_has_its_own_unit_in_si():
    assert in_own_unit("2 mm", "x") == (0.002, "meter") and in_own_unit("3", "x") == (3.0, "")
    np.testing.assert_allclose(in_own_unit("10 Hz", "x")[0], 20.0 * np.pi, rtol=1e-15)
    assert in_own_unit("10 Hz", "x")[1] == in_own_unit("600 rpm", "x")[1] == "radian / second"
    for text in ("", "3 nonsense", "3,4 mm", "nan", "1 " + "m" * 10**6):
        with pytest.raises(jv.InputError, match=r"^x is "):
            in_own_unit(text, "x")


@pytest.mark.parametrize(
    ("text", "beside", "expected"),
    [
        ("600 min^-1", "", (20 * np.pi, "radian / second")),
        ("600 min^-1", "m", (20 * np.pi, "radian / second")),
        ("600 1/min", "rad/s", (20 * np.pi, "rad/s")),
        ("600 1/min", "Hz", (10.0, "Hz")),
        ("1200 rpm", "Hz", (20.0, "Hz")),
        ("180 1/min", "1/s", (3.0, "1/s")),
        ("3 1/s", "1/s", (3.0, "1/s")),
        ("3 1/s", "", (3.0, "1 / second")),
        ("3 rad/s", "1/s", (3.0, "radian / second")),
        (pint.Quantity(600.0, "1/min"), "rad/s", (20 * np.pi, "rad/s")),
    ],
)
def test_a_text_per_time_counts_as_its_neighbour(text, beside, expected):
    value, unit = in_own_unit(text, "x", beside)
    np.testing.assert_allclose(value, expected[0], rtol=1e-14)
    assert unit == expected[1]


def test_a_text_beside_a_speed_must_say_what_it_counts():
    with pytest.raises(jv.InputError, match=r"does not state radians or revolutions"):
        in_own_unit("10 1/s", "x", "rad/s")


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("cps", 2 * np.pi), ("U/min", np.pi / 30), ("upm", np.pi / 30), ("min^-1", np.pi / 30), ("1/s", None), ("s^-1", None)],
)
def test_a_column_of_speeds_must_say_what_it_counts(unit, factor):
    assert unit_factor(unit, "rad/s") == (None if factor is None else pytest.approx(factor, rel=1e-15))


def test_hertz_count_as_turns_in_every_power():
    np.testing.assert_allclose(to_float("20 Hz^2", "rad^2/s^2", "hold"), 20 * 4 * np.pi**2)
    assert to_float("20 Hz", "1/s", "rate") == 20.0


def test_a_small_angle_out_of_bounds_names_its_bounds():
    with pytest.raises(jv.InputError, match="is -1 rad; it must be at least 0"):
        number(-1.0, "rad", "phase", low=0.0)


def test_equal_parts_of_equal_parts_are_refused():
    assert to_float("2 x 3 kg", "kg", "mass") == 6.0
    assert to_float("2 x 9 kN", "N", "force") == 18e3
    with pytest.raises(jv.InputError, match="2 x 3 x 4 kg"):
        to_float("2 x 3 x 4 kg", "kg", "mass")


def test_values_are_shown_in_si_on_request():
    try:
        jv.display_units(si=True)
        assert [shown_unit(unit, 0.02) for unit in ("m", "kg", "rad")] == [("m", 1.0), ("kg", 1.0), ("rad", 1.0)]
        assert [value_text(5e4, "N/m"), value_text(0.12, "m"), value_text(0.05, "kg")] == ["50000 N/m", "0.12 m", "0.05 kg"]
        texts = [text.get_text() for text in jv.sketch(jv.scene_from_toml(TEMPLATES["rotor"])).axes[0].texts]
        assert "loads at -0.28, -0.25, +0.25, +0.28 m" in texts and not any("mm" in text for text in texts)
    finally:
        jv.display_units()
    assert shown_unit("m", 0.02) == ("mm", 1e3)


def test_speeds_are_shown_without_an_exponent():
    assert quantity_text([1151.917306, 1.5e5 * np.pi / 30.0], "rad/s", 4) == "11000, 150000 rpm"
    assert quantity_text([1e8], "rad/s", 4) == "9.549e+08 rpm"


def test_values_above_all_numbers_are_shown_without_a_warning():
    assert quantity_text(np.asarray([1e308, 1.0]), "rad/s", 3) == "inf, 9.55 rpm"


@pytest.mark.parametrize(
    ("text", "unit", "force", "value"),
    [("280 kg/mm", "N/m", "280 kgf/mm", 2745862.0), ("5 kg", "N", "5 kgf", 49.03325)],
)
def test_kilograms_as_a_force_are_refused_with_kgf(text, unit, force, value):
    with pytest.raises(jv.InputError, match=f"field is '{text}'; a kilogram is a mass; for the force write '{force}', or N"):
        number(text, unit, "field")
    assert float(number(force, unit, "field")) == pytest.approx(value, rel=1e-12)
    with pytest.raises(jv.InputError, match="field is '3 kg', which is not in N/m"):
        number("3 kg", "N/m", "field")


@pytest.mark.parametrize("unit", ["m*9**9**9", "m^9^9^9", "m*9**(99*99*99*99)", "m*9⁹⁹⁹⁹⁹⁹⁹⁹", "m*9⁹⁹^99", "m*9**-+9e9"])
def test_large_powers_in_units_are_refused_at_once(unit):
    assert unit_factor(unit, "m") is None and unit_factor("m", unit) is None
    with pytest.raises(jv.InputError, match="not in m"):
        to_float(f"5 {unit}", "m", "length")


@pytest.mark.parametrize("unit", ["m^(4/2)", "m^2.0", "m**+2", "m²", "m³/m", "m⁴ m^-2", "1e4 cm^2"])
def test_powers_in_units_are_read(unit):
    assert unit_factor(unit, "m^2") == pytest.approx(1.0, rel=1e-15)


def test_long_units_are_refused_at_once():
    assert unit_factor("m", "m" * 10**5) is None


def test_bounds_of_numpy_values_are_decided_while_tracing():
    @jax.jit
    def signed(x):
        return x if np.all(Bounds(low=0.0).allow(np.array([0.0, 2.0]))) else -x

    assert float(signed(3.0)) == 3.0


def test_a_single_number_is_repeated_unless_shared():
    assert numbers("44 N/mm", "N/m", "stiffness", 3).tolist() == [4.4e4] * 3
    assert jax.jit(lambda x: numbers(x, "N/m", "stiffness", 3))(2.0).tolist() == [2.0] * 3
    for scalar in (numbers(2.0, "N/m", "stiffness", 3, shared=True), numbers(2.0, "N/m", "stiffness", None)):
        assert scalar.shape == () and float(scalar) == 2.0
