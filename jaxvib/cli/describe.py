"""jaxvib describe."""

from __future__ import annotations

import inspect

import click

from jaxvib.cli.app import Output, app, shared, table


@app.command("describe")
@click.argument("group", type=click.Choice(["machines", "loads", "drives", "effects"]), required=False)
@click.argument("name", required=False)
@shared
def describe(group: str | None, name: str | None, output: Output) -> None:
    """List the contents of scene files: machines, loads, drives, effects, their arguments with units and defaults."""
    from jaxvib.report.arguments import GROUPS, arguments_of, described

    if group is None:
        known = {word: list(kinds) for word, kinds in GROUPS.items()}
        output.done({"groups": known}, lambda: "\n".join(f"{g}: {', '.join(k)}" for g, k in known.items()), "describe")
        return
    kinds = GROUPS[group] if name is None else {name: described(group, name)}
    found = [
        {
            "kind": kind,
            "about": (inspect.getdoc(build) or "").split("\n\n")[0].replace("\n", " "),
            "arguments": [argument._asdict() for argument in arguments_of(build)],
        }
        for kind, build in kinds.items()
    ]

    def text() -> str:
        parts = []
        for part in found:
            rows = [
                [
                    argument["name"],
                    argument["unit"],
                    "needed" if argument["needed"] else argument["default"] or "none",
                    ", ".join(argument["allowed"]) or argument["bounds"],
                ]
                for argument in part["arguments"]
            ]
            parts.append(f"{part['kind']}: {part['about']}")
            parts.append(table("", ["argument", "unit", "default", "allowed"], rows))
        if name is not None:
            parts.append(_manual(kinds[name]))
        return "\n".join(parts)

    output.done({group: found}, text, "describe")


def _manual(build: object) -> str:
    """Return the docstring up to its example."""
    return (inspect.getdoc(build) or "").split(">>>")[0].rstrip()
