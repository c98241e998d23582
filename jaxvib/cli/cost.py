"""jaxvib cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import jaxvib as jv
from jaxvib.cli.app import Output, app, shared, table
from jaxvib.study.accuracy import QUANTITIES, CostRow

_WANTED = (1e-2, 1e-4, 1e-6)


@app.command("cost")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--quantity", type=click.Choice(QUANTITIES), default="amplitude", show_default=True, help="What is computed.")
@click.option("--mode", type=int, help="Number of the jam mode [the last below the rotor's own speed that is stable].")
@click.option("--until", help="End of the time integration, such as 20s [20 slow periods].")
@click.option("--repeats", type=click.IntRange(min=1), default=3, show_default=True, help="Timings; the fastest counts.")
@shared
def cost(scene: Path, quantity: Any, mode: int | None, until: str | None, repeats: int, output: Output) -> None:
    """What accuracy costs in time on SCENE: error against seconds, in every way; --out adds the figure."""
    found = jv.accuracy(jv.load_scene(scene), quantity, mode=mode, until=until, repeats=repeats)
    best = {f"{error:.0e}": found.cheapest(error) for error in _WANTED}
    picture = output.file("cost.png")
    if picture is not None:
        found.plot().savefig(picture)
    document = {
        "quantity": found.quantity,
        "reference": found.reference,
        "reference_error": found.reference_error,
        "rows": [row._asdict() for row in found.rows],
        "cheapest": {error: None if row is None else row._asdict() for error, row in best.items()},
    }

    def text() -> str:
        head = ["tier", "method", "precision", "setting", "error", "seconds", "first call, s"]
        rows = [
            [row.tier, row.method, row.dtype, row.setting, f"{row.error:.1e}", f"{row.seconds:.2e}", f"{row.compile:.2f}"]
            for row in found.rows
        ]
        title = f"{found.quantity.replace('_', ' ')}; the reference itself is good to {found.reference_error:.1e}"
        chosen = [[error, *_named(row)] for error, row in best.items()]
        return table(title, head, rows) + "\n" + table("cheapest", ["error", "way", "seconds"], chosen)

    output.done(document, text, "cost")


def _named(row: CostRow | None) -> list[str]:
    if row is None:
        return ["none of these, or the reference cannot tell", ""]
    return [", ".join(part for part in (row.tier, row.method, row.dtype, row.setting) if part), f"{row.seconds:.2e}"]
