"""Commands `settle`, `envelope` and `growth` of jaxvib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import jaxvib as jv
from jaxvib.cli.app import (
    SPEED,
    TOLERANCE,
    WITHOUT,
    Output,
    command,
    loaded_scene,
    ranges_within,
    require_tolerances,
    tolerance_table,
)
from jaxvib.cli.document import (
    SEPARATION,
    chosen_steps,
    deck_options,
    measured_document,
    measures_document,
    require_deck_options,
    run_document,
    run_measures,
    run_text,
)
from jaxvib.cli.output import csv_options
from jaxvib.errors import InputError

_START_HELP = "Initial state [jam with --mode, otherwise rest]."
_START = click.option("--start", type=click.Choice(["rest", "jam", "spin_up"]), help=_START_HELP)
_START_AT_FULL_SPEED = click.option("--start", type=click.Choice(["rest", "jam"]), help=_START_HELP)
_MODE = click.option("--mode", type=int, help="Number of the jam mode near which the run starts.")


@command("settle")
@_START_AT_FULL_SPEED
@_MODE
@SEPARATION
@click.option(
    "--drift", type=float, help="Largest drift (relative change) of a settled motion [1e-6, or a change without a trend]."
)
@click.option("--step-tolerance", "tolerance", type=float, help="Allowed error of one time step [1e-9].")
@click.option("--segments", type=int, default=200, help="Largest number of segments of the run.")
@SPEED
@TOLERANCE
@deck_options
def settle(
    scene: Path,
    speed: str | None,
    tolerance: float | None,
    tolerances: tuple[str, ...],
    output: Output,
    **options: Any,
) -> None:
    """Integrate the full equations of SCENE until amplitudes and speeds no longer change, or change without a trend.

    The run consists of segments of 100 periods of the lowest natural frequency; --out saves the last one. With --drift, the
    motion must settle to this drift; a motion that is only steady in the mean (changes without a trend) does not suffice.
    """
    from jaxvib.machine.validation import off_notes  # slow import, which --help does not need

    loaded = loaded_scene(scene, speed=speed, constant=True)
    require_tolerances(loaded, tolerances)
    require_deck_options(loaded)
    run = jv.settle(loaded, stepsize_controller=chosen_steps(tolerance), **options)
    output.figure("history.png", run.plot)
    output.save_result("run.npz", run)
    measures = run_measures(run)
    ranges = ranges_within(run.scene, _modes_of(run) if tolerances else [], tolerances)
    document = run_document(run, measures) | (
        {"tolerances": [ranges_of_quantity._asdict() for ranges_of_quantity in ranges]} if tolerances else {}
    )

    def text() -> str:
        table = [tolerance_table(ranges, tolerances)] if tolerances else []
        return "\n".join([*off_notes(loaded), run_text(run, measures), *table])

    output.done(document, text, "settle", run)


def _modes_of(run: jv.Run) -> list[int] | None:
    """Return the jam mode of a run in a list; None for a scene without jam modes, see `Scene.is_plain`.

    **Raises** `InputError` for loads that are not jammed.
    """
    if not run.scene.is_plain:
        return None
    if not (mode := int(run.regime.mode)):
        raise InputError("--tolerance", f"is for jams; these loads are {run.regime.label.replace('_', ' ')}; leave it out")
    return [mode]


_SAMPLES = 4000
"""Number of saved states of an averaged run: enough for a figure in which fast beats are bands."""


@command("envelope")
@click.option("--until", required=True, help="End time, such as 20s or '10 min'.")
@_START
@_MODE
@SEPARATION
@click.option("--spin-up", help="Duration of the spin-up, with --start spin_up [half of --until].")
@click.option("--step-tolerance", "tolerance", type=float, help="Allowed error of one time step [1e-4].")
@WITHOUT
@deck_options
@csv_options
def envelope(
    scene: Path, tolerance: float | None, without: tuple[str, ...], csv: Path | None, output: Output, **options: Any
) -> None:
    """Integrate the averaged equations of SCENE, with steps of many turns, for long run-ups; --out saves envelope.npz."""
    loaded = loaded_scene(scene, without)
    run = jv.envelope(loaded, stepsize_controller=chosen_steps(tolerance), samples=_SAMPLES, **_with_start(options))
    output.figure("envelope.png", run.plot)
    output.save_result("envelope.npz", run)
    output.csv(csv, run, "trajectory_time")
    measures = run_measures(run)
    document = {**measured_document(run, loaded), **measures_document(run, measures), "ripple": run.ripple}
    output.done(document, lambda: run.summary(measures), "envelope", run)


@command("growth")
@click.option("--until", required=True, help="Duration of the whole run, such as 60s.")
@_START_AT_FULL_SPEED
@_MODE
@SEPARATION
@SPEED
@click.option("--segments", type=int, default=40, help="Number of equal parts of the run, at least 8.")
def growth(scene: Path, speed: str | None, output: Output, **options: Any) -> None:
    """Measure the growth of small disturbances of a motion of SCENE.

    The growth shows whether the motion is regular, unstable, chaotic or undecided. It also determines the time after which
    derivatives are meaningless."""
    result = jv.growth(loaded_scene(scene, speed=speed, constant=True), **_with_start(options))
    output.figure("growth.png", result.plot)
    output.done(result.as_dict(), result.summary, "growth", result)


def _with_start(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a run. If `start` is None, it becomes "jam" for a run with a mode, otherwise "rest"."""
    return {**options, "start": options["start"] or ("rest" if options["mode"] is None else "jam")}
