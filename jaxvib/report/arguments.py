"""Arguments of the parts of a scene file, with units and defaults, read from the classes and functions that build the parts."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.machine.files import EFFECTS, SECTIONS
from jaxvib.machine.numbers import PLAIN, number_specs
from jaxvib.machine.scene import Exciter
from jaxvib.machine.structures.plane_body import body, support

GROUPS: Mapping[str, Mapping[str, Callable[..., object]]] = {
    "machines": SECTIONS["machine"],
    "loads": SECTIONS["loads"],
    "drives": SECTIONS["drive"],
    "effects": EFFECTS,
    "tables": {"exciter": Exciter, "support": support, "body": body},
}
"""Functions that build the parts of a scene, by group and by the name of the part in a scene file. The group "tables" has the
contents of [[exciters]], [[machine.supports]] and [[machine.bodies]]."""


class Argument(NamedTuple):
    """Argument of a part.

    **Attributes**: `name`; `unit`, "" for none; `needed`: True if the argument has no default; `default` as text, or None;
    `allowed`: the allowed texts, () if other values are possible; `bounds` of a number in words; `meaning` from the docstring.
    """

    name: str
    unit: str
    needed: bool
    default: str | None
    allowed: tuple[str, ...]
    bounds: str
    meaning: str


def arguments_of(build: Callable[..., object]) -> list[Argument]:
    """Return the arguments of the class or function that builds a part of a scene, such as `jv.balls`.

    Units and bounds are those of the part's fields of the same names.

    >>> import jaxvib as jv
    >>> [(a.name, a.unit, a.needed, a.default, a.bounds) for a in arguments_of(jv.Stop)][1:3]
    [('gap', 'm', True, None, 'at least 0'), ('damping', 'N s/m', False, '0.0', 'at least 0')]
    """
    arguments, specs, meanings = [], number_specs(part_of(build)), _meanings(inspect.getdoc(build) or "")
    for name, parameter in inspect.signature(build).parameters.items():
        default = None if parameter.default in (parameter.empty, None) else _default_text(parameter.default)
        spec = specs.get(name, PLAIN)
        needed = parameter.default is parameter.empty
        meaning = meanings.get(name, spec.words)
        if spec.unit and meaning.startswith(spec.unit):
            meaning = f"{spec.words}, {meaning}"
        arguments.append(Argument(name, spec.unit, needed, default, _choices(build, parameter), spec.bounds.words, meaning))
    return arguments


def _meanings(text: str) -> dict[str, str]:
    """Return the descriptions in the list of arguments of a docstring, by the name of the argument.

    >>> _meanings("**Arguments**\\n\\n- `mass` M, kg; typical: 5\\n- `low` and `high`: the ends\\n  of a range\\n\\nEnd.")
    {'mass': 'mass M, kg; typical: 5', 'low': 'the ends of a range', 'high': 'the ends of a range'}
    """
    _, _, listed = text.partition("**Arguments**")
    meanings = {}
    for entry in re.findall(r"^- (`.*(?:\n  .*)*)", listed.partition("**Returns**")[0], re.MULTILINE):
        line = " ".join(entry.split())
        head = re.match(r"`\w+`(?:(?:, | and | or )`\w+`)*", line)
        if head is not None:
            rest = line[head.end() :].replace("`", "")
            meaning = rest.lstrip(":, ") if rest.startswith((":", ",")) else head[0].strip("`").replace("_", " ") + rest
            meanings |= dict.fromkeys(re.findall(r"\w+", head[0].replace(" and ", " ").replace(" or ", " ")), meaning)
    return meanings


def part_of(build: Callable[..., object]) -> type:
    """Return the class of the part that a class or a function builds."""
    if isinstance(build, type):
        return build
    function = inspect.unwrap(build)
    returned = function.__annotations__["return"]
    return returned if isinstance(returned, type) else function.__globals__[returned]


def _choices(build: Callable[..., object], parameter: inspect.Parameter) -> tuple[str, ...]:
    """Return the allowed texts of an argument whose type is a Literal, or an alias of a Literal; () for other types."""
    annotation = str(parameter.annotation)
    module = inspect.getmodule(build)
    alias = getattr(module, annotation, None) if annotation.isidentifier() else None
    texts = re.findall(r"['\"]([^'\"]+)['\"]", str(alias) if alias is not None else annotation)
    return tuple(texts) if "Literal" in (annotation + str(alias)) else ()


def _default_text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def builder_of(group: str, name: str) -> Callable[..., object]:
    """Return the class or function that builds the part with this group and name. **Raises** `InputError` for unknown names."""
    if group not in GROUPS:
        raise InputError("group", f"is {quoted(group)}; {suggest_name(group, list(GROUPS))}")
    if name not in GROUPS[group]:
        raise InputError("name", f"is {quoted(name)}; {suggest_name(name, list(GROUPS[group]))}")
    return GROUPS[group][name]
