"""Command `audit` of jaxvib."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import jaxvib as jv
from jaxvib.cli.app import WITHOUT, Output, command, loaded_scene, table
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.study.audit.compared import EffectRow
    from jaxvib.study.audit.operation_counts import OperationCount


@command("audit", required=False)
@click.option("--accuracy", default="1%", help="Relative change below which an effect is negligible.")
@click.option("--mode", type=int, help="Number of the jam mode [second-highest of those that are stable by slope].")
@click.option(
    "--until",
    help="Duration of the run if no jam is compared, such as 20s [100 periods of the lowest natural frequency, plus twice the "
    "duration of a run-up].",
)
@click.option(
    "--start",
    type=click.Choice(["rest", "turning"]),
    help="Compare a run from this initial state in place of a jam; turning: loads evenly spread, at the rotor speed.",
)
@click.option("--add-missing/--no-add-missing", default=True, help="Also add each effect that the scene does not have.")
@click.option(
    "--tiers/--no-tiers",
    default=True,
    help="Compare all tiers: leading order, averaged equations, exact orbit, full equations.",
)
@click.option("--repeats", type=click.IntRange(min=0), default=3, help="Number of timings; the fastest is reported.")
@click.option(
    "--operations",
    "count_operations",
    is_flag=True,
    help="Without SCENE: count the operations of effects, drives, machines and loads.",
)
@WITHOUT
def audit(
    scene: Path | None,
    accuracy: str,
    add_missing: bool,
    count_operations: bool,
    without: tuple[str, ...],
    output: Output,
    **options: Any,
) -> None:
    """List how much each effect and each tier (method) changes the results of SCENE, and the computing time of each.

    The list shows which effects are negligible or missing. The effects of the scene are removed one at a time, and effects that
    the scene lacks are added one at a time, with typical values. --out adds the figure."""
    if count_operations:
        from jaxvib.study.audit.operation_counts import operation_counts  # slow import, which --help does not need

        if scene is not None:
            raise InputError("--operations", "cannot be combined with a scene; leave one of them out")
        rows = operation_counts()
        output.done({"operations": rows}, lambda: _operations_table(rows), "operations")
        return
    if scene is None:
        raise InputError("SCENE", "is missing; give the path of a scene file, or --operations")
    from jaxvib.units import number

    share = float(number(accuracy.replace("%", "percent") if accuracy.endswith("%") else accuracy, "", "--accuracy"))
    loaded = loaded_scene(scene, without)
    with output.progress() as progress:
        result = jv.audit(loaded, accuracy=share, possible=None if add_missing else (), progress=progress, **options)
    if result.effects:
        output.figure("audit.png", result.plot)
    output.done(result.as_dict(), lambda: audit_text(result), "audit", result)


def audit_text(result: jv.Audit) -> str:
    """Return the tables and notes of an `Audit` as text."""
    time_text = (
        "" if math.isnan(result.seconds) else f", a run of 100 turns {result.seconds:.2g} s, compiled in {result.compile:.2g} s"
    )
    lines = [
        f"{result.motion}: {result.kind}; {result.message}",
        f"equations of motion: {result.operations} operations{time_text}",
    ]
    if result.effects:
        heading = f"changes by effects, %; requested accuracy {100.0 * result.accuracy:g} %"
        absent = any(not row.present for row in result.effects)
        head = ["effect", "advice", "amplitude", "force", "load speed", "fold", "tier"]
        changes = [_changes(row) for row in result.effects]
        lines.append(table(f"{heading}; in brackets: added effects" if absent else heading, head, changes))
        head = ["effect", "operations", "time of a run", "time to compile"]
        lines.append(table("cost of effects", head, [_cost(row, result) for row in result.effects]))
    lines += [f"{row.effect.replace('_', ' ')}: {row.note}" for row in result.effects if row.note]
    tier_rows = [
        [t.tier, *map(_percent, (t.amplitude, t.foundation_force, t.omega)), _seconds(t.seconds), _seconds(t.compile)]
        for t in result.tiers
    ]
    if tier_rows:
        lines.append(
            table("tiers: error, %", ["tier", "amplitude", "force", "load speed", "seconds", "first call, s"], tier_rows)
        )
    lines += [f"{t.tier}: {t.note}" for t in result.tiers]
    if result.numbers:
        numbers = [[n.name, f"{n.value:.3g}", f"{n.limit:.3g}", n.advice] for n in result.numbers]
        lines.append(
            table(
                "effects that are not in the scene, estimated by dimensionless numbers",
                ["number", "value", "limit", "advice"],
                numbers,
            )
        )
        lines += [f"{n.name.partition(':')[0]}: {n.note}" for n in result.numbers]
    return "\n".join(lines)


def _name(row: EffectRow) -> str:
    name = row.effect.replace("_", " ")
    return name if row.present else f"({name})"


def _changes(row: EffectRow) -> list[str]:
    changes = map(_percent, (row.amplitude, row.foundation_force, row.omega, row.fold))
    return [_name(row), row.advice, *changes, row.tier.replace("exact orbit", "exact")]


def _cost(row: EffectRow, result: jv.Audit) -> list[str]:
    cost = [f"{row.operations:+d}"]
    for added_time, total_time in ((row.seconds, result.seconds), (row.compile, result.compile)):
        cost.append("" if math.isnan(added_time) else f"{100.0 * added_time / total_time:+.0f} %")
    return [_name(row), *cost]


def _percent(share: float) -> str:
    return "" if math.isnan(share) else f"{100.0 * share:+.2g}"


def _seconds(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2g}"


def _operations_table(rows: list[OperationCount]) -> str:
    cells = [[f"{row.part}: {row.kind}", f"{row.operations}", f"{row.added:+d}", row.reference] for row in rows]
    title = "operations of the traced equations of motion; an operation on a vector counts once"
    return table(title, ["part", "operations", "added", "compared with"], cells)
