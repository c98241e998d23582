"""Names and units in the headers of columns and in descriptions of channels, with the spellings common in laboratories."""

from __future__ import annotations

import re

import numpy as np

from jaxvib.units.reading import STANDARD_GRAVITY, unit_ratio

_SPELLINGS: dict[str, dict[str, float]] = {
    "s": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "с"), 1.0),
        **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds", "мс"), 1e-3),
        **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), 1e-6),
        **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    },
    "rad": {
        **dict.fromkeys(("rad", "rads", "radian", "radians", "рад"), 1.0),
        **dict.fromkeys(("mrad", "milliradian", "milliradians"), 1e-3),
        **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "град"), np.pi / 180.0),
        **dict.fromkeys(("mdeg", "millidegree", "millidegrees"), np.pi / 180e3),
        **dict.fromkeys(("gon", "gradian", "gradians"), np.pi / 200.0),
        **dict.fromkeys(("turn", "turns", "rev", "revs", "revolution", "revolutions"), 2.0 * np.pi),
    },
    "m/s^2": {
        **dict.fromkeys(("m/s^2", "m/s2", "m/s²", "m/s/s", "m/s**2", "mps2", "ms2"), 1.0),
        **dict.fromkeys(("mm/s^2", "mm/s2", "mm/s²"), 1e-3),
        **dict.fromkeys(("g", "gn", "g0", "g_n", "g_0"), STANDARD_GRAVITY),
        "mg": 1e-3 * STANDARD_GRAVITY,
    },
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, **dict.fromkeys(("in/s", "ips"), 0.0254)},
    "m": {
        "m": 1.0,
        "mm": 1e-3,
        **dict.fromkeys(("um", "µm", "μm", "micron", "microns"), 1e-6),
        **dict.fromkeys(("mil", "mils"), 25.4e-6),
    },
    "N": {"n": 1.0, "kn": 1e3, "lbf": 4.4482216152605},
    "rad/s": {
        **dict.fromkeys(("rad/s", "rads"), 1.0),
        **dict.fromkeys(("rpm", "1/min", "r/min", "u/min", "rev/min", "min^-1", "min-1"), np.pi / 30.0),
        **dict.fromkeys(("hz", "cps", "rps", "rev/s"), 2.0 * np.pi),
        "deg/s": np.pi / 180.0,
    },
    "N m": {**dict.fromkeys(("nm", "n m", "n*m", "n.m", "n·m"), 1.0), "knm": 1e3},
    "A": {"a": 1.0, "ma": 1e-3},
    "Hz": {
        **dict.fromkeys(("hz", "hertz", "s/s", "sa/s", "sps", "1/s", "samples/s", "samples/sec", "samples/second"), 1.0),
        **dict.fromkeys(("khz", "ks/s", "ksa/s", "ksps", "ksamples/s"), 1e3),
    },
}
"""Factors to each SI unit, by the spellings of units in headers of columns, in lower case (headers may be in either case)."""

_MULTIPLE = re.compile(r"^(\d+\.?\d*(?:[eE][+-]?\d+)?)\s+([^\s\d/].*)$")
"""Pattern of a multiple of a unit, such as "50 kN"."""

_PRODUCT = r"[^\W\d_]{1,3}(?:[\d^/*·²³-]\S*)?(?: [^\W\d_]{1,3}(?:[\d^/*·²³-]\S*)?)+"
"""Pattern of a unit with blanks, such as "N s/m"."""

_HEAD = re.compile(rf"^(?P<name>.*?)\s*(?:[(\[{{]\s*(?P<unit>[^)\]}}]*?)\s*[)\]}}]|/\s*(?P<per>{_PRODUCT}|\S+))$")
_TAIL = re.compile(r"^(?P<name>.+?)[\s_.:-]+(?P<tail>[^\W_]+|°)$")


def unit_factor(unit: str, si: str) -> float | None:
    """Return the factor from a unit in the header of a column, or from a multiple of a unit, to an SI unit.

    The result is None for a unit of another dimension and for an unknown unit.

    >>> unit_factor("G", "m/s^2"), unit_factor("mm/s", "m/s"), unit_factor("mm", "N"), unit_factor("50 kN", "N")
    (9.80665, 0.001, None, 50000.0)
    """
    unit = unit.strip()
    factor = _SPELLINGS.get(si, {}).get(unit.lower())
    if factor is not None:
        return factor
    multiple = _MULTIPLE.match(unit)
    if multiple is not None:
        factor = unit_factor(multiple[2], si)
        return None if factor is None or not 0.0 < float(multiple[1]) < np.inf else float(multiple[1]) * factor
    return unit_ratio(unit, si) if si and unit else None


def split_head(head: str, si: str) -> tuple[str, str]:
    """Return the name and the unit of the header of a column: `name (unit)`, `name / unit`, or `name_unit` for a unit in the
    dimension of `si`.

    >>> split_head("frame [mm/s]", "m/s"), split_head("ANGLE_DEG", "rad"), split_head("acc_1", "m/s^2")
    (('frame', 'mm/s'), ('ANGLE', 'DEG'), ('acc_1', ''))
    """
    part = _HEAD.match(head)
    if part is not None:
        return part["name"].strip(), part["unit"] or part["per"] or ""
    tail = _TAIL.match(head)
    if tail is not None and tail["tail"].lower() in _SPELLINGS.get(si, {}):
        return tail["name"].strip(), tail["tail"]
    return head.strip(), ""
