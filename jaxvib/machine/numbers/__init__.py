"""Units, bounds and labels of the parameters of a scene, stored as metadata of dataclass fields.

Constructors use this metadata to read their arguments. The module `named` uses it to name the parameters of a whole scene. In
names of functions and classes, "number" stands for a parameter.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import Module
from jaxvib.display import ELECTRICAL, shown_unit
from jaxvib.errors import InputError, counted, quoted
from jaxvib.runtime.startup import start
from jaxvib.units import Bounds, number, numbers
from jaxvib.units.known import when_known

_KEY = "number"


class NumberSpec(NamedTuple):
    """Specification of a parameter, or of an array of parameters, in a field of a part of a scene; `unit` stores it in the
    metadata of the field.

    **Attributes**

    - `units`: one unit for all entries, or one for each entry
    - `bounds` of each entry
    - `words`: name of the parameter in text for users
    - `each`: kind of part to which each entry of an array belongs, such as "platform"; "" for a single number
    - `typical`: typical magnitude in SI, the scale of a number whose value is 0; needed for numbers that may be negative
    - `electrical`: True for the frequency of a supply, which tables show in Hz
    """

    units: tuple[str, ...]
    bounds: Bounds
    words: str = ""
    each: str = ""
    typical: float | None = None
    electrical: bool = False

    @property
    def unit(self) -> str:
        """Unit, or the different units of the entries separated by commas, for tables."""
        return ", ".join(dict.fromkeys(self.units))

    @property
    def unit_of_tables(self) -> str:
        """Unit for `jaxvib.display.shown_unit`."""
        return ELECTRICAL if self.electrical else self.unit

    @property
    def zero_is_absent(self) -> bool:
        """True if a 0 in an array means that the machine does not have the part, such as a spring."""
        return bool(self.each) and self.bounds.low == 0.0


PLAIN = NumberSpec(("",), Bounds())
"""Specification of a parameter whose field has no metadata: any value, in SI."""


def unit(
    *units: str,
    low: float = -math.inf,
    open_low: bool = False,
    high: float = math.inf,
    open_high: bool = False,
    words: str = "",
    each: str = "",
    typical: float | None = None,
    electrical: bool = False,
) -> Mapping[str, NumberSpec]:
    """Return the metadata of a field of a machine, a load, a drive or an effect with a number or an array of numbers.

    **Arguments**: as the attributes of `NumberSpec`. The bounds `low` and `high` are allowed values unless `open_low` or
    `open_high` is True. With `each="load"`, a single number may be given for all loads. In `words`, "{load}" stands for the
    kind of load.

    >>> import equinox as eqx
    >>> class Seal(eqx.Module):
    ...     torque: float = eqx.field(metadata=unit("N m", low=0.0, words="torque of the seal"))
    >>> number_specs(Seal)["torque"].bounds.words
    'at least 0'
    """
    return {_KEY: NumberSpec(units, Bounds(low, open_low, high, open_high), words, each, typical, electrical)}


@functools.lru_cache(maxsize=256)
def number_specs(part: type) -> Mapping[str, NumberSpec]:
    """Return the specification of each parameter of a part of a scene, by the name of its field."""
    fields = dataclasses.fields(part)
    found = {field.name: field.metadata[_KEY] for field in fields if _KEY in field.metadata}
    return {name: spec._replace(words=spec.words or name.replace("_", " ")) for name, spec in found.items()}


def read_numbers(part: type[eqx.Module], section: str, length: int | None = None, /, **values: Any) -> dict[str, Any]:
    """Return the arguments of a constructor as arrays in SI units, validated by the metadata of the fields of the same names.

    None remains None for a field that may be None.

    **Arguments**: `section`, name of the table in a scene file, for error messages, or ""; `length` of arrays, None for any
    length.

    **Raises** `InputError` for a wrong unit, a value out of bounds, and a list of another length.

    >>> import jaxvib as jv
    >>> read_numbers(jv.SpinUp, "drive", speed="100 rad/s", duration=0.0)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: drive.duration is 0 s; it must be greater than 0
    """
    start()  # a part of a user's file may be the first array of a process
    specs, optional = number_specs(part), {field.name for field in dataclasses.fields(part) if "None" in str(field.type)}
    return {
        name: None if value is None and name in optional else _read(specs[name], value, f"{section}.{name}".lstrip("."), length)
        for name, value in values.items()
    }


def _read(spec: NumberSpec, value: Any, field: str, length: int | None) -> Array:
    bounds, size = spec.bounds._asdict(), len(spec.units)
    if size == 1 and spec.each:
        return numbers(value, spec.unit, field, length, **bounds, shared=spec.each == "load")
    if size == 1:
        return number(value, spec.unit, field, **bounds)
    if not isinstance(value, (list, tuple)) and getattr(value, "ndim", 0) != 1:
        raise InputError(field, f"is {quoted(value)}; it must be a list of {size} numbers, in {spec.unit}")
    if len(value) != size:
        raise InputError(field, f"has {counted(len(value))}; {size} are needed")
    units = enumerate(spec.units)
    return jnp.stack([number(value[k], unit, f"{field}[{k}]", **bounds) for k, unit in units])


class Part(Module):
    """Base of the parts of a scene: its text representation shows values with their units.

    >>> import jaxvib as jv
    >>> jv.ConstantSpeed("157.08 rad/s")
    constant_speed(speed='1500.003508 rpm')
    """

    def __repr__(self) -> str:
        specs = number_specs(type(self))
        names = [field.name for field in dataclasses.fields(self) if field.name != "kind"]
        values = {name: getattr(self, name) for name in names}
        present = {name: value for name, value in values.items() if value is not None and not _is_empty(value)}
        shown = [f"{name}={_shown(value, specs.get(name, PLAIN))}" for name, value in present.items()]
        name = getattr(self, "kind", type(self).__name__)
        if any(isinstance(value, Part) for value in values.values()):
            lines = ",\n".join(shown).replace("\n", "\n    ")
            return f"{name}(\n    {lines},\n)"
        return f"{name}({', '.join(shown)})"

    def __hash__(self) -> int:
        try:
            return super().__hash__()
        except TypeError:
            problem = f"{type(self).__name__} contains arrays and has no hash, like every equinox.Module with arrays"
            raise TypeError(f"{problem}; as a key use a text such as jv.scene_to_toml(scene)") from None


def _is_empty(value: object) -> bool:
    return value == () if isinstance(value, tuple) else getattr(value, "shape", None) == (0,)


def _shown(value: object, spec: NumberSpec) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_shown(each, spec) for each in value)}{',' * (len(value) == 1)})"
    if not hasattr(value, "dtype"):
        return repr(value) if isinstance(value, eqx.Module) else quoted(value, longest=300)
    text = when_known(lambda known: repr(with_display_units(spec, known)), value)
    return eqx.tree_pformat(value) if text is None else text


def with_display_units(spec: NumberSpec, value: Any) -> Any:
    """Return a number, or the nested list of an array, as texts with 10 digits and the display unit, which constructors read.

    A number without a unit, or one that is not finite in the display unit, stays a number.

    >>> with_display_units(NumberSpec(("N/m",), Bounds()), [5e4, 0.0]), with_display_units(PLAIN, 0.1)
    (['50 N/mm', '0 N/mm'], 0.1)
    """
    array = np.asarray(value)
    if len(spec.units) > 1:
        units = zip(spec.units, array, strict=True)
        return [with_display_units(spec._replace(units=(each,)), entry) for each, entry in units]
    if not spec.unit or array.dtype.kind != "f":
        return array.tolist()
    shown, factor = shown_unit(spec.unit_of_tables, float(np.max(np.abs(array), initial=0.0)))
    with np.errstate(over="ignore"):
        numbers = factor * array
    if not np.all(np.isfinite(numbers)):
        return array.tolist()
    return np.vectorize(lambda number: f"{number:.10g} {shown}", otypes=[object])(numbers).tolist()
