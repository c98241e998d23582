"""jaxvib reproduce."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, app, shared, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaxvib.study.published.entry import PublishedRow


@app.command("reproduce")
@click.argument("papers", nargs=-1, metavar="[PAPER]...")
@click.option("--full", is_flag=True, help="All six rows of the torus paper's tables in place of one; minutes more.")
@click.option("--list", "listing", is_flag=True, help="Say what the papers are, and compute nothing.")
@shared
@click.pass_context
def reproduce(context: click.Context, papers: tuple[str, ...], full: bool, listing: bool, output: Output) -> None:
    """Numbers that the source papers print beside computed ones, with verdicts; PAPER is antiphase, criterion, rotor, torus or
    bearing [all, some minutes]. --out draws their figures again. Exit code 1: a verdict is not the one that is known."""
    from jaxvib.study.published.run import PAPERS  # slow to import, and --help needs none of it

    if listing:
        output.done({"papers": PAPERS}, lambda: "\n".join(f"{name}: {about}" for name, about in PAPERS.items()), "papers")
        return

    def figure(name: str, draw: Callable[[], Figure]) -> None:
        output.picture(f"{name}.png", draw)

    found = jv.reproduce(papers, full=full, report=lambda name: click.echo(f"{name}: computing", err=True), figure=figure)
    output.picture("reproduce.png", found.plot)
    output.done(found.as_dict(), lambda: _text(found), "reproduce", found)
    if found.unexpected:
        context.exit(1)


def _text(found: jv.Reproduced) -> str:
    return "\n".join([*(_table(name, found.of(name)) for name in found.papers), found.summary()])


def _table(paper: str, rows: list[PublishedRow]) -> str:
    from jaxvib.study.published.run import PAPERS

    def shown(value: float, unit: str = "") -> str:
        return "" if math.isnan(value) else f"{value:.6g} {unit}".rstrip()

    cells = [
        [f"{row.place}: {row.quantity}", shown(row.printed, row.unit), shown(row.computed), _difference(row), row.verdict]
        for row in rows
    ]
    return table(f"{paper}: {PAPERS[paper]}", ["quantity", "printed", "computed", "difference", "verdict"], cells)


def _difference(row: PublishedRow) -> str:
    return "" if math.isnan(row.difference) else f"{row.difference:+.1e}"
