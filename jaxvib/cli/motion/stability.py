"""Commands `stability-map` and `onset` of jaxvib."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import SPEED_TYPE, WITHOUT, Output, command, loaded_scene, table
from jaxvib.cli.output import fields_of
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.machine.scene import Scene

_VARY = click.option(
    "--vary",
    required=True,
    metavar="NAME",
    help="Name of a parameter of the scene, such as loads.mass or machine.stiffness[0].",
)
_OMEGA = click.option(
    "--omega",
    nargs=2,
    type=SPEED_TYPE,
    required=True,
    metavar="FROM TO",
    help="Range of load speeds, such as '20 rad/s' '60 rad/s'.",
)
_POINTS_OPTION = click.option("--points", type=int, default=300, help="Number of load speeds of each diagram.")


@command("stability-map")
@_VARY
@click.option("--value", "values", multiple=True, required=True, help="Value of the parameter with its unit; repeatable.")
@_OMEGA
@_POINTS_OPTION
@WITHOUT
def stability_map(
    scene: Path,
    vary: str,
    values: tuple[str, ...],
    omega: tuple[str, str],
    points: int,
    without: tuple[str, ...],
    output: Output,
) -> None:
    """Map the stability of exact jams of SCENE over a parameter; --out draws the map."""
    loaded = loaded_scene(scene, without)
    make, read = _scene_function_and_reader(loaded, vary)
    x = [read(value, "--value") for value in values]
    result = jv.stability_map(make, x, omega=_speed_range(omega), points=points)
    words = ", ".join(filter(None, _words_and_unit(loaded, vary)))
    output.figure("stability_map.png", lambda: result.plot(label=words))
    rows = [
        {
            "value": float(value),
            "stable_share": float(result.stable_share[k]),
            "special": [fields_of(p, "kind", "omega", "rotor_speed") for p in result.special[k]],
        }
        for k, value in enumerate(result.value)
    ]

    def text() -> str:
        from jaxvib.display import speed_unit  # slow import, which --help does not need

        unit, scale = speed_unit()
        cells = [
            [f"{row['value']:.6g}", f"{100.0 * row['stable_share']:.3g} %", _special_text(row["special"], scale)]
            for row in rows
        ]
        return table(f"exact jams over {vary}", [words, "stable load speeds", f"where stability changes, {unit}"], cells)

    output.done({"vary": vary, "map": rows}, text, "stability_map", result)


def _special_text(points: list[dict], scale: float) -> str:
    from jaxvib.steady.jams.branch_plot import KINDS  # slow import, which --help does not need

    return ", ".join(f"{KINDS[p['kind']]} {scale * p['omega']:.5g}" for p in points) or "nowhere"


@command("onset")
@_VARY
@click.option(
    "--kind", required=True, help="Kind: fold, torus (torus bifurcation), period_doubling or symmetry (loss of symmetry)."
)
@click.option(
    "--between", nargs=2, required=True, metavar="LOW HIGH", help="A value without the special point, and a higher one with it."
)
@_OMEGA
@_POINTS_OPTION
@click.option("--accuracy", type=float, default=1e-3, help="Relative accuracy of the value.")
@WITHOUT
def onset(
    scene: Path,
    vary: str,
    kind: str,
    between: tuple[str, str],
    omega: tuple[str, str],
    points: int,
    accuracy: float,
    without: tuple[str, ...],
    output: Output,
) -> None:
    """Find the value of a parameter at which a torus bifurcation, or another special point, appears in the diagram of SCENE."""
    from jaxvib.steady.jams.branch_plot import KINDS  # slow import, which --help does not need

    loaded = loaded_scene(scene, without)
    make, read = _scene_function_and_reader(loaded, vary)
    low, high = (read(value, "--between") for value in between)
    found = jv.stability_onset(make, kind, (low, high), omega=_speed_range(omega), points=points, accuracy=accuracy)
    document = {"vary": vary, "kind": kind, "value": found, "accuracy": accuracy, "between": [low, high]}
    words, unit = _words_and_unit(loaded, vary)
    value = f"{found:.6g} {unit}".rstrip()
    sentence = f"{KINDS[kind]}: appears when {words} increases to {value} (relative accuracy {accuracy:g})"
    output.done(document, lambda: sentence, "onset")


def _scene_function_and_reader(scene: Scene, name: str) -> tuple[Callable[[float], Scene], Callable[[str, str], float]]:
    """Return a function that returns the scene for a value of the parameter `name`, and a function that reads such a value."""
    from jaxvib.machine.numbers.named import find_number, present_numbers, put_present

    parameter = find_number(scene, name, "--vary")
    present_numbers(scene, parameter, "--vary")  # raises an error for an array of absent springs
    return lambda x: put_present(scene, parameter, x), parameter.value


def _words_and_unit(scene: Scene, name: str) -> tuple[str, str]:
    """Return the name of a parameter in words, and its SI unit."""
    from jaxvib.machine.numbers.named import find_number

    parameter = find_number(scene, name, "--vary")
    words = parameter.words(scene)
    return words[0] if len(words) == 1 else name, parameter.unit


def _speed_range(omega: tuple[str, str]) -> tuple[float, float]:
    from jaxvib.units import number

    low, high = (float(number(value, "rad/s", "--omega", low=0.0)) for value in omega)
    if not low < high:
        raise InputError("--omega", f"is {low:g} to {high:g} rad/s; the second must be larger than the first")
    return low, high
