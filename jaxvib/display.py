"""Units in which texts, tables and figures show numbers to readers; data and files of results stay in SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    from jaxvib.boundary import Axes, Figure

Onto: TypeAlias = Axes | Sequence[Axes] | None
"""Axes onto which a chart is drawn: one, or as many as it has panels; None for a new figure."""

Drawn: TypeAlias = "Figure | Any"
"""Result of a plot: the new figure, or the axes of the argument `ax`, which are of the caller's type (`Any`)."""

SpeedUnit: TypeAlias = Literal["rad/s", "rpm", "Hz"]
"""Unit in which speeds are shown."""

_SPEED_FACTORS = {"rad/s": 1.0, "rpm": 30.0 / math.pi, "Hz": 0.5 / math.pi}


ELECTRICAL = "rad/s of a supply"
"""Unit of the frequency of an electrical supply, shown in Hz for every unit of speeds, and in rad/s with SI units."""


GRAVITIES = "g0"
"""Unit of accelerations relative to that of gravity, 9.80665 m/s^2."""


class _CurrentUnits:
    """Display units of this process: `speed` is the unit of speeds; `si` is True for SI units of all other quantities."""

    speed: SpeedUnit = "rpm"
    si = False


@validated
def display_units(*, speed: SpeedUnit = "rpm", si: bool = False) -> None:
    """Set the units of all texts, tables and figures of this process. Without arguments, set the units that are usual in
    engineering.

    The command-line option `--unit` sets `speed`; `--unit SI` stands for `speed="rad/s", si=True`.

    **Arguments**

    - `speed`: unit of speeds and frequencies, "rpm", "Hz" or "rad/s"
    - `si`: True for SI units, such as m, N/m, kg and rad; False for deg, and for mm, N/mm, g and kN if they suit the size of
      the value. Use `speed="rad/s", si=True` for machines with dimensionless parameters

    **Returns** None. **Raises** `InputError` for another unit.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> print(jv.mode_shapes(scene).summary())
    267.434 rpm: y1 +1.000
    >>> jv.display_units(speed="Hz")
    >>> print(jv.mode_shapes(scene).summary())
    4.45723 Hz: y1 +1.000
    >>> jv.display_units()
    """
    _CurrentUnits.speed, _CurrentUnits.si = speed_unit(speed)[0], si


def speed_unit(unit: SpeedUnit | None = None) -> tuple[SpeedUnit, float]:
    """Return a unit of speeds, by default that of `display_units`, and the factor from rad/s to it.

    **Raises** `InputError` for a unit other than "rad/s", "rpm" and "Hz".

    >>> unit, factor = speed_unit("rpm")
    >>> round(factor, 3)
    9.549
    """
    unit = _CurrentUnits.speed if unit is None else unit
    if not isinstance(unit, str) or unit not in _SPEED_FACTORS:
        raise InputError("unit", f"is {quoted(unit)}; it must be one of 'rad/s', 'rpm', 'Hz'")
    return unit, _SPEED_FACTORS[unit]


def shown_unit(unit: str, size: float) -> tuple[str, float]:
    """Return the display unit of values of about `size`, given in the SI `unit`, and the factor from the SI unit to it.

    >>> shown_unit("m", 0.02), shown_unit("N", 120.0), shown_unit("rad/s^2", 10.0)[0]
    (('mm', 1000.0), ('N', 1.0), 'rpm/s')
    """
    if unit == "rad/s":
        return speed_unit()
    if unit == "rad/s^2":
        name, factor = speed_unit()
        return ("rad/s^2" if name == "rad/s" else f"{name}/s"), factor
    if unit == ELECTRICAL:
        return ("rad/s", 1.0) if _CurrentUnits.si else ("Hz", _SPEED_FACTORS["Hz"])
    if _CurrentUnits.si:
        return unit, 1.0
    if unit == "N/m" and size >= 1e3:
        return "N/mm", 1e-3
    if unit in ("m", "meter") and 0.0 < size < 1.0:
        return ("mm", 1e3) if size >= 1e-5 else ("um", 1e6)
    if unit == "m/s" and 0.0 < size < 1.0:
        return "mm/s", 1e3
    if unit == GRAVITIES:
        return "g", 1.0
    if unit == "rad":
        return "deg", 180.0 / np.pi
    if unit == "kg" and 0.0 < size < 1.0:
        return "g", 1e3
    if unit == "kg m" and 0.0 < size < 1e-2:
        return "g m", 1e3
    if unit == "N" and size >= 1e4:
        return "kN", 1e-3
    return unit, 1.0


def quantity_text(values: ArrayLike, unit: str, digits: int = 5, between: str = ", ") -> str:
    """Return numbers in their display unit as text, with the unit once.

    **Arguments**: `values` in the SI `unit`, a number or an array of one axis; `digits`: significant digits; `between`:
    separator.

    >>> quantity_text([0.0234, 0.0012], "m", 3)
    '23.4, 1.2 mm'
    """
    numbers = np.atleast_1d(np.asarray(values, float))
    shown, factor = shown_unit(unit, float(np.max(np.abs(numbers), initial=0.0, where=np.isfinite(numbers))))
    # `tolist` returns Python's numbers, because NumPy's would warn of an overflow.
    return between.join(_without_exponent(f"{factor * x:.{digits}g}") for x in numbers.tolist()) + f" {shown}"


def _without_exponent(text: str) -> str:
    """Return the text of a number below 1e6 without a positive exponent: "11000" for "1.1e+04"."""
    return f"{float(text):.0f}" if "e+" in text and abs(float(text)) < 1e6 else text


def speed_text(values: ArrayLike, digits: int = 5, between: str = ", ") -> str:
    """Return speeds, rad/s, as text, see `quantity_text`.

    >>> speed_text(157.0796), speed_text([100.0, 200.0], 3, " .. ")
    ('1500 rpm', '955 .. 1910 rpm')
    """
    return quantity_text(values, "rad/s", digits, between)


class SpeedIntervals(list[list[float]]):
    """Intervals [from, to] of speed, rad/s, printed in the unit of `display_units`.

    >>> SpeedIntervals([[10.0, 20.0], [40.0, 50.0]]), SpeedIntervals()
    (95.493 .. 190.986, 381.972 .. 477.465 rpm, no interval)
    >>> print(SpeedIntervals([[10.0, 20.0]]).summary())
    95.493 .. 190.986 rpm
    """

    def __repr__(self) -> str:
        """Return the intervals with six digits."""
        unit, factor = speed_unit()
        ends = ", ".join(f"{factor * low:.6g} .. {factor * high:.6g}" for low, high in self)
        return f"{ends} {unit}" if ends else "no interval"

    def summary(self) -> str:
        """Return the intervals as text."""
        return repr(self)
