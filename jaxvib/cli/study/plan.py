"""Command `plan` of jaxvib."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, table
from jaxvib.cli.output import fields_of
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.identification.further_runs.plan import RunPlan


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
    document |= fields_of(plan, "candidates", "numbers", "errors", "now", "minutes", "benefit")
    document["profile"] = None if profile is None else fields_of(profile, "times", "speeds")

    output.done(document, lambda: _text(plan), "plan", plan)


def _text(plan: RunPlan) -> str:
    """Return the candidates of a plan, the expected errors in percent, and the optimized speed, as tables."""
    from jaxvib.display import speed_text  # slow import, which --help does not need

    runs, errors = [], [["so far", *map(_percent, plan.now)]]
    for k, (name, minutes, benefit) in enumerate(zip(plan.candidates, plan.minutes, plan.benefit, strict=True)):
        runs.append([f"{k + 1} {name}", f"{minutes:.3g}", f"{benefit:.3g}"])
        errors.append([str(k + 1), *map(_percent, plan.errors[k])])
    lines = [table("candidate runs, the best one first", ["run", "minutes", "benefit per minute"], runs)]
    lines += [f"({k + 1}) {name}" for k, name in enumerate(plan.numbers)]
    heads = ["run", *(f"({k + 1})" for k in range(len(plan.numbers)))]
    lines.append(table("expected relative standard errors after the run, %; -: not determined", heads, errors))
    if plan.profile is not None:
        points = zip(plan.profile.times.tolist(), plan.profile.speeds.tolist(), strict=True)
        rows = [[f"{t:.4g}", speed_text(speed, 4)] for t, speed in points]
        lines.append(table("optimized speed, linear between these times", ["time, s", "speed"], rows))
    return "\n".join(lines)


def _percent(error: float) -> str:
    if not math.isfinite(error):
        return "-"
    return f"{100.0 * error:.2g}" if error < 0.995 else f"{100.0 * error:.0f}"
