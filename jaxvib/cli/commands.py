"""Commands `new` and `simulate` of jaxvib."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, loaded_scene
from jaxvib.cli.document import (
    SEPARATION,
    chosen_steps,
    deck_options,
    require_deck_options,
    run_document,
    run_measures,
    run_text,
)
from jaxvib.cli.output import csv_options, write_file
from jaxvib.errors import InputError
from jaxvib.machine.templates import SCREENS, TEMPLATES

if TYPE_CHECKING:
    from jaxvib.ode.progress import ProgressMeter

_START_HELP = (
    "Initial state: rest (an ideal drive turns at its speed, a motor stands still), jam (with --mode), or spin_up (smooth, "
    "from rest)."
)

_FILES = ("design", *(f"{kind.replace('_', '-')}-design" for kind in SCREENS), "identification", "measurement", "sweep")
_MACHINES = tuple(kind.replace("_", "-") for kind in (*TEMPLATES, *SCREENS))


@command("new", None, context_settings={"token_normalize_func": lambda word: word.replace("_", "-").lower()})
@click.argument("kind", metavar="KIND", type=click.Choice([*_MACHINES, *_FILES]))
def new(kind: str, output: Output) -> None:
    """Print a commented scene file of a KIND of machine, or a file for `optimize`, `sweep`, `identify` or `plan`.

    \b
    For `optimize`: design, linear-screen-design, circular-screen-design,
      feeder-design.
    For `sweep`: sweep (a study). For `identify` and `plan`: identification
      (recorded runs of a machine). For `identify`: measurement (a swing)."""
    from jaxvib.exchange.recordings.fit_file import TEMPLATE as IDENTIFICATION
    from jaxvib.study.bearing.measurement import TEMPLATE as MEASUREMENT
    from jaxvib.sweeps.study import TEMPLATE as STUDY
    from optimize.files import TEMPLATES as DESIGNS

    files = {**DESIGNS, "identification": IDENTIFICATION, "measurement": MEASUREMENT, "sweep": STUDY}
    text = files[kind] if kind in files else {**TEMPLATES, **SCREENS}[kind.replace("-", "_")]
    name = "study" if kind == "sweep" else kind
    path = output.file(f"{name}.toml" if kind in files else "machine.toml")
    if path is None:
        output.done({"kind": kind, "toml": text}, lambda: text.rstrip(), "new")
        return
    if path.exists():
        raise InputError("--out", f"already contains {path.name}, which is not overwritten; give another folder")
    write_file(path, text)
    output.done({"kind": kind, "toml": text}, lambda: f"a commented file for {kind}", "new")


new.help = f"{inspect.cleandoc(new.help or '')}\n\nMachines: {', '.join(_MACHINES)}."


@command("simulate")
@click.option("--until", required=True, help="End time, such as 20s or '0.5 min'.")
@click.option("--start", type=click.Choice(["rest", "jam", "spin_up"]), default="rest", help=_START_HELP)
@click.option("--mode", type=int, help="Number of the jam mode, with --start jam.")
@SEPARATION
@click.option("--spin-up", help="Duration of the spin-up, with --start spin_up [half of --until].")
@click.option("--step-tolerance", "tolerance", type=float, help="Allowed error of one time step [1e-8].")
@click.option("--accuracy", type=float, help="Allowed error of the motion at the end, in place of --step-tolerance.")
@click.option("--max-steps", type=int, help="Largest number of time steps.")
@click.option("--window", is_flag=True, help="Save only the measurements over the last turns, and no trajectory.")
@deck_options
@csv_options
def simulate(
    scene: Path, tolerance: float | None, accuracy: float | None, window: bool, csv: Path | None, output: Output, **options: Any
) -> None:
    """Integrate the full equations of SCENE; --out saves the motion (run.npz) and its figure."""
    if tolerance is not None and accuracy is not None:
        raise InputError("--accuracy", "cannot be combined with --step-tolerance; give one of them")
    if csv is not None and window:
        raise InputError("--csv", "needs a trajectory, which --window does not save; leave one of them out")
    loaded = loaded_scene(scene)
    require_deck_options(loaded)
    with _progress_meter(output) if _is_long(loaded, options["until"]) else contextlib.nullcontext() as meter:
        run = jv.simulate(
            loaded,
            stepsize_controller=chosen_steps(tolerance) if accuracy is None else jv.Accuracy(accuracy),
            save="window" if window else "all",
            progress_meter=meter,
            **options,
        )
    output.figure("history.png", lambda: run.plot())
    output.save_result("run.npz", run)
    output.csv(csv, run, "time")
    measures = run_measures(run)
    output.done(run_document(run, measures), lambda: run_text(run, measures), "simulate", run)


@contextlib.contextmanager
def _progress_meter(output: Output) -> Iterator[ProgressMeter]:
    """Show the finished share of the time of a run, which the yielded meter reports."""
    from jaxvib.ode.progress import ProgressMeter  # slow import, which --help does not need

    with output.progress() as progress:
        yield ProgressMeter(lambda share: progress("integrating", share))


_MIN_ANGLE_OF_LONG_RUNS = 2e6
"""Angle of the rotor, rad, from which the share of a run is shown. A program that shows it cannot be stored and is compiled for
each run, which takes as long as a run of about this angle."""


def _is_long(scene: jv.Scene, until: str) -> bool:
    """Return True for a run that is so long that its finished share is useful."""
    from jaxvib.units import number

    return bool(number(until, "s", "until") * scene.top_speed > _MIN_ANGLE_OF_LONG_RUNS)
