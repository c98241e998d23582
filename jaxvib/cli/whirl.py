"""Command `whirl` of jaxvib."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

import jaxvib as jv
from jaxvib.cli.app import SPEED_TYPE, Output, command, loaded_scene, table
from jaxvib.cli.output import csv_options

_MOTION = ("forward", "straight", "angle")
"""Attributes of `Whirl` and `CriticalSpeeds` on the sense of each motion."""


@command("whirl")
@click.option("--speed", type=SPEED_TYPE, help="Rotor speed, such as '3000 rpm' [the speed of the drive].")
@click.option(
    "--loads",
    type=click.Choice(["fixed", "none"]),
    default="fixed",
    help="'fixed': the masses of the loads are fixed to the rotor; 'none': without the loads.",
)
@csv_options
def whirl(scene: Path, speed: str | None, loads: Literal["fixed", "none"], csv: Path | None, output: Output) -> None:
    """List the whirl frequencies of the rotor in SCENE, forward, backward or straight (on a line at an angle), and
    its critical speeds; --out adds the Campbell diagram."""
    import numpy as np  # slow imports, which --help does not need

    from jaxvib.units import number

    loaded = loaded_scene(scene)
    rotor_speed = float(loaded.exciter.drive.speed) if speed is None else float(number(speed, "rad/s", "--speed", low=0.0))
    result = jv.whirl(loaded, [rotor_speed], loads=loads)
    exists = np.isfinite(result.critical.speed)
    named = {name: np.asarray(getattr(result.critical, name))[exists].tolist() for name in ("speed", *_MOTION)}
    critical = [dict(zip(named, values, strict=True)) for values in zip(*named.values(), strict=True)]
    named = {name: np.asarray(getattr(result, name))[0].tolist() for name in ("speed", "decay", *_MOTION)}
    whirls = [dict(zip(named, values, strict=True)) for values in zip(*named.values(), strict=True)]
    top = 1.3 * max([rotor_speed, *(entry["speed"] for entry in critical)])
    speeds = np.linspace(0.0, top, 161)
    output.figure("campbell.png", lambda: jv.whirl(loaded, speeds, loads=loads).plot(at=rotor_speed))
    if csv is not None:
        output.csv(csv, jv.whirl(loaded, speeds, loads=loads), "rotor_speed")
    document = {"rotor_speed": rotor_speed, "loads": loads, "whirl": whirls, "critical": critical}

    def text() -> str:
        from jaxvib.display import speed_text, speed_unit  # slow import, which --help does not need

        unit, scale = speed_unit()

        pairs = zip(critical, result.critical.sense[exists], strict=True)
        rows = [[sense, f"{scale * w['speed']:.6g}"] for w, sense in pairs]
        whirl_pairs = zip(whirls, result.sense[0], strict=True)
        whirl_speeds = [[sense, f"{scale * w['speed']:.6g}", f"{w['decay']:.4g}"] for w, sense in whirl_pairs]
        return "\n".join(
            [
                table("critical speeds: whirl frequency = rotor speed", ["", unit], rows),
                table(f"whirl at {speed_text(rotor_speed)}", ["", unit, "decay, 1/s"], whirl_speeds),
            ]
        )

    output.done(document, text, "whirl", result)
