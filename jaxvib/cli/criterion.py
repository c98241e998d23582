"""jaxvib criterion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import WITHOUT, Output, app, loaded_scene, shared, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@app.command("criterion")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--check", is_flag=True, help="Add the exact boundaries, from Floquet multipliers of the full equations.")
@WITHOUT
@shared
def criterion(scene: Path, check: bool, without: tuple[str, ...], output: Output) -> None:
    """List the rotor speeds at which the loads of SCENE gather, and those at which they spread and balance the rotor, according
    to the empirical criterion."""
    from jaxvib.steady.balance.criterion import criterion_table  # slow import, which --help does not need
    from jaxvib.steady.balance.states import balanced_intervals

    loaded = loaded_scene(scene, without)
    judged = jv.criterion(loaded)
    document = criterion_table(judged)
    top = 1.5 * max([*document["resonances"], *document["damped_resonances"], float(loaded.drive.speed)])
    exact = None
    if check:
        lowest = min((w for w in document["resonances"] if w > 0.0), default=top)
        exact = balanced_intervals(loaded, 0.05 * lowest, top)
        document["exact_balancing"] = exact
        document["exact_up_to"] = top

    def figure() -> Figure:
        import jax
        import jax.numpy as jnp
        import numpy as np

        from jaxvib.draw.criterion import criterion_chart
        from jaxvib.draw.style import panels
        from jaxvib.steady.balance.criterion import criterion_functional

        crowd = np.concatenate([w + np.geomspace(1e-4, 0.2, 60) * w * s for w in document["resonances"] for s in (-1, 1)])
        speeds = np.unique(np.clip(np.concatenate([np.linspace(1e-3, 1.0, 1200) * top, crowd]), 1e-3 * top, top))
        pull = jax.vmap(lambda w: criterion_functional(loaded, w))(jnp.asarray(speeds))
        figure, (axis,) = panels(1)
        criterion_chart(axis, speeds, np.asarray(pull), document["balancing"], exact, float(loaded.drive.speed))
        return figure

    output.picture("criterion.png", figure)

    def text() -> str:
        from jaxvib.display import speed_text, speed_unit  # slow import, which --help does not need

        unit, scale = speed_unit()
        rows = [[label, f"{scale * w:.6g}"] for label, w in judged.speeds.labelled()]
        damped = [[label, f"{scale * w:.6g}"] for label, w in judged.speeds.labelled(damped=True)]
        kinds = [("balancing", "loads spread and balance"), ("gathering", "loads stay together")]
        spans = [[words, *_ends(span, scale)] for name, words in kinds for span in document[name]]
        spans += [["balancing, exactly", *_ends(span, scale)] for span in exact or []]
        lines = [
            document["status"],
            table("characteristic speeds, no damping", ["", unit], rows),
            table("sign changes with this damping", ["", unit], damped),
            table("rotor speeds", ["", f"from, {unit}", f"to, {unit}"], spans),
        ]
        if check:
            lines.append(f"exact stability was computed up to {speed_text(top)}")
        return "\n".join(lines)

    output.done(document, text, "criterion", judged)


def _ends(span: Sequence[float | None], scale: float) -> list[str]:
    return ["no end" if end is None else f"{scale * end:.6g}" for end in span]
