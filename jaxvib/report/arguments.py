"""Arguments of the parts of a scene file, with units and defaults, read from the classes and functions that build the parts."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from jaxvib.errors import InputError, quoted
from jaxvib.machine.files import EFFECTS, SECTIONS, suggest_name
from jaxvib.machine.numbers import PLAIN, number_specs

__all__ = ["GROUPS", "Argument", "arguments_of", "described", "part_of"]

GROUPS: Mapping[str, Mapping[str, Callable[..., object]]] = {
    "machines": SECTIONS["machine"],
    "loads": SECTIONS["loads"],
    "drives": SECTIONS["drive"],
    "effects": EFFECTS,
}
"""Parts that a scene file may name, by their word in the file."""


class Argument(NamedTuple):
    """One argument of a part: its `name`; its `unit`, "" for none; whether it must be given, `needed`; its `default` as text,
    None where there is none; the `allowed` texts, where it is one of several; the `bounds` of a number in words."""

    name: str
    unit: str
    needed: bool
    default: str | None
    allowed: tuple[str, ...]
    bounds: str


def arguments_of(build: Callable[..., object]) -> list[Argument]:
    """Return the arguments of the class or function that builds a part of a scene, such as `jv.balls`.

    Units and bounds are those of the part's fields of the same names.

    >>> import jaxvib as jv
    >>> [(a.name, a.unit, a.needed, a.default, a.bounds) for a in arguments_of(jv.Stop)][1:3]
    [('gap', 'm', True, None, 'at least 0'), ('damping', 'N s/m', False, '0.0', 'at least 0')]
    """
    found, specs = [], number_specs(part_of(build))
    for name, parameter in inspect.signature(build).parameters.items():
        default = None if parameter.default in (parameter.empty, None) else _shown(parameter.default)
        spec = specs.get(name, PLAIN)
        needed = parameter.default is parameter.empty
        found.append(Argument(name, spec.unit, needed, default, _choices(build, parameter), spec.bounds.words))
    return found


def part_of(build: Callable[..., object]) -> type:
    """Return the class of the part that a class or a function builds."""
    if isinstance(build, type):
        return build
    function = inspect.unwrap(build)
    return function.__globals__[function.__annotations__["return"]]


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
