"""Conversion of strings with units and of pint quantities to SI numbers."""

from __future__ import annotations

import math
import re
import tokenize
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
from jax import Array

from jaxvib.boundary import is_real
from jaxvib.errors import InputError, quoted


@runtime_checkable
class Quantity(Protocol):
    """Number with a unit, such as a quantity of pint."""

    def m_as(self, units: str, /) -> Any:
        """Return the magnitude in a unit."""
        ...


Number: TypeAlias = float | Array | np.ndarray | np.number | str | Quantity
"""Number in an argument of a public function: a float, an array, a traced value, a string with a unit, a pint quantity."""

Numbers: TypeAlias = Number | Sequence[Number]
"""Several numbers, or a single number for all entries."""


_NUMBER_WITH_UNIT = re.compile(
    r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(\s*[^\W\d_]|\s+1\s*/|\s*[%°])((?:(?!\s\d)[^,;()])*)"
)
"""Pattern of one number (with a point, not a comma, before decimals), then one unit, which may begin with "1/". Other texts
are refused as mistakes, even if pint could evaluate them."""

SEVERAL = r"[1-9]\d{0,3}\s*[x×*]\s*"
"""Pattern of the number of equal parts side by side, such as "4 x " in "4 x 50 N/mm"."""

_SEVERAL = re.compile(rf"({SEVERAL})(\S.*)")

ADDED = ("N/m", "N s/m", "kg", "kg m", "N")
"""Units of values that add if equal parts are side by side."""

STANDARD_GRAVITY = 9.80665
"""Acceleration 1 g, m/s^2."""

_UNDER = re.compile(r"(.+?)\s+under\s+(.+)")
"""Pattern of a stiffness that is given as a deflection under a mass or a force, such as "25 mm under 650 kg"."""

_MASS_TIMES_RADIUS = re.compile(r"(.+?)\s*[x×*]\s*([+-]?\.?\d.*)")
"""Pattern of an unbalance that is given as a mass times a radius, such as "0.3 kg x 0.24 m"."""

_THOUSANDS_APART = re.compile(r"(?<![\d.,])([1-9]\d{0,2}(?:[ \u00a0\u2009\u202f]\d{3})+)(?!\d|\s\d|/)")
"""Number with spaces, also thin or non-breaking ones, between its thousands, such as "1 234"."""

_PER_TIME = re.compile(r"(?!1\s*/)(\d+\.?\d*)\s*/\s*(min|Min|s)")
"""Frequency without the 1 of its unit, such as "1450/min"."""

_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*(?:[^\W\d_%°][^,;()]*)?")

_THOUSANDS = re.compile(r"[+-]?\d{1,3},\d{3}(?!\d)")
"""Pattern of a number whose comma can separate thousands."""

_GROUPS = (r"(?:['’]\d{3})+", r"(?:\.\d{3}){2,}", r"(?:,\d{3}){2,}", r"(?:\.\d{3})+(?=,\d)", r"(?:,\d{3})+(?=\.\d)")
_DIGIT_GROUPS = re.compile(rf"([+-]?\d{{1,3}}(?:{'|'.join(_GROUPS)}))(?!\d)(?:[.,](?=\d))?")
"""Number with marks that can only separate thousands, and the point or comma before its decimals."""

_INCHES = re.compile(r"(?<=\d)\s*(?:[\"″”]|'')$")

_FEET = re.compile(r"(?<=\d)\s*['′’]$")

_FRACTION = re.compile(r"(?<![\d.,])(?:(\d{1,3})[\s-]+)?(\d{1,4})\s*/\s*([1-9]\d{0,3})(?=\s*[^\W\d_])")
"""Fraction, also after a whole number, such as "1 1/2"."""

_SPELLINGS = {
    **dict.fromkeys(("RPM", "Rpm", "upm", "Upm", "UPM", "r/min", "U/min", "rev/min"), "rpm"),
    **dict.fromkeys(("cps", "rps", "r/s", "U/s", "rev/s"), "turn/s"),
    **dict.fromkeys(("1/Min", "U/Min", "u/min", "revs/min", "tr/min", "r.p.m.", "cpm", "CPM"), "rpm"),
    **dict.fromkeys(("Kg", "KG", "kgs"), "kg"),
    **dict.fromkeys(("HP", "Hp", "bhp"), "hp"),
    **dict.fromkeys(("kw", "KW"), "kW"),
    **dict.fromkeys(("Hertz", "HERTZ"), "Hz"),
    **dict.fromkeys(("ips", "IPS"), "in/s"),
    **dict.fromkeys(("ppi", "pli"), "lbf/in"),
    **dict.fromkeys(("Newton", "Newtons"), "N"),
    **dict.fromkeys(("Newtonmeter", "Newton meter"), "N m"),
    "KN": "kN",
    "Ohm": "ohm",
    "Prozent": "%",
    "PS": "metric_horsepower",
    "hz": "Hz",
    "HZ": "Hz",
    "khz": "kHz",
}
"""Other spellings of units, as on rating plates and in catalogues."""

_PER_MINUTE = ("1/min", "min^-1", "min**-1", "min⁻¹", "min-1")
"""Spellings of revolutions per minute, if the argument is a speed."""

_GRAVITIES = ("g", "G")
"""Spellings of the standard gravity, if the argument is an acceleration."""

_JOINED = {
    "Ns": "N s",
    "kNs": "kN s",
    "Nms": "N m s",
    "Nm": "N m",
    "kNm": "kN m",
    "Nmm": "N mm",
    "mNm": "mN m",
    "Ncm": "N cm",
    "kgm": "kg m",
    "kgmm": "kg mm",
    "kgcm": "kg cm",
    "gmm": "g mm",
    "gcm": "g cm",
    "gm": "g m",
    "daNm": "daN m",
    "kpm": "kgf m",
    "kp": "kgf",
    "lbm": "lb",
    "ftlbf": "ft lbf",
    "inlbf": "in lbf",
    "mil": "thou",
    "mils": "thou",
    "Pas": "Pa s",
    "mPas": "mPa s",
}
"""Products that are often written without a space, and units that pint does not know. Without this list, pint would read "Nm"
as `number_meter`, meters per gram, and "mil" as an angle."""

_JOINED_PATTERN = re.compile(rf"(?<![^\W\d_])({'|'.join(_JOINED)})((?:\^|\*\*)\d|[²³])?(?![^\W\d_])")

_PLAIN_POWER = re.compile(r"(?<=[^\W\d_])([23])(?!\w)")
"""Power of a unit without a sign, as in "kg m2"."""

_HYPHEN = re.compile(r"(?<=[^\W\d_])-(?=[^\W\d_])")
"""Hyphen between the factors of a product, as in "lb-in"."""

_MASS_UNIT = re.compile(r"(?<![^\W\d])(?!lbm)(ft|in)?(kg|lb|oz)s?(ft|in|[cm]?m)?(?!\w)")
"""Unit of mass, alone or joined to a length, as in "ftlb" and "kgcm"."""

_AMBIGUOUS = (
    (re.compile(r"(?<![^\W\d_])grad(?![^\W\d_])", re.IGNORECASE), "degrees or gon; write deg or gon"),
    (re.compile(r"(?<![^\W\d])tons?(?!\w)"), "1000 kg or 907 kg; write t or short_ton"),
    (re.compile(r"(?<![^\W\d])gr(?!\w)"), "grams or grains; write g or grain"),
)
"""Names with several meanings. "Grad" means degrees in German, and gon in mathematics and on calculators. pint would read
"Grad" as gigaradian, "grad" as gon, "ton" as the ton of the United States, and "gr" as grain."""

_FACTORS = {
    "kg": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "N/m": {"N/m": 1.0, "N/mm": 1e3, "kN/m": 1e3, "kN/mm": 1e6},
    "N s/m": {"N s/m": 1.0, "N s/mm": 1e3, "kN s/m": 1e3},
    "kg m^2": {"kg m^2": 1.0, "kg cm^2": 1e-4},
    "rad/s": {"rad/s": 1.0, "rpm": math.pi / 30.0, "Hz": 2.0 * math.pi},
}
"""Factors of the most common units of engineering drawings. Other units are read by pint, whose import takes half a second."""

_SIGN, _RAISED, _EXPONENT = r"(?:\^|\*\*)", "[⁰¹²³⁴-⁹]", r"[+-]?\d{1,2}(?:[./]\d{1,2})?"
_POWER = re.compile(
    rf"{_SIGN}\s*(?:{_EXPONENT}|\({_EXPONENT}\))(?![\d.e]|{_RAISED}|\s*{_SIGN})|{_RAISED}{{1,2}}(?!{_RAISED}|{_SIGN})"
)
"""Power of at most two digits. pint would compute any other, such as 9**9**9, which takes minutes."""

_MAX_UNIT_CHARACTERS = 100
"""Largest length of a unit. pint takes minutes for long strings."""

_PARSE_ERRORS = (AttributeError, TypeError, ValueError, ArithmeticError, AssertionError, SyntaxError, tokenize.TokenError)
"""Errors, other than pint's own classes, that pint raises for a string that is not a unit; it parses the string as Python."""


def number_words(unit: str) -> str:
    """Return the words of messages for a number in a unit: "number in kg", or "plain number" without a unit."""
    return f"number in {unit}" if unit else "plain number"


def _example(unit: str) -> str:
    return "'1500 rpm', '157.1 rad/s' or '25 Hz'" if unit == "rad/s" else f"'1.5 {unit}'" if unit else "1.5"


def without_typesetting(text: str) -> str:
    """Return a text with the minus of a keyboard, without spaces between thousands, and with "1/min" for "/min".

    >>> without_typesetting("\u22125 kg"), without_typesetting("1 234 kg"), without_typesetting("1450/min")
    ('-5 kg', '1234 kg', '1450 1/min')
    """
    text = text.strip().replace("\u2212", "-")
    if len(text) > _MAX_UNIT_CHARACTERS:  # the patterns take minutes for long texts
        return text
    if (per := _PER_TIME.fullmatch(text)) is not None:
        return f"{per[1]} 1/{per[2]}"
    return _THOUSANDS_APART.sub(lambda apart: re.sub(r"\s", "", apart[1]), text)


def to_float(value: Number, unit: str, field: str) -> float | Array | np.ndarray | np.number:
    """Return the magnitude of `value` in the SI unit `unit`; a number without a unit is already in `unit`.

    Strings and pint quantities are converted. If `unit` contains an angle, "1500 1/min" is 1500 rpm, 1/s without an angle
    raises an error, and a frequency in hertz counts as revolutions per second. (pint alone would convert 25 Hz to 25 rad/s.)
    Stiffnesses, dampings, masses and unbalances of several equal parts side by side are added: "4 x 50 N/mm". A stiffness may
    be a deflection of the spring under a mass or a force: "25 mm under 650 kg". An unbalance may be a mass times a radius:
    "0.3 kg x 0.24 m".

    **Raises** `InputError` for a string that is not a number, an unknown unit, a unit of another dimension, and a value that
    is not a real number (`require_real`).

    >>> round(to_float("1500 rpm", "rad/s", "drive.speed"), 4)
    157.0796
    >>> round(to_float("25 Hz", "rad/s", "drive.speed"), 4)
    157.0796
    >>> round(to_float("25 mm under 650 kg", "N/m", "machine.stiffness"))  # 650 * 9.80665 / 0.025
    254973
    >>> to_float("3 kg", "N/m", "machine.stiffness")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: machine.stiffness is '3 kg', which is not in N/m; write for example '1.5 N/m'
    """
    if isinstance(value, str):
        try:
            if "_" not in value:  # Python would read "1_000"
                return float(without_typesetting(value))
        except ValueError:
            pass
        text = without_typesetting(value)
        under = _UNDER.fullmatch(text) if unit == "N/m" and len(text) < 100 else None
        if under is not None:
            return _stiffness_under(under[1], under[2], value, field)
        several = _SEVERAL.fullmatch(text) if unit in ADDED and len(text) < 100 else None
        if several is not None and _SEVERAL.fullmatch(several[2]) is None:
            return int(several[1].rstrip("x×* \t")) * to_float(several[2], unit, field)
        times = _MASS_TIMES_RADIUS.fullmatch(text) if unit == "kg m" and len(text) < 100 else None
        if times is not None:
            return _unbalance_of(times[1], times[2], value, field)
        parts = _NUMBER_WITH_UNIT.fullmatch(text) if len(text) < 100 else None
        if parts is None:
            if len(text) < 100 and _COMMA.fullmatch(text):
                point, none = quoted(text.replace(",", ".")), quoted(text.replace(",", ""))
                thousands = f" if it is a decimal comma, otherwise {none}" if _THOUSANDS.match(text) else ""
                raise InputError(field, f"is {quoted(value)}, with a comma; write {point}{thousands}")
            raise _wrong_unit(value, unit, field)
        magnitude, written = float(parts[1]), (parts[2] + parts[3]).strip()
        factor = _FACTORS.get(unit, {}).get("rpm" if written in _PER_MINUTE else _SPELLINGS.get(written, written))
        if factor is None and unit == "m/s^2" and written in _GRAVITIES:
            factor = STANDARD_GRAVITY
        if factor is not None:
            return magnitude * factor
        return _magnitude(_quantity(magnitude, written, value, unit, field), unit, field, value)
    # `hasattr` is tested first, because `isinstance` with a protocol is slow.
    if hasattr(value, "m_as") and isinstance(value, Quantity):
        if not hasattr(value, "units"):  # a quantity of another library, with its own conversion
            return value.m_as(unit or "dimensionless")
        return _magnitude(value, unit, field, str(value))
    require_real(value, unit, field)
    return cast("float | Array | np.ndarray | np.number", value)


def _stiffness_under(deflection: str, load: str, value: str, field: str) -> float:
    """Return the stiffness, N/m, of a spring that deflects under a mass or a force.

    **Raises** `InputError` for texts that are not such quantities, and for values that are not positive. The text
    "4 x 25 mm under 650 kg" raises it too, because it does not state whether each spring carries the mass.
    """
    if _SEVERAL.fullmatch(deflection):
        problem = f"is {quoted(value)}, which can mean the load of one spring or of all together"
        without = re.sub(SEVERAL, "", value.strip(), count=1)
        raise InputError(field, f"{problem}; write {quoted(without)} with the load of all together")
    mass = _in_unit(load, "kg")
    sag = to_float(deflection, "m", field)
    force = to_float(load, "N", field) if mass is None else STANDARD_GRAVITY * mass
    has_units = all(_NUMBER_WITH_UNIT.fullmatch(text) for text in (deflection, load))
    if not (has_units and 0.0 < float(sag) < math.inf and 0.0 < float(force) < math.inf):
        problem = "needs a positive deflection and a positive mass or force, with units"
        raise InputError(field, f"is {quoted(value)}, which {problem}, such as '25 mm under 650 kg'")
    return float(force) / float(sag)


def _unbalance_of(one: str, other: str, value: str, field: str) -> float:
    """Return the unbalance, kg m, of a mass at a radius; either may be first.

    **Raises** `InputError` for texts that are not such quantities with units, and for negative values.
    """
    mass, radius = (one, other) if _in_unit(one, "m") is None else (other, one)
    factors = [_in_unit(text, unit) for text, unit in ((mass, "kg"), (radius, "m")) if _NUMBER_WITH_UNIT.fullmatch(text)]
    if len(factors) != 2 or not all(factor is not None and 0.0 <= factor < math.inf for factor in factors):
        raise InputError(
            field, f"is {quoted(value)}; a product needs a mass and a radius with units, such as '0.3 kg x 0.24 m'"
        )
    return math.prod(factor for factor in factors if factor is not None)


def _in_unit(text: str, unit: str) -> float | None:
    """Return a text as a number in `unit`; None for another dimension."""
    try:
        return float(to_float(text, unit, ""))
    except InputError:
        return None


def require_real(value: object, unit: str, field: str) -> None:
    """Check that a value is a real number or an array of real numbers. All arguments are checked by this function, except texts
    and quantities of libraries other than pint.

    **Raises** `InputError` for Booleans, complex numbers, dates, masked values, bytes, lists, None and objects that are not
    numbers.

    >>> require_real(True, "kg", "machine.mass")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: machine.mass is True, which is not a number; write a number in kg
    """
    if np.ma.is_masked(value):
        raise InputError(field, "has masked values; fill them in or leave them out")
    if not is_real(value):
        raise InputError(field, f"is {quoted(value)}, which is not a number; write a {number_words(unit)}")


def _without_shorthand(text: str) -> str:
    """Return a text without marks between thousands, signs of inches and feet, and fractions.

    >>> _without_shorthand("1.234,5 kg"), _without_shorthand('1 1/2"')
    ('1234.5 kg', '1.5 in')
    """

    def in_decimals(found: re.Match[str]) -> str:
        return f"{int(found[1] or 0) + int(found[2]) / int(found[3]):.6g}"

    text = _FEET.sub(" ft", _INCHES.sub(" in", text.strip()))
    grouped = _DIGIT_GROUPS.match(text)
    if grouped is not None:
        point = "" if grouped[0] == grouped[1] else "."
        text = re.sub("[.,'’]", "", grouped[1]) + point + text[grouped.end() :]
    return _FRACTION.sub(in_decimals, text, count=1)


def _wrong_unit(value: str, unit: str | None, field: str) -> InputError:
    """Return the error for a string that is not in `unit`, or for a string without a readable unit if `unit` is None."""
    for pattern, meanings in _AMBIGUOUS:
        if pattern.search(value):
            return InputError(field, f"is {quoted(value)}, which can mean {meanings}")
    if unit == "N/m" and _in_unit(value, "m") is not None:
        under = f"'{value.strip()} under 650 kg'"
        return InputError(
            field, f"is {quoted(value)}, a deflection; write {under} with the mass (or force) that this spring carries"
        )
    meant = _without_shorthand(value)
    if unit and meant != value and len(value) < 100 and _in_unit(meant, unit) is not None:
        return InputError(field, f"is {quoted(value)}; write {quoted(meant)}")
    as_force = _MASS_UNIT.sub(lambda found: " ".join(filter(None, (found[1], f"{found[2]}f", found[3]))), value)
    if unit and as_force != value:
        try:
            to_float(as_force, unit, field)
        except InputError:
            pass
        else:
            mass = "a pound" if "lbf" in as_force else "an ounce" if "ozf" in as_force else "a kilogram"
            return InputError(field, f"is {quoted(value)}; {mass} is a mass; for the force write {quoted(as_force)}, or N")
    wanted = "not a number with a unit" if unit is None else f"not in {unit}" if unit else "not a plain number"
    return InputError(
        field, f"is {quoted(value)}, which is {wanted}; write for example {_example('m' if unit is None else unit)}"
    )


def _parsed(unit: str) -> Any:
    """Return pint's unit for a string. **Raises** an error of `_PARSE_ERRORS` or of pint for a string that is not a unit."""
    import pint

    if any(pattern.search(unit) for pattern, _ in _AMBIGUOUS):
        raise ValueError("a name with several meanings")
    if len(unit) > _MAX_UNIT_CHARACTERS or re.search(f"{_SIGN}|{_RAISED}", _POWER.sub("", unit)):
        raise ValueError("a long text, or a large power")
    name = _PLAIN_POWER.sub(r"^\1", _HYPHEN.sub(" ", _SPELLINGS.get(unit, unit)))
    return pint.get_application_registry().Unit(
        _JOINED_PATTERN.sub(lambda found: f"({_JOINED[found[1]]}{found[2] or ''})", name) or "dimensionless"
    )


def _quantity(magnitude: float, written: str, value: str, unit: str | None, field: str) -> Any:
    """Return a pint quantity of a number and the string of its unit. **Raises** `InputError` for a string that is not a
    unit."""
    import pint

    try:
        return pint.get_application_registry().Quantity(magnitude, _parsed(written))
    except (pint.PintError, *_PARSE_ERRORS) as error:
        raise _wrong_unit(value, unit, field) from error


def _magnitude(given: Any, unit: str, field: str, text: str) -> Any:
    """Return the magnitude in `unit` of a pint quantity that the user wrote as `text`. **Raises** `InputError` for another
    dimension, and for 1/s without an angle if `unit` is that of a speed."""
    import pint

    if not hasattr(given, "units"):  # a quantity of another library
        return given.m_as(unit or "dimensionless")
    require_real(given.m, unit, field)
    try:
        registry, wanted = pint.get_application_registry(), _parsed(unit)
        units = registry.Unit(str(given.units))
        (rest, angle, hertz), (wanted_rest, wanted_angle, wanted_hertz) = _exponents(units), _exponents(wanted)
        if (wanted_angle or wanted_hertz) and units == registry.Unit("1/min"):
            given, angle = registry.Quantity(given.m, "rpm"), 1.0
        if rest != wanted_rest:
            raise _wrong_unit(text, unit, field)
        magnitude = given.m_as(str(wanted))
    except (pint.PintError, *_PARSE_ERRORS) as error:
        if isinstance(error, InputError):
            raise
        raise _wrong_unit(text, unit, field) from error
    if angle + hertz == wanted_angle + wanted_hertz:  # hertz in either unit counts as 2 pi rad/s
        return magnitude * (2.0 * math.pi) ** (hertz - wanted_hertz)
    if angle != wanted_angle and not rest.keys() - {"second"}:
        if unit == "rad/s":
            raise InputError(field, f"is {quoted(text)}, which does not state radians or revolutions; write {_example(unit)}")
        raise _wrong_unit(text, unit, field)
    return magnitude


def _exponents(units: Any) -> tuple[dict[str, float], float, float]:
    """Return the exponents of a pint unit: a dictionary for the base units other than the radian, that of the radian, and that
    of hertz."""
    import pint

    _, roots = pint.get_application_registry().get_root_units(units)
    powers = {name: float(power) for name, power in roots._units.items()}
    angle = powers.pop("radian", 0.0)
    return powers, angle, float(sum(power for name, power in units._units.items() if name.endswith("hertz")))


def unit_ratio(one: str, other: str) -> float | None:
    """Return the value of 1 `one` in the unit `other`, or None if their dimensions differ.

    One hertz is one revolution per second if the other unit contains an angle.

    >>> round(unit_ratio("Hz", "rad/s"), 3), unit_ratio("kg", "N")
    (6.283, None)
    """
    import pint

    try:
        return float(_magnitude(pint.get_application_registry().Quantity(1.0, _parsed(one)), other, "unit", one))
    except (InputError, pint.PintError, *_PARSE_ERRORS):
        return None


def in_own_unit(value: str | Quantity, field: str, beside: str = "") -> tuple[float, str]:
    """Return the magnitude and the SI unit of a string or a pint quantity of any dimension.

    A plain number has the unit "". A frequency in Hz is converted to rad/s. `beside` is the unit of the other operand of a
    ratio:

    - if it is the unit of a speed, a speed is returned in this unit
    - a value in 1/s is a rate. It is refused beside a speed in rad/s, because it states neither radians nor revolutions
    - a value in 1/min is returned in the unit `beside` if that is a rate such as 1/s; otherwise it is in rpm

    **Raises** `InputError` for other strings, for values that are not finite, and for 1/s beside a speed in rad/s.

    >>> in_own_unit("2 mm", "limit")
    (0.002, 'meter')
    """
    import pint

    given: Any = value
    if isinstance(value, str):
        parts = _NUMBER_WITH_UNIT.fullmatch(without_typesetting(value)) if len(value) < 100 else None
        if parts is None:
            return _finite(to_float(value, "", field), field), ""
        if beside == "m/s^2" and (parts[2] + parts[3]).strip() in _GRAVITIES:
            return _finite(to_float(value, beside, field), field), beside
        given = _quantity(float(parts[1]), (parts[2] + parts[3]).strip(), value, None, field)
    require_real(given.m, "", field)
    try:
        units = pint.get_application_registry().Unit(str(given.units))
        rest, angle, hertz = _exponents(units)
        if rest == {"second": -1.0}:
            other, *turns = _exponents(_parsed(beside))
            if other == rest and (any(turns) or not (angle or hertz)):
                return _finite(to_float(value, beside, field), field), beside
            if units == pint.get_application_registry().Unit("1/min"):
                given = pint.get_application_registry().Quantity(given.m, "rpm")
        given = given.to_base_units() * pint.get_application_registry().Quantity(2.0 * math.pi, "rad") ** hertz
        magnitude = _finite(given.m, field)
    except (pint.PintError, *_PARSE_ERRORS) as error:
        if isinstance(error, InputError):
            raise
        raise _wrong_unit(str(value), None, field) from error
    return magnitude, "" if given.unitless else str(given.units)


def _finite(value: Any, field: str) -> float:
    if not math.isfinite(value):
        raise InputError(field, f"is {quoted(float(value))}; a finite number is needed")
    return float(value)
