"""Arguments of the parts of a scene file, with units and defaults, read from the classes and functions that build the parts."""

from __future__ import annotations

import contextlib
import inspect
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from jaxvib.errors import InputError, quoted
from jaxvib.machine.files import EFFECTS, SECTIONS, suggest_name

__all__ = ["GROUPS", "Argument", "arguments_of", "described", "units_of_fields"]

GROUPS: Mapping[str, Mapping[str, Callable[..., object]]] = {
    "machines": SECTIONS["machine"],
    "loads": SECTIONS["loads"],
    "drives": SECTIONS["drive"],
    "effects": EFFECTS,
}
"""Parts that a scene file may name, by their word in the file."""


class Argument(NamedTuple):
    """One argument of a part: its `name`; its `unit`, "" for none; whether it must be given, `needed`; its `default` as text,
    None where there is none; the `allowed` texts, where it is one of several."""

    name: str
    unit: str
    needed: bool
    default: str | None
    allowed: tuple[str, ...]


class _Probe:
    """A quantity that notes in which unit it is read."""

    def __init__(self, value: float) -> None:
        self.value = value
        self.unit: str | None = None

    def m_as(self, units: str, /) -> float:
        self.unit = "" if units == "dimensionless" else units
        return self.value

    def unit_items(self) -> tuple[tuple[str, int], ...]:
        return ()


def arguments_of(build: Callable[..., object]) -> list[Argument]:
    """The arguments of what builds a part of a scene, such as `jv.balls`.

    The units are those in which it reads them: it is given quantities that note what they are asked for.

    >>> import jaxvib as jv
    >>> [(a.name, a.unit, a.needed, a.default) for a in arguments_of(jv.Stop)][1:3]
    [('gap', 'm', True, None), ('damping', 'N s/m', False, '0.0')]
    """
    parameters = inspect.signature(build).parameters
    numeric = [name for name, p in parameters.items() if _numeric(str(p.annotation))]
    needed = {name for name, p in parameters.items() if p.default is p.empty}
    units: dict[str, str] = {}
    works = 1  # how many numbers a list of those that are needed has
    # Numbers that descend make parts whose sizes must; options are asked for one at a time, since some exclude each other.
    for option in (None, *(name for name in numeric if name not in needed)):
        for several in (1, 2, 3):
            names = [name for name in numeric if name in needed or name == option]
            probes = {
                name: [
                    _Probe(0.5 ** (k + 1) * (j + 1.0)) for j in range(several if name == option or option is None else works)
                ]
                for k, name in enumerate(names)
            }
            listed = {name: str(parameters[name].annotation).startswith("Sequence") for name in names}
            given = {n: _example(p, several) for n, p in parameters.items() if n not in numeric}
            given |= {n: each if listed[n] else each[0] for n, each in probes.items()}
            # What these numbers make may be no machine; the units are read before that is seen.
            with contextlib.suppress(InputError, TypeError, ValueError):
                build(**given)
            for name, each in probes.items():
                read = list(dict.fromkeys(probe.unit for probe in each if probe.unit is not None))
                if len(read) > len(units.get(name, "").split(", ")) or (read and name not in units):
                    units[name] = ", ".join(read)
            if option is None and all(name in units for name in names):
                works = several
                break
    found = []
    for name, parameter in parameters.items():
        default = None if parameter.default in (parameter.empty, None) else _shown(parameter.default)
        found.append(Argument(name, units.get(name, ""), name in needed, default, _choices(build, parameter)))
    return found


def _numeric(annotation: str) -> bool:
    return re.search(r"\bNumbers?\b", annotation) is not None


def _example(parameter: inspect.Parameter, several: int) -> object:
    """A value that the part accepts, for an argument that is no number with a unit."""
    if "Sequence[int]" in str(parameter.annotation):
        return [(1, 2), (2, 3), (1, 3)] if several == 3 else []
    return 2 if parameter.default is parameter.empty else parameter.default


def _choices(build: Callable[..., object], parameter: inspect.Parameter) -> tuple[str, ...]:
    """The texts of a Literal, by its own name or written out."""
    annotation = str(parameter.annotation)
    home = inspect.getmodule(build)
    named = getattr(home, annotation, None) if annotation.isidentifier() else None
    texts = re.findall(r"['\"]([^'\"]+)['\"]", str(named) if named is not None else annotation)
    return tuple(texts) if "Literal" in (annotation + str(named)) else ()


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def described(group: str, name: str) -> Callable[..., object]:
    """Class or function that builds the part of that name. **Raises** `InputError` for a group or a name that there is not."""
    if group not in GROUPS:
        raise InputError("group", f"is {quoted(group)}; {suggest_name(group, list(GROUPS))}")
    if name not in GROUPS[group]:
        raise InputError("name", f"is {quoted(name)}; {suggest_name(name, list(GROUPS[group]))}")
    return GROUPS[group][name]


def units_of_fields(section: str, kind: str) -> dict[str, str]:
    """Units of the fields of a table of a scene file, such as ("machine", "two_mass"), or of ("effects", an effect)."""
    kinds = EFFECTS if section == "effects" else SECTIONS[section]
    return {argument.name: argument.unit for argument in arguments_of(kinds[kind])} if kind in kinds else {}
