"""jaxvib stress."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, app, shared, table

if TYPE_CHECKING:
    from jaxvib.study.stress.case import Precision, StressRow

_PRECISIONS: tuple[Precision, ...] = ("float64", "float32")


@app.command("stress")
@click.option("--only", multiple=True, metavar="NAME", help="A case, or a part of names, repeatable [all].")
@click.option("--precision", "precisions", multiple=True, type=click.Choice(_PRECISIONS), help="Repeatable [both].")
@click.option("--list", "listing", is_flag=True, help="Say what the cases are, and ask none.")
@shared
@click.pass_context
def stress(
    context: click.Context, only: tuple[str, ...], precisions: tuple[Precision, ...], listing: bool, output: Output
) -> None:
    """Hard cases against independent references: right, with the error, or a named status; minutes. Exit code 1: one failed."""
    if listing:
        from jaxvib.study.stress.run import CATALOGUE  # slow to import, and --help needs none of it

        cases = [dict(case=c.name, quantity=c.quantity, against=c.against, hard=c.hard) for c in CATALOGUE]
        text = "\n".join(f"{c.name}: {c.hard}\n    {c.quantity}; {c.against}" for c in CATALOGUE)
        output.done({"cases": cases}, lambda: text, "cases")
        return

    def report(row: StressRow) -> None:
        click.echo(f"{row.case}, {row.dtype}: {row.verdict}", err=True)

    found = jv.stress(only, precisions=precisions or _PRECISIONS, report=report)
    output.picture("stress.png", found.plot)
    output.done(found.as_dict(), lambda: f"{_table(found)}\n{found.summary()}", "stress", found)
    if found.failures:
        context.exit(1)


def _table(found: jv.Stress) -> str:
    def shown(value: float) -> str:
        return "" if value != value else f"{value:.1e}"

    head = ["case", "precision", "ended", "error", "claimed", "bound", "s"]
    rows = [
        [row.case, row.dtype, row.verdict, shown(row.error), shown(row.claimed), shown(row.bound), f"{row.seconds:.1f}"]
        for row in found.rows
    ]
    return table("hard cases", head, rows)
