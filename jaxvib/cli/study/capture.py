"""Command `capture` of jaxvib."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, loaded_scene, table
from jaxvib.cli.output import fields_of

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

    from jaxvib.motion.start import Rotation


@command("capture")
@click.option(
    "--from",
    "low",
    type=float,
    default=-1.0,
    help="Lowest initial speed of the balls relative to the rotor, divided by the rotor speed: -1 for balls at rest, 0 for "
    "balls that turn with the rotor.",
)
@click.option("--to", "high", type=float, default=0.0, help="Highest initial speed, as for --from.")
@click.option("--speeds", type=click.IntRange(min=2), default=32, help="Number of initial speeds.")
@click.option(
    "--starts",
    type=click.IntRange(min=1),
    default=1,
    help="Number of initial states at each speed; all but the first are perturbed.",
)
@click.option("--turns", type=click.IntRange(min=1), default=2000, help="Duration of each run, in turns of the rotor.")
@click.option(
    "--resolution", type=float, help="Resolution of the threshold, divided by the rotor speed [spacing of the speeds]."
)
@click.option(
    "--rotation",
    type=click.Choice(["rolling", "none"]),
    default="rolling",
    help="Initial rotation of the balls: rolling, or none, so that they slide at first (needs the effect sliding).",
)
@click.option("--all", "show_all", is_flag=True, help="List every initial speed.")
def capture(
    scene: Path,
    low: float,
    high: float,
    speeds: int,
    starts: int,
    turns: int,
    resolution: float | None,
    rotation: Rotation,
    show_all: bool,
    output: Output,
) -> None:
    """Find the initial speeds from which the balls in a torus of SCENE reach the rotor speed; --out adds figures."""
    import numpy as np  # slow import, which --help does not need

    if not -1.0 <= low < high <= 0.0:
        raise jv.InputError("--from", f"is {low:g} with --to {high:g}; the speeds must ascend and lie between -1 and 0")
    loaded = loaded_scene(scene)
    result = jv.capture(
        loaded, np.linspace(low, high, speeds), turns=turns, starts=starts, resolution=resolution, rotation=rotation
    )
    output.figure("capture.png", result.plot)

    def paths() -> Figure:
        from jaxvib.draw.capture import torus_paths
        from jaxvib.study.capture.capture import moving_state

        # One run starts just above the threshold, or at the highest speed if no threshold was found.
        speed = (
            min(high, float(result.threshold) + 2.0 * float(result.uncertainty)) if math.isfinite(result.threshold) else high
        )
        until = 2.0 * math.pi * min(turns, 400) / float(loaded.drive.speed)
        run = jv.simulate(loaded, until, start=jv.with_spin(loaded, moving_state(loaded, speed), rotation), estimate=False)
        trajectory = run.trajectory
        assert trajectory is not None
        relative_angle = np.asarray(trajectory.state.azimuth) - np.asarray(trajectory.rotor_angle)[:, None]
        rate = np.asarray(trajectory.state.azimuth_rate) / np.asarray(trajectory.rotor_speed)[:, None] - 1.0
        return torus_paths(relative_angle, np.asarray(trajectory.state.angle[1]), rate, np.asarray(trajectory.time))

    output.figure("paths.png", paths)

    def text() -> str:
        rows = [
            [f"{v:.5f}", f"{f:.3f}", f"{e:.3f}" if starts > 1 else ""]
            for v, f, e in zip(result.speed, result.fraction, result.standard_error, strict=True)
        ]
        head = ["initial speed / rotor speed", "fraction captured", "standard error"]
        rows = [row for k, row in enumerate(rows) if show_all or _is_near_change(result.fraction, k)]
        title = "starts captured" if show_all else "starts captured, where the fraction changes (all speeds: --all)"
        return result.summary() + "\n" + table(title, head, rows)

    document = {**result.as_dict(), **fields_of(result, "fraction", "standard_error")}
    output.done(document, text, "capture", result)


def _is_near_change(fraction: np.ndarray, k: int) -> bool:
    """Return True for the first and the last speed, and for speeds at which the fraction differs from that of a neighbour."""
    return k in (0, len(fraction) - 1) or fraction[k] != fraction[k - 1] or fraction[k] != fraction[k + 1]
