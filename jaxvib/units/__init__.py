"""Conversion of users' values to SI units, and checks of these values. `jaxvib.display` converts results to other units."""

from __future__ import annotations

import contextlib
import contextvars
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.boundary import is_whole
from jaxvib.errors import InputError, counted, quoted
from jaxvib.runtime.compat import traced
from jaxvib.runtime.devices import array_module
from jaxvib.units.reading import ADDED, Number, Numbers, number_words, to_float


class Bounds(NamedTuple):
    """Allowed values of a number, from `low` to `high`; an open end is not included.

    >>> Bounds(0.0, open_low=True).words, Bounds(0.0, high=1.0).words, Bounds(0.0).allow(np.asarray([-1.0, 0.0])).tolist()
    ('greater than 0', 'at least 0 and at most 1', [False, True])
    """

    low: float = -math.inf
    open_low: bool = False
    high: float = math.inf
    open_high: bool = False

    def allow(self, value: Array | np.ndarray) -> Array | np.ndarray:
        """Return True for each entry that is finite and within the bounds."""
        finite = jnp.isfinite(value) if isinstance(value, jax.Array) else np.isfinite(value)
        allowed = finite & ((value > self.low) if self.open_low else (value >= self.low))
        if self.high == math.inf:
            return allowed
        return allowed & ((value < self.high) if self.open_high else (value <= self.high))

    @property
    def words(self) -> str:
        """Bounds as part of a sentence; "" if there are none."""
        low = f"{'greater than' if self.open_low else 'at least'} {self.low:g}" if self.low > -math.inf else ""
        high = f"{'less than' if self.open_high else 'at most'} {self.high:g}" if self.high < math.inf else ""
        return " and ".join(filter(None, (low, high)))


_COLLECTED_CONDITIONS: contextvars.ContextVar[list[Array] | None] = contextvars.ContextVar("collected", default=None)


@contextlib.contextmanager
def conditions_of_traced_values() -> Iterator[list[Array]]:
    """Yield a list. In the `with` block, each check of a traced value appends a Boolean to it: True if the value is allowed."""
    conditions: list[Array] = []
    token = _COLLECTED_CONDITIONS.set(conditions)
    try:
        yield conditions
    finally:
        _COLLECTED_CONDITIONS.reset(token)


_MAX_NUMBERS = 10**7
"""Largest length of a list of numbers; more numbers must be passed as an array."""


def _check_bounds(
    value: Array | np.ndarray, field: str, unit: str, bounds: Bounds, *, is_list: bool = False, text: str = ""
) -> None:
    """Check values against bounds. The condition for a traced value is added to the list of `conditions_of_traced_values`.

    The message contains the `text` of a finite value if the bounds are the same in all units.
    """
    if traced(value):
        collected = _COLLECTED_CONDITIONS.get()
        if collected is not None:
            collected.append(jnp.all(bounds.allow(value)))
        return
    flat = np.atleast_1d(np.asarray(value))
    allowed, precision = bounds.allow(flat), np.finfo(flat.dtype).eps
    if unit == "rad":
        allowed = allowed & (np.abs(flat) * precision <= 1.0)
    if np.all(allowed):
        return
    index = int(np.argmin(allowed))
    entry, name = flat[index], f"{field}[{index}]" if is_list else field
    needed = f"it must be {bounds.words}"
    if not np.isfinite(entry):
        needed = "a finite number is needed"
    elif unit == "rad" and abs(entry) * precision > 1.0:
        needed = f"it must be below {1.0 / precision:.1e} rad, above which an angle is not resolved within one turn"
    shown = f"{entry:g} {unit}".strip()
    is_same_in_all_units = {bounds.low, bounds.high} <= {-math.inf, 0.0, math.inf}
    if is_same_in_all_units and np.isfinite(entry) and any(map(str.isalpha, text)):
        shown = shown if text.replace(" ", "") == shown.replace(" ", "") else text
    raise InputError(name, f"is {shown}; {needed}")


def number(
    value: Number,
    unit: str,
    field: str,
    *,
    low: float = -math.inf,
    open_low: bool = False,
    high: float = math.inf,
    open_high: bool = False,
) -> Array:
    """Return one number as a floating-point scalar array in SI units, checked against `Bounds`.

    **Raises** `InputError` for a wrong unit, a list, and a value that is not finite or not within the bounds.

    >>> float(number("2 t", "kg", "machine.mass"))
    2000.0
    """
    # With a dtype, JAX copies NumPy's array to the device; without one, it would compile a program for each shape.
    return jnp.asarray(_number(value, unit, field, Bounds(low, open_low, high, open_high)), dtype=float)


def known_number(value: Number, unit: str, field: str, *, low: float = -math.inf, open_low: bool = False) -> Any:
    """Return one number as `number` does, but as a NumPy array unless it is a JAX array. A compiled program to which a NumPy
    array is passed copies it to the device itself, ten times as fast as a separate copy before the call."""
    return _number(value, unit, field, Bounds(low, open_low))


def _number(value: Number, unit: str, field: str, bounds: Bounds) -> Array | np.ndarray:
    if isinstance(value, (list, tuple)):
        problem = f"is a list of {len(value)} values; one {number_words(unit)} is needed"
        raise InputError(field, problem + _hint_of_parts(unit))
    return _converted(to_float(value, unit, field), unit, field, (), bounds, value if isinstance(value, str) else "")


def numbers(
    value: Numbers,
    unit: str,
    field: str,
    length: int | None,
    *,
    low: float = -math.inf,
    open_low: bool = False,
    high: float = math.inf,
    open_high: bool = False,
    shared: bool = False,
) -> Array:
    """Return `length` numbers as an array in SI units; `length` None allows any length of at least 1.

    A single number applies to all entries. It is repeated, or returned as a scalar if `shared` is True or `length` is None.

    **Raises** `InputError` in the same cases as `number`, and for a list of another length.

    >>> numbers(["44 N/mm", 5e4], "N/m", "machine.stiffness", 2).tolist()
    [44000.0, 50000.0]
    """
    bounds = Bounds(low, open_low, high, open_high)
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes, bytearray)):
        if len(value) > (_MAX_NUMBERS if length is None else length):
            needed = _needed(length, unit) if length is not None else f"at most {_MAX_NUMBERS} are allowed"
            raise InputError(field, f"has {counted(len(value))}; {needed}")
        for i, part in enumerate(value):
            if isinstance(part, (list, tuple)) or getattr(part, "ndim", 0) != 0:
                raise InputError(f"{field}[{i}]", f"is not a single number; write a {number_words(unit)}")
        parts = [to_float(v, unit, f"{field}[{i}]") for i, v in enumerate(value)]
        if length is not None and len(parts) != length:
            raise InputError(field, f"has {counted(len(parts))}; {_needed(length, unit)}")
        if not parts:
            raise InputError(field, "is an empty list; at least 1 value is needed")
        if not all(isinstance(part, jax.Array) for part in parts):
            for i, part in enumerate(parts):
                _converted(part, unit, f"{field}[{i}]", (), bounds)
        is_plain = not any(isinstance(part, jax.Array) for part in parts)
        stacked = np.asarray(parts, dtype=float) if is_plain else jnp.stack([jnp.asarray(p, dtype=float) for p in parts])
        return _array(stacked, unit, field, stacked.shape, bounds)
    single: Any = value
    magnitude = to_float(single, unit, field)
    if np.ndim(magnitude) == 0:
        scalar = _converted(magnitude, unit, field, (), bounds)
        if not (shared or length is None):
            scalar = array_module(scalar).broadcast_to(scalar, (length,))
        return jnp.asarray(scalar, dtype=float)
    if np.size(magnitude) == 0 and length is None:
        raise InputError(field, "is an empty array; at least 1 value is needed")
    if np.ndim(magnitude) != 1 or (length is not None and np.shape(magnitude)[0] != length):
        raise InputError(field, f"has shape {np.shape(magnitude)}; {'a list' if length is None else f'({length},)'} is needed")
    return _array(magnitude, unit, field, np.shape(magnitude), bounds)


def _needed(length: int, unit: str) -> str:
    """Return the end of a message about a list of another length."""
    return f"{length} are needed" if length != 1 else f"1 is needed{_hint_of_parts(unit)}"


def _hint_of_parts(unit: str) -> str:
    """Return a hint for a list in place of one number: the notation of equal parts side by side, if values in `unit` add."""
    return f"; equal parts side by side are written as '2 x 100 {unit}'" if unit in ADDED else ""


def _array(value: ArrayLike, unit: str, field: str, shape: tuple[int, ...], bounds: Bounds) -> Array:
    return jnp.asarray(_converted(value, unit, field, shape, bounds), dtype=float)  # as in `number`


def _converted(
    value: ArrayLike, unit: str, field: str, shape: tuple[int, ...], bounds: Bounds, text: str = ""
) -> Array | np.ndarray:
    """Return the checked value in SI. NumPy converts a value that is not a JAX array; JAX would compile a program for it."""
    try:
        if isinstance(value, jax.Array):
            array = jnp.asarray(value, dtype=float)
        else:
            with np.errstate(over="ignore"):  # too large for single precision: infinite, which `_check_bounds` refuses
                array = np.asarray(value, dtype=float).astype(jnp.result_type(float))
    except OverflowError as error:
        raise InputError(field, f"is {quoted(value)}, which is too large; give a number below 1e308") from error
    except (TypeError, ValueError) as error:
        raise InputError(field, f"is {quoted(value)}, which is not a number; write a {number_words(unit)}") from error
    if array.shape != shape:
        raise InputError(field, f"has shape {array.shape}; one {number_words(unit)} is needed")
    _check_bounds(array, field, unit, bounds, is_list=bool(shape), text=text)
    return array


_MAX_COUNT = 2**31 - 1
"""Largest count, because accelerators index arrays by integers of 32 bits."""


def count(value: object, field: str, *, low: int = 1, each: float = 0.0) -> int:
    """Return a whole number of objects, at least `low`; one object needs `each` bytes.

    **Raises** `InputError` for any other value, and if the objects need more than half of the computer's memory.

    >>> count(0, "loads.count")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: loads.count is 0; it must be a whole number, at least 1
    """
    if not isinstance(value, (int, np.integer)) or not is_whole(value) or value < low:
        raise InputError(field, f"is {quoted(value)}; it must be a whole number, at least {low}")
    if each and 2.0**30 / each < value < 2**63:
        room = 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2.0**33
        if value * each > room:
            needs = f"needs {value * each / 2.0**30:.3g} GiB, more than half of the computer's memory"
            raise InputError(field, f"is {value}, which {needs}; at most {int(room / each)} fit")
    if value > _MAX_COUNT:
        raise InputError(field, f"is {quoted(value)}; it must be a whole number from {low} to {_MAX_COUNT}")
    return int(value)


def random_numbers(seed: object) -> np.random.Generator:
    """Return the generator of random numbers for a seed, which must be a whole number of at least 0.

    >>> random_numbers(-1)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: seed is -1; it must be a whole number, at least 0
    """
    return np.random.default_rng(count(seed, "seed", low=0))


def validate_tolerance(value: float, name: str, dtype: np.dtype, roundings: float) -> float:
    """Return a tolerance or an accuracy. **Raises** `InputError` unless it is less than 1 and at least `roundings` times the
    machine epsilon of `dtype`."""
    precision = float(jnp.finfo(dtype).eps)
    is_python_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (is_python_number and roundings * precision <= value < 1.0):
        # 5 % more, so that the value in the message, rounded to two digits, is allowed.
        raise InputError(
            name,
            f"is {quoted(value)}; in {dtype} it must be at least {1.05 * roundings * precision:.2g} and less than 1"
            + ("" if is_python_number else ", a Python number such as 1e-6")
            + ("; for smaller ones switch JAX to float64" if precision > 1e-10 else ""),
        )
    return value
