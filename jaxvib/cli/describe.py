"""Command `describe` of jaxvib."""

from __future__ import annotations

import inspect
import textwrap
from typing import TYPE_CHECKING

import click

from jaxvib.cli.app import Output, command
from jaxvib.errors import InputError, quoted

if TYPE_CHECKING:
    from jaxvib.report.arguments import Argument

_WIDTH = 80


@command("describe", None)
@click.argument("group", metavar="[GROUP|NAME]", required=False)
@click.argument("name", required=False)
def describe(group: str | None, name: str | None, output: Output) -> None:
    """List the contents of scene files: machines, loads, drives, effects, their arguments with units, defaults and meanings.

    GROUP is machines, loads, drives, effects or tables ([[exciters]], [[machine.supports]], [[machine.bodies]]); NAME is a
    part, such as three_mass or exciter, whose whole documentation is printed."""
    from jaxvib.errors import suggest_name
    from jaxvib.report.arguments import GROUPS, arguments_of, builder_of

    if group is None:
        groups = {word: list(kinds) for word, kinds in GROUPS.items()}
        output.done({"groups": groups}, lambda: "\n".join(f"{g}: {', '.join(k)}" for g, k in groups.items()), "describe")
        return
    group, name = group.replace("-", "_"), name and name.replace("-", "_")  # two-mass, as in `jaxvib new two-mass`
    if group not in GROUPS and name is None:
        group_of_part = next((each for each, kinds in GROUPS.items() if group in kinds), None)
        if group_of_part is None:
            all_names = {kind: build for kinds in GROUPS.values() for kind, build in kinds.items()}
            word = group.replace("_", " ")
            parts = [kind for kind, build in all_names.items() if word in f"{kind} {inspect.getdoc(build)}".lower()]
            known = f"parts that mention it: {', '.join(parts)}" if parts else suggest_name(group, [*GROUPS, *all_names])
            raise InputError("name", f"is {quoted(group)}; {known}")
        group, name = group_of_part, group
    kinds = GROUPS.get(group, {}) if name is None else {name: builder_of(group, name)}
    parts_found = [
        {
            "kind": kind,
            "about": (inspect.getdoc(build) or "").split("\n\n")[0].replace("\n", " "),
            "arguments": [argument._asdict() for argument in arguments_of(build)],
        }
        for kind, build in kinds.items()
    ]

    def text() -> str:
        parts = []
        for kind, build in kinds.items():
            parts.append(_wrap(f"{kind}: {(inspect.getdoc(build) or '').split(chr(10) * 2)[0]}", ""))
            parts += [_argument_text(argument) for argument in arguments_of(build)]
            parts.append("")
        if name is not None:
            parts.append((inspect.getdoc(kinds[name]) or "").split(">>>")[0].rstrip())
        return "\n".join(parts).rstrip()

    output.done({group: parts_found}, text, "describe")


def _argument_text(argument: Argument) -> str:
    """Return an argument as a line with its unit, default and allowed values, followed by its meaning."""
    default = "needed" if argument.needed else f"default {argument.default or 'none'}"
    facts = [argument.unit, default, ", ".join(argument.allowed) or argument.bounds]
    head = _wrap(f"{argument.name}: {'; '.join(filter(None, facts))}", "  ")
    return f"{head}\n{_wrap(argument.meaning, '      ')}" if argument.meaning else head


def _wrap(text: str, indent: str) -> str:
    return textwrap.fill(" ".join(text.split()), _WIDTH, initial_indent=indent, subsequent_indent=indent)
