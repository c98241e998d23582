"""Commands `run-up` and `run-up-map` of jaxvib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import jaxvib as jv
from jaxvib.cli.app import WITHOUT, Output, command, loaded_scene, table
from jaxvib.cli.document import SEPARATION, chosen_steps, stays_document
from jaxvib.cli.output import csv_options, fields_of
from jaxvib.errors import InputError


@command("run-up")
@click.option("--until", required=True, help="End time, such as 20s.")
@click.option(
    "--least", is_flag=True, help="Also find the smallest factor of all torques with which all exciters pass the resonances."
)
@WITHOUT
@csv_options
def run_up(scene: Path, until: str, least: bool, without: tuple[str, ...], csv: Path | None, output: Output) -> None:
    """Compute the run-up of the motors of SCENE from rest by averaged equations, and list the resonances that catch exciters.

    --out adds the figure. For scenes with loads (balls, pendulums) use `run-up-map`."""
    found = jv.run_up(loaded_scene(scene, without), until, least=least)
    output.figure("run_up.png", found.plot)
    output.csv(csv, found.run, "trajectory_time")
    names = ("resonances", "speed", "caught_at", "peak_amplitude", "peak_force", "speed_variation")
    optional_fields = {"least_torque": found.least_torque} if least else {}
    document = {"status": found.status_name, "message": found.message, **fields_of(found, *names), **stays_document(found.run)}
    output.done(document | optional_fields, found.summary, "run_up", found)


@command("run-up-map")
@click.option("--until", required=True, help="End time of each run-up, such as 6s.")
@click.option("--drag", "drags", multiple=True, help="Drag of the loads, such as '0.5 N s/m'; repeatable [value of SCENE].")
@click.option("--starts", type=int, help="Number of random sets of initial angles [one set: loads side by side at the bottom].")
@click.option("--seed", type=int, default=0, help="Seed of the random angles.")
@SEPARATION
@click.option("--step-tolerance", "tolerance", type=float, help="Allowed error of one time step [1e-7].")
@click.option("--batch", type=int, default=16, help="Number of run-ups that advance together on each core.")
def run_up_map(scene: Path, drags: tuple[str, ...], tolerance: float | None, output: Output, **options: Any) -> None:
    """Compute run-ups of SCENE from rest for each drag and each set of initial angles, and report the final regimes.

    \b
    For other parameters, such as a torque, use `jaxvib sweep` with a study:
      scene = "machine.toml"
      samples = 8               # initial angles for each torque
      [axes]
      "drive.stall_torque" = { from = 10.0, to = 80.0, count = 3 }
      "start.angle" = { from = "0 deg", to = "360 deg" }
      [run]
      until = "6 s"
      [[measure]]
      quantity = "run.regime"
    """
    from jaxvib.units import number

    drag_values = [float(number(drag, "N s/m", "--drag", low=0.0)) for drag in drags] or None
    loaded = loaded_scene(scene)
    if all(exciter.loads is None for exciter in loaded.exciters):
        raise InputError("scene", "has no loads (balls, pendulums); for motors with unbalances use `jaxvib run-up`")
    found = jv.run_up_map(loaded, drag=drag_values, stepsize_controller=chosen_steps(tolerance), **options)
    output.figure("run_up_map.png", found.plot)
    output.save_result("run_up_map.npz", found)
    kinds = sorted(set(found.kind.ravel().tolist()))
    rows = [
        {
            "drag": float(drag),
            "shares": {kind: float(found.fraction(kind)[k]) for kind in kinds},
            "kind": found.kind[k],
            "omega": found.omega[k],
        }
        for k, drag in enumerate(found.drag)
    ]

    def text() -> str:
        if len(found.angle) == 1:
            return found.summary()
        shares = [[f"{row['drag']:.5g}", *(f"{100.0 * row['shares'][kind]:.3g} %" for kind in kinds)] for row in rows]
        return "\n".join([table("final motion of the loads", ["drag, N s/m", *kinds], shares), found.summary()])

    document = {"until": options["until"], "starts": len(found.angle), "seed": options["seed"], "map": rows}
    output.done(document, text, "run_up_map", found)
