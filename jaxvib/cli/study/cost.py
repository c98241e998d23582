"""Command `cost` of jaxvib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import jaxvib as jv
from jaxvib.cli.app import SPEED, Output, command, loaded_scene, table
from jaxvib.cli.output import fields_of

if TYPE_CHECKING:
    from jaxvib.study.accuracy.cost import Cost, CostRow
    from jaxvib.study.accuracy.work_precision import Quantity

_QUANTITIES = ("amplitude", "foundation_force", "final_state", "gradient")
_SOLVERS = ("default", "Tsit5", "Dopri8")
"""Names in `jaxvib.study.accuracy.work_precision`, repeated here because its import is slow."""


@command("cost")
@click.option("--quantity", type=click.Choice(_QUANTITIES), default="amplitude", help="Computed quantity.")
@click.option("--mode", type=int, help="Number of the jam mode [second-highest of those that are stable by slope].")
@click.option(
    "--until",
    help="Duration of the time integration, such as 20s [20 periods of the lowest natural frequency; for a jam, until "
    "transients decay].",
)
@click.option(
    "--solver", "solvers", type=click.Choice(_SOLVERS), multiple=True, help="Method of time integration; repeatable [all]."
)
@click.option("--repeats", type=click.IntRange(min=1), default=3, help="Number of timings; the fastest is reported.")
@SPEED
def cost(
    scene: Path,
    quantity: Quantity,
    mode: int | None,
    until: str | None,
    solvers: tuple[str, ...],
    repeats: int,
    speed: str | None,
    output: Output,
) -> None:
    """Measure the cost of accuracy for SCENE: error and computing time of every method; --out adds the figure."""
    options: dict[str, Any] = dict(mode=mode, until=until, solvers=solvers or _SOLVERS, repeats=repeats)
    loaded = loaded_scene(scene, speed=speed)
    with output.progress() as progress:
        result = jv.work_precision(loaded, quantity, progress=progress, **options)
    output.figure("cost.png", result.plot)
    output.done(cost_document(result), lambda: cost_table(result), "cost", result)


def cost_document(cost: Cost) -> dict[str, object]:
    """Return the contents of a `Cost` for JSON."""
    from jaxvib.study.accuracy.cost import SHOWN_ERRORS

    return {
        **fields_of(cost, "quantity", "reference", "reference_error", "rows", "left_out"),
        "cheapest": {f"{error:.0e}": cost.cheapest(error) for error in SHOWN_ERRORS},
    }


def cost_table(cost: Cost) -> str:
    """Return a `Cost` as text."""
    from jaxvib.study.accuracy.cost import SHOWN_ERRORS

    head = ["tier", "method", "precision", "setting", "error", "seconds", "first call, s"]
    rows = [
        [row.tier, row.method, row.dtype, row.setting, f"{row.error:.1e}", f"{row.seconds:.2e}", f"{row.compile:.2f}"]
        for row in cost.rows
    ]
    title = f"{cost.quantity.replace('_', ' ')}; the reference has an error of {cost.reference_error:.1e}"
    chosen = [[f"{error:.0e}", *_method_columns(cost.cheapest(error))] for error in SHOWN_ERRORS]
    parts = [table(title, head, rows), table("fastest method", ["error", "method", "seconds"], chosen)]
    return "\n".join(parts + [f"left out: {reason}" for reason in cost.left_out])


def _method_columns(row: CostRow | None) -> list[str]:
    if row is None:
        return ["no method is this accurate, or the reference itself is not", ""]
    return [", ".join(part for part in (row.tier, row.method, row.dtype, row.setting) if part), f"{row.seconds:.2e}"]
