"""Command `export` of jaxvib."""

from __future__ import annotations

from pathlib import Path

import click

import jaxvib as jv
from jaxvib.cli.app import Output, app, loaded_scene
from jaxvib.errors import InputError

_KINDS = ("fmu", "state-space", "uff")
_KIND_OF_OPTION = {
    "fmi": "fmu",
    "drive": "fmu",
    "source_only": "fmu",
    "mode": "state-space",
    "quantity": "uff",
    "rotor_speed": None,
}
"""Kind of file to which an option applies, by option; None: all kinds except fmu."""


@app.command("export")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--to", type=click.Choice(_KINDS), required=True, help="Format of the file.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="Path of the file to write.")
@click.option("--fmi", type=click.Choice(["2.0", "3.0"]), help="Version of an FMU [2.0].")
@click.option(
    "--drive",
    type=click.Choice(["scene", "input"]),
    help="Drive of the rotor in an FMU: that of SCENE, or inputs of the FMU [scene].",
)
@click.option("--source-only", is_flag=True, default=None, help="Do not compile an FMU.")
@click.option("--mode", type=int, help="Jam mode about which the state space is linearized [the machine at rest].")
@click.option(
    "--quantity",
    type=click.Choice(["displacement", "velocity", "acceleration"]),
    help="Quantity of the frequency responses in UFF [displacement].",
)
@click.option(
    "--rotor-speed",
    help="Rotor speed of the gyroscopic coupling, in a state space without --mode or in UFF, such as '3000 rpm' [mean speed of "
    "the drives].",
)
@click.option("--json", "as_json", is_flag=True, help="Print only one JSON document on stdout.")
def export(scene: Path, to: str, out: Path, as_json: bool, **options: object) -> None:
    """Write SCENE for other tools: an FMU, a state-space model (MAT) or a universal file (UFF)."""
    options_given = {name: value for name, value in options.items() if value is not None}
    for name in options_given:
        if to not in ([_KIND_OF_OPTION[name]] if _KIND_OF_OPTION[name] else ["state-space", "uff"]):
            raise InputError(f"--{name.replace('_', '-')}", f"cannot be used with --to {to}; leave it out")
    loaded, output = loaded_scene(scene), Output(as_json, None, scene=scene)
    if to == "fmu":
        source_only = bool(options_given.pop("source_only", False))
        unit = jv.export_fmu(loaded, out, binary=not source_only, **options_given)  # pyright: ignore[reportArgumentType]
        path, message = unit.path, unit.message
    elif to == "uff":
        path = jv.export_uff(loaded, out, **options_given)  # pyright: ignore[reportArgumentType]
        message = f"{len(jv.read_uff(path).functions)} frequency response functions, nodes and mode shapes"
    else:
        mode = options_given.pop("mode", None)
        at = "rest" if mode is None else jv.jam_modes(loaded).select(mode)  # pyright: ignore[reportArgumentType]
        model = jv.state_space(loaded, at, **options_given)  # pyright: ignore[reportArgumentType]
        path, message = model.save(out), model.about
    output.files.append(str(path))
    output.done({"kind": to, "path": str(path), "message": message}, lambda: message, "export")
