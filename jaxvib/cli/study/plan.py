"""Command `plan` of jaxvib."""

from __future__ import annotations

from pathlib import Path

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, table
from jaxvib.cli.output import fields_of
from jaxvib.errors import InputError


@command("plan", "identification")
@click.option("--fit", type=click.Path(path_type=Path), help="File fit.npz of `jaxvib identify`, in place of a new fit.")
def plan(identification: Path, fit: Path | None, output: Output) -> None:
    """Rank the candidate runs of an IDENTIFICATION file by the reduction of the expected errors of the unknown parameters per
    minute of the run.

    The file names the runs recorded so far, as for `identify`, and has a table [[candidate]] for each run that could be
    recorded next: a run-up, a run at constant speed or a coast-down, other places of sensors, or changed parameters of the
    machine, such as an added mass. With the table [limits], the speed of the best candidate over time is optimized for the
    smallest expected errors."""
    import numpy as np  # slow imports, which --help does not need

    from jaxvib.display import speed_text
    from jaxvib.exchange.recordings.fit_file import fit_from_tables
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

    def text() -> str:
        def error_text(error: float) -> str:
            return f"{error:.2g}" if np.isfinite(error) else "-"

        rows = [["so far", "", "", *map(error_text, plan.now)]]
        for name, minutes, benefit, errors in zip(plan.candidates, plan.minutes, plan.benefit, plan.errors, strict=True):
            rows.append([name, f"{minutes:.3g}", f"{benefit:.3g}", *map(error_text, errors)])
        heads = ["run", "minutes", "benefit per minute", *(f"({k + 1})" for k in range(len(plan.numbers)))]
        lines = [f"({k + 1}) {name}" for k, name in enumerate(plan.numbers)]
        lines.append(table("expected relative standard errors; -: not determined", heads, rows))
        if profile is not None:
            points = zip(np.asarray(profile.times), np.asarray(profile.speeds), strict=True)
            parts = [[f"{t:.4g}", speed_text(float(n), 4)] for t, n in points]
            lines.append(table("optimized speed, linear between these times", ["time, s", "speed"], parts))
        return "\n".join(lines)

    output.done(document, text, "plan", plan)
