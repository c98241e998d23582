"""Commands `sweep` and `show` of jaxvib."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from jaxvib.cli.app import Output, command, table
from jaxvib.cli.output import duration_text, note
from jaxvib.errors import InputError, optional_module, quoted

if TYPE_CHECKING:
    from jaxvib.sweeps.sweep import Progress, Sweep


@command("sweep", "study")
@click.option("--store", type=click.Path(path_type=Path), help="Folder to write [name of STUDY with the ending .zarr].")
@click.option("--resume/--no-resume", default=True, help="Continue the study if its store exists already.")
@click.option("--workers", type=click.IntRange(min=1), help="Number of processes on this computer (Dask).")
@click.option("--scheduler", metavar="ADDRESS", help="Address of a Dask scheduler, such as tcp://10.0.0.1:8786.")
@click.option("--timeout", default="30 s", help="Longest time until the scheduler and its workers answer.")
def sweep(
    study: Path, store: Path | None, resume: bool, workers: int | None, scheduler: str | None, timeout: str, output: Output
) -> None:
    """Compute all cases of the study file STUDY, and store the results on disk; after an interruption, the same command
    continues.

    --out adds the figure that fits the study (sweep.png).
    """
    optional_module("zarr", "sweep")  # first, because the other imports and the study take seconds

    from jaxvib.sweeps.study import load_study  # slow imports, which --help does not need
    from jaxvib.sweeps.sweep import run_study

    path = store or study.with_suffix(".zarr")
    if not resume and os.path.exists(path):
        raise InputError("--no-resume", f"is given, but {quoted(str(path))} exists already; give another folder with --store")
    definition = load_study(study)
    try:
        with output.progress() as progress:

            def report(now: Progress) -> None:
                progress(_progress_text(now), now.done / now.cases)

            result = run_study(definition, path, workers=workers, scheduler=scheduler, timeout=timeout, report=report)
    except KeyboardInterrupt:
        click.echo(f"stopped: finished cases are saved in {path}; run the same command again to continue", err=True)
        raise
    output.figure("sweep.png", result.plot)
    _print_result(result, output, "sweep")


@command("show", "store")
@click.option("--measure", help="Name of the array to show [the regime if it was measured, otherwise the first array].")
@click.option("--over", nargs=2, metavar="X Y", help="Names of the two axes of the map.")
@click.option(
    "--theory/--no-theory", default=True, help="Draw the lines on which exact jams have a fold or lose their stability."
)
def show(store: Path, measure: str | None, over: tuple[str, str] | None, theory: bool, output: Output) -> None:
    """Summarize a STORE of `jaxvib sweep`; --out adds the figures that fit the study: map.png, shares.png, distribution.png,
    tornado.png."""
    from jaxvib.sweeps.sweep import open_sweep

    result = open_sweep(store)
    if all(status == "missing" for status, _ in result.counts):
        note("note: no figures, because no case was computed: continue the study with jaxvib sweep")
    elif output.folder is not None or output.report is not None:
        from jaxvib.sweeps.figures import figures

        x, y = over or (None, None)
        for name, figure in figures(store, measure, x=x, y=y, theory=theory):
            output.figure(f"{name}.png", lambda drawn=figure: drawn)
    _print_result(result, output, "show")


def _print_result(result: Sweep, output: Output, name: str) -> None:
    from jaxvib.sweeps.results import results_table  # slow import, which --help does not need

    def text() -> str:
        title, heads, results = results_table(result.store)
        return "\n".join([result.summary(), *([table(title, heads, results)] if results else [])])

    output.done(result.as_dict(), text, name, result)


def _progress_text(now: Progress) -> str:
    return f"{now.done} of {now.cases} cases, {now.rate:.3g} a second, {duration_text(now.left)} left"
