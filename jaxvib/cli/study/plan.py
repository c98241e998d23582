"""Command `plan` of jaxvib."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, table
from jaxvib.cli.output import fields_of
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.identification.further_runs.plan import RunPlan

_COLUMNS, _BORDERS, _SO_FAR = 80, 4, 9
"""Widths in characters: of a table, of the borders of its first column, and of its column "so far" with a border."""


@command("plan", "identification")
@click.option("--fit", type=click.Path(path_type=Path), help="File fit.npz of `jaxvib identify`, in place of a new fit.")
def plan(identification: Path, fit: Path | None, output: Output) -> None:
    """Rank the candidate runs of an IDENTIFICATION file by the reduction of the expected errors of the unknown parameters per
    minute of the run.

    The file names the runs recorded so far, as for `identify`, and has a table [[candidate]] for each run that could be
    recorded next: a run-up, a run at constant speed or a coast-down, other places of sensors, or changed parameters of the
    machine, such as an added mass. With the table [limits], the speed of the best candidate over time is optimized for the
    smallest expected errors."""
    from jaxvib.exchange.recordings.fit_file import fit_from_tables  # slow imports, which --help does not need
    from jaxvib.machine.files import read_toml

    fit_input = fit_from_tables(read_toml(identification), identification.parent)
    if not fit_input.candidates:
        raise InputError("candidate", "is missing; write [[candidate]] for each run that could be recorded next")
    machine_fit = (
        jv.load(fit) if fit else jv.identify(fit_input.scene, fit_input.runs, unknown=fit_input.unknown, known=fit_input.known)
    )
    if not isinstance(machine_fit, jv.MachineFit):
        raise InputError("--fit", f"is a file of {type(machine_fit).__name__}; it must be a fit.npz of jaxvib identify")
    plan = jv.plan_runs(machine_fit, fit_input.candidates, fit_input.limits)
    output.figure("plan.png", plan.plot)
    output.save_result("plan.npz", plan)
    profile = plan.profile
    document = {"status": plan.status_name, "message": plan.message}
    document |= fields_of(plan, "candidates", "numbers", "errors", "errors_low", "errors_high", "now", "minutes", "benefit")
    document["profile"] = None if profile is None else fields_of(profile, "times", "speeds")

    output.done(document, lambda: _text(plan), "plan", plan)


def _text(plan: RunPlan) -> str:
    """Return the candidates of a plan, the expected errors in percent, and the optimized speed, as tables and notes."""
    from jaxvib.display import speed_text  # slow import, which --help does not need

    values = zip(plan.candidates, 60.0 * plan.minutes, plan.reduction, plan.benefit, strict=True)
    runs = [
        [f"{k} {name}", f"{t:.4g}", f"{ratio:.3g}", f"{benefit:.3g}"] for k, (name, t, ratio, benefit) in enumerate(values, 1)
    ]
    title = (
        "candidate runs, the best one first; error ratio: error so far / error after the run, geometric mean over the "
        "parameters; benefit: sum of the logarithms of these ratios; errors above 100 % count as 100 %"
    )
    lines = [table(title, ["run", "time, s", "error ratio", "benefit per minute"], runs)]
    lines += [*_error_tables(plan), *_notes(plan)]
    if plan.profile is not None:
        points = zip(plan.profile.times.tolist(), plan.profile.speeds.tolist(), strict=True)
        rows = [[f"{t:.4g}", speed_text(speed, 4)] for t, speed in points]
        lines.append(table("optimized speed, linear between these times", ["time, s", "speed"], rows))
    return "\n".join(lines)


def _error_tables(plan: RunPlan) -> list[str]:
    """Return tables of the expected errors, with a line for each parameter and as many runs as fit into a table."""
    title = "expected standard errors after each run, % of the parameter (-: not determined"
    title += "; two numbers: range over the machines that the runs so far leave possible)" if plan.has_wide_range.any() else ")"
    tables, empty = [], _COLUMNS - _BORDERS - _SO_FAR - max(map(len, plan.numbers))
    first = [["parameter", *plan.numbers], ["so far", *map(_percent, plan.now)]]
    columns = [
        [f"run {run + 1}", *(_error_text(plan, run, k) for k in range(len(plan.numbers)))] for run in range(len(plan.errors))
    ]
    while columns:
        shown, room = list(first), empty
        while columns and (len(shown) == len(first) or max(map(len, columns[0])) + 3 <= room):
            room -= max(map(len, columns[0])) + 3
            shown.append(columns.pop(0))
        heads, *rows = map(list, zip(*shown, strict=True))
        tables.append(table(title, heads, rows))
        title = "further runs"
    return tables


def _error_text(plan: RunPlan, run: int, k: int) -> str:
    if not plan.has_wide_range[run, k]:
        return _percent(plan.errors[run, k])
    return f"{_percent(plan.errors_low[run, k])} to {_percent(plan.errors_high[run, k])}"


def _notes(plan: RunPlan) -> list[str]:
    """Return sentences about wide ranges and about parameters that no candidate determines."""
    notes = []
    if plan.has_wide_range.any():
        notes.append("The runs so far leave the machine uncertain: record run 1, fit all runs again, and repeat the plan.")
    undetermined = [
        name for name, errors in zip(plan.numbers, plan.errors.T, strict=True) if not any(map(math.isfinite, errors))
    ]
    if undetermined:
        advice = (
            "add a candidate with another sensor, an added mass or a higher speed, give a value as known, or, if the fitted "
            "value is near 0, fit again from another first value"
        )
        notes.append(f"No candidate determines {', '.join(undetermined)}: {advice}.")
    return [textwrap.fill(each, _COLUMNS) for each in notes]


def _percent(error: float) -> str:
    if not math.isfinite(error):
        return "-"
    return f"{100.0 * error:.2g}" if error < 0.995 else f"{100.0 * error:.0f}"
